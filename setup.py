"""Builds the native operator library while installing; everything else is in pyproject.toml.

Without a compiler the install succeeds all the same and says so once: the models' function body serves.
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

from setuptools import Extension, setup
from setuptools.command.build_ext import build_ext

ROOT = Path(__file__).parent
PACKAGE = ("runtime", "native")


def _native_build() -> ModuleType:
    """The build module, loaded from its file: the package itself is not importable yet."""
    path = ROOT.joinpath(*PACKAGE, "build.py")
    spec = importlib.util.spec_from_file_location("edge_native_build", path)
    if spec is None or spec.loader is None:
        raise FileNotFoundError(path)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


class BuildNative(build_ext):
    """Compiles a plain shared library, which ONNX Runtime loads, in place of a Python extension."""

    def run(self) -> None:
        """Builds into the wheel's tree, or into the source tree for an editable install."""
        native = _native_build()
        in_tree = self.inplace or self.editable_mode
        directory = (ROOT if in_tree else Path(self.build_lib)).joinpath(*PACKAGE)
        try:
            native.build(directory)
        except native.BuildError as error:
            (directory / native.LIBRARY_NAME).unlink(missing_ok=True)  # of an older build
            sys.stderr.write(f"native correlation library: {error}\n")

    def get_outputs(self) -> list[str]:
        """What ``run`` wrote, if it could."""
        library = Path(self.build_lib).joinpath(*PACKAGE, _native_build().LIBRARY_NAME)
        return [str(library)] if library.is_file() else []

    def get_output_mapping(self) -> dict[str, str]:
        """Nothing to map: an editable install has the library in the source tree already."""
        return {}


setup(
    # Named only so that setuptools builds a wheel for this platform and runs the command above.
    ext_modules=[Extension("runtime.native.edge_stereo", sources=[])],
    cmdclass={"build_ext": BuildNative},
)
