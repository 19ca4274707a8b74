"""What a source yields: one moment seen by one or two cameras."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError
from runtime.contracts.geometry import StereoGeometry


@dataclass(frozen=True, slots=True)
class StereoFrame:
    """A rectified pair; immutable, its arrays are made read-only.

    Attributes:
        left: (H, W, 3) uint8 BGR.
        right: the same shape, or None for a single view.
        timestamp_secs: capture time in seconds, on the source's clock.
        sequence: running number within the source, from 0.
        frame_id: the name results are filed under (``000123``, ``0010/000003``).
        geometry: P2, P3 of these images.

    Raises:
        FrameError: a view is not uint8 (H, W, 3), or the two differ in size, or differ from the geometry's size.
    """

    left: NDArray[np.uint8]
    right: NDArray[np.uint8] | None
    timestamp_secs: float
    sequence: int
    frame_id: str
    geometry: StereoGeometry

    def __post_init__(self) -> None:
        for name, image in (("left", self.left), ("right", self.right)):
            if image is None:
                continue
            if image.dtype != np.uint8 or image.ndim != 3 or image.shape[2] != 3 or 0 in image.shape:
                raise FrameError(
                    f"frame {self.frame_id}: {name} image is {image.dtype} {image.shape}, expected uint8 (H, W, 3); "
                    "decode it as a colour image"
                )
            view = image.view()
            view.setflags(write=False)
            object.__setattr__(self, name, view)
        if self.right is not None and self.right.shape != self.left.shape:
            raise FrameError(
                f"frame {self.frame_id}: left is {_size(self.left)} and right is {_size(self.right)} pixels, "
                "expected equal sizes; check that both files belong to one rectified pair"
            )
        if self.geometry.image_size_wh != self.size_wh:
            raise FrameError(
                f"frame {self.frame_id}: images are {_size(self.left)} pixels, the geometry is for "
                f"{self.geometry.image_size_wh[0]}x{self.geometry.image_size_wh[1]}; "
                "give the geometry of this image size"
            )

    @property
    def size_wh(self) -> tuple[int, int]:
        """Width and height in pixels."""
        return int(self.left.shape[1]), int(self.left.shape[0])


def _size(image: NDArray[np.uint8]) -> str:
    return f"{image.shape[1]}x{image.shape[0]}"
