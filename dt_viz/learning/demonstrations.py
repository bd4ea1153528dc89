"""Demonstrations: recorded motions, their checks, and their files.

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

from dt_viz.errors import DataError, FormatError, naming, parsing
from dt_viz.files.checks import check_at_most, check_finite, checked_suffix, read_bytes, real_numbers, too_many
from dt_viz.files.npz import NpzFile
from dt_viz.files.text import decimal_numbers, read_table
from dt_viz.learning.matfile import Value, read_variable

DIMENSIONS = (2, 3)
MAX_BYTES = 16 * 2**20
"""Largest number of bytes of a file, and of what an npz unpacks to; some 300,000 samples."""
MAX_CSV_ROWS = 600_000
MAX_DEMONSTRATIONS = 1000
MAX_NAME = 1000
"""Largest number of characters of a name."""
CSV_HEADERS = (("demo", "t", "x", "y"), ("demo", "t", "x", "y", "z"), ("t", "x", "y"), ("t", "x", "y", "z"))
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


def load_demonstrations(path: str | Path) -> tuple[Demonstration, ...]:
    """Read the demonstrations of a file (CSV, npz, LASA .mat) or of a folder of CSV files.

    Args:
        path: the file, whose suffix says what it is (see the module's docstring), or the folder.

    Raises:
        DemonstrationError: there is no such file or folder, it cannot be read, is not what its suffix says, or holds
            demonstrations that :func:`check_demonstrations` refuses. Nothing else is raised, whatever the file holds.
    """
    path = Path(path)
    with parsing(DemonstrationError, path, "path", "a readable file or folder"):
        if path.is_dir():
            return _load_csv_folder(path)
        if not path.exists():
            raise FormatError("path", "no such file or folder", "a readable file or folder")
        content = read_bytes(path, MAX_BYTES)
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
    with naming(DemonstrationError, source):
        read, accepted = _READERS[checked_suffix(content, source, _READERS, MAX_BYTES)]
    with parsing(DemonstrationError, source, "file", accepted):
        demonstrations, lines = read(content, source.stem)
    return check_demonstrations(demonstrations, source, lines)


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
    files = {path.stem: path for path in _files_of(Path(folder), ".mat")}
    if not files:
        raise DemonstrationError(folder, "folder", "no .mat file", "one .mat file per shape")
    return files


def _files_of(folder: Path, *suffixes: str) -> list[Path]:
    """Return the visible files of a folder with one of these suffixes, by name."""
    with parsing(DemonstrationError, folder, "folder", "a readable folder"):
        files = sorted(path for path in folder.iterdir() if path.is_file() and not path.name.startswith("."))
        return [path for path in files if path.suffix.lower() in suffixes]


def _load_csv_folder(folder: Path) -> tuple[Demonstration, ...]:
    if others := _files_of(folder, ".npz", ".mat"):
        raise FormatError("folder", f"{others[0].name!r}", "only .csv files; load other files one by one")
    tables = _files_of(folder, ".csv")
    if not tables:
        raise FormatError("folder", "no .csv file", "one or more .csv files")
    return check_demonstrations([demo for path in tables for demo in load_demonstrations(path)], folder)


Read = tuple[list[Demonstration], "list[array[int]] | None"]
"""Demonstrations of a file before they are checked, and for each the lines of its samples in a text file."""


def _read_csv(content: bytes, stem: str) -> Read:
    samples: dict[str, array[float]] = {}
    lines: dict[str, array[int]] = {}
    header, rows = read_table(content, CSV_HEADERS, max_rows=MAX_CSV_ROWS)
    columns = [name for name in header if name != "demo"]
    for line, row in rows:
        label = stem if len(row) == len(columns) else row[0]
        if label not in samples:
            if len(samples) == MAX_DEMONSTRATIONS:
                raise too_many("demonstrations", MAX_DEMONSTRATIONS)
            samples[label], lines[label] = array("d"), array("q")
        samples[label].extend(decimal_numbers(row[-len(columns) :], line))
        lines[label].append(line)
    tables = {label: np.asarray(numbers).reshape(-1, len(columns)) for label, numbers in samples.items()}
    demonstrations = [Demonstration(table[:, 0], table[:, 1:], label) for label, table in tables.items()]
    return demonstrations, list(lines.values())


def _read_npz(content: bytes, stem: str) -> Read:
    archive = NpzFile(content, max_bytes=MAX_BYTES)
    accepted = "times_0, positions_0, times_1, positions_1, … and optionally name_0, name_1, …"
    numbers = set()
    for key in archive.names:
        match = re.fullmatch(r"(?:times|positions|name)_(0|[1-9][0-9]{0,8})", key)
        if match is None:
            raise FormatError("arrays", repr(key[:40]), accepted)
        numbers.add(int(match[1]))

    def read(key: str) -> np.ndarray:
        if key not in archive.names:
            raise FormatError("arrays", f"no {key!r}", accepted)
        return archive.read(key)

    demonstrations = []
    for i in sorted(numbers):
        name = f"{stem} {i}"
        if f"name_{i}" in archive.names:
            text = archive.read(f"name_{i}")
            if text.dtype.kind != "U" or text.ndim:
                raise FormatError(f"name_{i}", f"{text.dtype} of shape {text.shape}", "one string")
            name = str(text)
        times, positions = (read(key) for key in (f"times_{i}", f"positions_{i}"))
        demonstrations.append(Demonstration(times, positions, name))
    return demonstrations, None


def _read_lasa(content: bytes, stem: str) -> Read:
    accepted = "a cell array of structures with t and pos"
    try:
        recordings = read_variable(content, "demos")
    except KeyError as error:
        raise FormatError("variable 'demos'", "no such variable", accepted) from error
    if not isinstance(recordings, list):
        raise FormatError("variable 'demos'", "no cells", accepted)
    demonstrations = []
    for i, recording in enumerate(recordings):
        times, positions = (_lasa_field(recording, field, f"demos{{{i + 1}}}.{field}") for field in ("t", "pos"))
        if times.ndim != 2 or 1 not in times.shape:
            raise FormatError(f"demos{{{i + 1}}}.t", f"an array of shape {times.shape}", "1×T")
        demonstrations.append(Demonstration(times.ravel(), positions.T * METRES_PER_LASA_UNIT, f"{stem} {i}"))
    return demonstrations, None


def _lasa_field(recording: Value, field: str, where: str) -> np.ndarray:
    fields = recording[0] if isinstance(recording, list) and len(recording) == 1 else recording
    if not isinstance(fields, dict) or field not in fields:
        raise FormatError(where, "no such field", "a structure with t (1×T) and pos (d×T)")
    numbers = fields[field]
    if not isinstance(numbers, np.ndarray):
        raise FormatError(where, "something else than numbers", "a matrix of real numbers")
    return real_numbers(numbers, where)


_READERS: dict[str, tuple[Callable[[bytes, str], Read], str]] = {
    ".csv": (_read_csv, "comma-separated text in UTF-8"),
    ".npz": (_read_npz, "an npz archive of plain numbers; pickled objects are never opened"),
    ".mat": (_read_lasa, "a MATLAB file of version 5 to 7"),
}
"""Reader of each kind of file, given all its bytes and the stem of its name, and the accepted content."""
