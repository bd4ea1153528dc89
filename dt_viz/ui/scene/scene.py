"""Frame → scene handles. Each picture is a class with `draw(frame)` and `visible`."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import viser

from dt_viz.motion.diagnostics import MAX_GOAL_MISS
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.stack import anchored
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.anchors import BALL_RADIUS, Anchors
from dt_viz.ui.scene.arm_layers import Onion
from dt_viz.ui.scene.comparison import ComparedMotions
from dt_viz.ui.scene.levels import LevelRollouts
from dt_viz.ui.scene.manifold import Generator, WarpedGrid
from dt_viz.ui.scene.obstacles import Obstacles
from dt_viz.ui.scene.panels import Panels
from dt_viz.ui.scene.picture import Picture
from dt_viz.ui.scene.rollouts import Demonstrations, Ghost, Middles, Rollouts
from dt_viz.ui.scene.slice import MovableSlice
from dt_viz.ui.scene.slice_layers import ColourSlice, FieldArrows, OccupancySlice, Streamlines
from dt_viz.ui.scene.stage import Table, background, set_stage
from dt_viz.ui.scene.starts import Starts

GOAL, OLD_GOAL = "goal", "demonstrated goal"
"""Labels of the demonstrations' end: where motions end there, and where they end elsewhere."""
OF_A_MOTION = {"field", "streamlines", "grid", "onion"}
"""Fields of `View` whose pictures are hidden while there is no motion: unlike the rollouts they cannot turn grey."""
OF_A_TASK = {"demonstrations", "ghost", "panels", "compared"}
"""Fields of `View` whose pictures are hidden while another task or scene is being computed."""
COMPUTING = "computing"


class Goal(Picture):
    """The goal as a ball, and a second ball where motions end if something covers the goal."""

    def __init__(self, scene: viser.SceneApi) -> None:
        self._goal = scene.add_frame("/goal", show_axes=False)
        super().__init__(self._goal)
        label = {"position": (0.0, 0.0, 0.02), "anchor": "bottom-center", "font_screen_scale": 0.8}
        scene.add_icosphere("/goal/ball", radius=0.012, color=palette.GOAL)
        self.label = scene.add_label("/goal/label", GOAL, **label)
        self._end = scene.add_frame("/end", show_axes=False, visible=False)
        scene.add_icosphere("/end/ball", radius=0.009, color=palette.ROLLOUT)
        scene.add_label("/end/label", "end", **label)

    def draw(self, frame: Frame) -> None:
        self._goal.position = frame.goal
        self._end.position = frame.reached
        elsewhere = bool(np.linalg.norm(frame.reached - frame.goal) > MAX_GOAL_MISS)
        self.label.text = OLD_GOAL if elsewhere else GOAL
        # the marker of a transform that moves the goal says so
        goals = [to.anchor for to in anchored(frame.scenario).values() if to.anchor is not None and to.ends_motions]
        marked = any(np.linalg.norm(frame.reached - goal) < BALL_RADIUS for goal in goals)
        self._end.visible = elsewhere and not marked


class ScenePictures:
    """Everything in the scene of one visitor that is drawn from frames."""

    def __init__(
        self,
        scene: viser.SceneApi,
        robot: Robot,
        obstacles: Obstacles,
        anchors: Anchors,
        area: MovableSlice,
        starts: Starts,
    ) -> None:
        """Build the rest of the scene of this robot, beside what its visitor drags."""
        set_stage(scene)
        self._scene = scene
        self.obstacles, self.anchors, self.slice, self.starts = obstacles, anchors, area, starts
        self._always: tuple[Picture, ...] = (
            self.obstacles,
            self.anchors,
            self.slice,
            self.starts,
            LevelRollouts(scene),
            Goal(scene),
        )
        self.middles = Middles()
        """Of the rollouts that are drawn."""
        self.rollouts = Rollouts(scene, self.middles)
        self._by_view: dict[str, Picture] = {
            "demonstrations": Demonstrations(scene, self.middles),
            "rollouts": self.rollouts,
            "ghost": Ghost(scene, self.middles),
            "field": FieldArrows(scene),
            "streamlines": Streamlines(scene),
            "table": Table(scene),
            "generator": Generator(scene),
            "grid": WarpedGrid(scene),
            "panels": Panels(scene),
            "onion": Onion(scene, robot),
            "compared": ComparedMotions(scene),
        }
        self._view, self._blocked = View(), False
        self._showing = threading.Lock()  # views change on another thread than the one that draws
        self._drawing = threading.Lock()
        self._frame: Frame | None = None
        self._adopted: Scenario | None = None
        self._grey = False
        """Whether the last frame was drawn as `stale`."""
        function = ColourSlice(scene)
        self._by_colour: dict[str, Picture] = {
            "det": function,
            "lyapunov": function,
            "occupancy": OccupancySlice(scene),
        }

    def layer(self, view: str) -> Picture:
        """The picture that this field of `View` shows or hides."""
        return self._by_view[view]

    @property
    def stale(self) -> bool:
        """Whether the last frame belongs to another task or scene than the scenario adopted since."""
        return not (self._frame is None or self._adopted is None or self._frame.scenario.begins_like(self._adopted))

    def draw(self, frame: Frame) -> None:
        """Assign fresh arrays to the handles."""
        with self._drawing:
            self._frame = frame
            self._draw(frame)

    def _draw(self, frame: Frame) -> None:
        """Draw a frame, a stale one grey: as one that there is no motion for."""
        before, self._grey = (self._blocked, self._grey), self.stale
        self.middles.shown = self._view.rollouts
        if self._grey:
            frame = replace(frame, blocked=(*frame.blocked, COMPUTING))
        for picture in self._pictures:
            picture.draw(frame)
        if (bool(frame.blocked), self._grey) != before:
            with self._showing:
                self._blocked = bool(frame.blocked)
                self._show()

    def dye(self, dark: bool) -> None:
        """Take the colours of the dark theme, or of the light one."""
        self._scene.set_background_image(background(dark), "png")
        with self._drawing:
            for picture in self._pictures:
                picture.dye(dark)
            if self._frame is not None:
                self._draw(self._frame)

    @property
    def _pictures(self) -> tuple[Picture, ...]:
        return *self._always, *self._by_view.values(), *dict.fromkeys(self._by_colour.values())

    def adopt(self, scenario: Scenario) -> None:
        """Show and hide what the scenario's view says, and move the obstacles to where they stand."""
        self._adopted = scenario
        self.obstacles.adopt(scenario)
        self.anchors.adopt(scenario)
        self.slice.adopt(scenario)
        self.starts.adopt(scenario)
        with self._showing:
            self._view = scenario.view
            self._show()
        # a thread that is drawing has seen the new scenario, or is waited for
        if (self.stale, scenario.view.rollouts) != (self._grey, self.middles.shown):
            with self._drawing:
                if self._frame is not None:
                    self._draw(self._frame)

    def _show(self) -> None:
        """Show what the view says; nothing that belongs to another motion while the scenario has none."""
        for name, picture in self._by_view.items():
            hidden = (self._blocked and name in OF_A_MOTION) or (self._grey and name in OF_A_TASK)
            picture.visible = bool(getattr(self._view, name)) and not hidden
        shown = None if self._blocked else self._by_colour.get(self._view.colour)
        for picture in self._by_colour.values():
            picture.visible = picture is shown

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide all handles for as long as a picture takes, and the table: on white it would end at the horizon."""
        table = self._by_view["table"]
        shown, table.visible = table.visible, False
        try:
            with self.obstacles.without_handles(), self.anchors.without_handles(), self.slice.without_handles():
                yield
        finally:
            table.visible = shown
