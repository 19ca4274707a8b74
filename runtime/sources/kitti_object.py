"""``kitti-object:ROOT?split=val``: training/{image_2,image_3,calib,label_2}, ImageSets/NAME.txt.

Without ``split``: every frame of ``training``. A split named ``test`` lies in ``testing``, as the benchmark
has it. Where the folder has no lists in ``ImageSets``, as it is downloaded, ``train`` and ``val`` are Chen's lists
(3,712 and 3,769 frames of the benchmark's training set), which lie in ``splits`` beside this file, and ``test`` is
every frame of ``testing``. Frames keep their KITTI numbers.
"""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from runtime.contracts.errors import SourceError
from runtime.contracts.kitti import parse_labels
from runtime.contracts.objects import Objects3D
from runtime.sources.base import DEFAULT_CAMERA_HZ
from runtime.sources.kitti_files import expect_file, expect_folder, text_of
from runtime.sources.pairs import ImagePairs, PairFiles
from runtime.sources.pictures import list_images, locate_image
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ("split",)
LAYOUT = "ROOT/training/{image_2,image_3,calib,label_2}"
TEST_SPLIT = "test"
BUNDLED_SPLITS = ("train", "val")
"""Chen's lists (Chen et al., 3D Object Proposals for Accurate Object Class Detection, 2015)."""


def open_kitti_object(uri: SourceUri, options: SourceOptions) -> ImagePairs:
    """The frames of an object-detection folder.

    Raises:
        SourceError: the folder, the split or every image is missing.
        FrameError: a frame of the split has no image.
    """
    root = expect_folder(Path(uri.target), uri=uri.text, layout=LAYOUT)
    split = uri.options.get("split")
    folder = root / ("testing" if split == TEST_SPLIT else "training")
    left = expect_folder(folder / "image_2", uri=uri.text, layout=LAYOUT)
    listed = split is not None and (split != TEST_SPLIT or (root / "ImageSets" / f"{split}.txt").is_file())
    stems = read_split(root / "ImageSets", str(split), uri=uri.text) if listed else list(list_images(left))
    pairs = [
        PairFiles(
            frame_id=stem,
            left=locate_image(left, stem),
            right=None if options.views == "left" else locate_image(folder / "image_3", stem),
            calibration=folder / "calib" / f"{stem}.txt",
            timestamp_secs=index / DEFAULT_CAMERA_HZ,
        )
        for index, stem in enumerate(stems)
    ]
    source = ImagePairs(uri.text, pairs, options=options, read_labels=_LabelFiles(folder / "label_2"))
    expect_file(pairs[0].calibration, uri=uri.text, layout=LAYOUT)
    return source


def read_split(folder: Path, name: str, *, uri: str) -> list[str]:
    """Frame names of ``ImageSets/NAME.txt``, in the file's order; Chen's list where the folder holds no list.

    Raises:
        SourceError: there is no such split, or it is empty.
    """
    path = folder / f"{name}.txt"
    own_lists = {item.stem for item in folder.glob("*.txt")}
    if not own_lists and name in BUNDLED_SPLITS:
        return bundled_split(name)
    text = text_of(path)
    if text is None:
        found = ", ".join(sorted(own_lists or BUNDLED_SPLITS))
        raise SourceError(f"{uri}: found no split {name!r} in {folder}, expected one of: {found}; choose one")
    stems = text.split()
    if not stems:
        raise SourceError(f"{uri}: the split {path} is empty, expected one frame name a line; fill it")
    return stems


def bundled_split(name: str) -> list[str]:
    """Frame names of one of Chen's lists, ascending."""
    return (files("runtime.sources") / "splits" / f"{name}.txt").read_text(encoding="utf-8").split()


class _LabelFiles:
    """Reads ``label_2/NAME.txt``; None where there is no such file."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder

    def __call__(self, pair: PairFiles) -> Objects3D | None:
        path = self._folder / f"{pair.frame_id}.txt"
        text = text_of(path)
        return None if text is None else parse_labels(text, where=str(path))
