"""Options, tables and files that the commands share."""

from __future__ import annotations

import argparse
import json
import math
import re
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.robot.models import load_arm
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry, known_tasks
from dt_viz.session.engine import Engine
from dt_viz.session.tasks_in_reach import in_reach

Row = Mapping[str, str | float | None]
"""Row of a table: text or number of each column by its header, which names the unit."""
FOLDER = "DIR"
"""What a command's `OUT` is where it writes several files."""
TABLES = "TABLES"
"""What a command's `OUT` is where it writes nothing but what it prints."""
PRINTED: list[Sequence[Row]] = []
"""Tables that the running command has printed."""


def add_task(parser: argparse.ArgumentParser) -> None:
    """Add `--task` and `--lasa`."""
    parser.add_argument("--task", required=True, help=f"{', '.join(TASKS)}, or a file of --lasa without its suffix")
    add_lasa(parser)


def add_lasa(parser: argparse.ArgumentParser) -> None:
    """Add `--lasa`."""
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")


def chosen_task(options: argparse.Namespace) -> tuple[Mapping[str, TaskEntry], Task]:
    """Return all tasks by name, and the chosen one, loaded.

    Raises:
        FormatError: there is none of this name.
        DemonstrationError: the folder or the task's file cannot be used.
    """
    tasks = known_tasks(options.lasa)
    if options.task not in tasks:
        hint = "" if options.lasa is not None else "; --lasa DIR adds more"
        raise FormatError("--task", repr(options.task), ", ".join(tasks) + hint)
    return tasks, tasks[options.task]()


def new_engine(tasks: Mapping[str, TaskEntry], arm: str = "jaco") -> Engine:
    """Return an engine that has computed nothing yet, with what was learned before on this machine, tasks in reach.

    Raises:
        ArmError: there is no such arm.
    """
    robot = load_arm(arm)
    return Engine(in_reach(tasks, robot), FitStore(default_cache_folder()), robot)


def engine_of(task: Task) -> Engine:
    """Return a new engine with one task."""
    return new_engine({task.name: TaskEntry(task.title, lambda: task)})


def whole_number(minimum: int, maximum: int | None = None) -> Callable[[str], int]:
    """Return a type for argparse: a whole number of at least `minimum`, which is not negative, and up to `maximum`."""
    to = "or more" if maximum is None else f"to {maximum}"

    def convert(text: str) -> int:
        number = int(text) if text.isdecimal() else -1
        if number < minimum or (maximum is not None and number > maximum):
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: a whole number, {minimum} {to}")
        return number

    return convert


def positive_number(unit: str, maximum: float) -> Callable[[str], float]:
    """Return a type for argparse: a number above 0 and up to `maximum`."""
    return number(unit, math.ulp(0), maximum)


def number(unit: str, minimum: float, maximum: float) -> Callable[[str], float]:
    """Return a type for argparse: a number between two others."""
    least = "more than 0" if minimum == math.ulp(0) else f"at least {minimum:g}"
    return lambda text: _numbers(text, (1,), f"{unit}, {least} and at most {maximum:g}", minimum, maximum)[0]


def interval(minimum: float, maximum: float) -> Callable[[str], tuple[float, float]]:
    """Return a type for argparse: LOW,HIGH within bounds, or one number for both."""
    accepted = f"a number or LOW,HIGH, at least {minimum:g} and at most {maximum:g}"

    def convert(text: str) -> tuple[float, float]:
        low, *_, high = 2 * _numbers(text, (1, 2), accepted, minimum, maximum)
        if low > high:
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {accepted}")
        return low, high

    return convert


def point(text: str) -> tuple[float, float, float]:
    """Convert X,Y,Z, metres; a type for argparse."""
    x, y, z = _numbers(text, (3,), "three numbers X,Y,Z in metres, such as 0,-0.5,0.4", -1e9, 1e9)
    return x, y, z


def with_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join an option to a value such as -0.1,-0.5,0.4, which argparse would take for an option."""
    joined: list[str] = []
    for argument in arguments:
        if re.match(r"-[\d.]", argument) and joined and re.fullmatch(r"--[^=]+", joined[-1]):
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def ready_to_write(path: Path, form: str) -> Path:
    """Check, before minutes of measuring, that a file can be written, and make its folder.

    Args:
        path: the file, or folder.
        form: `FOLDER`, or "FILE" with the suffix that it has to have.

    Raises:
        FormatError: it has another suffix, is a folder where a file is wanted, or cannot be written.
    """
    suffix = "" if form == FOLDER else Path(form).suffix
    if path.suffix.lower() != suffix and form != FOLDER:
        raise FormatError("--out", repr(str(path)), f"a file that ends in {suffix}")
    try:
        (path.parent if suffix else path).mkdir(parents=True, exist_ok=True)
        if suffix and not path.exists():
            path.touch()
            path.unlink()
        elif suffix:
            path.open("ab").close()
    except OSError as error:
        found = f"{str(path)!r}, which cannot be written ({error.strerror or error})"
        raise FormatError("--out", found, "a file or folder that can be written") from error
    return path


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write figures as standard JSON, without NaN."""
    path.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def write_npz(path: Path, **arrays: Any) -> None:  # noqa: ANN401 - numbers and arrays
    """Write arrays to an npz file of exactly this name."""
    with path.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)


def unit_ms() -> float:
    """Measure a fixed piece of numpy work: 3,000 calls of exp and einsum on small arrays, the best of ten, ms."""
    rows, best = np.linspace(-1, 1, 24).reshape(8, 3), np.inf
    for _ in range(10):
        began = time.perf_counter()
        for _ in range(1500):
            np.einsum("ij,ij->i", rows, np.exp(rows))
        best = min(best, time.perf_counter() - began)
    return 1e3 * best


def report(rows: Sequence[Row], *, markdown: bool = False) -> None:
    """Print rows, if there are any, as a table whose header is the columns of the first, aligned left, then right."""
    if not rows:
        return
    PRINTED.append([{column: row.get(column) for column in rows[0]} for row in rows])
    texts = [[*rows[0]], *([as_text(cell) for cell in row.values()] for row in PRINTED[-1])]
    first, *widths = (max(map(len, column)) for column in zip(*texts, strict=True))
    aligned = [[name.ljust(first), *map(str.rjust, cells, widths)] for name, *cells in texts]
    if markdown:
        aligned.insert(1, ["-" * first, *("-" * (width - 1) + ":" for width in widths)])
    for cells in aligned:
        print(f"| {' | '.join(cells)} |" if markdown else "  ".join(cells).rstrip())


def write_tables(path: Path) -> None:
    """Write all tables that were printed to a JSON file: lists of rows; null for what is no number."""
    finite = [[{name: _finite(cell) for name, cell in row.items()} for row in rows] for rows in PRINTED]
    write_json(path, {"tables": finite})


def _finite(cell: str | float | None) -> str | float | None:
    return None if isinstance(cell, float) and not math.isfinite(cell) else cell


def as_text(value: str | float | None) -> str:
    """Text of a cell: three digits of a number; a dash where there is none."""
    if value is None or value != value:  # noqa: PLR0124 - NaN
        return "–"
    if isinstance(value, float):
        return f"{value:.0f}" if 100 <= abs(value) < 1e6 else f"{value:.3g}"
    return str(value)


def _numbers(text: str, counts: tuple[int, ...], accepted: str, minimum: float, maximum: float) -> list[float]:
    """Convert so many numbers between bounds, separated by commas."""
    try:
        numbers = [float(part) for part in text.split(",")]
    except ValueError:
        numbers = []
    if len(numbers) not in counts or not all(minimum <= number <= maximum for number in numbers):
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {accepted}")
    return numbers
