"""Inverse kinematics, and tracking of end-effector paths with the joints.

Both find the configuration of best posture among those with the end effector in the right place, for whole batches.
Lengths are metres, angles radians, positions and directions in the robot's base frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from dt_viz.arm.robot import NUM_JOINTS, KinematicChain, Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dt_viz.flows.fields import Array


HAND_PITCH = np.deg2rad(40.0)
"""Default angle of the hand below horizontal, rad."""

DIRECTION_WEIGHT = 1.5
"""Weight w_d of the hand's direction (unit vectors) against joint angles (rad). Much above 2, the best posture stops
being unique and tracked joints jump between wrist postures."""
ASKED_DIRECTION_WEIGHT = 40.0
"""Weight w_d where inverse kinematics is given a direction: it chooses one posture and need not be continuous."""
LIMIT_WEIGHT = 50.0
"""Weight of the springs before the joint limits, against 1 for staying near the reference."""
LIMIT_MARGIN = 0.15
"""Distance from the limit at which those springs start, rad."""
DAMPING_FLOOR = 1e-6
"""Least damping λ₀² of the pseudo-inverse, m²: bounds the step at a singularity, is negligible elsewhere."""
DAMPING_PER_ERROR = 0.2
"""Growth of λ² with the remaining error, m: about half the curvature of the forward kinematics."""
CURVATURE = 0.1
"""Curvature of the forward kinematics along the null space, m per rad²; see `_newton`."""
STEP_LIMIT = 0.4
"""Largest joint motion in one step, rad; beyond it the linear model is invalid."""

STRIDE = 0.08
"""Distance along the path that a cold start covers in one step, metres."""
MAX_SWEEPS, FINAL_SWEEPS = 8, 3
"""Largest number of sweeps, and of those after them that keep the posture and only correct the positions."""
STEP_TOLERANCE = 1e-3
"""Step, rad, below which a waypoint is done: the remaining error is about its square times the reach."""
JUMP_PER_ROOT_METRE = 4.0
"""Joint motion over the root of the hand's, rad/√m, above which a warm start has lost its branch. The stretched arm
follows the root: 0.4 rad bend it by 2 cm."""
SINGULAR_MANIPULABILITY = 3e-3
"""Manipulability, m³, below which the damping takes about 1 % or more of a step; the workspace has 0.05 to 0.2."""

NUM_RESTARTS = 24
IK_ITERATIONS = 60
IK_TOLERANCE = 1e-5
"""Distance from the target, metres, below which it counts as reached."""
NUM_CORRECTIONS = 3
"""Number of Newton steps from an error of millimetres to rounding; their convergence is quadratic."""
FLOOR_WEIGHT = 100.0
"""Cost per metre of a joint below the table, where inverse kinematics chooses among its solutions."""


class UnreachableError(ValueError):
    """No configuration inside the joint limits puts the end effector at the target."""


@dataclass(frozen=True, eq=False)
class JointPath:
    """A joint trajectory that follows an end-effector path.

    Attributes:
        q: (*B, T, 6) joint angles, rad, inside the limits; continuous joints unwrapped.
        error: (*B, T) distance of the end effector from the path, metres.
        limits_hit: (*B, T) whether a joint was held at its limit.
        manipulability: (*B, T) sqrt det(J Jᵀ), m³.
        damped: (*B, T) whether the manipulability is below `SINGULAR_MANIPULABILITY`: the pseudo-inverse is no longer
            the exact Moore-Penrose one there, which would move the joints fast for little motion of the hand.
    """

    q: Array
    error: Array
    limits_hit: NDArray[np.bool_]
    manipulability: Array
    damped: NDArray[np.bool_]


class _Posture(NamedTuple):
    """Secondary objective in the null space; one column for each configuration, or one for all."""

    reference: Array  # (6, N) or (6, 1), rad
    direction: Array  # (3, N) or (3, 1), unit vectors, base frame
    soft_lower: Array  # (6, N) or (6, 1), rad, starts of the springs before the limits
    soft_upper: Array
    direction_weight: Array  # (1, N) or (1, 1), against 1 for the reference

    def take(self, columns: NDArray[np.intp]) -> _Posture:
        """Select the postures of some columns, in their order."""
        return _Posture(*(field[:, columns] for field in self))


def inverse_kinematics(
    robot: Robot, target: ArrayLike, seed: ArrayLike | None = None, hand_direction: ArrayLike | None = None
) -> Array:
    """Find a natural configuration inside the joint limits with the end effector at the target.

    Damped Gauss-Newton steps run from many starts at once: the seed, the ready pose turned towards the target, and
    random ones around both (always the same). Among those that arrive, the one with the best posture wins: near the
    seed, hand pointing as wanted, away from joint limits, no joint below the table z = 0. The arm's collisions with
    itself are not considered.

    Args:
        robot: the arm.
        target: (3,) metres, base frame.
        seed: (6,) rad, posture to stay near; by default the ready pose turned towards the target.
        hand_direction: (3,) desired direction of the hand, base frame, any length; weighed against the rest of the
            posture. By default the seed's direction, or without a seed outwards and `HAND_PITCH` below horizontal.

    Returns:
        (6,) joint angles, rad; continuous joints within π of the seed.

    Raises:
        UnreachableError: No start arrived. The message says by how much the best one missed.
    """
    target = np.asarray(target, dtype=float)
    azimuth = np.arctan2(target[0], -target[1])  # 0 ahead of the base
    ready = robot.home.copy()
    ready[0] -= azimuth
    if seed is None:
        reference = ready
        direction = np.array([np.sin(azimuth), -np.cos(azimuth), -np.tan(HAND_PITCH)])
    else:
        reference = np.asarray(seed, dtype=float)
        direction = robot.hand_direction(reference)
    weight = DIRECTION_WEIGHT
    if hand_direction is not None:
        direction, weight = np.asarray(hand_direction, dtype=float), ASKED_DIRECTION_WEIGHT
    direction = direction / np.linalg.norm(direction)

    scatter = np.random.default_rng(0).normal(scale=0.8, size=(NUM_RESTARTS, NUM_JOINTS))
    scatter[:2] = 0.0
    starts = np.where(np.arange(NUM_RESTARTS)[:, None] % 2 == 0, reference, ready) + scatter
    q = robot.clip(starts).T
    posture = _posture(robot, reference[:, None], direction[:, None], weight)
    for iteration in range(IK_ITERATIONS):
        gain = 1.0 if iteration < IK_ITERATIONS - FINAL_SWEEPS else 0.0
        q, step = _newton(robot, q, target[:, None], posture, gain)
        if step.max() < 1e-6:
            break

    turns = np.where(np.isinf(robot.upper), np.round((q.T - reference) / (2 * np.pi)), 0.0)
    q -= 2 * np.pi * turns.T
    chain = robot.chain(q)
    miss = np.linalg.norm(chain.position - target[:, None], axis=0)
    if miss.min() > IK_TOLERANCE:
        shoulder = robot.joint_translations[0] + robot.joint_rotations[0] @ robot.joint_translations[1]
        shoulder = np.round(shoulder, 2) + 0.0  # the sum turns -0 into 0
        raise UnreachableError(
            f"no configuration reaches {np.round(target, 3).tolist()} m: the nearest misses by {miss.min():.3f} m. "
            f"The arm reaches at most {robot.reach:.2f} m from its shoulder at {shoulder.tolist()} m; "
            f"the target is {np.linalg.norm(target - shoulder):.2f} m from it."
        )
    cost = _posture_cost(q, chain, posture) + FLOOR_WEIGHT * np.maximum(0.0, -chain.origins[:, 2]).sum(axis=0)
    return q[:, np.argmin(np.where(miss <= IK_TOLERANCE, cost, np.inf))]


def track(
    robot: Robot,
    path: ArrayLike,
    start: ArrayLike,
    initial: ArrayLike | None = None,
    reference: ArrayLike | None = None,
) -> JointPath:
    """Follow end-effector paths with the joints.

    Every waypoint solves  q_k = argmin h(q)  subject to  x(q) = x_k, with

        h(q) = ½‖q − q_ref‖² + ½·w_d‖d(q) − d(q_ref)‖² + springs before the joint limits,

    d the direction of the hand. The step is the resolved-rate step with drift correction, written with the
    Moore-Penrose pseudo-inverse J# in the metric of h's second derivative, damped as in `_newton`:

        δq = J#(x_k − x(q)) − (I − J#J) H⁻¹∇h.

    Since h is measured from one reference, q depends on the position of the end effector, not on its history: paths
    that return give joints that return, a dragged path changes its joints continuously, and all paths with the same
    reference are lifted by one section x → q(x), as long as their starts lie on its branch. As waypoints do not depend
    on each other, all of them step at once. A cold start first walks along the path in strides of `STRIDE`, one step
    each, to stay on one branch; this also bridges jumps between samples.

    Waypoints out of reach get the nearest reachable position inside the limits; see `error`.

    Args:
        robot: the arm.
        path: (*B, T, 3) waypoints, metres, base frame. They need not be evenly spaced.
        start: (*B, 6) configuration to start from, rad; usually reaches the first waypoint.
        initial: (*B, T, 6) tracked joints of a nearby path, rad, from the same start: a warm start for live
            dragging. If its joints jump, a cold start follows.
        reference: (*B, 6) or (6,) configuration q_ref that the posture is measured from, rad; by default the start.

    Returns:
        The joint path with its error and the interference of limits and singularities.

    Raises:
        ValueError: `start`, `initial` or `reference` do not fit the shape of `path`.
    """
    path, start = np.asarray(path, dtype=float), np.asarray(start, dtype=float)
    if path.shape[-1] != 3 or start.shape != (*path.shape[:-2], NUM_JOINTS):
        raise ValueError(f"path must be (*B, T, 3) and start (*B, 6), got {path.shape} and {start.shape}")
    shape = (*path.shape[:-1], NUM_JOINTS)
    paths, starts = path.reshape(-1, *path.shape[-2:]), robot.clip(start.reshape(-1, NUM_JOINTS))
    references = starts if reference is None else _references(robot, reference, start.shape)
    posture = _posture(robot, references.T, robot.hand_direction(references).T, at_reference=True)
    strides = [STRIDE, STRIDE / 4]
    if initial is None:
        guess = _walk(robot, paths, starts, posture, strides.pop(0))
    else:
        guess = np.asarray(initial, dtype=float)
        if guess.shape != shape:
            raise ValueError(f"initial must be {shape} like the path, got {guess.shape}")
    q = _sweep(robot, guess.reshape(*paths.shape[:2], NUM_JOINTS), paths, posture)
    for stride in strides:
        lost = np.flatnonzero(_loses_branch(q, paths))
        if not len(lost):
            break
        part = posture.take(lost)
        q[lost] = _sweep(robot, _walk(robot, paths[lost], starts[lost], part, stride), paths[lost], part)
    return _report(robot, q.reshape(shape), path)


def drawn_onto(robot: Robot, q: Array, positions: Array, reference: Array) -> Array:
    """Correct postures by small motions so that the end effector is at given positions.

    Args:
        robot: the arm.
        q: (N, 6) postures a few millimetres off, rad.
        positions: (N, 3) desired positions of the end effector, metres.
        reference: (6,) as in `track`, rad.

    Returns:
        (N, 6) rad, inside the limits; for a position out of reach a posture near it.
    """
    posture = _posture(robot, reference[:, None], robot.hand_direction(reference)[:, None], at_reference=True)
    columns, target = q.T, np.ascontiguousarray(positions.T)
    for _ in range(NUM_CORRECTIONS):
        columns, _ = _newton(robot, columns, target, posture, gain=0.0)
    return columns.T


def _references(robot: Robot, reference: ArrayLike, shape: tuple[int, ...]) -> Array:
    """Return the reference configurations (B, 6), one for each start; `shape` is that of the starts, (*B, 6)."""
    reference = np.asarray(reference, dtype=float)
    if reference.shape not in {shape, shape[-1:]}:
        raise ValueError(f"reference must be {shape} like the start, or one for all, got {reference.shape}")
    return robot.clip(np.broadcast_to(reference, shape).reshape(-1, NUM_JOINTS))


def _walk(robot: Robot, paths: Array, starts: Array, posture: _Posture, stride: float) -> Array:
    """Walk along paths (B, T, 3), all at once, one stride after the other; return rough joints (B, T, 6)."""
    lines = np.concatenate([robot.end_effector(starts)[:, None], paths], axis=1)
    lengths = np.cumsum(np.linalg.norm(np.diff(lines, axis=1), axis=-1), axis=1)
    num_strides = 1 + int(lengths.max() / stride)
    progress = np.linspace(0.0, 1.0, num_strides + 1)
    knots = np.empty((num_strides + 1, 3, len(paths)))
    for b, line in enumerate(lines):
        travelled = np.concatenate([[0.0], lengths[b]])
        for axis in range(3):
            knots[:, axis, b] = np.interp(progress * travelled[-1], travelled, line[:, axis])
    q = np.empty((num_strides + 1, NUM_JOINTS, len(paths)))
    q[0] = starts.T
    for k in range(1, num_strides + 1):
        q[k], _ = _newton(robot, q[k - 1], knots[k], posture)
    # interpolate at the waypoints, linearly in the distance travelled
    place = lengths / np.maximum(lengths[:, -1:], 1e-12) * num_strides  # (B, T)
    left = np.minimum(place.astype(int), num_strides - 1)
    fraction = (place - left)[..., None]
    rows = np.arange(len(paths))[:, None]
    return (1 - fraction) * q[left, :, rows] + fraction * q[left + 1, :, rows]


def _sweep(robot: Robot, q: Array, paths: Array, posture: _Posture) -> Array:
    """Step all waypoints at once until none moves; q (B, T, 6), paths (B, T, 3), posture of B columns."""
    shape, targets = q.shape, np.array(paths.reshape(-1, 3).T, order="C")
    q = np.array(q.reshape(-1, NUM_JOINTS).T, order="C")
    posture = posture.take(np.repeat(np.arange(shape[0]), shape[1]))
    moving = np.arange(q.shape[1])
    for sweep in range(MAX_SWEEPS + FINAL_SWEEPS):
        gain = 1.0 if sweep < MAX_SWEEPS else 0.0
        q[:, moving], step = _newton(robot, q[:, moving], targets[:, moving], posture.take(moving), gain)
        moving = moving[step > STEP_TOLERANCE]
        if not len(moving):
            break
    return np.ascontiguousarray(q.T).reshape(shape)


def _report(robot: Robot, q: Array, path: Array) -> JointPath:
    chain = robot.chain(q.reshape(-1, NUM_JOINTS).T)
    manipulability = chain.manipulability().reshape(path.shape[:-1])
    return JointPath(
        q=q,
        error=np.linalg.norm(chain.position.T.reshape(path.shape) - path, axis=-1),
        limits_hit=np.any((q <= robot.lower) | (q >= robot.upper), axis=-1),
        manipulability=manipulability,
        damped=manipulability < SINGULAR_MANIPULABILITY,
    )


def _posture(
    robot: Robot, reference: Array, direction: Array, weight: float = DIRECTION_WEIGHT, *, at_reference: bool = False
) -> _Posture:
    """Make the posture of a reference (6, N); `at_reference` slackens the springs there, so that it is an optimum."""
    soft_lower = np.broadcast_to(robot.lower[:, None] + LIMIT_MARGIN, reference.shape)
    soft_upper = np.broadcast_to(robot.upper[:, None] - LIMIT_MARGIN, reference.shape)
    if at_reference:
        soft_lower, soft_upper = np.minimum(soft_lower, reference), np.maximum(soft_upper, reference)
    return _Posture(reference, direction, soft_lower, soft_upper, np.full((1, reference.shape[1]), weight))


def _newton(robot: Robot, q: Array, target: Array, posture: _Posture, gain: float = 1.0) -> tuple[Array, Array]:
    """Make one damped resolved-rate step towards the targets and improve the posture in the null space.

    With e = target − x(q), H ≈ ∇²h (Gauss-Newton) and p = −H⁻¹∇h:

        δq = J#(λ) e + c·(I − J#(λ₀) J) p,   J#(λ) = H⁻¹Jᵀ(J H⁻¹ Jᵀ + λ²I)⁻¹.

    λ² grows with ‖e‖, which keeps steps moderate far from the target and out of reach, and falls with it to the small
    λ₀² of the projector, so that the posture does not pull the hand off its target. μ = (J H⁻¹ Jᵀ + λ₀²I)⁻¹ J p are the
    multipliers of x(q) = target, and c = 1/(1 + κ‖μ‖) stands in for the curvature μ·∇²x that they add to H in the
    null space; without it the posture overshoots again and again near singularities.

    Args:
        robot: the arm.
        q: (6, N) rad.
        target: (3, N) or (3, 1), metres.
        posture: N columns, or one.
        gain: factor of the null-space part; 0 leaves the plain pseudo-inverse.

    Returns:
        The configurations (6, N) after the step, inside the limits, and the largest joint motion (N,), rad.
    """
    chain = robot.chain(q)
    J, D = chain.position_jacobian(), chain.direction_jacobian()  # (6, 3, N)
    error = target - chain.position
    excess = q - np.clip(q, posture.soft_lower, posture.soft_upper)

    # H = diag(1/mobility) + w_d DᵀD, inverted by Woodbury: only 3 x 3 systems are solved.
    mobility = 1.0 / (1.0 + LIMIT_WEIGHT * (excess != 0.0))  # (6, N)
    mobile_D = mobility[:, None] * D
    C = _spd_inverse(np.einsum("irn,isn->rsn", D, mobile_D), 1.0 / posture.direction_weight[0])
    gain_D = np.einsum("rsn,isn->irn", C, mobile_D)
    p = mobility * (posture.reference - q - LIMIT_WEIGHT * excess)
    turn = posture.direction - chain.direction - np.einsum("irn,in->rn", D, p)
    p = p + np.einsum("irn,rn->in", gain_D, turn)
    H_inv_J = mobility[:, None] * J - np.einsum("isn,srn->irn", gain_D, np.einsum("isn,irn->srn", mobile_D, J))
    S = np.einsum("irn,isn->rsn", J, H_inv_J)

    damping = DAMPING_FLOOR + DAMPING_PER_ERROR * np.sqrt((error**2).sum(axis=0))
    towards = np.einsum("rsn,sn->rn", _spd_inverse(S, damping), error)
    multipliers = np.einsum("rsn,sn->rn", _spd_inverse(S, DAMPING_FLOOR), np.einsum("irn,in->rn", J, p))
    caution = gain / (1.0 + CURVATURE * np.sqrt((multipliers**2).sum(axis=0)))
    step = caution * p + np.einsum("irn,rn->in", H_inv_J, towards - caution * multipliers)

    step *= np.minimum(1.0, STEP_LIMIT / np.maximum(np.abs(step).max(axis=0), 1e-12))
    moved = np.clip(q + step, robot.lower[:, None], robot.upper[:, None])
    return moved, np.abs(moved - q).max(axis=0)


def _spd_inverse(A: Array, damping: Array | float) -> Array:
    """Invert A + damping·I by cofactors; A (3, 3, N) symmetric, positive semidefinite."""
    a, b, c = A[0, 0] + damping, A[1, 1] + damping, A[2, 2] + damping
    f, g, h = A[1, 2], A[0, 2], A[0, 1]
    out = np.empty(A.shape)
    out[0, 0], out[1, 1], out[2, 2] = b * c - f * f, a * c - g * g, a * b - h * h
    out[1, 2] = out[2, 1] = g * h - a * f
    out[0, 2] = out[2, 0] = f * h - b * g
    out[0, 1] = out[1, 0] = f * g - c * h
    return out / (a * out[0, 0] + h * out[0, 1] + g * out[0, 2])


def _loses_branch(q: Array, paths: Array) -> NDArray[np.bool_]:
    """Find which (B,) joints (B, T, 6) jump by more than a continuous solution along paths (B, T, 3) can."""
    moved = np.linalg.norm(np.diff(paths, axis=1), axis=-1)
    allowed = 0.05 + JUMP_PER_ROOT_METRE * np.sqrt(moved)  # the constant is for repeated samples
    return np.any(np.abs(np.diff(q, axis=1)) > allowed[..., None], axis=(1, 2))


def _posture_cost(q: Array, chain: KinematicChain, posture: _Posture) -> Array:
    """Compute the posture cost h(q) of `track`, (N,)."""
    excess = q - np.clip(q, posture.soft_lower, posture.soft_upper)
    away = ((q - posture.reference) ** 2).sum(axis=0)
    turned = ((chain.direction - posture.direction) ** 2).sum(axis=0)
    return 0.5 * (away + posture.direction_weight[0] * turned + LIMIT_WEIGHT * (excess**2).sum(axis=0))
