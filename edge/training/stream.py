"""The endless, resumable order of training samples.

Position n of a run always is the same frame with the same augmentation, whatever came before: epoch e is a permutation
drawn from (seed, e), the sample's generator from (seed, n). Resuming is starting at n.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from edge.training.assign import IGNORED
from edge.training.distributed import ALONE, Ranks
from edge.training.frame_changes import FrameChanges
from edge.training.losses import ImageTargets
from edge.training.point_clouds import points_in_camera
from edge.training.samples import Sample, SampleMaker
from runtime.contracts.errors import EdgeError, SourceError
from runtime.contracts.objects import Objects3D
from runtime.sources.base import FrameSequence


@dataclass(frozen=True, slots=True)
class Batch:
    """A batch on its way to the device; a mono preset's has neither right views nor disparities.

    Attributes:
        left, right, disparity, targets: the samples'.
        unlabelled: how many of them teach disparity alone.
    """

    left: torch.Tensor
    right: torch.Tensor | None
    disparity: torch.Tensor | None
    targets: list[ImageTargets]
    unlabelled: int = 0

    def to(self, device: torch.device) -> Batch:
        """The same on another device; images channels-last."""
        move = [
            ImageTargets(
                t.label.to(device),
                t.positive.to(device),
                t.deltas.to(device),
                t.facing.to(device),
                t.object_count,
            )
            for t in self.targets
        ]
        left, right = (
            None if x is None else x.to(device, memory_format=torch.channels_last, non_blocking=True)
            for x in (self.left, self.right)
        )
        assert left is not None
        disparity = None if self.disparity is None else self.disparity.to(device)
        return Batch(left, right, disparity, move, self.unlabelled)


class MixedFrames(Dataset[Sample]):
    """Frames of several sources, each repeated by its weight, as samples by position.

    Args:
        sources: labelled stereo sequences.
        weights: how often an epoch shows each source's frames.
        maker: frame to sample.
        seed: of order and augmentation.
        changes: what is done to frames before they become samples.
        unlabelled: sequences that teach disparity alone, whether or not they have labels.
    """

    def __init__(
        self,
        sources: Sequence[FrameSequence],
        weights: Sequence[int],
        *,
        maker: SampleMaker,
        seed: int,
        changes: FrameChanges | None = None,
        unlabelled: Sequence[FrameSequence] = (),
    ) -> None:
        self._sources = [*sources, *unlabelled]
        self._labelled_count = len(sources)
        self._changes = changes or FrameChanges()
        self._maker = maker
        self._seed = seed
        rows = [
            (index, row)
            for index, (source, weight) in enumerate(zip(sources, weights, strict=True))
            for _ in range(weight)
            for row in range(len(source))
            if source.labels(row) is not None
        ]
        if not rows:
            raise SourceError("the datasets hold no labelled frame, expected at least one; give a source with labels")
        rows += [(len(sources) + index, row) for index, source in enumerate(unlabelled) for row in range(len(source))]
        self._rows = np.array(rows)
        self._epoch: tuple[int, np.ndarray] = (-1, np.zeros(0, int))

    @property
    def epoch_length(self) -> int:
        """Samples an epoch."""
        return len(self._rows)

    def __getitem__(self, position: int) -> Sample:
        """The sample at a position of the run."""
        epoch, offset = divmod(position, len(self._rows))
        if self._epoch[0] != epoch:
            order = np.random.default_rng([self._seed, epoch]).permutation(len(self._rows))
            self._epoch = (epoch, order)
        source_index, row = self._rows[self._epoch[1][offset]]
        source = self._sources[source_index]
        labelled = source_index < self._labelled_count
        objects = source.labels(int(row)) if labelled else Objects3D.empty(("Car",))
        assert objects is not None
        draws = np.random.RandomState(np.random.default_rng([self._seed, position]).integers(2**31))
        points = points_in_camera(source, int(row)) if self._maker.wants_points else None
        frame = source[int(row)]
        place = {"seed": self._seed, "position": position}
        frame, objects = self._changes.of_scene(frame, objects, labelled=labelled, **place)
        faults = self._changes.of_cameras(views=1 if frame.right is None else 2, **place)
        sample = self._maker.make(frame, objects, draws, points_in_camera=points, faults=faults)
        return sample if labelled else _without_classes(sample)


def _without_classes(sample: Sample) -> Sample:
    """A sample whose anchors teach nothing: what stands in the picture is not known."""
    ignored = np.full_like(sample.targets.label, IGNORED)
    return replace(sample, targets=replace(sample.targets, label=ignored), labelled=False)


class Positions(Sampler[int]):
    """The run's positions that one process looks at: of each step's joint batch, the share of its rank.

    Args:
        first_step, last_step: steps ``first_step`` .. ``last_step - 1``.
        batch_size: of all processes together.
        ranks: this process among them.
    """

    def __init__(self, first_step: int, last_step: int, *, batch_size: int, ranks: Ranks) -> None:
        self._steps = range(first_step, last_step)
        self._batch_size = batch_size
        self._share = ranks.share_of(batch_size)
        self._offset = ranks.rank * self._share

    def __iter__(self) -> Iterator[int]:
        for step in self._steps:
            begin = step * self._batch_size + self._offset
            yield from range(begin, begin + self._share)

    def __len__(self) -> int:
        return len(self._steps) * self._share


def batches(
    frames: MixedFrames, *, first_step: int, last_step: int, batch_size: int, workers: int, ranks: Ranks = ALONE
) -> Iterator[Batch]:
    """Batches for steps ``first_step`` .. ``last_step - 1``: this process's share of ``batch_size`` samples each.

    Raises:
        EdgeError: a frame is unusable.
    """
    loader = DataLoader(
        _Told(frames),
        batch_size=ranks.share_of(batch_size),
        sampler=Positions(first_step, last_step, batch_size=batch_size, ranks=ranks),
        num_workers=workers,
        collate_fn=_collate_told,
        worker_init_fn=_single_threaded,
        prefetch_factor=4 if workers else None,
        generator=torch.Generator(),  # else each start of the loader draws from the generator that dropout uses
    )
    for batch in loader:
        if isinstance(batch, EdgeError):
            raise batch
        yield batch


class _Told(Dataset[Sample | EdgeError]):
    """Samples, or what is wrong with their frames, as a value: what a worker raises comes wrapped in a traceback."""

    def __init__(self, frames: MixedFrames) -> None:
        self._frames = frames

    def __getitem__(self, position: int) -> Sample | EdgeError:
        try:
            return self._frames[position]
        except EdgeError as error:
            return error


def _collate_told(told: list[Sample | EdgeError]) -> Batch | EdgeError:
    wrong = next((item for item in told if isinstance(item, EdgeError)), None)
    return collate([item for item in told if isinstance(item, Sample)]) if wrong is None else wrong


def collate(samples: list[Sample]) -> Batch:
    """Samples to one batch."""
    targets = [
        ImageTargets(
            label=torch.from_numpy(s.targets.label),
            positive=torch.from_numpy(s.targets.positive),
            deltas=torch.from_numpy(s.targets.deltas),
            facing=torch.from_numpy(s.targets.facing),
            object_count=s.targets.object_count,
        )
        for s in samples
    ]
    stacked = {}
    for name in ("left", "right", "disparity"):
        arrays = [getattr(sample, name) for sample in samples]
        stacked[name] = None if arrays[0] is None else torch.from_numpy(np.stack(arrays))
    unlabelled = sum(not sample.labelled for sample in samples)
    return Batch(**stacked, targets=targets, unlabelled=unlabelled)  # type: ignore[arg-type]


def _single_threaded(_: int) -> None:
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
