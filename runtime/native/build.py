"""Compiles the native operator library; ``python -m runtime.native.build`` does it in place.

Standard library only, since ``setup.py`` loads this file before anything is installed.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

LIBRARY_NAME = "libedge_stereo.so"
SOURCE_DIRECTORY = Path(__file__).parent

COMMON_FLAGS = (
    "-std=c++17",
    "-fPIC",
    "-fvisibility=hidden",
    "-ffp-contract=off",
    "-Wall",
    "-Wextra",
    "-Werror",
)
"""No contraction: a*b+c in one rounding would change the quantized operator's bits."""

LINK_FLAGS = ("-shared", "-static-libstdc++", "-static-libgcc", "-Wl,--exclude-libs,ALL")
"""The C++ runtime inside and hidden, so that the library runs on older systems and meets no other copy."""

_AVX512 = ("-mavx512f", "-mavx512bw", "-mfma")
_ANYWHERE: dict[str, tuple[str, ...]] = {
    "candidates.cc": (),
    "correlation_scalar.cc": (),
    "dispatch.cc": (),
    "matching.cc": (),
    "refine.cc": (),
}
_ENTRIES = ("register.cc", "entry.cc")
_X86 = {
    "correlation_avx2.cc": ("-mavx2", "-mfma"),
    "correlation_avx512.cc": _AVX512,
    "correlation_vnni.cc": (*_AVX512, "-mavx512vnni"),
}
_ARM: dict[str, tuple[str, ...]] = {"correlation_neon.cc": ()}


def kernel_flags(machine: str) -> dict[str, tuple[str, ...]]:
    """Kernel sources for a machine, and what each adds to the common flags.

    Args:
        machine: As ``platform.machine()`` names it.
    """
    kernels = {"x86_64": _X86, "AMD64": _X86, "aarch64": _ARM, "arm64": _ARM}
    return _ANYWHERE | kernels.get(machine, {})


HINT = "the models' function body serves instead (same results, slower)"


class BuildError(Exception):
    """The library cannot be built here; the message is one line. Not fatal: the function body serves."""


def find_compiler() -> list[str]:
    """The C++ compiler as a command line: ``$CXX``, else c++, g++ or clang++.

    Raises:
        BuildError: There is none.
    """
    if wanted := os.environ.get("CXX"):
        return shlex.split(wanted)
    for name in ("c++", "g++", "clang++"):
        if path := shutil.which(name):
            return [path]
    raise BuildError(f"found no C++ compiler; expected c++, g++ or clang++ (or CXX); install one, else {HINT}")


def compile_objects(
    compiler: Sequence[str],
    sources: Sequence[Path],
    out: Path,
    *,
    flags: Sequence[str],
    machine: str | None = None,
) -> list[Path]:
    """Compiles sources side by side, one process each.

    Args:
        compiler: From ``find_compiler``.
        sources: ``.cc`` files; kernels get their own flags as well.
        out: Directory for the objects.
        flags: For all of them.
        machine: That the compiler makes code for; this one where not given.

    Raises:
        BuildError: A file does not compile.
    """
    objects = [out / f"{source.stem}.o" for source in sources]
    own_flags = kernel_flags(machine or platform.machine())
    commands = [
        [*compiler, *flags, *own_flags.get(source.name, ()), "-c", str(source), "-o", str(target)]
        for source, target in zip(sources, objects, strict=True)
    ]
    running = [
        subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) for command in commands
    ]
    outputs = [process.communicate()[0] for process in running]
    for source, process, output in zip(sources, running, outputs, strict=True):
        if process.returncode != 0:
            raise _failure(source.name, output)
    return objects


def link(compiler: Sequence[str], objects: Sequence[Path], out: Path, *, flags: Sequence[str]) -> None:
    """Links objects to a library or program.

    Raises:
        BuildError: The linker fails.
    """
    command = [*compiler, *flags, *map(str, objects), "-o", str(out)]
    result = subprocess.run(command, capture_output=True, text=True, check=False)
    if result.returncode != 0:
        raise _failure(out.name, result.stderr)


def build(directory: Path) -> Path:
    """Builds the library into a directory.

    Returns:
        Its path.

    Raises:
        BuildError: There is no compiler, or it fails.
    """
    compiler = find_compiler()
    sources = [SOURCE_DIRECTORY / name for name in (*kernel_flags(platform.machine()), *_ENTRIES)]
    directory.mkdir(parents=True, exist_ok=True)
    try:
        with tempfile.TemporaryDirectory(prefix="edge-stereo-") as scratch:
            objects = compile_objects(compiler, sources, Path(scratch), flags=[*COMMON_FLAGS, "-O3"])
            # Beside its place and then renamed: a session may have the old one mapped.
            fresh = directory / f".{LIBRARY_NAME}.{os.getpid()}"
            link(compiler, objects, fresh, flags=LINK_FLAGS)
            fresh.replace(directory / LIBRARY_NAME)
    except OSError as error:
        raise BuildError(
            f"found that the compiler cannot be run ({error}); expected a working one; check CXX, else {HINT}"
        ) from error
    return directory / LIBRARY_NAME


def is_current(library: Path) -> bool:
    """Whether a library is newer than all that it is built from."""
    made_from = [*SOURCE_DIRECTORY.glob("*.cc"), *SOURCE_DIRECTORY.glob("*.h"), Path(__file__)]
    return library.is_file() and all(path.stat().st_mtime <= library.stat().st_mtime for path in made_from)


def main(arguments: Sequence[str] = ()) -> int:
    """Builds in place what is not current; ``--force`` builds anyway.

    Returns:
        0, also where there is no compiler, since the function body serves then; 1 where an outdated library
        cannot be removed, which would be loaded.
    """
    library = SOURCE_DIRECTORY / LIBRARY_NAME
    if is_current(library) and "--force" not in arguments:
        return 0
    try:
        built = build(SOURCE_DIRECTORY)
    except BuildError as error:
        sys.stderr.write(f"native correlation library: {error}\n")
        try:
            library.unlink(missing_ok=True)  # of an older build
        except OSError as kept:
            sys.stderr.write(f"native correlation library: found an outdated {library.name} that stays ({kept}); ")
            sys.stderr.write("expected to remove it; delete it by hand\n")
            return 1
    else:
        sys.stdout.write(f"native correlation library: built {built.name}\n")
    return 0


def _failure(name: str, output: str) -> BuildError:
    first = next((line for line in output.splitlines() if "error" in line.lower()), output.strip()[:200])
    return BuildError(
        f"found that {name} does not compile ({first}); expected a C++17 compiler; update it, else {HINT}"
    )


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
