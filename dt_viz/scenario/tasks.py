"""The named tasks: demonstrations and their place in the robot's world."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.learning.demonstrations import Demonstration, DemonstrationError, lasa_files, load_demonstrations
from dt_viz.learning.inspection import PreparationSettings
from dt_viz.learning.interface import AnyImitation, State
from dt_viz.memo import cached_property
from dt_viz.metrics import resample_by_arc_length
from dt_viz.numerics import unit
from dt_viz.obstacles.shapes import Point, Sphere, as_point
from dt_viz.scenario.objects import Ball, LiftedBox, Pot, PushedBox, TaskObject
from dt_viz.scenario.scenario import Layer
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.taught import Lesson
from dt_viz.shipped import ASSETS

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

DRAWING_CENTRE = np.array([0.0, -0.50, 0.42])
"""Middle of the vertical drawing plane before the robot, metres. Whoever faces the robot sees it as a blackboard."""
DRAWING_AXES = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]).T
"""Columns: right, up, and out of the plane towards the viewer."""
DRAWING_SIZE = 0.40
"""Larger of width and height, metres, to which a drawing in other units is scaled."""

OWN = "own_data"  # name of the task that `own_task` makes

Move = tuple[float, Point]  # scale and shift, metres, of a placement
POTS = (Pot(-0.16, -0.52), Pot(0.0, -0.52), Pot(0.16, -0.52))
"""Pots of `drop_pots`: left, centre and right as seen facing the robot."""


@dataclass(frozen=True, eq=False, kw_only=True)
class Task:
    """Demonstrations of one motion, placed in the world.

    A point u (k,) of the demonstrations is the world point origin + scale·axes·u; a drawing has k = 2. What has a
    default is for the page.
    """

    demonstrations: tuple[Demonstration, ...]
    name: str = ""
    title: str = ""
    hint: str = ""  # line that says what to try
    origin: Array = field(default_factory=lambda: np.zeros(3))  # (3,), metres
    axes: Array = field(default_factory=lambda: np.eye(3))  # (3, 3) orthonormal columns
    scale: float = 1.0
    slice: Slice = field(default_factory=lambda: Slice(np.zeros(3), np.eye(3)[:, :2], (1.0, 1.0)))
    camera: tuple[tuple[float, float, float], tuple[float, float, float]] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    """Position and look-at, metres."""
    obstacle_position: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """First position of the obstacle, metres."""
    pots: tuple[Pot, ...] = ()  # pots on the table, from left to right
    objects: tuple[TaskObject, ...] = ()  # what the hand moves
    state: State = "auto"  # state that it is learned in where none is asked for
    draws: bool = False  # whether the hand holds a pen and draws on the slice
    preparation: PreparationSettings = field(default_factory=PreparationSettings)
    """Settings of what is done to the demonstrations before they are learned."""
    seen: tuple[str, ...] = ()
    """What was found about the demonstrations and shown before they were learned: it is no warning any more."""
    size: float = 1.0
    """Scale at which `placed` has put it, and at which what is added to it is made."""
    moves: tuple[Move, ...] = ()  # how `placed` has put it, one after the other
    imitation: AnyImitation | None = None
    """What was learned from the demonstrations, in its state; None is learned here."""
    layers: tuple[Layer, ...] = ()
    """Transforms that it begins with, in the frame of the demonstrations; without any it is a sphere to avoid."""
    lesson: Lesson | None = None
    """What a visitor has taught for it in the page; None if that was nothing."""

    def sphere(self, diameter: float = Sphere.diameter) -> Sphere:
        """Return the sphere in the way of the motions, of a diameter in metres where the task has its own size."""
        return Sphere(self.obstacle_position, self.size * diameter)

    def to_world(self, points: Array) -> Array:
        """Transform points (*B, k) of the demonstrations to the world, (*B, 3), metres."""
        return self.origin + self.scale * (points @ self.axes[:, : points.shape[-1]].T)

    def system(self, imitation: AnyImitation) -> DiffeomorphicSystem:
        """Return the motion learned from the demonstrations, as a system in the world, metres and seconds."""
        return imitation.system_in(self.origin, self.axes, self.scale)

    def placed(self, scale: float, shift: ArrayLike) -> Task:
        """Scale and move the task, x ↦ scale·x + shift (3,) metres; off the table it is without objects on that."""

        def mapped(point: ArrayLike) -> Array:
            return scale * np.asarray(point) + np.asarray(shift)

        eye, target = (as_point(mapped(point)) for point in self.camera)
        width, height = self.slice.half_size
        x, y, z = as_point(np.asarray(shift))
        return replace(
            self,
            origin=mapped(self.origin),
            scale=scale * self.scale,
            slice=replace(self.slice, centre=mapped(self.slice.centre), half_size=(scale * width, scale * height)),
            camera=(eye, target),
            obstacle_position=as_point(mapped(self.obstacle_position)),
            size=scale * self.size,
            moves=(*self.moves, (float(scale), (x, y, z))),
            hint="Drag the sphere into the way." if z and self.on_table else self.hint,
            pots=() if z else tuple(pot.placed(scale, x, y) for pot in self.pots),
            objects=() if z else tuple(one.placed(scale, x, y) for one in self.objects),
        )

    @property
    def on_table(self) -> bool:
        """Whether something of it stands on the table."""
        return bool(self.objects or self.pots)

    @cached_property
    def paths(self) -> tuple[Array, ...]:
        """Each demonstration in the world, (T_i, 3), metres."""
        return tuple(self.to_world(d.positions) for d in self.demonstrations)

    @property
    def mean_path(self) -> Array:
        """(101, 3) the mean demonstration by arc length, metres."""
        return np.mean([resample_by_arc_length(path, 101) for path in self.paths], axis=0)

    @property
    def starts(self) -> Array:
        """First points of the demonstrations in the world, (R, 3), metres."""
        return np.stack([path[0] for path in self.paths])


@dataclass(frozen=True)
class TaskEntry:
    """A task to choose. Calling it gives the task; raises DemonstrationError if its file cannot be used."""

    title: str
    load: Callable[[], Task]
    is_recorded: bool = False
    """Whether it was recorded in space: it stays there while an arm follows it there."""

    def __call__(self) -> Task:
        """The task, loaded on first use; all threads get the same one."""
        return self._task

    @cached_property
    def _task(self) -> Task:
        return self.load()


def letter(
    character: str,
    hint: str = "Drag the sphere through the letter.",
    obstacle_at: float = 0.5,
    state: State = "plain",
) -> Task:
    """Draw a letter that ships with DT-Viz, in a vertical plane before the robot (sec. 5); see `drawing_task`."""
    name = f"draw_{character.lower()}"
    task = drawing_task(name, TASKS[name].title, hint, load_demonstrations(ASSETS / f"{name}.npz"), obstacle_at)
    return replace(task, state=state)


def lift_box() -> Task:
    """Reach into a box, then lift abruptly (sec. 5)."""
    demonstrations = load_demonstrations(ASSETS / "lift_box.npz")
    lower, upper = _bounds(demonstrations)
    middle = (lower + upper) / 2
    # the slice follows the motion: from the mean start towards the corner in the box, and up
    start = np.mean([d.positions[0] for d in demonstrations], axis=0)
    along = unit(np.array([-start[0], -0.55 - start[1], 0.0]))
    lowest = np.mean([d.positions[d.positions[:, 2].argmin()] for d in demonstrations], axis=0)
    return Task(
        name="lift_box",
        state="plain",
        title="Lift box",
        hint="Put the sphere in the way into the box, or on the way up.",
        demonstrations=demonstrations,
        slice=Slice(middle + np.array([0.0, 0.0, 0.02]), np.stack([along, [0.0, 0.0, 1.0]], axis=1), (0.32, 0.26)),
        camera=((0.98, -1.60, 0.92), (0.24, -0.33, 0.28)),
        obstacle_position=as_point(_mean(demonstrations)[42]),
        objects=(LiftedBox((float(lowest[0]), float(lowest[1])), float(lowest[2])),),
    )


def push_box() -> Task:
    """Come down behind a box and push it along the table (sec. 5)."""
    demonstrations = load_demonstrations(ASSETS / "push_box.npz")
    lower, upper = _bounds(demonstrations)
    middle = (lower + upper) / 2
    height = demonstrations[0].positions[-1, 2]  # of the push: the slice lies level in it
    mean = _mean(demonstrations)
    return Task(
        name="push_box",
        state="plain",
        title="Push box",
        hint="Put the sphere where the box is pushed along the table.",
        demonstrations=demonstrations,
        slice=Slice(np.array([middle[0], middle[1], height]), np.eye(3)[:, :2], (0.42, 0.20)),
        camera=((0.70, -1.58, 0.95), (0.13, -0.32, 0.22)),
        obstacle_position=as_point(mean[55] - [0.0, 0.0, 0.02]),  # low: the way over it is free, under it is the table
        objects=(PushedBox.before(mean[35, :2], mean[-1, :2]),),
    )


def drop_pots() -> Task:
    """Carry an object over the centre pot, to be biased towards the left or the right one (fig. 8)."""
    demonstrations = load_demonstrations(ASSETS / "drop_pots.npz")
    paths = np.stack([resample_by_arc_length(d.positions, 101) for d in demonstrations])
    # the slice is tilted: from the mean start down to the goals above all three pots
    _, y, z = paths[:, -1].mean(axis=0) - paths[:, 0].mean(axis=0)
    down = unit(np.array([0.0, y, z]))
    return Task(
        name="drop_pots",
        state="plain",
        title="Drop in pots",
        hint="Bias the motion to the left or the right pot, its goal along with it.",
        demonstrations=demonstrations,
        slice=Slice(paths.mean(axis=(0, 1)), np.stack([[1.0, 0.0, 0.0], down], axis=1), (0.30, 0.24)),
        camera=((0.62, -1.58, 0.90), (0.06, -0.38, 0.24)),
        obstacle_position=(0.0, -0.58, 0.36),  # beyond the pots: on the other side it would meet the arm
        pots=POTS,
        objects=(Ball(POTS),),
    )


def drawing_task(
    name: str, title: str, hint: str, demonstrations: tuple[Demonstration, ...], obstacle_at: float = 0.5
) -> Task:
    """Return a task from 2-D demonstrations, on the vertical plane before the robot.

    Drawings between a half and the whole of `DRAWING_SIZE` keep their size; others are scaled to it.

    Args:
        name: name of the task.
        title: title on the page.
        hint: line that says what to try.
        demonstrations: demonstrations of one drawing.
        obstacle_at: first place of the obstacle on the mean drawing, as a fraction of its length.
    """
    lower, upper = _bounds(demonstrations)
    size = float((upper - lower).max())
    scale = 1.0 if DRAWING_SIZE / 2 <= size <= 1.1 * DRAWING_SIZE else DRAWING_SIZE / size
    origin = DRAWING_CENTRE - scale * DRAWING_AXES[:, :2] @ ((lower + upper) / 2)
    half, middle = scale * (upper - lower) / 2 + 0.10, _mean(demonstrations)[round(100 * obstacle_at)]
    return Task(
        name=name,
        title=title,
        hint=hint,
        demonstrations=demonstrations,
        origin=origin,
        axes=DRAWING_AXES,
        scale=scale,
        slice=Slice(DRAWING_CENTRE, DRAWING_AXES[:, :2], (float(half[0]), float(half[1]))),
        camera=((0.79, -1.56, 0.75), (0.15, -0.33, 0.355)),
        obstacle_position=as_point(origin + scale * DRAWING_AXES[:, :2] @ middle),
        draws=True,
    )


def own_task(demonstrations: tuple[Demonstration, ...]) -> Task:
    """Return a task from demonstrations that somebody brings: drawings as in `drawing_task`, others where they are.

    The slice of motions in space is the plane that they are nearest to, its first axis level.
    """
    hint = "Drag the sphere into the way of your motion."
    if demonstrations[0].dimension == 2:
        return drawing_task(OWN, "Own data", hint, demonstrations)
    points = np.concatenate([resample_by_arc_length(d.positions, 101) for d in demonstrations])
    lower, upper = _bounds(demonstrations)
    middle = (lower + upper) / 2
    normal = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][2]
    along = np.cross(normal, [0.0, 0.0, 1.0])
    along = unit(along) if np.linalg.norm(along) > 0.1 else np.array([1.0, 0.0, 0.0])  # a level plane
    across = unit(np.cross(along, normal))
    axes = np.stack([along, across], axis=1)
    half = np.ptp((points - middle) @ axes, axis=0) / 2 + 0.10
    eye = middle + max(1.3, 3 * float((upper - lower).max())) * unit(np.array([0.5, -1.0, 0.5]))
    return Task(
        name=OWN,
        title="Own data",
        hint=hint,
        demonstrations=demonstrations,
        slice=Slice(middle, axes, (float(half[0]), float(half[1]))),
        camera=(as_point(eye), as_point(middle)),
        obstacle_position=as_point(_mean(demonstrations)[50]),
    )


def known_tasks(lasa: Path | None) -> dict[str, TaskEntry]:
    """Return the tasks that ship with DT-Viz, and a drawing for each .mat file of a folder with the LASA data.

    Raises:
        DemonstrationError: the folder cannot be read or holds no .mat file; each is read when it is chosen.
    """
    files = {} if lasa is None else lasa_files(lasa)
    entries = {name: TaskEntry(f"LASA {name}", partial(_lasa_task, name, path)) for name, path in files.items()}
    return {**TASKS, **entries}


def _lasa_task(name: str, path: Path) -> Task:
    demonstrations = load_demonstrations(path)
    if demonstrations[0].dimension != 2:
        found = f"{demonstrations[0].dimension} coordinates"
        raise DemonstrationError(path, "pos", found, "2: a drawing in the plane")
    return drawing_task(name, f"LASA {name}", "Drag the sphere through the letter.", demonstrations)


def _bounds(demonstrations: tuple[Demonstration, ...]) -> tuple[Array, Array]:
    """Smallest and largest coordinates (k,) of the demonstrations."""
    points = np.concatenate([d.positions for d in demonstrations])
    return points.min(axis=0), points.max(axis=0)


def _mean(demonstrations: tuple[Demonstration, ...]) -> Array:
    """The mean demonstration (101, k) by arc length."""
    return np.mean([resample_by_arc_length(d.positions, 101) for d in demonstrations], axis=0)


TASKS: Mapping[str, TaskEntry] = {
    "draw_s": TaskEntry("Draw S", partial(letter, "S")),
    "draw_j": TaskEntry("Draw J", partial(letter, "J", "Bias the letter to points beside it.")),
    "draw_c": TaskEntry("Draw C", partial(letter, "C")),
    "draw_g": TaskEntry("Draw G", partial(letter, "G")),
    "draw_w": TaskEntry("Draw W", partial(letter, "W", obstacle_at=0.36)),  # not between two strokes
    "draw_z": TaskEntry("Draw Z", partial(letter, "Z")),
    "draw_8": TaskEntry(
        "Draw 8", partial(letter, "8", "The 8 crosses itself. Drag the sphere through it.", 0.3, "augmented")
    ),
    "draw_s_wavy": TaskEntry(
        "Draw wavy S", partial(letter, "S_wavy", "The S of another hand, in waves.", state="augmented")
    ),
    "lift_box": TaskEntry("Lift box", lift_box),
    "push_box": TaskEntry("Push box", push_box),
    "drop_pots": TaskEntry("Drop in pots", drop_pots),
}
"""The tasks that ship with DT-Viz, by name."""
STYLES: Mapping[str, tuple[str, str]] = {"wavy": ("draw_s", "draw_s_wavy")}
"""Tasks of the same action, by the usual hand and in a style, by the style's name."""
