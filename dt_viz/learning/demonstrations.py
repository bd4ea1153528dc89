"""Demonstrations: recorded motions, their checks, and their files.

Three kinds of file are read, and a folder of the first:

CSV (``.csv``), UTF-8, one header line and then one line per sample, seconds and metres::

    demo,t,x,y,z
    first,0.00,0.10,0.20,0.30
    first,0.04,0.11,0.20,0.30
    second,0.00,0.12,0.21,0.30

    Columns are found by their names, in any order; others are left out, and a log line names them.

    - ``demo`` is any label; lines with the same label are one demonstration, in the order they stand in. Without it
      the file is a single demonstration.
    - ``t``, ``time``, ``timestamp`` or ``stamp``, perhaps with a unit (``time_ms``, ``stamp_ns``); ``%time`` of
      ``rostopic echo -p`` is nanoseconds. Without it the samples have equal distances in time: `rate` samples per
      second, or `UNTIMED` seconds in all.
    - ``x``, ``y``, ``z``, also as ``pos_x``, ``position.x`` or ``field.pose.position.x``. ``z`` is left out for
      motions in the plane.

    Of a folder, every CSV file is read, in the order of their names.

npz (``.npz``), seconds and metres, for i = 0, 1, 2, …:
    ``times_i`` (T,), ``positions_i`` (T, d), and optionally ``name_i``, a string. Pickled arrays are never opened.

LASA handwriting (``.mat``, MATLAB v5 to v7), seconds and millimetres:
    ``demos``, a cell array (or array) of structures with ``t`` 1×T and ``pos`` d×T; nothing else in it is used.
"""

import csv
import io
import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import scipy.io

from dt_viz.errors import DataError, FormatError, naming, parsing
from dt_viz.files.checks import check_at_most, check_finite, checked_suffix, read_bytes, real_numbers
from dt_viz.files.npz import arrays_of

logger = logging.getLogger(__name__)

DIMENSIONS = (2, 3)
MAX_BYTES = 16 * 2**20
"""Largest number of bytes of a file, and of what an npz unpacks to; some 300,000 samples."""
MAX_DEMONSTRATIONS = 1000
MAX_NAME = 1000
"""Largest number of characters of a name."""
UNTIMED = 5.0
"""Duration of a demonstration of a table without times or rate, seconds."""
TIME = re.compile(r"(?:t|time|timestamp|stamp)(?:[_ .]?[(\[]?(s|ms|us|ns)[)\]]?)?|(%time)")
"""Names of the column of times, and the unit they end in."""
SECONDS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
COORDINATE = re.compile(r"(?:.*[._/ ])?(?:p|pos|position)[._/ ]?([xyz])")
"""Names of the columns of positions other than x, y, z."""
ACCEPTED = "columns x, y and perhaps z, t and demo, such as 't,x,y,z' or 'timestamp,pos_x,pos_y,pos_z'"
MAX_COORDINATE, MAX_DURATION = 100.0, 3600.0
"""Largest coordinate (m) and duration (s); numbers beyond them are in another unit."""
MIN_EXTENT = 1e-6
"""Smallest extent of a motion, metres; a smaller one is a point."""
METRES_PER_LASA_UNIT = 1e-3


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One recorded motion. Compared and hashed by identity.

    Attributes:
        times: shape ``(T,)``, seconds, strictly increasing from 0.
        positions: shape ``(T, d)``, metres, d is 2 or 3, in the frame of the task.
        name: name on the page and in messages.
    """

    times: np.ndarray
    positions: np.ndarray
    name: str = ""

    @property
    def dimension(self) -> int:
        """Number of coordinates d."""
        return self.positions.shape[1]

    @property
    def duration(self) -> float:
        """Time from the first to the last sample, seconds."""
        return float(self.times[-1])

    def __repr__(self) -> str:
        shape = "×".join(map(str, np.shape(self.positions)))
        duration = f", {self.times[-1] - self.times[0]:.3g} s" if np.size(self.times) > 1 else ""
        return f"Demonstration({self.name!r}: {shape} positions, metres{duration})"


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
    with naming(DemonstrationError, source):
        check_at_most("demonstrations", len(demonstrations), MAX_DEMONSTRATIONS)
        checked = []
        for demonstration, (times, positions) in zip(demonstrations, samples_of(demonstrations, lines), strict=True):
            name = demonstration.name
            if len(name) > MAX_NAME or re.search("[\ud800-\udfff]", name):  # a page cannot be sent half a character
                raise FormatError("name", repr(name[:40]), f"text of at most {MAX_NAME} characters")
            where = _places(lines, len(checked))
            farthest = np.abs(positions).max(axis=1)
            if farthest.max() > MAX_COORDINATE:
                found = f"{farthest.max():.6g} m {where(int(farthest.argmax()))}; is the file in millimetres?"
                accepted = f"metres, at most {MAX_COORDINATE:g} from the origin"
                raise FormatError(f"positions of {name!r}", found, accepted)
            if times[-1] > MAX_DURATION:
                found = f"a duration of {times[-1]:.6g} s; is the file in milliseconds?"
                accepted = f"seconds, at most {MAX_DURATION:g} from first to last"
                raise FormatError(f"times of {name!r}", found, accepted)
            if np.ptp(positions, axis=0).max() < MIN_EXTENT:
                raise FormatError(f"positions of {name!r}", "a motion that stays at one point", "a motion")
            times.setflags(write=False)
            positions.setflags(write=False)
            checked.append(Demonstration(times, positions, name))
    return tuple(checked)


def samples_of(
    demonstrations: Sequence[Demonstration], lines: Sequence[Sequence[int]] | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the times (T,) from 0 and the positions (T, d) of demonstrations as new float64 arrays.

    Args:
        demonstrations: recorded motions.
        lines: as in :func:`check_demonstrations`.

    Raises:
        FormatError: there are none, they differ in dimension, or one of them has not the shapes, the number of samples,
            the finite values or the increasing times that :class:`Demonstration` promises.
    """
    if not demonstrations:
        raise FormatError("demonstrations", "none", "at least one")
    samples = []
    for i, demonstration in enumerate(demonstrations):
        name, where = demonstration.name, _places(lines, i)
        times_field, positions_field = f"times of {name!r}", f"positions of {name!r}"
        times = real_numbers(demonstration.times, times_field)
        positions = real_numbers(demonstration.positions, positions_field)
        if times.ndim != 1:
            raise FormatError(times_field, f"an array of shape {times.shape}", "shape (T,)")
        if positions.ndim != 2 or positions.shape[1] not in DIMENSIONS:
            raise FormatError(positions_field, f"an array of shape {positions.shape}", "(T, 2) or (T, 3)")
        if len(times) != len(positions):
            found = f"{len(positions)} positions for {len(times)} times"
            raise FormatError(positions_field, found, "as many positions as times")
        if len(times) < 2:
            raise FormatError(positions_field, f"{len(times)} sample(s)", "at least 2 samples")
        check_finite(times[:, None], times_field, where)
        check_finite(positions, positions_field, where)
        with np.errstate(over="ignore"):
            elapsed = times - times[0]  # what will be stored: rounding may make close times equal
        still = np.flatnonzero(elapsed[1:] <= elapsed[:-1])
        if len(still):
            row = int(still[0]) + 1
            found = f"{times[row]:.9g} s {where(row)}, after {times[row - 1]:.9g} s"
            raise FormatError(times_field, found, "times that increase from each sample to the next")
        samples.append((elapsed, positions))
        first, this = samples[0][1].shape[1], positions.shape[1]
        if this != first:
            found = f"{first} in {demonstrations[0].name!r} but {this} in {name!r}"
            raise FormatError("dimension", found, "one dimension for all")
    return samples


def _places(lines: Sequence[Sequence[int]] | None, index: int) -> Callable[[int], str]:
    """Return what describes the place of a sample of the demonstration with this index."""
    return lambda row: f"at sample {row + 1}" if lines is None else f"at line {lines[index][row]}"


def load_demonstrations(path: str | Path, *, rate: float | None = None) -> tuple[Demonstration, ...]:
    """Read the demonstrations of a file (CSV, npz, LASA .mat) or of a folder of CSV files.

    Args:
        path: the file, whose suffix says what it is (see the module's docstring), or the folder.
        rate: samples per second (Hz) of tables without times; None takes them as `UNTIMED` seconds long.

    Raises:
        DemonstrationError: there is no such file or folder, it cannot be read, is not what its suffix says, or holds
            demonstrations that :func:`check_demonstrations` refuses; or there are times beside a rate.
    """
    path = Path(path)
    with parsing(DemonstrationError, path, "path", "a readable file or folder"):
        if path.is_dir():
            return _load_csv_folder(path, rate)
        if not path.exists():
            raise FormatError("path", "no such file or folder", "a readable file or folder")
        content = read_bytes(path, MAX_BYTES)
    return read_demonstrations(content, path, rate=rate)


def read_demonstrations(content: bytes, source: str | Path, *, rate: float | None = None) -> tuple[Demonstration, ...]:
    """Read the demonstrations in the bytes of a file.

    Args:
        content: all bytes of the file.
        source: its name or path; the suffix says what it is, the stem names demonstrations that have no name.
        rate: as for :func:`load_demonstrations`.

    Raises:
        DemonstrationError: as :func:`load_demonstrations`.
    """
    source = Path(source)
    with naming(DemonstrationError, source):
        suffix = checked_suffix(content, source, _READERS, MAX_BYTES)
        if rate is not None and not (suffix == ".csv" and 0 < rate < np.inf):
            raise FormatError("rate", f"{rate} for a {suffix} file", "samples per second, above 0, of a .csv file")
    read, accepted = _READERS[suffix]
    with parsing(DemonstrationError, source, "file", accepted):
        demonstrations, lines = read(content, source, rate)
    return check_demonstrations(demonstrations, source, lines)


def save_demonstrations(path: str | Path, demonstrations: Sequence[Demonstration]) -> None:
    """Write demonstrations as npz: ``times_i``, ``positions_i`` and ``name_i`` for i = 0, 1, …."""
    arrays: dict[str, Any] = {
        f"{field}_{i}": np.asarray(getattr(demonstration, field))
        for i, demonstration in enumerate(demonstrations)
        for field in ("times", "positions", "name")
    }
    np.savez_compressed(path, **arrays)


def lasa_files(folder: str | Path) -> dict[str, Path]:
    """List the shapes of a LASA folder by name, without reading them: load one with :func:`load_demonstrations`.

    Args:
        folder: holds one ``.mat`` file per shape, such as ``Sshape.mat``.

    Raises:
        DemonstrationError: there is no such folder, it cannot be read, or it holds no ``.mat`` file.
    """
    files = {path.stem: path for path in _files_of(Path(folder), ".mat")}
    if not files:
        raise DemonstrationError(folder, "folder", "no .mat file", "one .mat file per shape")
    return files


def _files_of(folder: Path, *suffixes: str) -> list[Path]:
    """Return the visible files of a folder with one of these suffixes, by name."""
    with parsing(DemonstrationError, folder, "folder", "a readable folder"):
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
        return [path for path in files if path.suffix.lower() in suffixes]


def _load_csv_folder(folder: Path, rate: float | None) -> tuple[Demonstration, ...]:
    if others := _files_of(folder, ".npz", ".mat"):
        raise FormatError("folder", f"{others[0].name!r}", "only .csv files; load other files one by one")
    tables = _files_of(folder, ".csv")
    if not tables:
        raise FormatError("folder", "no .csv file", "one or more .csv files")
    return check_demonstrations([demo for path in tables for demo in load_demonstrations(path, rate=rate)], folder)


Read = tuple[list[Demonstration], list[list[int]] | None]
"""Demonstrations of a file before they are checked, and for each the lines of its samples in a text file."""


def _read_csv(content: bytes, source: Path, rate: float | None) -> Read:
    table = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
    header = [cell.strip().lower() for cell in next(table, [])]
    columns, second = _columns(header)
    if "t" in columns and rate is not None:
        raise FormatError("rate", f"{rate:g} beside a column of times", "either times or a rate")
    if others := [name for k, name in enumerate(header) if k not in columns.values()]:
        logger.warning("%s: columns %s are not used", source, ", ".join(others)[:200])
    numbers = [columns[name] for name in ("t", "x", "y", "z") if name in columns]
    samples: dict[str, list[list[float]]] = {}
    lines: dict[str, list[int]] = {}
    for row in table:
        if not any(map(str.strip, row)):
            continue
        if len(row) != len(header):
            raise FormatError(f"line {table.line_num}", f"{len(row)} columns", f"{len(header)}, as in the header")
        label = row[columns["demo"]].strip() if "demo" in columns else source.stem
        try:
            samples.setdefault(label, []).append([float(row[column]) for column in numbers])
        except ValueError as error:
            raise FormatError(f"line {table.line_num}", repr(",".join(row)[:60]), "decimal numbers") from error
        lines.setdefault(label, []).append(table.line_num)
    demonstrations = []
    for label, rows in samples.items():
        values = np.array(rows)
        if "t" in columns:
            times, positions = second * values[:, 0], values[:, 1:]
        else:
            times = np.arange(len(values)) / (rate or max(len(values) - 1, 1) / UNTIMED)
            positions = values
        demonstrations.append(Demonstration(times, positions, label))
    if "t" not in columns and rate is None:
        logger.warning("%s: no times and no rate: each demonstration takes %g s, evenly sampled", source, UNTIMED)
    return demonstrations, list(lines.values())


def _columns(header: Sequence[str]) -> tuple[dict[str, int], float]:
    """Find the numbers of the columns demo, t, x, y, z, those that there are, and the seconds of a unit of t."""
    columns = {name: header.index(name) for name in ("demo", "x", "y", "z") if name in header}
    found = [(k, match) for k, name in enumerate(header) if (match := COORDINATE.fullmatch(name))]
    if not {"x", "y", "z"} & set(columns):
        for k, match in found:
            columns.setdefault(match[1], k)  # the first of several poses
    second = 1.0
    for k, name in enumerate(header):
        if "t" not in columns and (match := TIME.fullmatch(name)):
            columns["t"], second = k, 1e-9 if match[2] else SECONDS[match[1] or "s"]
    if not {"x", "y"} <= set(columns):
        raise FormatError("header line", repr(",".join(header)[:80]), ACCEPTED)
    return columns, second


def _read_npz(content: bytes, source: Path, _rate: float | None) -> Read:
    arrays = arrays_of(content, max_bytes=MAX_BYTES)
    accepted = "times_0, positions_0, times_1, positions_1, … and optionally name_0, name_1, …"
    matches = {key: re.fullmatch(r"(?:times|positions|name)_(0|[1-9][0-9]{0,8})", key) for key in arrays}
    demonstrations = []
    for i in sorted({int(match[1]) if match else -1 for match in matches.values()}):
        if missing := [key for key in (f"times_{i}", f"positions_{i}") if key not in arrays]:
            wrong = [repr(key[:40]) for key, match in matches.items() if not match]
            raise FormatError("arrays", wrong[0] if wrong else f"no {missing[0]!r}", accepted)
        name = arrays.get(f"name_{i}", np.array(f"{source.stem} {i}"))
        if name.dtype.kind != "U" or name.ndim:
            raise FormatError(f"name_{i}", f"{name.dtype} of shape {name.shape}", "one string")
        demonstrations.append(Demonstration(arrays[f"times_{i}"], arrays[f"positions_{i}"], str(name)))
    return demonstrations, None


def _read_lasa(content: bytes, source: Path, _rate: float | None) -> Read:
    variables = scipy.io.loadmat(io.BytesIO(content), simplify_cells=True, variable_names=("demos",))
    accepted = "a cell array of structures with t (1×T) and pos (d×T)"
    if "demos" not in variables:
        raise FormatError("variable 'demos'", "no such variable", accepted)
    recordings = np.atleast_1d(np.asarray(variables["demos"], dtype=object)).ravel()
    demonstrations = []
    for i, recording in enumerate(recordings):
        if not isinstance(recording, dict) or not {"t", "pos"} <= set(recording):
            raise FormatError(f"demos{{{i + 1}}}", "no structure with t and pos", accepted)
        times, positions = (real_numbers(recording[field], f"demos{{{i + 1}}}.{field}") for field in ("t", "pos"))
        if times.ndim != 1:
            raise FormatError(f"demos{{{i + 1}}}.t", f"an array of shape {times.shape}", "1×T")
        demonstrations.append(Demonstration(times, positions.T * METRES_PER_LASA_UNIT, f"{source.stem} {i}"))
    return demonstrations, None


_READERS: dict[str, tuple[Callable[[bytes, Path, float | None], Read], str]] = {
    ".csv": (_read_csv, "comma-separated text in UTF-8"),
    ".npz": (_read_npz, "an npz archive of plain numbers; pickled objects are never opened"),
    ".mat": (_read_lasa, "a MATLAB file of version 5 to 7"),
}
"""Reader of each kind of file, given all its bytes, its path and the rate, and the accepted content."""
