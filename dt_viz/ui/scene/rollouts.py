"""Motions in the scene: rollouts as tubes, those of a level of the stack, and the lines beside them."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import viser

from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length, resample_by_arc_length
from dt_viz.motion.diagnostics import MAX_GOAL_MISS
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import IMITATION
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.opening import Preview
from dt_viz.ui.scene.palette import LIGHT, STYLES, Theme
from dt_viz.ui.scene.picture import Lines, Look, Picture, Shown, add_ball, add_label
from dt_viz.ui.scene.tubes import Tubes, middles_of

NUM_HANDS = 7  # number of frames along a motion that show the hand's orientation
HAND_AXIS = 0.045  # length of their axes, metres


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


MOST_POINTS = 60_000  # number of points that all takes together are drawn with


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
