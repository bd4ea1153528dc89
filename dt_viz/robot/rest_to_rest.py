"""Motions of the joints, timed anew from rest to rest within the arm's limits, for a controller.

The path q(s) is the cubic spline through the samples, s their distance in rad; it has the samples of the motion, in
their order, and no corners at which a joint would have to stop. Its pace ṡ is the motion's own where the limits allow:

    |q′|ṡ ≤ v,     |q″|ṡ² ≤ a/2,     |q′||s̈| ≤ a/2,     ṡ = 0 at both ends,

of which the largest ṡ² is a minimum of cones, as in `dt_viz.robot.retiming`. A B-spline of degree 5 through its even
samples in time makes s̈ continuous and 0 at both ends, within the same bounds, since a B-spline averages. Points are
placed where the quintic between two of them, which is what ROS's joint_trajectory_controller follows where points have
positions, velocities and accelerations, is the path.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.interpolate import BSpline, CubicSpline

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length
from dt_viz.robot.joint_trajectory import JointTrajectory
from dt_viz.robot.robot import Robot

Moving = Callable[[Array], tuple[Array, Array, Array]]
"""Positions, velocities and accelerations, each (T, n), at times (T,)."""


@dataclass(frozen=True)
class TrajectorySettings:
    """Settings of `rest_to_rest`."""

    distinct: float = 1e-6
    """Distance of two samples, rad, up to which the second is left out."""
    jump: float = 0.5
    """Largest change of a joint from one sample to the next, rad; beyond, nothing is known of the way between them."""
    num_cells: int = 1000
    """Least number of cells in which the pace is chosen."""
    share: float = 0.5
    """Part of the acceleration limit for speeding up and slowing down; the rest is for the path's bends."""
    smoothing: float = 0.02
    """Knot spacing of the B-spline that makes the acceleration continuous, seconds."""
    spacing: float = 0.1
    """Largest time between two points, seconds."""
    error: float = 3e-7
    """Largest deviation of the quintics from the path, rad."""
    margin: float = 1e-3
    """Part of the limits that is not used, so that rounding in a file does not exceed them."""


def rest_to_rest(
    robot: Robot, times: Array, q: Array, acceleration: float, settings: TrajectorySettings | None = None
) -> JointTrajectory:
    """Time a motion anew, from rest to rest, and no faster than it is.

    Args:
        robot: the arm, of n joints.
        times: (T,) seconds, not decreasing.
        q: (T, n) joint angles, rad; those of continuous joints unwrapped.
        acceleration: limit for each joint, rad/s².
        settings: what may be chosen; None are the defaults.

    Raises:
        FormatError: the motion stands still, or jumps, or a joint leaves its range.
    """
    chosen, joint_names = settings or TrajectorySettings(), robot.joint_names
    steps = np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0)
    if len(steps) and steps.max() > chosen.jump:
        name = joint_names[np.abs(np.diff(q, axis=0)[steps.argmax()]).argmax()]
        accepted = f"changes of up to {chosen.jump:g} rad, as of one posture that moves"
        raise FormatError("the joints", f"a jump of {steps.max():.2g} rad of {name}", accepted)
    kept = _distinct(q, chosen.distinct)
    if len(kept) < 2:
        raise FormatError("the joints", "an arm that stands still", "a motion")
    moving, end = _timed(times[kept], q[kept], robot.velocity_limits, acceleration, chosen)
    at = _points(moving, np.linspace(0, end, int(np.ceil(end / chosen.spacing)) + 1), chosen.error)
    found = JointTrajectory(joint_names, at, *moving(at))
    curve = found.quintics
    dense = np.concatenate([np.linspace(at[:-1], at[1:], 16, endpoint=False).ravel("F"), at[-1:]])
    beyond = np.maximum(robot.lower - curve(dense), curve(dense) - robot.upper).max(axis=0)
    if beyond.max() > 0:
        name = joint_names[beyond.argmax()]
        raise FormatError("the joints", f"{name} {beyond.max():.2g} rad beyond its range", "motions within it")
    used = np.abs(curve(dense, 1) / robot.velocity_limits).max(), np.sqrt(np.abs(curve(dense, 2)).max() / acceleration)
    return found.slower(max(1.0, *(float(part) * (1 + chosen.margin) for part in used)))


def _distinct(q: Array, apart: float) -> list[int]:
    """Indices of the samples that are so far, rad, from the one before; the last one is the motion's."""
    kept = [0]
    for k in range(1, len(q)):
        if np.abs(q[k] - q[kept[-1]]).max() > apart:
            kept.append(k)
    return kept


def _timed(
    times: Array, q: Array, velocity: Array, acceleration: float, chosen: TrajectorySettings
) -> tuple[Moving, float]:
    """The motion through distinct samples (K, n) from rest to rest, and its duration, seconds."""
    knots = arc_length(q)
    curve = CubicSpline(knots, q)
    each = int(np.ceil(chosen.num_cells / (len(knots) - 1)))
    samples = np.arange(len(knots))
    s = np.interp(np.linspace(0, samples[-1], each * samples[-1] + 1), samples, knots)
    with np.errstate(divide="ignore"):
        pace = np.repeat(np.diff(knots) / np.diff(times), each)
        along, bend = np.abs(curve(s, 1)), np.abs(curve(s, 2))
        most = np.minimum((velocity / along).min(axis=1) ** 2, (1 - chosen.share) * acceleration / bend.max(axis=1))
    most[1:] = np.minimum(most[1:], pace**2)
    most[:-1] = np.minimum(most[:-1], pace**2)
    most[[0, -1]] = 0.0
    gain = 2 * chosen.share * acceleration / along.max(axis=1)
    rise = np.concatenate([[0.0], np.cumsum(np.diff(s) * np.minimum(gain[1:], gain[:-1]))])
    most = np.minimum(most, np.minimum.accumulate(most - rise) + rise)
    most = np.minimum(most, np.minimum.accumulate((most + rise)[::-1])[::-1] - rise)
    rate = np.sqrt(np.maximum(most, 0.0))
    passed = np.concatenate([[0.0], np.cumsum(2 * np.diff(s) / (rate[1:] + rate[:-1]))])

    even = np.arange(0, passed[-1], chosen.smoothing)
    cell = np.searchsorted(passed, even, side="right") - 1
    since, change = even - passed[cell], np.diff(rate)[cell] / np.diff(passed)[cell]
    begins, ends = np.zeros(5), np.full(6, s[-1])
    control = np.concatenate([begins, s[cell] + since * (rate[cell] + since * change / 2), ends])
    progress = BSpline(chosen.smoothing * (np.arange(len(control) + 6) - 5.0), control, 5)

    def moving(t: Array) -> tuple[Array, Array, Array]:
        at, speed, change = (progress(t, order)[:, None] for order in range(3))
        first, second = (curve(at[:, 0], order) for order in (1, 2))
        return curve(at[:, 0]), first * speed, second * speed**2 + first * change

    return moving, chosen.smoothing * (len(control) - 5)


def _points(moving: Moving, times: Array, error: float) -> Array:
    """Times, seconds, among them those given, between which quintics deviate from a motion by so much at most, rad."""
    while True:
        curve = JointTrajectory((), times, *moving(times)).quintics
        between = np.linspace(times[:-1], times[1:], 10)[1:-1]
        off = np.abs(curve(between.ravel()) - moving(between.ravel())[0]).max(axis=1).reshape(between.shape).max(axis=0)
        if (off <= error).all():
            return times
        times = np.sort(np.concatenate([times, (times[:-1] + times[1:])[off > error] / 2]))
