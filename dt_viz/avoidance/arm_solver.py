"""The duration of a flow that clears an obstacle for the whole arm, and the samples that show the motion (sec. 4.5)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.arm_field import GradientField, JointLimits, WholeArmField, WholeArmSettings
from dt_viz.avoidance.avoidance import ArmAvoidance, Lack, clearing_duration
from dt_viz.avoidance.detour import Detour
from dt_viz.avoidance.lift import Lift
from dt_viz.flows.diffeomorphisms import Conjugated, Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array, Indices, Mask, VectorField
from dt_viz.flows.rollouts import Bundle, refined
from dt_viz.kernels.blocks import room_asked
from dt_viz.memo import cached_property
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.robot import Robot

NUM_COARSE = 40  # number of samples of each rollout of coarse motions, before refinement
MAX_DURATION = 2.0  # longest flow that is tried: a contact at full strength moves by 40 cm in it
SNAPSHOT = 0.1
"""Flow time between two checks of the clearance: contacts move by at most two centimetres in it."""
STRIDE = 3
"""Stride of the samples that the duration is chosen for at first: the time that they take to escape changes slowly
along a rollout."""
MAX_ROUNDS = 4
"""Largest number of rounds in which the flow is prolonged for samples that refinement has added."""
SLOPE = 0.1
"""Slope, m/m, at which the required clearance grows away from a start or goal that has less than the margin."""
MOVED = 5e-3  # smallest shift of an added start by the avoidance that is reported, metres
MARGIN_TOLERANCE = 1e-3  # tolerance of a clearance, metres
COARSE_STEP = 0.25
"""Length of a coarse RK4 step, in flow time: off by at most 1.2 mm at the hand in drags around Draw S and push box."""
TOLERANCE = 3e-9  # tolerance of a step of the fine flow, rad
LONG = 1.0
"""Flow time beyond which other escapes and reference postures are tried, too: such motions wind around the obstacle."""


@dataclass(frozen=True, eq=False)
class ArmSolution:
    """Joint motions of all rollouts, one after the other."""

    transform: Diffeomorphism
    """ψ_q, from the configurations where the arm moves to those of the undisturbed motion."""
    index: Indices  # (N,) which rollout a sample belongs to, not decreasing
    fraction: Array  # (N,) where on its base ray it is
    q: Array  # (N, n) without avoidance, rad
    p: Array  # (N, n) the motion, rad
    duration: float  # t of the avoidance flow
    clearance: float
    """Smallest distance of the arm from the obstacle along the rollouts that shape the flow, metres; only where it is
    near, else less."""
    stuck: Mask  # (R,) rollouts that shape the flow and do not keep the clearance that is asked for
    too_near: Mask  # (R,) other rollouts that do not keep it
    moved: Mask  # (R,) other rollouts that begin more than `MOVED` away from their start
    detours: tuple[Detour | None, ...] = ()
    """Detour around each obstacle; None for those that are not in the way, empty where none is."""

    @property
    def cleared(self) -> bool:
        """Whether all rollouts that shape the flow keep the clearance that is asked for."""
        return not self.stuck.any()

    @property
    def soon(self) -> bool:
        """Whether they keep it after so short a flow that no other escape is tried."""
        return self.cleared and self.duration <= LONG


class Solver:
    """Finds the duration of one generator's flow, and the samples that show the motion."""

    def __init__(
        self,
        robot: Robot,
        body: BodyPoints,
        limits: JointLimits,
        lifted: Lift,
        avoidance: ArmAvoidance,
        detours: Sequence[Detour | None],
        spacing: float,
        *,
        coarse: bool = True,
        between: tuple[float, float] = (0.0, MAX_DURATION),
    ) -> None:
        self._robot, self._body, self._limits = robot, body, limits
        self._lifted = lifted
        self._avoidance = avoidance
        self._detours = tuple(detours)
        self._generator = self._generated([detour for detour in detours if detour is not None])
        self._spacing = spacing
        self._coarse = coarse and self._generator is not None
        self._between = between
        self._margin = max(float(avoidance.margin), 2 * MARGIN_TOLERANCE)
        self._room = (
            body.clearance(robot, lifted.pins, avoidance.avoided, self._margin + MARGIN_TOLERANCE) - MARGIN_TOLERANCE
        )

    @cached_property
    def _settings(self) -> WholeArmSettings:
        return WholeArmSettings.of(self._robot)

    def _generated(self, met: Sequence[Detour]) -> VectorField | None:
        """The field whose flow takes these detours, with starts and goal at rest; None without any."""
        reach = self._settings.reach_per_temperature * self._avoidance.temperature
        obstacles = tuple(detour.obstacle for detour in met)
        if not met:
            return None
        if self._avoidance.generator == "probability":
            return GradientField(self._robot, self._body, obstacles, reach)
        pins = self._limits.forward(self._limits.inside(self._lifted.pins))
        directions = np.stack([detour.direction for detour in met])
        return WholeArmField(self._robot, self._body, obstacles, directions, pins, reach)

    def solution(self) -> ArmSolution:
        """Find the motions: with `auto`, after the shortest duration that clears them."""
        duration = self._avoidance.duration
        if self._generator is None:
            duration = 0.0
        elif duration is None:
            shaping = self._lifted.tracked.q[self._lifted.shaping]
            q = self._limits.inside(shaping[:, ::STRIDE].reshape(-1, self._robot.num_joints))
            duration = self._clearing_duration(q)
        return self._with_duration(float(np.clip(duration, *self._between)))

    def _with_duration(self, duration: float) -> ArmSolution:
        transform = self._transform(duration)
        bundle = self._sampled(transform)
        asked, kept = self._clearances(bundle.positions / self._robot.levers)
        automatic, longest = self._generator is not None and self._avoidance.duration is None, self._between[1]
        for _ in range(MAX_ROUNDS if automatic else 0):
            lacking = self._shaping(bundle) & (asked > kept)
            if duration >= longest or (asked - kept)[lacking].max(initial=0.0) <= MARGIN_TOLERANCE:
                break
            p = bundle.positions[lacking] / self._robot.levers
            more = min(self._clearing_duration(p), longest - duration)
            duration += more
            bundle, transform = self._continued(bundle, more, duration)
            asked, kept = self._clearances(bundle.positions / self._robot.levers)
        return self._along(bundle, transform, duration, asked, kept)

    def _continued(self, bundle: Bundle, more: float, duration: float) -> tuple[Bundle, Diffeomorphism]:
        """The samples carried on by the flow, by `more` up to this duration, and its transform then."""
        transform, levers = self._transform(duration), self._robot.levers
        if self._avoidance.integration.by_hand:  # a few coarse steps are no one-parameter group
            levels = self._evaluate(transform, bundle.index, bundle.fraction)
        else:
            levels = (self._transform(more).inverse(bundle.positions / levers) * levers)[:, None]
        return self._refined(replace(bundle, levels=levels), transform), transform

    def through(self, transform: Diffeomorphism, duration: float) -> ArmSolution:
        """The motions of a given transform, of which that is the full duration."""
        bundle = self._sampled(transform)
        return self._along(bundle, transform, duration, *self._clearances(bundle.positions / self._robot.levers))

    def _along(
        self, bundle: Bundle, transform: Diffeomorphism, duration: float, asked: Array, kept: Array
    ) -> ArmSolution:
        p = bundle.positions / self._robot.levers
        shaping, near = self._shaping(bundle), asked - kept > MARGIN_TOLERANCE
        q = self._lifted.at(bundle.index, bundle.fraction)
        away = np.linalg.norm(self._robot.end_effector(p) - self._robot.end_effector(q), axis=1) > MOVED
        samples = near & shaping, near & ~shaping, away & ~shaping & (bundle.fraction == 0)
        rollouts = np.arange(len(self._lifted.fractions))
        stuck, too_near, moved = (np.isin(rollouts, bundle.index[which]) for which in samples)
        clearance, detours = float(kept[shaping].min()), self._detours if any(self._detours) else ()
        ends = stuck, too_near, moved
        return ArmSolution(transform, bundle.index, bundle.fraction, q, p, duration, clearance, *ends, detours)

    def _shaping(self, bundle: Bundle) -> Mask:
        return self._lifted.shaping[bundle.index]

    def _sampled(self, transform: Diffeomorphism) -> Bundle:
        rollouts, num_samples = np.flatnonzero(self._lifted.moving), self._lifted.fractions.shape[1]
        first = np.linspace(0, num_samples - 1, NUM_COARSE if self._coarse else num_samples).round().astype(int)
        index, fraction = np.repeat(rollouts, len(first)), self._lifted.fractions[rollouts][:, first].ravel()
        return self._refined(Bundle(index, fraction, self._evaluate(transform, index, fraction)), transform)

    def _transform(self, duration: float) -> Diffeomorphism:
        limits = self._limits
        if self._generator is None or duration == 0:
            return Identity(self._robot.num_joints)
        if self._avoidance.integration.by_hand:
            flow = self._avoidance.integration.of(Flow(self._generator, duration))
        elif self._coarse:
            flow = Flow(self._generator, duration, math.ceil(duration / COARSE_STEP))
        else:
            flow = Flow.adaptive(self._generator, duration, TOLERANCE)
        return Conjugated(flow, limits)

    def _evaluate(self, transform: Diffeomorphism, index: Indices, fraction: Array) -> Array:
        """Levels (N, 1, n) of the samples: postures by their `levers`, so that distances are metres."""
        q = self._limits.inside(self._lifted.at(index, fraction))
        return (transform.inverse(q) * self._robot.levers)[:, None]

    def _refined(self, bundle: Bundle, transform: Diffeomorphism) -> Bundle:
        def integrated(index: Indices, fraction: Array) -> Array:
            return self._evaluate(transform, index, fraction)

        spacing = max(self._spacing, self._settings.coarse_spacing) if self._coarse else self._spacing
        return refined(bundle, integrated, spacing)

    def _lack(self, p: Array, most: float) -> Array:
        """Metres (N,), up to `most`, by which the arm at configurations (N, n) misses the clearance asked for."""
        asked, kept = self._clearances(p, most)
        return asked - kept

    def _clearances(self, p: Array, most: float = np.inf) -> tuple[Array, Array]:
        """Clearances (N,), metres, that are asked for at configurations (N, n), and that are kept.

        Asked for is the margin, or what the starts and goal beside a configuration have. What is kept is cut off where
        it is more or less by `most`, or more by what a contact moves between two checks.
        """
        pins, levers = self._lifted.pins, np.array(self._robot.levers)
        asked = room_asked(np.array(p, order="C"), pins, self._room, levers, SLOPE, self._margin)
        more = min(self._settings.speed * SNAPSHOT, most)
        return asked, self._body.clearance(self._robot, p, self._avoidance.avoided, asked + more, asked - most)

    def _clearing_duration(self, p: Array) -> float:
        """The shortest duration after which the flow has carried configurations (N, n) clear, or the longest."""
        assert self._generator is not None
        return clearing(self._generator, self._limits, p, self._lack, SNAPSHOT, self._between[1])


def clearing(field: VectorField, limits: JointLimits, p: Array, lack: Lack, step: float, longest: float) -> float:
    """The shortest flow time after which a field's reverse flow has carried postures (N, n) clear, or the longest.

    The field is in the coordinates of the limits; a `step` is the flow time between two checks of what postures lack.
    """
    duration = clearing_duration(field, limits.forward(p), lambda z, most: lack(limits.inverse(z), most), step, longest)
    return longest if duration is None else duration
