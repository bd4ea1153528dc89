"""Meshes of the arm's links for the browser: full ones for the arm, light ones for further arms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh
import yourdfpy

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import package_folder, urdf_path

CELL = 0.005
"""Edge length of the cells in which a light mesh keeps one vertex, metres."""


@dataclass(frozen=True)
class Body:
    """The meshes that move with one joint."""

    placement: Array
    """(4, 4) pose in the parent link, that of the base in the world; all joint angles zero, metres."""
    shell: trimesh.Trimesh
    rings: trimesh.Trimesh | None


@lru_cache(maxsize=1)
def bodies(joint_names: tuple[str, ...]) -> tuple[Body, ...]:
    """Load the base and the six links with everything fixed to them, once for all visitors."""
    urdf = yourdfpy.URDF.load(
        str(urdf_path()), filename_handler=lambda fname: str(fname).replace("package://", f"{package_folder()}/")
    )
    scene = urdf.scene
    assert scene is not None
    moving = [urdf.joint_map[name] for name in joint_names]
    links = [moving[0].parent, *(joint.child for joint in moving)]
    parents = scene.graph.transforms.parents
    shells: list[list[trimesh.Trimesh]] = [[] for _ in links]
    rings: list[list[trimesh.Trimesh]] = [[] for _ in links]
    for name, mesh in scene.geometry.items():
        link = parents[name]
        while link not in links:
            link = parents[link]
        placed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        placed.apply_transform(urdf.get_transform(name, link))
        (rings if name.startswith("ring") else shells)[links.index(link)].append(placed)
    result = []
    for index, link in enumerate(links):
        placement = urdf.get_transform(link, links[index - 1] if index else scene.graph.base_frame)
        result.append(Body(placement, _merged(shells[index]), _merged(rings[index]) if rings[index] else None))
    return tuple(result)


@lru_cache(maxsize=1)
def light_shells(joint_names: tuple[str, ...]) -> tuple[trimesh.Trimesh, ...]:
    """Return a mesh for the base and each link with at most a third of the triangles and without rings."""
    return tuple(simplified(body.shell, CELL) for body in bodies(joint_names))


def simplified(mesh: trimesh.Trimesh, cell: float) -> trimesh.Trimesh:
    """Replace all vertices in a cell of a grid, of edge length `cell`, metres, by their mean."""
    _, cluster = np.unique(np.floor(mesh.vertices / cell).astype(int), axis=0, return_inverse=True)
    cluster = cluster.ravel()
    sums = np.zeros((cluster.max() + 1, 3))
    np.add.at(sums, cluster, mesh.vertices)
    vertices = sums / np.bincount(cluster)[:, None]
    faces = cluster[mesh.faces]
    corners = np.sort(faces, axis=1)
    whole = (np.diff(corners, axis=1) > 0).all(axis=1)
    _, first = np.unique(corners[whole], axis=0, return_index=True)
    return trimesh.Trimesh(vertices, faces[whole][first], process=False)


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    merged = trimesh.util.concatenate(meshes)
    assert isinstance(merged, trimesh.Trimesh)
    merged.merge_vertices()
    return merged
