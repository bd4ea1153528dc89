"""The button "Draw your own", and how takes are taught: drawn on the board, or by guiding the hand."""

from __future__ import annotations

import html
from collections.abc import Mapping
from functools import partial

import viser

from dt_viz.scenario.slices import Slice
from dt_viz.session.teaching import Stroke
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.pen import Kind, Pen
from dt_viz.ui.tabs.opening import OpenPanel
from dt_viz.ui.tabs.plots import small
from dt_viz.warning import Severity

KINDS: Mapping[str, Kind] = {"Draw": "draw", "Guide the hand": "guide"}
"""Ways of teaching, by the name of their button."""
NAMES: Mapping[Kind, str] = {"draw": "drawn", "guide": "guided"}
"""Begin of the names of takes."""
TOLD: Mapping[Kind, str] = {
    "draw": "Press on the board, draw, let go: that is a take. Make two or three that end at one place, then Learn. "
    "Escape leaves.",
    "guide": "Drag the violet ball, turn the view, drag on. “Take done” ends a take. Make two or three that end at one "
    "place, then Learn. Escape leaves.",
}
"""What is to be done, by the way of teaching."""


class TeachPanel:
    """Controls of teaching at the top of the folder "Your data", which takes what was taught."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, opening: OpenPanel, pen: Pen) -> None:
        """Build the controls where the panel is being built."""
        self._bindings, self._opening, self._pen = bindings, opening, pen
        hint = "demonstrations of your own: drawn on a board before the arm, or by guiding its hand"
        begin = gui.add_button("Draw your own", icon=viser.Icon.PENCIL, hint=hint, order=opening.upload.order + 0.5)
        with opening.folder:
            first = opening.table.order - 1
            ways = gui.add_button_group("Teach", tuple(KINDS), hint="adds takes", order=first)
            self._told = gui.add_html("", order=first + 0.2)
            self._done = gui.add_button(
                "Take done", icon=viser.Icon.CHECK, visible=False, hint="ends and keeps it", order=first + 0.5
            )
        opening.control(begin, lambda _pressed: self._begin("draw"))
        opening.control(ways, lambda name: self._begin(KINDS[name]))
        opening.control(self._done, lambda _pressed: pen.finish())
        bindings.show(lambda s: s.arm, lambda _arm: pen.put_down())

    def _begin(self, kind: Kind) -> None:
        self._opening.teach()
        self._done.visible, self._told.content = kind == "guide", small(html.escape(TOLD[kind]))
        self._pen.take_up(kind, partial(self._finished, NAMES[kind]))
        self._bindings.session.say(TOLD[kind], Severity.NOTE)

    def _finished(self, name: str, stroke: Stroke, board: Slice | None) -> None:
        self._opening.later(partial(self._opening.add, name, stroke, board))
