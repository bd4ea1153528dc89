"""The scenes of the paper, each with a line that says what to see."""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance, Avoidance
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.registry import BIAS
from dt_viz.flows.fields import Array, Mask
from dt_viz.memo import cached_property
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.occupancy import sample_labels
from dt_viz.obstacles.shapes import UPRIGHT, Box, CloudObstacle, MeshObstacle, Point, Sphere, as_point, lathe
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario.objects import Pot
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.slices import BASE_PANEL, Panel
from dt_viz.scenario.stack import IMITATION, avoiding, plane_of, with_added
from dt_viz.scenario.tasks import Task

OTHER_LETTERS = tuple(f"draw_{letter}" for letter in "cgjwz")
"""Tasks of fig. 5 beside the S, of the letters that ship with DT-Viz."""
OTHER_LASA_LETTERS = ("Angle", "CShape", "GShape", "JShape", "Leaf_1", "NShape", "PShape")
"""Tasks of fig. 5 beside the S, of the LASA handwriting data."""
HAND_ONLY = {"arm": False}
"""View of scenes where only the path of the hand gives way: the fingers would be in the obstacle."""
FIGURE = HAND_ONLY | {"field": False, "streamlines": True, "table": False, "ghost": False, "demonstrations": False}
"""View of panels side by side: flat figures of the motion alone."""
POSES = {"onion": True, "field": False, "demonstrations": False}
"""View of the scenes of fig. 8: the arm from its starting pose to where it lets go."""
FIG_6_PLACES: Mapping[str, Point] = {
    "push_box": (0.0156, -0.5003, 0.1605),
    "lift_box": (0.0246, -0.4889, 0.1217),
    "draw_s": (0.0688, -0.4549, 0.3857),
}
"""Places of the sphere of fig. 6, for each task: the first at which `evaluate table1` measures, metres."""
FIG_6 = {"compared": ("eflow-repulsive", "linear", "modulation"), "field": False, "ghost": False}
"""View of its scenes: the methods that follow a drag, one of each kind."""
FIRST_BIAS = f"{BIAS.title} 1"  # name of the layer of the first bias point


@dataclass(frozen=True)
class PaperScene:
    """A scenario of one of the paper's figures."""

    name: str
    title: str
    line: str  # line that says what to see
    task: str  # name of its task
    make: Callable[[Task], Scenario]
    view: Mapping[str, Any] = field(default_factory=dict)
    """Fields of `View` that differ from the defaults."""
    of_jaco: bool = False
    """Whether its places are the JACO's, so that it is not offered with another arm."""

    @property
    def tasks(self) -> frozenset[str]:
        """Names of all tasks that it shows."""
        return frozenset((self.task, *(panel.task for panel in self.view.get("panels", ()) if panel.task)))

    def scenario(self, task: Task) -> Scenario:
        """Return the scenario for its task."""
        return replace(self.make(task), scene=self.name, view=replace(View(), **self.view))

    def is_changed(self, scenario: Scenario, task: Task) -> bool:
        """Return whether the stack differs from the scene's own."""
        free = {name: getattr(scenario, name) for name in ("arm", "warp", "starts", "arm_rollout")}
        return scenario.choices != replace(self.scenario(task), **free).choices


def _biased(task: Task, *points: BiasPoint) -> Scenario:
    scenario = Scenario(task.name)
    for point in points:
        scenario = replace(scenario, stack=with_added(scenario, point)[0])
    return scenario


@lru_cache(maxsize=1)
def bottle() -> Solid:
    """Return a bottle that stands in the origin."""
    # radius of body, neck and rim, and the height at which each ends, metres
    (body, top), (neck, under), (rim, height) = (0.035, 0.180), (0.013, 0.265), (0.0155, 0.280)
    part = np.linspace(0, 1, 9)  # along the shoulder, which is 5 cm high
    shoulder = zip(neck + (body - neck) * (1 + np.cos(np.pi * part)) / 2, top + 0.05 * part, strict=True)
    bottom, mouth = [(0.0, 0.0), (body, 0.0)], [(neck, under), (rim, under), (rim, height), (0.0, height)]
    return Solid(*lathe([*bottom, *shoulder, *mouth], 32))


def _bottle_in_the_way(task: Task) -> Scenario:
    """Fig. 1 and 7: a standing bottle in the path, given way to by the whole arm."""
    beside_the_box = {"lift_box": 34, "push_box": 55}  # percent of the motion's length
    x, y, _ = task.mean_path[beside_the_box[task.name]]
    return avoiding(task, ArmAvoidance(MeshObstacle((float(x), float(y), 0.0), bottle(), scale=task.size)))


def _sphere_in_the_letter(diameter: float) -> Callable[[Task], Scenario]:
    return lambda task: avoiding(task, Avoidance(task.sphere(diameter), plane=plane_of(task)))


def _cube_before_the_attractor(task: Task) -> Scenario:
    """Fig. 3 (a): motions that are straight but for a cube of 10 cm."""
    middle, side = (task.starts.mean(axis=0) + task.mean_path[-1]) / 2, 0.10 * task.size
    cube = Box(as_point(middle), (side, side, side))
    return replace(avoiding(task, Avoidance(cube, plane=plane_of(task))), imitation=False)


def _alone(task: Task) -> Scenario:
    """Fig. 3 (b), 5 and 8: what was learned, and nothing in its way."""
    return Scenario(task.name, ())


def _gallery(name: str, title: str, task: str, others: tuple[str, ...]) -> PaperScene:
    """Return a scene of what was learned of several drawings, side by side (fig. 5)."""
    return PaperScene(
        name,
        title,
        "Motions learned from seven drawings of each letter (pale), and where they lead from elsewhere.",
        task,
        _alone,
        view=FIGURE | {"panels": tuple(Panel(task=other) for other in others), "demonstrations": True},
    )


@dataclass(frozen=True)
class Clover:
    """A smooth clover of three leaves around the y axis, metres."""

    radius: float = 0.06  # mean radius
    thickness: float = 0.06  # half the thickness
    lobes: float = 0.4  # height of the lobes, relative to the mean radius

    def holds(self, s: Array) -> Mask:
        """Return whether points `s` (N, 3), metres, lie in it."""
        turn = np.arctan2(s[:, 2], s[:, 0])
        radius = self.radius * (1 + self.lobes * np.cos(3 * turn))
        return (s[:, 0] ** 2 + s[:, 2] ** 2) / radius**2 + (s[:, 1] / self.thickness) ** 2 < 1

    @cached_property
    def cloud(self) -> Cloud:
        """Points labelled by whether they lie in it."""
        half = np.array([1 + self.lobes, 0, 1 + self.lobes]) * self.radius + [0, self.thickness, 0]
        return Cloud(*sample_labels(self.holds, -half, half, 4000, np.random.default_rng(0)))


CLOVER = Clover()


def _two_points(task: Task) -> Scenario:
    mean, plane = task.mean_path, plane_of(task)
    offsets = {30: (0.05, 0.0), 70: (0.0, -0.03)}  # to the right and up, metres, by the percent of its length
    places = [mean[at] + task.size * task.slice.axes @ offset for at, offset in offsets.items()]
    return _biased(task, *(BiasPoint(as_point(place), plane=plane) for place in places))


def release(pot: Pot) -> Point:
    """Return the place where an object is released to fall into this pot, metres, as in the demonstrations."""
    x, y, z = pot.opening
    return x, y, z + 0.16


def _comparison(name: str, title: str, task: str) -> PaperScene:
    """Return a scene of ours beside other methods (fig. 6)."""
    line = "Ours is orange. Scores and curves of all are in “Compare”; drag the sphere."
    avoidance = ArmAvoidance(Sphere(FIG_6_PLACES[task]))
    return PaperScene(name, f"Fig. 6: {title}", line, task, lambda task: avoiding(task, avoidance), FIG_6, of_jaco=True)


def _into_pot(name: str, index: int) -> PaperScene:
    """Return a scene of a goal that is taken along to another pot (fig. 8)."""
    return PaperScene(
        f"{name}_pot",
        f"Fig. 8: into the {name} pot",
        f"One bias point takes the goal along from the centre pot to the {name} one. "
        "Pale arms: from the starting pose on.",
        "drop_pots",
        lambda task: _biased(task, BiasPoint(release(task.pots[index]), moves_goal=True)),
        view=POSES,
        of_jaco=True,
    )


SCENES: Mapping[str, PaperScene] = {
    scene.name: scene
    for scene in (
        PaperScene(
            "lift",
            "Fig. 1, 7: lift, a bottle in the way",
            "The whole arm gives way to the bottle, and still dips before it lifts.",
            "lift_box",
            _bottle_in_the_way,
        ),
        PaperScene(
            "push",
            "Fig. 1, 7: push, a bottle in the way",
            "The whole arm gives way to the bottle, and still ends where the demonstrations do.",
            "push_box",
            _bottle_in_the_way,
        ),
        PaperScene(
            "steps",
            "Fig. 2: attractor, imitation, avoidance",
            "Each step is a diffeomorphism on the one before it: straight motions, the S, the S around the sphere. "
            "Drag the sphere.",
            "draw_s",
            _sphere_in_the_letter(0.15),
            view=FIGURE | {"panels": (BASE_PANEL, Panel(IMITATION))},
        ),
        PaperScene(
            "cube",
            "Fig. 3 (a): a cube before an attractor",
            "Nothing is learned here: straight motions, and the same ones led around the cube. Drag the cube.",
            "draw_s",
            _cube_before_the_attractor,
            view=FIGURE | {"panels": (BASE_PANEL,)},
        ),
        PaperScene(
            "learned",
            "Fig. 3 (b): how the S is learned",
            "The flow of the vector field in the middle turns straight motions (left) into the S (right).",
            "draw_s",
            _alone,
            view=FIGURE | {"panels": (BASE_PANEL, Panel(IMITATION, generator=True)), "demonstrations": True},
        ),
        PaperScene(
            "two_points",
            "Fig. 4: a J biased to two points",
            "The J, the field that leads it to the first point, the J through that point, and through both: drag them.",
            "draw_j",
            _two_points,
            view=FIGURE | {"panels": (Panel(IMITATION), Panel(FIRST_BIAS, generator=True), Panel(FIRST_BIAS))},
        ),
        _gallery("letters", "Fig. 5: letters", "draw_s", OTHER_LETTERS),
        _gallery("lasa", "Fig. 5: letters of the LASA data", "Sshape", OTHER_LASA_LETTERS),
        PaperScene(
            "cloud",
            "Sec. 4.4: labelled points in the S",
            "Known of the clover is only which points lie in it (dark). Strokes leave the occupancy learned from them.",
            "draw_s",
            lambda task: avoiding(
                task, Avoidance(CloudObstacle(task.obstacle_position, CLOVER.cloud, UPRIGHT, task.size))
            ),
            view=HAND_ONLY | {"colour": "occupancy", "field": False, "demonstrations": False},
        ),
        _comparison("others_push", "push, beside other methods", "push_box"),
        _comparison("others_lift", "lift, beside other methods", "lift_box"),
        _comparison("others_s", "the S, beside other methods", "draw_s"),
        PaperScene(
            "augmented",
            "Augmented states (sec. 6)",
            "An 8 crosses itself. Motions of one field never do (left). One that remembers how far it is does: drag "
            "the sphere.",
            "draw_8",
            _sphere_in_the_letter(0.09),  # small, so that the 8 remains one
            view=FIGURE
            | {"panels": (Panel(task="draw_8", state="plain"),), "streamlines": False, "demonstrations": True},
        ),
        PaperScene(
            "style",
            "Style (sec. 6)",
            "Two hands draw an S (left). What leads from the one to the other is put on the C of the first: "
            "Stack → Amount.",
            "draw_c",
            lambda task: replace(_alone(task), style="wavy"),
            view=FIGURE
            | {
                "panels": (Panel(task="draw_s", state="augmented"), Panel(task="draw_s_wavy", state="augmented")),
                "streamlines": False,
                "demonstrations": True,
                "tuned": IMITATION,
            },
        ),
        PaperScene(
            "centre_pot",
            "Fig. 8: into the centre pot",
            "All demonstrations end over the centre pot, into which the object falls. "
            "Pale arms: from the starting pose on.",
            "drop_pots",
            _alone,
            view=POSES,
        ),
        _into_pot("left", 0),
        _into_pot("right", 2),
    )
}
"""Scenes by name, in the order of the figures; see `offered`."""


def found(name: str, scenes: Iterable[PaperScene]) -> PaperScene | None:
    """Return the scene of a name, or the first of a figure, such as "fig-4"; None if there is none."""

    def called(scene: PaperScene) -> bool:
        title = re.sub(r"[^a-z0-9]+", "-", scene.title.lower())
        return name == scene.name or f"{title}-".startswith(f"{name.lower()}-")

    return next(filter(called, scenes), None)


def offered(tasks: Container[str], *, jaco: bool = True) -> tuple[PaperScene, ...]:
    """Return the scenes whose tasks are all among these: those of the LASA data only where the user has them.

    Args:
        tasks: names of the tasks that there are.
        jaco: whether they are for the JACO; scenes with places of its own are left out otherwise.
    """
    known = (scene for scene in SCENES.values() if all(name in tasks for name in scene.tasks))
    return tuple(scene for scene in known if jaco or not scene.of_jaco)
