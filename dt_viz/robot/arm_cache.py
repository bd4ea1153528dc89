"""Arms as archives of arrays, kept in the user's cache folder."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.files.npz import read_cached, write_cached
from dt_viz.flows.fields import Array
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.meshes import LinkMesh, VisualMesh, constant
from dt_viz.robot.robot import Robot

FORMAT = 5
"""Version of what is found of an arm and of its file; raised with every change, so that older files are not used."""
MAX_BYTES = 500 * 10**6
"""Largest number of bytes that a file unpacks to."""
SMALL = ("joint_names", "lower", "upper", "velocity_limits", "joint_rotations", "joint_translations", "hand_axis",
         "hand_rotation", "end_effector_offset", "home", "levers", "base")  # fmt: skip
"""Fields of an arm that are arrays, and are stored as they are."""


def digest(parts: Iterable[bytes]) -> str:
    """Compute a key of what an arm is made from."""
    total = hashlib.sha256(f"{FORMAT}".encode())
    for part in parts:
        total.update(hashlib.sha256(part).digest())
    return total.hexdigest()


def write(path: Path, robot: Robot) -> None:
    """Store an arm, if that can be."""
    write_cached(path, to_arrays(robot))


def read(path: Path, given: Mapping[str, Any]) -> Robot | None:
    """Read an arm that was stored, with `given` fields that are not; None where there is none, or it is damaged."""
    return read_cached(path, lambda arrays: from_arrays(arrays, given), MAX_BYTES)


def to_arrays(robot: Robot) -> dict[str, np.ndarray]:
    """Return the arrays that an arm is stored as."""
    arrays = {name: np.array(getattr(robot, name)) for name in SMALL}
    arrays |= {f"body_{name}": robot.body.spheres[name] for name in BODY_POINT.names or ()}
    arrays["num_fixed"] = np.array(robot.num_fixed)
    arrays["touching"] = np.array(sorted(map(sorted, robot.touching)), str).reshape(-1, 2)
    arrays["found"] = np.array(robot.found, str).reshape(-1, 2)
    for kind, meshes in (("mesh", robot.meshes), ("visual", robot.visuals)):
        arrays[f"{kind}_names"] = np.array([mesh.name for mesh in meshes], str)
        arrays[f"{kind}_joints"] = np.array([mesh.joint for mesh in meshes], int)
        for part, dtype in (("vertices", float), ("faces", np.int32)):
            every = [np.asarray(getattr(mesh, part), dtype) for mesh in meshes]
            arrays[f"{kind}_{part}"] = np.concatenate([np.empty((0, 3), dtype), *every])
            arrays[f"{kind}_{part}_ends"] = np.cumsum([len(one) for one in every], dtype=int)
    colours = [(-1, -1, -1) if mesh.colour is None else mesh.colour for mesh in robot.visuals]
    arrays["visual_colours"] = np.array(colours, int).reshape(-1, 3)
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray], given: Mapping[str, Any]) -> Robot:
    """Make an arm of its arrays and the other fields.

    Raises:
        Exception: of almost any kind, if some are missing or do not fit.
    """
    colours = [None if min(colour) < 0 else tuple(colour) for colour in arrays["visual_colours"].tolist()]
    values: dict[str, Any] = {name: constant(arrays[name]) for name in SMALL if name != "joint_names"}
    values["joint_names"] = tuple(arrays["joint_names"].tolist())
    robot = Robot(
        **values,
        **given,
        body=BodyPoints.from_arrays(arrays, "body_"),
        num_fixed=int(arrays["num_fixed"]),
        touching=frozenset(frozenset(pair) for pair in arrays["touching"].tolist()),
        found=tuple((what, why) for what, why in arrays["found"].tolist()),
        meshes=tuple(LinkMesh(*parts) for parts in _meshes(arrays, "mesh")),
        visuals=tuple(
            VisualMesh(*parts, colour) for parts, colour in zip(_meshes(arrays, "visual"), colours, strict=True)
        ),
    )
    lengths = {
        len(getattr(robot, name)) for name in ("joint_names", "lower", "upper", "velocity_limits", "home", "levers")
    }
    if lengths != {robot.num_joints}:
        raise ValueError("arrays of different lengths")
    return robot


def _meshes(arrays: Mapping[str, np.ndarray], kind: str) -> list[tuple[str, int, Array, np.ndarray]]:
    parts = {
        part: np.split(arrays[f"{kind}_{part}"], arrays[f"{kind}_{part}_ends"])[:-1] for part in ("vertices", "faces")
    }
    names: Sequence[tuple[str, int]] = list(
        zip(arrays[f"{kind}_names"].tolist(), arrays[f"{kind}_joints"].tolist(), strict=True)
    )
    return [
        (name, joint, constant(vertices), constant(faces, np.intp))
        for (name, joint), vertices, faces in zip(names, parts["vertices"], parts["faces"], strict=True)
    ]
