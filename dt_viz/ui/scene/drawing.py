"""Drawing: the pen in the hand, the board, and the ink that the pen leaves where it touches the board."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.obstacles.surfaces import lathe
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines

TOUCHES = 0.006
"""Distance of the pen's tip from the board at which it leaves ink, metres."""
STEP = 0.004
"""Shortest piece of ink, metres."""
PERIOD = 0.12
"""Time between two drawings of the ink, seconds: each sends all of it to the browser."""
PEN = ((0.0, 0.0), (0.0055, 0.022), (0.0075, 0.028), (0.0075, 0.15), (0.0, 0.15))
"""Profile of the pen: distances from its axis and from its tip, metres."""


class Drawing:
    """Board, pen and ink of a task that draws."""

    def __init__(self, scene: viser.SceneApi, hand: str, tip: Array) -> None:
        """Make them, hidden.

        Args:
            scene: scene of the visitor.
            hand: name of the hand in the scene tree.
            tip: (3,) where the end effector is, in the hand's frame, metres; the pen's axis leads there.
        """
        self._board = scene.add_mesh_simple(
            "/board",
            np.zeros((4, 3), np.float32),
            np.array([[0, 1, 2], [0, 2, 3]]),
            color=palette.BOARD,
            opacity=0.06,
            side="double",
            cast_shadow=False,
            receive_shadow=False,
            visible=False,
        )
        vertices, faces = lathe(PEN, 24)
        if tip[2] > 0:
            vertices = vertices * [1.0, -1.0, -1.0]  # turned about x: towards the hand
        self._pen = scene.add_mesh_simple(f"{hand}/pen", tip + vertices, faces, color=palette.INK, visible=False)
        self.ink = Lines(scene, "/ink", palette.INK, 0.005)
        self._task: Task | None = None
        self._arm = True
        self._area: Slice | None = None
        self._strokes: list[list[Array]] = []
        self._touched = False
        self._arrived, self._drawn = 0.0, -np.inf
        self._show()

    def stand(self, task: Task) -> None:
        """Show the board of a task, empty, unless it is shown."""
        if task is self._task:
            return
        self._task, self._area = task, task.slice if task.draws else None
        self._wipe()
        if self._area is not None:
            self._board.vertices = self._area.border[:4].astype(np.float32)
        self._show()

    def show(self, *, arm: bool) -> None:
        """Show all only with the arm."""
        self._arm = arm
        self._show()

    def dye(self, dark: bool) -> None:
        """Take the colours of the dark theme, or of the light one."""
        self.ink.dye(dark)

    def pose(self, moment: float, hand: Array, arrived: float) -> None:
        """Let the hand go on; when it sets out again, the board is wiped.

        Args:
            moment: now, seconds.
            hand: (3,) where the pen's tip is, metres.
            arrived: time since it came to the goal, seconds; 0 until it does.
        """
        if self._area is None:
            return
        if arrived == 0 and self._arrived > 0:
            self._wipe()
        self._arrived = arrived
        touches = arrived == 0 and abs(float((hand - self._area.centre) @ self._area.normal)) < TOUCHES
        if touches and not self._touched:
            self._strokes.append([hand])
        elif touches and np.linalg.norm(hand - self._strokes[-1][-1]) > STEP:
            self._strokes[-1].append(hand)
        self._touched = touches
        if moment - self._drawn > PERIOD and touches:
            self._drawn = moment
            self.ink.show([np.array(stroke) for stroke in self._strokes if len(stroke) > 1])

    def _wipe(self) -> None:
        self._strokes, self._touched = [], False
        self.ink.show([])

    def _show(self) -> None:
        for node in (self._board, self._pen, self.ink.node):
            node.visible = self._arm and self._area is not None
