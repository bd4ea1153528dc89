"""Controls of the slice: where it lies and what its colour shows."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import viser

from dt_viz.engine.frame import Frame
from dt_viz.engine.session import Session
from dt_viz.scenario.scenario import SLICE_COLOURS, Scenario
from dt_viz.ui.controls import on_press
from dt_viz.ui.scene.legend import OCCUPANCY, Legend, legend_of

COLOUR_LABELS: Mapping[str, str] = {
    "none": "None",
    "det": "det J",
    "lyapunov": "Lyapunov value",
    "occupancy": "Learned occupancy",
}
assert set(COLOUR_LABELS) == set(SLICE_COLOURS)
WHOLE_ARM_NOTE = "The slice shows the stack of the hand's path; what the whole arm avoids with is not in it."
_SMALL = "font-size:0.8em;line-height:1.4;padding:0.1em 0.9em 0.4em;opacity:0.85"


class SlicePanel:
    """What the user chooses for the slice."""

    def __init__(self, gui: viser.GuiApi, bind: Callable[..., Any]) -> None:
        """Build the controls; `bind` ties one to the scenario, see `Panel`."""
        self._session: Session | None = None
        self._colour = "none"
        bind(
            gui.add_checkbox(
                "Move the slice", False, hint="handles that move and tilt the plane of arrows and colours"
            ),
            lambda s: s.view.move_slice,
            lambda s, value: {"view": replace(s.view, move_slice=value)},
        )
        self.back = gui.add_button("Back to the task's slice", visible=False)

        on_press(self.back, self._put_back)

        bind(
            gui.add_dropdown("Colour", tuple(COLOUR_LABELS.values()), hint="of the slice"),
            lambda s: COLOUR_LABELS[s.view.colour],
            lambda s, value: {
                "view": replace(s.view, colour=next(name for name, label in COLOUR_LABELS.items() if label == value))
            },
        )
        self.legend: Legend | None = None
        """Of the colours that are shown."""
        self.key = gui.add_html("", visible=False)
        self.note = gui.add_html(f"<div style='{_SMALL}'>{WHOLE_ARM_NOTE}</div>", visible=False)

    def connect(self, session: Session) -> None:
        """Let the controls edit this session."""
        self._session = session

    def _put_back(self) -> None:
        if self._session is not None:
            self._session.edit("slice", view=replace(self._session.scenario.view, slice=None))
            self._session.end_gesture()

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's choices."""
        view = scenario.view
        self._colour = view.colour
        self.back.visible = view.slice is not None
        shown = view.colour != "none" or view.field or view.streamlines or view.grid
        self.note.visible = shown and scenario.arm_avoidance is not None and bool(scenario.obstacles)
        if view.colour in {"none", "occupancy"}:
            self._explain(OCCUPANCY if view.colour == "occupancy" else None)

    def report(self, frame: Frame) -> None:
        """Show the legend of the colours that are shown."""
        picture = frame.pictures.colour
        if picture is not None and picture.what == self._colour:  # or another was chosen meanwhile
            self._explain(legend_of(picture))

    def _explain(self, legend: Legend | None) -> None:
        self.legend = legend
        text = legend.html if legend else ""
        if self.key.content != text:
            self.key.content, self.key.visible = text, bool(text)
