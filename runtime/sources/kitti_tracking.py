"""``kitti-tracking:ROOT?sequence=0001``: training/{image_02,image_03,calib,label_02}.

Frame ids are ``0010/000003``; without ``sequence``: all of them, one after the other.
"""

from __future__ import annotations

from pathlib import Path

from runtime.contracts.kitti import KITTI_CLASSES, parse_tracking_labels
from runtime.contracts.objects import Objects3D
from runtime.sources.kitti_files import expect_file, expect_folder, frame_number, sequence_folders, text_of, time_of
from runtime.sources.pairs import ImagePairs, PairFiles
from runtime.sources.pictures import list_images, locate_image
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ("sequence",)
LAYOUT = "ROOT/training/{image_02,image_03}/SEQUENCE, calib/SEQUENCE.txt, label_02/SEQUENCE.txt"


def open_kitti_tracking(uri: SourceUri, options: SourceOptions) -> ImagePairs:
    """The frames of one or all sequences.

    Raises:
        SourceError: a folder, the sequence or its calibration is missing.
        FrameError: a frame has no right image.
    """
    root = expect_folder(Path(uri.target), uri=uri.text, layout=LAYOUT) / "training"
    parent = expect_folder(root / "image_02", uri=uri.text, layout=LAYOUT)
    pairs: list[PairFiles] = []
    for folder in sequence_folders(parent, uri.options.get("sequence"), uri=uri.text):
        calibration = expect_file(root / "calib" / f"{folder.name}.txt", uri=uri.text, layout=LAYOUT)
        for stem, left in list_images(folder).items():
            right = None if options.views == "left" else locate_image(root / "image_03" / folder.name, stem)
            pairs.append(
                PairFiles(
                    frame_id=f"{folder.name}/{stem}",
                    left=left,
                    right=right,
                    calibration=calibration,
                    timestamp_secs=time_of(frame_number(stem, where=left), None),
                )
            )
    return ImagePairs(uri.text, pairs, options=options, read_labels=_LabelTables(root / "label_02"))


class _LabelTables:
    """Reads ``label_02/SEQUENCE.txt`` once; a frame without a line has no objects."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._tables: dict[str, dict[int, Objects3D] | None] = {}

    def __call__(self, pair: PairFiles) -> Objects3D | None:
        sequence, _, stem = pair.frame_id.partition("/")
        if sequence not in self._tables:
            path = self._folder / f"{sequence}.txt"
            text = text_of(path)
            self._tables[sequence] = None if text is None else parse_tracking_labels(text, where=str(path))
        table = self._tables[sequence]
        return None if table is None else table.get(int(stem), Objects3D.empty(KITTI_CLASSES))
