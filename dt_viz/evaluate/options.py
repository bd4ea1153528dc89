"""What the subcommands ask on the command line alike: tasks, numbers, and files to write."""

from __future__ import annotations

import argparse
import json
import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.scenario.scenario import SPACES
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry, lasa_tasks


class InputError(ValueError):
    """What was asked for cannot be done."""

    def __init__(self, field: str, found: str, accepted: str) -> None:
        super().__init__(f"{field}: found {found}; accepted: {accepted}")


def add_task(parser: argparse.ArgumentParser) -> None:
    """Add `--task` and `--lasa`."""
    parser.add_argument("--task", required=True, help=f"{', '.join(TASKS)}, or a file of --lasa without its suffix")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")


def add_space(parser: argparse.ArgumentParser) -> None:
    """Add `--space`."""
    parser.add_argument(
        "--space",
        type=_space,
        default="task",
        help="what avoids: the end effector (task), the whole arm (cspace), or both",
    )


def add_generator(parser: argparse.ArgumentParser) -> None:
    """Add `--generator`."""
    parser.add_argument(
        "--generator",
        choices=GENERATORS,
        default=GENERATORS[0],
        help="probability is the paper's (default: %(default)s)",
    )


def chosen_task(options: argparse.Namespace) -> tuple[Mapping[str, TaskEntry], Task]:
    """All tasks by name, and the chosen one, loaded.

    Raises:
        InputError: there is none of this name.
        DemonstrationError: the folder or the task's file cannot be used.
    """
    tasks = {**TASKS, **(lasa_tasks(options.lasa) if options.lasa is not None else {})}
    if options.task not in tasks:
        hint = "" if options.lasa is not None else "; --lasa DIR adds more"
        raise InputError("--task", repr(options.task), ", ".join(tasks) + hint)
    return tasks, tasks[options.task]()


def whole_number(minimum: int) -> Callable[[str], int]:
    """A type for argparse: a whole number of at least `minimum`, which is not negative."""

    def convert(text: str) -> int:
        number = int(text) if text.isdecimal() else -1
        if number < minimum:
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: a whole number, {minimum} or more")
        return number

    return convert


def positive_number(unit: str, maximum: float) -> Callable[[str], float]:
    """A type for argparse: a number above 0 and up to `maximum`."""

    def convert(text: str) -> float:
        number = _number(text)
        if not 0 < number <= maximum:
            raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {unit}, more than 0, at most {maximum:g}")
        return number

    return convert


def point(text: str) -> tuple[float, float, float]:
    """A type for argparse: X,Y,Z in metres."""
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


def ready_to_write(path: Path, suffix: str, field: str = "--out") -> Path:
    """Check, before minutes of measuring, that a file can be written; its folder is made.

    Raises:
        InputError: it has another suffix, is a folder, or cannot be written.
    """
    if path.suffix.lower() != suffix:
        raise InputError(field, repr(str(path)), f"a file that ends in {suffix}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab"):
            pass
    except OSError as error:
        found = f"{str(path)!r}, which cannot be written ({error.strerror or error})"
        raise InputError(field, found, "a file in a folder that can be written to") from error
    return path


def ready_folder(path: Path, field: str = "--out") -> Path:
    """Make a folder to write to. Raises InputError where that is not possible."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        found = f"{str(path)!r}, which cannot be made ({error.strerror or error})"
        raise InputError(field, found, "a folder, existing or new") from error
    return path


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write figures as JSON that other languages read, too: without NaN."""
    path.write_text(json.dumps(values, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def print_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print rows under a header, the first column to the left, the others to the right."""
    widths = [max(len(row[k]) for row in (header, *rows)) for k in range(len(header))]
    for row in (header, *rows):
        cells = [cell.rjust(width) for cell, width in zip(row, widths, strict=True)]
        print("  ".join([row[0].ljust(widths[0]), *cells[1:]]).rstrip())


def _space(text: str) -> str:
    if text not in SPACES:
        accepted = ", ".join(SPACES)
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: {accepted}")
    return text


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan
