"""Compiling of kernels: once for each version and processor, into the user's cache folder.

Compiling takes seconds a kernel, loading milliseconds. Files of the cache carry a checksum, are written whole or not at
all, and are made anew where they are damaged. Without a folder that can be written, each process compiles for itself.
The environment variable NUMBA_CACHE_DIR names another folder.

A process that compiles keeps hundreds of megabytes until it ends. A server therefore has other processes compile all
kernels, and only loads them: see `compiling_all`.
"""

from __future__ import annotations

import hashlib
import logging
import os
import pickle
import platform
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import llvmlite.binding
import numba
from numba.core.compiler import CompileResult
from numba.core.registry import CPUDispatcher, cpu_target
from numba.core.serialize import dumps

from dt_viz.folders import default_cache_folder

try:
    import fcntl
except ImportError:  # nobody waits for others there
    fcntl = None

logger = logging.getLogger(__name__)

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile a function that kernels call; errors of arithmetic give nan or inf as in numpy."""
    return _dispatcher(function, no_cfunc_wrapper=True)


def inlined(function: F) -> F:
    """Put a function's source into its one caller: what is compiled by itself is compiled again within each caller."""
    return _dispatcher(function, inline="always")


def kernel(function: F) -> F:
    """Compile a function that Python calls, and keep its code for the next process; meanwhile other threads go on."""
    return _kept(_dispatcher(function, nogil=True))


def short_kernel(function: F) -> F:
    """The same for what takes microseconds: letting other threads go on would take longer."""
    return _kept(_dispatcher(function))


def _dispatcher(function: Callable[..., Any], **options: Any) -> Any:  # noqa: ANN401 - numba's
    decorator: Any = numba.njit(error_model="numpy", **options)
    return decorator(function)


def _kept(dispatcher: Any) -> Any:  # noqa: ANN401
    dispatcher._cache = _Cache(dispatcher)
    return dispatcher


class _Cache:
    """Machine code of one kernel, with the interface of numba's caches."""

    def __init__(self, dispatcher: CPUDispatcher) -> None:
        self._name = f"{dispatcher.py_func.__module__.rpartition('.')[2]}.{dispatcher.py_func.__name__}"

    def load_overload(self, signature: object, target_context: Any) -> CompileResult | None:  # noqa: ANN401 - numba's
        """Return the code for these types of arguments; None where there is none, or it is damaged."""
        target_context.refresh()
        path = self._path(signature, target_context.codegen())
        loaded = self._load(path, target_context)
        return self._load(path, target_context) if loaded is None and _waited() else loaded

    def _load(self, path: Path, target_context: Any) -> CompileResult | None:  # noqa: ANN401 - numba's
        try:
            checksum, data = (content := path.read_bytes())[:32], content[32:]
        except OSError:
            return None
        if hashlib.sha256(data).digest() != checksum:
            logger.warning("the compiled code in %s is damaged: it is made again", path)
            return None
        result = CompileResult._rebuild(target_context, *pickle.loads(data))
        result.library._shared_module = None  # numba refuses to link it, rather than link what does nothing
        return result

    def save_overload(self, signature: object, result: CompileResult) -> None:
        """Keep the code for these types of arguments, if the folder can be written."""
        (name, kind, (machine_code, bitcode)), *rest = result._reduce()
        path = self._path(signature, result.codegen)
        data = dumps([(name, kind, (machine_code, _hollow(bitcode))), *rest])
        unfinished = path.with_name(f"{path.name}.{os.getpid()}.unfinished")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            unfinished.write_bytes(hashlib.sha256(data).digest() + data)
            unfinished.replace(path)
        except OSError as error:
            with suppress(OSError):
                unfinished.unlink()
            _say_once(str(error))

    def _path(self, signature: object, codegen: Any) -> Path:  # noqa: ANN401 - numba's
        return _file(self._name, (signature, codegen.magic_tuple(), _version()))


def _hollow(bitcode: bytes) -> bytes:
    """Return bitcode of functions with the same names that do nothing.

    Numba needs names to find the machine code, and bodies only to link a kernel into other compiled code, which calls
    none. Bodies take 2 MB of each process that loads a kernel.
    """
    functions = (each for each in llvmlite.binding.parse_bitcode(bitcode).functions if not each.is_declaration)
    hollow = "\n".join(f'define void @"{each.name}"() {{ ret void }}' for each in functions)
    return llvmlite.binding.parse_assembly(hollow).as_bitcode()


def _file(name: str, key: object) -> Path:
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    folder = Path(chosen) if chosen else default_cache_folder() / "kernels"
    return folder / f"{name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:24]}"


@contextmanager
def compiling_all() -> Iterator[bool]:
    """Have all processes that need a kernel wait for the end of this block, in which others compile all kernels.

    Yields whether they are to be compiled: not where they are `complete`, another server has that done, or nothing can
    be kept. Those that compile call `wait_for_nobody`.
    """
    path = _file("compiling", _version())
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        lock = path.open("wb")
    except OSError:  # nothing can be kept
        yield False
        return
    with lock:
        yield not is_complete() and _locked(lock.fileno())


def complete() -> None:
    """Note that all kernels are compiled, so that no process begins anew to compile all."""
    with suppress(OSError):
        _complete().touch()


def is_complete() -> bool:
    """Return whether all kernels of this version are compiled for this processor, and kept."""
    return _complete().exists()


def wait_for_nobody() -> None:
    """Have this process compile the kernels that it needs: others wait for it."""
    global _waits  # noqa: PLW0603 - a property of the process
    _waits = False


_waits = True


def _waited() -> bool:
    """Wait while another process compiles all; return whether one did."""
    if not _waits or fcntl is None:
        return False
    try:
        with _file("compiling", _version()).open("rb") as lock:
            if _locked(lock.fileno(), exclusive=False):
                return False
            fcntl.flock(lock.fileno(), fcntl.LOCK_SH)
            return True
    except OSError:
        return False


def _locked(lock: int, *, exclusive: bool = True) -> bool:
    """Lock a file by its descriptor, for as long as it is open; return whether that was possible at once."""
    if fcntl is None:
        return False
    try:
        fcntl.flock(lock, (fcntl.LOCK_EX if exclusive else fcntl.LOCK_SH) | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _complete() -> Path:
    """File that is there where all is compiled."""
    context: Any = cpu_target.target_context
    return _file("complete", (context.codegen().magic_tuple(), _version()))


@lru_cache(maxsize=1)
def _version() -> tuple[str, ...]:
    """Digest of the kernels' source, which call each other, and versions of what compiles them."""
    source = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        source.update(path.read_bytes())
    return source.hexdigest(), numba.__version__, platform.python_version()


@lru_cache(maxsize=1)
def _say_once(error: str) -> None:
    logger.warning("compiled code cannot be kept, so that each start compiles it again for a minute: %s", error)
