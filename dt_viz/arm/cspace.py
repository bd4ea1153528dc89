"""Whole-arm avoidance: diffeomorphisms of configuration space (sec. 4.5).

A configuration is six joint angles, rad. `WholeArmField` is a generator V_q on R⁶ whose reverse flow carries the arm
out of an obstacle; `JointLimits` bends R⁶ so that no flow leaves the joint limits. Derivatives are exact to rounding by
complex steps: f(q + ih·u) = f(q) + ih·Df(q)·u + O(h²), with no difference of near numbers, so h can be tiny.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.arm.body_points import BodyPoints
from dt_viz.arm.robot import NUM_JOINTS, KinematicChain, Robot, cross
from dt_viz.arm.tracking import DIRECTION_WEIGHT
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array, Indices
from dt_viz.interruption import checkpoint
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.properties import cached_property

COMPLEX_STEP = 1e-30
DIFFERENCE = 1e-4
"""Step of the finite differences for the slope of an obstacle's distance, metres."""

REACH_PER_TEMPERATURE = 0.08 / 6
"""Reach of an obstacle's field, metres, for each unit of the temperature T."""
CORE = 0.5
"""Depth at which the field has its full strength, as a part of the way from touching the obstacle to its middle; deeper
inside the strength is constant, so the middle is not singular."""
SHARPNESS = 2
"""Exponent p of the smooth maximum over body points: stronger contacts count more."""
FAN = 4.0
"""Distance of the source, from which escaping points fan out, behind the obstacle's middle, in the obstacle's radii."""
BEHIND = 1.25
"""Lower bound of that distance, in multiples of the field's outer radius, for no point may escape from the source."""
DAMPING = 0.06
"""Damping λ of the contact's pseudo-inverse, m/rad: contacts that joints can hardly move are not chased."""
HAND_WEIGHT = 100.0
"""Weight of the end effector's motion, rad²/m²: a contact of the forearm is resolved with the hand at rest."""
LEVERS = np.array([0.5, 0.5, 0.35, 0.12, 0.14, 0.05])
"""Approximate motion of the hand for each joint's turning, m/rad: converts a distance of postures to a length."""
PIN = 0.03
"""Size of the region around a pinned posture in which the field fades out, metres of that distance."""

BLOCK = 4096
"""Size of one joint's angles in what is evaluated in one step, bytes: intermediate results stay in the cache."""

SPEED = 0.2
"""Distance that a contact at full strength escapes in a unit of flow time, metres."""

LIMIT_ZONE = 0.05
"""Width of the zone before a joint limit in which joints are held back, rad."""
NEAREST_TO_LIMIT = 0.9
"""Part of that zone that a planned path may use."""


@dataclass(frozen=True, eq=False)
class ArmField:
    """Base of the generators V_q on R⁶ of an arm and an obstacle."""

    robot: Robot
    body: BodyPoints
    """Body points that can be moved away."""
    obstacle: Obstacle

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return NUM_JOINTS

    @cached_property
    def _core(self) -> Array:
        return -CORE * (self.obstacle.depth + self.body.radius)[:, None]

    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, 6), as (N, 6)."""
        raise NotImplementedError

    def with_jacobian(self, q: Array) -> tuple[Array, Array]:
        """Compute V_q (N, 6) and DV_q (N, 6, 6) at configurations `q` (N, 6)."""
        num, d = q.shape
        shifted: Any = (q + 1j * COMPLEX_STEP * np.eye(d)[:, None]).reshape(-1, d)  # fields take complex angles, too
        values = self(shifted).reshape(d, num, d)
        return values[0].real, values.imag.transpose(1, 2, 0) / COMPLEX_STEP

    def _distances(self, points: Array) -> Array:
        """Return the distances (P, N) of the body points' spheres, at `points` (P, 3, N), from the obstacle."""
        return self.obstacle.signed_distance(points.transpose(0, 2, 1)) - self.body.radius[:, None]


@dataclass(frozen=True, eq=False)
class WholeArmField(ArmField):
    """Generator V_q whose reverse flow takes the arm out of an obstacle along an escape direction.

    A body point x_b with sphere radius r_b has the occupancy w_b = S(d(x_b) − r_b), d the distance from the obstacle's
    surface and S a smooth step from 1 inside to 0 at `reach`. The arm's contact is the average of its body points with
    weights ŵ_b = w_b^p / Σw^p, with the Jacobian J_c = Σ ŵ_b J_b, the direction n_c = Σ ŵ_b n_b and the strength
    m = (Σ w_b^p)^(1/p). It escapes by the weighted pseudo-inverse

        −V_q(q) = v · m · χ(q) · H⁻¹ J_cᵀ (J_c H⁻¹ J_cᵀ + λ²I)⁻¹ n_c,   H = I + w_d DᵀD + w_x JᵀJ,

    which moves the contact along n_c with as little motion of the joints, the hand's direction (D) and the end effector
    (J) as possible. χ vanishes at pinned postures, so start and goal do not move.

    The plain gradient ∇_q ΣU(x_b) of the paper (`GradientField`) follows the joints' mobility instead: it sweeps along
    the path with the first joint and turns sharply, see dt_viz/README.md.
    """

    direction: Array
    """n, (3,) unit vector in which the arm escapes."""
    pins: Array
    """(K, 6) postures that do not move, rad."""
    reach: float = 6 * REACH_PER_TEMPERATURE
    """Distance from the obstacle's surface at which the field ends, metres."""

    @cached_property
    def _source(self) -> Array:
        end = self.obstacle.radius + self.reach + self.body.radius.max()
        behind = max(FAN * self.obstacle.radius, BEHIND * end)
        return (np.asarray(self.obstacle.position) - behind * self.direction)[:, None]

    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, 6), as (N, 6)."""
        size = BLOCK // q.itemsize
        if len(q) > size:
            return np.concatenate([self(q[i : i + size]) for i in range(0, len(q), size)])
        checkpoint()
        chain = self.robot.chain(q.T)
        points = self.body.of_chain(chain)
        distance = self._distances(points)
        close = (distance.real < self.reach).any(axis=1)  # points away from the obstacle have no weight
        velocity = np.zeros_like(q)
        if not close.any():
            return velocity
        u = (self.reach - distance[close]) / (self.reach - self._core[close])
        powers, points = _fading(u) ** SHARPNESS, points[close]  # (P', N), (P', 3, N)
        total = powers.sum(axis=0)
        near = np.flatnonzero(total.real > 0)
        if len(near) < len(q):
            chain = KinematicChain(*(_columns(part, near) for part in chain))
            points, powers, total = _columns(points, near), _columns(powers, near), total[near]
        weights = powers / total
        outward = points - self._source
        outward = outward / np.sqrt((outward * outward).sum(axis=1, keepdims=True))
        wanted = SPEED * total ** (1 / SHARPNESS) * (weights[:, None] * outward).sum(axis=0)  # (3, M)
        # J_c = Σ ŵ_b J_b: each joint moves the points beyond it
        beyond = self.body.is_beyond[:, close]
        lever = (beyond @ (weights[:, None] * points).reshape(len(points), -1)).reshape(NUM_JOINTS, 3, -1)
        lever -= (beyond @ weights)[:, None] * chain.origins
        J = cross(chain.axes[:, 2], lever) / DAMPING  # (6, 3, M)
        stays = [
            np.sqrt(DIRECTION_WEIGHT) * chain.direction_jacobian(),
            np.sqrt(HAND_WEIGHT) * chain.position_jacobian(),
        ]
        # H⁻¹Jᵀ(JH⁻¹Jᵀ + λ²I)⁻¹ = (H + JᵀJ/λ²)⁻¹Jᵀ/λ²: one system in place of two
        A = np.concatenate([J, *stays], axis=1).transpose(2, 1, 0)  # (M, 9, 6)
        resistance = np.eye(NUM_JOINTS) + A.transpose(0, 2, 1) @ A
        pull = (J * (wanted / DAMPING)).sum(axis=1).T
        turning = np.linalg.solve(resistance, pull[..., None])[..., 0]
        velocity[near] = -turning * self._freedom(q[near])[:, None]
        return velocity

    def _freedom(self, q: Array) -> Array:
        """Compute χ, (N,): 0 at the pins, 1 away from them."""
        return np.prod(1 - np.exp(-squared_lengths(q, self.pins) / (2 * PIN**2)), axis=1)


@dataclass(frozen=True, eq=False)
class GradientField(ArmField):
    """The paper's generator V_q = ∇_q Σ_b U(x_b), U the occupancy w_b of `WholeArmField` times the depth it grows over.

    It moves start and goal, too, and ignores the motion of the hand.
    """

    reach: float = 6 * REACH_PER_TEMPERATURE
    """Distance from the obstacle's surface at which the field ends, metres."""

    def __call__(self, q: Array) -> Array:
        """Compute V_q at configurations `q` (N, 6), as (N, 6)."""
        chain = self.robot.chain(q.T)
        points = self.body.of_chain(chain)
        distance = self._distances(points)
        u = _unit_interval((self.reach - distance) / (self.reach - self._core))
        force: Array = -30 * (u * u * (1 - u) * (1 - u))[:, None] * self._outward(points)  # the slope of `_fading`
        moment = self._beyond(cross(points, force)) - cross(chain.origins, self._beyond(force))
        return (chain.axes[:, 2] * moment).sum(axis=1).T

    def _beyond(self, values: Array) -> Array:
        """Sum `values` (P, 3, N), for each joint over the points that it moves, (6, 3, N)."""
        return (self.body.is_beyond @ values.reshape(len(values), -1)).reshape(NUM_JOINTS, *values.shape[1:])

    def _outward(self, points: Array) -> Array:
        """Compute the slope (P, 3, N) of the obstacle's distance at `points` (P, 3, N) by differences, analytic."""
        shifts = DIFFERENCE * np.eye(3)[:, None, None]
        s = points.transpose(0, 2, 1)
        near, far = (self._change(s, k * shifts) for k in (1, 2))  # (3, P, N)
        return ((8 * near - far) / (12 * DIFFERENCE)).transpose(1, 0, 2)

    def _change(self, s: Array, shifts: Array) -> Array:
        return self.obstacle.signed_distance(s + shifts) - self.obstacle.signed_distance(s - shifts)


@dataclass(frozen=True, eq=False)
class JointLimits(Diffeomorphism):
    """Map from the configurations inside the joint limits onto R⁶: flows there correspond to flows inside the limits.

    With e the depth of a joint in the zone of width m before its limit, ψ⁻¹ is the flow of ė = −e³ for the time
    1/(2m²), which carries joints away from their limits:

        ψ⁻¹(e) = e/√(1 + (e/m)²) < m,    ψ(e) = e/√(1 − (e/m)²).

    Joints outside the zone, and continuous ones, are not changed.
    """

    lower: Array
    """(6,) rad, −inf for continuous joints."""
    upper: Array
    """(6,) rad, +inf for continuous joints."""
    zone: float = LIMIT_ZONE
    """m, rad."""
    fraction: float = 1.0
    """Part s of that time: (e/m)² becomes s·(e/m)² in both formulas."""

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return len(self.lower)

    def scaled(self, fraction: float) -> JointLimits:
        """See `Diffeomorphism`. A part of the flow does not hold joints inside their limits."""
        return replace(self, fraction=fraction * self.fraction)

    def inside(self, q: Array) -> Array:
        """Clip configurations (*B, 6) to a little less than the limits, where ψ is finite."""
        slack = (1 - NEAREST_TO_LIMIT) * self.zone
        return np.clip(q, self.lower + slack, self.upper - slack)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        free = np.clip(s.real, self.lower + self.zone, self.upper - self.zone)
        excess = s - free
        squared = (excess / self.zone) ** 2 * (self.fraction if inverse else -self.fraction)
        stretch = 1 / np.sqrt(1 + squared)
        mapped = np.where(excess == 0, s, free + excess * stretch)
        return mapped, None if U is None else (stretch**3)[..., None] * U


def squared_lengths(q: Array, pins: Array) -> Array:
    """Compute squared distances (N, K), m², of postures `q` (N, 6) from `pins` (K, 6), by `LEVERS`."""
    offset = (q * LEVERS).T[:, None] - (pins * LEVERS).T[..., None]  # the batch last, for long inner loops
    return (offset * offset).sum(axis=0).T


def _unit_interval(u: Array) -> Array:
    """Clip u, which may be complex, to the interval from 0 to 1."""
    return np.where(u.real <= 0, 0.0, np.where(u.real >= 1, 1.0, u))


def _fading(u: Array) -> Array:
    """Smooth step from 0 at u = 0 to 1 at u = 1, with two derivatives of 0 at both ends."""
    u = _unit_interval(u)
    return u * u * u * (10 - 15 * u + 6 * u * u)


def _columns(values: Array, columns: Indices) -> Array:
    """Select columns of the last axis and keep it innermost in memory, which indexing would not."""
    return values.take(columns, axis=-1)
