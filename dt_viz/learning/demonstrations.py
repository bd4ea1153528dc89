"""Demonstrations: what they are, how they are checked, how files become them.

Three kinds of file are read, and a folder of the first:

CSV (``.csv``), UTF-8, one header line and then one line per sample, seconds and metres::

    demo,t,x,y,z
    first,0.00,0.10,0.20,0.30
    first,0.04,0.11,0.20,0.30
    second,0.00,0.12,0.21,0.30

    ``demo`` is any label; lines with the same label are one demonstration, in the order they stand in. ``z`` is
    left out for motions in the plane. Without the column ``demo`` the file is a single demonstration. Of a folder,
    every CSV file is read, in the order of their names.

npz (``.npz``), seconds and metres, for i = 0, 1, 2, …:
    ``times_i`` (T,), ``positions_i`` (T, d), and optionally ``name_i``, a string. Pickled arrays are never opened.

LASA handwriting (``.mat``, MATLAB v5 to v7), seconds and millimetres:
    ``demos``, a cell array (or array) of structures with ``t`` 1×T and ``pos`` d×T; nothing else in it is used.
"""

import re
from array import array
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.errors import DataError, parsing
from dt_viz.files.npz import NpzFile
from dt_viz.files.text import read_table
from dt_viz.learning.matfile import Value, read_variable

DIMENSIONS = (2, 3)
MAX_BYTES = 16 * 2**20  # of a file, and of what an npz unpacks to; some 300,000 samples
MAX_CSV_ROWS = 600_000
MAX_DEMONSTRATIONS = 1000
MAX_NAME = 1000  # characters
CSV_HEADERS = (("demo", "t", "x", "y"), ("demo", "t", "x", "y", "z"), ("t", "x", "y"), ("t", "x", "y", "z"))
MAX_COORDINATE = 100.0  # metres; beyond it the numbers are in another unit
MAX_DURATION = 3600.0  # seconds; beyond it the numbers are in another unit
MIN_EXTENT = 1e-6  # metres; a motion that stays within it is a point
METRES_PER_LASA_UNIT = 1e-3


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One recorded motion. Compared and hashed by identity.

    Attributes:
        times: shape ``(T,)``, seconds, strictly increasing from 0.
        positions: shape ``(T, d)``, metres, d is 2 or 3, in the frame of the task.
        name: what to call it in the page and in messages.
    """

    times: np.ndarray
    positions: np.ndarray
    name: str

    @property
    def dimension(self) -> int:
        """Number of coordinates d."""
        return self.positions.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, seconds."""
        return float(self.times[-1])


class DemonstrationError(DataError):
    """A demonstration that cannot be used."""


def check_demonstrations(
    demonstrations: Sequence[Demonstration], source: str | Path, lines: Sequence[Sequence[int]] | None = None
) -> tuple[Demonstration, ...]:
    """Check recorded motions and bring them into the one form that the rest of the program trusts.

    Every loader ends here; motions recorded in memory go through it as well.

    Args:
        demonstrations: times ``(T,)`` in seconds from any start, positions ``(T, d)`` in metres, any real number type.
        source: the file or recording, for messages.
        lines: for each demonstration, the line of the file that each sample stands on, for messages;
            without it, samples are counted from 1.

    Returns:
        The same motions with times from 0, as read-only float64 arrays.

    Raises:
        DemonstrationError: there are none, or too many; they differ in dimension; or one of them has not the shapes,
            the number of samples, the finite values or the increasing times that :class:`Demonstration` promises, does
            not move, has values so large that its unit must be another one, or a name that cannot be shown.
    """
    if not demonstrations:
        raise DemonstrationError(source, "demonstrations", "none", "at least one")
    if len(demonstrations) > MAX_DEMONSTRATIONS:
        raise DemonstrationError(source, "demonstrations", f"{len(demonstrations)}", f"at most {MAX_DEMONSTRATIONS}")
    checked = []
    for i, demonstration in enumerate(demonstrations):
        where = (lambda row: f"sample {row + 1}") if lines is None else (lambda row, n=lines[i]: f"line {n[row]}")
        checked.append(_check_one(demonstration, source, where))
        first, this = checked[0], checked[-1]
        if this.dimension != first.dimension:
            raise DemonstrationError(
                source,
                "dimension",
                f"{first.dimension} in {first.name!r} but {this.dimension} in {this.name!r}",
                "one dimension for all",
            )
    return tuple(checked)


def _check_one(demonstration: Demonstration, source: str | Path, where: Callable[[int], str]) -> Demonstration:
    name = demonstration.name
    if len(name) > MAX_NAME or re.search("[\ud800-\udfff]", name):  # halves of characters cannot be sent to a page
        raise DemonstrationError(source, "name", repr(name[:40]), f"text of at most {MAX_NAME} characters")
    times_field, positions_field = f"times of {name!r}", f"positions of {name!r}"
    times = _real_numbers(demonstration.times, source, times_field)
    positions = _real_numbers(demonstration.positions, source, positions_field)
    if times.ndim != 1:
        raise DemonstrationError(source, times_field, f"an array of shape {times.shape}", "shape (T,)")
    if positions.ndim != 2 or positions.shape[1] not in DIMENSIONS:
        raise DemonstrationError(source, positions_field, f"an array of shape {positions.shape}", "(T, 2) or (T, 3)")
    if len(times) != len(positions):
        found = f"{len(positions)} positions for {len(times)} times"
        raise DemonstrationError(source, positions_field, found, "as many positions as times")
    if len(times) < 2:
        raise DemonstrationError(source, positions_field, f"{len(times)} sample(s)", "at least 2 samples")
    for field, values in ((times_field, times[:, None]), (positions_field, positions)):
        if not np.isfinite(values).all():
            row, column = np.argwhere(~np.isfinite(values))[0]
            raise DemonstrationError(source, field, f"{values[row, column]} at {where(row)}", "finite numbers")
    _check_times(times, source, times_field, where)
    if np.abs(positions).max() > MAX_COORDINATE:
        row = int(np.abs(positions).max(axis=1).argmax())
        found = f"{np.abs(positions[row]).max():.6g} m at {where(row)}; is the file in millimetres?"
        raise DemonstrationError(source, positions_field, found, f"metres, at most {MAX_COORDINATE:g} from the origin")
    if np.ptp(positions, axis=0).max() < MIN_EXTENT:
        raise DemonstrationError(source, positions_field, "a motion that stays at one point", "a motion")
    times = times - times[0]
    times.setflags(write=False)
    positions.setflags(write=False)
    return Demonstration(times, positions, name)


def _check_times(times: np.ndarray, source: str | Path, field: str, where: Callable[[int], str]) -> None:
    with np.errstate(over="ignore"):
        elapsed = times - times[0]  # what will be stored: rounding may make close times equal
    still = np.flatnonzero(elapsed[1:] <= elapsed[:-1])
    if len(still):
        row = int(still[0]) + 1
        found = f"{times[row]:.9g} s at {where(row)}, after {times[row - 1]:.9g} s"
        raise DemonstrationError(source, field, found, "times that increase from each sample to the next")
    if elapsed[-1] > MAX_DURATION:
        found = f"a duration of {elapsed[-1]:.6g} s; is the file in milliseconds?"
        raise DemonstrationError(source, field, found, f"seconds, at most {MAX_DURATION:g} from first to last")


def _real_numbers(values: object, source: str | Path, field: str, unit: float = 1.0) -> np.ndarray:
    """Return as float64 what must be an array of integers or real numbers, times ``unit``."""
    array = np.asarray(values)
    if array.dtype.kind not in "iuf":
        raise DemonstrationError(source, field, f"values of type {array.dtype}", "integers or real numbers")
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes inf or nan is refused later
        return array.astype(np.float64) * unit


def load_demonstrations(path: str | Path) -> tuple[Demonstration, ...]:
    """Read the demonstrations of a file (CSV, npz, LASA .mat) or of a folder of CSV files.

    Args:
        path: the file, whose suffix says what it is (see the module's docstring), or the folder.

    Raises:
        DemonstrationError: there is no such file or folder, it cannot be read, is not what its suffix says, or holds
            demonstrations that :func:`check_demonstrations` refuses. Nothing else is raised, whatever the file holds.
    """
    path = Path(path)
    try:
        if path.is_dir():
            return _load_csv_folder(path)
        if not path.is_file():
            raise DemonstrationError(path, "path", "no such file or folder", "a readable file or folder")
        size = path.stat().st_size
        if size > MAX_BYTES:
            raise DemonstrationError(path, "file", f"{size} bytes", f"at most {MAX_BYTES} bytes")
        content = path.read_bytes()
    except OSError as error:
        found = f"nothing that can be read ({error.strerror or error})"
        raise DemonstrationError(path, "path", found, "a readable file or folder") from error
    return read_demonstrations(content, path)


def read_demonstrations(content: bytes, source: str | Path) -> tuple[Demonstration, ...]:
    """Read the demonstrations in the bytes of a file, such as one uploaded from the browser.

    Args:
        content: all bytes of the file.
        source: its name or path; the suffix says what it is, the stem names demonstrations that have no name.

    Raises:
        DemonstrationError: as :func:`load_demonstrations`.
    """
    source = Path(source)
    reader = _READERS.get(source.suffix.lower())
    if reader is None:
        found = repr(source.suffix) if source.suffix else "no suffix"
        raise DemonstrationError(source, "suffix", found, f"{', '.join(_READERS)} or a folder of .csv files")
    if not content:
        raise DemonstrationError(source, "file", "an empty file", "at least one demonstration")
    return reader(content, source)


def save_demonstrations(path: str | Path, demonstrations: Sequence[Demonstration]) -> None:
    """Write demonstrations as npz: ``times_i``, ``positions_i`` and ``name_i`` for i = 0, 1, ….

    Args:
        path: the file to write, ending in ``.npz``; an existing one is replaced.
        demonstrations: what to write; :func:`load_demonstrations` gives back equal times, positions and names.

    Raises:
        DemonstrationError: the suffix is another one, or :func:`check_demonstrations` refuses the demonstrations.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".npz":
        raise DemonstrationError(path, "suffix", repr(path.suffix), ".npz")
    arrays: dict[str, Any] = {}
    for i, demonstration in enumerate(check_demonstrations(demonstrations, path)):
        arrays[f"times_{i}"] = demonstration.times
        arrays[f"positions_{i}"] = demonstration.positions
        arrays[f"name_{i}"] = np.array(demonstration.name)
    with path.open("wb") as file:
        np.savez_compressed(file, **arrays)


def lasa_files(folder: str | Path) -> dict[str, Path]:
    """List the shapes of a LASA folder by name, without reading them: load one with :func:`load_demonstrations`.

    Args:
        folder: holds one ``.mat`` file per shape, such as ``Sshape.mat``.

    Raises:
        DemonstrationError: there is no such folder, it cannot be read, or it holds no ``.mat`` file.
    """
    folder = Path(folder)
    files = {path.stem: path for path in _files_of(folder) if path.suffix.lower() == ".mat"}
    if not files:
        raise DemonstrationError(folder, "folder", "no .mat file", "one .mat file per shape")
    return files


def load_lasa_folder(folder: str | Path) -> dict[str, tuple[Demonstration, ...]]:
    """Read every shape of a LASA folder, by name.

    Raises:
        DemonstrationError: as :func:`lasa_files`, or any one of the files cannot be used: none is left out.
    """
    return {name: load_demonstrations(path) for name, path in lasa_files(folder).items()}


def _files_of(folder: Path) -> list[Path]:
    """Return the visible files of a folder, by name."""
    try:
        return sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
    except OSError as error:
        found = f"nothing that can be read ({error.strerror or error})"
        raise DemonstrationError(folder, "folder", found, "a readable folder") from error


def _load_csv_folder(folder: Path) -> tuple[Demonstration, ...]:
    files = _files_of(folder)
    others = [path.name for path in files if path.suffix.lower() in {".npz", ".mat"}]
    if others:
        raise DemonstrationError(folder, "folder", f"{others[0]!r}", "only .csv files; load other files one by one")
    tables = [path for path in files if path.suffix.lower() == ".csv"]
    if not tables:
        raise DemonstrationError(folder, "folder", "no .csv file", "one or more .csv files")
    return check_demonstrations([demo for path in tables for demo in load_demonstrations(path)], folder)


def _read_csv(content: bytes, source: Path) -> tuple[Demonstration, ...]:
    samples: dict[str, array[float]] = {}
    lines: dict[str, array[int]] = {}
    with parsing(DemonstrationError, source, "file", "comma-separated text in UTF-8"):
        header, rows = read_table(content, CSV_HEADERS, max_rows=MAX_CSV_ROWS)
        columns = [name for name in header if name != "demo"]
        for line, row in rows:
            label = source.stem if len(row) == len(columns) else row[0]
            if label not in samples:
                if len(samples) == MAX_DEMONSTRATIONS:
                    found = f"more than {MAX_DEMONSTRATIONS}"
                    raise DemonstrationError(source, "demonstrations", found, f"at most {MAX_DEMONSTRATIONS}")
                samples[label], lines[label] = array("d"), array("q")
            samples[label].extend(_csv_numbers(row[-len(columns) :], columns, line, source))
            lines[label].append(line)
    tables = {label: np.asarray(numbers).reshape(-1, len(columns)) for label, numbers in samples.items()}
    demonstrations = [Demonstration(table[:, 0], table[:, 1:], label) for label, table in tables.items()]
    return check_demonstrations(demonstrations, source, list(lines.values()))


def _csv_numbers(cells: Sequence[str], columns: Sequence[str], line: int, source: Path) -> list[float]:
    numbers = []
    for cell, column in zip(cells, columns, strict=True):
        try:
            numbers.append(float(cell))
        except ValueError as error:
            found = repr(cell[:40])
            raise DemonstrationError(source, f"line {line}, column {column}", found, "a decimal number") from error
    return numbers


def _read_npz(content: bytes, source: Path) -> tuple[Demonstration, ...]:
    with parsing(DemonstrationError, source, "file", "an npz archive"):
        archive = NpzFile(content, max_bytes=MAX_BYTES)
    accepted = "times_0, positions_0, times_1, positions_1, … and optionally name_0, name_1, …"
    numbers = set()
    for key in archive.names:
        match = re.fullmatch(r"(?:times|positions|name)_(0|[1-9][0-9]{0,8})", key)
        if match is None:
            raise DemonstrationError(source, "arrays", repr(key[:40]), accepted)
        numbers.add(int(match[1]))

    def read(key: str) -> np.ndarray:
        if key not in archive.names:
            raise DemonstrationError(source, "arrays", f"no {key!r}", accepted)
        with parsing(DemonstrationError, source, f"array {key!r}", "plain numbers; pickled objects are never opened"):
            return archive.read(key)

    demonstrations = []
    for i in sorted(numbers):
        name = f"{source.stem} {i}"
        if f"name_{i}" in archive.names:
            text = read(f"name_{i}")
            if text.dtype.kind != "U" or text.ndim:
                raise DemonstrationError(source, f"name_{i}", f"{text.dtype} of shape {text.shape}", "one string")
            with parsing(DemonstrationError, source, f"name_{i}", "one string"):
                name = str(text)
        demonstrations.append(Demonstration(read(f"times_{i}"), read(f"positions_{i}"), name))
    return check_demonstrations(demonstrations, source)


def _read_lasa(content: bytes, source: Path) -> tuple[Demonstration, ...]:
    accepted = "a cell array of structures with t and pos"
    with parsing(DemonstrationError, source, "file", "a MATLAB file of version 5 to 7"):
        try:
            recordings = read_variable(content, "demos")
        except KeyError as error:
            raise DemonstrationError(source, "variable 'demos'", "no such variable", accepted) from error
    if not isinstance(recordings, list):
        raise DemonstrationError(source, "variable 'demos'", "no cells", accepted)
    demonstrations = []
    for i, recording in enumerate(recordings):
        times = _lasa_field(recording, "t", f"demos{{{i + 1}}}", source)
        positions = _lasa_field(recording, "pos", f"demos{{{i + 1}}}", source, METRES_PER_LASA_UNIT)
        if times.ndim != 2 or 1 not in times.shape:
            raise DemonstrationError(source, f"demos{{{i + 1}}}.t", f"an array of shape {times.shape}", "1×T")
        demonstrations.append(Demonstration(times.ravel(), positions.T, f"{source.stem} {i}"))
    return check_demonstrations(demonstrations, source)


def _lasa_field(recording: Value, field: str, where: str, source: Path, unit: float = 1.0) -> np.ndarray:
    fields = recording[0] if isinstance(recording, list) and len(recording) == 1 else recording
    if not isinstance(fields, dict) or field not in fields:
        raise DemonstrationError(source, f"{where}.{field}", "no such field", "a structure with t (1×T) and pos (d×T)")
    numbers = fields[field]
    if not isinstance(numbers, np.ndarray):
        raise DemonstrationError(source, f"{where}.{field}", "something else than numbers", "a matrix of real numbers")
    return _real_numbers(numbers, source, f"{where}.{field}", unit)


_READERS: dict[str, Callable[[bytes, Path], tuple[Demonstration, ...]]] = {
    ".csv": _read_csv,
    ".npz": _read_npz,
    ".mat": _read_lasa,
}
