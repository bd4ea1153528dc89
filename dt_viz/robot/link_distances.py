"""Distances of the arm's links from an obstacle, from each other and from the table, one configuration at a time.

The meshes are those of the URDF, taken as solids; coal measures distances to them, batched kinematics places them.
Own bounds stay: pinocchio's `computeDistances` takes 5 to 14 times as long, depths without groups 18 times and more.
Lengths are metres, angles radians, positions in the robot's base frame.
"""

# pyright: reportAttributeAccessIssue=false
# (coal has no stubs)

from __future__ import annotations

import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import lru_cache
from itertools import combinations, product
from os.path import commonprefix
from typing import NamedTuple

import coal
import numpy as np

from dt_viz.files.triangles import grid_nodes, inside_of_grid, surface_samples
from dt_viz.flows.fields import Array, Indices
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle, Primitive, rotation
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.urdf import LinkMesh, cells

TOLERANCE = 1e-4  # largest excess of a reported smallest distance from a ball or the table, metres
SHAPE_TOLERANCE = 1e-3
"""Largest excess of a reported smallest distance from an obstacle that is no ball, or of links, metres."""
SURFACE_SPACING = 2e-3
"""Spacing of points on a link's surface, vertices included, at which its depth in an obstacle is measured, metres."""
INNER_SPACING = 4e-3
"""Spacing of such points inside the link, where an obstacle may be deepest, metres."""
RESOLUTION = 3.5e-3
"""Largest error of a reported depth in an obstacle that is no ball, metres; 1.5 mm on a link's surface."""
CERTAIN = 3e-3
"""Depth, metres, greater than the error of an obstacle's signed distance: a deeper point surely is inside."""
GROUP_SIZE = 0.02  # size of the cells into which these points are grouped, metres


class Poses(NamedTuple):
    """Frames of the base and the n joints, for N configurations; a link of joint j is at j + 1."""

    rotations: Array  # (N, n + 1, 3, 3)
    origins: Array  # (N, n + 1, 3), metres

    @classmethod
    def of(cls, robot: Kinematics, q: Array) -> Poses:
        """Compute the poses at configurations q (N, n), rad."""
        rotations, origins = robot.forward_kinematics(q)
        base = np.broadcast_to(np.eye(3), (len(q), 1, 3, 3))
        return cls(np.concatenate([base, rotations], axis=1), np.pad(origins, [(0, 0), (1, 0), (0, 0)]))


class _Groups(NamedTuple):
    """Points in groups of neighbours."""

    points: Array  # (N, 3), metres, one group after the other
    ends: Indices  # (G,) ends of the groups in `points`
    centres: Array  # (G, 3), metres
    radii: Array  # (G,) radii of the balls around the centres that hold the groups, metres

    @classmethod
    def of(cls, points: Array, size: float) -> _Groups:
        """Group the points (N, 3) by the cells, of this size, of a grid."""
        _, member = np.unique(cells(points - points.min(axis=0), size), return_inverse=True)
        points = points[np.argsort(member, kind="stable")]
        ends = np.cumsum(np.bincount(member))
        begins = np.r_[0, ends[:-1]]
        centres = (np.minimum.reduceat(points, begins) + np.maximum.reduceat(points, begins)) / 2
        apart = np.linalg.norm(points - np.repeat(centres, ends - begins, axis=0), axis=1)
        return cls(points, ends, centres, np.maximum.reduceat(apart, begins))

    def of_group(self, group: int) -> Array:
        """Return the points (M, 3) of a group."""
        return self.points[self.ends[group - 1] if group else 0 : self.ends[group]]


def page_names(names: Sequence[str]) -> list[str]:
    """Names of links on the page: those of the URDF without what all begin with, and without the word link.

    A link that has a number alone is "link 1".
    """
    common, found = commonprefix(names).rpartition("_")[0], []  # noqa: RUF071 - of characters
    for name in names:
        words = re.sub(r"(?<![a-z])link_?|_?link$", "_", name.removeprefix(common)).split("_")
        own = " ".join(filter(None, words))
        found.append(f"link {own}".rstrip() if not own or own.isdecimal() else own)
    return found


class Link:
    """A link as a solid, in the frame of its joint.

    Attributes:
        name: name on the page.
        urdf_name: name in the URDF.
        frame: index of its frame in `Poses`.
        surface: coal's model of the mesh.
        centre: (3,) centre of the box around the mesh, metres.
        half_size: (3,) half the sides of that box, metres.
        radius: radius of the ball around that centre that holds the mesh, metres.
        corners: (8, 3) corners of that box, metres.
        hull: (H, 3) vertices of the convex hull, all of a flat link, metres.
    """

    def __init__(self, mesh: LinkMesh, name: str) -> None:
        self.name, self.urdf_name = name, mesh.name
        self.frame = mesh.joint + 1
        self._triangles = mesh.vertices[mesh.faces]  # (F, 3, 3)
        self._vertices = mesh.vertices
        self.surface = _bounding_volumes(mesh.vertices, mesh.faces)
        lower, upper = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        self.centre, self.half_size = (lower + upper) / 2, (upper - lower) / 2
        self.radius = float(np.linalg.norm(mesh.vertices - self.centre, axis=1).max())
        self.corners = np.array(list(product(*zip(lower, upper, strict=True))))
        self.hull = mesh.vertices
        if np.linalg.matrix_rank(mesh.vertices - self.centre, tol=1e-6) == 3:  # qhull crashes on what is flat
            self.surface.buildConvexHull(False, "Qt")
            self.hull = np.array(self.surface.convex.points())

    @cached_property
    def groups(self) -> _Groups:
        """Points of the solid, so dense that each place in it has one within `RESOLUTION`."""
        shape = tuple(int(n) for n in np.ceil(2 * self.half_size / INNER_SPACING) + 1)
        origin = self.centre - INNER_SPACING * (np.array(shape) - 1) / 2
        inside = inside_of_grid(self._triangles, origin, INNER_SPACING, shape)
        inner = grid_nodes(origin, INNER_SPACING, shape)[inside.ravel()]
        on_surface = surface_samples(self._triangles, SURFACE_SPACING)[0]
        return _Groups.of(np.concatenate([self._vertices, on_surface, inner]), GROUP_SIZE)

    def contains(self, point: Array) -> bool:
        """Return whether a point (3,) is inside, by the winding number, as the hand's mesh has small holes."""
        if np.any(np.abs(point - self.centre) > self.half_size):
            return False
        a, b, c = np.moveaxis(self._triangles - point, 1, 0)
        la, lb, lc = (np.sqrt(np.einsum("ij,ij->i", side, side)) for side in (a, b, c))
        # The winding number is the sum of the triangles' solid angles (van Oosterom and Strackee, 1983)
        volume = np.einsum("ij,ij->i", a, np.cross(b, c))
        ab, bc, ca = np.einsum("ij,ij->i", a, b), np.einsum("ij,ij->i", b, c), np.einsum("ij,ij->i", c, a)
        winding = np.arctan2(volume, la * lb * lc + ab * lc + bc * la + ca * lb).sum() / (2 * np.pi)
        return bool(abs(winding) > 0.5)


class Measure(ABC):
    """Distances of several items, each a link or a pair of links."""

    tolerance: float  # largest excess of a reported smallest distance, metres
    lowest: float  # distance below which no nearer place is searched for, metres
    bodies: Indices  # (I,) indices of the items' moving links
    bases: Indices  # (I,) indices of the frames that items are measured from and move relative to

    @abstractmethod
    def names(self, item: int) -> tuple[str, ...]:
        """Return the names of an item's links."""

    @abstractmethod
    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        """Compute quick lower bounds (N,) of the distances of items (N,) at the poses in rows (N,)."""

    @abstractmethod
    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        """Compute the distance of an item, exact below the ceiling; else any value between the ceiling and it."""


class _OfLinks(Measure):
    """Base of the measures whose items are links, measured from something that does not move."""

    def __init__(self, links: Sequence[Link], first_frame: int = 0) -> None:
        self.bodies = np.array([k for k, link in enumerate(links) if link.frame >= first_frame])
        self.bases = np.zeros_like(self.bodies)
        self._links = [links[k] for k in self.bodies]
        self._frames = np.array([link.frame for link in self._links])
        self._centres = np.array([link.centre for link in self._links])
        self._radii = np.array([link.radius for link in self._links])

    def names(self, item: int) -> tuple[str, ...]:
        return (self._links[item].name,)

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        frames = self._frames[items]
        turned = np.einsum("nij,nj->ni", poses.rotations[rows, frames], self._centres[items])
        return self._signed_distance(turned + poses.origins[rows, frames]) - self._radii[items]

    @abstractmethod
    def _signed_distance(self, s: Array) -> Array:
        """Compute the signed distances (*B,) of points (*B, 3) from what is measured from."""


class FromObstacle(_OfLinks):
    """Signed distances of the links from an obstacle, which is a core and all that is within some radius of it.

    The core of a ball is its centre, of a capsule a segment, of other shapes the shape itself, with radius 0. Outside,
    it is coal's exact distance between the surfaces of core and link; the surface of a mesh or a cloud is the drawn
    one. Where they intersect, the depth in the core is that of points that fill the link; the true one may be larger by
    `RESOLUTION`.

    (Coal's signed distance of a mesh from a ball is not its depth: once one triangle is inside, all other overlaps are
    skipped.)
    """

    def __init__(self, links: Sequence[Link], obstacle: Obstacle) -> None:
        super().__init__(links)
        self._obstacle, self._turn, self._position = obstacle, rotation(obstacle.wxyz), np.asarray(obstacle.position)
        self._core, self._radius = _core(obstacle)
        if self._radius > 0:
            self.tolerance, self._on_core = TOLERANCE, self._position
        else:
            self.tolerance, self._on_core = SHAPE_TOLERANCE, self._turn @ obstacle.surface()[0][0] + self._position
        self.lowest = self.tolerance - obstacle.depth

    def _signed_distance(self, s: Array) -> Array:
        return self._obstacle.signed_distance(s)

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        link = self._links[item]
        turn, origin = poses.rotations[row, link.frame], poses.origins[row, link.frame]
        deepest = self._from_core(link, turn, origin)
        if deepest < -CERTAIN:
            return deepest
        place = coal.Transform3s(turn.T @ self._turn, turn.T @ (self._position - origin))
        at_most = max(ceiling + self._radius, CERTAIN)
        gap = _coal_distance(link.surface, coal.Transform3s(), self._core, place, at_most)
        if gap > 0 and not (deepest < RESOLUTION and link.contains(turn.T @ (self._on_core - origin))):
            return gap - self._radius
        return min(deepest, 0.0) - self._radius

    def _from_core(self, link: Link, turn: Array, origin: Array) -> float:
        """Return the smallest signed distance of the link's points from the core, or `RESOLUTION` where it is more."""

        def from_core(points: Array) -> Array:
            return self._signed_distance(points @ turn.T + origin) + self._radius

        if from_core(link.centre[None])[0] - link.radius >= RESOLUTION:
            return RESOLUTION
        groups = link.groups
        distance = from_core(groups.centres)
        # others have no point that is as deep as all of some group
        (near,) = np.nonzero(distance - groups.radii < min(RESOLUTION, float((distance + groups.radii).min())))
        points = np.concatenate([groups.points[:0], *(groups.of_group(int(group)) for group in near)])
        return float(from_core(points).min(initial=RESOLUTION))


def _core(obstacle: Obstacle) -> tuple[coal.CollisionGeometry, float]:
    if isinstance(obstacle, Primitive):
        name, sizes, radius = obstacle.core
        return getattr(coal, name)(*sizes), radius
    return _drawn(obstacle.moved((0.0, 0.0, 0.0))), 0.0


@lru_cache(maxsize=16)
def _drawn(obstacle: Obstacle) -> coal.CollisionGeometry:
    return _bounding_volumes(*obstacle.surface())


def _bounding_volumes(vertices: Array, faces: Indices) -> coal.CollisionGeometry:
    model = coal.BVHModelOBBRSS()
    model.beginModel(len(faces), len(vertices))
    model.addVertices(vertices)
    model.addTriangles(faces)
    model.endModel()
    return model


class BetweenLinks(Measure):
    """Distances of those pairs of links that can come near each other; `pairs` has their names in the URDF."""

    tolerance = SHAPE_TOLERANCE
    lowest = 0.0

    def __init__(self, links: Sequence[Link], touching: frozenset[frozenset[str]]) -> None:
        # Neighbours touch by design.
        apart = [
            (a, b)
            for a, b in combinations(range(len(links)), 2)
            if links[b].frame - links[a].frame > 1 and {links[a].urdf_name, links[b].urdf_name} not in touching
        ]
        self.pairs = [frozenset((links[a].urdf_name, links[b].urdf_name)) for a, b in apart]
        self._links = links
        self._pairs = np.array(apart, dtype=np.intp).reshape(-1, 2)
        self._centres = np.array([link.centre for link in links])
        self._radii = np.array([link.radius for link in links])
        self._frames = np.array([link.frame for link in links])
        self.bodies = self._pairs[:, 1]
        self.bases = self._frames[self._pairs[:, 0]]

    def names(self, item: int) -> tuple[str, ...]:
        first, second = self._pairs[item]
        return self._links[first].name, self._links[second].name

    def lower(self, poses: Poses, rows: Indices, items: Indices) -> Array:
        pairs, rows = self._pairs[items], rows[:, None]  # (N, 2), (N, 1)
        frames = self._frames[pairs]
        turned = np.einsum("npij,npj->npi", poses.rotations[rows, frames], self._centres[pairs])
        first, second = (turned + poses.origins[rows, frames]).swapaxes(0, 1)
        return np.linalg.norm(first - second, axis=1) - self._radii[pairs].sum(axis=1)

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        first, second = (self._links[k] for k in self._pairs[item])
        place, other_place = (
            coal.Transform3s(poses.rotations[row, link.frame], poses.origins[row, link.frame])
            for link in (first, second)
        )
        return _coal_distance(first.surface, place, second.surface, other_place, ceiling)


class AboveTable(_OfLinks):
    """Heights of the links' lowest points above the table, on which the base and the first links stand."""

    tolerance = TOLERANCE
    lowest = -np.inf

    def __init__(self, links: Sequence[Link], num_fixed: int) -> None:
        super().__init__(links, first_frame=num_fixed + 1)

    def _signed_distance(self, s: Array) -> Array:
        return s[..., 2]

    def distance(self, poses: Poses, row: int, item: int, ceiling: float) -> float:
        link = self._links[item]
        heights = link.hull @ poses.rotations[row, link.frame, 2]
        return float(heights.min() + poses.origins[row, link.frame, 2])


_REQUEST = coal.DistanceRequest()
_REQUEST.enable_signed_distance = False


def _coal_distance(
    a: coal.CollisionGeometry,
    place_a: coal.Transform3s,
    b: coal.CollisionGeometry,
    place_b: coal.Transform3s,
    ceiling: float,
) -> float:
    """Return the distance of two shapes, 0 where they intersect, or the ceiling if that is smaller."""
    result = coal.DistanceResult()
    result.min_distance = ceiling  # farther pairs are skipped
    return max(0.0, coal.distance(a, place_a, b, place_b, _REQUEST, result))
