"""Bindings of the panel to a session: what the page shows of a scenario, and how its inputs edit it."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import viser

from dt_viz.scenario.scenario import OFFERS, Scenario, View
from dt_viz.session import player
from dt_viz.session.frame import Frame
from dt_viz.session.player import Play
from dt_viz.session.session import Session
from dt_viz.ui import patches

KEEP: Any = object()  # value of a binding that leaves what is shown as it is
EDITS = "edits"
"""Lane of the session's jobs for edits that take longer than the server's event loop may wait."""
STOP = "Stop"
Handle = Value = Any  # handles of viser, and values of inputs, of all kinds
Act = Callable[[Session, Value], object]
Read = Callable[[Scenario], Value]
"""Function of the adopted scenario; it may look at `Bindings.frame`, too."""


class Control:
    """An input of the panel, with the value that was shown last, or accepted from the browser since.

    viser accepts any claim of a browser, also for inputs that are disabled or hidden, and calls back afterwards. A
    number beyond the limits is moved to them. Anything else that the input cannot have sent is refused, and the
    browser is shown the previous value.
    """

    def __init__(self, handle: Handle, act: Callable[[Value], object] = lambda _value: None) -> None:
        """Take over an input of viser; `act`, which must only submit, is called with each allowed value."""
        self.handle, self.act = handle, act
        self._value, self._is_button = handle.value, hasattr(handle, "on_click")
        (handle.on_click if self._is_button else handle.on_update)(self._changed)

    @property
    def value(self) -> Value:
        """Value shown last, or accepted from the browser since; assigning shows another one."""
        return self._value

    @value.setter
    def value(self, value: Value) -> None:
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

    def switch(self) -> None:
        """Do as the visitor who presses this checkbox."""
        self.value = not self.value
        self.act(self.value)

    def _put_back(self) -> None:
        patches.put_back(self.handle, self._value, shown=not self._is_button)


def allowed(handle: Handle, claimed: Value) -> Value | None:
    """Return the value that an input takes for a claim; None if its browser cannot have sent it.

    viser has converted the claim to the type of the input's value, unless it is a file, which any input may be sent.
    """
    if handle.disabled or not handle.visible or isinstance(claimed, viser.UploadedFile):
        return None
    if isinstance(handle, viser.GuiSliderHandle):
        finite = -math.inf < claimed < math.inf
        return type(claimed)(min(max(claimed, handle.min), handle.max)) if finite else None
    return claimed if claimed in getattr(handle, "options", (claimed,)) else None


@dataclass
class _Binding:
    read: Read
    put: Callable[[Any], None]
    last: Any = KEEP  # value that was read last
    of_frame: bool = False
    """Whether a frame was looked at for it, so that the next one may change it."""


class Bindings:
    """All bindings of one visitor's panel.

    Each reads a value from the adopted scenario and the last frame, and shows it where it differs from what it read
    before. So an edit is shown on the controls that it changes, and nowhere else: what a browser has moved meanwhile
    stays as it is.
    """

    def __init__(self) -> None:
        self.scenario: Scenario | None = None  # the scenario adopted last
        self._frame: Frame | None = None
        self._looked = False  # whether the binding that is being read has looked at the frame
        self._session: Session | None = None
        self._bindings: list[_Binding] = []
        self._showing = threading.Lock()  # edits are adopted by one thread, frames reported by another

    @property
    def frame(self) -> Frame | None:
        """The frame reported last; bindings that look at it are read again with the next one."""
        self._looked = True
        return self._frame

    @property
    def session(self) -> Session:
        """The session that inputs act on, once they do."""
        assert self._session is not None
        return self._session

    def connect(self, session: Session) -> None:
        """Let the inputs act on this session."""
        self._session = session

    def show(self, read: Read, put: Callable[[Any], None]) -> None:
        """Call `put` with each new value that `read` gives."""
        self._bindings.append(_Binding(read, put))

    def properties(self, handle: Handle, **read: Read) -> Handle:
        """Bind properties of a handle of viser, such as `visible`, to what functions of the scenario return.

        Returns:
            The handle.
        """
        for name, value in read.items():
            self.show(value, partial(setattr, handle, name))
        return handle

    def input(
        self,
        handle: Handle,
        read: Read,
        change: Callable[[Scenario, Any], Mapping[str, Any]],
        **properties: Read,
    ) -> Control:
        """Bind an input: `read` gives its value, `change` the fields of the scenario that a new value replaces."""

        def edit(session: Session, value: Value) -> None:
            session.edit(handle.label, **change(session.scenario, value))

        return self.choice(handle, read, edit, **properties)

    def field(self, handle: Handle, name: str, **properties: Read) -> Control:
        """Bind an input to a field of the scenario."""
        return self.input(handle, lambda s: getattr(s, name), lambda _s, value: {name: value}, **properties)

    def view(
        self,
        handle: Handle,
        name: str,
        shown: Callable[[Value], Value] = lambda value: value,
        meant: Callable[[Value], Value] = lambda value: value,
        **properties: Read,
    ) -> Control:
        """Bind an input to a field of `View`: `shown` is its value for the field's, `meant` the field's for its own."""
        return self.input(
            handle,
            lambda s: shown(getattr(s.view, name)),
            lambda s, value: {"view": replace(s.view, **{name: meant(value)})},
            **properties,
        )

    def checkbox(self, gui: viser.GuiApi, name: str, **properties: Read) -> Control:
        """Add the checkbox of a field of `View` where the panel is being built."""
        offer, shown = OFFERS[name], "visible" not in properties
        handle = gui.add_checkbox(offer.label, bool(getattr(View(), name)), hint=offer.hint, visible=shown)
        return self.view(handle, name, bool, **properties)

    def slider(self, gui: viser.GuiApi, name: str, **properties: Read) -> Control:
        """Add the slider of a field of `View` likewise."""
        offer, initial, shown = OFFERS[name], getattr(View(), name), "visible" not in properties
        handle = gui.add_slider(offer.label, *offer.limits, initial, hint=offer.hint, visible=shown)
        return self.view(handle, name, meant=type(initial), **properties)

    def choice(self, handle: Handle, read: Read, act: Act, **properties: Read) -> Control:
        """Bind an input whose new values do more than to edit the scenario."""
        self.properties(handle, **properties)
        return self.properties(self.on(handle, act), value=read)

    def on(self, handle: Handle, act: Act, **properties: Read) -> Control:
        """Call `act`, which must only submit, with each new value of an input, or press of a button."""

        def acts(value: Value) -> None:
            if self._session is not None:
                act(self._session, value)

        return Control(self.properties(handle, **properties), acts)

    def later(self, handle: Handle, act: Act, **properties: Read) -> Control:
        """Do `act` with each press of a button, one after the other, beside the server's event loop."""
        edits = lambda session, value: session.jobs.submit(EDITS, partial(act, session, value))  # noqa: E731
        return self.on(handle, edits, **properties)

    def plays(
        self, buttons: Handle, gesture: str, chosen: Callable[[Session, str], Play | None], *, returns: bool = False
    ) -> Control:
        """Play what is `chosen` by a button of a group, which is one that stops it meanwhile; see `player.start`."""
        options = buttons.options

        def show(playing: bool) -> None:
            buttons.options = (STOP,) if playing else options

        def press(session: Session, button: str) -> None:
            play = None if button == STOP else chosen(session, button)
            if play is None:
                player.stop(session)
            else:
                player.start(session, gesture, play, show, returns=returns)

        return self.on(buttons, press)

    def on_command(self, command: Handle, act: Callable[[Session], None]) -> None:
        """Call `act`, which must only submit, when an enabled command of the palette is given."""

        @command.on_trigger
        async def _(_event: viser.CommandEvent) -> None:
            if self._session is not None:
                act(self._session)

    def adopt(self, scenario: Scenario) -> None:
        """Show what is new in a scenario."""
        with self._showing:
            self.scenario = scenario
            self._show(self._bindings)

    def report(self, frame: Frame) -> None:
        """Show what is new in a frame."""
        with self._showing:
            self._frame = frame
            self._show([binding for binding in self._bindings if binding.of_frame])

    def restore(self) -> None:
        """Show the adopted scenario on all inputs, also on those that a browser has moved in vain."""
        with self._showing:
            for binding in self._bindings:
                binding.last = KEEP
            self._show(self._bindings)

    def _show(self, bindings: Sequence[_Binding]) -> None:
        if self.scenario is not None:
            for binding in bindings:
                self._looked = False
                value, last = binding.read(self.scenario), binding.last
                binding.last, binding.of_frame = value, self._looked
                if value is not KEEP and (last is KEEP or value != last):
                    binding.put(value)
