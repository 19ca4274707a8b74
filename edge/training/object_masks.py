"""Which pixels of a stereo pair show a labelled object: those whose measured depth lies inside its 3D box.

Each pixel's ray is cut with the box, a little enlarged; the pixel is the object's where semi-global matching finds it
between the ray's entry and its exit. So the outline needs no drawn masks, and serves recorded and simulated pairs
alike. Each view is measured on its own, by mirroring the pair for the right one, and cut along the picture's edges; the
four outlines, moved by the disparity, then vote: what leaks into the background does so elsewhere in the other view.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.geometry import FloatArray, StereoGeometry
from runtime.contracts.objects import Objects3D

MARGIN_SIDE_M = 0.12  # arms, mirrors and label noise reach out of the box
MARGIN_TOP_M = 0.1
DISPARITY_SLACK_PX = 1.0
MARGIN_PX = 6  # of the window around the outline
BLOCK_PX = 3
EDGE_SOFTNESS_PX = 0.8
MIN_MATCHED_SHARE = 0.35  # of the outline, else there is too little texture to tell
CUT_HEIGHT_PX = 110  # larger windows are refined at this height, for speed
CUT_ROUNDS = 2
GROUND_SLACK_PX = 0.7
BLOWN_OUT = 245
MIN_VOTES, SURE_VOTES = 1.9, 2.9  # of four


@dataclass(frozen=True, slots=True)
class ViewEvidence:
    """What one view alone says of an object's pixels.

    Attributes:
        corner_xy: column and row of the window in the view.
        matched: (h, w) 0 or 1, where matching finds the box.
        cut: (h, w) 0 or 1, the same moved to the picture's edges.
        disparity_px: (h, w) within the box; the object's median where nothing matched.
    """

    corner_xy: tuple[int, int]
    matched: NDArray[np.uint8]
    cut: NDArray[np.uint8]
    disparity_px: NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ViewMask:
    """An object in one view.

    Attributes:
        corner_xy: column and row of the window in the view.
        opacity: (h, w) float32, 1 inside, soft at the edge.
        agreement: share of the mask that nearly all votes agree on.
    """

    corner_xy: tuple[int, int]
    opacity: NDArray[np.float32]
    agreement: float


def depth_along_rays(
    projection: FloatArray, columns: FloatArray, rows: FloatArray, *, objects: Objects3D, row: int
) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Depth at which the rays of a window's pixels enter and leave an object's box.

    Args:
        projection: (3, 4), P2 or P3.
        columns, rows: (w,) and (h,) pixels.
        objects: labels.
        row: which of them.

    Returns:
        (h, w) entry and exit in metres of `project_to_image`'s depth, entry > exit where the ray misses; and whether
        it leaves through the bottom.
    """
    inverse = np.linalg.inv(projection[:, :3])
    u, v = np.meshgrid(columns, rows)
    directions = np.stack([u, v, np.ones_like(u)], axis=-1) @ inverse.T  # a metre of depth each
    origin = -inverse @ projection[:, 3]
    yaw_rad = float(objects.yaw_rad[row])
    height, width, length = objects.size_hwl[row]
    axes = np.array(
        [[np.cos(yaw_rad), 0.0, -np.sin(yaw_rad)], [0.0, 1.0, 0.0], [np.sin(yaw_rad), 0.0, np.cos(yaw_rad)]]
    )
    start = axes @ (origin - objects.center_in_camera[row])
    along = directions @ axes.T
    along = np.where(np.abs(along) < 1e-9, 1e-9, along)
    low = np.array([-length / 2 - MARGIN_SIDE_M, -height / 2 - MARGIN_TOP_M, -width / 2 - MARGIN_SIDE_M])
    high = np.array([length / 2 + MARGIN_SIDE_M, height / 2, width / 2 + MARGIN_SIDE_M])
    one, other = (low - start) / along, (high - start) / along
    leaving = np.maximum(one, other)
    return (
        np.minimum(one, other).max(axis=-1),
        leaving.min(axis=-1),
        (leaving.argmin(axis=-1) == 1) & (along[..., 1] > 0),
    )


def disparity_at(geometry: StereoGeometry, depth_m: FloatArray) -> FloatArray:
    """Disparity in pixels at a depth: ``f b / z + (c_left - c_right)``; a real rig's columns may differ."""
    offset_px = geometry.P2[0, 2] - geometry.P3[0, 2]
    disparity_px: FloatArray = geometry.focal_px * geometry.baseline_m / depth_m + offset_px
    return disparity_px


def look_for_object(
    reference: NDArray[np.uint8],
    other: NDArray[np.uint8],
    *,
    picture: NDArray[np.uint8],
    geometry: StereoGeometry,
    objects: Objects3D,
    row: int,
    box: FloatArray,
    right: bool = False,
    without_ground: bool = False,
) -> ViewEvidence | None:
    """Find an object's pixels in one view.

    Args:
        reference, other: (H, W) grey, the view that is asked about and its twin.
        picture: (H, W, 3) the view in colour.
        geometry: of the pair.
        objects: labels.
        row: which of them.
        box: (4,) xyxy around the object in ``reference``; nothing outside is the object's.
        right: ``reference`` is the right view.
        without_ground: the ground within the box is left out; a car's shadow goes with it, a walker's road does not.

    Returns:
        None where matching finds too little of it.
    """
    height, width = reference.shape
    x1, y1 = (max(int(np.floor(value)) - MARGIN_PX, 0) for value in box[:2])
    x2, y2 = min(int(np.ceil(box[2])) + MARGIN_PX, width), min(int(np.ceil(box[3])) + MARGIN_PX, height)
    if x2 - x1 < 2 * MARGIN_PX or y2 - y1 < 2 * MARGIN_PX:
        return None
    entry, exit_, below = depth_along_rays(
        geometry.P3 if right else geometry.P2,
        np.arange(x1, x2, dtype=float),
        np.arange(y1, y2, dtype=float),
        objects=objects,
        row=row,
    )
    v, u = np.ogrid[y1:y2, x1:x2]
    within = (u >= box[0] - 1) & (u <= box[2] + 1) & (v >= box[1] - 1) & (v <= box[3] + 1)
    outline = (entry < exit_) & (entry > 1.0) & within
    if outline.sum() < MARGIN_PX**2:
        return None
    entry_px, exit_px = (
        np.where(outline, disparity_at(geometry, np.where(outline, depth_m, 1.0)), 0.0) for depth_m in (entry, exit_)
    )
    nearest_px, farthest_px = entry_px + DISPARITY_SLACK_PX, exit_px - DISPARITY_SLACK_PX
    limits = float(farthest_px[outline].min()), float(nearest_px[outline].max())
    found = _disparity(reference, other, (x1, y1, x2, y2), limits=limits, right=right)
    inside = outline & (found >= farthest_px) & (found <= nearest_px)
    if inside.sum() < MIN_MATCHED_SHARE * outline.sum():
        return None
    behind = (found >= 0) & (found < farthest_px - DISPARITY_SLACK_PX)
    if without_ground:
        ground = outline & (found < exit_px + GROUND_SLACK_PX) & below
        lower = np.arange(y1, y2)[:, None] > (box[1] + box[3]) / 2
        behind |= lower & (picture[y1:y2, x1:x2].min(axis=2) >= BLOWN_OUT)  # a glaring road matches anything
        inside &= ~(ground | behind)
    solid = _one_piece(inside.astype(np.uint8))
    refined = _along_edges(picture[y1:y2, x1:x2], solid, (outline & ~behind).astype(np.uint8))
    known = np.where(inside, found, np.median(found[inside]))
    return ViewEvidence((x1, y1), solid, refined, known.astype(np.float32))


def agreed_mask(one: ViewEvidence, other: ViewEvidence, *, right: bool = False) -> ViewMask | None:
    """The pixels of a view that two of four outlines call the object's: both views' own and cut ones.

    Args:
        one: of the view that is asked about.
        other: of its twin.
        right: ``one`` is the right view.

    Returns:
        None where nothing is left.
    """
    height, width = one.matched.shape
    columns, rows = np.meshgrid(np.arange(width, dtype=np.float32), np.arange(height, dtype=np.float32))
    shift = one.disparity_px if right else -one.disparity_px
    columns += shift + np.float32(one.corner_xy[0] - other.corner_xy[0])
    rows += np.float32(one.corner_xy[1] - other.corner_xy[1])
    votes = one.matched.astype(np.float32) + one.cut
    votes += cv2.remap((other.matched + other.cut).astype(np.float32), columns, rows, cv2.INTER_LINEAR)
    likely = votes >= MIN_VOTES
    if not likely.any():
        return None
    solid = _one_piece(likely.astype(np.uint8))
    opacity = cv2.GaussianBlur(solid.astype(np.float32), (5, 5), EDGE_SOFTNESS_PX)
    return ViewMask(one.corner_xy, opacity, float((votes[solid > 0] > SURE_VOTES).mean()) if solid.any() else 0.0)


def _disparity(
    reference: NDArray[np.uint8],
    other: NDArray[np.uint8],
    window: tuple[int, int, int, int],
    *,
    limits: tuple[float, float],
    right: bool,
) -> FloatArray:
    """(h, w) disparity of a window, -1 where nothing matched; also searches a little beyond the limits."""
    lowest = max(int(limits[0]) - 12, 0)
    count = -(-(int(limits[1]) + 12 - lowest) // 16) * 16
    x1, y1, x2, y2 = window
    reach = lowest + count + BLOCK_PX
    width = reference.shape[1]
    first, last = (x1, min(x2 + reach, width)) if right else (max(x1 - reach, 0), x2)
    strips = [image[y1:y2, first:last] for image in (reference, other)]
    if right:
        strips = [np.ascontiguousarray(strip[:, ::-1]) for strip in strips]
    missing = reach - (strips[0].shape[1] - (x2 - x1))
    if missing > 0:  # beyond the image: the matcher leaves as many columns out
        strips = [cv2.copyMakeBorder(strip, 0, 0, missing, 0, cv2.BORDER_REPLICATE) for strip in strips]
    matcher = cv2.StereoSGBM.create(
        minDisparity=lowest,
        numDisparities=count,
        blockSize=BLOCK_PX,
        P1=6 * BLOCK_PX**2,
        P2=24 * BLOCK_PX**2,
        disp12MaxDiff=1,
        uniquenessRatio=5,
        speckleWindowSize=40,
        speckleRange=2,
    )
    found = matcher.compute(strips[0], strips[1])[:, reach:].astype(np.float64) / 16.0
    found = found[:, ::-1] if right else found
    return np.where(found < lowest, -1.0, found)


def _one_piece(inside: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The largest piece, gaps closed, holes filled."""
    closed = cv2.morphologyEx(inside, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7)))
    opened = cv2.morphologyEx(closed, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (3, 3)))
    outlines, _ = cv2.findContours(opened, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    solid = np.zeros_like(inside)
    if outlines:
        cv2.drawContours(solid, [max(outlines, key=cv2.contourArea)], -1, 1, cv2.FILLED)
    return solid


def _along_edges(picture: NDArray[np.uint8], solid: NDArray[np.uint8], outline: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """The mask moved to the picture's edges by a graph cut; matching widens what is in front and frays at the rim.

    Args:
        picture: (h, w, 3) the window.
        solid: (h, w) 0 or 1, what matching found.
        outline: (h, w) 0 or 1, pixels whose ray meets the box: nothing outside belongs to the object.
    """
    height, width = solid.shape
    factor = min(1.0, CUT_HEIGHT_PX / height)
    size_wh = max(round(width * factor), 8), max(round(height * factor), 8)
    small, rough, possible = (
        cv2.resize(image, size_wh, interpolation=cv2.INTER_AREA if image is picture else cv2.INTER_NEAREST)
        for image in (picture, solid, outline)
    )
    reach = max(round(0.05 * min(size_wh)), 1)
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * reach + 1, 2 * reach + 1))
    core = cv2.erode(rough, kernel, iterations=2)
    marks = np.where(cv2.dilate(rough, kernel, iterations=2) * possible > 0, cv2.GC_PR_BGD, cv2.GC_BGD).astype(np.uint8)
    marks[(rough > 0) & (possible > 0)] = cv2.GC_PR_FGD
    marks[core > 0] = cv2.GC_FGD
    if core.any() and (marks == cv2.GC_BGD).any():
        cv2.setRNGSeed(0)  # of its clustering of colours
        cv2.grabCut(small, marks, None, np.zeros((1, 65)), np.zeros((1, 65)), CUT_ROUNDS, cv2.GC_INIT_WITH_MASK)
    cut = _one_piece(((marks == cv2.GC_FGD) | (marks == cv2.GC_PR_FGD)).astype(np.uint8))
    refined: NDArray[np.uint8] = (cv2.resize(cut.astype(np.float32), (width, height)) > 0.5).astype(np.uint8)
    return refined
