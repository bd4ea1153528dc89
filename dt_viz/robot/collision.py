"""Collision checks of the arm's meshes with an obstacle, the table and itself, also between the samples of a path.

The checks are independent of the body points that motions are planned with. Lengths are metres, angles radians,
positions in the robot's base frame. A path is a sequence of configurations, continuous joints unwrapped, joined by
straight lines in joint space.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dt_viz.flows.fields import Array, Indices
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import AboveTable, BetweenLinks, FromObstacle, Link, Measure, Poses, page_names
from dt_viz.robot.urdf import LinkMesh
from dt_viz.scheduler import checkpoint
from dt_viz.warning import ARM, Kind, MotionWarning

SELF_REACH = 0.05
"""Distance of links beyond which it is not measured, metres: between the ends of the JACO's wrist are at most 7 cm."""
SELF_MARGIN = 0.01  # distance of links below which a problem is reported, metres
KNOT_STRIDE = 4  # stride in samples of the coarse path that a search begins with


@dataclass(frozen=True)
class Nearest:
    """The smallest distance on a path."""

    distance: float  # metres
    links: tuple[str, ...]  # names of the link, or of both links
    at: float  # place on the path, samples from its start; 2.5 is halfway from the third to the fourth


NOTHING = Nearest(np.inf, (), 0.0)  # the result without any obstacle


@dataclass(frozen=True)
class CollisionReport:
    """Smallest distances on a joint path."""

    obstacle: Nearest
    """Smallest signed distance of the arm from the obstacles, negative inside; infinite without any."""
    itself: Nearest | None
    """Smallest distance of two links that are not neighbours, 0 where they intersect; None beyond `SELF_REACH`."""
    table: Nearest  # smallest signed height of the links that do not stand on the table

    @property
    def depth(self) -> float:
        """Maximum collision distance (sec. 5): greatest depth of the arm in an obstacle, metres; 0 if there is none."""
        return max(0.0, -self.obstacle.distance)

    @property
    def warnings(self) -> tuple[MotionWarning, ...]:
        """Warnings about collisions and small distances."""
        found = []
        if self.depth > 0:
            text = f"{self.obstacle.links[0]} enters the obstacle by {1e3 * self.depth:.0f} mm"
            found.append(MotionWarning(Kind.ARM_ENTERS, text, ARM))
        if self.itself and self.itself.distance < SELF_MARGIN:
            inner, outer = self.itself.links
            gap = self.itself.distance
            text = f"{outer} comes within {1e3 * gap:.0f} mm of {inner}" if gap > 0 else f"{outer} hits {inner}"
            found.append(MotionWarning(Kind.ARM_HITS_ITSELF, text, ARM))
        if self.table.distance < 0:
            text = f"{self.table.links[0]} is {-1e3 * self.table.distance:.0f} mm below the table"
            found.append(MotionWarning(Kind.ARM_BELOW_TABLE, text, ARM))
        return tuple(found)


class _MotionPieces(NamedTuple):
    """Pieces of a path, each for one item, with lower bounds of its distance at both ends."""

    start: Array  # (P,) samples from the path's start
    end: Array
    item: Indices  # (P,)
    at_start: Array  # (P,) metres
    at_end: Array
    travel: Array  # (P,) upper bound of the distance that the item's points move, metres

    def take(self, which: NDArray[np.bool_]) -> _MotionPieces:
        """Select some of them."""
        return _MotionPieces._make(field[which] for field in self)

    def lower(self) -> Array:
        """Compute lower bounds (P,) of the distances anywhere on the pieces."""
        return (self.at_start + self.at_end - self.travel) / 2


class _Search:
    """Search for the smallest distance on a path, over all items of a measure.

    As `metrics.maximum_collision_distance`: a distance changes no faster than the link moves, so on a piece of the path
    that moves the link by L it is at least (d₀ + d₁ − L)/2. Pieces that could hold less than the best are halved.
    """

    def __init__(self, robot: Kinematics, measure: Measure, q: Array, travel: Array, ceiling: float) -> None:
        """Take the path q (T, n), bounds travel (T − 1, I) between its samples, and an upper bound of the result."""
        self._robot, self._measure = robot, measure
        self._last = len(q) - 1
        self._q = q if self._last else np.repeat(q, 2, axis=0)  # a path of one sample becomes one that stays there
        travel = travel if len(travel) else np.zeros((1, travel.shape[1]))
        self._travelled = np.vstack([np.zeros(travel.shape[1]), np.cumsum(travel, axis=0)])  # (T, I) from the start
        self._best, self._place, self._item = ceiling, 0.0, -1

    def run(self) -> Nearest | None:
        """Return the smallest distance, up to the measure's tolerance; None if none is below the ceiling."""
        checkpoint()
        pieces = self._first_pieces()
        while self._best > self._measure.lowest:
            pieces = pieces.take(pieces.lower() < self._best - self._measure.tolerance)
            if not len(pieces.item):
                break
            pieces = self._halved(pieces)
        if self._item < 0:
            return None
        return Nearest(self._best, self._measure.names(self._item), min(self._place, float(self._last)))

    def _first_pieces(self) -> _MotionPieces:
        last, num_items = len(self._q) - 1, self._travelled.shape[1]
        knots = np.append(np.arange(0, last, KNOT_STRIDE), last)
        travel = np.diff(self._travelled[knots], axis=0)  # (K − 1, I)
        padded = np.pad(travel, [(1, 1), (0, 0)])
        places, items = np.repeat(knots.astype(float), num_items), np.tile(np.arange(num_items), len(knots))
        values = self._measured(places, items, np.maximum(padded[:-1], padded[1:]).ravel())
        n = num_items
        return _MotionPieces(places[:-n], places[n:], items[n:], values[:-n], values[n:], travel.ravel())

    def _halved(self, pieces: _MotionPieces) -> _MotionPieces:
        start, end, item, at_start, at_end, _ = pieces
        middle = (start + end) / 2
        first = self._travel_to(middle, item) - self._travel_to(start, item)
        second = self._travel_to(end, item) - self._travel_to(middle, item)
        at_middle = self._measured(middle, item, np.maximum(first, second))
        halves = (start, middle, item, at_start, at_middle, first), (middle, end, item, at_middle, at_end, second)
        return _MotionPieces._make(map(np.concatenate, zip(*halves, strict=True)))

    def _travel_to(self, places: Array, items: Indices) -> Array:
        """Return the distances (N,) that the items (N,) have moved up to places (N,)."""
        before = np.minimum(places.astype(np.intp), len(self._q) - 2)
        fraction = places - before
        return (1 - fraction) * self._travelled[before, items] + fraction * self._travelled[before + 1, items]

    def _measured(self, places: Array, items: Indices, travel: Array) -> Array:
        """Compute lower bounds (N,) of the distances of items (N,) at places (N,), exact where `travel` demands it."""
        distinct, rows = np.unique(places, return_inverse=True)
        before = np.minimum(distinct.astype(np.intp), len(self._q) - 2)
        fraction = (distinct - before)[:, None]
        poses = Poses.of(self._robot, (1 - fraction) * self._q[before] + fraction * self._q[before + 1])
        values = self._measure.lower(poses, rows, items)
        slack = travel / 2  # above the best plus this, the piece's bound exceeds the best
        for k in np.argsort(values - slack):
            if values[k] >= self._best + slack[k]:
                break
            values[k] = self._measure.distance(poses, int(rows[k]), int(items[k]), float(self._best + slack[k]))
            if values[k] < self._best:
                self._best, self._place, self._item = float(values[k]), float(places[k]), int(items[k])
        return values


class CollisionModel:
    """The arm's links as solids.

    Attributes:
        robot: kinematics that places them.
        links: from the base to the finger tips.
        num_fixed: number of first joints whose links stand on the table.
        touching: pairs of links that may touch besides neighbours, by their names in the URDF.
    """

    def __init__(
        self,
        robot: Kinematics,
        meshes: Sequence[LinkMesh],
        num_fixed: int,
        touching: frozenset[frozenset[str]] = frozenset(),
    ) -> None:
        self.robot, self.num_fixed, self.touching = robot, num_fixed, touching
        self.links = tuple(map(Link, meshes, page_names([mesh.name for mesh in meshes])))

    @cached_property
    def reach(self) -> Array:
        """Upper bounds (L, n) of the distance of each link's points from each joint's axis in any posture, metres.

        They are 0 for joints that do not move the link, and do not increase from one moving joint to the next.
        """
        steps = np.linalg.norm(self.robot.joint_translations, axis=1)
        sideways = np.linalg.norm(self.robot.joint_translations[:, :2], axis=1)
        bounds = np.zeros((len(self.links), self.robot.num_joints))
        for link, bound in zip(self.links, bounds, strict=True):
            joint = link.frame - 1
            if joint < 0:
                continue
            bound[joint] = np.linalg.norm(link.hull[:, :2], axis=1).max()
            beyond = np.linalg.norm(link.hull, axis=1).max()  # the joint after: from its origin
            for i in range(joint - 1, -1, -1):
                bound[i] = max(bound[i + 1], sideways[i + 1] + beyond)
                beyond += steps[i + 1]
        return bounds

    def obstacle_distance(self, q: ArrayLike, obstacle: Obstacle) -> tuple[Array, Indices]:
        """Compute the smallest signed distance of any point of the arm from the obstacle, and the nearest link.

        For configurations q (T, n), rad, these are distances (T,), metres, negative inside, and indices (T,) into
        `links`.
        """
        q = np.asarray(q, dtype=float)
        measure, poses = FromObstacle(self.links, obstacle), Poses.of(self.robot, q)
        rows, items = (index.ravel() for index in np.indices((len(q), len(self.links))))
        lower = measure.lower(poses, rows, items).reshape(len(q), -1)
        distances, nearest = np.full(len(q), np.inf), np.zeros(len(q), dtype=np.intp)
        for row, order in enumerate(np.argsort(lower, axis=1)):
            for item in order:
                if lower[row, item] >= distances[row]:
                    break
                distance = measure.distance(poses, row, int(item), float(distances[row]))
                if distance < distances[row]:
                    distances[row], nearest[row] = distance, item
        return distances, nearest

    def nearest_to_obstacle(self, q: ArrayLike, obstacle: Union | Obstacle, below: float = np.inf) -> Nearest:
        """Find the smallest signed distance of the arm from the obstacle on a path q (T, n), rad.

        It is accurate to `link_distances.TOLERANCE` for a ball, for other shapes to `SHAPE_TOLERANCE`, inside to
        `RESOLUTION`. Only what is `below` a distance is searched for; `NOTHING` where nothing is, which is quick.
        """
        nearest = NOTHING
        for part in obstacle.parts if isinstance(obstacle, Union) else (obstacle,):
            nearest = self._search(FromObstacle(self.links, part), q, min(below, nearest.distance)) or nearest
        return nearest

    def nearest_to_itself(self, q: ArrayLike) -> Nearest | None:
        """Find the smallest distance of two links on a path q (T, n), rad; None beyond `SELF_REACH`.

        It is accurate to `link_distances.SHAPE_TOLERANCE`. Links that a joint connects or that may touch are left out.
        """
        measure = BetweenLinks(self.links, self.touching)
        return self._search(measure, q, SELF_REACH) if len(measure.bodies) else None

    def nearest_to_table(self, q: ArrayLike) -> Nearest:
        """Find the smallest height above the table z = 0 on a path q (T, n), rad, to `link_distances.TOLERANCE`.

        The base and other links that stand on it are left out.
        """
        found = self._search(AboveTable(self.links, self.num_fixed), q)
        assert found is not None
        return found

    def report(self, q: ArrayLike, obstacle: Union | Obstacle) -> CollisionReport:
        """Compute all distances on one path q (T, n), rad."""
        return CollisionReport(
            self.nearest_to_obstacle(q, obstacle), self.nearest_to_itself(q), self.nearest_to_table(q)
        )

    def _search(self, measure: Measure, q: ArrayLike, ceiling: float = np.inf) -> Nearest | None:
        q = np.asarray(q, dtype=float)
        return _Search(self.robot, measure, q, self._travel(measure, q), ceiling).run()

    def _travel(self, measure: Measure, q: Array) -> Array:
        """Bound the distances (T − 1, I) that the items' points move from sample to sample of q (T, n)."""
        poses, turns = Poses.of(self.robot, q), np.abs(np.diff(q, axis=0))
        bounds = np.empty((len(turns), len(measure.bodies)))
        for k, (body, base) in enumerate(zip(measure.bodies, measure.bases, strict=True)):
            link = self.links[body]
            turning = turns[:, base : link.frame]  # by the joints between the two frames
            at_most = turning @ self.reach[body, base : link.frame]
            # The path is nearly straight: its speed differs from the mean by at most half the largest acceleration, and
            # the displacement of a rigid body is convex in the point, so largest in a corner of the box.
            inverse = poses.rotations[:, base].transpose(0, 2, 1)
            rotation = inverse @ poses.rotations[:, link.frame]
            origin = np.einsum("tij,tj->ti", inverse, poses.origins[:, link.frame] - poses.origins[:, base])
            corners = link.corners @ rotation.transpose(0, 2, 1) + origin[:, None]
            displaced = np.linalg.norm(np.diff(corners, axis=0), axis=-1).max(axis=1)
            bounds[:, k] = np.minimum(at_most, displaced + at_most * turning.sum(axis=1) / 2)
        return bounds
