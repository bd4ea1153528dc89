"""EFlow with a repulsive potential of the obstacle's distance overlaid, as Zhi et al. compare with (sec. 5).

ẏ = v(y) + η·(1/d − 1/d₀)/d²·∇d within the range d₀ of the obstacle (Khatib, 1986), d the distance from its
surface; beyond it nothing but EFlow's v. Only the stretches within the range are stepped; from where a motion leaves
it, EFlow's own rollout goes on, exactly.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.eflow import EFlow, EFlowSystem
from dt_viz.baselines.surface import distance_and_normal
from dt_viz.baselines.weights import FOLDER
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.union import Union

RANGE = 0.05
"""d₀, distance from the surface at which the repulsion begins, metres."""
GAIN = 1e-6
"""η, m⁴/s: two centimetres from the surface the repulsion is 0.075 m/s. Range and gain were chosen once, at places of
other seeds than are reported: of 0.05 and 0.1 m and 1, 3, 10 and 30·10⁻⁷ m⁴/s the pair of least Fréchet distance among
those with which no end effector touched a 15 cm sphere, at 12 places for each of push box, lift box and draw S."""
STRONGEST = 0.5
"""Largest speed of the repulsion, m/s; also inside the obstacle, where the potential is not defined."""
LONGEST = 20.0
"""Time after which a motion that has not left the range is given up, seconds."""
STUCK_DISTANCE, STUCK_TIME = 0.005, 1.0
"""Distance, metres, that a motion gains in this time, seconds, if it is not stuck between goal and obstacle."""
MAX_VISITS = 5
"""Largest number of times that a motion enters the range."""


def repulsion(obstacle: Union, y: Array) -> tuple[Array, Array]:
    """Distance (N,), metres, of points `y` (N, 3) from the obstacle, and the velocities (N, 3), m/s, away from it."""
    distance, normal = distance_and_normal(obstacle, y)
    near = np.maximum(distance, np.finfo(float).tiny ** 0.25)
    speed = np.where(distance < RANGE, GAIN * (1 / near - 1 / RANGE) / near**2, 0.0)
    return distance, np.minimum(speed, STRONGEST)[:, None] * normal


@dataclass(eq=False)
class _Motion:
    """A motion that grows."""

    paths: list[Array] = field(default_factory=list)
    times: list[Array] = field(default_factory=list)

    def go_on(self, path: Array, times: Array) -> None:
        """Append samples (N, 3) at times (N,), the first of which is the last one that there is."""
        if self.paths:
            path, times = path[1:], self.times[-1][-1] + times[1:]
        if len(path):
            self.paths.append(path)
            self.times.append(times)


@dataclass(frozen=True, eq=False)
class _Planner:
    system: EFlowSystem
    interval: float
    """Length of a step, seconds."""
    spacing: float

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan motions of the end effector; see `Planner`."""
        motions = [_Motion() for _ in starts]
        rows, y = np.arange(len(starts)), starts
        for _ in range(MAX_VISITS):
            paths, times = self.system.rollouts(y, self.spacing)
            near = [obstacle.signed_distance(path) < RANGE for path in paths]
            entering = []
            for row, path, t, inside in zip(rows, paths, times, near, strict=True):
                last = max(int(inside.argmax()) - 1, 0) if inside.any() else len(path) - 1
                motions[row].go_on(path[: last + 1], t[: last + 1])
                if inside.any():
                    entering.append((row, path[last]))
            if not entering:
                break
            rows, y = np.array([row for row, _ in entering]), np.stack([place for _, place in entering])
            rows, y = self._stepped(obstacle, motions, rows, y, cancelled)
            if not len(rows):
                break
        return Plan(
            tuple(np.concatenate(motion.paths) for motion in motions),
            tuple(np.concatenate(motion.times) for motion in motions),
        )

    def _stepped(
        self, obstacle: Union, motions: list[_Motion], rows: Array, y: Array, cancelled: Cancelled
    ) -> tuple[Array, Array]:
        """Step motions `rows` from `y` until they leave the range; which ones do, and where."""
        steps = [y]
        before, force = repulsion(obstacle, y)
        lengths = np.zeros(len(rows), dtype=int)
        left, open_ = np.zeros(len(rows), dtype=bool), np.arange(len(rows))
        window = round(STUCK_TIME / self.interval)
        for k in range(round(LONGEST / self.interval)):
            end_if(cancelled)
            y = y.copy()
            y[open_] += self.interval * (self.system.velocity(y[open_]) + force[open_])
            steps.append(y)
            lengths[open_] += 1
            distance, force = repulsion(obstacle, y)
            left[open_] = (distance >= RANGE)[open_] & (distance >= before)[open_]
            stuck = np.zeros(len(rows), dtype=bool)
            if k + 1 >= window:
                stuck = np.linalg.norm(y - steps[-1 - window], axis=1) < STUCK_DISTANCE
            open_ = np.flatnonzero(~left & ~stuck & (lengths == k + 1))
            before = distance
            if not len(open_):
                break
        walked = np.stack(steps, axis=1)
        for row, length, path in zip(rows, lengths, walked, strict=True):
            motions[row].go_on(path[: length + 1], self.interval * np.arange(length + 1))
        return rows[left], y[left]


class EFlowRepulsive(Method):
    """EFlow with a repulsive potential, stepped at 20 Hz as in the paper."""

    name, title = "eflow-repulsive", "EFlow (repulsive)"
    promise = "No guarantee: it may stop in a local minimum, and a step may end inside the obstacle."
    stable, whole_arm, live = False, False, True
    rate = 20.0
    """Steps a second."""

    def __init__(self, spacing: float = LIVE.spacing, folder: Path = FOLDER) -> None:
        """Choose the largest distance between samples of the exact stretches, metres, and the folder of the weights."""
        self.spacing, self.folder = spacing, folder

    def fit(self, problem: Problem) -> Planner:
        """Load the task's weights; see `Method`."""
        system = EFlow(folder=self.folder).system(problem.task)
        return _Planner(system, 1 / self.rate, self.spacing)


class EFlowRepulsiveFine(EFlowRepulsive):
    """The same, stepped more finely."""

    name, title = "eflow-repulsive-fine", "EFlow (repulsive, 200 Hz)"
    promise = "No guarantee: it may stop in a local minimum."
    live = False
    rate = 200.0
