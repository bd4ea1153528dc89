"""The tab "Show": the slice and its colours, the plots, and what is drawn in the scene."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import viser

from dt_viz.scenario.scenario import OFFERS, SLICE_COLOURS, Scenario
from dt_viz.scenario.stack import side_by_side
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.bindings import KEEP, Bindings
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.slice_layers import OCCUPANCY, legend_in
from dt_viz.ui.tabs.plots import Plots, small
from dt_viz.ui.tabs.timeline import Timeline

WHOLE_ARM_NOTE = "The slice shows the stack of the hand's path; what the whole arm avoids with is not in it."
IN_SCENE = (
    "rollouts",
    "ghost",
    "demonstrations",
    "field",
    "streamlines",
    "arm",
    "ghost_arm",
    "onion",
    "body_points",
    "table",
    "grid",
    "panels",
    "generator",
)
"""Fields of `View` that show and hide what is drawn in the scene, in the order of their checkboxes."""


class ShowTab:
    """The controls of one visitor's tab."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, send: Callable[[str, bytes], None]) -> None:
        """Build the controls where the panel is being built; `send` gets the end of a file's name, and its content."""
        self._bindings = bindings
        self._add_slice(gui, bindings)
        self.plots = Plots(gui, bindings, send)  # high up in the tab, to be seen when it opens
        self.timeline = Timeline(gui, bindings, self.plots)
        for name in IN_SCENE:
            if name == "panels":
                box = gui.add_checkbox(OFFERS[name].label, False, hint=OFFERS[name].hint)
                bindings.view(box, "panels", bool, lambda on: side_by_side(bindings.session.scenario) if on else ())
            else:
                bindings.checkbox(gui, name)
        num_flows = lambda _s: _num_flows(bindings.frame)  # noqa: E731
        bindings.slider(gui, "generator_layer", visible=lambda s: s.view.generator, max=num_flows)

    def _add_slice(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        bindings.checkbox(gui, "move_slice")
        self.back = gui.add_button("Back to the task's slice", visible=False, hint="where it was before it was moved")
        bindings.on(self.back, _put_back, visible=lambda s: s.view.slice is not None)
        names = {label: name for name, label in SLICE_COLOURS.items()}
        colour = gui.add_dropdown(OFFERS["colour"].label, tuple(names), hint=OFFERS["colour"].hint)
        bindings.view(colour, "colour", SLICE_COLOURS.__getitem__, names.__getitem__)
        of_phase = {
            "visible": lambda _s: bindings.frame is not None and bindings.frame.remembers,
            "disabled": lambda s: not _shows_velocities(s),
        }
        bindings.slider(gui, "phase", **of_phase)
        take = gui.add_button("Take the arm's phase", visible=False, hint="at which the arm is now")
        bindings.on(take, lambda session, _pressed: session.take_phase(), **of_phase)
        self.key = gui.add_html("", visible=False)
        bindings.show(self._legend_of, self._explain)
        self.note = gui.add_html(small(WHOLE_ARM_NOTE), visible=False)
        lacks_arm = lambda s: _shows_velocities(s) and s.arm_avoidance is not None and bool(s.obstacles)  # noqa: E731
        bindings.properties(self.note, visible=lacks_arm)

    def _legend_of(self, scenario: Scenario) -> Legend | None:
        """Return the legend of the view's colours; `KEEP` until their picture is there."""
        colour, frame = scenario.view.colour, self._bindings.frame
        if colour in {"none", "occupancy"}:
            return OCCUPANCY if colour == "occupancy" else None
        return KEEP if frame is None else legend_in(frame, colour) or KEEP

    def _explain(self, legend: Legend | None) -> None:
        self.key.content, self.key.visible = legend.html if legend else "", legend is not None


def _put_back(session: Session, _pressed: bool) -> None:
    session.step("slice", view=replace(session.scenario.view, slice=None))


def _num_flows(frame: Frame | None) -> int:
    picture = None if frame is None else frame.pictures.generator
    return KEEP if picture is None else picture.num_flows


def _shows_velocities(scenario: Scenario) -> bool:
    """Whether the slice shows something of the vector field or of ψ."""
    view = scenario.view
    return view.colour != "none" or view.field or view.streamlines or view.grid
