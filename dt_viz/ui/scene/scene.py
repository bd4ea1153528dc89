"""Frame → scene handles. Each picture is a class with `draw(frame, look)` and `visible`."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from typing import NamedTuple

import numpy as np
import viser

from dt_viz.motion.diagnostics import MAX_GOAL_MISS
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import anchored
from dt_viz.session.frame import Frame
from dt_viz.session.opening import Preview
from dt_viz.session.session import Session
from dt_viz.ui.scene.arm import ArmSequence
from dt_viz.ui.scene.comparison import ComparedMotions
from dt_viz.ui.scene.draggables import BiasPoints, MovableSlice, Obstacles, Starts
from dt_viz.ui.scene.legend import Legend
from dt_viz.ui.scene.palette import LIGHT, STYLES, Theme
from dt_viz.ui.scene.picture import Look, Picture, add_ball, add_label
from dt_viz.ui.scene.rollouts import LevelRollouts, Rollouts, Takes, demonstrations, ghost
from dt_viz.ui.scene.slice_layers import (
    ColourSlice,
    FieldArrows,
    Generator,
    OccupancySlice,
    Panels,
    Streamlines,
    WarpedGrid,
)
from dt_viz.ui.scene.stage import Board, Stage
from dt_viz.ui.scene.tubes import RolloutTubes

GOAL, OLD_GOAL = "goal", "demonstrated goal"
"""Labels of the demonstrations' end: where motions end there, and where they end elsewhere."""
OF_A_MOTION = {"field", "streamlines", "grid", "onion"}
"""Fields of `View` whose pictures are hidden while there is no motion: unlike the rollouts they cannot turn grey."""
OF_A_TASK = {"demonstrations", "ghost", "panels", "compared"}
"""Fields of `View` whose pictures are hidden while another task or scene is being computed."""


class Goal(Picture):
    """The goal as a ball, and a second ball where motions end if something covers the goal."""

    def __init__(self, scene: viser.SceneApi) -> None:
        super().__init__(scene.add_frame("/goal", show_axes=False))
        add_ball(scene, "/goal/ball", STYLES.goal)
        self.label = add_label(scene, "/goal/label", GOAL, height=0.02)
        self._end = scene.add_frame("/end", show_axes=False, visible=False)
        add_ball(scene, "/end/ball", STYLES.end)
        add_label(scene, "/end/label", "end", height=0.02)

    def draw(self, frame: Frame, look: Look) -> None:
        self.node.position = frame.goal
        self._end.position = frame.reached
        elsewhere = bool(np.linalg.norm(frame.reached - frame.goal) > MAX_GOAL_MISS)
        self.label.text = OLD_GOAL if elsewhere else GOAL
        # the marker of a transform that moves the goal says so
        goals = [to.position for to in anchored(frame.scenario).values() if to.moves_goal]
        marked = any(np.linalg.norm(frame.reached - goal) < STYLES.bias.radius for goal in goals)
        self._end.visible = elsewhere and not marked


class Markers(NamedTuple):
    """All that a visitor drags, but for the hand."""

    obstacles: Obstacles
    bias_points: BiasPoints
    slice: MovableSlice
    starts: Starts


class ScenePictures:
    """Everything in the scene of one visitor that is drawn from frames."""

    def __init__(self, scene: viser.SceneApi, robot: Robot, session: Callable[[], Session]) -> None:
        """Build the scene of this robot; `session` returns the one that its markers edit."""
        self.markers = Markers(
            Obstacles(scene, session), BiasPoints(scene, session), MovableSlice(scene, session), Starts(scene, session)
        )
        self._always: tuple[Picture, ...] = (*self.markers, LevelRollouts(scene), Goal(scene))
        self._by_view: dict[str, Picture] = {
            "demonstrations": demonstrations(scene),
            "rollouts": Rollouts(scene),
            "ghost": ghost(scene),
            "field": FieldArrows(scene),
            "streamlines": Streamlines(scene),
            "table": Stage(scene),
            "generator": Generator(scene),
            "grid": WarpedGrid(scene),
            "panels": Panels(scene),
            "onion": ArmSequence(scene, robot),
            "compared": ComparedMotions(scene),
        }
        function = ColourSlice(scene)
        self._by_colour: dict[str, Picture] = {
            "det": function,
            "lyapunov": function,
            "occupancy": OccupancySlice(scene),
        }
        self._takes = Takes(scene)
        self.board = Board(scene)  # what a visitor draws on
        self._showing = threading.Lock()  # views change on another thread than the one that draws
        self._drawing = threading.Lock()
        self._frame: Frame | None = None
        self._adopted: Scenario | None = None
        self._theme = LIGHT
        self.look = Look()  # what the last frame was drawn with

    def layer(self, view: str) -> Picture:
        """The picture that this field of `View` shows or hides."""
        return self._by_view[view]

    @property
    def legends(self) -> list[Legend]:
        """What explains the colours and lines that are shown, in a saved picture."""
        pictures = *dict.fromkeys(self._by_colour.values()), *self._by_view.values()
        return [picture.legend for picture in pictures if picture.visible and picture.legend is not None]

    def take(self, scene: viser.SceneApi, robot: Robot) -> None:
        """Show another arm from now on."""
        with self._drawing:
            self._by_view["onion"].node.remove()
            self._by_view["onion"] = ArmSequence(scene, robot)
        self._show()

    def draw(self, frame: Frame) -> None:
        """Assign fresh arrays to the handles."""
        with self._drawing:
            self._frame = frame
            self._draw()

    def adopt(self, scenario: Scenario) -> None:
        """Show and hide what the scenario's view says, and move the markers to where their things stand."""
        self._adopted = scenario
        for markers in self.markers:
            markers.adopt(scenario)
        self._show()
        # a thread that is drawing has seen the new scenario, or is waited for
        if self._wanted_look() != self.look:
            self._redraw()

    def paint(self, theme: Theme) -> None:
        """Draw the last frame again in the colours of another theme."""
        if theme is not self._theme:
            self._theme = theme
            self._redraw()

    def preview(self, seen: Preview | None, number: int) -> None:
        """Show takes in place of the motions, with the name of one of them; None ends it."""
        if seen is not None:
            self._takes.draw(seen, number, self._theme)
        self._takes.visible = seen is not None
        for picture in (*self.markers[:2], self.markers.starts, self._always[-1]):
            picture.visible = seen is None
        self._show()

    def _redraw(self) -> None:
        with self._drawing:
            if self._frame is not None:
                self._draw()

    def _wanted_look(self) -> Look:
        """How the frame is to be drawn: a stale one as one that there is no motion for."""
        frame, tubes, adopted = self._frame, self.look.tubes, self._adopted
        if frame is None:
            return self.look
        stale = adopted is not None and not frame.scenario.begins_like(adopted)
        blocked = stale or bool(frame.blocked)
        shown = adopted is None or adopted.view.rollouts
        if tubes.rollouts is not frame.rollouts or tubes.shown != shown:
            tubes = RolloutTubes(frame.rollouts, shown)
        return Look(self._theme.without_motion if blocked else self._theme, blocked, stale, tubes)

    def _draw(self) -> None:
        assert self._frame is not None
        before, self.look = self.look, self._wanted_look()
        for picture in (*self._always, *self._by_view.values(), *dict.fromkeys(self._by_colour.values())):
            picture.draw(self._frame, self.look)
        if (before.blocked, before.stale) != (self.look.blocked, self.look.stale):
            self._show()

    def _show(self) -> None:
        """Show what the view says; nothing that belongs to another motion while the scenario has none."""
        with self._showing:
            if self._adopted is None:
                return
            view, look = self._adopted.view, self.look
            hidden = (OF_A_MOTION if look.blocked else set()) | (OF_A_TASK if look.stale else set())
            hidden = set(self._by_view) - {"table"} if self._takes.visible else hidden
            for name, picture in self._by_view.items():
                picture.visible = bool(getattr(view, name)) and name not in hidden
            shown = None if look.blocked or self._takes.visible else self._by_colour.get(view.colour)
            for picture in self._by_colour.values():
                picture.visible = picture is shown

    @contextmanager
    def without_handles(self) -> Iterator[None]:
        """Hide what is there for the page only, for as long as a picture takes."""
        with ExitStack() as stack:
            for picture in (*self._always, *self._by_view.values()):
                stack.enter_context(picture.without_handles())
            yield
