"""Motions in the scene: rollouts as tubes, those of a level of the stack, and the lines beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.motion.diagnostics import MAX_GOAL_MISS
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION
from dt_viz.session.frame import Frame, Stage
from dt_viz.ui.scene.picture import Lines, Look, Picture, add_ball, add_label
from dt_viz.ui.scene.style import STYLES
from dt_viz.ui.scene.tubes import Tubes, middles_of

NUM_HANDS = 7
"""Number of frames along a motion that show the hand's orientation."""
HAND_AXIS = 0.045
"""Length of their axes, metres."""


class OutsideTubes(Picture):
    """Lines where they are not inside the tube of a rollout; while a drag goes on they follow with the field."""

    def __init__(self, lines: Lines, paths: Callable[[Frame], Sequence[Array]]) -> None:
        """Draw the paths (T_i, 3), metres, of each frame with these lines."""
        super().__init__(lines.node)
        self._lines, self._paths = lines, paths

    def draw(self, frame: Frame, look: Look) -> None:
        drawn = frame.task, look.tubes.shown, self._lines.style.on(look.theme)
        if self._is_new(*drawn) or frame.stage is not Stage.ROLLOUTS:
            segments = self._lines.segments(self._paths(frame))
            self._lines.show_segments(look.tubes.outside(segments), look.theme)


def demonstrations(scene: viser.SceneApi) -> OutsideTubes:
    """Return the picture of the demonstrations: thin lines."""
    return OutsideTubes(Lines(scene, "/demonstrations", STYLES.demonstration), lambda frame: frame.task.paths)


def ghost(scene: viser.SceneApi) -> OutsideTubes:
    """Return the picture of the undisturbed motions: a dashed line for the rollout that the arm follows.

    Where that is an added start without a motion, there is a line for each of the task's starts.
    """

    def paths(frame: Frame) -> Sequence[Array]:
        shown = frame.shaping if frame.chosen is None else np.arange(len(frame.ghost)) == frame.chosen
        return [path for path, is_shown in zip(frame.ghost, shown, strict=True) if is_shown]

    return OutsideTubes(Lines(scene, "/ghost", STYLES.ghost), paths)


class HandAxes(Picture):
    """Frames of the hand along the rollout that the arm follows, where its orientation was learned."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/rollouts/hands", show_axes=False, visible=False))
        self.axes = [Lines(scene, f"/rollouts/hands/{name}", STYLES.hand_axis, k) for k, name in enumerate("xyz")]

    def draw(self, frame: Frame, look: Look) -> None:
        frames = None if look.blocked or frame.level is not None else frame.hand_frames(NUM_HANDS)
        if frames is not None:
            places, turned = frames
            for k, axis in enumerate(self.axes):
                axis.show_segments(np.stack([places, places + HAND_AXIS * turned[:, :, k]], axis=1), look.theme)
        self.visible = frames is not None


class Rollouts(Picture):
    """The rollouts as tubes: the one that the arm follows thick, the others thin and translucent."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/rollouts", show_axes=False))
        self.followed = Tubes(scene, "/rollouts/followed", STYLES.followed)
        self.others = Tubes(scene, "/rollouts/others", STYLES.rollout)
        self.added = Tubes(scene, "/rollouts/added", STYLES.added)
        self.hands = HandAxes(scene)

    def draw(self, frame: Frame, look: Look) -> None:
        middles, theme = look.tubes.middles, look.theme
        places = np.array([place for place, path in enumerate(frame.rollouts) if len(path)], int)
        followed, added = places == (frame.chosen if frame.level is None else None), ~frame.shaping[places]
        self.followed.show(middles[followed], theme)
        # thinner beside those of a level
        self.others.show(middles[~added & ~followed], theme, scale=1.0 if frame.level is None else 0.7)
        self.added.show(middles[added & ~followed], theme)
        self.hands.draw(frame, look)


class LevelRollouts(Picture):
    """Rollouts of the selected level, without the transforms stacked on it, and the name of its manifold."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/level", show_axes=False, visible=False))
        self.tubes = Tubes(scene, "/level/rollouts", STYLES.level)
        self.end = scene.add_frame("/level/end", show_axes=False, visible=False)
        add_ball(scene, "/level/end/ball", STYLES.level_end)
        add_label(scene, "/level/end/label", "its end", height=0.02)
        self.label = add_label(scene, "/level/label", font_screen_scale=1.1)

    def draw(self, frame: Frame, look: Look) -> None:
        if frame.level is not None:
            paths = [path for path in frame.levels[frame.level] if len(path)]
            self.tubes.show(middles_of(paths), look.theme)
            self.end.position = paths[0][-1]  # marked unless it is the goal
            self.end.visible = bool(np.linalg.norm(paths[0][-1] - frame.goal) > MAX_GOAL_MISS)
            self.label.text, area = manifold(frame.scenario), frame.slice
            self.label.position = area.centre + np.array([0.0, 0.0, np.ptp(area.border[:, 2]) / 2 + 0.03])
        self.visible = frame.level is not None


def manifold(scenario: Scenario) -> str:
    """Return the name of the manifold of the level that the view shows."""
    level = scenario.view.level
    if level == IMITATION:
        return "manifold of the imitation" if scenario.imitation else "base attractor: straight motions"
    return f"manifold up to {level[:1].lower() + level[1:]}"
