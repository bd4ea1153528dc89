"""Joint trajectories, and their files: CSV, npz, and the YAML of ROS 2's trajectory_msgs/JointTrajectory."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.interpolate import BPoly, BSpline, CubicSpline

from dt_viz.errors import DataError, FormatError
from dt_viz.files.npz import npz_bytes, write_whole
from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length
from dt_viz.robot.robot import Robot

DECIMALS = 9  # number of decimals of texts: 1 nrad, and 1 ns, which is the step of times in ROS
TOPIC = "/joint_trajectory_controller/joint_trajectory trajectory_msgs/msg/JointTrajectory"
"""Topic of the controller, under its usual name, and type of the message."""
PUBLISH = f"""\
# ros2 topic pub --once {TOPIC} --yaml-file FILE
# (where ros2 has no --yaml-file: "$(cat FILE)"); first bring the arm to the first positions
"""
"""Head of the YAML file: the command that has a controller follow it."""


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """A motion of the joints from rest to rest: points, with a quintic between each two."""

    joint_names: tuple[str, ...]  # names of the n joints
    times: Array  # (K,) seconds from the start, strictly increasing from 0
    positions: Array  # (K, n) rad; continuous joints unwrapped
    velocities: Array  # (K, n) rad/s; 0 at both ends
    accelerations: Array  # (K, n) rad/s²; 0 at both ends

    @property
    def quintics(self) -> BPoly:
        """The function of time (T,) that interpolates the points: (T, n) rad."""
        states = np.stack([self.positions, self.velocities, self.accelerations], axis=1)
        return BPoly.from_derivatives(self.times, states)

    def slower(self, factor: float) -> JointTrajectory:
        """Return it on the same path, with times longer by a factor."""
        times, velocities = self.times * factor, self.velocities / factor
        return replace(self, times=times, velocities=velocities, accelerations=self.accelerations / factor**2)

    def save(self, path: str | os.PathLike[str]) -> None:
        """Write a file in the format of its suffix: .csv, .npz, or .yaml for ROS 2.

        Raises:
            DataError: there is no such format, or the file cannot be written.
        """
        file = Path(path)
        if file.suffix not in FORMATS:
            raise DataError(file, "suffix", repr(file.suffix), ", ".join(FORMATS))
        try:
            write_whole(file, FORMATS[file.suffix](self))
        except OSError as error:
            raise DataError(
                file, "place", error.strerror or str(error), "a file in a folder that can be written"
            ) from None


def _csv(trajectory: JointTrajectory) -> bytes:
    names, states = trajectory.joint_names, ("position_rad", "velocity_rad_s", "acceleration_rad_s2")
    heads = ["time_s", *(f"{name}_{state}" for state in states for name in names)]
    values = (trajectory.times, trajectory.positions, trajectory.velocities, trajectory.accelerations)
    rows = [",".join(map(_decimal, row)) for row in np.column_stack(values)]
    return "\n".join([",".join(heads), *rows, ""]).encode()


def _npz(trajectory: JointTrajectory) -> bytes:
    arrays = {name: getattr(trajectory, name) for name in ("times", "positions", "velocities", "accelerations")}
    return npz_bytes({"joint_names": np.array(trajectory.joint_names), **arrays})


def _yaml(trajectory: JointTrajectory) -> bytes:
    states = ("positions", "velocities", "accelerations")
    lines = ["header: {stamp: {sec: 0, nanosec: 0}, frame_id: ''}"]
    lines += [f"joint_names: {json.dumps(trajectory.joint_names)}", "points:"]
    for k, time in enumerate(trajectory.times):
        rows = [f"{state}: [{', '.join(map(_decimal, getattr(trajectory, state)[k]))}]" for state in states]
        sec, nanosec = divmod(round(time * 10**9), 10**9)
        since = f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}"
        lines += [f"- {rows[0]}", *(f"  {row}" for row in (*rows[1:], since))]
    return (PUBLISH + "\n".join([*lines, ""])).encode()


def _decimal(value: float) -> str:
    """A number with at most so many decimals, and at least one, which makes it no integer in YAML."""
    text = f"{value:.{DECIMALS}f}".rstrip("0")
    text = f"{text}0" if text.endswith(".") else text
    return "0.0" if text == "-0.0" else text


FORMATS: Mapping[str, Callable[[JointTrajectory], bytes]] = {".csv": _csv, ".npz": _npz, ".yaml": _yaml}
"""Function that encodes a trajectory, by the suffix of the file."""


RAMP = 0.3
"""Shortest time in which a motion slows down from its own pace to a standstill, or back, seconds."""
NEGLIGIBLE = 1e-6
"""Delay of a segment, seconds, up to which the motion around it does not slow down."""


def within_velocity_limits(times: Array, q: Array, limits: Array) -> Array:
    """Delay a motion so that it respects the joint velocity limits.

    The progress of the motion is the rate g = dt/ds of its own time t in the new time s: at most 1, and at most what
    each segment allows. It changes at most at the rate 1/`RAMP`, and since dg/ds = ½ d(g²)/dt, its square is the
    largest function below the squares of what the segments allow whose slope in t nowhere exceeds 2/`RAMP`:

        g²(t) = minₖ (gₖ² + 2 |t − segment k| / RAMP),     s = ∫ dt/g.

    Between two samples g² rises, stays at what the segment allows, and falls, so that its integral is exact. Where a
    motion jumps (g = 0), it comes to rest, crosses the gap at the limit, and goes on.

    Args:
        times: (T,) seconds, not decreasing.
        q: (T, n) joint angles, rad; those of continuous joints unwrapped.
        limits: (n,) rad/s, greater than 0.

    Returns:
        (T,) seconds, from the same start: no interval is shorter than before, and in none is a joint's mean speed above
        its limit (up to rounding). A motion that respects the limits keeps its times, bit for bit.
    """
    intervals, least = np.diff(times), (np.abs(np.diff(q, axis=0)) / limits).max(axis=1)  # at a joint's limit
    if (least <= intervals).all():
        return times
    slows = least > intervals + NEGLIGIBLE
    allowed = np.ones_like(intervals)  # g² of each segment
    np.divide(intervals, least, out=allowed, where=slows)
    np.square(allowed, out=allowed)
    slope = 2 / RAMP
    sources = np.where(slows, allowed, np.inf)
    behind = np.minimum.accumulate(sources - slope * times[1:]) + slope * times[1:]
    ahead = np.minimum.accumulate((sources + slope * times[:-1])[::-1])[::-1] - slope * times[:-1]
    nodes = np.ones_like(times)  # g² at the samples; the minima with `sources` undo rounding
    nodes[1:] = np.minimum(np.minimum(behind, sources), nodes[1:])
    nodes[:-1] = np.minimum(np.minimum(ahead, sources), nodes[:-1])
    nodes = np.maximum(nodes, 0.0)

    highest = np.minimum(allowed, (nodes[:-1] + nodes[1:] + slope * intervals) / 2)
    ramps = 2 * highest - nodes[:-1] - nodes[1:]  # how much g² rises and falls within a segment
    at_nodes, at_highest = np.sqrt(nodes), np.sqrt(highest)
    level = np.maximum(intervals - ramps / slope, 0.0)  # of the segment, in its own time
    np.divide(level, at_highest, out=level, where=at_highest > 0)
    new = level + 2 / slope * (2 * at_highest - at_nodes[:-1] - at_nodes[1:])
    delays = np.maximum(np.maximum(new, least) - intervals, 0.0)
    return times + np.concatenate([[0.0], np.cumsum(delays)])


# --- From rest to rest ---

DISTINCT = 1e-6  # distance of two samples, rad, up to which the second is left out
JUMP = 0.5
"""Largest change of a joint from one sample to the next, rad; beyond, nothing is known of the way between them."""
NUM_CELLS = 1000  # least number of cells in which the pace is chosen
SHARE = 0.5  # part of the acceleration limit for speeding up and slowing down; the rest is for the path's bends
SMOOTHING = 0.02  # knot spacing of the B-spline that makes the acceleration continuous, seconds
SPACING = 0.1  # largest time between two points, seconds
ERROR = 3e-7  # largest deviation of the quintics from the path, rad
MARGIN = 1e-3  # part of the limits that is not used, so that rounding in a file does not exceed them

Moving = Callable[[Array], tuple[Array, Array, Array]]
"""Positions, velocities and accelerations, each (T, n), at times (T,)."""


def rest_to_rest(robot: Robot, times: Array, q: Array, acceleration: float) -> JointTrajectory:
    """Time a motion anew, from rest to rest, and no faster than it is, within the arm's limits, for a controller.

    The path q(s) is the cubic spline through the samples, s their distance in rad; it has the samples of the motion, in
    their order, and no corners at which a joint would have to stop. Its pace ṡ is the motion's own where limits allow:

        |q′|ṡ ≤ v,     |q″|ṡ² ≤ a/2,     |q′||s̈| ≤ a/2,     ṡ = 0 at both ends,

    of which the largest ṡ² is a minimum of cones, as in `within_velocity_limits`. A B-spline of degree 5 through its
    even samples in time makes s̈ continuous and 0 at both ends, within the same bounds, since a B-spline averages.
    Points are placed where the quintic between two of them is the path; ROS's joint_trajectory_controller follows it
    where points have positions, velocities and accelerations.

    Args:
        robot: the arm, of n joints.
        times: (T,) seconds, not decreasing.
        q: (T, n) joint angles, rad; those of continuous joints unwrapped.
        acceleration: limit for each joint, rad/s².

    Raises:
        FormatError: the motion stands still, or jumps, or a joint leaves its range.
    """
    joint_names = robot.joint_names
    steps = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0)
    if len(steps) and steps.max() > JUMP:
        name = joint_names[np.abs(np.diff(q, axis=0)[steps.argmax()]).argmax()]
        accepted = f"changes of up to {JUMP:g} rad, as of one posture that moves"
        raise FormatError("the joints", f"a jump of {steps.max():.2g} rad of {name}", accepted)
    kept = _distinct(q)
    if len(kept) < 2:
        raise FormatError("the joints", "an arm that stands still", "a motion")
    moving, end = _timed(times[kept], q[kept], robot.velocity_limits, acceleration)
    at = _points(moving, np.linspace(0, end, int(np.ceil(end / SPACING)) + 1))
    found = JointTrajectory(joint_names, at, *moving(at))
    curve = found.quintics
    dense = np.concatenate([np.linspace(at[:-1], at[1:], 16, endpoint=False).ravel("F"), at[-1:]])
    beyond = np.maximum(robot.lower - curve(dense), curve(dense) - robot.upper).max(axis=0)
    if beyond.max() > 0:
        name = joint_names[beyond.argmax()]
        raise FormatError("the joints", f"{name} {beyond.max():.2g} rad beyond its range", "motions within it")
    used = np.abs(curve(dense, 1) / robot.velocity_limits).max(), np.sqrt(np.abs(curve(dense, 2)).max() / acceleration)
    return found.slower(max(1.0, *(float(part) * (1 + MARGIN) for part in used)))


def _distinct(q: Array) -> list[int]:
    """Indices of the samples that are so far, rad, from the one before; the last one is the motion's."""
    kept = [0]
    for k in range(1, len(q)):
        if np.abs(q[k] - q[kept[-1]]).max() > DISTINCT:
            kept.append(k)
    return kept


def _timed(times: Array, q: Array, velocity: Array, acceleration: float) -> tuple[Moving, float]:
    """The motion through distinct samples (K, n) from rest to rest, and its duration, seconds."""
    knots = arc_length(q)
    curve = CubicSpline(knots, q)
    each = int(np.ceil(NUM_CELLS / (len(knots) - 1)))
    samples = np.arange(len(knots))
    s = np.interp(np.linspace(0, samples[-1], each * samples[-1] + 1), samples, knots)
    with np.errstate(divide="ignore"):
        pace = np.repeat(np.diff(knots) / np.diff(times), each)
        along, bend = np.abs(curve(s, 1)), np.abs(curve(s, 2))
        most = np.minimum((velocity / along).min(axis=1) ** 2, (1 - SHARE) * acceleration / bend.max(axis=1))
    most[1:] = np.minimum(most[1:], pace**2)
    most[:-1] = np.minimum(most[:-1], pace**2)
    most[[0, -1]] = 0.0
    gain = 2 * SHARE * acceleration / along.max(axis=1)
    rise = np.concatenate([[0.0], np.cumsum(np.diff(s) * np.minimum(gain[1:], gain[:-1]))])
    most = np.minimum(most, np.minimum.accumulate(most - rise) + rise)
    most = np.minimum(most, np.minimum.accumulate((most + rise)[::-1])[::-1] - rise)
    rate = np.sqrt(np.maximum(most, 0.0))
    passed = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (rate[1:] + rate[:-1]))])

    even = np.arange(0, passed[-1], SMOOTHING)
    cell = np.searchsorted(passed, even, side="right") - 1
    since, change = even - passed[cell], np.diff(rate)[cell] / np.diff(passed)[cell]
    begins, ends = np.zeros(5), np.full(6, s[-1])
    control = np.concatenate([begins, s[cell] + since * (rate[cell] + since * change / 2), ends])
    progress = BSpline(SMOOTHING * (np.arange(len(control) + 6) - 5.0), control, 5)

    def moving(t: Array) -> tuple[Array, Array, Array]:
        at, speed, change = (progress(t, order)[:, None] for order in range(3))
        first, second = (curve(at[:, 0], order) for order in (1, 2))
        return curve(at[:, 0]), first * speed, second * speed**2 + first * change

    return moving, SMOOTHING * (len(control) - 5)


def _points(moving: Moving, times: Array) -> Array:
    """Times, seconds, among them those given, between which quintics deviate from a motion by so much at most, rad."""
    while True:
        curve = JointTrajectory((), times, *moving(times)).quintics
        between = np.linspace(times[:-1], times[1:], 10)[1:-1]
        off = np.abs(curve(between.ravel()) - moving(between.ravel())[0]).max(axis=1).reshape(between.shape).max(axis=0)
        if (off <= ERROR).all():
            return times
        times = np.sort(np.concatenate([times, (times[:-1] + times[1:])[off > ERROR] / 2]))
