"""Measure arms: loading, tasks in reach, random balls in the way, the robot in the loop, the frames of a drag.

    python -m tests.benchmarks arms --arm panda ur5 --count 50 --seed 0 --out arms.npz

Each arm follows the tasks that ship with DT-Viz, placed in its reach. A ball's middle is near the hand, or near a point
of a random link that moves, in a random posture of a random task's motions; it is nearer to the arm there than the
margin. Clearance is coal's distance from the collision shapes of the URDF, also between samples; the spheres that the
avoidance computes with are not used. A ball that the arm cannot possibly pass is drawn again, and counted: one that is
nearer than the margin to a link that no joint carries away, to the goal or a start, or to the arm in each of many
postures with the hand there (inverse kinematics from random seeds, free of the arm itself and the table). Where the
arm does not clear the others from all starts, a planner that knows no demonstrations tells whether there is a way.

The npz file holds for each arm NAME and its N balls the fields of `Passage`, ``NAME_task`` (N,), ``NAME_ball`` (N, 4) …
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, fields, replace
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController
from dt_viz.evaluate.around import ALLOWANCE, in_ball, measured
from dt_viz.evaluate.options import (
    interval,
    new_engine,
    report,
    whole_number,
    write_npz,
)
from dt_viz.evaluate.reactive import SETTINGS, driven
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.motion.following import MAX_TRACKING_ERROR
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.cover import protrusion
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.robot.models import ARMS
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoiding, with_avoidance
from dt_viz.scenario.tasks import TASKS, Task
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from tests.benchmarks.passable import has_way, postures_at

OUT = "FILE.npz"
SPREAD = 0.05
"""Largest distance of a ball's middle from the point that it is put at, metres, for an arm as large as the JACO."""
NUM_FRAMES = 40
"""Number of frames of each of two drags that are timed."""


@dataclass(frozen=True)
class Passage:
    """One ball, the motions around it and the robot in the loop; lengths in metres, NaN where there is no motion."""

    task: str
    ball: tuple[float, float, float, float]
    """Centre and radius."""
    drawn_again: int
    """Number of balls before it that cannot be passed."""
    num_starts: int
    num_moving: int
    """Number of starts that the arm moves from."""
    lacking: float
    """What the nearest motion lacks of the margin, negative if it keeps more."""
    clearance: float
    """Smallest clearance of the motions."""
    missed: float = np.nan
    """Distance of the robot in the loop from the goal at its end."""
    loop: float = np.nan
    """Its smallest clearance."""
    has_way: bool | None = None
    """Whether a planner finds a way, where the arm does not clear the ball."""

    @property
    def is_cleared(self) -> bool:
        """Whether the arm moves from all starts, and keeps the margin."""
        return self.num_moving == self.num_starts and self.lacking <= ALLOWANCE

    def __str__(self) -> str:
        motions = f"{self.num_moving} of {self.num_starts} motions keep {1e3 * self.clearance:.1f} mm"
        way = "" if self.has_way is None else f"; a planner finds {'a' if self.has_way else 'no'} way"
        return f"{self.task}: {motions}; loop {1e3 * self.loop:.1f} mm, missed by {1e3 * self.missed:.2f} mm{way}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--arm", nargs="+", default=[*ARMS], metavar="NAME", help=f"(default: {' '.join(ARMS)})")
    parser.add_argument("--task", nargs="+", choices=[*TASKS], default=[*TASKS], metavar="TASK", help="(default: all)")
    parser.add_argument("--count", type=whole_number(1), default=50, help="balls for each (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the balls (default: %(default)s)")
    size = "range of their diameters in metres, for an arm as large as the JACO (default: 0.06,0.16)"
    parser.add_argument("--size", type=interval(1e-3, 1), default=(0.06, 0.16), metavar="LOW[,HIGH]", help=size)
    parser.add_argument("--first-load", action="store_true", help="also load each arm with an empty cache")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    jaco = new_engine(TASKS)
    engines = {arm: new_engine(TASKS, arm) for arm in options.arm}
    rows, arrays = [], {}
    for arm, engine in engines.items():
        robot, passages = engine.follower.robot, []
        row = {"arm": robot.title, "joints": robot.num_joints, "reach m": robot.reach}
        row |= _loading(arm, first=options.first_load) | _following(engine, options.task)
        for passage in _passages(engine, options):
            print(f"{arm} {len(passages)} {passage}", flush=True)
            passages.append(passage)
        own, jacos = np.median([*_frames(engine, jaco, options)], axis=0)
        mean, _ = protrusion(robot.body.spheres, robot.meshes)
        rows.append(row | _row(passages) | {"frame × JACO": float(own / jacos), "cover mm": 1e3 * mean})
        for field in fields(Passage):
            values = [getattr(passage, field.name) for passage in passages]
            arrays[f"{arm}_{field.name}"] = np.array([-1 if value is None else value for value in values])
        write_npz(options.out, **arrays)
    report(rows, markdown=True)
    return 0


def _loading(arm: str, *, first: bool) -> dict[str, Any]:
    """Seconds that processes of their own load an arm in: from the user's cache folder, and with an empty one."""
    code = "import sys, time; from dt_viz.robot.models import load_arm; began = time.perf_counter()\n"
    code += "load_arm(sys.argv[1]); print(time.perf_counter() - began)"
    kernels = os.environ.get("NUMBA_CACHE_DIR") or str(default_cache_folder() / "kernels")

    def seconds(**environment: str) -> float:
        known = {**os.environ, "NUMBA_CACHE_DIR": kernels, **environment}
        done = subprocess.run([sys.executable, "-c", code, arm], env=known, stdout=subprocess.PIPE, check=True)
        return float(done.stdout)

    cached = seconds()
    with TemporaryDirectory() as empty:
        return {"load s": cached, "first s": seconds(XDG_CACHE_HOME=empty) if first else None}


def _following(engine: Engine, tasks: Sequence[str]) -> dict[str, Any]:
    """How many tasks the arm follows, by how much it misses them at most, and at which scale they are at least."""
    worst, scales = [], []
    for name in tasks:
        nominal = engine.nominal(Scenario(name))
        scales.append(engine.task(name).scale / TASKS[name]().scale / engine.follower.robot.size)
        try:
            worst.append(float(engine.follower.undisturbed(nominal).tracked.error.max()))
        except UnreachableError:
            worst.append(np.inf)
    num = sum(error <= MAX_TRACKING_ERROR for error in worst)
    return {"tasks followed": f"{num} of {len(worst)}", "off mm": 1e3 * max(worst), "scale": min(scales)}


def _passages(engine: Engine, options: argparse.Namespace) -> Iterator[Passage]:
    """Measure so many balls."""
    rng, robot = np.random.default_rng(options.seed), engine.follower.robot
    for _ in range(options.count):
        task = engine.task(str(rng.choice(options.task)))
        ball, postures, again = _passable_ball(engine, task, rng, options.size)
        avoidance = ArmAvoidance(ball)
        place = measured(engine, task, avoidance)
        values = (*ball.position, ball.radius), again, len(place.ends) - 1, len(place.motions)
        passage = Passage(task.name, *values, avoidance.margin - place.clearance, place.clearance)
        if place.motions:
            joints, goal = _in_the_loop(engine, avoiding(task, avoidance), int(rng.choice([*place.motions])))
            missed = float(np.linalg.norm(robot.end_effector(joints[-1]) - goal))
            passage = replace(passage, missed=missed, loop=robot.collision.nearest_to_obstacle(joints, ball).distance)
        if not passage.is_cleared:
            passage = replace(passage, has_way=has_way(robot, ball, avoidance.margin, postures))
        yield passage


def _passable_ball(
    engine: Engine, task: Task, rng: np.random.Generator, size: tuple[float, float]
) -> tuple[Sphere, Array, int]:
    """Draw a ball; postures (R + 1, n), rad, beside it at starts and goal; how many before it cannot be passed."""
    nominal, robot = engine.nominal(Scenario(task.name)), engine.follower.robot
    q = engine.follower.undisturbed(nominal).tracked.q.reshape(-1, robot.num_joints)
    again = 0
    while True:
        ball = _ball(engine, q, rng, size)
        postures = postures_at(robot, nominal.learned.demonstrated.ends, ArmAvoidance(ball), rng)
        if postures is not None:
            return ball, postures, again
        again += 1


def _ball(engine: Engine, q: Array, rng: np.random.Generator, size: tuple[float, float]) -> Sphere:
    """Draw a ball that meets the arm in one of the postures q (N, n)."""
    robot, body = engine.follower.robot, engine.follower.whole_arm.body
    while True:
        posture = q[rng.integers(len(q))]
        on_link = np.flatnonzero(body.joint == rng.choice(np.unique(body.joint)))
        point = len(body.joint) - 1 if rng.random() < 0.5 else rng.choice(on_link)  # the hand is the last one
        middle = body.positions(robot, posture)[point] + in_ball(rng, robot.size * SPREAD, 1)[0]
        ball = Sphere(as_point(middle), robot.size * rng.uniform(*size))
        if robot.collision.obstacle_distance(posture[None], ball)[0][0] < ArmAvoidance(ball).margin:
            return ball


def _in_the_loop(engine: Engine, scenario: Scenario, rollout: int) -> tuple[Array, Array]:
    """Joints (T, n), rad, of the robot in the loop from the start of a rollout on, and the goal (3,), metres."""
    solved = engine.solved(scenario, LIVE)
    assert solved.arm is not None
    q, controller = solved.arm.p[np.argmax(solved.arm.index == rollout)], ArmController(engine.follower, solved)
    controller.begin(q, rollout)
    return driven(controller, q), solved.nominal.goal


def _frames(engine: Engine, jaco: Engine, options: argparse.Namespace) -> Iterator[tuple[float, float]]:
    """Processor times, seconds, of the same drag's frames of an arm and of the JACO, in turn."""
    for task in options.task[:2]:
        yield from zip(*(_drag(one, task, options.size[-1]) for one in (engine, jaco)), strict=True)


def _drag(engine: Engine, name: str, diameter: float) -> Iterator[float]:
    """Drag a ball on a loop through a task's motions; yields the processor time of each frame but the first."""
    size, task, passing = engine.follower.robot.size, engine.task(name), None
    ball = Sphere(task.obstacle_position, size * diameter)
    scenario = avoiding(task, ArmAvoidance(ball))
    for a in np.linspace(0, 2 * np.pi, NUM_FRAMES + 1):
        aside = 0.06 * size * np.array([np.sin(a), 0.3 * np.sin(2 * a), 1 - np.cos(a)])
        stack = with_avoidance(scenario, obstacles=(ball.moved(as_point(np.asarray(ball.position) + aside)),))
        began = time.thread_time()
        frames = engine.frames(replace(scenario, stack=stack, passing=passing))
        frame = next(frame for frame in frames if frame.stage is Stage.LIVE)
        if passing is not None:
            yield time.thread_time() - began
        passing = frame.passing


def _row(passages: Sequence[Passage]) -> dict[str, Any]:
    """Row of the table, as far as balls go."""
    num, others = len(passages), [passage.has_way for passage in passages if not passage.is_cleared]
    return {
        "cleared": f"{num - len(others)} of {num}",
        "others with a way": None if None in others else sum(map(bool, others)),
        "least mm": _least_mm(passage.clearance for passage in passages),
        "some starts": sum(0 < passage.num_moving < passage.num_starts for passage in passages),
        "no way": sum(passage.num_moving == 0 for passage in passages),
        "drawn again": sum(passage.drawn_again for passage in passages),
        "loop at goal": f"{sum(passage.missed <= SETTINGS.at_goal for passage in passages)} of {num}",
        "loop least mm": _least_mm(passage.loop for passage in passages),
    }


def _least_mm(distances: Iterable[float]) -> float:
    """The least of distances in metres, millimetres, without those that are NaN; NaN if all are."""
    return 1e3 * min((distance for distance in distances if not np.isnan(distance)), default=np.nan)
