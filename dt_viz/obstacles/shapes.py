"""Obstacles: their true shape, and the field learned from samples of it that motions are led around with (sec. 4.4)."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any, Protocol, TypeVar

import numpy as np

from dt_viz.flows.fields import Array, Indices, Mask, PlacedField
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.occupancy import (
    AvoidanceField,
    Generator,
    OccupancyMap,
    StretchedField,
    fit_occupancy,
    sample_labels,
)
from dt_viz.obstacles.solids import Solid
from dt_viz.properties import cached_property

Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
NUM_SAMPLES = 4000
KERNEL_WIDTH = 0.9
"""Of the occupancy map, in radii of the obstacle; in half sizes where it has three of them."""
REGULARISATION = 10.0
SOLID_REGULARISATION = 1.0
"""The same for shapes that may be hollow: their map must rise more steeply for the flow to be as quick."""
FLATTEST = 0.3
"""Smallest half size, relative to the largest, that the kernel adapts to: a field around something flatter is as thick
as around this, or it would turn motions sharply."""
MAX_BALLS = 12
"""Of a cover."""
NUM_BALLS = 10
"""Of the cover of a mesh."""
NUM_STEPS = 10
"""Of Newton's method to a surface."""
THINNEST = 0.3
"""Depth, relative to the largest half size, up to which walls are thickened before they are learned: the kernel is too
wide for thinner ones."""
TURNED = 0.8
"""Volume of the box along a shape's principal axes, relative to that along the axes of its frame, from which the field
takes the principal ones."""

T = TypeVar("T", bound="Obstacle")


def as_point(v: Array) -> Point:
    """An array (3,) as a value."""
    x, y, z = (float(c) for c in v)
    return x, y, z


class Obstacle(Protocol):
    """A solid somewhere in the world: a value, cheap to move, compared and hashed by what it is."""

    @property
    def position(self) -> Point:
        """Origin of its own frame in the world, metres."""
        ...

    @property
    def wxyz(self) -> Quaternion:
        """Unit quaternion that turns its own frame into the world's."""
        ...

    @property
    def radius(self) -> float:
        """Of the ball around `position` that holds it, metres."""
        ...

    @property
    def depth(self) -> float:
        """How far inside its deepest point is, metres."""
        ...

    def moved(self: T, position: Point, wxyz: Quaternion = UPRIGHT) -> T:
        """The same shape somewhere else."""
        ...

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the surface, (*B,), metres, negative inside.

        Its slope is nowhere above 1 (of triangles, by two percent in places). Analytic in `s`: derivatives by complex
        steps are exact.
        """
        ...

    def nearest_free(self, s: Array) -> Array:
        """The points `s` (*B, 3), those inside moved to the nearest point of the surface, (*B, 3), metres."""
        ...

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """The generator whose reverse flow leaves the shape, learned once for all places of it."""
        ...

    def cover(self) -> tuple[Array, Array]:
        """Balls that together hold the shape: centres (K, 3) in the world and radii (K,), metres, K ≤ `MAX_BALLS`."""
        ...

    def surface(self) -> tuple[Array, Indices]:
        """What to draw: vertices (V, 3), metres, in its own frame, and faces (F, 3), outward."""
        ...


class _Turned:
    """What is common to shapes that are given in a frame of their own."""

    position: Point
    wxyz: Quaternion

    def moved(self: T, position: Point, wxyz: Quaternion = UPRIGHT) -> T:
        """See `Obstacle`."""
        return replace(self, position=position, wxyz=wxyz)  # pyright: ignore[reportArgumentType, reportCallIssue]

    def _to_own(self, s: Array) -> Array:
        return (s - np.asarray(self.position)) @ rotation(self.wxyz)

    def _to_world(self, s: Array) -> Array:
        return s @ rotation(self.wxyz).T + np.asarray(self.position)

    def _placed(
        self,
        occupancy: OccupancyMap,
        generator: Generator,
        temperature: float,
        axes: Array,
        centre: Array | float = 0.0,
        scale: float = 1.0,
    ) -> PlacedField:
        """The field of a map in the frame u, where a point of this shape's own frame is axes·u + centre.

        World metres are `scale` times the units of the own frame.
        """
        local = StretchedField(AvoidanceField(occupancy, generator, temperature), axes)
        return PlacedField(local, self._to_world(np.zeros(3) + centre), rotation(self.wxyz), scale)


@dataclass(frozen=True)
class Sphere:
    """A ball in the world, with the true shape that clearances are measured against."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.15
    """Metres."""

    @property
    def wxyz(self) -> Quaternion:
        """A ball is turned by nothing."""
        return UPRIGHT

    @property
    def radius(self) -> float:
        """Metres."""
        return self.diameter / 2

    @property
    def depth(self) -> float:
        """See `Obstacle`."""
        return self.radius

    def moved(self, position: Point, wxyz: Quaternion = UPRIGHT) -> Sphere:
        """See `Obstacle`."""
        return Sphere(position, self.diameter)

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the surface, (*B,), metres, negative inside; analytic in `s`."""
        offset = s - np.asarray(self.position)
        return np.sqrt((offset * offset).sum(axis=-1)) - self.radius

    def nearest_free(self, s: Array) -> Array:
        """The points `s` (*B, 3), those inside moved to the nearest point of the surface, (*B, 3), metres."""
        offset = s - np.asarray(self.position)
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        outward = np.where(distance > 0, offset / np.maximum(distance, 1e-300), np.array([0.0, 0.0, 1.0]))
        return np.where(distance < self.radius, np.asarray(self.position) + self.radius * outward, s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """The generator whose reverse flow leaves the sphere, from an occupancy map learned once for all spheres."""
        local = AvoidanceField(unit_sphere_map(), generator, temperature)
        return PlacedField(local, np.asarray(self.position), np.eye(3), self.radius)

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        return np.array([self.position]), np.array([self.radius])

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        heights = -np.cos(np.linspace(0, np.pi, 25))
        vertices, faces = _lathe(np.sqrt(1 - heights**2)[1:-1], heights[1:-1], -1.0, 1.0)
        return self.radius * vertices, faces


@dataclass(frozen=True)
class Box(_Turned):
    """A box; a cube where its sizes are equal."""

    position: Point
    """Centre, metres."""
    sizes: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Of the whole box along its own axes, metres."""
    wxyz: Quaternion = UPRIGHT

    @cached_property
    def _half(self) -> Array:
        return np.asarray(self.sizes) / 2

    @property
    def radius(self) -> float:
        """Half the diagonal, metres."""
        return float(np.linalg.norm(self._half))

    @property
    def depth(self) -> float:
        """See `Obstacle`."""
        return float(self._half.min())

    def signed_distance(self, s: Array) -> Array:
        """See `Obstacle`."""
        own = self._to_own(s)
        x, y, z = (_magnitude(own[..., i]) - self._half[i] for i in range(3))
        return _beyond_faces(x, y, z)

    def nearest_free(self, s: Array) -> Array:
        """See `Obstacle`."""
        own = self._to_own(s)
        excess = np.abs(own) - self._half
        nearest = np.eye(3, dtype=bool)[excess.argmax(axis=-1)]
        moved = np.where(nearest, np.where(own < 0, -self._half, self._half), own)
        return np.where(np.all(excess < 0, axis=-1, keepdims=True), self._to_world(moved), s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        unit = _unit_sizes(self._half)
        return self._placed(_box_map(unit), generator, temperature, np.diag(self._half / unit))

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        own, radius = _blocks(self._half)
        return self._to_world(own), np.full(len(own), radius)

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        corners = np.array(list(itertools.product([-1.0, 1.0], repeat=3)))  # x slowest
        quads = np.array([[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]])
        return corners * self._half, quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


@dataclass(frozen=True)
class Cylinder(_Turned):
    """A cylinder along the z axis of its own frame."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.12
    """Metres."""
    height: float = 0.2
    """Metres."""
    wxyz: Quaternion = UPRIGHT

    @cached_property
    def _half(self) -> Array:
        return np.array([self.diameter, self.diameter, self.height]) / 2

    @property
    def radius(self) -> float:
        """Of the ball that holds it, metres."""
        return float(np.hypot(self.diameter, self.height) / 2)

    @property
    def depth(self) -> float:
        """See `Obstacle`."""
        return float(self._half.min())

    def signed_distance(self, s: Array) -> Array:
        """See `Obstacle`."""
        own = self._to_own(s)
        x, y, z = (own[..., i] for i in range(3))
        return _beyond_faces(np.sqrt(x * x + y * y) - self._half[0], _magnitude(z) - self._half[2])

    def nearest_free(self, s: Array) -> Array:
        """See `Obstacle`."""
        own = self._to_own(s)
        r = np.linalg.norm(own[..., :2], axis=-1, keepdims=True)
        sideways, upwards = r - self._half[0], np.abs(own[..., 2:]) - self._half[2]
        outward = np.where(r > 0, own[..., :2] / np.maximum(r, 1e-300), np.array([1.0, 0.0]))
        around = np.concatenate([self._half[0] * outward, own[..., 2:]], axis=-1)
        above = np.concatenate([own[..., :2], np.where(own[..., 2:] < 0, -self._half[2], self._half[2])], axis=-1)
        moved = self._to_world(np.where(sideways > upwards, around, above))
        return np.where((sideways < 0) & (upwards < 0), moved, s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        unit = _unit_sizes(self._half)
        return self._placed(_cylinder_map(unit), generator, temperature, np.diag(self._half / unit))

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`: slices one above the other, or seven balls side by side, whatever is tighter."""
        (R, _, half), slices = self._half, np.arange(1, MAX_BALLS + 1)
        stacked = np.hypot(R, half / slices)
        num = int(slices[stacked <= 1.02 * stacked[-1]][0])  # more would gain nothing
        centres = np.zeros((num, 3))
        centres[:, 2] = half * ((2 * np.arange(num) + 1) / num - 1)
        radius = stacked[num - 1]
        if (beside := np.hypot(R / 2, half)) < radius:  # seven discs of half the radius cover a disc
            turn = np.arange(6) * np.pi / 3
            ring = R * np.sqrt(3) / 2 * np.stack([np.cos(turn), np.sin(turn), np.zeros(6)], axis=1)
            centres, radius = np.concatenate([np.zeros((1, 3)), ring]), beside
        return self._to_world(centres), np.full(len(centres), radius)

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        vertices, faces = _lathe(np.ones(2), np.array([-1.0, 1.0]), -1.0, 1.0)
        return vertices * self._half, faces


class _Triangles(_Turned):
    """What is common to shapes that triangles bound: larger or smaller ones share what was computed for one."""

    scale: float

    @property
    def solid(self) -> Solid:
        """What they enclose, in its own frame, before it is scaled."""
        raise NotImplementedError

    @property
    def size(self) -> float:
        """Largest side of its bounding box, metres."""
        return self.scale * float(np.ptp(self.solid.bounds, axis=0).max())

    def resized(self: T, size: float) -> T:
        """The same shape with the largest side of its bounding box of this size, metres."""
        shape: Any = self
        return replace(shape, scale=size / shape.size * shape.scale)

    @property
    def radius(self) -> float:
        """See `Obstacle`."""
        return self.scale * self.solid.radius

    @property
    def depth(self) -> float:
        """See `Obstacle`."""
        return self.scale * self.solid.distances.depth

    def signed_distance(self, s: Array) -> Array:
        """See `Obstacle`; interpolated on a grid, which rounds edges by about a quarter of its cells."""
        return self.scale * self.solid.distances(self._to_own(s))

    def nearest_free(self, s: Array) -> Array:
        """See `Obstacle`."""
        own = self._to_own(s).reshape(-1, 3)
        distance = self.solid.distances
        inside = np.flatnonzero(distance(own) < 0)
        moved = self.solid.nearest(own[inside])
        for _ in range(NUM_STEPS):  # to where the interpolated distance is 0, too
            depth, slope = distance.with_slope(moved)
            moved -= (depth / np.maximum((slope * slope).sum(axis=1), 0.25))[:, None] * slope
        found = np.array(s, dtype=float)
        found.reshape(-1, 3)[inside] = self._to_world(moved)
        return found

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        occupancy, axes, centre = _solid_map(self.solid)
        return self._placed(occupancy, generator, temperature, axes, centre, self.scale)

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        centres, radii = self.solid.balls(NUM_BALLS)
        return self._to_world(centres), self.scale * radii

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        return self.scale * self.solid.vertices, self.solid.faces

    def _to_own(self, s: Array) -> Array:
        return super()._to_own(s) / self.scale

    def _to_world(self, s: Array) -> Array:
        return super()._to_world(self.scale * s)


@dataclass(frozen=True)
class MeshObstacle(_Triangles):
    """What a closed mesh encloses."""

    position: Point
    """Of the mesh's origin, metres."""
    mesh: Solid
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0
    """Of the mesh."""

    @property
    def solid(self) -> Solid:
        """The mesh."""
        return self.mesh


@dataclass(frozen=True)
class CloudObstacle(_Triangles):
    """What a point cloud occupies."""

    position: Point
    """Of the cloud's origin, metres."""
    cloud: Cloud
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0
    """Of the cloud."""

    @property
    def solid(self) -> Solid:
        """See `Cloud`."""
        return self.cloud.solid

    def labelled(self) -> tuple[Array, Mask]:
        """Its points in the world (K, 3), metres, and whether each is occupied (K,)."""
        points, labels = self._to_world(self.cloud.points), self.cloud.labels
        return points, np.ones(len(points), dtype=bool) if labels is None else labels > 0.5


@lru_cache(maxsize=256)
def rotation(wxyz: Quaternion) -> Array:
    """(3, 3) matrix of a quaternion, whose length does not count; columns are the turned axes."""
    w, x, y, z = np.asarray(wxyz, dtype=float) / np.linalg.norm(wxyz)
    matrix = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )
    matrix.flags.writeable = False
    return matrix


@lru_cache(maxsize=1)
def unit_sphere_map() -> OccupancyMap:
    """Occupancy of the unit ball, learned from labelled samples."""
    return learned(lambda s: np.linalg.norm(s, axis=1) < 1)


def learned(inside: Callable[[Array], Mask], regularisation: float = REGULARISATION) -> OccupancyMap:
    """Occupancy of a shape whose largest half sizes are 1, learned from labelled samples around it."""
    samples, labels = sample_labels(inside, -np.ones(3), np.ones(3), NUM_SAMPLES, np.random.default_rng(0))
    return fit_occupancy(samples, labels, KERNEL_WIDTH, regularisation=regularisation)


def _unit_sizes(half: Array) -> tuple[float, float, float]:
    """Half sizes where space is stretched until they are alike: 1, or less for what is flatter than `FLATTEST`."""
    x, y, z = (round(float(min(1.0, size / (FLATTEST * half.max()))), 3) for size in half)
    return x, y, z


@lru_cache(maxsize=16)
def _box_map(half: tuple[float, float, float]) -> OccupancyMap:
    return learned(lambda s: np.all(np.abs(s) < np.array(half), axis=1))


@lru_cache(maxsize=16)
def _cylinder_map(half: tuple[float, float, float]) -> OccupancyMap:
    return learned(lambda s: (np.linalg.norm(s[:, :2], axis=1) < half[0]) & (np.abs(s[:, 2]) < half[2]))


@lru_cache(maxsize=16)
def _solid_map(solid: Solid) -> tuple[OccupancyMap, Array, Array]:
    """The map of a solid, the stretched axes (3, 3) of its frame, as columns, and its origin (3,), metres."""
    grid = solid.distances
    interior = grid.interior if len(grid.interior) else solid.vertices
    turn = np.eye(3)
    spread = np.linalg.eigh(np.cov(interior.T))[1]
    if np.prod(np.ptp(solid.vertices @ spread, axis=0)) < TURNED * np.prod(np.ptp(solid.vertices, axis=0)):
        turn = spread  # it stands askew in its own frame
    along = solid.vertices @ turn
    lower, upper = along.min(axis=0), along.max(axis=0)
    half = (upper - lower) / 2
    axes, centre = turn * (half / np.array(_unit_sizes(half))), turn @ ((lower + upper) / 2)
    thicker = max(0.0, THINNEST * float(half.max()) - grid.depth)
    return learned(lambda u: grid(u @ axes.T + centre) < thicker, SOLID_REGULARISATION), axes, centre


def _magnitude(x: Array) -> Array:
    return np.where(x.real < 0, -x, x)


def _beyond_faces(*excess: Array) -> Array:
    """Signed distance from a box in the coordinates whose excesses over the half sizes these are."""
    inside, squared = excess[0], np.zeros(())
    for x in excess[1:]:
        inside: Array = np.where(x.real > inside.real, x, inside)
    for x in excess:
        beyond: Array = np.where(x.real > 0, x, 0.0)
        squared = squared + beyond * beyond
    return np.where(inside.real > 0, np.sqrt(squared), inside)


def _blocks(half: Array) -> tuple[Array, float]:
    """Centres (K, 3) of the equal parts that a box is best cut into, and half the diagonal of a part."""
    limit = range(1, MAX_BALLS + 1)
    cuts = np.array([cut for cut in itertools.product(limit, repeat=3) if np.prod(cut) <= MAX_BALLS])
    radius = np.linalg.norm(half / cuts, axis=1)
    good = np.flatnonzero(radius <= 1.15 * radius.min())  # the fewest parts that are nearly as small as can be
    best = good[np.prod(cuts[good], axis=1).argmin()]
    sides = [size * ((2 * np.arange(num) + 1) / num - 1) for size, num in zip(half, cuts[best], strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3), float(radius[best])


def _lathe(radii: Array, heights: Array, bottom: float, top: float, num: int = 48) -> tuple[Array, Indices]:
    """A closed surface of revolution around z through rings (K,), with an apex below and above."""
    turn = 2 * np.pi * np.arange(num) / num
    rings = np.stack(
        [
            np.outer(radii, np.cos(turn)),
            np.outer(radii, np.sin(turn)),
            np.repeat(heights[:, None], num, axis=1),
        ],
        axis=-1,
    ).reshape(-1, 3)
    vertices = np.concatenate([rings, [[0, 0, bottom], [0, 0, top]]])
    here = np.arange(num)
    there = (here + 1) % num
    below = len(rings)
    parts = [np.stack([np.full(num, below), there, here], axis=1)]
    for k in range(len(radii) - 1):
        a, b, c, d = here + k * num, there + k * num, there + (k + 1) * num, here + (k + 1) * num
        parts += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    last = (len(radii) - 1) * num
    parts.append(np.stack([np.full(num, below + 1), here + last, there + last], axis=1))
    return vertices, np.concatenate(parts)
