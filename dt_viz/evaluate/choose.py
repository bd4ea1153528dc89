"""Constants of the augmented state, chosen on half of the shapes and measured on the other half, both ways round.

Each setting is judged by what is held out: that of the kernel over the starts by the discrete Fréchet distance, that of
the clock by the distance at equal times. The power of the base system is not among them: it does not change a motion
that begins where it was predicted from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import product

import numpy as np

from dt_viz.evaluate.held_out import HeldOut
from dt_viz.flows.fields import Array
from dt_viz.learning import augmented

Setting = tuple[tuple[str, float], ...]
"""Values of constants of `dt_viz.learning.augmented`, by name."""


@dataclass(frozen=True)
class Grid:
    """Values of constants among which one combination is chosen."""

    values: Mapping[str, Sequence[float]]
    """Values of each constant, by its name."""
    figure: str
    """Figure of `HeldOut` that judges them, mm."""

    @property
    def settings(self) -> list[Setting]:
        """All combinations, that of the shipped constants first."""
        found = [tuple(zip(self.values, values, strict=True)) for values in product(*self.values.values())]
        return sorted(found, key=lambda setting: setting != self.shipped)

    @property
    def shipped(self) -> Setting:
        """The constants as they are."""
        return tuple((name, float(getattr(augmented, name))) for name in self.values)


GRIDS = (
    Grid({"WIDTH": (1.0, 2.0, 4.0), "NOISE": (0.2, 0.6, 1.2)}, "learned_mm"),
    Grid({"TIME_NOISE": (0.3, 1.0, 3.0)}, "learned_rms_mm"),
)


@dataclass(frozen=True)
class Choice:
    """Constants that were chosen on some shapes, and what they do on the others."""

    figure: str
    """Figure of `HeldOut`."""
    chosen_on: tuple[str, ...]
    """Names of the shapes."""
    chosen: Setting
    others_mm: float
    """Mean of the figure over the other shapes, with what was chosen."""
    shipped_mm: float
    """The same, with the constants as they are."""
    best_mm: float
    """The same, with the setting of the grid that is best on these other shapes."""


def measure(grid: Grid, measured: Callable[[], Sequence[HeldOut]]) -> dict[Setting, Array]:
    """Measure the figure of every shape, (S,), mm, for every setting of a grid."""
    found = {}
    for setting in grid.settings:
        with _constants(setting):
            found[setting] = np.array([getattr(row, grid.figure) for row in measured()])
    return found


def choose(grid: Grid, measured: Mapping[Setting, Array], names: list[str], seed: int) -> list[Choice]:
    """Choose a setting on each half of the shapes, and compare it with the shipped one on the other half.

    Args:
        grid: settings.
        measured: figure of every shape (S,), mm, by setting.
        names: of the shapes.
        seed: of the random halves.
    """
    order = np.random.default_rng(seed).permutation(len(names))
    halves = np.sort(order[: len(names) // 2]), np.sort(order[len(names) // 2 :])
    choices = []
    for seen, unseen in (halves, halves[::-1]):
        chosen = min(measured, key=lambda setting: float(measured[setting][seen].mean()))
        others = {setting: float(values[unseen].mean()) for setting, values in measured.items()}
        on = tuple(str(names[i]) for i in seen)
        figures = others[chosen], others[grid.shipped], min(others.values())
        choices.append(Choice(grid.figure, on, chosen, *figures))
    return choices


@contextmanager
def _constants(setting: Setting) -> Iterator[None]:
    """Replace constants of `dt_viz.learning.augmented` meanwhile."""
    before = {name: getattr(augmented, name) for name, _ in setting}
    for name, value in setting:
        setattr(augmented, name, value)
    try:
        yield
    finally:
        for name, value in before.items():
            setattr(augmented, name, value)
