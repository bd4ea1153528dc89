"""Settings of one transform of the stack: its flow, and what is its own."""

from __future__ import annotations

import html
from dataclasses import replace
from typing import Any

import viser

from dt_viz.avoidance.transform import Number, Setting, Switch, Transform
from dt_viz.learning.imitation import OBJECTIVES
from dt_viz.learning.state import STATES
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION, tunable, tuned
from dt_viz.scenario.tasks import STYLES
from dt_viz.session.frame import Frame
from dt_viz.ui.panel.bindings import Bindings
from dt_viz.ui.panel.settings import add_settings

NO_STYLE = "–"
_SMALL = "font-size:0.8em;line-height:1.45;padding:0.1em 0.9em 0.5em;opacity:0.85"


def add_transform_settings(gui: viser.GuiApi, bindings: Bindings, order: float) -> None:
    """Build the settings of the transform that is chosen here, or was looked at last.

    Args:
        gui: controls of the visitor, in the folder that they go into.
        bindings: bindings of the visitor's panel.
        order: order of the first of them in the folder.
    """
    which = gui.add_dropdown("Settings of", (IMITATION,), order=order, hint="the transform that is changed below")
    bindings.properties(which, options=tunable)
    bindings.input(which, tuned, lambda s, value: {"view": replace(s.view, tuned=value)})
    order += 1
    hint = "what is fitted to the demonstrations: whole motions, or velocities as in eq. (3) of the paper"
    objective = gui.add_dropdown("Objective", OBJECTIVES, order=order, hint=hint)
    bindings.input(objective, lambda s: s.objective, lambda _s, value: {"objective": value})
    hint = (
        "plain: the paper's, one field that needs no memory. augmented: remembers its phase and where it began, so "
        "that it crosses itself, comes back, and draws the figure from other starts. auto: plain, unless "
        "it misses a demonstration"
    )
    state = gui.add_dropdown("State", STATES, order=order, hint=hint)
    bindings.input(state, lambda s: s.state, lambda _s, value: {"state": value})
    hint = "how another hand draws, taken off its demonstrations of one letter and put on this one (augmented)"
    style = gui.add_dropdown("Style", (NO_STYLE, *STYLES), order=order, hint=hint)
    bindings.input(style, lambda s: s.style or NO_STYLE, _with_style)
    hint = "part of the style that is put on; below 0 it is taken off"
    amount = gui.add_slider("Amount", -1.0, 2.0, 0.05, 1.0, order=order, hint=hint)
    bindings.input(amount, lambda s: s.style_amount, lambda _s, value: {"style_amount": value})
    bindings.properties(style, visible=lambda s: _is_imitation(s) and _is_drawing(bindings.frame))
    bindings.properties(amount, visible=lambda s: _is_imitation(s) and bool(s.style))
    note = gui.add_html("", order=order)
    bindings.properties(note, content=lambda _s: learned_html(bindings.frame))
    for handle in (objective, state, note):
        bindings.properties(handle, visible=_is_imitation)
    add_settings(gui, bindings, _settings, tuned, order)


def _with_style(_scenario: Scenario, name: str) -> dict[str, Any]:
    return {"style": "" if name == NO_STYLE else name}


def _is_drawing(frame: Frame | None) -> bool:
    return frame is not None and frame.task.draws


def _is_imitation(scenario: Scenario) -> bool:
    return tuned(scenario) == IMITATION


def _settings(kind: type[Transform]) -> tuple[Setting, ...]:
    """Return the settings of a kind in the stack: those of its flow; all of one that is not added on the page."""
    return kind.settings if kind.most == 1 else tuple(setting for setting in kind.settings if not own(setting))


def own(setting: Setting) -> bool:
    """Return whether a setting is about what the transform is for, not about its flow."""
    return isinstance(setting, Switch) or (isinstance(setting, Number) and not setting.of_flow)


def learned_html(frame: Frame | None) -> str:
    """Return a note about what was learned: in which state and why, and of how many steps the flows are."""
    steps = () if frame is None else frame.learned_steps
    if frame is not None and frame.remembers:
        why = f"Chosen because {frame.reason}. " if frame.reason else ""
        text = (
            f"{why}Augmented: each motion remembers its phase and where it began, and follows what is predicted for "
            "them. Space is shifted along that prediction, not bent by flows (det J = 1): there are no steps to choose."
        )
        if frame.labels:
            text += (
                f" The demonstrations show {len(set(frame.labels))} patterns that begin at about the same place. A "
                "number, their label, tells them apart: World → Starts → Label chooses it for starts that you add."
            )
        return f"<div style='{_SMALL}'>{html.escape(text)}</div>"
    if not steps:
        return f"<div style='{_SMALL}'>Off: motions are straight.</div>"
    flows = f"{len(steps)} flows" if len(steps) > 1 else "One flow"
    text = (
        f"{flows} of {max(steps)} Euler steps, t = 1, with an exact inverse. "
        "The steps are part of what was learned: other ones would be another motion, so there is nothing to choose."
    )
    return f"<div style='{_SMALL}'>{html.escape(text)}</div>"
