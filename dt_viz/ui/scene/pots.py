"""The pots of a task, standing on the table."""

from __future__ import annotations

import viser

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array, Indices
from dt_viz.obstacles.shapes import lathe
from dt_viz.scenario.tasks import Pot, Task
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Picture

WALL = 0.004
"""Thickness of the walls, metres."""
NUM_SIDES = 64


class Pots(Picture):
    """The pots as open cylinders."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._scene = scene
        super().__init__(scene.add_frame("/pots", show_axes=False))
        self._task: Task | None = None
        self.handles: tuple[viser.MeshHandle, ...] = ()

    def draw(self, frame: Frame) -> None:
        """See `Picture`."""
        if frame.task is self._task:
            return
        self._task = frame.task
        for handle in self.handles:
            handle.remove()
        self.handles = tuple(
            self._scene.add_mesh_simple(
                f"/pots/{k}", *surface(pot), color=palette.POT, position=(pot.x, pot.y, 0.0), flat_shading=True
            )
            for k, pot in enumerate(frame.task.pots)
        )


def surface(pot: Pot) -> tuple[Array, Indices]:
    """Return vertices (V, 3), metres, above the middle of its bottom, and faces (F, 3), outward."""
    inner, outer = pot.radius, pot.radius + WALL
    profile = [(0.0, 0.0), (outer, 0.0), (outer, pot.height), (inner, pot.height), (inner, WALL), (0.0, WALL)]
    return lathe(profile, NUM_SIDES)
