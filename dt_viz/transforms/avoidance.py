"""Avoiding an obstacle: the reverse flow out of what it occupies, for as long as it takes to be clear (sec. 4.4)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from dt_viz.flows.diffeomorphisms import AdaptiveFlow
from dt_viz.flows.fields import Array, Mask, VectorField
from dt_viz.flows.integrators import integrate_adaptive, rk4
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.transforms.base import Built, Motion, named_starts

MAX_DURATION = 2.5
"""Longest flow that is tried to clear an obstacle: a motion that still collides runs through the flow's centre."""
SNAPSHOT = 0.05
"""Flow time between two looks at the clearance. The field turns points around in about ten of them, so one RK4 step is
off by micrometres; between the last two the duration is interpolated."""
TOLERANCE = 1e-5
"""Of the integration up to the duration that is known to be needed, metres a step."""
NUM_DEEPEST = 8
"""Samples of each rollout that the duration is chosen for at first."""
TINY = 1e-12
"""Metres between samples that are the same."""
ROUNDING = 1e-6
"""Metres that do not count: a motion may end on the surface."""
ACCEPTED_MARGIN = 0.9
"""Part of the margin that a sample between the checked ones may keep."""
BESIDE = 1e-3
"""Metres inside that still are beside the obstacle where its surface is only nearly known, and by which a motion may go
deeper than its covered start before that counts."""
TAIL = 2.0
"""Length of the end of a path to a covered goal that may be inside, in distances from the goal to the nearest free
place: such a path arrives at up to 60° from the straight way out."""
GOAL_INSIDE, STAYS_INSIDE = "the goal is inside the obstacle", "a motion does not leave the obstacle"
"""Words of the doubts that name a cause; what follows from it is not said again."""


class ObstacleAvoidance:
    """The end effector avoids the obstacle."""

    def build(self, motion: Motion, tolerance: float, at_least: float) -> Built | None:
        """See `Behaviour`. With `auto` the duration is the shortest that clears all that can be cleared.

        That is, of this motion. The ends of the next one are moved by this flow, and its duration only grows from one
        attempt to the next: where a start or goal is close to the obstacle it may end up longer than needed.
        """
        scenario = motion.scenario
        if not scenario.avoidance or scenario.space == "cspace" or not scenario.obstacle.parts:
            return None
        obstacle = scenario.obstacle
        field = obstacle.field(scenario.generator, scenario.temperature)
        num_demonstrated = len(motion.demonstrated.starts)
        doubts = named_starts(np.flatnonzero(_blocked(motion)), num_demonstrated, "inside the obstacle")
        duration, hopeless = scenario.duration, False
        if duration is None:
            # the deepest samples leave last, or nearly so; where they did not tell the whole story, take all
            depth = np.where(_avoidable(motion), obstacle.signed_distance(motion.positions), np.inf)
            if at_least:
                points = motion.positions[np.isfinite(depth)]
            else:
                points = np.concatenate([_deepest(motion, depth), _crests(motion, depth, field)])
            duration = clearing_duration(field, obstacle, points, _margin(motion), at_least=at_least)
            # where the exact flow is clear for longer already, more time is not what a coarse one lacks
            hopeless = duration is None or (scenario.integration.by_hand and 0 < duration <= at_least)
            if duration is None:
                duration = MAX_DURATION
                carried, _ = integrate_adaptive(field, points, None, -duration, TOLERANCE)
                if obstacle.signed_distance(carried).min() < 0:
                    flat = scenario.generator == "probability"
                    why = "∇p is flat inside it" if flat else "it runs through its dead centre"
                    doubts.append(f"{STAYS_INSIDE}: {why}")
        flow = scenario.integration.of(AdaptiveFlow(field, duration, tolerance))
        goal = _goal(motion) if motion.keeps_goal else flow.inverse(motion.goal)
        if obstacle.signed_distance(motion.goal) < 0:
            inside = -float(obstacle.signed_distance(goal))
            end = "end beside it" if inside < BESIDE else f"end {1e3 * inside:.0f} mm deep in it"
            doubts.append(f"{GOAL_INSIDE}: motions {end}")
        return Built(flow, duration, goal, hopeless, tuple(doubts), scenario.integration)

    def satisfied(self, motion: Motion) -> bool:
        """Whether all that can be cleared keeps (almost) the margin, where that is to be seen to."""
        if motion.scenario.duration is not None:
            return True
        distance = motion.scenario.obstacle.signed_distance(motion.positions[_avoidable(motion)])
        return bool((distance >= ACCEPTED_MARGIN * _margin(motion) - ROUNDING).all())


def smallest_kept(motion: Motion) -> float:
    """Smallest distance from the obstacle of what the stack could keep out of it, metres, negative inside.

    Of a motion that starts inside, what is deeper than its start counts, too; of one that was to end beside a covered
    goal, all up to its end. Infinite if nothing counts.
    """
    obstacle, motion = motion.scenario.obstacle, replace(motion, keeps_goal=False)
    distance, at_start = obstacle.signed_distance(motion.positions), obstacle.signed_distance(motion.starts)
    deeper = (at_start < 0)[motion.index] & (distance < at_start[motion.index] - BESIDE)
    return float(distance[_avoidable(motion) | deeper].min(initial=np.inf))


def _goal(motion: Motion) -> Array:
    """Where motions around the obstacle end: at the goal, or beside the obstacle if that covers it."""
    return motion.scenario.obstacle.nearest_free(motion.goal)


def _blocked(motion: Motion) -> Mask:
    """(R,) bool: which rollouts start inside the obstacle."""
    return motion.scenario.obstacle.signed_distance(motion.starts) < 0


def _margin(motion: Motion) -> float:
    """The clearance to keep, metres: the wanted one, or what start and goal leave of it."""
    ends = motion.starts[~_blocked(motion)]
    if motion.keeps_goal:
        ends = np.concatenate([ends, _goal(motion)[None]])
    room = motion.scenario.obstacle.signed_distance(ends).min(initial=motion.scenario.margin)
    return max(0.0, float(room))


def _deepest(motion: Motion, depth: Array) -> Array:
    """(M, 3) the deepest few samples of each rollout; `depth` (N,), metres, is infinite for those that do not count."""
    order = np.lexsort([depth, motion.index])
    rank = np.arange(len(order)) - np.searchsorted(motion.index, motion.index)
    return motion.positions[order[(rank < NUM_DEEPEST) & np.isfinite(depth[order])]]


def _crests(motion: Motion, depth: Array, field: VectorField) -> Array:
    """(M, 3) places between the samples of the rollouts where the field stops leading onwards and starts leading back.

    The field is a gradient, or nearly so: its potential is largest there, and what is there leaves last.
    """
    s, step = motion.positions, np.diff(motion.positions, axis=0)
    near, same = depth < _margin(motion), np.diff(motion.index) == 0
    k = np.flatnonzero(same & near[:-1] & near[1:])
    here, there = (field(np.concatenate([s[k], s[k + 1]])) * np.tile(step[k], (2, 1))).sum(axis=1).reshape(2, -1)
    turns = (here > 0) & (there < 0)
    k, part = k[turns], (here / np.where(turns, here - there, 1))[turns, None]
    # between two samples a path bends like the parabolas through them and the ones beside them; lengths tell them apart
    length = np.maximum(np.linalg.norm(step, axis=1, keepdims=True), TINY)
    bend, inner = np.zeros_like(s), (same[:-1] & same[1:])[:, None]
    bend[1:-1] = np.diff(step / length, axis=0) / (length[:-1] + length[1:]) * inner
    return s[k] + part * step[k] - part * (1 - part) * length[k] ** 2 * (bend[k] + bend[k + 1]) / 2


def _avoidable(motion: Motion) -> Mask:
    """(N,) bool: samples that a transform can keep out of the obstacle.

    Not the first ones of a motion that starts inside it, until it keeps the margin. If it covers the goal, not the last
    ones either, as near to the end as the way to where motions end instead is short.
    """
    obstacle = motion.scenario.obstacle
    distance = obstacle.signed_distance(motion.positions)
    free, clear = distance >= -ROUNDING, distance >= ACCEPTED_MARGIN * _margin(motion) - ROUNDING
    goal_covered = motion.keeps_goal and obstacle.signed_distance(motion.goal) < 0
    instead = _goal(motion) if goal_covered else motion.goal
    avoidable = np.ones(len(free), dtype=bool)
    for rollout, blocked in enumerate(_blocked(motion)):
        if not (blocked or goal_covered):
            continue
        rows = np.flatnonzero(motion.index == rollout)
        outside = np.flatnonzero((clear if clear[rows].any() else free)[rows])
        if blocked:
            avoidable[rows[: outside[0] if len(outside) else None]] = False
        if goal_covered:
            path = motion.positions[rows]
            to_end = np.append(np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1)[::-1])[::-1], 0)
            tail = to_end <= TAIL * np.linalg.norm(path[-1] - instead) + BESIDE
            tail[: outside[-1] + 1 if len(outside) else 0] = False
            avoidable[rows[tail]] = False
    return avoidable


def clearing_duration(
    field: VectorField, obstacle: Union | Obstacle, points: Array, margin: float, *, at_least: float = 0.0
) -> float | None:
    """The shortest duration after which the reverse flow has carried all `points` clear of the obstacle.

    γ is a one-parameter group, so one integration with snapshots passes every duration on its way; and occupancy falls
    along the reverse flow, so what is clear stays clear and can be left behind.

    Args:
        field: generator of the flow.
        obstacle: true shape.
        points: (N, 3) points before the flow, metres.
        margin: clearance wanted, metres.
        at_least: duration to start from.

    Returns:
        The duration, or None where some point is not clear after `MAX_DURATION`.
    """
    duration = at_least
    if duration > 0:
        points, _ = integrate_adaptive(field, points, None, -duration, TOLERANCE)
    clearance = obstacle.signed_distance(points)
    inside = clearance < margin
    points, clearance = points[inside], clearance[inside]
    while len(points):
        if duration >= MAX_DURATION:
            return None
        points, _ = rk4(field, points, None, -SNAPSHOT)
        before, clearance = clearance, obstacle.signed_distance(points)
        inside = clearance < margin
        if not inside.any():
            fraction = (margin - before) / np.maximum(clearance - before, 1e-12)
            return duration + SNAPSHOT * float(np.clip(fraction, 0, 1).max())
        points, clearance, duration = points[inside], clearance[inside], duration + SNAPSHOT
    return duration
