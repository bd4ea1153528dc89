"""An arm: its kinematics, limits, shapes, and what is known of it; the JACO."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property, lru_cache
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pinocchio as pin
import yourdfpy

from dt_viz.kernels.arm import BODY_POINT
from dt_viz.kernels.blocks import MOST_JOINTS
from dt_viz.kernels.proximity import least_contacts
from dt_viz.kernels.tracking import TrackingArm
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import page_names
from dt_viz.robot.meshes import LinkMesh, VisualMesh
from dt_viz.robot.sizing import sized
from dt_viz.robot.tracking_settings import TrackingSettings
from dt_viz.shipped import ASSETS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from numpy.typing import ArrayLike

    from dt_viz.flows.fields import Array, Indices

DISTRIBUTION = "example-robot-data"
URDF_IN_DISTRIBUTION = "kinova_description/robots/kinova.urdf"
END_EFFECTOR_FRAME = "j2s6s200_end_effector"

HOME = (0.0, 3.2, 1.1, 0.0, 3.4, 0.0)
"""Ready pose, rad: upper arm upright, elbow high, hand ahead of the base (the JACO's front is -y), 47° downwards."""
LEVERS = (0.5, 0.5, 0.35, 0.12, 0.14, 0.05)
"""Levers of the JACO's joints, m/rad."""
RING = (62, 66, 74)
"""Colour of the JACO's rings."""
LEAST_JOINTS = 3
"""Smallest number of joints of an arm whose hand can be taken anywhere."""


@dataclass(frozen=True, eq=False)
class Robot(Kinematics):
    """An arm of n joints, all that is known of it.

    Its frame is that of the arm's base, turned about z so that the arm's front is −y.
    """

    name: str
    """Short name, such as "jaco"."""
    title: str
    """Name on the page."""
    joint_names: tuple[str, ...]
    """Names of the n joints, base to hand."""
    lower: Array
    """(n,) lower limits, rad; −inf for continuous joints."""
    upper: Array
    """(n,) upper limits, rad; +inf for continuous joints."""
    velocity_limits: Array
    """(n,) rad/s."""
    home: Array
    """(n,) ready pose, rad."""
    levers: Array
    """(n,) motion of the hand for each joint's turning, m/rad, about: converts a distance of postures to a length."""
    body: BodyPoints
    """Body points of all links."""
    meshes: tuple[LinkMesh, ...]
    """Collision shapes of the links, from the base to the finger tips."""
    visuals: tuple[VisualMesh, ...]
    """What is drawn of the links."""
    num_fixed: int
    """Number of first joints whose links no motion moves away from an obstacle: that of a joint at the base only
    spins."""
    touching: frozenset[frozenset[str]]
    """Pairs of links that may touch, besides neighbours, by name."""
    base: Array
    """(3, 3) rotation from the URDF's base to this frame."""
    urdf: Path
    """File that describes the arm."""
    package_dirs: tuple[Path, ...]
    """Folders in which the `package://` addresses of its meshes resolve."""
    tracking: TrackingSettings = field(default=TrackingSettings())
    """Settings of inverse kinematics and tracking, their lengths for an arm as large as the JACO."""

    def __post_init__(self) -> None:
        """Raise ValueError for fewer joints than the hand has coordinates, or more than compiled loops take."""
        if not LEAST_JOINTS <= self.num_joints <= MOST_JOINTS:
            accepted = f"{LEAST_JOINTS} to {MOST_JOINTS} between base and hand"
            raise ValueError(f"{self.name}: found {self.num_joints} joints; accepted: {accepted}")

    @cached_property
    def links(self) -> BodyPoints:
        """Body points of the links that joints can move away from an obstacle."""
        return self.body.of_joints(self.num_fixed)

    @cached_property
    def pedestal(self) -> BodyPoints:
        """Body points of the base and the links that no motion moves away from anything."""
        return self.body.of_joints(-1, self.num_fixed)

    def link_name(self, joint: int) -> str:
        """Name on the page of the link that moves with a joint; −1 is the base."""
        names = page_names([mesh.name for mesh in self.meshes])
        return next((name for name, mesh in zip(names, self.meshes, strict=True) if mesh.joint == joint), "base")

    @cached_property
    def collision(self) -> CollisionModel:
        """The links as solids."""
        return CollisionModel(self, self.meshes, self.num_fixed, self.touching)

    @cached_property
    def sized_tracking(self) -> TrackingSettings:
        """These settings for this arm."""
        return sized(self.tracking, self.size)

    @cached_property
    def tracking_arm(self) -> TrackingArm:
        """The arm for the compiled loops of tracking."""
        arrays = (self.end_effector_offset, self.hand_axis, self.lower, self.upper)
        hand, axis, lower, upper = (np.array(values) for values in arrays)
        weights = (getattr(self.sized_tracking, name) for name in TrackingArm._fields[5:])
        return TrackingArm(self.records, hand, axis, lower, upper, *weights)

    @property
    def top_speed(self) -> float:
        """Largest speed of any point, m/s, each joint at its limit: a fifth more than by levers, which are means."""
        return float(1.2 * self.levers @ self.velocity_limits)

    def pairs(self, between: int) -> Indices:
        """Pairs (K, 2) of body points, by their own spheres, that may not touch.

        Args:
            between: smallest number of joints between them.
        """
        points, joint_of = self.body, {mesh.name: mesh.joint for mesh in self.meshes}
        may_touch = np.zeros((self.num_joints + 1, self.num_joints + 1), bool)  # the last one is the base, −1
        for first, second in self.touching:
            if first in joint_of and second in joint_of:
                a, b = joint_of[first], joint_of[second]
                may_touch[a, b] = may_touch[b, a] = True
        apart = points.joint[:, None] + between <= points.joint
        a, b = np.nonzero(apart & ~may_touch[points.joint[:, None], points.joint])
        return points.indices[np.stack([a, b], axis=1)]

    def self_clearance(self, q: Array, enough: float) -> float:
        """Compute the smallest distance, metres, of links that no joint connects at configurations q (N, n), rad.

        It is too small by twice `PROTRUSION` at most, and at most `enough`.
        """
        pairs = self.pairs(between=2)
        apart = least_contacts(self.records, self.body.spheres, pairs, np.array(q, order="C"), enough)
        return float(apart.min(initial=enough))

    def clip(self, q: ArrayLike) -> Array:
        """Return the nearest configuration inside the joint limits; q (*B, n), rad."""
        return np.clip(q, self.lower, self.upper)


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


@lru_cache(maxsize=1)
def load_jaco() -> Robot:
    """Load the JACO arm (j2s6s200: six joints, two fingers), once.

    Raises:
        FileNotFoundError: As `urdf_path`.
    """
    urdf = urdf_path()
    package_dir = next(folder.parent for folder in urdf.parents if folder.name == DISTRIBUTION)
    model = pin.buildModelFromUrdf(str(urdf))  # pyright: ignore[reportAttributeAccessIssue]  # it has no stubs
    joints = range(1, model.njoints)  # 0 is pinocchio's universe
    hand = _constant(model.frames[model.getFrameId(END_EFFECTOR_FRAME)].placement.translation)
    lower, upper = np.full(len(joints), -np.inf), np.full(len(joints), np.inf)
    for i in joints:
        if model.joints[i].nq == 1:  # the continuous joints' limits bound (cos, sin), not the angle
            lower[i - 1] = model.lowerPositionLimit[model.joints[i].idx_q]
            upper[i - 1] = model.upperPositionLimit[model.joints[i].idx_q]
    joint_names = tuple(model.names)[1:]
    return Robot(
        name="jaco",
        title="JACO",
        joint_names=joint_names,
        lower=_constant(lower),
        upper=_constant(upper),
        velocity_limits=_constant(model.velocityLimit),
        joint_rotations=_constant([model.jointPlacements[i].rotation for i in joints]),
        joint_translations=_constant([model.jointPlacements[i].translation for i in joints]),
        end_effector_offset=hand,
        hand_axis=hand,
        home=_constant(HOME),
        levers=_constant(LEVERS),
        body=_body_points(),
        meshes=_collision_meshes(model, urdf, package_dir),
        visuals=_visuals(joint_names, urdf, package_dir),
        num_fixed=1,
        touching=frozenset(),
        base=_constant(np.eye(3)),
        urdf=urdf,
        package_dirs=(package_dir,),
    )


def _body_points() -> BodyPoints:
    """The JACO's body points, made by ``python -m assets.make_body_points``."""
    with np.load(ASSETS / "body_points.npz", allow_pickle=False) as data:
        spheres = np.zeros(len(data["joint"]), BODY_POINT)
        for name in BODY_POINT.names or ():
            spheres[name] = data[name]
    return BodyPoints(spheres)


def _collision_meshes(model: Any, urdf: Path, package_dir: Path) -> tuple[LinkMesh, ...]:  # noqa: ANN401 - no stubs
    kind = pin.GeometryType.COLLISION  # pyright: ignore[reportAttributeAccessIssue]
    shapes = pin.buildGeomFromUrdf(  # pyright: ignore[reportAttributeAccessIssue]
        model, str(urdf), kind, package_dirs=[str(package_dir)]
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


def _visuals(joint_names: Sequence[str], urdf: Path, package_dir: Path) -> tuple[VisualMesh, ...]:
    """The meshes that are drawn, of the base, of the links, and of what is fixed to them; rings are dark."""
    model = yourdfpy.URDF.load(
        str(urdf), filename_handler=lambda fname: str(fname).replace("package://", f"{package_dir}/")
    )
    scene = model.scene
    assert scene is not None
    frames = [scene.graph.base_frame, *(model.joint_map[name].child for name in joint_names)]
    parents, meshes = scene.graph.transforms.parents, []
    for name, mesh in scene.geometry.items():
        link = parents[name]
        while link not in frames:
            link = parents[link]
        place, faces = model.get_transform(name, link), np.array(mesh.faces, dtype=np.intp)
        faces.flags.writeable = False
        vertices = _constant(mesh.vertices @ place[:3, :3].T + place[:3, 3])
        colour = RING if name.startswith("ring") else None
        meshes.append(VisualMesh(name, frames.index(link) - 1, vertices, faces, colour))
    return tuple(meshes)


def _constant(values: ArrayLike) -> Array:
    """Return a read-only copy."""
    array = np.array(values, dtype=float)
    array.flags.writeable = False
    return array
