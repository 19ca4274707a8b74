"""The kernels under the address and undefined-behaviour sanitizers, in a program of their own."""

from __future__ import annotations

import platform
import shutil
import subprocess
from pathlib import Path

import pytest

from runtime.native.build import (
    COMMON_FLAGS,
    SOURCE_DIRECTORY,
    BuildError,
    compile_objects,
    find_compiler,
    kernel_flags,
    link,
)

SANITIZE = ("-fsanitize=address,undefined", "-fno-sanitize-recover=all", "-g", "-O1")
DRIVER = Path(__file__).with_name("kernel_driver.cc")


@pytest.fixture(scope="module")
def compiler(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """A compiler with sanitizers; tests skip, saying so, where there is none."""
    try:
        found = find_compiler()
    except BuildError as error:
        pytest.skip(str(error))
    folder = tmp_path_factory.mktemp("probe")
    probe = folder / "probe.cc"
    probe.write_text("int main() { return 0; }\n")
    try:
        link(found, compile_objects(found, [probe], folder, flags=SANITIZE), folder / "probe", flags=SANITIZE)
    except BuildError as error:
        pytest.skip(f"the compiler has no sanitizers: {error}")
    return found


@pytest.mark.slow
def test_no_kernel_steps_beside_its_buffers(compiler: list[str], tmp_path: Path) -> None:
    flags = [*COMMON_FLAGS, *SANITIZE, f"-I{SOURCE_DIRECTORY}"]
    sources = [*(SOURCE_DIRECTORY / name for name in kernel_flags(platform.machine())), DRIVER]
    program = tmp_path / "kernel_driver"
    link(compiler, compile_objects(compiler, sources, tmp_path, flags=flags), program, flags=SANITIZE)
    result = subprocess.run([program], capture_output=True, text=True, check=False, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "scalar: 0 wrong" in result.stdout


@pytest.mark.slow
def test_neon_kernels_under_emulation(tmp_path: Path) -> None:
    """The ARM kernels on any machine that has a cross compiler and an emulator."""
    compiler, emulator = shutil.which("aarch64-linux-gnu-g++"), shutil.which("qemu-aarch64-static")
    if compiler is None or emulator is None:
        pytest.skip("no aarch64-linux-gnu-g++ or no qemu-aarch64-static on this machine")
    flags = [*COMMON_FLAGS, "-O2", f"-I{SOURCE_DIRECTORY}"]
    sources = [*(SOURCE_DIRECTORY / name for name in kernel_flags("aarch64")), DRIVER]
    program = tmp_path / "kernel_driver"
    objects = compile_objects([compiler], sources, tmp_path, flags=flags, machine="aarch64")
    link([compiler], objects, program, flags=("-static",))
    result = subprocess.run([emulator, program], capture_output=True, text=True, check=False, timeout=300)
    assert result.returncode == 0, result.stdout + result.stderr
    assert "neon: 0 wrong" in result.stdout


def test_no_compiler_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(BuildError, match=r"^found no C\+\+ compiler; expected .*function body serves"):
        find_compiler()


def test_a_compiler_that_fails_is_one_line(tmp_path: Path) -> None:
    source = tmp_path / "broken.cc"
    source.write_text("int main() { return unknown; }\n")
    try:
        found = find_compiler()
    except BuildError as error:
        pytest.skip(str(error))
    with pytest.raises(BuildError, match=r"found that broken\.cc does not compile") as caught:
        compile_objects(found, [source], tmp_path, flags=())
    assert "\n" not in str(caught.value)
