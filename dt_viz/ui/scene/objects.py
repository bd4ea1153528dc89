"""The objects of a task: what stands on the table, and what the hand moves."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.objects import Hand, TaskObject
from dt_viz.scenario.tasks import Task
from dt_viz.ui.scene import palette


class Objects:
    """The pots of a task, and its objects; these are shown with the arm only."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        self._task: Task | None = None
        self._arm = True
        self._hand: Hand | None = None
        self.pots: tuple[viser.MeshHandle, ...] = ()
        self.items: tuple[tuple[TaskObject, viser.MeshHandle], ...] = ()
        """What the hand moves, and its picture."""

    def stand(self, task: Task) -> None:
        """Show the objects of a task where they are at first, unless they are shown."""
        if task is self._task:
            return
        for handle in (*self.pots, *(handle for _, handle in self.items)):
            handle.remove()
        self._task, self._hand = task, None
        self.pots = tuple(
            self._scene.add_mesh_simple(
                f"/pots/{k}", *pot.surface(), color=palette.POT, position=(pot.x, pot.y, 0.0), flat_shading=True
            )
            for k, pot in enumerate(task.pots)
        )
        self.items = tuple((each, self._added(k, each)) for k, each in enumerate(task.objects))

    def show(self, *, arm: bool) -> None:
        """Show what the hand moves only with the arm."""
        self._arm = arm
        self._show()

    def pose(self, hand: Array, arrived: float) -> None:
        """Let the hand go on.

        Args:
            hand: (3,) where it is, metres.
            arrived: time since it came to the goal, seconds; 0 until it does.
        """
        last = self._hand
        sets_out = last is None or (arrived == 0 and last.arrived > 0)
        goal = hand if last is None or arrived == 0 or last.arrived == 0 else last.goal
        self._hand = now = Hand(hand, hand if last is None else last.place, goal, arrived)
        for each, handle in self.items:
            if sets_out:
                handle.position = hand if each.start is None else each.start
            place = np.asarray(handle.position)
            moved = each.moved(place, now)
            if (
                moved is not place
            ):  # comparing places, as an assignment does, takes longer than most pictures of an object
                handle.position = moved
        if last is None:
            self._show()

    def _added(self, k: int, each: TaskObject) -> viser.MeshHandle:
        place = np.zeros(3) if each.start is None else each.start
        visible = self._arm and each.start is not None
        look = {"color": palette.OBJECT, "flat_shading": True, "visible": visible}
        return self._scene.add_mesh_simple(f"/objects/{k}", *each.surface(), position=place, **look)

    def _show(self) -> None:
        for each, handle in self.items:
            handle.visible = self._arm and (self._hand is not None or each.start is not None)
