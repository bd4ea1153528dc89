"""From motions of the end effector to motions of the whole arm that clear an obstacle (sec. 4.5).

The joints follow the end effector by the pseudo-inverse: q(t) = Q(x(t)) with one section Q for all rollouts of a task
(`robot.inverse_kinematics.track` with a shared reference). It does not depend on the obstacle, so it is computed once;
a drag costs p(t) = ψ_q⁻¹(q(t)) only, one batched flow in Rⁿ.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse.csgraph import connected_components

from dt_viz.avoidance.arm_field import JointLimits, WholeArmField, WholeArmSettings
from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE, MAX_DURATION, SLOPE, ArmSolution, Solver
from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.avoidance.detour import Detour, carried_over, escape_directions
from dt_viz.avoidance.lift import Lift
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.flows.fields import Array, Indices, Mask
from dt_viz.kernels.blocks import room_asked
from dt_viz.kernels.compiled import complete
from dt_viz.kernels.dodging import Forecast, LimitedArm, dodge
from dt_viz.kernels.limits import barrier, velocity_bounds
from dt_viz.kernels.proximity import contacts, least_contacts, proximity
from dt_viz.kernels.tubes import evenly_bent, tubes
from dt_viz.numerics import unit
from dt_viz.obstacles.shapes import Obstacle, Sphere, records
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import track
from dt_viz.robot.robot import Robot, sized

NUM_COMPARED = 60  # colliding samples that escapes are compared by
NUM_ESCAPES = 3  # largest number of escapes from each obstacle that are tried


class WholeArm:
    """Makes the arm's motions clear an obstacle, by a diffeomorphism of configuration space."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.body = robot.links.with_end_effector(robot)
        """Body points of the links, and what the hand holds."""
        self.settings = WholeArmSettings.of(robot)
        self.limits = JointLimits(robot.lower, robot.upper)
        self._solver = partial(Solver, robot, self.body, self.limits)

    def compiled(self) -> Iterator[float]:
        """Compile the kernels that a drag calls, or load them from the cache; yields the fraction done."""
        robot, q, obstacle = self.robot, self.robot.home[None].copy(), Sphere((0.0, 0.0, 0.0))
        field = WholeArmField(robot, self.body, (obstacle,), np.eye(3)[:1], q[:0], 0.1)
        points = self.body.of_chain(robot.chain(q.T))
        shapes, values = records((obstacle,))
        joints, links, still = robot.records, robot.links.spheres, np.zeros(robot.num_joints)
        limits = robot.lower, robot.upper, robot.velocity_limits
        dodging, ones = LimitedArm(joints, links, *limits, 1.0), np.ones((1, 1))
        forecast = Forecast(shapes, values, np.ones(1), np.ones((1, 1, 3)), ones, 0.0, 0.0, 1.0)
        calls: tuple[Callable[[], object], ...] = (
            lambda: robot.end_effector(q),
            lambda: self.clearance(q, obstacle),
            lambda: track(robot, robot.end_effector(q)[:, None], q, reference=q),
            lambda: room_asked(q, q, np.zeros(1), np.array(robot.levers), SLOPE, 0.0),
            lambda: proximity(joints, links, shapes, values, q[0].copy(), 1.0),
            lambda: contacts(joints, links, np.array([[-1, 0]]), q[0].copy(), 1.0),
            lambda: least_contacts(joints, links, np.array([[-1, 0]]), q.copy(), 1.0),
            lambda: dodge(dodging, forecast, still, still, still, still, 0.0),
            lambda: velocity_bounds(dodging, still, still, 1.0),
            lambda: barrier(np.ones(1), np.ones((1, robot.num_joints)), 1.0, 1.0),
            lambda: tubes(evenly_bent(np.eye(3), 3)[None], 1.0, 1.0, 3),
            lambda: escape_directions(points, self.body.radius, np.eye(3)[:1], obstacle, margin=2.0),
            lambda: field(q),
            lambda: obstacle.field("free-space", 1.0)(np.zeros((1, 3))),  # the hand's fields
        )
        for done, call in enumerate(calls, start=1):
            call()
            yield done / len(calls)
        complete()

    def undisturbed(self, lifted: Lift, avoidance: ArmAvoidance, spacing: float) -> ArmSolution:
        """The motions as lifted, avoiding nothing."""
        return self._solver(lifted, avoidance, (), spacing).solution()

    def avoiding(
        self, lifted: Lift, avoidance: ArmAvoidance, spacing: float, *, coarse: bool, passing: Passing = ANEW
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
                `WholeArmSettings.coarse_spacing` if that is more.
            coarse: whether the flow is integrated for the eye only, in a few equal steps.
            passing: detours to keep while obstacles are dragged.
        """
        known = carried_over(passing.arm, avoidance.avoided.parts, turn=False)
        sides = self._sides(lifted, avoidance, known)
        by_hand = avoidance.duration is not None or avoidance.generator == "probability"
        coarsely, best = coarse or not by_hand, None
        for attempt in range(min(NUM_ESCAPES, max(map(len, sides), default=0))):
            detours = _detours(avoidance, sides, known, [attempt] * len(sides))
            tried = self._solver(lifted, avoidance, detours, spacing, coarse=coarsely).solution()
            if by_hand:
                return tried
            if best is None or self._better(tried, best):
                best = tried
            if tried.soon or (tried.cleared and any(detour is not None and detour.kept for detour in detours)):
                break
        if coarse and best is not None:
            return best
        return self._solver(lifted, avoidance, best.detours if best else (), spacing, coarse=False).solution()

    def followed(self, lifted: Lift, avoidance: ArmAvoidance, spacing: float, passing: Passing) -> ArmSolution:
        """Coarse motions that follow an obstacle which is dragged: they change no faster than the obstacle moves.

        Detours turn towards the sides that are to be taken, and the flow's duration changes, at rates limited by the
        drag. So no motion jumps where the side changes or none clears the obstacle; until a detour has arrived at its
        side, motions may come nearer than the margin. Where it has and does not clear, it turns to the next side.
        `passing` has the detours around the obstacles at their last poses, and the duration of that flow.
        """
        known = carried_over(passing.arm, avoidance.avoided.parts)
        failed = not passing.cleared and passing.duration >= MAX_DURATION
        attempts = [int(failed and last is not None and last.arrived) for last in known]
        detours = _detours(avoidance, self._sides(lifted, avoidance, known), known, attempts)
        travelled = max((last.travelled or 0.0 for last in known if last is not None), default=0.0)
        change = self.settings.duration_change * travelled
        between = max(passing.duration - change, 0.0), min(passing.duration + change, MAX_DURATION)
        return self._solver(lifted, avoidance, detours, spacing, between=between).solution()

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
        solver = self._solver(lifted, avoidance, full.detours, spacing, coarse=False)
        return solver.through(full.transform.scaled(fraction), full.duration)

    def clearance(
        self, q: Array, obstacle: Union | Obstacle, highest: ArrayLike = np.inf, lowest: ArrayLike = -np.inf
    ) -> Array:
        """Distance (N,), metres, of arm and end effector from the obstacle; see `BodyPoints.clearance`."""
        return self.body.clearance(self.robot, q, obstacle, highest, lowest)

    def _sides(self, lifted: Lift, avoidance: ArmAvoidance, known: Sequence[Detour | None]) -> list[list[Array]]:
        """Escapes (3,) from each obstacle, the most promising first; none where nothing comes too near it.

        Obstacles that one posture comes near to are left in one direction where their own ones are opposed: else their
        flows would hold each other up, and motions turn back between them.
        """
        q, parts, margin = lifted.tracked.q[lifted.shaping], avoidance.avoided.parts, avoidance.margin
        settings, detour = self.settings, sized(avoidance.detour, self.robot.size)
        beside = max(settings.beside, margin)
        tangents = unit(np.gradient(self.robot.end_effector(q), axis=1).reshape(-1, 3))
        q = q.reshape(-1, q.shape[-1])
        clearance = np.array([self.body.outermost.clearance(self.robot, q, part, beside) for part in parts])  # at most
        clearance = clearance.reshape(len(parts), len(q))
        near: Mask = clearance < margin
        for part, mask in zip(parts, near, strict=True):
            mask[mask] = self.clearance(q[mask], part, margin, margin - MARGIN_TOLERANCE) < margin

        def escapes(which: Indices) -> list[Array]:
            """Directions that leave all of these obstacles."""
            collides = np.flatnonzero(near[which].any(axis=0))
            bent = np.flatnonzero((clearance[which] < beside).any(axis=0))
            compared = q[collides[:: max(1, len(collides) // NUM_COMPARED)]]
            return escape_directions(
                self.body.of_chain(self.robot.chain(compared.T)),
                self.body.radius,
                tangents[bent[:: max(1, len(bent) // NUM_COMPARED)]],
                Union(tuple(parts[k] for k in which)),
                margin,
                num=NUM_ESCAPES,
                settings=detour,
                previous=next((last.side for last in (known[k] for k in which) if last is not None), None),
            )

        sides: list[list[Array]] = [[] for _ in parts]
        met = np.flatnonzero(near.any(axis=1))
        for k in met:
            sides[k] = escapes(np.array([k]))
        if len(met) > 1:
            first = np.array([sides[k][0] for k in met])
            together = (near[met, None] & (clearance[met] < settings.together)).any(axis=2)
            num_groups, group = connected_components(together & (first @ first.T < settings.opposed), directed=False)
            for which in (met[group == k] for k in range(num_groups)):
                if len(which) > 1:
                    shared = escapes(which)
                    for k in which:
                        sides[k] = shared
        return sides


def _detours(
    avoidance: ArmAvoidance, sides: Sequence[Sequence[Array]], known: Sequence[Detour | None], attempts: Sequence[int]
) -> tuple[Detour | None, ...]:
    """Make detours to sides (3,) of each obstacle, the most promising first, or turning to them from `known` ones.

    The `attempts` say which side of each is taken; the last one where there are fewer.
    """
    detours: list[Detour | None] = []
    for part, found, last, attempt in zip(avoidance.avoided.parts, sides, known, attempts, strict=True):
        side = found[min(attempt, len(found) - 1)] if found else None
        detour = None if side is None else Detour(part, side, side, kept=last is not None)
        if detour is not None and last is not None and last.travelled is not None:
            detour = detour.turned_from(last, found, avoidance.detour.turning)
        detours.append(detour)
    return tuple(detours)
