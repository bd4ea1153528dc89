"""The tab "World": obstacles, transforms that are added, and added starts."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import UnionType
from typing import Any

import numpy as np
import viser

from dt_viz.avoidance import registry
from dt_viz.avoidance.transform import Transform
from dt_viz.motion.following import room_at_rest
from dt_viz.obstacles import files as shapes
from dt_viz.obstacles.shapes import ORIGIN, Box, CloudObstacle, Cylinder, MeshObstacle, Obstacle, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.scenario.scenario import MAX_DIAMETER, MAX_MARGIN, MAX_OBSTACLES, MIN_DIAMETER, Scenario
from dt_viz.scenario.stack import added, selected, surroundings, with_added, with_avoidance, without
from dt_viz.scenario.starts import followed, label_of, with_grid, with_label
from dt_viz.scenario.tasks import Task
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings
from dt_viz.ui.tabs.from_file import FileLoader, has_room
from dt_viz.ui.tabs.settings import add_settings, settings_of_purpose
from dt_viz.warning import Severity

SHAPES: Mapping[str, Obstacle] = {
    "Sphere": Sphere(ORIGIN, 0.10),
    "Cylinder": Cylinder(ORIGIN, 0.08, 0.16),
    "Cube (fig. 3a)": Box(ORIGIN, (0.12, 0.12, 0.12)),
    "Box": Box(ORIGIN, (0.16, 0.10, 0.06)),
}
"""Shapes that can be added, by the name of their button."""
NONE: str = "none"
NO_TRANSFORM = "–"
NEAREST = "nearest"
LABEL_HINT = (
    "which of the patterns that the demonstrations show is followed, where they differ although they begin at one "
    "place: of new starts, and of an added start that the arm follows. Numbers are those of demonstrations with that "
    "pattern, as in Follows rollout. nearest: that of the nearest demonstration"
)


@dataclass(frozen=True)
class _Length:
    """A slider [cm] for a length of obstacles of one shape, metres."""

    label: str
    shape: type[Obstacle] | UnionType
    low: float
    high: float
    field: str
    """Name of the shape's field."""
    place: int | None = None
    """Place of the length where the field is a tuple of them."""
    hint: str | None = None

    def add(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build it where the panel is being built; it is shown while the selected obstacle has the shape."""

        def shown(scenario: Scenario) -> float:
            chosen = _selected(scenario)
            if not isinstance(chosen, self.shape):
                return KEEP
            value = getattr(chosen, self.field)
            return round(100 * (value if self.place is None else value[self.place]), 3)

        def changed(scenario: Scenario, value: float) -> dict[str, Any]:
            chosen = _selected(scenario)
            if not isinstance(chosen, self.shape):
                return {}
            index, before = scenario.selected or 0, scenario.obstacles
            changed = (*before[:index], self._with(chosen, value / 100), *before[index + 1 :])
            return {"stack": with_avoidance(scenario, obstacles=changed)}

        slider = gui.add_slider(self.label, 100 * self.low, 100 * self.high, 0.5, 15.0, hint=self.hint)
        bindings.input(slider, shown, changed, visible=lambda s: isinstance(_selected(s), self.shape))

    def _with(self, obstacle: Any, length: float) -> Obstacle:  # noqa: ANN401 - of the shape
        if isinstance(obstacle, MeshObstacle | CloudObstacle):
            return obstacle.resized(length)
        before = getattr(obstacle, self.field)
        lengths = length if self.place is None else (*before[: self.place], length, *before[self.place + 1 :])
        return replace(obstacle, **{self.field: lengths})


SIDE = 0.03, 0.40
"""Smallest and largest side of a box, and height of a cylinder, metres."""
LENGTHS = (
    _Length("Diameter [cm]", Sphere, MIN_DIAMETER, MAX_DIAMETER, "diameter"),
    _Length("Diameter [cm]", Cylinder, MIN_DIAMETER, MAX_DIAMETER, "diameter"),
    _Length("Height [cm]", Cylinder, *SIDE, "height"),
    *(_Length(f"Size {axis} [cm]", Box, *SIDE, "sizes", place) for place, axis in enumerate("xyz")),
    _Length(
        "Size [cm]",
        MeshObstacle | CloudObstacle,
        shapes.MIN_SIZE,
        shapes.MAX_SIZE,
        "size",
        hint="largest side of its bounding box",
    ),
)
"""Sliders for the lengths of all shapes."""


def add_obstacles(gui: viser.GuiApi, bindings: Bindings) -> FileLoader:
    """Build the folder "Obstacles" where the panel is being built; return its part that loads files."""
    with gui.add_folder("Obstacles"):
        hint = "the obstacle that is changed here; a click in the scene selects one, too"
        choice = gui.add_dropdown("Selected", (NONE,), hint=hint)
        bindings.input(
            choice,
            lambda s: _names(s)[s.selected or 0],
            lambda s, name: {"view": replace(s.view, selected=choice.options.index(name))},
            options=_names,
        )
        bindings.checkbox(gui, "handles")
        group = gui.add_button_group("Add", tuple(SHAPES), hint=f"up to {MAX_OBSTACLES}, where there is room")
        # groups of buttons cannot be disabled
        bindings.later(group, lambda session, name: add(session, SHAPES[name]), visible=has_room)
        changes = {"Duplicate": duplicate, "Delete": delete}
        change = gui.add_button_group("Change", tuple(changes), hint="the selected obstacle")
        bindings.later(change, lambda session, name: changes[name](session), visible=lambda s: bool(s.obstacles))
        for length in LENGTHS:
            length.add(gui, bindings)
        hint = "clearance that the automatic flow time keeps"
        bindings.input(
            gui.add_slider("Margin [cm]", 0.0, 100 * MAX_MARGIN, 0.1, 1.0, hint=hint),
            lambda s: round(100 * s.avoidance.margin, 3),
            lambda s, value: {"stack": with_avoidance(s, margin=value / 100)},
        )
        return FileLoader(gui, bindings, add)


def add(session: Session, obstacle: Obstacle) -> None:
    """Put another obstacle, turned as it is, where there is room on the motion, and select it."""
    before = session.scenario.obstacles
    if has_room(session.scenario):
        _replace(session, (*before, with_room(obstacle, before, session.task)), selected=len(before))


def duplicate(session: Session) -> None:
    """Add another obstacle like the selected one."""
    chosen = _selected(session.scenario)
    if chosen is not None:
        add(session, chosen)


def delete(session: Session) -> None:
    """Delete the selected obstacle."""
    index, before = session.scenario.selected, session.scenario.obstacles
    if index is not None:
        _replace(session, (*before[:index], *before[index + 1 :]), selected=max(0, index - 1))


def _replace(session: Session, obstacles: tuple[Obstacle, ...], selected: int) -> None:
    view = replace(session.scenario.view, selected=selected)
    session.step("obstacles", stack=with_avoidance(session.scenario, obstacles=obstacles), view=view)


def _names(scenario: Scenario) -> tuple[str, ...]:
    return tuple(f"{k}: {name_of(obstacle)}" for k, obstacle in enumerate(scenario.obstacles, 1)) or (NONE,)


def _selected(scenario: Scenario) -> Obstacle | None:
    return None if scenario.selected is None else scenario.obstacles[scenario.selected]


def name_of(obstacle: Obstacle) -> str:
    """Return the name of its shape on the panel."""
    if isinstance(obstacle, Box) and len(set(obstacle.sizes)) == 1:
        return "cube"
    return type(obstacle).__name__.removesuffix("Obstacle").lower()


def with_room(obstacle: Obstacle, others: Sequence[Obstacle], task: Task) -> Obstacle:
    """Return the obstacle beside the mean demonstration, where that is farthest from its ends and other obstacles."""
    mean = task.mean_path
    ends = np.concatenate([task.starts, mean[-1:]])
    room = np.linalg.norm(mean[:, None] - ends, axis=-1).min(axis=1)
    room = np.minimum(room, Union(tuple(others)).signed_distance(mean))
    best = int(room.argmax())
    along = mean[min(best + 1, 100)] - mean[max(best - 1, 0)]
    aside = np.cross(along, np.cross(*task.slice.axes.T))
    aside /= max(float(np.linalg.norm(aside)), 1e-12)
    # 0.4 inner radii aside: dead ahead no side is the shorter one
    return obstacle.moved(as_point(mean[best] + 0.4 * obstacle.depth * aside), obstacle.wxyz)


def add_transforms(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the folder "Transforms": adds and deletes transforms, and changes the selected one."""
    kinds = addable()
    with gui.add_folder("Transforms"):
        hinted = ((title, registry.KINDS[kind].hint) for title, kind in kinds.items())
        hints = "; ".join(f"{title}: {hint}" for title, hint in hinted if hint)
        buttons = gui.add_button_group("Add", tuple(kinds), hint=hints)
        offered = {"options": lambda s: _offered(s) or KEEP, "visible": lambda s: bool(_offered(s))}
        bindings.later(buttons, lambda session, title: add_transform(session, kinds[title]), **offered)
        buttons = gui.add_button_group("Change", ("Delete",), visible=False, hint="the selected transform")
        bindings.later(buttons, lambda session, _name: delete_transform(session), visible=lambda s: bool(added(s)))
        bindings.input(
            gui.add_dropdown("Selected", (NO_TRANSFORM,), visible=False, hint="what the controls below are of"),
            lambda s: selected(s) or NO_TRANSFORM,
            lambda s, value: {"view": replace(s.view, bias=value)},
            options=lambda s: tuple(added(s)) or (NO_TRANSFORM,),
            visible=lambda s: len(added(s)) > 1,
        )
        bindings.checkbox(gui, "bias_handles", visible=lambda s: bool(added(s)))
        add_settings(gui, bindings, lambda entry: settings_of_purpose(entry) if entry.most > 1 else (), selected)


def add_transform(session: Session, kind: type[Transform]) -> None:
    """Add a transform of a kind beside the middle of the motion, and select it."""
    scenario, entry = session.scenario, registry.KINDS[kind]
    if entry.title in _offered(scenario):
        transform = entry.added(surroundings(session.task, scenario)) if entry.added else kind()
        stack, name = with_added(scenario, transform)
        session.step("add", stack=stack, view=replace(scenario.view, bias=name))


def delete_transform(session: Session) -> None:
    """Delete the selected transform."""
    name = selected(session.scenario)
    if name is not None:
        session.step("delete", stack=without(session.scenario, name))


def addable() -> dict[str, type[Transform]]:
    """Return the kinds of transforms that are added, by the name of their button."""
    return {entry.title: kind for kind, entry in registry.KINDS.items() if entry.most > 1}


def _offered(scenario: Scenario) -> tuple[str, ...]:
    """Return the titles of the kinds of which there may be one more."""
    present = [registry.entry_of(transform).title for transform in added(scenario).values()]
    return tuple(title for title, kind in addable().items() if present.count(title) < registry.KINDS[kind].most)


def add_starts(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the folder "Starts": adds starts by clicks and in a grid, labels and removes them."""
    with gui.add_folder("Starts", expand_by_default=False):
        bindings.checkbox(gui, "click_to_start")
        _add_label(gui, bindings)
        acts = {"Grid": add_grid, "Remove": remove_start, "Clear": clear_starts}
        hint = "Grid: starts all over the slice. Remove: the start that the arm follows, or else the newest"
        buttons = gui.add_button_group("Starts", tuple(acts), hint=hint)
        bindings.later(buttons, lambda session, name: acts[name](session))


def _add_label(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the choice of the label that new starts, and the added start that the arm follows, get."""

    def names() -> dict[float | None, str]:
        labels = () if bindings.frame is None else bindings.frame.labels
        return {None: NEAREST} | {label: _named(label, labels) for label in sorted(set(labels))}

    def shown(scenario: Scenario) -> str:
        label = None if bindings.frame is None else label_of(scenario, bindings.frame.task)
        return names().get(label, NEAREST)

    def changed(scenario: Scenario, name: str) -> dict[str, Any]:
        label = next((label for label, known in names().items() if known == name), None)
        starts = with_label(scenario, bindings.session.task, label)
        return {"starts": starts, "view": replace(scenario.view, start_label=label)}

    bindings.input(
        gui.add_dropdown("Label", (NEAREST,), initial_value=NEAREST, hint=LABEL_HINT),
        shown,
        changed,
        options=lambda _s: tuple(names().values()),
        visible=lambda _s: len(names()) > 1,
    )


def add_grid(session: Session) -> None:
    """Add starts all over the slice."""
    scenario, task = session.scenario, session.task
    arm_room = partial(room_at_rest, session.robot, task, scenario.obstacle)
    try:
        grid = with_grid(scenario, task.slice.posed(scenario.view.slice), arm_room, session.robot.reaches)
    except UnreachableError as error:
        session.say(f"the arm cannot reach the starts: {error}", Severity.WARNING)
        return
    arm_rollout = followed(scenario, task)
    session.step("grid of starts", starts=grid.starts, arm_rollout=arm_rollout)
    reasons = (
        (grid.num_blocked, "at or inside an obstacle, or the arm is there"),
        (grid.num_far, "where the hand cannot be"),
    )
    left_out = [f"{num} {why}" for num, why in reasons if num]
    if left_out:
        session.say(f"places of the grid left out: {', '.join(left_out)}", Severity.WARNING)


def remove_start(session: Session) -> None:
    """Remove the start that the arm follows, or else the newest."""
    starts, num = session.scenario.starts, len(session.task.starts)
    if starts:
        arm_rollout = followed(session.scenario, session.task)
        index = len(starts) - 1
        if arm_rollout >= num:
            index, arm_rollout = arm_rollout - num, 0
        session.step("remove start", starts=(*starts[:index], *starts[index + 1 :]), arm_rollout=arm_rollout)


def clear_starts(session: Session) -> None:
    """Remove all added starts."""
    place = followed(session.scenario, session.task)
    session.step("clear starts", starts=(), arm_rollout=place if place < len(session.task.starts) else 0)


def _named(label: float, labels: Sequence[float]) -> str:
    """The name of a label, which tells the first demonstrations that have it, up to three."""
    numbers = [str(k + 1) for k, other in enumerate(labels) if other == label]
    more = " …" if len(numbers) > 3 else ""
    return f"{label:g}".replace("-", "−") + f": as {', '.join(numbers[:3])}{more}"
