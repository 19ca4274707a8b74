"""Fixtures shared by all rooms' tests."""

from __future__ import annotations

from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parent.parent


@pytest.fixture(scope="session")
def shared_dir() -> Path:
    """The folder with reference recordings and real frames, beside the checkout; absent in a user's clone."""
    folder = REPOSITORY.parent / "shared"
    if not (folder / "reference").is_dir():
        pytest.skip("reference recordings and KITTI frames are not on this machine")
    return folder


@pytest.fixture(scope="session")
def reference_dir(shared_dir: Path) -> Path:
    """Recorded numbers of the official code."""
    return shared_dir / "reference"


@pytest.fixture(scope="session")
def kitti_dir(shared_dir: Path) -> Path:
    """Real KITTI frames, labels, published detections."""
    folder = shared_dir / "kitti"
    if not folder.is_dir():
        pytest.skip("KITTI frames are not on this machine")
    return folder
