"""Control of what avoids the obstacles: nothing, the hand's path, or the whole arm."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import viser

from dt_viz.engine.session import Session
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoidance_layer, avoiding_with
from dt_viz.transforms.avoidance import Space
from dt_viz.ui.panel.bindings import Bindings
from dt_viz.warning import Kind

OFF = "Off"
SPACES: Mapping[str, Space] = {"Hand": "task", "Arm": "cspace"}
"""Spaces of the avoidance, by their names on the page."""
HINT = "Hand: its path gives way, the arm follows. Arm: the joints keep the whole arm clear."
GESTURE = "Avoid"


class AvoidPanel:
    """The dropdown "Avoid", and a button that has the whole arm avoid where a part of it would enter an obstacle."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build the dropdown.

        Args:
            gui: controls of the visitor.
            bindings: bindings of the visitor's panel.
        """
        self._gui, self._bindings = gui, bindings
        bindings.input(gui.add_dropdown(GESTURE, (OFF, *SPACES), hint=HINT), avoids_with, _changed)

    def add_remedy(self) -> None:
        """Add the button; it shows while the frame has a warning that it mends."""
        button = self._gui.add_button("Let the whole arm avoid", icon=viser.Icon.SHIELD_CHECK, visible=False)
        self._bindings.properties(button, visible=self._mends)
        self._bindings.on(button, _let_arm_avoid)

    def _mends(self, scenario: Scenario) -> bool:
        frame = self._bindings.frame
        if frame is None or not frame.scenario.moves_like(scenario):
            return False
        enters = any(warning.kind is Kind.ARM_ENTERS for warning in frame.certificates.warnings)
        return enters and scenario.avoids and scenario.arm_avoidance is None and scenario.view.arm


def avoids_with(scenario: Scenario) -> str:
    """Name of what avoids the page's obstacles."""
    layer = avoidance_layer(scenario)
    return ("Hand" if scenario.arm_avoidance is None else "Arm") if layer.on else OFF


def _changed(scenario: Scenario, name: str) -> dict[str, Any]:
    return {"stack": avoiding_with(scenario, SPACES.get(name))}


def _let_arm_avoid(session: Session, _pressed: Any) -> None:  # noqa: ANN401 - a button has no value
    session.edit(GESTURE, **_changed(session.scenario, "Arm"))
