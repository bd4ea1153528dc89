"""Mending of triangles into one closed surface, outward, where hardly anything has to be invented.

Vertices in the same place are merged, small holes are filled and triangles that face inwards are turned. A large hole
has no unique surface (a bowl is not a half ball), so a mesh with one is refused.
"""

from __future__ import annotations

import itertools
from collections import defaultdict
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Indices, Mask

SAME, NEAR = 1e-8, 1e-5
"""Sizes of the cells in which vertices are merged, always and where the surface would not be closed otherwise, relative
to the largest side of the bounding box."""
MAX_FILLED = 0.02
"""Largest share of filled holes in the closed surface."""
MAX_OPEN_EDGES = 10_000
"""Largest number of edges around holes."""
SMALLEST_VOLUME = 1e-6
"""Smallest part of its bounding box that a solid fills."""
MIXERS = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd multipliers of a hash of cells: sums modulo 2⁶⁴ hardly ever coincide."""
REMEDY = (
    "close it in a mesh editor, or give its walls a thickness; if its hollows do not matter, load its convex hull "
    "(Blender, MeshLab and trimesh make one)"
)


@dataclass(frozen=True)
class ClosedMesh:
    """A closed surface whose triangles face outwards."""

    vertices: Array
    """(V, 3) metres."""
    faces: Indices
    """(F, 3)."""
    volume: float
    """Enclosed volume, m³."""
    notes: tuple[str, ...]
    """Descriptions of what was mended, for the page."""


def closed(vertices: Array, faces: Indices) -> ClosedMesh:
    """Close a surface.

    Args:
        vertices: (V, 3) metres, finite.
        faces: (F, 3), indices of vertices.

    Raises:
        FormatError: it has no area, edges of more than two triangles, or large holes, or encloses nothing.
    """
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    size = float(np.ptp(vertices[used], axis=0).max())
    vertices, faces = _merged(vertices, faces, SAME * size)
    if not len(faces):
        raise FormatError("faces", "only triangles without area", "a closed mesh of triangles")
    notes = []
    sides = np.sort(_sides(faces, len(vertices)))
    if not _joins_pairs(sides):
        vertices, faces, once = _without_seams(vertices, faces, NEAR * size)
        notes.append("open seams were closed")
        if len(once):
            vertices, faces, note = _filled(vertices, faces, once)
            notes = [note]
        sides = np.sort(_sides(faces, len(vertices)))
    if (sides[::2] == sides[1::2]).any():  # neighbours that run along their edge in the same direction
        turned = _turned(faces, len(vertices))
        faces = np.where(turned[:, None], faces[:, ::-1], faces)
        notes.append("triangles that faced inwards were turned")
    a, b, c = (vertices[column] for column in faces.T)
    volume = float(np.einsum("ni,ni->", a, np.cross(b, c))) / 6
    if abs(volume) < SMALLEST_VOLUME * np.ptp(vertices, axis=0).prod():
        raise FormatError("mesh", f"a volume of {1e6 * abs(volume):.3g} cm³", "a mesh that encloses something")
    return ClosedMesh(vertices, faces if volume > 0 else faces[:, ::-1], abs(volume), tuple(notes))


def _merged(
    vertices: Array, faces: Indices, cell: float, shift: tuple[float, ...] = (0.0, 0.0, 0.0)
) -> tuple[Array, Indices]:
    """Merge used vertices in the same cell of a grid, and drop triangles with two corners in one cell."""
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    kept = np.flatnonzero(used)
    cells = np.round(vertices[kept] / max(cell, 1e-300) + shift).astype(np.int64)
    order = np.argsort(cells.astype(np.uint64) @ MIXERS, kind="stable")
    cells = cells[order]
    new = np.concatenate([[True], (cells[1:] != cells[:-1]).any(axis=1)])  # also where hashes coincide
    number = np.empty(len(vertices), dtype=np.intp)
    number[kept[order]] = np.cumsum(new) - 1
    faces = number[faces]
    a, b, c = faces.T
    return vertices[kept[order[new]]], faces[(a != b) & (b != c) & (c != a)]


def _without_seams(vertices: Array, faces: Indices, cell: float) -> tuple[Array, Indices, Indices]:
    """Merge near vertices; return the surface and its open edges (E, 2).

    Borders of cells separate some near vertices, so the cells are shifted until nothing is open, or until a shift
    changes nothing, as for unrelated triangles.
    """
    before, once = np.inf, np.empty((0, 2), dtype=np.intp)
    for shift in itertools.product((0.0, 0.5), repeat=3):
        vertices, faces = _merged(vertices, faces, cell, shift)
        if not len(faces):
            raise FormatError("faces", "only triangles without area", "a closed mesh of triangles")
        faces = _different(faces, len(vertices))
        once = _edges_of_one(faces, len(vertices))
        if not len(once) or len(once) == before:
            break
        before = len(once)
    return vertices, faces, once


def _sides(faces: Indices, num_vertices: int) -> Indices:
    """Number the sides of the triangles, (3F,): twice the number of the edge, plus one in its other direction."""
    a, b = np.concatenate(faces.T), np.concatenate(np.roll(faces, -1, axis=1).T)
    return 2 * (np.minimum(a, b) * num_vertices + np.maximum(a, b)) + (a > b)


def _joins_pairs(sides: Indices) -> bool:
    """Return whether each edge has exactly two triangles, given their sides in order."""
    edges = sides // 2
    return bool(len(edges) % 2 == 0 and (edges[::2] == edges[1::2]).all() and (edges[1:-1:2] != edges[2::2]).all())


def _different(faces: Indices, num_vertices: int) -> Indices:
    """Return each triangle once, whatever its orientation."""
    a, b, c = np.sort(faces, axis=1).T
    order = np.lexsort((c, a * num_vertices + b))
    in_order = np.sort(faces, axis=1)[order]
    new = np.concatenate([[True], (in_order[1:] != in_order[:-1]).any(axis=1)])
    return faces[np.sort(order[new])]


def _edges_of_one(faces: Indices, num_vertices: int) -> Indices:
    """Return the edges (E, 2) of one triangle only, along it. Raises FormatError if an edge has more than two."""
    _, first, count = np.unique(_sides(faces, num_vertices) // 2, return_index=True, return_counts=True)
    if (count > 2).any():
        found = f"{(count != 2).sum()} edges that do not join two triangles, {(count > 2).sum()} of them more than two"
        raise FormatError("mesh", found, f"a closed (watertight) mesh: {REMEDY}")
    side, triangle = np.divmod(first[count == 1], len(faces))
    return np.stack([faces[triangle, side], faces[triangle, (side + 1) % 3]], axis=1)


def _filled(vertices: Array, faces: Indices, once: Indices) -> tuple[Array, Indices, str]:
    """Fill each hole by triangles around its middle; return the surface and a note for the page."""
    loops = _loops(once) if len(once) <= MAX_OPEN_EDGES else None
    if loops is None:
        found = f"{len(once)} edges that do not join two triangles, and are not around holes that could be filled"
        raise FormatError("mesh", found, f"a closed (watertight) mesh: {REMEDY}")
    along = set(map(tuple, once.tolist()))
    patches, middles = [], []
    for loop in loops:
        if (loop[0], loop[1]) in along:  # a patch runs in the other direction
            loop.reverse()
        if len(loop) == 3:
            patches.append(loop)
            continue
        middle = len(vertices) + len(middles)
        middles.append(vertices[loop].mean(axis=0))
        patches += [[a, b, middle] for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
    vertices = np.concatenate([vertices, np.reshape(middles, (-1, 3))])
    added = np.array(patches)
    share = _area(vertices, added) / max(_area(vertices, added) + _area(vertices, faces), 1e-300)
    holes = _counted(len(loops), "hole")
    if share > MAX_FILLED:
        widest = max(float(np.linalg.norm(np.ptp(vertices[loop], axis=0))) for loop in loops)
        found = f"{holes}, {share:.1%} of its closed surface, the largest {100 * widest:.3g} cm across"
        accepted = f"a closed (watertight) mesh, of which holes of up to {MAX_FILLED:.0%} are filled: {REMEDY}"
        raise FormatError("mesh", found, accepted)
    note = f"{holes} ({max(share, 1e-4):.2%} of its surface) filled with {_counted(len(added), 'triangle')}"
    return vertices, np.concatenate([faces, added]), note


def _counted(num: int, one: str) -> str:
    return f"{num} {one}{'s' if num > 1 else ''}"


def _area(vertices: Array, faces: Indices) -> float:
    a, b, c = (vertices[column] for column in faces.T)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def _loops(edges: Indices) -> list[list[int]] | None:
    """Split edges (E, 2) into loops, lists of distinct vertices; None if they do not consist of loops."""
    neighbours: defaultdict[int, set[int]] = defaultdict(set)
    for a, b in edges.tolist():
        neighbours[a].add(b)
        neighbours[b].add(a)
    if any(len(others) % 2 for others in neighbours.values()):
        return None
    loops = []
    for start in list(neighbours):
        path, place = [start], {start: 0}
        while neighbours[path[-1]]:
            here = path[-1]
            there = neighbours[here].pop()
            neighbours[there].remove(here)
            if there not in place:
                place[there] = len(path)
                path.append(there)
                continue
            loop = path[place[there] :]
            loops.append(loop)
            for vertex in loop[1:]:
                del place[vertex]
            del path[place[there] + 1 :]
    return loops


def _turned(faces: Indices, num_vertices: int) -> Mask:
    """Find the fewest triangles (F,) of a closed surface to turn so that neighbours face the same way.

    Each triangle is two nodes of a graph, as it is and turned, and neighbours that agree are joined: each orientation
    of a connected surface is then one component.

    Raises:
        FormatError: the surface has no orientation, as a Klein bottle.
    """
    sides, num = _sides(faces, num_vertices), len(faces)
    order = np.argsort(sides, kind="stable").reshape(-1, 2)  # the two triangles at each edge
    agree = sides[order[:, 0]] != sides[order[:, 1]]
    one, other = (order % num).T
    rows = np.concatenate([one, one + num])
    columns = np.concatenate([np.where(agree, other, other + num), np.where(agree, other + num, other)])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * num, 2 * num))
    _, component = connected_components(graph.tocsr(), directed=False)
    as_is, turned = component[:num], component[num:]
    if (as_is == turned).any():
        raise FormatError("mesh", "a surface with one side only", "a closed mesh with an inside")
    votes = np.bincount(as_is, minlength=2 * num)
    return votes[as_is] < votes[turned]
