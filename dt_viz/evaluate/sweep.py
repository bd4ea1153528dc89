"""Items of a measurement computed beside each other, through joblib: in processes, or on a Dask cluster.

An item says all that its result depends on, also what is drawn at random, and results come in the order of the items:
by the same versions on the same kind of processor they are the same to the last bit, except times, however many are
computed at once. What the items share, such as an engine, each worker makes for its first item and then keeps.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import BrokenExecutor
from contextlib import contextmanager
from functools import partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, TypeVar
from uuid import uuid4

from dt_viz.errors import FormatError
from dt_viz.evaluate import THREADS
from dt_viz.evaluate.options import whole_number

if TYPE_CHECKING:
    from distributed import Client
    from joblib import Parallel

NEEDS = {"--jobs": ("joblib",), "--dask": ("joblib", "distributed")}
"""Modules that each option needs beyond DT-Viz's own."""
INSTALL = 'pip install "dt-viz[sweeps]"'
"""Command that installs them."""
SETTINGS: Mapping[str, Any] = {"return_as": "generator", "pre_dispatch": "all", "batch_size": 1}
"""Settings of `joblib.Parallel` for items of seconds."""
PATIENCE = 5.0
"""Time that a cluster is given to answer, and then to have a worker, seconds."""
CLUSTER = "the address of a Dask scheduler, such as tcp://127.0.0.1:8786, whose workers have memory and these versions"
"""What `--dask` accepts."""

Shared = TypeVar("Shared")
Swept = Callable[[Callable[[Any, Any], Any], Iterable[Any]], Iterator[Any]]
"""Computes a function of what is shared, and of each item; yields the results in order."""


class _Kept(threading.local):
    """What a worker's thread keeps from one item to the next."""

    key: str | None = None
    """Sweep that it is of."""
    shared: Any = None


_kept = _Kept()


def add_workers(parser: argparse.ArgumentParser) -> None:
    """Define `--jobs` and `--dask`."""
    where = parser.add_mutually_exclusive_group()
    most = 4 * (os.cpu_count() or 1)
    where.add_argument(
        "--jobs", type=whole_number(1, most), default=1, metavar="N", help="processes (default: %(default)s)"
    )
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster that computes instead")


@contextmanager
def sweep(options: argparse.Namespace, make: Callable[[], Shared]) -> Iterator[tuple[Shared, Swept]]:
    """Give what `make` makes, for this process, and a function that computes items as the options say.

    Functions, items, results, and `make`, which is called once in each worker's thread, have to be picklable.

    Raises:
        FormatError: an extra is not installed, the cluster does not answer, or workers are lost again and again.
    """
    jobs, address = options.jobs, options.dask
    if address is None and jobs == 1:
        shared = make()
        yield shared, lambda function, items: map(partial(function, shared), items)
        return
    option, workers = ("--jobs", _processes(jobs)) if address is None else ("--dask", _cluster(address))
    if missing := [module for module in NEEDS[option] if find_spec(module) is None]:
        raise FormatError(option, f"{' and '.join(missing)} not installed", f"--jobs 1, or more after {INSTALL}")
    with workers as parallel:
        yield make(), partial(_swept, parallel, (uuid4().hex, make, _threads()))


def _swept(
    parallel: Callable[[], Parallel], sweep: tuple[Any, ...], function: Callable[[Any, Any], Any], items: Iterable[Any]
) -> Iterator[Any]:
    """Compute items by joblib, each within a tuple: arrays joblib would leave to one Dask worker, and lose with it.

    Each call has a `Parallel` of its own: in one that is used again, an item of a call that failed may end the next.
    """
    from joblib import delayed  # noqa: PLC0415 - an extra

    try:
        yield from parallel()([delayed(_computed)((*sweep, function, item)) for item in items])
    except BrokenExecutor as error:
        raise FormatError("--jobs", "a process that was ended, as for want of memory", "fewer") from error


def _computed(work: tuple[str, Callable[[], Any], list[str | None], Callable[[Any, Any], Any], Any]) -> Any:  # noqa: ANN401
    """Compute an item in a worker.

    Raises:
        FormatError: it does linear algebra in another number of threads, which would round otherwise.
    """
    key, make, threads, function, item = work
    if _threads() != threads:
        found = f"a worker with {_threads()} as {', '.join(THREADS)}"
        raise FormatError("--dask", found, f"workers with {threads}, as of `dask worker` with a nanny")
    if _kept.key != key:
        _kept.shared = make()
        _kept.key = key
    return function(_kept.shared, item)


def _threads() -> list[str | None]:
    return [os.environ.get(variable) for variable in THREADS]


@contextmanager
def _processes(jobs: int) -> Iterator[Callable[[], Parallel]]:
    """Workers of this machine, which end with the sweep."""
    from joblib import Parallel  # noqa: PLC0415 - an extra
    from joblib.externals.loky import get_reusable_executor  # noqa: PLC0415

    try:
        yield partial(Parallel, jobs, "loky", max_nbytes=None, **SETTINGS)
    finally:
        get_reusable_executor(reuse=True).shutdown(wait=True, kill_workers=True)  # pyright: ignore[reportArgumentType]


@contextmanager
def _cluster(address: str) -> Iterator[Callable[[], Parallel]]:
    """Workers of a Dask cluster."""
    from distributed import Client  # noqa: PLC0415 - an extra
    from joblib import Parallel  # noqa: PLC0415

    if error := _unanswered(address):
        raise FormatError("--dask", f"{address!r}, where no scheduler answers ({_line(error)})", CLUSTER)
    with Client(address, timeout=PATIENCE, set_as_default=False) as client:
        try:
            client.wait_for_workers(1, PATIENCE)
        except (OSError, asyncio.TimeoutError) as error:
            raise FormatError("--dask", f"{address!r}, which has no workers", CLUSTER) from error
        yield lambda: Parallel(backend=_backend(client), **SETTINGS)


def _unanswered(address: str) -> Exception | None:
    """Connect to a scheduler and leave; return what went wrong.

    A client that cannot connect would hold up the end of this process, and a server of another kind `connect` itself.
    """
    from distributed.comm.core import connect  # noqa: PLC0415 - an extra

    found: list[Exception | None] = []

    async def greet() -> None:
        await (await connect(address, timeout=PATIENCE)).close()

    def try_it() -> None:
        try:
            asyncio.run(greet())
            found.append(None)
        except Exception as error:  # of any kind where another program answers
            found.append(error)

    thread = threading.Thread(target=try_it, daemon=True)
    thread.start()
    thread.join(PATIENCE + 1)
    return found[0] if found else TimeoutError("another program")


def _backend(client: Client) -> Any:  # noqa: ANN401 - joblib's
    from joblib._dask import DaskDistributedBackend  # noqa: PLC0415 - an extra

    class Backend(DaskDistributedBackend):
        """Joblib's own, which else waits for ever for what a cluster gives up, as when an item kills each worker."""

        def submit(self, func: Any, callback: Any = None) -> Any:  # noqa: ANN401
            future = super().submit(func, callback)
            future.add_done_callback(lambda done: done.exception() is None or callback(done.exception()))
            return future

        def retrieve_result_callback(self, out: Any) -> Any:  # noqa: ANN401
            if isinstance(out, BaseException):
                raise FormatError("--dask", f"a cluster that gave up ({_line(out)})", CLUSTER)
            return super().retrieve_result_callback(out)

        def effective_n_jobs(self, n_jobs: int) -> int:
            """At least two: a single one joblib would compute in this process."""
            return max(2, super().effective_n_jobs(n_jobs))

    return Backend(client=client)


def _line(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
