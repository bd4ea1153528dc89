"""EFlow with a repulsive potential of the obstacle's distance overlaid, as Zhi et al. compare with (sec. 5).

ẏ = v(y) + η·(1/d − 1/d₀)/d²·∇d within the range d₀ of the obstacle (Khatib, 1986), d the distance from its
surface; beyond it nothing but EFlow's v. Only the stretches within the range are stepped, by Euler's method; before and
after them motions are EFlow's own rollouts, exactly.

Range and gain were chosen once, at places of other seeds than are reported: of 0.05 and 0.1 m and 1, 3, 10 and
30·10⁻⁷ m⁴/s the pair of least Fréchet distance among those with which no end effector touched a 15 cm sphere, at 12
places for each of push box, lift box and draw S.
"""

from __future__ import annotations

from functools import partial

import numpy as np

from dt_viz.baselines.base import Plan, Planner, Problem
from dt_viz.baselines.eflow import EFlowSystem, load_system
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array, Mask
from dt_viz.motion.stack import LIVE
from dt_viz.numerics import divisor
from dt_viz.obstacles.union import Union

RATE = 20.0  # steps a second, the paper's
RANGE = 0.05  # d₀, distance from the surface at which the repulsion begins, metres
GAIN = 1e-6  # η, m⁴/s: two centimetres from the surface the repulsion is 0.075 m/s
STRONGEST = 0.5
"""Largest speed of the repulsion, m/s; also inside the obstacle, where the potential is not defined."""
LONGEST = 20.0  # time after which a motion that has not left the range is given up, seconds
MAX_VISITS = 5  # largest number of times that a motion enters the range
STUCK_DISTANCE, STUCK_TIME = 0.005, 1.0
"""Distance, metres, that a motion gains in this time, seconds, if it is not stuck between goal and obstacle."""


def repulsion(obstacle: Union, y: Array) -> tuple[Array, Array]:
    """Distance (N,), metres, of points `y` (N, 3) from the obstacle, and velocities (N, 3), m/s, away from it."""
    distance, normal = obstacle.distance_and_normal(y)
    near = divisor(np.clip(distance, 0, RANGE))
    speed = np.minimum(GAIN * (1 / near - 1 / RANGE) / near**2, STRONGEST)
    return distance, speed[:, None] * normal


def fit(problem: Problem) -> Planner:
    """Load EFlow's weights for the task. Raises NotFittedError where there are none that can be used."""
    return partial(plan, load_system(problem.task))


def plan(system: EFlowSystem, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
    """Plan motions of the end effector; see `Planner`."""
    motions: dict[int, tuple[Array, Array]] = {}

    def go_on(row: int, path: Array, times: Array) -> None:
        if row in motions:
            before, passed = motions[row]
            path, times = np.concatenate([before, path[1:]]), np.append(passed, passed[-1] + times[1:])
        motions[row] = path, times

    rows, y = [*range(len(starts))], starts
    for _ in range(MAX_VISITS):
        entering = []
        for row, path, times in zip(rows, *system.rollouts(y, LIVE.spacing), strict=True):
            inside = obstacle.signed_distance(path) < RANGE
            last = max(int(inside.argmax()) - 1, 0) if inside.any() else len(path) - 1
            go_on(row, path[: last + 1], times[: last + 1])
            entering += [row] if inside.any() else []
        if not entering:
            break
        begin = np.stack([motions[row][0][-1] for row in entering])
        walks, leave = _stepped(system, obstacle, begin, cancelled)
        for row, walk in zip(entering, walks, strict=True):
            go_on(row, walk, np.arange(len(walk)) / RATE)
        rows = [row for row, leaves in zip(entering, leave, strict=True) if leaves]
        if not rows:
            break
        y = np.stack([motions[row][0][-1] for row in rows])
    paths, times = zip(*(motions[row] for row in range(len(starts))), strict=True)
    return Plan(paths, times)


def _stepped(system: EFlowSystem, obstacle: Union, y: Array, cancelled: Cancelled) -> tuple[list[Array], Mask]:
    """Step motions from `y` (N, 3) while they are within the range: paths (N_i, 3), and which leave it (N,)."""
    interval, window = 1 / RATE, round(STUCK_TIME * RATE)
    places, lengths = [y], np.ones(len(y), dtype=int)
    leave, within = np.zeros(len(y), dtype=bool), np.ones(len(y), dtype=bool)
    before, force = repulsion(obstacle, y)
    while within.any() and len(places) < LONGEST * RATE:
        end_if(cancelled)
        y = y.copy()
        y[within] += interval * (system.velocity(y[within]) + force[within])
        places.append(y)
        lengths[within] += 1
        distance, force = repulsion(obstacle, y)
        leave |= within & (distance >= RANGE) & (distance >= before)
        within &= ~leave
        if len(places) > window:
            within &= np.linalg.norm(y - places[-1 - window], axis=1) >= STUCK_DISTANCE
        before = distance
    return [path[:length] for path, length in zip(np.stack(places, axis=1), lengths, strict=True)], leave
