"""Other methods beside ours in the scene: their motions, and the arm along one of them."""

from __future__ import annotations

import time
from collections.abc import Mapping
from itertools import cycle

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.metrics import distance_from_path
from dt_viz.robot.robot import Robot
from dt_viz.session.comparison import OTHERS
from dt_viz.session.frame import Compared, Frame, Stage
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.arm import GhostArm
from dt_viz.ui.scene.picture import Colour, Lines, Picture

COLOURS: Mapping[str, Colour] = {
    method.name: colour for method, colour in zip(OTHERS, cycle(palette.COMPARED), strict=False)
}
"""Colour of each method's motions, by its name."""
BOLD, THIN = 0.0055, 0.0014
"""Thickness of the motion beside the one that the arm follows, and of the others, metres."""
ABOVE, APART = 0.012, 0.045
"""Height of a name above its motion, and of one name above another, metres."""


class _DrawnMotions:
    """Motions of one method, and its name beside them."""

    def __init__(self, scene: viser.SceneApi, name: str, title: str) -> None:
        node = f"/compared/{name}"
        self.node = scene.add_frame(node, show_axes=False)
        self.lines = {
            thickness: Lines(scene, f"{node}/{part}", COLOURS[name], thickness)
            for part, thickness in (("followed", BOLD), ("others", THIN))
        }
        self.label = scene.add_label(f"{node}/name", title, anchor="bottom-center", font_screen_scale=0.8)

    def show(self, compared: Compared, ours: Array, names: list[Array]) -> None:
        """Show motions, with the name where they are farthest from ours.

        Args:
            compared: the motions.
            ours: (N, 3) path, metres.
            names: places (3,) of other names, metres, which this one is kept clear of; it is appended.
        """
        followed, others = [], []
        for number, path in enumerate(compared.paths):
            (followed if number == compared.rollout else others).append(path)
        self.lines[BOLD].show(followed)
        self.lines[THIN].show(others)
        self.node.visible = bool(followed)
        if followed:
            (path,) = followed
            place = path[np.argmax(distance_from_path(path, ours))] + np.array([0.0, 0.0, ABOVE])
            while any(np.linalg.norm(place - other) < 0.9 * APART for other in names):
                place = place + np.array([0.0, 0.0, APART])
            names.append(place)
            self.label.position = place


class ComparedMotions(Picture):
    """Motions of the methods that the view compares with ours, each in its colour."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/compared", show_axes=False, visible=False))
        self._scene, self._dark = scene, False
        self.motions: dict[str, _DrawnMotions] = {}
        """Of the methods that were ever shown."""

    def draw(self, frame: Frame) -> None:
        shown = {compared.method.name: compared for compared in frame.comparison if compared.method.name in COLOURS}
        for name in set(self.motions) - set(shown):
            self.motions[name].node.visible = False
        names: list[Array] = []
        for name, compared in shown.items():
            if name not in self.motions:
                self.motions[name] = _DrawnMotions(self._scene, name, compared.method.title)
                self._dye(self.motions[name])
            self.motions[name].show(compared, frame.rollouts[frame.chosen or 0], names)

    def dye(self, dark: bool) -> None:
        self._dark = dark
        for motions in self.motions.values():
            self._dye(motions)

    def _dye(self, motions: _DrawnMotions) -> None:
        for lines in motions.lines.values():
            lines.dye(self._dark)


class TheirArm:
    """The arm along a motion of a method beside ours: it begins anew when our arm does."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._ghost = GhostArm(scene, robot, "/their_arm")
        self._replay, self._seen = Replay(), 0.0
        self._arrived = False
        """Whether our arm was at the goal when it was looked at last."""

    def draw(self, frame: Frame) -> None:
        """Take the motion of a frame; without one, as while its method waits for the obstacle to rest, it is hidden."""
        if frame.stage is Stage.ROLLOUTS:
            return
        self._replay.motion = None
        for compared in frame.comparison:
            if compared.arm is not None:
                self._replay.motion = compared.arm
                for link in self._ghost.links:
                    link.color = COLOURS[compared.method.name]

    def show(self, shown: bool) -> None:
        """Show or hide it; it is hidden until it has a motion."""
        self._ghost.visible = shown and self._replay.motion is not None

    def pose(self, q: Array, speed: float, *, arrived: bool) -> None:
        """Go on, at a speed relative to real time, beside our arm at `q` (6,), rad, at the goal or not."""
        now, before = time.monotonic(), self._seen
        self._seen = now
        if not self._ghost.visible:
            return
        if self._arrived and not arrived:
            self._replay.restart()
        self._arrived = arrived
        self._replay.advance(speed * (now - before))
        posture = self._replay.posture
        if posture is not None:
            self._ghost.pose(q, posture[0])
