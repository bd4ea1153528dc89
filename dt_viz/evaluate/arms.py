"""Measure arms: how long they load, tasks in their reach, random balls in their way, the robot in the loop, a drag's frame.

    python -m dt_viz.evaluate arms --arm panda ur5 --count 50 --seed 0 --out arms.npz

Each arm follows the tasks that ship with DT-Viz, placed in its reach. A ball's middle is near the hand, or near a random
point of a random link that moves, in a random posture of a random task's motions without it; its diameter is random,
too. Clearance is coal's distance of the ball from the collision shapes of the URDF, also between samples; the spheres
that the avoidance computes with are not used. A ball around which the arm cannot possibly pass is drawn again, and
counted: one that is nearer than the margin to a link that no joint carries away, or to the arm in all of many random
postures with the hand at the goal or at a start (inverse kinematics from random seeds, free of itself and the table).

The npz file holds for each arm NAME and its N balls:

``NAME_balls`` (N, 4), ``NAME_tasks`` (N,)
    centres and radii, metres; names of tasks.
``NAME_clearance`` (N, R), ``NAME_no_way`` (N,)
    smallest clearance of each motion, metres, NaN where a start has none; whether the arm finds no motion at all.
``NAME_missed`` (N,), ``NAME_loop`` (N,)
    distance of the robot in the loop from the goal at its end, and its smallest clearance, metres.
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController
from dt_viz.evaluate.around import ALLOWANCE, Place, in_ball, measured
from dt_viz.evaluate.options import (
    Row,
    avoiding,
    interval,
    new_engine,
    ready_to_write,
    report,
    whole_number,
    write_npz,
)
from dt_viz.evaluate.reactive import driven
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.choices import Ranges
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.cover import protrusion
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.robot.models import ARMS
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import with_avoidance
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

SPREAD = 0.05
"""Largest distance of a ball's middle from the point that it is put at, metres, for an arm as large as the JACO."""
AT_GOAL = 1e-3
"""Distance within which a path is followed and the goal is reached, metres."""
NUM_POSTURES = 400
"""Number of random postures of which one has to keep clear of a ball where a motion starts or ends."""
NUM_FRAMES = 40
"""Number of frames of each drag that are timed."""


@dataclass(frozen=True)
class Passage:
    """One ball, the motions around it, and the robot in the loop."""

    task: str
    place: Place
    ball: Sphere
    missed: float = np.nan
    """Distance of the robot in the loop from the goal at its end, metres; NaN where it has no motion."""
    loop: float = np.nan
    """Its smallest clearance, metres."""

    @property
    def from_all(self) -> bool:
        """Whether the arm moves from all starts."""
        return len(self.place.rollouts) == len(self.place.ends) - 1

    @property
    def is_cleared(self) -> bool:
        """Whether it does so with the margin."""
        return self.from_all and self.place.clearance >= self.place.avoidance.margin - ALLOWANCE

    @property
    def arrives(self) -> bool:
        """Whether the robot in the loop reaches the goal."""
        return self.missed <= AT_GOAL


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--arm", nargs="+", default=[*ARMS], metavar="NAME", help=f"(default: {' '.join(ARMS)})")
    parser.add_argument("--task", nargs="+", choices=[*TASKS], default=[*TASKS], metavar="TASK", help="(default: all)")
    parser.add_argument("--count", type=whole_number(1), default=50, help="balls for each (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the balls (default: %(default)s)")
    size = "range of their diameters in metres, for an arm as large as the JACO (default: 0.06,0.16)"
    parser.add_argument("--size", type=interval(1e-3, 1), default=(0.06, 0.16), metavar="LOW[,HIGH]", help=size)
    parser.add_argument("--first-load", action="store_true", help="also load each arm with an empty cache")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    out, jaco, rows, arrays = ready_to_write(options.out, ".npz"), new_engine(TASKS), [], {}
    engines = {arm: new_engine(TASKS, arm) for arm in options.arm}
    for arm, engine in engines.items():
        robot = engine.follower.robot
        row = {"arm": robot.title, "joints": robot.num_joints, "reach m": robot.reach}
        row |= _loading(arm, first=options.first_load) | _following(engine, options.task)
        passages, num_again = [], 0
        for passage, again in _passages(engine, options):
            print(f"{arm} {len(passages)} {_line(passage)}", flush=True)
            passages.append(passage)
            num_again += again
        ratio = np.divide(*np.median(list(_frames(engine, jaco, options)), axis=0))
        mean, _ = protrusion(robot.body.spheres, robot.meshes)
        row |= _row(passages, num_again) | {"frame × JACO": float(ratio), "cover mm": 1e3 * mean}
        arrays |= {f"{arm}_{name}": values for name, values in _arrays(passages).items()}
        rows.append(row)
    write_npz(out, **arrays)
    report(rows, markdown=True)
    return 0


def _loading(arm: str, *, first: bool) -> Row:
    """Seconds that processes of their own load an arm in: from the user's cache folder, and with an empty one."""
    code = "import sys, time; from dt_viz.robot.models import load_arm; began = time.perf_counter()\n"
    code += "load_arm(sys.argv[1]); print(time.perf_counter() - began)"
    kernels = os.environ.get("NUMBA_CACHE_DIR") or str(default_cache_folder() / "kernels")

    def seconds(**environment: str) -> float:
        around = {**os.environ, "NUMBA_CACHE_DIR": kernels, **environment}
        done = subprocess.run([sys.executable, "-c", code, arm], env=around, capture_output=True, check=True, text=True)
        return float(done.stdout)

    row: dict[str, float] = {"load s": seconds()}
    if first:
        with TemporaryDirectory() as empty:
            row["first s"] = seconds(XDG_CACHE_HOME=empty)
    return row


def _following(engine: Engine, tasks: Sequence[str]) -> Row:
    """How many of the tasks the arm follows, how far from them at most, and the least scale at which they are placed."""
    worst, scales = [], []
    for name in tasks:
        nominal, task = engine.nominal(Scenario(name)), engine.task(name)
        scales.append(task.scale / TASKS[name]().scale)
        try:
            worst.append(float(engine.follower.undisturbed(nominal).tracked.error.max()))
        except UnreachableError:
            worst.append(np.inf)
    followed = [error for error in worst if error <= AT_GOAL]
    return {
        "tasks": f"{len(followed)} of {len(worst)}",
        "off mm": 1e3 * max(worst),
        "scale": min(scales) / engine.follower.robot.size,
    }


def _passages(engine: Engine, options: argparse.Namespace) -> Iterator[tuple[Passage, int]]:
    """So many balls, each with the number of those that were drawn before it and cannot be passed."""
    rng, robot = np.random.default_rng(options.seed), engine.follower.robot
    for _ in range(options.count):
        name, again = rng.choice(options.task), 0
        task, nominal = engine.task(name), engine.nominal(Scenario(name))
        places = nominal.learned.demonstrated.ends
        q = engine.follower.undisturbed(nominal).tracked.q.reshape(-1, robot.num_joints)
        while True:
            ball = _ball(engine, q[rng.integers(len(q))], rng, options.size)
            avoidance = ArmAvoidance(ball)
            if _can_be_passed(engine, ball, places, avoidance.margin, rng):
                break
            again += 1
        place = measured(engine, task, avoidance)
        passage = Passage(name, place, ball)
        if place.motions:
            rollout = int(rng.choice([*place.motions]))
            joints, goal = _in_the_loop(engine, avoiding(task, avoidance), rollout)
            missed = float(np.linalg.norm(robot.end_effector(joints[-1]) - goal))
            passage = replace(passage, missed=missed, loop=robot.collision.nearest_to_obstacle(joints, ball).distance)
        yield passage, again


def _ball(engine: Engine, q: Array, rng: np.random.Generator, size: tuple[float, float]) -> Sphere:
    """Draw a ball near the hand or a link of the arm in a posture q (n,)."""
    robot, body = engine.follower.robot, engine.follower.whole_arm.body
    on_link = np.flatnonzero(body.joint == rng.choice(np.unique(body.joint)))
    point = len(body.joint) - 1 if rng.random() < 0.5 else rng.choice(on_link)  # the hand is the last one
    middle = body.positions(robot, q)[point] + in_ball(rng, robot.size * SPREAD, 1)[0]
    return Sphere(as_point(middle), robot.size * rng.uniform(*size))


def _can_be_passed(engine: Engine, ball: Sphere, places: Array, margin: float, rng: np.random.Generator) -> bool:
    """Whether the arm may have a motion between places (R, 3) of the hand, metres: see the file's first lines."""
    robot = engine.follower.robot
    fixed = CollisionModel(robot, [mesh for mesh in robot.meshes if mesh.joint < robot.num_fixed], robot.num_fixed)
    if fixed.nearest_to_obstacle(robot.home[None], ball).distance < margin:
        return False
    seeds = Ranges.of(robot.lower, robot.upper).random(rng, NUM_POSTURES)
    for place in places:
        found = track(robot, np.broadcast_to(place, (len(seeds), 1, 3)), seeds)
        q = found.q[found.error[:, 0] < AT_GOAL, 0]
        apart = np.array([robot.collision.obstacle_distance(one[None], ball)[0][0] >= margin for one in q], bool)
        if not any(_is_sound(robot.collision, one) for one in q[apart]):
            return False
    return True


def _is_sound(solids: CollisionModel, q: Array) -> bool:
    """Whether the links keep clear of each other and of the table in a posture q (n,)."""
    near = solids.nearest_to_itself(q[None])
    return (near is None or near.distance > 0) and solids.nearest_to_table(q[None]).distance >= 0


def _in_the_loop(engine: Engine, scenario: Scenario, rollout: int) -> tuple[Array, Array]:
    """The joints (T, n), rad, of the robot in the loop from where a rollout starts, and the goal (3,), metres."""
    solved = engine.solved(scenario, LIVE)
    assert solved.arm is not None
    q = solved.arm.p[int(np.argmax(solved.arm.index == rollout))]
    controller = ArmController(engine.follower, solved)
    controller.begin(q, rollout)
    return driven(controller, q), solved.nominal.goal


def _frames(engine: Engine, jaco: Engine, options: argparse.Namespace) -> Iterator[tuple[float, float]]:
    """Processor times, seconds, of the same drag's frames of an arm and of the JACO, in turn."""
    for task in ("draw_s", "push_box"):
        yield from zip(*(_drag(of, task, options.size[-1]) for of in (engine, jaco)), strict=True)


def _drag(engine: Engine, name: str, diameter: float) -> Iterator[float]:
    """Drag a ball along a loop through a task's motions; yields the processor time of each frame but the first."""
    size, task = engine.follower.robot.size, engine.task(name)
    ball, passing = Sphere(task.obstacle_position, size * diameter), None
    scenario = avoiding(task, ArmAvoidance(ball))
    for a in np.linspace(0, 2 * np.pi, NUM_FRAMES + 1):
        aside = 0.06 * size * np.array([np.sin(a), 0.3 * np.sin(2 * a), 1 - np.cos(a)])
        moved = ball.moved(as_point(np.asarray(ball.position) + aside))
        frames = engine.frames(replace(scenario, stack=with_avoidance(scenario, obstacles=(moved,)), passing=passing))
        began = time.thread_time()
        frame = next(frame for frame in frames if frame.stage is Stage.LIVE)
        if passing is not None:
            yield time.thread_time() - began
        passing = frame.passing


def _line(passage: Passage) -> str:
    """What is said of a ball at once."""
    place = passage.place
    reasons = " ".join(map(str, place.blocked)) if place.blocked else ""
    return (
        f"{passage.task}: {len(place.rollouts)} of {len(place.ends) - 1} motions, clearance {1e3 * place.clearance:.1f} mm"
        f" ({1e3 * place.without:.0f} without); loop {1e3 * passage.loop:.1f} mm, missed {1e3 * passage.missed:.2f} mm {reasons}"
    )


def _row(passages: Sequence[Passage], num_again: int) -> Row:
    """Row of the table, as far as balls go."""
    num = len(passages)
    return {
        "cleared": f"{sum(passage.is_cleared for passage in passages)} of {num}",
        "least mm": 1e3 * min(passage.place.clearance for passage in passages if passage.place.rollouts),
        "some starts": sum(bool(passage.place.rollouts) and not passage.from_all for passage in passages),
        "no way": sum(bool(passage.place.blocked) for passage in passages),
        "in the way": sum(passage.place.without < passage.place.avoidance.margin for passage in passages),
        "drawn again": num_again,
        "loop at goal": f"{sum(passage.arrives for passage in passages)} of {num}",
        "loop least mm": 1e3 * float(np.nanmin([passage.loop for passage in passages])),
    }


def _arrays(passages: Sequence[Passage]) -> dict[str, Array]:
    """Arrays of the file, of one arm."""
    most = max(len(passage.place.ends) - 1 for passage in passages)
    clearance = np.full((len(passages), most), np.nan)
    for passage, of_ball in zip(passages, clearance, strict=True):
        for i, rollout in passage.place.rollouts.items():
            of_ball[i] = rollout.arm
    return {
        "balls": np.array([[*passage.ball.position, passage.ball.radius] for passage in passages]),
        "tasks": np.array([passage.task for passage in passages]),
        "clearance": clearance,
        "no_way": np.array([bool(passage.place.blocked) for passage in passages]),
        "missed": np.array([passage.missed for passage in passages]),
        "loop": np.array([passage.loop for passage in passages]),
    }
