"""Readers of meshes and point clouds by trimesh and numpy, for the process of `dt_viz.files.reading`.

They are meant for a process with limits: on hostile bytes they raise anything, run long, need memory or crash.
"""

from __future__ import annotations

import csv
import io
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from trimesh.exchange.ply import load_ply

from dt_viz.errors import FormatError
from dt_viz.files.checks import MAX_FACES, check_at_most, check_finite, check_triangles, real_numbers, too_many
from dt_viz.files.npz import arrays_of
from dt_viz.files.repair import repaired
from dt_viz.numerics import Array, Indices


@dataclass(frozen=True)
class ShapeLimits:
    """The largest files; those of text take a hundred bytes and more for each line while they are read."""

    vertices: int = 3 * MAX_FACES
    points: int = 1_000_000
    lines: int = 2_000_000
    unpacked: int = 40 * 10**6  # bytes that an archive of points unpacks to
    model: int = 200 * 10**6  # bytes that a 3MF file, which is text in an archive, unpacks to


LIMITS = ShapeLimits()
LABELS = ("occupied", "occupancy", "label", "labels")  # names of the labels in a file of points
TEXTS = (".obj", ".off", ".csv", ".stl", ".ply", ".gltf")  # suffixes of what is text, or may be
EXTENSIONS = (b"KHR_draco_mesh_compression", b"EXT_meshopt_compression", b"EXT_mesh_gpu_instancing")
"""Extensions of glTF files that change triangles, and are not read."""

Files = Sequence[tuple[str, bytes]]  # names and contents
Columns = tuple[np.ndarray, np.ndarray | None, tuple[str, ...]]
"""Points, labels and notes of `Points`, of any type."""


@dataclass(frozen=True)
class Triangles:
    """A mesh that was read and repaired."""

    vertices: Array  # (V, 3)
    faces: Indices  # (F, 3), indices of vertices
    notes: tuple[str, ...]  # what was repaired, for the page


@dataclass(frozen=True)
class Points:
    """A point cloud that was read."""

    points: Array  # (K, 3)
    labels: Array | None  # (K,) 1 occupied and 0 free; None where there are none
    notes: tuple[str, ...]  # what was left out, for the page


def read_triangles(files: Files) -> Triangles:
    """Read the vertices and triangles of a file, all parts in their places, and repair them.

    Raises:
        FormatError: it has no triangles, or too many.
        Exception: of any kind, on hostile bytes.
    """
    content, suffix = _opened(files)
    vertices, faces = _triangles(content, suffix)
    if not len(faces):
        accepted = f"a complete {suffix} file of a closed mesh; a point cloud is loaded as a cloud"
        raise FormatError("faces", "none that could be read", accepted)
    check_triangles(vertices, faces)
    return Triangles(*repaired(vertices, faces))


def read_points(files: Files) -> Points:
    """Read the points of a file and, where it has them, their labels.

    Raises:
        FormatError: it has no points, or too many.
        Exception: of any kind, on hostile bytes.
    """
    content, suffix = _opened(files)
    points, labels, notes = {".npz": _npz_points, ".csv": _csv_points, ".ply": _ply_points}[suffix](content)
    check_at_most("points", len(points), LIMITS.points)
    points = real_numbers(points, "points", "biuf")
    check_finite(np.atleast_2d(points), "points", lambda row: f"in point {row + 1}")
    if labels is not None:
        labels = real_numbers(labels, "labels", "biuf")
        check_finite(labels.reshape(-1, 1), "labels", lambda row: f"of point {row + 1}")
    return Points(points, labels, notes)


def _opened(files: Files) -> tuple[bytes, str]:
    """Return the content and the suffix of a file. Raises FormatError if it would need too much, or an extension."""
    ((name, content),) = files
    suffix = Path(name).suffix.lower()
    if suffix in TEXTS and content.count(b"\n") > LIMITS.lines:
        raise too_many("file", LIMITS.lines, "lines")
    if suffix == ".3mf":
        arrays_of(content, max_bytes=LIMITS.model, names=())
    if suffix == ".gltf":
        json.loads(content)  # trimesh would look for another file
    if suffix in (".glb", ".gltf"):
        _, found, required = content.partition(b'"extensionsRequired"')
        for extension in EXTENSIONS:
            if found and extension in required:
                raise FormatError(
                    "JSON", f"the extension {extension.decode()}", "plain triangles (no Draco, no meshopt)"
                )
    return content, suffix


class _OtherFiles:
    """What trimesh asks for the files that a file names."""

    def get(self, name: str) -> bytes:
        """Refuse a file."""
        raise FormatError("file", f"data in another file, {name[:40]!r}", "a file that holds all its data")

    __getitem__ = get


def _triangles(content: bytes, suffix: str) -> tuple[Array, Indices]:
    """Read all parts of a scene; what they add up to is counted before: a few bytes can place a mesh very often."""
    alone: Any = _OtherFiles()
    file = io.BytesIO(content)
    loaded = trimesh.load(file, file_type=suffix[1:], resolver=alone, process=False, skip_materials=True)
    scene = loaded if isinstance(loaded, trimesh.Scene) else trimesh.Scene(loaded)
    parts = []
    num_vertices = num_faces = 0
    for node in scene.graph.nodes_geometry:
        place, name = scene.graph[node]
        part = scene.geometry[name]
        if isinstance(part, trimesh.Trimesh):
            num_vertices, num_faces = num_vertices + len(part.vertices), num_faces + len(part.faces)
            if num_faces > MAX_FACES:
                raise too_many("faces", MAX_FACES, "of all parts")
            if num_vertices > LIMITS.vertices:
                raise too_many("vertices", LIMITS.vertices, "of all parts")
            parts.append((part, place))
    vertices, faces, first = [np.empty((0, 3))], [np.empty((0, 3), dtype=np.int64)], 0
    for part, place in parts:
        vertices.append(trimesh.transform_points(part.vertices, place))
        faces.append(first + (part.faces[:, ::-1] if np.linalg.det(place[:3, :3]) < 0 else part.faces))
        first += len(part.vertices)
    return np.concatenate(vertices), np.concatenate(faces)


def _npz_points(content: bytes) -> Columns:
    arrays = arrays_of(content, max_bytes=LIMITS.unpacked, names=("points", "labels"))
    if "points" not in arrays:
        raise FormatError("arrays", "no 'points'", "'points' and optionally 'labels'")
    return arrays["points"], arrays.get("labels"), ()


def _csv_points(content: bytes) -> Columns:
    first, _, rows = content.decode("utf-8-sig").partition("\n")
    header = [name.strip().lower() for name in next(csv.reader([first]), [])]
    wanted = ["x", "y", "z", *(name for name in LABELS if name in header)][:4]
    if not set(wanted) <= set(header):
        raise FormatError("header line", repr(",".join(header)[:80]), "'x,y,z' or 'x,y,z,occupied', in any order")
    if not rows.strip():  # numpy would warn
        raise FormatError("points", "0", "one line per point")
    columns, most = [header.index(name) for name in wanted], LIMITS.points + 1
    table = np.loadtxt(io.StringIO(rows), delimiter=",", usecols=columns, ndmin=2, max_rows=most, comments=None)
    others = [name for name in header if name not in wanted]
    notes = (f"columns {', '.join(others)[:80]} are not used",) if others else ()
    return table[:, :3], table[:, 3] if len(wanted) > 3 else None, notes


def _ply_points(content: bytes) -> Columns:
    vertex = load_ply(io.BytesIO(content), skip_materials=True)["metadata"]["_ply_raw"]["vertex"]
    columns = vertex["data"] if vertex["length"] else dict.fromkeys("xyz", np.empty(0))
    points = np.stack([np.ravel(columns[axis]) for axis in "xyz"], axis=1)
    label = next((name for name in LABELS if name in vertex["properties"]), None)
    return points, None if label is None else np.ravel(columns[label]), ()
