"""Tables of takes: what every reader of recorded motions gives, and the reader of text."""

from __future__ import annotations

import csv
import importlib
import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import too_many
from dt_viz.files.columns import role_of


@dataclass(frozen=True)
class TakeLimits:
    """The largest recordings: fifty takes of 200,000 samples with room for orientations."""

    bytes: int = 512 * 2**20  # bytes of a file, and of what it unpacks to
    text: int = 64 * 2**20  # bytes of JSON, which needs ten times as much while it is read
    numbers: int = 60_000_000  # numbers in the columns of a file
    columns: int = 2000


LIMITS = TakeLimits()
EMPTY = ("", "na", "nan", "none", "null")  # words in cells without a number


@dataclass(frozen=True)
class ReadOptions:
    """What is known of recorded motions beside their file."""

    rate: float | None = None  # samples per second (Hz) of takes without times
    unit: str | None = None
    """Units of lengths, times and angles, such as "mm" or "cm,ms,deg"; None recognises them."""
    columns: str | Sequence[str] | Mapping[str, str] | None = None
    """Names of a table's columns in their order, or the columns to use by what they are: ``{"x": "column"}``."""
    topic: str | None = None  # topic of a bag, or child frame of its transforms
    joint_names: tuple[str, ...] = ()  # names of the joints of the arm at hand; empty without one
    asks: bool = False  # whether what is not clear is asked, of all columns, rather than guessed

    @property
    def num_joints(self) -> int | None:
        """Number of joints of the arm at hand."""
        return len(self.joint_names) or None

    @property
    def names(self) -> list[str] | None:
        """Names of the columns in their order, if they are given so."""
        if self.columns is None or isinstance(self.columns, Mapping):
            return None
        return [name.strip() for name in (self.columns.split(",") if isinstance(self.columns, str) else self.columns)]

    @property
    def roles(self) -> Mapping[str, str]:
        """Columns by what they are, if they are given so."""
        return self.columns if isinstance(self.columns, Mapping) else {}


def at_sample(row: int) -> str:
    """Describe the place of a row of a table that is no text."""
    return f"at sample {row + 1}"


@dataclass(frozen=True)
class Table:
    """Named columns as a file holds them, of one take or, told apart by labels or times, several."""

    name: str  # name of the take
    columns: Mapping[str, Any]
    """Arrays (T,) or (T, k) of numbers, or (T,) of text; a matrix without a name has the name ""."""
    place: Callable[[int], str] = at_sample  # describes the place of a row in the file
    units: dict[str, float] = field(default_factory=dict)
    """Sizes of the units of lengths, times and angles, as far as the format says."""
    unused: tuple[str, ...] = ()  # names of columns that were not read
    labels: tuple[str, ...] = ()  # texts of labels, of which the column of labels holds the indices
    is_text: bool = False
    """Whether it is text, in which the first of three columns without names may be times."""


def imported(module: str, extra: str) -> Any:  # noqa: ANN401 - a module
    """Import what reads a format.

    Raises:
        FormatError: it is not installed; the message names the extra of this package that brings it.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        accepted = f"such files after: pip install 'dt-viz[{extra}]'"
        raise FormatError("file", f"a format that needs the package {module.partition('.')[0]}", accepted) from error


def read_text(path: Path, options: ReadOptions) -> Iterator[Table]:
    """Read a table of text: cells between commas, semicolons, tabs or spaces, with a header or without.

    Raises:
        FormatError: a line has other cells than the first, or one that is no number.
    """
    header, first, skipped, delimiter = _beginning(path)
    if not first:
        yield Table(path.stem, dict.fromkeys(header or ["x", "y"], np.empty(0)))
        return
    width = len(first)
    if len(header or first) != width:
        raise FormatError(f"line {skipped + 1}", f"{width} columns", f"{len(header)}, as in the header")
    given = options.names
    if given is not None and len(given) != width:
        raise FormatError("columns", f"{len(given)} names for {width} columns", f"{width} names")
    names = given or header
    lower = {name.lower() for name in options.roles.values()}
    by_name = [bool(role_of(name, options.joint_names)) or name.lower() in lower for name in names]
    wanted = [not names or options.asks or by_name[k] for k in range(width)]
    labels: dict[str, float] = {}
    label = [bool(names) and _is_label(names[k], options) for k in range(width)]
    used = [
        k
        for k in range(width)
        if wanted[k] and (label[k] or first[k].lower() in EMPTY or _is_number(first[k], delimiter))
    ]
    max_rows = LIMITS.numbers // max(len(used), 1)
    fields = [(f"f{k}", "f8" if k in used else "U1") for k in range(width)]
    converters: Any = {k: lambda cell: labels.setdefault(cell.strip(), len(labels)) for k in used if label[k]}
    lines: Any = (line for _, line in itertools.islice(_rows(path, skipped, delimiter), max_rows + 1))
    try:
        rows = np.loadtxt(
            lines,
            dtype=np.dtype(fields),
            delimiter=delimiter,
            quotechar='"',
            comments=None,
            converters=converters,
            ndmin=1,
            encoding=None,
        )
    except ValueError as error:
        raise _wrong_line(path, skipped, delimiter, used, label) or error from error
    if len(rows) > max_rows:
        raise too_many("file", max_rows, "lines")

    def place(row: int) -> str:
        number, _ = next(itertools.islice(_rows(path, skipped, delimiter), row, None))
        return f"at line {number}"

    unused = tuple(name for k, name in enumerate(names) if k not in used)
    values = [rows[f"f{k}"] for k in used]
    columns = dict(zip([names[k] for k in used], values, strict=True)) if names else {"": np.stack(values, axis=1)}
    yield Table(path.stem, columns, place, unused=unused, labels=tuple(labels), is_text=True)


def _is_label(name: str, options: ReadOptions) -> bool:
    wanted = options.roles.get("demo", "")
    role = role_of(name)
    return name.lower() == wanted.lower() if wanted else role is not None and role.kind == "label"


def _beginning(path: Path) -> tuple[list[str], list[str], int, str | None]:
    """Return the header (empty without one), the first row, the number of lines before it, and what parts cells."""
    before: list[str] = []
    delimiter: str | None = None
    with path.open(encoding="utf-8-sig", newline="") as file:
        for number, line in enumerate(iter(lambda: file.readline(2**20), "")):
            text = line.strip()
            if not text:
                continue
            marked = text[0] == "#" or (text[0] == "%" and not text.lower().startswith("%time"))
            if not before or before[0] == "#":
                delimiter = next((mark for mark in "\t;," if mark in text), None)
            cells = _cells(text.lstrip("#% ") if marked else text, delimiter)
            if len(cells) > LIMITS.columns:
                raise too_many("file", LIMITS.columns, "columns")
            if marked:
                before = ["#", *cells]
            elif all(_is_number(cell, delimiter) for cell in cells) or (before and before[0] != "#"):
                header = before[1:]
                return (header if before[:1] != ["#"] or len(header) == len(cells) else []), cells, number, delimiter
            else:
                before = ["", *cells]
    return before[1:], [], 0, delimiter


def _cells(line: str, delimiter: str | None) -> list[str]:
    if delimiter is None:
        return line.split()
    return [cell.strip() for cell in next(csv.reader([line], delimiter=delimiter, strict=True), [])]


def _is_number(cell: str, delimiter: str | None) -> bool:
    try:
        float(cell.replace(",", ".") if delimiter == ";" else cell)
    except ValueError:
        return False
    return True


def _rows(path: Path, skipped: int, delimiter: str | None) -> Iterator[tuple[int, str]]:
    """Number and text of each line with cells, from the first row on; decimal points for commas between semicolons."""
    with path.open(encoding="utf-8-sig", newline="") as file:
        for number, line in enumerate(file, 1):
            if number > skipped and line.strip():
                yield number, line.replace(",", ".") if delimiter == ";" else line


def _wrong_line(
    path: Path, skipped: int, delimiter: str | None, used: Sequence[int], label: Sequence[bool]
) -> FormatError | None:
    """Return the error about the first line that is no row of the table."""
    for number, line in _rows(path, skipped, delimiter):
        cells = _cells(line.strip("\r\n"), delimiter)
        if len(cells) != len(label):
            return FormatError(f"line {number}", f"{len(cells)} columns", f"{len(label)}, as in the first line")
        if not all(label[k] or _is_number(cells[k], delimiter) for k in used):
            return FormatError(f"line {number}", repr(line.strip()[:60]), "decimal numbers")
    return None
