"""Demonstrations of whatever a caller has: arrays, tables, files, with or without times."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from numbers import Real
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.errors import FormatError, naming
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import (
    DIMENSIONS,
    MAX_COORDINATE,
    MAX_DURATION,
    Demonstration,
    DemonstrationError,
    checked_orientations,
    load_demonstrations,
    samples_of,
)
from dt_viz.learning.inspection import Inspection
from dt_viz.learning.preparation import DemonstrationWarning
from dt_viz.scenario.tasks import TASKS

Demonstrations: TypeAlias = (
    "Demonstration | ArrayLike | str | os.PathLike[str] | Mapping[str, Any] | Iterable[Any]"  # or a pandas.DataFrame
)
"""What `fit` learns from; see there."""
DURATION = 5.0  # duration of a take without times, seconds, as in files
UNTIMED = np.empty(0)  # times of a take without times, until it is known whether all have some
ACCEPTED = "arrays (T, 2) or (T, 3), metres, such as dt.fit([positions, …], rate=100)"


def example(name: str) -> tuple[Demonstration, ...]:
    """The demonstrations of a task that ships with DT-Viz, such as "push_box".

    Raises:
        FormatError: there is no such task; the message lists all.
    """
    if name not in list(TASKS):
        raise FormatError("example", repr(name), ", ".join(TASKS))
    return TASKS[name]().demonstrations


def demonstrations_of(given: Any, rate: float | None = None) -> tuple[Demonstration, ...]:  # noqa: ANN401 - see `fit`
    """Demonstrations of what was given to `fit`, checked, with names; `rate`, Hz, is that of what has no times.

    Raises:
        DataError: it is no demonstrations.
    """
    if rate is not None and not (isinstance(rate, Real) and 0 < float(rate) < np.inf):
        raise FormatError("rate", repr(rate)[:40], "samples a second, above 0")
    with naming(DemonstrationError, "demonstrations"):
        takes = list(_takes(given, rate))
        if not takes:
            raise FormatError("takes", "none", ACCEPTED)
        if any(take.times is UNTIMED for take in takes):
            text = f"no times and no rate: each take is taken as {DURATION:g} s long; rate=…, Hz, says otherwise"
            warnings.warn(text, DemonstrationWarning, stacklevel=3)
        named = [_complete(take, number) for number, take in enumerate(takes, 1)]
        pairs = zip(named, samples_of(named), strict=True)
        checked = tuple(_checked(take, *samples) for take, samples in pairs)
        farthest = np.array([np.abs(take.positions).max() for take in checked])
        if np.median(farthest) > MAX_COORDINATE or farthest.max() > 1e3 * MAX_COORDINATE:
            found = f"{farthest.max():.6g} m in {checked[int(farthest.argmax())].name!r}"
            accepted = f"metres, at most {MAX_COORDINATE:g} from the origin; of millimetres: positions / 1000"
            raise FormatError("positions", found, accepted)
        longest = max(checked, key=lambda take: take.duration)
        if longest.duration > MAX_DURATION:
            found = f"a duration of {longest.duration:.6g} s in {longest.name!r}; is it in milliseconds?"
            raise FormatError("times", found, f"seconds, at most {MAX_DURATION:g} from first to last")
    return checked


def _complete(take: Demonstration, number: int) -> Demonstration:
    times = np.linspace(0.0, DURATION, len(take.positions)) if take.times is UNTIMED else take.times
    return replace(take, times=times, name=take.name or f"take {number}")


def _checked(take: Demonstration, times: Array, positions: Array) -> Demonstration:
    """A take with its samples, and orientations that are unit quaternions."""
    turns = take.orientations
    turns = None if turns is None else checked_orientations(turns, len(times), f"orientations of {take.name!r}")
    return replace(take, times=times, positions=positions, orientations=turns)


def _takes(given: Any, rate: float | None) -> Iterator[Demonstration]:  # noqa: ANN401 - whatever was given
    """The takes in a value. Raises FormatError where it has none."""
    if isinstance(given, Demonstration):
        yield given
    elif isinstance(given, str | os.PathLike):
        yield from load_demonstrations(Path(given), rate=rate)
    elif hasattr(given, "columns"):
        yield from _of_table(given, rate)
    elif isinstance(given, Mapping):
        yield from (replace(take, name=str(name)) for name, value in given.items() for take in _takes(value, rate))
    elif _is_timed(given):
        yield Demonstration(given[0], given[1])
    elif not hasattr(given, "__array__") and isinstance(given, Iterable) and not _is_path(given := list(given)):
        for value in given:
            yield from _takes(value, rate)
    else:
        yield from _of_array(given, rate)


def _is_timed(given: Any) -> bool:  # noqa: ANN401 - whatever was given
    """Whether it is a pair of times (T,) and positions (T, d)."""
    if not (isinstance(given, tuple) and len(given) == 2):
        return False
    shapes = [np.shape(part) if hasattr(part, "__array__") or isinstance(part, Sequence) else () for part in given]
    return [len(shape) for shape in shapes] == [1, 2]


def _is_path(given: Sequence[Any]) -> bool:
    """Whether it is the points of one motion, such as [(0, 0), (0.1, 0), …], or a single point."""
    numbers = (int, float, np.number)
    return bool(given) and all(
        isinstance(point, numbers)
        or (isinstance(point, Sequence | np.ndarray) and len(point) and isinstance(point[0], numbers))
        for point in given
    )


def _of_array(given: Any, rate: float | None) -> Iterator[Demonstration]:  # noqa: ANN401 - whatever was given
    try:
        array = np.asarray(given)
    except ValueError as error:
        raise FormatError("positions", "points of different dimension", ACCEPTED) from error
    if array.dtype == object and array.ndim and len(array) and hasattr(array[0], "__len__"):
        for value in array:  # an array of arrays, or of their rows
            yield from _takes(value if array.ndim == 1 else value.tolist(), rate)
        return
    if array.dtype.kind not in "fiu":
        said = isinstance(given, str | bool | None)
        what = repr(given)[:40] if said else f"{array.dtype} values of type {type(given).__name__}"
        raise FormatError("positions", what, ACCEPTED)
    if array.ndim not in (2, 3) or array.shape[-1] not in DIMENSIONS:
        raise FormatError("positions", f"an array of shape {array.shape}", f"{ACCEPTED}{_way_out(array)}")
    for positions in array[None] if array.ndim == 2 else array:
        yield Demonstration(_times(len(positions), rate), positions)


def _way_out(array: Array) -> str:
    if array.ndim == 2 and array.shape[0] in DIMENSIONS:
        return "; if each row is a coordinate: positions.T"
    if array.ndim in (2, 3) and array.shape[-1] == 4:
        return "; if the first column is time: dt.Demonstration(a[:, 0], a[:, 1:])"
    if array.ndim in (2, 3) and array.shape[-1] in (5, 6, 7):
        return "; of joint angles: positions = arm.end_effector(q), of poses: a[:, :3], orientations=a[:, 3:]"
    return ""


def _times(num: int, rate: float | None) -> Array:
    """Times (T,) at a rate, Hz; without one, times to come."""
    return UNTIMED if rate is None else np.arange(num) / rate


def _of_table(table: Any, rate: float | None) -> Iterator[Demonstration]:  # noqa: ANN401 - a pandas.DataFrame
    """Takes of a table with columns x, y, perhaps z, t and demo."""
    names = {str(name).strip().lower(): name for name in table.columns}
    axes = [names[axis] for axis in "xyz" if axis in names]
    if not {"x", "y"} <= set(names):
        raise FormatError("columns", ", ".join(map(str, table.columns))[:80], "x, y and perhaps z, t and demo")
    columns = [np.asarray(table[axis]) for axis in axes]
    if any(column.dtype.kind not in "fiu" for column in columns):
        raise FormatError("columns", "x, y or z with text", "numbers, metres")
    positions = np.column_stack(columns)
    times = next((np.asarray(table[names[name]]) for name in ("t", "time", "timestamp") if name in names), None)
    if times is not None and times.dtype.kind == "M":
        times = (times - times[0]) / np.timedelta64(1, "s")
    labels = np.asarray(table[names["demo"]]).astype(str) if "demo" in names else np.full(len(positions), "")
    for label in dict.fromkeys(labels.tolist()):
        rows = labels == label
        yield Demonstration(_times(int(rows.sum()), rate) if times is None else times[rows], positions[rows], label)


def check_goals(inspections: Sequence[Inspection], labels: Sequence[float] | None) -> None:
    """Raise FormatError where all takes with a label were left out: it has a goal of its own."""
    if labels is None or len(labels) != len(inspections):
        return
    kept = dict.fromkeys(labels, False)
    for inspection, label in zip(inspections, labels, strict=True):
        kept[label] |= inspection.kept
    if not all(kept.values()):
        lost = next(label for label in kept if not kept[label])
        accepted = "labels of motions to one goal; learn the takes to each goal by themselves, with goal=… if need be"
        raise FormatError("labels", f"{lost!r} for takes that end elsewhere than the others", accepted)
