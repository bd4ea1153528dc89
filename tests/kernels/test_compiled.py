"""Compiled code is kept: one process compiles all of it while others wait for what they need."""

import pickle
import subprocess
import sys
import threading
from collections.abc import Iterator
from importlib import import_module
from pkgutil import iter_modules
from typing import Any

import llvmlite.binding
import pytest
from numba.core.registry import CPUDispatcher

from dt_viz import kernels
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


def dispatchers() -> Iterator[Any]:
    """All that numba compiles of this project."""
    for module in iter_modules(kernels.__path__, "dt_viz.kernels."):
        yield from (each for each in vars(import_module(module.name)).values() if isinstance(each, CPUDispatcher))


def is_kernel(dispatcher: Any) -> bool:
    return isinstance(dispatcher._cache, compiled._Cache)


def test_no_kernel_is_called_by_what_is_compiled_as_its_bitcode_is_not_kept():
    found = [each for each in dispatchers() if is_kernel(each)]
    assert found
    for dispatcher in dispatchers():
        function = dispatcher.py_func
        called = [function.__globals__.get(name) for name in function.__code__.co_names]
        assert not [each for each in called if isinstance(each, CPUDispatcher) and is_kernel(each)], function


USE = """
from tests.kernels.test_compiled import loads, short_kernel, twice
kernel = short_kernel(twice)
print(kernel(2.0), kernel(3.0), loads(kernel))
"""


def test_what_is_kept_of_a_kernel_is_its_machine_code_and_another_process_loads_it(folder):
    for num_loads in (0, 1):
        done = subprocess.run([sys.executable, "-c", USE], capture_output=True, text=True, check=True)
        assert done.stdout.split() == ["4.0", "6.0", str(num_loads)]
    (file,) = folder.glob("test_compiled.twice-*")
    (_name, kind, (machine_code, bitcode)), *_ = pickle.loads(file.read_bytes()[32:])
    assert kind == "object" and len(machine_code) > 1000
    functions = list(llvmlite.binding.parse_bitcode(bitcode).functions)
    assert functions and all(len(list(block.instructions)) == 1 for each in functions for block in each.blocks)


def test_a_loaded_kernel_is_refused_where_compiled_code_calls_it(kept):
    kept()
    callee = short_kernel(twice)
    assert (callee(2.0), loads(callee)) == (4.0, 1)
    with pytest.raises(RuntimeError, match="unfit for linking"):
        compiled.compiled(lambda x: callee(x) + 1)(2.0)


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
