"""What may lie in the tree: sizes, no paths or names of anybody's machine, no real frames."""

from __future__ import annotations

import hashlib
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
MIB = 1 << 20
# So that a clone stays quick: all, recordings, weights, models, the rest.
LIMITS_MIB = {"all": 40, "recordings": 8, "weights": 16, "models": 10, "rest": 4}
PACKAGES = ("calib", "edge", "export", "quantize", "runtime")
PICTURE_SUFFIXES = {".jpg", ".jpeg", ".png", ".webp", ".bmp", ".mp4", ".avi", ".webm"}
PICTURE_FOLDERS = ("edge/samples/", "docs/")
# "someone" is whom tests make up.
ABSOLUTE_PATH = re.compile(rb"(?<![\w.:/])/(?:work|root|home|Users|mnt|opt)" rb"/(?!someone\b)[\w.-]+")
REAL_DRIVE = re.compile(rb"20\d\d_\d\d_\d\d_" rb"drive_\d{4}")


def tracked_files() -> list[Path]:
    """Files that git tracks and that are there, relative to the repository."""
    if shutil.which("git") is None or not (REPOSITORY / ".git").exists():
        pytest.skip("the tree is no git checkout here")
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=REPOSITORY, capture_output=True, check=True).stdout
    paths = [Path(name) for name in listed.decode().split("\0") if name]
    return [path for path in paths if (REPOSITORY / path).is_file()]


def kind(path: Path) -> str:
    """Which limit a file counts against."""
    name = path.as_posix()
    if name.startswith("edge/samples/"):
        return "recordings"
    if path.suffix == ".safetensors":
        return "weights"
    if name.startswith("edge/zoo/") and path.suffix in (".onnx", ".npz", ".json", ".md"):
        return "models"
    return "rest"


def test_sizes_stay_within_their_limits() -> None:
    sums = dict.fromkeys(LIMITS_MIB, 0)
    for path in tracked_files():
        size = (REPOSITORY / path).stat().st_size
        sums[kind(path)] += size
        sums["all"] += size
    assert sums["rest"] > 0
    too_large = {name: total / MIB for name, total in sums.items() if total > LIMITS_MIB[name] * MIB}
    assert too_large == {}


@pytest.mark.parametrize("suffix", [".pt", ".pth", ".pkl", ".npy", ".so", ".o", ".pyc", ".gz", ".zip", ".tar"])
def test_no_pickles_builds_or_archives(suffix: str) -> None:
    assert [path for path in tracked_files() if path.suffix == suffix] == []


def test_no_absolute_paths() -> None:
    """Also in models, manifests and weights, which tools like to stamp with where they were made."""
    found = {}
    for path in tracked_files():
        own = path.as_posix() == "tests/test_tree.py"
        if (
            not own
            and path.suffix not in PICTURE_SUFFIXES
            and (hits := ABSOLUTE_PATH.findall((REPOSITORY / path).read_bytes()))
        ):
            found[path.as_posix()] = hits[:3]
    assert found == {}


@pytest.mark.parametrize(
    ("text", "found"),
    [
        (b"", False),
        (b"saved to /" + b"home/me/model.onnx", True),
        (b'File "/' + b'root/a.py"', True),
        (b"edge/work/x, https://example.org/home/page", False),  # part of a longer path or an address
        (b"/path/to/model", False),
    ],
)
def test_the_search_for_absolute_paths(text: bytes, found: bool) -> None:
    assert bool(ABSOLUTE_PATH.search(text)) is found


LIST_WHEEL = """
from setuptools.dist import Distribution
made = Distribution({"script_name": "setup.py"})
made.parse_config_files(["pyproject.toml"])
command = made.get_command_obj("build_py")
command.ensure_finalized()
for name in command.get_outputs(include_bytecode=False):
    print(name.removeprefix(command.build_lib + "/"))
"""


def test_the_wheel_has_every_file_of_the_packages() -> None:
    """A recipe or a model that stays behind would be missed only by those who do not work in the tree."""
    pytest.importorskip("setuptools")
    ran = subprocess.run(
        [sys.executable, "-W", "ignore", "-c", LIST_WHEEL], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert ran.returncode == 0, ran.stderr
    packed = set(ran.stdout.split())
    tracked = {path.as_posix() for path in tracked_files() if path.parts[0] in PACKAGES}
    assert tracked
    assert tracked - packed == set()


def test_pictures_lie_only_where_simulated_ones_belong() -> None:
    pictures = [path.as_posix() for path in tracked_files() if path.suffix.lower() in PICTURE_SUFFIXES]
    assert [name for name in pictures if not name.startswith(PICTURE_FOLDERS)] == []


def test_nothing_is_named_after_a_real_drive() -> None:
    """Neither a file nor anything that a bundled model or recording says; tests may read real drives by name."""
    found = {}
    for path in tracked_files():
        said = b"" if path.parts[0] == "tests" else (REPOSITORY / path).read_bytes()
        if names := set(REAL_DRIVE.findall(path.as_posix().encode() + b"\n" + said)):
            found[path.as_posix()] = sorted(names)[:3]
    assert found == {}


def test_no_real_frame_or_label_is_tracked(kitti_dir: Path) -> None:
    """No tracked file has the bytes of a real picture, label or calibration."""
    sizes: dict[int, list[Path]] = {}
    for path in kitti_dir.rglob("*"):
        if path.is_file() and path.stat().st_size:
            sizes.setdefault(path.stat().st_size, []).append(path)
    found = []
    for path in tracked_files():
        rivals = sizes.get((REPOSITORY / path).stat().st_size, [])
        if rivals:
            digest = hashlib.sha256((REPOSITORY / path).read_bytes()).digest()
            found += [path for rival in rivals if hashlib.sha256(rival.read_bytes()).digest() == digest]
    assert found == []
