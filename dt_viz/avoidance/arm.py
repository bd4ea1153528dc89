"""From motions of the end effector to motions of the whole arm that clear an obstacle (sec. 4.5).

The joints follow the end effector by the pseudo-inverse: q(t) = Q(x(t)) with one section Q for all rollouts of a task
(`robot.inverse_kinematics.track` with a shared reference). It does not depend on the obstacle, so it is computed once;
a drag costs p(t) = ψ_q⁻¹(q(t)) only, one batched flow in R⁶.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse.csgraph import connected_components

from dt_viz.avoidance.arm_field import (
    LEVERS,
    REACH_PER_TEMPERATURE,
    SPEED,
    GradientField,
    JointLimits,
    WholeArmField,
)
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.clearing import clearing_duration
from dt_viz.avoidance.detour import Detour, escape_directions, remembered, travel
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Conjugated, Diffeomorphism, Flow, Identity
from dt_viz.flows.fields import Array, Indices, Mask, VectorField
from dt_viz.flows.rollouts import Bundle, refined
from dt_viz.kernels.blocks import room_asked
from dt_viz.kernels.dodging import Forecast, LimitedArm, dodge
from dt_viz.kernels.proximity import contacts, least_contacts, proximity
from dt_viz.kernels.splines import cubics
from dt_viz.obstacles.arrays import records
from dt_viz.obstacles.shapes import Obstacle, Sphere
from dt_viz.obstacles.union import Union
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.inverse_kinematics import TrackedPath, track
from dt_viz.robot.robot import NUM_JOINTS, Robot

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

NUM_CONFIGURATIONS = 100
"""Samples of each rollout before refinement."""
NUM_COARSE = 40
"""The same for coarse motions."""
MAX_DURATION = 2.0
"""Longest flow that is tried: a contact at full strength moves by 40 cm in it."""
SNAPSHOT = 0.1
"""Flow time between two looks at the clearance: contacts move by at most two centimetres in it."""
STRIDE = 3
"""Every which sample the duration is chosen for at first: the time that they take to leave changes slowly along a
rollout, and the deepest are not the last."""
MAX_ROUNDS = 4
"""Rounds of refinement and of a longer flow where the samples that it adds are not clear."""
SLOPE = 0.1
"""Clearance that is asked for, beside a start or goal that has less itself, for each metre of distance from it."""
MOVED = 5e-3
"""Smallest shift of an added start by the avoidance that is reported, metres."""
ROUNDING = 1e-3
"""Tolerance of a clearance, metres."""
COARSE_STEP = 0.25
"""Length of a coarse RK4 step, in flow time: off by at most 1.2 mm at the hand in drags around Draw S and push box."""
COARSE_SPACING = 0.025
"""Distance, metres at the hand, about, up to which neighbouring samples of coarse motions may be apart."""
TOLERANCE = 3e-9
"""Tolerance of a step of the fine flow, rad."""
NUM_COMPARED = 60
"""Colliding samples that escapes are compared by."""
DURATION_CHANGE = 50.0
"""Largest change of the flow time for each metre that an obstacle is dragged: contacts move by 1 cm a millimetre."""
LONG = 1.0
"""Flow time beyond which other escapes and stances are tried, too: such motions wind around the obstacle."""
NUM_WAYS = 3
"""Largest number of escapes from each obstacle that are tried."""
TOGETHER, OPPOSED = 0.05, -0.5
"""Clearance from another obstacle, metres, up to which a colliding posture meets both, and cosine of the angle between
their escapes beyond which both are left in one direction."""
BESIDE = 0.20
"""Clearance up to which a sample is bent along with the colliding ones, metres."""


@dataclass(frozen=True, eq=False)
class Lift:
    """The joints along each rollout: q = Q(x), a smooth function of the fraction of its base ray."""

    fractions: Array
    """(R, T) increasing along each rollout."""
    tracked: TrackedPath
    """Joints at these fractions; its q has shape (R, T, 6)."""
    reference: Array
    """(6,) posture that the arm stays near to, rad."""
    exactly: Callable[[Array, Indices, Array], Array] | None = None
    """Takes postures (N, 6) between the fractions onto the motion that they follow, of these rollouts (N,) at these
    fractions (N,); None is content with the spline."""
    num_added: int = 0
    """Number of the rollouts, the last ones, from added starts: the avoidance is not made for these."""

    @property
    def num_shaping(self) -> int:
        """Number of the rollouts, the first ones, that an avoidance is made for."""
        return len(self.fractions) - self.num_added

    @cached_property
    def _splines(self) -> tuple[Array, Array]:
        """Fractions (R, T − 1) at which the cubics begin, and their coefficients (4, R·(T − 1), 6)."""
        coefficients = cubics(np.array(self.fractions, order="C"), np.array(self.tracked.q, order="C"))
        return self.fractions[:, :-1], coefficients.reshape(4, -1, NUM_JOINTS)

    def at(self, index: Indices, fraction: Array) -> Array:
        """Configurations (N, 6), rad, of the rollouts `index` (N,) at the fractions `fraction` (N,)."""
        begins, (a, b, c, d) = self._splines
        apart = 2 * np.arange(len(begins))[:, None]  # so that one search finds the piece of the right rollout
        piece = np.searchsorted((begins + apart).ravel(), fraction + 2 * index, side="right") - 1
        u = (fraction - begins.ravel()[piece])[:, None]
        q = d[piece] + u * (c[piece] + u * (b[piece] + u * a[piece]))
        return q if self.exactly is None else self.exactly(q, index, fraction)

    def only(self, rollout: int) -> Lift:
        """One of the rollouts."""
        q, error, limits_hit, manipulability, damped = (
            getattr(self.tracked, name)[rollout : rollout + 1] for name in TrackedPath.__dataclass_fields__
        )
        tracked = TrackedPath(q, error, limits_hit, manipulability, damped)
        return Lift(self.fractions[rollout : rollout + 1], tracked, self.reference)

    @cached_property
    def pins(self) -> Array:
        """(R' + 1, 6) postures at the starts of the R' rollouts that shape the flow, and at the goal, rad."""
        return np.concatenate([self.tracked.q[: self.num_shaping, 0], self.tracked.q[:1, -1]])


def joined(lifts: Sequence[Lift], num_added: int) -> Lift:
    """The rollouts of several, one after the other, those from added starts last, with the reference of the first."""
    tracked = TrackedPath(
        *(np.concatenate([getattr(part.tracked, name) for part in lifts]) for name in TrackedPath.__dataclass_fields__)
    )
    fractions = np.concatenate([part.fractions for part in lifts])
    return Lift(fractions, tracked, lifts[0].reference, num_added=num_added)


def lift(robot: Robot, fractions: Array, paths: Array, reference: Array, initial: Array | None = None) -> Lift:
    """Follow rollouts with the joints.

    Args:
        robot: whose joints.
        fractions: (R, T) where on their base rays the samples are.
        paths: (R, T, 3) end effector there, metres.
        reference: (6,) posture that the arm stays near to, rad.
        initial: (R, T, 6) joints of nearby paths to begin from, rad.
    """
    start = np.broadcast_to(reference, (len(paths), NUM_JOINTS))
    return Lift(fractions, track(robot, paths, start, initial, reference=start), reference)


@dataclass(frozen=True, eq=False)
class ArmSolution:
    """Joint motions of all rollouts, one after the other."""

    transform: Diffeomorphism
    """ψ_q, from the configurations where the arm moves to those of the undisturbed motion."""
    index: Indices
    """(N,) which rollout a sample belongs to, not decreasing."""
    fraction: Array
    """(N,) where on its base ray it is."""
    q: Array
    """(N, 6) without avoidance, rad."""
    p: Array
    """(N, 6) the motion, rad."""
    duration: float
    """t of the avoidance flow."""
    clearance: float
    """Smallest distance of the arm from the obstacle along the rollouts that shape the flow, metres; only where it is
    near, else less."""
    stuck: Indices
    """Hosts that do not keep the clearance that is asked for."""
    too_near: Indices
    """Guests, counted among all rollouts, that do not keep it."""
    moved: Indices
    """Guests that begin more than `MOVED` away from their start."""
    detours: tuple[Detour | None, ...] = ()
    """Detour around each obstacle; None for those that are not in the way, empty where none is."""

    @property
    def cleared(self) -> bool:
        """Whether all rollouts that shape the flow keep the clearance that is asked for."""
        return not len(self.stuck)

    @property
    def soon(self) -> bool:
        """Whether they keep it after so short a flow that nothing better is looked for."""
        return self.cleared and self.duration <= LONG


class WholeArm:
    """Makes the arm's motions clear an obstacle, by a diffeomorphism of configuration space."""

    def __init__(self, robot: Robot, body: BodyPoints) -> None:
        self.robot = robot
        self.links = body.on_moving_links
        """Points of the links."""
        self.body = self.links.with_end_effector(robot)
        """The same, and what the hand holds."""
        self.limits = JointLimits(robot.lower, robot.upper)

    def compiled(self) -> Iterator[float]:
        """Compile what a drag repeats for this processor, or load what was compiled before; yields the part done."""
        q, obstacle = self.robot.home[None], Sphere((0.0, 0.0, 0.0))
        field = WholeArmField(self.robot, self.body, (obstacle,), np.eye(3)[:1], np.empty((0, NUM_JOINTS)))
        points = self.body.of_chain(self.robot.chain(q.T))
        shapes, values = records((obstacle,))
        joints, links, still = self.robot.records, self.links.spheres, np.zeros(NUM_JOINTS)
        dodging, ones = LimitedArm(joints, links, still, still, still, 1.0), np.ones((1, 1))
        forecast = Forecast(shapes, values, np.ones(1), np.ones((1, 1, 3)), ones, 0.0, 0.0, 1.0)
        calls: tuple[Callable[[], object], ...] = (
            lambda: self.robot.end_effector(q),
            lambda: self.clearance(q, obstacle),
            lambda: track(self.robot, self.robot.end_effector(q)[:, None], q, reference=q),
            lambda: cubics(np.arange(4.0)[None], np.zeros((1, 4, NUM_JOINTS))),
            lambda: room_asked(q, q, np.zeros(1), LEVERS, SLOPE, 0.0),
            lambda: proximity(joints, links, shapes, values, q[0].copy(), 1.0),
            lambda: contacts(joints, links, np.array([[-1, 0]]), q[0].copy(), 1.0),
            lambda: least_contacts(joints, links, np.array([[-1, 0]]), q.copy(), 1.0),
            lambda: dodge(dodging, forecast, still, still, still, still, 0.0),
            lambda: escape_directions(points, self.body.radius, np.eye(3)[:1], obstacle, margin=2.0),
            lambda: field(q),
            lambda: field.rk4(q, 1.0, 1),
            lambda: field.dormand_prince(q, 1.0, TOLERANCE, 1000),
            lambda: field.with_jacobian(q),
            lambda: obstacle.field("free-space", 1.0)(np.zeros((1, 3))),  # the hand's fields
        )
        for done, call in enumerate(calls, start=1):
            call()
            yield done / len(calls)

    def undisturbed(self, lifted: Lift, avoidance: ArmAvoidance, spacing: float) -> ArmSolution:
        """The motions as lifted, avoiding nothing."""
        return _Solver(self, lifted, avoidance, None, spacing, coarse=True).solution()

    def avoiding(
        self,
        lifted: Lift,
        avoidance: ArmAvoidance,
        spacing: float,
        *,
        coarse: bool,
        passing: Passing = ANEW,
    ) -> ArmSolution:
        """The motions around the obstacle.

        With `auto` the duration is the shortest after which every sample keeps the clearance that is asked for: the
        margin, or what the start or goal beside it has. Of several escapes the first is taken that works soon, else
        the one with the least detour, else the one that comes nearest to working, all by coarse motions. All this looks
        only at rollouts from the task's starts: added ones do not change their motions.

        While an obstacle is dragged, the side on which all motions pass it is kept until another one is much shorter,
        or this one fails; see `followed`.

        Args:
            lifted: the motions below.
            avoidance: what is to be avoided, and how.
            spacing: largest distance between neighbouring samples, metres at the hand, about; in coarse motions it is
                `COARSE_SPACING` if that is more.
            coarse: whether the flow is integrated for the eye only, in a few equal steps.
            passing: detours to keep while obstacles are dragged.
        """
        parts = avoidance.avoided.parts
        known = remembered(passing.arm, parts)
        sides, pins = self._sides(lifted, avoidance, known), self._pins(lifted)
        best = None
        for attempt in range(min(NUM_WAYS, max(map(len, sides), default=0))):
            detours = [
                _on_side(part, found[min(attempt, len(found) - 1)], last) if found else None
                for part, found, last in zip(parts, sides, known, strict=True)
            ]
            generator = self._generator(detours, avoidance, pins)
            by_hand = avoidance.duration is not None or avoidance.generator == "probability"
            solver = _Solver(self, lifted, avoidance, generator, spacing, coarse=coarse or not by_hand)
            tried = replace(solver.solution(), detours=tuple(detours))
            if by_hand:
                return tried
            if best is None or self._better(tried, best):
                best = tried
            if tried.soon or (tried.cleared and any(detour is not None and detour.kept for detour in detours)):
                break
        if best is None:
            return self.undisturbed(lifted, avoidance, spacing)
        if coarse:
            return best
        generator = self._generator(best.detours, avoidance, pins)
        exact = _Solver(self, lifted, avoidance, generator, spacing, coarse=False).solution()
        return replace(exact, detours=best.detours)

    def followed(self, lifted: Lift, avoidance: ArmAvoidance, spacing: float, passing: Passing) -> ArmSolution:
        """Coarse motions that follow an obstacle which is dragged: they change no faster than the obstacle moves.

        Detours turn towards the sides that are to be taken, and the flow's duration changes, by so much for each metre
        of the drag. So no motion jumps, where a side is changed or none clears it: until the new way is there, motions
        may come nearer to the obstacle than the margin. Where a way is there and does not clear it, the next side is
        turned to. For the other arguments see `avoiding`.

        Args:
            lifted: the motions below.
            avoidance: what is to be avoided.
            spacing: as in `avoiding`.
            passing: the detours of the motions where the obstacles were just before, and the duration of their flow.
        """
        parts = avoidance.avoided.parts
        known = remembered(passing.arm, parts)
        failed = not passing.cleared and passing.duration >= MAX_DURATION
        detours: list[Detour | None] = []
        for part, found, last in zip(parts, self._sides(lifted, avoidance, known), known, strict=True):
            if not found:
                detours.append(None)
            elif last is None:
                detours.append(_on_side(part, found[0], last))
            else:
                side = found[1] if failed and last.is_there and len(found) > 1 else found[0]
                detours.append(_on_side(part, side, last).turned_from(last, found, avoidance.detour.turning))
        if not any(detours):
            return self.undisturbed(lifted, avoidance, spacing)
        moved = max(travel(last.obstacle, part) for last, part in zip(known, parts, strict=True) if last is not None)
        change = DURATION_CHANGE * moved
        between = max(passing.duration - change, 0.0), min(passing.duration + change, MAX_DURATION)
        generator = self._generator(detours, avoidance, self._pins(lifted))
        solver = _Solver(self, lifted, avoidance, generator, spacing, coarse=True, between=between)
        return replace(solver.solution(), detours=tuple(detours))

    def _pins(self, lifted: Lift) -> Array:
        """The postures (K, 6) that do not move, where the flow meets them."""
        return self.limits.forward(self.limits.inside(lifted.pins))

    def _better(self, tried: ArmSolution, best: ArmSolution) -> bool:
        """Whether one solution's motions clear the obstacle with less detour than another's, or come nearer to it."""
        if not (tried.cleared and best.cleared):
            return tried.cleared or (not best.cleared and tried.clearance > best.clearance)
        return self._detour(tried) < self._detour(best)

    def _detour(self, solution: ArmSolution) -> float:
        """Largest distance, metres, by which the hand is moved away from its undisturbed motion."""
        hand = self.robot.end_effector
        return float(np.linalg.norm(hand(solution.p) - hand(solution.q), axis=1).max())

    def warped(
        self, full: ArmSolution, lifted: Lift, avoidance: ArmAvoidance, fraction: float, spacing: float
    ) -> ArmSolution:
        """The motions with the transform of a solution run for a fraction of its duration.

        Args:
            full: whose transform it is.
            lifted: the motions below, warped as far.
            avoidance: what is avoided.
            fraction: s, from 0 to 1.
            spacing: as in `avoiding`.
        """
        solver = _Solver(self, lifted, avoidance, None, spacing, coarse=True)
        return replace(solver.through(full.transform.scaled(fraction), full.duration), detours=full.detours)

    def clearance(self, q: Array, obstacle: Union | Obstacle, enough: ArrayLike = np.inf) -> Array:
        """Distance (N,), metres, of arm and end effector from the obstacle; see `BodyPoints.clearance`."""
        return self.body.clearance(self.robot, q, obstacle, enough)

    def _generator(self, detours: Sequence[Detour | None], avoidance: ArmAvoidance, pins: Array) -> VectorField:
        """The field whose flow takes these detours, with these postures (K, 6) at rest, where the flow meets them."""
        reach = REACH_PER_TEMPERATURE * avoidance.temperature
        met = [detour for detour in detours if detour is not None]
        obstacles = tuple(detour.obstacle for detour in met)
        if avoidance.generator == "probability":
            return GradientField(self.robot, self.body, obstacles, reach)
        directions = np.stack([detour.direction for detour in met])
        return WholeArmField(self.robot, self.body, obstacles, directions, pins, reach)

    def _sides(self, lifted: Lift, avoidance: ArmAvoidance, known: Sequence[Detour | None]) -> list[list[Array]]:
        """Escapes (3,) from each obstacle, the most promising first; none where nothing comes too near it.

        Obstacles that one posture comes near to are left in one direction where their own ones are opposed: else their
        flows would hold each other up, and motions turn back between them.
        """
        q, parts, margin = lifted.tracked.q[: lifted.num_shaping], avoidance.avoided.parts, avoidance.margin
        tangents = np.gradient(self.robot.end_effector(q), axis=1).reshape(-1, 3)
        tangents /= np.maximum(np.linalg.norm(tangents, axis=1, keepdims=True), 1e-12)
        q = q.reshape(-1, NUM_JOINTS)
        near: Mask = np.array([self.clearance(q, part, margin) < margin for part in parts]).reshape(len(parts), len(q))
        clearance = np.array([self.body.outermost.clearance(self.robot, q, part, BESIDE) for part in parts])  # about
        clearance = clearance.reshape(len(parts), len(q))

        def escapes(which: Indices) -> list[Array]:
            """Directions that leave all of these obstacles."""
            collides = np.flatnonzero(near[which].any(axis=0))
            bent = np.flatnonzero((clearance[which] < BESIDE).any(axis=0))
            compared = q[collides[:: max(1, len(collides) // NUM_COMPARED)]]
            return escape_directions(
                self.body.of_chain(self.robot.chain(compared.T)),
                self.body.radius,
                tangents[bent[:: max(1, len(bent) // NUM_COMPARED)]],
                Union(tuple(parts[k] for k in which)),
                margin,
                num=NUM_WAYS,
                settings=avoidance.detour,
                previous=next((last.side for last in (known[k] for k in which) if last is not None), None),
            )

        sides: list[list[Array]] = [[] for _ in parts]
        met = np.flatnonzero(near.any(axis=1))
        for k in met:
            sides[k] = escapes(np.array([k]))
        if len(met) > 1:
            first = np.array([sides[k][0] for k in met])
            together = (near[met, None] & (clearance[met] < TOGETHER)).any(axis=2)
            num_groups, group = connected_components(together & (first @ first.T < OPPOSED), directed=False)
            for which in (met[group == k] for k in range(num_groups)):
                if len(which) > 1:
                    shared = escapes(which)
                    for k in which:
                        sides[k] = shared
        return sides


class _Solver:
    """Finds the duration of one generator's flow, and the samples that show the motion."""

    def __init__(
        self,
        arm: WholeArm,
        lifted: Lift,
        avoidance: ArmAvoidance,
        generator: VectorField | None,
        spacing: float,
        *,
        coarse: bool,
        between: tuple[float, float] = (0.0, MAX_DURATION),
    ) -> None:
        self._arm = arm
        self._lifted = lifted
        self._avoidance = avoidance
        self._generator = generator
        self._spacing = spacing
        self._coarse = coarse and generator is not None
        self._shortest, self._longest = between
        self._margin = max(float(avoidance.margin), 2 * ROUNDING)
        self._room = arm.clearance(lifted.pins, avoidance.avoided, self._margin + ROUNDING) - ROUNDING

    def solution(self) -> ArmSolution:
        duration = self._avoidance.duration
        if self._generator is None:
            duration = 0.0
        elif duration is None:
            shaping = self._lifted.tracked.q[: self._lifted.num_shaping]
            q = self._arm.limits.inside(shaping[:, ::STRIDE].reshape(-1, NUM_JOINTS))
            duration = self._clearing_duration(q[self._lack(q) > 0])
        return self._with_duration(min(max(duration, self._shortest), self._longest))

    def _with_duration(self, duration: float) -> ArmSolution:
        transform = self._transform(duration)
        bundle = self._sampled(transform)
        asked, kept = self._clearances(bundle.positions / LEVERS)
        automatic = self._generator is not None and self._avoidance.duration is None
        for _ in range(MAX_ROUNDS if automatic else 0):
            lacking = self._shaping(bundle) & (asked > kept)
            if duration >= self._longest or (asked - kept)[lacking].max(initial=0.0) <= ROUNDING:
                break
            p = bundle.positions[lacking] / LEVERS
            more = min(self._clearing_duration(p), self._longest - duration)
            duration += more
            bundle, transform = self._continued(bundle, more, duration)
            asked, kept = self._clearances(bundle.positions / LEVERS)
        return self._along(bundle, transform, duration, asked, kept)

    def _continued(self, bundle: Bundle, more: float, duration: float) -> tuple[Bundle, Diffeomorphism]:
        """The samples carried on by the flow, by `more` up to this duration, and its transform then."""
        transform = self._transform(duration)
        if self._avoidance.integration.by_hand:  # a few coarse steps are no one-parameter group
            levels = self._evaluate(transform, bundle.index, bundle.fraction)
        else:
            levels = (self._transform(more).inverse(bundle.positions / LEVERS) * LEVERS)[:, None]
        return self._refined(replace(bundle, levels=levels), transform), transform

    def through(self, transform: Diffeomorphism, duration: float) -> ArmSolution:
        """The motions of a transform that is there already, of which that is the full duration."""
        bundle = self._sampled(transform)
        return self._along(bundle, transform, duration, *self._clearances(bundle.positions / LEVERS))

    def _along(
        self, bundle: Bundle, transform: Diffeomorphism, duration: float, asked: Array, kept: Array
    ) -> ArmSolution:
        p = bundle.positions / LEVERS
        shaping, near = self._shaping(bundle), asked - kept > ROUNDING
        q = self._lifted.at(bundle.index, bundle.fraction)
        stuck, too_near = (np.unique(bundle.index[near & which]) for which in (shaping, ~shaping))
        away = np.linalg.norm(self._arm.robot.end_effector(p) - self._arm.robot.end_effector(q), axis=1) > MOVED
        moved = np.unique(bundle.index[away & ~shaping & (bundle.fraction == 0)])
        return ArmSolution(
            transform, bundle.index, bundle.fraction, q, p, duration, float(kept[shaping].min()), stuck, too_near, moved
        )

    def _shaping(self, bundle: Bundle) -> Mask:
        return bundle.index < self._lifted.num_shaping

    def _sampled(self, transform: Diffeomorphism) -> Bundle:
        num_rollouts, num_samples = self._lifted.fractions.shape
        first = np.linspace(0, num_samples - 1, NUM_COARSE if self._coarse else num_samples).round().astype(int)
        index, fraction = np.repeat(np.arange(num_rollouts), len(first)), self._lifted.fractions[:, first].ravel()
        return self._refined(Bundle(index, fraction, self._evaluate(transform, index, fraction)), transform)

    def _transform(self, duration: float) -> Diffeomorphism:
        limits = self._arm.limits
        if self._generator is None or duration == 0:
            return Identity(NUM_JOINTS)
        if self._avoidance.integration.by_hand:
            flow = self._avoidance.integration.of(Flow(self._generator, duration))
        elif self._coarse:
            flow = Flow(self._generator, duration, math.ceil(duration / COARSE_STEP))
        else:
            flow = AdaptiveFlow(self._generator, duration, TOLERANCE)
        return Conjugated(flow, limits)

    def _evaluate(self, transform: Diffeomorphism, index: Indices, fraction: Array) -> Array:
        """Levels (N, 1, 6) of the samples: postures by their `LEVERS`, so that distances are metres."""
        q = self._arm.limits.inside(self._lifted.at(index, fraction))
        return (transform.inverse(q) * LEVERS)[:, None]

    def _refined(self, bundle: Bundle, transform: Diffeomorphism) -> Bundle:
        def integrated(index: Indices, fraction: Array) -> Array:
            return self._evaluate(transform, index, fraction)

        return refined(bundle, integrated, max(self._spacing, COARSE_SPACING) if self._coarse else self._spacing)

    def _lack(self, p: Array) -> Array:
        """(N,) metres by which the arm at configurations (N, 6) misses the clearance that is asked for."""
        asked, kept = self._clearances(p)
        return asked - kept

    def _clearances(self, p: Array) -> tuple[Array, Array]:
        """Clearances (N,), metres, that are asked for at configurations (N, 6), and that are kept.

        Asked for is the margin, or what the starts and goal beside a configuration have. What is kept ends where it is
        more by what a contact moves between two looks at it.
        """
        asked = room_asked(np.array(p, order="C"), self._lifted.pins, self._room, LEVERS, SLOPE, self._margin)
        return asked, self._arm.clearance(p, self._avoidance.avoided, asked + SPEED * SNAPSHOT)

    def _clearing_duration(self, p: Array) -> float:
        """The shortest duration after which the flow has carried configurations (N, 6) clear, or the longest."""
        assert self._generator is not None
        return clearing(self._generator, self._arm.limits, p, self._lack, SNAPSHOT, self._longest)


def clearing(
    field: VectorField, limits: JointLimits, p: Array, lack: Callable[[Array], Array], step: float, longest: float
) -> float:
    """The shortest time after which the reverse flow of a field has carried postures clear, or the longest.

    Args:
        field: generator of the flow, in the coordinates of the limits.
        limits: of the joints.
        p: (N, 6) rad.
        lack: distances (N,), metres, by which postures (N, 6) miss the clearance that is asked for.
        step: flow time between two looks at the clearance.
        longest: flow time.
    """
    duration = clearing_duration(field, limits.forward(p), lambda state: lack(limits.inverse(state)), step, longest)
    return longest if duration is None else duration


def _on_side(obstacle: Obstacle, side: Array, previous: Detour | None) -> Detour:
    """The detour around an obstacle on a side, which goes on from the previous one, if any."""
    return Detour(obstacle, side, side, kept=previous is not None)
