"""What the hand carries, the objects of a task and a pen, and what it leaves behind: ink on the board."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import lathe
from dt_viz.scenario.objects import Hand, TaskObject
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.tasks import Task
from dt_viz.ui.scene.palette import LIGHT, STYLES, Theme
from dt_viz.ui.scene.picture import Lines, Shown, assign
from dt_viz.ui.scene.tubes import RolloutTubes

TOUCHES = 0.006  # distance of the pen's tip from the board at which it leaves ink, metres
INK_STEP = 0.004  # shortest piece of ink, metres
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
        self._area: Slice | None = None  # board of the task; None if that does not draw
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
        self._hand: Hand | None = None  # where the hand was last; None before it moves in this task
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


TRAIL_SECONDS = 2.5  # time after which the trail has faded, seconds
TRAIL_STEP = 0.006  # shortest path of the hand that becomes a piece of the trail, metres
ALONG = 0.008
"""Distance from a rollout up to which the path ahead counts as along it, and is not drawn, metres."""
PATH_PERIOD = 0.2  # time between two drawings, seconds: each sends the whole line to the browser


class HandPath(Shown):
    """A line from the hand to where it is going, and a fading one to where it was."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/way", show_axes=False, visible=False))
        self.ahead = Lines(scene, "/way/ahead", STYLES.way)
        self._trail = Lines(scene, "/way/trail", STYLES.trail).node
        self._drawn, self._when = np.empty((0, 3)), -np.inf
        self._came: deque[tuple[float, Array]] = deque()  # when the hand was where, the newest last

    def is_due(self, moment: float) -> bool:
        """Whether `show` sends something at a moment, seconds."""
        return moment - self._when >= PATH_PERIOD

    def show(self, moment: float, hand: Array, going: Callable[[], Array], tubes: RolloutTubes, theme: Theme) -> None:
        """Show the path.

        Args:
            moment: now, seconds.
            hand: (3,) where the hand is, metres.
            going: returns (K, 3) where it is going, metres; asked for each drawing only.
            tubes: tubes of the rollouts, along which the path ahead is not drawn.
            theme: colours.
        """
        if not self._came or np.linalg.norm(hand - self._came[-1][1]) > TRAIL_STEP:
            self._came.append((moment, hand))
        if not self.is_due(moment):
            return
        self._when, ahead = moment, going()
        if not np.array_equal(ahead, self._drawn):
            self._drawn = ahead
            self.ahead.show_segments(tubes.outside(self.ahead.segments([ahead]), ALONG), theme)
        while self._came and moment - self._came[0][0] > TRAIL_SECONDS:
            self._came.popleft()
        times, places = np.array([t for t, _ in self._came]), [*(place for _, place in self._came), hand]
        pieces = np.stack([places[:-1], places[1:]], axis=1) if len(times) else np.zeros((0, 2, 3))
        if len(pieces) or len(self._trail.points):
            assign(self._trail, pieces, _faded((moment - times) / TRAIL_SECONDS, theme))

    def forget(self) -> None:
        """Forget where the hand came: it was put where it is."""
        self._came.clear()


def _faded(age: Array, theme: Theme) -> NDArray[np.uint8]:
    """Colours (K, 2, 3) of pieces of an age (K,) from 0 to 1."""
    fresh, old = (np.array(colour) for colour in (theme.way, theme.way_faded))
    colours = fresh + age[:, None] * (old - fresh)
    light = np.round(255 * (colours / 255) ** 2.2).astype(np.uint8)  # see `palette.linear`
    return np.repeat(light[:, None], 2, axis=1)
