"""From a camera pair to the network's input: crop rows, resize, cut or pad, RGB planes.

One affine map per camera (`NetworkView`) serves both ways: pixels in, boxes out. The official code's order and
rounding are kept: the resized width is rounded while the geometry takes the unrounded factor, columns beyond the
network's width are cut, missing ones are black before normalisation (paper, implementation details).
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FrameError
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.manifest import Manifest, Normalisation


@dataclass(frozen=True, slots=True)
class NetworkView:
    """How one camera's image maps to the network's.

    ``x_network = scale * x``, ``y_network = scale * (y - top_row)``.

    Attributes:
        top_row: first camera row that the network sees; negative where black rows are put above the image.
        scale: network pixels a camera pixel.
        size_hw: network height and width.
        camera_geometry: of the camera image.
        geometry: of the network image.
    """

    top_row: int
    scale: float
    size_hw: tuple[int, int]
    camera_geometry: StereoGeometry
    geometry: StereoGeometry

    def to_network(self, box_in_camera_image: FloatArray) -> FloatArray:
        """Boxes (N, 4) xyxy from camera pixels to network pixels."""
        shift = np.array([0.0, self.top_row, 0.0, self.top_row])
        boxes: FloatArray = (box_in_camera_image - shift) * self.scale
        return boxes


def network_view(geometry: StereoGeometry, manifest: Manifest) -> NetworkView:
    """The view that a model takes of a camera.

    Raises:
        FrameError: the image ends above the first row that the network would see.
    """
    height, width = manifest.input_size_hw
    rows = geometry.image_size_wh[1]
    crop = manifest.crop
    if crop.mode == "top_rows":
        top_row = crop.rows
        scale = height / max(rows - top_row, 1)
    else:
        scale = manifest.rig.focal_px / geometry.focal_px
        training_focal_px = crop.training_focal_px or manifest.rig.focal_px
        top_row = round(geometry.principal_point_px[1] - crop.rows * geometry.focal_px / training_focal_px)
    if top_row >= rows:
        raise FrameError(
            f"image has {rows} rows and the model drops the top {top_row}, expected a taller image; "
            "check the geometry or use a model made for this camera"
        )
    seen = geometry.crop(left=0, top=top_row, size_wh=(geometry.image_size_wh[0], rows - top_row))
    return NetworkView(top_row, scale, (height, width), geometry, seen.scale((scale, scale), (width, height)))


def to_network_image(image: NDArray[np.uint8], view: NetworkView, *, as_float: bool = False) -> NDArray[np.generic]:
    """Crop, resize (bilinear) and cut or pad one BGR image.

    Args:
        image: (H, W, 3) uint8 BGR.
        view: the map.
        as_float: resize in float32 (what the official code does) instead of 8-bit.

    Returns:
        (height, width, 3) BGR in 0..255, uint8 or float32.
    """
    height, width = view.size_hw
    first = max(view.top_row, 0)
    wanted_rows = round(height / view.scale) - (first - view.top_row)
    cut = image[first : first + max(wanted_rows, 1)]
    source = cut.astype(np.float32) if as_float else cut
    rows = max(round(cut.shape[0] * view.scale), 1)
    columns = max(round(cut.shape[1] * view.scale), 1)
    resized = cv2.resize(source, (columns, rows), interpolation=cv2.INTER_LINEAR)
    offset = round((first - view.top_row) * view.scale)
    rows, columns = min(rows, height - offset), min(columns, width)
    if (offset, rows, columns) == (0, height, width):
        return np.ascontiguousarray(resized[:rows, :columns])
    canvas = np.zeros((height, width, 3), resized.dtype)
    canvas[offset : offset + rows, :columns] = resized[:rows, :columns]
    return canvas


def to_planes(network_image: NDArray[np.generic]) -> NDArray[np.generic]:
    """(H, W, 3) BGR to (1, 3, H, W) RGB planes of the same type."""
    planes = np.empty((1, 3, *network_image.shape[:2]), network_image.dtype)
    for target, channel in enumerate((2, 1, 0)):
        planes[0, target] = network_image[..., channel]
    return planes


def normalise(planes: NDArray[np.generic], normalisation: Normalisation) -> NDArray[np.float32]:
    """RGB planes (B, 3, H, W) in 0..255 to ``(value / 255 - mean) / std``, float32."""
    mean = np.array(normalisation.mean, np.float32)[None, :, None, None]
    std = np.array(normalisation.std, np.float32)[None, :, None, None]
    scaled: NDArray[np.float32] = planes.astype(np.float32) / np.float32(255)
    return (scaled - mean) / std


def prepare(frame: StereoFrame, view: NetworkView, manifest: Manifest) -> dict[str, NDArray[np.generic]]:
    """The graph's feeds of one frame: ``left`` and, for a stereo model, ``right``; (1, 3, H, W) each.

    Raises:
        FrameError: a stereo model is given a frame with one view.
    """
    images = {"left": frame.left}
    if manifest.views == 2:
        if frame.right is None:
            raise FrameError(
                f"frame {frame.frame_id} has no right image, expected a pair for the stereo preset "
                f"{manifest.preset}; use a stereo source"
            )
        images["right"] = frame.right
    as_float = manifest.input_type == "float32"
    feeds = {}
    for name, image in images.items():
        planes = to_planes(to_network_image(image, view, as_float=as_float))
        feeds[name] = normalise(planes, manifest.normalisation) if as_float else planes
    return feeds
