"""Controls for the settings that kinds of transforms declare: those of the chosen one are shown."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import Any, cast

import viser

from dt_viz.flows.diffeomorphisms import MAX_STEPS, Integration, Method
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import transform_of, with_transform
from dt_viz.transforms import registry
from dt_viz.transforms.base import Choice, FlowIntegration, Number, Setting, Switch, Transform
from dt_viz.ui.controls import Control

Bind = Callable[[Any, Callable[[Scenario], Any], Callable[[Scenario, Any], Mapping[str, Any]]], Control]
"""Ties a control to the scenario: how its value is read, and which fields a new value replaces."""
Chosen = Callable[[Scenario], str | None]
"""Name of the layer whose settings are shown; None where there is none."""
METHOD_LABELS: Mapping[Method, str] = {"auto": "auto", "rk4": "RK4", "euler": "Euler (the paper's)"}


class Settings:
    """The settings of one transform of the stack."""

    def __init__(
        self,
        gui: viser.GuiApi,
        bind: Bind,
        offered: Callable[[type[Transform]], Iterable[Setting]],
        chosen: Chosen,
        order: float | None = None,
    ) -> None:
        """Build the controls of all kinds of transforms.

        Args:
            gui: of the visitor, in the folder that they go into.
            bind: ties them to the scenario.
            offered: settings of a kind that are shown here.
            chosen: which transform they are of.
            order: of all of them in the folder.
        """
        self._chosen, self._offered = chosen, offered
        self._adopted: Scenario | None = None
        self._controls: dict[Setting, _SettingControls] = {}
        for setting in dict.fromkeys(setting for kind in registry.KINDS for setting in offered(kind)):
            self._controls[setting] = _CONTROLS[type(setting)](gui, _Tie(bind, chosen, setting), setting, order)

    def adopt(self, scenario: Scenario) -> None:
        """Show the settings that the chosen transform has; the values themselves are those of bound controls."""
        self._adopted = scenario
        name = self._chosen(scenario)
        transform = None if name is None else transform_of(scenario, name)
        own = () if transform is None else tuple(self._offered(type(transform)))
        for setting, controls in self._controls.items():
            controls.show(getattr(transform, setting.field) if setting in own else _ABSENT)

    def report(self, chosen_values: Mapping[str, Mapping[str, float]]) -> None:
        """Show what transforms chose automatically, by their names and fields, to go on from by hand."""
        name = None if self._adopted is None else self._chosen(self._adopted)
        transform = None if self._adopted is None or name is None else transform_of(self._adopted, name)
        if name is None or transform is None:
            return
        values = chosen_values.get(name, {})
        for setting in self._offered(type(transform)):
            if getattr(transform, setting.field) is None and setting.field in values:
                self._controls[setting].suggest(values[setting.field])


_ABSENT = object()
"""Value of a setting that the chosen transform does not have."""


class _Tie:
    """Ties controls to one field of the chosen transform."""

    def __init__(self, bind: Bind, chosen: Chosen, setting: Setting) -> None:
        self._bind, self._chosen, self._field = bind, chosen, setting.field

    def value(self, scenario: Scenario) -> Any:  # noqa: ANN401 - fields of all types
        """Value of the field; `_ABSENT` if the chosen transform has no such field."""
        name = self._chosen(scenario)
        return _ABSENT if name is None else getattr(transform_of(scenario, name), self._field, _ABSENT)

    def tie(self, handle: Any, shown: Callable[[Any], Any], meant: Callable[[Any, Any], Any]) -> Control:  # noqa: ANN401
        """Tie a control: `shown` gives its value for the field's, `meant` the field's for the old one and its value."""
        otherwise = handle.value

        def read(scenario: Scenario) -> Any:  # noqa: ANN401
            value = self.value(scenario)
            return otherwise if value is _ABSENT else shown(value)

        def change(scenario: Scenario, value: Any) -> Mapping[str, Any]:  # noqa: ANN401
            before, name = self.value(scenario), self._chosen(scenario)
            transform = None if name is None else transform_of(scenario, name)
            if before is _ABSENT or name is None or transform is None:
                return {}
            after, dataclass = meant(before, value), cast(Any, transform)
            if after == before:
                return {}
            return {"stack": with_transform(scenario, name, replace(dataclass, **{self._field: after}))}

        return self._bind(handle, read, change)


class _SettingControls(ABC):
    """The controls of one setting."""

    @abstractmethod
    def __init__(self, gui: viser.GuiApi, tie: _Tie, setting: Any, order: float | None) -> None:  # noqa: ANN401
        """Build them."""

    @abstractmethod
    def show(self, value: Any) -> None:  # noqa: ANN401
        """Show the controls that a value asks for; none for `_ABSENT`."""

    def suggest(self, value: float) -> None:  # noqa: B027 - only numbers can be chosen automatically
        """Show the value that was chosen automatically."""


class _NumberControls(_SettingControls):
    def __init__(self, gui: viser.GuiApi, tie: _Tie, setting: Number, order: float | None) -> None:
        self._setting, self._auto = setting, None
        if setting.automatic:
            self._auto = tie.tie(
                gui.add_checkbox(f"{setting.label}: auto", True, order=order, visible=False, hint=setting.hint),
                lambda value: value is None,
                lambda _before, auto: None if auto else self._number.value / setting.scale,
            ).handle
        self._number = tie.tie(
            gui.add_slider(
                f"{setting.label} {setting.unit}",
                setting.low,
                setting.high,
                setting.step,
                setting.initial,
                order=order,
                visible=False,
                hint=None if setting.automatic else setting.hint,
            ),
            lambda value: self._number.value if value is None else self._rounded(value),
            lambda before, number: None if before is None else number / setting.scale,
        )

    def show(self, value: Any) -> None:  # noqa: ANN401
        self._number.handle.visible = value is not _ABSENT
        self._number.handle.disabled = value is None
        if self._auto is not None:
            self._auto.visible = value is not _ABSENT

    def suggest(self, value: float) -> None:
        self._number.value = min(max(self._rounded(value), self._setting.low), self._setting.high)

    def _rounded(self, value: float) -> float:
        return round(value * self._setting.scale, 3 if self._setting.scale == 1 else 1)


class _SwitchControls(_SettingControls):
    def __init__(self, gui: viser.GuiApi, tie: _Tie, setting: Switch, order: float | None) -> None:
        handle = gui.add_checkbox(setting.label, False, order=order, visible=False, hint=setting.hint)
        self._switch = tie.tie(handle, bool, lambda _before, on: on).handle

    def show(self, value: Any) -> None:  # noqa: ANN401
        self._switch.visible = value is not _ABSENT


class _ChoiceControls(_SettingControls):
    def __init__(self, gui: viser.GuiApi, tie: _Tie, setting: Choice, order: float | None) -> None:
        labels = setting.options
        handle = gui.add_dropdown(setting.label, tuple(labels.values()), order=order, visible=False, hint=setting.hint)
        self._choice = tie.tie(handle, lambda value: labels[value], lambda _before, label: _key(labels, label)).handle

    def show(self, value: Any) -> None:  # noqa: ANN401
        self._choice.visible = value is not _ABSENT


class _IntegrationControls(_SettingControls):
    def __init__(self, gui: viser.GuiApi, tie: _Tie, _setting: FlowIntegration, order: float | None) -> None:
        hint = "auto: as exact as is seen; the others take equal steps, and the status says what they cost"
        method = gui.add_dropdown("Integrator", tuple(METHOD_LABELS.values()), order=order, visible=False, hint=hint)
        self._method = tie.tie(
            method,
            lambda integration: METHOD_LABELS[integration.method],
            lambda before, label: replace(before, method=_key(METHOD_LABELS, label)),
        ).handle
        self._steps = tie.tie(
            gui.add_slider("Steps", 1, MAX_STEPS, 1, 8, order=order, visible=False),
            lambda integration: integration.steps,
            lambda before, steps: replace(before, steps=int(steps)),
        ).handle

    def show(self, value: Integration | Any) -> None:  # noqa: ANN401
        self._method.visible = value is not _ABSENT
        self._steps.visible = value is not _ABSENT and value.by_hand


_CONTROLS: Mapping[type[Setting], type[_SettingControls]] = {
    Number: _NumberControls,
    Switch: _SwitchControls,
    Choice: _ChoiceControls,
    FlowIntegration: _IntegrationControls,
}


def _key(labels: Mapping[Any, str], label: str) -> Any:  # noqa: ANN401 - names of several kinds
    return next(name for name, text in labels.items() if text == label)
