"""Makes simulated data sets: seeds go in, folders in KITTI's layouts come out; frames are spread over processes."""

from __future__ import annotations

import hashlib
import math
import multiprocessing
import os
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from edge.simulation.dataset import IMAGE_FORMATS, ObjectFolder, Record, TrackingFolder, claim_folder
from edge.simulation.drafts import AS_LABELLED, Mix
from edge.simulation.drive import FRAMES_PER_SECOND, Drive, build_drive, moment_at
from edge.simulation.frames import frame_of_seed, take
from edge.simulation.render.renderer import Renderer
from edge.simulation.rig import load_rig
from edge.simulation.sensor import draw_sensor
from runtime.contracts.errors import FormatError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_labels
from runtime.rig import format_geometry

DEFAULT_QUALITY = 92
LEAST_FACTOR, MOST_FACTOR = 0.1, 20.0  # of a mix
Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class _Job:
    """What every process needs to know."""

    out: Path
    record: Record
    geometry: StereoGeometry


def simulate(
    out: Path | str,
    *,
    frames: int = 100,
    sequence: bool = False,
    seconds: float = 10.0,
    rig: str = "kitti",
    seed: int = 0,
    image_format: str = "jpg",
    quality: int = DEFAULT_QUALITY,
    mix: Mix = AS_LABELLED,
    workers: int = 2,
    progress: Progress | None = None,
) -> int:
    """Write labelled frames (object layout), or one drive at 10 Hz (tracking layout).

    Frame ``i`` of a set is made from ``seed + i`` alone: the same seed gives the same frame in any set, with any
    number of workers. Single frames that a folder made by the same settings holds already are kept, and listed even
    where there are more than ``frames``; a drive is rendered anew.

    Args:
        out: folder to make.
        frames: number of single frames.
        sequence: write a drive instead of single frames.
        seconds: length of the drive.
        rig: kitti, oak-d, or a rig file.
        seed: first seed.
        image_format: jpg, png or webp.
        quality: of jpg and webp.
        mix: what single frames show oftener than KITTI's labels do.
        workers: processes that render.
        progress: called with (frames done, frames in all).

    Returns:
        The number of frames in the set.

    Raises:
        FormatError: a setting makes no sense, or the rig is broken.
        OutputError: the folder is taken.
        MissingExtraError: the renderer cannot start.
    """
    out = Path(out)
    if not math.isfinite(seconds):
        raise FormatError(f"seconds gives {seconds}, expected the length of a drive; give a number")
    count = round(FRAMES_PER_SECOND * seconds) if sequence else frames
    for name, value in (("frames", count), ("workers", workers), ("quality", quality), ("seed", seed + 1)):
        if value < 1:
            raise FormatError(f"{name} gives {value}, expected a positive number; give a larger one")
    if image_format not in IMAGE_FORMATS:
        raise FormatError(
            f"image format {image_format!r} is unknown, expected one of {', '.join(IMAGE_FORMATS)}; name one of them"
        )
    for name, factor in (("people", mix.people), ("near", mix.near)):
        if not LEAST_FACTOR <= factor <= MOST_FACTOR:
            raise FormatError(
                f"{name} gives {factor}, expected a factor from {LEAST_FACTOR:g} to {MOST_FACTOR:g}; choose one"
            )
    if sequence and mix != AS_LABELLED:
        raise FormatError("people or near were given for a drive, expected single frames; leave out --sequence")
    geometry = load_rig(rig)
    rig_name = (
        rig
        if rig in ("kitti", "oak-d")
        else f"file {hashlib.sha256(format_geometry(geometry).encode()).hexdigest()[:16]}"
    )
    record = Record(
        "tracking" if sequence else "object",
        seed,
        rig_name,
        image_format,
        quality,
        seconds if sequence else 0.0,
        people=mix.people,
        near=mix.near,
    )
    claim_folder(out, record)
    job = _Job(out, record, geometry)
    report = progress or (lambda done, total: None)
    if not sequence:
        return _write_frames(job, count, workers=workers, report=report)
    _write_drive(job, count, workers=workers, report=report)
    return count


def _write_frames(job: _Job, count: int, *, workers: int, report: Progress) -> int:
    folder = ObjectFolder(job.out, job.record.image_format, job.record.quality)
    listed = folder.prepare(job.geometry, count)
    missing = [index for index in range(count) if not folder.has(index)]
    done = count - len(missing)
    report(done, count)
    for _ in _run(job, missing, workers=workers):
        done += 1
        report(done, count)
    return listed


def _write_drive(job: _Job, count: int, *, workers: int, report: Progress) -> None:
    folder = TrackingFolder(job.out, job.record.image_format, job.record.quality)
    folder.prepare(job.geometry)
    texts: dict[int, str] = {}
    report(0, count)
    for index, text in _run(job, list(range(count)), workers=workers):
        texts[index] = text
        report(len(texts), count)
    folder.write_labels([texts[index] for index in range(count)])


def _run(job: _Job, indices: list[int], *, workers: int) -> Iterator[tuple[int, str]]:
    """Frame index and label text of each frame as it is finished."""
    if not indices:
        return
    if workers == 1 or len(indices) == 1:
        with _Worker.opened(job) as worker:
            for index in indices:
                yield index, worker.make(index)
        return
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(min(workers, len(indices)), context, initializer=_start_worker, initargs=(job,)) as pool:
        pending = {pool.submit(_make_in_worker, index): index for index in indices}
        try:
            for future in as_completed(pending):
                yield pending[future], future.result()
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise


class _Worker:
    """Renders frames of one job; holds the OpenGL context and, for a drive, its world."""

    def __init__(self, job: _Job, renderer: Renderer) -> None:
        self._job, self._renderer = job, renderer
        self._drive: Drive | None = None
        if job.record.layout == "tracking":
            self._drive = build_drive(job.record.seed, job.record.seconds)
            self._sensor = draw_sensor(np.random.default_rng([job.record.seed, 12]))

    @classmethod
    @contextmanager
    def opened(cls, job: _Job) -> Iterator[_Worker]:
        """A worker with an open renderer."""
        with Renderer(job.geometry.image_size_wh) as renderer:
            yield cls(job, renderer)

    def make(self, index: int) -> str:
        """Render and write one frame; its label text."""
        record, geometry = self._job.record, self._job.geometry
        if self._drive is not None:
            moment = moment_at(self._drive, index / FRAMES_PER_SECOND)
            rng = np.random.default_rng([record.seed, 13, index])
            frame = take(moment, geometry, self._renderer, sensor=self._sensor, rng=rng)
            text = format_labels(frame.labels, tracking_frame=index)
            folder = TrackingFolder(self._job.out, record.image_format, record.quality)
            folder.write(index, (frame.left, frame.right))
            return text
        mix = Mix(people=record.people, near=record.near)
        frame = frame_of_seed(record.seed + index, geometry, self._renderer, mix)
        text = format_labels(frame.labels)
        ObjectFolder(self._job.out, record.image_format, record.quality).write(
            index, (frame.left, frame.right), geometry=geometry, label_text=text
        )
        return text


_job: _Job | None = None  # both one a process; the worker starts with the first task, so that its errors come back
_worker: _Worker | None = None


def _start_worker(job: _Job) -> None:
    global _job
    threading.Thread(target=_end_with_parent, daemon=True).start()
    os.environ.setdefault("LP_NUM_THREADS", "1")  # Mesa's rasteriser: the processes share the cores already
    _job = job


def _end_with_parent() -> None:
    """A pool's process whose parent was killed would wait for tasks for ever."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _make_in_worker(index: int) -> str:
    global _worker
    if _worker is None:
        assert _job is not None
        _worker = _Worker(_job, Renderer(_job.geometry.image_size_wh))
    return _worker.make(index)
