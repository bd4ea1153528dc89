"""Put obstacles at random places along the mean demonstration, and measure the whole arm for each.

With ``--space task``, where the hand alone gives way, its motions are measured instead: see `dt_viz.evaluate.hand`.

The npz file holds for each of K places with N obstacles in each:

``places`` (K, N, 3), ``sizes`` (K, N, 3), ``turns`` (K, N, 4), ``shapes`` (K, N)
    centres and side lengths, metres, of a cylinder its diameter twice and its height; unit quaternions wxyz; names.
    The first place is at the middle of the part of the mean demonstration that they are spread along.
``blocked`` (K,), ``left_out`` (K,)
    whether the arm is said to have no motion, and the number of the task's starts left out.
``no_way`` (K,)
    whether that is so although there is room at the ends.
``shift`` (K,)
    length of the shortest straight shift by which the undisturbed arm would clear the obstacles, metres.
``hand_room`` (K, R + 1)
    distance of the hand's covering spheres from the obstacles at the R starts and at the goal, metres, turned to where
    the hand has most room.
``arm_depth``, ``arm_clearance``, ``hand_clearance``, ``depth_without``, ``frechet``, ``goal_miss`` (K, R)
    metres, of each rollout; ``turn`` and ``turn_without`` in degrees, ``num_outside``; NaN where there is no motion.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.arm.body_points import load_body_points
from dt_viz.arm.robot import NUM_JOINTS, Robot, load_jaco
from dt_viz.arm.whole_arm import OVERSHOOT
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Frame
from dt_viz.evaluate import hand
from dt_viz.evaluate.avoidance import Measured, measure
from dt_viz.evaluate.options import (
    add_avoidance,
    add_task,
    chosen_task,
    interval,
    number,
    print_table,
    ready_to_write,
    scenario_around,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.stack import FINE
from dt_viz.obstacles.shapes import UPRIGHT, Box, Cylinder, Obstacle, Quaternion, Sphere, as_point, golden_spiral
from dt_viz.obstacles.union import Union
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import Task
from dt_viz.warning import Kind

WITHIN = 0.05
"""Default of the largest distance of an obstacle from the mean demonstration, metres."""
ALLOWANCE = 1e-3
"""Distance, metres, by which the meshes may come nearer than the margin where it counts as kept."""
SHARP = 90.0
"""Turn over `dt_viz.evaluate.avoidance.TURN_ARC` beyond which it is sharp, degrees."""
SHAPES = ("sphere", "box", "cylinder")
NUM_DIRECTIONS, NUM_STEPS, STRIDE = 128, 40, 6
"""Number of directions of a shift, largest number of steps until it is long enough, and stride of the postures."""
ROUNDING = 1e-3
"""Tolerance of its length, metres."""
NUM_TURNS = 500
"""Number of orientations of the hand that room is looked for in."""
SEEDS = 1_000_003
"""Difference of the seeds of the first and the second obstacle of a place."""


@dataclass(frozen=True)
class Place:
    """What was measured with obstacles at one place."""

    union: Union
    hand_room: Array
    """(R + 1,) room that the hand has at the starts and at the goal, see `hand_room`."""
    frame: Frame
    rollouts: dict[int, Measured]
    """By the numbers of their starts; empty where the arm is blocked."""
    shift: float = np.nan
    """Length of the shortest straight shift, see `shortest_shift`; NaN where the arm is blocked."""

    @property
    def no_way(self) -> bool:
        """Whether the arm finds no way between free ends."""
        return any(warning.kind is Kind.NO_WAY for warning in self.frame.blocked)

    def largest(self, value: Callable[[Measured], float]) -> float:
        """The largest value of the rollouts."""
        return max(value(measured) for measured in self.rollouts.values())

    def clearance(self) -> float:
        """Smallest distance of the arm's meshes from the obstacles, metres, negative inside."""
        return -self.largest(lambda m: -m.arm.obstacle.distance)

    def detour(self, margin: float) -> float:
        """Largest Fréchet distance relative to the depth without avoidance plus the margin."""
        return self.largest(lambda m: m.frechet / (m.depth_without + margin))

    def beside_shift(self, margin: float) -> float:
        """Largest Fréchet distance relative to the shortest straight shift, or to the margin if that is larger."""
        return self.largest(lambda m: m.frechet) / max(margin, self.shift)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--count", type=whole_number(0), default=20, help="random places (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the places (default: %(default)s)")
    parser.add_argument("--shape", choices=(*SHAPES, "any"), default="sphere", help="(default: %(default)s)")
    parser.add_argument("--number", type=int, choices=(1, 2, 3), default=1, help="obstacles (default: %(default)s)")
    size = "diameter or sides in metres, or a range of them (default: 0.15)"
    parser.add_argument("--size", type=interval(1e-3, 1), default=(0.15, 0.15), metavar="LOW[,HIGH]", help=size)
    along = "part of the mean demonstration's length, from 0 to 1, that they are spread along (default: 0.5)"
    parser.add_argument("--along", type=interval(0, 1), default=(0.5, 0.5), metavar="FROM[,TO]", help=along)
    spread = "largest distance of an obstacle from there, metres (default: %(default)s)"
    parser.add_argument("--spread", type=number("metres", 0, 1), default=WITHIN, help=spread)
    parser.add_argument("--only-blocked", action="store_true", help="measure no motions, only which are blocked")
    add_avoidance(parser, "cspace")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    tasks, task = chosen_task(options)
    out = ready_to_write(options.out, ".npz")
    robot = load_jaco()
    engine = Engine(tasks, FitStore(default_cache_folder()), robot)
    if options.space == "task":
        unions = [Union(obstacles) for obstacles in _obstacles(task, options)]
        scenarios = [scenario_around(union.parts, task, options) for union in unions]
        passed = [hand.passed(engine, scenario, union) for scenario, union in zip(scenarios, unions, strict=True)]
        write_npz(out, **_of_obstacles(unions), **hand.arrays(passed))
        print(_title(task, options) + ", hand")
        hand.print_places(passed, scenarios[0].avoidance.margin)
        return 0
    places, rows = [], []
    margin = 0.0
    for k, obstacles in enumerate(_obstacles(task, options)):
        scenario = scenario_around(obstacles, task, options)
        margin = scenario.avoidance.margin
        union = Union(obstacles)
        room = hand_room(robot, union, engine.nominal(scenario).learned.demonstrated.ends)
        places.append(_measured(engine, scenario, union, room, robot, only_blocked=options.only_blocked))
        rows.append((str(k), *_row(places[-1], margin)))
    write_npz(out, **_arrays(places, len(task.paths)))
    print(_title(task, options))
    header = (
        "place", "hand's room", "M.C.D. without", "M.C.D. arm", "clearance", "F.D.", "F.D./forced", "F.D./shift",
        "turn (without)", "goal missed", "outside limits", "",
    )  # fmt: skip
    print_table(header, rows)
    _summarise(places, margin)
    return 0


def _title(task: Task, options: argparse.Namespace) -> str:
    low, high = options.size
    size = f"{low:g} m" if low == high else f"{low:g} to {high:g} m"
    return f"{task.name}, {options.number} × {options.shape} of {size}; lengths in mm, the worst rollout of each place"


def hand_room(robot: Robot, obstacle: Union, places: Array) -> Array:
    """Distance (N,), metres, of the hand from an obstacle, turned to where it is largest, whatever the arm can do.

    The end effector, a point between the fingers, belongs to it.

    Args:
        robot: whose hand it is.
        obstacle: what is in the way.
        places: (N, 3) of the end effector, metres.
    """
    body = load_body_points()
    of_hand = body.joint == NUM_JOINTS - 1
    turns = Rotation.random(NUM_TURNS, np.random.default_rng(0)).as_matrix()
    points = (body.offset[of_hand] - robot.end_effector_offset) @ turns.transpose(0, 2, 1)  # (turns, points, 3)
    distance = obstacle.signed_distance(places[:, None, None] + points) - body.radius[of_hand]
    return np.minimum(distance.min(axis=2).max(axis=1), obstacle.signed_distance(places))


def shortest_shift(robot: Robot, obstacle: Union, q: Array, clearance: float) -> float:
    """Length, metres, of the shortest shift of the whole arm in one direction after which no posture is too near.

    It is about the least detour that there can be: a depth is that of a single point, which may leave a plate on its
    other side, or a hole in the hand. No shift leads below the table.

    Args:
        robot: the arm.
        obstacle: what is in the way.
        q: (N, 6) the undisturbed postures, rad.
        clearance: distance that its covering spheres are to have, metres.
    """
    body, directions = load_body_points().on_moving_links, golden_spiral(NUM_DIRECTIONS, 0.5)
    points = body.positions(robot, q)  # (N, P, 3)
    points = points[(obstacle.signed_distance(points) - body.radius).min(axis=1) < clearance]
    if not len(points):
        return 0.0
    length = np.zeros((NUM_DIRECTIONS, len(points)))
    shifted = np.broadcast_to(points, (NUM_DIRECTIONS, *points.shape))
    for _ in range(NUM_STEPS):
        lack = clearance - (obstacle.signed_distance(shifted) - body.radius).min(axis=2)
        if (lack < ROUNDING).all():
            break
        length += np.maximum(lack, 0)
        shifted = points + (length[..., None] * directions[:, None])[:, :, None]  # (directions, N', P, 3)
    lowest = (shifted[..., 2] - body.radius).min(axis=(1, 2))
    return float(length.max(axis=1)[lowest > -ROUNDING].min(initial=np.inf))


def _measured(
    engine: Engine, scenario: Scenario, union: Union, room: Array, robot: Robot, *, only_blocked: bool
) -> Place:
    if only_blocked:
        return Place(union, room, next(engine.frames(scenario)), {})
    frame, motions = engine.arm_motions(scenario)
    if not motions:
        return Place(union, room, frame, {})
    numbers, paths = engine.solved(scenario, FINE).nominal.numbers, frame.task.paths
    of_rollouts = {
        number: measure(motion, paths[number], frame.goal, union, robot)
        for number, motion in zip(numbers, motions, strict=True)
    }
    q = np.concatenate([motion.without[::STRIDE] for motion in motions])
    avoidance = scenario.arm_avoidance
    shift = np.nan if avoidance is None else shortest_shift(robot, union, q, avoidance.margin - OVERSHOOT)
    return Place(union, room, frame, of_rollouts, shift)


def _obstacles(task: Task, options: argparse.Namespace) -> list[tuple[Obstacle, ...]]:
    """The obstacles of the first place, and of each random one."""
    count, (low, high), (begin, end) = options.count, options.size, options.along
    first = SHAPES[0] if options.shape == "any" else options.shape
    middle = _shaped(first, _on(task, (begin + end) / 2), np.full(3, (low + high) / 2), UPRIGHT)
    drawn = []
    for nth in range(options.number):
        rng = np.random.default_rng(options.seed + SEEDS * nth)
        direction = rng.normal(size=(count, 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        offset = options.spread * rng.uniform(size=(count, 1)) ** (1 / 3) * direction
        along, sizes = rng.uniform(begin, end, size=count), rng.uniform(low, high, size=(count, 3))
        turns = np.roll(Rotation.from_rotvec(np.pi * rng.normal(size=(count, 3))).as_quat(), 1, axis=1)
        shapes = rng.choice(SHAPES, size=count) if options.shape == "any" else np.full(count, options.shape)
        centres = np.array([_on(task, s) for s in along]).reshape(-1, 3) + offset
        drawn.append([_shaped(*values) for values in zip(shapes, centres, sizes, turns, strict=True)])
    return [(middle,), *zip(*drawn, strict=True)]


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


def _row(place: Place, margin: float) -> tuple[str, ...]:
    room = f"{1e3 * place.hand_room.min():.0f}"
    said = "; ".join(map(str, (place.frame.blocked or place.frame.certificates.warnings)[:1]))
    if not place.rollouts:
        return (room, *[""] * 9, said)
    worst = max(place.rollouts.values(), key=lambda m: m.turn)
    return (
        room,
        f"{1e3 * place.largest(lambda m: m.depth_without):.0f}",
        f"{1e3 * place.largest(lambda m: m.arm.depth):.1f}",
        f"{1e3 * place.clearance():.1f}",
        f"{1e3 * place.largest(lambda m: m.frechet):.0f}",
        f"{place.detour(margin):.2f}",
        f"{place.beside_shift(margin):.2f}",
        f"{worst.turn:.0f}° ({worst.turn_without:.0f}°)",
        f"{1e3 * place.largest(lambda m: m.goal_miss):.3f}",
        f"{sum(m.num_outside for m in place.rollouts.values())}",
        said,
    )


def _arrays(places: Sequence[Place], num_rollouts: int) -> dict[str, Any]:
    """What is written."""

    def of_rollouts(value: Callable[[Measured], float]) -> Array:
        table = np.full((len(places), num_rollouts), np.nan)
        for row, place in zip(table, places, strict=True):
            for number_, measured in place.rollouts.items():
                row[number_] = value(measured)
        return table

    names = ("hand_clearance", "frechet", "depth_without", "turn", "turn_without", "num_outside", "goal_miss")
    return {
        **_of_obstacles([place.union for place in places]),
        "blocked": np.array([bool(place.frame.blocked) for place in places]),
        "left_out": np.array([num_rollouts - len(place.frame.rollouts) for place in places]),
        "no_way": np.array([place.no_way for place in places]),
        "shift": np.array([place.shift for place in places]),
        "hand_room": np.array([place.hand_room for place in places]),
        "arm_depth": of_rollouts(lambda m: m.arm.depth),
        "arm_clearance": of_rollouts(lambda m: m.arm.obstacle.distance),
        **{name: of_rollouts(lambda m, name=name: getattr(m, name)) for name in names},
    }


def _of_obstacles(unions: Sequence[Union]) -> dict[str, Any]:
    """What is written of the obstacles, repeating the last one where a place has fewer."""
    most = max(len(union.parts) for union in unions)

    def of_parts(value: Callable[[Obstacle], Any]) -> Array:
        return np.array([[value(union.parts[min(k, len(union.parts) - 1)]) for k in range(most)] for union in unions])

    return {
        "places": of_parts(lambda part: part.position),
        "sizes": of_parts(_sizes),
        "turns": of_parts(lambda part: part.wxyz),
        "shapes": of_parts(lambda part: type(part).__name__.lower()),
    }


def _summarise(places: Sequence[Place], margin: float) -> None:
    """Print the figures over all places."""
    free = [place for place in places if place.hand_room.min() > 0]
    open_ = [place for place in places if not place.frame.blocked]
    print(f"\n{len(free)} of {len(places)} places leave the hand free at the starts and at the goal")
    print(f"called blocked: {_share(sum(bool(p.frame.blocked) for p in free), free)} of these", end=", ")
    print(f"{_share(len(places) - len(open_), places)} of all")
    print(f"between free ends: {_share(sum(place.no_way for place in free), free)}", end=", ")
    some = sum(len(place.frame.rollouts) < len(place.hand_room) - 1 for place in open_)
    print(f"only from some of the starts: {_share(some, open_)}")
    if not any(place.rollouts for place in places):
        return
    clearance, detour = np.array([place.clearance() for place in open_]), [place.detour(margin) for place in open_]
    kept, touched = int((clearance >= margin - ALLOWANCE).sum()), int((clearance < 0).sum())
    sharp = sum(place.largest(lambda m: m.turn) > SHARP for place in open_)
    sharp_without = sum(place.largest(lambda m: m.turn_without) > SHARP for place in open_)
    depth, outside = max(p.largest(lambda m: m.arm.depth) for p in open_), (lambda m: m.num_outside)
    hand = min(-place.largest(lambda m: -m.hand_clearance) for place in open_)
    print("at the places that are not blocked:")
    print(f"M.C.D. of the whole arm {1e3 * depth:.1f} mm, clearance {1e3 * clearance.min():.1f} mm; ", end="")
    print(f"clearance of the end effector {1e3 * hand:.1f} mm")
    print(
        f"collisions {_share(touched, open_)}, at least {1e3 * (margin - ALLOWANCE):.0f} mm kept {_share(kept, open_)}"
    )
    shift = [place.beside_shift(margin) for place in open_]
    print(f"F.D. / shortest shift, median {np.median(shift):.2f}, 95 % {np.percentile(shift, 95):.2f}")
    print(f"F.D. / forced, median {np.median(detour):.2f}, 95 % {np.percentile(detour, 95):.2f}")
    print(f"turns sharper than {SHARP:.0f}° {_share(sharp, open_)}, without avoidance {_share(sharp_without, open_)}")
    print(f"F.D. mean {1e3 * np.mean([m.frechet for place in open_ for m in place.rollouts.values()]):.0f} mm")
    print(f"configurations outside the joint limits {sum(outside(m) for p in open_ for m in p.rollouts.values())}")
    print(f"goal missed by {1e3 * max(place.largest(lambda m: m.goal_miss) for place in open_):.3f} mm")


def _share(num: int, of: Sequence[Place]) -> str:
    return f"{num} of {len(of)} ({100 * num / max(len(of), 1):.1f} %)"
