"""Commands of the palette that Ctrl-K opens, most of them with a key of their own."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import viser

from dt_viz.session.session import Session
from dt_viz.ui.panel.bindings import Bindings

MAX_DIGIT = 9
PAGES = {"pageup": "Page Up", "pagedown": "Page Down"}
"""Names of keys of more than one word."""
SHIFT: Literal["shift"] = "shift"


@dataclass(frozen=True)
class Command:
    """A command with its name in the palette."""

    label: str
    act: Callable[[Session], None]
    """Does it; it must only submit."""
    key: str = ""
    """Key on which it is done; empty for none. A capital letter, a digit, or a name of viser's, such as "space"."""
    shifted: bool = False
    """Whether Shift is held with the key."""

    @property
    def keys(self) -> str:
        """The key as a person reads it."""
        return f"Shift {self.key}" if self.shifted else PAGES.get(self.key, self.key.capitalize())


def numbered(titles: Sequence[str], choose: Callable[[Session, str], None]) -> list[Command]:
    """Return a command for each title, the first nine on the digits."""
    return [
        Command(title, lambda session, title=title: choose(session, title), str(k) if k <= MAX_DIGIT else "")
        for k, title in enumerate(titles, 1)
    ]


def add_commands(gui: viser.GuiApi, bindings: Bindings, commands: Sequence[Command]) -> None:
    """Add commands to the palette of a page; they act on the session of the bindings."""
    for command in commands:
        handle = gui.add_command(
            command.label,
            hotkey=cast(Literal["R"], command.key) if command.key else None,  # viser's own type lists all keys
            modifier=SHIFT if command.shifted else None,
        )
        bindings.on_command(handle, command.act)


class Curtain:
    """The panel, folded to its title bar or not. A visitor may unfold it by hand, which nobody is told of."""

    def __init__(self, gui: viser.GuiApi) -> None:
        self._panel, self._drawn = gui.main_panel, False

    def pull(self) -> None:
        """Fold the panel, or unfold it again."""
        self._drawn = not self._drawn
        if self._drawn:
            self._panel.minimize()
        else:
            self._panel.expand()
