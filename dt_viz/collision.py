"""Collision truth: the arm's meshes against an obstacle, the table and itself, also between the samples of a path.

Nothing here knows of the body points that motions are planned with. The meshes are those of the URDF, taken as solids;
coal measures distances to them, batched kinematics places them. Lengths are metres, angles radians, positions in the
robot's base frame. A path is sampled configurations, continuous joints unwrapped, with straight lines in joint space
between them.
"""

# pyright: reportAttributeAccessIssue=false
# (coal has no stubs)

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple, Protocol

import coal
import numpy as np

from dt_viz.obstacles import Box, Cylinder, Obstacle, Sphere, rotation
from dt_viz.robot import NUM_JOINTS, LinkMesh, Robot, collision_meshes, load_jaco
from dt_viz.several import Several
from dt_viz.solids import grid_nodes, inside_of_grid, surface_samples

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dt_viz.fields import Array, Indices


TOLERANCE = 1e-4
"""How much more than the smallest distance on a path may be reported, metres."""
SHAPE_TOLERANCE = 1e-3
"""The same for obstacles that are no balls."""
SURFACE_SPACING = 2e-3
"""Of points on a link that its depth in an obstacle is found with, metres; vertices are among them."""
INNER_SPACING = 4e-3
"""Of points inside, which count where an obstacle is deepest inside the link."""
RESOLUTION = 3.5e-3
"""Metres by which the depth in an obstacle that is no ball may be larger than reported. On a link's surface 1.5 mm."""
CERTAIN = 3e-3
"""Depth, metres, that is more than an obstacle's signed distance is off by: what is deeper intersects it."""
GROUP_SIZE = 0.02
"""Of the cells in which these points are told deep or not at once, metres."""
BALL_SIZE = 0.06
"""Of the cells that a link is divided into for quick bounds, metres."""
AT_ONCE = 8
"""Cells whose points are measured at once."""
SELF_TOLERANCE = 1e-3
"""The same for the distance of links from each other."""
SELF_REACH = 0.05
"""Links farther apart than this are not measured, metres: the wrist never has more than 7 cm between its ends."""
SELF_MARGIN = 0.01
"""Links nearer to each other than this are reported, metres."""
KNOT_STRIDE = 4
"""Samples of a path between those that a search begins with."""


@dataclass(frozen=True)
class Nearest:
    """The smallest distance on a path.

    Attributes:
        distance: metres.
        links: names of the link, or of both links.
        at: where on the path, in samples from its start; 2.5 is halfway from the third to the fourth.
    """

    distance: float
    links: tuple[str, ...]
    at: float


NOTHING = Nearest(np.inf, (), 0.0)
"""Where there is nothing to come near to."""


@dataclass(frozen=True)
class CollisionReport:
    """What a joint path comes near to or collides with.

    Attributes:
        obstacle: smallest signed distance of the arm from an obstacle, negative inside; infinite if there is none.
        itself: smallest distance of two links that are not neighbours, 0 where they intersect; None beyond
            `SELF_REACH`.
        table: smallest signed height above the table of what does not stand on it.
    """

    obstacle: Nearest
    itself: Nearest | None
    table: Nearest

    @property
    def depth(self) -> float:
        """Maximum collision distance (sec. 5): how deep the arm enters the obstacle, metres; 0 when it is clear."""
        return max(0.0, -self.obstacle.distance)

    @property
    def problems(self) -> tuple[str, ...]:
        """What is wrong, in words for the page; empty when nothing is."""
        found = []
        if self.depth > 0:
            found.append(f"{self.obstacle.links[0]} enters the obstacle by {1e3 * self.depth:.0f} mm")
        if self.itself and self.itself.distance < SELF_MARGIN:
            inner, outer = self.itself.links
            gap = self.itself.distance
            found.append(f"{outer} comes within {1e3 * gap:.0f} mm of {inner}" if gap > 0 else f"{outer} hits {inner}")
        if self.table.distance < 0:
            found.append(f"{self.table.links[0]} is {-1e3 * self.table.distance:.0f} mm below the table")
        return tuple(found)


class Poses(NamedTuple):
    """Frames of the base and the six joints, for N configurations; a link of joint j is at j + 1."""

    rotations: Array  # (N, 7, 3, 3)
    origins: Array  # (N, 7, 3), metres

    @classmethod
    def of(cls, robot: Robot, q: Array) -> Poses:
        """Poses at configurations q (N, 6), rad."""
        rotations, origins = robot.forward_kinematics(q)
        base = np.broadcast_to(np.eye(3), (len(q), 1, 3, 3))
        return cls(np.concatenate([base, rotations], axis=1), np.pad(origins, [(0, 0), (1, 0), (0, 0)]))


class _Groups(NamedTuple):
    """Points, those near to each other in groups; or balls, when they have radii."""

    points: Array  # (N, 3), metres, one group after the other
    ends: Indices  # (G,) where each group ends
    centres: Array  # (G, 3)
    radii: Array  # (G,) metres, of the balls around the centres that hold the groups

    @classmethod
    def of(cls, points: Array, size: float, radii: Array | float = 0.0) -> _Groups:
        """Groups of the points (N, 3) in the cells, that large, of a grid."""
        cell = np.floor((points - points.min(axis=0)) / size).astype(np.intp)
        _, member = np.unique(cell, axis=0, return_inverse=True)
        order = np.argsort(member.ravel(), kind="stable")
        points, radii = points[order], np.broadcast_to(radii, len(points))[order]
        ends = np.cumsum(np.bincount(member.ravel()))
        begins = np.r_[0, ends[:-1]]
        centres = (np.minimum.reduceat(points, begins) + np.maximum.reduceat(points, begins)) / 2
        apart = np.linalg.norm(points - np.repeat(centres, ends - begins, axis=0), axis=1) + radii
        return cls(points, ends, centres, np.maximum.reduceat(apart, begins))

    def of_group(self, group: int) -> Array:
        """(M, 3) the points of a group."""
        return self.points[self.ends[group - 1] if group else 0 : self.ends[group]]


class Link:
    """A link as a solid, in the frame of its joint.

    Attributes:
        name: as the page calls it.
        frame: index of its frame in `Poses`.
        surface: the mesh, as coal measures it.
        centre: (3,) of the box around the mesh, metres.
        half_size: (3,) of that box.
        radius: of the ball around that centre that holds the mesh.
        corners: (8, 3) of that box.
        hull: (H, 3) vertices of the convex hull.
    """

    def __init__(self, mesh: LinkMesh) -> None:
        self.name = mesh.name.split("_link_")[-1].replace("_", " ")
        if self.name.isdecimal():
            self.name = f"link {self.name}"
        self.frame = mesh.joint + 1
        self._triangles = mesh.vertices[mesh.faces]  # (F, 3, 3)
        self._vertices = mesh.vertices
        self.surface = _bounding_volumes(mesh.vertices, mesh.faces)
        lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.centre, self.half_size = (lower + upper) / 2, (upper - lower) / 2
        self.radius = float(np.linalg.norm(mesh.vertices - self.centre, axis=1).max())
        signs = np.array(np.meshgrid(*3 * [[-1.0, 1.0]])).reshape(3, -1).T
        self.corners = self.centre + signs * self.half_size
        self.surface.buildConvexHull(False, "Qt")
        self.hull = np.array(self.surface.convex.points())

    @cached_property
    def groups(self) -> _Groups:
        """Points of the solid, so dense that none of it is farther than `RESOLUTION` from one."""
        surface, _ = surface_samples(self._triangles, SURFACE_SPACING)
        shape = tuple(int(n) for n in np.ceil(2 * self.half_size / INNER_SPACING) + 1)
        origin = self.centre - INNER_SPACING * (np.array(shape) - 1) / 2
        inside = inside_of_grid(self._triangles, origin, INNER_SPACING, shape)
        inner = grid_nodes(origin, INNER_SPACING, shape)[inside.ravel()]
        return _Groups.of(np.concatenate([self._vertices, surface, inner]), GROUP_SIZE)

    @cached_property
    def balls(self) -> _Groups:
        """A few balls that hold the mesh."""
        return _Groups.of(self.groups.centres, BALL_SIZE, self.groups.radii)

    def contains(self, point: Array) -> bool:
        """Whether a point (3,) off the surface is inside, by the winding number: the hand's mesh has small holes."""
        if np.any(np.abs(point - self.centre) > self.half_size):
            return False
        a, b, c = np.moveaxis(self._triangles - point, 1, 0)
        la, lb, lc = (np.sqrt(np.einsum("ij,ij->i", side, side)) for side in (a, b, c))
        # Solid angles of the triangles (van Oosterom and Strackee, 1983).
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        ab, bc, ca = np.einsum("ij,ij->i", a, b), np.einsum("ij,ij->i", b, c), np.einsum("ij,ij->i", c, a)
        winding = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi)
        return bool(abs(winding) > 0.5)


class _Rounded(NamedTuple):
    """An obstacle as all points within `radius` of a core.

    Where the arm touches the core it counts as `radius` deep, so depth is exact for a core without volume.
    """

    core: coal.CollisionGeometry
    rotation: Array  # (3, 3)
    position: Array  # (3,), metres
    extent: float  # of the core from its position, metres
    radius: float  # metres


def _rounded(obstacle: Sphere) -> _Rounded:
    """The obstacle as coal knows it.

    Coal's signed distance of a mesh from a ball is not its depth: once one triangle is inside, whatever else overlaps
    is skipped. The distance from the ball's centre is positive, and so exact.
    """
    return _Rounded(coal.Sphere(0.0), np.eye(3), np.asarray(obstacle.position), 0.0, obstacle.radius)


class _Measure(Protocol):
    """Distances of several items (a link, or a pair of links), as a search needs them."""

    lowest: float
    """No distance is smaller."""

    @property
    def bodies(self) -> Indices:
        """(I,) the link of each item."""
        ...

    @property
    def bases(self) -> Indices:
        """(I,) the frame that its motion counts against: what it is measured from moves with that frame."""
        ...

    def names(self, item: int) -> tuple[str, ...]:
        """Of the links of an item."""
        ...

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        """Quick lower bounds (N,) of the distances of items (N,) at the poses in rows (N,)."""
        ...

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        """The distance of one item, exact if it is below the ceiling; else any value from the ceiling to it."""
        ...


class _FromBall:
    """Signed distances of the links from a ball."""

    def __init__(self, links: Sequence[Link], obstacle: Sphere) -> None:
        self._links, self._obstacle = links, _rounded(obstacle)
        self._frames = np.array([link.frame for link in links])
        self._centres = np.array([link.centre for link in links])
        self._half_sizes = np.array([link.half_size for link in links])
        self.bodies = np.arange(len(links))
        self.bases = np.zeros(len(links), dtype=np.intp)
        self.lowest = -self._obstacle.radius
        self._known: dict[int, list[tuple[Array, float, bool]]] = {}

    def names(self, item: int) -> tuple[str, ...]:
        return (self._links[item].name,)

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        frames = self._frames[items]
        offset = self._obstacle.position - poses.origins[rows, frames]
        local = np.einsum("nji,nj->ni", poses.rotations[rows, frames], offset) - self._centres[items]
        outside = np.maximum(np.abs(local) - self._half_sizes[items], 0.0)
        return np.maximum(np.linalg.norm(outside, axis=1) - self._obstacle.extent, 0.0) - self._obstacle.radius

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        link, (core, rotation, position, _, radius) = self._links[item], self._obstacle
        turn = poses.rotations[row, link.frame].T
        centre = turn @ (position - poses.origins[row, link.frame])
        place = coal.Transform3s(turn @ rotation, centre)
        gap = _coal_distance(link.surface, coal.Transform3s(), core, place, ceiling + radius)
        return (0.0 if gap > 0 and self._inside(item, centre, gap) else gap) - radius

    def _inside(self, item: int, point: Array, gap: float) -> bool:
        """Whether a point is inside the link, its surface at least `gap` away."""
        known = self._known.setdefault(item, [])
        for other, free, inside in known:
            if np.linalg.norm(point - other) < free:  # no surface in between
                return inside
        inside = self._links[item].contains(point)  # slow, so remembered
        known.append((point, gap, inside))
        return inside


class _FromShape:
    """Signed distances of the links from an obstacle of any shape.

    Outside, coal's distance of its surface (a mesh's, a cloud's as it is drawn) from the links', which is exact. Where
    they intersect, the smallest signed distance, as the obstacle knows it, of points that fill the link: the depth may
    be larger by up to `RESOLUTION`.
    """

    def __init__(self, links: Sequence[Link], obstacle: Obstacle) -> None:
        self._links, self._obstacle = links, obstacle
        self._core = _coal_shape(obstacle)
        self._turn, self._position = rotation(obstacle.wxyz), np.asarray(obstacle.position)
        self._on_surface = self._turn @ obstacle.surface()[0][0] + self._position
        self._frames = np.array([link.frame for link in links])
        # the balls of all links, as many for each
        most = max(len(link.balls.radii) for link in links)
        fill = [np.minimum(np.arange(most), len(link.balls.radii) - 1) for link in links]
        self._centres = np.stack([link.balls.centres[k] for link, k in zip(links, fill, strict=True)])
        self._radii = np.stack([link.balls.radii[k] for link, k in zip(links, fill, strict=True)])
        self.bodies = np.arange(len(links))
        self.bases = np.zeros(len(links), dtype=np.intp)
        self.lowest = SHAPE_TOLERANCE - obstacle.depth

    def names(self, item: int) -> tuple[str, ...]:
        return (self._links[item].name,)

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        frames = self._frames[items]
        turned = np.einsum("nij,nkj->nki", poses.rotations[rows, frames], self._centres[items])
        centres = turned + poses.origins[rows, frames][:, None]
        return (self._obstacle.signed_distance(centres) - self._radii[items]).min(axis=1)

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        link = self._links[item]
        turn, origin = poses.rotations[row, link.frame], poses.origins[row, link.frame]
        deepest = self._deepest(link, turn, origin)
        if deepest < -CERTAIN:
            return deepest
        place = coal.Transform3s(turn.T @ self._turn, turn.T @ (self._position - origin))
        gap = _coal_distance(link.surface, coal.Transform3s(), self._core, place, max(ceiling, CERTAIN))
        if gap > 0 and not (deepest < 0 and link.contains(turn.T @ (self._on_surface - origin))):
            return gap
        return min(deepest, 0.0)

    def _deepest(self, link: Link, turn: Array, origin: Array) -> float:
        """The smallest signed distance of the link's points, if it is negative; else 0."""
        groups, deepest = link.groups, 0.0
        lower = self._obstacle.signed_distance(groups.centres @ turn.T + origin) - groups.radii
        order = np.argsort(lower)
        order = order[lower[order] < 0]
        for first in range(0, len(order), AT_ONCE):
            some = [group for group in order[first : first + AT_ONCE] if lower[group] < deepest]
            if not some:
                break
            points = np.concatenate([groups.of_group(group) for group in some])
            deepest = min(deepest, float(self._obstacle.signed_distance(points @ turn.T + origin).min()))
        return deepest


def _coal_shape(obstacle: Obstacle) -> coal.CollisionGeometry:
    """The obstacle's surface in its own frame."""
    if isinstance(obstacle, Box):
        return coal.Box(*obstacle.sizes)
    if isinstance(obstacle, Cylinder):
        return coal.Cylinder(obstacle.diameter / 2, obstacle.height)
    return _drawn(obstacle.moved((0.0, 0.0, 0.0)))


@lru_cache(maxsize=16)
def _drawn(obstacle: Obstacle) -> coal.CollisionGeometry:
    return _bounding_volumes(*obstacle.surface())


def _bounding_volumes(vertices: Array, faces: Indices) -> coal.CollisionGeometry:
    """Triangles as coal measures them."""
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(vertices)
    model.addTriangles(faces)
    model.endModel()
    return model


def _measure_from(links: Sequence[Link], obstacle: Obstacle) -> _Measure:
    return _FromBall(links, obstacle) if isinstance(obstacle, Sphere) else _FromShape(links, obstacle)


class _BetweenLinks:
    """Distances of pairs of links."""

    lowest = 0.0

    def __init__(self, links: Sequence[Link]) -> None:
        # Neighbours touch by design. No other pair does: each is apart in 96 % or more of random postures.
        apart = [(a, b) for a, b in combinations(range(len(links)), 2) if links[b].frame - links[a].frame > 1]
        self._links = links
        self._pairs = np.array(apart)
        self._centres = np.array([link.centre for link in links])
        self._radii = np.array([link.radius for link in links])
        self._frames = np.array([link.frame for link in links])
        self.bodies = self._pairs[:, 1]
        self.bases = self._frames[self._pairs[:, 0]]

    def names(self, item: int) -> tuple[str, ...]:
        first, second = self._pairs[item]
        return self._links[first].name, self._links[second].name

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        a, b = self._pairs[items].T
        apart = np.linalg.norm(self._centre(poses, rows, a) - self._centre(poses, rows, b), axis=1)
        return apart - self._radii[a] - self._radii[b]

    def _centre(self, poses: Poses, rows: Indices, links: Indices) -> Array:
        frames = self._frames[links]
        turned = np.einsum("nij,nj->ni", poses.rotations[rows, frames], self._centres[links])
        return turned + poses.origins[rows, frames]

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        first, second = (self._links[k] for k in self._pairs[item])
        place, other_place = (
            coal.Transform3s(poses.rotations[row, link.frame], poses.origins[row, link.frame])
            for link in (first, second)
        )
        return _coal_distance(first.surface, place, second.surface, other_place, ceiling)


class _AboveTable:
    """Heights of links above the table."""

    lowest = -np.inf

    def __init__(self, links: Sequence[Link]) -> None:
        self._links = [link for link in links if link.frame > 1]  # the base and link 1 stand on it
        self.bodies = np.array([k for k, link in enumerate(links) if link.frame > 1])
        self.bases = np.zeros(len(self.bodies), dtype=np.intp)
        self._frames = np.array([link.frame for link in self._links])
        self._centres = np.array([link.centre for link in self._links])
        self._half_sizes = np.array([link.half_size for link in self._links])

    def names(self, item: int) -> tuple[str, ...]:
        return (self._links[item].name,)

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        up = poses.rotations[rows, self._frames[items], 2]  # (N, 3)
        sag = (up * self._centres[items] - np.abs(up) * self._half_sizes[items]).sum(axis=1)
        return poses.origins[rows, self._frames[items], 2] + sag

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        link = self._links[item]
        heights = link.hull @ poses.rotations[row, link.frame, 2]
        return float(heights.min() + poses.origins[row, link.frame, 2])


class _Pieces(NamedTuple):
    """Pieces of a path, each for one item; lower bounds of its distance at both ends."""

    start: Array  # (P,) samples from the path's start
    end: Array
    item: Indices  # (P,)
    at_start: Array  # (P,) metres
    at_end: Array
    travel: Array  # (P,) bound on how far the item's points move, metres

    def take(self, which: NDArray[np.bool_]) -> _Pieces:
        """Some of them."""
        start, end, item, at_start, at_end, travel = self
        return _Pieces(start[which], end[which], item[which], at_start[which], at_end[which], travel[which])

    def lower(self) -> Array:
        """(P,) bounds from below on the distances anywhere on the pieces."""
        return (self.at_start + self.at_end - self.travel) / 2


class _Search:
    """Looks for the smallest distance on a path, of all items of a measure.

    As `metrics.maximum_collision_distance`: a distance changes no faster than the link moves, so on a piece of the path
    that moves the link by L it is at least (d₀ + d₁ − L)/2. Pieces that could hold less than the best are halved.
    """

    def __init__(self, robot: Robot, measure: _Measure, q: Array, travel: Array, ceiling: float) -> None:
        """Takes the path q (T, 6), bounds travel (T − 1, I) between its samples, and what the result must be below."""
        self._robot, self._measure = robot, measure
        self._last = len(q) - 1
        self._q = q if self._last else np.repeat(q, 2, axis=0)  # a path of one sample becomes one that stays there
        travel = travel if len(travel) else np.zeros((1, travel.shape[1]))
        self._travelled = np.vstack([np.zeros(travel.shape[1]), np.cumsum(travel, axis=0)])  # (T, I) from the start
        self._best, self._place, self._item = ceiling, 0.0, -1

    def run(self, tolerance: float) -> Nearest | None:
        """The smallest distance, too large by the tolerance at most; None where none is below the ceiling."""
        pieces = self._first_pieces()
        while self._best > self._measure.lowest:
            pieces = pieces.take(pieces.lower() < self._best - tolerance)
            if not len(pieces.item):
                break
            pieces = self._halved(pieces)
        if self._item < 0:
            return None
        return Nearest(self._best, self._measure.names(self._item), min(self._place, float(self._last)))

    def _first_pieces(self) -> _Pieces:
        last, num_items = len(self._q) - 1, self._travelled.shape[1]
        knots = np.append(np.arange(0, last, KNOT_STRIDE), last)
        travel = np.diff(self._travelled[knots], axis=0)  # (K − 1, I)
        padded = np.pad(travel, [(1, 1), (0, 0)])
        places, items = np.repeat(knots.astype(float), num_items), np.tile(np.arange(num_items), len(knots))
        values = self._measured(places, items, np.maximum(padded[:-1], padded[1:]).ravel())
        return _Pieces(
            places[:-num_items],
            places[num_items:],
            items[num_items:],
            values[:-num_items],
            values[num_items:],
            travel.ravel(),
        )

    def _halved(self, pieces: _Pieces) -> _Pieces:
        start, end, item, at_start, at_end, _ = pieces
        middle = (start + end) / 2
        first = self._travel_to(middle, item) - self._travel_to(start, item)
        second = self._travel_to(end, item) - self._travel_to(middle, item)
        at_middle = self._measured(middle, item, np.maximum(first, second))
        return _Pieces(
            np.concatenate([start, middle]),
            np.concatenate([middle, end]),
            np.tile(item, 2),
            np.concatenate([at_start, at_middle]),
            np.concatenate([at_middle, at_end]),
            np.concatenate([first, second]),
        )

    def _travel_to(self, places: Array, items: Indices) -> Array:
        """How far (N,) the items (N,) have moved at places (N,)."""
        before = np.minimum(places.astype(np.intp), len(self._q) - 2)
        fraction = places - before
        return (1 - fraction) * self._travelled[before, items] + fraction * self._travelled[before + 1, items]

    def _measured(self, places: Array, items: Indices, travel: Array) -> Array:
        """Lower bounds (N,) of the distances of items (N,) at places (N,); exact where such travel needs it."""
        distinct, rows = np.unique(places, return_inverse=True)
        before = np.minimum(distinct.astype(np.intp), len(self._q) - 2)
        fraction = (distinct - before)[:, None]
        poses = Poses.of(self._robot, (1 - fraction) * self._q[before] + fraction * self._q[before + 1])
        values = self._measure.lower(poses, rows, items)
        slack = travel / 2  # from there up, the bound of the piece exceeds the best
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
        robot: whose kinematics places them.
        links: from the base to the finger tips.
    """

    def __init__(self, robot: Robot, meshes: Sequence[LinkMesh]) -> None:
        self.robot = robot
        self.links = tuple(Link(mesh) for mesh in meshes)

    @cached_property
    def reach(self) -> Array:
        """(11, 6) bounds on the distance of each link's points from each joint's axis, in any posture, metres.

        0 for the joints that do not move the link; elsewhere never less than for the joints that come later.
        """
        steps = np.linalg.norm(self.robot.joint_translations, axis=1)
        sideways = np.linalg.norm(self.robot.joint_translations[:, :2], axis=1)
        bounds = np.zeros((len(self.links), NUM_JOINTS))
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
        """Signed distance of the whole arm from the obstacle, and the nearest link.

        The smallest signed distance from the obstacle of any point of the arm, so minus the depth where it enters.

        Args:
            q: (T, 6) configurations, rad.
            obstacle: in the base frame.

        Returns:
            Distances (T,), metres, negative inside; indices (T,) into `links`.
        """
        q = np.asarray(q, dtype=float)
        measure, poses = _measure_from(self.links, obstacle), Poses.of(self.robot, q)
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

    def nearest_to_obstacle(self, q: ArrayLike, obstacle: Several | Obstacle) -> Nearest:
        """The smallest signed distance of the arm from the obstacle on a path q (T, 6), rad.

        To `TOLERANCE` for a ball; to `SHAPE_TOLERANCE` and, inside, `RESOLUTION` for other shapes.
        """
        nearest = NOTHING
        for part in obstacle.parts if isinstance(obstacle, Several) else (obstacle,):
            tolerance = TOLERANCE if isinstance(part, Sphere) else SHAPE_TOLERANCE
            found = self._search(_measure_from(self.links, part), q, tolerance)
            assert found is not None  # without a ceiling there always is one
            nearest = min(nearest, found, key=lambda near: near.distance)
        return nearest

    def nearest_to_itself(self, q: ArrayLike) -> Nearest | None:
        """The smallest distance of two links on a path q (T, 6), rad, to `SELF_TOLERANCE`; None beyond `SELF_REACH`.

        Links that a joint connects are left out.
        """
        return self._search(_BetweenLinks(self.links), q, SELF_TOLERANCE, SELF_REACH)

    def nearest_to_table(self, q: ArrayLike) -> Nearest:
        """The smallest height above the table z = 0 on a path q (T, 6), rad, to `TOLERANCE`.

        Of all links but the base and link 1, which stand on it.
        """
        found = self._search(_AboveTable(self.links), q, TOLERANCE)
        assert found is not None
        return found

    def report(self, q: ArrayLike, obstacle: Several | Obstacle) -> CollisionReport:
        """All of it for one path q (T, 6), rad."""
        return CollisionReport(
            self.nearest_to_obstacle(q, obstacle), self.nearest_to_itself(q), self.nearest_to_table(q)
        )

    def _search(self, measure: _Measure, q: ArrayLike, tolerance: float, ceiling: float = np.inf) -> Nearest | None:
        q = np.asarray(q, dtype=float)
        return _Search(self.robot, measure, q, self._travel(measure, q), ceiling).run(tolerance)

    def _travel(self, measure: _Measure, q: Array) -> Array:
        """Bounds (T − 1, I) on how far points of the items' links move from sample to sample of q (T, 6)."""
        poses, turns = Poses.of(self.robot, q), np.abs(np.diff(q, axis=0))
        bounds = np.empty((len(turns), len(measure.bodies)))
        for k, (body, base) in enumerate(zip(measure.bodies, measure.bases, strict=True)):
            link = self.links[body]
            turning = turns[:, base : link.frame]  # by the joints between the two frames
            at_most = turning @ self.reach[body, base : link.frame]
            # Nearly straight: the speed differs from its mean by at most half the largest acceleration, and how far
            # a rigid body's points are displaced is convex in the point, so largest in a corner of the box.
            inverse = poses.rotations[:, base].transpose(0, 2, 1)
            rotation = inverse @ poses.rotations[:, link.frame]
            origin = np.einsum("tij,tj->ti", inverse, poses.origins[:, link.frame] - poses.origins[:, base])
            corners = link.corners @ rotation.transpose(0, 2, 1) + origin[:, None]
            displaced = np.linalg.norm(np.diff(corners, axis=0), axis=-1).max(axis=1)
            bounds[:, k] = np.minimum(at_most, displaced + at_most * turning.sum(axis=1) / 2)
        return bounds


_REQUEST = coal.DistanceRequest()
_REQUEST.enable_signed_distance = False


def _coal_distance(
    a: coal.CollisionGeometry,
    place_a: coal.Transform3s,
    b: coal.CollisionGeometry,
    place_b: coal.Transform3s,
    ceiling: float,
) -> float:
    """Distance of two shapes, 0 where they intersect, or the ceiling, whatever is smaller."""
    result = coal.DistanceResult()
    result.min_distance = ceiling  # what is farther is skipped
    return max(0.0, coal.distance(a, place_a, b, place_b, _REQUEST, result))


@lru_cache(maxsize=1)
def load_collision_model() -> CollisionModel:
    """The JACO's links, read once."""
    return CollisionModel(load_jaco(), collision_meshes())
