"""Controls of the slice: where it lies and what its colour shows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import viser

from dt_viz.scenario.scenario import SLICE_COLOURS, Scenario, SliceColour
from dt_viz.session.session import Session
from dt_viz.ui.panel.bindings import KEEP, Bindings
from dt_viz.ui.scene.legend import OCCUPANCY, Legend, legend_of

COLOUR_LABELS: Mapping[SliceColour, str] = {
    "none": "None",
    "det": "det J",
    "lyapunov": "Lyapunov value",
    "occupancy": "Learned occupancy",
}
assert set(COLOUR_LABELS) == set(SLICE_COLOURS)
WHOLE_ARM_NOTE = "The slice shows the stack of the hand's path; what the whole arm avoids with is not in it."
_SMALL = "font-size:0.8em;line-height:1.4;padding:0.1em 0.9em 0.4em;opacity:0.85"


class SlicePanel:
    """The controls of the slice, with a legend of its colours."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        """Build the controls."""
        self._bindings = bindings
        bindings.input(
            gui.add_checkbox(
                "Move the slice",
                False,
                hint="handles that move and tilt the slice, the plane on which arrows and colours are shown",
            ),
            lambda s: s.view.move_slice,
            lambda s, value: {"view": replace(s.view, move_slice=value)},
        )
        self.back = gui.add_button("Back to the task's slice", visible=False)
        bindings.properties(self.back, visible=lambda s: s.view.slice is not None)
        bindings.on(self.back, _put_back)
        names = {label: name for name, label in COLOUR_LABELS.items()}
        bindings.input(
            gui.add_dropdown("Slice colour", tuple(names), hint="quantity shown as colour on the slice"),
            lambda s: COLOUR_LABELS[s.view.colour],
            lambda s, label: {"view": replace(s.view, colour=names[label])},
        )
        hint = (
            "of an augmented motion, whose field changes on the way: the part of it that is left, from 1 at its start "
            "to 0 at the goal, for which vector field, streamlines, grid and colours are shown"
        )
        phase = gui.add_slider("Phase", 0.0, 1.0, 0.01, 1.0, hint=hint, visible=False)
        bindings.input(phase, lambda s: s.view.phase, lambda s, value: {"view": replace(s.view, phase=value)})
        take = gui.add_button("Take the arm's phase", visible=False)
        bindings.on(take, lambda session, _pressed: session.take_phase())
        for handle in (phase, take):
            bindings.properties(
                handle,
                visible=lambda _s: bindings.frame is not None and bindings.frame.remembers,
                disabled=lambda s: not _shows_velocities(s),
            )
        self.legend: Legend | None = None
        """Legend of the colours that are shown."""
        self.key = gui.add_html("", visible=False)
        bindings.show(self._legend_of, self._explain)
        self.note = gui.add_html(f"<div style='{_SMALL}'>{WHOLE_ARM_NOTE}</div>", visible=False)
        bindings.properties(self.note, visible=_lacks_whole_arm)

    def _legend_of(self, scenario: Scenario) -> Legend | None:
        """Return the legend of the view's colours; `KEEP` until their picture is there."""
        colour, frame = scenario.view.colour, self._bindings.frame
        if colour in {"none", "occupancy"}:
            return OCCUPANCY if colour == "occupancy" else None
        picture = None if frame is None else frame.pictures.colour
        return legend_of(picture) if picture is not None and picture.what == colour else KEEP

    def _explain(self, legend: Legend | None) -> None:
        self.legend = legend
        self.key.content, self.key.visible = legend.html if legend else "", legend is not None


def _put_back(session: Session, _pressed: bool) -> None:
    session.edit("slice", view=replace(session.scenario.view, slice=None))
    session.end_gesture()


def _shows_velocities(scenario: Scenario) -> bool:
    """Whether the slice shows something of the vector field or of ψ."""
    view = scenario.view
    return view.colour != "none" or view.field or view.streamlines or view.grid


def _lacks_whole_arm(scenario: Scenario) -> bool:
    """Whether the slice shows something that the whole arm's avoidance would change."""
    return _shows_velocities(scenario) and scenario.arm_avoidance is not None and bool(scenario.obstacles)
