"""Modulation of our imitation's velocity around obstacles (Huber, Billard and Slotine, RA-L 4(2), 2019).

ẏ = E·D·E⁻¹·v(y) with E = [r, e₁, e₂]: r points from the obstacle's reference point, e₁ and e₂ along its surface. The
eigenvalues λ_r = 1 − 1/Γ and λ_e = 1 + 1/Γ lead the velocity past it; Γ is 1 on the surface and grows away from it.
Written from the published equations, since the authors' library `dynamic_obstacle_avoidance` is on no package index.

Motions are stepped in base space, where the imitation's own are straight: y = ψ⁻¹(z) and ż = (Dψ⁻¹)⁻¹ẏ need ψ⁻¹ only,
the quick side of ψ.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicHermiteSpline

from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.surface import distance_and_normal
from dt_viz.flows.fields import Array, Mask
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.interruption import checkpoint
from dt_viz.motion.nominal import Learned
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union

LEAST_SLANT = 0.1
"""Least n·r: beyond it the surface is not star-shaped about the reference point, and the modulation not defined."""
TOLERANCE = 1.5e-3
"""Distance of a step on the page from one of Euler's method, metres; the error is smaller by an order."""
FIRST, SHORTEST, LONGEST = 5e-3, 1e-3, 0.06
"""Length of the first step, and bounds of all, metres."""
SHRINK, GROW, SAFETY = 0.3, 2.0, 0.9
"""Bounds of the ratio of a step to the one before, and factor on the length that the tolerance allows."""
APPROACH = 0.5
"""Largest step relative to the distance from the goal, and to that from the obstacle and `BESIDE` beyond."""
BESIDE = 0.03
"""Distance that a step beside an obstacle is measured by, metres."""
NEAR_GOAL = 2e-3
"""Distance from the goal at which a motion counts as arriving, metres."""
NUM_STEPS = 2000
"""Largest number of steps."""
SLOWEST = 2e-3
"""Speed of a motion that is stuck before an obstacle, m/s."""
NUM_BETWEEN = 4
"""Number of samples for each step."""


def gamma(obstacle: Obstacle, distance: Array) -> Array:
    """Γ (N,) at distances (N,), metres: (1 + d/R)², with R the depth of the obstacle; of a sphere (‖y − c‖/R)²."""
    return (1 + np.maximum(distance, 0) / obstacle.depth) ** 2


def modulated(obstacle: Union, y: Array, v: Array) -> tuple[Array, Array]:
    """Velocities `v` (N, 3), m/s, at `y` (N, 3), metres, as the obstacles modulate them.

    Where a velocity leads away from an obstacle, λ_r is 1 (the tail effect). Several obstacles are weighted by how near
    each is, so that on the surface of one it alone counts.

    Returns:
        Velocities (N, 3), m/s, and the distances (N,), metres, from the nearest obstacle.
    """
    if not obstacle.parts:
        return v, np.full(len(y), np.inf)
    velocities, gammas, distances = [], [], []
    for part in obstacle.parts:
        distance, n = distance_and_normal(Union((part,)), y)
        r = y - np.array(part.position)
        r = r / np.maximum(np.linalg.norm(r, axis=1, keepdims=True), np.finfo(float).tiny)
        towards = np.einsum("nd,nd->n", n, v)
        along_r = towards / np.maximum(np.einsum("nd,nd->n", n, r), LEAST_SLANT)
        tangential = v - along_r[:, None] * r  # n·(v − a·r) = 0
        near = 1 / gamma(part, distance)
        radial = np.where(towards >= 0, 1.0, 1 - near) * along_r
        velocities.append(radial[:, None] * r + (1 + near)[:, None] * tangential)
        gammas.append(near)
        distances.append(distance)
    far = 1 / np.array(gammas) - 1  # (parts, N), zero on the surface
    weights = np.array([np.prod(np.delete(far, k, axis=0), axis=0) for k in range(len(far))])
    total = weights.sum(axis=0)
    weights = np.where(total > 0, weights / np.where(total > 0, total, 1), 1 / len(far))
    return np.einsum("pn,pnd->nd", weights, np.array(velocities)), np.min(distances, axis=0)


@dataclass(frozen=True, eq=False)
class _State:
    """Motions at one moment each."""

    z: Array
    rate: Array
    """ż (N, 3)."""
    y: Array
    stretch: Array
    """Dψ⁻¹ (N, 3, 3)."""
    speed: Array
    """‖ẏ‖ (N,), m/s."""
    distance: Array
    """(N,) from the obstacles, metres."""


@dataclass(frozen=True, eq=False)
class _Planner:
    learned: Learned
    tolerance: float

    @property
    def system(self) -> DiffeomorphicSystem:
        """Our imitation."""
        return self.learned.system

    def plan(self, obstacle: Union, starts: Array) -> Plan:
        """Plan motions of the end effector; see `Planner`."""
        state = self._state(obstacle, self.system.transform.forward(starts))
        states, times = [state], [np.zeros(len(starts))]
        moving, h = self._moving(state), FIRST / np.maximum(state.speed, SLOWEST)
        while moving.any() and len(states) < NUM_STEPS:
            checkpoint()
            bend = np.zeros_like(state.z)
            if len(states) > 1:  # the method of Adams and Bashforth, of order 2, with steps of their own
                last = times[-1] - times[-2]
                slope = (state.rate - states[-2].rate) / np.where(last > 0, last, 1)[:, None]
                error = np.linalg.norm((state.stretch @ slope[..., None])[..., 0], axis=1) * last**2 / 2
                allowed = SAFETY * np.sqrt(self.tolerance / np.maximum(error, np.finfo(float).tiny))
                h = self._bounded(last * np.clip(allowed, SHRINK, GROW), state)
                bend = slope * (h / 2)[:, None]
            h = np.where(moving, h, 0.0)
            state = self._state(obstacle, state.z + h[:, None] * (state.rate + bend))
            states.append(state)
            times.append(times[-1] + h)
            moving &= self._moving(state)
        return self._densely(states, np.stack(times, axis=1), starts)

    def _state(self, obstacle: Union, z: Array) -> _State:
        y, D = self.system.transform.inverse_jacobian(z)
        v, distance = modulated(obstacle, y, (D @ self.system.base.velocity(z)[..., None])[..., 0])
        rate = np.linalg.solve(D, v[..., None])[..., 0]
        return _State(z, rate, y, D, np.linalg.norm(v, axis=1), distance)

    def _bounded(self, h: Array, state: _State) -> Array:
        """Durations (N,) of the next steps, seconds, within the bounds of their lengths."""
        to_goal = np.linalg.norm(state.y - self.learned.goal, axis=1)
        most = np.minimum(APPROACH * np.minimum(to_goal, np.maximum(state.distance, 0) + BESIDE), LONGEST)
        return np.clip(h * state.speed, np.minimum(SHORTEST, most), most) / np.maximum(state.speed, SLOWEST)

    def _moving(self, state: _State) -> Mask:
        """Which motions (N,) have neither arrived nor got stuck."""
        return (np.linalg.norm(state.y - self.learned.goal, axis=1) > NEAR_GOAL) & (state.speed > SLOWEST)

    def _densely(self, states: list[_State], times: Array, starts: Array) -> Plan:
        """The motions with samples between their steps, on cubic curves, and with the goal where they arrive."""
        z, rate = (np.stack([getattr(state, name) for state in states], axis=1) for name in ("z", "rate"))
        base, ends = self.system.base, states[-1]
        arrived = np.linalg.norm(ends.y - self.learned.goal, axis=1) <= NEAR_GOAL
        within = np.arange(NUM_BETWEEN) / NUM_BETWEEN
        images, dues = [], []
        for k in range(len(starts)):
            steps = 1 + int((np.diff(times[k]) > 0).sum())
            t, nodes = times[k, :steps], z[k, :steps]
            due = np.append((t[:-1, None] + np.diff(t)[:, None] * within).ravel(), t[-1])
            image = CubicHermiteSpline(t, nodes, rate[k, :steps])(due) if steps > 1 else nodes
            if arrived[k]:
                image = np.vstack([image, base.goal])
                due = np.append(due, due[-1] + np.maximum(base.arrival_time(nodes[-1], ARRIVED), ARRIVED))
            images.append(image)
            dues.append(due)
        ends_at = np.cumsum([len(image) for image in images])[:-1]
        paths = np.split(self.system.transform.inverse(np.concatenate(images)), ends_at)
        return Plan(tuple(paths), tuple(dues))


class Modulation(Method):
    """Our imitation, its velocity modulated around the obstacles."""

    name, title = "modulation", "Modulation"
    promise = "The end effector's velocity never leads into a star-shaped obstacle; a motion may stop before one."
    stable, whole_arm, live = False, False, True

    def __init__(self, tolerance: float = TOLERANCE) -> None:
        """Choose the tolerance of a step, metres; see `TOLERANCE`."""
        self.tolerance = tolerance

    def fit(self, problem: Problem) -> Planner:
        """Take what is learned already; see `Method`."""
        return _Planner(problem.learned, self.tolerance)
