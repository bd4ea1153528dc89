"""Repair of damaged meshes: coinciding vertices, triangles that are turned, and small holes.

What stays open is for the votes of winding numbers (`dt_viz.files.triangles.inside_of_grid`).
"""

from __future__ import annotations

import itertools

import numpy as np
import trimesh
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from dt_viz.errors import FormatError
from dt_viz.numerics import Array, Indices, Mask


def repaired(vertices: Array, faces: Indices) -> tuple[Array, Indices, tuple[str, ...]]:
    """Merge coinciding vertices, turn triangles as most of their neighbours, outwards, and fill holes of 3 or 4 edges.

    Returns vertices (V, 3) and faces (F, 3) of the repaired mesh, and notes about it for the page.

    Raises:
        FormatError: its triangles have no area, or no side is the outer one.
    """
    used, faces = np.unique(faces, return_inverse=True)
    vertices = vertices[used]
    lower = vertices.min(axis=0)
    size = float(np.ptp(vertices, axis=0).max())
    mesh = trimesh.Trimesh((vertices - lower) / (size or 1.0), faces.reshape(-1, 3), process=False)
    _merge(mesh)
    if not size > 0 or not len(mesh.faces):
        raise FormatError("faces", "only triangles without area", "a closed mesh of triangles")
    notes = []
    if not mesh.is_winding_consistent:
        turned = _turned(mesh)
        mesh.faces = np.where(turned[:, None], mesh.faces[:, ::-1], mesh.faces)
        notes += ["triangles that faced inwards were turned"] if turned.any() else []
    before, area = len(mesh.faces), mesh.area
    if not mesh.is_watertight and np.sum(np.bincount(mesh.edges_unique_inverse) == 1) <= 100_000:  # more take too long
        trimesh.repair.fill_holes(mesh)
    if (added := len(mesh.faces) - before) > 0:
        notes.append(
            f"holes filled with {added} triangle{'s' * (added > 1)}, {mesh.area / area - 1:.2%} of the surface"
        )
    faces = mesh.faces[:, ::-1] if mesh.volume < 0 else mesh.faces
    return mesh.vertices * size + lower, np.asarray(faces, dtype=np.int64), tuple(notes)


def _merge(mesh: trimesh.Trimesh) -> None:
    """Merge vertices in the same cell of a grid, and drop triangles that have no area or are there twice.

    Borders of cells separate some near vertices, so the cells are shifted until nothing is open, or nothing changes.
    """
    before, digits = 0, 5  # decimals of the coordinates, which are at most 1
    for shift in itertools.product((0.0, 0.5), repeat=3):
        mesh.vertices += np.multiply(shift, 10.0**-digits)
        mesh.merge_vertices(digits_vertex=digits)
        mesh.vertices -= np.multiply(shift, 10.0**-digits)
        a, b, c = mesh.faces.T
        mesh.update_faces(mesh.unique_faces() & (a != b) & (b != c) & (c != a))
        if len(mesh.vertices) == before or mesh.is_watertight:
            return
        before = len(mesh.vertices)


def _turned(mesh: trimesh.Trimesh) -> Mask:
    """Find the fewest triangles (F,) to turn so that neighbours face the same way.

    Each triangle is two nodes of a graph, as it is and turned, and neighbours that agree are joined: each orientation
    of a connected surface is then one component. (`trimesh.repair.fix_winding` takes a hundred times as long, and
    turns all others if it begins at a wrong one.)

    Raises:
        FormatError: the surface has one side only, as a Klein bottle.
    """
    faces, num = mesh.faces, len(mesh.faces)
    one, other = mesh.face_adjacency.T
    start, end = mesh.face_adjacency_edges.T[..., None]

    def along(chosen: Indices) -> Mask:
        return ((faces[chosen] == start) & (np.roll(faces[chosen], -1, axis=1) == end)).any(axis=1)

    agree = along(one) != along(other)
    rows = np.concatenate([one, one + num])
    columns = np.concatenate([np.where(agree, other, other + num), np.where(agree, other + num, other)])
    graph = coo_array((np.ones(len(rows), dtype=np.int8), (rows, columns)), shape=(2 * num, 2 * num))
    _, component = connected_components(graph.tocsr(), directed=False)
    as_is, turned = component[:num], component[num:]
    if (as_is == turned).any():
        raise FormatError("mesh", "a surface with one side only", "a closed mesh with an inside")
    votes = np.bincount(as_is, minlength=2 * num)
    return votes[as_is] < votes[turned]
