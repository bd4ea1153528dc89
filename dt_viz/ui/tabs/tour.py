"""The tour: its offer at the top of the panel, and in its place the text of the step that is shown, with buttons."""

from __future__ import annotations

import html
from collections.abc import Callable
from functools import partial

import viser

from dt_viz.scenario.tour import STEPS, TASK, TourStep
from dt_viz.session import player
from dt_viz.session.session import CHOICES, Session
from dt_viz.ui import keeping
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.host import Host
from dt_viz.ui.scene.camera import Pose
from dt_viz.ui.scene.palette import LIGHT, css
from dt_viz.ui.scripts import arrows_html
from dt_viz.ui.tabs.plots import small
from dt_viz.ui.tabs.stack import PLAY, add_warp

TAKE, DECLINE = "Take the tour", "No, thanks"
BACK, NEXT, END = "Back", "Next", "End"
KEY = "dt-viz-tour"
"""Key under which a browser keeps the number of the step that is shown, from 1, or `OVER`."""
PAPER = "rgba(0, 158, 115, 0.10)"  # colour behind the text, on light and on dark
OVER = "over"  # text that a browser keeps once the tour is ended or declined
NUMBERS = tuple(str(number) for number in range(1, len(STEPS) + 1))
"""Numbers of the steps, as a browser or a link tells them."""
LANE = "tour"  # lane of the session's jobs on which the browser is asked, and the tour begins
Begin = Callable[[Callable[[Session, str], None], Session, str], None]
"""Function that begins something of a session, with a title; see `ControlPanel.choose`."""


class Tour:
    """The tour of one visitor: shows its steps in place of his scenario, which he has again at the end."""

    def __init__(self, gui: viser.GuiApi, bindings: Bindings, page: Host, begin: Begin) -> None:
        """Build the controls where the panel is being built.

        Args:
            gui: the panel's.
            bindings: those of the panel.
            page: what the tour is shown on; its camera is as before when the tour ends.
            begin: has something begun beside the server's event loop; see `ControlPanel.choose`.
        """
        self._page, self._begin, self._storage = page, begin, page.client.local_storage
        self.number: int | None = None
        """Number of the step that is shown, from 0; None outside the tour."""
        self.pose: Pose | None = None  # pose that the camera had before the tour; None as it began
        hint = "six steps, two minutes: from an attractor to a whole arm. What you have made stays as it is"
        self._offer = gui.add_button_group("New here?", (TAKE, DECLINE), visible=False, hint=hint)
        self._card = gui.add_html("")
        self._warp = add_warp(gui, bindings)
        self._arrows = gui.add_html(arrows_html(BACK, NEXT), visible=False)
        self._buttons = gui.add_button_group("Step", (NEXT, END), hint="or the keys ←, →, Escape")
        bindings.on(self._offer, lambda session, button: self.take(session) if button == TAKE else self._decline())
        bindings.on(self._buttons, self._press)
        self._write()

    @property
    def step(self) -> TourStep | None:
        """The step that is shown; None outside the tour."""
        return None if self.number is None else STEPS[self.number]

    def begin(self, session: Session) -> None:
        """Ask the browser whether the tour is to be offered, or which step was shown before a reload."""
        session.jobs.submit(LANE, partial(self._ask, session))

    def take(self, session: Session, number: int = 0) -> None:
        """Begin the tour at a step, from 0, or go to it."""
        if self.number is None:
            session.jobs.submit(LANE, partial(self._enter, session, number), latest=True)
        else:
            self._go(session, number)

    def turn(self, session: Session, steps: int) -> None:
        """Go so many steps on, if there are so many."""
        if self.number is not None and 0 <= self.number + steps < len(STEPS):
            self._go(session, self.number + steps)

    def end(self, session: Session) -> None:
        """End the tour, if it is on."""
        if self.number is not None:
            self._begin(lambda session, _title: self.leave(session), session, "")

    def leave(self, session: Session) -> None:
        """End the tour, if it is on: the visitor's own scenario is there again; called on the lane `CHOICES`."""
        if self.number is None:
            return
        self.number = None
        self._write()
        _stop_playing(session)
        self._page.camera.view()
        self._page.came_back(self.pose)
        session.come_back()
        self._keep(OVER)

    def _press(self, session: Session, button: str) -> None:
        if button == END:
            self.end(session)
        else:
            self.turn(session, 1 if button == NEXT else -1)

    def _decline(self) -> None:
        self._offer.visible = False
        self._keep(OVER)

    def _ask(self, session: Session) -> None:
        """Ask the browser until it tells; what no page has written is as nothing."""
        found = None
        for _ in range(keeping.ATTEMPTS):
            if session.jobs.superseded(LANE):
                return
            try:
                found = self._storage.get_item(KEY, timeout=keeping.PATIENCE)
                break
            except TimeoutError:
                continue
            except RuntimeError:  # it keeps nothing, or is gone
                break
        else:
            return
        if found in NUMBERS:
            self._enter(session, NUMBERS.index(found))
        elif found != OVER:
            self._offer.visible = True

    def _enter(self, session: Session, number: int) -> None:
        """Begin once the page goes on with what the browser keeps: what begins before takes its place."""
        session.jobs.wait_idle(keeping.LANE)
        session.jobs.wait_idle(CHOICES)
        self._go(session, number)

    def _go(self, session: Session, number: int) -> None:
        if self.number is None:
            self.pose = self._page.camera.chosen
        self.number = number
        self._write()
        self._begin(partial(self._visit, number), session, "")

    def _visit(self, number: int, session: Session, _title: str) -> None:
        if self.number != number:  # ended meanwhile
            return
        _stop_playing(session)
        self._page.camera.view()
        session.visit(TASK, STEPS[number].scenario)
        self._keep(NUMBERS[number])
        if STEPS[number].grows:
            session.jobs.submit(LANE, partial(self._grow, session, number), latest=True)

    def _grow(self, session: Session, number: int) -> None:
        """Play the warp once the motion is there that it begins with."""
        session.wait_idle()
        if self.number == number:
            self._warp[1].act(PLAY)

    def _write(self) -> None:
        step, number = self.step, self.number
        self._card.visible = self._arrows.visible = self._buttons.visible = step is not None
        for control in self._warp:
            control.handle.visible = step is not None and step.grows
        if step is not None and number is not None:
            self._offer.visible = False
            self._card.content = card_html(step, number)
            self._buttons.options = (*(BACK,) * (number > 0), *(NEXT,) * (number < len(STEPS) - 1), END)

    def _keep(self, text: str) -> None:
        self._storage.set_item(KEY, text)


def _stop_playing(session: Session) -> None:
    player.stop(session)
    session.jobs.wait_idle(player.LANE)


def card_html(step: TourStep, number: int) -> str:
    """Return the text of a step of a number, from 0."""
    title = f"<b>{number + 1} of {len(STEPS)} · {html.escape(step.title)}</b>"
    formula = f"<div style='text-align:center;padding:0.3em;font-size:1.15em'>{step.formula}</div>"
    trial = f"<b>Try:</b> {html.escape(step.trial)}"
    style = f"margin:0 -0.2em;padding:0.5em 0.7em;border-left:3px solid {css(LIGHT.goal)};background:{PAPER}"
    return small(f"<div role='note' style='{style}'>{title}<br/>{html.escape(step.text)}{formula}{trial}</div>")
