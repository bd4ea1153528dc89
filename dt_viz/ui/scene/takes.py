"""Takes that are seen before they are learned: as they were recorded, and as they are learned from."""

from __future__ import annotations

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length, resample_by_arc_length
from dt_viz.session.opening import Preview
from dt_viz.ui.scene.palette import LIGHT, Theme
from dt_viz.ui.scene.picture import Lines, Shown, add_ball, add_label
from dt_viz.ui.scene.style import STYLES

MOST_POINTS = 60_000
"""Number of points that all takes together are drawn with."""


class Takes(Shown):
    """Lines of takes, each in its colour, grey and dashed where they are left out; the goal, and the name of one.

    Of takes that were taught the way of the pointer is dotted, and red where it is out of reach.
    """

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/takes", show_axes=False, visible=False))
        self.learned = [Lines(scene, f"/takes/{k}", STYLES.take, k) for k in range(len(LIGHT.takes))]
        self.given = Lines(scene, "/takes/given", STYLES.take_given)
        self.left_out = Lines(scene, "/takes/left_out", STYLES.take_left_out)
        self.drawn, self.beyond = Lines(scene, "/takes/drawn", STYLES.drawn), Lines(scene, "/takes/beyond", STYLES.far)
        self.goal = scene.add_frame("/takes/goal", show_axes=False)
        add_ball(scene, "/takes/goal/ball", STYLES.goal)
        add_label(scene, "/takes/goal/label", "goal", height=0.02)
        self.name = add_label(scene, "/takes/name")

    def draw(self, seen: Preview, number: int, theme: Theme) -> None:
        """Show takes; the name of one of them stands at its start."""
        most = max(MOST_POINTS // max(len(seen.takes), 1), 20)
        for k, lines in enumerate(self.learned):
            own = [take.learned for take in seen.takes[k :: len(self.learned)] if take.learned is not None]
            lines.show([_thinned(path, most) for path in own], theme)
        self.given.show([_thinned(take.given, most) for take in seen.takes if take.learned is not None], theme)
        self.left_out.show([_thinned(take.given, min(most, 150)) for take in seen.takes if take.learned is None], theme)
        self.drawn.show([_dense(path) for path in seen.drawn], theme)
        self.beyond.show(seen.beyond, theme)
        self.goal.visible = seen.goal is not None
        if seen.goal is not None:
            self.goal.position = seen.goal
        self.name.visible = bool(seen.takes)
        if not seen.takes:
            return
        one = seen.takes[number]
        start = (one.given if one.learned is None else one.learned)[0]
        self.name.text, self.name.position = one.inspection.name[:40], start + np.array([0.0, 0.0, 0.015])


def _thinned(path: Array, most: int) -> Array:
    """At most so many of the points (T, 3) of a path."""
    return path[np.unique(np.linspace(0, len(path) - 1, min(len(path), most)).round().astype(int))]


def _dense(path: Array, step: float = STYLES.drawn.dash / 2, most: int = 2000) -> Array:
    """The path (N, 3), metres, with so many samples that it can be dotted."""
    return resample_by_arc_length(path, min(int(arc_length(path)[-1] / step) + 2, most))
