"""Paths as shaded tubes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import viser
from scipy.spatial import KDTree

from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.tubes import evenly_bent, tubes
from dt_viz.memo import cached_property
from dt_viz.ui.scene.palette import LIGHT, Style, Theme

NUM_RINGS, NUM_SIDES = 80, 7  # numbers of rings along a tube, and of corners of a ring
INSIDE = 0.0035
"""Distance of a line from the middle of a rollout up to which it counts as inside its tube, metres."""


class Tubes:
    """Paths of one look as tubes: one mesh, of which a drag moves the vertices."""

    def __init__(self, scene: viser.SceneApi, name: str, style: Style) -> None:
        """Make an empty set of this name in the scene tree."""
        self._style = style
        self.node = scene.add_mesh_simple(
            name,
            *_NOTHING,
            color=style.on(LIGHT),
            opacity=style.opacity,
            cast_shadow=style.opacity is None,
        )

    def show(self, middles: Array, theme: Theme, *, scale: float = 1.0) -> None:
        """Show paths: two messages where their number changes, so the caller must hold an atomic block.

        Args:
            middles: (R, `NUM_RINGS`, 3), as of `middles_of`, metres.
            theme: colours.
            scale: thickness of tubes and balls, relative to the usual one.
        """
        vertices, faces = _NOTHING
        if len(middles):
            vertices = tubes(middles, scale * self._style.radius, scale * self._style.ball, NUM_SIDES)
            faces = tube_faces(*vertices.shape[:3])
        if len(faces) != len(self.node.faces):
            self.node.faces = np.asarray(faces, np.uint32)
        self.node.vertices = vertices.reshape(-1, 3)
        self.node.color = self._style.on(theme)


_NOTHING = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]])  # a triangle without size


@lru_cache(maxsize=16)
def tube_faces(num: int, num_rings: int, num_sides: int) -> Indices:
    """Return the faces (F, 3), outward, of so many tubes."""
    corner = np.arange(num * num_rings * num_sides).reshape(num, num_rings, num_sides)
    a, b = corner[:, :-1], corner[:, 1:]
    c, d = np.roll(a, -1, axis=2), np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, c, b], axis=-1), np.stack([c, d, b], axis=-1)], axis=-2)
    return faces.reshape(-1, 3)


def middles_of(paths: Sequence[Array]) -> Array:
    """Return the middles (R, `NUM_RINGS`, 3) of the rings of tubes around paths (T_i, 3), metres."""
    middles = [evenly_bent(np.array(path, float, order="C"), NUM_RINGS) for path in paths]
    return np.stack(middles) if middles else np.zeros((0, NUM_RINGS, 3))


@dataclass(frozen=True, eq=False)
class RolloutTubes:
    """Where the tubes of a frame's rollouts lie, computed once for all that is drawn beside them."""

    rollouts: tuple[Array, ...] = ()  # (T_i, 3), metres; empty ones have no tube
    shown: bool = True  # whether the tubes are shown; hidden ones cover nothing

    @cached_property
    def middles(self) -> Array:
        """Middles (R, `NUM_RINGS`, 3) of the tubes' rings, metres."""
        return middles_of([path for path in self.rollouts if len(path)])

    @cached_property
    def _samples(self) -> KDTree:
        """Points along the middles, a few millimetres apart."""
        part = np.arange(5)[:, None] / 5
        pieces = self.middles[:, :-1, None] + part * np.diff(self.middles, axis=1)[:, :, None]
        return KDTree(np.concatenate([pieces.reshape(-1, 3), self.middles[:, -1]]))

    def outside(self, segments: Array, distance: float = INSIDE) -> Array:
        """Return those of the segments (K, 2, 3) farther than a distance from the middles, all in metres."""
        if not self.shown or not self.rollouts:
            return segments
        away, _ = self._samples.query(segments.mean(axis=1), distance_upper_bound=distance)
        return segments[np.isinf(away)]
