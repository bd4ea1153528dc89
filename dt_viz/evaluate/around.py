"""Put obstacles in the way of a task's motions, and measure the end effector and the whole arm around them.

``--obstacle`` is the centre of one. Without it there are K places: the middle of the part of the mean demonstration
that obstacles are spread along, and random ones. The arm's collision meshes are measured, also between the samples; the
spheres that the avoidance computes with are not used. With ``--space task`` the path of the end effector gives way, and
the arm follows it.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.avoidance.avoidance import SPACES, Avoidance
from dt_viz.evaluate import options as shared
from dt_viz.evaluate.held_out import frechet
from dt_viz.flows.fields import Array
from dt_viz.flows.rollouts import refined
from dt_viz.metrics import interpolate, maximum_collision_distance, sharpest_turn
from dt_viz.motion.stack import FINE, Solution
from dt_viz.numerics import unit
from dt_viz.obstacles.occupancy import GENERATORS
from dt_viz.obstacles.shapes import UPRIGHT, Primitive, as_point, as_quaternion, primitives
from dt_viz.obstacles.union import Union
from dt_viz.robot.inverse_kinematics import UnreachableError
from dt_viz.scenario.stack import avoiding
from dt_viz.scenario.tasks import Task
from dt_viz.session.engine import ArmMotion, Engine
from dt_viz.warning import Kind, MotionWarning

TURN_ARC = 0.015  # m of the path over which a turn is measured
ALLOWANCE = 1e-3  # shortfall of a clearance, metres, with which the margin counts as kept
CLEARANCES = ("hand", "arm", "hand_without", "arm_without")
FIGURES = ("hand", "arm", "turn", "hand_without", "arm_without", "turn_without")
FIGURES += ("frechet", "detour", "goal_miss", "num_outside")  # of a rollout


@dataclass(frozen=True)
class Place:
    """Motions around the obstacles at one place, and their measurements."""

    ends: Array  # (R + 1,) clearance of the undisturbed starts and goal of the end effector, metres
    figures: Array  # (R, F), each of `FIGURES`; NaN for starts without a motion
    motions: Mapping[int, ArmMotion]  # by the numbers of their starts; empty where the arm is blocked
    blocked: tuple[MotionWarning, ...] = ()  # reasons for which there is no motion
    warnings: tuple[MotionWarning, ...] = ()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    shared.add_task(parser)
    where, default = parser.add_mutually_exclusive_group(), "(default: %(default)s)"
    centre = shared.numbers("three numbers X,Y,Z in metres, such as 0,-0.5,0.4", -1e9, 1e9, 3)
    where.add_argument("--obstacle", type=centre, metavar="X,Y,Z", help="centre of the obstacle, metres")
    where.add_argument("--count", type=shared.whole_number(0), default=20, help=f"random places {default}")
    parser.add_argument("--seed", type=shared.whole_number(0), default=0, help=f"of the places {default}")
    parser.add_argument("--shape", choices=(*primitives(), "any"), default="sphere", help=default)
    parser.add_argument("--number", type=int, choices=(1, 2, 3), default=1, help=f"obstacles {default}")
    size, sizes = "diameter or sides in metres, or a range of them (default: 0.15)", shared.interval(1e-3, 1)
    parser.add_argument("--size", "--diameter", type=sizes, default=(0.15, 0.15), metavar="LOW[,HIGH]", help=size)
    along = "part of the mean demonstration's length, from 0 to 1, that they are spread along (default: 0.5)"
    parser.add_argument("--along", type=shared.interval(0, 1), default=(0.5, 0.5), metavar="FROM[,TO]", help=along)
    spread = f"largest distance of an obstacle from there, metres {default}"
    parser.add_argument("--spread", type=shared.numbers("metres, 0 to 1", 0, 1), default=0.05, help=spread)
    space = f"what avoids: the end effector (task) or the whole arm (cspace) {default}"
    parser.add_argument("--space", choices=SPACES, default="cspace", help=space)
    generator = f"probability is the paper's {default}"
    parser.add_argument("--generator", choices=GENERATORS, default=GENERATORS[0], help=generator)
    parser.add_argument("--no-avoidance", action="store_true", help="leave the obstacle's transforms out")
    shared.add_output(parser, ".npz")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if the one obstacle that was asked for leaves no motion."""
    task = shared.chosen_task(options)
    name, on, around = task.name, not options.no_avoidance, _drawn(task, options)
    engine, arrays = shared.Made(lambda: shared.engine_of(task)), _as_arrays(around)
    cases = [Avoidance(tuple(each), space=options.space, generator=options.generator) for each in around]
    try:
        places = [*shared.computed(options, lambda case: measured(engine(), engine().task(name), case, on=on), cases)]
    except UnreachableError as error:
        print(f"no motion: the arm cannot reach the starts: {error}", file=sys.stderr)
        return 1
    one, *_ = places
    if options.obstacle and one.blocked:
        for reason in one.blocked:
            print(f"no motion: {reason}", file=sys.stderr)
        return 1
    figures, default = np.stack([place.figures for place in places]), cases[0]
    reasons = [[reason.kind for reason in place.blocked] for place in places]
    arrays |= {"ends": np.stack([place.ends for place in places]), "blocked": np.array([*map(bool, reasons)])}
    arrays |= {"no_way": np.array([Kind.NO_WAY in kinds for kinds in reasons])}
    arrays |= {figure: figures[..., f] for f, figure in enumerate(FIGURES)}
    by_name = {f"place {k}": of_place for k, of_place in enumerate(figures)}
    if options.obstacle:
        by_name = {f"start {i}": one.figures[[i]] for i in one.motions}
        for i, motion in one.motions.items():
            x = engine().follower.robot.end_effector(motion.q)
            arrays |= {f"q_{i}": motion.q, f"times_{i}": motion.times, f"x_{i}": x, f"demo_{i}": task.paths[i]}
    shared.write_npz(options.out, arrays)
    avoids = {"task": "the end effector", "cspace": "the whole arm"}[options.space] if on else "nothing"
    print(f"{name}, {avoids} avoids; worst rollout of each row, clearances negative inside")
    by_name["all"] = np.concatenate(figures)
    shared.report([_row(label, of_row, default) for label, of_row in by_name.items()])
    for place in places:
        for warning in (*place.blocked, *place.warnings)[: None if options.obstacle else 1]:
            print(f"warning: {warning}")
    shared.report([{"figure": label, "value": value} for label, value in _shares(arrays, figures, default).items()])
    return 0


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
        return Place(ends, figures, {}, frame.blocked)
    solved, robot, rounding = engine.solved(scenario, FINE), engine.follower.robot, 1e-9
    if scenario.arm_avoidance is None:
        paths, without = _finely(solved.stack), solved.nominal.paths
    else:
        paths = {i: robot.end_effector(motion.q) for i, motion in motions.items()}
        without = {i: robot.end_effector(motion.without) for i, motion in motions.items()}

    def alone(x: Array, q: Array) -> tuple[float, float, float]:
        nearest = robot.collision.nearest_to_obstacle(q, obstacle).distance
        return _clearance(x, obstacle), nearest, sharpest_turn(x, TURN_ARC)

    for i, motion in motions.items():
        outside = (motion.q < robot.lower - rounding) | (motion.q > robot.upper + rounding)
        apart = [frechet([paths[i]], [other])[0] for other in (task.paths[i], without[i])]
        missed = np.linalg.norm(paths[i][-1] - frame.goal)
        both = (*alone(paths[i], motion.q), *alone(without[i], motion.without))
        figures[i] = (*both, *apart, missed, outside.any(axis=1).sum())
    return Place(ends, figures, motions, (), frame.certificates.warnings)


def _clearance(path: Array, obstacle: Union) -> float:
    """Smallest clearance of a path (T, 3), metres, also between its points where it is inside."""
    depth = maximum_collision_distance(path, obstacle.signed_distance)
    return -depth if depth > 0 else float(obstacle.signed_distance(path).min())


def _finely(solution: Solution) -> tuple[Array, ...]:
    """Rollouts (T, 3) of a stack, sampled every millimetre."""
    bundle = replace(solution.bundle, levels=solution.bundle.positions[:, None])
    return refined(bundle, lambda i, u: solution.positions_at(i, u)[:, None], 1e-3).paths


def _drawn(task: Task, options: argparse.Namespace) -> list[list[Primitive]]:
    """Draw the obstacles: of the first place one, and those of each random place."""
    count, number = (0, 1) if options.obstacle else (options.count, options.number)
    (low, high), (begin, end), path = options.size, options.along, task.mean_path
    on_path = lambda part: interpolate(part * (len(path) - 1), np.arange(len(path)), path)  # noqa: E731
    middle = options.obstacle or on_path(np.array([begin + end]) / 2)[0]
    kind = "sphere" if options.shape == "any" else options.shape
    places = [[_obstacle(kind, np.array(middle), np.full(3, (low + high) / 2), np.array(UPRIGHT))]]
    places += [[] for _ in range(count)]
    for nth in range(number if count else 0):
        rng = np.random.default_rng(options.seed + 1_000_003 * nth)  # not the seed of another place
        offset = in_ball(rng, options.spread, count)
        centres, sizes = on_path(rng.uniform(begin, end, size=count)) + offset, rng.uniform(low, high, size=(count, 3))
        turns = np.roll(Rotation.from_rotvec(np.pi * rng.normal(size=(count, 3))).as_quat(), 1, axis=1)
        kinds = rng.choice([*primitives()], size=count) if options.shape == "any" else [kind] * count
        for k, place in enumerate(places[1:]):
            place.append(_obstacle(str(kinds[k]), centres[k], sizes[k], turns[k]))
    return places


def _obstacle(kind: str, centre: Array, sizes: Array, wxyz: Array) -> Primitive:
    return primitives()[kind].of_extents(as_point(sizes), as_point(centre), as_quaternion(wxyz))


def _as_arrays(places: Sequence[Sequence[Primitive]]) -> dict[str, Array]:
    """Arrays of the file, of the obstacles of each place (K + 1, N); that of the first is repeated."""
    drawn = [len(places[-1]) * [*places[0]], *places[1:]]
    arrays = {"places": "position", "sizes": "extents", "turns": "wxyz"}
    found = {name: np.array([[getattr(one, field) for one in of] for of in drawn]) for name, field in arrays.items()}
    return found | {"shapes": np.array([[type(one).__name__.lower() for one in of_place] for of_place in drawn])}


def in_ball(rng: np.random.Generator, radius: float, num: int) -> Array:
    """Draw places (num, 3) evenly from a ball around 0, metres."""
    direction = unit(rng.normal(size=(num, 3)))
    return radius * rng.uniform(size=(num, 1)) ** (1 / 3) * direction


def worst(figures: Array, name: str) -> Array:
    """Return the largest value (*B,) of a figure over rollouts (*B, R, F), of a clearance the smallest; NaN without."""
    return (np.fmin if name in CLEARANCES else np.fmax).reduce(figures[..., FIGURES.index(name)], axis=-1)


def _clearances(figures: Array, avoidance: Avoidance) -> tuple[Array, Array, Array]:
    """Smallest clearances (*B,), metres, of the end effector or arm that avoids, with and without avoidance, and ratio.

    That of the largest detour to what the deepest motion lacks of the margin without avoidance; NaN without any.
    """
    avoids = "hand" if avoidance.space == "task" else "arm"
    without = worst(figures, f"{avoids}_without")
    forced = np.where(without < avoidance.margin, avoidance.margin - without, np.nan)
    return worst(figures, avoids), without, worst(figures, "detour") / forced


def _row(name: str, figures: Array, avoidance: Avoidance) -> shared.Row:
    """Row of the table, of rollouts (R, F)."""
    _, without, ratio = _clearances(figures, avoidance)
    largest = {figure: float(worst(figures, figure)) for figure in FIGURES}
    return {
        "": name,
        "hand mm": 1e3 * largest["hand"],
        "arm mm": 1e3 * largest["arm"],
        "without mm": 1e3 * float(without),
        "F.D. mm": 1e3 * largest["frechet"],
        "detour/forced": float(ratio),
        "turn °": largest["turn"],
        "without °": largest["turn_without"],
        "goal missed mm": 1e3 * largest["goal_miss"],
        "outside limits": int(np.nansum(figures[:, FIGURES.index("num_outside")])),
    }


def _shares(arrays: Mapping[str, Array], figures: Array, avoidance: Avoidance) -> dict[str, str]:
    """Shares of the places, and medians over them."""
    has, free = np.isfinite(arrays["frechet"]), arrays["ends"] >= 0
    moved = has.any(axis=1) & (free[:, :-1] | ~has).all(axis=1) & free[:, -1]
    found = {
        "places that leave the end effector's starts and goal free": free.all(axis=1),
        "blocked": arrays["blocked"],
        "blocked between free ends": arrays["no_way"],
    }
    clearance, _, ratio = _clearances(figures[moved], avoidance)
    kept, others = avoidance.margin - ALLOWANCE, {}
    if moved.any():
        found |= {
            "from some of the starts only": ~has[moved].all(axis=1),
            "collisions": clearance < 0,
            f"at least {1e3 * kept:.0f} mm kept": clearance >= kept,
            "turns sharper than 90°": worst(figures[moved], "turn") > 90,
            "the same without avoidance": worst(figures[moved], "turn_without") > 90,
        }
        if len(ratio := ratio[ratio > 0]):
            label = "detour/forced where a motion is in the way, median, 95 %"
            others[label] = "{:.2f}, {:.2f}".format(*np.percentile(ratio, [50, 95]))
        others["F.D. mean mm"] = f"{1e3 * np.nanmean(arrays['frechet'][moved]):.1f}"
    return {label: f"{of.sum()} of {len(of)} ({100 * of.mean():.1f} %)" for label, of in found.items()} | others
