"""Tasks of a visitor's own, as saved scenarios hold them: by the demonstrations and what was chosen about them."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from dt_viz.errors import FormatError, check_between
from dt_viz.files.checks import check_at_most
from dt_viz.files.texts import encoded
from dt_viz.files.values import packed
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import MAX_COORDINATE, Demonstration, check_demonstrations
from dt_viz.learning.imitation import Imitation
from dt_viz.learning.inspection import PreparationSettings
from dt_viz.learning.interface import State
from dt_viz.scenario.scenario import MAX_DISTANCE
from dt_viz.scenario.tasks import Move, Task, own_task
from dt_viz.scenario.taught import Lesson

MAX_MOVES = 20  # largest number of times that a task is placed
MAX_SEEN = 1000  # largest number of findings, and of their characters
MAX_GAUSSIANS = 2 * 10**7
"""Largest number of Gaussians of what was learned, once for each step and demonstration: a picture takes seconds."""
SCALES = (1e-3, 1e3)  # smallest and largest scale of a placement


@dataclass(frozen=True, eq=False)
class Own:
    """What a task is made from that does not ship with DT-Viz."""

    demonstrations: tuple[Demonstration, ...]
    preparation: PreparationSettings = field(default_factory=PreparationSettings)
    """Settings of the preparation: the defaults, but for its switches and the goal."""
    seen: tuple[str, ...] = ()
    """What was found about the demonstrations and shown before they were learned."""
    moves: tuple[Move, ...] = ()  # how it was placed in an arm's reach
    state: State = "auto"  # state that it is learned in where none is asked for
    learned: Mapping[str, Array] | None = None
    """What was learned from the demonstrations elsewhere, in the plain state; see `Imitation.to_arrays`."""
    lesson: Lesson | None = None  # what was taught for it in the page; None if that was nothing

    @classmethod
    def of(cls, task: Task) -> Own:
        """Return what a task is made from, whose demonstrations somebody has brought."""
        learned = task.imitation.to_arrays() if isinstance(task.imitation, Imitation) else None
        numbers = learned and {name: array for name, array in learned.items() if array.dtype.kind != "U"}
        return cls(task.demonstrations, task.preparation, task.seen, task.moves, task.state, numbers, task.lesson)

    @property
    def task(self) -> Task:
        """The task, without a name."""
        imitation = None if self.learned is None else Imitation.from_arrays(self.learned)
        own = {"preparation": self.preparation, "seen": self.seen, "state": self.state, "imitation": imitation}
        task = replace(own_task(self.demonstrations), name="", lesson=self.lesson, **own)
        for scale, shift in self.moves:
            task = task.placed(scale, shift)
        return task

    @property
    def digest(self) -> str:
        """Digest of all fields: tasks that are made from the same have the same."""
        arrays = dict[str, np.ndarray]()
        digest = hashlib.sha256(encoded({"own": packed(self, "own", arrays)}, {}))
        for array in arrays.values():
            digest.update(repr(array.shape).encode())
            digest.update(array.tobytes())
        return digest.hexdigest()

    def checked(self, source: str) -> Own:
        """Return the same with demonstrations that can be learned from.

        Raises:
            DemonstrationError: there are none; see `check_demonstrations`.
            FormatError: no page makes such a task.
        """
        usable = check_demonstrations(self.demonstrations, source)
        switches = {name: True for name, value in vars(PreparationSettings()).items() if isinstance(value, bool)}
        goal = self.preparation.goal
        if replace(self.preparation, **switches, goal=None) != PreparationSettings():
            raise FormatError("preparation", "other settings", "the defaults, but for switches and the goal")
        if goal is not None:
            check_between("number of coordinates of the goal", len(goal), *[usable[0].dimension] * 2)
            check_between("goal", float(np.abs(goal).max()), 0.0, MAX_COORDINATE)
        check_at_most("seen", max([len(self.seen), *map(len, self.seen)]), MAX_SEEN)
        check_at_most("moves", len(self.moves), MAX_MOVES)
        for scale, shift in self.moves:
            check_between("scale of a move", scale, *SCALES)
            check_between("shift of a move", float(np.abs(shift).max()), 0.0, MAX_DISTANCE)
        lesson = None if self.lesson is None else self.lesson.checked(source)
        own = replace(self, demonstrations=tuple(map(_as_given, self.demonstrations, usable)), lesson=lesson)
        if (imitation := own.task.imitation) is not None:
            check_between("dimension of what was learned", len(imitation.goal), *[usable[0].dimension] * 2)
            num = imitation.num_gaussians * len(usable) if isinstance(imitation, Imitation) else 0
            check_at_most("Gaussians of what was learned, in all steps of all demonstrations", num, MAX_GAUSSIANS)
        check_between("farthest place", max(float(np.abs(path).max()) for path in own.task.paths), 0.0, MAX_COORDINATE)
        return own


def _as_given(given: Demonstration, usable: Demonstration) -> Demonstration:
    """The usable demonstration, its unit quaternions as they were given: dividing them again may change a last bit."""
    if (
        given.orientations is None
        or usable.orientations is None
        or np.abs(given.orientations - usable.orientations).max() > 1e-12
    ):
        return usable
    return replace(usable, orientations=given.orientations)
