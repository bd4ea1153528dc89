"""Obstacles: their true shapes, and the avoidance fields learned from samples of them (sec. 4.4)."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol, TypeVar

import numpy as np

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array, Indices, Mask, PlacedField
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.occupancy import (
    AvoidanceField,
    Generator,
    OccupancyMap,
    fit_occupancy,
    sample_labels,
)
from dt_viz.obstacles.solids import Solid

Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
NUM_SAMPLES = 4000
KERNEL_WIDTH = 0.9
"""Kernel width of the occupancy map, in radii of the obstacle, or along each axis in half sizes."""
REGULARISATION, SOLID_REGULARISATION = 10.0, 1.0
"""Regularisation of the occupancy map, and that for shapes that may be hollow, whose map must rise more steeply."""
FLATTEST = 0.3
"""Smallest half size, relative to the largest, that the kernel adapts to: a thinner field turns motions sharply."""
MAX_BALLS, NUM_BALLS = 12, 10
"""Largest number of balls of a cover, and the number for a mesh."""
CUTS = np.array([cut for cut in itertools.product(range(1, MAX_BALLS + 1), repeat=3) if math.prod(cut) <= MAX_BALLS])
"""(C, 3) numbers of parts along its axes that a box may be cut into."""
SMALLEST, LARGEST = 1e-6, 100.0
"""Bounds of sizes, metres."""
NUM_STEPS = 10
"""Number of Newton steps to a surface."""
THINNEST = 0.3
"""Depth, relative to the largest half size, to which thinner shapes are thickened before they are learned."""
TURNED = 0.8
"""Volume of the box along a shape's principal axes, relative to that along its frame's, below which the field follows
the principal axes."""

T = TypeVar("T", bound="Obstacle")


def as_point(v: Array) -> Point:
    """Convert an array (3,) to a tuple."""
    x, y, z = (float(c) for c in v)
    return x, y, z


def as_quaternion(v: Array) -> Quaternion:
    """Convert an array (4,) to a tuple."""
    w, x, y, z = (float(c) for c in v)
    return w, x, y, z


class Obstacle(Protocol):
    """A solid somewhere in the world: an immutable value, cheap to move."""

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
        """Radius of the ball around `position` that holds it, metres."""
        ...

    @property
    def depth(self) -> float:
        """Distance of its deepest point from the surface, metres."""
        ...

    def moved(self: T, position: Point, wxyz: Quaternion = UPRIGHT) -> T:
        """Return the same shape somewhere else."""
        ...

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the surface, (*B,), metres, negative inside.

        Its slope is nowhere above 1 (of triangles, by two percent in places). Analytic in `s`: derivatives by complex
        steps are exact.
        """
        ...

    def nearest_free(self, s: Array) -> Array:
        """Return the points `s` (*B, 3), those inside moved to the nearest point of the surface, (*B, 3), metres."""
        ...

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """Return the generator whose reverse flow leaves the shape, learned once for all its places."""
        ...

    def cover(self) -> tuple[Array, Array]:
        """Cover the shape by balls: centres (K, 3) in the world and radii (K,), metres, K ≤ `MAX_BALLS`."""
        ...

    def surface(self) -> tuple[Array, Indices]:
        """Return the drawn mesh: vertices (V, 3), metres, in its own frame, and faces (F, 3), outward."""
        ...


class _Turned:
    """Base of shapes that are given in a frame of their own."""

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
        """Return the field of a map in a frame u; u ↦ axes·u + centre gives this shape's own frame.

        Metres of the world are `scale` times the units of the own frame.
        """
        local = AvoidanceField(occupancy, generator, temperature)
        return PlacedField(local, self._to_world(np.zeros(3) + centre), scale * rotation(self.wxyz) @ axes)


@dataclass(frozen=True)
class Sphere:
    """A ball. Raises FormatError, as other shapes, where its size makes no sense."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.15
    """Diameter, metres."""

    def __post_init__(self) -> None:
        check_between("diameter", self.diameter, SMALLEST, LARGEST)

    @property
    def wxyz(self) -> Quaternion:
        """Identity: a ball looks the same in any orientation."""
        return UPRIGHT

    @property
    def radius(self) -> float:
        """Radius, metres."""
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
        """See `Obstacle`."""
        offset = s - np.asarray(self.position)
        distance = np.linalg.norm(offset, axis=-1, keepdims=True)
        outward = np.where(distance > 0, offset / np.maximum(distance, 1e-300), np.array([0.0, 0.0, 1.0]))
        return np.where(distance < self.radius, np.asarray(self.position) + self.radius * outward, s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`: from one occupancy map for all spheres."""
        local = AvoidanceField(unit_sphere_map(), generator, temperature)
        return PlacedField(local, np.asarray(self.position), self.radius * np.eye(3))

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        return np.array([self.position]), np.array([self.radius])

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        turn = np.linspace(0, np.pi, 25)
        vertices, faces = lathe(list(zip(np.sin(turn), -np.cos(turn), strict=True)))
        return self.radius * vertices, faces


@dataclass(frozen=True)
class Box(_Turned):
    """A box; a cube where its sizes are equal."""

    position: Point
    """Centre, metres."""
    sizes: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Side lengths along its own axes, metres."""
    wxyz: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        check_between("sizes", min(self.sizes), SMALLEST, LARGEST)
        check_between("sizes", max(self.sizes), SMALLEST, LARGEST)

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
    """Diameter, metres."""
    height: float = 0.2
    """Height, metres."""
    wxyz: Quaternion = UPRIGHT

    def __post_init__(self) -> None:
        check_between("diameter", self.diameter, SMALLEST, LARGEST)
        check_between("height", self.height, SMALLEST, LARGEST)

    @cached_property
    def _half(self) -> Array:
        return np.array([self.diameter, self.diameter, self.height]) / 2

    @property
    def radius(self) -> float:
        """Half the diagonal, metres."""
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
        """See `Obstacle`: balls of slices one above the other, or seven balls side by side, whichever is tighter."""
        (R, _, half), slices = self._half, np.arange(1, MAX_BALLS + 1)
        stacked = np.hypot(R, half / slices)
        num = int(slices[stacked <= 1.02 * stacked[-1]][0])  # the fewest that are nearly as tight
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
        radius, _, half = self._half
        return lathe([(0, -half), (radius, -half), (radius, half), (0, half)])


class _Triangles(_Turned):
    """Base of shapes bounded by triangles; shapes that differ in scale only share what was computed for one."""

    scale: float

    def __post_init__(self) -> None:
        check_between("scale", self.scale, SMALLEST, 1 / SMALLEST)

    @property
    def solid(self) -> Solid:
        """Enclosed solid in its own frame, before scaling."""
        raise NotImplementedError

    @property
    def size(self) -> float:
        """Largest side of its bounding box, metres."""
        return self.scale * float(np.ptp(self.solid.bounds, axis=0).max())

    def resized(self: T, size: float) -> T:
        """Return the same shape scaled so that the largest side of its bounding box is `size`, metres."""
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
        for _ in range(NUM_STEPS):  # so that the interpolated distance is 0, too
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
    """An obstacle enclosed by a mesh."""

    position: Point
    """Position of the mesh's origin, metres."""
    mesh: Solid
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0
    """Length of one unit of the mesh, metres."""

    @property
    def solid(self) -> Solid:
        """The mesh."""
        return self.mesh


@dataclass(frozen=True)
class CloudObstacle(_Triangles):
    """An obstacle that a point cloud occupies."""

    position: Point
    """Position of the cloud's origin, metres."""
    cloud: Cloud
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0
    """Length of one unit of the cloud, metres."""

    @property
    def solid(self) -> Solid:
        return self.cloud.solid

    def labelled(self) -> tuple[Array, Mask]:
        """Return its points in the world (K, 3), metres, and whether each is occupied (K,)."""
        points, labels = self._to_world(self.cloud.points), self.cloud.labels
        return points, np.ones(len(points), dtype=bool) if labels is None else labels > 0.5


SHAPES = (Sphere, Box, Cylinder, MeshObstacle, CloudObstacle)
"""All kinds of obstacles."""


@lru_cache(maxsize=256)
def rotation(wxyz: Quaternion) -> Array:
    """Return the matrix (3, 3) of a quaternion of any length; its columns are the turned axes."""
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
    """Learn the occupancy of the unit ball from labelled samples."""
    return learned(lambda s: np.linalg.norm(s, axis=1) < 1)


def learned(inside: Callable[[Array], Mask], regularisation: float = REGULARISATION) -> OccupancyMap:
    """Learn the occupancy of a shape whose largest half sizes are 1 from labelled samples around it."""
    samples, labels = sample_labels(inside, -np.ones(3), np.ones(3), NUM_SAMPLES, np.random.default_rng(0))
    return fit_occupancy(samples, labels, KERNEL_WIDTH, regularisation=regularisation)


def _unit_sizes(half: Array) -> tuple[float, float, float]:
    """Return half sizes after space is stretched to make them equal: 1, or less for a shape flatter than `FLATTEST`."""
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
    """Return the map of a solid, the stretched axes (3, 3) of its frame as columns, and its origin (3,), metres."""
    grid = solid.distances
    interior = grid.interior if len(grid.interior) else solid.vertices
    turn = np.eye(3)
    spread = np.linalg.eigh(np.cov(interior.T))[1]
    if np.prod(np.ptp(solid.vertices @ spread, axis=0)) < TURNED * np.prod(np.ptp(solid.vertices, axis=0)):
        turn = spread  # it is askew in its own frame
    along = solid.vertices @ turn
    lower, upper = along.min(axis=0), along.max(axis=0)
    half = (upper - lower) / 2
    axes, centre = turn * (half / np.array(_unit_sizes(half))), turn @ ((lower + upper) / 2)
    thicker = max(0.0, THINNEST * float(half.max()) - grid.depth)
    return learned(lambda u: grid(u @ axes.T + centre) < thicker, SOLID_REGULARISATION), axes, centre


def _magnitude(x: Array) -> Array:
    return np.where(x.real < 0, -x, x)


def _beyond_faces(*excess: Array) -> Array:
    """Return the signed distance from a box, given the excesses of coordinates over its half sizes."""
    inside, squared = excess[0], np.zeros(())
    for x in excess[1:]:
        inside: Array = np.where(x.real > inside.real, x, inside)
    for x in excess:
        beyond: Array = np.where(x.real > 0, x, 0.0)
        squared = squared + beyond * beyond
    return np.where(inside.real > 0, np.sqrt(squared), inside)


def _blocks(half: Array) -> tuple[Array, float]:
    """Cut a box into equal parts; return their centres (K, 3) and half the diagonal of a part."""
    radius = np.linalg.norm(half / CUTS, axis=1)
    good = np.flatnonzero(radius <= 1.15 * radius.min())  # the fewest parts that are nearly as small as can be
    best = good[np.prod(CUTS[good], axis=1).argmin()]
    sides = [size * ((2 * np.arange(num) + 1) / num - 1) for size, num in zip(half, CUTS[best], strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3), float(radius[best])


def lathe(profile: Sequence[tuple[float, float]], num: int = 48) -> tuple[Array, Indices]:
    """Return the closed surface of revolution of a profile around z.

    Args:
        profile: distances from the axis and heights, metres, from the axis up along the outside and back to it.
        num: number of sides.

    Returns:
        Vertices (V, 3), metres, and faces (F, 3), outward.
    """
    (_, bottom), *rings, (_, top) = profile
    turn, here = 2 * np.pi * np.arange(num) / num, np.arange(num)
    circle, there = np.stack([np.cos(turn), np.sin(turn)], axis=1), (here + 1) % num
    vertices = [np.column_stack([radius * circle, np.full(num, height)]) for radius, height in rings]
    last, below = (len(rings) - 1) * num, len(rings) * num
    faces = [np.stack([np.full(num, below), there, here], axis=1)]
    for first in range(0, last, num):
        a, b, c, d = here + first, there + first, there + first + num, here + first + num
        faces += [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    faces.append(np.stack([np.full(num, below + 1), here + last, there + last], axis=1))
    return np.concatenate([*vertices, [[0, 0, bottom], [0, 0, top]]]), np.concatenate(faces)


@lru_cache(maxsize=4)
def golden_spiral(num: int, offset: float = 0.0) -> Array:
    """Return evenly spread unit vectors (num, 3): a spiral in golden angles, turned by `offset` of them."""
    k = np.arange(num)
    z, turn = 1 - (2 * k + 1) / num, np.pi * (1 + np.sqrt(5)) * (k + offset)
    r = np.sqrt(1 - z * z)
    vectors = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    vectors.flags.writeable = False
    return vectors
