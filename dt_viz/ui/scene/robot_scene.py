"""The robot in the scene of one visitor, and what moves with it: other arms, what it carries and draws, its path."""

from __future__ import annotations

from contextlib import nullcontext

import viser

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Frame, Stage
from dt_viz.ui.playback import Playback, Replay
from dt_viz.ui.scene.arm import Arms
from dt_viz.ui.scene.carried import Carried, HandPath
from dt_viz.ui.scene.comparison import TheirArm
from dt_viz.ui.scene.draggables import Grip
from dt_viz.ui.scene.palette import LIGHT, Theme
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.tubes import RolloutTubes


class RobotScene:
    """A playback's arm, and what moves with it."""

    def __init__(self, client: viser.ClientHandle, robot: Robot, playback: Playback) -> None:
        """Build it in the scene of a visitor."""
        scene = client.scene
        self._client, self._robot, self.playback = client, robot, playback
        self.arms, self.their_arm = Arms(scene, robot), TheirArm(scene, robot)
        node = self.arms.arm.frames[-1].name
        self.carried = Carried(scene, node, robot.end_effector_offset, robot.hand_axis)
        self.path = HandPath(scene)
        self.grip = Grip(scene, robot, node, lambda: self.hand, self._hold)
        self._view, self._theme = View(), LIGHT
        self._aside = False  # whether what the arm is about to do is not shown
        self._posed: tuple[bytes, bool, int] | None = None
        """The posture that was drawn last, whether with that without avoidance, and after how many jumps."""

    def remove(self) -> None:
        """Take it from the scene."""
        for node in (self.arms.arm.frames[0], self.arms.ghost.node, self.arms.body.node, self.their_arm.node):
            node.remove()
        self.carried.remove()
        self.path.node.remove()

    @property
    def hand(self) -> Array | None:
        """Where the hand is, (3,), metres; None before it moves."""
        q = self.playback.arm.q
        return None if q is None else self._robot.end_effector(q)

    def paint(self, theme: Theme) -> None:
        """Take the colours of a theme."""
        self._theme = theme
        for lines in (self.path.ahead, self.carried.drawing.ink):
            lines.paint(theme)

    def draw(self, frame: Frame, look: Look) -> None:
        """Take what a frame has of the arm."""
        self.their_arm.draw(frame)
        self.their_arm.show(bool(self._view.their_arm))
        self.carried.stand(frame.task)
        if frame.blocked or frame.stage is not Stage.ROLLOUTS:  # until then the arm stays where it was
            self.arms.arm.stale = self._view.replay and look.blocked
        if frame.stage is not Stage.ROLLOUTS:
            self.playback.replay.motion = frame.arm
            self.grip.draw(frame, look)
            self._show_way()

    def set_aside(self, aside: bool) -> None:
        """Hide the way, the grip and what is carried, or show them again."""
        self._aside = aside
        self._show_way()

    def _show_way(self) -> None:
        view, live = self._view, self.playback.arm is self.playback.live
        self.carried.show(arm=view.arm and not self._aside)
        self.path.visible = view.arm and live and not self._aside
        self.grip.visible = live and (not self._aside or self.grip.guides)

    def adopt(self, view: View, look: Look) -> None:
        """Show and hide what a view says, beside a frame that was drawn with a look."""
        self._view, arm = view, self.arms.arm
        arm.stale = view.replay and (arm.stale or look.blocked)
        self.arms.show(view)
        self.their_arm.show(bool(view.their_arm))
        if view.replay:  # a drag of the ball ends without an event
            self.playback.live.release()
        self.playback.play(view.playing, view.speed, replays=view.replay)
        self._show_way()

    def pose(self, now: float, tubes: RolloutTubes) -> None:
        """Draw all where it is at a moment, seconds; called by the playback's thread.

        Args:
            now: moment, seconds.
            tubes: tubes of the rollouts, along which the path ahead is not drawn.
        """
        playback, arm, view = self.playback, self.playback.arm, self._view
        q = arm.q
        if q is None:
            return
        before, posed = self._posed, (q.tobytes(), view.ghost_arm or view.body_points, playback.jumps)
        moves, jumped = posed != before, before is not None and posed[2] != before[2]
        # a block wakes the connection, also if nothing is sent
        drawn = moves or bool(view.their_arm) or self.path.is_due(now)
        with self._client.atomic() if drawn else nullcontext():
            if moves:
                self._posed = posed
                without = arm.undisturbed if posed[1] else None
                self.arms.pose(q, q if without is None else without)
            if jumped:
                self._show_way()
                joints, arrived = playback.trace
                self.carried.retrace(self._robot.end_effector(joints) if len(joints) else joints, arrived, self._theme)
            hand = self._robot.end_effector(q)
            sets_out = self.carried.pose(now, hand, arm.arrived, self._theme)
            clock = arm.clock if isinstance(arm, Replay) and arm is not playback.past else None
            self.their_arm.pose(now, q, playback.pace, sets_out=sets_out, clock=clock)
            if arm is playback.live:
                self.path.show(now, hand, lambda: playback.live.ahead, tubes, self._theme)
                self.grip.say(playback.note)
            else:
                self.path.forget()

    def _hold(self, place: Array, phase: str) -> None:
        self.playback.live.hold(place)
        if phase == "end":
            self.playback.live.release()
