"""Opens the windowless OpenGL context that the simulator draws with."""

from __future__ import annotations

from typing import Any

from runtime.contracts.errors import MissingExtraError

MINIMUM_GL_VERSION = 410


def open_context() -> Any:
    """Open a standalone OpenGL context through EGL (Mesa on a CPU, the driver on a GPU).

    Returns:
        A `moderngl.Context`; the caller releases it.

    Raises:
        MissingExtraError: moderngl is not installed, or the machine offers no EGL with OpenGL 4.1.
    """
    try:
        import moderngl
    except ImportError as error:
        raise MissingExtraError(
            "moderngl is not installed, drawing simulated frames needs it; run: pip install .[simulate]"
        ) from error
    try:
        context = moderngl.create_context(standalone=True, backend="egl")
    except Exception as error:  # the loader raises plain Exception, ImportError or OSError by cause
        raise MissingExtraError(
            f"no OpenGL context through EGL ({_one_line(error)}), drawing simulated frames needs one; "
            "run: apt-get install libegl1 libgl1 libgl1-mesa-dri"
        ) from error
    if context.version_code < MINIMUM_GL_VERSION:
        found = context.version_code
        context.release()
        raise MissingExtraError(
            f"found OpenGL {found / 100:.1f} through EGL, expected {MINIMUM_GL_VERSION / 100:.1f} or newer; "
            "run: apt-get install libegl1 libgl1 libgl1-mesa-dri"
        )
    return context


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split()) or type(error).__name__
