"""Inverse kinematics, and tracking of end-effector paths with the joints.

Both find the configuration of best posture among those with the end effector in the right place, for whole batches.
`Robot.tracking` holds what may be chosen about it. Lengths are metres, angles radians, positions and directions in the
robot's base frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dt_viz.flows.fields import Array
from dt_viz.flows.rotations import apart, rotation
from dt_viz.kernels.tracking import Postures, settle, walk
from dt_viz.robot.robot import Robot
from dt_viz.scheduler import checkpoint


class UnreachableError(ValueError):
    """No configuration inside the joint limits puts the end effector at the target."""


@dataclass(frozen=True, eq=False)
class TrackedPath:
    """A joint trajectory that follows an end-effector path."""

    q: Array  # (*B, T, n) joint angles, rad, inside the limits; continuous joints unwrapped
    error: Array  # (*B, T) distance of the end effector from the path, metres
    limits_hit: NDArray[np.bool_]  # (*B, T) whether a joint was held at its limit
    manipulability: Array  # (*B, T) sqrt det(J Jᵀ), m³
    damped: NDArray[np.bool_]
    """(*B, T) whether the manipulability is that of a singularity: the pseudo-inverse is no longer the exact
    Moore-Penrose one there, which would move the joints fast for little motion of the hand."""
    turned: Array  # (*B, T) angle of the hand from the orientation that is wanted, rad; 0 without one


def inverse_kinematics(
    robot: Robot,
    target: ArrayLike,
    seed: ArrayLike | None = None,
    hand_direction: ArrayLike | None = None,
    orientation: ArrayLike | None = None,
) -> Array:
    """Find a natural configuration inside the joint limits with the end effector at the target: the best of `arriving`.

    Damped Gauss-Newton steps run from many starts at once: the seed, the ready pose turned towards the target, and
    random ones around both (always the same). Among those that arrive, the one with the best posture wins: near the
    seed, hand pointing as wanted, away from joint limits, no joint below the table z = 0. The arm's collisions with
    itself are not considered.

    Args:
        robot: the arm.
        target: (3,) metres, base frame.
        seed: (n,) rad, posture to stay near; by default the ready pose turned towards the target.
        hand_direction: (3,) desired direction of the hand, base frame, any length; weighed against the rest of the
            posture. By default the seed's direction, or without a seed outwards and `hand_pitch` below horizontal.
        orientation: (4,) desired orientation of the hand, wxyz, in place of its direction; as near as the place allows.

    Returns:
        (n,) joint angles, rad; continuous joints within π of the seed.

    Raises:
        UnreachableError: No start arrived. The message says by how much the best one missed.
    """
    return arriving(robot, target, seed, hand_direction, orientation)[0]


def arriving(
    robot: Robot,
    target: ArrayLike,
    seed: ArrayLike | None = None,
    hand_direction: ArrayLike | None = None,
    orientation: ArrayLike | None = None,
) -> Array:
    """Find all configurations (K, n), rad, to which the starts of `inverse_kinematics` lead, the best first.

    Arguments and errors are those of that.
    """
    checkpoint()
    settings, target = robot.sized_tracking, np.asarray(target, dtype=float)
    ahead, left = np.array(robot.front), np.array([-robot.front[1], robot.front[0], 0.0])
    azimuth = np.arctan2(left @ target, ahead @ target)  # 0 ahead of the base
    ready = robot.home.copy()
    ready[0] += np.round(robot.joint_rotations[0, 2, 2]) * azimuth  # whichever way the first joint's axis points
    ready = robot.clip(ready)
    if seed is None:
        reference = ready
        direction = np.sin(azimuth) * left + np.cos(azimuth) * ahead
        direction[2] = -np.tan(settings.hand_pitch)
    else:
        reference = np.asarray(seed, dtype=float)
        direction = robot.hand_direction(reference)
    weight = settings.direction_weight
    if hand_direction is not None:
        direction, weight = np.asarray(hand_direction, dtype=float), settings.asked_direction_weight
    if orientation is not None:
        weight = settings.first_orientation_weight
    wanted = targets_of(robot, target, orientation)
    direction = direction / np.linalg.norm(direction)

    scatter = np.random.default_rng(0).normal(scale=0.8, size=(settings.num_restarts, robot.num_joints))
    scatter[:2] = 0.0
    starts = np.where(np.arange(len(scatter))[:, None] % 2 == 0, reference, ready) + scatter
    posture = _posture(robot, reference[None], direction[None], weight)
    targets, which, q = np.tile(wanted, (len(starts), 1)), np.zeros(len(starts), int), robot.clip(starts)
    for iteration in range(settings.max_iterations):  # all go on until each has come to rest
        improves = iteration < settings.max_iterations - settings.final_sweeps
        before, q = q, settle(robot.tracking_arm, posture, q, targets, which, int(improves), int(not improves), -1.0)
        if np.abs(q - before).max() < 1e-6:
            break
    if orientation is not None:
        q = _turned_to(robot, q, targets, which, posture, settings.turning_sweeps)

    q -= 2 * np.pi * np.where(np.isinf(robot.upper), np.round((q - reference) / (2 * np.pi)), 0.0)
    chain = robot.chain(q.T)
    miss = np.linalg.norm(chain.position - target[:, None], axis=0)
    if miss.min() > settings.tolerance:
        raise UnreachableError(
            f"no configuration reaches {np.round(target, 3).tolist()} m: the nearest misses by {miss.min():.3f} m. "
            f"The arm reaches at most {robot.reach:.2f} m from its shoulder at {robot.shoulder.tolist()} m; "
            f"the target is {np.linalg.norm(target - robot.shoulder):.2f} m from it."
        )
    excess = q - np.clip(q, posture.soft_lower, posture.soft_upper)
    cost = ((q - reference) ** 2 + settings.limit_weight * excess**2).sum(axis=1) / 2  # h(q) of `track`
    if orientation is None:
        cost += weight / 2 * ((chain.direction - direction[:, None]) ** 2).sum(axis=0)
    else:
        off = apart(robot.hand_orientation(q), np.broadcast_to(orientation, (len(q), 4)))
        cost += settings.orientation_weight / 2 * off**2
    cost += settings.floor_weight * np.maximum(0.0, -chain.origins[:, 2]).sum(axis=0)
    cost[miss > settings.tolerance] = np.inf
    return q[np.argsort(cost, kind="stable")[: np.isfinite(cost).sum()]]


def best_start(robot: Robot, path: Array, orientations: Array) -> Array:
    """Find the posture (n,), rad, from which an arm follows a path (T, 3) with orientations (T, 4) of the hand best.

    Where the wrist turns far, its joints reach their limits from one branch and not from another.

    Raises:
        UnreachableError: as `inverse_kinematics`, of the first place.
    """
    settings, starts = robot.sized_tracking, arriving(robot, path[0], orientation=orientations[0])
    paths, wanted = (np.broadcast_to(each, (len(starts), *each.shape)) for each in (path, orientations))
    tracked = track(robot, paths, starts, orientations=wanted)
    missed = np.maximum(tracked.error.max(axis=1) - settings.tolerance, 0) / settings.turn_length
    off = missed + tracked.turned.max(axis=1)
    return starts[np.argmax(off <= off.min() + settings.as_well_turned)]  # the first of those is the best posture


def track(
    robot: Robot,
    path: ArrayLike,
    start: ArrayLike,
    initial: ArrayLike | None = None,
    reference: ArrayLike | None = None,
    orientations: ArrayLike | None = None,
) -> TrackedPath:
    """Follow end-effector paths with the joints.

    Every waypoint solves  q_k = argmin h(q)  subject to  x(q) = x_k, with

        h(q) = ½‖q − q_ref‖² + ½·w_d‖d(q) − d(q_ref)‖² + springs before the joint limits,

    d the direction of the hand. The step is the resolved-rate step with drift correction, written with the
    Moore-Penrose pseudo-inverse J# in the metric of h's second derivative, damped as in `dt_viz.kernels.tracking`:

        δq = J#(x_k − x(q)) − (I − J#J) H⁻¹∇h.

    Since h is measured from one reference, q depends on the position of the end effector, not on its history: paths
    that return give joints that return, a dragged path changes its joints continuously, and all paths with the same
    reference are lifted by one section x → q(x), as long as their starts lie on its branch. As waypoints do not depend
    on each other, all of them step at once. A cold start first walks along the path in strides, one step each, to stay
    on one branch; this also bridges jumps between samples.

    Where the hand is to have orientations, h counts the square of the angle θ from them in place of the direction, by
    `orientation_weight`: ½·w_o·θ². The place comes first, so that an arm of five joints turns as far as it can.

    Waypoints out of reach get the nearest reachable position inside the limits; see `error`.

    Args:
        robot: the arm.
        path: (*B, T, 3) waypoints, metres, base frame. They need not be evenly spaced.
        start: (*B, n) configuration to start from, rad; usually reaches the first waypoint.
        initial: (*B, T, n) tracked joints of a nearby path, rad, from the same start: a warm start for live
            dragging. If its joints jump, a cold start follows.
        reference: (*B, n) or (n,) configuration q_ref that the posture is measured from, rad; by default the start.
        orientations: (*B, T, 4) of the hand at the waypoints, wxyz; None wants none.

    Returns:
        The joint path with its error and the interference of limits and singularities.

    Raises:
        ValueError: `start`, `initial`, `reference` or `orientations` do not fit the shape of `path`.
    """
    path, start = np.asarray(path, dtype=float), np.asarray(start, dtype=float)
    if path.shape[-1] != 3 or start.shape != (*path.shape[:-2], robot.num_joints):
        raise ValueError(f"path must be (*B, T, 3) and start (*B, n), got {path.shape} and {start.shape}")
    shape = (*path.shape[:-1], robot.num_joints)
    targets, starts = targets_of(robot, path, orientations), robot.clip(start.reshape(-1, robot.num_joints))
    paths = targets.reshape(-1, *targets.shape[-2:])
    references = starts if reference is None else _references(robot, reference, start.shape)
    settings, turns = robot.sized_tracking, orientations is not None
    posture = _near(robot, references, settings.first_orientation_weight if turns else None)
    strides, each = [robot.sized_tracking.stride, robot.sized_tracking.stride / 4], np.arange(len(paths))
    if initial is None:
        guess = _walk(robot, paths, starts, posture, strides.pop(0))
    else:
        guess = np.asarray(initial, dtype=float)
        if guess.shape != shape:
            raise ValueError(f"initial must be {shape} like the path, got {guess.shape}")
    q = _swept(robot, guess.reshape(*paths.shape[:2], robot.num_joints), paths, posture, each)
    for stride in strides:
        lost = np.flatnonzero(loses_branch(robot, q, paths))
        if not len(lost):
            break
        part = Postures(*(field[lost] for field in posture))
        q[lost] = _swept(robot, _walk(robot, paths[lost], starts[lost], part, stride), paths[lost], posture, lost)
    if turns:
        q, every = q.reshape(-1, robot.num_joints), np.repeat(each, path.shape[-2])
        q = _turned_to(robot, q, paths.reshape(-1, 12).copy(), every, posture, settings.turning_sweeps)
    return _report(robot, q.reshape(shape), path, orientations)


def drawn_onto(robot: Robot, q: Array, positions: Array, reference: Array, orientations: Array | None = None) -> Array:
    """Correct postures q (N, n), rad, by small motions so that the end effector is at nearby positions (N, 3), metres.

    The reference (n,) and the orientations (N, 4) are as in `track`. Postures stay inside the limits; for a position
    out of reach they are near it.
    """
    settings, turns = robot.sized_tracking, orientations is not None
    posture = _near(robot, reference[None], settings.first_orientation_weight if turns else None)
    begin, targets = np.array(q, order="C"), np.array(targets_of(robot, positions, orientations), order="C")
    which = np.zeros(len(q), int)
    if turns:
        return _turned_to(robot, begin, targets, which, posture, settings.final_sweeps)
    return settle(robot.tracking_arm, posture, begin, targets, which, 0, settings.final_sweeps, -1.0)


def _turned_to(
    robot: Robot, q: Array, targets: Array, which: NDArray[np.intp], posture: Postures, sweeps: int
) -> Array:
    """Turn hands to orientations, as far as their places allow; q (N, n) nearly so, with a lower weight, in `posture`.

    The whole weight makes positions converge slowly near singularities, so that these are corrected with the lower one.
    """
    settings, arm = robot.sized_tracking, robot.tracking_arm
    firm = posture._replace(direction_weight=np.full_like(posture.direction_weight, settings.orientation_weight))
    q = settle(arm, firm, q, targets, which, sweeps, 0, settings.step_tolerance)
    return settle(arm, posture, q, targets, which, 0, sweeps, -1.0)


def targets_of(robot: Robot, positions: Array, orientations: ArrayLike | None) -> Array:
    """Places (*B, 3) of the end effector; or with orientations (*B, 4) of it those of the last joint, too, (*B, 12)."""
    if orientations is None:
        return positions
    wanted = np.asarray(orientations, dtype=float)
    if wanted.shape != (*positions.shape[:-1], 4):
        raise ValueError(f"orientations must be (*B, T, 4) like the path, got {wanted.shape}")
    columns = robot.hand_rotation @ rotation(wanted.reshape(-1, 4)).as_matrix().transpose(0, 2, 1)
    return np.concatenate([positions, columns.reshape(*positions.shape[:-1], 9)], axis=-1)


def _along(robot: Robot, targets: Array) -> Array:
    """Targets (*B, 3 or 12) whose distances are lengths along a path: a turn by an angle θ moves columns by √2·θ."""
    turns = np.full(targets.shape[-1], robot.sized_tracking.turn_length / np.sqrt(2))
    turns[:3] = 1.0
    return targets if targets.shape[-1] == 3 else turns * targets


def _references(robot: Robot, reference: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return the reference configurations (B, n), one for each start; `shape` is that of the starts, (*B, n)."""
    reference = np.asarray(reference, dtype=float)
    if reference.shape not in {shape, shape[-1:]}:
        raise ValueError(f"reference must be {shape} like the start, or one for all, got {reference.shape}")
    return robot.clip(np.broadcast_to(reference, shape).reshape(-1, robot.num_joints))


def _walk(robot: Robot, paths: Array, starts: Array, posture: Postures, stride: float) -> Array:
    """Walk along targets (B, T, 3 or 12), all at once, one stride after the other; return rough joints (B, T, n)."""
    checkpoint()
    begin = robot.end_effector(starts)
    if paths.shape[-1] > 3:
        begin = targets_of(robot, begin, robot.hand_orientation(starts))
    lines = np.concatenate([begin[:, None], paths], axis=1)
    lengths = np.cumsum(np.linalg.norm(np.diff(_along(robot, lines), axis=1), axis=-1), axis=1)
    num_strides = 1 + int(lengths.max() / stride)
    lines, lengths = (np.array(values, order="C") for values in (lines, np.insert(lengths, 0, 0.0, axis=1)))
    return walk(robot.tracking_arm, posture, lines, lengths, np.array(starts), num_strides)


def _swept(robot: Robot, q: Array, paths: Array, posture: Postures, which: NDArray[np.intp]) -> Array:
    """Step all waypoints until none moves; q (B, T, n), targets (B, T, …), `which` (B,) of the postures they have."""
    each, settings = np.repeat(which, paths.shape[1]), robot.sized_tracking
    begin, targets = (np.array(part.reshape(-1, part.shape[-1]), order="C") for part in (q, paths))
    improving = settings.max_sweeps if paths.shape[-1] == 3 else settings.turning_sweeps
    limits = improving, settings.final_sweeps, settings.step_tolerance
    return settle(robot.tracking_arm, posture, begin, targets, each, *limits).reshape(q.shape)


def _report(robot: Robot, q: Array, path: Array, orientations: ArrayLike | None) -> TrackedPath:
    chain = robot.chain(q.reshape(-1, robot.num_joints).T)
    manipulability = chain.manipulability().reshape(path.shape[:-1])
    turned = np.zeros(path.shape[:-1])
    if orientations is not None:
        wanted, flat = np.asarray(orientations, dtype=float).reshape(-1, 4), q.reshape(-1, robot.num_joints)
        turned = apart(robot.hand_orientation(flat), wanted).reshape(turned.shape)
    return TrackedPath(
        q=q,
        error=np.linalg.norm(chain.position.T.reshape(path.shape) - path, axis=-1),
        limits_hit=np.any((q <= robot.lower) | (q >= robot.upper), axis=-1),
        manipulability=manipulability,
        damped=manipulability < robot.sized_tracking.singular_manipulability,
        turned=turned,
    )


def soft_limits(robot: Robot, reference: Array, *, at_reference: bool = True) -> tuple[Array, Array]:
    """Find where the springs of references (*B, n) start: `at_reference` not before these, which are optima then."""
    margin = robot.sized_tracking.limit_margin
    lower, upper = np.broadcast_arrays(robot.lower + margin, robot.upper - margin, reference)[:2]
    return (np.minimum(lower, reference), np.maximum(upper, reference)) if at_reference else (lower, upper)


def _near(robot: Robot, references: Array, weight: float | None) -> Postures:
    """Make the posture of references (B, n) along paths; None is the usual weight of the hand's direction."""
    return _posture(robot, references, robot.hand_direction(references), weight, at_reference=True)


def _posture(
    robot: Robot, reference: Array, direction: Array, weight: float | None = None, *, at_reference: bool = False
) -> Postures:
    """Make the posture of references (B, n); see `soft_limits`. None is the usual weight of the direction."""
    weight = robot.sized_tracking.direction_weight if weight is None else weight
    soft_lower, soft_upper = soft_limits(robot, reference, at_reference=at_reference)
    arrays = reference, direction, soft_lower, soft_upper, np.full(len(reference), weight)
    return Postures(*(np.array(values, order="C") for values in arrays))


def loses_branch(robot: Robot, q: Array, paths: Array) -> NDArray[np.bool_]:
    """Find which (B,) joints (B, T, n) jump by more than a continuous solution along targets (B, T, …) can."""
    moved = np.linalg.norm(np.diff(_along(robot, paths), axis=1), axis=-1)
    allowed = 0.05 + robot.sized_tracking.jump_per_root_metre * np.sqrt(moved)  # the constant is for repeated samples
    return np.any(np.abs(np.diff(q, axis=1)) > allowed[..., None], axis=(1, 2))
