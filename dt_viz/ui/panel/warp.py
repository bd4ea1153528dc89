"""The warp: how far the flows of the stack have run, by hand or played from straight rays to the full stack."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

import viser

from dt_viz.engine.session import Session
from dt_viz.ui.panel.bindings import Bindings

SECONDS = 5.0
"""Duration of playing."""
STEP = 0.05
"""Interval of the edits, seconds, as of a dragged slider."""
PLAY, STOP = "0 → 1", "Stop"
NAME = "Warp"
"""Name of the slider, and of its gesture for undo."""


class WarpPlayer:
    """Moves a session's warp from 0 to 1, once, until the scenario is changed by something else."""

    def __init__(self, changed: Callable[[bool], None], seconds: float = SECONDS) -> None:
        """Wait to be started.

        Args:
            changed: called with True when playing begins and with False when it ends.
            seconds: duration of playing.
        """
        self._changed = changed
        self._seconds = seconds
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def playing(self) -> bool:
        """Whether it is under way."""
        return self._thread is not None and self._thread.is_alive()

    def toggle(self, session: Session) -> None:
        """Start to play, or stop at the current warp."""
        if self.playing:
            self._stop.set()
        else:
            self._stop.clear()
            self._thread = threading.Thread(target=self._play, args=(session,), name="warp", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """Stop, and wait for the last edit."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout=1)

    def _play(self, session: Session) -> None:
        self._changed(True)
        session.begin_gesture()
        began, mine = time.monotonic(), None
        while mine is None or session.scenario.moves_like(mine):  # else the user edits something
            warp = min(1.0, (time.monotonic() - began) / self._seconds)
            session.edit(NAME, warp=round(warp, 3))
            mine = session.scenario
            if warp == 1.0 or self._stop.wait(STEP):
                session.end_gesture()
                break
        self._changed(False)


class WarpControls:
    """The slider and the button that plays it."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, order: float) -> None:
        """Build them.

        Args:
            gui: controls of the visitor, in the folder that they go into.
            bindings: bindings of the visitor's panel.
            order: order of the first of them in the folder.
        """
        self._player = WarpPlayer(self._show)
        hint = "part of its time that each flow runs: at 0 motions and space are straight, at 1 the stack is complete"
        bindings.input(
            gui.add_slider(NAME, 0.0, 1.0, 0.01, 1.0, order=order, hint=hint),
            lambda s: s.warp,
            lambda _s, value: {"warp": value},
        )
        self._play = gui.add_button_group("Play warp", (PLAY,), order=order + 1)
        bindings.on(self._play, lambda session, _button: self._player.toggle(session))

    def _show(self, playing: bool) -> None:
        self._play.options = (STOP,) if playing else (PLAY,)

    def close(self) -> None:
        """Stop playing."""
        self._player.close()
