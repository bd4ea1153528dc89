"""Compiled code is kept: one process compiles all of it while others wait for what they need."""

import threading
from typing import Any

import pytest

from dt_viz.kernels import compiled
from dt_viz.kernels.compiled import compiling_all, complete, short_kernel

PATIENCE = 60
"""Seconds after which a test gives up; nothing takes that long."""


def twice(x):
    return 2 * x


def loads(kernel: Any) -> int:
    """Number of times that code for it was loaded, not compiled."""
    return sum(kernel._cache_hits.values())


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Folder of compiled code."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    return tmp_path / "kernels"


@pytest.fixture
def kept(folder, tmp_path):
    """Take what is kept away; return what puts it back."""
    assert short_kernel(twice)(2.0) == 4.0
    (file,) = folder.glob("test_compiled.twice-*")
    hidden = file.rename(tmp_path / "hidden")
    return lambda: hidden.rename(file)


def test_who_needs_a_kernel_waits_while_all_are_compiled_and_loads_it_then(kept):
    kernel, done = short_kernel(twice), threading.Event()
    thread = threading.Thread(target=lambda: (kernel(2.0), done.set()))
    with compiling_all() as wanted:
        assert wanted
        thread.start()
        assert not done.wait(0.5)
        kept()
    thread.join(PATIENCE)
    assert done.is_set()
    assert loads(kernel) == 1  # it was not compiled again


def test_who_compiles_for_others_does_not_wait(kept, monkeypatch):
    monkeypatch.setattr(compiled, "_waits", False)
    with compiling_all():
        assert short_kernel(twice)(2.0) == 4.0


def test_a_kernel_that_is_missing_afterwards_is_compiled(kept):
    with compiling_all():
        pass
    kernel = short_kernel(twice)
    assert kernel(2.0) == 4.0
    assert loads(kernel) == 0


def test_all_are_compiled_by_one_process_and_once():
    with compiling_all() as wanted, compiling_all() as also:
        assert wanted and not also
    with compiling_all() as wanted:
        assert wanted  # who did so was ended
        complete()
    with compiling_all() as wanted:
        assert not wanted


def test_nobody_compiles_for_others_where_nothing_can_be_kept(folder):
    folder.touch()
    with compiling_all() as wanted:
        assert not wanted
        assert short_kernel(twice)(2.0) == 4.0
    complete()
