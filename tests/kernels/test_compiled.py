"""Compiled code is cached on disk, and one process compiles for others."""

import subprocess
import sys
from typing import Any

import pytest

from dt_viz.kernels import compiled
from dt_viz.kernels.compiled import compiling_elsewhere, complete, is_complete, is_wanted, short_kernel


def twice(x):
    return 2 * x


def loads(kernel: Any) -> int:
    """Number of times that code for it was loaded, not compiled."""
    return sum(kernel._cache_hits.values())


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Folder of the cache."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "kernels"))
    compiled._folder.cache_clear()
    yield compiled._folder()
    compiled._folder.cache_clear()


USE = """
from tests.kernels.test_compiled import loads, short_kernel, twice
kernel = short_kernel(twice)
print(kernel(2.0), kernel(3.0), loads(kernel))
"""


def used():
    """What another process prints that uses a kernel."""
    done = subprocess.run([sys.executable, "-c", USE], capture_output=True, text=True, check=True)
    return done.stdout.split(), done.stderr


def test_another_process_loads_what_one_has_compiled():
    assert [used()[0] for _ in range(2)] == [["4.0", "6.0", "0"], ["4.0", "6.0", "1"]]


@pytest.mark.parametrize("damage", [lambda data: data[: len(data) // 2], lambda data: b"", lambda data: data[::-1]])
@pytest.mark.parametrize("suffix", ["nbi", "nbc"])
def test_a_damaged_file_is_compiled_again(folder, damage, suffix):
    used()
    (file,) = folder.glob(f"test_compiled.twice-*.{suffix}")
    file.write_bytes(damage(file.read_bytes()))
    assert [used()[0] for _ in range(2)] == [["4.0", "6.0", "0"], ["4.0", "6.0", "1"]]


def test_where_nothing_can_be_cached_each_process_compiles_and_says_so_once(folder):
    folder.parent.mkdir(parents=True)
    folder.touch()
    assert not is_wanted()
    complete()
    assert not is_complete()
    answered, logged = used()
    assert answered == ["4.0", "6.0", "0"] and logged.count("cannot be cached") == 1


def test_a_cache_that_can_only_be_read_is_read(folder, monkeypatch):
    used()

    def refuse(*_what: Any, **_how: Any) -> None:
        raise PermissionError

    monkeypatch.setattr("numba.core.caching.os.makedirs", refuse)
    monkeypatch.setattr("numba.core.caching.tempfile.TemporaryFile", refuse)
    kernel = short_kernel(twice)
    assert (kernel(2.0), loads(kernel)) == (4.0, 1)


def test_all_are_compiled_once():
    assert is_wanted()
    complete()
    assert is_complete() and not is_wanted()


def test_a_server_that_ends_leaves_no_kernel_waiting():
    with pytest.raises(KeyboardInterrupt), compiling_elsewhere():
        raise KeyboardInterrupt
    assert short_kernel(twice)(2.0) == 4.0
