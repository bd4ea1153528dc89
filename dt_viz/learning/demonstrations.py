"""Demonstrations: recorded motions and their checks. `dt_viz.files.takes` reads their files.

They are saved as npz, seconds and metres, for i = 0, 1, 2, …: ``times_i`` (T,), ``positions_i`` (T, d), and optionally
``orientations_wxyz_i`` (T, 4) and ``name_i``, a string.
"""

import io
import logging
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from dt_viz.errors import DataError, FormatError, naming, parsing
from dt_viz.files.checks import check_at_most, check_finite, real_numbers
from dt_viz.files.folders import accepted_as, files_of, parts_of, read_part
from dt_viz.files.tables import ReadOptions, at_sample
from dt_viz.files.takes import READERS, Take, in_si_units
from dt_viz.flows.rotations import turned

logger = logging.getLogger(__name__)

DIMENSIONS = (2, 3)
MAX_DEMONSTRATIONS = 1000
MAX_NAME = 1000  # largest number of characters of a name
MAX_COORDINATE, MAX_DURATION = 100.0, 3600.0
"""Largest coordinate (m) and duration (s); numbers beyond them are in another unit."""
MIN_EXTENT = 1e-6  # smallest extent of a motion, metres; a smaller one is a point
Found = tuple[Path, Sequence[Take], Sequence[str]]  # a file, its takes, and notes about them
Places = Sequence[Callable[[int], str]]
"""For each demonstration, what describes the place of a sample in its file."""


@dataclass(frozen=True, eq=False)
class Demonstration:
    """One recorded motion. Compared and hashed by identity.

    Attributes:
        times: shape ``(T,)``, seconds, strictly increasing from 0.
        positions: shape ``(T, d)``, metres, d is 2 or 3, in the frame of the task.
        name: name on the page and in messages.
        orientations: shape ``(T, 4)``, unit quaternions wxyz of the hand, where the data have them.
    """

    times: np.ndarray
    positions: np.ndarray
    name: str = ""
    orientations: np.ndarray | None = None

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
        turns = "" if self.orientations is None else " with orientations"
        return f"Demonstration({self.name!r}: {shape} positions{turns}, metres{duration})"


class DemonstrationError(DataError):
    """A demonstration that cannot be used."""


class ForwardKinematics(Protocol):
    """What turns joint angles into places of the hand, such as `dt_viz.robot.robot.Robot`.

    Two members are optional: `hand_orientation(q)`, the orientations (T, 4) of the hand, unit quaternions wxyz, and
    `base`, the rotation (3, 3) from the frame of the arm's base to the frame of these places and orientations.
    """

    @property
    def joint_names(self) -> Sequence[str]:
        """Names of the n joints, from the base to the hand."""
        ...

    def end_effector(self, q: np.ndarray) -> np.ndarray:
        """Compute the positions (T, 3) of the hand, metres, at joint angles q (T, n), rad."""
        ...


def check_demonstrations(
    demonstrations: Sequence[Demonstration], source: str | Path, places: Places | None = None
) -> tuple[Demonstration, ...]:
    """Check recorded motions and bring them into the one form that the rest of the program trusts.

    Every loader ends here; motions recorded in memory, of any real number type and from any time on, do as well.
    The source, a file or recording, is for messages, and so is, for each demonstration, what describes the place of a
    sample in it; without `places`, samples are counted from 1.

    Returns the same motions with times from 0, as read-only float64 arrays.

    Raises:
        DemonstrationError: there are none, or too many; they differ in dimension; or one of them has not the shapes,
            the number of samples, the finite values or the increasing times that :class:`Demonstration` promises, does
            not move, has values so large that its unit must be another one, or a name that cannot be shown.
    """
    with naming(DemonstrationError, source):
        check_at_most("demonstrations", len(demonstrations), MAX_DEMONSTRATIONS)
        checked = []
        for demonstration, (times, positions) in zip(demonstrations, samples_of(demonstrations, places), strict=True):
            name, orientations = demonstration.name, demonstration.orientations
            if len(name) > MAX_NAME or re.search("[\ud800-\udfff]", name):  # a page cannot be sent half a character
                raise FormatError("name", repr(name[:40]), f"text of at most {MAX_NAME} characters")
            where = at_sample if places is None else places[len(checked)]
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
            if orientations is not None:
                orientations = checked_orientations(orientations, len(times), f"orientations of {name!r}", where)
            times.setflags(write=False)
            positions.setflags(write=False)
            checked.append(Demonstration(times, positions, name, orientations))
    return tuple(checked)


def samples_of(
    demonstrations: Sequence[Demonstration], places: Places | None = None
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the times (T,) from 0 and the positions (T, d) of demonstrations as new float64 arrays.

    Raises:
        FormatError: there are none, they differ in dimension, or one of them has not the shapes, the number of samples,
            the finite values or the increasing times that :class:`Demonstration` promises. It says where by `places`,
            as :func:`check_demonstrations` does.
    """
    if not demonstrations:
        raise FormatError("demonstrations", "none", "at least one")
    samples = []
    for i, demonstration in enumerate(demonstrations):
        name, where = demonstration.name, at_sample if places is None else places[i]
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


def checked_orientations(
    orientations: np.ndarray, num: int, field: str = "orientations", where: Callable[[int], str] = at_sample
) -> np.ndarray:
    """Return unit quaternions (T, 4) as a new read-only array; raise FormatError if they are none."""
    turns = real_numbers(orientations, field)
    if turns.shape != (num, 4):
        raise FormatError(field, f"an array of shape {turns.shape}", f"quaternions wxyz, ({num}, 4)")
    check_finite(turns, field, where)
    lengths = np.linalg.norm(turns, axis=1, keepdims=True)
    if not lengths.all():
        raise FormatError(field, f"a zero {where(int(lengths.argmin()))}", "unit quaternions wxyz")
    turns /= lengths
    turns.setflags(write=False)
    return turns


def load_demonstrations(
    path: str | Path | Sequence[str | Path],
    *,
    rate: float | None = None,
    unit: str | None = None,
    columns: str | Sequence[str] | Mapping[str, str] | None = None,
    topic: str | None = None,
    arm: ForwardKinematics | None = None,
) -> tuple[Demonstration, ...]:
    """Read the demonstrations of files and folders: tables of text, arrays, MATLAB, JSON, Parquet, HDF5, ROS bags.

    Columns, or named arrays, are found by their names (``t``, ``time_ms``, ``stamp.sec``; ``x``, ``pos_x``,
    ``pose.position.x``, ``tool0 x``; ``qx``, ``ori.w``; ``joint1``; ``demo``, ``episode_index``), units by their sizes.
    Takes in one file are told apart by labels, or by times that begin again. Log lines say what was recognised and
    what is not used.

    Args:
        path: a file, whose suffix says what it is; a folder, of which every such file is read in the order of their
            names (or a LeRobot data set, or a ROS bag); or several of them.
        rate: samples per second (Hz) of takes without times; None takes them as 5 s long.
        unit: units of lengths, times and angles, such as "mm" or "cm,ms,deg"; None recognises them.
        columns: names of the columns in their order, such as "t,x,y,z", or the columns to use by what they are,
            such as ``{"x": "column", "y": "other"}``; None finds them.
        topic: topic of a bag, or frame of its transforms; None takes the only one with poses.
        arm: what turns joint angles into places of the hand, and into orientations if it has `hand_orientation`: an
            arm, or any :class:`ForwardKinematics`. Places in space are taken as in the frame of its base.

    Raises:
        DemonstrationError: there is no such file or folder, it cannot be read, is not what its suffix says, needs a
            package that is not installed, has columns that are not clear, or holds demonstrations that
            :func:`check_demonstrations` refuses; or there are times beside a rate, or joint angles without an arm.
    """
    options = ReadOptions(rate, unit, columns, topic, () if arm is None else tuple(arm.joint_names))
    sources = [Path(path)] if isinstance(path, str | Path) else [*map(Path, path)]
    found = [read for source in sources for read in _found_in(source, options)]
    return demonstrations_of(found, ", ".join(map(str, sources))[:200], arm)


def demonstrations_of(
    found: Sequence[Found], source: str | Path, arm: ForwardKinematics | None = None
) -> tuple[Demonstration, ...]:
    """Make demonstrations of the takes of one or several files; log lines say what was recognised or is not used.

    For each file its path, its takes and notes about them are given, as `read_takes` gives them; the source, all files
    or their folder, is for messages. Raises as :func:`load_demonstrations`.
    """
    said: dict[str, list[Path]] = {}
    for path, _, notes in found:
        for note in notes:
            said.setdefault(note, []).append(path)
    for note, paths in said.items():
        logger.warning("%s%s: %s", paths[0], f" and {len(paths) - 1} more" * (len(paths) > 1), note)
    with parsing(DemonstrationError, source, "takes", "recorded motions"):
        takes, note = in_si_units(
            [take for _, some, _ in found for take in some], None if arm is None else len(arm.joint_names)
        )
        takes = [_in_frame_of(take, arm) for take in takes]
        if note:
            logger.warning("%s: %s", source, note)
        check_at_most("demonstrations", len(takes), MAX_DEMONSTRATIONS)
        kinds = {take.positions is None: take.name for take in takes}
        if len(kinds) > 1:
            what = f"joint angles in {kinds[True]!r} but places of the hand in {kinds[False]!r}"
            raise FormatError("columns", what, "one kind for all")
    demonstrations: list[Demonstration] = []
    for path, some, _ in found:
        mine, takes = takes[: len(some)], takes[len(some) :]
        with parsing(DemonstrationError, path, "takes", "recorded motions"):
            given = [_of_hand(take, arm) for take in mine]
        demonstrations += check_demonstrations(given, path, [take.place for take in mine])
    with naming(DemonstrationError, source):
        if not demonstrations:
            raise FormatError("demonstrations", "none", "at least one")
        first = demonstrations[0]
        if others := [d for d in demonstrations if d.dimension != first.dimension]:
            what = f"{first.dimension} in {first.name!r} but {others[0].dimension} in {others[0].name!r}"
            raise FormatError("dimension", what, "one dimension for all")
    return tuple(demonstrations)


def _found_in(path: Path, options: ReadOptions) -> list[Found]:
    with parsing(DemonstrationError, path, "path", "a readable file or folder"):
        if not path.exists():
            raise FormatError("path", "no such file or folder", "a readable file or folder")
        if not (parts := parts_of(path)):
            raise FormatError("folder", "no file of recorded motions", f"files of the kinds {', '.join(READERS)}")
    found: list[Found] = []
    for part in parts:
        with parsing(DemonstrationError, part, "file", accepted_as(part)):
            found.append((part, *read_part(part, options)))
    return found


def _in_frame_of(take: Take, arm: ForwardKinematics | None) -> Take:
    """Turn what was recorded in the frame of an arm's base to the frame that the arm is used in."""
    base: np.ndarray = np.eye(3) if arm is None else getattr(arm, "base", np.eye(3))
    if take.positions is None or take.positions.shape[1] != len(base) or np.array_equal(base, np.eye(3)):
        return take
    wxyz = None if take.orientations is None else turned(base, take.orientations)
    return replace(take, positions=take.positions @ base.T, orientations=wxyz)


def _of_hand(take: Take, arm: ForwardKinematics | None) -> Demonstration:
    """Make a demonstration of the hand, perhaps by an arm's kinematics: with orientations if the arm computes them."""
    if take.joints is None or take.positions is not None:
        return Demonstration(take.times, take.values, take.name, take.orientations)
    q, names = take.joints, take.joint_names
    found = f"angles of {q.shape[1]} joints ({', '.join(names)[:160]})"
    if arm is None:
        accepted = "places of the hand, x, y and perhaps z; or name the arm that turns angles into such: arm=…"
        raise FormatError(f"columns of {take.name!r}", found, accepted)
    wanted = list(arm.joint_names)
    check_finite(q, f"joints of {take.name!r}", take.place)
    if set(wanted) <= set(names):
        q = q[:, [names.index(name) for name in wanted]]
    elif len(names) in (len(wanted), len(wanted) + 1):  # the last one may be a gripper
        q = q[:, : len(wanted)].copy()
    else:
        accepted = f"those of the arm's {len(wanted)} ({', '.join(wanted)[:160]}), and perhaps a gripper's behind them"
        raise FormatError(f"columns of {take.name!r}", found, accepted)
    orientation = getattr(arm, "hand_orientation", None)
    return Demonstration(take.times, arm.end_effector(q), take.name, None if orientation is None else orientation(q))


def save_demonstrations(path: str | Path | io.BytesIO, demonstrations: Sequence[Demonstration]) -> None:
    """Write demonstrations as npz, to a path or a buffer; see the module's docstring."""
    arrays: dict[str, Any] = {}
    for i, demonstration in enumerate(demonstrations):
        for field in ("times", "positions", "name"):
            arrays[f"{field}_{i}"] = np.asarray(getattr(demonstration, field))
        if demonstration.orientations is not None:
            arrays[f"orientations_wxyz_{i}"] = demonstration.orientations
    np.savez_compressed(path, **arrays)


def as_npz(demonstrations: Sequence[Demonstration]) -> bytes:
    """Return the npz file of demonstrations; see the module's docstring."""
    file = io.BytesIO()
    save_demonstrations(file, demonstrations)
    return file.getvalue()


def as_csv(demonstrations: Sequence[Demonstration]) -> bytes:
    """Return a table with columns demo, t, x, y and perhaps z, seconds and metres, of demonstrations without turns."""
    lines = [",".join(("demo", "t", *"xyz"[: demonstrations[0].dimension]))]
    for each in demonstrations:
        for row in np.column_stack([each.times, each.positions]):
            lines.append(",".join((each.name.replace(",", " "), *(f"{value:.9g}" for value in row))))
    return "\n".join([*lines, ""]).encode()


WRITERS: Mapping[str, Callable[[Sequence[Demonstration]], bytes]] = {"csv": as_csv, "npz": as_npz}
"""Writers of a file of demonstrations, by its suffix without the dot."""


def lasa_files(folder: str | Path) -> dict[str, Path]:
    """List the shapes of a LASA folder, one ``.mat`` file each, by name: load one with :func:`load_demonstrations`.

    Raises:
        DemonstrationError: there is no such folder, it cannot be read, or it holds no ``.mat`` file.
    """
    with parsing(DemonstrationError, folder, "folder", "a readable folder"):
        files = {path.stem: path for path in files_of(Path(folder)) if path.suffix.lower() == ".mat"}
    if not files:
        raise DemonstrationError(folder, "folder", "no .mat file", "one .mat file per shape")
    return files
