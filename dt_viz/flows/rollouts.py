"""Bundles of exact rollouts, sampled along their base rays and refined where the stack stretches them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.systems import Attractor
from dt_viz.metrics import arc_length

ARRIVED = 1e-4  # distance (m) from the goal in base space at which a motion counts as arrived
ARRIVING = 0.5
"""Upper bound of that distance, relative to that of the sample before: a stack may stretch it to a visible length."""
UNEVEN = 1.5
"""Ratio to its narrower neighbour from which on a gap counts as unevenly stretched inside."""
OVERSAMPLING = 2
"""Factor on the number of samples that such a gap lacks; too many cost less than another round."""
MAX_INSERTED = 40
"""Largest number of samples inserted between two neighbours in one round of refinement."""
MAX_SAMPLES = 60_000
"""Number of samples of a bundle at which refinement ends; a stack may stretch a motion without limit."""


@dataclass(frozen=True)
class Rays:
    """The base system's motions, u from 0 at the start to 1 at the goal.

    Those of a plain attractor are straight rays, z = z_e + (1 − u)(z₀ − z_e).
    """

    z0: Array  # (R, d) starts in base space
    base: Attractor

    def at(self, index: Indices, fraction: Array) -> Array:
        """Points (N, d) of the rays `index` (N,) at the fractions `fraction` (N,)."""
        return self.base.at_fraction(self.z0[index], (1 - fraction)[:, None])[:, 0]

    def times(self, index: Indices, fraction: Array) -> Array:
        """Times (N,), seconds, at which the motions are at the points that `at` gives; `index` must not decrease.

        The goal counts as reached at the distance `ARRIVED`, or nearer, so that no two samples share a time.
        """
        radius = self.base.left(self.z0)
        left = (1 - fraction) * radius[index]
        least = np.full(len(radius), ARRIVED)
        np.minimum.at(least, index[left > 0], ARRIVING * left[left > 0])
        # one row for each ray, padded with its start, so that what all its samples share is computed once
        column = np.arange(len(index)) - np.searchsorted(index, index)
        remaining = np.repeat(radius[:, None], int(column.max()) + 1, axis=1)
        remaining[index, column] = np.maximum(left, least[index])
        return self.base.times_at(self.z0, remaining)[index, column]


@dataclass(frozen=True)
class Bundle:
    """Sampled rollouts, one after the other, each from its start to its goal."""

    index: Indices  # (N,) which rollout a sample belongs to, not decreasing
    fraction: Array
    """(N,) fraction of the base ray that lies behind it, increasing within a rollout."""
    levels: Array
    """(N, L, 3) positions on the manifold of each level of the stack, from the imitation up, metres."""

    @property
    def positions(self) -> Array:
        """(N, 3) positions on the top level, where the robot moves, metres."""
        return self.levels[:, -1]

    def split(self, values: Array) -> tuple[Array, ...]:
        """Cut an array (N, …) that belongs to the samples into one array for each rollout."""
        return tuple(np.split(values, np.flatnonzero(np.diff(self.index)) + 1))

    @property
    def paths(self) -> tuple[Array, ...]:
        """Positions of each rollout on the top level, (T_i, 3), metres."""
        return self.split(self.positions)


Evaluate = Callable[[Indices, Array], Array]
"""Levels (N, L, 3) of the samples with ray index (N,) and fraction (N,)."""


def evenly_sampled(evaluate: Evaluate, num_rollouts: int, num_samples: int) -> Bundle:
    """Sample R rollouts at even distances along their paths, ends included; one that rests at even fractions.

    `evaluate` gives the levels of samples; there are `num_samples` of each rollout.
    """
    trial = np.linspace(0, 1, 2 * num_samples)
    index = np.repeat(np.arange(num_rollouts), len(trial))
    paths = evaluate(index, np.tile(trial, num_rollouts))[:, -1].reshape(num_rollouts, len(trial), -1)
    lengths = arc_length(paths)
    even = np.linspace(0, 1, num_samples)
    fraction = np.concatenate(
        [np.interp(even, length / length[-1], trial) if length[-1] > 0 else even for length in lengths]
    )
    index = np.repeat(np.arange(num_rollouts), num_samples)
    return Bundle(index, fraction, evaluate(index, fraction))


def refined(bundle: Bundle, evaluate: Evaluate, spacing: float, *, max_rounds: int = 12) -> Bundle:
    """Insert samples into rollouts until neighbours are at most `spacing` apart, metres.

    Close to an obstacle's centre ψ⁻¹ stretches a path a hundredfold; without refinement a drawn segment cuts through
    the obstacle that the motion avoids. `evaluate` gives the levels of samples. Wider gaps remain after `max_rounds` of
    insertion, and where there are `MAX_SAMPLES`.
    """
    for _ in range(max_rounds):
        same = np.diff(bundle.index) == 0
        gap = np.linalg.norm(np.diff(bundle.positions, axis=0), axis=1) * same
        # a gap between neighbouring floats on either side of an obstacle's centre cannot be divided
        divisible = np.diff(bundle.fraction) > 1e-13
        wide = np.flatnonzero((gap > spacing) & divisible)
        room = MAX_SAMPLES - len(bundle.index)
        if not len(wide) or room <= 0:
            break
        inside = np.r_[np.inf, np.where(same, gap, np.inf), np.inf]
        uneven = gap[wide] > UNEVEN * np.minimum(inside[:-2], inside[2:])[wide]
        lacking = (gap[wide] / spacing - 1) * np.where(uneven, OVERSAMPLING, 1)
        counts = np.minimum(np.ceil(lacking).astype(int), MAX_INSERTED)
        if counts.sum() > room:
            widest = np.argsort(-gap[wide], kind="stable")
            counts[widest] = np.diff(np.minimum(np.cumsum(counts[widest]), room), prepend=0)
        before, last = np.repeat(wide, counts), np.repeat(np.cumsum(counts), counts)
        within = 1 - (last - np.arange(len(last))) / (np.repeat(counts, counts) + 1)
        fraction = bundle.fraction[before] + within * (bundle.fraction[before + 1] - bundle.fraction[before])
        index = bundle.index[before]
        bundle = Bundle(
            np.insert(bundle.index, before + 1, index),
            np.insert(bundle.fraction, before + 1, fraction),
            np.insert(bundle.levels, before + 1, evaluate(index, fraction), axis=0),
        )
    return bundle
