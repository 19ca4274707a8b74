"""The library's way to thin candidates, where it is built."""

from __future__ import annotations

import pytest

from runtime.candidates import Thinning, thinning
from runtime.native.library import library_path


@pytest.fixture(scope="session")
def native_thinning() -> Thinning:
    """Tests skip where the library is not built, and fail where it is an older one."""
    if library_path() is None:
        pytest.skip("the native library is not built")
    found, oracle = thinning(), Thinning()
    assert found.suppress is not oracle.suppress, "run python -m runtime.native.build"
    assert found.vote is not oracle.vote, "run python -m runtime.native.build"
    return found
