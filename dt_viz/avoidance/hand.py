"""Avoiding obstacles: the reverse flow out of what they occupy, for as long as it takes to be clear (sec. 4.4)."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance, clearing_duration, start_warnings
from dt_viz.avoidance.detour import Detour, DetourSettings, directions_around
from dt_viz.avoidance.sideways import Encounter, fixing_ends
from dt_viz.avoidance.transform import Built, MotionBelow, Planar, axes_of
from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Flow
from dt_viz.flows.fields import Array, Mask, Projected, VectorField
from dt_viz.metrics import arc_length
from dt_viz.obstacles.shapes import Obstacle, Point
from dt_viz.obstacles.union import Union, escape_lengths
from dt_viz.warning import Kind, MotionWarning, in_millimetres

MAX_DURATION = 2.5
"""Longest flow time that is tried: a motion that still collides runs through the flow's centre."""
SNAPSHOT = 0.05
"""Interval of flow time between two checks of the clearance, one RK4 step. The field turns points around in about ten
of them, so a step is off by micrometres; between the last two checks the duration is interpolated."""
TOLERANCE = 1e-5
"""Tolerance of a step of the integration up to the duration that is known to be needed, metres."""
ROUNDING = 1e-6  # depth that counts as rounding, metres: a motion may end on the surface
ACCEPTED_MARGIN = 0.9  # smallest part of the margin that samples between the checked ones may keep
BESIDE = 1e-3
"""Tolerance of the surface of an obstacle, metres, which is known approximately; also of a covered start's depth."""
NUM_DIRECTIONS = 360  # number of directions of a plane in which the nearest free place is searched
TAIL = 2.0
"""Length of the end of a path to a covered goal that may be inside, in distances from the goal to the nearest free
place: such a path arrives at up to 60° from the straight escape."""


@dataclass(frozen=True, init=False, repr=False)
class HandAvoidance(Avoidance, Planar, space="task"):
    """The end effector avoids (sec. 4.4)."""

    plane: tuple[Point, Point] | None
    """Two orthonormal vectors: the flow acts along these only; None is in space."""

    def __init__(
        self,
        obstacles: Obstacle | Iterable[Obstacle] | Union = (),
        *,
        plane: tuple[Point, Point] | None = None,
        detour: DetourSettings = DetourSettings(along=1.0),  # noqa: B008 - it is frozen
        **others: Any,  # noqa: ANN401 - those of Avoidance
    ) -> None:
        """Take what `Avoidance` takes, and a plane; a side along the motions costs the hand less than the arm."""
        super().__init__(obstacles, detour=detour, **others)
        object.__setattr__(self, "plane", plane)

    @property
    def acts(self) -> bool:
        return bool(self.obstacles)

    def _field(self) -> VectorField:
        field = self.avoided.field(self.generator, self.temperature)
        if self.plane is None:
            return field
        along = axes_of(self.plane)[:, :2]
        return Projected(field, along @ along.T)

    def _nearest_free(self, goal: Array) -> Array:
        """Return the nearest free place (3,) to a covered goal (3,), metres; in the plane, if the flow acts there."""
        obstacle = self.avoided
        if self.plane is None or obstacle.signed_distance(goal) >= 0:
            return obstacle.nearest_free(goal)
        directions = directions_around(axes_of(self.plane)[:, :2], NUM_DIRECTIONS)
        length = escape_lengths(obstacle, goal, directions)
        return goal + length.min() * directions[length.argmin()]

    def build(self, motion: MotionBelow) -> Built:
        """The automatic flow time is the shortest that clears all avoidable samples of this motion.

        The flow also moves the ends of the next attempt's motion, and the flow time only grows from one attempt to the
        next: where a start or goal is close to the obstacle it may end up longer than needed.
        """
        obstacle = self.avoided
        field = self._field()
        detours, sideways, motion = self._sideways(motion)
        spent = sum(flow.duration for flow in sideways)
        at_least = max(0.0, motion.at_least - spent)
        if sideways and motion.earlier is not None:
            last = self.integration.of(Flow.adaptive(field, at_least, motion.tolerance))
            motion = replace(
                motion, positions=Chain([fixing_ends(first, last) for first in sideways]).inverse(motion.positions)
            )
        covered = obstacle.signed_distance(motion.starts) < 0
        added = np.zeros(len(covered), bool) if motion.shaping is None else ~motion.shaping
        warnings = [*start_warnings(covered, added, Kind.START_COVERED, "inside the obstacle", motion.name)]
        duration, hopeless = None if self.duration is None else self.duration - spent, False
        if duration is None:
            points, margin = motion.positions[self._avoidable(motion)], self._kept_margin(motion)
            if at_least > 0:
                points = Flow.adaptive(field, at_least, TOLERANCE).inverse(points)
            more = clearing_duration(
                field, points, lambda s, _: margin - obstacle.signed_distance(s), SNAPSHOT, MAX_DURATION - at_least
            )
            duration = None if more is None else at_least + more
            # a coarse flow that is not clear after the time of the exact one needs more steps, not more time
            hopeless = duration is None or (self.integration.by_hand and 0 < duration <= at_least)
            if duration is None:
                duration = MAX_DURATION
                carried = Flow.adaptive(field, duration, TOLERANCE).inverse(points)
                if obstacle.signed_distance(carried).min() < 0:
                    flat = self.generator == "probability"
                    why = "∇p is flat inside it" if flat else "it runs through its dead centre"
                    text = f"a motion does not leave the obstacle: {why}"
                    warnings.append(motion.warning(Kind.STAYS_INSIDE, text))
        flow: Diffeomorphism = self.integration.of(Flow.adaptive(field, duration, motion.tolerance))
        if sideways:
            flow = Chain([*(fixing_ends(first, flow) for first in sideways), flow])
        goal = self._nearest_free(motion.goal) if motion.keeps_goal else flow.inverse(motion.goal)
        if obstacle.signed_distance(motion.goal) < 0:
            inside = -float(obstacle.signed_distance(goal))
            end = "end beside it" if inside < BESIDE else f"end {1e3 * inside:.0f} mm deep in it"
            warnings.append(motion.warning(Kind.GOAL_COVERED, f"the goal is inside the obstacle: motions {end}"))
        duration += spent
        chosen = {"duration": duration}
        return Built(flow, duration, goal, hopeless, tuple(warnings), self.integration, chosen, detours, sideways)

    def _sideways(self, motion: MotionBelow) -> tuple[tuple[Detour | None, ...], tuple[Flow, ...], MotionBelow]:
        """Return detours around the obstacles, the flows that carry all motions to one side of each, and these there.

        Further attempts take those of the first, with the motion before them: for starts that the flows have moved into
        the obstacle they would be longer, and move these farther. A flow time by hand is spent on these first. In a
        plane no escape turns from one side to the other, so none is carried over there. The paper's generator acts
        alone.
        """
        if motion.earlier is not None:
            return motion.earlier.detours, motion.earlier.sideways, motion
        detours: list[Detour | None] = [None] * len(self.obstacles)
        sideways: list[Flow] = []
        if self.generator == "probability":
            return tuple(detours), (), motion
        plane = None if self.plane is None else axes_of(self.plane)[:, :2]
        known = motion.detours if motion.detours and plane is None else (None,) * len(self.obstacles)
        margin = self._kept_margin(motion.demonstrated)
        left = math.inf if self.duration is None else self.duration
        for k, (obstacle, previous) in enumerate(zip(self.obstacles, known, strict=True)):
            seen = motion.demonstrated
            met = Encounter.of(seen, self._avoidable(seen), obstacle, margin, self.obstacles[:k], plane)
            if met is None:
                continue
            detours[k] = detour = met.detour(previous, self.detour)
            flow = met.flow(detour.direction, motion.tolerance)
            flow = self.integration.of(replace(flow, duration=min(flow.duration, left)))
            left -= flow.duration
            if flow.duration > 0:
                sideways.append(flow)
                motion = replace(motion, positions=flow.inverse(motion.positions))
        return tuple(detours), tuple(sideways), motion

    def satisfied(self, motion: MotionBelow, top: Array) -> bool:
        """Return whether all avoidable samples keep (almost) the margin; true for any flow time by hand."""
        if self.duration is not None:
            return True
        distance = self.avoided.signed_distance(motion.positions[self._avoidable(motion)])
        return bool((distance >= ACCEPTED_MARGIN * self._kept_margin(motion) - ROUNDING).all())

    def shortfall(self, motion: MotionBelow, made: Built, *, satisfied: bool) -> tuple[MotionWarning, ...]:
        """Warnings about how near the end effector comes to the obstacle; see `Transform`."""
        if satisfied and float(self.avoided.signed_distance(motion.positions).min()) >= 0:
            return ()
        kept = self.smallest_kept(motion)
        covered = any(warning.kind is Kind.GOAL_COVERED for warning in made.warnings)
        # motions to a covered goal end beside it, nearly on the surface
        if kept < (-BESIDE if covered else -ROUNDING):
            return (motion.warning(Kind.ENTERS, f"a motion enters the obstacle by {in_millimetres(-kept)}"),)
        if satisfied or np.isinf(kept):
            return ()
        far = made.hopeless and not made.integration.by_hand
        hotter = "" if self.generator == "probability" else "a higher T or "  # that of the paper has no T
        why = f": the field does not reach farther; {hotter}a smaller margin helps" if far else ""
        text = f"a motion keeps only {1e3 * kept:.1f} mm from the obstacle{why}"
        return (motion.warning(Kind.TOO_NEAR, text),)

    def smallest_kept(self, motion: MotionBelow) -> float:
        """Return the smallest distance of avoidable samples from the obstacle, metres, negative inside.

        Samples deeper than a covered start count, too, and for a covered goal all samples up to the end. Infinite if
        nothing counts.
        """
        obstacle, motion = self.avoided, replace(motion, keeps_goal=False)
        distance, at_start = obstacle.signed_distance(motion.positions), obstacle.signed_distance(motion.starts)
        deeper = (at_start < 0)[motion.index] & (distance < at_start[motion.index] - BESIDE)
        return float(distance[self._avoidable(motion) | deeper].min(initial=np.inf))

    def _kept_margin(self, motion: MotionBelow) -> float:
        """Return the clearance to keep, metres: the margin, or less where a start or goal is nearer to the surface.

        A start may be on either side of it, so that nothing jumps while an obstacle is dragged over it.
        """
        ends = motion.starts
        if motion.keeps_goal:
            ends = np.concatenate([ends, self._nearest_free(motion.goal)[None]])
        return float(np.abs(self.avoided.signed_distance(ends)).min(initial=self.margin))

    def _avoidable(self, motion: MotionBelow) -> Mask:
        """Return which samples (N,) can be kept out of the obstacle.

        Excluded are the first samples of a motion that starts inside, until it keeps the margin; and, if the goal is
        covered, the last samples, within `TAIL` distances from the end to where motions end instead.
        """
        obstacle = self.avoided
        distance = obstacle.signed_distance(motion.positions)
        free, clear = distance >= -ROUNDING, distance >= ACCEPTED_MARGIN * self._kept_margin(motion) - ROUNDING
        goal_covered = motion.keeps_goal and obstacle.signed_distance(motion.goal) < 0
        instead = self._nearest_free(motion.goal) if goal_covered else motion.goal
        avoidable = np.ones(len(free), dtype=bool)
        for rollout, blocked in enumerate(obstacle.signed_distance(motion.starts) < 0):
            if not (blocked or goal_covered):
                continue
            rows = np.flatnonzero(motion.index == rollout)
            outside = np.flatnonzero((clear if clear[rows].any() else free)[rows])
            if blocked:
                avoidable[rows[: outside[0] if len(outside) else None]] = False
            if goal_covered:
                path = motion.positions[rows]
                to_end = arc_length(path[::-1])[::-1]
                tail = to_end <= TAIL * np.linalg.norm(path[-1] - instead) + BESIDE
                tail[: outside[-1] + 1 if len(outside) else 0] = False
                avoidable[rows[tail]] = False
        return avoidable
