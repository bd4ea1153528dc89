"""Modulation of our imitation's velocity around obstacles (Huber, Billard and Slotine, RA-L 4(2), 2019).

ẏ = E·D·E⁻¹·v(y) with E = [r, e₁, e₂]: r points from the obstacle's reference point, e₁ and e₂ along its surface. The
eigenvalues λ_r = 1 − 1/Γ and λ_e = 1 + 1/Γ lead the velocity past it; Γ is 1 on the surface and grows away from it.
Written from the published equations, since the authors' library `dynamic_obstacle_avoidance` is on no package index.

Motions are integrated in base space, where the imitation's own are straight: y = ψ⁻¹(z) and ż = (Dψ⁻¹)⁻¹ẏ need ψ⁻¹
only, the quick side of ψ. The modulation is linear in the velocity, so that its paths do not depend on the imitation's
pace: they are integrated by the length of the path in the world, and timed afterwards.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from scipy.integrate import cumulative_trapezoid, solve_ivp

from dt_viz.baselines.base import NotFittedError, Plan, Planner, Problem
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import ARRIVED
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.metrics import arc_length
from dt_viz.numerics import divisor, unit
from dt_viz.obstacles.shapes import Obstacle
from dt_viz.obstacles.union import Union

LEAST_SLANT = 0.1
"""Least n·r: beyond it the surface is not star-shaped about the reference point, and the modulation not defined."""
TOLERANCE = 1e-3
"""Tolerated error of a step (Runge–Kutta of order 3, Bogacki and Shampine), metres."""
LONGEST_STEP = 0.06  # largest length of a step, metres: obstacles are not stepped over
NEAR_GOAL = 2e-3  # distance from the goal at which a motion counts as arriving, metres
APPROACH = 0.06  # distance from the goal from which on steps are shorter in proportion, metres
SLOWEST = 0.01  # part of the imitation's speed at which a motion is about to get stuck before an obstacle
LONGEST = 4.0  # largest length of a path, metres


def gamma(obstacle: Obstacle, distance: Array) -> Array:
    """Γ (N,) at distances (N,), metres: (1 + d/R)², with R the depth of the obstacle; of a sphere (‖y − c‖/R)²."""
    return (1 + np.maximum(distance, 0) / obstacle.depth) ** 2


def modulated(obstacle: Union, y: Array, v: Array) -> Array:
    """Return velocities `v` (N, 3), m/s, at `y` (N, 3), metres, as the obstacles modulate them.

    Where a velocity leads away from an obstacle, λ_r is 1 (the tail effect). Several obstacles are weighted by how near
    each is, so that on the surface of one it alone counts.
    """
    if not obstacle.parts:
        return v
    velocities, gammas = [], []
    for part in obstacle.parts:
        distance, n = Union((part,)).distance_and_normal(y)
        r = unit(y - np.array(part.position))
        towards = np.einsum("nd,nd->n", n, v)
        along_r = towards / np.maximum(np.einsum("nd,nd->n", n, r), LEAST_SLANT)
        tangential = v - along_r[:, None] * r  # n·(v − a·r) = 0
        near = 1 / gamma(part, distance)
        radial = np.where(towards >= 0, 1.0, 1 - near) * along_r
        velocities.append(radial[:, None] * r + (1 + near)[:, None] * tangential)
        gammas.append(near)
    far = 1 / np.array(gammas) - 1  # (parts, N), zero on the surface
    weights = np.array([np.prod(np.delete(far, k, axis=0), axis=0) for k in range(len(far))])
    total = weights.sum(axis=0)
    weights = np.where(total > 0, weights / np.where(total > 0, total, 1), 1 / len(far))
    return np.einsum("pn,pnd->nd", weights, np.array(velocities))


def fit(problem: Problem) -> Planner:
    """Take what is learned already. Raises NotFittedError where that is not a velocity at each place."""
    system = problem.learned.system
    if system.transform.dim != problem.task.starts.shape[1]:
        raise NotFittedError("modulation turns velocities at places; this task is learned in augmented states")
    return partial(_plan, system)


def _plan(system: DiffeomorphicSystem, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
    base, num = system.base, len(starts)

    def rate(_: float, z: Array) -> Array:
        return _evaluated(system, obstacle, z.reshape(num, 3))[1].ravel()

    def left(_: float, z: Array) -> float:
        return float(base.distance(z.reshape(num, 3)).max()) - NEAR_GOAL

    left.terminal = True  # pyright: ignore[reportFunctionMemberAccess] - as scipy wants it
    begin, span, longest = system.transform.forward(starts).ravel(), (0.0, LONGEST), LONGEST_STEP
    solved = solve_ivp(rate, span, begin, "RK23", dense_output=True, events=left, atol=TOLERANCE, max_step=longest)
    at = np.interp(np.arange(0, len(solved.t) - 0.75, 0.25), np.arange(len(solved.t)), solved.t)  # and between
    z = solved.sol(at).T.reshape(-1, 3)
    y, _, step = _evaluated(system, obstacle, z)
    pace = np.linalg.norm(base.velocity(z), axis=1)
    clocks = cumulative_trapezoid((step / divisor(pace)).reshape(len(at), num), at, axis=0, initial=0)
    arrives = base.distance(z[-num:]) <= 1.01 * NEAR_GOAL
    paths, times, goal = [], [], system.transform.inverse(base.goal[None])
    for k, (path, clock) in enumerate(zip(y.reshape(-1, num, 3).swapaxes(0, 1), clocks.T, strict=True)):
        length = arc_length(path)
        last = int((length < length[-1] - NEAR_GOAL).sum())  # from there on it rests
        arrival = clock[last] + max(base.arrival_time(z[last * num + k], ARRIVED), ARRIVED)
        paths.append(np.vstack([path[: last + 1], goal]) if arrives[k] else path[: last + 1])
        times.append(np.append(clock[: last + 1], arrival) if arrives[k] else clock[: last + 1])
    return Plan(tuple(paths), tuple(times))


def _evaluated(system: DiffeomorphicSystem, obstacle: Union, z: Array) -> tuple[Array, Array, Array]:
    """Evaluate the modulated motion at points of base space `z` (N, 3), by the length of its path.

    Returns:
        Places (N, 3), metres; dz/ds (N, 3), shorter towards the goal; and the distance (N,) that the imitation
        would go in base space meanwhile.
    """
    y, D = system.transform.inverse_jacobian(z)
    offset = system.base.goal - z
    nominal = np.einsum("nij,nj->ni", D, unit(offset))
    v = modulated(obstacle, y, nominal)
    speed = np.linalg.norm(v, axis=1) + SLOWEST * np.linalg.norm(nominal, axis=1)
    step = np.tanh(np.linalg.norm(offset, axis=1) / APPROACH) / divisor(speed)
    return y, step[:, None] * np.linalg.solve(D, v[..., None])[..., 0], step
