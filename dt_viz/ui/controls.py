"""Checks of what a browser sends for the page's controls, before anything acts on it.

viser accepts any value, whatever the limits, choices and types, also for controls that are disabled or hidden, and
calls back afterwards. So `handle.value` is a browser's claim; `Control.value` was shown to it, or accepted from it.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import viser

from dt_viz.ui import patches


class Control:
    """An input of the panel.

    A number beyond the control's limits is moved to them. Anything else that the control cannot have sent is refused,
    and the browser is shown the previous value.
    """

    def __init__(self, handle: Any, act: Callable[[Any], None] | None = None) -> None:  # noqa: ANN401
        """Take over an input of viser.

        Args:
            handle: a slider, a dropdown, a checkbox, a button or a group of buttons.
            act: called with each allowed value from the browser. It must only submit.
        """
        self.handle = handle
        self._value, self._act = handle.value, act or (lambda _value: None)
        listen = handle.on_click if _is_button(handle) else handle.on_update
        listen(self._changed)

    @property
    def value(self) -> Any:  # noqa: ANN401 - as the kind of control
        """Value shown last, or accepted from the browser since; assigning shows another one."""
        return self._value

    @value.setter
    def value(self, value: Any) -> None:  # noqa: ANN401
        self._value = value
        if self.handle.value != value:
            self._put_back()

    async def _changed(self, event: viser.GuiEvent) -> None:
        if event.client is None:  # assigned here, not in a browser
            return
        claimed = self.handle.value
        value = allowed(self.handle, claimed)
        self._value = self._value if value is None else value
        if claimed != self._value:
            self._put_back()
        if value is not None:
            self.act(value)

    def act(self, value: Any) -> None:  # noqa: ANN401
        """Do what the control is for, with a value that it has."""
        self._act(value)

    def _put_back(self) -> None:
        patches.put_back(self.handle, self._value, shown=not _is_button(self.handle))


def switch(checkbox: Control) -> None:
    """Do as the visitor who presses a checkbox."""
    checkbox.value = not checkbox.value
    checkbox.act(checkbox.value)


def on_press(button: viser.GuiButtonHandle, act: Callable[[], None]) -> None:
    """Call `act`, which must only submit, when the button is pressed while it is enabled."""
    Control(button, lambda _pressed: act())


def on_command(command: viser.CommandHandle, act: Callable[[], None]) -> None:
    """Call `act`, which must only submit, when a command is given; viser gives none that is disabled."""

    @command.on_trigger
    async def _(_event: viser.CommandEvent) -> None:
        act()


def allowed(handle: Any, claimed: Any) -> Any | None:  # noqa: ANN401 - handles and values of all kinds
    """Return the value that a control accepts for a browser's claim; None if the control cannot have sent it."""
    if handle.disabled or not handle.visible:
        return None
    match handle:
        case viser.GuiSliderHandle():
            if isinstance(claimed, bool) or not isinstance(claimed, int | float) or not math.isfinite(claimed):
                return None
            return type(claimed)(min(max(claimed, handle.min), handle.max))
        case viser.GuiDropdownHandle() | viser.GuiButtonGroupHandle():
            return claimed if claimed in handle.options else None
        case viser.GuiCheckboxHandle() | viser.GuiButtonHandle():
            return claimed if isinstance(claimed, bool) else None
    raise TypeError(f"no rule for the values of a {type(handle).__name__}")


def _is_button(handle: Any) -> bool:  # noqa: ANN401
    return isinstance(handle, viser.GuiButtonHandle | viser.GuiButtonGroupHandle)
