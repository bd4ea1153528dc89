"""The pots of a task, standing on the table."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array, Indices
from dt_viz.scenario.tasks import Pot, Task
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Picture

WALL = 0.004
"""Thickness, metres."""
NUM_SIDES = 64


class Pots(Picture):
    """Open cylinders."""

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
    """Vertices (V, 3), metres, above the middle of its bottom, and faces (F, 3), outward."""
    turn = 2 * np.pi * np.arange(NUM_SIDES) / NUM_SIDES
    ring = np.stack([np.cos(turn), np.sin(turn)], axis=1)
    inner, outer = pot.radius, pot.radius + WALL
    # the profile from the middle of the bottom outside, up over the rim, and down to the middle inside
    profile = ((0.0, 0.0), (outer, 0.0), (outer, pot.height), (inner, pot.height), (inner, WALL), (0.0, WALL))
    vertices = np.concatenate([np.column_stack([r * ring, np.full(NUM_SIDES, z)]) for r, z in profile])
    here, there = np.arange(NUM_SIDES), (np.arange(NUM_SIDES) + 1) % NUM_SIDES
    faces = []
    for k in range(len(profile) - 1):
        a, b, c, d = (
            here + k * NUM_SIDES,
            there + k * NUM_SIDES,
            there + (k + 1) * NUM_SIDES,
            here + (k + 1) * NUM_SIDES,
        )
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    return vertices, np.concatenate(faces)
