"""Modulation of our imitation's velocity around obstacles (Huber, Billard and Slotine, RA-L 4(2), 2019).

ẏ = E·D·E⁻¹·v(y) with E = [r, e₁, e₂]: r points from the obstacle's reference point, e₁ and e₂ along its surface. The
eigenvalues λ_r = 1 − 1/Γ and λ_e = 1 + 1/Γ lead the velocity past it; Γ is 1 on the surface and grows away from it.
Written from the published equations, since the authors' library `dynamic_obstacle_avoidance` is on no package index.

Motions are stepped in base space, where the imitation's own are straight: y = ψ⁻¹(z) and ż = (Dψ⁻¹)⁻¹ẏ need ψ⁻¹ only,
the quick side of ψ. The modulation is linear in the velocity, so that its paths do not depend on the imitation's pace:
they are stepped as if that were 1 in base space, where no step is lost on its changes, and timed afterwards.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np

from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.surface import distance_and_normal
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array, Mask
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.numerics import unit
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
SLOWEST = 0.01
"""Part of the imitation's speed at which a motion is stuck before an obstacle."""
LEAST = 1e-3
"""Smallest ‖dy/ds‖ that a step is measured by."""
NUM_KEPT = 4
"""Number of sets of starts whose images are kept."""
NUM_BETWEEN = 3
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
        r = unit(y - np.array(part.position))
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
    """Motions at one place each; derivatives are by the distance s that the imitation would go in base space."""

    z: Array
    rate: Array
    """dz/ds (N, 3)."""
    y: Array
    stretch: Array
    """Dψ⁻¹ (N, 3, 3)."""
    speed: Array
    """‖dy/ds‖ (N,)."""
    share: Array
    """The same relative to the imitation's (N,)."""
    distance: Array
    """(N,) from the obstacles, metres."""


@dataclass(frozen=True, eq=False)
class _Planner:
    system: DiffeomorphicSystem
    """Our imitation."""
    goal: Array
    """(3,), metres."""
    tolerance: float

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan motions of the end effector; see `Planner`."""
        state = self._state(obstacle, self._images(starts.tobytes()))
        states, gone = [state], [np.zeros(len(starts))]
        moving, h = self._moving(state), FIRST / np.maximum(state.speed, LEAST)
        while moving.any() and len(states) < NUM_STEPS:
            bend = np.zeros_like(state.z)
            if len(states) > 1:  # the method of Adams and Bashforth, of order 2, with steps of their own
                last = gone[-1] - gone[-2]
                slope = (state.rate - states[-2].rate) / np.where(last > 0, last, 1)[:, None]
                error = np.linalg.norm((state.stretch @ slope[..., None])[..., 0], axis=1) * last**2 / 2
                allowed = SAFETY * np.sqrt(self.tolerance / np.maximum(error, np.finfo(float).tiny))
                h = self._bounded(last * np.clip(allowed, SHRINK, GROW), state)
                bend = slope * (h / 2)[:, None]
            h = np.where(moving, h, 0.0)
            state = self._state(obstacle, state.z + h[:, None] * (state.rate + bend))
            states.append(state)
            gone.append(gone[-1] + h)
            moving &= self._moving(state)
        return self._densely(states, np.stack(gone, axis=1))

    @cached_property
    def _images(self) -> Callable[[bytes], Array]:
        """ψ of starts (R, 3), as bytes; those asked for lately are kept, for they stay while an obstacle is dragged."""
        forward = self.system.transform.forward
        return lru_cache(NUM_KEPT)(lambda starts: forward(np.frombuffer(starts).reshape(-1, 3)))

    def _state(self, obstacle: Union, z: Array) -> _State:
        y, D = self.system.transform.inverse_jacobian(z)
        left = self.system.base.goal - z
        forward = left / np.maximum(np.linalg.norm(left, axis=1), np.finfo(float).tiny)[:, None]
        imitated = (D @ forward[..., None])[..., 0]
        v, distance = modulated(obstacle, y, imitated)
        rate = np.linalg.solve(D, v[..., None])[..., 0]
        speed = np.linalg.norm(v, axis=1)
        share = speed / np.maximum(np.linalg.norm(imitated, axis=1), np.finfo(float).tiny)
        return _State(z, rate, y, D, speed, share, distance)

    def _bounded(self, h: Array, state: _State) -> Array:
        """Steps (N,) of s, metres, within the bounds of their lengths."""
        to_goal = np.linalg.norm(state.y - self.goal, axis=1)
        most = np.minimum(APPROACH * np.minimum(to_goal, np.maximum(state.distance, 0) + BESIDE), LONGEST)
        return np.clip(h * state.speed, np.minimum(SHORTEST, most), most) / np.maximum(state.speed, LEAST)

    def _moving(self, state: _State) -> Mask:
        """Which motions (N,) have neither arrived nor got stuck."""
        return (np.linalg.norm(state.y - self.goal, axis=1) > NEAR_GOAL) & (state.share > SLOWEST)

    def _densely(self, states: list[_State], gone: Array) -> Plan:
        """The motions with samples between their steps, on cubic curves, and with the goal where they arrive."""
        z, rate = (np.stack([getattr(state, name) for state in states], axis=1) for name in ("z", "rate"))
        base, h = self.system.base, np.diff(gone)[..., None, None]
        u = (np.arange(NUM_BETWEEN) / NUM_BETWEEN)[:, None]
        chord, start, end = np.diff(z, axis=1)[:, :, None], h * rate[:, :-1, None], h * rate[:, 1:, None]
        between = z[:, :-1, None] + u * start + u**2 * (3 * chord - 2 * start - end + u * (start + end - 2 * chord))
        images = [
            np.concatenate([some[step > 0].reshape(-1, 3), last[None]])
            for some, step, last in zip(between, h[..., 0, 0], z[:, -1], strict=True)
        ]
        counts = np.array([len(image) for image in images])
        pace = np.linalg.norm(base.velocity(np.concatenate(images)), axis=1)
        arrived = np.linalg.norm(states[-1].y - self.goal, axis=1) <= NEAR_GOAL
        arrival = np.maximum(base.arrival_time(z[:, -1], ARRIVED), ARRIVED)
        dues = []
        for k, own in enumerate(np.split(pace, np.cumsum(counts)[:-1])):
            steps = np.repeat(h[k][h[k] > 0] / NUM_BETWEEN, NUM_BETWEEN)
            due = np.append(0.0, np.cumsum(steps / np.sqrt(own[1:] * own[:-1])))
            if arrived[k]:
                images[k], due = np.vstack([images[k], base.goal]), np.append(due, due[-1] + arrival[k])
            dues.append(due)
        paths = np.split(self.system.transform.inverse(np.concatenate(images)), np.cumsum(counts + arrived)[:-1])
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
        return _Planner(problem.learned.system, problem.learned.goal, self.tolerance)
