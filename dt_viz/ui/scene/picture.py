"""Elements of pictures: lines and arrows of one look, and what is shown and hidden under one node of the scene tree."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.session.engine import ArmMotion
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette

Colour = tuple[int, int, int]


class Shown:
    """A part of the page under one node, which can be hidden."""

    def __init__(self, node: Any) -> None:  # noqa: ANN401 - a node of the scene, or a folder of the panel
        self.node = node

    @property
    def visible(self) -> bool:
        """Whether it is shown."""
        return self.node.visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        if visible != self.node.visible:
            self.node.visible = visible  # first, so that a frame that comes meanwhile is drawn
            if visible:
                self._catch_up()

    def _catch_up(self) -> None:
        """Draw what was left out while it was hidden; most parts need nothing."""


class Following(Shown, ABC):
    """A part of the page that is drawn from the newest motion, only while it is shown."""

    def __init__(self, node: Any) -> None:  # noqa: ANN401 - a node of the scene, or a folder of the panel
        super().__init__(node)
        self._motion: ArmMotion | None = None
        self._drawn: ArmMotion | None = None
        self._drawing = threading.Lock()  # it is switched on by another thread than the one that computes

    def follow(self, motion: ArmMotion | None) -> None:
        """Show this motion; None leaves what is there."""
        self._motion = motion or self._motion
        if self.visible:
            self._catch_up()

    def _catch_up(self) -> None:
        with self._drawing:
            motion = self._motion
            if motion is not None and motion is not self._drawn:
                self._drawn = motion
                self._show(motion)

    @abstractmethod
    def _show(self, motion: ArmMotion) -> None:
        """Draw a motion."""


class Picture(Shown, ABC):
    """A part of the scene that is drawn from frames."""

    @abstractmethod
    def draw(self, frame: Frame) -> None:
        """Show the frame."""

    def dye(self, dark: bool) -> None:
        """Take the colours of the dark theme, or of the light one, from the next drawing on at the latest."""


class Lines:
    """Polylines of one look, as one set of line segments."""

    def __init__(self, scene: viser.SceneApi, name: str, colour: Colour, thickness: float, *, dash: float = 0) -> None:
        """Make an empty set.

        Args:
            scene: scene of the visitor.
            name: name in the scene tree.
            colour: colour of all lines.
            thickness: metres.
            dash: length of a dash and of the gap after it, metres; 0 draws through.
        """
        self._dash, self._light = dash, colour
        self.node = scene.add_line_segments(name, np.zeros((1, 2, 3), np.float32), colour, thickness=thickness)

    @property
    def colour(self) -> NDArray[np.uint8]:
        """Colour of all lines, (3,)."""
        return self.node.colors

    @colour.setter
    def colour(self, colour: Colour) -> None:
        self.node.colors = np.array(colour, np.uint8)

    def dye(self, dark: bool) -> None:
        """Take the colour of the dark theme, or of the light one."""
        self.colour = palette.shade(self._light, dark)

    def show(self, paths: Sequence[Array]) -> None:
        """Show polylines (T_i, 3), metres."""
        self.show_segments(self.segments(paths))

    def segments(self, paths: Sequence[Array]) -> Array:
        """The segments (K, 2, 3) that polylines (T_i, 3), metres, are drawn with."""
        segments: list[Array] = [np.zeros((0, 2, 3))]
        for path in paths:
            pieces = np.stack([path[:-1], path[1:]], axis=1)
            if self._dash:
                middle = np.cumsum(np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1))
                pieces = pieces[(middle / self._dash).astype(int) % 2 == 0]
            segments.append(pieces)
        return np.concatenate(segments)

    def show_segments(self, segments: Array) -> None:
        """Show segments (K, 2, 3), metres."""
        self.node.points = segments.astype(np.float32)


def assign(node: Any, points: Array, colours: NDArray[np.uint8]) -> None:  # noqa: ANN401 - lines, arrows and clouds
    """Give a node points (N, …), metres, and as many colours: two messages, so the caller must hold an atomic block.

    Without points a single colour is sent, which stands for all.
    """
    node.points = points.astype(np.float32)
    node.colors = colours if len(colours) else np.zeros(3, np.uint8)


def rgb(colour: Colour, shape: tuple[int, ...]) -> NDArray[np.uint8]:
    """Return one colour, as linear light, for an array of points of this shape."""
    return np.broadcast_to(np.array(palette.linear(colour), dtype=np.uint8), shape)


class Arrows:
    """Vectors at points, the larger the longer and darker."""

    def __init__(
        self, scene: viser.SceneApi, name: str, little: Colour, much: Colour, length: float, thickness: float = 1.0
    ) -> None:
        """Make an empty set.

        Args:
            scene: scene of the visitor.
            name: name in the scene tree.
            little: colour of the shortest.
            much: colour of the longest.
            length: length of the longest, metres.
            thickness: thickness relative to the vector field's.
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

    def paint(self, little: Colour, much: Colour) -> None:
        """Give other colours to the shortest and the longest, from the next time that they are shown."""
        self._little, self._much = np.array(little), np.array(much)

    def show(self, points: Array, vectors: Array) -> None:
        """Show vectors (N, 3), of any unit, with their middles at points (N, 3), metres."""
        size = np.linalg.norm(vectors, axis=1, keepdims=True)
        # the largest lie where ψ⁻¹ stretches most; a high quantile as the unit keeps the others readable
        relative = np.minimum(size / np.quantile(size, 0.9), 1) if len(size) else size
        arrows = vectors / np.maximum(size, 1e-12) * self._length * (0.45 + 0.55 * relative)
        ends = np.stack([points - arrows / 2, points + arrows / 2], axis=1)
        assign(self.node, ends, (self._little + relative * (self._much - self._little)).astype(np.uint8))
