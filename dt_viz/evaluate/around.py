"""Put obstacles in the way of a task's motions, and measure the end effector and the whole arm around them.

    python -m dt_viz.evaluate around --task draw_s --obstacle -0.004,-0.5,0.412 --out around.npz
    python -m dt_viz.evaluate around --task push_box --count 20 --seed 0 --out around.npz

``--obstacle`` is the centre of one. Without it there are K places: the middle of the part of the mean demonstration
that obstacles are spread along, and random ones. The arm's collision meshes are measured, also between the samples; the
spheres that the avoidance computes with are not used. With ``--space task`` the path of the end effector gives way, and
the arm follows it. The npz file holds for each place with N obstacles and R starts:

``places`` (K, N, 3), ``sizes`` (K, N, 3), ``turns`` (K, N, 4), ``shapes`` (K, N)
    centres and side lengths, metres, of a cylinder its diameter twice and its height; unit quaternions wxyz; names.
``ends`` (K, R + 1)
    distance of the R starts and the goal of the end effector from the obstacles, metres, negative inside.
``blocked`` (K,), ``no_way`` (K,)
    whether the arm has no motion, and whether that is so although its postures at the ends are free.
``hand``, ``arm``, ``hand_without``, ``arm_without``, ``frechet``, … (K, R)
    the fields of `Rollout`; NaN where there is no motion.

With ``--obstacle`` it also holds of each rollout i ``q_i`` (T, n), rad, continuous joints unwrapped, ``times_i`` (T,),
seconds, ``x_i`` (T, 3), the end effector at these, and ``demo_i`` (T_i, 3), its demonstration, metres.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.avoidance.avoidance import SPACES, Avoidance
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import (
    Row,
    add_task,
    avoiding,
    chosen_task,
    interval,
    new_engine,
    number,
    point,
    ready_to_write,
    report,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import refined
from dt_viz.metrics import maximum_collision_distance, sharpest_turn
from dt_viz.motion.stack import FINE, Solution
from dt_viz.numerics import unit
from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.obstacles.shapes import UPRIGHT, Box, Cylinder, Obstacle, Quaternion, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.scenario.tasks import Task
from dt_viz.session.engine import ArmMotion, Engine
from dt_viz.warning import Kind, MotionWarning

TURN_ARC = 0.015
"""Length of the path over which a turn is measured, metres."""
ALLOWANCE = 1e-3
"""Shortfall of a clearance, metres, with which the margin counts as kept."""
SHAPES = ("sphere", "box", "cylinder")


@dataclass(frozen=True)
class Rollout:
    """Measurements of one rollout; lengths in metres, clearances negative inside the obstacle."""

    hand: float
    """Smallest clearance of the end effector."""
    arm: float
    """Smallest clearance of the arm's meshes."""
    hand_without: float
    """Smallest clearance of the end effector without avoidance."""
    arm_without: float
    """Smallest clearance of the arm's meshes without avoidance."""
    frechet: float
    """Discrete Fréchet distance of the end effector from the demonstration."""
    detour: float
    """Discrete Fréchet distance of the end effector from its motion without avoidance."""
    turn: float
    """Sharpest turn of the end effector over `TURN_ARC`, degrees."""
    turn_without: float
    """Sharpest turn without avoidance, degrees."""
    num_outside: int
    """Number of postures outside the joint limits."""
    goal_miss: float
    """Distance of the end effector's last position from the demonstrations' goal."""


@dataclass(frozen=True)
class Place:
    """Measurements of the motions around the obstacles at one place."""

    obstacle: Union
    avoidance: Avoidance
    ends: Array
    """(R + 1,) clearance of the undisturbed starts and goal of the end effector, metres."""
    rollouts: Mapping[int, Rollout]
    """By the numbers of their starts; empty where the arm is blocked."""
    motions: Mapping[int, ArmMotion]
    blocked: tuple[MotionWarning, ...] = ()
    """Reasons for which there is no motion."""
    warnings: tuple[MotionWarning, ...] = ()

    @property
    def no_way(self) -> bool:
        """Whether the arm finds no way between free ends."""
        return any(warning.kind is Kind.NO_WAY for warning in self.blocked)

    def largest(self, value: Callable[[Rollout], float]) -> float:
        """Largest value of the rollouts; NaN without any."""
        return max(map(value, self.rollouts.values()), default=np.nan)

    @property
    def is_free(self) -> bool:
        """Whether the obstacles leave the end effector's goal free, and the starts of all rollouts."""
        return bool(self.ends[[*self.rollouts, -1]].min() >= 0)

    @property
    def clearance(self) -> float:
        """Smallest clearance of what avoids, metres."""
        return -self.largest(lambda r: -(r.hand if self.avoidance.space == "task" else r.arm))

    @property
    def without(self) -> float:
        """Smallest clearance of what avoids where it does not, metres."""
        return -self.largest(lambda r: -(r.hand_without if self.avoidance.space == "task" else r.arm_without))

    @property
    def ratio(self) -> float:
        """Largest detour relative to what the deepest motion lacks of the margin without avoidance; NaN without any."""
        forced = self.avoidance.margin - self.without
        return self.largest(lambda r: r.detour) / forced if forced > 0 else np.nan


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_task(parser)
    where = parser.add_mutually_exclusive_group()
    where.add_argument("--obstacle", type=point, metavar="X,Y,Z", help="centre of the obstacle, metres")
    where.add_argument("--count", type=whole_number(0), default=20, help="random places (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the places (default: %(default)s)")
    parser.add_argument("--shape", choices=(*SHAPES, "any"), default=SHAPES[0], help="(default: %(default)s)")
    parser.add_argument("--number", type=int, choices=(1, 2, 3), default=1, help="obstacles (default: %(default)s)")
    size = "diameter or sides in metres, or a range of them (default: 0.15)"
    sizes = interval(1e-3, 1)
    parser.add_argument("--size", "--diameter", type=sizes, default=(0.15, 0.15), metavar="LOW[,HIGH]", help=size)
    along = "part of the mean demonstration's length, from 0 to 1, that they are spread along (default: 0.5)"
    parser.add_argument("--along", type=interval(0, 1), default=(0.5, 0.5), metavar="FROM[,TO]", help=along)
    spread = "largest distance of an obstacle from there, metres (default: %(default)s)"
    parser.add_argument("--spread", type=number("metres", 0, 1), default=0.05, help=spread)
    space = "what avoids: the end effector (task) or the whole arm (cspace) (default: %(default)s)"
    parser.add_argument("--space", choices=SPACES, default="cspace", help=space)
    generator = "probability is the paper's (default: %(default)s)"
    parser.add_argument("--generator", choices=GENERATORS, default=GENERATORS[0], help=generator)
    parser.add_argument("--no-avoidance", action="store_true", help="leave the obstacle's transforms out")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if the one obstacle that was asked for leaves no motion."""
    tasks, task = chosen_task(options)
    out, engine = ready_to_write(options.out, ".npz"), new_engine(tasks)
    try:
        chosen = {"space": options.space, "generator": options.generator}
        avoided = (Avoidance(obstacles, **chosen) for obstacles in _obstacles(task, options))
        places = [measured(engine, task, avoidance, on=not options.no_avoidance) for avoidance in avoided]
    except UnreachableError as error:
        print(f"no motion: the arm cannot reach the starts: {error}", file=sys.stderr)
        return 1
    one, *_ = places
    if options.obstacle and one.blocked:
        for reason in one.blocked:
            print(f"no motion: {reason}", file=sys.stderr)
        return 1
    arrays = _arrays(places, len(task.paths))
    if options.obstacle:
        for i, motion in one.motions.items():
            x = engine.follower.robot.end_effector(motion.q)
            arrays |= {f"q_{i}": motion.q, f"times_{i}": motion.times, f"x_{i}": x, f"demo_{i}": task.paths[i]}
    write_npz(out, **arrays)
    who = {"task": "the end effector", "cspace": "the whole arm"}[options.space]
    avoids = "nothing" if options.no_avoidance else who
    print(f"{task.name}, {avoids} avoids; worst rollout of each row, clearances negative inside")
    every = dict(enumerate(rollout for place in places for rollout in place.rollouts.values()))
    by_name = {f"place {k}": place for k, place in enumerate(places)}
    if options.obstacle:
        by_name = {f"start {i}": replace(one, rollouts={i: rollout}) for i, rollout in one.rollouts.items()}
    report([_row(name, of_row) for name, of_row in {**by_name, "all": replace(one, rollouts=every)}.items()])
    for place in places:
        for warning in (*place.blocked, *place.warnings)[: None if options.obstacle else 1]:
            print(f"warning: {warning}")
    report([*_shares(places)])
    return 0


def measured(engine: Engine, task: Task, avoidance: Avoidance, *, on: bool = True) -> Place:
    """Measure a task's motions around obstacles, on the arm's meshes; with the avoidance off through them.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    scenario, obstacle = avoiding(task, avoidance, on=on), avoidance.avoided
    ends = obstacle.signed_distance(engine.nominal(scenario).learned.demonstrated.ends)
    frame, motions = engine.arm_motions(scenario)
    if frame.blocked:
        return Place(obstacle, avoidance, ends, {}, {}, frame.blocked)
    solved, robot = engine.solved(scenario, FINE), engine.follower.robot
    if scenario.arm_avoidance is None:
        paths, without = _finely(solved.stack), solved.nominal.paths
    else:
        paths = {i: robot.end_effector(motion.q) for i, motion in motions.items()}
        without = {i: robot.end_effector(motion.without) for i, motion in motions.items()}
    rollouts, rounding = {}, 1e-9
    for i, motion in motions.items():
        path, undisturbed = paths[i], without[i]
        outside = (motion.q < robot.lower - rounding) | (motion.q > robot.upper + rounding)
        rollouts[i] = Rollout(
            hand=_clearance(path, obstacle),
            arm=robot.collision.nearest_to_obstacle(motion.q, obstacle).distance,
            hand_without=_clearance(undisturbed, obstacle),
            arm_without=robot.collision.nearest_to_obstacle(motion.without, obstacle).distance,
            frechet=float(frechet([path], [task.paths[i]])[0]),
            detour=float(frechet([path], [undisturbed])[0]),
            turn=sharpest_turn(path, TURN_ARC),
            turn_without=sharpest_turn(undisturbed, TURN_ARC),
            num_outside=int(outside.any(axis=1).sum()),
            goal_miss=float(np.linalg.norm(path[-1] - frame.goal)),
        )
    return Place(obstacle, avoidance, ends, rollouts, motions, (), frame.certificates.warnings)


def _clearance(path: Array, obstacle: Union) -> float:
    """Smallest clearance of a path (T, 3), metres, also between its points where it is inside."""
    depth = maximum_collision_distance(path, obstacle.signed_distance)
    return -depth if depth > 0 else float(obstacle.signed_distance(path).min())


def _finely(solution: Solution) -> tuple[Array, ...]:
    """Rollouts (T, 3) of a stack, sampled every millimetre."""
    bundle = replace(solution.bundle, levels=solution.bundle.positions[:, None])
    return refined(bundle, lambda i, u: solution.positions_at(i, u)[:, None], 1e-3).paths


def _obstacles(task: Task, options: argparse.Namespace) -> list[tuple[Obstacle, ...]]:
    """The obstacles of the first place, and of each random one."""
    count, (low, high), (begin, end) = options.count, options.size, options.along
    first = SHAPES[0] if options.shape == "any" else options.shape
    centre = _on(task, (begin + end) / 2) if options.obstacle is None else np.array(options.obstacle)
    middle = _shaped(first, centre, np.full(3, (low + high) / 2), UPRIGHT)
    drawn = []
    for nth in range(0 if options.obstacle else options.number):
        rng = np.random.default_rng(options.seed + 1_000_003 * nth)  # not the seed of another place
        offset = in_ball(rng, options.spread, count)
        along, sizes = rng.uniform(begin, end, size=count), rng.uniform(low, high, size=(count, 3))
        turns = np.roll(Rotation.from_rotvec(np.pi * rng.normal(size=(count, 3))).as_quat(), 1, axis=1)
        shapes = rng.choice(SHAPES, size=count) if options.shape == "any" else np.full(count, options.shape)
        centres = np.array([_on(task, s) for s in along]).reshape(-1, 3) + offset
        drawn.append([_shaped(*values) for values in zip(shapes, centres, sizes, turns, strict=True)])
    return [(middle,), *zip(*drawn, strict=True)]


def in_ball(rng: np.random.Generator, radius: float, num: int) -> Array:
    """Draw places (num, 3) evenly from a ball around 0, metres."""
    direction = unit(rng.normal(size=(num, 3)))
    return radius * rng.uniform(size=(num, 1)) ** (1 / 3) * direction


def _on(task: Task, fraction: float) -> Array:
    """Point (3,) of the mean demonstration at a fraction of its length, metres."""
    path = task.mean_path
    return np.array([np.interp(fraction * (len(path) - 1), np.arange(len(path)), axis) for axis in path.T])


def _shaped(shape: str, centre: Array, sizes: Array, turn: Array | Quaternion) -> Obstacle:
    """An obstacle: of a cylinder the first size is the diameter and the last one its height."""
    x, y, z = (float(size) for size in sizes)
    a, b, c, d = (float(part) for part in turn)
    if shape == "box":
        return Box(as_point(centre), (x, y, z), (a, b, c, d))
    if shape == "cylinder":
        return Cylinder(as_point(centre), x, z, (a, b, c, d))
    return Sphere(as_point(centre), x)


def _sizes(obstacle: Obstacle) -> tuple[float, float, float]:
    """Sizes as `_shaped` takes them."""
    if isinstance(obstacle, Box):
        return obstacle.sizes
    if isinstance(obstacle, Cylinder):
        return obstacle.diameter, obstacle.diameter, obstacle.height
    return (2 * obstacle.radius, 2 * obstacle.radius, 2 * obstacle.radius)


def _arrays(places: Sequence[Place], num_starts: int) -> dict[str, Array]:
    """Arrays of the file; the last obstacle is repeated where a place has fewer."""
    most = max(len(place.obstacle.parts) for place in places)

    def of_parts(value: Callable[[Obstacle], Any]) -> Array:
        parts = [place.obstacle.parts for place in places]
        return np.array([[value(of_place[min(k, len(of_place) - 1)]) for k in range(most)] for of_place in parts])

    of_rollouts = {field.name: np.full((len(places), num_starts), np.nan) for field in fields(Rollout)}
    for k, place in enumerate(places):
        for i, rollout in place.rollouts.items():
            for name, table in of_rollouts.items():
                table[k, i] = getattr(rollout, name)
    return {
        "places": of_parts(lambda part: part.position),
        "sizes": of_parts(_sizes),
        "turns": of_parts(lambda part: part.wxyz),
        "shapes": of_parts(lambda part: type(part).__name__.lower()),
        "ends": np.array([place.ends for place in places]),
        "blocked": np.array([bool(place.blocked) for place in places]),
        "no_way": np.array([place.no_way for place in places]),
        **of_rollouts,
    }


def _row(name: str, place: Place) -> Row:
    """Row of the table."""
    return {
        "": name,
        "hand mm": -1e3 * place.largest(lambda r: -r.hand),
        "arm mm": -1e3 * place.largest(lambda r: -r.arm),
        "without mm": 1e3 * place.without,
        "F.D. mm": 1e3 * place.largest(lambda r: r.frechet),
        "detour/forced": place.ratio,
        "turn °": place.largest(lambda r: r.turn),
        "without °": place.largest(lambda r: r.turn_without),
        "goal missed mm": 1e3 * place.largest(lambda r: r.goal_miss),
        "outside limits": sum(rollout.num_outside for rollout in place.rollouts.values()),
    }


def _shares(places: Sequence[Place]) -> Iterator[Row]:
    """Shares of the places, and medians over them."""
    moved = [place for place in places if place.rollouts and place.is_free]
    margin = places[0].avoidance.margin - ALLOWANCE

    def share(label: str, found: Sequence[bool]) -> Row:
        return {"figure": label, "value": f"{sum(found)} of {len(found)} ({100 * sum(found) / len(found):.1f} %)"}

    yield share("places that leave the end effector's starts and goal free", [p.ends.min() >= 0 for p in places])
    yield share("blocked", [bool(place.blocked) for place in places])
    yield share("blocked between free ends", [place.no_way for place in places])
    if not moved:
        return
    yield share("from some of the starts only", [len(place.rollouts) < len(place.ends) - 1 for place in moved])
    yield share("collisions", [place.clearance < 0 for place in moved])
    yield share(f"at least {1e3 * margin:.0f} mm kept", [place.clearance >= margin for place in moved])
    yield share("turns sharper than 90°", [place.largest(lambda r: r.turn) > 90 for place in moved])
    yield share("the same without avoidance", [place.largest(lambda r: r.turn_without) > 90 for place in moved])
    if ratios := [place.ratio for place in moved if place.ratio > 0]:
        median, p95 = np.percentile(ratios, [50, 95])
        yield {
            "figure": "detour/forced where a motion is in the way, median, 95 %",
            "value": f"{median:.2f}, {p95:.2f}",
        }
    mean = np.mean([rollout.frechet for place in moved for rollout in place.rollouts.values()])
    yield {"figure": "F.D. mean mm", "value": f"{1e3 * mean:.1f}"}
