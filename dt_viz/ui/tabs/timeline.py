"""The timeline: a window under the scene that plays the finished motion, or what the robot has just done."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from dt_viz.scenario.scenario import OFFERS
from dt_viz.session.session import Session
from dt_viz.ui import patches
from dt_viz.ui.bindings import Bindings, Control
from dt_viz.ui.playback import SPAN, Playback, Replay
from dt_viz.ui.tabs.about import Command
from dt_viz.ui.tabs.arm import play_or_pause
from dt_viz.ui.tabs.plots import Plots, cursor_html
from dt_viz.warning import Severity

LIVE, REPLAY, PAST = "Live", "Replay", f"Last {SPAN:.0f} s"
"""What is shown: the robot, its finished motion, and what it did."""
BACK, PLAY, PAUSE, ON = "◂ Step", "Play", "Pause", "Step ▸"
WIDTH = 340.0  # width of the window, CSS pixels


class Timeline:
    """The window of one visitor, which is there while another arm is shown than the one in the loop.

    The state is the playback's; each picture shows it on the controls.
    """

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, plots: Plots) -> None:
        """Make the window, hidden, until `follow` is given a playback; the plots are marked at its moment."""
        self._playback: Playback | None = None
        self._bindings, self._plots = bindings, plots
        self.panel = gui.add_panel(visible=False)
        self.panel.float(x=15, y=-15, width=WIDTH)
        with self.panel.add_tab("Timeline"):
            gui.add_html(patches.AT_THE_FOOT)
            self._mark = gui.add_html(cursor_html())
            hint = (
                f"{REPLAY}: the finished motion, which follows your edits. {PAST}: what the robot did, which edits "
                f"leave as it is; the robot goes on meanwhile. {LIVE}: the robot again"
            )
            self._source = bindings.on(gui.add_dropdown("Shown", (REPLAY, PAST, LIVE), hint=hint), self.show)
            hint = "J and K: by one sample of what is shown; the space bar plays and pauses"
            self._buttons = gui.add_button_group("Play", (BACK, PLAY, ON), hint=hint)
            bindings.on(self._buttons, self._press)
            hint = "moment that is shown; moving it pauses"
            self._moment = self._on(gui.add_slider("Time [s]", 0.0, SPAN, 0.01, 0.0, hint=hint), Replay.seek)
            loop = gui.add_checkbox("Loop", True, hint="begins anew after its end")
            self._loops = self._on(loop, lambda player, on: setattr(player, "loops", on))
            speed = gui.add_slider("Pace", *OFFERS["speed"].limits, 1.0, hint="speed of what is shown: 1 is real time")
            self._speed = self._on(speed, lambda player, to: setattr(player, "speed", to))

    @property
    def commands(self) -> list[Command]:
        """What is done by keys while it is there."""
        return [
            Command("Pause, or play", self.play_or_pause, "space"),
            Command("Timeline: a step back", lambda session: self._press(session, BACK), "J"),
            Command("Timeline: a step on", lambda session: self._press(session, ON), "K"),
            Command("Timeline: what the robot did", lambda session: self.show(session, PAST)),
        ]

    def show(self, session: Session, source: str) -> None:
        """Show the robot, its motion, or what it did."""
        playback = self._playback
        if playback is None:
            return
        if source != PAST:
            playback.resume()
        elif not playback.rewind():
            session.say("The robot has done nothing yet.", Severity.WARNING)
            return
        view = session.scenario.view
        if view.replay != (source == REPLAY):
            session.step("replay", view=replace(view, replay=source == REPLAY))

    def play_or_pause(self, session: Session) -> None:
        """Play what is shown, or hold it."""
        player = self._player
        if player is None:
            play_or_pause(session)
        elif player.playing:
            player.playing = False
        else:
            player.play()

    def follow(self, playback: Playback) -> None:
        """Show what a playback shows now; called by its thread."""
        self._playback, player = playback, playback.player
        self._mark.content = self._plots.mark(player, past=player is playback.past)
        if player is None:
            self.panel.visible = False
            return
        self._buttons.options = (BACK, PAUSE if player.playing else PLAY, ON)
        self._moment.handle.max = max(0.01, math.ceil(100 * player.duration) / 100)
        for control, value in (
            (self._source, PAST if player is playback.past else REPLAY),
            (self._moment, round(player.moment, 2)),
            (self._loops, player.loops),
            (self._speed, player.speed),
        ):
            if value != control.value:  # what a visitor changes at this instant is not put back
                control.value = value
        if not self.panel.visible:
            self.panel.visible = True
            self.panel.expand()  # on a phone it is folded at first

    @property
    def _player(self) -> Replay | None:
        return None if self._playback is None else self._playback.player

    def _on(self, handle: Any, act: Callable[[Replay, Any], None]) -> Control:  # noqa: ANN401 - viser's of all kinds
        def acts(_session: Session, value: Any) -> None:  # noqa: ANN401
            player = self._player
            if player is not None:
                act(player, value)

        return self._bindings.on(handle, acts)

    def _press(self, session: Session, button: str) -> None:
        player = self._player
        if button not in (BACK, ON):
            self.play_or_pause(session)
        elif player is not None:
            player.step(1 if button == ON else -1)
