"""KITTI result text: one file a frame, empty where nothing was found; a slash in its id makes a folder."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType
from typing import Self

from runtime.contracts.errors import OutputError
from runtime.contracts.kitti import format_detections
from runtime.sinks.base import FrameResult
from runtime.sinks.places import claim_folder


class KittiTextSink:
    """Writes ``FOLDER/FRAME_ID.txt``."""

    def __init__(self, folder: Path | str, *, overwrite: bool = False) -> None:
        """Claims the folder."""
        self._folder = claim_folder(Path(folder), overwrite=overwrite)
        self._older = set(self._folder.rglob("*.txt"))  # of this run only a count: a camera has no last frame
        self._count = 0

    def __enter__(self) -> Self:
        """Returns itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Each file is closed already."""

    def write(self, result: FrameResult) -> None:
        """One file.

        Raises:
            OutputError: it cannot be written.
        """
        path = self._folder / f"{result.frame.frame_id}.txt"
        try:
            is_new = path in self._older or not path.exists()
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(format_detections(result.detections), encoding="utf-8")
        except OSError as error:
            raise OutputError(
                f"{path} cannot be written ({error.strerror}), expected a writable place; choose another"
            ) from error
        self._older.discard(path)
        self._count += is_new

    def summary(self) -> str:
        """What was written where, and whether older files lie beside it."""
        others = len(self._older)
        beside = f" ({others} older text files are beside them)" if others else ""
        return f"{self._count} KITTI text files in {self._folder}{beside}"
