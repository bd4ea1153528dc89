"""Measure arms: tasks in reach, random balls in the way, the frames of a drag.

    python -m tests.benchmarks arms --arm panda ur5 --count 50 --seed 0 --out arms.npz

Each arm follows the tasks that ship with DT-Viz, placed in its reach. A ball's middle is near the hand, or near a point
of a random link that moves, in a random posture of a random task's motions; it is nearer to the arm there than the
margin. Clearance is coal's distance from the collision shapes of the URDF, also between samples; the spheres that the
avoidance computes with are not used. A ball that the arm cannot possibly pass is drawn again: one that is
nearer than the margin to a link that no joint carries away, to the goal or a start, or to the arm in each of many
postures with the hand there (inverse kinematics from random seeds, free of the arm itself and the table). Where the
arm does not clear the others from all starts, a planner that knows no demonstrations tells whether there is a way.

The npz file holds for each arm NAME and its N balls the fields of `Passage`, ``NAME_task`` (N,), ``NAME_ball`` (N, 4) …
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.baselines.mpnet import rrt_connect
from dt_viz.baselines.postures import PlanningScene
from dt_viz.evaluate.around import ALLOWANCE, in_ball, measured, worst
from dt_viz.evaluate.options import (
    new_engine,
    output,
    report,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.motion.following import MAX_TRACKING_ERROR
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.choices import Ranges
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.cover import protrusion
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.robot.models import ARMS
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoiding, with_avoidance
from dt_viz.scenario.tasks import TASKS, Task
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

SIZE = (0.06, 0.16)  # range of diameters of balls, metres, for an arm as large as the JACO
SPREAD = 0.05
"""Largest distance of a ball's middle from the point that it is put at, metres, for an arm as large as the JACO."""
NUM_FRAMES = 40  # number of frames of each of two drags that are timed
NUM_POSTURES = 400  # number of random postures with the hand at a place, one of which has to keep clear
PLANNING = 10.0  # time in which the planner has to find a way from a start, seconds


@dataclass(frozen=True)
class Passage:
    """One ball and the motions around it; lengths in metres, NaN where there is no motion."""

    task: str
    ball: tuple[float, float, float, float]  # centre and radius
    num_starts: int
    num_moving: int  # number of starts that the arm moves from
    lacking: float  # what the nearest motion lacks of the margin, negative if it keeps more
    clearance: float  # smallest clearance of the motions
    has_way: bool | None = None  # whether a planner finds a way, where the arm does not clear the ball

    @property
    def is_cleared(self) -> bool:
        """Whether the arm moves from all starts, and keeps the margin."""
        return self.num_moving == self.num_starts and self.lacking <= ALLOWANCE

    def __str__(self) -> str:
        motions = f"{self.num_moving} of {self.num_starts} motions keep {1e3 * self.clearance:.1f} mm"
        way = "" if self.has_way is None else f"; a planner finds {'a' if self.has_way else 'no'} way"
        return f"{self.task}: {motions}{way}"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--out", type=output(".npz"), required=True, metavar="FILE.npz", help="what is written")
    parser.add_argument("--arm", nargs="+", default=[*ARMS], metavar="NAME", help=f"(default: {' '.join(ARMS)})")
    parser.add_argument("--count", type=whole_number(1), default=50, help="balls for each (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the balls (default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    jaco = new_engine(TASKS)
    engines = {arm: new_engine(TASKS, arm) for arm in options.arm}
    rows, arrays = [], {}
    for arm, engine in engines.items():
        robot, passages = engine.follower.robot, []
        row = {"arm": robot.title, "joints": robot.num_joints, "reach m": robot.reach}
        row |= _following(engine)
        for passage in _passages(engine, options):
            print(f"{arm} {len(passages)} {passage}", flush=True)
            passages.append(passage)
        own, jacos = np.median([*_frames(engine, jaco)], axis=0)
        mean, _ = protrusion(robot.body.spheres, robot.meshes)
        rows.append(row | _row(passages) | {"frame × JACO": float(own / jacos), "cover mm": 1e3 * mean})
        for field in fields(Passage):
            values = [getattr(passage, field.name) for passage in passages]
            arrays[f"{arm}_{field.name}"] = np.array([-1 if value is None else value for value in values])
        write_npz(options.out, arrays)
    report(rows)
    return 0


def _following(engine: Engine) -> dict[str, Any]:
    """How many tasks the arm follows, and by how much it misses them at most."""
    worst = []
    for name in TASKS:
        try:
            worst.append(float(engine.follower.undisturbed(engine.nominal(Scenario(name))).tracked.error.max()))
        except UnreachableError:
            worst.append(np.inf)
    num = sum(error <= MAX_TRACKING_ERROR for error in worst)
    return {"tasks followed": f"{num} of {len(worst)}", "off mm": 1e3 * max(worst)}


def _passages(engine: Engine, options: argparse.Namespace) -> Iterator[Passage]:
    """Measure so many balls."""
    rng, robot = np.random.default_rng(options.seed), engine.follower.robot
    for _ in range(options.count):
        task = engine.task(str(rng.choice([*TASKS])))
        ball, postures = _passable_ball(engine, task, rng)
        avoidance = ArmAvoidance(ball)
        place = measured(engine, task, avoidance)
        clearance = float(worst(place.figures, "arm"))
        values = (*ball.position, ball.radius), len(place.ends) - 1, len(place.motions)
        passage = Passage(task.name, *values, avoidance.margin - clearance, clearance)
        if place.motions:
            rng.integers(len(place.motions))  # a number that was used once: the balls stay those of the documents
        if not passage.is_cleared:
            passage = replace(passage, has_way=has_way(robot, ball, avoidance.margin, postures))
        yield passage


def _passable_ball(engine: Engine, task: Task, rng: np.random.Generator) -> tuple[Sphere, Array]:
    """Draw a ball that may be passed, and postures (R + 1, n), rad, beside it at starts and goal."""
    nominal, robot = engine.nominal(Scenario(task.name)), engine.follower.robot
    q = engine.follower.undisturbed(nominal).tracked.q.reshape(-1, robot.num_joints)
    while True:
        ball = _ball(engine, q, rng)
        postures = postures_at(robot, nominal.learned.demonstrated.ends, ArmAvoidance(ball), rng)
        if postures is not None:
            return ball, postures


def _ball(engine: Engine, q: Array, rng: np.random.Generator) -> Sphere:
    """Draw a ball that meets the arm in one of the postures q (N, n)."""
    robot, body = engine.follower.robot, engine.follower.whole_arm.body
    while True:
        posture = q[rng.integers(len(q))]
        on_link = np.flatnonzero(body.joint == rng.choice(np.unique(body.joint)))
        point = len(body.joint) - 1 if rng.random() < 0.5 else rng.choice(on_link)  # the hand is the last one
        middle = body.positions(robot, posture)[point] + in_ball(rng, robot.size * SPREAD, 1)[0]
        ball = Sphere(as_point(middle), robot.size * rng.uniform(*SIZE))
        if robot.collision.obstacle_distance(posture[None], ball)[0][0] < ArmAvoidance(ball).margin:
            return ball


def postures_at(robot: Robot, places: Array, avoidance: ArmAvoidance, rng: np.random.Generator) -> Array | None:
    """Find postures (R, n), rad, with the hand at `places` (R, 3), metres, that keep clear on the meshes.

    Inverse kinematics begins from random seeds. None where one is missing, or an obstacle is at a place or at a link
    that no joint carries away.
    """
    obstacle, margin = avoidance.avoided, avoidance.margin

    def keeps_clear(solids: CollisionModel, q: Array) -> bool:
        return solids.nearest_to_obstacle(q[None], obstacle).distance >= margin

    def is_sound(q: Array) -> bool:
        near = robot.collision.nearest_to_itself(q[None])
        return (near is None or near.distance > 0) and robot.collision.nearest_to_table(q[None]).distance >= 0

    fixed = CollisionModel(robot, [mesh for mesh in robot.meshes if mesh.joint < robot.num_fixed], robot.num_fixed)
    if obstacle.signed_distance(places).min() < margin or not keeps_clear(fixed, robot.home):
        return None
    found = []
    for place in places:
        seeds = Ranges.of(robot.lower, robot.upper).random(rng, NUM_POSTURES)
        tracked = track(robot, np.broadcast_to(place, (len(seeds), 1, 3)), seeds)
        q = tracked.q[tracked.error[:, 0] < MAX_TRACKING_ERROR, 0]
        found.append(next((one for one in q if keeps_clear(robot.collision, one) and is_sound(one)), None))
        if found[-1] is None:
            return None
    return np.array(found)


def has_way(robot: Robot, ball: Sphere, margin: float, postures: Array) -> bool | None:
    """Whether a planner finds a way that keeps the margin, metres, from each start to the goal.

    `postures` (R + 1, n), rad, are those at the starts and the goal. None where there is no planner: it is an extra.
    """
    scene = PlanningScene(robot, Union((Sphere(ball.position, 2 * (ball.radius + margin)),)))
    *starts, goal = postures
    try:
        return all(rrt_connect(scene.is_free, robot, start, goal, PLANNING) for start in starts)
    except ImportError:
        return None


def _frames(engine: Engine, jaco: Engine) -> Iterator[tuple[float, float]]:
    """Processor times, seconds, of the same drag's frames of an arm and of the JACO, in turn."""
    for task in [*TASKS][:2]:
        yield from zip(*(_drag(one, task) for one in (engine, jaco)), strict=True)


def _drag(engine: Engine, name: str) -> Iterator[float]:
    """Drag a ball on a loop through a task's motions; yields the processor time of each frame but the first."""
    size, task, passing = engine.follower.robot.size, engine.task(name), None
    ball = Sphere(task.obstacle_position, size * SIZE[-1])
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
    with_way = None if None in others else sum(map(bool, others))
    return {"cleared": f"{num - len(others)} of {num}", "others with a way": with_way}
