"""Labels of many seeds without their pictures: for statistics of the simulated world."""

from __future__ import annotations

import multiprocessing
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor

from edge.simulation.frames import labels_of_seed
from edge.simulation.render.renderer import Renderer
from edge.simulation.rig import kitti_rig
from runtime.contracts.objects import Objects3D

COUNTING_SIZE_WH = (621, 188)  # half of KITTI's picture


def labels_of_seeds(seeds: Sequence[int], *, workers: int = 2) -> list[Objects3D]:
    """Labels of single frames with KITTI's rig, visible pixels counted at half size.

    Args:
        seeds: one a frame.
        workers: processes that share the seeds.

    Raises:
        MissingExtraError: the renderer cannot start.
    """
    parts = [list(seeds[first::workers]) for first in range(workers)]
    if workers == 1:
        return _labels(parts[0])
    with ProcessPoolExecutor(workers, multiprocessing.get_context("spawn")) as pool:
        found = list(pool.map(_labels, parts))
    return [found[place % workers][place // workers] for place in range(len(seeds))]


def _labels(seeds: list[int]) -> list[Objects3D]:
    rig = kitti_rig()
    with Renderer(COUNTING_SIZE_WH) as renderer:
        return [labels_of_seed(seed, rig, renderer, counting_size_wh=COUNTING_SIZE_WH) for seed in seeds]
