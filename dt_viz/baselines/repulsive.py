"""EFlow with a repulsive potential of the obstacle's distance overlaid, as Zhi et al. compare with (sec. 5).

ẏ = v(y) + η·(1/d − 1/d₀)/d²·∇d within the range d₀ of the obstacle (Khatib, 1986), d the distance from its
surface; beyond it nothing but EFlow's v. Motions are stepped by Euler's method.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.eflow import EFlow, EFlowSystem
from dt_viz.baselines.weights import FOLDER
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.numerics import divisor
from dt_viz.obstacles.union import Union


@dataclass(frozen=True)
class RepulsionSettings:
    """How a motion is pushed away, stepped and given up.

    Range and gain were chosen once, at places of other seeds than are reported: of 0.05 and 0.1 m and 1, 3, 10 and
    30·10⁻⁷ m⁴/s the pair of least Fréchet distance among those with which no end effector touched a 15 cm sphere, at 12
    places for each of push box, lift box and draw S.
    """

    rate: float = 20.0
    """Steps a second, the paper's."""
    range: float = 0.05
    """d₀, distance from the surface at which the repulsion begins, metres."""
    gain: float = 1e-6
    """η, m⁴/s: two centimetres from the surface the repulsion is 0.075 m/s."""
    strongest: float = 0.5
    """Largest speed of the repulsion, m/s; also inside the obstacle, where the potential is not defined."""
    longest: float = 40.0
    """Time after which a motion is given up, seconds."""
    stuck_distance: float = 0.005
    """Distance that a motion gains in `stuck_time` if it is not stuck between goal and obstacle, metres."""
    stuck_time: float = 1.0
    """Seconds."""
    at_goal: float = 1e-6
    """Distance from the goal at which a motion has arrived, metres."""

    def repulsion(self, obstacle: Union, y: Array) -> tuple[Array, Array]:
        """Distance (N,), metres, of points `y` (N, 3) from the obstacle, and velocities (N, 3), m/s, away from it."""
        distance, normal = obstacle.distance_and_normal(y)
        near = divisor(np.clip(distance, 0, self.range))
        speed = np.minimum(self.gain * (1 / near - 1 / self.range) / near**2, self.strongest)
        return distance, speed[:, None] * normal


@dataclass(frozen=True, eq=False)
class _Planner:
    system: EFlowSystem
    settings: RepulsionSettings

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan motions of the end effector; see `Planner`."""
        settings, system = self.settings, self.system
        interval, window = 1 / settings.rate, round(settings.stuck_time * settings.rate)
        places, times = [starts], [np.zeros(len(starts))]
        moving = np.full(len(starts), True)
        while moving.any() and len(places) < settings.longest * settings.rate:
            end_if(cancelled)
            y, step = places[-1].copy(), np.zeros(len(starts))
            velocity, left = system.velocity_and_time(y[moving])
            step[moving] = np.minimum(interval, left)  # the last one ends at the goal
            y[moving] += step[moving, None] * (velocity + settings.repulsion(obstacle, y[moving])[1])
            places.append(y)
            times.append(times[-1] + step)
            moving = moving & (np.linalg.norm(y - system.goal, axis=1) > settings.at_goal)
            if len(places) > window:
                gained = np.linalg.norm(y - places[-1 - window], axis=1)
                moving &= gained > settings.stuck_distance
        paths, clocks = np.stack(places, axis=1), np.stack(times, axis=1)
        lengths = 1 + np.count_nonzero(np.diff(clocks), axis=1)
        ends = zip(paths, clocks, lengths, strict=True)
        motions = [(path[:length], clock[:length]) for path, clock, length in ends]
        return Plan(tuple(path for path, _ in motions), tuple(clock for _, clock in motions))


class EFlowRepulsive(Method):
    """EFlow with a repulsive potential."""

    name, title = "eflow-repulsive", "EFlow (repulsive)"
    promise = "No guarantee: it may stop in a local minimum, and a step may end inside the obstacle."
    stable, whole_arm, live = False, False, True

    def __init__(self, settings: RepulsionSettings | None = None, folder: Path = FOLDER) -> None:
        """Choose the settings, and the folder of the weights."""
        self.settings, self.folder = settings or RepulsionSettings(), folder

    def fit(self, problem: Problem) -> Planner:
        """Load the task's weights; see `Method`."""
        return _Planner(EFlow(folder=self.folder).system(problem.task), self.settings)
