"""Measure a controller's call, the velocity of a motion at one point, for each kind of stack.

The JSON file holds for each stack:

``median_ms``, ``p95_ms``
    milliseconds of processor time of a call at one point of the stack's rollouts, as `dt_viz.library.Motion.velocity`
    computes it: the quickest of `REPEATS` calls at each point, since others use the machine, too.
"""

from __future__ import annotations

import argparse
import os
import platform
import time
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from dt_viz.evaluate.options import add_task, chosen_task, print_table, ready_to_write, whole_number, write_json
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import DiffeomorphicSystem
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.nominal import Learned
from dt_viz.motion.stack import FINE, build_stack
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, MeshObstacle, Point, Sphere, as_point
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import plane_of
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.avoidance import Avoidance
from dt_viz.transforms.base import Transform
from dt_viz.transforms.bias import BiasPoint

BIAS_OFFSET = 0.03
"""Distance (m) of the bias point from the mean demonstration, along the second axis of the task's slice."""
REPEATS = 3
"""Number of calls at each point."""
REGION = 0.2
"""Radius (m) of a region that is chosen by hand."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--points", type=whole_number(1), default=200, help="for each stack (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.json")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    _, task = chosen_task(options)
    out = ready_to_write(options.out, ".json")
    imitation = FitStore(default_cache_folder()).get(task.demonstrations)
    learned = Learned.of(task, imitation, imitates=True)
    figures: dict[str, dict[str, float]] = {}
    for name, stack in _stacks(task).items():
        layers = tuple(Layer(transform, name=f"{k}") for k, transform in enumerate(stack))
        solution = build_stack(learned.demonstrated, Scenario(task.name, layers).active, FINE)
        samples = solution.bundle.positions
        points = samples[np.linspace(0, len(samples) - 1, options.points).round().astype(int)]
        figures[name] = _measured(solution.system, points)
    environment = {"cores": os.cpu_count(), "python": platform.python_version(), "numpy": np.__version__}
    settings = {"task": task.name, "points": options.points, "tolerance": FINE.tolerance}
    write_json(out, {"stacks": figures, "settings": settings | environment})
    print_table(
        ("velocity at one point", "median ms", "95 % ms"),
        [(name, *(f"{milliseconds:.2f}" for milliseconds in stack.values())) for name, stack in figures.items()],
    )
    return 0


def _stacks(task: Task) -> Mapping[str, tuple[Transform, ...]]:
    """Return stacks on the imitation: obstacles in its way, and a bias point beside it."""

    def at(percent: int) -> Point:
        return as_point(task.mean_path[percent])

    ball, cube = Sphere(at(50), 0.12), Box(at(50), (0.1, 0.1, 0.1))
    cloud = Cloud(np.random.default_rng(0).uniform(-0.05, 0.05, (2000, 3)))
    beside = as_point(task.mean_path[75] + BIAS_OFFSET * task.slice.axes[:, 1])
    point = BiasPoint(beside, plane=plane_of(task))
    return {
        "imitation": (),
        "sphere": (Avoidance(ball),),
        "box": (Avoidance(cube),),
        "cylinder": (Avoidance(Cylinder(at(50), 0.1, 0.1)),),
        "three spheres": (Avoidance(Sphere(at(percent), 0.07) for percent in (30, 50, 70)),),
        "sphere, box and cylinder": (
            Avoidance((Sphere(at(30), 0.07), Box(at(50), (0.06, 0.06, 0.06)), Cylinder(at(70), 0.06, 0.06))),
        ),
        "bias point": (point,),
        "bias point in space, with a region": (BiasPoint(beside, radius=REGION),),
        "bias point and sphere": (point, Avoidance(Sphere(at(30), 0.12))),
        "mesh": (Avoidance(MeshObstacle(at(50), Solid(*cube.surface()))),),
        "cloud": (Avoidance(CloudObstacle(at(50), cloud)),),
    }


def _measured(system: DiffeomorphicSystem, points: Array) -> dict[str, float]:
    """Time a controller's velocities at `points` (N, 3), one after the other."""
    system.velocity(points[0])  # what is computed once for each field is computed here
    seconds = np.full(len(points), np.inf)
    for _ in range(REPEATS):
        for k, point in enumerate(points):
            began = time.thread_time()
            system.velocity(point)
            seconds[k] = min(seconds[k], time.thread_time() - began)
    median, p95 = 1e3 * np.percentile(seconds, [50, 95])
    return {"median_ms": float(median), "p95_ms": float(p95)}
