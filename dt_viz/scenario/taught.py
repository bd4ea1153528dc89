"""Takes that a visitor has taught in the page, as tasks and saved scenarios hold them."""

from __future__ import annotations

from dataclasses import dataclass

from dt_viz.files.takes import Take
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.scenario.slices import Slice

MAX_TAKES = 50
"""Largest number of takes that are taught for one task."""


@dataclass(frozen=True, eq=False)
class Taught:
    """A take that was taught. Compared by identity."""

    kept: Demonstration
    """What is kept of it: of a board in its coordinates, of the hand in space."""
    drawn: Array
    """(N, 3) places of the pointer, metres."""
    board: Slice | None = None
    """Board that it was drawn on; None was guided in space."""

    @property
    def name(self) -> str:
        """Name of the take."""
        return self.kept.name

    @property
    def take(self) -> Take:
        """The same as a take of a file."""
        units = {"length": 1.0, "time": 1.0, "angle": 1.0}
        return Take(self.name, self.kept.times, self.kept.positions, None, None, (), units)


@dataclass(frozen=True)
class Lesson:
    """Takes that were taught, and which of them are left out."""

    takes: tuple[Taught, ...] = ()
    left_out: tuple[int, ...] = ()
    """Numbers, in order, of those that are left out by choice, among all that can be used."""

    def without(self, number: int, name: str) -> Lesson:
        """Return the rest without the take of a number among all, and of a name, if that was taught."""
        takes = tuple(each for each in self.takes if each.name != name)
        if len(takes) == len(self.takes):
            return self
        return Lesson(takes, tuple(k - (k > number) for k in self.left_out if k != number))
