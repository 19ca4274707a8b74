"""A tiny network and six drawn pairs, shared by the tests of runs."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture(scope="session")
def toy() -> ModuleType:
    """`two_process_worker` as a module: `DrawnFrames`, `tiny_preset`, `plain_priors`, `run`."""
    pytest.importorskip("torch", reason="the torch workbench is not installed")
    spec = importlib.util.spec_from_file_location(
        "two_process_worker", Path(__file__).with_name("two_process_worker.py")
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Tiny tensors are slower with two threads, and sums keep their order with one."""
    import torch

    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)
