"""URDF files of small arms, and arms that come with example-robot-data, as pinocchio has them: oracles of ours."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from pathlib import Path

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle

from dt_viz.robot.robot import Robot

BOX = '<geometry><box size="0.06 0.06 0.2"/></geometry>'


def link(name: str, shape: str = BOX, tag: str = "collision") -> str:
    inside = f'<{tag}><origin xyz="0 0 0.1"/>{shape}</{tag}>' if shape else ""
    return f'<link name="{name}">{inside}</link>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "", axis: str = "0 0 1") -> str:
    limit = '<limit lower="-2" upper="2" velocity="1.5" effort="1"/>' if kind in ("revolute", "prismatic") else ""
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="0 0 0.2" rpy="0.1 0 0"/><axis xyz="{axis}"/>{limit}{more}</joint>'
    )


AXES = ("0 0 1", "0 1 0", "1 2 -0.5", "-1 0 0", "0 0 -1", "0.3 0.1 0.2", "0 1 0")


def urdf(num: int = 4, more: str = "", name: str = ' name="small"', shape: str = BOX) -> str:
    """An arm with oblique axes, of boxes, and what else is in its file."""
    links = [link(f"l{k}", shape) for k in range(num + 1)] + ['<link name="tcp"/>']
    joints = [joint(f"j{k}", f"l{k}", f"l{k + 1}", axis=AXES[k % len(AXES)]) for k in range(num)]
    return f"<robot{name}>{''.join(links + joints)}{joint('fix', f'l{num}', 'tcp', 'fixed')}{more}</robot>"


def write(folder: Path, text: str | bytes, name: str = "arm.urdf") -> Path:
    path = folder / name
    path.write_bytes(text.encode() if isinstance(text, str) else text)
    return path


def pinocchio_tool(
    path: Path, values: dict[str, float], tool: str, offset: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Place (3,) and Jacobian (3, all joints by name) of the tool, by pinocchio's model of the whole file."""
    model = pin.buildModelFromUrdf(str(path))
    data, q = model.createData(), pin.neutral(model)
    for name, value in values.items():
        own = model.joints[model.getJointId(name)]
        q[own.idx_q : own.idx_q + own.nq] = [np.cos(value), np.sin(value)] if own.nq == 2 else value
    frame = model.getFrameId(tool, pin.FrameType.BODY)
    J = pin.computeFrameJacobian(model, data, q, frame, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)
    pin.framesForwardKinematics(model, data, q)
    turned = data.oMf[frame].rotation @ offset
    columns = [model.joints[model.getJointId(name)].idx_v for name in values]
    linear = J[:3] + np.cross(J[3:], turned, axisa=0, axisc=0)
    return data.oMf[frame].translation + turned, linear[:, columns]


def random_postures(robot: Robot, num: int, seed: int = 0) -> np.ndarray:
    lower, upper = np.maximum(robot.lower, -np.pi), np.minimum(robot.upper, np.pi)
    return np.random.default_rng(seed).uniform(lower, upper, (num, robot.num_joints))
