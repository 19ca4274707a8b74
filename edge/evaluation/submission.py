"""Results as the KITTI object benchmark's test server takes them: one text file a frame, all in one zip.

Each frame of the split has a file, empty where nothing was found, named by its six-digit number; the archive holds
the files at its root, as the object development kit asks for. Lines carry the score last.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Sequence
from pathlib import Path

from runtime.contracts.errors import OutputError, SourceError
from runtime.contracts.kitti import format_detections
from runtime.contracts.objects import Detections3D

DATA_FOLDER, ARCHIVE = "data", "results.zip"
FRAME_NAME = re.compile(r"\d{6}")
ARCHIVE_DATE = (1980, 1, 1, 0, 0, 0)
"""Of every member: the same results give the same bytes."""


def check_frame_names(frame_ids: Sequence[str]) -> None:
    """Refuse frames that the server does not know.

    Raises:
        SourceError: a name is no six-digit number, or comes twice.
    """
    wrong = [name for name in frame_ids if not FRAME_NAME.fullmatch(name)]
    if wrong:
        raise SourceError(
            f"results for the test server: found the frame {wrong[0]!r}, expected six digits such as 000012; "
            "take frames of kitti-object:ROOT?split=test"
        )
    if len(set(frame_ids)) < len(frame_ids):
        raise SourceError("results for the test server: found a frame twice, expected each once; mend the split")


def write_submission(folder: Path, frame_ids: Sequence[str], detections: Sequence[Detections3D]) -> Path:
    """Write ``data/NNNNNN.txt`` and ``results.zip`` into an existing folder.

    Args:
        folder: where to.
        frame_ids: six-digit names.
        detections: of each frame.

    Returns:
        The archive.

    Raises:
        SourceError: a frame name that the server does not know.
        OutputError: the place cannot be written to.
    """
    check_frame_names(frame_ids)
    texts = {f"{name}.txt": format_detections(found) for name, found in zip(frame_ids, detections, strict=True)}
    data, archive = folder / DATA_FOLDER, folder / ARCHIVE
    try:
        data.mkdir(parents=True, exist_ok=True)
        for name, text in texts.items():
            (data / name).write_text(text, encoding="utf-8")
        with zipfile.ZipFile(archive, "w") as members:
            for name in sorted(texts):
                member = zipfile.ZipInfo(name, ARCHIVE_DATE)
                member.compress_type = zipfile.ZIP_DEFLATED
                members.writestr(member, texts[name])
    except OSError as error:
        raise OutputError(
            f"{folder} cannot be written ({error.strerror}), expected a writable place; choose another"
        ) from error
    return archive
