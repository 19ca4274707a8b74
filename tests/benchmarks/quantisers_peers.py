"""The quantisers that are compared, each with the settings that its makers recommend for such a network and machine.

`edge quantize` runs as a user runs it, in a process of its own. ONNX Runtime quantises the exported graph as it is (the
correlation by its function body). NNCF drops function bodies, so its graph has the correlation in standard operators.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from quantize.errors import QuantizeError
from tests.benchmarks.quantisers_job import Feeds, Job, write_peer

REPOSITORY = Path(__file__).resolve().parents[2]
ORT_CHUNK = 8
"""Most frames whose activations ONNX Runtime's calibrators keep in memory at once."""


@dataclass(frozen=True, slots=True)
class Peer:
    """One quantiser with its settings.

    Attributes:
        title: what tables call it.
        settings: what is set beside defaults.
        needs: distribution that it comes from; None for our own.
        make: writes a model directory at a place.
        controlled: whether it looks at the control frames.
    """

    title: str
    settings: str
    needs: str | None
    make: Callable[[Job, Path], None]
    controlled: bool = False


class FrameReader:
    """Calibration frames in the form that ONNX Runtime asks for."""

    def __init__(self, feeds: list[Feeds]) -> None:
        self._feeds, self._next, self._end = feeds, 0, len(feeds)

    def __len__(self) -> int:
        return len(self._feeds)

    def set_range(self, start_index: int, end_index: int) -> None:
        """Give only these frames from now on."""
        self._next, self._end = start_index, end_index

    def get_next(self) -> Feeds | None:
        """The next frame; None behind the last."""
        if self._next >= self._end:
            return None
        self._next += 1
        return self._feeds[self._next - 1]


def largest_chunk(frames: int, most: int = ORT_CHUNK) -> int:
    """The largest size of equal chunks: ONNX Runtime takes no remainder."""
    return next(size for size in range(min(frames, most), 0, -1) if frames % size == 0)


def _onnxruntime(method: str) -> Callable[[Job, Path], None]:
    def make(job: Job, out: Path) -> None:
        from onnxruntime.quantization import CalibrationMethod, QuantFormat, QuantType, quantize_static

        def write_graph(place: Path) -> None:
            quantize_static(
                job.model.model_path,
                place,
                FrameReader(job.feeds()),  # type: ignore[arg-type]  # it asks for no more than these methods
                quant_format=QuantFormat.QDQ,
                per_channel=True,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                calibrate_method=CalibrationMethod[method],
                extra_options={"CalibStridedMinMax": largest_chunk(job.frames)},
            )

        write_peer(job.model, out, recipe=f"onnxruntime-{method.lower()}", write_graph=write_graph)

    return make


def _nncf(*, fast: bool = True, control: bool = False) -> Callable[[Job, Path], None]:
    def make(job: Job, out: Path) -> None:
        from tests.benchmarks.quantisers_nncf import quantised, quantised_with_control

        def write_graph(place: Path) -> None:
            import onnx

            onnx.save(quantised_with_control(job) if control else quantised(job, fast=fast), place)

        recipe = "nncf-control" if control else f"nncf-{'fast' if fast else 'slow'}-bias"
        write_peer(job.model, out, recipe=recipe, write_graph=write_graph)

    return make


def _edge(*options: str, control: bool = False) -> Callable[[Job, Path], None]:
    def make(job: Job, out: Path) -> None:
        command = [sys.executable, "-m", "edge", "quantize", str(job.model.path), "--no-cache"]
        command += ["--calibration", job.calibration, "--frames", str(job.frames), "--out", str(out), *options]
        if control:
            # NNCF's control frames, whichever calibrate
            command += ["--validation", job.control.uri, "--allow-overlap"]
            command += ["--max-disagreement", f"{job.control.max_disagreement:g}"]
        ran = subprocess.run(command, cwd=REPOSITORY, capture_output=True, text=True, check=False)
        if ran.returncode != 0:
            said = ran.stderr.strip().splitlines() or [f"exit code {ran.returncode}"]
            raise QuantizeError(said[-1])

    return make


PEERS: dict[str, Peer] = {
    "edge": Peer("edge quantize", "none", None, _edge()),
    "edge-minmax": Peer("edge quantize, minmax", "--method minmax", None, _edge("--method", "minmax")),
    "edge-budget": Peer("edge quantize, budget", "--max-disagreement", None, _edge(control=True), controlled=True),
    **{
        f"ort-{method.lower()}": Peer(
            f"ONNX Runtime, {method}", "QDQ, u8 activations, s8 weights by channel", "onnxruntime", _onnxruntime(method)
        )
        for method in ("MinMax", "Entropy", "Percentile", "Distribution")
    },
    "nncf": Peer("NNCF", "preset MIXED, fast bias correction", "nncf", _nncf()),
    "nncf-slow-bias": Peer(
        "NNCF, slow bias correction", "preset MIXED, fast_bias_correction=False", "nncf", _nncf(fast=False)
    ),
    "nncf-control": Peer(
        "NNCF, accuracy control",
        "preset MIXED, agreement with FP32 as accuracy",
        "nncf",
        _nncf(control=True),
        controlled=True,
    ),
}
"""By the name that ``--only`` takes, in the order of the table."""
