"""The sinks that a stream was asked for."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from runtime.contracts.manifest import Manifest
from runtime.sinks.base import Sink
from runtime.sinks.canvas import CanvasWriter, OverlaySink, PictureFolder, VideoFile
from runtime.sinks.jsonl import JsonLinesSink
from runtime.sinks.kitti_txt import KittiTextSink
from runtime.sinks.overlay import OverlayRenderer


@dataclass(frozen=True, slots=True)
class SinkRequest:
    """What to write; None leaves a sink out.

    Attributes:
        json: file for JSON lines, ``-`` for standard output; kitti: folder for KITTI text; video: file;
            pictures: folder;
        overwrite: replace what is there.
    """

    json: str | None = None
    kitti: Path | None = None
    video: Path | None = None
    pictures: Path | None = None
    overwrite: bool = False


def open_sinks(request: SinkRequest, manifest: Manifest, *, fps: float) -> list[Sink]:
    """The sinks, their places claimed, to be entered by the caller.

    Args:
        request: what to write.
        manifest: of the model, for names in pictures.
        fps: of a video.

    Raises:
        OutputError: a place is taken or cannot be made.
    """
    sinks: list[Sink] = []
    if request.json is not None:
        sinks.append(JsonLinesSink(request.json, overwrite=request.overwrite))
    if request.kitti is not None:
        sinks.append(KittiTextSink(request.kitti, overwrite=request.overwrite))
    writers: list[CanvasWriter] = []
    if request.video is not None:
        writers.append(VideoFile(request.video, fps=fps, overwrite=request.overwrite))
    if request.pictures is not None:
        writers.append(PictureFolder(request.pictures, overwrite=request.overwrite))
    if writers:
        title = f"YOLOStereo3D {manifest.preset} {manifest.recipe}"
        sinks.append(OverlaySink(OverlayRenderer(title, manifest.classes), writers))
    return sinks
