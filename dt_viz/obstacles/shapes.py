"""Obstacles: their true shapes, and the avoidance fields learned from samples of them (sec. 4.4)."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, Protocol, TypeVar

import numpy as np

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array, Indices, Mask, PlacedField
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.covers import box_cover, cylinder_cover
from dt_viz.obstacles.learned_maps import solid_map, unit_map, unit_sizes
from dt_viz.obstacles.occupancy import AvoidanceField, Generator, OccupancyMap
from dt_viz.obstacles.solids import Solid
from dt_viz.obstacles.surfaces import box_surface, lathe

Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ORIGIN: Point = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
SMALLEST, LARGEST = 1e-6, 100.0
"""Bounds of sizes, metres."""

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

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`: from one occupancy map for all spheres."""
        local = AvoidanceField(unit_map(Sphere(ORIGIN, 2.0)), generator, temperature)
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

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        unit = unit_sizes(self._half)
        x, y, z = (2 * half for half in unit)
        return self._placed(unit_map(Box(ORIGIN, (x, y, z))), generator, temperature, np.diag(self._half / unit))

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        centres, radii = box_cover(self._half)
        return self._to_world(centres), radii

    def surface(self) -> tuple[Array, Indices]:
        """See `Obstacle`."""
        return box_surface(self._half)


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

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        unit = unit_sizes(self._half)
        return self._placed(
            unit_map(Cylinder(ORIGIN, 2 * unit[0], 2 * unit[2])), generator, temperature, np.diag(self._half / unit)
        )

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        centres, radii = cylinder_cover(self._half[0], self._half[2])
        return self._to_world(centres), radii

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

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """See `Obstacle`."""
        occupancy, axes, centre = solid_map(self.solid)
        return self._placed(occupancy, generator, temperature, axes, centre, self.scale)

    def cover(self) -> tuple[Array, Array]:
        """See `Obstacle`."""
        centres, radii = self.solid.balls
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
        """See `Obstacle`."""
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
