"""``edge doctor``: what this machine has, what is missing, and the line that installs it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from pathlib import Path

DISTRIBUTION = "stereo-edge"
EXTRAS: dict[str, tuple[str, ...]] = {
    "oak": ("depthai",),
    "export": ("torch", "onnx", "onnxscript", "onnxsim", "safetensors"),
    "quantize": ("onnx", "onnxsim"),
    "train": ("torch", "safetensors", "matplotlib", "tensorboardX"),
    "simulate": ("moderngl", "glcontext"),
    "report": ("matplotlib",),
}
"""Extra to the packages that its commands import."""
SLIM_DISTRIBUTIONS = ("numpy", "onnxruntime", "opencv-python-headless", "typer", "rich")
EGL_LIBRARIES = ("libEGL.so.1", "libGL.so.1")
EGL_PACKAGES = "apt-get install libegl1 libgl1 libgl1-mesa-dri"
COMPILERS = ("c++", "g++", "clang++")
SELF_CHECK_FRAMES = 3


class State(Enum):
    """How a finding is to be taken."""

    GOOD = "green"
    OPTIONAL = "yellow"
    BROKEN = "red"


@dataclass(frozen=True, slots=True)
class Finding:
    """One row: what was looked at, what was found, what to do about it ("" for nothing)."""

    subject: str
    found: str
    state: State = State.GOOD
    remedy: str = ""


def doctor_command() -> None:
    """Tell what is installed, what is missing, and whether the bundled model works here."""
    from rich.console import Console
    from rich.table import Table
    from rich.text import Text

    findings = [*_packages(), *_processor(), *_native_library(), *_extras(), *_egl(), *_cameras(), *_self_check()]
    table = Table(title="edge doctor")
    for heading in ("subject", "found", "to do"):
        table.add_column(heading, overflow="fold")
    for finding in findings:
        table.add_row(finding.subject, Text(finding.found, style=finding.state.value), Text(finding.remedy))
    Console().print(table)
    if any(finding.state is State.BROKEN for finding in findings):
        raise typer.Exit(1)


def _packages() -> list[Finding]:
    import platform

    from runtime.machine import package_version

    rows = [Finding(DISTRIBUTION, package_version(DISTRIBUTION) or "not installed, run from its folder")]
    rows.append(Finding("Python", f"{platform.python_version()} on {platform.system()} {platform.machine()}"))
    for name in SLIM_DISTRIBUTIONS:
        version = package_version(name)
        # another build of OpenCV serves as well, so what counts is whether the self-check below runs
        missing = Finding(name, "not installed", State.OPTIONAL, f"pip install {name}")
        rows.append(missing if version is None else Finding(name, version))
    return rows


def _processor() -> list[Finding]:
    from runtime.machine import processor

    cpu = processor()
    rows = [Finding("processor", f"{cpu.model}, {cpu.cores} cores")]
    if cpu.flags is None:
        rows.append(Finding("instructions", "the system does not tell", State.OPTIONAL))
    elif cpu.has_int8_dot_products:
        rows.append(Finding("instructions", " ".join(cpu.flags)))
    else:
        slow = "no INT8 dot products: INT8 gains less here"
        rows.append(Finding("instructions", " ".join(cpu.flags) or "none known", State.OPTIONAL, slow))
    return [*rows, _target()]


def _target() -> Finding:
    """What ``edge quantize`` takes here when it is told nothing, and whether that is known to be fast."""
    from quantize.recipe import detect_target, recipe_for_target

    recipe = recipe_for_target(detect_target())
    found = f"{recipe.target}: {recipe.weight_bits}-bit weights, {recipe.activation_type} activations"
    if recipe.verified == "measured" and recipe.target != "generic":
        return Finding("INT8 target", found)
    slow = "INT8 may be slower than float32 here: compare both with edge bench before you ship"
    return Finding("INT8 target", found, State.OPTIONAL, slow)


def _native_library() -> list[Finding]:
    import shutil

    from runtime.native.library import library_path

    path = library_path()
    if path is not None:
        return [Finding("native library", f"built ({path.name})")]
    compiler = next((name for name in COMPILERS if shutil.which(name)), None)
    remedy = "python -m runtime.native.build" if compiler else "apt-get install g++, then pip install ."
    return [Finding("native library", "not built; the models' function body serves, slower", State.OPTIONAL, remedy)]


def _extras() -> list[Finding]:
    rows = []
    for extra, packages in EXTRAS.items():
        missing = [name for name in packages if not _installed(name)]
        if missing:
            remedy = f"pip install '.[{extra}]'"
            rows.append(Finding(f"extra {extra}", f"missing {', '.join(missing)}", State.OPTIONAL, remedy))
        else:
            rows.append(Finding(f"extra {extra}", "installed"))
    return rows


def _installed(module: str) -> bool:
    from importlib.util import find_spec

    try:
        return find_spec(module) is not None
    except (ModuleNotFoundError, ValueError):
        return False


def _egl() -> list[Finding]:
    import ctypes

    missing = []
    for name in EGL_LIBRARIES:
        try:
            ctypes.CDLL(name)
        except OSError:
            missing.append(name)
    if missing:
        return [Finding("EGL (for edge simulate)", f"missing {', '.join(missing)}", State.OPTIONAL, EGL_PACKAGES)]
    return [Finding("EGL (for edge simulate)", "found")]


def _cameras() -> list[Finding]:
    if not _installed("depthai"):
        return [Finding("OAK cameras", "not looked for", State.OPTIONAL, "pip install '.[oak]'")]
    from runtime.contracts.errors import MissingExtraError
    from runtime.sources.oak import import_depthai

    try:
        found = import_depthai().Device.getAllAvailableDevices()
    except (ImportError, RuntimeError, MissingExtraError) as error:
        return [Finding("OAK cameras", f"depthai does not run: {error}", State.OPTIONAL, "pip install '.[oak]' again")]
    if not found:
        return [Finding("OAK cameras", "none connected", State.OPTIONAL)]
    return [Finding("OAK camera", f"{info.name} ({info.getDeviceId()})") for info in found]


def _self_check() -> list[Finding]:
    from importlib.resources import files
    from pathlib import Path

    from runtime.contracts.manifest import MANIFEST_FILE

    models = sorted(Path(str(files("edge.zoo"))).glob(f"*/{MANIFEST_FILE}"))
    if not models:
        return [Finding("bundled model", "none in this copy", State.OPTIONAL, "edge export, edge quantize")]
    return [_run_model(path.parent) for path in models]


def _run_model(folder: Path) -> Finding:
    """Loads a bundled model and looks at a few frames of the bundled recording."""
    from runtime.contracts.errors import EdgeError

    subject = f"bundled model {folder.name}"
    try:
        from edge.cli.notices import Notices
        from edge.samples import measuring_source
        from runtime.detector import open_detector
        from runtime.pipeline import run_stream
        from runtime.sources.factory import open_source

        with (
            Notices(),
            open_source(f"{measuring_source()}?limit={SELF_CHECK_FRAMES}") as frames,
            open_detector(folder) as detector,
        ):
            report = run_stream(frames, detector, [], score=detector.manifest.thresholds.display)
            native = detector.session.native_loaded
    except (EdgeError, ImportError) as error:  # a package may be missing, or lack a library of the system
        return Finding(subject, str(error), State.BROKEN, "install this package again")
    if report.interrupted:
        raise KeyboardInterrupt
    median_ms = report.latency.summary()["inference"].p50
    kernel = "native library" if native else "function body"
    found = f"{report.detections} boxes in {report.frames} frames, {median_ms:.0f} ms inference with the {kernel}"
    if report.detections == 0:
        return Finding(subject, found, State.BROKEN, "expected boxes: install this package again")
    return Finding(subject, found)
