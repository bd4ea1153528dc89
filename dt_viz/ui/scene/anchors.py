"""Transforms that have a place, in the scene: each is dragged itself, and a click gives one handles as well.

Then a ring is around the region that it acts in. In a drawing the handles move it in the drawing's plane.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import lru_cache

import numpy as np
import viser
import viser.transforms

from dt_viz.avoidance.registry import KINDS
from dt_viz.avoidance.transform import Transform, axes_of
from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.stack import anchored, selected
from dt_viz.session.frame import Frame
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Drag
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import Dragged, Handles

BALL_RADIUS = 0.011
"""Radius of the marker, metres."""
HANDLE_SCALE = 0.11
"""Approximate size of the handles, metres."""
RING_WIDTH = 1.6
"""Thickness of the rings' lines, pixels."""
MAX_ANCHORS = sum(kind.most for kind in KINDS if kind.most > 1)
"""Largest number of transforms that may have a place."""
NUM_SEGMENTS = 96
"""Number of segments of a ring."""

Moved = Callable[[str, Array, str], None]
"""Callback with the name of a transform, its new position (3,), metres, and the phase of the drag."""


class AnchorPicture:
    """Marker at a transform's place, a child of a gizmo; the browser moves both, without the server."""

    def __init__(
        self,
        scene: viser.SceneApi,
        number: int,
        moved: Moved,
        grabbed: Callable[[str], None],
        clicked: Callable[[str], None],
        area: Callable[[], Slice | None],
    ) -> None:
        """Hidden until `adopt` gives it a transform.

        Args:
            scene: scene of the visitor.
            number: number of this picture, from 0.
            moved: called with each new position.
            grabbed: called when a drag of it begins.
            clicked: called when it is clicked.
            area: returns the slice that it is dragged parallel to.
        """
        self.name = ""
        """Name of the transform."""
        self._has_region = False
        node = f"/bias/{number}"
        self.gizmo = scene.add_transform_controls(
            node, line_width=3.0, disable_rotations=True, depth_test=False, visible=False
        )
        self.handles = Handles(self.gizmo, HANDLE_SCALE)
        self.ball = scene.add_icosphere(f"{node}/ball", radius=BALL_RADIUS, color=palette.BIAS)
        # lines, not a surface: what lies behind and inside, such as colours on the slice, stays as it is
        self.region = scene.add_line_segments(
            f"{node}/region",
            _rings(flat=True),
            palette.REGION,
            thickness=RING_WIDTH,
            thickness_units="screen",
            visible=False,
        )
        self._label = scene.add_label(
            f"{node}/label",
            "",
            position=(0.0, 0.0, 0.0),
            anchor="top-left",
            font_screen_scale=0.8,
        )

        def put(position: Array, _wxyz: Array, phase: str) -> None:
            moved(self.name, position, phase)

        def dragged(drag: Drag) -> None:
            if drag.phase == "start":
                grabbed(self.name)
            self.handles.drag(drag, area(), put)

        self.handles.on_move(put)
        gestures.on_drag(self.ball, dragged)
        gestures.on_click(self.ball, lambda: clicked(self.name))

    def adopt(self, name: str, transform: Transform, *, on: bool, handles: bool) -> None:
        """Move to the transform's place, unless the browser has moved there already."""
        assert transform.anchor is not None
        plane = transform.anchor_plane
        self.handles.stand(transform.anchor, viser.transforms.SO3.from_matrix(axes_of(plane)).wxyz)
        flat = plane is not None
        self.gizmo.active_axes = (True, True, not flat)
        self.region.points = _rings(flat=flat)
        self.name = name
        self._label.text = f"{name.lower()}: goal" if transform.ends_motions else name.lower()
        self.ball.color = palette.BIAS if on else palette.STALE
        self.region.colors = np.array(palette.REGION if on else palette.STALE, dtype=np.uint8)
        self.handles.show(handles)
        self.region.visible = handles and self._has_region
        self.gizmo.visible = True

    def show_region(self, transform: Transform, used: float | None) -> None:
        """Show the region of the transform: the radius used, or the one it asks for; nothing while neither is known."""
        radius = used or transform.region
        if radius is not None:
            self.region.scale = (radius, radius, radius)
        self._has_region = radius is not None
        self.region.visible = self.handles.shown and self._has_region

    def hide(self) -> None:
        """Hide the marker: there is no such transform."""
        self.name = ""
        self.gizmo.visible = False


@lru_cache(maxsize=2)
def _rings(*, flat: bool) -> Array:
    """Return segments (K, 2, 3) of a unit circle in the plane of the first two axes, or of one in each such plane."""
    turn = np.linspace(0, 2 * np.pi, NUM_SEGMENTS + 1)
    circle = np.column_stack([np.cos(turn), np.sin(turn), np.zeros(len(turn))])
    circles = [circle] if flat else [np.roll(circle, shift, axis=1) for shift in range(3)]
    return np.concatenate([np.stack([c[:-1], c[1:]], axis=1) for c in circles]).astype(np.float32)


class Anchors(Dragged):
    """All transforms of a scenario that have a place."""

    def __init__(
        self,
        scene: viser.SceneApi,
        moved: Moved,
        grabbed: Callable[[str], None],
        clicked: Callable[[str], None],
    ) -> None:
        """Begin with none; see `AnchorPicture`."""
        super().__init__(scene.add_frame("/bias", show_axes=False))
        self._transforms: Mapping[str, Transform] = {}
        self.items = tuple(AnchorPicture(scene, k, moved, grabbed, clicked, self.area) for k in range(MAX_ANCHORS))

    @property
    def handles(self) -> Iterable[Handles]:
        return [item.handles for item in self.items]

    def draw(self, frame: Frame) -> None:
        """Shows the regions, and remembers the slice for drags."""
        super().draw(frame)
        layers = zip(frame.scenario.stack, frame.chosen_values, strict=False)
        radii = {layer.name: chosen.get("radius") for layer, chosen in layers}
        for item, (name, transform) in zip(self.items, self._transforms.items(), strict=False):
            item.show_region(transform, radii.get(name))

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's transforms where they stand."""
        self._transforms = anchored(scenario)
        on = {layer.name for layer in scenario.stack if layer.on}
        shown = scenario.view.bias_handles and not scenario.view.move_slice
        handled = selected(scenario) if shown else None
        for item, (name, transform) in zip(self.items, self._transforms.items(), strict=False):
            item.adopt(name, transform, on=name in on, handles=name == handled)
        for item in self.items[len(self._transforms) :]:
            item.hide()
