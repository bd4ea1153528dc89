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
"""Metres between a point and those that the slope of an obstacle's distance is taken from."""

REACH_PER_TEMPERATURE = 0.08 / 6
"""Metres from an obstacle at which its field ends, for each unit of the temperature T."""
CORE = 0.5
"""Where the field has its full strength: part of the way from touching the obstacle to sitting on its middle. Deeper
inside it is flat, and nothing special happens at the middle itself."""
SHARPNESS = 2
"""p of the smooth maximum over body points: the stronger a contact, the more it counts."""
FAN = 4.0
"""Distance behind the obstacle's middle, in its radii, of the point from which escaping points fan out."""
BEHIND = 1.25
"""The same, at least, in distances at which the field ends: the point itself is no place to escape from."""
DAMPING = 0.06
"""λ of the contact's pseudo-inverse, metres per rad: a contact that joints can hardly move is not chased."""
HAND_WEIGHT = 100.0
"""Of the end effector's motion, rad² per m²: a forearm in contact is moved by what leaves the hand where it is."""
LEVERS = np.array([0.5, 0.5, 0.35, 0.12, 0.14, 0.05])
"""How far the hand moves when a joint turns, metres per rad, about: makes a distance of postures a length."""
PIN = 0.04
"""Size of the region around a pinned posture in which the field fades to nothing, metres of that distance."""

BLOCK = 256
"""Configurations that a field is worked out for at once: of more, what is worked out on the way leaves the cache."""

SPEED = 0.2
"""Metres that a contact at full strength escapes in a unit of flow time."""

LIMIT_ZONE = 0.05
"""Before a joint limit, in which joints are held back, rad."""
NEAREST_TO_LIMIT = 0.9
"""Part of that zone that a planned path may use."""


@dataclass(frozen=True, eq=False)
class WholeArmField:
    """Generator V_q whose reverse flow takes the arm out of an obstacle along an escape direction.

    A body point x_b with sphere radius r_b has the occupancy w_b = S(d(x_b) − r_b), d the distance from the obstacle's
    surface and S a smooth step from 1 inside to 0 at `reach`. The arm's contact is the average of its body points with
    weights ŵ_b = w_b^p / Σw^p, with the Jacobian J_c = Σ ŵ_b J_b, the direction n_c = Σ ŵ_b n_b and the strength
    m = (Σ w_b^p)^(1/p). It escapes by the weighted pseudo-inverse

        −V_q(q) = v · m · χ(q) · H⁻¹ J_cᵀ (J_c H⁻¹ J_cᵀ + λ²I)⁻¹ n_c,   H = I + w_d DᵀD + w_x JᵀJ,

    which moves the contact along n_c with as little motion of the joints, the hand's direction (D) and the end effector
    (J) as can be. χ vanishes at pinned postures, so start and goal stay where they are.

    The plain gradient ∇_q ΣU(x_b) of the paper (`GradientField`) follows the joints' mobility instead: it sweeps along
    the path with the first joint and turns sharply, see README "Departures".
    """

    robot: Robot
    body: BodyPoints
    """That can be carried away."""
    obstacle: Obstacle
    direction: Array
    """n, (3,) unit vector in which the arm escapes."""
    pins: Array
    """(K, 6) postures that stay, rad."""
    reach: float = 6 * REACH_PER_TEMPERATURE
    """Distance from the obstacle's surface at which the field ends, metres."""

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return NUM_JOINTS

    @cached_property
    def _source(self) -> Array:
        end = self.obstacle.radius + self.reach + self.body.radius.max()
        behind = max(FAN * self.obstacle.radius, BEHIND * end)
        return (np.asarray(self.obstacle.position) - behind * self.direction)[:, None]

    @cached_property
    def _core(self) -> Array:
        return -CORE * (self.obstacle.depth + self.body.radius)[:, None]

    def __call__(self, q: Array) -> Array:
        """V_q at configurations `q` (N, 6), as (N, 6)."""
        if len(q) > BLOCK:
            return np.concatenate([self(q[i : i + BLOCK]) for i in range(0, len(q), BLOCK)])
        checkpoint()
        chain = self.robot.chain(q.T)
        points = self.body.of_chain(chain)
        distance = self.obstacle.signed_distance(points.transpose(0, 2, 1)) - self.body.radius[:, None]
        close = (distance.real < self.reach).any(axis=1)  # what stays away from the obstacle has no weight
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
        stays = [
            np.sqrt(DIRECTION_WEIGHT) * chain.direction_jacobian(),
            np.sqrt(HAND_WEIGHT) * chain.position_jacobian(),
        ]
        A = np.concatenate(stays, axis=1).transpose(2, 1, 0)  # (M, 6, 6)
        H = np.eye(NUM_JOINTS) + A.transpose(0, 2, 1) @ A
        # J_c = Σ ŵ_b J_b: each joint turns what lies beyond it
        beyond = self.body.is_beyond[:, close]
        lever = (beyond @ (weights[:, None] * points).reshape(len(points), -1)).reshape(NUM_JOINTS, 3, -1)
        lever -= (beyond @ weights)[:, None] * chain.origins
        J = cross(chain.axes[:, 2], lever).transpose(2, 1, 0)  # (M, 3, 6)
        mobile = np.linalg.solve(H, J.transpose(0, 2, 1))
        pull = np.linalg.solve(J @ mobile + DAMPING**2 * np.eye(3), wanted.T[..., None])
        velocity[near] = -(mobile @ pull)[..., 0] * self._freedom(q[near])[:, None]
        return velocity

    def with_jacobian(self, q: Array) -> tuple[Array, Array]:
        """V_q (N, 6) and DV_q (N, 6, 6) at configurations `q` (N, 6)."""
        return by_complex_steps(self, q)

    def _freedom(self, q: Array) -> Array:
        """χ, (N,): 0 at the pins, 1 away from them."""
        return np.prod(1 - np.exp(-squared_lengths(q, self.pins) / (2 * PIN**2)), axis=1)


@dataclass(frozen=True, eq=False)
class GradientField:
    """The paper's generator V_q = ∇_q Σ_b U(x_b), U the occupancy w_b of `WholeArmField` times the depth it grows over.

    It takes no care of start and goal, nor of how the hand moves.
    """

    robot: Robot
    body: BodyPoints
    """That can be carried away."""
    obstacle: Obstacle
    reach: float = 6 * REACH_PER_TEMPERATURE
    """Distance from the obstacle's surface at which the field ends, metres."""

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return NUM_JOINTS

    def __call__(self, q: Array) -> Array:
        """V_q at configurations `q` (N, 6), as (N, 6)."""
        chain = self.robot.chain(q.T)
        points = self.body.of_chain(chain)
        core = -CORE * (self.obstacle.depth + self.body.radius)[:, None]
        distance = self.obstacle.signed_distance(points.transpose(0, 2, 1)) - self.body.radius[:, None]
        u = _unit_interval((self.reach - distance) / (self.reach - core))
        force: Array = -30 * (u * u * (1 - u) * (1 - u))[:, None] * self._outward(points)  # the slope of `_fading`
        moment = self._beyond(cross(points, force)) - cross(chain.origins, self._beyond(force))
        return (chain.axes[:, 2] * moment).sum(axis=1).T

    def _beyond(self, values: Array) -> Array:
        """Sums (6, 3, N) of `values` (P, 3, N): for each joint over the points that it turns."""
        return (self.body.is_beyond @ values.reshape(len(values), -1)).reshape(NUM_JOINTS, *values.shape[1:])

    def _outward(self, points: Array) -> Array:
        """Slope (P, 3, N) of the obstacle's distance at `points` (P, 3, N), by differences: analytic as it is."""
        shifts = DIFFERENCE * np.eye(3)[:, None, None]
        s = points.transpose(0, 2, 1)
        near, far = (self._change(s, k * shifts) for k in (1, 2))  # (3, P, N)
        return ((8 * near - far) / (12 * DIFFERENCE)).transpose(1, 0, 2)

    def _change(self, s: Array, shifts: Array) -> Array:
        return self.obstacle.signed_distance(s + shifts) - self.obstacle.signed_distance(s - shifts)

    def with_jacobian(self, q: Array) -> tuple[Array, Array]:
        """V_q (N, 6) and DV_q (N, 6, 6) at configurations `q` (N, 6)."""
        return by_complex_steps(self, q)


@dataclass(frozen=True, eq=False)
class JointLimits(Diffeomorphism):
    """From the configurations inside the joint limits onto all of R⁶: whatever flows there stays inside here.

    With e the distance by which a joint is inside the zone of width m before its limit, ψ⁻¹ is the flow of ė = −e³
    for the time 1/(2m²), which carries joints away from their limits:

        ψ⁻¹(e) = e/√(1 + (e/m)²) < m,    ψ(e) = e/√(1 − (e/m)²).

    Joints outside the zone, and continuous ones, stay as they are.
    """

    lower: Array
    """(6,) rad, −inf for continuous joints."""
    upper: Array
    """(6,) rad, +inf for continuous joints."""
    zone: float = LIMIT_ZONE
    """m, rad."""
    fraction: float = 1.0
    """s, the part of that time that is flown: (e/m)² becomes s·(e/m)² in both formulas."""

    @property
    def dim(self) -> int:
        """Dimension of configuration space."""
        return len(self.lower)

    def scaled(self, fraction: float) -> JointLimits:
        """See `Diffeomorphism`. Less than all of it does not hold joints inside their limits."""
        return replace(self, fraction=fraction * self.fraction)

    def inside(self, q: Array) -> Array:
        """Configurations (*B, 6) kept a little away from the limits, where ψ is finite."""
        slack = (1 - NEAREST_TO_LIMIT) * self.zone
        return np.clip(q, self.lower + slack, self.upper - slack)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        free = np.clip(s.real, self.lower + self.zone, self.upper - self.zone)
        excess = s - free
        squared = (excess / self.zone) ** 2 * (self.fraction if inverse else -self.fraction)
        stretch = 1 / np.sqrt(1 + squared)
        mapped = np.where(excess == 0, s, free + excess * stretch)
        return mapped, None if U is None else (stretch**3)[..., None] * U


def by_complex_steps(field: WholeArmField | GradientField, q: Array) -> tuple[Array, Array]:
    """A field (N, 6) and its derivative (N, 6, 6) at configurations `q` (N, 6)."""
    num, d = q.shape
    shifted: Any = (q + 1j * COMPLEX_STEP * np.eye(d)[:, None]).reshape(-1, d)  # the field takes complex angles, too
    values = field(shifted).reshape(d, num, d)
    return values[0].real, values.imag.transpose(1, 2, 0) / COMPLEX_STEP


def squared_lengths(q: Array, pins: Array) -> Array:
    """Squared distances (N, K), m², of the postures `q` (N, 6) from the postures `pins` (K, 6), by `LEVERS`."""
    offset = (q * LEVERS).T[:, None] - (pins * LEVERS).T[..., None]  # the batch last, for long inner loops
    return (offset * offset).sum(axis=0).T


def _unit_interval(u: Array) -> Array:
    """U where it is between 0 and 1, else the nearer of them."""
    return np.where(u.real <= 0, 0.0, np.where(u.real >= 1, 1.0, u))


def _fading(u: Array) -> Array:
    """A step from 0 at u = 0 to 1 at u = 1 with two derivatives of 0 at both ends."""
    u = _unit_interval(u)
    return u * u * u * (10 - 15 * u + 6 * u * u)


def _columns(values: Array, columns: Indices) -> Array:
    """Some columns of the last axis, which stays the one of the inner loops; indexing would put it first in memory."""
    return values.take(columns, axis=-1)
