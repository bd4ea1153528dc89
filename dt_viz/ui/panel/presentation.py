"""The presentation: the scene alone, with its title and caption in large type, and buttons to the next one."""

from __future__ import annotations

import html
from collections.abc import Callable

import viser

from dt_viz.ui.controls import Control
from dt_viz.ui.panel.commands import Command

BACK, ON, END = "Previous", "Next", "End"
STYLE = """<style>
.mantine-Paper-root:has(.dt-caption) { visibility: hidden; }
.dt-caption, div:has(> .dt-caption) + div { visibility: visible; position: fixed; bottom: 0; box-sizing: border-box; }
.dt-caption {
    left: 0; right: 0; padding: 2.2em 13em 1.2em 2.4em; pointer-events: none; color: var(--mantine-color-text);
    background: linear-gradient(to top, var(--mantine-color-body) 35%, transparent);
}
.dt-caption h1 { margin: 0; font-size: clamp(1.5rem, 3.2vw, 4rem); line-height: 1.2; font-weight: 650; }
.dt-caption p { margin: 0.2em 0 0; font-size: clamp(1rem, 1.7vw, 2.2rem); line-height: 1.3; }
div:has(> .dt-caption) + div { right: 1em; width: 11.5em; padding: 0 0 1em; }
div:has(> .dt-caption) + div label { display: none; }
div:has(> .dt-caption) + div > div > :first-child { display: none; }
@media (max-width: 700px) { .dt-caption { padding: 1.6em 1.2em 3.4em; } }
</style>"""
"""Style that hides the panel around the caption, and puts that and the buttons after it at the foot of the window."""


class Presentation:
    """Title and caption of what is shown, in place of the panel while it is on."""

    def __init__(self, gui: viser.GuiApi, turn: Callable[[int], None], present: Callable[[bool], None]) -> None:
        """Build its controls where the panel is being built, hidden.

        Args:
            gui: controls of the visitor.
            turn: goes so many scenes on, or back; must only submit.
            present: called when the presentation begins, and when it ends.
        """
        self._panel, self._turn, self._present = gui.main_panel, turn, present
        self._title = self._caption = ""
        self._html = gui.add_html("", visible=False)
        self._buttons = gui.add_button_group("Presentation", (BACK, ON, END), visible=False)
        Control(self._buttons, self._press)

    @property
    def on(self) -> bool:
        """Whether the panel is hidden, and the caption shown."""
        return self._html.visible

    @on.setter
    def on(self, on: bool) -> None:
        if on != self.on:
            if on:
                self._panel.expand()  # what is folded away has no caption either
            self._html.visible = self._buttons.visible = on
            self._present(on)

    @property
    def commands(self) -> list[Command]:
        """Begin and end it; the scenes can be turned with the panel, too."""
        return [
            Command("Presentation: the scene without the panel, or with it", lambda _: self._toggle(), "P"),
            Command("End the presentation", lambda _: self._press(END), "escape"),
            Command("Next scene", lambda _: self._turn(1), "pagedown"),
            Command("Previous scene", lambda _: self._turn(-1), "pageup"),
        ]

    def entitle(self, title: str) -> None:
        """Take the title of what is shown."""
        self._title = title
        self._write()

    def caption(self, text: str) -> None:
        """Take the line that says what to see."""
        self._caption = text
        self._write()

    def _write(self) -> None:
        title, caption = html.escape(self._title), html.escape(self._caption)
        self._html.content = f"{STYLE}<div class='dt-caption'><h1>{title}</h1><p>{caption}</p></div>"

    def begin(self) -> None:
        """Begin it."""
        self.on = True

    def _toggle(self) -> None:
        self.on = not self.on

    def _press(self, button: str) -> None:
        if button == END:
            self.on = False
        else:
            self._turn(1 if button == ON else -1)
