"""The foot of the panel and the palette that Ctrl-K opens: the paper, what the colours mean, commands and keys."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import viser

from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import Colour
from dt_viz.ui.tabs.plots import small

TITLE = "Diffeomorphic Transforms for Generalised Imitation Learning"
AUTHORS = "Weiming Zhi, Tin Lai, Lionel Ott, Fabio Ramos"
VENUE = "Learning for Dynamics and Control (L4DC), 2022"
LINK = "https://proceedings.mlr.press/v168/zhi22a.html"
LEGEND: Mapping[str, Colour] = {
    "demonstrations": palette.LIGHT.demonstration,
    "rollouts; the bold one is the arm’s": palette.LIGHT.rollout,
    "rollouts from added starts": palette.LIGHT.added,
    "undisturbed motions": palette.LIGHT.ghost,
    "way of the robot": palette.LIGHT.way,
    "obstacles": palette.LIGHT.obstacle,
    "bias points": palette.LIGHT.bias,
    "goal": palette.LIGHT.goal,
}
"""What is drawn, with its colour."""
PAGES = {"pageup": "Page Up", "pagedown": "Page Down"}  # names of keys of more than one word
SHIFT: Literal["shift"] = "shift"


@dataclass(frozen=True)
class Command:
    """A command with its name in the palette."""

    label: str
    act: Callable[[Session], None]  # does it; it must only submit
    key: str = ""
    """Key on which it is done; empty for none. A capital letter, a digit, or a name of viser's, such as "space"."""
    shifted: bool = False  # whether Shift is held with the key

    @property
    def keys(self) -> str:
        """The key as a person reads it."""
        return f"Shift {self.key}" if self.shifted else PAGES.get(self.key, self.key.capitalize())


def numbered(titles: Sequence[str], choose: Callable[[Session, str], None]) -> list[Command]:
    """Return a command for each title, the first nine on the digits."""
    return [
        Command(title, lambda session, title=title: choose(session, title), str(k) if k <= 9 else "")
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


def add_about(
    gui: viser.GuiApi, bindings: Bindings, commands: Sequence[Command], take_tour: Callable[[Session], None]
) -> None:
    """Build the folder "About" where the panel is being built, closed; `take_tour` must only submit."""
    with gui.add_folder("About: paper, colours, keys", expand_by_default=False):
        tour = gui.add_button("Take the tour", icon=viser.Icon.ROUTE, hint="six steps; it begins anew")
        bindings.on(tour, lambda session, _pressed: take_tour(session))
        link = f"<a href='{LINK}' target='_blank' rel='noopener noreferrer' style='font-weight:600'>{TITLE}</a>"
        gui.add_html(small(f"{link}<br/>{AUTHORS}<br/>{VENUE}") + legend_html() + keys_html(commands))


def legend_html() -> str:
    """Return the legend of what is drawn in the scene."""
    return small(Legend(tuple(LEGEND.items())).html)


def keys_html(commands: Sequence[Command]) -> str:
    """Return the keys of the commands; the scenes on the digits are one line."""
    keys = {command.keys: command.label for command in commands if command.key and not command.key.isdecimal()}
    keys |= {"← →": "previous and next step of the tour", "1 – 9": "scenes, in their order"}
    keys |= {"Ctrl K": "all commands by name"}
    rows = "".join(
        f"<tr><td style='white-space:nowrap;padding-right:0.9em;font-weight:600'>{key}</td>"
        f"<td>{html.escape(text)}</td></tr>"
        for key, text in keys.items()
    )
    return small(f"<table>{rows}</table>")
