"""Saved scenarios: what a visitor has made, as a text that is checked like a file from a stranger.

The text is JSON, one object:

`version`
    `FORMAT`, or `UNTAUGHT`.
`scenario`
    The `Scenario` by its fields, without its `passing`, which a session decides anew. What is shown
    is its field `view`.
`camera`
    Position and look-at of the camera, metres; null is the view that the task begins with.
`own`
    The task where it does not ship with DT-Viz, whose name then is "own_data"; see `Own`. Otherwise null.
`lesson`
    Takes that are taught and not learned yet; see `Lesson`. It is left out if there are none, here and in `own`.
`arrays`
    Arrays by their names: demonstrations and shapes from files; see `dt_viz.files.texts`. It is left out if there are
    none.

Objects are written by their fields, with the name of their class; fields that are left out have their defaults. Shapes
of the paper's figures are written by their names (`Figure`). Version 1 had no `own` and no `arrays`, version 2 no
`lesson`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.page import Choice, FlowIntegration, Number
from dt_viz.avoidance.registry import KINDS, entry_of
from dt_viz.avoidance.transform import Anchored, Transform
from dt_viz.errors import DataError, FormatError, check_between, naming, parsing
from dt_viz.files.checks import check_at_most, check_size
from dt_viz.files.texts import decoded, encoded
from dt_viz.files.values import packed, unpacked
from dt_viz.flows.diffeomorphisms import MAX_STEPS
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import (
    SHAPES,
    UPRIGHT,
    CloudObstacle,
    MeshObstacle,
    Obstacle,
    Point,
    Quaternion,
    TriangleObstacle,
)
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario.own import Own
from dt_viz.scenario.paper_scenes import CLOVER, bottle, offered
from dt_viz.scenario.scenario import (
    MAX_DISTANCE,
    MAX_MARGIN,
    MAX_OBSTACLES,
    MAX_SIGHT,
    MAX_STARTS,
    MAX_TURN,
    MIN_TURN,
    OFFERS,
    Layer,
    Scenario,
)
from dt_viz.scenario.tasks import OWN, STYLES
from dt_viz.scenario.taught import Lesson

FORMAT, UNTAUGHT = 3, 2
"""Version of the text, raised where versions from before could not read it, and of one without any lesson."""
READ = (1, UNTAUGHT, FORMAT)  # versions that are read
MAX_BYTES = 16 * 10**6  # largest number of bytes of a text
MAX_PLAIN = 300_000
"""Largest number of bytes of all but its arrays: so much is checked within a second."""
SIZES = (0.002, 2.0)
"""Smallest depth and largest radius of an obstacle, metres: beyond the page's sliders, as scenes scale with the arm."""
THINNEST = 1e-4  # smallest depth of an obstacle from a file, metres
ROOM = 5.0  # factor by which other lengths may be beyond the page's sliders, for the same reason
SCALES = (0.02, 20.0)  # smallest and largest scale of a shape of a figure
STYLE_AMOUNTS = (-1.0, 2.0)  # smallest and largest part of a style that is put on
MAX_FLOWS = MAX_PANELS = 20
"""Largest number of a flow of the imitation, and of panels: more than any task or stack has."""
MAX_ROLLOUT = 10**4  # largest number of the rollout that the arm follows; it is counted round
SHIPPED: Mapping[str, Callable[[], Solid | Cloud]] = {"bottle": bottle, "clover": lambda: CLOVER.cloud}
"""Shapes of the paper's figures, by their names."""

Sight = tuple[Point, Point]  # position and look-at of a camera, metres


class ScenarioError(DataError):
    """A scenario that cannot be saved, or a text that is no saved scenario."""


@dataclass(frozen=True)
class Saved:
    """What is saved of a visitor's page."""

    scenario: Scenario
    camera: Sight | None = None  # None where the camera shows what the task begins with
    own: Own | None = None
    """The scenario's task where its demonstrations are not those of a known one."""
    lesson: Lesson | None = None
    """Takes that are taught and not learned yet; None if there are none."""


@dataclass(frozen=True)
class Known:
    """Names that a scenario may have."""

    tasks: Collection[str]
    arms: Collection[str] | None = ("",)  # names of arms; None are any
    methods: Collection[str] | None = ()
    """Names of methods that ours is compared with; None are any."""


@dataclass(frozen=True)
class Figure:
    """Stand-in for an obstacle whose shape is one of `SHIPPED`."""

    position: Point
    shape: str
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0

    @property
    def obstacle(self) -> Obstacle:
        """The obstacle. Raises FormatError where there is no such shape."""
        _check_named("shape", self.shape, SHIPPED)
        shape = SHIPPED[self.shape]()
        make = MeshObstacle if isinstance(shape, Solid) else CloudObstacle
        made: Any = make(self.position, shape, self.wxyz, self.scale)  # pyright: ignore[reportArgumentType]
        return made


def is_saved(content: bytes) -> bool:
    """Return whether the content of a file says that it is a saved scenario, whether or not it can be read."""
    return re.search(rb'"class"\s*:\s*"Saved"', content) is not None


def portable(scenario: Scenario) -> tuple[Scenario, int]:
    """Return a scenario without obstacles whose shapes come from files, and how many these were."""
    left = _with_obstacles(
        scenario, lambda obstacle: None if isinstance(_named(obstacle), TriangleObstacle) else obstacle
    )
    return left, len(scenario.obstacles) - len(left.obstacles)


def encode(saved: Saved) -> str:
    """Return what is saved as text, which `decode` reads back to the last bit.

    Raises:
        ScenarioError: the text would be larger than `MAX_BYTES`.
    """
    scenario, arrays = replace(_with_obstacles(saved.scenario, _named), passing=None), dict[str, np.ndarray]()
    if saved.own is not None:
        scenario = replace(scenario, task=OWN)
    plain = {"version": UNTAUGHT, **packed(replace(saved, scenario=scenario), "saved", arrays)}
    del plain["scenario"]["passing"]
    for taught in (plain, plain["own"]):
        if taught is not None and taught["lesson"] is None:
            del taught["lesson"]
        elif taught is not None:
            plain["version"] = FORMAT
    content = encoded(plain, arrays)
    with naming(ScenarioError, "scenario"):
        check_size(len(content), MAX_BYTES)
    return content.decode()


def decode(text: str | bytes, known: Known, source: str = "scenario") -> Saved:
    """Read what `encode` wrote; `source` names the text in messages.

    The shapes of obstacles are checked by `check_shapes`, which takes longer.

    Raises:
        DataError: it is too large, is no such text, or has a value that no page of these tasks, arms and methods
            gives, which is named. Nothing else is raised, whatever the text holds.
    """
    with parsing(ScenarioError, source, "text", "a scenario that DT-Viz saved"):
        content = text.encode() if isinstance(text, str) else text
        fields = "version", "class", *Saved.__dataclass_fields__
        plain, arrays = decoded(content, fields, max_bytes=MAX_BYTES, max_plain=MAX_PLAIN)
        version = plain.pop("version", None)
        if version not in READ or isinstance(version, bool):
            accepted = f"{', '.join(map(str, READ))}; another version of DT-Viz may have saved it"
            raise FormatError("version", repr(version)[:40], accepted)
        saved: Saved = unpacked(plain, Saved, "saved", arrays, {Transform: KINDS, Obstacle: (*SHAPES, Figure)})
        if arrays:
            raise FormatError("arrays", f"{next(iter(arrays))[:40]!r}, which nothing is made of", "those that are used")
        saved = replace(saved, scenario=_with_obstacles(saved.scenario, _whole))
        if saved.own is not None:
            saved, known = replace(saved, own=saved.own.checked(source)), replace(known, tasks=(*known.tasks, OWN))
            _check_named("task", saved.scenario.task, (OWN,))
        if saved.lesson is not None:
            saved = replace(saved, lesson=saved.lesson.checked(source))
        _check(saved, known)
        return saved


def check_shapes(scenario: Scenario, source: str = "scenario") -> None:
    """Check that obstacles from files are solids of a sensible size, and make them ready to be shown.

    It takes about a second for each shape.

    Raises:
        ScenarioError: one is none, such as an open mesh.
    """
    with parsing(ScenarioError, source, "shape of an obstacle", "a closed mesh, or points that something occupies"):
        for obstacle in scenario.obstacles:
            if isinstance(obstacle, TriangleObstacle):
                check_between("radius of an obstacle", obstacle.radius, *SIZES)
                check_between("depth of an obstacle", obstacle.depth, THINNEST, SIZES[1])
                obstacle.surface()


def _with_obstacles(scenario: Scenario, change: Callable[[Any], Any]) -> Scenario:
    """The scenario with each obstacle changed, or left out where it becomes None."""

    def changed(layer: Layer) -> Layer:
        if not isinstance(layer.transform, Avoidance):
            return layer
        obstacles = tuple(part for part in map(change, layer.transform.obstacles) if part is not None)
        return replace(layer, transform=replace(layer.transform, obstacles=obstacles))

    return replace(scenario, stack=tuple(map(changed, scenario.stack)))


def _named(obstacle: Obstacle) -> Any:  # noqa: ANN401 - an obstacle, or its stand-in
    """The obstacle, by the name of its shape where that ships."""
    if not isinstance(obstacle, MeshObstacle | CloudObstacle):
        return obstacle
    shape = obstacle.mesh if isinstance(obstacle, MeshObstacle) else obstacle.cloud
    name = next((name for name, shipped in SHIPPED.items() if shape == shipped()), None)
    return obstacle if name is None else Figure(obstacle.position, name, obstacle.wxyz, obstacle.scale)


def _whole(obstacle: Any) -> Obstacle:  # noqa: ANN401
    return obstacle.obstacle if isinstance(obstacle, Figure) else obstacle


def _check(saved: Saved, known: Known) -> None:
    """Raise FormatError unless a page could have made it; types, and what its values check themselves, are right."""
    scenario, view = saved.scenario, saved.scenario.view
    if scenario.passing is not None:
        raise FormatError("passing", "one", "none: it is decided anew")
    scenes = [scene.name for scene in offered(known.tasks) if scene.task == scenario.task]
    _check_named("task", scenario.task, known.tasks)
    _check_named("arm", scenario.arm, (scenario.arm,) if known.arms is None else known.arms)
    _check_named("scene", scenario.scene, ("", *scenes))
    _check_named("style", scenario.style, ("", *STYLES))
    for name in (*view.compared, view.their_arm):
        _check_named("compared method", name, ("", *((name,) if known.methods is None else known.methods)))
    for panel in view.panels:
        _check_named("task of a panel", panel.task, ("", *known.tasks))
    counts = {
        "obstacles": (len(scenario.obstacles), MAX_OBSTACLES),
        "starts": (len(scenario.starts), MAX_STARTS),
        "panels": (len(view.panels), MAX_PANELS),
        "arm_rollout": (scenario.arm_rollout, MAX_ROLLOUT),
        "selected": (view.selected, MAX_OBSTACLES),
        "generator_layer": (view.generator_layer, MAX_FLOWS),
    }
    for name, (count, most) in counts.items():
        check_between(name, count, 0, most)
    check_between("warp", scenario.warp, 0.0, 1.0)
    check_between("style_amount", scenario.style_amount, *STYLE_AMOUNTS)
    for name, value in (("phase", view.phase), ("speed", view.speed)):
        check_between(name, value, *OFFERS[name].limits[:2])
    for name, place in _places(saved):
        check_between(name, np.abs(place).max(), 0.0, MAX_SIGHT if name == "camera" else MAX_DISTANCE)
    for name, wxyz in _turns(scenario):
        check_between(name, float(np.linalg.norm(wxyz)), MIN_TURN, MAX_TURN)
    if saved.camera is not None:
        check_between("length of sight", float(np.linalg.norm(np.subtract(*saved.camera))), 1e-3, 4 * MAX_SIGHT)
    for obstacle in scenario.obstacles:
        if isinstance(obstacle, TriangleObstacle):  # its size would take a while to find
            check_between("scale of an obstacle", obstacle.scale, *SCALES)
        else:
            check_between("depth of an obstacle", obstacle.depth, *SIZES)
            check_between("radius of an obstacle", obstacle.radius, *SIZES)
    for layer in scenario.stack:
        _check_layer(layer, scenario)


def _places(saved: Saved) -> Iterator[tuple[str, Point]]:
    """Yield all places, metres, and what each is of."""
    scenario, pose = saved.scenario, saved.scenario.view.slice
    yield from (("place of a start", start.place) for start in scenario.starts)
    yield from (("position of an obstacle", obstacle.position) for obstacle in scenario.obstacles)
    transforms = [layer.transform for layer in scenario.stack]
    yield from ((f"position of {each!r}"[:40], each.position) for each in transforms if isinstance(each, Anchored))
    yield from () if pose is None else (("position of the slice", pose.position),)
    yield from (("camera", place) for place in saved.camera or ())


def _turns(scenario: Scenario) -> Iterator[tuple[str, Quaternion]]:
    yield from (("wxyz of an obstacle", obstacle.wxyz) for obstacle in scenario.obstacles)
    if scenario.view.slice is not None:
        yield "wxyz of the slice", scenario.view.slice.wxyz


def _check_layer(layer: Layer, scenario: Scenario) -> None:
    """Raise FormatError unless the page could have given a layer its name, and its transform its settings."""
    transform, entry = layer.transform, entry_of(layer.transform)
    alike = [other for other in scenario.stack if entry_of(other.transform) is entry]
    check_at_most(f"transforms {entry.title!r}", len(alike), entry.most)
    pattern = re.escape(entry.title) + ("" if entry.most == 1 else r" [1-9]\d?")
    same = [other for other in scenario.stack if other.name == layer.name]
    if len(same) > 1 or not re.fullmatch(pattern, layer.name, re.ASCII):
        raise FormatError("name of a transform", repr(layer.name)[:40], f"{entry.title!r}, each numbered if several")
    for setting in entry.settings:
        value: Any = getattr(transform, setting.field)
        if isinstance(setting, FlowIntegration):
            check_between(f"{setting.field}.steps", value.steps, 1, MAX_STEPS)
        elif isinstance(setting, Choice):
            _check_named(setting.field, value, setting.options)
        elif isinstance(setting, Number) and not (setting.automatic and value is None):
            room = ROOM if setting.scale != 1 else 1.0
            check_between(setting.field, setting.scale * value, setting.low / room, setting.high * room)
    plane = getattr(transform, "plane", None)
    if plane is not None:
        check_between("plane", float(np.abs(np.array(plane) @ np.transpose(plane) - np.eye(2)).max()), 0.0, 1e-6)
    if isinstance(transform, Avoidance):
        check_between("margin", transform.margin, 0.0, MAX_MARGIN)
        if transform.detour != type(transform)().detour:
            raise FormatError("detour", "other settings", "those that it has")


def _check_named(field: str, name: Any, accepted: Collection[Any]) -> None:  # noqa: ANN401 - of a choice
    if name not in accepted:
        raise FormatError(field, repr(name)[:40], ", ".join(map(repr, accepted))[:200])
