"""Put a sphere into a motion and measure what the arm's end effector does.

The npz file holds for each rollout i, as the page shows it when it rests:

``q_i`` (T, 6), ``times_i`` (T,)
    joint angles, rad, continuous joints unwrapped, and seconds. NaN where the arm cannot reach the rollout's start.
``x_i`` (T, 3)
    end effector, metres, from these angles; the rollout itself where there are none.
``demo_i`` (T_i, 3)
    its demonstration, metres.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.engine import Engine, Frame
from dt_viz.evaluate.options import (
    add_space,
    add_task,
    chosen_task,
    point,
    positive_number,
    print_table,
    ready_to_write,
)
from dt_viz.fields import Array
from dt_viz.fits import FitStore, default_cache_folder
from dt_viz.metrics import discrete_frechet, maximum_collision_distance, resample_by_arc_length
from dt_viz.obstacles import Sphere
from dt_viz.robot import Robot, load_jaco
from dt_viz.scenario import Scenario

NUM_COMPARED = 400
"""Points by arc length that a Fréchet distance is taken between."""
LIMIT_TOLERANCE = 1e-9
"""Rad by which rounding may take a joint over its limit."""


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--obstacle", type=point, required=True, metavar="X,Y,Z", help="centre of the sphere, metres")
    parser.add_argument("--diameter", type=positive_number("metres", 1), required=True, metavar="D", help="metres")
    add_space(parser)
    parser.add_argument("--no-avoidance", action="store_true", help="leave the obstacle's transform out")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    tasks, task = chosen_task(options)
    out = ready_to_write(options.out, ".npz")
    robot = load_jaco()
    engine = Engine(tasks, FitStore(default_cache_folder()), robot)
    obstacle = Sphere(options.obstacle, options.diameter)
    scenario = Scenario(task.name, obstacle, avoidance=not options.no_avoidance)
    arrays: dict[str, Any] = {}
    rows: list[tuple[str, ...]] = []
    doubts: dict[str, None] = {}  # in the order they come, each once
    depths, clearances, distances, violations = [], [], [], 0
    for i, demonstration in enumerate(task.paths):
        *_, frame = engine.frames(replace(scenario, arm_rollout=i))
        doubts.update(dict.fromkeys(frame.health.doubts))
        times, q, x = _arm_motion(frame, robot, i)
        arrays |= {f"q_{i}": q, f"x_{i}": x, f"times_{i}": times, f"demo_{i}": demonstration}
        a, b = (resample_by_arc_length(path, NUM_COMPARED) for path in (x, demonstration))
        distances.append(float(discrete_frechet(a, b)))
        depths.append(maximum_collision_distance(x, obstacle.signed_distance) + 0.0)  # never -0
        clearances.append(-depths[-1] if depths[-1] > 0 else float(obstacle.signed_distance(x).min()))
        outside = int(((q < robot.lower - LIMIT_TOLERANCE) | (q > robot.upper + LIMIT_TOLERANCE)).any(axis=1).sum())
        violations += outside
        within = "no arm" if np.isnan(q).any() else f"{outside} of {len(q)}"
        figures = (f"{1e3 * value:.1f}" for value in (distances[-1], depths[-1], clearances[-1]))
        rows.append((str(i), *figures, within))
    with out.open("wb") as file:
        np.savez_compressed(file, allow_pickle=False, **arrays)

    x, y, z = options.obstacle
    avoidance = "without avoidance" if options.no_avoidance else f"avoidance in {options.space} space"
    print(f"{task.name}, sphere of {options.diameter:g} m at ({x:g}, {y:g}, {z:g}) m, {avoidance}; end effector:")
    print_table(("rollout", "F.D. mm", "M.C.D. mm", "clearance mm", "outside joint limits"), rows)
    print(f"\nF.D. mean {1e3 * np.mean(distances):.1f} mm, largest {1e3 * max(distances):.1f} mm")
    print(f"M.C.D. {1e3 * max(depths):.1f} mm; clearance {1e3 * min(clearances):.1f} mm")
    print(f"joint-limit violations: {violations} configuration(s)")
    for doubt in doubts:
        print(f"doubt: {doubt}")
    return 0


def _arm_motion(frame: Frame, robot: Robot, rollout: int) -> tuple[Array, Array, Array]:
    """Times (T,), joint angles (T, 6) and end effector (T, 3) of the arm on its rollout."""
    if frame.arm is None:
        path = frame.rollouts[rollout]
        return frame.times[rollout], np.full((len(path), 6), np.nan), path
    q = frame.arm.q
    return frame.arm.times, q, robot.end_effector(q)
