"""Stereo-consistent copy and paste: objects of other frames set onto a frame's ground, in both views.

An object keeps the angle that it is seen at (alpha) and is moved to another depth and another ray: its pixels are
scaled by the ratio of the depths about the point where it stands, separately in each view, about that view's own
image of the point. Size goes with 1 / z, disparity with f b / z, the row with the ground; yaw follows from alpha. It
is pasted only where matching sees nothing nearer, the ground where the ground should be, and no other footprint.
Disparity supervision is matched on the finished pair and needs no change.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from edge.training.free_ground import (
    Ground,
    footprint_of,
    footprints_apart,
    ground_of,
    is_in_front,
    is_on_ground,
    scene_disparity,
)
from edge.training.object_bank import ObjectBank, ObjectCut, ViewCut
from runtime.contracts.frame import StereoFrame
from runtime.contracts.geometry import FloatArray, project_to_image
from runtime.contracts.objects import Objects3D, box_corners, wrap_angle_rad

CLASS_SHARES = {"Pedestrian": 0.45, "Cyclist": 0.3, "Car": 0.25}
MAX_OBJECTS = 3
CUTS_TRIED, PLACES_TRIED = 4, 30  # a frame, an object
DEPTH_RATIO = (0.9, 2.2)  # new over old: little is magnified
DEPTH_LIMITS_M = (4.5, 40.0)
MAX_TURN_RAD = 0.21  # change of the ray's azimuth: beyond, the flat image stretches visibly
MAX_BASELINE_SHARE = 0.05  # difference of the rigs
BRIGHTNESS_LIMITS = (0.6, 1.6)
BRIGHTNESS_TRUST = 0.7  # exponent of the ratio of surroundings
MAX_ON_NEARER, MAX_ON_DONT_CARE = 0.02, 0.15
PARTLY, LARGELY, GONE = 0.1, 0.45, 0.75  # covered share of what is behind
BORDER_PX = 2.0


@dataclass(frozen=True, slots=True)
class Place:
    """Where an object goes, and what its label says there.

    Attributes:
        center: (3,) metres.
        yaw_rad: rotation about y.
        box: (4,) xyxy of its outline in the left view.
        scale: new size over old size of its pixels.
        disparity_px: at its centre.
    """

    center: FloatArray
    yaw_rad: float
    box: FloatArray
    scale: float
    disparity_px: float


class ObjectPaster:
    """Pastes objects of a bank.

    Args:
        bank: where objects come from.
        probability: share of frames that get any.
    """

    def __init__(self, bank: ObjectBank, probability: float) -> None:
        self._bank = bank
        self._probability = probability

    def paste(self, frame: StereoFrame, objects: Objects3D, rng: np.random.Generator) -> tuple[StereoFrame, Objects3D]:
        """The frame with up to `MAX_OBJECTS` more objects; as it is where the draw says so or nothing fits.

        Args:
            frame: a stereo pair.
            objects: its labels.
            rng: of this position of the run.
        """
        if frame.right is None or rng.random() >= self._probability:
            return frame, objects
        names = [name for name in CLASS_SHARES if name in self._bank.classes]
        shares = np.array([CLASS_SHARES[name] for name in names])
        scene, ground = scene_disparity(frame), ground_of(objects)
        wanted = int(rng.integers(1, MAX_OBJECTS + 1))
        chosen: list[tuple[ObjectCut, Place]] = []
        for _ in range(CUTS_TRIED):
            cut = self._bank.draw(names[rng.choice(len(names), p=shares / shares.sum())], rng)
            if cut is None:
                continue
            place = _find_place(cut, frame, objects, scene=scene, ground=ground, taken=chosen, rng=rng)
            if place is not None:
                chosen.append((cut, place))
            if len(chosen) == wanted:
                break
        chosen.sort(key=lambda item: -item[1].center[2])  # far ones first, so that near ones cover them
        for cut, place in chosen:
            frame, objects = paste_object(frame, objects, cut=cut, place=place)
        return frame, objects


def place_at(cut: ObjectCut, frame: StereoFrame, *, x_m: float, z_m: float, ground: Ground) -> Place:
    """What an object's label would be at a spot of the frame's ground."""
    center = np.array([x_m, ground.y_at(z_m) - cut.size_hwl[0] / 2, z_m])
    yaw_rad = float(wrap_angle_rad(np.array(cut.alpha_rad + np.arctan2(x_m, z_m))))
    geometry = frame.geometry
    corners = box_corners(center[None], cut.size_hwl[None], np.array([yaw_rad]))[0]
    pixels, _ = project_to_image(geometry.P2, corners)
    (one, other), (depth_m, old_depth_m) = (
        np.array([project_to_image(P, center)[0] for P in (geometry.P2, geometry.P3)]),
        (float(project_to_image(g.P2, c)[1]) for g, c in ((geometry, center), (cut.geometry, cut.center_in_camera))),
    )
    return Place(
        center=center,
        yaw_rad=yaw_rad,
        box=np.concatenate([pixels.min(axis=0), pixels.max(axis=0)]),
        scale=geometry.focal_px / cut.geometry.focal_px * old_depth_m / depth_m,
        disparity_px=float(one[0] - other[0]),
    )


def paste_object(
    frame: StereoFrame, objects: Objects3D, *, cut: ObjectCut, place: Place
) -> tuple[StereoFrame, Objects3D]:
    """Draw one object into both views and into the labels; what it hides is marked, or left out where little remains.

    Args:
        frame: a stereo pair.
        objects: its labels.
        cut: the object.
        place: where it goes.
    """
    assert frame.right is not None
    gain = _brightness(cut, frame, place)
    left, mask = _draw(frame.left, cut.left, cut, place, P=(cut.geometry.P2, frame.geometry.P2), gain=gain)
    right, _ = _draw(frame.right, cut.right, cut, place, P=(cut.geometry.P3, frame.geometry.P3), gain=gain)
    labels = _relabelled(objects, cut, place, mask=mask, box=_moved(cut, place, P=frame.geometry.P2))
    return replace(frame, left=left, right=right), labels


def _find_place(
    cut: ObjectCut,
    frame: StereoFrame,
    objects: Objects3D,
    *,
    scene: NDArray[np.float32],
    ground: Ground,
    taken: Sequence[tuple[ObjectCut, Place]],
    rng: np.random.Generator,
) -> Place | None:
    geometry = frame.geometry
    if abs(cut.geometry.baseline_m / geometry.baseline_m - 1.0) > MAX_BASELINE_SHARE:
        return None
    footprints = [
        footprint_of(center, size, yaw)
        for center, size, yaw in zip(objects.center_in_camera, objects.size_hwl, objects.yaw_rad, strict=True)
    ]
    footprints += [footprint_of(place.center, other.size_hwl, place.yaw_rad) for other, place in taken]
    boxes = np.concatenate([objects.box_in_left_image, *(place.box[None] for _, place in taken)])
    depths_m = np.concatenate([objects.center_in_camera[:, 2], [place.center[2] for _, place in taken]])
    old_x, _, old_z = cut.center_in_camera
    for _ in range(PLACES_TRIED):
        z_m = float(np.clip(old_z * np.exp(rng.uniform(*np.log(DEPTH_RATIO))), *DEPTH_LIMITS_M))
        x_m = float(z_m * np.tan(np.arctan2(old_x, old_z) + rng.uniform(-MAX_TURN_RAD, MAX_TURN_RAD)))
        place = place_at(cut, frame, x_m=x_m, z_m=z_m, ground=ground)
        width, height = frame.size_wh
        inside = (
            place.box[0] >= place.disparity_px + BORDER_PX  # seen by the right camera, too
            and place.box[1] >= 0
            and place.box[2] < width - BORDER_PX
            and place.box[3] < height - BORDER_PX
        )
        if (
            inside
            and (_share_on(place.box, boxes[depths_m < z_m]) <= MAX_ON_NEARER).all()
            and (_share_on(place.box, objects.dont_care_boxes) <= MAX_ON_DONT_CARE).all()
            and footprints_apart(footprint_of(place.center, cut.size_hwl, place.yaw_rad), footprints)
            and is_in_front(scene, place.box, place.disparity_px)
            and is_on_ground(scene, geometry, center=place.center, size_hwl=cut.size_hwl, ground=ground)
        ):
            return place
    return None


def _draw(
    image: NDArray[np.uint8],
    view: ViewCut,
    cut: ObjectCut,
    place: Place,
    *,
    P: tuple[FloatArray, FloatArray],
    gain: FloatArray,
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """One view with the object, and the (H, W) opacity of what was drawn. P: of the cut's view, of this one."""
    before, after = _standing_points(cut, place, P=P)
    offset = after + place.scale * (np.array(view.corner_xy) - before)
    height, width = image.shape[:2]
    rows, columns = view.opacity.shape
    x1, y1 = np.maximum(np.floor(offset).astype(int), 0)
    x2 = min(int(np.ceil(offset[0] + place.scale * columns)), width)
    y2 = min(int(np.ceil(offset[1] + place.scale * rows)), height)
    mask = np.zeros((height, width), np.float32)
    if x2 <= x1 or y2 <= y1:
        return image, mask
    colour = view.image.astype(np.float32) * view.opacity[..., None]
    layers = np.concatenate([colour, view.opacity[..., None]], axis=2)
    if place.scale < 0.75:  # else fine detail would alias
        layers = cv2.GaussianBlur(layers, (0, 0), 0.4 * (1 / place.scale - 0.6))
    shift = offset - [x1, y1] + 0.5 * (place.scale - 1)  # between pixel centres
    warp = np.array([[place.scale, 0.0, shift[0]], [0.0, place.scale, shift[1]]])
    drawn = cv2.warpAffine(layers, warp, (int(x2 - x1), int(y2 - y1)), flags=cv2.INTER_LINEAR)
    opacity = drawn[..., 3:]
    out = image.copy()
    part = out[y1:y2, x1:x2]
    blended = drawn[..., :3] * gain.astype(np.float32) + (1 - opacity) * part
    out[y1:y2, x1:x2] = np.clip(blended + 0.5, 0, 255).astype(np.uint8)
    mask[y1:y2, x1:x2] = opacity[..., 0]
    return out, mask


def _standing_points(
    cut: ObjectCut, place: Place, *, P: tuple[FloatArray, FloatArray]
) -> tuple[FloatArray, FloatArray]:
    """(2,) pixels of the point under the object's centre, where it was and where it goes."""
    down = np.array([0.0, cut.size_hwl[0] / 2, 0.0])
    before, _ = project_to_image(P[0], cut.center_in_camera + down)
    after, _ = project_to_image(P[1], place.center + down)
    return before, after


def _moved(cut: ObjectCut, place: Place, *, P: FloatArray) -> FloatArray:
    """(4,) the labelled 2D box where the object goes."""
    before, after = _standing_points(cut, place, P=(cut.geometry.P2, P))
    box: FloatArray = np.tile(after, 2) + place.scale * (cut.box_in_left_image - np.tile(before, 2))
    return box


def _brightness(cut: ObjectCut, frame: StereoFrame, place: Place) -> FloatArray:
    """(3,) BGR factors that bring the light of the old surroundings to the new."""
    x1, y1, x2, y2 = place.box.astype(int)
    pad = max((y2 - y1) // 4, 4)
    around = frame.left[max(y1 - pad, 0) : y2 + pad, max(x1 - pad, 0) : x2 + pad].reshape(-1, 3)
    ratio = (around.mean(axis=0) + 8.0) / (cut.surroundings_bgr + 8.0)
    grey = ratio.mean()
    gain: FloatArray = np.clip(grey**BRIGHTNESS_TRUST, *BRIGHTNESS_LIMITS) * np.clip((ratio / grey) ** 0.5, 0.9, 1.1)
    return gain


def _relabelled(
    objects: Objects3D, cut: ObjectCut, place: Place, *, mask: NDArray[np.float32], box: FloatArray
) -> Objects3D:
    """Labels with the new object; those behind it get the occlusion that they now have."""
    occlusion, kept, hidden = objects.occlusion.copy(), np.ones(len(objects), bool), [objects.dont_care_boxes]
    for row in np.flatnonzero(objects.center_in_camera[:, 2] > place.center[2]):
        covered = covered_share(mask, objects.box_in_left_image[row])
        if covered >= GONE:
            kept[row] = False
            hidden.append(objects.box_in_left_image[row : row + 1])
        elif covered >= LARGELY or (covered >= LARGELY / 2 and occlusion[row] == 1):
            occlusion[row] = max(occlusion[row], 2)
        elif covered >= PARTLY:
            occlusion[row] = max(occlusion[row], 1)
    names = objects.class_names
    if cut.class_name not in names:
        names = (*names, cut.class_name)
    values = {
        "class_id": names.index(cut.class_name),
        "box_in_left_image": box,
        "center_in_camera": place.center,
        "size_hwl": cut.size_hwl,
        "alpha_rad": cut.alpha_rad,
        "yaw_rad": place.yaw_rad,
        "truncation": 0.0,
        "occlusion": 0,
        "track_id": -1,
    }
    before = replace(objects, occlusion=occlusion).select(kept)
    rows = {name: np.concatenate([getattr(before, name), np.array([value])]) for name, value in values.items()}
    return replace(before, **rows, dont_care_boxes=np.concatenate(hidden), class_names=names)


def covered_share(mask: NDArray[np.float32], box: FloatArray) -> float:
    """Share of a box under a mask."""
    x1, y1 = np.maximum(np.floor(box[:2]).astype(int), 0)
    part = mask[y1 : int(np.ceil(box[3])), x1 : int(np.ceil(box[2]))]
    return float((part > 0.5).mean()) if part.size else 0.0


def _share_on(box: FloatArray, others: FloatArray) -> FloatArray:
    """(N,) share of a box under each of the others."""
    extent = np.minimum(others[:, 2:], box[2:]) - np.maximum(others[:, :2], box[:2])
    share: FloatArray = np.maximum(extent, 0.0).prod(axis=1) / (box[2:] - box[:2]).prod()
    return share
