"""Controls for the settings that kinds of transforms declare: those of the chosen one are shown."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import viser

from dt_viz.avoidance import registry
from dt_viz.avoidance.page import Choice, FlowIntegration, Number, PageEntry, Setting, Switch
from dt_viz.avoidance.transform import Transform
from dt_viz.flows.diffeomorphisms import MAX_STEPS, Method
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import transform_of, with_transform
from dt_viz.ui.bindings import KEEP, Bindings, Control, Handle, Read, Value

Chosen = Callable[[Scenario], str | None]
"""Function that returns the name of the layer whose settings are shown; None where there is none."""
Offered = Callable[[PageEntry], Iterable[Setting]]
"""Function that returns the settings of a kind that are shown."""


def add_settings(
    gui: viser.GuiApi, bindings: Bindings, offered: Offered, chosen: Chosen, order: float | None = None
) -> None:
    """Build the controls of the settings of all kinds of transforms, of which those of the chosen one are shown."""
    for setting in dict.fromkeys(setting for entry in registry.KINDS.values() for setting in offered(entry)):
        _SettingField(gui, bindings, offered, chosen, setting).add({"order": order, "visible": False})


def settings_of_purpose(kind: PageEntry) -> tuple[Setting, ...]:
    """Return the settings of a kind that are about what it is for, not about its flow."""
    return tuple(
        setting
        for setting in kind.settings
        if isinstance(setting, Switch) or (isinstance(setting, Number) and not setting.of_flow)
    )


@dataclass(frozen=True)
class _SettingField:
    """The field of the chosen transform that a setting is about."""

    gui: viser.GuiApi
    bindings: Bindings
    offered: Offered
    chosen: Chosen
    setting: Setting

    def transform(self, scenario: Scenario) -> Transform | None:
        """Return the chosen transform; None if it has no such setting."""
        name = self.chosen(scenario)
        transform = None if name is None else transform_of(scenario, name)
        return transform if transform and self.setting in self.offered(registry.entry_of(transform)) else None

    def read(self, of_value: Callable[[Value], Value], otherwise: Value) -> Read:
        """Return a function of a scenario: `of_value` of the field, or `otherwise` where there is none."""

        def read(scenario: Scenario) -> Value:
            transform = self.transform(scenario)
            return otherwise if transform is None else of_value(getattr(transform, self.setting.field))

        return read

    def bind(
        self,
        handle: Handle,
        shown: Callable[[Value], Value],
        meant: Callable[[Value, Value], Value],
        visible: Callable[[Value], bool] = lambda _value: True,
        **properties: Read,
    ) -> Control:
        """Bind an input of the panel to this field of the chosen transform.

        Args:
            handle: the input.
            shown: returns the value of the input for that of the field.
            meant: returns the new value of the field for its old one and that of the input.
            visible: returns whether the input is visible for a value of the field; without the field it is not.
            properties: see `Bindings.properties`.
        """

        def change(scenario: Scenario, value: Value) -> Mapping[str, Any]:
            name, transform = self.chosen(scenario), self.transform(scenario)
            if name is None or transform is None:
                return {}
            changed = {self.setting.field: meant(getattr(transform, self.setting.field), value)}
            return {"stack": with_transform(scenario, name, replace(transform, **changed))}

        properties["visible"] = self.read(visible, otherwise=False)
        return self.bindings.input(handle, self.read(shown, otherwise=KEEP), change, **properties)

    def suggestion(self) -> float | None:
        """Return the value that the chosen transform chose automatically, if it is known."""
        scenario, frame = self.bindings.scenario, self.bindings.frame
        name = None if scenario is None else self.chosen(scenario)
        return None if name is None or frame is None else frame.chosen_values.get(name, {}).get(self.setting.field)

    def add(self, given: dict[str, Any]) -> None:
        """Build its controls where the panel is being built, with the options of viser that are given."""
        gui, setting = self.gui, self.setting
        match setting:
            case Number():
                self._add_number(setting, given)
            case Switch():
                box = gui.add_checkbox(setting.label, False, hint=setting.hint, **given)
                self.bind(box, bool, lambda _before, on: on)
            case Choice():
                keys = {label: key for key, label in setting.options.items()}
                choice = gui.add_dropdown(setting.label, tuple(keys), hint=setting.hint, **given)
                self.bind(choice, lambda value: setting.options[value], lambda _before, label: keys[label])
            case FlowIntegration():
                self._add_integration(given)
            case _:
                raise TypeError(f"no control for a {type(setting).__name__}")

    def _add_number(self, setting: Number, given: dict[str, Any]) -> None:
        def shown(value: float | None) -> float:
            """Return what the slider shows: while it is automatic what was chosen, to go on from by hand."""
            value = self.suggestion() if value is None else value
            if value is None:
                return KEEP
            return min(max(round(value * setting.scale, 3 if setting.scale == 1 else 1), setting.low), setting.high)

        if setting.automatic:
            self.bind(
                self.gui.add_checkbox(f"{setting.label}: auto", True, hint=setting.hint, **given),
                lambda value: value is None,
                lambda _before, auto: None if auto else slider.value / setting.scale,
            )
        limits = setting.low, setting.high, setting.step, setting.initial
        hint = None if setting.automatic else setting.hint
        slider = self.bind(
            self.gui.add_slider(f"{setting.label} {setting.unit}", *limits, hint=hint, **given),
            shown,
            lambda before, number: None if before is None else number / setting.scale,
            disabled=self.read(lambda value: value is None, otherwise=KEEP),
        )

    def _add_integration(self, given: dict[str, Any]) -> None:
        hint = "auto: errors stay invisible; the others take equal steps, and the status warns of their errors"
        methods: dict[str, Method] = {"auto": "auto", "RK4": "rk4", "Euler (the paper's)": "euler"}
        labels = {method: label for label, method in methods.items()}
        self.bind(
            self.gui.add_dropdown("Integrator", tuple(methods), hint=hint, **given),
            lambda integration: labels[integration.method],
            lambda before, label: replace(before, method=methods[label]),
        )
        self.bind(
            self.gui.add_slider("Steps", 1, MAX_STEPS, 1, 8, hint="of the flow, all of one length", **given),
            lambda integration: integration.steps,
            lambda before, steps: replace(before, steps=int(steps)),
            visible=lambda integration: integration.by_hand,
        )
