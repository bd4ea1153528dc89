"""Added starts in the scene: small balls that are dragged, and places on the slice that are clicked to add one."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
import viser

from dt_viz.engine.frame import Frame
from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.slices import Slice
from dt_viz.scenario.starts import struck
from dt_viz.ui import gestures
from dt_viz.ui.gestures import Clicks, Drag
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.handles import in_slice
from dt_viz.ui.scene.picture import Picture

RADIUS = 0.010
"""Of a ball, metres."""

Moved = Callable[[int, Array, str], None]
"""Told which start was moved, its position (3,), metres, and the phase of the drag."""


class StartBall:
    """One added start, with its number as doubts name it."""

    def __init__(
        self,
        scene: viser.SceneApi,
        index: int,
        moved: Moved,
        chosen: Callable[[int], None],
        area: Callable[[], Slice | None],
    ) -> None:
        """Stand nowhere yet.

        Args:
            scene: of the visitor.
            index: in the scenario.
            moved: told of each new position.
            chosen: told that it was clicked.
            area: what it is dragged parallel to.
        """
        self.ball = scene.add_icosphere(
            f"/starts/{index}", radius=RADIUS, color=palette.START, subdivisions=2, cast_shadow=False
        )
        scene.add_label(
            f"/starts/{index}/label",
            str(index + 1),
            position=(0.0, 0.0, RADIUS),
            anchor="bottom-center",
            font_screen_scale=0.6,
        )
        self._grabbed, self._from = np.zeros(3), np.zeros(3)

        def dragged(drag: Drag) -> None:
            if drag.phase == "start":
                self._grabbed, self._from = drag.grabbed, np.array(self.ball.position)
            place = gestures.place(self._from + in_slice(area(), drag.camera, self._grabbed, drag.pointer))
            moved(index, np.array(self.ball.position) if place is None else place, drag.phase)

        gestures.on_drag(self.ball, dragged)
        gestures.on_click(self.ball, partial(chosen, index))


class Starts(Picture):
    """All added starts of a scenario."""

    def __init__(
        self, scene: viser.SceneApi, moved: Moved, chosen: Callable[[int], None], clicked: Callable[[Array], None]
    ) -> None:
        """Begin with none.

        Args:
            scene: of the visitor.
            moved: told of a new position of one of them.
            chosen: told which one was clicked.
            clicked: told of a place (3,), metres, on the slice that was clicked to add one.
        """
        super().__init__(scene.add_frame("/starts", show_axes=False))
        self._scene, self._moved, self._chosen, self._clicked = scene, moved, chosen, clicked
        self._slice: Slice | None = None
        self._clicks = Clicks(scene, self.click)
        self.items: list[StartBall] = []
        """In the order of the scenario."""

    def draw(self, frame: Frame) -> None:
        """See `Picture`: remembers the slice; grey are starts from which nothing moves."""
        self._slice = frame.slice
        colour = palette.STALE if frame.blocked else palette.START
        for item in self.items:
            if item.ball.color != colour:
                item.ball.color = colour

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's starts, and listen to clicks on the slice while it says so."""
        while len(self.items) > len(scenario.starts):
            self.items.pop().ball.remove()
        while len(self.items) < len(scenario.starts):
            ball = StartBall(self._scene, len(self.items), self._moved, self._chosen, lambda: self._slice)
            self.items.append(ball)
        for item, start in zip(self.items, scenario.starts, strict=True):
            if np.abs(np.asarray(item.ball.position) - start).max() > 1e-9:
                item.ball.position = start
        self._clicks.listen(scenario.view.click_to_start)

    def click(self, origin: Array, direction: Array) -> None:
        """Add a start where this ray, both (3,), metres, meets the slice, unless one that is there was clicked."""
        place = None if self._slice is None else struck(self._slice, origin, direction)
        if place is not None and not any(self._hits(item, origin, direction) for item in self.items):
            self._clicked(place)

    def _hits(self, item: StartBall, origin: Array, direction: Array) -> bool:
        away = np.cross(item.ball.position - origin, direction / np.linalg.norm(direction))
        return bool(np.linalg.norm(away) <= 1.1 * RADIUS)
