"""Preparation of demonstrations for a fit: a common goal, clean motions, and a warning about every change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rotations import apart, logarithm, mean_orientation
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import Demonstration, samples_of
from dt_viz.learning.inspection import Inspection, PreparationSettings, Repaired, repair, smoothed_turns
from dt_viz.memo import cached_property
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length
from dt_viz.warning import in_metres, in_millimetres


class ImitationError(ValueError):
    """Demonstrations from which no stable system can be learned; the message names the demonstration and the reason."""


class NoCommonGoalError(ImitationError):
    """Demonstrations that end at several places, none of them the place of most.

    Its `goals` are, those of most takes first, what ends at each place and where, and the place (d,), metres.
    """

    def __init__(self, message: str, goals: Sequence[tuple[str, tuple[float, ...]]]) -> None:
        super().__init__(message)
        self.goals = tuple(goals)


class DemonstrationWarning(UserWarning):
    """Something odd about demonstrations, and what was done about it."""


@dataclass(frozen=True)
class Motions:
    """Prepared motions, the input of a fit."""

    numbers: tuple[int, ...]
    """Numbers of the demonstrations that they are, from 0; others are left out."""
    names: tuple[str, ...]
    times: tuple[Array, ...]  # (T_i,) times of each motion, seconds, increasing from 0
    positions: tuple[Array, ...]  # (T_i, d) positions of each motion, the last row the goal
    goal: Array  # (d,) common end
    spread: float  # RMS distance of all points from their mean
    inspections: tuple[Inspection, ...]
    """What was found out about each demonstration, also about those that are left out."""
    repaired: tuple[Demonstration, ...]
    """All demonstrations without outliers, gaps, jitter and pauses; their ends are where they were, but for jitter."""
    goal_orientation: Array | None = None
    """(4,) mean orientation of the hand at the ends, wxyz; None of motions without orientations."""
    turns: tuple[Array, ...] = ()
    """(T_i, 3) rotation vectors of the hand at that orientation, rad; none without orientations."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """Descriptions of what was found, and of the changes to the demonstrations."""
        return tuple(warning for inspection in self.inspections for warning in inspection.warnings)

    @cached_property
    def crossing(self) -> tuple[str, ...]:
        """Descriptions of what the plain state cannot follow."""
        return tuple(
            f"'{name}' crosses itself, which no motion of a first-order system can; the crossing is smoothed"
            for name, path in zip(self.names, self.positions, strict=True)
            if path.shape[1] == 2 and _crosses_itself(resample_by_arc_length(path, 120))
        )

    @cached_property
    def length(self) -> float:
        """Mean length of the motions, in units of the spread."""
        return float(np.mean([arc_length(path)[-1] for path in self.positions])) / self.spread

    @cached_property
    def extent(self) -> float:
        """Length of all motions together along the principal axis in which it is largest, however they are turned."""
        points = np.concatenate(self.positions)
        way = np.mean([path[0] for path in self.positions], axis=0) - self.goal
        return float(np.ptp(points @ self.principal_axes(points, way), axis=0).max())

    def principal_axes(self, points: Array, way: Array) -> Array:
        """Return the principal axes (d, d), as columns, of points (N, d).

        Where these scatter alike to all sides, or not at all, a `way` (d,) decides, not rounding.
        """
        along = 1e-3 * self.spread * way / max(float(np.linalg.norm(way)), 1e-12 * self.spread)
        return np.linalg.eigh(np.cov(points, rowvar=False, bias=True) + np.outer(along, along))[1]

    @property
    def starts(self) -> Array:
        """First points, (R, d)."""
        return np.stack([path[0] for path in self.positions])

    def poses(self, radius: float) -> tuple[Array, ...]:
        """Places and rotation vectors times a radius, (T_i, d + 3), metres; places (T_i, d) without orientations."""
        if not self.turns:
            return self.positions
        return tuple(np.hstack([path, radius * turn]) for path, turn in zip(self.positions, self.turns, strict=True))

    def resampled(self, num: int = 120) -> Array:
        """Resample all motions at `num` points equally spaced along each, (R, num, d)."""
        return np.stack([resample_by_arc_length(path, num) for path in self.positions])

    def only(self, which: Indices) -> Motions:
        """Some of these motions, by their places among these."""
        names = ("numbers", "names", "times", "positions", *(("turns",) if self.turns else ()))
        chosen = {name: tuple(getattr(self, name)[k] for k in which) for name in names}
        return replace(self, **chosen)

    def missed_by(self, system: DiffeomorphicSystem, states: Array) -> float:
        """Largest discrete Fréchet distance of a system's motions from these, relative to the extent."""
        return float(self.distances(system, states).max()) / self.extent

    def distances(self, system: DiffeomorphicSystem, states: Array) -> Array:
        """Discrete Fréchet distances (R,) of the motions of a system from these, which begin in states (R, k).

        The first d coordinates of its states are a place.
        """
        wanted = self.resampled()
        z = system.base.at_fraction(system.transform.forward(states), np.linspace(1.0, 0.0, wanted.shape[1]))
        paths = system.transform.inverse(z)[..., : wanted.shape[2]]
        found = np.stack([resample_by_arc_length(path, wanted.shape[1]) for path in paths])
        return discrete_frechet(found, wanted)


def prepare(demonstrations: Sequence[Demonstration], settings: PreparationSettings | None = None) -> Motions:
    """Inspect demonstrations, repair them and give them a common goal; None takes the default settings.

    Raises:
        ImitationError: there are none, they are damaged, or most do not end at one place, or at the goal that is given.
    """
    settings = settings or PreparationSettings()
    try:
        samples = samples_of(demonstrations)
    except FormatError as error:
        raise ImitationError(str(error)) from error
    takes = [Repaired(own, *sample) for own, sample in zip(demonstrations, samples, strict=True)]
    for take in takes:
        if not arc_length(take.positions)[-1] > 0:
            take.leave_out("still", "never moves")
    moving = [take for take in takes if take.kept]
    if not moving:
        raise ImitationError("no demonstration moves; at least one must lead to the goal")
    repair(moving, settings)
    spread = _spread(moving)
    goal = _common_goal(moving, spread, settings)
    repaired = tuple(take.repaired for take in takes)
    for take in moving:
        if take.kept:
            _lead_to_goal(take, goal, settings.at_goal * spread)
    kept = {number: take for number, take in enumerate(takes) if take.kept}
    if not kept:
        raise ImitationError("every demonstration starts at the goal and stays there; there is nothing to learn")
    names = tuple(take.demonstration.name for take in kept.values())
    times, positions = zip(*((take.times, take.positions) for take in kept.values()), strict=True)
    orientation, turns = _turns([take for take in takes if take.kept], settings)
    inspections = tuple(take.inspection for take in takes)
    return Motions(tuple(kept), names, times, positions, goal, spread, inspections, repaired, orientation, turns)


def _turns(takes: Sequence[Repaired], settings: PreparationSettings) -> tuple[Array | None, tuple[Array, ...]]:
    """Find the goal's orientation (4,), and rotation vectors (T_i, 3) of the takes; none unless all have some."""
    if len(takes[0].positions[0]) < 3 or any(take.demonstration.orientations is None for take in takes):
        return None, ()
    orientations = [take.orientations_at(take.times) for take in takes]
    goal = _common_orientation(takes, np.stack([turned[-1] for turned in orientations]), settings.max_turned_end)
    pairs = zip(takes, orientations, strict=True)
    turns = tuple(smoothed_turns(take, logarithm(goal, turned), settings) for take, turned in pairs)
    for take, turn in zip(takes, turns, strict=True):
        if (farthest := np.linalg.norm(turn, axis=1).max()) > np.pi:
            take.find("turn", f"turns by {np.rad2deg(farthest):.0f}° away from the orientation at the goal")
    return goal, turns


def _common_orientation(takes: Sequence[Repaired], ends: Array, reach: float) -> Array:
    """The orientation (4,) in which most takes end, those within a reach, rad; of the others (R, 4) it is said."""
    near = apart(ends, mean_orientation(ends)) <= reach
    if 2 * near.sum() <= len(ends):
        around = np.stack([apart(ends, end) <= reach for end in ends])
        near = around[around.sum(axis=1).argmax()]
    goal = mean_orientation(ends[near])
    for take, off in zip(takes, apart(ends, goal), strict=True):
        if off > reach:
            text, amount = "ends with the hand turned by {} from the others' goal", f"{np.rad2deg(off):.0f}°"
            take.find("turn", text, "its end is turned there", amount)
    return goal


def _spread(takes: Sequence[Repaired]) -> float:
    points = np.concatenate([resample_by_arc_length(take.positions, 100) for take in takes])
    return float(np.sqrt(points.var(axis=0).sum()))


def _common_goal(takes: Sequence[Repaired], spread: float, settings: PreparationSettings) -> Array:
    """Find the goal (d,), which is given or where most takes end, and leave out those that end elsewhere."""
    ends = np.array([take.positions[-1] for take in takes])
    reach = settings.max_moved_end * spread
    if settings.goal is not None:
        goal = _given_goal(settings.goal, ends, reach)
    else:
        near = np.linalg.norm(ends - np.median(ends, axis=0), axis=1) <= reach
        if 2 * near.sum() <= len(ends):
            around = np.linalg.norm(ends[:, None] - ends, axis=-1) <= reach
            near = around[around.sum(axis=1).argmax()]
        if 2 * near.sum() <= len(ends):
            raise _no_common_goal(takes, ends, reach)
        goal = ends[near].mean(axis=0)
        if not settings.move_ends:
            goal = ends[np.linalg.norm(ends - goal, axis=1).argmin()]
    for take, end in zip(takes, ends, strict=True):
        off = float(np.linalg.norm(end - goal))
        text, amount = f"ends {{}} from the {'common goal' if settings.goal is None else 'goal'}", in_millimetres(off)
        if off > reach and settings.leave_out:
            take.leave_out("elsewhere", text, amount)
        elif 0 < off <= take.jitter and settings.move_ends:
            take.positions = _end_moved(take.positions, goal)
        elif off <= settings.same_goal * spread:
            continue
        elif not settings.move_ends:
            take.leave_out("end", text, amount)
        else:
            take.find("end", text, "its end is moved there", amount)
    if not any(take.kept for take in takes):
        raise ImitationError("no demonstration ends at the goal; accepted: move_ends=True, which moves ends there")
    return goal


def _given_goal(given: Sequence[float], ends: Array, reach: float) -> Array:
    goal = np.asarray(given, float)
    if goal.shape != ends.shape[1:] or not np.isfinite(goal).all():
        raise ImitationError(f"goal: found {given}; accepted: {ends.shape[1]} finite numbers, metres")
    off = np.linalg.norm(ends - goal, axis=1)
    if off.min() > reach:
        nearest = in_metres(ends[off.argmin()])
        raise ImitationError(
            f"goal: found {in_metres(goal)}, at which no demonstration ends; accepted: a place within "
            f"{in_millimetres(reach)} of an end, such as {nearest}"
        )
    return goal


def _no_common_goal(takes: Sequence[Repaired], ends: Array, reach: float) -> NoCommonGoalError:
    left, groups = np.ones(len(ends), bool), []
    while left.any():
        around = (np.linalg.norm(ends[:, None] - ends, axis=-1) <= reach) & left
        group = np.flatnonzero(around[(around.sum(axis=1) * left).argmax()])
        left[group] = False
        names = ", ".join(f"'{takes[k].demonstration.name}'" for k in group[:3])
        more = f" and {len(group) - 3} more" if len(group) > 3 else ""
        goal = ends[group].mean(axis=0)
        groups.append((f"{names}{more} at {in_metres(goal)}", tuple(goal.tolist())))
    several = f" and {len(groups) - 4} more places" if len(groups) > 4 else ""
    message = (
        f"the demonstrations have no common goal, they end at {'; '.join(text for text, _ in groups[:4])}{several}. "
        f"Choose one of these places as the goal (goal=…), or learn the takes of each place by themselves"
    )
    return NoCommonGoalError(message, groups)


def _lead_to_goal(take: Repaired, goal: Array, near: float) -> None:
    """Move the end of a take to the goal, and let it begin away from it, at more than the distance `near`, metres."""
    take.positions = path = _end_moved(take.positions, goal)
    away = np.flatnonzero(np.linalg.norm(path - goal, axis=1) > near)
    if len(away) == 0:
        take.leave_out("start", "stays at the goal")
    elif np.linalg.norm(path[0] - goal) <= near:
        first = away[0]
        text = "starts at the goal, where a stable motion ends"
        amount = f"{take.times[first]:.2g} s"
        take.find("start", text, f"its first {amount} are left out", amount)
        take.replace(take.times[first:], path[first:], take.times[first:])


def _end_moved(path: Array, goal: Array) -> Array:
    """Move the end of a path to the goal, and its other points less the farther they are from the end."""
    length = arc_length(path)
    moved = path + (length / length[-1])[:, None] ** 2 * (goal - path[-1])
    moved[-1] = goal
    return moved


def _crosses_itself(path: Array) -> bool:
    """Return whether two segments of a polyline (T, 2) that are not neighbours cross."""
    a, b = path[:-1], path[1:]

    def side(p: Array, q: Array, r: Array) -> Array:
        u, v = q - p, r - p
        return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]

    first, second = (a[:, None], b[:, None]), (a[None], b[None])
    crossing = (side(*first, second[0]) * side(*first, second[1]) < 0) & (
        side(*second, first[0]) * side(*second, first[1]) < 0
    )
    return bool(np.triu(crossing, 2).any())
