"""Reproduction of motions that were not learned from, compared with two ways that need no learning.

The demonstrations of a shape are divided into folds; those of a fold are held out, and followed from their start by

``learned``
    the motion fitted to the others;
``mean``
    the mean of the others by arc length, shifted to that start by an offset that fades linearly to the end;
``nearest``
    the other demonstration with the nearest start, shifted likewise.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import Imitation, ImitationSettings, fit
from dt_viz.metrics import discrete_frechet, resample_by_arc_length

WAYS = ("learned", "mean", "nearest")
AT_GOAL = 5e-5
"""Distance from the goal at which a rollout ends, metres."""
NUM_SAMPLES = 1000
"""Number of samples of a rollout, evenly in time."""
NUM_COMPARED = 400
"""Number of points, evenly by arc length, between which a Fréchet distance is computed."""


@dataclass(frozen=True)
class HeldOut:
    """Row of the table: mean discrete Fréchet distances to the held-out demonstrations of a shape."""

    name: str
    folds: int
    learned_mm: float
    mean_mm: float
    nearest_mm: float


def follow(demonstrations: Sequence[Demonstration], settings: ImitationSettings, folds: int) -> list[dict[str, Array]]:
    """Follow each demonstration in each of `WAYS` without having learned from it.

    Args:
        demonstrations: two or more, of one shape.
        settings: settings of the fits.
        folds: number of folds, at most that of demonstrations.

    Returns:
        For each demonstration the path (T, d), metres, of each way.

    Raises:
        ImitationError: nothing can be learned from the others.
    """
    followed: list[dict[str, Array]] = [{}] * len(demonstrations)
    for fold in range(folds):
        held = range(fold, len(demonstrations), folds)
        others = [d for i, d in enumerate(demonstrations) if i not in held]
        imitation = fit(others, settings)
        paths = np.stack([resample_by_arc_length(d.positions, NUM_COMPARED) for d in others])
        for i in held:
            start = demonstrations[i].positions[0]
            nearest = np.linalg.norm(paths[:, 0] - start, axis=1).argmin()
            (rollout,), _ = rollouts_from(imitation, start[None])
            shifted = (shifted_to(start, path) for path in (paths.mean(axis=0), paths[nearest]))
            followed[i] = dict(zip(WAYS, (rollout, *shifted), strict=True))
    return followed


def rollouts_from(imitation: Imitation, starts: Array) -> tuple[Array, Array]:
    """Return learned motions (R, T, d) from `starts` (R, d), metres, up to the goal, and their times (R, T), s."""
    ends = arrival_times(imitation.system, imitation.transform.forward(starts))
    times = ends[:, None] * np.linspace(0.0, 1.0, NUM_SAMPLES)
    return imitation.system.rollout(starts, times), times


def arrival_times(system: DiffeomorphicSystem, z0: Array) -> Array:
    """Return the times (R,), s, at which motions from `z0` (R, d) in base space are within `AT_GOAL` of the goal."""
    # near the goal ψ⁻¹ stretches by at most the norm of its Jacobian there
    stretch = np.linalg.norm(system.transform.inverse_jacobian(system.base.goal)[1], 2)
    return system.base.arrival_time(z0, float(AT_GOAL / max(stretch, 1.0)))


def shifted_to(start: Array, path: Array) -> Array:
    """Shift a path (T, d) to begin at `start` (d,), by an offset that fades linearly to none at its end."""
    return path + np.linspace(1, 0, len(path))[:, None] * (start - path[0])


def frechet(paths: Sequence[Array], references: Sequence[Array]) -> Array:
    """Compute discrete Fréchet distances (R,) of paths to references, both at `NUM_COMPARED` points by arc length."""
    a, b = (np.stack([resample_by_arc_length(path, NUM_COMPARED) for path in these]) for these in (paths, references))
    return discrete_frechet(a, b)


def summed_up(
    name: str, folds: int, arrays: Mapping[str, Array], references: Sequence[Array], millimetres: float
) -> HeldOut:
    """Compare arrays ``WAY_i`` (T, d), in a unit of so many millimetres, with `references` in that unit."""
    distances = [frechet([arrays[f"{way}_{i}"] for i in range(len(references))], references).mean() for way in WAYS]
    return HeldOut(name, folds, *(millimetres * float(distance) for distance in distances))
