"""Controls of the bias points."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import viser

from dt_viz.engine.frame import Frame
from dt_viz.engine.session import Session
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import (
    MAX_BIAS_POINTS,
    bias_points,
    place_beside,
    with_bias_point,
    with_changed_point,
    without,
)
from dt_viz.transforms.bias import BiasPoint
from dt_viz.ui.controls import Control
from dt_viz.ui.panel.transform_settings import Bind
from dt_viz.ui.scene.bias import selected_point

MIN_RADIUS, MAX_RADIUS = 4.0, 40.0
"""Of a region, centimetres."""
NONE = "–"


class BiasPanel:
    """Adds and deletes bias points, and changes the selected one."""

    def __init__(self, gui: viser.GuiApi, bind: Bind) -> None:
        """Build the controls; they act once `connect` has given them a session."""
        self._session: Session | None = None
        self._adopted: Scenario | None = None
        with gui.add_folder("Bias points"):
            self._buttons = gui.add_button_group("Bias point", ("Add",))
            self._which = bind(
                gui.add_dropdown("Selected", (NONE,), visible=False),
                lambda s: selected_point(s) or NONE,
                lambda s, value: {"view": replace(s.view, bias=value)},
            )
            radius_is_auto = bind(
                gui.add_checkbox("Radius: auto", True, visible=False, hint="by how far the motion is away"),
                lambda s: _selected(s).radius is None,
                lambda s, value: _changed(s, radius=None if value else self._radius.value / 100),
            )
            self._radius = bind(
                gui.add_slider(
                    "Radius [cm]",
                    MIN_RADIUS,
                    MAX_RADIUS,
                    0.5,
                    15.0,
                    visible=False,
                    hint="of the region that it acts in",
                ),
                lambda s: self._radius.value if (r := _selected(s).radius) is None else round(100 * r, 1),
                lambda s, value: {} if _selected(s).radius is None else _changed(s, radius=value / 100),
            )
            moves_goal = bind(
                gui.add_checkbox(
                    "Moves the goal", False, visible=False, hint="motions end here instead of at the goal"
                ),
                lambda s: _selected(s).moves_goal,
                lambda s, value: _changed(s, moves_goal=value),
            )
        self._settings = (self._which, radius_is_auto, self._radius, moves_goal)

        Control(self._buttons, lambda name: {"Add": self.add, "Delete": self.delete}[name]())

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        self._session = session

    def add(self) -> None:
        """One more beside the middle of the motion, selected."""
        session = self._session
        if session is None:
            return
        scenario = session.scenario
        points = bias_points(scenario.layers)
        if len(points) < MAX_BIAS_POINTS:
            layers = with_bias_point(scenario.layers, place_beside(session.task, scenario))
            session.edit("add", layers=layers, view=replace(scenario.view, bias=layers[-1].name))
            session.end_gesture()

    def delete(self) -> None:
        """The selected one."""
        session = self._session
        name = None if session is None else selected_point(session.scenario)
        if session is not None and name is not None:
            session.edit("delete", **without(session.scenario, name))
            session.end_gesture()

    def adopt(self, scenario: Scenario) -> None:
        """Offer what the scenario has; the values themselves are those of bound controls."""
        self._adopted = scenario
        names = tuple(bias_points(scenario.layers))
        buttons = ("Add",) * (len(names) < MAX_BIAS_POINTS) + ("Delete",) * bool(names)
        if self._buttons.options != buttons:
            self._buttons.options = buttons
        if self._which.handle.options != (names or (NONE,)):
            self._which.handle.options = names or (NONE,)
        point = _selected(scenario)
        for control in self._settings:
            shown = bool(names) and (control is not self._which or len(names) > 1)
            if control.handle.visible != shown:
                control.handle.visible = shown
        self._radius.handle.disabled = point.radius is None

    def report(self, frame: Frame) -> None:
        """Show what `auto` chose for the selected one, to go on from by hand."""
        if self._adopted is None:
            return
        name, point = selected_point(self._adopted), _selected(self._adopted)
        for layer, radius in zip(frame.scenario.layers, frame.layer_radii, strict=False):
            if layer.name == name and point.radius is None and radius is not None:
                self._radius.value = round(100 * min(max(radius, MIN_RADIUS / 100), MAX_RADIUS / 100), 1)


def _selected(scenario: Scenario) -> BiasPoint:
    """The selected bias point; one that is nowhere if there is none."""
    name = selected_point(scenario)
    return BiasPoint((0.0, 0.0, 0.0)) if name is None else bias_points(scenario.layers)[name]


def _changed(scenario: Scenario, **changes: Any) -> dict[str, Any]:  # noqa: ANN401 - the fields of BiasPoint
    name = selected_point(scenario)
    if name is None:
        return {}
    return {"layers": with_changed_point(scenario.layers, name, replace(_selected(scenario), **changes))}
