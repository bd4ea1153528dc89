"""Shapes of obstacles from files: closed meshes and point clouds, checked.

Meshes, in metres (or scaled to them): STL, OBJ, PLY, GLB. They must be closed; small holes and seams are mended
(see `dt_viz.obstacles.mending`).

Point clouds, in metres (or scaled to them):
    PLY (``.ply``): the vertices, with labels if they have a property ``occupied``, ``occupancy`` or ``label``.
    npz (``.npz``): ``points`` (K, 3), and optionally ``labels`` (K,). Pickled arrays are never opened.
    CSV (``.csv``), UTF-8: a header line ``x,y,z`` or ``x,y,z,occupied`` and one line per point.
    Labels are 1 (occupied) or 0 (free); without them every point is occupied.

A shape's origin is put into the middle of its bounding box.
"""

from __future__ import annotations

from array import array
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dt_viz.errors import DataError, FormatError, parsing
from dt_viz.files.glb import read_glb
from dt_viz.files.meshes import read_obj, read_stl
from dt_viz.files.npz import NpzFile
from dt_viz.files.ply import read_ply
from dt_viz.files.text import read_table
from dt_viz.flows.fields import Array, Indices
from dt_viz.interruption import checkpoint
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.mending import closed
from dt_viz.obstacles.solids import Solid

MAX_BYTES = 20 * 10**6
"""Largest number of bytes of a file."""
MAX_UNPACKED = 2 * MAX_BYTES
"""Largest number of bytes that an npz unpacks to."""
MAX_FACES = 500_000
MAX_VERTICES = 3 * MAX_FACES
MAX_POINTS = 1_000_000
ENOUGH_POINTS = 100_000
"""Of a cloud; of more, so many are taken at random."""
MIN_POINTS = 50
MIN_SIZE, MAX_SIZE = 0.01, 1.0
"""Metres, of the largest side of the bounding box."""
UNITS = {"metres": 1.0, "millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
"""Of files, in metres; the first that gives a sensible size is suggested."""
LOST = 0.8
"""Part of the volume that the distances know of, below which it is said that a shape is too thin."""
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb")
CLOUD_SUFFIXES = (".ply", ".npz", ".csv")


class ShapeError(DataError):
    """A file that cannot be used as a shape."""


class SizeError(ShapeError):
    """A shape so large or small that its file must be in another unit.

    Attributes:
        unit: one of `UNITS` in which its size would be sensible, if there is one.
        sizes: of its bounding box, in the file's unit.
    """

    unit: str | None = None
    sizes: tuple[float, ...] = ()

    @property
    def question(self) -> str | None:
        """What to ask about it, if another unit would do."""
        if self.unit is None:
            return None
        box = " × ".join(f"{size:.4g}" for size in self.sizes)
        return f"{self.source} seems to be in {self.unit}: {box} units. Read it in {self.unit}?"


@dataclass(frozen=True)
class LoadedMesh:
    """A closed mesh, ready to be an obstacle."""

    solid: Solid
    name: str
    notes: tuple[str, ...] = ()
    """What was mended, and what is not to be trusted, in words for the page."""


@dataclass(frozen=True)
class LoadedCloud:
    """A point cloud, ready to be an obstacle."""

    cloud: Cloud
    name: str
    notes: tuple[str, ...] = ()
    """What was left out, in words for the page."""


def load_mesh(path: str | Path, *, scale: float = 1.0) -> LoadedMesh:
    """Read a closed mesh from a file.

    Args:
        path: of an STL, OBJ, PLY or GLB file.
        scale: metres for one unit of the file.

    Raises:
        ShapeError: there is no such file, it cannot be read, is not what its suffix says, or holds no closed mesh of
            a sensible size. Nothing else is raised, whatever the file holds.
    """
    return read_mesh(_content(Path(path)), path, scale=scale)


def read_mesh(content: bytes, source: str | Path, *, scale: float = 1.0) -> LoadedMesh:
    """Read a closed mesh from the bytes of a file, such as one uploaded from the browser.

    Args:
        content: all bytes of the file.
        source: its name or path; the suffix says what it is.
        scale: metres for one unit of the file.

    Raises:
        ShapeError: as :func:`load_mesh`.
    """
    source = Path(source)
    suffix = _checked_suffix(content, source, MESH_SUFFIXES, scale)
    with parsing(ShapeError, source, "file", f"a {suffix} file of a mesh"):
        vertices, faces = _triangles(content, suffix)
    checkpoint()
    if not len(faces):
        raise ShapeError(source, "faces", "none", "a closed mesh of triangles; a point cloud is loaded as a cloud")
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise ShapeError(source, "faces", f"vertex {wrong}", f"indices of the {len(vertices)} vertices")
    _check_finite(vertices, source, "vertices", "vertex")
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    vertices = _checked_size(vertices, vertices[used], source, scale)
    with parsing(ShapeError, source, "mesh", "a closed mesh"):
        mesh = closed(vertices, faces)
        solid = Solid(mesh.vertices, mesh.faces)
        checkpoint()
        grid = solid.distances
    checkpoint()
    if not grid.depth > 0:
        found = f"walls thinner than {1e3 * grid.cell:.1f} mm, which leave nothing inside"
        raise ShapeError(source, "thickness", found, f"a solid thicker than about {2e3 * grid.cell:.0f} mm")
    notes = mesh.notes
    if grid.cell**3 * len(grid.interior) < LOST * mesh.volume:
        notes += (f"parts thinner than about {2e3 * grid.cell:.0f} mm are rounded away from its distances",)
    return LoadedMesh(solid, source.stem, notes)


def load_cloud(path: str | Path, *, scale: float = 1.0) -> LoadedCloud:
    """Read a point cloud from a file.

    Args:
        path: of a PLY, npz or CSV file, see the module's docstring.
        scale: metres for one unit of the file.

    Raises:
        ShapeError: there is no such file, it cannot be read, is not what its suffix says, or holds no points that
            make a solid of a sensible size. Nothing else is raised, whatever the file holds.
    """
    return read_cloud(_content(Path(path)), path, scale=scale)


def read_cloud(content: bytes, source: str | Path, *, scale: float = 1.0) -> LoadedCloud:
    """Read a point cloud from the bytes of a file, such as one uploaded from the browser.

    Args:
        content: all bytes of the file.
        source: its name or path; the suffix says what it is.
        scale: metres for one unit of the file.

    Raises:
        ShapeError: as :func:`load_cloud`.
    """
    source = Path(source)
    suffix = _checked_suffix(content, source, CLOUD_SUFFIXES, scale)
    with parsing(ShapeError, source, "file", f"a {suffix} file of points"):
        points, labels = {".ply": _ply_points, ".npz": _npz_points, ".csv": _csv_points}[suffix](content)
    checkpoint()
    if len(points) < MIN_POINTS:
        raise ShapeError(source, "points", f"{len(points)}", f"at least {MIN_POINTS}")
    if len(points) > MAX_POINTS:
        raise ShapeError(source, "points", f"{len(points)}", f"at most {MAX_POINTS}")
    _check_finite(points, source, "points", "point")
    if labels is not None:
        _check_labels(labels, source)
    occupied = points if labels is None else points[labels > 0.5]
    if len(occupied) < MIN_POINTS:
        raise ShapeError(source, "labels", f"{len(occupied)} occupied points", f"at least {MIN_POINTS}")
    points, notes = _checked_size(points, occupied, source, scale), []
    if len(points) > ENOUGH_POINTS:
        some = np.sort(np.random.default_rng(0).permutation(len(points))[:ENOUGH_POINTS])
        notes.append(f"{ENOUGH_POINTS} of its {len(points)} points are used, chosen at random")
        points, labels = points[some], None if labels is None else labels[some]
    if labels is None:  # a search among very many points in one place takes the square of their number
        points = np.unique(points, axis=0)
        if len(points) < MIN_POINTS:
            raise ShapeError(source, "points", f"{len(points)} different ones", f"at least {MIN_POINTS}")
    cloud = Cloud(points, labels)
    checkpoint()
    with parsing(ShapeError, source, "points", "points that something occupies"):
        depth = cloud.solid.distances.depth
    if not depth > 0:
        raise ShapeError(source, "points", "nothing that has an inside", "points that something occupies")
    return LoadedCloud(cloud, source.stem, tuple(notes))


def _content(path: Path) -> bytes:
    try:
        if not path.is_file():
            raise ShapeError(path, "path", "no such file", "a readable file")
        if (size := path.stat().st_size) > MAX_BYTES:
            raise ShapeError(path, "file", f"{size / 1e6:.1f} MB", f"at most {MAX_BYTES / 1e6:.0f} MB")
        return path.read_bytes()
    except OSError as error:
        found = f"nothing that can be read ({error.strerror or error})"
        raise ShapeError(path, "path", found, "a readable file") from error


def _checked_suffix(content: bytes, source: Path, accepted: tuple[str, ...], scale: float) -> str:
    suffix = source.suffix.lower()
    if suffix not in accepted:
        raise ShapeError(source, "suffix", repr(suffix) if suffix else "no suffix", ", ".join(accepted))
    if len(content) > MAX_BYTES:
        raise ShapeError(source, "file", f"{len(content) / 1e6:.1f} MB", f"at most {MAX_BYTES / 1e6:.0f} MB")
    if not content:
        raise ShapeError(source, "file", "an empty file", "at least one shape")
    if not (np.isfinite(scale) and scale > 0):
        raise ShapeError(source, "scale", f"{scale}", "metres for one unit of the file, above 0")
    return suffix


def _check_finite(points: Array, source: Path, field: str, one: str) -> None:
    if not np.isfinite(points).all():
        row, column = np.argwhere(~np.isfinite(points))[0]
        raise ShapeError(source, field, f"{points[row, column]} in {one} {row + 1}", "finite numbers")


def _checked_size(points: Array, shape: Array, source: Path, scale: float) -> Array:
    """Points in metres, the middle of the shape's bounding box at 0."""
    with np.errstate(over="ignore"):
        lower, upper = shape.min(axis=0), shape.max(axis=0)
        sizes = upper - lower
        box = scale * sizes
    if not MIN_SIZE <= box.max() <= MAX_SIZE:
        fitting = [unit for unit, metres in UNITS.items() if MIN_SIZE <= metres * sizes.max() <= MAX_SIZE]
        found = f"a bounding box of {_box(box)}"
        if fitting:
            metres = UNITS[fitting[0]]
            found += f"; is the file in {fitting[0]} (scale={metres:g})? then that is {_box(metres * sizes)}"
        accepted = f"a largest side of {MIN_SIZE:g} m to {MAX_SIZE:g} m, after scaling"
        error = SizeError(source, "size", found, accepted)
        error.unit = fitting[0] if fitting else None
        error.sizes = tuple(sizes.tolist())
        raise error
    return (points - (lower + upper) / 2) * scale


def _box(sizes: Array) -> str:
    return " × ".join(f"{size:.4g}" for size in sizes) + " m"


def _check_labels(labels: Array, source: Path) -> None:
    wrong = np.flatnonzero((labels != 0) & (labels != 1))
    if len(wrong):
        found = f"{labels[wrong[0]]:g} for point {wrong[0] + 1}"
        raise ShapeError(source, "labels", found, "1 for occupied and 0 for free")
    if (labels == labels[0]).all():
        kind = "occupied" if labels[0] else "free"
        raise ShapeError(source, "labels", f"all {len(labels)} points {kind}", "both kinds, or no labels")


def _triangles(content: bytes, suffix: str) -> tuple[Array, Indices]:
    """Vertices (V, 3) and faces (F, 3) of all parts of a file."""
    if suffix == ".stl":
        return read_stl(content, max_triangles=MAX_FACES)
    if suffix == ".obj":
        return read_obj(content, max_vertices=MAX_VERTICES, max_triangles=MAX_FACES)
    if suffix == ".glb":
        return read_glb(content, max_vertices=MAX_VERTICES, max_triangles=MAX_FACES)
    ply = read_ply(content, max_vertices=MAX_VERTICES, max_triangles=MAX_FACES)
    return ply.vertices, ply.faces


def _ply_points(content: bytes) -> tuple[Array, Array | None]:
    ply = read_ply(content, max_vertices=MAX_POINTS, max_triangles=MAX_FACES)
    return ply.vertices, ply.labels


def _npz_points(content: bytes) -> tuple[Array, Array | None]:
    archive = NpzFile(content, max_bytes=MAX_UNPACKED)
    if "points" not in archive.names:
        found = ", ".join(archive.names)[:80] or "none"
        raise FormatError("arrays", found, "'points' and optionally 'labels'")
    points, labels = archive.read("points"), archive.read("labels") if "labels" in archive.names else None
    for name, values in (("points", points), ("labels", labels)):
        if values is not None and values.dtype.kind not in "biuf":
            raise FormatError(f"array {name!r}", f"values of type {values.dtype}", "integers or real numbers")
    if points.ndim != 2 or points.shape[1] != 3:
        raise FormatError("array 'points'", f"shape {points.shape}", "shape (K, 3)")
    if labels is not None and labels.shape != (len(points),):
        raise FormatError("array 'labels'", f"shape {labels.shape}", f"shape ({len(points)},)")
    return points.astype(float), None if labels is None else labels.astype(float)


def _csv_points(content: bytes) -> tuple[Array, Array | None]:
    header, rows = read_table(content, (("x", "y", "z"), ("x", "y", "z", "occupied")), max_rows=MAX_POINTS)
    numbers = array("d")
    for line, row in rows:
        try:
            numbers.extend(map(float, row))
        except ValueError as error:
            raise FormatError(f"line {line}", repr(",".join(row)[:60]), "decimal numbers") from error
    values = np.asarray(numbers).reshape(-1, len(header))
    return values[:, :3], values[:, 3] if len(header) == 4 else None
