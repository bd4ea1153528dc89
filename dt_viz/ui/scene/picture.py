"""Elements of pictures: lines and arrows of one look, and what is shown and hidden under one node of the scene tree."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, Generic, TypeVar

import numpy as np
import viser
from numpy.typing import NDArray

from dt_viz.flows.fields import Array
from dt_viz.session.frame import Frame
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import LIGHT, Style, Theme, linear
from dt_viz.ui.scene.tubes import RolloutTubes


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


_Followed = TypeVar("_Followed")


class Following(Shown, ABC, Generic[_Followed]):
    """A part of the page that is drawn from the newest motion, or what is told of it, only while it is shown."""

    def __init__(self, node: Any) -> None:  # noqa: ANN401 - a node of the scene, or a folder of the panel
        super().__init__(node)
        self._newest: _Followed | None = None
        self._drawn: _Followed | None = None
        self._drawing = threading.Lock()  # it is switched on by another thread than the one that computes

    def follow(self, newest: _Followed | None) -> None:
        """Show this; None leaves what is there."""
        self._newest = newest or self._newest
        if self.visible:
            self._catch_up()

    def _catch_up(self) -> None:
        with self._drawing:
            newest = self._newest
            if newest is not None and newest is not self._drawn:
                self._drawn = newest
                self._show(newest)

    @abstractmethod
    def _show(self, newest: _Followed) -> None:
        """Draw it."""


@dataclass(frozen=True)
class Look:
    """How a frame is drawn."""

    theme: Theme = LIGHT  # grey where the frame has no motion of the scenario
    blocked: bool = False
    """Whether there is no motion for the scenario: what the frame holds is another one's."""
    stale: bool = False
    """Whether the frame belongs to another task or scene than the scenario that is chosen."""
    tubes: RolloutTubes = field(default_factory=RolloutTubes)  # tubes of the frame's rollouts


class Picture(Shown, ABC):
    """A part of the scene that is drawn from frames."""

    legend: Legend | None = None  # what explains its colours or lines in a saved picture, if anything does
    _sources: tuple[object, ...] = ()  # what it was drawn from last

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide what is there for the page only, for as long as a picture takes."""
        yield

    @abstractmethod
    def draw(self, frame: Frame, look: Look) -> None:
        """Show the frame."""

    def _is_new(self, *drawn: object) -> bool:
        """Whether it was drawn from other objects than these, and note that it is drawn from these now."""
        before, self._sources = self._sources, drawn
        return len(before) != len(drawn) or any(a is not b for a, b in zip(before, drawn, strict=True))


class Lines:
    """Polylines of one look, as one set of line segments."""

    def __init__(self, scene: viser.SceneApi, name: str, style: Style, number: int = 0) -> None:
        """Make an empty set.

        Args:
            scene: scene of the visitor.
            name: name in the scene tree.
            style: look of all lines.
            number: which of several colours of the style's name they have.
        """
        self.style, self._number = style, number
        self.node = scene.add_line_segments(
            name, np.zeros((1, 2, 3), np.float32), style.on(LIGHT, number), thickness=style.width
        )

    def show(self, paths: Sequence[Array], theme: Theme) -> None:
        """Show polylines (T_i, 3), metres."""
        self.show_segments(self.segments(paths), theme)

    def segments(self, paths: Sequence[Array]) -> Array:
        """The segments (K, 2, 3) that polylines (T_i, 3), metres, are drawn with."""
        segments: list[Array] = [np.zeros((0, 2, 3))]
        for path in paths:
            pieces = np.stack([path[:-1], path[1:]], axis=1)
            if self.style.dash:
                middle = np.cumsum(np.linalg.norm(pieces[:, 1] - pieces[:, 0], axis=1))
                pieces = pieces[(middle / self.style.dash).astype(int) % 2 == 0]
            segments.append(pieces)
        return np.concatenate(segments)

    def show_segments(self, segments: Array, theme: Theme) -> None:
        """Show segments (K, 2, 3), metres."""
        self.node.points = segments.astype(np.float32)
        self.node.thickness = self.style.width
        self.paint(theme)

    def paint(self, theme: Theme) -> None:
        """Take the colour that a theme has for them."""
        self.node.colors = np.array(self.style.on(theme, self._number), np.uint8)


def assign(node: Any, points: Array, colours: NDArray[np.uint8]) -> None:  # noqa: ANN401 - lines, arrows and clouds
    """Give a node points (N, …), metres, and as many colours: two messages, so the caller must hold an atomic block.

    Without points a single colour is sent, which stands for all.
    """
    node.points = points.astype(np.float32)
    node.colors = colours if len(colours) else np.zeros(3, np.uint8)


class Arrows:
    """Vectors at points, the larger the longer and nearer to the strong colour."""

    def __init__(self, scene: viser.SceneApi, name: str, style: Style) -> None:
        """Make an empty set of this name in the scene tree."""
        self._style = style
        self.node = scene.add_arrows(
            name,
            np.zeros((1, 2, 3), np.float32),
            np.array([style.on(LIGHT)], np.uint8),
            shaft_radius=0.0011 * style.thickness,
            head_radius=0.0034 * style.thickness,
            head_length=0.0085 * style.thickness,
        )

    def show(self, points: Array, vectors: Array, theme: Theme) -> None:
        """Show vectors (N, 3), of any unit, with their middles at points (N, 3), metres."""
        size = np.linalg.norm(vectors, axis=1, keepdims=True)
        # the largest lie where ψ⁻¹ stretches most; a high quantile as the unit keeps the others readable
        relative = np.minimum(size / np.quantile(size, 0.9), 1) if len(size) else size
        arrows = vectors / np.maximum(size, 1e-12) * self._style.length * (0.45 + 0.55 * relative)
        ends = np.stack([points - arrows / 2, points + arrows / 2], axis=1)
        weak, strong = (np.array(linear(c)) for c in (getattr(theme, self._style.weak), self._style.on(theme)))
        assign(self.node, ends, (weak + relative * (strong - weak)).astype(np.uint8))


def add_label(
    scene: viser.SceneApi,
    name: str,
    text: str = "",
    *,
    height: float = 0.0,
    **options: Any,  # noqa: ANN401 - as viser's
) -> viser.LabelHandle:
    """Add a text whose foot is a height, metres, above the origin of its parent, with viser's further options."""
    usual = {"position": (0.0, 0.0, height), "anchor": "bottom-center", "font_screen_scale": 0.8}
    return scene.add_label(name, text, **(usual | options))


def add_ball(scene: viser.SceneApi, name: str, style: Style, **options: Any) -> viser.IcosphereHandle:  # noqa: ANN401
    """Add the ball that marks a place, with viser's further options."""
    return scene.add_icosphere(name, radius=style.radius, color=style.on(LIGHT), **options)
