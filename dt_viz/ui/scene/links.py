"""Meshes of the arm's links for the browser: full ones for the arm, light ones for further arms."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import trimesh

from dt_viz.flows.fields import Array
from dt_viz.robot.robot import Robot
from dt_viz.ui.scene.palette import LIGHT, Colour

GRAIN = 2.0**-16
"""Rounding of all vertices, metres: unseen, and what is sent or saved of them is a quarter smaller."""
CELL = 0.005
"""Edge length of the cells in which a light mesh keeps one vertex, metres."""


@dataclass(frozen=True)
class Body:
    """The meshes that move with one joint, or those of the base."""

    placement: Array
    """(4, 4) pose in the frame of the joint before, that of the base in the world; all joint angles zero, metres."""
    parts: tuple[tuple[Colour, trimesh.Trimesh], ...]
    """What has one colour, with it; none where nothing is drawn."""


@lru_cache(maxsize=4)
def bodies(robot: Robot) -> tuple[Body, ...]:
    """Join the meshes of the base and of each link with everything fixed to it, once for all visitors."""
    result, still = [], (np.eye(3)[None], np.zeros((1, 3)))
    turns, shifts = map(np.concatenate, zip(still, (robot.joint_rotations, robot.joint_translations), strict=True))
    for joint, (turn, shift) in enumerate(zip(turns, shifts, strict=True), start=-1):
        placement = np.eye(4)
        placement[:3, :3], placement[:3, 3] = turn, shift
        found: dict[Colour | None, list[trimesh.Trimesh]] = {}
        for mesh in robot.visuals:
            if mesh.joint == joint:
                shape = trimesh.Trimesh(GRAIN * np.round(mesh.vertices / GRAIN), mesh.faces, process=False)
                found.setdefault(mesh.colour, []).append(shape)
        merged = {colour: _merged(meshes) for colour, meshes in found.items()}
        result.append(Body(placement, tuple((colour or LIGHT.arm, mesh) for colour, mesh in merged.items())))
    return tuple(result)


@lru_cache(maxsize=4)
def light_links(robot: Robot) -> dict[int, trimesh.Trimesh]:
    """Meshes with at most a third of the triangles, by joint, of what motions move away from something.

    Parts with a colour of their own, beside others in the arm's, are left out.
    """
    links = {}
    for joint, body in enumerate(bodies(robot)[1:]):
        plain = [mesh for colour, mesh in body.parts if colour == LIGHT.arm]
        if joint >= robot.num_fixed and body.parts:
            links[joint] = simplified(_merged(plain or [mesh for _, mesh in body.parts]), CELL)
    return links


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
