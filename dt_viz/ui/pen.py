"""The pen of a visitor: points on the board, or of the hand that is guided, while the arm follows them."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Literal

from dt_viz.flows.fields import Array
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.starts import struck
from dt_viz.session.teaching import Stroke, board_of
from dt_viz.ui.host import Host
from dt_viz.ui.scene.markers import Drag, on_drag

LANE = "pen"  # lane of the session's jobs on which the line of a stroke is drawn
Kind = Literal["draw", "guide"]  # ways of teaching: on the board, or by the ball at the hand
Finished = Callable[[Stroke, Slice | None], None]
"""Callback that takes a stroke, and the board that it is on. It must only submit."""


class Pen:
    """Collects strokes, shows them as they come, and has the arm hold its hand where they are."""

    def __init__(self, page: Host) -> None:
        """Wait for `take_up` on a page."""
        self._page = page
        self._changing = threading.Lock()  # the event loop adds points that a job draws
        self._kind: Kind | None = None
        self._area: Slice | None = None
        self._stroke = Stroke()
        self._finished: Finished = lambda _stroke, _area: None
        on_drag(page.pictures.board.plate, self._drawn)

    def take_up(self, kind: Kind, finished: Finished) -> None:
        """Begin to teach in a way; called beside the server's event loop. The arm minds no obstacle meanwhile."""
        robot, session = self._page.robot, self._page.session
        self._stroke, self._finished, self._kind = Stroke(), finished, kind
        self._area = board_of(session.robot) if kind == "draw" else None
        if session.scenario.view.replay:  # its arm cannot be held
            session.step("replay", view=replace(session.scenario.view, replay=False))
        robot.playback.resume()
        robot.playback.live.see(None)
        robot.grip.guide(None if kind == "draw" else self._moved)
        robot.set_aside(True)
        board, theme = self._page.pictures.board, self._page.pictures.look.theme
        board.stand(self._area, theme)
        board.ink(self._stroke.points, session.robot, theme)
        board.visible = True
        self._page.face(self._area)

    def put_down(self) -> None:
        """End teaching, if it goes on: the arm goes on with its motion, around the obstacles."""
        if self._kind is None:
            return
        self._kind = None
        robot, session = self._page.robot, self._page.session
        self._page.pictures.board.visible = self._page.pictures.board.plate.visible = False
        robot.grip.guide(None)
        robot.playback.live.release()
        session.engine.see(session.scenario)

    def finish(self) -> None:
        """End the take that is guided."""
        with self._changing:
            stroke, self._stroke = self._stroke, Stroke()
        self._page.session.jobs.submit(LANE, self._ink, latest=True)
        if stroke.moments:
            self._finished(stroke, self._area)

    def _drawn(self, drag: Drag) -> None:
        """Draw where the pointer's ray meets the board: on its rim the pen leaves it."""
        if self._kind == "draw" and self._area is not None:
            if drag.phase == "start":
                self._stroke = Stroke()
            place = struck(self._area, drag.camera, drag.pointer - drag.camera)
            if place is not None:
                self._moved(place, drag.phase)
            if drag.phase == "end":
                self.finish()

    def _moved(self, place: Array, phase: str) -> None:
        if self._kind is None:
            return
        with self._changing:
            self._stroke.add(time.monotonic(), place, begins=phase == "start")
        self._page.robot.playback.live.hold(place)
        self._page.session.jobs.submit(LANE, self._ink, latest=True)

    def _ink(self) -> None:
        with self._changing:
            points = self._stroke.points
        self._page.pictures.board.ink(points, self._page.session.robot, self._page.pictures.look.theme)
