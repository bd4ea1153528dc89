"""Names of columns: which of them are times, places, orientations, joint angles or labels, and in which unit.

A name is cut into words at punctuation, spaces and humps (``field.pose.position.x``, ``tool0 x``, ``posX``); a unit may
end it (``time_ms``, ``x [mm]``). Columns that belong together share all other words.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from dt_viz.errors import UnclearError
from dt_viz.files.checks import check_at_most

UNITS: Mapping[str, tuple[str, float]] = {
    **{"m": ("length", 1.0), "cm": ("length", 1e-2), "mm": ("length", 1e-3)},
    **{"s": ("time", 1.0), "ms": ("time", 1e-3), "us": ("time", 1e-6), "ns": ("time", 1e-9)},
    **{"rad": ("angle", 1.0), "deg": ("angle", np.pi / 180)},
}
"""Units by name: what they measure, and their size in metres, seconds or radians."""
_SYNONYMS = {
    **dict.fromkeys(("sec", "secs", "second", "seconds"), "s"),
    **dict.fromkeys(("msec", "msecs", "millis", "milliseconds"), "ms"),
    **dict.fromkeys(("usec", "usecs", "micros", "microseconds"), "us"),
    **dict.fromkeys(("nsec", "nsecs", "nanosec", "nanosecs", "nanos", "nanoseconds"), "ns"),
    **{"metres": "m", "meters": "m", "millimetres": "mm", "millimeters": "mm"},
    **{"degree": "deg", "degrees": "deg", "radian": "rad", "radians": "rad"},
}
TIMES = {"t", "time", "times", "timestamp", "timestamps", "stamp", "stamps", "elapsed"}
LABELS = ("demo", "demonstration", "take", "trial", "episode", "trajectory", "traj", "run", "recording")
RATES = {"rate", "fps", "hz", "frequency", "control_freq", "dt"}
POSITIONS = {"p", "pos", "position", "positions", "translation", "xyz", "xy", "points", "path"}
ORIENTATIONS = {
    *("q", "quat", "quats", "quaternion", "quaternions", "ori", "orientation", "orientations"),
    *("rot", "rotation", "rotations"),
}
HAND = {
    *("field", "pose", "poses", "point", "transform", "msg", "data", "obs", "observation", "state", "robot", "robot0"),
    *("current", "actual", "measured", "cartesian", "cart", "base", "world", "end", "effector", "ee", "eef", "tcp"),
    *("tool", "tool0", "hand", "gripper", "flange", "wrist", "tip"),
}
"""Words that tell the hand's place from nothing else in a file."""
TOOL = {"cartesian", "tcp", "ee", "eef", "effector", "tool"}
"""Words of which the first three numbered columns are places: ``actual_TCP_pose_0``."""
WANTED = {"action", "actions", "cmd", "command", "target", "desired", "goal", "ref", "reference", "setpoint", "object"}
"""Words of places that the hand has not been at."""
WANTED_RANK = 4  # rank of such places: they come after joint angles
OTHERS = {
    *("vel", "velocity", "velocities", "linear", "angular", "twist", "acc", "accel", "acceleration", "jerk"),
    *("force", "torque", "effort", "wrench", "imu", "gyro", "mag", "rpy", "euler", "omega"),
    *("covariance", "std", "error", "sin", "cos", "next", "reward", "rewards", "normal", "scale", "size"),
}
"""Words of quantities that are not used."""
ANGLES = {"q", "j", "joint", "theta", "angle", "axis", "pos", "position", "positions"}
"""Words of joint angles before a number."""
JOINTS = {"joint", "joints", "qpos", "angles", "servo", "motor"}
AROUND_JOINTS = (HAND - {"gripper"}) | ANGLES | JOINTS
"""Words that may stand beside the name of an arm's joint: ``observation.state.shoulder_pan.pos``."""
MAX_COLUMNS = 1000
"""Number of columns without names of their own that a matrix may have; an empty one may claim billions."""
MAX_TURN = 4 * np.pi  # largest joint angle, rad; numbers beyond it are degrees


@dataclass(frozen=True)
class Role:
    """What a column is."""

    kind: str  # "time", "label", "rate", "position", "orientation" or "joint"
    group: tuple[str, ...] = ()  # words that it shares with the columns that it belongs to
    part: str = ""  # its axis x, y, z or w
    rank: int = 0  # place among the columns of its kind: the lowest is used
    unit: str = ""  # its unit, a name of `UNITS`; empty if it does not say


def unit_of(word: str) -> str:
    """Return the name in `UNITS` of a unit; empty if it is none."""
    word = _SYNONYMS.get(word, word)
    return word if word in UNITS else ""


@lru_cache(maxsize=4096)
def role_of(name: str, joint_names: tuple[str, ...] = ()) -> Role | None:
    """Tell what a column of numbers is by its name, if it is none of an arm's joints; None if it is not used."""
    words = _words(name)
    own = [joint for joint in joint_names if _is_named(words, _words(joint))]
    if words == ["%time"]:  # of `rostopic echo -p`
        return Role("time", unit="ns")
    unit = unit_of(words[-1]) if words else ""
    if unit and len(words) > 1:
        words.pop()
    elif unit and UNITS[unit][0] == "time" and len(words[-1]) > 1:
        return Role("time", rank=1, unit=unit)
    else:
        unit = ""
    if own:
        joint = max(own, key=lambda joint: len(_words(joint)))  # joint_1 is in gripper_joint_1, too
        return Role("joint", (joint,), rank=len(words) - len(_words(joint)), unit=unit)
    if "_".join(words) in RATES:
        return Role("rate", tuple(words), unit=unit)
    label = [word for word in words if word not in {"id", "index", "idx", "number", "no", "num", "name"}]
    if len(label) == 1 and label[0] in LABELS:
        return Role("label", rank=LABELS.index(label[0]))
    is_time = words == ["t"] or set(words) & (TIMES - {"t"})
    return Role("time", tuple(words), rank=len(words) - 1, unit=unit) if is_time else _place(words, unit)


def _place(words: list[str], unit: str) -> Role | None:
    """Role of a column of places, orientations or joint angles."""
    axes = [word for word in words if word in ("x", "y", "z", "w")]
    group = tuple(word for word in words if word not in axes)
    among = set(group)
    if among & OTHERS or group in [("v",), ("a",), ("f",), ("r",)] or len(axes) > 1:
        return None
    if axes and among & ORIENTATIONS:
        return None if among & WANTED else Role("orientation", group, axes[0], unit=unit)
    if not axes and words[-1:] in (["0"], ["1"], ["2"]) and words[-2] in POSITIONS | {"pose"} and among & TOOL:
        axes, group = ["xyz"[int(words[-1])]], group[:-1]
    if axes and axes[0] != "w":
        within = among <= HAND | POSITIONS | {"0", "1", "2"}
        rank = WANTED_RANK if among & WANTED else int(bool(among)) if within else 2 if among & POSITIONS else 3
        return Role("position", group, axes[0], rank, unit)
    return Role("joint", unit=unit) if not axes and _is_joint(words) else None


def _is_joint(words: list[str]) -> bool:
    """Tell whether these words are a joint angle's: ``shoulder_pan_joint``, ``q1``, ``actual_q_0``, ``position0``."""
    if not words or set(words) & (WANTED | {"gripper", "finger", "fingers"}):
        return False
    numbered = words[-1].isdecimal() and words[:-1] and words[-2] in ANGLES
    fused = re.fullmatch(r"([a-z]+)\d+", words[-1])
    return bool(set(words) & JOINTS or numbered or (fused and fused[1] in ANGLES))


def _is_named(words: Sequence[str], joint: Sequence[str]) -> bool:
    """Tell whether these words hold a joint's, one after the other, and none but those around it and of units."""
    at = next((k for k in range(len(words)) if [*words[k : k + len(joint)]] == [*joint]), None)
    if at is None or not joint:
        return False
    return {*words[:at], *words[at + len(joint) :]} <= AROUND_JOINTS | {*UNITS, *_SYNONYMS}


def _words(name: str) -> list[str]:
    humps = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.strip())
    words = []
    for word in re.findall(r"%?[^\W\d_]+\d*|\d+", humps.lower()):
        if fused := re.fullmatch(r"(p|pos|position|t)([xyz])|(q|quat|ori)([xyzw])", word):
            words += [part for part in fused.groups() if part]
        else:
            words.append(word)
    return words


def is_kind(name: str, kind: str) -> bool:
    """Tell whether this is the name of a column of some kind; see `Role`."""
    role = role_of(name)
    return role is not None and role.kind == kind


def is_place(name: str) -> bool:
    """Tell whether an array of this name may be one of places."""
    return not set(_words(name)) & (OTHERS | WANTED | ORIENTATIONS | TIMES)


def expanded(name: str, values: np.ndarray) -> dict[str, np.ndarray]:
    """Name the columns of a matrix (T, k) after it, by what its name and its width say; those of a vector stay."""
    if values.ndim != 2:
        return {name: values}
    words, width = set(_words(name)), values.shape[1]
    if width == 1:
        return {name: values[:, 0]}
    if width == 4 and words & ORIENTATIONS:
        parts: Iterable[str] = "wxyz" if "wxyz" in name.lower() else "xyzw"
    elif width == 7 and words & (HAND | POSITIONS) and _is_unit(values[:, 3:]) and not words & JOINTS:
        parts = (*(f"position.{axis}" for axis in "xyz"), *(f"orientation.{axis}" for axis in "xyzw"))
    elif words & JOINTS or name in ("q", "state", "states", "observation.state"):
        check_at_most(f"columns of {name[:40]!r}", width, MAX_COLUMNS)
        parts = (f"joint{k + 1}" for k in range(width))
    elif width in (2, 3):
        parts = "xyz"[:width]
    else:
        return {}
    before = "" if name.lower() == "x" else f"{name}."
    return {f"{before}{part}": values[:, k] for k, part in enumerate(parts)}


def numbered(width: int) -> list[str]:
    """Name columns that have no names, for those who are asked what they are."""
    check_at_most("columns", width, MAX_COLUMNS)
    return [f"column {k + 1}" for k in range(width)]


def unnamed(values: np.ndarray, num_joints: int | None, *, rated: bool, timed: bool, asks: bool = False) -> list[str]:
    """Name the columns of a matrix (T, k) without names, as far as its numbers make them clear.

    Args:
        values: the matrix.
        num_joints: number of joints of the arm at hand.
        rated: whether the rate is known, so that no column has times.
        timed: whether two or three columns may begin with times.
        asks: whether it is asked, rather than guessed, if the first of three has times.

    Raises:
        UnclearError: they are not clear.
    """
    width = values.shape[1]
    pose = [*"xyz", "qx", "qy", "qz", "qw"]
    joints = [f"joint{k + 1}" for k in range(num_joints or 0)]
    even = not rated and _is_even(values[:, 0])
    if width in (2, 3):
        return _few(width, timed=timed and even and width == 3 and not _is_even(values[:, 1]), asks=asks)
    if num_joints and width in (num_joints, num_joints + 1) and not _is_unit(values[:, -4:]):
        return joints if width == num_joints else ["t", *joints]
    if width == 4 and (even or (not rated and (np.diff(values[:, 0]) > 0).all())):
        return ["t", *"xyz"]
    if width == 7 and _is_unit(values[:, 3:]):
        return pose
    if width == 7 and _is_unit(values[:, :4]):
        return [*pose[3:], *"xyz"]
    if width == 8 and _is_unit(values[:, 4:]):
        return ["t", *pose]
    accepted = "(T, 2) or (T, 3); else say what they are, such as columns='t,x,y,z' or columns='joint1,joint2,…'"
    raise UnclearError("columns", f"{width} columns without names", accepted, "columns", numbered(width))


def _few(width: int, *, timed: bool, asks: bool) -> list[str]:
    """Name two or three columns, the first of three times if it may be `timed`, or ask."""
    if timed and asks:
        readings = ("t,x,y", "x,y,z")
        found, accepted = "three without names, of which the first may have times", " or ".join(readings)
        raise UnclearError("columns", found, accepted, "reading", readings)
    return ["t", "x", "y"] if timed else [*"xyz"[:width]]


def _is_unit(values: np.ndarray) -> bool:
    """Tell whether these may be quaternions (T, 4)."""
    return values.shape[1] == 4 and bool(np.abs((values**2).sum(axis=1) - 1).max(initial=0.0) < 1e-2)


def _is_even(values: np.ndarray) -> bool:
    """Tell whether these (T,) may be times: they grow by steps that are alike, as no hand moves."""
    steps = np.diff(values)
    return len(steps) > 1 and bool(steps.min() > 0 and steps.max() < 1.5 * np.median(steps) < 3 * steps.min())


@dataclass(frozen=True)
class Layout:
    """Names of the columns that are used."""

    time: str = ""
    fraction: str = ""  # column of nanoseconds that belong to the seconds of `time`
    label: str = ""
    rate: str = ""
    positions: tuple[str, ...] = ()  # x, y and perhaps z
    orientations: tuple[str, ...] = ()  # w, x, y, z, or none
    joints: tuple[str, ...] = ()
    joint_names: tuple[str, ...] = ()
    """Names of the joints: the arm's where they are known, otherwise of the columns."""
    units: tuple[str, ...] = ()  # units that names of times, positions and joints end in

    @property
    def used(self) -> set[str]:
        """All of them."""
        named = (self.time, self.fraction, self.label, self.rate)
        return {*named, *self.positions, *self.orientations, *self.joints} - {""}


def layout(names: Sequence[str], others: Sequence[str] = (), joint_names: tuple[str, ...] = ()) -> Layout:
    """Find the columns of a table by their names, or an arm's names of joints; others of the file are for messages.

    Raises:
        FormatError: there are neither places nor joint angles, or several places that are alike.
    """
    roles = {name: role for name in names if (role := role_of(name, joint_names))}
    by_kind = {
        kind: sorted((name for name in roles if roles[name].kind == kind), key=lambda name: roles[name].rank)
        for kind in ("time", "label", "rate", "position", "orientation", "joint")
    }
    time, fraction = _clock(by_kind["time"], roles)
    positions, group = _position_columns(by_kind["position"], roles, names)
    joints = _joint_columns(by_kind["joint"], roles, joint_names)
    if positions and roles[positions[0]].rank < WANTED_RANK:
        joints = ()
    elif joints:
        positions = ()
    if not positions and not joints:
        raise _unclear("no places", [*names, *others], names)
    first = {kind: next(iter(by_kind[kind]), "") for kind in ("label", "rate")}
    orientations = _orientation_columns(by_kind["orientation"], roles, group) if len(positions) == 3 else ()
    known = tuple(next(iter(roles[name].group), name.removeprefix("joint.")) for name in joints)
    units = tuple(roles[name].unit for name in (time, *positions, *joints) if name)
    return Layout(time, fraction, first["label"], first["rate"], positions, orientations, joints, known, units)


def _joint_columns(names: Sequence[str], roles: Mapping[str, Role], joint_names: Sequence[str]) -> tuple[str, ...]:
    """Return the columns of an arm's joints, for each the one with the fewest words, if it has all; otherwise all."""
    by_joint: dict[str, str] = {}
    for name in names:
        for joint in roles[name].group:
            by_joint.setdefault(joint, name)
    whole = bool(joint_names) and set(joint_names) <= set(by_joint)
    return tuple(by_joint[joint] for joint in joint_names) if whole else tuple(names)


def _unclear(what: str, names: Sequence[str], choices: Sequence[str]) -> UnclearError:
    found = f"{what} in {','.join(names)[:160]!r}"
    accepted = (
        "x, y and perhaps z, t, demo, or joint1, joint2, …, such as 't,x,y,z' or 'timestamp,pos_x,pos_y,pos_z'; "
        "or say which, such as columns={'x': 'name of x', 'y': 'name of y'}"
    )
    return UnclearError("columns", found, accepted, "columns", choices)


def _clock(names: Sequence[str], roles: Mapping[str, Role]) -> tuple[str, str]:
    """Return the column of times, and that of the nanoseconds that belong to it."""
    if not names:
        return "", ""
    stamps = [name for name in names if roles[name].group == roles[names[0]].group]
    seconds = [name for name in stamps if roles[name].unit == "s"]
    nanoseconds = [name for name in stamps if roles[name].unit == "ns"]
    return (seconds[0], nanoseconds[0]) if seconds and nanoseconds else (names[0], "")


def _position_columns(
    names: Sequence[str], roles: Mapping[str, Role], given: Sequence[str]
) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return the columns x, y and perhaps z of one group of words, and these words."""
    whole = _whole_groups(names, roles, "xy")
    if not whole:
        return (), ()
    best = {group: roles[axes["x"]].rank for group, axes in whole.items()}
    alike = [group for group in whole if best[group] == min(best.values())]
    if len(alike) > 1 and not set(alike[0]) & POSITIONS:
        raise _unclear(f"{len(alike)} places ({', '.join(' '.join(group) for group in alike)[:80]})", given, given)
    return tuple(whole[alike[0]][axis] for axis in "xyz" if axis in whole[alike[0]]), alike[0]


def _orientation_columns(names: Sequence[str], roles: Mapping[str, Role], group: Sequence[str]) -> tuple[str, ...]:
    """Return the columns w, x, y, z whose words are most like those of the positions; none if some are missing."""
    whole = _whole_groups(names, roles, "wxyz")
    best = whole[max(whole, key=lambda words: len(set(group) & set(words)))] if whole else {}
    return tuple(best[axis] for axis in "wxyz" if best)


def _whole_groups(names: Sequence[str], roles: Mapping[str, Role], axes: str) -> dict[tuple[str, ...], dict[str, str]]:
    """Return the columns of each group of words by their axis, if it has these axes."""
    groups: dict[tuple[str, ...], dict[str, str]] = {}
    for name in names:
        groups.setdefault(roles[name].group, {}).setdefault(roles[name].part, name)
    return {group: parts for group, parts in groups.items() if set(axes) <= set(parts)}
