"""``kitti-raw:DRIVE``: DRIVE/{image_02,image_03}/data, calib_cam_to_cam.txt in DRIVE or above it."""

from __future__ import annotations

from pathlib import Path

from runtime.contracts.errors import SourceError
from runtime.sources.kitti_files import expect_folder, frame_number, read_seconds, time_of
from runtime.sources.pairs import ImagePairs, PairFiles
from runtime.sources.pictures import list_images, locate_image
from runtime.sources.uri import SourceOptions, SourceUri

OPTIONS = ()
LAYOUT = "DRIVE/{image_02,image_03}/data with calib_cam_to_cam.txt in DRIVE or above it"
CALIBRATION = "calib_cam_to_cam.txt"


def open_kitti_raw(uri: SourceUri, options: SourceOptions) -> ImagePairs:
    """The frames of one drive; raw drives have no labels in this layout.

    Raises:
        SourceError: the drive, its images or its calibration are missing.
        FrameError: a frame has no right image.
    """
    drive = expect_folder(Path(uri.target), uri=uri.text, layout=LAYOUT)
    left = expect_folder(drive / "image_02" / "data", uri=uri.text, layout=LAYOUT)
    calibration = next(
        (path for path in (drive / CALIBRATION, drive.resolve().parent / CALIBRATION) if path.is_file()), None
    )
    if calibration is None:
        raise SourceError(
            f"{uri.text}: found no {CALIBRATION} in {drive} or above it, expected {LAYOUT}; "
            "add the calibration of the drive's date"
        )
    seconds = read_seconds(drive / "image_02" / "timestamps.txt")
    pairs = [
        PairFiles(
            frame_id=stem,
            left=path,
            right=None if options.views == "left" else locate_image(drive / "image_03" / "data", stem),
            calibration=calibration,
            timestamp_secs=time_of(frame_number(stem, where=path), seconds),
        )
        for stem, path in list_images(left).items()
    ]
    return ImagePairs(uri.text, pairs, options=options)
