"""What a model directory may say of where its frames came from."""

from __future__ import annotations

from pathlib import Path


def public_name(uri: str) -> str:
    """A source's URI without the folders above the last: what a model directory may say of where it was made.

    ``kitti-object:/data/kitti/object?split=train`` becomes ``kitti-object:object?split=train``.

    Raises:
        SourceError: ``uri`` is none.
    """
    from runtime.sources.uri import parse_uri

    parsed = parse_uri(uri)
    shown = ",".join(Path(part).name for part in parsed.target.split(","))
    options = {name: Path(value).name for name, value in parsed.options.items() if name != "geometry"}
    kept = "&".join(f"{name}={value}" for name, value in options.items())
    return f"{parsed.scheme}:{shown}" + (f"?{kept}" if kept else "")
