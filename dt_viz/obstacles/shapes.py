"""Obstacles: their true shapes, and the avoidance fields learned from samples of them (sec. 4.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Any, TypeVar

import numpy as np

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array, Indices, Mask, PlacedField
from dt_viz.kernels.distances import BOX, CYLINDER, SHAPE, SPHERE, Shapes, Values, batch, distances
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.covers import box_cover, cylinder_cover
from dt_viz.obstacles.learned_maps import solid_map, unit_map, unit_sizes
from dt_viz.obstacles.occupancy import AvoidanceField, Generator, OccupancyMap
from dt_viz.obstacles.solids import DistanceGrid, Solid
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


class Obstacle(ABC):
    """A solid somewhere in the world: an immutable value, cheap to move.

    A shape gives its record for compiled loops, map and cover in a frame of its own.
    """

    position: Point
    """Origin of its own frame in the world, metres."""
    wxyz: Quaternion
    """Unit quaternion that turns its own frame into the world's."""
    scale: float = 1.0
    """Length of one unit of its own frame, metres."""

    @property
    @abstractmethod
    def radius(self) -> float:
        """Radius of the ball around `position` that holds it, metres."""

    @property
    @abstractmethod
    def depth(self) -> float:
        """Distance of its deepest point from the surface, metres."""

    @abstractmethod
    def surface(self) -> tuple[Array, Indices]:
        """Return the drawn mesh: vertices (V, 3), metres, in its own frame, and faces (F, 3), outward."""

    @property
    @abstractmethod
    def record(self) -> dict[str, Any]:
        """Fields of its `dt_viz.kernels.distances.SHAPE`, but its place; its kind decides its distance."""

    @property
    def grid(self) -> DistanceGrid | None:
        """Grid on which its signed distance is sampled, in its own frame; None where a formula gives it."""
        return None

    @abstractmethod
    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        """Return the map of its occupancy in a frame u, and axes A (3, 3) and centre c (3,): own frame = A·u + c."""

    @abstractmethod
    def _cover(self) -> tuple[Array, Array]:
        """Cover it by balls, centres (K, 3) and radii (K,), both in its own frame."""

    def moved(self: T, position: Point, wxyz: Quaternion = UPRIGHT) -> T:
        """Return the same shape somewhere else."""
        changes: Any = {"position": position, "wxyz": wxyz}
        return replace(self, **changes)  # pyright: ignore[reportArgumentType]

    def signed_distance(self, s: Array) -> Array:
        """Distance of the points `s` (*B, 3) from the surface, (*B,), metres, negative inside.

        Its slope is nowhere above 1 (of triangles, by two percent in places). Analytic in `s`: derivatives by complex
        steps are exact.
        """
        return nearest((self,), s)

    def field(self, generator: Generator, temperature: float) -> PlacedField:
        """Return the generator whose reverse flow leaves the shape, learned once for all its places."""
        occupancy, axes, centre = self._map()
        local, turned = AvoidanceField(occupancy, generator, temperature), self.scale * rotation(self.wxyz) @ axes
        return PlacedField(local, self._to_world(centre), turned)

    def cover(self) -> tuple[Array, Array]:
        """Cover the shape by balls: centres (K, 3) in the world and radii (K,), metres, K ≤ `MAX_BALLS`."""
        centres, radii = self._cover()
        return self._to_world(centres), self.scale * radii

    def _to_world(self, own: Array) -> Array:
        return self.scale * own @ rotation(self.wxyz).T + np.asarray(self.position)


@dataclass(frozen=True)
class Sphere(Obstacle):
    """A ball. Raises FormatError, as other shapes, where its size makes no sense."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.15
    """Diameter, metres."""
    wxyz = UPRIGHT  # a ball looks the same in any orientation

    def __post_init__(self) -> None:
        check_between("diameter", self.diameter, SMALLEST, LARGEST)

    @property
    def radius(self) -> float:
        return self.diameter / 2

    @property
    def depth(self) -> float:
        return self.radius

    def moved(self, position: Point, wxyz: Quaternion = UPRIGHT) -> Sphere:
        return Sphere(position, self.diameter)

    def surface(self) -> tuple[Array, Indices]:
        turn = np.linspace(0, np.pi, 25)
        vertices, faces = lathe(list(zip(np.sin(turn), -np.cos(turn), strict=True)))
        return self.radius * vertices, faces

    @property
    def record(self) -> dict[str, Any]:
        return {"kind": SPHERE, "half": self.radius}

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        return unit_map(Sphere(ORIGIN, 2.0)), self.radius * np.eye(3), np.zeros(3)

    def _cover(self) -> tuple[Array, Array]:
        return np.zeros((1, 3)), np.array([self.radius])


@dataclass(frozen=True)
class Box(Obstacle):
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
        return float(np.linalg.norm(self._half))

    @property
    def depth(self) -> float:
        return float(self._half.min())

    def surface(self) -> tuple[Array, Indices]:
        return box_surface(self._half)

    @property
    def record(self) -> dict[str, Any]:
        return {"kind": BOX, "half": self._half}

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        x, y, z = unit = unit_sizes(self._half)
        return unit_map(Box(ORIGIN, (2 * x, 2 * y, 2 * z))), np.diag(self._half / unit), np.zeros(3)

    def _cover(self) -> tuple[Array, Array]:
        return box_cover(self._half)


@dataclass(frozen=True)
class Cylinder(Obstacle):
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
        return float(np.hypot(self.diameter, self.height) / 2)

    @property
    def depth(self) -> float:
        return float(self._half.min())

    def surface(self) -> tuple[Array, Indices]:
        radius, _, half = self._half
        return lathe([(0, -half), (radius, -half), (radius, half), (0, half)])

    @property
    def record(self) -> dict[str, Any]:
        return {"kind": CYLINDER, "half": self._half}

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        radius, _, half = unit = unit_sizes(self._half)
        return unit_map(Cylinder(ORIGIN, 2 * radius, 2 * half)), np.diag(self._half / unit), np.zeros(3)

    def _cover(self) -> tuple[Array, Array]:
        return cylinder_cover(self._half[0], self._half[2])


class TriangleObstacle(Obstacle):
    """Base of shapes bounded by triangles; shapes that differ in scale only share what was computed for one.

    Distances are interpolated on a grid, which rounds edges by about a quarter of its cells.
    """

    def __post_init__(self) -> None:
        check_between("scale", self.scale, SMALLEST, 1 / SMALLEST)

    @property
    @abstractmethod
    def solid(self) -> Solid:
        """Enclosed solid in its own frame, before scaling."""

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
        return self.scale * self.solid.radius

    @property
    def depth(self) -> float:
        return self.scale * self.solid.distances.depth

    def surface(self) -> tuple[Array, Indices]:
        return self.scale * self.solid.vertices, self.solid.faces

    @property
    def grid(self) -> DistanceGrid:
        return self.solid.distances

    @property
    def record(self) -> dict[str, Any]:
        return {**self.grid.record, "scale": self.scale}

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        return solid_map(self.solid)

    def _cover(self) -> tuple[Array, Array]:
        return self.solid.balls


@dataclass(frozen=True)
class MeshObstacle(TriangleObstacle):
    """An obstacle enclosed by a mesh."""

    position: Point
    """Position of the mesh's origin, metres."""
    mesh: Solid
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0
    """Length of one unit of the mesh, metres."""

    @property
    def solid(self) -> Solid:
        return self.mesh


@dataclass(frozen=True)
class CloudObstacle(TriangleObstacle):
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


@lru_cache(maxsize=64)
def records(parts: tuple[Obstacle, ...]) -> tuple[Shapes, Values]:
    """Convert obstacles to the records that compiled loops take, and the values of their grids."""
    shapes = np.zeros(len(parts), SHAPE)
    grids = tuple(dict.fromkeys(part.grid for part in parts if part.grid is not None))
    begins = dict(zip(grids, np.cumsum([0, *(grid.values.size for grid in grids)]).tolist(), strict=False))
    for shape, part in zip(shapes, parts, strict=True):
        for name, value in {**part.record, "position": part.position, "axes": rotation(part.wxyz)}.items():
            shape[name] = value
        if part.grid is not None:
            shape["begin"] = begins[part.grid]
    return shapes, _joined(grids)


@lru_cache(maxsize=8)
def _joined(grids: tuple[DistanceGrid, ...]) -> Values:
    return np.concatenate([np.empty(0, np.float32), *(grid.coefficients for grid in grids)])


def nearest(parts: tuple[Obstacle, ...], s: Array) -> Array:
    """Compute the distances (*B,), metres, of points `s` (*B, 3) from the nearest obstacle; see `signed_distance`."""
    return distances(*records(parts), batch(s)).reshape(s.shape[:-1])
