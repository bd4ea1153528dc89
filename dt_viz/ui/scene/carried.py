"""What the hand carries, the objects of a task and a pen, and what it leaves behind: ink on the board."""

from __future__ import annotations

import numpy as np
import viser
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import lathe
from dt_viz.scenario.objects import Hand, TaskObject
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.ui.scene.palette import LIGHT, Theme
from dt_viz.ui.scene.picture import Lines
from dt_viz.ui.scene.style import STYLES

TOUCHES = 0.006
"""Distance of the pen's tip from the board at which it leaves ink, metres."""
INK_STEP = 0.004
"""Shortest piece of ink, metres."""
INK_PERIOD = 0.12
"""Time between two drawings of the ink, seconds: each sends all of it to the browser."""


class Drawing:
    """Board, pen and ink of a task that draws."""

    def __init__(self, scene: viser.SceneApi, hand: str, tip: Array, axis: Array) -> None:
        """Make them, hidden.

        Args:
            scene: scene of the visitor.
            hand: name of the hand in the scene tree.
            tip: (3,) where the end effector is, in the hand's frame, metres.
            axis: (3,) direction of the hand, and of the pen to its tip, in that frame.
        """
        self.board = scene.add_mesh_simple(
            "/board",
            np.zeros((4, 3), np.float32),
            np.array([[0, 1, 2], [0, 2, 3]]),
            color=STYLES.board.on(LIGHT),
            opacity=STYLES.board.opacity,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        # distances from the pen's axis and from its tip, metres
        vertices, faces = lathe(((0.0, 0.0), (0.0055, 0.022), (0.0075, 0.028), (0.0075, 0.15), (0.0, 0.15)), 24)
        back = -axis / np.linalg.norm(axis)
        across = np.array([-back[1], back[0], 0.0])  # z × back
        slope = float(np.linalg.norm(across))
        turn = Rotation.from_rotvec(np.arctan2(slope, back[2]) * (across / slope if slope > 1e-9 else np.eye(3)[0]))
        self._pen = scene.add_mesh_simple(
            f"{hand}/pen", tip + turn.apply(vertices), faces, color=LIGHT.ink, visible=False
        )
        self.ink = Lines(scene, "/ink", STYLES.ink)
        self._area: Slice | None = None
        """Board of the task; None if that does not draw."""
        self._strokes: list[list[Array]] = []
        self._touched, self._drawn = False, -np.inf

    def stand(self, task: Task) -> None:
        """Take the board of another task, empty."""
        self._area = task.slice if task.draws else None
        self._wipe()
        if self._area is not None:
            self.board.vertices = self._area.border[:4].astype(np.float32)

    def show(self, *, arm: bool) -> None:
        """Show all only with the arm."""
        for node in (self.board, self._pen, self.ink.node):
            node.visible = arm and self._area is not None

    def pose(self, moment: float, hand: Hand, theme: Theme, *, sets_out: bool) -> None:
        """Let the hand, where the pen's tip is, go on to a moment, seconds; where it sets out, the board is wiped."""
        if self._area is None:
            return
        if sets_out:
            self._wipe()
        place = hand.place
        touches = hand.arrived == 0 and abs(float((place - self._area.centre) @ self._area.normal)) < TOUCHES
        strokes = self._strokes  # another thread may wipe the board meanwhile
        if touches and not (self._touched and strokes):
            strokes.append([place])
        elif touches and np.linalg.norm(place - strokes[-1][-1]) > INK_STEP:
            strokes[-1].append(place)
        self._touched = touches
        if moment - self._drawn > INK_PERIOD and touches:
            self._drawn = moment
            self.draw(theme)

    def draw(self, theme: Theme) -> None:
        """Show all that the pen has drawn."""
        self.ink.show([np.array(stroke) for stroke in self._strokes if len(stroke) > 1], theme)

    def _wipe(self) -> None:
        self._strokes, self._touched = [], False
        self.ink.node.points = np.zeros((0, 2, 3), np.float32)


class Carried:
    """What the hand carries, and what it draws, shown with the arm only, and the pots of a task.

    All begins anew when the hand sets out from a start.
    """

    def __init__(self, scene: viser.SceneApi, node: str, tip: Array, axis: Array) -> None:
        """Begin with nothing; see `Drawing`."""
        self._scene, self.drawing = scene, Drawing(scene, node, tip, axis)
        self._arm = True
        self._task: Task | None = None
        self._hand: Hand | None = None
        """Where the hand was last; None before it moves in this task."""
        self.pots: tuple[viser.MeshHandle, ...] = ()
        self.items: tuple[tuple[TaskObject, viser.MeshHandle], ...] = ()
        """What the hand moves, and its picture."""

    def stand(self, task: Task) -> None:
        """Show the objects of a task where they are at first, unless they are shown."""
        if task is self._task:
            return
        self._clear()
        self._task, self._hand, add = task, None, self._scene.add_mesh_simple
        self.pots = tuple(
            add(f"/pots/{k}", *pot.surface(), color=LIGHT.pot, position=(pot.x, pot.y, 0.0), flat_shading=True)
            for k, pot in enumerate(task.pots)
        )
        self.items = tuple(
            (each, add(f"/objects/{k}", *each.surface(), color=LIGHT.object, flat_shading=True))
            for k, each in enumerate(task.objects)
        )
        for each, handle in self.items:
            handle.position = np.zeros(3) if each.start is None else each.start
        self.drawing.stand(task)
        self.show(arm=self._arm)

    def _clear(self) -> None:
        for handle in (*self.pots, *(handle for _, handle in self.items)):
            handle.remove()

    def remove(self) -> None:
        """Take all from the scene but what is in the hand."""
        self._clear()
        for node in (self.drawing.board, self.drawing.ink.node):
            node.remove()

    def show(self, *, arm: bool) -> None:
        """Show all only with the arm, and what begins in the hand once that is known."""
        self._arm = arm
        for each, handle in self.items:
            handle.visible = arm and (self._hand is not None or each.start is not None)
        self.drawing.show(arm=arm)

    def retrace(self, places: Array, arrived: Array, theme: Theme) -> None:
        """Begin anew, and let the hand go along places (K, 3), metres, with the times since it arrived (K,), s."""
        self._hand = None
        for place, rested in zip(places, arrived, strict=True):
            self.pose(-np.inf, place, rested, theme)
        self.drawing.draw(theme)

    def pose(self, now: float, place: Array, arrived: float, theme: Theme) -> bool:
        """Let the hand go on; return whether it sets out from a start.

        Args:
            now: moment, seconds.
            place: (3,) where the hand is, metres.
            arrived: time since it came to the goal, seconds; 0 until it does.
            theme: colours.
        """
        begins, last = self._hand is None, self._hand or Hand(place, place, place, arrived)
        sets_out = begins or (arrived == 0 and last.arrived > 0)
        goal = place if arrived == 0 or last.arrived == 0 else last.goal
        self._hand = hand = Hand(place, last.place, goal, arrived)
        for each, handle in self.items:
            if sets_out:
                handle.position = hand.place if each.start is None else each.start
            before = np.asarray(handle.position)
            moved = each.moved(before, hand)
            if moved is not before:  # comparing, as an assignment does, takes longer than most pictures of an object
                handle.position = moved
        if begins:
            self.show(arm=self._arm)
        self.drawing.pose(now, hand, theme, sets_out=sets_out)
        return sets_out
