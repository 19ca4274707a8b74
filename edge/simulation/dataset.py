"""Folders in KITTI's layouts, and the record that says how a folder was made."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from runtime.contracts.errors import FormatError, OutputError
from runtime.contracts.geometry import StereoGeometry
from runtime.contracts.kitti import format_calib
from runtime.rig import format_geometry

RECORD_NAME, RIG_NAME = "simulation.json", "rig.json"
RECORD_SCHEMA = 1
SEQUENCE = "0000"
IMAGE_FORMATS = ("jpg", "png", "webp")
SPLIT_NAMES = ("all", "train", "val")  # one simulated set is one side: each list names every frame
_ENCODER_FLAGS = {
    "jpg": lambda quality: [
        cv2.IMWRITE_JPEG_QUALITY,
        quality,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
        cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
    ],
    "png": lambda quality: [cv2.IMWRITE_PNG_COMPRESSION, 4],
    "webp": lambda quality: [cv2.IMWRITE_WEBP_QUALITY, quality],
}


@dataclass(frozen=True, slots=True)
class Record:
    """What made a folder; the same record may go on with it."""

    layout: str  # object or tracking
    seed: int
    rig: str
    image_format: str
    quality: int
    seconds: float  # 0 for single frames
    schema: int = RECORD_SCHEMA
    people: float = 1.0  # the two factors of a `Mix`; 1 is not written
    near: float = 1.0


def claim_folder(out: Path, record: Record) -> None:
    """Make the folder, or take up one that the same settings made before.

    Raises:
        OutputError: it is not empty and was not made by these settings, or cannot be made.
    """
    if out.exists() and not out.is_dir():
        raise OutputError(f"{out} is a file, expected a folder to write to; choose another place")
    try:
        out.mkdir(parents=True, exist_ok=True)
        taken = any(out.iterdir())
    except OSError as error:
        raise OutputError(
            f"{out} cannot be made ({error.strerror}), expected a writable place; choose another one"
        ) from None
    path = out / RECORD_NAME
    if taken and not path.is_file():
        raise OutputError(
            f"{out} is not empty and was not made by edge simulate, expected a new or empty folder; choose another one"
        )
    if taken:
        found = path.read_text(encoding="utf-8")
        if found != _record_text(record):
            raise OutputError(
                f"{out} was made with other settings (see {RECORD_NAME}), expected the same ones; choose another folder"
            )
    else:
        _write_text(path, _record_text(record))


def _record_text(record: Record) -> str:
    entries = {name: value for name, value in asdict(record).items() if name not in ("people", "near") or value != 1.0}
    return json.dumps(entries, indent=2) + "\n"


def _write_text(path: Path, text: str) -> None:
    """Write beside the place, then rename: an interrupted run leaves no half file."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def encode_image(image: NDArray[np.uint8], *, image_format: str, quality: int) -> bytes:
    """An encoded picture (H, W, 3) BGR.

    Raises:
        FormatError: unknown format, or the encoder refused.
    """
    if image_format not in IMAGE_FORMATS:
        raise FormatError(
            f"image format {image_format!r} is unknown, expected one of {', '.join(IMAGE_FORMATS)}; name one of them"
        )
    done, data = cv2.imencode(f".{image_format}", image, _ENCODER_FLAGS[image_format](quality))
    if not done:
        raise FormatError(f"OpenCV cannot write {image_format}, expected a build that can; use --format png")
    return data.tobytes()


@dataclass(frozen=True, slots=True)
class ObjectFolder:
    """KITTI object layout: training/{image_2,image_3,calib,label_2}, ImageSets."""

    root: Path
    image_format: str
    quality: int

    def prepare(self, geometry: StereoGeometry, frames: int) -> int:
        """Make the folders, the rig and the lists.

        Args:
            geometry: of the rig.
            frames: of the set. Complete frames beyond them that it lists already stay listed.

        Returns:
            How many frames the lists name.
        """
        for name in ("image_2", "image_3", "calib", "label_2"):
            (self.root / "training" / name).mkdir(parents=True, exist_ok=True)
        (self.root / "ImageSets").mkdir(exist_ok=True)
        _write_text(self.root / RIG_NAME, format_geometry(geometry))
        earlier = self._listed()
        indices = [*range(frames), *(index for index in earlier if index >= frames and self.has(index))]
        for split in SPLIT_NAMES:
            path = self.root / "ImageSets" / f"{split}.txt"
            if indices != earlier or not path.is_file():  # else the user may have shortened one
                _write_text(path, "".join(f"{index:06d}\n" for index in indices))
        return len(indices)

    def _listed(self) -> list[int]:
        """Frames that an earlier run named."""
        path = self.root / "ImageSets" / f"{SPLIT_NAMES[0]}.txt"
        words = path.read_text(encoding="utf-8").split() if path.is_file() else []
        return sorted({int(word) for word in words if word.isdecimal()})

    def has(self, index: int) -> bool:
        """Whether a frame is complete (its label is written last)."""
        return (self.root / "training" / "label_2" / f"{index:06d}.txt").is_file()

    def write(
        self,
        index: int,
        views: tuple[NDArray[np.uint8], NDArray[np.uint8]],
        *,
        geometry: StereoGeometry,
        label_text: str,
    ) -> None:
        """Write one labelled pair."""
        name = f"{index:06d}"
        for folder, view in zip(("image_2", "image_3"), views, strict=True):
            data = encode_image(view, image_format=self.image_format, quality=self.quality)
            (self.root / "training" / folder / f"{name}.{self.image_format}").write_bytes(data)
        _write_text(self.root / "training" / "calib" / f"{name}.txt", format_calib(geometry))
        _write_text(self.root / "training" / "label_2" / f"{name}.txt", label_text)


@dataclass(frozen=True, slots=True)
class TrackingFolder:
    """KITTI tracking layout: training/{image_02,image_03}/0000, calib, label_02."""

    root: Path
    image_format: str
    quality: int

    def prepare(self, geometry: StereoGeometry) -> None:
        """Make the folders, the rig and the calibration."""
        for name in ("image_02", "image_03"):
            (self.root / "training" / name / SEQUENCE).mkdir(parents=True, exist_ok=True)
        for name in ("calib", "label_02"):
            (self.root / "training" / name).mkdir(parents=True, exist_ok=True)
        _write_text(self.root / RIG_NAME, format_geometry(geometry))
        _write_text(self.root / "training" / "calib" / f"{SEQUENCE}.txt", format_calib(geometry))

    def write(self, index: int, views: tuple[NDArray[np.uint8], NDArray[np.uint8]]) -> None:
        """Write one pair."""
        for folder, view in zip(("image_02", "image_03"), views, strict=True):
            data = encode_image(view, image_format=self.image_format, quality=self.quality)
            (self.root / "training" / folder / SEQUENCE / f"{index:06d}.{self.image_format}").write_bytes(data)

    def write_labels(self, texts: list[str]) -> None:
        """Write the labels of all frames, in frame order."""
        _write_text(self.root / "training" / "label_02" / f"{SEQUENCE}.txt", "".join(texts))
