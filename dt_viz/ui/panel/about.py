"""The foot of the panel: the paper, what the colours mean, and the keys."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence

import viser

from dt_viz.ui.panel.commands import MAX_DIGIT, Command
from dt_viz.ui.panel.status import SMALL
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.palette import Colour

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


def add_about(gui: viser.GuiApi, commands: Sequence[Command]) -> None:
    """Build the folder "About" where the panel is being built, closed."""
    with gui.add_folder("About: paper, colours, keys", expand_by_default=False):
        gui.add_html(paper_html() + legend_html() + keys_html(commands))


def paper_html() -> str:
    """Return title, authors and venue of the paper, with a link."""
    return (
        f"<div style='{SMALL}'><a href='{LINK}' target='_blank' rel='noopener noreferrer' style='font-weight:600'>"
        f"{TITLE}</a><br/>{AUTHORS}<br/>{VENUE}</div>"
    )


def legend_html() -> str:
    """Return the legend of what is drawn in the scene."""
    mark = "display:inline-block;width:0.9em;height:0.9em;border-radius:50%;vertical-align:-0.1em;margin-right:0.5em;"
    return f"<div style='{SMALL}'>{''.join(_entry(mark, text, colour) for text, colour in LEGEND.items())}</div>"


def _entry(mark: str, text: str, colour: Colour) -> str:
    return f"<div><span style='{mark}background:{palette.css(colour)}'></span>{html.escape(text)}</div>"


def keys_html(commands: Sequence[Command]) -> str:
    """Return the keys of the commands; the scenes on the digits are one line."""
    keys = {command.keys: command.label for command in commands if command.key and not command.key.isdecimal()}
    keys |= {f"1 – {MAX_DIGIT}": "scenes, in their order", "Ctrl K": "all commands by name"}
    rows = "".join(
        f"<tr><td style='white-space:nowrap;padding-right:0.9em;font-weight:600'>{key}</td>"
        f"<td>{html.escape(text)}</td></tr>"
        for key, text in keys.items()
    )
    return f"<table style='{SMALL}'>{rows}</table>"
