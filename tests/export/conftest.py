"""A network like the detector in small: shared backbone, two correlations of different D, two outputs."""

from __future__ import annotations

import pytest

torch = pytest.importorskip("torch")
pytest.importorskip("onnx")

IMAGE_HW = (32, 96)
DISPARITIES = (7, 3)


OUTPUTS = ("cls_logits", "box_deltas")


@pytest.fixture
def two_view_network():  # type: ignore[no-untyped-def]
    """Seeded, with batch norms that do something, in eval mode; a new one each time."""
    return make_network()


@pytest.fixture(scope="session")
def exported() -> bytes:
    """Its finished graph."""
    from export.to_onnx import to_onnx

    return bytes(to_onnx(make_network(), make_views(), OUTPUTS).SerializeToString())


@pytest.fixture
def views():  # type: ignore[no-untyped-def]
    """Example inputs of it, float32, by name."""
    return make_views()


def make_views():  # type: ignore[no-untyped-def]
    generator = torch.Generator().manual_seed(1)
    return {name: torch.randn(1, 3, *IMAGE_HW, generator=generator) for name in ("left", "right")}


def make_network():  # type: ignore[no-untyped-def]
    from export.correlation import StereoCorrelation

    class TwoViews(torch.nn.Module):
        def __init__(self) -> None:
            super().__init__()
            self.stem = torch.nn.Sequential(
                torch.nn.Conv2d(3, 8, 3, stride=4, padding=1, bias=False), torch.nn.BatchNorm2d(8), torch.nn.ReLU()
            )
            self.next = torch.nn.Conv2d(8, 12, 3, stride=2, padding=1)
            self.fine, self.coarse = (StereoCorrelation(count) for count in DISPARITIES)
            self.classes = torch.nn.Conv2d(sum(DISPARITIES), 4, 1)
            self.boxes = torch.nn.Conv2d(sum(DISPARITIES), 24, 1)

        def forward(self, left, right):  # type: ignore[no-untyped-def]
            count = left.shape[0]
            fine = self.stem(torch.cat([left, right]))
            coarse = self.next(fine)
            volume = torch.nn.functional.avg_pool2d(self.fine(fine[:count], fine[count:]), 2)
            both = torch.cat([volume, self.coarse(coarse[:count], coarse[count:])], dim=1)
            return tuple(
                head(both).permute(0, 2, 3, 1).reshape(count, -1, width)
                for head, width in ((self.classes, 2), (self.boxes, 12))
            )

    torch.manual_seed(0)
    network = TwoViews()
    norm = network.stem[1]
    norm.running_mean.normal_(0, 0.2)
    norm.running_var.uniform_(0.5, 2)
    return network.eval()
