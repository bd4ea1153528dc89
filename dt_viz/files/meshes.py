"""Readers of the triangles in STL and OBJ files. Materials and pictures are ignored; no other file is read."""

from __future__ import annotations

import itertools
import struct
from array import array

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, too_many
from dt_viz.files.text import MAX_LENGTH, numbered_lines
from dt_viz.flows.fields import Array, Indices

STL_HEADER = 84
"""Number of bytes before the first triangle of a binary STL file; the last four are the number of triangles."""
STL_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(content: bytes, *, max_triangles: int) -> tuple[Array, Indices]:
    """Read vertices (V, 3), three for each triangle, and triangles (F, 3) of an STL file, binary or text.

    Raises:
        FormatError: it is no complete STL file, or has more triangles than that.
    """
    count = struct.unpack_from("<I", content, STL_HEADER - 4)[0] if len(content) >= STL_HEADER else 0
    size = STL_HEADER + STL_TRIANGLE.itemsize * count
    is_text = content.lstrip()[:5].lower() == b"solid" and b"facet" in content and len(content) != size
    if is_text:
        corners = _stl_text(content, max_triangles)
    else:
        if len(content) < STL_HEADER:
            found = f"{len(content)} bytes"
            raise FormatError("file", found, f"a complete STL file, with a header of {STL_HEADER} bytes")
        check_at_most("faces", count, max_triangles)
        if len(content) < size:
            found = f"{len(content)} bytes for {count} triangles"
            raise FormatError("file", found, f"a complete STL file, {size} bytes")
        triangles = np.frombuffer(content, STL_TRIANGLE, count, STL_HEADER)
        corners = triangles["corners"].reshape(-1, 3).astype(float)
    return corners, np.arange(len(corners)).reshape(-1, 3)


def _stl_text(content: bytes, max_triangles: int) -> Array:
    """Read the corners (3F, 3)."""
    corners, ended, num_facets = array("d"), False, 0
    for number, line in numbered_lines(content, errors="replace"):
        words = line.lower().split()
        if words[:1] == ["vertex"]:
            corners.extend(_coordinates(words[1:4], number))
        elif words[:1] == ["endfacet"]:
            num_facets += 1
            check_at_most("faces", num_facets, max_triangles)
            if len(corners) != 9 * num_facets:
                raise FormatError(f"line {number}", "a facet without three vertices", "three for each facet")
        elif words:
            ended = words[0] == "endsolid"
    if not ended or len(corners) != 9 * num_facets:
        raise FormatError("file", "text that ends before 'endsolid'", "a complete STL file")
    return np.asarray(corners).reshape(-1, 3)


def read_obj(content: bytes, *, max_vertices: int, max_triangles: int) -> tuple[Array, Indices]:
    """Read vertices (V, 3) and triangles (F, 3) of an OBJ file; polygons are split into fans of triangles.

    Raises:
        FormatError: a vertex or face cannot be read, or there are more vertices or triangles than that.
    """
    vertices, corners, begun = array("d"), array("q"), ""
    for number, text in numbered_lines(content, errors="replace"):
        line, begun = begun + text, ""
        if line.endswith("\\"):  # the line continues on the next one
            if len(line) > MAX_LENGTH:
                raise FormatError(f"line {number}", "a line that goes on and on", f"at most {MAX_LENGTH} characters")
            begun = line[:-1]
            continue
        words = line.split()
        if words[:1] == ["v"]:
            vertices.extend(_coordinates(words[1:4], number))
            if len(vertices) > 3 * max_vertices:
                raise too_many("vertices", max_vertices)
        elif words[:1] == ["f"]:
            polygon = [_obj_index(word, len(vertices) // 3, number) for word in words[1:]]
            if len(polygon) < 3:
                raise FormatError(f"line {number}", repr(line[:60]), "at least three vertices for a face")
            for second, third in itertools.pairwise(polygon[1:]):
                corners.extend((polygon[0], second, third))
            check_at_most("faces", len(corners) // 3, max_triangles)
    return np.asarray(vertices).reshape(-1, 3), np.asarray(corners).reshape(-1, 3)


def _obj_index(word: str, num_vertices: int, line: int) -> int:
    """Return the index, from 0, of a vertex that a face counts from 1, or backwards from −1."""
    try:
        index = int(word.split("/", 1)[0])
    except ValueError as error:
        raise FormatError(f"line {line}", repr(word[:40]), "the number of a vertex") from error
    if index == 0 or abs(index) >= 2**62:
        raise FormatError(f"line {line}", f"vertex {word[:40]}", "numbers from 1, or backwards from -1")
    return index - 1 if index > 0 else num_vertices + index


def _coordinates(words: list[str], line: int) -> list[float]:
    try:
        x, y, z = (float(word) for word in words)
    except ValueError as error:
        raise FormatError(f"line {line}", repr(" ".join(words)[:60]), "three coordinates") from error
    return [x, y, z]
