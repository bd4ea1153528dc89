"""The ball by which the user holds the arm's hand."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import viser

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Frame
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import Pull

RADIUS = 0.016
"""Radius of the ball, metres: easy to hit, hardly wider than the fingers."""

Held = Callable[[Array, str], None]
"""Callback with the desired place of the hand, (3,), metres, and the phase of the drag: "start", "update" or "end"."""


class Grip:
    """A ball that moves with the hand, and is dragged parallel to the slice."""

    def __init__(
        self, scene: viser.SceneApi, robot: Robot, hand: str, where: Callable[[], Array | None], held: Held
    ) -> None:
        """Attach the ball to the hand.

        Args:
            scene: scene of the visitor.
            robot: the arm.
            hand: node of its last joint.
            where: returns the current place of the hand, (3,), metres; None before it moves.
            held: called with each event of a drag.
        """
        self.ball = scene.add_icosphere(
            f"{hand}/grip",
            radius=RADIUS,
            color=palette.WAY,
            position=robot.end_effector_offset,
            opacity=0.85,
            cast_shadow=False,
        )
        self._note = scene.add_label(
            f"{hand}/grip/note",
            "",
            position=(0.0, 0.0, 0.0),
            anchor="bottom-left",
            font_screen_scale=0.8,
            visible=False,
        )
        self.ball.visible, self._said = False, ""
        self._slice: Slice | None = None
        pull = Pull()

        def dragged(drag: Drag) -> None:
            hand = where()
            held(pull.place(drag, drag.grabbed if hand is None else hand, self._slice), drag.phase)

        gestures.on_drag(self.ball, dragged)

    def draw(self, frame: Frame, *, live: bool) -> None:
        """Show the ball while the arm is in the loop, and remember the slice that it is dragged in."""
        self._slice = frame.slice
        self.ball.visible = live

    def say(self, warning: str) -> None:
        """Show a warning beside the hand; none if it is empty."""
        if warning != self._said:
            self._said = warning
            self._note.text = warning or self._note.text
            self._note.visible = bool(warning)

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the ball while a picture is made."""
        shown, self.ball.visible = self.ball.visible, False
        try:
            yield
        finally:
            self.ball.visible = shown
