"""Options, tables and files that the commands share."""

from __future__ import annotations

import argparse
import json
import math
import os
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, Generic, TypeVar
from uuid import uuid4

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.robot.models import load_arm
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry, known_tasks
from dt_viz.session.engine import Engine
from dt_viz.session.tasks_in_reach import in_reach

Row = Mapping[str, str | float | None]  # text or number of each column by its header, which names the unit
PRINTED: list[Sequence[Row]] = []  # tables that the running command has printed


def add_task(parser: argparse.ArgumentParser) -> None:
    """Define `--task` and `--lasa`."""
    parser.add_argument("--task", required=True, help=f"{', '.join(TASKS)}, or a file of --lasa without its suffix")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")


def chosen_task(options: argparse.Namespace) -> Task:
    """Load the chosen task. Raises FormatError if there is none of this name, DemonstrationError if it is unusable."""
    tasks = known_tasks(options.lasa)
    if options.task not in tasks:
        hint = "" if options.lasa is not None else "; --lasa DIR adds more"
        raise FormatError("--task", repr(options.task), ", ".join(tasks) + hint)
    return tasks[options.task]()


def new_engine(tasks: Mapping[str, TaskEntry], arm: str = "jaco") -> Engine:
    """Return an engine that has computed nothing yet, with what was learned before on this machine, tasks in reach."""
    robot = load_arm(arm)
    return Engine(in_reach(tasks, robot), FitStore(default_cache_folder()), robot)


def engine_of(task: Task) -> Engine:
    """Return a new engine with one task."""
    return new_engine({task.name: TaskEntry(task.title, lambda: task)})


def numbers(accepted: str, low: float, high: float, *counts: int, kind: type[float] = float) -> Callable[[str], Any]:
    """Return a type for argparse: a number within bounds, or a tuple of as many as one of `counts`, between commas."""

    def convert(text: str) -> float | tuple[float, ...]:
        found: list[float] = []
        with suppress(ValueError):
            found = [*map(kind, text.split(","))]
        if len(found) not in (counts or (1,)) or not all(low <= number <= high for number in found):
            raise argparse.ArgumentTypeError(f"found {text.strip()!r}; accepted: {accepted}")
        return tuple(found) if counts else found[0]

    return convert


def whole_number(minimum: int) -> Callable[[str], int]:
    """Return a type for argparse: a whole number of at least `minimum`."""
    return numbers(f"a whole number, {minimum} or more", minimum, math.inf, kind=int)


def positive_number(unit: str, maximum: float) -> Callable[[str], float]:
    """Return a type for argparse: a number above 0 and up to `maximum`."""
    return numbers(f"{unit}, more than 0 and at most {maximum:g}", math.ulp(0), maximum)


def interval(minimum: float, maximum: float) -> Callable[[str], tuple[float, float]]:
    """Return a type for argparse: LOW,HIGH within bounds, or one number for both."""
    convert = numbers(f"a number or LOW,HIGH, at least {minimum:g} and at most {maximum:g}", minimum, maximum, 1, 2)
    return lambda text: (min(found := convert(text)), max(found))


def output(suffix: str = "") -> Callable[[str], Path]:
    """Return a type for argparse: the path of a file with a suffix, or of a folder, that can be written."""

    def convert(text: str) -> Path:
        path = Path(text)
        there = next(each for each in (path, *path.absolute().parents) if each.exists())
        is_whole = suffix in ("", path.suffix) and there.is_dir() == (not suffix or there != path)
        if not is_whole or not os.access(there, os.W_OK):
            kind = f"a file that ends in {suffix} and can be written" if suffix else "a folder that can be written to"
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {kind}")
        return path

    return convert


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write figures as standard JSON, without NaN."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_npz(path: Path, arrays: Mapping[str, Any]) -> None:
    """Write numbers and arrays."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(path, **arrays)


def report(rows: Sequence[Row]) -> None:
    """Print rows, if there are any, as a table whose header is the columns of the first, aligned left, then right."""
    if not rows:
        return
    PRINTED.append([{column: row.get(column) for column in rows[0]} for row in rows])
    texts = [[*rows[0]], *([as_text(cell) for cell in row.values()] for row in PRINTED[-1])]
    first, *widths = (max(map(len, column)) for column in zip(*texts, strict=True))
    for name, *cells in texts:
        print("  ".join([name.ljust(first), *map(str.rjust, cells, widths)]).rstrip())


def write_tables(path: Path) -> None:
    """Write all tables that were printed to a JSON file: lists of rows; null for what is no number."""
    finite = lambda cell: None if isinstance(cell, float) and not math.isfinite(cell) else cell  # noqa: E731
    write_json(path, {"tables": [[{name: finite(row[name]) for name in row} for row in rows] for rows in PRINTED]})


def as_text(value: str | float | None) -> str:
    """Return the text of a cell: three digits of a number; a dash where there is none."""
    if value is None or value != value:  # noqa: PLR0124 - NaN
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


INSTALL = 'pip install "dt-viz[sweeps]"'
PATIENCE = 5.0  # s within which a Dask scheduler has to answer
T = TypeVar("T")
_made = threading.local()


class Made(Generic[T]):
    """A value, such as an engine, that each worker thread makes once, as it is not sent."""

    def __init__(self, make: Callable[[], T]) -> None:
        self.make, self.key = make, uuid4().hex

    def __call__(self) -> T:
        """Return the value of this thread."""
        if getattr(_made, "key", None) != self.key:
            _made.value, _made.key = self.make(), self.key
        return _made.value


def add_output(parser: argparse.ArgumentParser, suffix: str = "") -> None:
    """Define `--out`, a file with this suffix or else a folder, and `--jobs` and `--dask`."""
    metavar, kind = (f"FILE{suffix}", "file") if suffix else ("DIR", "folder")
    parser.add_argument("--out", type=output(suffix), required=True, metavar=metavar, help=f"{kind} that is written")
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--jobs", type=whole_number(1), default=1, metavar="N", help="processes (default: %(default)s)")
    where.add_argument("--dask", metavar="ADDRESS", help="scheduler of a Dask cluster that computes instead")


def computed(options: argparse.Namespace, function: Callable[[Any], Any], items: Iterable[Any]) -> Iterator[Any]:
    """Yield the results of a function, in the order of its items.

    Raises FormatError if joblib or distributed is not installed, or no scheduler answers.
    """
    if options.dask is None and options.jobs == 1:
        yield from map(function, items)
        return
    with ExitStack() as stack:
        try:
            from joblib import Parallel, delayed, parallel_config  # noqa: PLC0415 - an extra

            if options.dask is not None:
                from distributed import Client  # noqa: PLC0415 - an extra

                stack.enter_context(Client(options.dask, timeout=PATIENCE))
                stack.enter_context(parallel_config("dask"))
        except ImportError as error:
            option = "--jobs" if options.dask is None else "--dask"
            raise FormatError(option, f"{error.name} not installed", f"--jobs 1, or more after {INSTALL}") from error
        except (OSError, ValueError) as error:
            found, accepted = f"{options.dask!r}, where no scheduler answers", "such as tcp://127.0.0.1:8786"
            raise FormatError("--dask", found, f"the address of a Dask scheduler, {accepted}") from error
        jobs = options.jobs if options.dask is None else None
        yield from Parallel(jobs, return_as="generator")(delayed(function)(item) for item in items)
