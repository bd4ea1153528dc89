"""The tab "Stack": the transforms as a list, the outermost on top, how far they have run, and their settings."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import zip_longest
from typing import Any

import viser

from dt_viz.avoidance.avoidance import Avoidance
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.page import PageEntry, Setting
from dt_viz.avoidance.registry import AVOIDANCE, entry_of
from dt_viz.avoidance.transform import Transform
from dt_viz.learning.imitation import OBJECTIVES
from dt_viz.learning.state import STATES
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import BASE_PANEL
from dt_viz.scenario.stack import (
    IMITATION,
    WHOLE_ARM,
    levels,
    listed,
    place_of,
    shifted,
    switched,
    transform_of,
    tunable,
    tuned,
)
from dt_viz.scenario.tasks import STYLES
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import Colour
from dt_viz.ui.scene.rollouts import manifold
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.settings import add_settings, settings_of_purpose

BASE = "Base attractor"
ON, OFF, UP, DOWN, SHOW, SHOWN = "● on", "○ off", "↑", "↓", "show", "● shown"
WARP, PLAY = "Warp", "▶ 0 → 1"
SECONDS = 5.0  # duration of playing the warp
NO_STYLE = "–"

_COLOURS: Mapping[type[Transform], Colour] = {Avoidance: palette.LIGHT.obstacle, BiasPoint: palette.LIGHT.bias}
"""Colours of kinds of transforms in the formula; those of what is drawn of them."""


@dataclass(frozen=True)
class StackRow:
    """Row of the list: a transform with its buttons."""

    name: str
    label: str
    buttons: tuple[str, ...]


class StackPanel:
    """The stack, a row for each transform."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings) -> None:
        self._gui, self._bindings = gui, bindings
        bindings.properties(gui.add_html(""), content=formula_html)
        self._folder = gui.add_folder("Stack, the outermost on top")
        self.rows: list[Any] = []
        self._shown: tuple[StackRow, ...] = ()
        with self._folder:
            below = 1e9  # order of the controls below the rows, of which there is any number
            add_warp(gui, bindings, below)
            add_transform_settings(gui, bindings, below + 2)
        bindings.show(self._wanted, self._show)
        legend = gui.add_html("", visible=False)  # at the end: as it comes and goes it moves no controls
        bindings.properties(legend, content=legend_html, visible=lambda s: bool(legend_html(s)))

    def _wanted(self, scenario: Scenario) -> tuple[StackRow, ...]:
        frame = self._bindings.frame
        return rows(scenario, {} if frame is None else frame.durations)

    def _show(self, wanted: tuple[StackRow, ...]) -> None:
        """Reuse the rows that there are, from the top; those that are not needed are hidden."""
        self._shown = wanted
        with self._folder:
            for k in range(len(self.rows), len(wanted)):
                self.rows.append(self._gui.add_button_group(wanted[k].label, wanted[k].buttons))
                self._bindings.on(self.rows[k], partial(self._press, k))
        for handle, row in zip_longest(self.rows, wanted):
            handle.visible = row is not None
            if row is not None:
                handle.label, handle.options = row.label, row.buttons

    def _press(self, k: int, session: Session, button: str) -> None:
        if k < len(self._shown):
            press(session, self._shown[k].name, button)


def press(session: Session, name: str, button: str) -> None:
    """Do what a button of the row of this name does."""
    session.step(f"{name} {button}", **_ACTIONS[button](session.scenario, name))


def rows(scenario: Scenario, durations: Mapping[str, float]) -> tuple[StackRow, ...]:
    """Return the rows from the top down, with the durations of the last frame."""
    on = {layer.name for layer in scenario.stack if layer.on}
    seen, order, rows = levels(scenario), listed(scenario), []
    for k, name in enumerate(order):
        moves = (UP,) * (k < len(order) - 1) + (DOWN,) * (k > 0)
        look = (_look(scenario, name),) * (name in seen)
        transform = transform_of(scenario, name)
        label = _label(name, durations.get(name), "t" if transform is None else entry_of(transform).flow_time)
        rows.append(StackRow(name, label, (ON if name in on else OFF, *moves, *look)))
    place = place_of(scenario, WHOLE_ARM)
    if WHOLE_ARM in tunable(scenario) and place is not None:
        label = _label(WHOLE_ARM, durations.get(WHOLE_ARM))
        rows.append(StackRow(WHOLE_ARM, label, (ON if scenario.stack[place].on else OFF,)))
    imitation = StackRow(IMITATION, IMITATION, (ON if scenario.imitation else OFF, _look(scenario, IMITATION)))
    base = StackRow(BASE, BASE, (SHOWN if BASE_PANEL in scenario.view.panels else SHOW,))
    return (*reversed(rows), imitation, base)


def legend_html(scenario: Scenario) -> str:
    """Return a legend of the selected level's lines; empty if none is selected."""
    if scenario.view.level not in levels(scenario):
        return ""
    shown = "without what is stacked on it: rollouts, and all that lies on the slice"
    text = f"{manifold(scenario)}, {shown}. Pale: rollouts of the whole stack"
    return small(Legend(((text, palette.LIGHT.level),)).html)


def formula_html(scenario: Scenario) -> str:
    """Return how a place of the base attractor follows from one of the motion, with the names of the transforms.

    The whole arm avoids in the space of its joints q, from which forward kinematics leads to the end effector.
    """
    parts = [(IMITATION, _part("i", palette.LIGHT.level))] if scenario.imitation else []
    for _, layer in scenario.active:
        colour = _COLOURS.get(type(layer.transform), palette.LIGHT.streamline)
        parts.append((layer.name, _part(_index(layer.name), colour)))
    inner = "y"
    names = [f"{part} {html.escape(name)}" for name, part in parts]
    if scenario.arm_avoidance is not None and scenario.obstacles:
        whole = _part("q", palette.LIGHT.way)
        inner, names = f"fk({whole}(q))", [*names, f"{whole} {WHOLE_ARM}"]
    formula = "".join(f"{part}(" for _, part in parts) + inner + ")" * len(parts)
    legend = small(" · ".join((f"z {BASE}", *names)))
    return f"<div style='padding:0.3em 0.9em 0;font-size:1.05em'>z = {formula}</div>{legend}"


def _index(name: str) -> str:
    """Return the index of a transform's ψ: o for the avoidance of obstacles, or else its initial and number."""
    word, _, number = name.partition(" ")
    return "o" if name == AVOIDANCE.title else html.escape(word[:1].lower() + number)


def _part(index: str, colour: Colour) -> str:
    return f"<b style='color:{palette.ink(colour)}'>ψ<sub>{index}</sub></b>"


def _label(name: str, duration: float | None, what: str = "t") -> str:
    return name if duration is None else f"{name}, {what}\u00a0{duration:.2f}"


def _look(scenario: Scenario, name: str) -> str:
    return SHOWN if scenario.view.level == name else SHOW


def _switch(scenario: Scenario, name: str) -> dict[str, Any]:
    return {"imitation": not scenario.imitation} if name == IMITATION else {"stack": switched(scenario, name)}


def _select(scenario: Scenario, name: str) -> dict[str, Any]:
    view = scenario.view
    if name == BASE:
        return {"view": replace(view, panels=() if BASE_PANEL in view.panels else (BASE_PANEL,))}
    return {"view": replace(view, level="" if view.level == name else name, tuned=name)}


_ACTIONS: dict[str, Callable[[Scenario, str], dict[str, Any]]] = {
    ON: _switch,
    OFF: _switch,
    UP: lambda scenario, name: {"stack": shifted(scenario, name, 1)},
    DOWN: lambda scenario, name: {"stack": shifted(scenario, name, -1)},
    SHOW: _select,
    SHOWN: _select,
}


def add_warp(gui: viser.GuiApi, bindings: Bindings, order: float | None = None) -> tuple[Control, Control]:
    """Build the slider of the warp and the button that plays it, from an order on; return both."""
    hint = "part of its time that each flow runs. 0: motions and space are straight; 1: the stack is complete"
    slider = gui.add_slider(WARP, 0.0, 1.0, 0.01, 1.0, order=order, hint=hint)
    play = gui.add_button_group("Play warp", (PLAY,), hint="from 0 to 1", order=None if order is None else order + 1)
    return bindings.field(slider, "warp"), bindings.plays(play, WARP, lambda _session, _button: grown)


def grown(scenario: Scenario, seconds: float) -> dict[str, float] | None:
    """Return the warp some seconds after playing began; None once it is full."""
    return None if scenario.warp == 1 and seconds > SECONDS else {"warp": round(min(1.0, seconds / SECONDS), 3)}


def add_transform_settings(gui: viser.GuiApi, bindings: Bindings, order: float) -> None:
    """Build the settings of the transform that is chosen here, or was looked at last, from an order on."""
    which = gui.add_dropdown("Settings of", (IMITATION,), order=order, hint="the transform that is changed below")
    bindings.input(which, tuned, lambda s, value: {"view": replace(s.view, tuned=value)}, options=tunable)
    order += 1
    hint = "what is fitted to the demonstrations: whole motions, or velocities as in eq. (3) of the paper"
    objective = gui.add_dropdown("Objective", OBJECTIVES, order=order, hint=hint)
    bindings.field(objective, "objective", visible=_is_imitation)
    hint = (
        "plain: the paper's, one field that needs no memory. augmented: remembers its phase and where it began, so "
        "that it crosses itself, comes back, and draws the figure from other starts. auto: plain, unless it "
        "misses a demonstration, or clearly those that it has not learned from"
    )
    bindings.field(gui.add_dropdown("State", STATES, order=order, hint=hint), "state", visible=_is_imitation)
    hint = "how another hand draws, taken off its demonstrations of one letter and put on this one (augmented)"
    bindings.input(
        gui.add_dropdown("Style", (NO_STYLE, *STYLES), order=order, hint=hint),
        lambda s: s.style or NO_STYLE,
        lambda _s, name: {"style": "" if name == NO_STYLE else name},
        visible=lambda s: _is_imitation(s) and bindings.frame is not None and bindings.frame.task.draws,
    )
    hint = "part of the style that is put on; below 0 it is taken off"
    amount = gui.add_slider("Amount", -1.0, 2.0, 0.05, 1.0, order=order, hint=hint)
    bindings.field(amount, "style_amount", visible=lambda s: _is_imitation(s) and bool(s.style))
    note = gui.add_html("", order=order)
    bindings.properties(note, content=lambda _s: learned_html(bindings.frame), visible=_is_imitation)
    add_settings(gui, bindings, _settings, tuned, order)


def _is_imitation(scenario: Scenario) -> bool:
    return tuned(scenario) == IMITATION


def _settings(kind: PageEntry) -> tuple[Setting, ...]:
    """Return the settings of a kind in the stack: those of its flow; all of one that is not added on the page."""
    others = () if kind.most == 1 else settings_of_purpose(kind)
    return tuple(setting for setting in kind.settings if setting not in others)


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
    elif steps:
        flows = f"{len(steps)} flows" if len(steps) > 1 else "One flow"
        text = (
            f"{flows} of {max(steps)} Euler steps, t = 1, with an exact inverse. The steps are part of what was "
            "learned: other ones would be another motion, so there is nothing to choose."
        )
    else:
        text = "Off: motions are straight."
    return small(html.escape(text))
