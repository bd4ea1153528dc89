"""The JACO arm: joint limits, kinematics, and the shapes of its links.

Pinocchio reads the URDF once, into plain arrays; numpy computes everything else, for whole batches of configurations.
Lengths are metres, angles radians, positions and directions in the robot's base frame. A configuration q is always six
angles, also for the continuous joints, which pinocchio keeps as (cos, sin).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pinocchio as pin
from scipy.spatial.transform import Rotation

from dt_viz.kernels.arm import JOINT, chains, places
from dt_viz.kernels.tracking import TrackingArm
from dt_viz.robot.tracking_settings import TrackingSettings

if TYPE_CHECKING:
    from numpy.typing import ArrayLike, NDArray

    from dt_viz.flows.fields import Array

NUM_JOINTS = 6
DISTRIBUTION = "example-robot-data"
URDF_IN_DISTRIBUTION = "kinova_description/robots/kinova.urdf"
END_EFFECTOR_FRAME = "j2s6s200_end_effector"

HOME = (0.0, 3.2, 1.1, 0.0, 3.4, 0.0)
"""Ready pose, rad: upper arm upright, elbow high, hand ahead of the base (the JACO's front is -y), 47° downwards."""


class KinematicChain(NamedTuple):
    """Forward kinematics with the batch last, where a rotation costs one matrix product for the whole batch."""

    axes: Array
    """(6, 3, 3, N): [joint, column of the rotation, component], base frame."""
    origins: Array
    """(6, 3, N) of the joints, metres."""
    position: Array
    """(3, N) of the end effector, metres."""
    direction: Array
    """(3, N) unit vectors along the hand."""

    def position_jacobian(self) -> Array:
        """Compute the velocity of the end effector for each joint's, (6, 3, N), m/rad."""
        return cross(self.axes[:, 2], self.position - self.origins)

    def direction_jacobian(self) -> Array:
        """Compute the velocity of the hand's direction for each joint's, (6, 3, N), per rad."""
        return cross(self.axes[:, 2], self.direction)

    def manipulability(self) -> Array:
        """Compute the square root of det(J Jᵀ), J the position's Jacobian, (N,), m³."""
        J = self.position_jacobian()
        x, y, z = np.einsum("irn,isn->rsn", J, J)
        return np.sqrt(np.maximum((x * cross(y, z)).sum(axis=0), 0.0))


@dataclass(frozen=True, eq=False)
class Robot:
    """A serial arm of six revolute joints about their own z axes.

    Attributes:
        joint_names: Names of the six joints, base to hand.
        lower: (6,) lower limits, rad; -inf for continuous joints.
        upper: (6,) upper limits, rad; +inf for continuous joints.
        velocity_limits: (6,) rad/s.
        joint_rotations: (6, 3, 3) orientation of each joint in the previous one, at angle zero.
        joint_translations: (6, 3) position of each joint in the previous one, metres.
        link_rotations: (6, 3, 3) orientation of each joint at angle zero in its *parent link* in the URDF. It differs
            from `joint_rotations` where fixed joints lie in between.
        end_effector_offset: (3,) position of the end effector in the last joint, metres.
        home: (6,) ready pose, rad.
        tracking: settings of inverse kinematics and tracking.
    """

    joint_names: tuple[str, ...]
    lower: Array
    upper: Array
    velocity_limits: Array
    joint_rotations: Array
    joint_translations: Array
    link_rotations: Array
    end_effector_offset: Array
    home: Array
    tracking: TrackingSettings = field(default=TrackingSettings())

    @property
    def reach(self) -> float:
        """Length of the straightened arm from the second joint to the end effector, metres."""
        segments = np.vstack([self.joint_translations[2:], self.end_effector_offset])
        return float(np.linalg.norm(segments, axis=1).sum())

    def clip(self, q: ArrayLike) -> Array:
        """Return the nearest configuration inside the joint limits; q (*B, 6), rad."""
        return np.clip(q, self.lower, self.upper)

    # --- Kinematics ---

    @cached_property
    def records(self) -> NDArray[np.void]:
        """(6,) joints for compiled loops."""
        joints = np.zeros(NUM_JOINTS, JOINT)
        joints["rotation"], joints["translation"] = self.joint_rotations, self.joint_translations
        return joints

    @cached_property
    def tracking_arm(self) -> TrackingArm:
        """The arm for the compiled loops of tracking."""
        hand, lower, upper = (np.array(values) for values in (self.end_effector_offset, self.lower, self.upper))
        weights = (getattr(self.tracking, name) for name in TrackingArm._fields[4:])
        return TrackingArm(self.records, hand, lower, upper, *weights)

    def forward_kinematics(self, q: ArrayLike) -> tuple[Array, Array]:
        """Compute the poses of the six joint frames (each turns with the link after it).

        Args:
            q: (*B, 6) joint angles, rad.

        Returns:
            Rotations (*B, 6, 3, 3) and origins (*B, 6, 3) in metres, both in the base frame.
        """
        q = np.asarray(q, dtype=float)
        chain = self.chain(q.reshape(-1, NUM_JOINTS).T)
        rotations = chain.axes.transpose(3, 0, 2, 1).reshape(*q.shape, 3, 3)
        origins = chain.origins.transpose(2, 0, 1).reshape(*q.shape, 3)
        return rotations, origins

    def end_effector(self, q: ArrayLike) -> Array:
        """Compute the end-effector positions (*B, 3), metres, of configurations q (*B, 6), rad."""
        q = np.asarray(q, dtype=float)
        return places(self.records, self.end_effector_offset, q.reshape(-1, NUM_JOINTS).copy()).reshape(
            *q.shape[:-1], 3
        )

    def hand_direction(self, q: ArrayLike) -> Array:
        """Compute unit vectors (*B, 3), base frame, from the last joint to the end effector; q (*B, 6), rad."""
        q = np.asarray(q, dtype=float)
        return self.chain(q.reshape(-1, NUM_JOINTS).T).direction.T.reshape(*q.shape[:-1], 3)

    def jacobian(self, q: ArrayLike) -> Array:
        """Compute the linear Jacobian of the end effector in the base frame.

        Args:
            q: (*B, 6) joint angles, rad.

        Returns:
            (*B, 3, 6), metres per rad: ẋ = J q̇.
        """
        q = np.asarray(q, dtype=float)
        chain = self.chain(q.reshape(-1, NUM_JOINTS).T)
        return chain.position_jacobian().transpose(2, 1, 0).reshape(*q.shape[:-1], 3, NUM_JOINTS)

    def joint_frames(self, q: ArrayLike) -> Array:
        """Compute the rotation of each joint's child link in its parent link, for a viewer's scene tree.

        The positions of these frames do not depend on q.

        Args:
            q: (*B, 6) joint angles, rad.

        Returns:
            (*B, 6, 4) unit quaternions, wxyz.
        """
        q = np.asarray(q, dtype=float)
        w, x, y, z = _quaternions(self.link_rotations).T
        c, s = np.cos(q / 2), np.sin(q / 2)
        # the fixed quaternion times (c, 0, 0, s), a turn about z
        return np.stack([w * c - z * s, x * c + y * s, y * c - x * s, z * c + w * s], axis=-1)

    def chain(self, q: Array) -> KinematicChain:
        """Compute the forward kinematics of q (6, N), rad, with the batch last."""
        axes, origins = chains(self.records, np.array(q.T, order="C"))
        hand = (self.end_effector_offset @ axes[-1].reshape(3, -1)).reshape(3, -1)
        return KinematicChain(axes, origins, origins[-1] + hand, hand / np.linalg.norm(self.end_effector_offset))


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """Collision shape of a link; the fingers, which do not move, are links of the last joint.

    Attributes:
        name: name of the link in the URDF.
        joint: index of the joint that it moves with, -1 for the base.
        vertices: (V, 3) metres, in the frame of that joint; of the base in the base frame.
        faces: (F, 3) indices of vertices.
    """

    name: str
    joint: int
    vertices: Array
    faces: NDArray[np.intp]


def cross(a: Array, b: Array) -> Array:
    """Compute cross products over the second last axis of a (*B, 3, N) and b (*B, 3, N)."""
    ax, ay, az = a[..., 0, :], a[..., 1, :], a[..., 2, :]
    bx, by, bz = b[..., 0, :], b[..., 1, :], b[..., 2, :]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-2)


def _quaternions(rotations: Array) -> Array:
    """Convert rotations (N, 3, 3) to unit quaternions (N, 4), wxyz."""
    return np.roll(Rotation.from_matrix(rotations).as_quat(), 1, axis=-1)


def urdf_path() -> Path:
    """Find the JACO's URDF in the installed example-robot-data.

    Raises:
        FileNotFoundError: The package is not installed, or its version has no such file.
    """
    try:
        distribution = metadata.distribution(DISTRIBUTION)
    except metadata.PackageNotFoundError as error:
        raise FileNotFoundError(
            f"the JACO model needs the package {DISTRIBUTION}: pip install {DISTRIBUTION}"
        ) from error
    for file in distribution.files or ():
        path = Path(str(distribution.locate_file(file)))
        if file.as_posix().endswith(URDF_IN_DISTRIBUTION) and path.is_file():
            return path.resolve()
    raise FileNotFoundError(f"{DISTRIBUTION} {distribution.version} holds no {URDF_IN_DISTRIBUTION}; 6.0.0 does")


def package_folder() -> Path:
    """Return the folder in which the `package://` addresses of the URDF's meshes resolve.

    Raises:
        FileNotFoundError: As `urdf_path`.
    """
    path = urdf_path()
    return next(folder.parent for folder in path.parents if folder.name == DISTRIBUTION)


@lru_cache(maxsize=1)
def load_jaco() -> Robot:
    """Load the JACO arm (j2s6s200: six joints, two fingers), once.

    Raises:
        FileNotFoundError: As `urdf_path`.
    """
    model = pin.buildModelFromUrdf(str(urdf_path()))  # pyright: ignore[reportAttributeAccessIssue]  # it has no stubs
    joints = range(1, NUM_JOINTS + 1)  # 0 is pinocchio's universe
    hand = model.frames[model.getFrameId(END_EFFECTOR_FRAME)].placement
    lower, upper, in_link = np.full(NUM_JOINTS, -np.inf), np.full(NUM_JOINTS, np.inf), []
    for i in joints:
        if model.joints[i].nq == 1:  # the continuous joints' limits bound (cos, sin), not the angle
            lower[i - 1] = model.lowerPositionLimit[model.joints[i].idx_q]
            upper[i - 1] = model.upperPositionLimit[model.joints[i].idx_q]
        frame = model.frames[model.getFrameId(model.names[i])]
        in_link.append(model.frames[frame.parentFrame].placement.actInv(model.jointPlacements[i]))
    return Robot(
        joint_names=tuple(model.names)[1:],
        lower=_constant(lower),
        upper=_constant(upper),
        velocity_limits=_constant(model.velocityLimit),
        joint_rotations=_constant([model.jointPlacements[i].rotation for i in joints]),
        joint_translations=_constant([model.jointPlacements[i].translation for i in joints]),
        link_rotations=_constant([placement.rotation for placement in in_link]),
        end_effector_offset=_constant(hand.translation),
        home=_constant(HOME),
    )


@lru_cache(maxsize=1)
def collision_meshes() -> tuple[LinkMesh, ...]:
    """Load the collision meshes of the URDF, from the base to the finger tips, once.

    Raises:
        FileNotFoundError: As `urdf_path`.
    """
    path = str(urdf_path())
    model = pin.buildModelFromUrdf(path)  # pyright: ignore[reportAttributeAccessIssue]  # it has no stubs
    kind = pin.GeometryType.COLLISION  # pyright: ignore[reportAttributeAccessIssue]
    shapes = pin.buildGeomFromUrdf(  # pyright: ignore[reportAttributeAccessIssue]
        model, path, kind, package_dirs=[str(package_folder())]
    )
    meshes = []
    for shape in shapes.geometryObjects:
        triangles = (shape.geometry.tri_indices(i) for i in range(shape.geometry.num_tris))
        faces = np.array([[triangle[k] for k in range(3)] for triangle in triangles], dtype=np.intp)
        faces.flags.writeable = False
        vertices = shape.geometry.vertices() * shape.meshScale
        meshes.append(
            LinkMesh(
                name=model.frames[shape.parentFrame].name,
                joint=shape.parentJoint - 1,  # 0 is pinocchio's universe
                vertices=_constant(vertices @ shape.placement.rotation.T + shape.placement.translation),
                faces=faces,
            )
        )
    return tuple(meshes)


def _constant(values: ArrayLike) -> Array:
    """Return a read-only copy."""
    array = np.array(values, dtype=float)
    array.flags.writeable = False
    return array
