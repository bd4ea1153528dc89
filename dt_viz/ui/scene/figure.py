"""The scene as a figure for a paper, seen from the plane of the task: lines and text in the page's colours."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from PIL import Image, ImageColor, ImageDraw
from scipy.ndimage import gaussian_filter

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.baselines.registry import OURS
from dt_viz.flows.fields import Array, Mask
from dt_viz.obstacles.shapes import Obstacle, Point, nearest, rotation
from dt_viz.pictures.figures import Arrows, Drawing, Levels, Strokes, check_installed, encoded, scene_figure
from dt_viz.pictures.panels import PanelPicture
from dt_viz.pictures.slice_fields import ColourPicture
from dt_viz.scenario.slices import Slice, directions
from dt_viz.session.frame import Compared, Frame
from dt_viz.ui.scene.comparison import followed, number_of
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import LIGHT, STYLES, Colour, Style
from dt_viz.ui.scene.slice_layers import CM2

Step = Callable[[float], None]
"""Function that takes the part of a file that is made, from 0 to 1; it raises UnwantedError where that is cancelled."""
SUFFIXES = (".svg", ".pdf")  # suffixes of the files
PIXEL = 1e-3  # spacing of the lattice on which the outlines of bodies are found, metres
DET_LEVELS = (0.1, 0.3, 1.0, 3.0, 10.0)  # values of det J whose level lines are drawn
OCCUPIED = (0.25, 0.5, 0.75)  # probabilities of being occupied whose level lines are drawn
NUM_LEVELS = 8  # largest number of level lines of the Lyapunov value
_DRAWING = threading.Lock()
"""Held while matplotlib draws: its settings and fonts are shared by all threads."""


def ignored(_part: float) -> None:
    """A `Step` that shows nothing."""


@dataclass(frozen=True)
class _Plane:
    """A rectangle as the camera of the task reads it: places on it in metres, to the right and up from its middle."""

    area: Slice
    axes: Array  # (3, 2) to the right and up
    bodies: tuple[Obstacle, ...] = ()  # obstacles that hide the lines drawn here

    @classmethod
    def of(cls, area: Slice, frame: Frame, bodies: tuple[Obstacle, ...] = ()) -> _Plane:
        return cls(area, np.stack(directions(area, frame.task.camera), axis=1), bodies)

    def across(self, points: Array) -> Array:
        """Places (*B, 2) of world points (*B, 3), metres."""
        return (points - self.area.centre) @ self.axes

    def strokes(self, label: str, style: Style, paths: Iterable[Array] | None, number: int = 0) -> Strokes:
        """Paths (T_i, 3), metres, if any, in the style's colour of a number; empty ones are left out."""
        given = [path for path in (() if paths is None else paths) if len(path)]
        seen, hidden = [self.across(path) for path in given], [self.hidden(path) for path in given]
        width, is_directed = style.width or style.radius, style in (STYLES.streamline, STYLES.panel_streamline)
        colour = _hex(style.on(LIGHT, number))
        return Strokes(label, seen, colour, width, bool(style.dash), is_directed, style.ball > 0, hidden)

    def hidden(self, points: Array) -> Mask:
        """Which (N,) of some points (N, 3), metres, a body hides from who looks at the plane, or has in it."""
        toward, hidden = np.cross(*self.axes.T), np.zeros(len(points), bool)
        end = max((body.position @ toward + body.radius for body in self.bodies), default=-np.inf)
        gone, rows = np.zeros(len(points)), np.arange(len(points))
        while len(rows := rows[points[rows] @ toward + gone[rows] < end]):  # nothing lies between there and the eye
            distance = nearest(self.bodies, points[rows] + gone[rows, None] * toward)
            hidden[rows] = distance < 0
            gone[rows] += np.maximum(distance, PIXEL)
            rows = rows[distance >= 0]
        return hidden

    def points(self, places: Sequence[Array | Point], colour: Colour) -> tuple[Array, str]:
        """Places in the world, metres, and their colour."""
        return self.across(np.array(places)), _hex(colour)

    def levels(self, label: str, values: Array, levels: Sequence[float], colour: Colour, seen: _Plane) -> Levels:
        """Level lines of values (n, m) from corner to corner of this rectangle, where they are `seen` in another."""
        along = [bool(mine @ own > 0) for mine, own in zip(self.axes.T, self.area.axes.T, strict=True)]
        half, middle = np.array(self.area.half_size), seen.across(self.area.centre)
        own = values[:: 1 if along[0] else -1, :: 1 if along[1] else -1]
        return Levels(label, own, levels, _hex(colour), middle - half, middle + half)

    def body(self, obstacle: Obstacle) -> Levels:
        """The outline of a body as it is seen: that of its triangles together."""
        half = np.array(self.area.half_size)
        vertices, faces = obstacle.surface()
        places = self.across(np.asarray(obstacle.position) + vertices @ rotation(obstacle.wxyz).T)
        size = np.ceil(2 * half / PIXEL).astype(int) + 1
        image = Image.new("L", (int(size[0]), int(size[1])))
        draw = ImageDraw.Draw(image)
        for triangle in ((places + half) / PIXEL)[faces]:
            draw.polygon([(x, y) for x, y in triangle.tolist()], fill=255)
        covered = gaussian_filter(np.asarray(image, float).T / 255, 1.0)
        return Levels("obstacle", covered, (0.5,), _hex(LIGHT.obstacle), -half, (size - 1) * PIXEL - half, is_body=True)

    def drawing(
        self,
        title: str,
        strokes: Sequence[Strokes],
        points: Mapping[str, tuple[Array, str]],
        field: tuple[Array, Array] | None,
        arrows: Style,
        levels: Sequence[Levels] = (),
    ) -> Drawing:
        """All of it, with a field at places (N, 3), metres, and vectors (N, 3) there."""
        places, vectors = np.zeros((2, 0, 3)) if field is None else field
        known = np.isfinite(vectors).all(axis=1)
        seen = Arrows(self.across(places[known]), vectors[known] @ self.axes, _hex(arrows.on(LIGHT)), arrows.length)
        half = np.array(self.area.half_size)
        return Drawing(title, -half, half, strokes, levels, seen, points)


def render_figure(frame: Frame, suffix: str, step: Step = ignored) -> bytes:
    """Return the figure of a frame as the content of a file with one of `SUFFIXES`.

    Raises:
        FormatError: matplotlib is not installed.
    """
    check_installed()
    *panels, own = frame.pictures.panels or (None,)
    drawings = [_panel(panel, frame) for panel in panels if panel is not None]
    step(0.2)
    drawings.append(_scene(frame, "" if own is None else own.title))
    step(0.4)
    with _DRAWING:
        figure = scene_figure(drawings)
        step(0.7)
        return encoded(figure, suffix)


def key_of(frame: Frame) -> Legend:
    """Return the names and colours of what the scene of a frame shows."""
    drawing = _scene(frame, "")
    named = {one.label: one.colour for one in drawing.strokes if one.paths}
    named |= {one.label: one.colour for one in drawing.levels if one.is_body}
    named |= {label: colour for label, (_, colour) in drawing.points.items()}
    return Legend(tuple((label, ImageColor.getrgb(colour)[:3]) for label, colour in named.items()))


def _scene(frame: Frame, title: str) -> Drawing:
    """The scene itself, with what its view shows; without a motion only what it is about."""
    view, pictures, moves = frame.scenario.view, frame.pictures, not frame.blocked
    rollouts = {place: path for place, path in enumerate(frame.rollouts) if len(path) and view.rollouts and moves}
    own, added = ([path for place, path in rollouts.items() if frame.shaping[place] == own] for own in (True, False))
    demonstrations = frame.task.paths if view.demonstrations else ()
    ghost = [path for place, path in enumerate(frame.ghost) if place == frame.chosen and view.ghost and moves]
    others = followed(frame)
    beside = [path for compared in others for path in compared.paths]
    area = frame.slice.holding([*frame.task.paths, *rollouts.values(), *beside])
    plane = _Plane.of(area, frame, frame.scenario.obstacles)
    strokes = [
        plane.strokes("warped grid", STYLES.grid, pictures.grid),
        plane.strokes("streamlines", STYLES.streamline, pictures.streamlines),
        plane.strokes("demonstrations", STYLES.demonstration, demonstrations),
        plane.strokes("undisturbed", STYLES.ghost, ghost),
        plane.strokes("rollouts of the level", STYLES.level, () if frame.level is None else frame.levels[frame.level]),
        *(part for compared in others for part in _compared(plane, compared)),
        plane.strokes(OURS.title if others else "rollouts", STYLES.rollout, own),
        plane.strokes("added rollouts", STYLES.added, added),
    ]
    levels = [plane.body(obstacle) for obstacle in frame.scenario.obstacles]
    if moves and pictures.colour is not None:
        levels.append(_function(_Plane.of(pictures.colour.area, frame), pictures.colour, plane))
    if moves and pictures.occupancy is not None:
        area = _Plane.of(pictures.occupancy.area, frame)
        levels.append(area.levels("occupancy", pictures.occupancy.probability, OCCUPIED, LIGHT.occupancy_level, plane))
    biases = [layer.transform for _, layer in frame.scenario.active if isinstance(layer.transform, BiasPoint)]
    points = {"bias point": plane.points([bias.position for bias in biases], LIGHT.bias)} if biases else {}
    points["goal"] = plane.points([frame.goal], LIGHT.goal)
    field = (pictures.field.points, pictures.field.velocities) if moves and pictures.field is not None else None
    return plane.drawing(title, strokes, points, field, STYLES.field, levels)


def _compared(plane: _Plane, compared: Compared) -> Iterator[Strokes]:
    """The motions of a method beside ours, the one that is named in the scene last."""
    number, title = number_of(compared.method), compared.method.title
    for style, is_named in ((STYLES.compared, False), (STYLES.compared_followed, True)):
        paths = [path for k, path in enumerate(compared.paths) if (k == compared.rollout) == is_named]
        yield plane.strokes(title, style, paths, number)


def _function(area: _Plane, picture: ColourPicture, seen: _Plane) -> Levels:
    """The level lines of what the slice shows as colour on the page."""
    if picture.what == "det":
        return area.levels("det J", picture.values, DET_LEVELS, LIGHT.volume[0], seen)
    values = CM2 * picture.values
    step = float(np.nanmax(values, initial=1e-9)) / NUM_LEVELS
    rounded = np.ceil(step / 10 ** np.floor(np.log10(step))) * 10 ** np.floor(np.log10(step))
    return area.levels("Lyapunov value, cm²/s", values, rounded * np.arange(1, NUM_LEVELS + 1), LIGHT.lyapunov[3], seen)


def _panel(panel: PanelPicture, frame: Frame) -> Drawing:
    plane = _Plane.of(panel.area, frame)
    strokes = [
        plane.strokes("lattice", STYLES.panel_grid, panel.grid),
        plane.strokes("streamlines", STYLES.panel_streamline, panel.streamlines),
        plane.strokes("demonstrations", STYLES.demonstration, panel.demonstrations),
        plane.strokes("outline", STYLES.outline, panel.outlines),
        plane.strokes("rollouts", STYLES.panel_rollout, panel.rollouts),
    ]
    points = {} if panel.goal is None else {"goal": plane.points([panel.goal], LIGHT.goal)}
    return plane.drawing(panel.title, strokes, points, (panel.points, panel.vectors), STYLES.panel_generator)


def _hex(colour: Colour) -> str:
    return "#{:02x}{:02x}{:02x}".format(*colour)
