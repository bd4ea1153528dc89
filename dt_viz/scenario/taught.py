"""Takes that a visitor has taught in the page, as tasks and saved scenarios hold them."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.errors import FormatError, check_between
from dt_viz.files.takes import Take
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import MAX_COORDINATE, Demonstration, check_demonstrations
from dt_viz.scenario.scenario import MAX_DISTANCE
from dt_viz.scenario.slices import Slice

MAX_TAKES = 50  # largest number of takes that are taught for one task
MAX_POINTS = 4096  # largest number of points of the pointer in a take
NAME = r"(drawn|guided) [1-9]\d{0,8}"
"""Pattern of the names of takes: how they were taught, and a number."""


@dataclass(frozen=True, eq=False)
class Taught:
    """A take that was taught. Compared by identity."""

    kept: Demonstration  # what is kept of it: of a board in its coordinates, of the hand in space
    drawn: Array  # (N, 3) places of the pointer, metres
    board: Slice | None = None  # board that it was drawn on; None was guided in space

    @property
    def name(self) -> str:
        """Name of the take."""
        return self.kept.name

    @property
    def take(self) -> Take:
        """The same as a take of a file."""
        units = {"length": 1.0, "time": 1.0, "angle": 1.0}
        return Take(self.name, self.kept.times, self.kept.positions, None, None, (), units)

    def checked(self, source: str) -> Taught:
        """Return the same with a demonstration that can be learned from; `source` is for messages.

        Raises:
            DemonstrationError: it cannot be; see `check_demonstrations`.
            FormatError: no page makes such a take.
        """
        if not re.fullmatch(NAME, self.name, re.ASCII):
            raise FormatError("name of a take", repr(self.name)[:40], "how it was taught, and a number: 'drawn 1'")
        (kept,) = check_demonstrations([self.kept], source)
        if kept.dimension != (3 if self.board is None else 2) or kept.orientations is not None:
            raise FormatError(self.name, repr(kept), "places in space, or on a board, without orientations")
        if self.drawn.ndim != 2 or self.drawn.shape[1] != 3 or not 1 <= len(self.drawn) <= MAX_POINTS:
            accepted = f"1 to {MAX_POINTS} places in space"
            raise FormatError(f"drawn of {self.name}", f"an array of {self.drawn.shape}", accepted)
        check_between(f"drawn of {self.name}", float(np.abs(self.drawn).max()), 0.0, MAX_COORDINATE)
        if self.board is not None:
            _check_board(self.board)
        return replace(self, kept=kept)


def _check_board(board: Slice) -> None:
    """Raise FormatError unless a board is a rectangle of a sensible size before an arm."""
    if board.centre.shape != (3,) or board.axes.shape != (3, 2):
        found = f"a centre of {board.centre.shape} and axes of {board.axes.shape}"
        raise FormatError("board", found, "a centre of (3,) and axes of (3, 2)")
    check_between("centre of the board", float(np.abs(board.centre).max()), 0.0, MAX_DISTANCE)
    check_between("axes of the board", float(np.abs(board.axes.T @ board.axes - np.eye(2)).max()), 0.0, 1e-6)
    for length in board.half_size:
        check_between("half_size of the board", length, 1e-3, MAX_DISTANCE)


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

    def checked(self, source: str) -> Lesson:
        """Return the same with takes that can be learned from; it raises what `Taught.checked` raises."""
        check_between("number of takes", len(self.takes), 1, MAX_TAKES)
        takes = tuple(take.checked(source) for take in self.takes)
        if len({take.name for take in takes}) < len(takes):
            raise FormatError("names of takes", "one twice", "one for each")
        if [*self.left_out] != sorted({*self.left_out} & {*range(len(takes))}):
            raise FormatError("left_out", repr(self.left_out)[:40], "numbers of takes, in order")
        return replace(self, takes=takes)
