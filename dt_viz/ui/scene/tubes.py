"""Paths as shaded tubes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import numpy as np
import viser

from dt_viz.flows.fields import Array, Indices
from dt_viz.metrics import interpolate
from dt_viz.ui.scene.picture import Colour

NUM_RINGS, NUM_SIDES = 80, 7
"""Numbers of rings along a tube, and of corners of a ring."""
TURN = 0.03
"""Length of a path that needs as many rings as a turn by one radian, metres."""
BALL_RINGS = 6
"""Number of rings of the ball at the beginning of a tube."""


class Tubes:
    """Paths of one look as tubes, each with a ball at its beginning: one mesh, of which a drag moves the vertices."""

    def __init__(
        self,
        scene: viser.SceneApi,
        name: str,
        colour: Colour,
        radius: float,
        *,
        ball: float = 0.0,
        opacity: float = 1.0,
    ) -> None:
        """Make an empty set.

        Args:
            scene: scene of the visitor.
            name: name in the scene tree.
            colour: colour of all tubes.
            radius: radius of a tube, metres.
            ball: radius of the ball at its beginning, metres; 0 makes none.
            opacity: from 0 to 1.
        """
        self._radius, self._ball = radius, ball
        self.node = scene.add_mesh_simple(
            name, *_NOTHING, color=colour, opacity=None if opacity == 1 else opacity, cast_shadow=opacity == 1
        )

    @property
    def colour(self) -> Colour:
        """Colour of all tubes."""
        return self.node.color

    @colour.setter
    def colour(self, colour: Colour) -> None:
        self.node.color = colour

    def show(self, middles: Array, *, scale: float = 1.0) -> None:
        """Show paths: two messages where their number changes, so the caller must hold an atomic block.

        Args:
            middles: (R, `NUM_RINGS`, 3), as of `middles_of`, metres.
            scale: thickness of tubes and balls, relative to the usual one.
        """
        vertices, faces = _NOTHING
        if len(middles):
            vertices = tubes(middles, scale * self._radius, scale * self._ball)
            faces = tube_faces(*vertices.shape[:3])
        if len(faces) != len(self.node.faces):
            self.node.faces = np.asarray(faces, np.uint32)
        self.node.vertices = vertices.reshape(-1, 3).astype(np.float32)


_NOTHING = np.zeros((3, 3), np.float32), np.array([[0, 1, 2]])
"""A triangle without size."""


def tubes(paths: Array, radius: float, ball: float = 0.0) -> Array:
    """Return the vertices (R, K, `NUM_SIDES`, 3) of tubes around paths (R, T, 3), metres, in K rings.

    The rings do not twist: their frames go along by double reflection (Wang et al., "Computation of Rotation
    Minimizing Frames", 2008), which takes a frame of each ring to one of the next.
    """
    tangents = np.gradient(paths, axis=1)
    tangents /= np.maximum(np.linalg.norm(tangents, axis=2, keepdims=True), 1e-12)
    least = np.eye(3)[np.abs(tangents).argmin(axis=2)]
    normals = least - (least * tangents).sum(axis=2, keepdims=True) * tangents
    normals /= np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    across, between = np.cross(tangents, normals), np.diff(paths, axis=1)
    normal, tangent = _reflected(between, normals[:, :-1]), _reflected(between, tangents[:, :-1])
    carried = _reflected(tangents[:, 1:] - tangent, normal)
    twist = np.arctan2((carried * across[:, 1:]).sum(axis=2), (carried * normals[:, 1:]).sum(axis=2))
    angle = np.pad(np.cumsum(twist, axis=1), ((0, 0), (1, 0)))[..., None]
    normals = np.cos(angle) * normals + np.sin(angle) * across
    turn = np.linspace(0, 2 * np.pi, NUM_SIDES, endpoint=False)[:, None]

    def ring(normal: Array, tangent: Array) -> Array:
        return np.cos(turn) * normal[..., None, :] + np.sin(turn) * np.cross(tangent, normal)[..., None, :]

    rings = paths[:, :, None] + radius * ring(normals, tangents)
    ends = np.broadcast_to(paths[:, -1:, None], rings[:, :1].shape)
    first, along = paths[:, :1, None], tangents[:, :1, None]
    if ball == 0:
        return np.concatenate([np.broadcast_to(first, ends.shape), rings, ends], axis=1)
    height = np.linspace(np.pi, 0, BALL_RINGS)[None, :, None, None]
    globe = first + ball * (np.cos(height) * along + np.sin(height) * ring(normals[:, :1], tangents[:, :1]))
    return np.concatenate([globe, rings, ends], axis=1)


@lru_cache(maxsize=16)
def tube_faces(num: int, num_rings: int, num_sides: int) -> Indices:
    """Return the faces (F, 3), outward, of so many tubes."""
    corner = np.arange(num * num_rings * num_sides).reshape(num, num_rings, num_sides)
    a, b = corner[:, :-1], corner[:, 1:]
    c, d = np.roll(a, -1, axis=2), np.roll(b, -1, axis=2)
    faces = np.stack([np.stack([a, c, b], axis=-1), np.stack([c, d, b], axis=-1)], axis=-2)
    return faces.reshape(-1, 3)


def evenly_bent(path: Array, num: int = NUM_RINGS) -> Array:
    """Return (num, 3) points of a path (T, 3), metres: the denser the more it bends."""
    pieces = np.diff(path, axis=0)
    length = np.linalg.norm(pieces, axis=1)
    directions = pieces / np.maximum(length, 1e-12)[:, None]
    turn = np.linalg.norm(np.diff(directions, axis=0, prepend=directions[:1]), axis=1)
    measure = np.concatenate([[0.0], np.cumsum(np.maximum(length + TURN * turn, 1e-12))])
    return interpolate(np.linspace(0, measure[-1], num), measure, path)


def middles_of(paths: Sequence[Array]) -> Array:
    """Return the middles (R, `NUM_RINGS`, 3) of the rings of tubes around paths (T_i, 3), metres."""
    return np.stack([evenly_bent(path) for path in paths]) if len(paths) else np.zeros((0, NUM_RINGS, 3))


def _reflected(across: Array, vectors: Array) -> Array:
    """Vectors (*B, 3) reflected in planes across others (*B, 3)."""
    size = np.maximum((across * across).sum(axis=-1, keepdims=True), 1e-18)
    return vectors - 2 * (across * vectors).sum(axis=-1, keepdims=True) / size * across
