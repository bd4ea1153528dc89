"""Pictures of ψ and on the slice: arrows, streamlines, warped grid; det J, Lyapunov value or occupancy as colour."""

from __future__ import annotations

import numpy as np
import viser
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt, map_coordinates
from viser import transforms

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Point
from dt_viz.pictures.panels import PanelPicture
from dt_viz.pictures.slice_fields import ColourPicture
from dt_viz.scenario.scenario import SliceColour
from dt_viz.scenario.slices import Slice, directions
from dt_viz.session.frame import Frame
from dt_viz.ui.scene.colour_scale import NUM_SHADES, Scale, diverging, ramp
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import LIGHT, STYLES, Theme
from dt_viz.ui.scene.picture import Arrows, Lines, Look, Picture, add_ball, add_label, assign
from dt_viz.ui.scene.tubes import Tubes, middles_of

PIXEL = 0.004  # size of a pixel of the colours, metres
OPACITY, MOST_OPAQUE = 0.5, 0.85
"""Opacity of the ink of det J and the Lyapunov value, and of occupancy where it is certain."""
DET_DECADES = 2
"""Number of decades of det J on either side of 1; values beyond have the last colour."""
CM2 = 1e4  # square centimetres in a square metre

VOLUME, LYAPUNOV = diverging(LIGHT.volume), ramp(LIGHT.lyapunov)
_LIKELY = np.linspace(0, MOST_OPAQUE, NUM_SHADES)[:, None]
OCCUPANCY_SCALE = Scale(np.round(255 + _LIKELY * (np.array(LIGHT.occupancy) - 255)).astype(np.uint8), 0.0, 1.0)
"""Colours of the occupancy on white."""
OCCUPANCY = Legend(
    (("Bold line: its level 0.5. Thin line: the true outline", None),),
    "Learned occupancy: how likely something is there",
    OCCUPANCY_SCALE,
    tuple((p, f"{p:g}") for p in (0, 0.25, 0.5, 0.75, 1)),
)


class FieldArrows(Picture):
    """The vector field on the slice; faster arrows are longer and darker."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.arrows = Arrows(scene, "/field", STYLES.field)
        super().__init__(self.arrows.node)

    def draw(self, frame: Frame, look: Look) -> None:
        field = frame.pictures.field
        if field is not None:
            self.arrows.show(field.points, field.velocities, look.theme)


class Streamlines(Picture):
    """Motions from all over the slice as thin lines with an arrow head in the middle of each."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/streamlines", show_axes=False))
        self.lines = Lines(scene, "/streamlines/lines", STYLES.streamline)
        self.heads = Arrows(scene, "/streamlines/heads", STYLES.streamline_head)

    def draw(self, frame: Frame, look: Look) -> None:
        lines = frame.pictures.streamlines
        if lines is not None:
            self.lines.show(lines, look.theme)
            middles = [len(line) // 2 for line in lines]
            points = np.reshape([line[k] for line, k in zip(lines, middles, strict=True)], (-1, 3))
            ahead = np.reshape([line[k] - line[k - 1] for line, k in zip(lines, middles, strict=True)], (-1, 3))
            ahead /= np.maximum(np.linalg.norm(ahead, axis=1, keepdims=True), 1e-12)
            self.heads.show(points, ahead, look.theme)


class _Image:
    """An image on a slice."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        nothing = np.zeros((1, 1, 4), np.uint8)
        self.handle = scene.add_image(name, nothing, 1.0, 1.0, format="png", cast_shadow=False, receive_shadow=False)

    def show(self, area: Slice, pixels: NDArray[np.uint8]) -> None:
        """Show pixels (n, m, 4) along the first and the second axis of the slice."""
        right, up = area.axes.T
        turn = transforms.SO3.from_matrix(np.stack([right, -up, -area.normal], axis=1))
        self.handle.wxyz, self.handle.position = turn.wxyz, area.centre
        self.handle.render_width, self.handle.render_height = (2 * half for half in area.half_size)
        self.handle.image = pixels.swapaxes(0, 1)[::-1]  # the first row is the upper one


class ColourSlice(Picture):
    """det J, or the Lyapunov value with level lines, as colour."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/colour", show_axes=False))
        self.image = _Image(scene, "/colour/image")
        self.lines = Lines(scene, "/colour/lines", STYLES.level_line)

    def draw(self, frame: Frame, look: Look) -> None:
        picture = frame.pictures.colour
        if picture is not None and self._is_new(picture, look.theme):
            self.legend = legend_of(picture)
            self.image.show(picture.area, painted(picture))
            self.lines.show_segments(picture.lines, look.theme)


def scale_of(picture: ColourPicture) -> Scale:
    """Return the scale of a picture: for log₁₀ det J a fixed one, for the Lyapunov value cm²/s up to the largest."""
    if picture.what == "det":
        return Scale(VOLUME, -DET_DECADES, DET_DECADES)
    return Scale(LYAPUNOV, 0.0, _rounded_up(CM2 * float(np.nanmax(picture.values, initial=1e-9))))


def legend_in(frame: Frame, colour: SliceColour) -> Legend | None:
    """Return the legend of a colour on the slice of a frame; None if the frame has no picture of it."""
    picture = frame.pictures.colour
    if colour == "occupancy":
        return OCCUPANCY
    return legend_of(picture) if picture is not None and picture.what == colour else None


def legend_of(picture: ColourPicture) -> Legend:
    """Return the legend of a picture."""
    scale = scale_of(picture)
    if picture.what == "det":
        ticks = tuple((d, f"{10.0**d:g}") for d in range(-DET_DECADES, DET_DECADES + 1))
        folds = ("0 or less: folded, no diffeomorphism", LIGHT.folded)
        return Legend((folds,), "det J: volume in base space for volume here", scale, ticks)
    ticks = tuple((value, f"{value:g}") for value in np.linspace(0, scale.high, 5).tolist())
    return Legend((("Every motion goes down", None),), "Lyapunov value, square cm per second", scale, ticks)


def painted(picture: ColourPicture) -> NDArray[np.uint8]:
    """Return pixels (n, m, 4) along the axes of the slice, interpolated, and transparent where no motion comes."""
    values, unknown = picture.values, np.isnan(picture.values)
    shape = tuple(max(2, round(2 * half / PIXEL)) for half in picture.area.half_size)
    if unknown.all():
        return np.zeros((*shape, 4), np.uint8)
    if unknown.any():  # extrapolate the nearest values, for the border
        nearest = distance_transform_edt(unknown, return_distances=False, return_indices=True)
        values = values[tuple(np.asarray(nearest))]
    # the outermost samples lie on the border of the slice, pixels half a pixel inside
    axes = [(np.arange(p) + 0.5) / p * (n - 1) for p, n in zip(shape, values.shape, strict=True)]
    at = np.meshgrid(*axes, indexing="ij")
    shown = np.log10(np.maximum(values, 10.0 ** (-2 * DET_DECADES))) if picture.what == "det" else CM2 * values
    pixels = np.empty((*shape, 4), np.uint8)
    pixels[..., :3], ink = inked(scale_of(picture).colours(map_coordinates(shown, at, order=1)))
    room = map_coordinates(np.minimum(picture.clearance, 1.0), at, order=1)
    pixels[..., 3] = np.round(255 * OPACITY * ink * np.clip(room / PIXEL + 0.5, 0, 1))
    if picture.what == "det":
        pixels[map_coordinates(values, at, order=0) <= 0] = (*LIGHT.folded, 255)
    return pixels


def inked(colours: NDArray[np.uint8]) -> tuple[NDArray[np.uint8], Array]:
    """Return colours (..., 3) as ink and its opacity (...): alike on white, and what is behind is not whitened.

    White is left out: c = (1 − a) white + a ink with the smallest opacity a that is possible.
    """
    opacity = 1 - colours.min(axis=-1) / 255
    ink = 255 - (255 - colours) / np.maximum(opacity, 1 / 255)[..., None]
    return np.round(ink).astype(np.uint8), opacity


def _rounded_up(value: float) -> float:
    """Round up to 1, 1.5, 2, 3, 4, 5, 6 or 8 times a power of ten."""
    power = 10.0 ** np.floor(np.log10(value))
    return float(power * next(step for step in (1, 1.5, 2, 3, 4, 5, 6, 8, 10) if step * power >= value * (1 - 1e-9)))


class OccupancySlice(Picture):
    """The learned occupancy as colour on the slice, the more opaque the more likely."""

    legend = OCCUPANCY

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/occupancy", show_axes=False))
        self.image = _Image(scene, "/occupancy/image")
        self.level = Lines(scene, "/occupancy/level", STYLES.occupancy_level)
        self.outline = Lines(scene, "/occupancy/outline", STYLES.outline)
        self.points = scene.add_point_cloud(
            "/occupancy/points", np.zeros((0, 3), np.float32), LIGHT.free, point_size=0.0016, point_shape="circle"
        )

    def draw(self, frame: Frame, look: Look) -> None:
        picture = frame.pictures.occupancy
        if picture is not None and self._is_new(picture, look.theme):
            self.image.show(picture.area, _of_probability(picture.probability))
            self.level.show_segments(picture.level, look.theme)
            self.outline.show_segments(picture.outline, look.theme)
            colours = np.where(picture.occupied[:, None], LIGHT.occupied, LIGHT.free).astype(np.uint8)
            assign(self.points, picture.points, colours)


def _of_probability(probability: Array) -> NDArray[np.uint8]:
    pixels = np.empty((*probability.shape, 4), np.uint8)
    pixels[..., :3] = LIGHT.occupancy
    pixels[..., 3] = np.round(255 * MOST_OPAQUE * probability)
    return pixels


class Generator(Picture):
    """The learned generator as arrows, with the demonstrations on the manifold that it acts on."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/generator", show_axes=False))
        self.arrows = Arrows(scene, "/generator/arrows", STYLES.generator)
        self._motions = Lines(scene, "/generator/motions", STYLES.generator_motion)

    def draw(self, frame: Frame, look: Look) -> None:
        picture = frame.pictures.generator
        if picture is not None and self._is_new(picture, look.theme):
            self.arrows.show(picture.points, picture.displacements, look.theme)
            self._motions.show(picture.motions, look.theme)


class WarpedGrid(Picture):
    """Image of a grid of base space under ψ⁻¹ of the stack; thinner and paler beside the rollouts of a level."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self.lines = Lines(scene, "/grid", STYLES.grid)
        super().__init__(self.lines.node)

    def draw(self, frame: Frame, look: Look) -> None:
        if frame.pictures.grid is not None:
            self.lines.style = STYLES.grid if frame.level is None else STYLES.grid_beside
            self.lines.show_segments(frame.pictures.grid, look.theme)


class PanelNodes:
    """The nodes of one panel."""

    def __init__(self, scene: viser.SceneApi, name: str) -> None:
        """Make an empty panel of this name in the scene tree."""
        self.frame = scene.add_frame(name, show_axes=False)
        self._border = Lines(scene, f"{name}/border", STYLES.panel_border)
        styles = {
            "grid": STYLES.panel_grid,
            "streamlines": STYLES.panel_streamline,
            "demonstrations": STYLES.demonstration,
            "outlines": STYLES.outline,
        }
        self.lines = {field: Lines(scene, f"{name}/{field}", style) for field, style in styles.items()}
        """Lines by the field of `PanelPicture` that they show."""
        self._arrows = Arrows(scene, f"{name}/arrows", STYLES.panel_generator)
        self.rollouts = Tubes(scene, f"{name}/rollouts", STYLES.panel_rollout)
        self._goal = add_ball(scene, f"{name}/goal", STYLES.panel_goal)
        self._title = add_label(scene, f"{name}/title", font_screen_scale=1.1)
        self._drawn: tuple[PanelPicture, Theme] | None = None

    def draw(self, panel: PanelPicture, camera: tuple[Point, Point], theme: Theme) -> None:
        """Show a panel, read by a camera with this position and look-at, metres."""
        before, known = self._drawn or (panel, None)
        self._drawn = panel, theme

        def is_new(field: str) -> bool:
            return known is not theme or getattr(before, field) is not getattr(panel, field)

        self.frame.position = panel.offset
        for field, lines in self.lines.items():
            if is_new(field):
                show = lines.show_segments if field in {"grid", "outlines"} else lines.show
                show(getattr(panel, field), theme)
        if is_new("rollouts"):
            self.rollouts.show(middles_of(panel.rollouts), theme)
        if is_new("points"):
            self._arrows.show(panel.points, panel.vectors, theme)
        self._goal.visible = panel.goal is not None
        if panel.goal is not None:
            self._goal.position = panel.goal
        if known is not theme or before.area.key != panel.area.key:
            self._border.show([panel.area.border], theme)
        _, up = directions(panel.area, camera)
        self._title.text = panel.title
        self._title.position = panel.area.centre + (panel.area.half_size[1] + 0.015) * up


class Panels(Picture):
    """Systems on panels beside the scene, and a frame with a title around the scene's own slice."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/panels", show_axes=False))
        self._scene = scene
        self.panels: list[PanelNodes] = []

    def draw(self, frame: Frame, look: Look) -> None:
        panels = frame.pictures.panels
        if not panels:
            return
        for k in range(len(self.panels), len(panels)):
            self.panels.append(PanelNodes(self._scene, f"/panels/{k}"))
        for k, nodes in enumerate(self.panels):
            nodes.frame.visible = k < len(panels)
            if k < len(panels):
                nodes.draw(panels[k], frame.task.camera, look.theme)
