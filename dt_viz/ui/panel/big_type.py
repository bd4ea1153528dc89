"""Large type and controls for a projector."""

from __future__ import annotations

import viser

from dt_viz.ui.scene.camera import CameraController, Framing

WIDTH, SIZE = 320, 92.5
"""Width of viser's panel, CSS pixels, and size of its type, % of the browser's own."""
LARGER = 1.4
"""Factor by which the panel, its type and its controls are larger."""
STYLE = f"<style>@media (min-width: 577px) {{ :root {{ font-size: {SIZE * LARGER}%; }} }}</style>"
"""Style of it: viser measures its page in rem or em. It does nothing on a phone, whose window the panel fills."""


class BigType:
    """Size of the type of one visitor's page."""

    def __init__(self, gui: viser.GuiApi, tripod: CameraController) -> None:
        """Begin with the usual size; must be built outside tabs and folders, of which closed ones have no style."""
        self._style, self._panel, self._tripod = gui.add_html(STYLE, visible=False), gui.main_panel, tripod

    def show(self, on: bool) -> None:
        """Show large type, or the usual one, and frame the scene beside the wider panel."""
        wider = (LARGER - 1) * WIDTH if on else 0.0
        self._style.visible = on
        self._panel.set_width(WIDTH + wider)
        self._tripod.reframe(panel=Framing.panel + wider)
