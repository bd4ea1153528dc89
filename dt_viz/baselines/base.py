"""What a method of the comparison is: it is fitted to a task, and then plans motions around obstacles.

A new method is one file with a function `fit`, and a row in `dt_viz.baselines.registry.METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Protocol

from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import Task

INSTALL = 'pip install "dt-viz[baselines]"'
"""Command that installs what some methods need beside DT-Viz itself."""


class NotFittedError(Exception):
    """A method cannot be fitted to a task; the text says why, for the user."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a method is fitted to."""

    learned: Learned
    """The task, and our imitation of it."""
    robot: Robot
    postures: tuple[Array, ...]
    """Of the arm along each demonstration, (T_i, n), rad; the first row is where a motion from that start begins."""

    @property
    def task(self) -> Task:
        """The demonstrations and their place in the world."""
        return self.learned.task


@dataclass(frozen=True, eq=False)
class Plan:
    """Motions around obstacles, one from each start; that of a start without a way has one sample, at the start."""

    paths: tuple[Array, ...]
    """(N_i, 3) places of the end effector, metres."""
    times: tuple[Array, ...]
    """(N_i,) seconds from the start."""
    joints: tuple[Array, ...] | None = None
    """(N_i, n) of the arm, rad, where the method plans them; otherwise the arm tracks the paths."""
    warnings: tuple[str, ...] = ()
    """What the motions fail at, for the user."""


class Planner(Protocol):
    """A method that has been fitted to a task. Any thread may call it."""

    def __call__(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan motions from the starts (R, 3), metres, around obstacles (an empty union: none).

        Methods that plan joints start at the posture of the nearest demonstrated start, moved to the start by inverse
        kinematics. Methods that do not follow a drag ask between parts of their work whether they are cancelled.

        Raises:
            UnreachableError: the arm cannot get to a start.
            UnwantedError: it is cancelled.
        """
        ...


@dataclass(frozen=True, eq=False)
class Method:
    """A way to learn motions from demonstrations, or to plan them."""

    name: str
    """Short name in files and commands."""
    title: str
    promise: str
    """Sentence that says what it guarantees and what it does not."""
    fit: Callable[[Problem], Planner]
    """Fits it to a task, or loads what was fitted to it. Raises NotFittedError where the demonstrations do not allow
    it, or what was fitted is of another task or version."""
    stable: bool = False
    """Whether it is a dynamical system whose motions reach the goal for certain; a path planned once is none."""
    whole_arm: bool = False
    """Whether the whole arm avoids, not the end effector alone."""
    live: bool = False
    """Whether it follows a drag; others plan when the obstacle rests."""
    avoids: bool = True
    """Whether its motions depend on the obstacle."""
    needs: tuple[str, ...] = ()
    """Modules beyond DT-Viz's own that it cannot plan without."""

    @property
    def missing(self) -> tuple[str, ...]:
        """Modules it needs that are not installed; see `INSTALL`."""
        return tuple(module for module in self.needs if find_spec(module) is None)
