"""Placement of a task in an arm's reach: moved and scaled so that the arm follows it."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.robot.inverse_kinematics import UnreachableError, best_start, inverse_kinematics, track
from dt_viz.robot.robot import Robot

REFERENCE_SHOULDER = (0.0, 0.0, 0.28)
"""Place of the JACO's shoulder, metres, which tasks were made for."""
# Lengths are parts of the arm's reach where nothing else is stated.
SCALES = (1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4, 0.3, 0.2)  # scales that are tried, in the first one
AHEAD = (0.0, -0.1, 0.1, -0.2)  # moves ahead that are tried
UP = (0.0, 0.1, 0.2, 0.3)  # moves upwards that are tried
NUM_SAMPLES = 40  # number of samples of each path that are followed
TURNED = 0.1  # angle of the hand from its orientations up to which these are followed, rad
ERROR = 1e-3  # distance of the hand from a path up to which it is followed, metres
ROOM = 0.01  # distance of links from each other that is kept, metres


def is_jaco(robot: Robot) -> bool:
    """Return whether an arm has the JACO's size and shoulder, for which tasks and scenes of the paper were made."""
    return robot.size == 1.0 and tuple(robot.shoulder) == REFERENCE_SHOULDER


@dataclass(frozen=True)
class Placement:
    """A map of space that scales and moves: x ↦ scale·x + shift."""

    scale: float
    shift: tuple[float, float, float]  # metres

    def __call__(self, points: Array) -> Array:
        """Map points (*B, 3), metres."""
        return self.scale * np.asarray(points) + np.array(self.shift)


def place(
    robot: Robot,
    paths: Sequence[Array],
    scale: float | None = None,
    *,
    on_table: bool = False,
    orientations: Sequence[Array] | None = None,
) -> Placement:
    """Find where an arm follows the paths of a task that was made for the JACO, or for an arm of its size.

    They are scaled about the shoulder, by the arm's reach first, and moved a little where that is not enough; inverse
    kinematics decides, within the limits, away from singularities, above the table and clear of the arm itself.

    Args:
        robot: the arm.
        paths: (T, 3) positions of the hand on each, metres, with the arm's front at −y.
        scale: the scale that is wanted; None takes the largest that fits, up to that of the arm's reach.
        on_table: whether heights above the table are scaled only.
        orientations: (T, 4) of the hand on each, wxyz, that are followed, too.

    Raises:
        UnreachableError: No place fits, at the scale that is wanted; it says which one would.
    """
    sampled = np.array([resampled(path, NUM_SAMPLES) for path in paths])
    wanted = None if orientations is None else np.array([resampled(each, NUM_SAMPLES) for each in orientations])
    first = robot.size if scale is None else scale
    placement = fitting(robot, sampled, first, on_table=on_table, orientations=wanted)
    if scale is not None and placement.scale < scale:
        way_out = f"the largest scale that fits is about {placement.scale:.2g}"
        raise UnreachableError(f"{robot.title} cannot follow the task at the scale {scale:.3g}: {way_out}")
    return placement


def fitting(
    robot: Robot,
    paths: Array,
    scale: float,
    *,
    on_table: bool = False,
    orientations: Array | None = None,
) -> Placement:
    """Find where an arm follows paths (R, T, 3), metres, at the largest scale up to a given one; see `place`.

    Raises:
        UnreachableError: no place fits.
    """
    for part in SCALES:
        for placement in _candidates(robot, paths, part * scale, on_table):
            if follows(robot, placement(paths), orientations):
                return placement
    least = SCALES[-1] * scale
    raise UnreachableError(f"{robot.title} cannot follow the task anywhere ahead of it, even at the scale {least:.2g}")


def follows(robot: Robot, paths: Array, orientations: Array | None = None) -> bool:
    """Return whether an arm follows paths (R, T, 3), metres, from their starts, with orientations (R, T, 4) if any."""
    if paths[..., 2].min() < 0:
        return False
    try:
        if orientations is None:
            reference = inverse_kinematics(robot, paths[0, -1])
            starts = np.array([inverse_kinematics(robot, path[0], seed=reference) for path in paths])
        else:
            reference = best_start(robot, paths[0], orientations[0])
            starts = np.broadcast_to(reference, (len(paths), robot.num_joints))
    except UnreachableError:
        return False
    tracked = track(robot, paths, starts, reference=reference, orientations=orientations)
    missed = tracked.error.max() > ERROR or tracked.turned.max() > TURNED
    if missed or tracked.limits_hit.any() or tracked.damped.any():
        return False
    for q in tracked.q:
        above = robot.links.positions(robot, q)[..., 2] > robot.links.radius
        if robot.self_clearance(q, ROOM) >= ROOM and above.all():
            continue  # by the spheres around the links, which are quick
        near = robot.collision.nearest_to_itself(q[::4])
        if (near is not None and near.distance < ROOM) or robot.collision.nearest_to_table(q[::4]).distance < 0:
            return False
    return True


def _candidates(robot: Robot, paths: Array, scale: float, on_table: bool) -> Iterator[Placement]:
    """Yield placements at a scale, the least moved first: about the shoulder, but no lower above the table."""
    about = robot.shoulder - scale * np.array(REFERENCE_SHOULDER)
    about[2] = max(about[2], min(1.0 - scale, 0.0) * paths[..., 2].min())
    about[2] *= not on_table
    moves = sorted(product(AHEAD, (0.0,) if on_table else UP), key=lambda move: abs(move[0]) + abs(move[1]))
    for ahead, up in moves:
        x, y, z = about + robot.reach * np.array([0.0, -ahead, up])
        yield Placement(scale, (float(x), float(y), float(z)))


def resampled(path: Array, num: int) -> Array:
    """Take samples (num, 3) of a path (T, 3)."""
    return np.asarray(path, dtype=float)[np.linspace(0, len(path) - 1, num).round().astype(int)]
