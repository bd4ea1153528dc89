"""The tab "World": obstacles, transforms that are added, and added starts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import viser

from dt_viz.avoidance import registry
from dt_viz.avoidance.transform import Transform
from dt_viz.motion.following import room_at_rest
from dt_viz.obstacles.shapes import SHAPES, Box, Length, Obstacle, as_point, primitives
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.scenario.scenario import MAX_MARGIN, MAX_OBSTACLES, Scenario
from dt_viz.scenario.stack import added, selected, surroundings, with_added, with_avoidance, without
from dt_viz.scenario.starts import followed, label_of, with_grid, with_label
from dt_viz.scenario.tasks import Task
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings
from dt_viz.ui.tabs.from_file import FileLoader, has_room
from dt_viz.ui.tabs.settings import add_settings, settings_of_purpose
from dt_viz.warning import Severity

NONE: str = "none"
NO_TRANSFORM = "–"
NEAREST = "nearest"
LABEL_HINT = (
    "which of the patterns that the demonstrations show is followed, where they differ although they begin at one "
    "place: of new starts, and of an added start that the arm follows. Numbers are those of demonstrations with that "
    "pattern, as in Follows rollout. nearest: that of the nearest demonstration"
)


def add_length(gui: viser.GuiApi, bindings: Bindings, which: Length) -> None:
    """Build the slider [cm] of a length where the panel is being built; it is shown for the shapes that have it."""

    def has(obstacle: Obstacle | None) -> bool:
        return obstacle is not None and which in obstacle.lengths

    def shown(scenario: Scenario) -> float:
        chosen = _selected(scenario)
        return round(100 * chosen.length(which), 3) if chosen is not None and has(chosen) else KEEP

    def changed(scenario: Scenario, value: float) -> dict[str, Any]:
        chosen, index, before = _selected(scenario), scenario.selected or 0, scenario.obstacles
        if chosen is None or not has(chosen):
            return {}
        obstacles = (*before[:index], chosen.with_length(which, value / 100), *before[index + 1 :])
        return {"stack": with_avoidance(scenario, obstacles=obstacles)}

    low, high = 100 * which.low, 100 * which.high
    slider = gui.add_slider(f"{which.label} [cm]", low, high, 0.5, low, hint=which.hint)
    bindings.input(slider, shown, changed, visible=lambda s: has(_selected(s)))


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
        shapes = offered()
        group = gui.add_button_group("Add", tuple(shapes), hint=f"up to {MAX_OBSTACLES}, where there is room")
        # groups of buttons cannot be disabled
        bindings.later(group, lambda session, name: add(session, shapes[name]), visible=has_room)
        changes = {"Duplicate": duplicate, "Delete": delete}
        change = gui.add_button_group("Change", tuple(changes), hint="the selected obstacle")
        bindings.later(change, lambda session, name: changes[name](session), visible=lambda s: bool(s.obstacles))
        for which in dict.fromkeys(which for shape in SHAPES for which in shape.lengths):
            add_length(gui, bindings, which)
        hint = "clearance that the automatic flow time keeps"
        bindings.input(
            gui.add_slider("Margin [cm]", 0.0, 100 * MAX_MARGIN, 0.1, 1.0, hint=hint),
            lambda s: round(100 * s.avoidance.margin, 3),
            lambda s, value: {"stack": with_avoidance(s, margin=value / 100)},
        )
        return FileLoader(gui, bindings, add)


def offered() -> dict[str, Obstacle]:
    """Return the shapes that can be added, by the name of their button."""
    return {name: of.of_extents(size) for of in primitives().values() for name, size in of.offered.items()}


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
