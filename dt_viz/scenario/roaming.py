"""Smooth random ways of an obstacle that crosses a task's motion again and again, and of a goal that moves."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.flows.fields import Array
from dt_viz.metrics import interpolate, resample_by_arc_length
from dt_viz.numerics import divisor, unit
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import Stack, plane_of, with_added, with_avoidance, with_transform
from dt_viz.scenario.tasks import Task


@dataclass(frozen=True)
class RoamingSettings:
    """The round of an obstacle, and the sway of a goal; lengths in metres, times in seconds."""

    swings: int = 5  # number of swings through the motion and back on one round
    turns: int = 3  # number of turns of their direction
    along: float = 0.3
    """Largest distance of the swings' middle from that of the motion, in lengths of the motion."""
    beside: float = 0.22
    """Distance from the motion at which an obstacle turns round, beside its own size."""
    soft: float = 0.03  # width in which the round bends where it comes near to table or pedestal
    table_room: float = 0.01  # height of the obstacle above the table
    pedestal_room: float = 0.20
    """Distance of the obstacle's surface from the axis of the arm's base."""
    joining: float = 0.8  # time constant with which an obstacle joins its round
    goal_sway: float = 0.07  # amplitude of a goal that moves
    goal_periods: tuple[float, float] = (7.0, 11.0)  # periods of a goal that moves, along two axes


SETTINGS = RoamingSettings()


def crossings(task: Task, size: float, rng: np.random.Generator) -> Array:
    """A closed path (1200, 3), metres, evenly sampled, that crosses the mean motion again and again.

    It is a rose curve, whose petals all pass its middle, and the middle goes to and fro along the motion.

    Args:
        task: whose motion it is.
        size: radius of what moves, metres.
        rng: for directions and places.
    """
    mean = resample_by_arc_length(task.mean_path, 201)
    return max((_rose(mean, size, rng) for _ in range(12)), key=_smoothness)  # the smoothest of some


def _smoothness(way: Array) -> float:
    """Cosine of the sharpest angle between neighbouring pieces of a way."""
    pieces = unit(np.diff(np.concatenate([way, way[1:2]]), axis=0))
    return float((pieces[1:] * pieces[:-1]).sum(axis=1).min())


def _rose(mean: Array, size: float, rng: np.random.Generator) -> Array:
    """A way around a mean motion (201, 3), which may have corners where it is bent away from table and pedestal."""
    u, v = np.linalg.qr(rng.normal(size=(3, 2)))[0].T
    at, angle = rng.uniform(0, 2 * np.pi, size=2)
    round_ = np.linspace(0, 2 * np.pi, 4800)
    along = 200 * (0.5 + SETTINGS.along * np.sin(round_ + at))
    middle = interpolate(along, np.arange(201), mean)
    turned = SETTINGS.turns * round_ + angle
    direction = np.cos(turned)[:, None] * u + np.sin(turned)[:, None] * v
    way = middle + (SETTINGS.beside + size) * np.sin(SETTINGS.swings * round_)[:, None] * direction
    way[:, 2] = _at_least(way[:, 2], size + SETTINGS.table_room)
    away = np.linalg.norm(way[:, :2], axis=1)
    way[:, :2] *= (_at_least(away, size + SETTINGS.pedestal_room) / divisor(away))[:, None]
    return resample_by_arc_length(way, 1200)


def _at_least(values: Array, least: float) -> Array:
    """Values, smoothly kept above the least."""
    return (values + least + np.sqrt((values - least) ** 2 + SETTINGS.soft**2)) / 2


class Chase:
    """The selected obstacle, or a new sphere, crosses the motion at a constant speed."""

    def __init__(self, task: Task, scenario: Scenario, speed: float, rng: np.random.Generator) -> None:
        """Choose its way.

        Args:
            task: the scenario's.
            scenario: before.
            speed: m/s.
            rng: for the way.
        """
        selected = scenario.selected
        self._index = 0 if selected is None else selected
        self._begins = Sphere(task.obstacle_position) if selected is None else scenario.obstacles[selected]
        self._way, self._speed = crossings(task, self._begins.radius, rng), speed
        steps = np.linalg.norm(np.diff(self._way, axis=0), axis=1)
        self._length = float(steps.sum())
        # it begins where it is nearest to
        nearest = int(np.linalg.norm(self._way - np.asarray(self._begins.position), axis=1).argmin())
        self._offset = float(steps[:nearest].sum())

    def place(self, seconds: float) -> Array:
        """Where the obstacle is (3,), metres."""
        joins = np.exp(-seconds / SETTINGS.joining) * (np.asarray(self._begins.position) - self._at(0.0))
        return self._at(self._speed * seconds) + joins

    def __call__(self, scenario: Scenario, seconds: float) -> dict[str, Stack]:
        """The stack with the obstacle where it is after some seconds."""
        obstacles = list(scenario.obstacles)
        moved = self._begins.moved(as_point(self.place(seconds)), self._begins.wxyz)
        obstacles[self._index : self._index + 1] = [moved]
        return {"stack": with_avoidance(scenario, obstacles=tuple(obstacles))}

    def _at(self, length: float) -> Array:
        along = (self._offset + length) % self._length / self._length * (len(self._way) - 1)
        return interpolate(np.array([along]), np.arange(len(self._way)), self._way)[0]


class MovingGoal:
    """A bias point takes the goal along a figure around its place."""

    def __init__(self, task: Task, goal: Array) -> None:
        """Take the task and its goal (3,), metres."""
        self._goal, self._axes = goal, task.slice.axes
        self._point = BiasPoint(as_point(goal), moves_goal=True, plane=plane_of(task))
        self._name = ""

    def __call__(self, scenario: Scenario, seconds: float) -> dict[str, Stack]:
        """The stack with the goal where it is after some seconds."""
        if not self._name:
            stack, self._name = with_added(scenario, self._point)
            scenario = replace(scenario, stack=stack)
        sway = SETTINGS.goal_sway * np.sin(2 * np.pi * seconds / np.array(SETTINGS.goal_periods))
        place = self._goal + self._axes @ sway
        place[2] = max(place[2], self._goal[2] - SETTINGS.goal_sway / 2, SETTINGS.table_room)
        return {"stack": with_transform(scenario, self._name, replace(self._point, position=as_point(place)))}
