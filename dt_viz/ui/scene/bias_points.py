"""Transforms that have a place, in the scene: each is dragged itself, and a click gives one handles as well.

Then a ring is around the region that it acts in. In a drawing the handles move it in the drawing's plane.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache

import numpy as np
import viser
import viser.transforms

from dt_viz.avoidance.transform import Anchored, axes_of
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import as_point
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import anchored, selected, with_transform
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.scene.markers import Marker, MarkerGroup
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look, add_ball, add_label
from dt_viz.ui.scene.style import STYLES


class BiasMarker(Marker):
    """Marker at a transform's place."""

    def __init__(self, group: BiasPoints, index: int) -> None:
        """Make the marker of this index, of no transform yet."""
        scene, node = group.scene, f"/bias/{index}"
        gizmo = scene.add_transform_controls(node, line_width=3.0, disable_rotations=True, depth_test=False)
        self.ball = add_ball(scene, f"{node}/ball", STYLES.bias)
        # lines, not a surface: what lies behind and inside, such as colours on the slice, stays as it is
        self.region = scene.add_line_segments(
            f"{node}/region",
            _rings(flat=True),
            LIGHT.region,
            thickness=1.6,
            thickness_units="screen",
            visible=False,
        )
        self._label = add_label(scene, f"{node}/label", anchor="top-left")
        super().__init__(group, gizmo, self.ball, scale=0.11)

    def adopt(self, name: str, transform: Anchored, *, on: bool, handles: bool) -> None:
        """Move to the transform's place, unless the browser has moved there already."""
        plane = transform.plane
        self.stand(transform.position, viser.transforms.SO3.from_matrix(axes_of(plane)).wxyz)
        flat = plane is not None
        self.node.active_axes = (True, True, not flat)
        self.region.points = _rings(flat=flat)
        self.key = name
        self._label.text = f"{name.lower()}: goal" if transform.moves_goal else name.lower()
        self.ball.color = LIGHT.bias if on else LIGHT.stale
        self.region.colors = np.array(LIGHT.region if on else LIGHT.stale, dtype=np.uint8)
        self.has_handles = handles

    def show_region(self, radius: float | None) -> None:
        """Show the region of this radius, metres, while it has handles; nothing while the radius is not known."""
        if radius is not None:
            self.region.scale = (radius, radius, radius)
        self.region.visible = self.has_handles and radius is not None


@lru_cache(maxsize=2)
def _rings(*, flat: bool) -> Array:
    """Return segments (K, 2, 3) of a unit circle in the plane of the first two axes, or of one in each such plane."""
    turn = np.linspace(0, 2 * np.pi, 97)
    circle = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    circles = [circle] if flat else [np.roll(circle, shift, axis=1) for shift in range(3)]
    return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in circles]).astype(np.float32)


class BiasPoints(MarkerGroup[BiasMarker]):
    """All transforms of a scenario that have a place."""

    chosen, handles = "bias", "bias_handles"

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/bias", show_axes=False), session)
        self._regions: dict[int | str, float | None] = {}
        """Radii that the transforms ask for, metres, by name."""
        self._used: dict[int | str, float | None] = {}
        """Radii that the last frame's were computed with."""

    def draw(self, frame: Frame, look: Look) -> None:
        """Shows the regions, and remembers the slice for drags."""
        super().draw(frame, look)
        self._used = {name: chosen.get("radius") for name, chosen in frame.chosen_values.items()}
        self._show_regions()

    def adopt(self, scenario: Scenario) -> None:
        transforms, handled = anchored(scenario), self._handled(scenario)
        self._fit(len(transforms))
        on = {layer.name for layer in scenario.stack if layer.on}
        for marker, (name, transform) in zip(self.items, transforms.items(), strict=True):
            marker.adopt(name, transform, on=name in on, handles=name == handled)
        self._regions = {name: transform.radius for name, transform in transforms.items()}
        self._show_regions()

    def _show_regions(self) -> None:
        with self._changing:
            for marker in self.items:
                marker.show_region(self._used.get(marker.key) or self._regions.get(marker.key))

    def _new(self, index: int) -> BiasMarker:
        return BiasMarker(self, index)

    def _selected(self, scenario: Scenario) -> str | None:
        return selected(scenario)

    def _move(self, session: Session, marker: BiasMarker, position: Array, wxyz: Array) -> None:
        name, scenario = str(marker.key), session.scenario
        transform = anchored(scenario).get(name)
        if transform is not None:  # or it was deleted a moment ago
            session.edit(name, stack=with_transform(scenario, name, replace(transform, position=as_point(position))))
