"""Compare all methods, around a sphere at seeded places of the paper's three tasks (Table 1 and figure 6).

Places: a sphere of 15 cm is centred up to 5 cm from the mean demonstration, between a fifth and four fifths of its
length. Those places are kept where the hand of every undisturbed motion enters it, and where the arm's meshes are free
in its usual posture at every start and goal of the demonstrations: each method has a problem that can be solved. Hand
paths are tracked by the arm, in its usual posture, for the figures of the meshes.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Mapping, Sequence
from functools import cache, partial
from itertools import islice
from typing import Any, NamedTuple

import numpy as np

from dt_viz import metrics
from dt_viz.baselines.base import INSTALL, NotFittedError, Plan, Planner, Problem
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.errors import FormatError
from dt_viz.evaluate import options as shared
from dt_viz.evaluate.around import TURN_ARC, in_ball
from dt_viz.evaluate.held_out import frechet
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.pictures import figures
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.comparison import curves

PAPER_TASKS = ("push_box", "lift_box", "draw_s")
ALONG = (0.2, 0.8)  # part of the mean demonstration that spheres are drawn along
WITHIN = 0.05  # m, largest distance of a sphere from it
PERTURBED_BY = 0.05  # m, largest distance of a perturbed start from a demonstrated one
MAX_DRAWN = 2000  # number of spheres drawn for a task, at most
REACHED = 0.01  # m from the goal within which a motion has reached it
COLUMNS: Mapping[str, tuple[float, str]] = {
    **{name: (1e3, name) for name in ("frechet", "dtw", "arm_depth", "hand_depth", "clearance", "goal_error")},
    "turn": (1.0, "turn °"),
    "jerk": (1.0, "jerk m/s³"),
    "reached": (100.0, "reached %"),
    "seconds": (1.0, "seconds s"),
}
"""Columns of the file, and their factors and headers in the printed table; the last two are of all motions of a place,
the others of single ones."""
SMALLEST = ("clearance", "reached")  # columns whose worst value is the smallest
PAPER: Mapping[str, Sequence[tuple[float | None, float | None]]] = {
    "ours": ((0.124, 0.0), (0.127, 0.0), (0.067, 0.002)),
    "ours-no-avoidance": ((0.070, 0.012), (0.112, 0.012), (0.011, 0.018)),
    "eflow": ((0.068, 0.012), (0.093, 0.152), (0.021, 0.007)),
    "eflow-repulsive": ((0.168, 0.0), (0.252, 0.001), (0.195, 0.003)),
    "mpnet": ((0.371, 0.038), (0.133, 0.022), (None, None)),
    "mpnet-rrt": ((0.371, 0.0), (0.478, 0.0), (None, None)),
    "linear": ((0.242, 0.147), (0.205, 0.031), (None, None)),
}
"""The paper's Table 1: Fréchet and maximum collision distance, metres, by method, for each of `PAPER_TASKS`; it has no
drawing of the planners."""


class RandomPlace(NamedTuple):
    """A sphere, and starts beside the demonstrated ones."""

    sphere: Sphere
    perturbed: Array  # (P, 3), metres


class Fitted:
    """The problems, and the methods that are fitted to them, each made when it is first asked for."""

    def __init__(self) -> None:
        engine = shared.new_engine(TASKS)
        self.problem = cache(lambda task: problem_of(engine.nominal(Scenario(task)).learned, engine.follower))
        self.planner = cache(lambda method, task: METHODS[method].fit(self.problem(task)))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    number, default = shared.whole_number, "(default: %(default)s)"
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=list(METHODS), help="(default: all)")
    parser.add_argument("--tasks", nargs="+", choices=PAPER_TASKS, default=list(PAPER_TASKS), help="(default: all)")
    parser.add_argument("--count", type=number(1), default=10, help=f"places {default}")
    parser.add_argument("--perturbed", type=number(0), default=200, help=f"starts {default}")
    parser.add_argument("--seed", type=number(0), default=0, help=f"of the places {default}")
    shared.add_output(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    methods, folder, draws = [METHODS[name] for name in options.methods], options.out, figures.can_draw()
    for method in methods:
        if method.missing:
            found = f"{method.title}, which needs {', '.join(method.missing)}"
            raise FormatError("--methods", found, f"{INSTALL}, or the others")
    fitted = shared.Made(Fitted)
    problems = {name: fitted().problem(name) for name in options.tasks}
    places = {name: drawn(problems[name], options.count, options.perturbed, options.seed) for name in problems}
    cases = [(method.name, name, *at) for name in problems for method in methods for at in enumerate(places[name])]
    found = shared.computed(options, partial(_measured, fitted), cases)
    table: dict[str, dict[str, Any]] = {method.name: {} for method in methods}
    for name, problem in problems.items():
        title, first_motions, rows = problem.task.title, {}, []
        for method in methods:
            arrays = gathered(problem, [*islice(found, options.count)])
            shared.write_npz(folder / f"{method.name}_{name}.npz", arrays)
            table[method.name][name] = cells(method.name, name, arrays)
            rows.append(_row(method.title, title, table[method.name][name]))
            first_path, obstacle = _whole(arrays["x_0_0"]), Union((places[name][0].sphere,))
            first_motions[method.title] = curves(first_path, problem.task.paths[0], obstacle)
            print(f"{method.title}, {title}: {arrays['seconds'].sum():.0f} s of planning", flush=True)
        print("\nmean (worst) [paper]; lengths in mm")
        shared.report(rows)
        if draws:
            files = (folder / f"figure6_{name}.{suffix}" for suffix in ("svg", "png"))
            figures.save(figures.curves(title, first_motions), *files)
    shared.write_json(folder / "table1.json", table)
    return 0


def drawn(problem: Problem, count: int, num_perturbed: int, seed: int) -> list[RandomPlace]:
    """Draw the places of a task, as the module says, and perturbed starts, divided among the places.

    Raises:
        FormatError: the places are not found.
    """
    task, model = problem.task, problem.robot.collision
    rng, mean, undisturbed = np.random.default_rng(seed), task.mean_path, problem.learned.demonstrated.paths
    at_ends = np.concatenate([path[[0, -1]] for path in problem.postures])
    places: list[RandomPlace] = []
    for _ in range(MAX_DRAWN):
        if len(places) == count:
            return places
        centre = mean[round(rng.uniform(*ALONG) * (len(mean) - 1))] + in_ball(rng, WITHIN, 1)[0]
        sphere = Sphere(as_point(centre), 0.15)
        if any(sphere.signed_distance(path).min() >= 0 for path in undisturbed):
            continue
        if model.obstacle_distance(at_ends, sphere)[0].min() <= 0:
            continue
        share = (len(places) + 1) * num_perturbed // count - len(places) * num_perturbed // count
        beside = np.random.default_rng([seed, len(places)])  # places do not depend on how many starts there are
        places.append(RandomPlace(sphere, _perturbed(problem, sphere, share, beside)))
    found = f"{len(places)} of {task.title!r} among {MAX_DRAWN} spheres"
    raise FormatError("--count", found, "places at which each motion collides and the ends are free, fewer of them")


def _perturbed(problem: Problem, sphere: Sphere, num: int, rng: np.random.Generator) -> Array:
    """Starts (num, 3), beside the demonstrated ones: reached by the arm, which is free there."""
    starts, robot = problem.task.starts, problem.robot
    found: list[Array] = []
    for _ in range(MAX_DRAWN):
        if len(found) == num:
            break
        nearest = int(rng.integers(len(starts)))
        start = starts[nearest] + in_ball(rng, PERTURBED_BY, 1)[0]
        posture = track(robot, start[None], problem.postures[nearest][0])
        if posture.error[0] < 1e-3 and robot.collision.obstacle_distance(posture.q, sphere)[0].min() > 0:
            found.append(start)
    return np.array(found).reshape(-1, 3)


def _measured(fitted: shared.Made[Fitted], case: tuple[str, str, int, RandomPlace]) -> dict[str, Any]:
    """Measure a method, by name, at a place of a task."""
    method, task, k, place = case
    problem = fitted().problem(task)
    try:
        return measured(fitted().planner(method, task), problem, k, place)
    except NotFittedError as error:
        found = f"{METHODS[method].title}, {problem.task.title}: {error}"
        raise FormatError("--methods", found, "methods that are fitted to the tasks") from error


def measured(planner: Planner, problem: Problem, k: int, place: RandomPlace) -> dict[str, Any]:
    """Plan and measure the motions of a method at the place k; returns its arrays of the file, and its `COLUMNS`."""
    obstacle, ends = Union((place.sphere,)), place.perturbed
    began = time.thread_time()
    plan = planner(obstacle, problem.task.starts)
    seconds = time.thread_time() - began
    motions = [*zip(plan.paths, plan.times, joints_along(problem, plan), strict=True)]
    compared = zip(motions, problem.task.paths, strict=True)
    rows = [measure(problem, *motion, demonstration, obstacle) for motion, demonstration in compared]
    if len(ends):
        try:
            ends = np.stack([path[-1] for path in planner(obstacle, ends).paths])
        except UnreachableError:
            ends = np.full_like(ends, np.inf)
    near = np.linalg.norm(ends - problem.learned.goal, axis=1) <= REACHED
    columns = [*np.transpose(rows), near.mean() if len(near) else np.nan, seconds]
    arrays = {f"{name}_{k}_{i}": values for i, of in enumerate(motions) for name, values in zip("xtq", of, strict=True)}
    arrays |= {f"obstacle_{k}": np.array([*place.sphere.position, place.sphere.diameter])}
    return arrays | {f"perturbed_{k}": place.perturbed, f"ends_{k}": ends} | dict(zip(COLUMNS, columns, strict=True))


def measure(problem: Problem, x: Array, t: Array, q: Array, demonstration: Array, obstacle: Union) -> list[float]:
    """Measure one motion, the columns of single motions: the path x (N, 3), metres, at times t (N,), seconds.

    The arm's postures along it are q (M, n), rad; the demonstration is (T, 3), metres.
    """
    clearance, path = problem.robot.collision.nearest_to_obstacle(q, obstacle).distance, _whole(x)
    warped, matched = [metrics.resample_by_arc_length(p, 200) for p in (path, demonstration)]
    return [
        float(frechet([path], [demonstration])[0]),
        metrics.dynamic_time_warping(warped, matched) / len(matched),
        max(0.0, -clearance),
        metrics.maximum_collision_distance(path, obstacle.signed_distance) + 0.0,  # never -0
        clearance,
        float(np.linalg.norm(x[-1] - problem.learned.goal)),
        metrics.sharpest_turn(x, TURN_ARC),
        metrics.rms_jerk(t, x, 0.05),  # the paper's 20 Hz
    ]


def _whole(x: Array) -> Array:
    """A path of at least two points; that of a start without a way has one."""
    return x if len(x) > 1 else np.repeat(x, 2, axis=0)


def joints_along(problem: Problem, plan: Plan) -> tuple[Array, ...]:
    """The arm's postures (N_i, n), rad, along a plan: its own, or those that track its paths, as the demonstrations."""
    if plan.joints is not None:
        return plan.joints
    starts = (postures[0] for postures in problem.postures)
    return tuple(track(problem.robot, path, start).q for path, start in zip(plan.paths, starts, strict=True))


def gathered(problem: Problem, found: Sequence[Mapping[str, Any]]) -> dict[str, Array]:
    """Gather the arrays of a method's file, of what was measured at each place."""
    arrays: dict[str, Array] = {f"demo_{i}": path for i, path in enumerate(problem.task.paths)}
    arrays |= {f"demo_t_{i}": d.times for i, d in enumerate(problem.task.demonstrations)}
    for at_place in found:
        arrays |= at_place
    columns = {name: np.array([at_place[name] for at_place in found]) for name in COLUMNS}
    return arrays | columns | {"goal": problem.learned.goal}


def cells(method: str, task: str, arrays: Mapping[str, Array]) -> dict[str, dict[str, float | None]]:
    """Return the cells of a method's file, by column; None is unknown."""
    of_paper = PAPER[method][PAPER_TASKS.index(task)] if method in PAPER else (None, None)
    paper: Mapping[str, float | None] = dict(zip(("frechet", "arm_depth"), of_paper, strict=True))
    found = {}
    for column in COLUMNS:
        of_ours = {"mean": np.mean, "worst": np.min if column in SMALLEST else np.max}
        known = np.isfinite(arrays[column]).all()
        found[column] = {name: float(of(arrays[column])) if known else None for name, of in of_ours.items()}
        found[column]["paper"] = paper.get(column)
    return found


def _row(title: str, task: str, cells: Mapping[str, Mapping[str, float | None]]) -> shared.Row:
    """Row of a method and a task, by their titles, in the printed table."""
    row = {"method": title, "task": task}
    for column, (factor, header) in COLUMNS.items():
        digits = 3 if column == "seconds" else 0
        mean, worst, paper = ("–" if v is None else f"{factor * v:.{digits}f}" for v in cells[column].values())
        row[header] = f"{mean} ({worst})" + (f" [{paper}]" if cells[column]["paper"] is not None else "")
    return row
