"""Added starts in the scene: small balls that are dragged, and clicks on the slice that add one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.starts import struck
from dt_viz.session.frame import Frame
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Clicks, Drag
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import Pull
from dt_viz.ui.scene.picture import Picture

RADIUS = 0.010
"""Radius of a ball, metres."""

Moved = Callable[[int, Array, str], None]
"""Callback with the index of a start, its new position (3,), metres, and the phase of the drag."""


class StartBall:
    """One added start, with its number as in warnings."""

    def __init__(
        self,
        scene: viser.SceneApi,
        index: int,
        moved: Moved,
        chosen: Callable[[int], None],
        area: Callable[[], Slice | None],
    ) -> None:
        """Make the ball, without a place.

        Args:
            scene: scene of the visitor.
            index: index of the start in the scenario.
            moved: called with each new position.
            chosen: called when it is clicked.
            area: returns the slice that it is dragged parallel to.
        """
        self.ball = scene.add_icosphere(
            f"/starts/{index}", radius=RADIUS, color=palette.ADDED, subdivisions=2, cast_shadow=False
        )
        scene.add_label(
            f"/starts/{index}/label",
            str(index + 1),
            position=(0.0, 0.0, RADIUS),
            anchor="bottom-center",
            font_screen_scale=0.6,
        )
        pull = Pull()

        def dragged(drag: Drag) -> None:
            moved(index, pull.place(drag, np.array(self.ball.position), area()), drag.phase)

        gestures.on_drag(self.ball, dragged)
        gestures.on_click(self.ball, partial(chosen, index))


class Starts(Picture):
    """All added starts of a scenario."""

    def __init__(
        self, scene: viser.SceneApi, moved: Moved, chosen: Callable[[int], None], clicked: Callable[[Array], None]
    ) -> None:
        """Begin with none.

        Args:
            scene: scene of the visitor.
            moved: called with each new position of a start.
            chosen: called with the index of a clicked start.
            clicked: called with a place (3,), metres, on the slice that was clicked to add a start.
        """
        super().__init__(scene.add_frame("/starts", show_axes=False))
        self._scene, self._moved, self._chosen, self._clicked = scene, moved, chosen, clicked
        self._slice: Slice | None = None
        self._clicks = Clicks(scene, self.click)
        self.items: list[StartBall] = []
        """Pictures of the starts, in the order of the scenario."""

    def draw(self, frame: Frame) -> None:
        """Remembers the slice; starts without a motion are grey."""
        self._slice = frame.slice
        colour = palette.STALE if frame.blocked else palette.ADDED
        for item in self.items:
            item.ball.color = colour

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's starts, and listen to clicks on the slice if the view says so."""
        while len(self.items) > len(scenario.starts):
            self.items.pop().ball.remove()
        while len(self.items) < len(scenario.starts):
            ball = StartBall(self._scene, len(self.items), self._moved, self._chosen, lambda: self._slice)
            self.items.append(ball)
        for item, start in zip(self.items, scenario.starts, strict=True):
            item.ball.position = start.place
        self._clicks.listen(scenario.view.click_to_start)

    def click(self, origin: Array, direction: Array) -> None:
        """Add a start where a ray, given by `origin` and `direction` (3,), meets the slice, unless it hits a start."""
        place = None if self._slice is None else struck(self._slice, origin, direction)
        if place is not None and not any(self._hits(item, origin, direction) for item in self.items):
            self._clicked(place)

    def _hits(self, item: StartBall, origin: Array, direction: Array) -> bool:
        away = np.cross(item.ball.position - origin, direction / np.linalg.norm(direction))
        return bool(np.linalg.norm(away) <= 1.1 * RADIUS)
