"""Forward kinematics of a serial arm of revolute joints, each about its own z axis."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from dt_viz.flows.fields import Array
from dt_viz.flows.rotations import quaternions
from dt_viz.kernels.arm import JOINT, chains, places
from dt_viz.memo import cached_property
from dt_viz.robot.urdf import constant

T = TypeVar("T", bound="Kinematics")
REFERENCE_REACH = 0.9851132221222917
"""Reach of the JACO, metres, for which lengths that belong to an arm's size are given."""
WORKING_RADIUS = 0.95
"""Distance from the shoulder within which the JACO's hand gets anywhere, metres, about."""


class KinematicChain(NamedTuple):
    """Forward kinematics with the batch last, where a rotation costs one matrix product for the whole batch."""

    axes: Array  # (n, 3, 3, N): [joint, column of the rotation, component], base frame
    origins: Array  # (n, 3, N) of the joints, metres
    position: Array  # (3, N) of the end effector, metres
    direction: Array  # (3, N) unit vectors along the hand

    def position_jacobian(self) -> Array:
        """Compute the velocity of the end effector for each joint's, (n, 3, N), m/rad."""
        return cross(self.axes[:, 2], self.position - self.origins)

    def direction_jacobian(self) -> Array:
        """Compute the velocity of the hand's direction for each joint's, (n, 3, N), per rad."""
        return cross(self.axes[:, 2], self.direction)

    def manipulability(self) -> Array:
        """Compute the square root of det(J Jᵀ), J the position's Jacobian, (N,), m³."""
        J = self.position_jacobian()
        x, y, z = np.einsum("irn,isn->rsn", J, J)
        return np.sqrt(np.maximum((x * cross(y, z)).sum(axis=0), 0.0))


@dataclass(frozen=True, eq=False)
class Kinematics:
    """A serial arm of n revolute joints about their own z axes."""

    joint_rotations: Array  # (n, 3, 3) orientation of each joint in the previous one, at angle zero
    joint_translations: Array  # (n, 3) position of each joint in the previous one, metres
    end_effector_offset: Array  # (3,) position of the end effector in the last joint, metres
    hand_axis: Array  # (3,) direction of the hand in the last joint, of any length but 0
    hand_rotation: Array
    """(3, 3) orientation of the hand in the last joint: that of the end effector's frame, its axes renamed where z is
    not the one along the hand."""

    @property
    def num_joints(self) -> int:
        """Number n of joints."""
        return len(self.joint_translations)

    @property
    def reach(self) -> float:
        """Length of the straightened arm from the second joint to the end effector, metres."""
        segments = np.vstack([self.joint_translations[2:], self.end_effector_offset])
        return float(np.linalg.norm(segments, axis=1).sum())

    @property
    def size(self) -> float:
        """Reach, relative to the JACO's."""
        return self.reach / REFERENCE_REACH

    @property
    def working_radius(self) -> float:
        """Distance from the shoulder within which the hand gets anywhere, metres, about."""
        return WORKING_RADIUS * self.size

    @cached_property
    def shoulder(self) -> Array:
        """(3,) place of the second joint, about, to the centimetre, metres."""
        place = self.joint_translations[0] + self.joint_rotations[0] @ self.joint_translations[1]
        return np.round(place, 2) + 0.0  # the sum turns -0 into 0

    def reaches(self, places: ArrayLike) -> NDArray[np.bool_]:
        """Return which (*B,) of some places (*B, 3), metres, the hand gets to, about."""
        return np.linalg.norm(np.subtract(places, self.shoulder), axis=-1) <= self.working_radius

    @cached_property
    def records(self) -> NDArray[np.void]:
        """(n,) joints for compiled loops."""
        joints = np.zeros(self.num_joints, JOINT)
        joints["rotation"], joints["translation"] = self.joint_rotations, self.joint_translations
        return joints

    def turned(self: T, base: Array) -> T:
        """The same on a base that is turned by a rotation (3, 3)."""
        rotations, translations = np.array(self.joint_rotations), np.array(self.joint_translations)
        rotations[0], translations[0] = base @ rotations[0], base @ translations[0]
        return replace(self, joint_rotations=constant(rotations), joint_translations=constant(translations))

    def forward_kinematics(self, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the poses of the joint frames (each turns with the link after it).

        Args:
            q: (*B, n) joint angles, rad.

        Returns:
            Rotations (*B, n, 3, 3) and origins (*B, n, 3) in metres, both in the base frame.
        """
        q = np.asarray(q, dtype=float)
        chain = self.chain(q.reshape(-1, q.shape[-1]).T)
        rotations = chain.axes.transpose(3, 0, 2, 1).reshape(*q.shape, 3, 3)
        origins = chain.origins.transpose(2, 0, 1).reshape(*q.shape, 3)
        return rotations, origins

    def end_effector(self, q: ArrayLike) -> Array:
        """Compute the end-effector positions (*B, 3), metres, of configurations q (*B, n), rad."""
        q = np.asarray(q, dtype=float)
        flat = q.reshape(-1, q.shape[-1]).copy()
        return places(self.records, self.end_effector_offset, flat).reshape(*q.shape[:-1], 3)

    def hand_direction(self, q: ArrayLike) -> Array:
        """Compute unit vectors (*B, 3), base frame, along the hand; q (*B, n), rad."""
        q = np.asarray(q, dtype=float)
        return self.chain(q.reshape(-1, q.shape[-1]).T).direction.T.reshape(*q.shape[:-1], 3)

    def hand_orientation(self, q: ArrayLike) -> Array:
        """Compute orientations (*B, 4) of the hand, whose z axis is along it, wxyz, base frame; q (*B, n), rad."""
        rotations = self.forward_kinematics(q)[0][..., -1, :, :] @ self.hand_rotation
        return quaternions(Rotation.from_matrix(rotations.reshape(-1, 3, 3))).reshape(*rotations.shape[:-2], 4)

    def jacobian(self, q: ArrayLike) -> Array:
        """Compute the linear Jacobian J (*B, 3, n) of the end effector in the base frame, ẋ = J q̇; q (*B, n), rad."""
        q = np.asarray(q, dtype=float)
        chain = self.chain(q.reshape(-1, q.shape[-1]).T)
        return chain.position_jacobian().transpose(2, 1, 0).reshape(*q.shape[:-1], 3, q.shape[-1])

    def joint_frames(self, q: ArrayLike) -> Array:
        """Compute the rotation of each joint's frame in the previous one, (*B, n, 4), wxyz, for a viewer's scene tree.

        The positions of these frames do not depend on the angles q (*B, n), rad.
        """
        q = np.asarray(q, dtype=float)
        w, x, y, z = quaternions(Rotation.from_matrix(self.joint_rotations)).T
        c, s = np.cos(q / 2), np.sin(q / 2)
        # the fixed quaternion times (c, 0, 0, s), a turn about z
        return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=-1)

    def chain(self, q: Array) -> KinematicChain:
        """Compute the forward kinematics of q (n, N), rad, with the batch last."""
        axes, origins = chains(self.records, np.array(q.T, order="C"))
        hand, axis = (
            (part @ axes[-1].reshape(3, -1)).reshape(3, -1) for part in (self.end_effector_offset, self.hand_axis)
        )
        return KinematicChain(axes, origins, origins[-1] + hand, axis / np.linalg.norm(self.hand_axis))


def cross(a: Array, b: Array) -> Array:
    """Compute cross products over the second last axis of a (*B, 3, N) and b (*B, 3, N)."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)
