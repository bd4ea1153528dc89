"""Reader of the triangles in a GLB file (glTF 2.0, binary).

The size of a scene is added up from its description before any array is made: a few kilobytes can place one mesh ten
thousand times. Images, materials, skins and animations are ignored; no other file is read.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, too_many
from dt_viz.flows.fields import Array, Indices

MAX_JSON = 4_000_000
"""Largest number of bytes of the scene's description, which takes some thirty times as many as Python objects."""
MAX_PLACED = 10_000
"""Largest number of nodes, and of the parts that they place."""
MAGIC, JSON_CHUNK, BINARY_CHUNK = b"glTF", b"JSON", b"BIN\0"
COMPONENTS = {5120: "i1", 5121: "u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC3": 3}
TRIANGLES, STRIP, FAN = 4, 5, 6
"""Modes of primitives that have triangles; the others are points and lines."""
HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_mesh_quantization")
"""Prefixes of extensions that do not change triangles."""

Json: TypeAlias = Any


@dataclass(frozen=True)
class _Part:
    """A primitive in one of its places."""

    place: Array
    """(4, 4) transform from its own frame to the scene's."""
    positions: Json
    """Accessor of the vertices."""
    indices: Json | None
    """Accessor of the corners; None where they are the vertices in order."""
    mode: int

    @property
    def num_vertices(self) -> int:
        return self.positions["count"]

    @property
    def num_triangles(self) -> int:
        num = (self.indices or self.positions)["count"]
        return num // 3 if self.mode == TRIANGLES else max(0, num - 2)


def read_glb(content: bytes, *, max_vertices: int, max_triangles: int) -> tuple[Array, Indices]:
    """Read vertices (V, 3) and triangles (F, 3) of the whole scene, each part in its place.

    Args:
        content: all bytes of the file.
        max_vertices: largest number of vertices, all instances counted.
        max_triangles: largest number of triangles, all instances counted.

    Raises:
        FormatError: it is no complete GLB file, shows more than that, or has a part that is packed in another way.
        Exception: of almost any kind, if its description is no scene.
    """
    scene, data = _chunks(content)
    required = [name for name in scene.get("extensionsRequired", []) if not str(name).startswith(HARMLESS)]
    if required:
        raise FormatError("JSON", f"the extension {str(required[0])[:60]}", "plain triangles (no Draco, no meshopt)")
    parts = []
    num_vertices = num_triangles = 0
    for part in _parts(scene):
        num_vertices, num_triangles = num_vertices + part.num_vertices, num_triangles + part.num_triangles
        if num_triangles > max_triangles:
            raise too_many("faces", max_triangles, "of all instances")
        if num_vertices > max_vertices:
            raise too_many("vertices", max_vertices, "of all instances")
        if len(parts) == MAX_PLACED:
            raise too_many("JSON", MAX_PLACED, "parts")
        parts.append(part)
    vertices, faces = np.empty((num_vertices, 3)), np.empty((num_triangles, 3), dtype=np.intp)
    v = f = 0
    for part in parts:
        own = _numbers(scene, data, part.positions, "VEC3")
        corners = _corners(scene, data, part)
        if len(corners) and corners.max() >= len(own):
            raise FormatError("faces", f"vertex {corners.max()}", f"indices of the {len(own)} vertices")
        if np.linalg.det(part.place[:3, :3]) < 0:  # mirrored: outward stays outward
            corners = corners[:, ::-1]
        vertices[v : v + len(own)] = own @ part.place[:3, :3].T + part.place[:3, 3]
        faces[f : f + len(corners)] = corners + v
        v, f = v + len(own), f + len(corners)
    return vertices, faces


def _chunks(content: bytes) -> tuple[Json, memoryview]:
    """Return the description of the scene and its binary data."""
    if len(content) < 20 or content[:4] != MAGIC:
        raise FormatError("header", repr(content[:4]), "'glTF', as GLB files begin")
    version, length, json_length = struct.unpack_from("<III", content, 4)
    if version != 2 or length != len(content) or json_length > len(content) - 20 or content[16:20] != JSON_CHUNK:
        found = f"version {version} and {len(content)} of {length} bytes"
        raise FormatError("header", found, "a complete GLB file of version 2")
    check_at_most("JSON", json_length, MAX_JSON, "bytes")
    scene = json.loads(content[20 : 20 + json_length])
    if not isinstance(scene, dict):
        raise FormatError("JSON", "no scene", "a glTF scene")
    rest = memoryview(content)[20 + json_length :]
    if len(rest) < 8:
        return scene, rest[:0]
    size = struct.unpack_from("<I", rest)[0]
    if bytes(rest[4:8]) != BINARY_CHUNK or size > len(rest) - 8:
        raise FormatError("binary data", f"{len(rest) - 8} of {size} bytes", "a complete GLB file of version 2")
    return scene, rest[8 : 8 + size]


def _parts(scene: Json) -> Iterator[_Part]:
    """Yield the primitives of triangles in all their places, in the order of the scene, their accessors checked."""
    nodes = scene.get("nodes", [])
    check_at_most("JSON", len(nodes), MAX_PLACED, "nodes")
    if scene.get("scenes"):
        roots = _item(scene, "scenes", scene.get("scene", 0)).get("nodes", [])
    else:
        children = {child for node in nodes for child in node.get("children", [])}
        roots = [k for k in range(len(nodes)) if k not in children]
    todo = [(root, np.eye(4)) for root in reversed(roots)]
    seen = set()
    while todo:
        index, outer = todo.pop()
        if index in seen:
            raise FormatError("JSON", f"node {index} in two places, or inside itself", "a tree of nodes")
        seen.add(index)
        node = _item(scene, "nodes", index)
        place = outer @ _placement(node)
        todo += [(child, place) for child in reversed(node.get("children", []))]
        if "mesh" in node:
            for primitive in _item(scene, "meshes", node["mesh"])["primitives"]:
                mode = primitive.get("mode", TRIANGLES)
                if mode in (TRIANGLES, STRIP, FAN):
                    positions = _accessor(scene, primitive["attributes"]["POSITION"])
                    indices = _accessor(scene, primitive["indices"]) if "indices" in primitive else None
                    yield _Part(place, positions, indices, mode)


def _item(scene: Json, kind: str, index: Json) -> Json:
    items = scene.get(kind, [])
    if not isinstance(items, list) or type(index) is not int or not 0 <= index < len(items):
        raise FormatError("JSON", f"no {kind}[{str(index)[:20]}]", "indices of what the file holds")
    return items[index]


def _count(owner: Json, name: str) -> int:
    number = owner.get(name, 0)
    if type(number) is not int or number < 0:
        raise FormatError("JSON", f"{name} {str(number)[:20]}", "a whole number, 0 or more")
    return number


def _accessor(scene: Json, index: Json) -> Json:
    accessor = _item(scene, "accessors", index)
    _count(accessor, "count")
    if "sparse" in accessor or "bufferView" not in accessor:
        found = f"{'sparse data' if 'sparse' in accessor else 'no bufferView'} in accessor {index}"
        raise FormatError("JSON", found, "accessors with data of their own; compressed (Draco) meshes are not read")
    return accessor


def _placement(node: Json) -> Array:
    """Return the transform (4, 4) from the frame of a node to that of its parent."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=float).reshape(4, 4).T  # columns come first in the file
    turn = Rotation.from_quat(np.array(node.get("rotation", (0, 0, 0, 1)), dtype=float).reshape(4)).as_matrix()
    place = np.eye(4)
    place[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=float).reshape(3)
    place[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=float).reshape(3)
    return place


def _numbers(scene: Json, data: memoryview, accessor: Json, kind: str) -> Array:
    """Return the numbers (count, width) of an accessor: positions as float64, indices in their own type."""
    component, width = COMPONENTS.get(accessor.get("componentType")), WIDTHS[kind]
    if component is None or accessor.get("type") != kind or (kind == "SCALAR" and component[-2] != "u"):
        found = f"{str(accessor.get('type'))[:20]} of type {str(accessor.get('componentType'))[:20]}"
        raise FormatError("JSON", found, "positions as VEC3, indices as SCALAR of unsigned integers")
    view = _item(scene, "bufferViews", accessor["bufferView"])
    if _count(view, "buffer") or "uri" in _item(scene, "buffers", 0):
        raise FormatError("JSON", "data in another file", "a GLB file that holds all its data")
    dtype, count = np.dtype(component), _count(accessor, "count")
    size = width * dtype.itemsize
    stride = _count(view, "byteStride") or size
    start, end = _count(view, "byteOffset"), _count(view, "byteOffset") + _count(view, "byteLength")
    first = start + _count(accessor, "byteOffset")
    if end > len(data) or first + (stride * (count - 1) + size if count else 0) > end:
        found = f"{count} entries in a view of {_count(view, 'byteLength')} bytes, of {len(data)} in all"
        raise FormatError("JSON", found, "accessors that lie in the binary data of the file")
    values = np.ndarray((count, width), dtype, data, first, (stride, dtype.itemsize))
    if kind == "SCALAR":
        return values
    limit = np.iinfo(dtype).max if accessor.get("normalized") is True and dtype.kind in "iu" else 1
    return np.maximum(values / limit, -1) if limit > 1 else values.astype(float)


def _corners(scene: Json, data: memoryview, part: _Part) -> Indices:
    """Return the triangles (F, 3) of a part as indices of its own vertices."""
    if part.indices is None:
        order = np.arange(part.num_vertices)
    else:
        order = _numbers(scene, data, part.indices, "SCALAR")[:, 0].astype(np.intp)
    if part.mode == TRIANGLES:
        return order[: 3 * part.num_triangles].reshape(-1, 3)
    k = np.arange(part.num_triangles)
    if part.mode == FAN:
        return np.stack([order[k * 0], order[k + 1], order[k + 2]], axis=1)
    odd = k % 2  # every other triangle of a strip is turned round
    return np.stack([order[k], order[k + 1 + odd], order[k + 2 - odd]], axis=1)
