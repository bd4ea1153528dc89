"""Takes as strangers record them: clean ones with noise, tremor, pauses, gaps, outliers, other rates and durations."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.metrics import interpolate

NOISE = 0.003  # standard deviation of each coordinate, metres; amplitude of the tremor
Corrupt = Callable[[Array, Array, np.random.Generator], tuple[Array, Array]]


def sampled(times: Array, path: Array, rate: float) -> tuple[Array, Array]:
    """The same motion at another rate, Hz."""
    at = np.linspace(0.0, times[-1], max(round(times[-1] * rate) + 1, 20))
    return at, interpolate(at, times, path)


def noise(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    return times, path + NOISE * rng.normal(size=path.shape)


def tremor(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    waves = 2 * np.pi * rng.uniform(8, 12, path.shape[1]) * times[:, None] + rng.uniform(0, 6, path.shape[1])
    return times, path + NOISE * np.sin(waves)


def pause(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """A second or more in which nothing moves, on the way or before it begins."""
    at, length = rng.choice([0.0, 0.2, 0.5, 0.7]) * times[-1], rng.uniform(1.0, 2.5)
    even = np.arange(0.0, times[-1] + length, np.median(np.diff(times)))
    moved = np.where(even < at, even, np.maximum(at, even - length))
    return even, interpolate(moved, times, path)


def gap(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    first = rng.uniform(0.1, 0.8) * times[-1]
    keep = (times < first) | (times > first + 0.5)
    return times[keep], path[keep]


def outliers(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    path, rows = path.copy(), rng.choice(len(path), 1 + len(path) // 100, replace=False)
    away = rng.normal(size=(len(rows), path.shape[1]))
    path[rows] += 0.5 * away / np.linalg.norm(away, axis=1, keepdims=True)
    return times, path


def slower(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    return times * np.sqrt(5) ** rng.uniform(-1, 1), path


def elsewhere(times: Array, path: Array, rng: np.random.Generator) -> tuple[Array, Array]:
    """From another start, up to 10 cm off."""
    away = rng.normal(size=path.shape[1])
    fading = np.linspace(1.0, 0.0, len(path))[:, None] ** 2
    return times, path + 0.1 * rng.uniform() * away / np.linalg.norm(away) * fading


CORRUPTIONS: Mapping[str, Corrupt] = {
    "noise": noise,
    "tremor": tremor,
    "pauses": pause,
    "gaps": gap,
    "outliers": outliers,
}
"""What sensors and hands do to a motion, by name."""


def corrupted(
    demonstrations: Sequence[Demonstration], names: Sequence[str], rate: float, seed: int
) -> list[Demonstration]:
    """Takes at a rate, Hz, with these corruptions."""
    rng, found = np.random.default_rng(seed), []
    for own in demonstrations:
        times, path = sampled(own.times, own.positions, rate)
        for name in CORRUPTIONS:  # always in one order: outliers last
            if name in names:
                times, path = CORRUPTIONS[name](times, path, rng)
        found.append(Demonstration(times, path, own.name))
    return found
