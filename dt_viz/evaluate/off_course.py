"""What a learned motion does off its demonstrations: from starts far from theirs, and after a push on the way."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.evaluate.held_out import Learned, begun, frechet, path_from, shifted_to
from dt_viz.flows.fields import Array
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.metrics import resample_by_arc_length

AWAY = (0.25, 0.5)
"""Distances of starts from the mean one, relative to the extent of the demonstrations."""
NUM_AWAY, NUM_COMPARED = 12, 200
"""Number of starts at each distance, and number of points of the mean demonstration."""
NUM_TIMES, LONGEST = 1500, 3.0
"""Number of times at which speeds are looked at, and the last of them, in durations of the demonstrations."""
PUSH, PUSHED_AT, NUM_PUSHED, NUM_DIRECTIONS = 0.2, (0.65, 0.5, 0.35), 3, 8
"""Length of a push relative to the extent, parts of the way that are left then, number of motions that are pushed,
and number of directions."""
DRAWN = 0.05
"""Distance up to which a place of the rest of a motion counts as drawn, relative to the extent."""


@dataclass(frozen=True)
class OffCourse:
    """Figures of one shape."""

    name: str
    shape_error: tuple[float, ...]
    """Mean discrete Fréchet distance to the shifted mean demonstration, relative to the extent, for each of `AWAY`."""
    speed: tuple[float, ...]
    """Largest speed, relative to the fastest demonstrated."""
    drawn: float
    """Mean share of the rest of a motion that is still drawn after a push."""


def off_course(name: str, demonstrations: Sequence[Demonstration], imitation: Learned) -> OffCourse:
    """Measure a motion off its demonstrations."""
    paths = [d.positions for d in demonstrations]
    extent = float(np.ptp(np.concatenate(paths), axis=0).max())
    mean = np.mean([resample_by_arc_length(path, NUM_COMPARED) for path in paths], axis=0)
    fastest = max(_fastest(d.times, d.positions) for d in demonstrations)
    times = np.linspace(0, LONGEST * float(np.mean([d.times[-1] - d.times[0] for d in demonstrations])), NUM_TIMES)
    errors, speeds = [], []
    across = np.linalg.svd(mean - mean.mean(axis=0))[2][:2]  # in space: in the plane that the mean is nearest to
    for away in AWAY:
        found = []
        for direction in _directions(NUM_AWAY):
            start = mean[0] + away * extent * direction @ across
            system, state = begun(imitation, start)
            (error,) = frechet([path_from(system, state, len(start))], [shifted_to(start, mean)])
            found.append((error / extent, _fastest(times, system.rollout(state, times)[:, : len(start)]) / fastest))
        errors.append(float(np.mean([error for error, _ in found])))
        speeds.append(float(max(speed for _, speed in found)))
    drawn = [_drawn(imitation, d.positions[0], extent, across) for d in demonstrations[:NUM_PUSHED]]
    return OffCourse(name, tuple(errors), tuple(speeds), float(np.mean(drawn)))


def _directions(num: int) -> Array:
    """Unit vectors (num, 2) all around."""
    turn = np.linspace(0, 2 * np.pi, num, endpoint=False)
    return np.column_stack([np.cos(turn), np.sin(turn)])


def _fastest(times: Array, path: Array) -> float:
    return float((np.linalg.norm(np.diff(path, axis=0), axis=1) / np.diff(times)).max())


def _drawn(imitation: Learned, start: Array, extent: float, across: Array) -> float:
    """Share of the rest of a motion that is still drawn after pushes from it, over places and directions."""
    system, state = begun(imitation, start)
    z0, dim, shares = system.transform.forward(state), len(start), []
    for left in PUSHED_AT:
        here = system.transform.inverse(system.base.at_fraction(z0, np.array([left])))[0]
        rest = path_from(system, here, dim)
        for direction in _directions(NUM_DIRECTIONS):
            pushed = here.copy()
            pushed[:dim] += PUSH * extent * direction @ across
            if isinstance(imitation, AugmentedImitation):
                pushed[dim] = imitation.caught(pushed)
            after = path_from(system, pushed, dim)
            near = np.linalg.norm(rest[:, None] - after, axis=2).min(axis=1) < DRAWN * extent
            shares.append(near.mean())
    return float(np.mean(shares))
