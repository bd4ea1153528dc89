"""What pictures are made of: lines and arrows of one look, under one node of the scene tree."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array
from dt_viz.ui.scene import palette

Colour = tuple[int, int, int]


class Picture(ABC):
    """Something that is drawn from frames, under one node of the scene tree."""

    def __init__(self, node: viser.SceneNodeHandle) -> None:
        self._node = node

    @abstractmethod
    def draw(self, frame: Frame) -> None:
        """Show what the frame says."""

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self._node.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        if visible != self._node.visible:
            self._node.visible = visible  # first: a frame drawn meanwhile is then drawn by one of the two
            if visible:
                self._catch_up()

    def _catch_up(self) -> None:  # noqa: B027 - most pictures need none
        """Draw what was left out while it was hidden."""


class Lines:
    """Polylines of one look, as one set of line segments."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour, thickness: float, *, dash: float = 0) -> None:
        """Make an empty set.

        Args:
            scene: of the visitor.
            name: in the scene tree.
            colour: of all lines.
            thickness: metres.
            dash: length of a dash and of the gap after it, metres; 0 draws through.
        """
        self._colour = colour
        self._dash = dash
        self.node = scene.add_line_segments(
            name, np.zeros((1, 2, 3), np.float32), rgb(colour, (1, 2, 3)), thickness=thickness
        )

    def show(
        self,
        paths: Sequence[Array],
        marked: int | None = None,
        mark: Colour = palette.CHOSEN_ROLLOUT,
        colour: Colour | None = None,
    ) -> None:
        """Show these polylines (T_i, 3), metres, the one with index `marked` in the colour `mark`, in this `colour`."""
        segments: list[Array] = [np.zeros((0, 2, 3))]
        colours: list[NDArray[np.uint8]] = [np.zeros((0, 2, 3), np.uint8)]
        for index, path in enumerate(paths):
            pieces = np.stack([path[:-1], path[1:]], axis=1)
            if self._dash:
                middle = np.cumsum(np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1))
                pieces = pieces[(middle / self._dash).astype(int) % 2 == 0]
            segments.append(pieces)
            colours.append(rgb(mark if index == marked else colour or self._colour, pieces.shape))
        assign(self.node, np.concatenate(segments), np.concatenate(colours))

    def show_segments(self, segments: Array) -> None:
        """Show these segments (K, 2, 3), metres."""
        assign(self.node, segments, rgb(self._colour, segments.shape))


def assign(node: Any, points: Array, colours: NDArray[np.uint8]) -> None:  # noqa: ANN401 - lines, arrows and clouds
    """Give a node points (N, …), metres, and as many colours: two messages, for the browser to apply as one.

    So it must be done in an atomic block. Of no points there are no colours; the one that is sent instead means all.
    """
    node.points = points.astype(np.float32)
    node.colors = colours if len(colours) else np.zeros(3, np.uint8)


def rgb(colour: Colour, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """One colour for an array of points of lines of that shape."""
    return np.broadcast_to(np.array(palette.linear(colour), dtype=np.uint8), shape)


class Arrows:
    """Vectors at points: longer and darker is more."""

    def __init__(
        self, scene: viser.SceneApi, name: str, little: Colour, much: Colour, length: float, thickness: float = 1.0
    ) -> None:
        """Make an empty set.

        Args:
            scene: of the visitor.
            name: in the scene tree.
            little: colour of the shortest.
            much: colour of the longest.
            length: of the longest, metres.
            thickness: relative to that of the vector field.
        """
        self._little, self._much, self._length = np.array(little), np.array(much), length
        self.node = scene.add_arrows(
            name,
            np.zeros((1, 2, 3), np.float32),
            rgb(little, (1, 3)),
            shaft_radius=0.0011 * thickness,
            head_radius=0.0034 * thickness,
            head_length=0.0085 * thickness,
        )

    def show(self, points: Array, vectors: Array) -> None:
        """Show these vectors (N, 3), of any unit, in the middle of which the points (N, 3), metres, lie."""
        size = np.linalg.norm(vectors, axis=1, keepdims=True)
        # the largest lie where ψ⁻¹ stretches most; a high quantile keeps the others readable
        relative = np.minimum(size / np.quantile(size, 0.9), 1) if len(size) else size
        arrows = vectors / np.maximum(size, 1e-12) * self._length * (0.45 + 0.55 * relative)
        ends = np.stack([points - arrows / 2, points + arrows / 2], axis=1)
        assign(self.node, ends, (self._little + relative * (self._much - self._little)).astype(np.uint8))
