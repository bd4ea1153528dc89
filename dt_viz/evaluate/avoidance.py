"""Put a sphere into a motion and measure the motion of the end effector and the whole arm.

The npz file holds for each rollout i, as the page finally shows it, but for those whose start has no room:

``q_i`` (T, 6), ``times_i`` (T,)
    joint angles, rad, continuous joints unwrapped, and seconds.
``x_i`` (T, 3)
    end effector, metres, from these angles.
``demo_i`` (T_i, 3)
    its demonstration, metres.

The whole arm is measured by its collision meshes, also between the samples; the body points of the avoidance are not
used for that.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.arm.collision import CollisionReport, load_collision_model
from dt_viz.arm.robot import Robot, load_jaco
from dt_viz.arm.tracking import UnreachableError
from dt_viz.engine.engine import ArmMotion, Engine
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import (
    add_avoidance,
    add_task,
    chosen_task,
    point,
    positive_number,
    print_table,
    ready_to_write,
    scenario_around,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.metrics import maximum_collision_distance, sharpest_turn
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union

LIMIT_TOLERANCE = 1e-9
"""Excess over a joint limit, rad, that counts as rounding."""
TURN_ARC = 0.015
"""Length of the path over which a turn is measured, metres."""
NO_MOTION = 1
"""Exit status if the obstacle leaves no motion."""


@dataclass(frozen=True)
class Measured:
    """Measurements of one rollout; lengths in metres."""

    x: Array
    """(T, 3) positions of the end effector."""
    frechet: float
    """Discrete Fréchet distance of the end effector to the demonstration."""
    hand_depth: float
    """Greatest depth of the end effector in the obstacle."""
    hand_clearance: float
    """Smallest distance of the end effector from the obstacle, negative inside."""
    arm: CollisionReport
    """Collisions of the whole arm."""
    depth_without: float
    """Greatest depth of the arm in the obstacle without avoidance."""
    num_outside: int
    """Number of configurations outside the joint limits."""
    turn: float
    """Sharpest turn of the end effector over `TURN_ARC`, degrees."""
    turn_without: float
    """Sharpest turn without avoidance, degrees."""
    goal_miss: float
    """Distance of the end effector's last position from the demonstrations' goal."""


def measure(motion: ArmMotion, demonstration: Array, goal: Array, obstacle: Union, robot: Robot) -> Measured:
    """Measure one rollout of the arm."""
    model = load_collision_model()
    x = robot.end_effector(motion.q)
    depth = maximum_collision_distance(x, obstacle.signed_distance) + 0.0  # never -0
    outside = (motion.q < robot.lower - LIMIT_TOLERANCE) | (motion.q > robot.upper + LIMIT_TOLERANCE)
    return Measured(
        x=x,
        frechet=float(frechet([x], [demonstration])[0]),
        hand_depth=depth,
        hand_clearance=-depth if depth > 0 else float(obstacle.signed_distance(x).min()),
        arm=model.report(motion.q, obstacle),
        depth_without=max(0.0, -model.nearest_to_obstacle(motion.without, obstacle).distance),
        num_outside=int(outside.any(axis=1).sum()),
        turn=sharpest_turn(x, TURN_ARC),
        turn_without=sharpest_turn(robot.end_effector(motion.without), TURN_ARC),
        goal_miss=float(np.linalg.norm(x[-1] - goal)),
    )


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--obstacle", type=point, required=True, metavar="X,Y,Z", help="centre of the sphere, metres")
    parser.add_argument("--diameter", type=positive_number("metres", 1), required=True, metavar="D", help="metres")
    add_avoidance(parser, "task")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 1 if there is no motion to measure."""
    tasks, task = chosen_task(options)
    out = ready_to_write(options.out, ".npz")
    robot = load_jaco()
    engine = Engine(tasks, FitStore(default_cache_folder()), robot)
    obstacle = Union((Sphere(options.obstacle, options.diameter),))
    try:
        scenario = scenario_around(obstacle.parts, task, options)
        frame, motions = engine.arm_motions(scenario)
    except UnreachableError as error:
        print(f"no motion: the arm cannot reach the starts: {error}", file=sys.stderr)
        return NO_MOTION
    if frame.blocked:
        for reason in frame.blocked:
            print(f"no motion: {reason}", file=sys.stderr)
        return NO_MOTION

    arrays: dict[str, Any] = {}
    measured: dict[int, Measured] = {}
    numbers = engine.solved(scenario, FINE).nominal.numbers
    for i, motion in zip(numbers, motions, strict=True):
        demonstration = task.paths[i]
        measured[i] = measure(motion, demonstration, frame.goal, obstacle, robot)
        arrays |= {f"q_{i}": motion.q, f"x_{i}": measured[i].x, f"times_{i}": motion.times, f"demo_{i}": demonstration}
    write_npz(out, **arrays)
    _print(options, task.name, measured, motions)
    for warning in frame.certificates.warnings:
        print(f"warning: {warning}")
    return 0


def _print(
    options: argparse.Namespace, task: str, by_number: dict[int, Measured], motions: tuple[ArmMotion, ...]
) -> None:
    measured = list(by_number.values())
    x, y, z = options.obstacle
    who = {"task": "end effector", "cspace": "whole arm"}[options.space]
    avoidance = "without avoidance" if options.no_avoidance else f"avoidance by the {who}"
    print(f"{task}, sphere of {options.diameter:g} m at ({x:g}, {y:g}, {z:g}) m, {avoidance}; lengths in mm")
    rows = [
        (
            str(i),
            *(f"{1e3 * value:.1f}" for value in (m.frechet, m.hand_depth, m.hand_clearance, m.arm.depth)),
            f"{1e3 * m.arm.obstacle.distance:.1f}",
            m.arm.obstacle.links[0],
            f"{m.turn:.0f}° ({m.turn_without:.0f}°)",
            f"{m.num_outside} of {len(motion.q)}",
        )
        for (i, m), motion in zip(by_number.items(), motions, strict=True)
    ]
    print_table(
        (
            "rollout", "F.D.", "M.C.D. hand", "clearance", "M.C.D. arm", "clearance", "nearest link",
            "sharpest turn (without)", "outside joint limits",
        ),
        rows,
    )  # fmt: skip
    hand = max(m.hand_depth for m in measured), min(m.hand_clearance for m in measured)
    arm = max(m.arm.depth for m in measured), min(m.arm.obstacle.distance for m in measured)
    distances = [m.frechet for m in measured]
    print(f"\nF.D. mean {1e3 * np.mean(distances):.1f} mm, largest {1e3 * max(distances):.1f} mm")
    for name, (depth, clearance) in {"end effector": hand, "whole arm": arm}.items():
        print(f"M.C.D. of the {name} {1e3 * depth:.1f} mm; clearance {1e3 * clearance:.1f} mm")
    forced = max(m.depth_without for m in measured)
    print(f"M.C.D. of the whole arm without avoidance {1e3 * forced:.1f} mm")
    print(f"goal missed by {1e3 * max(m.goal_miss for m in measured):.3f} mm")
    print(f"joint-limit violations: {sum(m.num_outside for m in measured)} configuration(s)")
    itself = min((m.arm.itself.distance for m in measured if m.arm.itself), default=None)
    near = "more than 50 mm" if itself is None else f"{1e3 * itself:.0f} mm"
    print(f"links from each other {near}, from the table {1e3 * min(m.arm.table.distance for m in measured):.0f} mm")
