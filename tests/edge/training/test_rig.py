"""The rig of a run's data: kept where it is not the preset's, refused where there are two, read back by export."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from safetensors.torch import save_file  # noqa: E402

from edge.detector.presets import KITTI_BASELINE_M, preset  # noqa: E402
from edge.simulation.rig import kitti_rig, oak_d_rig  # noqa: E402
from edge.training.rig import rig_metadata, with_rig_of, with_rig_of_data  # noqa: E402
from runtime.contracts.errors import CheckpointError, RigError  # noqa: E402
from runtime.contracts.frame import StereoFrame  # noqa: E402
from runtime.contracts.geometry import StereoGeometry  # noqa: E402
from runtime.rig import check_rig  # noqa: E402

pytestmark = pytest.mark.torch
OAK_BASELINE_M = 0.075


class _Recording:
    """One black frame of a rig, or none."""

    def __init__(self, geometry: StereoGeometry, frames: int = 1) -> None:
        self._geometry, self._frames = geometry, frames

    def __len__(self) -> int:
        return self._frames

    def __getitem__(self, index: int) -> StereoFrame:
        width, height = self._geometry.image_size_wh
        view = np.zeros((height, width, 3), np.uint8)
        return StereoFrame(view, view, timestamp_secs=0.0, sequence=0, frame_id="0", geometry=self._geometry)


def test_without_frames_the_presets_rig_stays() -> None:
    compact = preset("compact")
    assert with_rig_of_data(compact, []) is compact
    assert with_rig_of_data(compact, [_Recording(oak_d_rig(), frames=0)]) is compact


def test_kittis_own_rig_changes_nothing() -> None:
    for name in ("compact", "paper"):
        assert with_rig_of_data(preset(name), [_Recording(kitti_rig())]) is preset(name)


def test_another_baseline_is_kept_and_the_runtime_accepts_that_rig_alone() -> None:
    chosen = with_rig_of_data(preset("compact"), [_Recording(oak_d_rig())])
    assert chosen.rig.baseline_m == pytest.approx(OAK_BASELINE_M)
    assert chosen.rig.focal_px == preset("compact").rig.focal_px
    seen = oak_d_rig().scale((0.65, 0.65), (832, 260))
    assert check_rig(seen, chosen.rig, stereo=True, allow=False) is None
    with pytest.raises(RigError, match="baseline"):
        check_rig(seen, preset("compact").rig, stereo=True, allow=False)


def test_two_rigs_in_one_run_are_refused() -> None:
    with pytest.raises(RigError, match=r"0\.075 m"):
        with_rig_of_data(preset("compact"), [_Recording(kitti_rig()), _Recording(oak_d_rig())])


def test_weights_name_their_rig(tmp_path: Path) -> None:
    trained = with_rig_of_data(preset("compact"), [_Recording(oak_d_rig())])
    weights = {"weight": torch.zeros(1)}
    for name, metadata in (("new", rig_metadata(trained)), ("old", {"preset": "compact"}), ("bad", {"rig": "[]"})):
        save_file(weights, tmp_path / f"{name}.safetensors", metadata=metadata)
    assert with_rig_of(preset("compact"), tmp_path / "new.safetensors").rig == trained.rig
    assert with_rig_of(preset("compact"), tmp_path / "old.safetensors").rig.baseline_m == KITTI_BASELINE_M
    assert with_rig_of(preset("compact"), tmp_path / "run.pt") is preset("compact")
    with pytest.raises(CheckpointError, match="rig"):
        with_rig_of(preset("compact"), tmp_path / "bad.safetensors")
