"""Verify exact rollouts and time them: against stepping, and from random starts.

    python -m tests.benchmarks exactness --task draw_s --out exactness.json

``rollouts``
    Eight rollouts of 200 points, without an obstacle and with one on the motion, against stepping the same system. Both
    sides must be within the same distance of a much finer stepping at every point. The cheapest such setting of each is
    timed: the tolerance of the obstacle's flow, and the faster of Runge–Kutta steps of one length and scipy's DOP853,
    which steps all rollouts together.
``starts``
    Motions from 10,000 random starts in the demonstrations' box grown by half its size on every side, which arrive by
    construction if ψ⁻¹ is the inverse of ψ.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from dt_viz.avoidance.hand import Avoidance
from dt_viz.evaluate.held_out import arrival_times
from dt_viz.evaluate.options import (
    Row,
    add_task,
    chosen_task,
    new_engine,
    report,
)
from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.motion.nominal import Learned
from dt_viz.motion.stack import FINE, build_stack
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoiding
from dt_viz.scenario.tasks import Task, known_tasks
from tests.benchmarks.options import add_out
from tests.oracles import stepped as in_steps

NUM_ROLLOUTS, NUM_POINTS = 8, 200
FINER = 1e-4  # tolerance of the truth, relative to the required accuracy
ARRIVED = 1e-4  # distance from the goal within which a motion has arrived, metres
ACCURACY = 1e-5  # required of both sides, metres
DIAMETER = 0.15  # of the task's obstacle, metres
NUM_REPEATS = 3  # number of timings, of which the median counts
NUM_STARTS = 10_000
Systems = Callable[[float], DiffeomorphicSystem]
"""Function from the tolerance of the obstacle's flow, metres, to the system."""


@dataclass(frozen=True)
class Timed:
    """Cheapest setting of one side that is accurate enough."""

    setting: str
    seconds: float
    error: float  # largest distance from the truth, metres
    accurate: bool  # whether the error is within the required accuracy


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    add_task(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if a side cannot be made accurate enough or a motion does not arrive."""
    tasks, task = known_tasks(options.lasa), chosen_task(options)
    learned, fine = new_engine(tasks).nominal(Scenario(task.name, state="plain")).learned, True
    for part in (rollouts, starts):
        rows, part_is_fine = part(task, learned)
        print(f"{task.name}, {part.__name__}")
        report(rows)
        fine = fine and part_is_fine
    return 0 if fine else 1


def rollouts(task: Task, learned: Learned) -> tuple[list[Row], bool]:
    """Compare exact rollouts with stepping, without an obstacle and with the task's."""
    plain = task.system(learned.imitation)
    # the learned pace has kinks, which a stepping of high order would have to find: that would flatter the exact side
    plain = replace(plain, base=Attractor(plain.base.goal, plain.base.speed, plain.base.smoothing))
    avoidance = Avoidance(Sphere(task.obstacle_position, DIAMETER))
    layers = avoiding(task, avoidance).active
    duration = build_stack(learned.demonstrated, layers, FINE).built[-1].made.duration
    field = avoidance.avoided.field(avoidance.generator, avoidance.temperature)

    def with_obstacle(tolerance: float) -> DiffeomorphicSystem:
        return replace(plain, transform=Chain([plain.transform, Flow.adaptive(field, duration, tolerance)]))

    starts = task.starts
    while len(starts) < NUM_ROLLOUTS:  # also middles between neighbours
        starts = np.concatenate([starts, (starts + np.roll(starts, -1, axis=0)) / 2])
    scenes: dict[str, Systems] = {"no obstacle": lambda _: plain, "obstacle": with_obstacle}
    rows: list[Row] = []
    for scene, systems in scenes.items():
        sides = compare(systems, starts[:NUM_ROLLOUTS])
        stepped = sides["stepped"].seconds
        rows += [
            {"scene": scene, "side": how, **asdict(s), "× faster": stepped / s.seconds} for how, s in sides.items()
        ]
    return rows, all(bool(row["accurate"]) for row in rows)


def compare(systems: Systems, starts: Array) -> dict[str, Timed]:
    """Time the cheapest accurate exact rollouts from `starts` (R, 3), metres, and the cheapest accurate stepping."""
    finest = systems(0.1 * FINER * ACCURACY)
    end = finest.base.arrival_time(finest.transform.forward(starts), ARRIVED).max()
    times = np.linspace(0.0, float(end), NUM_POINTS)
    truth = stepped_adaptively(finest, starts, times, FINER * ACCURACY)

    def cheapest(settings: Mapping[str, Callable[[], Array]], give_up: float = np.inf) -> Timed:
        best = Timed("", np.inf, np.inf, False)
        for setting, motion in settings.items():
            began = time.perf_counter()
            error = float(np.linalg.norm(motion() - truth, axis=-1).max())
            best = Timed(setting, time.perf_counter() - began, error, error <= ACCURACY)
            if best.accurate:
                return replace(best, seconds=_median_seconds(motion))
            if best.seconds > give_up:
                break
        return best

    tolerances = ACCURACY * 10.0 ** -np.arange(5)
    by_setting = {f"flow to {t:.0e} m": systems(t) for t in tolerances}
    exact = cheapest({name: lambda s=system: s.rollout(starts, times) for name, system in by_setting.items()})
    # a stepper whose field is rougher than its own tolerance takes ever smaller steps: the flow is ten times finer
    adaptive = {
        f"DOP853 to {t:.0e} m": lambda t=t: stepped_adaptively(systems(t / 10), starts, times, t)
        for t in 10 * tolerances
    }
    fixed = {
        f"RK4, {2**k} steps a point": lambda n=2**k: in_steps(systems(ACCURACY / 10).velocity, starts, times, n)
        for k in range(7)
    }
    by_dop853 = cheapest(adaptive)
    by_rk4 = cheapest(fixed, give_up=by_dop853.seconds if by_dop853.accurate else np.inf)
    return {"exact": exact, "stepped": min(by_dop853, by_rk4, key=lambda side: (not side.accurate, side.seconds))}


def stepped_adaptively(system: DiffeomorphicSystem, starts: Array, times: Array, tolerance: float) -> Array:
    """Compute the motion (R, T, 3) by DOP853 on ẏ = J⁻¹ f(ψ(y)), all rollouts in one state, to `tolerance` metres."""

    def velocity(_: float, state: Array) -> Array:
        return system.velocity(state.reshape(starts.shape)).ravel()

    span = (float(times[0]), float(times[-1]))
    solution = solve_ivp(velocity, span, starts.ravel(), "DOP853", times, rtol=tolerance, atol=tolerance)
    return np.moveaxis(solution.y.reshape(*starts.shape, -1), -1, 1)


def _median_seconds(motion: Callable[[], object]) -> float:
    seconds = []
    for _ in range(NUM_REPEATS):
        began = time.perf_counter()
        motion()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def starts(task: Task, learned: Learned) -> tuple[list[Row], bool]:
    """Follow motions from random starts."""
    system, begin = task.system(learned.imitation), random_starts(task)
    misses, dets, left = np.empty(len(begin)), np.empty(len(begin)), np.empty(len(begin))
    for first in range(0, len(begin), 500):
        chunk = slice(first, first + 500)
        z0 = system.transform.forward(begin[chunk])
        z = system.base.flow(z0, arrival_times(system, z0)[:, None] * np.linspace(0.0, 1.0, 50))
        paths, J_inverse = system.transform.inverse_jacobian(z)
        misses[chunk] = np.linalg.norm(paths[:, 0] - begin[chunk], axis=1)
        left[chunk] = np.linalg.norm(paths[:, -1] - learned.goal, axis=1)
        dets[chunk] = (1 / np.linalg.det(J_inverse)).min(axis=1)
    row: Row = {
        "starts": len(begin),
        "arrived": int((left < ARRIVED).sum()),
        "farthest at the end mm": 1e3 * float(left.max()),
        "smallest det J": float(dets.min()),
        "round trip mm": 1e3 * float(misses.max()),
    }
    return [row], bool((left < ARRIVED).all())


def random_starts(task: Task) -> Array:
    """Starts (N, 3), metres, spread evenly over the demonstrations' box grown by half its size on every side."""
    points = np.concatenate([d.positions for d in task.demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    uniform = np.random.default_rng(0).uniform(size=(NUM_STARTS, points.shape[1]))
    return task.to_world(lower + (2 * uniform - 0.5) * (upper - lower))
