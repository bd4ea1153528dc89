"""Reproduction of motions that were not learned from, compared with two ways that need no learning.

The demonstrations of a shape are divided into folds; those of a fold are held out, and followed from their start by

``learned``
    the motion fitted to the others;
``mean``
    the mean of the others by arc length, shifted to that start by an offset that fades linearly to the end, in their
    mean time and with their mean progress along the way;
``nearest``
    the other demonstration with the nearest start, shifted likewise, in its own time.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length, rms_at_equal_times

WAYS = ("learned", "mean", "nearest")
AT_GOAL = 5e-5
"""Distance from the goal at which a rollout ends, metres."""
NUM_SAMPLES = 1000
"""Number of samples of a rollout, evenly in time."""
Learned = Imitation | AugmentedImitation
Learn = Callable[[Sequence[Demonstration]], Learned]
NUM_COMPARED = 400
"""Number of points, evenly by arc length, between which a Fréchet distance is computed."""


@dataclass(frozen=True)
class HeldOut:
    """Row of the table: means over the held-out demonstrations of a shape."""

    name: str
    folds: int
    learned_mm: float
    """Discrete Fréchet distance of what was learned."""
    mean_mm: float
    nearest_mm: float
    learned_rms_mm: float
    """Root mean square distance at equal times of what was learned."""
    mean_rms_mm: float
    nearest_rms_mm: float


def follow(demonstrations: Sequence[Demonstration], learn: Learn, folds: int) -> list[dict[str, Array]]:
    """Follow each demonstration in each of `WAYS` without having learned from it.

    Args:
        demonstrations: two or more, of one shape.
        learn: learns from some of them.
        folds: number of folds, at most that of demonstrations.

    Returns:
        For each demonstration ``WAY`` (T, d), metres, and ``WAY_times`` (T,), seconds, of each way.

    Raises:
        ImitationError: nothing can be learned from the others.
    """
    followed: list[dict[str, Array]] = [{}] * len(demonstrations)
    for held in folds_of(len(demonstrations), folds):
        others = [d for i, d in enumerate(demonstrations) if i not in held]
        imitation = learn(others)
        paths = np.stack([resample_by_arc_length(d.positions, NUM_COMPARED) for d in others])
        progress, durations = np.stack([_progress(d) for d in others]), [d.times[-1] - d.times[0] for d in others]
        for i in held:
            start = demonstrations[i].positions[0]
            nearest = int(np.linalg.norm(paths[:, 0] - start, axis=1).argmin())
            (rollout,), (times,) = rollouts_from(imitation, start[None])
            mean = paths.mean(axis=0), progress.mean(axis=0), float(np.mean(durations))
            ways = (
                (rollout, times),
                _shifted(start, *mean),
                _shifted(start, paths[nearest], progress[nearest], durations[nearest]),
            )
            followed[i] = {way: path for way, (path, _) in zip(WAYS, ways, strict=True)}
            followed[i] |= {f"{way}_times": t for way, (_, t) in zip(WAYS, ways, strict=True)}
    return followed


def folds_of(num: int, folds: int) -> list[range]:
    """Numbers of the demonstrations, of `num`, that each fold holds out."""
    return [range(fold, num, folds) for fold in range(folds)]


def _progress(demonstration: Demonstration) -> Array:
    """The part of the length that lies behind at `NUM_COMPARED` even times."""
    times, length = demonstration.times, arc_length(demonstration.positions)
    return np.interp(np.linspace(times[0], times[-1], NUM_COMPARED), times, length / length[-1])


def _shifted(start: Array, path: Array, progress: Array, duration: float) -> tuple[Array, Array]:
    """A path (T, d), even in its length, shifted to `start` (d,), and its times (T,), seconds.

    Args:
        start: metres.
        path: metres.
        progress: (T,) part of the length that lies behind at even times.
        duration: seconds.
    """
    even = np.linspace(0, 1, len(path))
    return shifted_to(start, path), duration * np.interp(even, progress, even)


def begun(imitation: Learned, start: Array) -> tuple[DiffeomorphicSystem, Array]:
    """The system of a motion from a start (d,), metres, and the state in which it begins there."""
    return imitation.system, imitation.system.base.states(start)


def path_from(system: DiffeomorphicSystem, state: Array, dim: int, num: int = NUM_COMPARED) -> Array:
    """Places (num, dim), metres, of the motion from a state to the goal, evenly in base space."""
    z = system.base.at_fraction(system.transform.forward(state), np.linspace(1, 0, num))
    return system.transform.inverse(z)[:, :dim]


def rollouts_from(imitation: Learned, starts: Array) -> tuple[Array, Array]:
    """Return learned motions (R, T, d) from `starts` (R, d), metres, up to the goal, and their times (R, T), s."""
    rollouts, all_times = [], []
    for start in starts:
        system, state = begun(imitation, start)
        (end,) = arrival_times(system, system.transform.forward(state)[None])
        times = end * np.linspace(0.0, 1.0, NUM_SAMPLES)
        rollouts.append(system.rollout(state, times)[:, : len(start)])
        all_times.append(times)
    return np.stack(rollouts), np.stack(all_times)


def arrival_times(system: DiffeomorphicSystem, z0: Array) -> Array:
    """Return the times (R,), s, at which motions from `z0` (R, d) in base space are within `AT_GOAL` of the goal."""
    # near the goal ψ⁻¹ stretches by at most the norm of its Jacobian there
    ends = system.base.at_fraction(z0, np.zeros(1))[:, 0]
    stretch = np.linalg.norm(system.transform.inverse_jacobian(ends)[1], 2, axis=(1, 2)).max()
    return system.base.arrival_time(z0, float(AT_GOAL / max(stretch, 1.0)))


def shifted_to(start: Array, path: Array) -> Array:
    """Shift a path (T, d) to begin at `start` (d,), by an offset that fades linearly to none at its end."""
    return path + np.linspace(1, 0, len(path))[:, None] * (start - path[0])


def frechet(paths: Sequence[Array], references: Sequence[Array]) -> Array:
    """Compute discrete Fréchet distances (R,) of paths to references, both at `NUM_COMPARED` points by arc length."""
    a, b = (np.stack([resample_by_arc_length(path, NUM_COMPARED) for path in these]) for these in (paths, references))
    return discrete_frechet(a, b)


def summed_up(
    name: str,
    folds: int,
    arrays: Mapping[str, Array],
    references: Sequence[Array],
    times: Sequence[Array],
    millimetres: float,
) -> HeldOut:
    """Compare arrays ``WAY_i`` (T, d), in a unit of so many millimetres, with references in that unit and their times.

    Args:
        name: of the shape.
        folds: number of folds.
        arrays: ``WAY_i`` and ``WAY_times_i`` (T,), seconds.
        references: (T_i, d) demonstrations.
        times: (T_i,) their times, seconds.
        millimetres: the unit.
    """
    numbers = range(len(references))
    distances = [frechet([arrays[f"{way}_{i}"] for i in numbers], references).mean() for way in WAYS]
    apart = [
        np.mean(
            [
                rms_at_equal_times(
                    arrays[f"{way}_times_{i}"], arrays[f"{way}_{i}"], times[i] - times[i][0], references[i]
                )
                for i in numbers
            ]
        )
        for way in WAYS
    ]
    return HeldOut(name, folds, *(millimetres * float(value) for value in (*distances, *apart)))
