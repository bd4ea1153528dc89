"""Shapes of obstacles from files: closed meshes and point clouds, checked.

Meshes, in metres (or scaled to them): STL, OBJ, PLY, GLB. They must be closed; small holes and seams are mended.

Point clouds, in metres (or scaled to them):
    PLY (``.ply``): the vertices, with labels if they have a property ``occupied``, ``occupancy`` or ``label``.
    npz (``.npz``): ``points`` (K, 3), and optionally ``labels`` (K,). Pickled arrays are never opened.
    CSV (``.csv``), UTF-8: a header line ``x,y,z`` or ``x,y,z,occupied`` and one line per point.
    Labels are 1 (occupied) or 0 (free); without them every point is occupied.

A shape's origin is put into the middle of its bounding box.
"""

from __future__ import annotations

import csv
import io
import json
import re
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from dt_viz.clouds import Cloud
from dt_viz.errors import DataError
from dt_viz.fields import Array, Indices
from dt_viz.solids import Solid

MAX_BYTES = 20 * 10**6
"""Of a file, and of what an npz unpacks to."""
MAX_HEADER = 100_000
"""Bytes in which the header of a PLY file ends."""
MAX_FACES = 500_000
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
    """

    unit: str | None = None


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
    _check_counts(content, source, suffix)
    with _parsing(source, "file", f"a mesh in the format that {suffix} stands for"):
        vertices, faces = _triangles(content, source, suffix)
    if not len(faces):
        raise ShapeError(source, "faces", "none", "a closed mesh of triangles; a point cloud is loaded as a cloud")
    if len(faces) > MAX_FACES:
        raise ShapeError(source, "faces", f"{len(faces)}", f"at most {MAX_FACES}")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise ShapeError(source, "faces", f"vertex {faces.max()}", f"indices of the {len(vertices)} vertices")
    _check_finite(vertices, source, "vertices", "vertex")
    vertices = _checked_size(vertices, vertices[faces].reshape(-1, 3), source, scale)
    mesh, notes = _closed(vertices, faces, source)
    with _parsing(source, "mesh", "a closed mesh"):
        solid = Solid(np.asarray(mesh.vertices), np.asarray(mesh.faces))
        grid = solid.distances
    if not grid.depth > 0:
        found = f"walls thinner than {1e3 * grid.cell:.1f} mm, which leave nothing inside"
        raise ShapeError(source, "thickness", found, f"a solid thicker than about {2e3 * grid.cell:.0f} mm")
    if grid.cell**3 * len(grid.interior) < LOST * mesh.volume:
        notes.append(f"parts thinner than about {2e3 * grid.cell:.0f} mm are rounded away from its distances")
    return LoadedMesh(solid, source.stem, tuple(notes))


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
    reader = {".ply": _ply_points, ".npz": _npz_points, ".csv": _csv_points}[suffix]
    points, labels = reader(content, source)
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
    cloud = Cloud(points, labels)
    with _parsing(source, "points", "points that something occupies"):
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


@contextmanager
def _parsing(source: Path, field: str, accepted: str) -> Iterator[None]:
    """Turn whatever a parser raises on hostile bytes into one ShapeError."""
    try:
        with np.errstate(all="ignore"):
            yield
    except ShapeError:
        raise
    except Exception as error:  # no parser lists what corrupt bytes make it raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise ShapeError(source, field, f"something that cannot be read ({reason})", accepted) from error


def _check_finite(points: Array, source: Path, field: str, one: str) -> None:
    if not np.isfinite(points).all():
        row, column = np.argwhere(~np.isfinite(points))[0]
        raise ShapeError(source, field, f"{points[row, column]} in {one} {row + 1}", "finite numbers")


def _checked_size(points: Array, shape: Array, source: Path, scale: float) -> Array:
    """Points in metres, the middle of the shape's bounding box at 0."""
    lower, upper = shape.min(axis=0), shape.max(axis=0)
    sizes = upper - lower
    if not MIN_SIZE <= scale * sizes.max() <= MAX_SIZE:
        fitting = [unit for unit, metres in UNITS.items() if MIN_SIZE <= metres * sizes.max() <= MAX_SIZE]
        found = f"a bounding box of {_box(scale * sizes)}"
        if fitting:
            metres = UNITS[fitting[0]]
            found += f"; is the file in {fitting[0]} (scale={metres:g})? then that is {_box(metres * sizes)}"
        accepted = f"a largest side of {MIN_SIZE:g} m to {MAX_SIZE:g} m, after scaling"
        error = SizeError(source, "size", found, accepted)
        error.unit = fitting[0] if fitting else None
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


def _closed(vertices: Array, faces: Indices, source: Path) -> tuple[trimesh.Trimesh, list[str]]:
    """A closed mesh, outward, and what was done to make it one."""
    with _parsing(source, "mesh", "a closed mesh"):
        mesh, notes = trimesh.Trimesh(vertices, faces, process=False), []
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
        mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces(height=0.0))
        mesh.remove_unreferenced_vertices()
        if len(mesh.faces) and not mesh.is_watertight:
            before = len(mesh.faces)
            mesh.merge_vertices(digits_vertex=int(5 - np.floor(np.log10(mesh.extents.max()))))
            mesh.update_faces(mesh.unique_faces() & mesh.nondegenerate_faces(height=0.0))
            if not mesh.is_watertight:
                mesh.fill_holes()
            if mesh.is_watertight:
                added = len(mesh.faces) - before
                notes.append(f"holes were filled with {added} triangles" if added > 0 else "open seams were closed")
        open_edges = int((np.bincount(mesh.edges_unique_inverse) != 2).sum()) if len(mesh.faces) else 0
        watertight = len(mesh.faces) > 0 and mesh.is_watertight
    if not len(mesh.faces):
        raise ShapeError(source, "faces", "only triangles without area", "a closed mesh of triangles")
    if not watertight:
        found = (
            f"{open_edges} edges that do not join two triangles, also after merging vertices and filling small holes"
        )
        raise ShapeError(source, "mesh", found, "a closed (watertight) mesh; mend it in a mesh editor")
    with _parsing(source, "mesh", "a closed mesh"):
        if not mesh.is_winding_consistent:
            mesh.fix_normals()
            notes.append("triangles that faced inwards were turned")
        if mesh.volume < 0:
            mesh.invert()
        volume, sizes = mesh.volume, mesh.extents
    if volume < 1e-6 * np.prod(sizes):
        raise ShapeError(source, "mesh", f"a volume of {1e6 * volume:.3g} cm³", "a mesh that encloses something")
    return mesh, notes


def _triangles(content: bytes, source: Path, suffix: str) -> tuple[Array, Indices]:
    """Vertices (V, 3) and faces (F, 3) of all parts of a file."""
    options: dict[str, Any] = {"skip_materials": True} if suffix in {".obj", ".glb"} else {}
    loaded = trimesh.load(io.BytesIO(content), file_type=suffix[1:], process=False, **options)
    parts = [(np.eye(4), loaded)]
    if isinstance(loaded, trimesh.Scene):
        placed = (loaded.graph[node] for node in loaded.graph.nodes_geometry)
        parts = [(place, loaded.geometry[name]) for place, name in placed]
    meshes = [(np.asarray(place), part) for place, part in parts if isinstance(part, trimesh.Trimesh)]
    total = sum(len(part.faces) for _, part in meshes)  # a scene may show one mesh often
    if total > MAX_FACES:
        raise ShapeError(source, "faces", f"{total}", f"at most {MAX_FACES}")
    if not meshes:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.intp)
    first = np.cumsum([0] + [len(part.vertices) for _, part in meshes])
    vertices = [np.asarray(part.vertices, dtype=float) @ place[:3, :3].T + place[:3, 3] for place, part in meshes]
    faces = [np.asarray(part.faces, dtype=np.intp) + k for k, (_, part) in zip(first, meshes, strict=False)]
    return np.concatenate(vertices), np.concatenate(faces).reshape(-1, 3)


def _check_counts(content: bytes, source: Path, suffix: str) -> None:
    """Refuse files whose headers promise more than the file holds, before anyone makes room for it."""
    if suffix == ".stl":
        _check_stl(content, source)
    elif suffix == ".ply":
        _ply_header(content, source)
    elif suffix == ".glb":
        _check_glb(content, source)


def _check_stl(content: bytes, source: Path) -> None:
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content:
        if content.count(b"endfacet") > MAX_FACES:
            raise ShapeError(source, "faces", f"{content.count(b'endfacet')}", f"at most {MAX_FACES}")
        if not re.search(rb"endsolid[^\n]*\s*$", content[-2000:]):
            raise ShapeError(source, "file", "text that ends before 'endsolid'", "a complete STL file")
        return
    if len(content) < 84:
        raise ShapeError(source, "file", f"{len(content)} bytes", "a complete STL file, with a header of 84 bytes")
    (count,) = struct.unpack_from("<I", content, 80)
    if count > MAX_FACES:
        raise ShapeError(source, "faces", f"{count}", f"at most {MAX_FACES}")
    if len(content) < 84 + 50 * count:
        found = f"{len(content)} bytes for {count} triangles"
        raise ShapeError(source, "file", found, f"a complete STL file, {84 + 50 * count} bytes")


PLY_BYTES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "float", "int32", "uint32", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


def _ply_header(content: bytes, source: Path) -> dict[str, int]:
    """How many of each element a PLY file has, after looking whether there is room for them in it."""
    end = re.search(rb"end_header\r?\n", content[:MAX_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise ShapeError(source, "header", "no 'ply' … 'end_header'", "a PLY file")
    counts: dict[str, int] = {}
    smallest, ascii_text, element = 0, False, ""
    for line in content[: end.start()].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            ascii_text = words[1:2] == ["ascii"]
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,15}", words[2]):
                raise ShapeError(source, "header", repr(line[:60]), "'element', a name and how many there are")
            element, counts[words[1]] = words[1], int(words[2])
            smallest += counts[element] if ascii_text else 0  # a line break each
        elif words[:1] == ["property"] and element and not ascii_text:
            size = PLY_BYTES.get(words[2 if words[1:2] == ["list"] else 1] if len(words) > 2 else "")
            if size is None:
                raise ShapeError(source, "header", repr(line[:60]), "properties of a number type that PLY knows")
            smallest += size * counts[element]
    for name, limit in (("vertex", 3 * MAX_FACES), ("face", MAX_FACES)):
        if counts.get(name, 0) > limit:
            raise ShapeError(source, f"element {name}", f"{counts[name]}", f"at most {limit}")
    if len(content) - end.end() < smallest - 1:
        found = f"{len(content) - end.end()} bytes for {', '.join(f'{n} {name}' for name, n in counts.items())}"
        raise ShapeError(source, "file", found, f"a complete PLY file, at least {smallest} bytes after its header")
    return counts


def _check_glb(content: bytes, source: Path) -> None:
    if len(content) < 20 or content[:4] != b"glTF":
        raise ShapeError(source, "header", repr(content[:4]), "'glTF', as GLB files begin")
    version, length, json_length = struct.unpack_from("<III", content, 4)
    if version != 2 or length != len(content) or json_length > len(content) - 20:
        found = f"version {version} and {len(content)} of {length} bytes"
        raise ShapeError(source, "header", found, "a complete GLB file of version 2")
    with _parsing(source, "JSON", "a glTF scene"):
        scene = json.loads(content[20 : 20 + json_length])
        accessors, nodes = scene.get("accessors", []), scene.get("nodes", [])
        counts = [int(accessor["count"]) for accessor in accessors]
        without_data = [k for k, accessor in enumerate(accessors) if "bufferView" not in accessor]
    if without_data:
        found = f"no bufferView in accessor {without_data[0]}"
        raise ShapeError(source, "JSON", found, "accessors with data; compressed (Draco) meshes are not read")
    if max(counts, default=0) > 3 * MAX_FACES or min(counts, default=0) < 0:
        found = f"an accessor with {max(counts, key=abs)} entries"
        raise ShapeError(source, "JSON", found, f"at most {MAX_FACES} triangles")
    if len(nodes) > 10_000:
        raise ShapeError(source, "JSON", f"{len(nodes)} nodes", "at most 10000")


def _ply_points(content: bytes, source: Path) -> tuple[Array, Array | None]:
    counts = _ply_header(content, source)
    with _parsing(source, "file", "a PLY file with vertices x, y, z"):
        loaded: Any = trimesh.load(io.BytesIO(content), file_type="ply", process=False)
        points = np.array(loaded.vertices, dtype=float).reshape(-1, 3)
        data = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
        names = data.dtype.names if isinstance(data, np.ndarray) else data.keys()
        label = next((name for name in ("occupied", "occupancy", "label") if name in (names or ())), None)
        labels = None if label is None else np.asarray(data[label], dtype=float).ravel()
    if len(points) != counts.get("vertex", 0):
        raise ShapeError(source, "vertices", f"{len(points)} of {counts.get('vertex', 0)}", "a complete PLY file")
    return points, labels


def _npz_points(content: bytes, source: Path) -> tuple[Array, Array | None]:
    with _parsing(source, "file", "an npz archive"):
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            size = sum(member.file_size for member in archive.infolist())
        if size > 2 * MAX_BYTES:  # a small archive may unpack to more than the memory holds
            raise ShapeError(source, "file", f"{size / 1e6:.0f} MB when unpacked", f"at most {2e-6 * MAX_BYTES:.0f} MB")
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            names = archive.files
            arrays: dict[str, np.ndarray] = {}
            for name in ("points", "labels"):
                if name in names:
                    with _parsing(source, f"array {name!r}", "plain numbers; pickled objects are never opened"):
                        arrays[name] = np.asarray(archive[name])
    if "points" not in arrays:
        raise ShapeError(source, "arrays", ", ".join(names)[:80] or "none", "'points' and optionally 'labels'")
    for name, array in arrays.items():
        if array.dtype.kind not in "biuf":
            raise ShapeError(source, f"array {name!r}", f"values of type {array.dtype}", "integers or real numbers")
    points, labels = arrays["points"].astype(float), arrays.get("labels")
    if points.ndim != 2 or points.shape[1] != 3:
        raise ShapeError(source, "array 'points'", f"shape {points.shape}", "shape (K, 3)")
    if labels is not None and labels.shape != (len(points),):
        raise ShapeError(source, "array 'labels'", f"shape {labels.shape}", f"shape ({len(points)},)")
    return points, None if labels is None else labels.astype(float)


def _csv_points(content: bytes, source: Path) -> tuple[Array, Array | None]:
    with _parsing(source, "file", "comma-separated text in UTF-8"):
        reader = csv.reader(io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True)
        rows = [(reader.line_num, row) for row in reader if any(row)]
    header = tuple(cell.strip().lower() for cell in rows[0][1]) if rows else ()
    if header not in {("x", "y", "z"), ("x", "y", "z", "occupied")}:
        raise ShapeError(source, "header line", repr(",".join(header)[:80]), "'x,y,z' or 'x,y,z,occupied'")
    values = np.empty((len(rows) - 1, len(header)))
    for k, (line, row) in enumerate(rows[1:]):
        if len(row) != len(header):
            raise ShapeError(source, f"line {line}", f"{len(row)} columns", f"{len(header)}, as in the header")
        try:
            values[k] = [float(cell) for cell in row]
        except ValueError as error:
            raise ShapeError(source, f"line {line}", repr(",".join(row)[:60]), "decimal numbers") from error
    return values[:, :3], values[:, 3] if len(header) == 4 else None
