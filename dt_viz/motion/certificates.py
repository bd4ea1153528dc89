"""Certificates of the motions that are shown: computed from what is drawn, never from what made it.

A motion y(t) of the stack is the image of a motion of the base system: ψ(y(t)) = z(t). Certified is that ψ is a
diffeomorphism along it, that ψ⁻¹ undoes ψ there, that Φ(ψ(y)) falls, and the conjugacy itself: each sample lies where
the base motion from its start is at the time that is said, up to the goal. What is drawn of another motion, in another
order, displaced or at other times fails the last of these.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.arm.cspace import LEVERS
from dt_viz.arm.retiming import within_velocity_limits
from dt_viz.arm.robot import Robot
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Conjugated, Diffeomorphism
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.motion.health import FOLDS, MAX_ROUND_TRIP, RISES, THERE_AND_BACK, Health, in_millimetres
from dt_viz.motion.solve import Solution

NUM_CHECKED, NUM_CHECKED_POSTURES = 400, 100
"""Samples on which det J and what is lost there and back are computed, of the hand's stack and of the whole arm's
transform; all else is of every sample."""
MAX_OFF = 1e-6
"""Distance of ψ of a sample from its base motion, metres, before it is said. The flows' integration leaves up to 1e-8;
where a stack squeezes space most, five millimetres of what is shown are 2e-5."""
MAX_OFF_POSTURE = 1e-5
"""The same of ψ_q, by `LEVERS`: its flow, integrated to `POSTURE_TOLERANCE`, leaves up to 1e-6, and five millimetres
are 4e-4 where it squeezes most."""
POSTURE_TOLERANCE = 1e-7
"""Tolerance of a step of ψ_q's flow, rad, at every posture: half as costly as the one that the motion is made with."""
MAX_OFF_TRACKED = 1e-3
"""`MAX_OFF` where the hand follows the motion by the joints: a spline between postures on it leaves up to 1e-5, joints
at their limits leave more."""
RESOLVED = 1e-5
"""Metres in base space between samples up to which whether Φ falls is rounding."""
MAX_HAND_MISS = 1e-3
"""Distance of the hand of the arm that is shown from its rollout, metres, before it is said."""
MAX_DELAY_ERROR = 1e-9
"""Seconds by which the times of the arm may differ from those that its velocity limits ask for."""
MAX_CLEARANCE_ERROR = 1e-6
"""Metres by which a clearance may differ from the one that is said."""
OFF_MOTION = "beside the motion of the base system"
"""Words of the doubt about samples that are no images of the base motion."""


@dataclass(frozen=True, eq=False)
class Shown:
    """Motions of the end effector as they are shown, one after the other, and what is said of each sample."""

    index: Indices
    """(N,) which rollout a sample belongs to, not decreasing."""
    fraction: Array
    """(N,) where on its base ray it is said to be."""
    times: Array
    """(N,) when it is said to be there, seconds."""
    positions: Array
    """(N, 3), metres."""


def certified(health: Health, stack: Solution, ends: Array, shown: Shown, *, tolerance: float = MAX_OFF) -> Health:
    """Add the certificates of a stack along the motions that are shown of it, and a doubt for each that fails.

    Args:
        health: what is known already.
        stack: ψ and the rays of the base system.
        ends: (R + 1, 3) where the motions are to begin, and where all are to end, metres.
        shown: the motions.
        tolerance: distance of ψ of a sample from its base motion, metres, before it is said.
    """
    transform, y, base_motion = stack.transform, shown.positions, stack.rays.at(shown.index, shown.fraction)
    by_hand = any(applied.made.integration.by_hand for applied in stack.built)
    keep = _evenly(np.arange(len(y)), NUM_CHECKED)
    z = transform.forward(y)
    # coarse steps there and back are no inverses: then ψ⁻¹, which is what is drawn, is compared and looked at for folds
    off = transform.inverse(base_motion) - y if by_hand else z - base_motion
    det = _determinant(transform, y[keep], base_motion[keep] if by_hand else None)
    folds = health.says(FOLDS)
    health = _with_map(health, det, _longest(transform.inverse(z[keep]) - y[keep]))
    falls = _falls(np.linalg.norm(z - stack.rays.base.goal, axis=1), shown)
    if not (falls or folds):  # where a step is known to fold space, that has a cause
        health = health.doubting(RISES)
    return replace(health, lyapunov_falls=falls).doubting(
        *_beside(_longest(off), tolerance),
        *_of_ends(np.concatenate([stack.rays.z0, stack.rays.base.goal[None]]) - transform.forward(ends), shown),
        *_of_times(stack, shown, base_motion),
    )


def certified_arm(
    health: Health, transform: Diffeomorphism, p: Array, undisturbed: Array, *, by_hand: bool
) -> tuple[Health, Array]:
    """Add the certificates of the whole arm's transform along the postures that are shown.

    Args:
        health: what is known already.
        transform: ψ_q.
        p: (N, 6) the postures, rad.
        undisturbed: (N, 6) the postures inside the joint limits that ψ_q⁻¹ is said to lead to them, rad.
        by_hand: whether the integration of ψ_q was chosen by hand.

    Returns:
        The health, and the postures (N, 6) without avoidance that those shown are the images of, rad.
    """
    moved = np.flatnonzero((p != undisturbed).any(axis=1))
    keep = _evenly(moved if len(moved) else np.arange(len(p)), NUM_CHECKED_POSTURES)
    det = _determinant(transform, p[keep], undisturbed[keep] if by_hand else None)
    back = transform.inverse(transform.forward(p[keep]))
    health = _with_map(health, det, _longest((back - p[keep]) * LEVERS))
    if by_hand:
        q, off = undisturbed, transform.inverse(undisturbed) - p
    else:
        q = _quicker(transform).forward(p)
        off = q - undisturbed
    return health.doubting(*_beside(_longest(off * LEVERS), MAX_OFF_POSTURE)), q


def hand_doubts(
    health: Health, robot: Robot, q: Array, path: Array, *, tolerance: float = MAX_HAND_MISS
) -> tuple[str, ...]:
    """Whether the hand of the arm is where its rollouts are, in words.

    Args:
        health: what is known already.
        robot: whose hand it is.
        q: (N, 6) postures, rad.
        path: (N, 3) the samples that belong to them, metres.
        tolerance: distance before it is said, metres.
    """
    missed = _longest(robot.end_effector(q) - path)
    if missed <= tolerance or health.says("misses the path"):
        return ()
    return (f"the hand of the arm is up to {in_millimetres(missed)} beside its rollout",)


def delay_doubts(robot: Robot, q: Array, times: Array, due: Array) -> tuple[str, ...]:
    """Whether the arm is as late as its velocity limits ask for, in words.

    Args:
        robot: whose limits they are.
        q: (T, 6) postures, rad.
        times: (T,) when the arm takes them, seconds.
        due: (T,) times of the rollout, seconds.
    """
    if np.abs(times - within_velocity_limits(due, q, robot.velocity_limits)).max() <= MAX_DELAY_ERROR:
        return ()
    return ("the arm does not keep the times of its rollout and its velocity limits",)


def clearance_doubts(said: float, kept: float) -> tuple[str, ...]:
    """Whether the motions that are shown keep the clearance that is said of them, both in metres, in words."""
    if said == kept or abs(said - kept) <= MAX_CLEARANCE_ERROR:
        return ()
    return (f"the motions shown keep {1e3 * kept:.1f} mm from the obstacle, not {1e3 * said:.1f} mm",)


def _beside(off: float, tolerance: float) -> tuple[str, ...]:
    return () if off <= tolerance else (f"what is shown is up to {in_millimetres(off)} {OFF_MOTION}",)


def _of_ends(missed: Array, shown: Shown) -> tuple[str, ...]:
    """What there is to say of starts and goal: of base motions by which they miss theirs (R + 1, d), and of samples."""
    doubts = []
    first = np.r_[True, np.diff(shown.index) > 0]
    last = np.append(first[1:], True)
    if not _longest(missed) <= MAX_OFF or (shown.index[first] != np.arange(len(missed) - 1)).any():
        doubts.append(f"the motions begin or end up to {in_millimetres(_longest(missed))} beside where they are to")
    if (shown.fraction[first] != 0).any() or (shown.fraction[last] != 1).any():
        doubts.append("a motion is not shown from its start to its goal")
    return tuple(doubts)


def _of_times(stack: Solution, shown: Shown, base_motion: Array) -> tuple[str, ...]:
    """Whether the base motion is elsewhere (N, d) at the times that are said."""
    then = stack.rays.base.flow(stack.rays.z0[shown.index], shown.times[:, None])[:, 0]
    off = np.linalg.norm(then - base_motion, axis=1) - np.where(shown.fraction == 1, ARRIVED, 0.0)
    if off.max() <= MAX_OFF:
        return ()
    return (f"the times are not those of the motion: at them it is up to {in_millimetres(float(off.max()))} elsewhere",)


def _falls(distance: Array, shown: Shown) -> bool:
    """Whether Φ falls along every rollout from sample to sample: it grows with the `distance` (N,) from the goal alone.

    Samples that lie too close together to tell must only be said to go on.
    """
    same = np.diff(shown.index) == 0
    return bool(((np.diff(shown.fraction) > 0) & (np.diff(distance) <= RESOLVED))[same].all())


def _quicker(transform: Diffeomorphism) -> Diffeomorphism:
    """ψ_q with its flow integrated to `POSTURE_TOLERANCE`."""
    if isinstance(transform, Conjugated) and isinstance(transform.inner, AdaptiveFlow):
        return replace(transform, inner=replace(transform.inner, tolerance=POSTURE_TOLERANCE))
    return transform


def _determinant(transform: Diffeomorphism, y: Array, drawn_from: Array | None) -> float:
    """Smallest det J at `y`, or of ψ⁻¹'s derivative where that is not positive at what it is `drawn_from`."""
    det = np.linalg.det(transform.jacobian(y)[1])
    if drawn_from is not None:
        inverse = np.linalg.det(transform.inverse_jacobian(drawn_from)[1])
        det = np.append(det, inverse[~(inverse > 0)])
    return float(det.min())


def _with_map(health: Health, det: float, round_trip: float) -> Health:
    """Health with certificates of a map that may be worse than those it has, and a doubt for each new failure."""
    if not (det > 0 or health.says(FOLDS)):
        health = health.doubting(f"det J falls to {det:.2g}: the map {FOLDS}, the stack is no diffeomorphism there")
    if not round_trip <= MAX_ROUND_TRIP and not health.says(THERE_AND_BACK):
        health = health.doubting(f"{THERE_AND_BACK} again misses by {1e3 * round_trip:.3g} mm: steps too coarse")
    return replace(
        health,
        min_det_jacobian=min(det, np.inf if health.min_det_jacobian is None else health.min_det_jacobian),
        round_trip_error=max(round_trip, health.round_trip_error or 0.0),
    )


def _evenly(rows: Indices, num: int) -> Indices:
    """At most so many of the rows, evenly spread."""
    return rows[np.unique(np.linspace(0, len(rows) - 1, num).astype(int))]


def _longest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())
