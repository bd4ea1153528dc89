"""Reader of the vertices, triangles and labels of a PLY file, text or binary; everything else is skipped."""

from __future__ import annotations

import re
import struct
from array import array
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, too_many
from dt_viz.files.text import numbered_lines
from dt_viz.flows.fields import Array, Indices

MAX_HEADER = 100_000
"""Largest number of bytes of the header."""
MAX_PROPERTIES = 100
"""Largest number of properties, of all elements together."""
MAX_OTHERS = 1_000_000
"""Largest number of instances of an element that is skipped."""
TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
"""Types of PLY in numpy's notation."""
FORMATS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
"""Byte order of each format; empty for text."""
CORNERS, LABELS = ("vertex_indices", "vertex_index"), ("occupied", "occupancy", "label")
"""Accepted names of the property with a face's corners, and of that with a vertex's label."""


@dataclass(frozen=True)
class Ply:
    """The content of a PLY file."""

    vertices: Array
    """(V, 3) in the file's unit."""
    faces: Indices
    """(F, 3) triangles; polygons are split into fans. Their indices are those of the file and may be wrong."""
    labels: Array | None
    """(V,) values of the first property of the vertices that has a name of `LABELS`."""


@dataclass(frozen=True)
class _Property:
    name: str
    kind: str
    """Type of its numbers in numpy's notation."""
    count: str = ""
    """Type of a list's length; empty for a single number."""


@dataclass
class _Element:
    name: str
    num: int
    properties: list[_Property] = field(default_factory=list)

    @property
    def wanted(self) -> tuple[str, ...]:
        """Names of the properties that are read."""
        names = [p.name for p in self.properties]
        if self.name == "vertex":
            return ("x", "y", "z", *[name for name in LABELS if name in names][:1])
        if self.name == "face":
            lists = [p.name for p in self.properties if p.count]
            return tuple([name for name in CORNERS if name in lists] or lists)[:1]
        return ()


Columns = Mapping[str, "Array | _Lists"]


@dataclass(frozen=True)
class _Lists:
    """Lists of whole numbers, one after the other."""

    lengths: Indices
    numbers: Indices


def read_ply(content: bytes, *, max_vertices: int, max_triangles: int) -> Ply:
    """Read a PLY file.

    Raises:
        FormatError: it is no complete PLY file; its header announces more than the file holds or than is allowed, which
            is found before memory is taken; or a vertex lacks one of the coordinates x, y and z.
    """
    order, elements, body = _header(content)
    limits = {"vertex": max_vertices, "face": max_triangles}
    for element in elements:
        check_at_most(f"element {element.name[:40]}", element.num, limits.get(element.name, MAX_OTHERS))
    _check_room(elements, order, len(content) - body)
    read = _text_columns(content[body:], elements) if not order else _binary_columns(content, body, elements, order)
    columns = dict(read)
    vertex = columns.get("vertex", {})
    if not vertex:
        return Ply(np.empty((0, 3)), np.empty((0, 3), dtype=np.intp), None)
    vertices = np.stack([np.asarray(vertex[axis], dtype=float) for axis in "xyz"], axis=1)
    labels = [np.asarray(vertex[name], dtype=float) for name in LABELS if name in vertex]
    corners = [lists for lists in columns.get("face", {}).values() if isinstance(lists, _Lists)]
    faces = _fans(corners[0], max_triangles) if corners else np.empty((0, 3), dtype=np.intp)
    return Ply(vertices, faces, labels[0] if labels else None)


def _header(content: bytes) -> tuple[str, list[_Element], int]:
    """Return the byte order, the elements, and the position after the header."""
    end = re.search(rb"end_header[ \t]*\r?\n", content[:MAX_HEADER])
    if not content.startswith(b"ply") or end is None:
        raise FormatError("header", "no 'ply' … 'end_header'", "a PLY file")
    order, elements, num_properties = None, [], 0
    for line in content[: end.start()].decode("ascii", errors="replace").splitlines():
        words = line.split()
        if words[:1] == ["format"]:
            order = FORMATS.get(words[1]) if len(words) == 3 else None
        elif words[:1] == ["element"]:
            if len(words) != 3 or not re.fullmatch(r"[0-9]{1,15}", words[2]):
                raise FormatError("header", repr(line[:60]), "'element', a name and how many there are")
            if words[1] in [element.name for element in elements]:
                raise FormatError("header", f"element {words[1][:40]} twice", "each element once")
            elements.append(_Element(words[1], int(words[2])))
        elif words[:1] == ["property"] and elements:
            num_properties += 1
            if num_properties > MAX_PROPERTIES:
                raise too_many("header", MAX_PROPERTIES, "properties")
            elements[-1].properties.append(_property(words, line))
    if order is None:
        raise FormatError("header", "no format that is known", f"one of {', '.join(FORMATS)}")
    for element in elements:
        missing = [name for name in element.wanted if name not in {p.name for p in element.properties}]
        if missing and element.num:
            raise FormatError(f"element {element.name}", f"no property {missing[0]}", "vertices with x, y and z")
    return order, elements, end.end()


def _property(words: list[str], line: str) -> _Property:
    is_list = words[1:2] == ["list"]
    kinds, name = words[2:4] if is_list else words[1:2], words[-1]
    if len(words) != (5 if is_list else 3) or any(kind not in TYPES for kind in kinds):
        raise FormatError("header", repr(line[:60]), "properties of a number type that PLY knows")
    *count, kind = (TYPES[kind] for kind in kinds)
    if count and count[0].startswith("f"):
        raise FormatError("header", repr(line[:60]), "lists whose length is a whole number")
    return _Property(name, kind, *count)


def _check_room(elements: list[_Element], order: str, left: int) -> None:
    smallest = 0
    for element in elements:
        each = sum(np.dtype(p.count or p.kind).itemsize for p in element.properties) if order else 1  # a line break
        smallest += element.num * each
    if left < smallest - 1:
        found = f"{left} bytes for {', '.join(f'{element.num} {element.name[:40]}' for element in elements)}"
        raise FormatError("file", found, f"a complete PLY file, at least {smallest} bytes after its header")


def _fans(corners: _Lists, max_triangles: int) -> Indices:
    """Split polygons into triangles (F, 3); those with fewer than three corners have none."""
    num = np.maximum(corners.lengths - 2, 0)
    check_at_most("faces", num.sum(), max_triangles, "triangles")
    first = np.repeat(np.cumsum(corners.lengths) - corners.lengths, num)
    second = first + 1 + np.arange(num.sum()) - np.repeat(np.cumsum(num) - num, num)
    return np.stack([corners.numbers[first], corners.numbers[second], corners.numbers[second + 1]], axis=1)


def _text_columns(body: bytes, elements: list[_Element]) -> Iterator[tuple[str, Columns]]:
    lines = numbered_lines(body, errors="replace")
    for element in elements:
        names, wanted = [p.name for p in element.properties], element.wanted
        has_lists = any(p.count for p in element.properties)
        places = [] if has_lists else [names.index(name) for name in wanted]
        numbers, lengths = array("d"), array("q")
        for _ in range(element.num):
            number, line = next(lines, (0, ""))
            if not number:
                raise FormatError("file", f"an end before all of its {element.name[:40]} elements", "a complete file")
            words = line.split()
            try:
                if has_lists:
                    for cells in _text_cells(element.properties, wanted, words):
                        numbers.extend(map(float, cells))
                        lengths.append(len(cells))
                else:
                    numbers.extend([float(words[place]) for place in places])
            except (ValueError, IndexError) as error:
                raise FormatError(f"line {number} after the header", repr(line[:60]), "numbers") from error
        values = np.asarray(numbers)
        if element.name == "face":
            yield element.name, {name: _Lists(np.asarray(lengths), _whole(values)) for name in wanted}
        elif wanted and element.num:
            yield element.name, dict(zip(wanted, values.reshape(element.num, -1).T, strict=True))


def _text_cells(properties: list[_Property], wanted: tuple[str, ...], words: list[str]) -> Iterator[list[str]]:
    """Yield the cells of an element's wanted properties, given the words of its line."""
    at = 0
    for p in properties:
        num = 1
        if p.count:
            num, at = int(words[at]), at + 1
        if num < 0 or at + num > len(words):
            raise ValueError("a line that ends too early")
        if p.name in wanted:
            yield words[at : at + num]
        at += num


def _binary_columns(content: bytes, at: int, elements: list[_Element], order: str) -> Iterator[tuple[str, Columns]]:
    for element in elements:
        if not element.num or not element.properties:
            continue
        rows = _equal_rows(content, at, element, order)
        if rows is None:
            at, unequal = _unequal_rows(content, at, element, order)
            yield element.name, unequal
            continue
        at += rows.nbytes
        columns: dict[str, Array | _Lists] = {}
        for name in element.wanted:
            index = [p.name for p in element.properties].index(name)
            values = rows[f"values {index}"]
            if element.name == "face":
                lengths = np.full(len(rows), values.shape[1])
                columns[name] = _Lists(lengths, _whole(values.reshape(-1)))
            else:
                columns[name] = values[:, 0]
        yield element.name, columns


def _whole(numbers: Array) -> Indices:
    whole = numbers.astype(np.intp)
    if (whole != numbers).any():
        raise FormatError("faces", "a number that is not whole", "indices of vertices")
    return whole


def _equal_rows(content: bytes, at: int, element: _Element, order: str) -> np.ndarray | None:
    """Return the rows of an element; None unless each list is as long in every row as in the first."""
    fields: list[tuple] = []
    size = 0
    for k, p in enumerate(element.properties):
        num = 1
        if p.count:
            dtype = np.dtype(order + p.count)
            if at + size + dtype.itemsize > len(content):
                return None
            num = int(np.frombuffer(content, dtype, 1, at + size)[0])
            fields.append((f"count {k}", dtype))
            size += dtype.itemsize
        if not 0 <= num <= len(content):
            return None
        fields.append((f"values {k}", order + p.kind, (num,)))
        size += num * np.dtype(p.kind).itemsize
        if at + size * element.num > len(content):
            return None
    rows = np.frombuffer(content, np.dtype(fields), element.num, at)
    counts = [rows[name] for name, *_ in fields if name.startswith("count")]
    return rows if all((count == count[0]).all() for count in counts) else None


def _unequal_rows(content: bytes, at: int, element: _Element, order: str) -> tuple[int, Columns]:
    """Return the position after an element whose lists differ in length, and its columns."""
    numbers: dict[str, list[bytes]] = {name: [] for name in element.wanted}
    lengths: dict[str, array[int]] = {name: array("q") for name in element.wanted}
    counts = [struct.Struct(order + np.dtype(p.count).char) if p.count else None for p in element.properties]
    sizes = [np.dtype(p.kind).itemsize for p in element.properties]
    for _ in range(element.num):
        for p, count, size in zip(element.properties, counts, sizes, strict=True):
            num = 1
            if count is not None:
                if at + count.size > len(content):
                    break
                num, at = count.unpack_from(content, at)[0], at + count.size
            if num < 0 or at + num * size > len(content):
                break
            if p.name in numbers:
                numbers[p.name].append(content[at : at + num * size])
                lengths[p.name].append(num)
            at += num * size
        else:
            continue
        raise FormatError("file", f"an end before all of its {element.name[:40]} elements", "a complete file")
    columns: dict[str, Array | _Lists] = {}
    for p in element.properties:
        if p.name in numbers:
            values = np.frombuffer(b"".join(numbers[p.name]), order + p.kind)
            if element.name == "face":
                columns[p.name] = _Lists(np.asarray(lengths[p.name]), _whole(values))
            else:
                columns[p.name] = values
    return at, columns
