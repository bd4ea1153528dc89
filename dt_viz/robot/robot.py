"""An arm: its kinematics, limits, shapes, and what is known of it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.blocks import MOST_JOINTS
from dt_viz.kernels.proximity import least_contacts
from dt_viz.kernels.tracking import TrackingArm
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import page_names
from dt_viz.robot.meshes import LinkMesh, VisualMesh, constant
from dt_viz.robot.sizing import sized
from dt_viz.robot.tracking_settings import TrackingSettings

LEAST_JOINTS = 3
"""Smallest number of joints of an arm whose hand can be taken anywhere."""


@dataclass(frozen=True, eq=False)
class Robot(Kinematics):
    """An arm of n joints, all that is known of it.

    Its frame is that of the arm's base, turned about z so that the arm's front is −y; see `in_base_frame`.
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
    found: tuple[tuple[str, str], ...] = ()
    """What was chosen of it, and why."""
    front: tuple[float, float, float] = (0.0, -1.0, 0.0)
    """Horizontal unit vector to where it works."""

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
