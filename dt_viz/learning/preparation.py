"""Preparation of demonstrations for a fit: a common goal, clean motions, and a warning about every change."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import Demonstration, samples_of
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length

DECIDING = 1e-3  # deviation that points are given along a way, in spreads, to decide between axes that are alike


class ImitationError(ValueError):
    """Demonstrations from which no stable system can be learned; the message names the demonstration and the reason."""


@dataclass(frozen=True)
class PreparationSettings:
    """Settings of the preparation. Lengths are in spreads, the RMS distance of all points from their mean."""

    same_goal: float = 1e-3
    """Distance from the goal up to which an end is at the goal."""
    max_moved_end: float = 0.3
    """Distance from the goal up to which an end is moved there; farther ones are left out."""
    at_goal: float = 0.05
    """Distance from the goal up to which a start is at the goal."""
    standing_step: float = 1e-3
    """Length of a step, lasting 1 % of the motion, below which the motion stands still."""
    long_stand: float = 0.1
    """Part of the duration from which standing still is reported."""


@dataclass(frozen=True)
class Motions:
    """Prepared motions, the input of a fit."""

    numbers: tuple[int, ...]
    """Numbers of the demonstrations that they are, from 0; others are left out."""
    names: tuple[str, ...]
    times: tuple[Array, ...]
    """(T_i,) times of each motion, seconds, increasing from 0."""
    positions: tuple[Array, ...]
    """(T_i, d) positions of each motion, the last row the goal."""
    goal: Array
    """(d,) common end."""
    spread: float
    """RMS distance of all points from their mean."""
    warnings: tuple[str, ...]
    """Descriptions of the changes to the demonstrations."""

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
        along = DECIDING * self.spread * way / max(float(np.linalg.norm(way)), 1e-12 * self.spread)
        return np.linalg.eigh(np.cov(points, rowvar=False, bias=True) + np.outer(along, along))[1]

    @property
    def starts(self) -> Array:
        """First points, (R, d)."""
        return np.stack([path[0] for path in self.positions])

    def resampled(self, num: int = 120) -> Array:
        """Resample all motions at `num` points equally spaced along each, (R, num, d)."""
        return np.stack([resample_by_arc_length(path, num) for path in self.positions])

    def only(self, which: Indices) -> Motions:
        """Some of these motions, by their places among these."""
        chosen = {
            name: tuple(getattr(self, name)[k] for k in which) for name in ("numbers", "names", "times", "positions")
        }
        return replace(self, **chosen)

    def missed_by(self, system: DiffeomorphicSystem, states: Array) -> float:
        """Largest discrete Fréchet distance of a system's motions from these, relative to the extent."""
        return float(self.distances(system, states).max()) / self.extent

    def distances(self, system: DiffeomorphicSystem, states: Array) -> Array:
        """Discrete Fréchet distances (R,) of a system's motions from these.

        Args:
            system: of states, the first d coordinates of which are a place.
            states: (R, k) in which its motions begin.
        """
        wanted = self.resampled()
        z = system.base.at_fraction(system.transform.forward(states), np.linspace(1.0, 0.0, wanted.shape[1]))
        paths = system.transform.inverse(z)[..., : wanted.shape[2]]
        found = np.stack([resample_by_arc_length(path, wanted.shape[1]) for path in paths])
        return discrete_frechet(found, wanted)


def prepare(demonstrations: Sequence[Demonstration], settings: PreparationSettings | None = None) -> Motions:
    """Check demonstrations and give them a common goal; None takes the default settings.

    Raises:
        ImitationError: there are none, they are damaged, or most do not end at one place.
    """
    settings = settings or PreparationSettings()
    try:
        samples = samples_of(demonstrations)
    except FormatError as error:
        raise ImitationError(str(error)) from error
    warnings: list[str] = []
    usable: dict[int, Demonstration] = {}
    for number, (demonstration, (times, positions)) in enumerate(zip(demonstrations, samples, strict=True)):
        if arc_length(positions)[-1] > 0:
            usable[number] = Demonstration(times, positions, demonstration.name)
        else:
            warnings.append(f"'{demonstration.name}' never moves; it is left out")
    if not usable:
        raise ImitationError("no demonstration moves; at least one must lead to the goal")
    spread = _spread(list(usable.values()))
    usable, goal = _with_common_goal(usable, spread, settings, warnings)

    kept: dict[int, Demonstration] = {}
    for number, demonstration in usable.items():
        t, path = demonstration.times, _end_moved(demonstration.positions, goal)
        away = np.flatnonzero(np.linalg.norm(path - goal, axis=1) > settings.at_goal * spread)
        if len(away) == 0:
            warnings.append(f"'{demonstration.name}' stays at the goal; it is left out")
            continue
        if np.linalg.norm(path[0] - goal) <= settings.at_goal * spread:
            first = away[0]
            warnings.append(
                f"'{demonstration.name}' starts at the goal, where a stable motion ends; "
                f"its first {t[first]:.2g} s are left out"
            )
            t, path = t[first:] - t[first], path[first:]
        if standing := _stands_still(demonstration.name, t, path, spread, settings):
            warnings.append(standing)
        kept[number] = Demonstration(t, path, demonstration.name)
    if not kept:
        raise ImitationError("every demonstration starts at the goal and stays there; there is nothing to learn")
    names, times, positions = zip(*((one.name, one.times, one.positions) for one in kept.values()), strict=True)
    return Motions(tuple(kept), names, times, positions, goal, spread, tuple(warnings))


def _spread(demonstrations: Sequence[Demonstration]) -> float:
    points = np.concatenate([resample_by_arc_length(demonstration.positions, 100) for demonstration in demonstrations])
    return float(np.sqrt(points.var(axis=0).sum()))


def _with_common_goal(
    demonstrations: dict[int, Demonstration], spread: float, settings: PreparationSettings, warnings: list[str]
) -> tuple[dict[int, Demonstration], Array]:
    """Return the demonstrations that end where most of them do, and that goal."""
    found = list(demonstrations.values())
    ends = np.array([demonstration.positions[-1] for demonstration in found])
    near = np.linalg.norm(ends - np.median(ends, axis=0), axis=1) <= settings.max_moved_end * spread
    if 2 * near.sum() <= len(ends):
        farthest = found[int(np.argmax(np.linalg.norm(ends - np.median(ends, axis=0), axis=1)))]
        raise ImitationError(
            f"the demonstrations have no common goal: most end more than "
            f"{settings.max_moved_end * spread:.2g} from where the others do, '{farthest.name}' the farthest"
        )
    goal = ends[near].mean(axis=0)
    for demonstration, end, kept in zip(found, ends, near, strict=True):
        off = float(np.linalg.norm(end - goal))
        if not kept:
            warnings.append(f"'{demonstration.name}' ends {off:.2g} from the others' goal; it is left out")
        elif off > settings.same_goal * spread:
            warnings.append(f"'{demonstration.name}' ends {off:.2g} from the common goal; its end is moved there")
    return {number: d for (number, d), kept in zip(demonstrations.items(), near, strict=True) if kept}, goal


def _end_moved(path: Array, goal: Array) -> Array:
    """Move the end of a path to the goal, and its other points less the farther they are from the end."""
    length = arc_length(path)
    moved = path + (length / length[-1])[:, None] ** 2 * (goal - path[-1])
    moved[-1] = goal
    return moved


def _stands_still(name: str, t: Array, path: Array, spread: float, settings: PreparationSettings) -> str:
    """The warning about a motion that stands still for long; empty where it does not."""
    even = np.linspace(t[0], t[-1], 101)
    steps = np.linalg.norm(np.diff([np.interp(even, t, x) for x in path.T], axis=1), axis=0)
    standing = float((steps[1:-1] < settings.standing_step * spread).mean())
    if standing <= settings.long_stand:
        return ""
    return f"'{name}' stands still for {standing * t[-1]:.2g} s; the learned motion only slows down there"


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
