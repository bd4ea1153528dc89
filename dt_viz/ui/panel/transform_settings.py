"""Settings of one transform of the stack: its flow, and what is its own."""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import viser

from dt_viz.engine.frame import Frame
from dt_viz.flows.diffeomorphisms import MAX_STEPS, METHODS, Method
from dt_viz.learning.imitation import OBJECTIVES
from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.scenario.scenario import MAX_TEMPERATURE, MIN_TEMPERATURE, SPACES, Scenario
from dt_viz.scenario.stack import AVOIDANCE, IMITATION, WHOLE_ARM, bias_points
from dt_viz.scenario.tuning import FlowSettings, avoids, flow_settings, transforms, tuned, with_flow
from dt_viz.ui.controls import Control

Bind = Callable[[Any, Callable[[Scenario], Any], Callable[[Scenario, Any], Mapping[str, Any]]], Control]
"""Ties a control to the scenario: how its value is read, and which fields a new value replaces."""

SPACE_LABELS: Mapping[str, str] = {"task": "End effector", "cspace": "Whole arm", "both": "Both"}
assert set(SPACE_LABELS) == set(SPACES)
GENERATOR_LABELS = {"free-space": "Free space (−∇log(1−p))", "probability": "Probability (∇p, the paper's)"}
assert set(GENERATOR_LABELS) == set(GENERATORS)
METHOD_LABELS: Mapping[Method, str] = {"auto": "auto", "rk4": "RK4", "euler": "Euler (the paper's)"}
assert set(METHOD_LABELS) == set(METHODS)
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
        self._adopted: Scenario | None = None
        self._which = bind(
            gui.add_dropdown("Settings of", (IMITATION,), order=order),
            tuned,
            lambda s, value: {"view": replace(s.view, tuned=value)},
        )
        order += 1
        learn = bind(
            gui.add_dropdown(
                "Learn", OBJECTIVES, order=order, hint="what is fitted to the demonstrations: the motions or eq. (3)"
            ),
            lambda s: s.objective,
            lambda _s, value: {"objective": value},
        )
        self._note = gui.add_html("", order=order)
        space = bind(
            gui.add_dropdown(
                "Avoid with",
                tuple(SPACE_LABELS.values()),
                order=order,
                hint="what gives way: the hand's path, or the whole arm by a transform of its joint angles",
            ),
            lambda s: SPACE_LABELS[s.space],
            lambda _s, value: {"space": _key(SPACE_LABELS, value)},
        )
        generator = bind(
            gui.add_dropdown(
                "Generator", tuple(GENERATOR_LABELS.values()), order=order, hint="the vector field whose flow avoids"
            ),
            lambda s: GENERATOR_LABELS[s.generator],
            lambda _s, value: {"generator": _key(GENERATOR_LABELS, value)},
        )
        reach = bind(
            gui.add_slider(
                "Reach T",
                MIN_TEMPERATURE,
                MAX_TEMPERATURE,
                0.5,
                6.0,
                order=order,
                hint="temperature: higher bends more gently, from farther away",
            ),
            lambda s: s.temperature,
            lambda _s, value: {"temperature": value},
        )
        auto = bind(
            gui.add_checkbox(
                "Flow time: auto", True, order=order, hint="the shortest flow that does what the transform is for"
            ),
            lambda s: _flow(s, lambda flow: flow.duration is None, True),
            lambda s, value: with_flow(s, tuned(s), duration=None if value else self._duration.value),
        )
        self._duration = bind(
            gui.add_slider("Flow time t", 0.0, 4.0, 0.01, 0.5, order=order, disabled=True),
            lambda s: _flow(
                s, lambda flow: self._duration.value if flow.duration is None else round(flow.duration, 2), 0.5
            ),
            lambda s, value: {} if _is_auto(s) else with_flow(s, tuned(s), duration=value),
        )
        method = bind(
            gui.add_dropdown(
                "Integrator",
                tuple(METHOD_LABELS.values()),
                order=order,
                hint="auto: as exact as is seen; the others take equal steps, and the status says what they cost",
            ),
            lambda s: _flow(s, lambda flow: METHOD_LABELS[flow.integration.method], METHOD_LABELS["auto"]),
            lambda s, value: _integrated(s, method=_key(METHOD_LABELS, value)),
        )
        self._steps = bind(
            gui.add_slider("Steps", 1, MAX_STEPS, 1, 8, order=order, visible=False),
            lambda s: _flow(s, lambda flow: flow.integration.steps, 8),
            lambda s, value: _integrated(s, steps=int(value)),
        )
        self._of_imitation = (learn.handle, self._note)
        self._of_avoidance = (space.handle, generator.handle, reach.handle)
        self._auto = auto.handle
        self._of_flow = (auto.handle, self._duration.handle, method.handle)

    def adopt(self, scenario: Scenario) -> None:
        """Offer what the chosen transform has; the values themselves are those of bound controls."""
        self._adopted = scenario
        name = tuned(scenario)
        flow = flow_settings(scenario, name)
        if self._which.handle.options != transforms(scenario):
            self._which.handle.options = transforms(scenario)
        shown = (
            (self._of_imitation, name == IMITATION),
            (self._of_avoidance, avoids(name)),
            (self._of_flow, flow is not None),
            ((self._steps.handle,), flow is not None and flow.integration.by_hand),
        )
        for handles, visible in shown:
            for handle in handles:
                if handle.visible != visible:
                    handle.visible = visible
        for handle, label in zip((self._auto, self._duration.handle), flow_labels(scenario, name), strict=True):
            if handle.label != label:
                handle.label = label
        if flow is not None:
            if self._duration.handle.max != flow.max_duration:
                self._duration.handle.max = flow.max_duration
            self._duration.handle.disabled = flow.duration is None
        self._write_note()

    def report(self, frame: Frame) -> None:
        """Show what `auto` chose, to go on from by hand, and what was learned."""
        self._learned = frame.learned_steps
        self._write_note()
        if self._adopted is None:
            return
        name = tuned(self._adopted)
        flow, chosen = flow_settings(self._adopted, name), durations(frame).get(name)
        if flow is not None and flow.duration is None and chosen is not None:
            self._duration.value = round(min(chosen, flow.max_duration), 2)

    def _write_note(self) -> None:
        text = learned_html(self._learned)
        if self._note.content != text:
            self._note.content = text


def flow_labels(scenario: Scenario, name: str) -> tuple[str, str]:
    """What the switch of `auto` and t are called: of a bias point, t is its strength."""
    what = "Strength" if name in bias_points(scenario.layers) else "Flow time"
    return f"{what}: auto", f"{what} t"


def durations(frame: Frame) -> dict[str, float | None]:
    """T of the flow of each transform, by name; None where it is off."""
    health, layers = frame.health, frame.scenario.layers
    chosen = dict(zip((layer.name for layer in layers), health.layer_durations, strict=False))
    return {**chosen, AVOIDANCE: health.duration, WHOLE_ARM: health.arm_duration}


def learned_html(steps: tuple[int, ...]) -> str:
    """What there is to say of the imitation's flows, given how many steps each has."""
    if not steps:
        return f"<div style='{_SMALL}'>Off: motions are straight.</div>"
    flows = f"{len(steps)} flows" if len(steps) > 1 else "One flow"
    text = (
        f"{flows} of {max(steps)} Euler steps, t = 1, with an exact inverse. "
        "The steps are part of what was learned: other ones would be another motion, so there is nothing to choose."
    )
    return f"<div style='{_SMALL}'>{html.escape(text)}</div>"


def _key(labels: Mapping[Any, str], label: str) -> Any:  # noqa: ANN401 - names of several kinds
    return next(name for name, text in labels.items() if text == label)


def _flow(scenario: Scenario, read: Callable[[FlowSettings], Any], otherwise: Any) -> Any:  # noqa: ANN401 - values of controls
    flow = flow_settings(scenario, tuned(scenario))
    return otherwise if flow is None else read(flow)


def _is_auto(scenario: Scenario) -> bool:
    return _flow(scenario, lambda flow: flow.duration is None, True)


def _integrated(scenario: Scenario, **changes: Any) -> Mapping[str, Any]:  # noqa: ANN401 - the fields of Integration
    flow = flow_settings(scenario, tuned(scenario))
    if flow is None:
        return {}
    return with_flow(scenario, tuned(scenario), integration=replace(flow.integration, **changes))
