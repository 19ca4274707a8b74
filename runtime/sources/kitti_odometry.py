"""``kitti-odometry:ROOT?sequence=04``: sequences/04/{image_2,image_3,calib.txt,times.txt}.

Frame ids are ``04/000003``; without ``sequence``: all of them, one after the other.
"""

from __future__ import annotations

from pathlib import Path

from runtime.sources.kitti_files import (
    expect_file,
    expect_folder,
    frame_number,
    read_seconds,
    sequence_folders,
    time_of,
)
from runtime.sources.pairs import ImagePairs, PairFiles
from runtime.sources.pictures import list_images, locate_image
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ("sequence",)
LAYOUT = "ROOT/sequences/NUMBER/{image_2,image_3,calib.txt,times.txt}"


def open_kitti_odometry(uri: SourceUri, options: SourceOptions) -> ImagePairs:
    """The frames of one or all sequences; odometry has no labels.

    Raises:
        SourceError: a folder, the sequence or its calibration is missing.
        FrameError: a frame has no right image.
    """
    root = expect_folder(Path(uri.target), uri=uri.text, layout=LAYOUT)
    parent = expect_folder(root / "sequences", uri=uri.text, layout=LAYOUT)
    pairs: list[PairFiles] = []
    for folder in sequence_folders(parent, uri.options.get("sequence"), uri=uri.text):
        calibration = expect_file(folder / "calib.txt", uri=uri.text, layout=LAYOUT)
        left = expect_folder(folder / "image_2", uri=uri.text, layout=LAYOUT)
        seconds = read_seconds(folder / "times.txt")
        pairs.extend(
            PairFiles(
                frame_id=f"{folder.name}/{stem}",
                left=path,
                right=None if options.views == "left" else locate_image(folder / "image_3", stem),
                calibration=calibration,
                timestamp_secs=time_of(frame_number(stem, where=path), seconds),
            )
            for stem, path in list_images(left).items()
        )
    return ImagePairs(uri.text, pairs, options=options)
