"""Time exact rollouts against stepping the same system to the same accuracy.

Eight rollouts of 200 points at even times, without an obstacle and with one on the motion. For a fair comparison:

- The truth is a much finer stepping, with the flows of ψ integrated far more finely, too.
- Both sides must be within the same distance of it at every point, and the cheapest such setting of each is timed: for
  exact rollouts the tolerance of the obstacle's flow (nothing else in them is approximate), for stepping the step and
  that tolerance.
- Stepping may choose between the Runge–Kutta steps of `DiffeomorphicSystem.stepped_rollout`, fixed in length, and
  scipy's DOP853: eighth order, adaptive, with dense output, so that it need not stop at every point. It steps all eight
  rollouts together, and gets ẏ from one integration of ψ with its Jacobian. The faster of the two is compared.

The points of an exact rollout do not depend on each other, so all are evaluated together, which stepping cannot do. To
separate this effect, the same exact rollouts are also timed one rollout, and one point, at a time.

Stepping takes minutes near an obstacle's centre; a coarser `--accuracy` takes less.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from dt_viz.arm.robot import load_jaco
from dt_viz.engine.engine import Engine
from dt_viz.evaluate.options import (
    add_task,
    avoiding,
    chosen_task,
    point,
    positive_number,
    print_table,
    ready_to_write,
    whole_number,
    write_json,
)
from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Chain
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.obstacles.shapes import Sphere
from dt_viz.transforms.avoidance import Avoidance

NUM_ROLLOUTS, NUM_POINTS = 8, 200
ARRIVED = 1e-4
"""Distance from the goal in base space at which the last rollout ends, metres."""
FINER = 1e-3
"""Tolerance of the truth, relative to the required accuracy."""
NUM_REFINEMENTS = 4
"""Number of tolerances that are tried on each side, each a tenth of the one before."""
MAX_STEPS = 64
"""Largest number of fixed steps between neighbouring points; tried by doubling from 1."""

Systems = Callable[[float], DiffeomorphicSystem]
"""Function from the tolerance of the obstacle's flow, metres, to the system."""


@dataclass(frozen=True)
class Run:
    """Result of the cheapest setting of one side that is accurate enough."""

    setting: str
    seconds: float
    error: float
    """Largest distance from the truth, metres."""
    accurate: bool
    """Whether the error is within the required accuracy."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument(
        "--accuracy",
        type=positive_number("metres", 1),
        default=1e-5,
        metavar="M",
        help="metres from the truth that both sides must keep to (default: %(default)s)",
    )
    parser.add_argument("--obstacle", type=point, metavar="X,Y,Z", help="centre, metres (default: the task's)")
    parser.add_argument("--diameter", type=positive_number("metres", 1), metavar="D", default=0.15, help="metres")
    parser.add_argument("--repeats", type=whole_number(1), default=3, help="median of so many (default: %(default)s)")
    parser.add_argument("--out", type=Path, metavar="FILE.json", help="for the figures")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 1 if one of the sides cannot be made accurate enough."""
    tasks, task = chosen_task(options)
    out = None if options.out is None else ready_to_write(options.out, ".json")
    fits = FitStore(default_cache_folder())
    learned = task.system(fits.get(task.demonstrations))
    clock = learned.base
    # the learned pace has kinks, which a stepping of high order would have to find: that would flatter the exact side
    learned = replace(learned, base=Attractor(clock.goal, clock.speed, clock.smoothing))
    avoidance = Avoidance(Sphere(options.obstacle or task.obstacle_position, options.diameter))
    frame = next(iter(Engine(tasks, fits, load_jaco()).frames(avoiding(task, avoidance))))
    field = avoidance.avoided.field(avoidance.generator, avoidance.temperature)
    duration = frame.durations[0] or 0.0

    def with_obstacle(tolerance: float) -> DiffeomorphicSystem:
        avoiding = AdaptiveFlow(field, duration, tolerance)
        return replace(learned, transform=Chain([learned.transform, avoiding]))

    starts = _eight(task.starts)
    results: dict[str, Any] = {}
    rows = []
    scenes: dict[str, Systems] = {"no obstacle": lambda _: learned, "obstacle": with_obstacle}
    for scene, systems in scenes.items():
        exact, stepped, apart = compare(systems, starts, options.accuracy, options.repeats)
        ratios = {how: stepped.seconds / seconds for how, seconds in apart.items()}
        ratio, unbatched = stepped.seconds / exact.seconds, ", ".join(f"{ratios[how]:.3g} × {how}" for how in apart)
        print(f"{scene}: exact rollouts are {ratio:.0f} × faster; {unbatched}", flush=True)
        results[scene] = {"exact": vars(exact), "stepped": vars(stepped), "ratio": ratio, "ratios_apart": ratios}
        for name, side in (("exact", exact), ("stepped", stepped)):
            accuracy = f"{side.error:.1e}" + ("" if side.accurate else " (too coarse)")
            rows.append((f"{scene}, {name}", f"{1e3 * side.seconds:.1f}", accuracy, side.setting))
        rows += [(f"{scene}, exact, {how}", f"{1e3 * seconds:.1f}", "", "") for how, seconds in apart.items()]
    if out is not None:
        settings = {"task": task.name, "accuracy": options.accuracy, "repeats": options.repeats}
        settings |= {"obstacle": avoidance.obstacles[0].position, "diameter": options.diameter, "duration": duration}
        write_json(out, {**results, "settings": settings})
    print(
        f"{task.name}, {NUM_ROLLOUTS} rollouts × {NUM_POINTS} points, both within {options.accuracy:g} m of the truth"
    )
    print_table(("", "ms", "error m", "setting"), rows)
    return 0 if all(side["accurate"] for r in results.values() for side in (r["exact"], r["stepped"])) else 1


def compare(systems: Systems, starts: Array, accuracy: float, repeats: int) -> tuple[Run, Run, dict[str, float]]:
    """Time the cheapest accurate exact rollouts, the cheapest accurate stepping, and the former less batched.

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

    def distance(motion: Array) -> float:
        return float(np.linalg.norm(motion - truth, axis=-1).max())

    tolerances = accuracy * 10.0 ** -np.arange(NUM_REFINEMENTS)
    exact_to = {f"flow to {t:.0e} m": systems(t) for t in tolerances}
    exact = _cheapest(
        [(name, lambda system=system: system.rollout(starts, times)) for name, system in exact_to.items()],
        distance,
        accuracy,
        max(repeats, 5),
    )
    # a stepper whose field is rougher than its own tolerance takes ever smaller steps: the flow is ten times finer
    adaptive = _cheapest(
        [
            (f"DOP853 to {t:.0e} m", lambda t=t: stepped_adaptively(systems(t / 10), starts, times, t))
            for t in 10 * tolerances
        ],
        distance,
        accuracy,
        repeats,
    )
    fixed = _cheapest(
        [
            (f"RK4, {n} steps a point", lambda n=n: systems(accuracy / 10).stepped_rollout(starts, times, n))
            for n in (2**k for k in range(MAX_STEPS.bit_length()))
        ],
        distance,
        accuracy,
        repeats,
        give_up=adaptive.seconds if adaptive.accurate else np.inf,
    )
    apart = _apart(exact_to[exact.setting], starts, times, repeats)
    return exact, min(adaptive, fixed, key=lambda side: (not side.accurate, side.seconds)), apart


def _apart(system: DiffeomorphicSystem, starts: Array, times: Array, repeats: int) -> dict[str, float]:
    """Time exact rollouts (R, T, 3), in seconds, with fewer points evaluated together."""

    def by_point() -> Array:
        motion = [[system.rollout(start[None], times[[k]]) for k in range(len(times))] for start in starts]
        return np.array(motion)

    def by_rollout() -> Array:
        return np.stack([system.rollout(start, times) for start in starts])

    return {
        "one rollout at a time": _median_seconds(by_rollout, repeats),
        "one point at a time": _median_seconds(by_point, repeats),
    }


def stepped_adaptively(system: DiffeomorphicSystem, starts: Array, times: Array, tolerance: float) -> Array:
    """Compute the motion (R, T, 3) by DOP853 on ẏ = J⁻¹ f(ψ(y)), all rollouts in one state, to `tolerance` metres."""

    def velocity(_: float, state: Array) -> Array:
        return system.velocity(state.reshape(starts.shape)).ravel()

    span = (float(times[0]), float(times[-1]))
    solution = solve_ivp(velocity, span, starts.ravel(), "DOP853", times, rtol=tolerance, atol=tolerance)
    return np.moveaxis(solution.y.reshape(*starts.shape, -1), -1, 1)


def _cheapest(
    settings: list[tuple[str, Callable[[], Array]]],
    distance: Callable[[Array], float],
    accuracy: float,
    repeats: int,
    give_up: float = np.inf,
) -> Run:
    """Return the first accurate setting in order of cost, or the last one tried, at most `give_up` seconds each."""
    best = Run("", np.inf, np.inf, False)
    for setting, motion in settings:
        began = time.perf_counter()
        error = distance(motion())
        best = Run(setting, time.perf_counter() - began, error, error <= accuracy)
        if best.accurate:
            return replace(best, seconds=_median_seconds(motion, repeats))
        if best.seconds > give_up:
            break
    return best


def _median_seconds(motion: Callable[[], Array], repeats: int) -> float:
    seconds = []
    for _ in range(repeats):
        began = time.perf_counter()
        motion()
        seconds.append(time.perf_counter() - began)
    return float(np.median(seconds))


def _eight(starts: Array) -> Array:
    """Return eight starts: the task's own, and if these are fewer, middles between neighbours."""
    while len(starts) < NUM_ROLLOUTS:
        starts = np.concatenate([starts, (starts + np.roll(starts, -1, axis=0)) / 2])
    return starts[:NUM_ROLLOUTS]
