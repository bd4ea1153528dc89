"""Controls of the two transforms of the method: what avoids the obstacles, and whether motions are learned ones."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import viser

from dt_viz.avoidance.avoidance import Space
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoidance_layer, avoiding_with
from dt_viz.ui.panel.bindings import Bindings

OFF = "Off"
SPACES: Mapping[str, Space] = {"Hand": "task", "Arm": "cspace"}
"""Spaces of the avoidance, by their names on the page."""
HINT = "what gives way to the obstacles. Hand: the path of the hand, and the arm follows it. Arm: the whole arm"
IMITATE_HINT = "off: without what was learned, every motion is straight to the goal, and still avoids"


def add_avoid_and_imitate(gui: viser.GuiApi, bindings: Bindings) -> None:
    """Build the dropdown "Avoid" and the checkbox "Imitate" where the panel is being built."""
    bindings.input(gui.add_dropdown("Avoid", (OFF, *SPACES), hint=HINT), avoids_with, _changed)
    bindings.input(
        gui.add_checkbox("Imitate", True, hint=IMITATE_HINT),
        lambda s: s.imitation,
        lambda _s, value: {"imitation": value},
    )


def avoids_with(scenario: Scenario) -> str:
    """Name of what avoids the page's obstacles."""
    layer = avoidance_layer(scenario)
    return ("Hand" if scenario.arm_avoidance is None else "Arm") if layer.on else OFF


def _changed(scenario: Scenario, name: str) -> dict[str, Any]:
    return {"stack": avoiding_with(scenario, SPACES.get(name))}
