"""Reproduction of demonstrations that were not learned from, beside two ways that need no learning.

Those of a fold are held out, and followed from their starts in each of `WAYS`:

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
from dt_viz.flows.rotations import apart, logarithm
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.interface import AnyImitation
from dt_viz.metrics import arc_length, discrete_frechet, resample_by_arc_length, rms_at_equal_times

WAYS = ("learned", "mean", "nearest")
AT_GOAL = 5e-5  # m from the goal at which a rollout ends
NUM_COMPARED = 400  # points, evenly by arc length, between which a Fréchet distance is computed
Learn = Callable[[Sequence[Demonstration]], AnyImitation]


@dataclass(frozen=True)
class Followed:
    """A demonstration, and the motions that follow it."""

    number: int  # of the demonstration
    demonstration: Demonstration
    state: str  # in which the motion that follows it was learned
    motions: Mapping[str, tuple[Array, Array]]  # path (T, d), metres, and times (T,), seconds, of each of `WAYS`
    degrees: Mapping[str, Array]  # of "learned" and "mean", see `degrees_off`; empty without orientations

    def frechet(self, way: str) -> float:
        """Return the discrete Fréchet distance from the demonstration, metres."""
        return float(frechet([self.motions[way][0]], [self.demonstration.positions])[0])

    def rms(self, way: str) -> float:
        """Return the root mean square distance at equal times, metres."""
        path, times = self.motions[way]
        return rms_at_equal_times(times, path, self.demonstration.times, self.demonstration.positions)


def folds_of(num: int, folds: int) -> list[range]:
    """Return the numbers of the demonstrations, of `num`, that each fold holds out."""
    return [range(fold, num, folds) for fold in range(folds)]


def follow(demonstrations: Sequence[Demonstration], learn: Learn, held: range) -> list[Followed]:
    """Follow demonstrations in each of `WAYS`: those held out, by what the others teach; or else all, by all.

    Raises ImitationError where these teach nothing.
    """
    others = [demonstration for i, demonstration in enumerate(demonstrations) if i not in held]
    imitation, even = learn(others), np.linspace(0, 1, NUM_COMPARED)
    paths = np.stack([resample_by_arc_length(d.positions, NUM_COMPARED) for d in others])
    durations = np.array([d.times[-1] for d in others])
    progress = np.stack([_progress(d) for d in others])  # part of the way that lies behind at even times
    followed = []
    for i in held or range(len(demonstrations)):
        start = demonstrations[i].positions[0]
        nearest = int(np.linalg.norm(paths[:, 0] - start, axis=1).argmin())
        motions = {"learned": rollout_from(imitation, start)}
        for way, of in {"mean": slice(None), "nearest": slice(nearest, nearest + 1)}.items():
            moments = np.interp(even, progress[of].mean(axis=0), even)
            motions[way] = shifted_to(start, paths[of].mean(axis=0)), durations[of].mean() * moments
        degrees = degrees_off(imitation, others, demonstrations[i])
        followed.append(Followed(i, demonstrations[i], imitation.state, motions, degrees))
    return followed


def _progress(demonstration: Demonstration) -> Array:
    times, length = demonstration.times, arc_length(demonstration.positions)
    return np.interp(np.linspace(0, times[-1], NUM_COMPARED), times, length / length[-1])


def degrees_off(
    imitation: AnyImitation, others: Sequence[Demonstration], demonstration: Demonstration
) -> dict[str, Array]:
    """Angles (`NUM_COMPARED`,), degrees, from the hand's orientation in a demonstration, at equal parts of the way.

    The way is that of the hand's pose, in which a turn counts a length (`AugmentedSettings.turn_length`). "learned" is
    the orientation predicted for the demonstration's start, "mean" the mean of the others there. Empty without
    orientations.
    """
    poses = imitation.poses if isinstance(imitation, AugmentedImitation) else None
    if poses is None or demonstration.orientations is None:
        return {}
    phase = imitation.system.base.left(state := imitation.system.base.states(demonstration.positions[0]))
    rest = np.tile(state[3:], (NUM_COMPARED, 1))
    rest[:, 0] = phase * np.linspace(1, 0, NUM_COMPARED)
    wanted = poses.orientations(_turns(poses, demonstration))
    mean = poses.orientations(np.mean([_turns(poses, other) for other in others], axis=0))
    found = {"learned": poses.predicted(rest), "mean": mean}
    return {way: np.rad2deg(apart(orientations, wanted)) for way, orientations in found.items()}


def _turns(poses: AugmentedImitation, demonstration: Demonstration) -> Array:
    """Rotation vectors (`NUM_COMPARED`, 3) of a demonstration, times a radius, evenly along the way of its pose."""
    assert demonstration.orientations is not None and poses.goal_orientation is not None
    vectors = poses.radius * logarithm(poses.goal_orientation, demonstration.orientations)
    return resample_by_arc_length(np.hstack([demonstration.positions, vectors]), NUM_COMPARED)[:, 3:]


def rollout_from(imitation: AnyImitation, start: Array) -> tuple[Array, Array]:
    """Return the learned motion (T, d) from a start (d,), metres, up to the goal, and its times (T,), s."""
    system, state = imitation.system, imitation.system.base.states(start)
    (end,) = arrival_times(system, system.transform.forward(state)[None])
    times = end * np.linspace(0.0, 1.0, 1000)
    return system.rollout(state, times)[:, : len(start)], times


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
