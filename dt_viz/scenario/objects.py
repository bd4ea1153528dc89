"""Objects of a task, and how the hand moves them: pots and a ball that falls in, boxes that are pushed and lifted.

What an object does depends on where it is and where the hand goes, so it stays where the arm leaves it.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.fields import Array, Indices
from dt_viz.obstacles.shapes import Box, Sphere, lathe

FINGERS = 0.035  # distance of the hand's point from what the fingers push, metres
WALL = 0.004  # thickness of walls, metres


@dataclass(frozen=True)
class Hand:
    """Where the hand is, has been just before, and was when it came to the goal."""

    place: Array  # (3,), metres
    before: Array  # (3,), metres
    goal: Array  # (3,), metres; its place until then
    arrived: float  # time since it came there, seconds; 0 until then


def scaled(sizes: tuple[float, float, float], scale: float) -> tuple[float, float, float]:
    """Return sizes, metres, times a scale."""
    x, y, z = sizes
    return scale * x, scale * y, scale * z


class TaskObject(ABC):
    """An object that the hand moves."""

    @property
    @abstractmethod
    def start(self) -> Array | None:
        """Where it stands when the hand sets out, (3,), metres; None is in the hand."""

    @abstractmethod
    def surface(self) -> tuple[Array, Indices]:
        """Return vertices (V, 3), metres, about its place, and faces (F, 3), outward."""

    @abstractmethod
    def placed(self, scale: float, x: float, y: float) -> TaskObject:
        """Return it scaled about the base's foot and moved along the table by x and y, metres."""

    @abstractmethod
    def moved(self, place: Array, hand: Hand) -> Array:
        """Return its place (3,), metres, after it was at another one (3,) and the hand went on."""


@dataclass(frozen=True)
class Pot:
    """An open pot on the table."""

    x: float  # position of the axis, metres
    y: float
    radius: float = 0.055  # radius of the opening, metres
    height: float = 0.10  # height of the rim above the table, metres

    @property
    def opening(self) -> tuple[float, float, float]:
        """Middle of the opening, metres."""
        return self.x, self.y, self.height

    def surface(self) -> tuple[Array, Indices]:
        """Return vertices (V, 3), metres, above the middle of its bottom, and faces (F, 3), outward."""
        inner, outer = self.radius, self.radius + WALL
        profile = [(0.0, 0.0), (outer, 0.0), (outer, self.height), (inner, self.height), (inner, WALL), (0.0, WALL)]
        return lathe(profile, 64)

    def placed(self, scale: float, x: float, y: float) -> Pot:
        """Return it scaled and moved along the table, metres."""
        return Pot(scale * self.x + x, scale * self.y + y, scale * self.radius, scale * self.height)

    def catches(self, position: Array) -> bool:
        """Return whether an object released at `position` (3,), metres, falls into it."""
        x, y, z = (float(c) for c in position)
        return z > self.height and float(np.hypot(x - self.x, y - self.y)) < self.radius


@dataclass(frozen=True)
class Ball(TaskObject):
    """A ball that is carried to the goal and dropped there, into a pot or onto the table (fig. 8)."""

    pots: tuple[Pot, ...]
    radius: float = 0.022  # metres

    @property
    def start(self) -> None:
        return None

    def surface(self) -> tuple[Array, Indices]:
        return Sphere((0.0, 0.0, 0.0), 2 * self.radius).surface()

    def placed(self, scale: float, x: float, y: float) -> Ball:
        return Ball(tuple(pot.placed(scale, x, y) for pot in self.pots), scale * self.radius)

    def moved(self, place: Array, hand: Hand) -> Array:
        return hand.place if hand.arrived == 0 else self.fallen(hand.goal, hand.arrived)

    def fallen(self, place: Array, seconds: float) -> Array:
        """Return where a ball is that was dropped at a place (3,), metres, some time ago."""
        bottom = WALL if any(pot.catches(place) for pot in self.pots) else 0.0
        x, y, z = place
        return np.array([x, y, min(z, max(bottom + self.radius, z - 9.81 * seconds**2 / 2))])


@dataclass(frozen=True)
class PushedBox(TaskObject):
    """A box on the table that the hand pushes along a direction, while it is behind it."""

    middle: tuple[float, float]  # where it stands at first, metres
    direction: tuple[float, float]  # unit vector along which it is pushed
    sizes: tuple[float, float, float] = (0.07, 0.09, 0.19)
    """Length along the direction, width and height, metres."""
    friction: float = 0.5  # way that it is taken aside for each metre that it is pushed
    fingers: float = FINGERS  # distance of the hand's point from what it pushes, metres

    @classmethod
    def before(cls, hand: Array, goal: Array) -> PushedBox:
        """Return the box that a hand at a place (2,) begins to push towards a goal (2,), metres."""
        x, y = (goal - hand) / np.linalg.norm(goal - hand)
        ahead = FINGERS + cls.sizes[0] / 2
        return cls((float(hand[0] + ahead * x), float(hand[1] + ahead * y)), (float(x), float(y)))

    @property
    def start(self) -> Array:
        return np.array([*self.middle, self.sizes[2] / 2])

    def surface(self) -> tuple[Array, Indices]:
        vertices, faces = Box((0.0, 0.0, 0.0), self.sizes).surface()
        x, y = self.direction
        return vertices @ np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]]), faces

    def placed(self, scale: float, x: float, y: float) -> PushedBox:
        middle, sizes = (scale * self.middle[0] + x, scale * self.middle[1] + y), scaled(self.sizes, scale)
        return replace(self, middle=middle, sizes=sizes, fingers=scale * self.fingers)

    def moved(self, place: Array, hand: Hand) -> Array:
        along, across = np.array(self.direction), np.array([-self.direction[1], self.direction[0]])
        length, width, height = self.sizes
        offset, step = hand.place[:2] - place[:2], hand.place[:2] - hand.before[:2]
        ahead = float(offset @ along) + length / 2 + self.fingers
        behind = offset @ along < 0 and abs(offset @ across) < width / 2 and hand.place[2] < height
        if not behind or ahead <= 0 or hand.arrived > 0:
            return place
        aside = np.clip(step @ across, -self.friction * ahead, self.friction * ahead)
        return place + np.array([*(ahead * along + aside * across), 0.0])


@dataclass(frozen=True)
class LiftedBox(TaskObject):
    """An open box on the table that the hand reaches into, grasps and lifts."""

    middle: tuple[float, float]  # where it stands at first, metres
    grasp: float  # height of the hand at which it is grasped, metres
    sizes: tuple[float, float, float] = (0.22, 0.20, 0.08)  # sides and height, metres
    near: float = 0.03
    """Distance from the place where it is grasped at which the hand takes it along, metres."""

    @property
    def start(self) -> Array:
        return np.array([*self.middle, 0.0])

    def surface(self) -> tuple[Array, Indices]:
        length, width, height = self.sizes
        walls = [Box((0.0, 0.0, WALL / 2), (length, width, WALL))]
        walls += [Box((side * length / 2, 0.0, height / 2), (WALL, width, height)) for side in (-1, 1)]
        walls += [Box((0.0, side * width / 2, height / 2), (length, WALL, height)) for side in (-1, 1)]
        parts = [(wall.surface()[0] + wall.position, wall.surface()[1]) for wall in walls]
        num = len(parts[0][0])
        faces = np.concatenate([faces + k * num for k, (_, faces) in enumerate(parts)])
        return np.concatenate([vertices for vertices, _ in parts]), faces

    def placed(self, scale: float, x: float, y: float) -> LiftedBox:
        middle, sizes = (scale * self.middle[0] + x, scale * self.middle[1] + y), scaled(self.sizes, scale)
        return LiftedBox(middle, scale * self.grasp, sizes, scale * self.near)

    def moved(self, place: Array, hand: Hand) -> Array:
        step, grasped = hand.place - hand.before, place[2] > 0
        inside = np.linalg.norm(hand.place - [*place[:2], self.grasp]) < self.near
        if hand.arrived > 0 or not (grasped or (inside and step[2] > 0)):
            return place
        return np.maximum(place + step, [-np.inf, -np.inf, 0.0])
