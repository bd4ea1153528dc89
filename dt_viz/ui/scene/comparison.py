"""Other methods beside ours in the scene: their motions, and the arm along one of them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import viser

from dt_viz.baselines.base import Method
from dt_viz.baselines.registry import OURS, others
from dt_viz.flows.fields import Array
from dt_viz.metrics import distance_from_path
from dt_viz.robot.robot import Robot
from dt_viz.session.frame import Compared, Frame, Stage
from dt_viz.ui.playback import Replay
from dt_viz.ui.scene.arm import GhostArm
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import LIGHT, STYLES, Colour
from dt_viz.ui.scene.picture import Lines, Look, Picture, add_label

APART = 0.045  # height of one name above another, metres


def number_of(method: Method) -> int:
    """Return the number of a method beside ours, by which the styles of compared motions have its colour."""
    return others().index(method)


def colour_of(method: Method) -> Colour:
    """Return the colour of a method's motions on the page."""
    return LIGHT.rollout if method is OURS else STYLES.compared.on(LIGHT, number_of(method))


def followed(frame: Frame) -> list[Compared]:
    """Return the methods beside ours of which a motion is followed: those that are seen."""
    return [one for one in frame.comparison if one.method is not OURS and len(one.paths) > one.rollout]


class _DrawnMotions:
    """Motions of one method, and its name beside them."""

    def __init__(self, scene: viser.SceneApi, method: Method) -> None:
        node, number = f"/compared/{method.name}", number_of(method)
        self.node = scene.add_frame(node, show_axes=False)
        self.followed = Lines(scene, f"{node}/followed", STYLES.compared_followed, number)
        self.others = Lines(scene, f"{node}/others", STYLES.compared, number)
        self.label = add_label(scene, f"{node}/name", method.title)


class ComparedMotions(Picture):
    """Motions of the methods that the view compares with ours, each in its colour."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/compared", show_axes=False, visible=False))
        self._scene = scene
        self.motions: dict[Method, _DrawnMotions] = {}  # of the methods that were ever shown

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide the names beside the motions: a picture has the legend instead."""
        for motions in self.motions.values():
            motions.label.visible = False
        try:
            yield
        finally:
            for motions in self.motions.values():
                motions.label.visible = True

    def draw(self, frame: Frame, look: Look) -> None:
        shown = followed(frame)
        methods = {compared.method for compared in shown}
        marks = [
            (method.title, colour_of(method)) for method in (OURS, *others()) if method is OURS or method in methods
        ]
        self.legend = Legend(tuple(marks)) if shown else None
        for method in set(self.motions) - methods:
            self.motions[method].node.visible = False
        names: list[Array] = []  # places of names, each where its motion is farthest from ours, clear of the others
        for compared in shown:
            ours = next(path for path in frame.rollouts[frame.chosen or 0 :] if len(path))
            if compared.method not in self.motions:
                self.motions[compared.method] = _DrawnMotions(self._scene, compared.method)
            motions, rollout = self.motions[compared.method], compared.rollout
            motions.followed.show([path := compared.paths[rollout]], look.theme)
            motions.others.show(compared.paths[:rollout] + compared.paths[rollout + 1 :], look.theme)
            motions.node.visible = True
            place = path[np.argmax(distance_from_path(path, ours))] + np.array([0.0, 0.0, 0.012])
            while any(np.linalg.norm(place - other) < 0.9 * APART for other in names):
                place = place + np.array([0.0, 0.0, APART])
            names.append(place)
            motions.label.position = place


class TheirArm:
    """The arm along a motion of a method beside ours: it begins anew when our arm does."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._ghost = GhostArm(scene, robot, "/their_arm")
        self.node = self._ghost.node
        self._replay, self._seen = Replay(), 0.0

    def draw(self, frame: Frame) -> None:
        """Take the motion of a frame; without one, as while its method waits for the obstacle to rest, it is hidden."""
        if frame.stage is Stage.ROLLOUTS:
            return
        self._replay.motion = None
        for compared in frame.comparison:
            if compared.arm is not None:
                self._replay.motion = compared.arm
                for link in self._ghost.links:
                    link.color = colour_of(compared.method)

    def show(self, shown: bool) -> None:
        """Show or hide it; it is hidden until it has a motion."""
        self._ghost.visible = shown and self._replay.motion is not None

    def pose(self, now: float, q: Array, pace: float, *, sets_out: bool, clock: float | None = None) -> None:
        """Go on to a moment, seconds, at a pace relative to real time, beside our arm at `q` (n,), rad.

        Where our motion is played, its `clock` is theirs, too; see `Replay.clock`.
        """
        before, self._seen = self._seen, now
        if not self._ghost.visible:
            return
        if sets_out or clock is not None:
            self._replay.restart()
        self._replay.advance(pace * (now - before) if clock is None else clock)
        theirs = self._replay.q
        if theirs is not None:
            self._ghost.pose(q, theirs)
