"""Obstacles' shapes from files of closed meshes and point clouds; see the table in `dt_viz/files/README.md`.

The origin of a shape is moved to the middle of its bounding box. Files are read by a process of their own
(`dt_viz.files.reading`).
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np

from dt_viz.errors import Cancelled, DataError, FormatError, never, parsing
from dt_viz.files.checks import check_triangles, checked_suffix
from dt_viz.files.reading import read_upload
from dt_viz.files.shapes import Points, Triangles
from dt_viz.files.triangles import Distances
from dt_viz.flows.fields import Array
from dt_viz.obstacles.clouds import MAX_POINTS, Cloud, check_points
from dt_viz.obstacles.shapes import SIZE
from dt_viz.obstacles.solids import MEASURE, Solid

MAX_BYTES = 20 * 10**6  # largest number of bytes of a file
MIN_SIZE, MAX_SIZE = SIZE
UNITS = {"metres": 1.0, "millimetres": 1e-3, "centimetres": 1e-2, "inches": 0.0254}
"""Units of files, in metres; the first that gives a sensible size is suggested."""
LOST = 0.8
"""Part of a mesh's volume inside the distance grid below which its thin parts are reported as lost."""
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb", ".gltf", ".off", ".3mf")
CLOUD_SUFFIXES = (".ply", ".npz", ".csv")
MAX_HEADER = 10_000  # number of bytes in which the header of a PLY file ends


class ShapeError(DataError):
    """A file that cannot be used as a shape."""


class SizeError(ShapeError):
    """A shape so large or small that its file must be in another unit.

    Attributes:
        unit: one of `UNITS` in which its size would be sensible, if there is one.
        sizes: sides of its bounding box, in the file's unit.
    """

    unit: str | None = None
    sizes: tuple[float, ...] = ()

    @property
    def question(self) -> str | None:
        """The question whether to read the file in that unit; None if no unit would do."""
        if self.unit is None:
            return None
        box = " × ".join(f"{size:.4g}" for size in self.sizes)
        return f"{self.source} seems to be in {self.unit}: {box} units. Read it in {self.unit}?"


def is_cloud(content: bytes, source: str | Path) -> bool:
    """Return whether a file holds points rather than a mesh, as its suffix or, in a PLY file, its header says."""
    suffix = Path(source).suffix.lower()
    if suffix == ".ply":
        header = content[:MAX_HEADER].partition(b"end_header")[0]
        return re.search(rb"element\s+face\s+0*[1-9]", header) is None
    return suffix in CLOUD_SUFFIXES


@contextmanager
def measured_apart(cancelled: Cancelled) -> Iterator[None]:
    """Within the block have meshes measured by the process that reads files, with the errors of `read_upload`."""
    token = MEASURE.set(partial(read_upload, Distances, cancelled=cancelled))
    try:
        yield
    finally:
        MEASURE.reset(token)


def read_mesh(
    content: bytes, source: str | Path, *, scale: float = 1.0, cancelled: Cancelled = never
) -> tuple[Solid, tuple[str, ...]]:
    """Read a closed mesh from the bytes of a file, whose `source` has the suffix that says what it is.

    One unit of the file is `scale` metres. Returns the solid, and notes for the page on what was repaired and is
    inexact.

    Raises:
        ShapeError: the file is not what its suffix says, or holds no closed mesh of a sensible size. Nothing else is
            raised, whatever the file holds.
        UnwantedError: nobody wants it any more.
    """
    with _reading(content, source, MESH_SUFFIXES, scale) as files, measured_apart(cancelled):
        read = read_upload(Triangles, files, cancelled)
        check_triangles(read.vertices, read.faces)
        used = read.vertices[np.unique(read.faces)]
        solid = Solid(_in_metres(read.vertices, used, source, scale), read.faces)
        grid = solid.distances
        if not grid.depth > 0:
            found = f"walls thinner than {1e3 * grid.cell:.1f} mm, which leave nothing inside"
            raise FormatError("thickness", found, f"a solid thicker than about {2e3 * grid.cell:.0f} mm")
    a, b, c = solid.vertices[solid.faces].swapaxes(0, 1)
    volume = float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6
    lost = grid.cell**3 * len(grid.interior) < LOST * volume
    return solid, read.notes + (f"parts thinner than about {2e3 * grid.cell:.0f} mm are rounded away",) * lost


def read_cloud(
    content: bytes, source: str | Path, *, scale: float = 1.0, cancelled: Cancelled = never
) -> tuple[Cloud, tuple[str, ...]]:
    """Read a point cloud from the bytes of a file; arguments, notes and errors as of :func:`read_mesh`."""
    with _reading(content, source, CLOUD_SUFFIXES, scale) as files, measured_apart(cancelled):
        read = read_upload(Points, files, cancelled)
        points, labels, notes = read.points, read.labels, read.notes
        check_points(points, labels)
        points = _in_metres(points, points if labels is None else points[labels > 0.5], source, scale)
        if len(points) > MAX_POINTS:
            some = np.sort(np.random.default_rng(0).permutation(len(points))[:MAX_POINTS])
            notes += (f"{MAX_POINTS} of its {len(points)} points are used, chosen at random",)
            points, labels = points[some], None if labels is None else labels[some]
        cloud = Cloud(np.unique(points, axis=0) if labels is None else points, labels)
        if not cloud.solid.distances.depth > 0:
            raise FormatError("points", "nothing that has an inside", "points that something occupies")
    return cloud, notes


@contextmanager
def _reading(
    content: bytes, source: str | Path, accepted: tuple[str, ...], scale: float
) -> Iterator[list[tuple[str, bytes]]]:
    """Give the name and the content of a file, and turn all errors into such that name it."""
    name = Path(source).name
    with parsing(ShapeError, source, "file", f"a {Path(source).suffix} file of a shape"):
        if not (np.isfinite(scale) and scale > 0):
            raise FormatError("scale", f"{scale}", "metres for one unit of the file, above 0")
        yield [(f"shape{checked_suffix(len(content), Path(name), accepted, MAX_BYTES)}", content)]


def _in_metres(points: Array, shape: Array, source: str | Path, scale: float) -> Array:
    """Return the points in metres, with the middle of the shape's bounding box at 0."""
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
