"""Controls of the transforms that are added: which there are, and what each is for."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import viser

from dt_viz.engine.frame import Frame
from dt_viz.engine.session import Session
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import added, selected, surroundings, with_added, without
from dt_viz.transforms import registry
from dt_viz.transforms.base import Setting, Transform
from dt_viz.ui.chores import Later
from dt_viz.ui.controls import Control
from dt_viz.ui.panel.settings import Bind, Settings
from dt_viz.ui.panel.transform_settings import chosen_values, own

NONE = "–"
DELETE = "Delete"


class TransformsPanel:
    """Adds and deletes transforms, and changes the selected one."""

    def __init__(self, gui: viser.GuiApi, bind: Bind, later: Later) -> None:
        """Build the controls, which do their work `later`; they act once `connect` has given them a session."""
        self._session: Session | None = None
        kinds = addable()
        with gui.add_folder("Transforms"):
            hints = "; ".join(f"{title}: {kind.hint}" for title, kind in kinds.items() if kind.hint)
            self._add = gui.add_button_group("Add", tuple(kinds), hint=hints)
            self._delete = gui.add_button_group("Change", (DELETE,), visible=False, hint="the selected one")
            self._which = bind(
                gui.add_dropdown("Selected", (NONE,), visible=False),
                lambda s: selected(s) or NONE,
                lambda s, value: {"view": replace(s.view, bias=value)},
            ).handle
            self._settings = Settings(gui, bind, _own_settings, selected)
        Control(self._add, lambda title: later(partial(self.add, kinds[title])))
        Control(self._delete, lambda _delete: later(self.delete))

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        self._session = session

    def add(self, kind: type[Transform]) -> None:
        """Add one of a kind beside the middle of the motion, selected."""
        session = self._session
        if session is not None and kind.title in _offered(session.scenario):
            scenario = session.scenario
            stack, name = with_added(scenario, kind.beside(surroundings(session.task, scenario)))
            session.edit("add", stack=stack, view=replace(scenario.view, bias=name))
            session.end_gesture()

    def delete(self) -> None:
        """Delete the selected one."""
        session = self._session
        name = None if session is None else selected(session.scenario)
        if session is not None and name is not None:
            session.edit("delete", stack=without(session.scenario, name))
            session.end_gesture()

    def adopt(self, scenario: Scenario) -> None:
        """Offer what the scenario has; the values themselves are those of bound controls."""
        names, offered = tuple(added(scenario)), _offered(scenario)
        if offered and self._add.options != offered:
            self._add.options = offered
        self._add.visible, self._delete.visible = bool(offered), bool(names)
        if self._which.options != (names or (NONE,)):
            self._which.options = names or (NONE,)
        self._which.visible = len(names) > 1
        self._settings.adopt(scenario)

    def report(self, frame: Frame) -> None:
        """Show what was chosen automatically for the selected one, to go on from by hand."""
        self._settings.report(chosen_values(frame))


def addable() -> dict[str, type[Transform]]:
    """Kinds of transforms that are added, by the name of their button."""
    return {kind.title: kind for kind in registry.KINDS if kind.most > 1}


def _offered(scenario: Scenario) -> tuple[str, ...]:
    """Titles of the kinds of which there may be one more."""
    present = [type(transform).title for transform in added(scenario).values()]
    return tuple(title for title, kind in addable().items() if present.count(title) < kind.most)


def _own_settings(kind: type[Transform]) -> tuple[Setting, ...]:
    """Settings of an added kind that are about what it is for."""
    return tuple(setting for setting in kind.settings if own(setting)) if kind.most > 1 else ()
