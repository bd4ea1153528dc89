"""Verify exact rollouts and time them: against stepping, at single points, and from random starts.

    python -m tests.benchmarks exactness --task draw_s --out exactness.json      # --parts rollouts, velocity, starts

``rollouts``
    Eight rollouts of 200 points, without an obstacle and with one on the motion, against stepping the same system. Both
    sides must be within the same distance of a much finer stepping at every point. The cheapest such setting of each is
    timed: the tolerance of the obstacle's flow, and the faster of Runge–Kutta steps of one length and scipy's DOP853,
    which steps all rollouts together. Exact rollouts are also timed one rollout, and one point, at a time.
``velocity``
    Processor time of a controller's call, the velocity of a motion at one point, for each kind of stack.
``starts``
    Motions from random starts in the demonstrations' box grown by half its size on every side, which arrive by
    construction if ψ⁻¹ is the inverse of ψ. So the first of them are stepped, too: ẏ = J⁻¹ f(ψ(y)), eq. (1), uses
    neither the closed form nor ψ⁻¹, and must lead along the same rollouts.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, replace

import numpy as np
from scipy.integrate import solve_ivp

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import Avoidance
from dt_viz.avoidance.transform import Transform
from dt_viz.evaluate.held_out import arrival_times
from dt_viz.evaluate.options import (
    TABLES,
    Row,
    add_task,
    chosen_task,
    new_engine,
    number,
    report,
    whole_number,
)
from dt_viz.flows.diffeomorphisms import Chain, Flow
from dt_viz.flows.fields import Array
from dt_viz.flows.integrators import DORMAND_PRINCE, carried
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.motion.nominal import Learned
from dt_viz.motion.stack import FINE, build_stack
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import CloudObstacle, Point, Sphere, as_point
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import avoiding, plane_of
from dt_viz.scenario.tasks import Task
from tests.oracles import stepped as in_steps

OUT = TABLES
NUM_ROLLOUTS, NUM_POINTS = 8, 200
FINER = 1e-4
"""Tolerance of the truth, relative to the required accuracy."""
ARRIVED = 1e-4
"""Distance from the goal within which a motion has arrived, metres."""
MAX_DEPARTURE = 1e-3
"""Largest accepted distance of a stepped motion from the exact rollout, metres: where space is compressed, errors of
steps grow a hundredfold."""
STEP_TOLERANCE = 1e-6
"""Largest estimated error of a step, metres."""
Systems = Callable[[float], DiffeomorphicSystem]
"""Function from the tolerance of the obstacle's flow, metres, to the system."""


@dataclass(frozen=True)
class Timed:
    """Cheapest setting of one side that is accurate enough."""

    setting: str
    seconds: float
    error: float
    """Largest distance from the truth, metres."""
    accurate: bool
    """Whether the error is within the required accuracy."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_task(parser)
    parser.add_argument("--parts", nargs="+", choices=tuple(PARTS), default=list(PARTS), help="(default: all)")
    metres = number("metres", 1e-9, 1)
    parser.add_argument("--accuracy", type=metres, default=1e-5, help="of both sides, metres (default: %(default)s)")
    parser.add_argument("--diameter", type=metres, default=0.15, help="of the task's obstacle, metres")
    parser.add_argument("--repeats", type=whole_number(1), default=3, help="median of so many (default: %(default)s)")
    parser.add_argument("--points", type=whole_number(1), default=60, help="of each stack (default: %(default)s)")
    parser.add_argument("--count", type=whole_number(1), default=10_000, help="random starts (default: %(default)s)")
    parser.add_argument("--stepped", type=whole_number(0), default=500, help="of these (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the starts (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if a side cannot be made accurate enough, a motion does not arrive or departs."""
    tasks, task = chosen_task(options)
    fine = True
    learned = new_engine(tasks).nominal(Scenario(task.name, state="plain")).learned
    for part in options.parts:
        rows, part_is_fine = PARTS[part](task, learned, options)
        print(f"{task.name}, {part}")
        report(rows)
        fine = fine and part_is_fine
    return 0 if fine else 1


def rollouts(task: Task, learned: Learned, options: argparse.Namespace) -> tuple[list[Row], bool]:
    """Compare exact rollouts with stepping, without an obstacle and with the task's."""
    plain = task.system(learned.imitation)
    # the learned pace has kinks, which a stepping of high order would have to find: that would flatter the exact side
    plain = replace(plain, base=Attractor(plain.base.goal, plain.base.speed, plain.base.smoothing))
    avoidance = Avoidance(Sphere(task.obstacle_position, options.diameter))
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
        sides = compare(systems, starts[:NUM_ROLLOUTS], options.accuracy, options.repeats)
        stepped = sides["stepped"].seconds
        rows += [
            {"scene": scene, "side": how, **asdict(s), "× faster": stepped / s.seconds} for how, s in sides.items()
        ]
    return rows, all(bool(row["accurate"]) for row in rows)


def compare(systems: Systems, starts: Array, accuracy: float, repeats: int) -> dict[str, Timed]:
    """Time the cheapest accurate exact rollouts, these less batched, and the cheapest accurate stepping.

    Args:
        systems: the system for each tolerance.
        starts: (R, 3), metres.
        accuracy: largest distance from the truth, metres.
        repeats: number of repetitions of each timing.
    """
    finest = systems(0.1 * FINER * accuracy)
    end = finest.base.arrival_time(finest.transform.forward(starts), ARRIVED).max()
    times = np.linspace(0.0, float(end), NUM_POINTS)
    truth = stepped_adaptively(finest, starts, times, FINER * accuracy)

    def cheapest(settings: Mapping[str, Callable[[], Array]], give_up: float = np.inf) -> Timed:
        best = Timed("", np.inf, np.inf, False)
        for setting, motion in settings.items():
            began = time.perf_counter()
            error = float(np.linalg.norm(motion() - truth, axis=-1).max())
            best = Timed(setting, time.perf_counter() - began, error, error <= accuracy)
            if best.accurate:
                return replace(best, seconds=_median_seconds(motion, repeats))
            if best.seconds > give_up:
                break
        return best

    tolerances = accuracy * 10.0 ** -np.arange(5)
    by_setting = {f"flow to {t:.0e} m": systems(t) for t in tolerances}
    exact = cheapest({name: lambda s=system: s.rollout(starts, times) for name, system in by_setting.items()})
    # a stepper whose field is rougher than its own tolerance takes ever smaller steps: the flow is ten times finer
    adaptive = {
        f"DOP853 to {t:.0e} m": lambda t=t: stepped_adaptively(systems(t / 10), starts, times, t)
        for t in 10 * tolerances
    }
    fixed = {
        f"RK4, {2**k} steps a point": lambda n=2**k: in_steps(systems(accuracy / 10).velocity, starts, times, n)
        for k in range(7)
    }
    by_dop853 = cheapest(adaptive)
    by_rk4 = cheapest(fixed, give_up=by_dop853.seconds if by_dop853.accurate else np.inf)
    system = by_setting[exact.setting]
    apart: dict[str, Callable[[], Array]] = {
        "one rollout at a time": lambda: np.stack([system.rollout(start, times) for start in starts]),
        "one point at a time": lambda: np.array(
            [[system.rollout(s[None], times[[k]])[0, 0] for k in range(len(times))] for s in starts]
        ),
    }
    stepped = min(by_dop853, by_rk4, key=lambda side: (not side.accurate, side.seconds))
    less_batched = {how: replace(exact, seconds=_median_seconds(motion, repeats)) for how, motion in apart.items()}
    return {"exact": exact, **less_batched, "stepped": stepped}


def stepped_adaptively(system: DiffeomorphicSystem, starts: Array, times: Array, tolerance: float) -> Array:
    """Compute the motion (R, T, 3) by DOP853 on ẏ = J⁻¹ f(ψ(y)), all rollouts in one state, to `tolerance` metres."""

    def velocity(_: float, state: Array) -> Array:
        return system.velocity(state.reshape(starts.shape)).ravel()

    span = (float(times[0]), float(times[-1]))
    solution = solve_ivp(velocity, span, starts.ravel(), "DOP853", times, rtol=tolerance, atol=tolerance)
    return np.moveaxis(solution.y.reshape(*starts.shape, -1), -1, 1)


def _median_seconds(motion: Callable[[], object], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        motion()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def velocity(task: Task, learned: Learned, options: argparse.Namespace) -> tuple[list[Row], bool]:
    """Time a controller's call at points of the rollouts of each kind of stack: the quickest of three at each point."""
    rows: list[Row] = []
    for name, stack in stacks(task).items():
        layers = tuple(Layer(transform, name=f"{k}") for k, transform in enumerate(stack))
        solution = build_stack(learned.demonstrated, Scenario(task.name, layers).active, FINE)
        samples, system = solution.bundle.positions, solution.system
        system.velocity(samples[0])  # what is computed once for each field is computed here
        seconds = []
        for point in samples[np.linspace(0, len(samples) - 1, options.points).round().astype(int)]:
            calls = []
            for _ in range(3):
                began = time.thread_time()
                system.velocity(point)
                calls.append(time.thread_time() - began)
            seconds.append(min(calls))
        median, p95 = 1e3 * np.percentile(seconds, [50, 95])
        rows.append({"stack": name, "median_ms": float(median), "p95_ms": float(p95)})
    return rows, True


def stacks(task: Task) -> Mapping[str, tuple[Transform, ...]]:
    """Stacks on the imitation: obstacles in its way, and a bias point beside it."""

    def at(percent: int) -> Point:
        return as_point(task.mean_path[percent])

    cloud = Cloud(np.random.default_rng(0).uniform(-0.05, 0.05, (2000, 3)))
    bias = BiasPoint(as_point(task.mean_path[75] + 0.03 * task.slice.axes[:, 1]), plane=plane_of(task))
    return {
        "imitation": (),
        "sphere": (Avoidance(Sphere(at(50), 0.12)),),
        "bias point and sphere": (bias, Avoidance(Sphere(at(30), 0.12))),
        "cloud": (Avoidance(CloudObstacle(at(50), cloud)),),
    }


def starts(task: Task, learned: Learned, options: argparse.Namespace) -> tuple[list[Row], bool]:
    """Follow motions from random starts, and step the first of them."""
    system, goal = task.system(learned.imitation), learned.goal
    begin = random_starts(task, options.count, options.seed)
    misses, dets, left = np.empty(len(begin)), np.empty(len(begin)), np.empty(len(begin))
    durations = np.empty(len(begin))
    for first in range(0, len(begin), 500):
        chunk = slice(first, first + 500)
        z0 = system.transform.forward(begin[chunk])
        durations[chunk] = arrival_times(system, z0)
        z = system.base.flow(z0, durations[chunk, None] * np.linspace(0.0, 1.0, 50))
        paths, J_inverse = system.transform.inverse_jacobian(z)
        misses[chunk] = np.linalg.norm(paths[:, 0] - begin[chunk], axis=1)
        left[chunk] = np.linalg.norm(paths[:, -1] - goal, axis=1)
        dets[chunk] = (1 / np.linalg.det(J_inverse)).min(axis=1)
    num = min(options.stepped, len(begin))
    stepped, departures = stepped_beside(system, begin[:num], durations[:num])
    stepped_left = np.linalg.norm(stepped[:, -1] - goal, axis=1)
    row: Row = {
        "starts": len(begin),
        "arrived": int((left < ARRIVED).sum()),
        "farthest at the end mm": 1e3 * float(left.max()),
        "smallest det J": float(dets.min()),
        "round trip mm": 1e3 * float(misses.max()),
        "stepped": num,
        "stepped, arrived": int((stepped_left < ARRIVED).sum()),
        "stepped, farthest from exact mm": 1e3 * float(departures.max(initial=0.0)),
    }
    arrived = bool((left < ARRIVED).all() and (stepped_left < ARRIVED).all())
    return [row], arrived and not (departures > MAX_DEPARTURE).any()


def random_starts(task: Task, count: int, seed: int) -> Array:
    """Starts (N, 3), metres, spread evenly over the demonstrations' box grown by half its size on every side."""
    points = np.concatenate([d.positions for d in task.demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    uniform = np.random.default_rng(seed).uniform(size=(count, points.shape[1]))
    return task.to_world(lower + (2 * uniform - 0.5) * (upper - lower))


def stepped_beside(system: DiffeomorphicSystem, starts: Array, durations: Array) -> tuple[Array, Array]:
    """Step ẏ = J⁻¹ f(ψ(y)) from `starts` (M, 3), metres, for `durations` (M,), seconds, beside the exact rollouts.

    Returns:
        Places (M, 5, 3) at even times, and their largest distances (M,) from the exact rollouts, metres.
    """
    fractions = np.arange(1, 6) / 5
    state, places = np.concatenate([starts, durations[:, None]], axis=1), []
    for _ in fractions:
        state, _ = carried(_Clocked(system), state, None, DORMAND_PRINCE, 1 / 5, 1000, STEP_TOLERANCE)
        places.append(state[:, :-1])
    stepped = np.stack(places, axis=1)
    exact = system.rollout(starts, durations[:, None] * fractions)
    return stepped, np.linalg.norm(stepped - exact, axis=-1).max(axis=1)


class _Clocked:
    """The field (T·ẏ, 0) of states (y, T): each motion takes its own time T, seconds, while one unit passes."""

    def __init__(self, system: DiffeomorphicSystem) -> None:
        self._system = system
        self.dim = system.transform.dim + 1

    def __call__(self, s: Array) -> Array:
        """Velocities (N, d + 1) of the states `s` (N, d + 1)."""
        z, J = self._system.transform.jacobian(s[:, :-1])
        velocity = np.linalg.solve(J, self._system.base.velocity(z)[..., None])[..., 0]
        return np.concatenate([s[:, -1:] * velocity, np.zeros((len(s), 1))], axis=1)


PARTS = {"rollouts": rollouts, "velocity": velocity, "starts": starts}
