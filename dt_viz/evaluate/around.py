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
``hand``, ``arm``, ``hand_without``, ``arm_without`` (K, R)
    smallest clearance of the end effector and of the arm's meshes, with and without avoidance; as all that follows NaN
    where there is no motion.
``frechet``, ``detour``, ``goal_miss`` (K, R)
    discrete Fréchet distance of the end effector from the demonstration, and from its motion without avoidance;
    distance of its last position from the demonstrations' goal.
``turn``, ``turn_without``, ``num_outside`` (K, R)
    sharpest turn of the end effector over `TURN_ARC`, degrees; number of postures outside the joint limits.

With ``--obstacle`` it also holds of each rollout i ``q_i`` (T, n), rad, continuous joints unwrapped, ``times_i`` (T,),
seconds, ``x_i`` (T, 3), the end effector at these, and ``demo_i`` (T_i, 3), its demonstration, metres.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.avoidance.avoidance import SPACES, Avoidance
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import (
    Row,
    add_task,
    chosen_task,
    engine_of,
    interval,
    number,
    point,
    report,
    whole_number,
    write_npz,
)
from dt_viz.evaluate.sweep import add_workers, sweep
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import refined
from dt_viz.metrics import interpolate, maximum_collision_distance, sharpest_turn
from dt_viz.motion.stack import FINE, Solution
from dt_viz.numerics import unit
from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.obstacles.shapes import UPRIGHT, Box, Cylinder, Obstacle, Quaternion, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.scenario.stack import avoiding
from dt_viz.scenario.tasks import Task
from dt_viz.session.engine import ArmMotion, Engine
from dt_viz.warning import Kind, MotionWarning

OUT = "FILE.npz"
TURN_ARC = 0.015
"""Length of the path over which a turn is measured, metres."""
ALLOWANCE = 1e-3
"""Shortfall of a clearance, metres, with which the margin counts as kept."""
SHAPES = ("sphere", "box", "cylinder")


CLEARANCES = ("hand", "arm", "hand_without", "arm_without")
FIGURES = (*CLEARANCES, "frechet", "detour", "goal_miss", "turn", "turn_without", "num_outside")
"""Measurements of a rollout, as the module explains them."""


@dataclass(frozen=True)
class Place:
    """Measurements of the motions around the obstacles at one place."""

    avoidance: Avoidance
    ends: Array
    """(R + 1,) clearance of the undisturbed starts and goal of the end effector, metres."""
    motions: Mapping[int, ArmMotion]
    """By the numbers of their starts; empty where the arm is blocked."""
    figures: Array
    """(R, F), each of `FIGURES`; NaN for starts without a motion."""
    blocked: tuple[MotionWarning, ...] = ()
    """Reasons for which there is no motion."""
    warnings: tuple[MotionWarning, ...] = ()

    @property
    def no_way(self) -> bool:
        """Whether the arm finds no way between free ends."""
        return any(warning.kind is Kind.NO_WAY for warning in self.blocked)

    def of(self, figure: str) -> Array:
        """(R,) one of the figures."""
        return self.figures[:, FIGURES.index(figure)]

    def worst(self, figure: str) -> float:
        """Largest value of a figure over the rollouts, of a clearance the smallest; NaN without any."""
        known = self.of(figure)[np.isfinite(self.of(figure))]
        return float(known.min() if figure in CLEARANCES else known.max()) if len(known) else np.nan

    @property
    def is_free(self) -> bool:
        """Whether the obstacles leave the end effector's goal free, and the starts of all rollouts."""
        return bool(self.ends[[*self.motions, -1]].min() >= 0)

    @property
    def clearance(self) -> float:
        """Smallest clearance of what avoids, metres."""
        return self.worst("hand" if self.avoidance.space == "task" else "arm")

    @property
    def without(self) -> float:
        """Smallest clearance of what avoids where it does not, metres."""
        return self.worst("hand_without" if self.avoidance.space == "task" else "arm_without")

    @property
    def ratio(self) -> float:
        """Largest detour relative to what the deepest motion lacks of the margin without avoidance; NaN without any."""
        forced = self.avoidance.margin - self.without
        return self.worst("detour") / forced if forced > 0 else np.nan


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
    add_workers(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if the one obstacle that was asked for leaves no motion."""
    _, task = chosen_task(options)
    chosen = {"space": options.space, "generator": options.generator}
    avoided = [Avoidance(obstacles, **chosen) for obstacles in _obstacles(task, options)]
    try:
        with sweep(options, partial(engine_of, task)) as (engine, swept):
            places = [*swept(_measured, [(task.name, avoidance, not options.no_avoidance) for avoidance in avoided])]
    except UnreachableError as error:
        print(f"no motion: the arm cannot reach the starts: {error}", file=sys.stderr)
        return 1
    one, *_ = places
    if options.obstacle and one.blocked:
        for reason in one.blocked:
            print(f"no motion: {reason}", file=sys.stderr)
        return 1
    arrays = _arrays(places)
    if options.obstacle:
        for i, motion in one.motions.items():
            x = engine.follower.robot.end_effector(motion.q)
            arrays |= {f"q_{i}": motion.q, f"times_{i}": motion.times, f"x_{i}": x, f"demo_{i}": task.paths[i]}
    write_npz(options.out, **arrays)
    who = {"task": "the end effector", "cspace": "the whole arm"}[options.space]
    avoids = "nothing" if options.no_avoidance else who
    print(f"{task.name}, {avoids} avoids; worst rollout of each row, clearances negative inside")
    by_name = {f"place {k}": place for k, place in enumerate(places)}
    if options.obstacle:
        by_name = {f"start {i}": replace(one, figures=one.figures[[i]]) for i in one.motions}
    every = replace(one, figures=np.concatenate([place.figures for place in places]))
    report([_row(name, of_row) for name, of_row in {**by_name, "all": every}.items()])
    for place in places:
        for warning in (*place.blocked, *place.warnings)[: None if options.obstacle else 1]:
            print(f"warning: {warning}")
    report([*_shares(places)])
    return 0


def _measured(engine: Engine, case: tuple[str, Avoidance, bool]) -> Place:
    """Measure a task, by name, around an avoidance's obstacles, which is on or off."""
    task, avoidance, on = case
    return measured(engine, engine.task(task), avoidance, on=on)


def measured(engine: Engine, task: Task, avoidance: Avoidance, *, on: bool = True) -> Place:
    """Measure a task's motions around obstacles, on the arm's meshes; with the avoidance off through them.

    Raises:
        UnreachableError: the arm cannot get to where the motions start.
    """
    scenario, obstacle = avoiding(task, avoidance, on=on), avoidance.avoided
    ends = obstacle.signed_distance(engine.nominal(scenario).learned.demonstrated.ends)
    figures = np.full((len(ends) - 1, len(FIGURES)), np.nan)
    frame, motions = engine.arm_motions(scenario)
    if frame.blocked:
        return Place(avoidance, ends, {}, figures, frame.blocked)
    solved, robot = engine.solved(scenario, FINE), engine.follower.robot
    if scenario.arm_avoidance is None:
        paths, without = _finely(solved.stack), solved.nominal.paths
    else:
        paths = {i: robot.end_effector(motion.q) for i, motion in motions.items()}
        without = {i: robot.end_effector(motion.without) for i, motion in motions.items()}
    rounding = 1e-9
    for i, motion in motions.items():
        path, undisturbed = paths[i], without[i]
        outside = (motion.q < robot.lower - rounding) | (motion.q > robot.upper + rounding)
        figures[i] = (
            _clearance(path, obstacle),
            robot.collision.nearest_to_obstacle(motion.q, obstacle).distance,
            _clearance(undisturbed, obstacle),
            robot.collision.nearest_to_obstacle(motion.without, obstacle).distance,
            frechet([path], [task.paths[i]])[0],
            frechet([path], [undisturbed])[0],
            np.linalg.norm(path[-1] - frame.goal),
            sharpest_turn(path, TURN_ARC),
            sharpest_turn(undisturbed, TURN_ARC),
            outside.any(axis=1).sum(),
        )
    return Place(avoidance, ends, motions, figures, (), frame.certificates.warnings)


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
    centre = _on(task, np.array([begin + end]) / 2)[0] if options.obstacle is None else np.array(options.obstacle)
    middle = _shaped(first, centre, np.full(3, (low + high) / 2), UPRIGHT)
    drawn = []
    for nth in range(0 if options.obstacle else options.number):
        rng = np.random.default_rng(options.seed + 1_000_003 * nth)  # not the seed of another place
        offset = in_ball(rng, options.spread, count)
        along, sizes = rng.uniform(begin, end, size=count), rng.uniform(low, high, size=(count, 3))
        turns = np.roll(Rotation.from_rotvec(np.pi * rng.normal(size=(count, 3))).as_quat(), 1, axis=1)
        shapes = rng.choice(SHAPES, size=count) if options.shape == "any" else np.full(count, options.shape)
        centres = _on(task, along) + offset
        drawn.append([_shaped(*values) for values in zip(shapes, centres, sizes, turns, strict=True)])
    return [(middle,), *zip(*drawn, strict=True)]


def in_ball(rng: np.random.Generator, radius: float, num: int) -> Array:
    """Draw places (num, 3) evenly from a ball around 0, metres."""
    direction = unit(rng.normal(size=(num, 3)))
    return radius * rng.uniform(size=(num, 1)) ** (1 / 3) * direction


def _on(task: Task, fractions: Array) -> Array:
    """Points (N, 3) of the mean demonstration at fractions (N,) of its length, metres."""
    path = task.mean_path
    return interpolate(fractions * (len(path) - 1), np.arange(len(path)), path)


def _shaped(shape: str, centre: Array, sizes: Array, turn: Array | Quaternion) -> Obstacle:
    """An obstacle: of a cylinder the first size is the diameter and the last one its height."""
    (x, y, z), (a, b, c, d) = sizes.tolist(), np.asarray(turn).tolist()
    if shape == "box":
        return Box(as_point(centre), (x, y, z), (a, b, c, d))
    return Cylinder(as_point(centre), x, z, (a, b, c, d)) if shape == "cylinder" else Sphere(as_point(centre), x)


def _sizes(obstacle: Obstacle) -> tuple[float, float, float]:
    """Sizes as `_shaped` takes them."""
    if isinstance(obstacle, Box):
        return obstacle.sizes
    diameter = obstacle.diameter if isinstance(obstacle, Cylinder) else 2 * obstacle.radius
    return diameter, diameter, obstacle.height if isinstance(obstacle, Cylinder) else diameter


def _arrays(places: Sequence[Place]) -> dict[str, Array]:
    """Arrays of the file; the last obstacle is repeated where a place has fewer."""
    obstacles = [place.avoidance.obstacles for place in places]
    most = max(map(len, obstacles))
    parts = [(*of_place, *most * of_place[-1:])[:most] for of_place in obstacles]
    of_parts: dict[str, Callable[[Obstacle], Any]] = {
        "places": lambda part: part.position,
        "sizes": _sizes,
        "turns": lambda part: part.wxyz,
        "shapes": lambda part: type(part).__name__.lower(),
    }
    return {
        **{name: np.array([[value(part) for part in row] for row in parts]) for name, value in of_parts.items()},
        "ends": np.array([place.ends for place in places]),
        "blocked": np.array([bool(place.blocked) for place in places]),
        "no_way": np.array([place.no_way for place in places]),
        **{figure: np.array([place.of(figure) for place in places]) for figure in FIGURES},
    }


def _row(name: str, place: Place) -> Row:
    """Row of the table."""
    return {
        "": name,
        "hand mm": 1e3 * place.worst("hand"),
        "arm mm": 1e3 * place.worst("arm"),
        "without mm": 1e3 * place.without,
        "F.D. mm": 1e3 * place.worst("frechet"),
        "detour/forced": place.ratio,
        "turn °": place.worst("turn"),
        "without °": place.worst("turn_without"),
        "goal missed mm": 1e3 * place.worst("goal_miss"),
        "outside limits": int(np.nansum(place.of("num_outside"))),
    }


def _shares(places: Sequence[Place]) -> Iterator[Row]:
    """Shares of the places, and medians over them."""
    moved = [place for place in places if place.motions and place.is_free]
    margin = places[0].avoidance.margin - ALLOWANCE

    def share(label: str, found: Sequence[bool]) -> Row:
        return {"figure": label, "value": f"{sum(found)} of {len(found)} ({100 * sum(found) / len(found):.1f} %)"}

    yield share("places that leave the end effector's starts and goal free", [p.ends.min() >= 0 for p in places])
    yield share("blocked", [bool(place.blocked) for place in places])
    yield share("blocked between free ends", [place.no_way for place in places])
    if not moved:
        return
    yield share("from some of the starts only", [len(place.motions) < len(place.figures) for place in moved])
    yield share("collisions", [place.clearance < 0 for place in moved])
    yield share(f"at least {1e3 * margin:.0f} mm kept", [place.clearance >= margin for place in moved])
    yield share("turns sharper than 90°", [place.worst("turn") > 90 for place in moved])
    yield share("the same without avoidance", [place.worst("turn_without") > 90 for place in moved])
    if ratios := [place.ratio for place in moved if place.ratio > 0]:
        label = "detour/forced where a motion is in the way, median, 95 %"
        yield {"figure": label, "value": "{:.2f}, {:.2f}".format(*np.percentile(ratios, [50, 95]))}
    mean = np.nanmean(np.concatenate([place.of("frechet") for place in moved]))
    yield {"figure": "F.D. mean mm", "value": f"{1e3 * mean:.1f}"}
