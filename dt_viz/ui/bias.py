"""Bias points in the scene: each is dragged itself, the selected one also by handles; its region is pale.

In a drawing the handles move it in the drawing's plane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

import viser
import viser.transforms

from dt_viz.bias import BiasPoint
from dt_viz.engine import Frame
from dt_viz.fields import Array
from dt_viz.scenario import Scenario
from dt_viz.stacking import MAX_BIAS_POINTS, bias_points
from dt_viz.ui import palette
from dt_viz.ui.handles import Dragged, Handles

BALL_RADIUS = 0.011
"""Of the marker, metres."""
HANDLE_SCALE = 0.11
"""Metres that the handles stick out, about."""
DISC_HEIGHT = 0.002
"""Of the region in a drawing, metres."""
OPACITY, OPACITY_OFF = 0.14, 0.05
"""Of the region."""

Moved = Callable[[str, Array, str], None]
"""Told which bias point was moved, by name, its position (3,), metres, and the phase of the drag."""


class BiasPicture:
    """One bias point, hung on a gizmo: the browser moves both together, without asking the server."""

    def __init__(
        self,
        scene: viser.SceneApi,
        number: int,
        moved: Moved,
        selected: Callable[[str], None],
        along: Callable[[viser.SceneNodeDragEvent], Array],
    ) -> None:
        """Hidden until `adopt` gives it a bias point.

        Args:
            scene: of the visitor.
            number: of this picture, from 0.
            moved: told of each new position.
            selected: told that it was clicked or taken hold of.
            along: how far (3,) an event drags what it has grabbed, metres.
        """
        self.name = ""
        """Of the bias point."""
        node = f"/bias/{number}"
        self.gizmo = scene.add_transform_controls(
            node, line_width=3.0, disable_rotations=True, depth_test=False, visible=False
        )
        self.handles = Handles(self.gizmo, HANDLE_SCALE)
        self.ball = scene.add_icosphere(f"{node}/ball", radius=BALL_RADIUS, color=palette.BIAS)
        # a hidden node is not hit by the pointer, so the region never keeps it from what lies inside
        self.region = scene.add_icosphere(
            f"{node}/region", subdivisions=4, color=palette.BIAS, opacity=OPACITY, cast_shadow=False, visible=False
        )
        self._label = scene.add_label(
            f"{node}/label",
            "",
            position=(0.0, 0.0, 0.0),
            anchor="top-left",
            font_screen_scale=0.8,
        )

        @self.gizmo.on_update
        async def _(event: viser.TransformControlsEvent) -> None:
            moved(self.name, event.target.position.copy(), event.phase)

        @self.ball.on_drag
        async def _(event: viser.SceneNodeDragEvent) -> None:
            if event.phase == "start":
                selected(self.name)
            self.gizmo.position = self.gizmo.position + along(event)
            moved(self.name, self.gizmo.position.copy(), event.phase)

        @self.ball.on_click
        async def _(_event: viser.SceneNodePointerEvent) -> None:
            selected(self.name)

    def adopt(self, name: str, point: BiasPoint, *, on: bool, selected: bool) -> None:
        """Stand where the bias point does, unless that is where the browser has put it already."""
        self.handles.stand(point.position, viser.transforms.SO3.from_matrix(point.axes()).wxyz)
        flat = point.plane is not None
        if self.gizmo.active_axes[2] == flat:
            self.gizmo.active_axes = (True, True, not flat)
        if self.name != name:
            self.name = name
            self._label.text = name.lower()
        colour = palette.BIAS if on else palette.STALE
        if tuple(self.ball.color) != colour:
            self.ball.color = self.region.color = colour
            self.region.opacity = OPACITY if on else OPACITY_OFF
        self.handles.show(selected)
        if not self.gizmo.visible:
            self.gizmo.visible = True

    def show_region(self, point: BiasPoint, used: float | None) -> None:
        """Show how far it acts: the radius that was used, or the one asked for; nothing while neither is known."""
        radius = used or point.radius
        shown = radius is not None
        if shown:
            depth = radius if point.plane is None else DISC_HEIGHT
            scale = (radius, radius, depth)
            if self.region.scale != scale:
                self.region.scale = scale
        if self.region.visible != shown:
            self.region.visible = shown

    def hide(self) -> None:
        """There is no such bias point."""
        if self.gizmo.visible:
            self.gizmo.visible = False


class Biases(Dragged):
    """All bias points of a scenario."""

    def __init__(self, scene: viser.SceneApi, moved: Moved, selected: Callable[[str], None]) -> None:
        """Begin with none; see `BiasPicture`."""
        super().__init__(scene.add_frame("/bias", show_axes=False))
        self._points: Mapping[str, BiasPoint] = {}
        self.items = tuple(BiasPicture(scene, k, moved, selected, self.along) for k in range(MAX_BIAS_POINTS))

    @property
    def handles(self) -> Iterable[Handles]:
        """See `Dragged`."""
        return [item.handles for item in self.items]

    def draw(self, frame: Frame) -> None:
        """See `Picture`: the regions, and the slice to be dragged in."""
        super().draw(frame)
        radii = dict(zip((layer.name for layer in frame.scenario.layers), frame.layer_radii, strict=False))
        for item, (name, point) in zip(self.items, self._points.items(), strict=False):
            item.show_region(point, radii.get(name))

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's bias points where they stand."""
        points = bias_points(scenario.layers)
        self._points = points
        on = {layer.name for layer in scenario.layers if layer.on}
        selected = None if scenario.view.move_slice else selected_point(scenario)
        for item, (name, point) in zip(self.items, points.items(), strict=False):
            item.adopt(name, point, on=name in on, selected=name == selected)
        for item in self.items[len(points) :]:
            item.hide()


def selected_point(scenario: Scenario) -> str | None:
    """Name of the bias point that has the handles: the chosen one, or else the newest."""
    points = bias_points(scenario.layers)
    return scenario.view.bias if scenario.view.bias in points else next(reversed(points), None)
