"""What a method of the comparison is: it is fitted to a task, and then plans motions around obstacles.

A new method is one file with a function `fit`, and a row in `dt_viz.baselines.registry.METHODS`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import numpy as np

from dt_viz.errors import Cancelled, DataError, FormatError, never, parsing
from dt_viz.files.npz import arrays_of
from dt_viz.flows.fields import Array
from dt_viz.learning.store import fingerprint
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import TASKS, Task
from dt_viz.shipped import ASSETS

INSTALL = 'pip install "dt-viz[baselines]"'  # command that installs what some methods need beside DT-Viz itself
FOLDER = ASSETS / "baselines"  # folder of the weights that ship with DT-Viz
MADE_BY = "python -m assets.train_baselines"  # command that makes the weights, in a checkout
ONLY_SHIPPED = "only for the shipped tasks"
"""Reason why a method without weights for a task, such as one of the user's own, cannot be chosen."""
MAX_BYTES = 10**8  # largest number of bytes that a file of weights unpacks to


class NotFittedError(Exception):
    """A method cannot be fitted to a task; the text says why, for the user."""


@dataclass(frozen=True, eq=False)
class Problem:
    """What a method is fitted to."""

    learned: Learned  # the task, and our imitation of it
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

    paths: tuple[Array, ...]  # (N_i, 3) places of the end effector, metres
    times: tuple[Array, ...]  # (N_i,) seconds from the start
    joints: tuple[Array, ...] | None = None
    """(N_i, n) of the arm, rad, where the method plans them; otherwise the arm tracks the paths."""
    warnings: tuple[str, ...] = ()  # what the motions fail at, for the user


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

    name: str  # short name in files and commands
    title: str
    promise: str  # sentence that says what it guarantees and what it does not
    fit: Callable[[Problem], Planner]
    """Fits it to a task, or loads what was fitted to it. Raises NotFittedError where the demonstrations do not allow
    it, or what was fitted is of another task or version."""
    stable: bool = False
    """Whether it is a dynamical system whose motions reach the goal for certain; a path planned once is none."""
    whole_arm: bool = False  # whether the whole arm avoids, not the end effector alone
    live: bool = False  # whether it follows a drag; others plan when the obstacle rests
    avoids: bool = True  # whether its motions depend on the obstacle
    weights: str = ""
    """Name of the weights that it loads, which are made in advance for each task; empty if it has none."""
    needs: tuple[str, ...] = ()  # modules beyond DT-Viz's own that it cannot plan without

    def is_offered(self, task: str) -> bool:
        """Return whether it can be shown for the task of a name: whether its weights, if any, are made for that."""
        return not self.weights or weights_file(FOLDER, self.weights, task).is_file()

    @property
    def missing(self) -> tuple[str, ...]:
        """Modules it needs that are not installed; see `INSTALL`."""
        return tuple(module for module in self.needs if find_spec(module) is None)


def load_weights(method: str, version: int, task: Task, folder: Path = FOLDER) -> dict[str, Array]:
    """Read the weights of a method for a task, floats in double precision.

    Raises:
        NotFittedError: there are none, the file is damaged, or it is of another method, version or task.
    """
    path = weights_file(folder, method, task.name)
    if not path.is_file():
        remedy = f"{MADE_BY} --method {method} --task {task.name}" if task.name in TASKS else ONLY_SHIPPED
        raise NotFittedError(f"{method} has not been trained for {task.title!r}; {remedy}")
    try:
        with parsing(DataError, path, "file", f"weights as {MADE_BY!r} writes them"):
            arrays = arrays_of(path, max_bytes=MAX_BYTES)
            for field, wanted in stamp(method, version, task).items():
                found = arrays.pop(field).item()
                if found != wanted:
                    raise FormatError(field[1:], repr(found)[:80], repr(wanted))
            for name, array in arrays.items():
                if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
                    raise FormatError(f"array {name!r}", "text, or numbers that are not finite", "finite numbers")
    except DataError as error:
        raise NotFittedError(str(error)) from error
    return {name: array.astype(float) if array.dtype.kind == "f" else array for name, array in arrays.items()}


def weights_file(folder: Path, method: str, task: str) -> Path:
    """The file of a method's weights for the task of a name."""
    return folder / f"{method}_{task}.npz"


def stamp(method: str, version: int, task: Task) -> dict[str, str | int]:
    """Return what a file says about itself: method, version, and a digest of the task's demonstrations."""
    return {"_method": method, "_version": version, "_demonstrations": fingerprint(task.demonstrations, "weights")}
