"""Controls of what the scene is looked at with: views of the camera, orbit and lock, theme and size of type."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import viser

from dt_viz.ui.controls import Control, switch
from dt_viz.ui.panel.commands import Command
from dt_viz.ui.scene.camera import HAND, HOME, VIEWS, CameraController

ORBIT_HINT = "turns slowly around what is shown; where you move the camera, it goes on from there"
DARK_HINT = "for a dark room; pictures that are saved stay light"
BIG_HINT = "larger type and controls in a wider panel, to be read from afar"
LOCK_HINT = "no drag, wheel or key moves the camera; its views, the orbit and another scene do"

ROW = (
    "<style>div:has(> .dt-row) + div > div > :first-child { width: auto !important; }</style><div class='dt-row'></div>"
)
"""Mark and style of a group of buttons that needs the room beside its label to lie in one row."""


class CameraControls:
    """The controls of one visitor's camera, theme and size of type, and the same as commands."""

    def __init__(
        self,
        gui: viser.GuiApi,
        tripod: CameraController,
        darken: Callable[[bool], None],
        enlarge: Callable[[bool], None],
    ) -> None:
        """Build the controls where the panel is being built.

        Args:
            gui: controls of the visitor.
            tripod: stand of the visitor's camera.
            darken: takes whether the theme is the dark one.
            enlarge: takes whether the type is large.
        """
        self._tripod = tripod
        gui.add_html(ROW)
        Control(gui.add_button_group("View", (*VIEWS, HAND, HOME)), tripod.view)
        self._orbit = Control(gui.add_checkbox("Orbit", False, hint=ORBIT_HINT), partial(setattr, tripod, "orbits"))
        self._lock = Control(gui.add_checkbox("Lock camera", False, hint=LOCK_HINT), partial(setattr, tripod, "locked"))
        self._dark = Control(gui.add_checkbox("Dark theme", False, hint=DARK_HINT), darken)
        self._big = Control(gui.add_checkbox("Big type", False, hint=BIG_HINT), enlarge)

    @property
    def commands(self) -> list[Command]:
        """What the controls do; Home, which frames all again, comes first."""
        views = [Command(f"View: {name}", lambda _, name=name: self._tripod.view(name)) for name in (*VIEWS, HAND)]
        return [
            Command("Frame: move the camera back", lambda _: self._tripod.view(), "F"),
            *views,
            Command("Orbit: turn the camera slowly, or stop", lambda _: switch(self._orbit), "O"),
            Command("Lock the camera, or let it go", lambda _: switch(self._lock), "L"),
            Command("Theme: dark, or light", lambda _: switch(self._dark), "T"),
            Command("Big type for a projector, or the usual one", lambda _: switch(self._big), "B"),
        ]
