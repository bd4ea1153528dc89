"""Controls that add, select and delete transforms, and those of the selected one's own settings."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import viser

from dt_viz.avoidance import registry
from dt_viz.avoidance.transform import Setting, Transform
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import added, selected, surroundings, with_added, without
from dt_viz.session.session import Session
from dt_viz.ui.chores import Later
from dt_viz.ui.panel.bindings import KEEP, Bindings
from dt_viz.ui.panel.settings import add_settings
from dt_viz.ui.panel.transform_settings import own

NONE = "–"
DELETE = "Delete"


def add_transform_controls(gui: viser.GuiApi, bindings: Bindings, later: Later) -> None:
    """Build the folder "Transforms": adds and deletes transforms, and changes the selected one."""
    kinds = addable()
    with gui.add_folder("Transforms"):
        hints = "; ".join(f"{title}: {kind.hint}" for title, kind in kinds.items() if kind.hint)
        buttons = gui.add_button_group("Add", tuple(kinds), hint=hints)
        bindings.properties(buttons, options=lambda s: _offered(s) or KEEP, visible=lambda s: bool(_offered(s)))
        bindings.on(buttons, lambda session, title: later(partial(add, session, kinds[title])))
        buttons = gui.add_button_group("Change", (DELETE,), visible=False, hint="the selected transform")
        bindings.properties(buttons, visible=lambda s: bool(added(s)))
        bindings.on(buttons, lambda session, _delete: later(partial(delete, session)))
        which = gui.add_dropdown("Selected", (NONE,), visible=False)
        bindings.properties(which, options=lambda s: tuple(added(s)) or (NONE,), visible=lambda s: len(added(s)) > 1)
        bindings.input(which, lambda s: selected(s) or NONE, lambda s, value: {"view": replace(s.view, bias=value)})
        hint = "arrows that move it along axes, and a ring around its region; a click on it shows and hides them"
        handles = gui.add_checkbox("Handles", False, hint=hint, visible=False)
        bindings.properties(handles, visible=lambda s: bool(added(s)))
        bindings.input(handles, lambda s: s.view.bias_handles, lambda s, on: {"view": replace(s.view, bias_handles=on)})
        add_settings(gui, bindings, _own_settings, selected)


def add(session: Session, kind: type[Transform]) -> None:
    """Add a transform of a kind beside the middle of the motion, and select it."""
    scenario = session.scenario
    if kind.title in _offered(scenario):
        stack, name = with_added(scenario, kind.beside(surroundings(session.task, scenario)))
        session.edit("add", stack=stack, view=replace(scenario.view, bias=name))
        session.end_gesture()


def delete(session: Session) -> None:
    """Delete the selected transform."""
    name = selected(session.scenario)
    if name is not None:
        session.edit("delete", stack=without(session.scenario, name))
        session.end_gesture()


def addable() -> dict[str, type[Transform]]:
    """Return the kinds of transforms that are added, by the name of their button."""
    return {kind.title: kind for kind in registry.KINDS if kind.most > 1}


def _offered(scenario: Scenario) -> tuple[str, ...]:
    """Return the titles of the kinds of which there may be one more."""
    present = [type(transform).title for transform in added(scenario).values()]
    return tuple(title for title, kind in addable().items() if present.count(title) < kind.most)


def _own_settings(kind: type[Transform]) -> tuple[Setting, ...]:
    """Return the settings of an added kind that are about what it is for."""
    return tuple(setting for setting in kind.settings if own(setting)) if kind.most > 1 else ()
