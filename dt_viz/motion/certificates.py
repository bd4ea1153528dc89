"""Certificates of the motions that are shown: computed from what is drawn, never from what made it.

A motion y(t) of the stack is the image of a motion of the base system: ψ(y(t)) = z(t). Certified is that ψ is a
diffeomorphism along it, that ψ⁻¹ undoes ψ there, that Φ(ψ(y)) falls, and the conjugacy itself: each sample lies where
the base motion from its start is at its time, and the last one at the goal. The conjugacy check catches drawn samples
of another motion, and those that are permuted, shifted or mistimed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.rotations import apart
from dt_viz.memo import cached_property
from dt_viz.motion.stack import Solution
from dt_viz.robot.collision import CollisionReport
from dt_viz.robot.robot import Robot
from dt_viz.warning import Kind, MotionWarning, in_millimetres, told

NUM_CHECKED, NUM_POSTURES = 400, 100
"""Samples on which det J and what is lost there and back are computed, of the hand's stack and of the whole arm's
transform; all else is of every sample."""
MAX_OFF = 1e-6
"""Distance of ψ of a sample from its base motion, metres, before it is said. The flows' integration leaves up to 1e-8;
where a stack squeezes space most, five millimetres of what is shown are 2e-5."""
MAX_OFF_POSTURE = 1e-5
"""The same of ψ_q, by `Robot.levers`: its flow, integrated to `POSTURE_TOLERANCE`, leaves up to 1e-6, and five
millimetres are 4e-4 where it squeezes most."""
POSTURE_TOLERANCE = 1e-7
"""Tolerance of a step of ψ_q's flow, rad, at every posture: half as costly as the one that the motion is made with."""
RESOLVED = 1e-5
"""Distance between samples in base space, metres, up to which whether Φ falls is rounding."""
MAX_ROUND_TRIP = 1e-6
"""Largest ‖ψ⁻¹(ψ(y)) − y‖, metres, that is not said; the workspace is about one metre wide."""


@dataclass(frozen=True)
class HandTurn:
    """Angles, degrees, between an arm's hand and the orientations that its motion has."""

    median: float
    largest: float

    @classmethod
    def of(cls, robot: Robot, q: Array, orientations: Array) -> HandTurn:
        """Compute them at postures q (T, n), rad, from orientations (T, 4), wxyz."""
        off = np.rad2deg(apart(robot.hand_orientation(q), orientations))
        return cls(float(np.median(off)), float(off.max()))

    def __str__(self) -> str:
        return f"hand turned {self.median:.1f}° beside its orientation in the median, {self.largest:.1f}° at most"


@dataclass(frozen=True)
class Certificates:
    """Checks of a motion, and the warnings that follow; None is what has not been computed."""

    clearance: float
    """Smallest distance from the obstacle of what avoids it, metres, negative inside: of the end effector, or of the
    spheres that cover the arm on the motions from the task's starts."""
    collision: CollisionReport | None = None
    """Nearest approaches of the arm's meshes on the motion that it shows."""
    min_det_jacobian: float | None = None
    """Smallest det J of the whole stack along the rollouts: positive where it is a diffeomorphism. Where ψ⁻¹,
    integrated by hand, folds what is drawn, its det is taken. It is as exact as tangents are: where space is squeezed
    strongly, off by some per cent (see `Flow.tolerance`)."""
    round_trip_error: float | None = None
    """Largest ‖ψ⁻¹(ψ(y)) − y‖ along the rollouts, metres."""
    lyapunov_falls: bool | None = None
    """Whether Φ(ψ(y(t))) falls strictly along every rollout."""
    turn: HandTurn | None = None
    """How far the hand of the arm is turned from the orientations of the motion that it shows; None without any."""
    found: tuple[MotionWarning, ...] = ()
    """All warnings, also those that only follow from others."""

    def __repr__(self) -> str:
        parts = ["nothing to avoid" if np.isinf(self.clearance) else f"clearance {1e3 * self.clearance:.1f} mm"]
        if self.collision is not None:
            parts.append(f"arm {1e3 * self.collision.obstacle.distance:.1f} mm from the obstacle")
        if self.min_det_jacobian is not None:
            parts.append(f"det J ≥ {self.min_det_jacobian:.2g}")
        if self.round_trip_error is not None:
            parts.append(f"round trip within {1e3 * self.round_trip_error:.1g} mm")
        if self.lyapunov_falls is not None:
            parts.append(f"Lyapunov value {'falls' if self.lyapunov_falls else 'does not fall'}")
        if self.turn is not None:
            parts.append(f"{self.turn}")
        texts = "; ".join(warning.text for warning in self.warnings)
        return f"Certificates({', '.join(parts)}, {f'warnings: {texts}' if texts else 'no warnings'})"

    @property
    def warnings(self) -> tuple[MotionWarning, ...]:
        """Why the result is not to be trusted: what is to be told."""
        return told(self.found)

    def warning(self, *warnings: MotionWarning) -> Certificates:
        """The same with more warnings."""
        return replace(self, found=self.found + warnings)


@dataclass(frozen=True, eq=False)
class DrawnSamples:
    """Motions of the end effector as they are shown, one after the other, and what is said of each sample."""

    index: Indices  # (N,) which rollout a sample belongs to, not decreasing
    fraction: Array  # (N,) place of each sample on its base ray
    times: Array  # (N,) time of each sample, seconds
    positions: Array  # (N, 3), metres
    num: int  # R, the number of rollouts; those that are not shown have no samples

    def split(self, values: Array) -> tuple[Array, ...]:
        """Cut an array (N, …) that belongs to the samples into one array for each rollout."""
        return tuple(np.split(values, np.searchsorted(self.index, np.arange(1, self.num))))

    @cached_property
    def paths(self) -> tuple[Array, ...]:
        """Positions of each rollout, (T_i, 3), metres."""
        return self.split(self.positions)


def certified(known: Certificates, stack: Solution, shown: DrawnSamples, *, tolerance: float = MAX_OFF) -> Certificates:
    """Add the certificates of a stack along the motions that are shown of it, and a warning for each that fails.

    Beyond a tolerance, metres, it is said that ψ of a sample is off its base motion.
    """
    base = stack.rays.base
    base_motion = base.flow(stack.rays.z0[shown.index], shown.times[:, None])[:, 0]
    goal = stack.rays.at(shown.index, shown.fraction)
    arrived = (shown.fraction == 1) & (np.linalg.norm(base_motion - goal, axis=1) <= ARRIVED + MAX_OFF)
    base_motion[arrived] = goal[arrived]
    y = np.concatenate([shown.positions, base_motion[:, 3:]], axis=1)
    by_hand = any(applied.made.integration.by_hand for applied in stack.built)
    known, z = certified_map(known, stack.transform, y, base_motion, NUM_CHECKED, tolerance, by_hand=by_hand)
    falls = _falls(base.distance(z), shown)
    rises = () if falls else (MotionWarning(Kind.NOT_FALLING, "the Lyapunov value does not fall all the way"),)
    return replace(known, lyapunov_falls=falls).warning(*rises)


def certified_map(
    known: Certificates,
    transform: Diffeomorphism,
    y: Array,
    x: Array,
    num: int,
    tolerance: float,
    unit: Array | float = 1.0,
    *,
    by_hand: bool,
) -> tuple[Certificates, Array]:
    """The worse of the certificates known and of those of a map, with a warning for each failure, and its images.

    They are of `num` of the samples y (N, d) that it moves, which ψ⁻¹ is said to lead to from `x` (N, d): beyond a
    tolerance, metres, it is said that it does not. One unit of each coordinate is `unit` metres.
    """
    moved = np.flatnonzero((y != x).any(axis=1))
    rows = moved if len(moved) else np.arange(len(y))
    keep = rows[np.unique(np.linspace(0, len(rows) - 1, num).astype(int))]
    quicker = _quicker(transform)
    images, det = quicker.forward(y), np.linalg.det(quicker.jacobian(y[keep])[1])
    off = images - x
    if by_hand:
        # coarse steps there and back are no inverses: then ψ⁻¹, which is what is drawn, is compared and looked at for
        # folds
        off, inverse = transform.inverse(x) - y, np.linalg.det(transform.inverse_jacobian(x[keep])[1])
        det = np.append(det, inverse[~(inverse > 0)])
    least, beside = float(det.min()), _longest(off * unit)
    missed = _longest((transform.inverse(transform.forward(y[keep])) - y[keep]) * unit)
    folds = f"det J falls to {least:.2g}: the map folds space, the stack is no diffeomorphism there"
    loses = f"a round trip through the stack misses by {1e3 * missed:.3g} mm: steps too coarse"
    differs = f"what is shown is up to {in_millimetres(beside)} beside the motion of the base system"
    checks = (
        (Kind.NO_DIFFEOMORPHISM, least > 0, folds),
        (Kind.ROUND_TRIP, missed <= MAX_ROUND_TRIP, loses),
        (Kind.OFF_MOTION, beside <= tolerance, differs),
    )
    warnings = (MotionWarning(kind, text) for kind, holds, text in checks if not holds)
    worst = min(least, np.inf if known.min_det_jacobian is None else known.min_det_jacobian)
    known = replace(known, min_det_jacobian=worst, round_trip_error=max(missed, known.round_trip_error or 0.0))
    return known.warning(*warnings), images


def _falls(distance: Array, shown: DrawnSamples) -> bool:
    """Whether Φ falls along every rollout from sample to sample: it grows with the `distance` (N,) from the goal alone.

    Samples that lie too close together to tell must only be said to go on.
    """
    same = np.diff(shown.index) == 0
    return bool(((np.diff(shown.fraction) > 0) & (np.diff(distance) <= RESOLVED))[same].all())


def _quicker(transform: Diffeomorphism) -> Diffeomorphism:
    """ψ_q with its flow integrated to `POSTURE_TOLERANCE`."""
    if isinstance(transform, Conjugated) and isinstance(transform.inner, Flow) and transform.inner.tolerance:
        return replace(transform, inner=replace(transform.inner, tolerance=POSTURE_TOLERANCE))
    return transform


def _longest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=1).max())
