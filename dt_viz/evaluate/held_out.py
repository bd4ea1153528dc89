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

from collections.abc import Callable, Iterable, Mapping, Sequence
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
AT_GOAL = 5e-5
"""Distance from the goal at which a rollout ends, metres."""
Learn = Callable[[Sequence[Demonstration]], AnyImitation]
NUM_COMPARED = 400
"""Number of points, evenly by arc length, between which a Fréchet distance is computed."""


@dataclass(frozen=True)
class Followed:
    """A demonstration that was held out, and what it is followed by."""

    demonstration: Demonstration
    state: str
    """State in which the motion that follows it was learned."""
    motions: Mapping[str, tuple[Array, Array]]
    """Path (T, d), metres, and times (T,), seconds, of each of `WAYS`."""
    degrees: Mapping[str, Array]
    """Of "learned" and "mean", see `degrees_off`; empty without orientations."""

    def frechet(self, way: str) -> float:
        """Discrete Fréchet distance from the demonstration, metres."""
        return float(frechet([self.motions[way][0]], [self.demonstration.positions])[0])

    def rms(self, way: str) -> float:
        """Root mean square distance at equal times, metres."""
        (path, times), demonstrated = self.motions[way], self.demonstration
        return rms_at_equal_times(times, path, demonstrated.times - demonstrated.times[0], demonstrated.positions)


def follow(demonstrations: Sequence[Demonstration], learn: Learn, folds: int) -> list[Followed]:
    """Follow each demonstration in each of `WAYS` without having learned from it.

    Args:
        demonstrations: two or more, of one shape.
        learn: learns from some of them.
        folds: number of folds, at most that of demonstrations.

    Raises:
        ImitationError: nothing can be learned from the others.
    """
    parts = [follow_held(demonstrations, learn, held) for held in folds_of(len(demonstrations), folds)]
    return in_order(parts)


def follow_held(demonstrations: Sequence[Demonstration], learn: Learn, held: range) -> dict[int, Followed]:
    """Follow the demonstrations of one fold, by number, in each of `WAYS`; see `follow`."""
    followed: dict[int, Followed] = {}
    others = [d for i, d in enumerate(demonstrations) if i not in held]
    imitation = learn(others)
    paths = np.stack([resample_by_arc_length(d.positions, NUM_COMPARED) for d in others])
    progress, durations = np.stack([_progress(d) for d in others]), [d.times[-1] - d.times[0] for d in others]
    for i in held:
        start = demonstrations[i].positions[0]
        nearest = int(np.linalg.norm(paths[:, 0] - start, axis=1).argmin())
        (rollout,), (times,) = rollouts_from(imitation, start[None])
        motions = {
            "learned": (rollout, times),
            "mean": _shifted(start, paths.mean(axis=0), progress.mean(axis=0), float(np.mean(durations))),
            "nearest": _shifted(start, paths[nearest], progress[nearest], durations[nearest]),
        }
        degrees = degrees_off(imitation, others, demonstrations[i])
        followed[i] = Followed(demonstrations[i], imitation.state, motions, degrees)
    return followed


def in_order(parts: Iterable[Mapping[int, Followed]]) -> list[Followed]:
    """What folds have followed, in the order of the demonstrations."""
    followed = {i: found for part in parts for i, found in part.items()}
    return [followed[i] for i in sorted(followed)]


def degrees_off(
    imitation: AnyImitation, others: Sequence[Demonstration], demonstration: Demonstration
) -> dict[str, Array]:
    """Angles (`NUM_COMPARED`,), degrees, from the hand's orientation in a demonstration, at equal parts of the way.

    The way is that of the hand's pose, in which a turn counts a length (`AugmentedSettings.turn_length`). "learned" is
    what is predicted for the demonstration's start, "mean" the mean of the others there. Empty without orientations.
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


def folds_of(num: int, folds: int) -> list[range]:
    """Numbers of the demonstrations, of `num`, that each fold holds out."""
    return [range(fold, num, folds) for fold in range(folds)]


def _progress(demonstration: Demonstration) -> Array:
    """The part of the length that lies behind at `NUM_COMPARED` even times."""
    times, length = demonstration.times, arc_length(demonstration.positions)
    return np.interp(np.linspace(times[0], times[-1], NUM_COMPARED), times, length / length[-1])


def _shifted(start: Array, path: Array, progress: Array, duration: float) -> tuple[Array, Array]:
    """A path (T, d), even in its length, shifted to `start` (d,), and its times (T,); `progress` is at even times."""
    even = np.linspace(0, 1, len(path))
    return shifted_to(start, path), duration * np.interp(even, progress, even)


def rollouts_from(imitation: AnyImitation, starts: Array) -> tuple[Array, Array]:
    """Return learned motions (R, T, d) from `starts` (R, d), metres, up to the goal, and their times (R, T), s."""
    rollouts, all_times = [], []
    for start in starts:
        system = imitation.system
        state = system.base.states(start)
        (end,) = arrival_times(system, system.transform.forward(state)[None])
        times = end * np.linspace(0.0, 1.0, 1000)
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
