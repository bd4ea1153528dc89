"""Arms with other numbers of joints, made of the JACO: with its last joint locked, and with one more in the forearm."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.models import load_jaco
from dt_viz.robot.robot import Robot

MORE = 3  # index of the joint that is inserted


@lru_cache(maxsize=1)
def five_joints() -> Robot:
    """The JACO without its last joint: at its angle zero, what turned with it moves with the one before."""
    jaco = load_jaco()
    turn, shift = jaco.joint_rotations[-1], jaco.joint_translations[-1]
    spheres = jaco.body.spheres.copy()
    locked = spheres["joint"] == 5
    spheres["offset"][locked] = spheres["offset"][locked] @ turn.T + shift
    spheres["joint"][locked] = 4

    def fixed(mesh):
        return replace(mesh, joint=4, vertices=mesh.vertices @ turn.T + shift) if mesh.joint == 5 else mesh

    return replace(
        jaco,
        **{name: getattr(jaco, name)[:-1] for name in PER_JOINT},
        name="five",
        end_effector_offset=turn @ jaco.end_effector_offset + shift,
        hand_axis=turn @ jaco.hand_axis,
        hand_rotation=turn @ jaco.hand_rotation,
        body=BodyPoints(spheres),
        meshes=tuple(map(fixed, jaco.meshes)),
        visuals=tuple(map(fixed, jaco.visuals)),
    )


@lru_cache(maxsize=1)
def seven_joints() -> Robot:
    """The JACO with one more joint in the middle of its forearm, which turns what is beyond; at zero it is the JACO."""
    jaco = load_jaco()
    axis = Rotation.from_rotvec([-np.pi / 2, 0.0, 0.0]).as_matrix()  # z along the forearm
    turns, shifts = jaco.joint_rotations.copy(), jaco.joint_translations.copy()
    half = shifts[MORE] / 2
    turns[MORE], shifts[MORE] = axis.T @ turns[MORE], axis.T @ half
    spheres = jaco.body.spheres.copy()
    spheres["joint"] += spheres["joint"] >= MORE

    def beyond(mesh):
        return replace(mesh, joint=mesh.joint + (mesh.joint >= MORE))

    values = {"joint_rotations": axis, "joint_translations": half, "lower": -2.5, "upper": 2.5, "home": 0.3}
    values |= {"velocity_limits": 0.7, "levers": 0.2, "joint_names": "more"}
    before = {name: getattr(jaco, name) for name in PER_JOINT}
    before |= {"joint_rotations": turns, "joint_translations": shifts}
    inserted = {name: np.insert(before[name], MORE, value, axis=0) for name, value in values.items()}
    return replace(
        jaco,
        **inserted | {"joint_names": tuple(inserted["joint_names"].tolist())},
        name="seven",
        body=BodyPoints(spheres),
        meshes=tuple(map(beyond, jaco.meshes)),
        visuals=tuple(map(beyond, jaco.visuals)),
    )


def shorter(robot, part):
    """The JACO with all lengths shorter by a factor, as another arm."""
    lengths = {name: part * getattr(robot, name) for name in ("joint_translations", "end_effector_offset", "levers")}
    meshes = tuple(replace(mesh, vertices=part * mesh.vertices) for mesh in robot.meshes)
    spheres = robot.body.spheres.copy()
    for name in ("offset", "radius"):
        spheres[name] *= part
    return replace(robot, name="other", meshes=meshes, body=replace(robot.body, spheres=spheres), **lengths)


PER_JOINT = (
    "joint_names",
    "lower",
    "upper",
    "velocity_limits",
    "joint_rotations",
    "joint_translations",
    "home",
    "levers",
)
"""Fields of `Robot` that have an entry for each joint."""
OTHER_ARMS = {"five joints": five_joints, "seven joints": seven_joints}
