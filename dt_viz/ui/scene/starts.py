"""Added starts in the scene: small balls that are dragged, and clicks on the slice that add one."""

from __future__ import annotations

from collections.abc import Callable
from typing import cast

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.starts import followed, struck, with_moved_start, with_start
from dt_viz.session.frame import Frame
from dt_viz.session.session import Session
from dt_viz.ui.gestures import Clicks
from dt_viz.ui.scene.markers import Marker, MarkerGroup
from dt_viz.ui.scene.picture import Look, add_ball, add_label
from dt_viz.ui.scene.style import STYLES


class Starts(MarkerGroup[Marker]):
    """All added starts of a scenario, each with its number as in warnings."""

    def __init__(self, scene: viser.SceneApi, session: Callable[[], Session]) -> None:
        super().__init__(scene, scene.add_frame("/starts", show_axes=False), session)
        self._clicks = Clicks(scene, self.click)

    def draw(self, frame: Frame, look: Look) -> None:
        """Remembers the slice; starts without a motion are grey."""
        self.area = frame.slice
        with self._changing:
            for marker in self.items:
                marker.node.color = look.theme.added

    def adopt(self, scenario: Scenario) -> None:
        """Show the scenario's starts, and listen to clicks on the slice if the view says so."""
        self._fit(len(scenario.starts))
        for marker, start in zip(self.items, scenario.starts, strict=True):
            marker.stand(start.place)
        self._clicks.listen(scenario.view.click_to_start)

    def clicked(self, marker: Marker) -> None:
        """Have the arm begin there."""
        session, index = self._session(), cast(int, marker.key)
        if index < len(session.scenario.starts):  # or it was removed a moment ago
            session.edit("Follows rollout", arm_rollout=len(session.task.demonstrations) + index)

    def click(self, origin: Array, direction: Array) -> None:
        """Add a start where a ray, given by `origin` and `direction` (3,), meets the slice, unless it hits a start."""
        place = None if self.area is None else struck(self.area, origin, direction)
        if place is None or any(_hits(marker.position, origin, direction) for marker in self.items):
            return
        session = self._session()
        scenario = session.scenario
        arm_rollout = followed(scenario, session.task)
        session.edit("add start", starts=with_start(scenario, place), arm_rollout=arm_rollout)
        session.end_gesture()

    def grabbed(self, marker: Marker) -> None:
        """None is selected."""

    def _new(self, index: int) -> Marker:
        node = f"/starts/{index}"
        ball = add_ball(self.scene, node, STYLES.start, subdivisions=2, cast_shadow=False)
        add_label(self.scene, f"{node}/label", str(index + 1), font_screen_scale=0.6, height=STYLES.start.radius)
        return Marker(self, ball, ball, key=index)

    def _move(self, session: Session, marker: Marker, position: Array, wxyz: Array) -> None:
        index = cast(int, marker.key)
        session.edit(f"start {index}", starts=with_moved_start(session.scenario, index, position))


def _hits(place: Array, origin: Array, direction: Array) -> bool:
    """Whether a ray hits the ball of a start at a place (3,), metres."""
    away = np.cross(place - origin, direction / np.linalg.norm(direction))
    return bool(np.linalg.norm(away) <= 1.1 * STYLES.start.radius)
