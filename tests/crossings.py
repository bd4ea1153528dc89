"""Synthetic demonstrations that cross themselves or each other, come back, or wind: what no plain imitation follows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration

NUM_SAMPLES, NUM_DEMONSTRATIONS = 200, 5
JITTER, WOBBLE = 0.01, 0.005
"""Standard deviation of the starts, and amplitude of a slow wave on the way, metres; both fade to the goal."""
DURATION, LONGER = 4.0, 0.3
"""Duration of the first demonstration, and by how much longer each next one takes, seconds."""


@dataclass(frozen=True)
class Crossing:
    """Demonstrations of one case."""

    demonstrations: tuple[Demonstration, ...]
    labels: tuple[float, ...] | None = None
    """A number for each of them, where they begin at one place and differ."""


def _alpha(s: Array) -> Array:
    return 0.15 * np.column_stack([2 * s - 1 + 0.9 * np.sin(2 * np.pi * s), 1 - np.cos(2 * np.pi * s)])


def _eight(s: Array) -> Array:
    return 0.15 * np.column_stack([np.sin(1.94 * np.pi * s + 0.09), np.sin(3.88 * np.pi * s + 0.18) / 1.5])


def _wide_eight(s: Array) -> Array:
    return 0.15 * np.column_stack([np.cos(1.9 * np.pi * s), np.sin(3.8 * np.pi * s)])


def _double_loop(s: Array) -> Array:
    return 0.12 * np.column_stack([3 * s - 1.5 + 0.9 * np.sin(4 * np.pi * s), 1 - np.cos(4 * np.pi * s)])


def _reach_and_retreat(s: Array) -> Array:
    return 0.2 * np.column_stack([np.sin(0.98 * np.pi * s), 0.02 * s])


def _spiral(turns: float) -> Callable[[Array], Array]:
    def spiral(s: Array) -> Array:
        angle = 2 * np.pi * turns * s
        return (0.15 * (1 - s) + 0.01)[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])

    return spiral


def _helix(turns: float) -> Callable[[Array], Array]:
    def helix(s: Array) -> Array:
        angle = 2 * np.pi * turns * s
        return np.column_stack([0.08 * np.cos(angle), 0.08 * np.sin(angle), 0.25 * s])

    return helix


def _trefoil(s: Array) -> Array:
    angle = 1.9 * np.pi * s
    x, y = np.sin(angle) + 2 * np.sin(2 * angle), np.cos(angle) - 2 * np.cos(2 * angle)
    return 0.05 * np.column_stack([x, y, -np.sin(3 * angle)])


SHAPES: Mapping[str, Callable[[Array], Array]] = {
    "loop": _alpha,
    "eight": _eight,
    "wide eight": _wide_eight,
    "double loop": _double_loop,
    "reach and retreat": _reach_and_retreat,
    "spiral, 1.5 turns": _spiral(1.5),
    "spiral, 2.5 turns": _spiral(2.5),
    "helix, 2 turns": _helix(2),
    "helix, 4 turns": _helix(4),
    "trefoil": _trefoil,
}
"""Curves (N, d), metres, over the fraction (N,) of the way, by name."""


def crossings(seed: int = 0) -> dict[str, Crossing]:
    """Return all cases by name."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, NUM_SAMPLES)
    found = {name: Crossing(tuple(_varied(shape(s), rng))) for name, shape in SHAPES.items()}
    bent = np.cos(1.5 * np.pi * s) * (1 - s**3)
    apart = (-1.0, 1.0, -0.6, 0.6)
    found["crossing at equal phase"] = Crossing(
        tuple(_timed(np.column_stack([0.3 * s, 0.1 * k * bent]), DURATION, f"{k:g}") for k in apart), apart
    )
    sides = (1.0, -1.0)
    found["left and right from one start"] = Crossing(
        tuple(_timed(np.column_stack([0.3 * s, 0.1 * k * np.sin(np.pi * s)]), DURATION, f"{k:g}") for k in sides), sides
    )
    return found


def _varied(path: Array, rng: np.random.Generator) -> list[Demonstration]:
    """Return demonstrations of a path (N, d), each a little different."""
    left = np.linspace(1, 0, len(path))[:, None]
    varied = []
    for k in range(NUM_DEMONSTRATIONS):
        phase, rate = rng.uniform(0, 2 * np.pi), rng.uniform(0.5, 1.5)
        wave = WOBBLE * np.sin(2 * np.pi * rate * (1 - left) + phase)
        beside = JITTER * rng.normal(size=path.shape[1])
        varied.append(_timed(path + (beside + wave) * left, DURATION + LONGER * k, f"{k + 1}"))
    return varied


def _timed(path: Array, duration: float, name: str) -> Demonstration:
    """Return a demonstration that starts and stops gently."""
    s = np.linspace(0, 1, len(path))
    eased = 10 * s**3 - 15 * s**4 + 6 * s**5
    moved = np.column_stack([np.interp(eased, s, column) for column in path.T])
    return Demonstration(duration * s, moved, name)
