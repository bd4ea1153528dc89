"""Compilation of kernels by numba, and numba's cache of their machine code.

Compilation takes seconds a kernel, loading milliseconds. numba notices a change of the file that holds a kernel, not of
functions in other files that the kernel calls; so the cache has a folder for each version of all these files. It lies
in the user's cache folder, or in that of the environment variable NUMBA_CACHE_DIR. Where it cannot be written, each
process compiles for itself.
"""

from __future__ import annotations

import hashlib
import logging
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numba
from numba.core.caching import Cache, CompileResultCacheImpl, UserProvidedCacheLocator
from numba.core.registry import cpu_target

from dt_viz.folders import default_cache_folder

logger = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])

unrolled = numba.literal_unroll  # a loop over a tuple of different constants, compiled for each

READY = threading.Event()
"""Cleared while another process compiles all kernels for this one; a kernel that is called then waits."""
READY.set()


def compiled(function: F) -> F:
    """Compile a function that kernels call; errors of arithmetic give nan or inf as in numpy."""
    return _dispatcher(function, no_cfunc_wrapper=True)


def inlined(function: F) -> F:
    """Put a function's source into its one caller: a function of its own is compiled again within each caller."""
    return _dispatcher(function, inline="always")


def kernel(function: F) -> F:
    """Compile and cache a function that Python calls and that lets other threads run meanwhile."""
    return _cached(_dispatcher(function, nogil=True))


def short_kernel(function: F) -> F:
    """Compile and cache a function of microseconds, in which a switch of threads would take longer."""
    return _cached(_dispatcher(function))


def is_complete() -> bool:
    """Return whether all kernels are cached for this processor."""
    return _complete().exists()


def is_wanted() -> bool:
    """Return whether kernels are still to be compiled, and can be cached."""
    with suppress(OSError):
        _folder().mkdir(parents=True, exist_ok=True)
    return not is_complete() and _folder().is_dir() and os.access(_folder(), os.W_OK)


@contextmanager
def compiling_elsewhere() -> Iterator[None]:
    """Have kernels that are called wait for `READY`, at most until the end of this block, where any are wanted."""
    if is_wanted():
        READY.clear()
    try:
        yield
    finally:
        READY.set()


def complete() -> None:
    """Note that all kernels are cached for this processor."""
    with suppress(OSError):
        _complete().touch()


def _dispatcher(function: Callable[..., Any], **options: Any) -> Any:  # noqa: ANN401 - numba's
    decorator: Any = numba.njit(error_model="numpy", **options)
    return decorator(function)


def _cached(dispatcher: Any) -> Any:  # noqa: ANN401
    dispatcher._cache = _Cache(dispatcher.py_func)
    return dispatcher


class _Locator(UserProvidedCacheLocator):
    """Location of the cache; numba's own locators pass over a folder that can only be read, as in a container."""

    def __init__(self, py_func: Callable[..., Any], py_file: str) -> None:
        self._py_file, self._lineno, self._cache_path = py_file, py_func.__code__.co_firstlineno, str(_folder())

    @classmethod
    def from_function(cls, py_func: Callable[..., Any], py_file: str) -> _Locator:
        return cls(py_func, py_file)


class _Implementation(CompileResultCacheImpl):
    _locator_classes = (_Locator,)

    def check_cachable(self, cres: object) -> bool:
        """Allow addresses in machine code: those of functions that are passed to others, which never read them."""
        return True


class _Cache(Cache):
    """numba's cache of one kernel, without which a kernel is compiled: files may be damaged, disks full."""

    _impl_class = _Implementation

    def load_overload(self, sig: object, target_context: object) -> object | None:
        READY.wait()
        try:
            return super().load_overload(sig, target_context)
        except OSError:  # there is no folder
            return None
        except Exception as error:  # whatever pickle raises for bytes of any kind
            logger.warning("the cache of compiled code is damaged, so that %s is compiled again: %r", self, error)
            with suppress(OSError):
                self.flush()
            return None

    def save_overload(self, sig: object, data: object) -> None:
        try:
            super().save_overload(sig, data)
        except OSError as error:
            _warn_once(str(error))


@lru_cache(maxsize=1)
def _folder() -> Path:
    sources = hashlib.sha256(numba.__version__.encode())
    for path in sorted(Path(__file__).parent.glob("*.py")):
        sources.update(path.read_bytes())
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    return Path(chosen or default_cache_folder() / "kernels") / sources.hexdigest()[:16]


def _complete() -> Path:
    codegen: Any = cpu_target.target_context.codegen()  # pyright: ignore[reportAttributeAccessIssue]
    processor = hashlib.sha256(repr((codegen.magic_tuple(), sys.version_info[:2])).encode())
    return _folder() / f"complete-{processor.hexdigest()[:16]}"


@lru_cache(maxsize=1)
def _warn_once(error: str) -> None:
    logger.warning("compiled code cannot be cached, so that each start compiles it again for a minute: %s", error)
