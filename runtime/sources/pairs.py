"""A sequence of image pairs in files: what all image layouts share."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.objects import Objects3D
from runtime.rig import load_geometry
from runtime.sources.base import DEFAULT_CAMERA_HZ, FrameSequence
from runtime.sources.pictures import read_content, read_image
from runtime.sources.uri import SourceOptions


@dataclass(frozen=True, slots=True)
class PairFiles:
    """Where one frame lies.

    Attributes:
        frame_id: its name; left, right: image files, right None for a single view; calibration: file that
            `runtime.rig.load_geometry` reads; timestamp_secs: on the recording's clock.
    """

    frame_id: str
    left: Path
    right: Path | None
    calibration: Path
    timestamp_secs: float


LabelReader = Callable[[PairFiles], Objects3D | None]


class ImagePairs(FrameSequence):
    """Frames from image files."""

    def __init__(
        self,
        uri: str,
        pairs: Sequence[PairFiles],
        *,
        options: SourceOptions,
        read_labels: LabelReader | None = None,
        camera_hz: float = DEFAULT_CAMERA_HZ,
    ) -> None:
        """Takes the list of all frames of the recording and sees that the wanted ones are there.

        Args:
            uri: for messages.
            pairs: all frames.
            options: which of them.
            read_labels: gives a frame's objects when asked.
            camera_hz: rate of the recording.

        Raises:
            FrameError: an image file of a wanted frame is missing.
        """
        super().__init__(uri, count=len(pairs), options=options, camera_hz=camera_hz)
        self._pairs = pairs
        for row in self._rows:
            _expect_files(pairs[row])
        self._read_labels = read_labels
        self._geometries: dict[tuple[Path, tuple[int, int]], StereoGeometry] = {}

    def views_digest(self, index: int) -> str:
        """SHA-256 over the image files of a frame, left then right; decodes nothing.

        Raises:
            FrameError: an image cannot be read.
        """
        pair = self._pairs[self._rows[index]]
        digest = hashlib.sha256()
        for path in (pair.left, pair.right):
            if path is not None:
                content = read_content(path, frame_id=pair.frame_id)
                digest.update(len(content).to_bytes(8, "big") + content)
        return digest.hexdigest()

    def left_image(self, index: int) -> Path:
        """The file of a frame's left view, without links."""
        return self._pairs[self._rows[index]].left.resolve()

    def geometry(self, index: int, image_size_wh: tuple[int, int]) -> StereoGeometry:
        """The camera of a frame, whose images have that size; reads no image.

        Raises:
            FormatError: the calibration is wrong.
        """
        return self._geometry(self._pairs[self._rows[index]], image_size_wh)

    def _geometry(self, pair: PairFiles, image_size_wh: tuple[int, int]) -> StereoGeometry:
        key = (pair.calibration, image_size_wh)
        if key not in self._geometries:
            self._geometries[key] = load_geometry(pair.calibration, image_size_wh)
        return self._geometries[key]

    def _read(self, row: int, *, sequence: int) -> StereoFrame:
        pair = self._pairs[row]
        left, right = _read_views(pair)
        return StereoFrame(
            left=left,
            right=right,
            timestamp_secs=pair.timestamp_secs,
            sequence=sequence,
            frame_id=pair.frame_id,
            geometry=self._geometry(pair, (left.shape[1], left.shape[0])),
        )

    def _frame_id(self, row: int) -> str:
        return self._pairs[row].frame_id

    def _labels(self, row: int) -> Objects3D | None:
        return None if self._read_labels is None else self._read_labels(self._pairs[row])


def _read_views(pair: PairFiles) -> tuple[NDArray[np.uint8], NDArray[np.uint8] | None]:
    """Both views, the right one by a thread of its own: decoding takes longer than all else of a read."""
    if pair.right is None:
        return read_image(pair.left, frame_id=pair.frame_id), None
    with ThreadPoolExecutor(1) as beside:
        right = beside.submit(read_image, pair.right, frame_id=pair.frame_id)
        left = read_image(pair.left, frame_id=pair.frame_id)
        return left, right.result()


def _expect_files(pair: PairFiles) -> None:
    for name, path in (("left", pair.left), ("right", pair.right)):
        if path is not None and not path.is_file():
            remedy = "restore it" if name == "left" else "restore it, or ask for views=left"
            raise FrameError(
                f"frame {pair.frame_id}: found no {name} image {path} (nor .jpg, .jpeg, .webp), "
                f"expected the pair; {remedy}"
            )
