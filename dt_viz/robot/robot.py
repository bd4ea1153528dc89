"""An arm: its kinematics, limits, shapes, and what is known of it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.blocks import MOST_JOINTS
from dt_viz.kernels.proximity import least_contacts
from dt_viz.kernels.tracking import TrackingArm
from dt_viz.memo import cached_property
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import page_names
from dt_viz.robot.urdf import LinkMesh, VisualMesh, constant

_Settings = TypeVar("_Settings")


def scales(default: float, power: float = 1) -> Any:  # noqa: ANN401 - as `dataclasses.field`
    """Default of a field, in metres to a power, given for an arm as large as the JACO; it scales with the reach."""
    return field(default=default, metadata={"metres": power})


def sized(settings: _Settings, size: float) -> _Settings:
    """Settings, a frozen dataclass, for an arm whose reach is `size` times the JACO's."""
    return _sized(settings, size)


@lru_cache(maxsize=64)
def _sized(settings: Any, size: float) -> Any:  # noqa: ANN401 - as `sized`
    powers: dict[str, float] = {own.name: own.metadata.get("metres", 0) for own in fields(settings)}
    scaled = {name: getattr(settings, name) * size**power for name, power in powers.items() if power}
    return replace(settings, **scaled)


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of `dt_viz.robot.inverse_kinematics`, which compiled loops take, too.

    `scales` marks what is given for an arm as large as the JACO, and scales with an arm's reach.
    """

    direction_weight: float = 1.5
    """Weight w_d of the hand's direction (unit vectors) against joint angles (rad). Much above 2, the best posture
    stops being unique and tracked joints jump between wrist postures."""
    asked_direction_weight: float = 40.0
    """Weight w_d where inverse kinematics is given a direction: it chooses one posture and need not be continuous."""
    orientation_weight: float = 1000.0
    """Weight w_o of the hand's orientation (rad), where one is wanted, against joint angles (rad). Its place comes
    first."""
    first_orientation_weight: float = 30.0
    """That weight until postures have settled: with the whole of it they find their branch of the wrist less often."""
    as_well_turned: float = 0.05
    """Angle by which the hand may be turned farther beside its orientations along a path from a start of a better
    posture, rad."""
    turning_sweeps: int = 30
    """Largest number of sweeps that improve the posture where orientations are wanted."""
    turn_length: float = scales(0.2)
    """Length that a turn of the hand by one radian counts along a path, metres."""
    limit_weight: float = 50.0
    """Weight of the springs before the joint limits, against 1 for staying near the reference."""
    limit_margin: float = 0.15
    """Distance from the limit at which those springs start, rad."""
    damping_floor: float = scales(1e-6, 2)
    """Least damping λ₀² of the pseudo-inverse, m²: bounds the step at a singularity, is negligible elsewhere."""
    damping_per_error: float = scales(0.2)
    """Growth of λ² with the remaining error, m: about half the curvature of the forward kinematics."""
    curvature: float = scales(0.1)
    """Curvature of the forward kinematics along the null space, m per rad²; see `dt_viz.kernels.tracking`."""
    step_limit: float = 0.4
    """Largest joint motion in one step, rad; beyond it the linear model is invalid."""
    stride: float = scales(0.08)
    """Distance along the path that a cold start covers in one step, metres."""
    max_sweeps: int = 8
    """Largest number of sweeps that improve the posture, too."""
    final_sweeps: int = 3
    """Largest number of sweeps after them, which keep the posture and only correct the positions."""
    step_tolerance: float = 1e-3
    """Step, rad, below which a waypoint is done: the remaining error is about its square times the reach."""
    jump_per_root_metre: float = scales(4.0, -0.5)
    """Joint motion over the root of the hand's, rad/√m, above which a warm start has lost its branch. The stretched arm
    follows the root: 0.4 rad bend it by 2 cm."""
    singular_manipulability: float = scales(3e-3, 3)
    """Manipulability, m³, below which the damping takes about 1 % or more of a step; the workspace has 0.05 to 0.2."""
    hand_pitch: float = math.radians(40.0)
    """Angle of the hand below horizontal, rad, where inverse kinematics is asked for no other."""
    num_restarts: int = 24
    """Number of postures that inverse kinematics begins from."""
    max_iterations: int = 60
    """Largest number of its steps."""
    tolerance: float = 1e-5
    """Distance from its target, metres, below which that counts as reached."""
    floor_weight: float = scales(100.0, -1)
    """Cost per metre of a joint below the table, where it chooses among its solutions."""


LEAST_JOINTS = 3  # smallest number of joints of an arm whose hand can be taken anywhere


@dataclass(frozen=True, eq=False)
class Robot(Kinematics):
    """An arm of n joints, all that is known of it.

    Its frame is that of the arm's base, turned about z so that the arm's front is −y; see `in_base_frame`.
    """

    name: str  # short name, such as "jaco"
    title: str  # name on the page
    joint_names: tuple[str, ...]  # names of the n joints, base to hand
    lower: Array  # (n,) lower limits, rad; −inf for continuous joints
    upper: Array  # (n,) upper limits, rad; +inf for continuous joints
    velocity_limits: Array  # (n,) rad/s
    home: Array  # (n,) ready pose, rad
    levers: Array
    """(n,) motion of the hand for each joint's turning, m/rad, about: converts a distance of postures to a length."""
    body: BodyPoints  # body points of all links
    meshes: tuple[LinkMesh, ...]  # collision shapes of the links, from the base to the finger tips
    visuals: tuple[VisualMesh, ...]  # what is drawn of the links
    num_fixed: int
    """Number of first joints whose links no motion moves away from an obstacle: that of a joint at the base only
    spins."""
    touching: frozenset[frozenset[str]]
    """Pairs of links that may touch, besides neighbours, by name."""
    base: Array  # (3, 3) rotation from the URDF's base to this frame
    urdf: Path  # file that describes the arm
    package_dirs: tuple[Path, ...]
    """Folders in which the `package://` addresses of its meshes resolve."""
    tracking: TrackingSettings = field(default=TrackingSettings())
    """Settings of inverse kinematics and tracking, their lengths for an arm as large as the JACO."""
    found: tuple[tuple[str, str], ...] = ()  # what was chosen of it, and why
    front: tuple[float, float, float] = (0.0, -1.0, 0.0)  # horizontal unit vector to where it works

    def __post_init__(self) -> None:
        """Raise ValueError for fewer joints than the hand has coordinates, or more than compiled loops take."""
        if not LEAST_JOINTS <= self.num_joints <= MOST_JOINTS:
            accepted = f"{LEAST_JOINTS} to {MOST_JOINTS} between base and hand"
            raise ValueError(f"{self.name}: found {self.num_joints} joints; accepted: {accepted}")

    def in_base_frame(self) -> Robot:
        """The same arm in the frame of its URDF's base, whatever its front is."""
        if np.array_equal(self.base, np.eye(3)):
            return self
        back, spheres = self.base.T, self.body.spheres.copy()
        fixed = spheres["joint"] < 0
        spheres["offset"][fixed] = spheres["offset"][fixed] @ back.T
        return replace(
            self.turned(back),
            body=BodyPoints(spheres),
            meshes=tuple(mesh.turned(back) for mesh in self.meshes),
            visuals=tuple(mesh.turned(back) for mesh in self.visuals),
            base=constant(np.eye(3)),
            front=tuple((back @ self.front).tolist()),
        )

    def report(self) -> str:
        """Say what was chosen of the arm, and why, a line for each."""
        width = max((len(what) for what, _ in self.found), default=0)
        title = f"{self.title}: {self.num_joints} joints, reach {self.reach:.2f} m"
        return "\n".join([title, *(f"  {what:{width}}  {why}" for what, why in self.found)])

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

    @cached_property
    def top_speed(self) -> float:
        """Largest speed of any point, m/s, each joint at its limit: a fifth more than by levers, which are means."""
        return float(1.2 * self.levers @ self.velocity_limits)

    def pairs(self, between: int) -> Indices:
        """Pairs (K, 2) of body points, by their own spheres, that may not touch, with so many joints between them."""
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
