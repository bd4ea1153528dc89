"""Whole-arm avoidance: diffeomorphisms of configuration space (sec. 4.5).

A configuration is n joint angles, rad. `WholeArmField` is a generator V_q on Rⁿ whose reverse flow carries the arm
out of an obstacle; `JointLimits` bends Rⁿ so that no flow leaves the joint limits.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import numpy as np

from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array, CompiledField
from dt_viz.kernels import escape
from dt_viz.kernels.runge_kutta import RATE
from dt_viz.memo import cached_property
from dt_viz.obstacles.shapes import Obstacle, records
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.kinematics import cross
from dt_viz.robot.robot import Robot, scales, sized
from dt_viz.scheduler import checkpoint


@dataclass(frozen=True)
class WholeArmSettings:
    """Settings of `dt_viz.avoidance.arm`, of its field, and of the reference postures."""

    reach_per_temperature: float = scales(0.08 / 6)
    """Reach of an obstacle's field, metres, for each unit of the temperature T."""
    beyond: float = scales(0.03)
    """Reach of the field of a robot in the loop beyond the margin, metres, at least."""
    core: float = 0.5
    """Depth at which the field has its full strength, as a part of the way from touching the obstacle to its middle;
    deeper inside the strength is constant, so the middle is not singular."""
    fan: float = 4.0
    """Distance of the source, from which escaping points fan out, behind the obstacle's middle, in the obstacle's
    radii."""
    behind: float = 1.25
    """Lower bound of that distance, in multiples of the field's outer radius, for no point may escape from the
    source."""
    damping: float = scales(0.06)
    """Damping λ of the contact's pseudo-inverse, m/rad: contacts that joints can hardly move are not chased."""
    hand_weight: float = scales(100.0, -2)
    """Weight of the end effector's motion, rad²/m²: a contact of the forearm is resolved with the hand at rest."""
    pin: float = scales(0.02)
    """Size of the region around a pinned posture in which the field fades out, metres by `Robot.levers`."""
    speed: float = scales(0.2)
    """Distance that a contact at full strength escapes in a unit of flow time, metres."""
    coarse_spacing: float = scales(0.025)
    """Largest distance between neighbouring samples of coarse motions, metres at the hand, about."""
    beside: float = scales(0.20)
    """Clearance up to which a sample is bent along with the colliding ones, metres."""
    together: float = scales(0.05)
    """Clearance from another obstacle up to which a colliding posture meets both, metres."""
    opposed: float = -0.5
    """Cosine of the angle between the escapes from two obstacles beyond which both are left in one direction."""
    duration_change: float = scales(50.0, -1)
    """Largest change of the flow time for each metre that an obstacle is dragged: contacts move by 1 cm a
    millimetre."""
    alike: float = scales(0.15)
    """Root mean square distance of postures, by `Robot.levers`, up to which reference postures are alike, metres."""
    in_the_way: float = 10.0
    """Cost of each metre that the mean motion lacks of the clearance that is asked for, against a metre from the usual
    postures."""
    at_ends: float = 40.0  # factor by which that costs more at the ends of the motion
    ends: float = scales(0.06)  # distance from them over which this fades, metres

    @classmethod
    def of(cls, robot: Robot) -> WholeArmSettings:
        """The settings for an arm."""
        return sized(cls(), robot.size)


DIFFERENCE = 1e-4  # step of the finite differences for the slope of an obstacle's distance, metres

NEAREST_TO_LIMIT = 0.9  # part of the zone before a joint limit that a planned path may use


@dataclass(frozen=True, eq=False)
class ArmField(ABC):
    """Base of the generators V_q on Rⁿ of an arm and obstacles."""

    robot: Robot
    body: BodyPoints  # body points that can be moved away
    obstacles: tuple[Obstacle, ...]

    @cached_property
    def settings(self) -> WholeArmSettings:
        """Settings for the arm."""
        return WholeArmSettings.of(self.robot)

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return self.robot.num_joints

    @abstractmethod
    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, n), as (N, n)."""


@dataclass(frozen=True, eq=False)
class WholeArmField(ArmField, CompiledField):
    """Generator V_q whose reverse flow takes the arm out of obstacles, each along an escape direction.

    A body point x_b with sphere radius r_b has the occupancy w_b = S(d(x_b) − r_b), d the distance from an obstacle's
    surface and S a smooth step from 1 inside to 0 at `reach`. The arm's contact is the average of its body points with
    weights ŵ_b = w_b²/Σw², with the Jacobian J_c = Σ ŵ_b J_b, the direction n_c = Σ ŵ_b n_b and the strength
    m = √Σw_b². It escapes by the weighted pseudo-inverse

        −V_q(q) = v · m · χ(q) · H⁻¹ J_cᵀ (J_c H⁻¹ J_cᵀ + λ²I)⁻¹ n_c,   H = I + w_d DᵀD + w_x JᵀJ,

    which moves the contact along n_c with as little motion of the joints, the hand's direction (D) and the end effector
    (J) as possible. χ vanishes at pinned postures, so start and goal do not move. Those of several obstacles add up.

    The plain gradient ∇_q ΣU(x_b) of the paper (`GradientField`) follows the joints' mobility instead: it sweeps along
    the path with the first joint and turns sharply, see dt_viz/README.md.
    """

    directions: Array  # (K, 3) unit vectors in which the arm escapes from the obstacles
    pins: Array  # (M, n) postures that do not move, rad
    reach: float  # distance from an obstacle's surface at which the field ends, metres

    @cached_property
    def _escape(self) -> escape.Escape:
        radius = np.array([obstacle.radius for obstacle in self.obstacles])
        depth = np.array([obstacle.depth for obstacle in self.obstacles])
        settings = self.settings
        behind = np.maximum(settings.fan * radius, settings.behind * (radius + self.reach + self.body.radius.max()))
        places = np.array([obstacle.position for obstacle in self.obstacles])
        shapes, values = records(self.obstacles)
        return escape.Escape(
            joints=self.robot.records,
            points=self.body.outermost.spheres,
            hand=np.array(self.robot.end_effector_offset),
            axis=np.array(self.robot.hand_axis),
            shapes=shapes,
            values=values,
            sources=places - behind[:, None] * self.directions,
            cores=-settings.core * (depth[:, None] + self.body.radius),
            reach=float(self.reach),
            speed=settings.speed,
            damping=settings.damping,
            direction_weight=self.robot.tracking.direction_weight,
            hand_weight=settings.hand_weight,
            pins=np.array(self.pins, dtype=float),
            levers=np.array(self.robot.levers),
            pin=settings.pin,
        )

    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, n), as (N, n)."""
        return self.carried(q, RATE)

    def carried(self, s: Array, method: int, duration: float = 0.0, steps: int = 1, tolerance: float = 0.0) -> Array:
        checkpoint()
        q = np.array(s, order="C")
        if num_failed := escape.carry(self._escape, q, method, float(duration), int(steps), float(tolerance)):
            raise ArithmeticError(f"{num_failed} postures need more than {steps} steps")
        return q


@dataclass(frozen=True, eq=False)
class GradientField(ArmField):
    """The paper's generator V_q = ∇_q Σ_b U(x_b), U the occupancy w_b of `WholeArmField` times the depth it grows over.

    It moves start and goal, too, and ignores the motion of the hand. Those of several obstacles add up.
    """

    reach: float  # distance from the obstacle's surface at which the field ends, metres

    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, n), as (N, n)."""
        chain = self.robot.chain(q.T)
        points = self.body.of_chain(chain)
        force: Any = sum(self._force(obstacle, points) for obstacle in self.obstacles)
        moment = self._beyond(cross(points, force)) - cross(chain.origins, self._beyond(force))
        return (chain.axes[:, 2] * moment).sum(axis=1).T

    def _force(self, obstacle: Obstacle, points: Array) -> Array:
        """Compute the forces (P, 3, N) of one obstacle on body points (P, 3, N): −30u²(1 − u)² times their way out."""
        distance = obstacle.signed_distance(points.transpose(0, 2, 1)) - self.body.radius[:, None]
        core = -self.settings.core * (obstacle.depth + self.body.radius)[:, None]
        u = np.clip((self.reach - distance) / (self.reach - core), 0, 1)
        return -30 * (u * u * (1 - u) * (1 - u))[:, None] * _outward(obstacle, points)

    def _beyond(self, values: Array) -> Array:
        """Sum `values` (P, 3, N), for each joint over the points that it moves, (n, 3, N)."""
        moves = (self.body.joint >= np.arange(self.dim)[:, None]).astype(float)
        return (moves @ values.reshape(len(values), -1)).reshape(self.dim, *values.shape[1:])


@dataclass(frozen=True, eq=False)
class JointLimits(Diffeomorphism):
    """Map from the configurations inside the joint limits onto Rⁿ: flows there correspond to flows inside the limits.

    With e the depth of a joint in the zone of width m before its limit, ψ⁻¹ is the flow of ė = −e³ for the time
    1/(2m²), which carries joints away from their limits:

        ψ⁻¹(e) = e/√(1 + (e/m)²) < m,    ψ(e) = e/√(1 − (e/m)²).

    Joints outside the zone, and continuous ones, are not changed.
    """

    SCALED = ("fraction",)
    lower: Array  # (n,) rad, −inf for continuous joints
    upper: Array  # (n,) rad, +inf for continuous joints
    zone: float = 0.05  # m, rad
    fraction: float = 1.0
    """Part s of that time: (e/m)² becomes s·(e/m)² in both formulas; less than 1 holds no joint inside its limits."""

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return len(self.lower)

    def inside(self, q: Array) -> Array:
        """Clip configurations (*B, n) to a little less than the limits, where ψ is finite."""
        slack = (1 - NEAREST_TO_LIMIT) * self.zone
        return np.minimum(np.maximum(q, self.lower + slack), self.upper - slack)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        part = self.fraction if inverse else -self.fraction
        border = np.minimum(np.maximum(s, self.lower + self.zone), self.upper - self.zone)  # of the zone; else s itself
        depth = s - border
        factor = 1 / np.sqrt(1 + part * (depth / self.zone) ** 2)
        return border + factor * depth, None if U is None else (factor**3)[..., None] * U


def _outward(obstacle: Obstacle, points: Array) -> Array:
    """Compute the slope (P, 3, N) of an obstacle's distance at `points` (P, 3, N) by differences."""
    shifts = DIFFERENCE * np.eye(3)[:, None, None]
    s = points.transpose(0, 2, 1)
    near, far = (obstacle.signed_distance(s + k * shifts) - obstacle.signed_distance(s - k * shifts) for k in (1, 2))
    return ((8 * near - far) / (12 * DIFFERENCE)).transpose(1, 0, 2)  # of (3, P, N)
