"""Takes of files: times, places or joint angles, and orientations, found in the tables that the readers give."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.archives import read_hdf5, read_json, read_mat, read_npy, read_npz, read_parquet
from dt_viz.files.bags import read_bag
from dt_viz.files.checks import check_at_most, checked_suffix, real_numbers
from dt_viz.files.columns import MAX_TURN, UNITS, Layout, expanded, is_kind, layout, numbered, role_of, unit_of, unnamed
from dt_viz.files.tables import LIMITS, ReadOptions, Table, at_sample, read_text

UNTIMED = 5.0  # duration of a take without times or rate, seconds
MAX_REACH = 10.0
"""Coordinate beyond any arm's reach, metres: larger ones are centimetres, or millimetres from ten times as much."""
MAX_DURATION, SLOW = 120.0, 0.5
"""Duration and step in seconds beyond which times are taken to be in a smaller unit."""
USUAL_RATE = 100.0  # rate in Hz that decides between the units of such times: the nearest is taken


@dataclass(frozen=True, eq=False)
class Take:
    """One recorded motion of the hand, or of an arm's joints, before it is checked; its units may be others."""

    name: str
    times: np.ndarray  # (T,), seconds from any start
    positions: np.ndarray | None  # (T, d), metres, d is 2 or 3; None for motions of joints
    orientations: np.ndarray | None
    """(T, 4) unit quaternions wxyz, each in the hemisphere of the one before."""
    joints: np.ndarray | None  # (T, n), rad
    joint_names: tuple[str, ...]
    units: dict[str, float]
    """Sizes of the units of "length", "time" and "angle", as far as the file says."""
    is_timed: bool = True  # whether the file has its times or its rate
    place: Callable[[int], str] = at_sample
    """Describes the place of a sample in the file, for messages."""

    @property
    def values(self) -> np.ndarray:
        """Places (T, d) or joint angles (T, n)."""
        values = self.joints if self.positions is None else self.positions
        return np.empty((0, 3)) if values is None else values


Rows = slice | np.ndarray
Reader = Callable[[Path, ReadOptions], Iterator[Table]]
TEXT = "text in UTF-8: a header with t, x, y and perhaps z, and a line of numbers for each sample"
BAG = "a bag with poses, transforms or joint states"
READERS: Mapping[str, tuple[Reader, str]] = {
    ".csv": (read_text, TEXT),
    ".tsv": (read_text, TEXT),
    ".txt": (read_text, TEXT),
    ".dat": (read_text, TEXT),
    ".npz": (read_npz, "an npz archive of plain numbers; pickled objects are never opened"),
    ".npy": (read_npy, "an array (T, d) or (N, T, d) of plain numbers; pickled objects are never opened"),
    ".mat": (read_mat, "a MATLAB file of version 5 to 7"),
    ".json": (read_json, "JSON: lists of numbers, or records with times and positions"),
    ".parquet": (read_parquet, "a Parquet table"),
    ".h5": (read_hdf5, "an HDF5 file"),
    ".hdf5": (read_hdf5, "an HDF5 file"),
    ".mcap": (read_bag, BAG),
    ".db3": (read_bag, BAG),
    ".bag": (read_bag, BAG),
}
"""Reader of each kind of file, and what such a file is accepted as."""


def read_takes(path: Path, options: ReadOptions) -> tuple[list[Take], tuple[str, ...]]:
    """Read the takes of a file, in its units; `in_si_units` changes these over all files.

    Its suffix says what it is, the stem names takes that have no name. Returns also notes on what was chosen or is not
    used.

    Raises:
        FormatError: it is none of `READERS`, too large, or there are no takes in it.
        Exception: of almost any kind, on hostile bytes.
    """
    suffix = checked_suffix(path.stat().st_size, path, READERS, LIMITS.bytes)
    return takes_of(READERS[suffix][0](path, options), options)


def takes_of(tables: Iterable[Table], options: ReadOptions) -> tuple[list[Take], tuple[str, ...]]:
    """Find the takes in the tables of a file; see `read_takes`."""
    if options.rate is not None and not 0 < options.rate < np.inf:
        raise FormatError("rate", f"{options.rate:g}", "samples per second, above 0")
    given = _given_units(options.unit)
    takes: list[Take] = []
    notes: dict[str, None] = {}
    total = 0
    for table in tables:
        for take in _split(table, options, notes):
            takes.append(replace(take, units=take.units | given))
            total += len(take.times) * (8 if take.orientations is not None else 4)
            check_at_most("takes", total, LIMITS.numbers, "numbers")
    return takes, tuple(notes)


def _given_units(text: str | None) -> dict[str, float]:
    units = {}
    for word in (text or "").replace(",", " ").split():
        if not (name := unit_of(word)):
            raise FormatError("unit", repr(word), f"{', '.join(UNITS)}, or several of them, such as 'mm,ms'")
        units |= [UNITS[name]]
    return units


def _split(table: Table, options: ReadOptions, notes: dict[str, None]) -> Iterator[Take]:
    """Takes of a table, in its own units."""
    columns = _named_columns(table, options)
    found = layout([*columns], table.unused, options.joint_names)
    if others := [name for name in (*columns, *table.unused) if name not in {*found.used, "name", ""}]:
        notes[f"columns {', '.join(others)[:200]} are not used"] = None
    units = _units_of(found) | table.units
    names = found.positions or found.joints
    length = len(columns[names[0]])
    times = _times(columns, found, options)
    rate = _rate(columns, found, options) if times is None else None
    is_timed = times is not None or rate is not None
    if not is_timed:
        notes[
            f"no times and no rate: each demonstration takes {UNTIMED:g} s, evenly sampled; rate=… says otherwise"
        ] = None
    groups = [("", slice(0, length))]
    if found.label and columns[found.label].shape == (length,):
        groups = _labelled(columns[found.label], table.labels)
    elif times is not None and len(times) == length:
        groups = _by_time(times)
    for k, (label, rows) in enumerate(groups):
        name = label or (f"{table.name} {k}" if len(groups) > 1 else table.name)
        values = _stacked(columns, names, rows)
        turns = _stacked(columns, found.orientations, rows) if found.orientations else None
        if turns is not None and (turns := _unit_quaternions(turns)) is None:
            unused = ", ".join(name for name in columns if name in found.orientations)
            notes[f"columns {unused} are not used: some of their quaternions have another length than 1"] = None
        seconds = np.arange(len(values)) / (rate or max(len(values) - 1, 1) / UNTIMED) if times is None else times
        seconds = seconds[rows] if len(seconds) == length else seconds
        place = _placing(table.place, rows)
        if found.positions:
            yield Take(name, seconds, values, turns, None, (), units, is_timed, place)
        else:
            yield Take(name, seconds, None, None, values, found.joint_names, units, is_timed, place)


def _named_columns(table: Table, options: ReadOptions) -> dict[str, np.ndarray]:
    """Columns (T,) of a table by their names, those first that the options name."""
    columns: dict[str, np.ndarray] = {}
    for name, values in table.columns.items():
        if name:
            columns |= expanded(name, values)
            continue
        rated = options.rate is not None or any(is_kind(other, "time") for other in table.columns)
        how = {"rated": rated, "timed": table.is_text, "asks": options.asks}
        width = values.shape[1]
        names = options.names or (numbered(width) if options.roles else unnamed(values, options.num_joints, **how))
        if len(names) != width:
            raise FormatError("columns", f"{len(names)} names for {width} columns", "a name for each")
        columns |= {name: values[:, k] for k, name in enumerate(names)}
    lower, taken = {name.lower(): name for name in columns}, {name.lower() for name in options.roles.values()}
    if missing := [name for name in options.roles.values() if name.lower() not in lower]:
        raise FormatError("columns", f"no {missing[0]!r} in {','.join(columns)[:160]!r}", "names of the file's columns")
    chosen = {role: columns[lower[name.lower()]] for role, name in options.roles.items()}
    columns = {name: values for name, values in columns.items() if name.lower() not in taken}
    return chosen | {name: values for name, values in columns.items() if name not in chosen}


def _stacked(columns: Mapping[str, np.ndarray], names: Sequence[str], rows: Rows) -> np.ndarray:
    """Columns (T, k) of some rows."""
    for name in names:
        if columns[name].dtype.kind not in "iuf":
            raise FormatError(f"column {name!r}", f"values of type {columns[name].dtype}", "integers or real numbers")
        if columns[name].shape != columns[names[0]].shape:
            found = f"{len(columns[name])} values beside {len(columns[names[0]])}"
            raise FormatError(f"column {name!r}", found, "columns of one length")
    return np.stack([columns[name][rows] for name in names], axis=1, dtype=np.float64)


def _units_of(found: Layout) -> dict[str, float]:
    """Sizes of the units that the names of columns end in."""
    units: dict[str, float] = {}
    for kind, size in (UNITS[unit] for unit in found.units if unit):
        if units.setdefault(kind, size) != size:
            raise FormatError("columns", f"several units of one {kind}", "one unit for each kind of quantity")
    return units


def _times(columns: Mapping[str, np.ndarray], found: Layout, options: ReadOptions) -> np.ndarray | None:
    """Times of a table in its unit, None if it has none."""
    if not found.time:
        return None
    if options.rate is not None:
        raise FormatError("rate", f"{options.rate:g} beside a column of times", "either times or a rate")
    times = real_numbers(columns[found.time], "times")
    times = times.ravel() if times.size == max(times.shape, default=0) else times
    if times.ndim != 1:
        raise FormatError("times", f"an array of shape {times.shape}", "shape (T,)")
    if found.fraction and len(times):
        nanoseconds = real_numbers(columns[found.fraction], found.fraction)
        if nanoseconds.max() < 1e9:  # else they count from the same moment as the seconds
            times = times - times[0] + 1e-9 * nanoseconds
    return times


def _rate(columns: Mapping[str, np.ndarray], found: Layout, options: ReadOptions) -> float | None:
    """Rate that is given or in the file, Hz."""
    rate = options.rate
    if rate is None and found.rate and columns[found.rate].size:
        rate = float(columns[found.rate].flat[0])
        role = role_of(found.rate)
        if rate and role is not None and role.group == ("dt",):
            rate = 1 / (rate * UNITS[role.unit or "s"][1])
    return rate if rate is not None and 0 < rate < np.inf else None


def _labelled(labels: np.ndarray, names: Sequence[str]) -> list[tuple[str, Rows]]:
    """Rows of each label, in the order in which labels appear."""
    values, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return [(names[int(values[k])] if names else f"{values[k]}", np.flatnonzero(inverse == k)) for k in order]


def _by_time(times: np.ndarray) -> list[tuple[str, Rows]]:
    """Rows of takes that follow each other: times go back to about where the take began."""
    cuts = [0]
    for row in np.flatnonzero(np.diff(times) < 0) + 1:
        begin, end = times[cuts[-1]], times[row - 1]
        if row - cuts[-1] > 1 and times[row] <= begin + 0.1 * (end - begin):
            cuts.append(int(row))
    if len(cuts) > 1 and len(times) - cuts[-1] < 2:
        cuts.pop()
    return [("", slice(*pair)) for pair in zip(cuts, [*cuts[1:], len(times)], strict=True)]


def _placing(place: Callable[[int], str], rows: Rows) -> Callable[[int], str]:
    """Describe the place of a sample by that of its row."""
    return (lambda row: place(row + rows.start)) if isinstance(rows, slice) else (lambda row: place(int(rows[row])))


def _unit_quaternions(turns: np.ndarray) -> np.ndarray | None:
    """Unit quaternions (T, 4) that do not jump between q and −q; None if these are no quaternions."""
    norms = np.linalg.norm(turns, axis=1, keepdims=True)
    if not (np.abs(norms - 1) < 0.1).all():
        return None
    turns = turns / norms
    turns[1:] *= np.cumprod(np.where((turns[1:] * turns[:-1]).sum(axis=1) < 0, -1.0, 1.0))[:, None]
    return turns


def in_si_units(takes: Sequence[Take], num_joints: int | None = None) -> tuple[list[Take], str]:
    """Bring takes of one or several files into metres, seconds and radians; changes them, and gives a note on units.

    Units that the files do not say are recognised over all takes: coordinates beyond any arm's reach, steps in time
    that no recorder has, and angles of more than two turns are in smaller units. Angles are the first columns, one for
    each of an arm's joints; None is all.
    """
    recognised = {}
    lengths = [take.positions for take in takes if take.positions is not None and "length" not in take.units]
    angles = [take.joints[:, :num_joints] for take in takes if take.joints is not None and "angle" not in take.units]
    times = [take.times for take in takes if len(take.times) > 1 and "time" not in take.units]
    largest, widest = _largest(lengths), _largest(angles)
    if largest > MAX_REACH:
        recognised["length"] = "mm" if largest > 10 * MAX_REACH else "cm"
    if widest > MAX_TURN:
        recognised["angle"] = "deg"
    step = np.median([np.median(np.diff(t)) for t in times]) if times else 0.0
    if step > SLOW and max(t[-1] - t[0] for t in times) > MAX_DURATION:
        ratios = {unit: UNITS[unit][1] * step * USUAL_RATE for unit in ("ms", "us", "ns")}
        recognised["time"] = min(ratios, key=lambda unit: abs(np.log(ratios[unit])))
    guessed = {kind: UNITS[unit][1] for kind, unit in recognised.items()}
    note = f"taken as in {' and '.join(recognised.values())} by its size; unit=… says otherwise" if recognised else ""
    return [_scaled(take, guessed | take.units) for take in takes], note


def _largest(arrays: Sequence[np.ndarray]) -> float:
    return max((float(max(-array.min(), array.max())) for array in arrays if array.size), default=0.0)


def _scaled(take: Take, units: Mapping[str, float]) -> Take:
    if take.positions is not None and units.get("length", 1.0) != 1.0:
        np.multiply(take.positions, units["length"], out=take.positions)
    if take.joints is not None and units.get("angle", 1.0) != 1.0:
        np.multiply(take.joints, units["angle"], out=take.joints)
    size = units.get("time", 1.0)
    times = take.times if size == 1.0 else (take.times - take.times[:1]) * size
    return replace(take, times=times, units={"length": 1.0, "time": 1.0, "angle": 1.0})
