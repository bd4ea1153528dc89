"""Obstacles: their true shapes, and the avoidance fields learned from samples of them (sec. 4.4)."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, TypeVar

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from dt_viz.errors import check_between
from dt_viz.flows.fields import Array, Indices, Mask, PlacedField
from dt_viz.kernels.distances import (
    BOX,
    CAPSULE,
    CYLINDER,
    GRID,
    KINDS,
    SHAPE,
    SPHERE,
    Shapes,
    Values,
    batch,
    distances,
)
from dt_viz.memo import cached_property
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.occupancy import AvoidanceField, Generator, OccupancyMap, solid_map, unit_map, unit_sizes
from dt_viz.obstacles.solids import MAX_BALLS, DistanceGrid, Solid, box_cover, cylinder_cover


def box_surface(half: Array) -> tuple[Array, Indices]:
    """Return vertices (8, 3) and faces (12, 3), outward, of a box of half sizes (3,), metres."""
    mesh = trimesh.creation.box(2 * half)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


def lathe(profile: Sequence[tuple[float, float]], num: int = 48) -> tuple[Array, Indices]:
    """Return the closed surface, vertices (V, 3), metres, and faces (F, 3), outward, of a profile turned around z.

    The profile has distances from the axis and heights, metres, from the axis up along the outside and back to it; the
    surface has `num` sides.
    """
    mesh = trimesh.creation.revolve(np.array(profile), sections=num)
    return np.asarray(mesh.vertices), np.asarray(mesh.faces)


@lru_cache(maxsize=4)
def golden_spiral(num: int, offset: float = 0.0) -> Array:
    """Return evenly spread unit vectors (num, 3): a spiral in golden angles, turned by `offset` of them."""
    k = np.arange(num)
    z, turn = 1 - (2 * k + 1) / num, np.pi * (1 + np.sqrt(5)) * (k + offset)
    r = np.sqrt(1 - z * z)
    vectors = np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)
    vectors.flags.writeable = False
    return vectors


Point = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

ORIGIN: Point = (0.0, 0.0, 0.0)
UPRIGHT: Quaternion = (1.0, 0.0, 0.0, 0.0)
SMALLEST, LARGEST = 1e-6, 100.0  # bounds of sizes, metres
SIZE = 0.01, 1.0  # bounds of the longest side of what comes from a file, metres
PROPORTIONS = 16  # number of different proportions of capsules whose occupancy is learned

T = TypeVar("T", bound="Obstacle")
P = TypeVar("P", bound="Primitive")


def as_point(v: Array) -> Point:
    """Convert an array (3,) to a tuple."""
    x, y, z = (float(c) for c in v)
    return x, y, z


def as_quaternion(v: Array) -> Quaternion:
    """Convert an array (4,) to a tuple."""
    w, x, y, z = (float(c) for c in v)
    return w, x, y, z


class Length(NamedTuple):
    """A length of a shape that a user may change, within bounds, metres."""

    label: str
    low: float
    high: float
    axes: tuple[int, ...] = ()  # of the shape's own frame, along which its size is this length
    hint: str | None = None


class Obstacle(ABC):
    """A solid somewhere in the world: an immutable value, cheap to move.

    A new shape is a subclass in `SHAPES`: page, files, collisions and measurements take all that they need from it.
    """

    position: Point
    """Origin of its own frame in the world, metres."""
    wxyz: Quaternion
    """Unit quaternion that turns its own frame into the world's."""
    scale: float = 1.0
    """Length of one unit of its own frame, metres."""
    lengths: ClassVar[tuple[Length, ...]]
    """What a user may change."""

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
    def length(self, which: Length) -> float:
        """Return one of its `lengths`, metres."""

    @abstractmethod
    def with_length(self: T, which: Length, metres: float) -> T:
        """Return the shape with one of its `lengths` changed."""

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


class Primitive(Obstacle):
    """Base of shapes that the extents of their bounding box determine. Raises FormatError where these make no sense."""

    kind: ClassVar[int]
    """Its formula, of `dt_viz.kernels.distances.KINDS`."""
    offered: ClassVar[Mapping[str, Point]]
    """Extents, metres, of what a user may add, by its name."""

    @classmethod
    @abstractmethod
    def of_extents(cls: type[P], extents: Point, position: Point = ORIGIN, wxyz: Quaternion = UPRIGHT) -> P:
        """Return the shape with these `extents`; those that depend on others follow them."""

    @property
    @abstractmethod
    def extents(self) -> Point:
        """Sides of its bounding box along its own axes, metres."""

    @property
    @abstractmethod
    def core(self) -> tuple[str, tuple[float, ...], float]:
        """Class and sizes of a shape of coal, and the radius, metres, within which of it all is that belongs to it."""

    @cached_property
    def half(self) -> Array:
        """Half of its extents (3,), metres."""
        return np.array(self.extents) / 2

    @property
    def depth(self) -> float:
        return float(self.half.min())

    @property
    def record(self) -> dict[str, Any]:
        return {"kind": self.kind, "half": self.half}

    def length(self, which: Length) -> float:
        return self.extents[which.axes[0]]

    def with_length(self: P, which: Length, metres: float) -> P:
        x, y, z = (metres if axis in which.axes else size for axis, size in enumerate(self.extents))
        return self.of_extents((x, y, z), self.position, self.wxyz)

    def scaled(self: P, factor: float, digits: int) -> P:
        """Return it with its lengths times a factor, rounded to digits of a metre, within their bounds."""
        shape = self
        for which in self.lengths:
            shape = shape.with_length(
                which, min(max(round(factor * self.length(which), digits), which.low), which.high)
            )
        return shape

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        unit = np.array(unit_sizes(self.half))  # stretched, it is of the same kind
        return unit_map(self.of_extents(as_point(2 * unit))), np.diag(self.half / unit), np.zeros(3)


DIAMETER, SIDE = (0.04, 0.30), (0.03, 0.40)  # bounds of lengths on the page, metres


@dataclass(frozen=True)
class Sphere(Primitive):
    """A ball."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.15
    """Diameter, metres."""
    wxyz = UPRIGHT  # a ball looks the same in any orientation
    kind = SPHERE
    lengths = (Length("Diameter", *DIAMETER, (0, 1, 2)),)
    offered = MappingProxyType({"Sphere": (0.10, 0.10, 0.10)})

    def __post_init__(self) -> None:
        check_between("diameter", self.diameter, SMALLEST, LARGEST)

    @classmethod
    def of_extents(cls, extents: Point, position: Point = ORIGIN, wxyz: Quaternion = UPRIGHT) -> Sphere:
        return cls(position, extents[0])

    @property
    def extents(self) -> Point:
        return self.diameter, self.diameter, self.diameter

    @property
    def core(self) -> tuple[str, tuple[float, ...], float]:
        return "Sphere", (0.0,), self.radius

    @property
    def radius(self) -> float:
        return self.diameter / 2

    def moved(self, position: Point, wxyz: Quaternion = UPRIGHT) -> Sphere:
        return Sphere(position, self.diameter)

    def surface(self) -> tuple[Array, Indices]:
        turn = np.linspace(0, np.pi, 25)
        vertices, faces = lathe(list(zip(np.sin(turn), -np.cos(turn), strict=True)))
        return self.radius * vertices, faces

    def _cover(self) -> tuple[Array, Array]:
        return np.zeros((1, 3)), np.array([self.radius])


@dataclass(frozen=True)
class Box(Primitive):
    """A box; a cube where its sizes are equal."""

    position: Point
    """Centre, metres."""
    sizes: tuple[float, float, float] = (0.15, 0.15, 0.15)
    """Side lengths along its own axes, metres."""
    wxyz: Quaternion = UPRIGHT
    kind = BOX
    lengths = tuple(Length(f"Size {axis}", *SIDE, (i,)) for i, axis in enumerate("xyz"))
    offered = MappingProxyType({"Cube (fig. 3a)": (0.12, 0.12, 0.12), "Box": (0.16, 0.10, 0.06)})

    def __post_init__(self) -> None:
        check_between("sizes", min(self.sizes), SMALLEST, LARGEST)
        check_between("sizes", max(self.sizes), SMALLEST, LARGEST)

    @classmethod
    def of_extents(cls, extents: Point, position: Point = ORIGIN, wxyz: Quaternion = UPRIGHT) -> Box:
        return cls(position, extents, wxyz)

    @property
    def extents(self) -> Point:
        return self.sizes

    @property
    def core(self) -> tuple[str, tuple[float, ...], float]:
        return "Box", self.sizes, 0.0

    @property
    def radius(self) -> float:
        return float(np.linalg.norm(self.half))

    def surface(self) -> tuple[Array, Indices]:
        return box_surface(self.half)

    def _cover(self) -> tuple[Array, Array]:
        return box_cover(self.half)


@dataclass(frozen=True)
class Turned(Primitive):
    """Base of shapes of revolution about the z axis of their own frame."""

    position: Point
    """Centre, metres."""
    diameter: float = 0.12
    """Diameter, metres."""
    height: float = 0.2
    """Height, metres."""
    wxyz: Quaternion = UPRIGHT
    lengths = Length("Diameter", *DIAMETER, (0, 1)), Length("Height", *SIDE, (2,))

    def __post_init__(self) -> None:
        check_between("diameter", self.diameter, SMALLEST, LARGEST)
        check_between("height", self.height, SMALLEST, LARGEST)

    @classmethod
    def of_extents(cls, extents: Point, position: Point = ORIGIN, wxyz: Quaternion = UPRIGHT) -> Turned:
        return cls(position, extents[0], extents[2], wxyz)

    @property
    def extents(self) -> Point:
        return self.diameter, self.diameter, self.height


class Cylinder(Turned):
    """A cylinder along the z axis of its own frame."""

    kind = CYLINDER
    offered = MappingProxyType({"Cylinder": (0.08, 0.08, 0.16)})

    @property
    def core(self) -> tuple[str, tuple[float, ...], float]:
        return "Cylinder", (self.diameter / 2, self.height), 0.0

    @property
    def radius(self) -> float:
        return float(np.hypot(self.diameter, self.height) / 2)

    def surface(self) -> tuple[Array, Indices]:
        radius, _, half = self.half
        return lathe([(0, -half), (radius, -half), (radius, half), (0, half)])

    def _cover(self) -> tuple[Array, Array]:
        return cylinder_cover(self.half[0], self.half[2])


class Capsule(Turned):
    """A cylinder along the z axis with half balls as ends, which its height counts: it is not below the diameter."""

    kind = CAPSULE
    offered = MappingProxyType({"Capsule": (0.08, 0.08, 0.20)})

    def __post_init__(self) -> None:
        super().__post_init__()
        check_between("height", self.height, self.diameter, LARGEST)

    @classmethod
    def of_extents(cls, extents: Point, position: Point = ORIGIN, wxyz: Quaternion = UPRIGHT) -> Capsule:
        return cls(position, extents[0], max(extents[0], extents[2]), wxyz)

    @property
    def core(self) -> tuple[str, tuple[float, ...], float]:
        return "Capsule", (0.0, self.height - self.diameter), self.diameter / 2

    @property
    def radius(self) -> float:
        return self.height / 2

    def surface(self) -> tuple[Array, Indices]:
        (radius, _, half), turn = self.half, np.linspace(0, np.pi / 2, 13)
        rounded = np.column_stack([radius * np.sin(turn), half - radius + radius * np.cos(turn)])
        return lathe([*(rounded * [1, -1]), *rounded[::-1]])

    def _map(self) -> tuple[OccupancyMap, Array, Array]:
        # stretched, it is no capsule; proportions are rounded, so that few are learned while its lengths are changed
        across = max(1, round(PROPORTIONS * self.diameter / self.height)) / PROPORTIONS
        stretch = np.array([across, across, 1.0])
        shape, unit = Capsule(ORIGIN, 2 * across, 2.0), np.array(unit_sizes(stretch))
        return unit_map(shape, *(stretch / unit).tolist()), np.diag(self.half / unit), np.zeros(3)

    def _cover(self) -> tuple[Array, Array]:
        radius, _, half = self.half
        num = min(MAX_BALLS, 2 + int(5 * (half - radius) / radius))
        centres = np.zeros((num, 3))
        centres[:, 2] = np.linspace(radius - half, half - radius, num)
        return centres, np.full(num, np.hypot(radius, (half - radius) / (num - 1)))


class TriangleObstacle(Obstacle):
    """Base of shapes bounded by triangles; shapes that differ in scale only share what was computed for one.

    Distances are interpolated on a grid, which rounds edges by about a quarter of its cells.
    """

    lengths = (Length("Size", *SIZE, hint="largest side of its bounding box"),)

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

    def length(self, which: Length) -> float:
        return self.size

    def with_length(self: T, which: Length, metres: float) -> T:
        return self.resized(metres)  # pyright: ignore[reportAttributeAccessIssue]

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

    position: Point  # position of the mesh's origin, metres
    mesh: Solid
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0  # length of one unit of the mesh, metres

    @property
    def solid(self) -> Solid:
        return self.mesh


@dataclass(frozen=True)
class CloudObstacle(TriangleObstacle):
    """An obstacle that a point cloud occupies."""

    position: Point  # position of the cloud's origin, metres
    cloud: Cloud
    wxyz: Quaternion = UPRIGHT
    scale: float = 1.0  # length of one unit of the cloud, metres

    @property
    def solid(self) -> Solid:
        return self.cloud.solid

    def labelled(self) -> tuple[Array, Mask]:
        """Return its points in the world (K, 3), metres, and whether each is occupied (K,)."""
        points, labels = self._to_world(self.cloud.points), self.cloud.labels
        return points, np.ones(len(points), dtype=bool) if labels is None else labels > 0.5


SHAPES: list[type[Obstacle]] = [Sphere, Cylinder, Box, Capsule, MeshObstacle, CloudObstacle]
"""All kinds of obstacles, in the order of the page's buttons."""


def primitives() -> dict[str, type[Primitive]]:
    """Return the kinds of obstacles that need no file, by their names in lower case."""
    return {shape.__name__.lower(): shape for shape in SHAPES if issubclass(shape, Primitive)}


@lru_cache(maxsize=256)
def rotation(wxyz: Quaternion) -> Array:
    """Return the matrix (3, 3) of a quaternion of any length; its columns are the turned axes."""
    matrix = Rotation.from_quat(np.roll(wxyz, -1)).as_matrix()
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
        if shape["kind"] not in (*KINDS, GRID):
            raise ValueError(f"{type(part).__name__}: no formula of kind {shape['kind']}")
        if part.grid is not None:
            shape["begin"] = begins[part.grid]
    return shapes, _joined(grids)


@lru_cache(maxsize=8)
def _joined(grids: tuple[DistanceGrid, ...]) -> Values:
    return np.concatenate([np.empty(0, np.float32), *(grid.coefficients for grid in grids)])


def nearest(parts: tuple[Obstacle, ...], s: Array) -> Array:
    """Compute the distances (*B,), metres, of points `s` (*B, 3) from the nearest obstacle; see `signed_distance`."""
    return distances(*records(parts), batch(s)).reshape(s.shape[:-1])
