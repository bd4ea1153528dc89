"""Settings of one transform of the stack: its flow, and what is its own."""

from __future__ import annotations

import html
from dataclasses import replace

import viser

from dt_viz.engine.frame import Frame
from dt_viz.learning.imitation import OBJECTIVES
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION, WHOLE_ARM, place_of, tunable, tuned
from dt_viz.transforms.base import Number, Setting, Switch, Transform
from dt_viz.ui.panel.settings import Bind, Settings

_SMALL = "font-size:0.8em;line-height:1.45;padding:0.1em 0.9em 0.5em;opacity:0.85"


class TransformSettings:
    """The settings of the transform that is chosen here, or was looked at last."""

    def __init__(self, gui: viser.GuiApi, bind: Bind, order: float) -> None:
        """Build the controls.

        Args:
            gui: of the visitor, in the folder that they go into.
            bind: ties them to the scenario.
            order: of the first of them in the folder.
        """
        self._learned: tuple[int, ...] = ()
        self._which = bind(
            gui.add_dropdown("Settings of", (IMITATION,), order=order),
            tuned,
            lambda s, value: {"view": replace(s.view, tuned=value)},
        )
        order += 1
        hint = "what is fitted to the demonstrations: the motions or eq. (3)"
        self._objective = bind(
            gui.add_dropdown("Learn", OBJECTIVES, order=order, hint=hint),
            lambda s: s.objective,
            lambda _s, value: {"objective": value},
        ).handle
        self._note = gui.add_html("", order=order)
        self._settings = Settings(gui, bind, _settings, tuned, order)

    def adopt(self, scenario: Scenario) -> None:
        """Offer what the chosen transform has; the values themselves are those of bound controls."""
        if self._which.handle.options != tunable(scenario):
            self._which.handle.options = tunable(scenario)
        self._objective.visible = self._note.visible = tuned(scenario) == IMITATION
        self._settings.adopt(scenario)
        self._write_note()

    def report(self, frame: Frame) -> None:
        """Show what transforms chose automatically, to go on from by hand, and what was learned."""
        self._learned = frame.learned_steps
        self._write_note()
        self._settings.report(chosen_values(frame))

    def _write_note(self) -> None:
        self._note.content = learned_html(self._learned)


def _settings(kind: type[Transform]) -> tuple[Setting, ...]:
    """Settings of a kind in the stack: those of its flow; all of one that is not added on the page."""
    return kind.settings if kind.most == 1 else tuple(setting for setting in kind.settings if not own(setting))


def own(setting: Setting) -> bool:
    """Whether a setting is about what the transform is for, not about its flow."""
    return isinstance(setting, Switch) or (isinstance(setting, Number) and not setting.of_flow)


def chosen_values(frame: Frame) -> dict[str, dict[str, float]]:
    """Values that each transform chose automatically, by its name and its fields."""
    layers = zip(frame.scenario.stack, frame.chosen_values, strict=False)
    values = {layer.name: dict(chosen) for layer, chosen in layers}
    if frame.arm_duration is not None:
        values[WHOLE_ARM] = {"duration": frame.arm_duration}
    return values


def durations(frame: Frame) -> dict[str, float | None]:
    """T of the flow of each transform, by name; None where it is off."""
    layers = zip(frame.scenario.stack, frame.durations, strict=False)
    return {**{layer.name: duration for layer, duration in layers}, WHOLE_ARM: frame.arm_duration}


def flow_time_of(scenario: Scenario, name: str) -> str:
    """Name of t of a layer's flow."""
    place = place_of(scenario, name)
    return "t" if place is None else scenario.stack[place].transform.flow_time


def learned_html(steps: tuple[int, ...]) -> str:
    """A note about the imitation's flows, given how many steps each has."""
    if not steps:
        return f"<div style='{_SMALL}'>Off: motions are straight.</div>"
    flows = f"{len(steps)} flows" if len(steps) > 1 else "One flow"
    text = (
        f"{flows} of {max(steps)} Euler steps, t = 1, with an exact inverse. "
        "The steps are part of what was learned: other ones would be another motion, so there is nothing to choose."
    )
    return f"<div style='{_SMALL}'>{html.escape(text)}</div>"
