"""Shared parts of the subcommands: options of the command line, files to write, and tables."""

from __future__ import annotations

import argparse
import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry, known_tasks
from dt_viz.transforms.avoidance import SPACES, Avoidance


class InputError(ValueError):
    """A request on the command line that cannot be met."""

    def __init__(self, field: str, found: str, accepted: str) -> None:
        super().__init__(f"{field}: found {found}; accepted: {accepted}")


def add_task(parser: argparse.ArgumentParser) -> None:
    """Add `--task` and `--lasa`."""
    parser.add_argument("--task", required=True, help=f"{', '.join(TASKS)}, or a file of --lasa without its suffix")
    add_lasa(parser)


def add_lasa(parser: argparse.ArgumentParser) -> None:
    """Add `--lasa`."""
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")


def add_space(parser: argparse.ArgumentParser, default: str = "task") -> None:
    """Add `--space`."""
    what = "what avoids: the end effector (task) or the whole arm (cspace) (default: %(default)s)"
    parser.add_argument("--space", choices=SPACES, default=default, help=what)


def add_avoidance(parser: argparse.ArgumentParser, space: str) -> None:
    """Add `--space`, `--generator` and `--no-avoidance`."""
    add_space(parser, space)
    paper = "probability is the paper's (default: %(default)s)"
    parser.add_argument("--generator", choices=GENERATORS, default=GENERATORS[0], help=paper)
    parser.add_argument("--no-avoidance", action="store_true", help="leave the obstacle's transforms out")


def scenario_around(obstacles: Sequence[Obstacle], task: Task, options: argparse.Namespace) -> Scenario:
    """Return the scenario of obstacles with the options of `add_avoidance`."""
    avoidance = Avoidance(obstacles, space=options.space, generator=options.generator)
    return avoiding(task, avoidance, on=not options.no_avoidance)


def avoiding(task: Task, avoidance: Avoidance, *, on: bool = True) -> Scenario:
    """Return the scenario of a task with an avoidance, switched on or off, on its imitation."""
    return Scenario(task.name, (Layer(avoidance, on, avoidance.title),))


def chosen_task(options: argparse.Namespace) -> tuple[Mapping[str, TaskEntry], Task]:
    """Return all tasks by name, and the chosen one, loaded.

    Raises:
        InputError: there is none of this name.
        DemonstrationError: the folder or the task's file cannot be used.
    """
    tasks = known_tasks(options.lasa)
    if options.task not in tasks:
        hint = "" if options.lasa is not None else "; --lasa DIR adds more"
        raise InputError("--task", repr(options.task), ", ".join(tasks) + hint)
    return tasks, tasks[options.task]()


def whole_number(minimum: int) -> Callable[[str], int]:
    """Return a type for argparse: a whole number of at least `minimum`, which is not negative."""

    def convert(text: str) -> int:
        number = int(text) if text.isdecimal() else -1
        if number < minimum:
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: a whole number, {minimum} or more")
        return number

    return convert


def positive_number(unit: str, maximum: float) -> Callable[[str], float]:
    """Return a type for argparse: a number above 0 and up to `maximum`."""

    def convert(text: str) -> float:
        number = _number(text)
        if not 0 < number <= maximum:
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {unit}, more than 0, at most {maximum:g}")
        return number

    return convert


def number(unit: str, minimum: float, maximum: float) -> Callable[[str], float]:
    """Return a type for argparse: a number between two others."""

    def convert(text: str) -> float:
        found = _number(text)
        if not minimum <= found <= maximum:
            accepted = f"{unit}, at least {minimum:g} and at most {maximum:g}"
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {accepted}")
        return found

    return convert


def interval(minimum: float, maximum: float) -> Callable[[str], tuple[float, float]]:
    """Return a type for argparse: LOW,HIGH within bounds, or one number for both."""

    def convert(text: str) -> tuple[float, float]:
        parts = [_number(part) for part in text.split(",")]
        low, high = parts[0], parts[-1]
        if len(parts) > 2 or not minimum <= low <= high <= maximum:
            accepted = f"a number or LOW,HIGH, at least {minimum:g} and at most {maximum:g}"
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {accepted}")
        return low, high

    return convert


def point(text: str) -> tuple[float, float, float]:
    """Convert X,Y,Z, metres; a type for argparse."""
    numbers = [_number(part) for part in text.split(",")]
    if len(numbers) != 3 or not all(math.isfinite(number) for number in numbers):
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: three numbers X,Y,Z in metres, such as 0,-0.5,0.4")
    x, y, z = numbers
    return x, y, z


def with_negative_values(arguments: Sequence[str]) -> list[str]:
    """Join an option to a value such as -0.1,-0.5,0.4, which argparse would take for an option."""
    joined: list[str] = []
    for argument in arguments:
        negative = argument[:1] == "-" and argument[1:2] in set("0123456789.")
        if negative and joined and joined[-1].startswith("--") and "=" not in joined[-1]:
            joined[-1] += f"={argument}"
        else:
            joined.append(argument)
    return joined


def ready_to_write(path: Path, suffix: str) -> Path:
    """Check, before minutes of measuring, that `--out` can be written; make its folder.

    Raises:
        InputError: it has another suffix, is a folder, or cannot be written.
    """
    if path.suffix.lower() != suffix:
        raise InputError("--out", repr(str(path)), f"a file that ends in {suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
    except OSError as error:
        found = f"{str(path)!r}, which cannot be written ({error.strerror or error})"
        raise InputError("--out", found, "a file in a folder that can be written to") from error
    return path


def ready_folder(path: Path) -> Path:
    """Make the folder `--out`. Raises InputError if that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = f"{str(path)!r}, which cannot be made ({error.strerror or error})"
        raise InputError("--out", found, "a folder, existing or new") from error
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


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under a header, the first column aligned left, the others right."""
    widths = [max(len(row[k]) for row in (header, *rows)) for k in range(len(header))]
    for row in (header, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
