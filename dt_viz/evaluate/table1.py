"""Compare all methods, around a sphere at seeded places of the paper's three tasks (Table 1 and figure 6).

    python -m dt_viz.evaluate table1 --out DIR

Places: a sphere of 15 cm is centred up to 5 cm from the mean demonstration, between a fifth and four fifths of its
length. Those places are kept where the hand of every undisturbed motion enters it, and where the arm's meshes are free
in its usual posture at every start and goal of the demonstrations: each method has a problem that can be solved.

``DIR/table1.json`` holds ``{method: {task: {column: {"mean", "worst", "paper"}}}}`` in metres and seconds, over all
places and rollouts; ``paper`` is the paper's value, null where there is none. ``DIR/METHOD_TASK.npz`` holds what
the cells are made from: ``obstacle_k`` (4,), centre and diameter of the sphere at place k; ``x_k_i``, ``t_k_i`` and
``q_k_i``, the path (N, 3), its times (N,) and the arm's postures (M, n) along it, of the rollout from start i;
``demo_i`` (T, 3), its demonstration, and ``demo_t_i``; one array (K, R) for each column, of motions from the starts;
``perturbed_k`` (P, 3) and ``ends_k`` (P, 3), perturbed starts and where their motions end. Columns:

``frechet``, ``dtw``
    discrete Fréchet distance of the hand's path to the demonstration, between 400 points each; and mean distance of
    points matched by dynamic time warping, between 200 points each, all evenly by arc length.
``arm_depth``, ``hand_depth``, ``clearance``
    maximum collision distance of the arm's meshes and of the end effector, and the meshes' smallest distance.
``goal_error``, ``turn``, ``jerk``
    distance of the end from the demonstrations' goal; sharpest turn over `TURN_ARC`, degrees; root mean square of
    the third derivative at 20 Hz, m/s³.
``reached``
    share of motions from perturbed starts that end within 1 cm of the goal; worst is that of a place.
``seconds``
    processor time to plan all motions of a place, without tracking them.

Hand paths are tracked by the arm, in its usual posture, for what is measured of the meshes.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import islice
from typing import Any

import numpy as np

from dt_viz.baselines.base import INSTALL, Method, NotFittedError, Plan, Planner, Problem
from dt_viz.baselines.registry import METHODS, problem_of
from dt_viz.errors import FormatError
from dt_viz.evaluate.around import TURN_ARC, in_ball
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.options import (
    FOLDER,
    Row,
    new_engine,
    report,
    whole_number,
    write_json,
    write_npz,
)
from dt_viz.evaluate.sweep import Swept, add_workers, sweep
from dt_viz.flows.fields import Array
from dt_viz.metrics import (
    dynamic_time_warping,
    maximum_collision_distance,
    resample_by_arc_length,
    rms_jerk,
    sharpest_turn,
)
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.pictures import figures
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.comparison import curves

OUT = FOLDER
PAPER_TASKS = ("push_box", "lift_box", "draw_s")


@dataclass(frozen=True)
class Table1Settings:
    """Where spheres and starts are drawn; lengths in metres."""

    along: tuple[float, float] = (0.2, 0.8)
    """Part of the mean demonstration that spheres are drawn along."""
    within: float = 0.05
    """Largest distance of a sphere from it."""
    perturbed_by: float = 0.05
    """Largest distance of a perturbed start from a demonstrated one."""
    max_drawn: int = 2000
    """Largest number of spheres drawn for a task."""
    reached: float = 0.01
    """Distance from the goal at which a motion counts as having reached it."""


SETTINGS = Table1Settings()
SMALLEST = ("clearance", "reached")
"""Columns whose worst value is the smallest."""
UNITS = {"turn": (1.0, "°"), "reached": (100.0, "%"), "seconds": (1.0, "s"), "jerk": (1.0, "m/s³")}
"""Factor and unit of each column in the printed table; all others are lengths, printed in millimetres."""
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


OF_MOTIONS = ("frechet", "dtw", "arm_depth", "hand_depth", "clearance", "goal_error", "turn", "jerk")
COLUMNS = (*OF_MOTIONS, "reached", "seconds")
"""Columns of the file, see there: the first are of single motions, the others of all those of a place."""


@dataclass(frozen=True)
class RandomPlace:
    """A sphere, and starts beside the demonstrated ones."""

    sphere: Sphere
    perturbed: Array
    """(P, 3), metres."""

    @property
    def obstacle(self) -> Union:
        """The sphere as an obstacle."""
        return Union((self.sphere,))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--methods", nargs="+", choices=tuple(METHODS), default=list(METHODS), help="(default: all)")
    parser.add_argument("--tasks", nargs="+", choices=PAPER_TASKS, default=list(PAPER_TASKS), help="(default: all)")
    parser.add_argument("--count", type=whole_number(1), default=10, help="places (default: %(default)s)")
    parser.add_argument("--perturbed", type=whole_number(0), default=200, help="starts (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the places (default: %(default)s)")
    add_workers(parser)


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if a method needs what is not installed, or was not trained."""
    methods = [METHODS[name] for name in options.methods]
    for method in methods:
        if method.missing:
            print(f"{method.title} needs {', '.join(method.missing)}: {INSTALL}; or leave it out", file=sys.stderr)
    if any(method.missing for method in methods):
        return 1
    try:
        with sweep(options, Fitted) as (fitted, swept):
            _measure(fitted, swept, methods, options)
    except NotFittedError as error:
        print(error, file=sys.stderr)
        return 1
    return 0


def _measure(fitted: Fitted, swept: Swept, methods: Sequence[Method], options: argparse.Namespace) -> None:
    """Measure all methods at all places; write and print the results.

    Raises:
        FormatError: the places are not found.
        NotFittedError: a method was not trained.
    """
    folder, draws = options.out, figures.can_draw()
    table: dict[str, dict[str, Any]] = {method.name: {} for method in methods}
    problems = {name: fitted.problem(name) for name in options.tasks}
    drawn_for = {name: drawn(problems[name], options.count, options.perturbed, options.seed) for name in problems}
    cases = [(method.name, name, place) for name in problems for method in methods for place in drawn_for[name]]
    found = swept(_measured, cases)
    for name, problem in problems.items():
        places, first_motions = drawn_for[name], {}
        for method in methods:
            arrays = gathered(problem, places, [*islice(found, len(places))])
            write_npz(folder / f"{method.name}_{name}.npz", **arrays)
            table[method.name][name] = cells(method.name, name, arrays)
            x = arrays["x_0_0"]
            path = x if len(x) > 1 else np.repeat(x, 2, axis=0)
            first_motions[method.title] = curves(path, problem.task.paths[0], places[0].obstacle)
            print(f"{method.title}, {problem.task.title}: {arrays['seconds'].sum():.0f} s of planning", flush=True)
            write_json(folder / "table1.json", table)
        print("\nmean (worst) [paper]; lengths in mm")
        report([_row(method.title, problem.task.title, table[method.name][name]) for method in methods])
        if draws:
            files = (folder / f"figure6_{name}.{suffix}" for suffix in ("svg", "png"))
            figures.save(figures.curves(problem.task.title, first_motions), *files)


class Fitted:
    """The problems, and the methods that are fitted to them, each made when it is first asked for."""

    def __init__(self) -> None:
        self._engine = new_engine(TASKS)
        self.problem: Callable[[str], Problem] = cache(self._problem)
        """Problem of a task."""
        self.planner: Callable[[str, str], Planner] = cache(self._planner)
        """Method by name, fitted to a task; raises NotFittedError, which names both, if it was not trained."""

    def _problem(self, task: str) -> Problem:
        return problem_of(self._engine.nominal(Scenario(task)).learned, self._engine.follower)

    def _planner(self, method: str, task: str) -> Planner:
        problem = self.problem(task)
        try:
            return METHODS[method].fit(problem)
        except NotFittedError as error:
            raise NotFittedError(f"{METHODS[method].title}, {problem.task.title}: {error}") from error


def drawn(problem: Problem, count: int, num_perturbed: int, seed: int) -> list[RandomPlace]:
    """Draw the places of a task, as the module says, and perturbed starts, divided among the places.

    Raises:
        FormatError: the places are not found.
    """
    task, model = problem.task, problem.robot.collision
    rng, mean, undisturbed = np.random.default_rng(seed), task.mean_path, problem.learned.demonstrated.paths
    at_ends = np.concatenate([path[[0, -1]] for path in problem.postures])
    places: list[RandomPlace] = []
    for _ in range(SETTINGS.max_drawn):
        if len(places) == count:
            return places
        centre = mean[round(rng.uniform(*SETTINGS.along) * (len(mean) - 1))] + in_ball(rng, SETTINGS.within, 1)[0]
        sphere = Sphere(as_point(centre), 0.15)
        if any(sphere.signed_distance(path).min() >= 0 for path in undisturbed):
            continue
        if model.obstacle_distance(at_ends, sphere)[0].min() <= 0:
            continue
        share = (len(places) + 1) * num_perturbed // count - len(places) * num_perturbed // count
        beside = np.random.default_rng([seed, len(places)])  # places do not depend on how many starts there are
        places.append(RandomPlace(sphere, _perturbed(problem, sphere, share, beside)))
    found = f"{len(places)} of {task.title!r} among {SETTINGS.max_drawn} spheres"
    raise FormatError("--count", found, "places at which each motion collides and the ends are free, fewer of them")


def _perturbed(problem: Problem, sphere: Sphere, num: int, rng: np.random.Generator) -> Array:
    """Starts (num, 3), beside the demonstrated ones: reached by the arm, which is free there."""
    starts, robot = problem.task.starts, problem.robot
    found: list[Array] = []
    for _ in range(SETTINGS.max_drawn):
        if len(found) == num:
            break
        nearest = int(rng.integers(len(starts)))
        start = starts[nearest] + in_ball(rng, SETTINGS.perturbed_by, 1)[0]
        posture = track(robot, start[None], problem.postures[nearest][0])
        if posture.error[0] < 1e-3 and robot.collision.obstacle_distance(posture.q, sphere)[0].min() > 0:
            found.append(start)
    return np.array(found).reshape(-1, 3)


@dataclass(frozen=True)
class PlaceFigures:
    """Motions of a method at a place, and what is measured of them."""

    motions: Sequence[tuple[Array, Array, Array]]
    """Path (N, 3), times (N,) and postures (M, n) from each start."""
    of_motions: Sequence[Sequence[float]]
    """`OF_MOTIONS` of each."""
    ends: Array
    """(P, 3) where motions from the perturbed starts end, metres."""
    seconds: float


def _measured(fitted: Fitted, case: tuple[str, str, RandomPlace]) -> PlaceFigures:
    """Measure a method, by name, at a place of a task."""
    method, task, place = case
    return measured(fitted.planner(method, task), fitted.problem(task), place)


def measured(planner: Planner, problem: Problem, place: RandomPlace) -> PlaceFigures:
    """Plan and measure the motions of a method at a place."""
    began = time.thread_time()
    plan = planner(place.obstacle, problem.task.starts)
    seconds = time.thread_time() - began
    motions = [*zip(plan.paths, plan.times, joints_along(problem, plan), strict=True)]
    compared = zip(motions, problem.task.paths, strict=True)
    rows = [measure(problem, *motion, demonstration, place.obstacle) for motion, demonstration in compared]
    return PlaceFigures(motions, rows, _ends(planner, place), seconds)


def gathered(problem: Problem, places: Sequence[RandomPlace], found: Sequence[PlaceFigures]) -> dict[str, Array]:
    """The arrays of a method's file."""
    task, goal = problem.task, problem.learned.goal
    arrays: dict[str, Array] = {f"demo_{i}": path for i, path in enumerate(task.paths)}
    arrays |= {f"demo_t_{i}": d.times for i, d in enumerate(task.demonstrations)} | {"goal": goal}
    reached = []
    for k, (place, at_place) in enumerate(zip(places, found, strict=True)):
        for i, motion in enumerate(at_place.motions):
            arrays |= {f"{name}_{k}_{i}": values for name, values in zip("xtq", motion, strict=True)}
        arrays |= {f"obstacle_{k}": np.array([*place.sphere.position, place.sphere.diameter])}
        arrays |= {f"perturbed_{k}": place.perturbed, f"ends_{k}": at_place.ends}
        near = np.linalg.norm(at_place.ends - goal, axis=1) <= SETTINGS.reached
        reached.append(near.mean() if len(near) else np.nan)
    of_motions = np.array([at_place.of_motions for at_place in found]).transpose(2, 0, 1)
    seconds = np.array([at_place.seconds for at_place in found])
    return arrays | dict(zip(COLUMNS, (*of_motions, np.array(reached), seconds), strict=True))


def measure(problem: Problem, x: Array, t: Array, q: Array, demonstration: Array, obstacle: Union) -> list[float]:
    """Measure one motion: the columns `OF_MOTIONS`.

    Args:
        problem: the task and the arm.
        x: (N, 3) path of the end effector, metres.
        t: (N,) its times, seconds.
        q: (M, n) postures of the arm along it, rad.
        demonstration: (T, 3), metres.
        obstacle: what was to be avoided.
    """
    clearance = problem.robot.collision.nearest_to_obstacle(q, obstacle).distance
    path = x if len(x) > 1 else np.repeat(x, 2, axis=0)
    warped, matched = [resample_by_arc_length(p, 200) for p in (path, demonstration)]
    return [
        float(frechet([path], [demonstration])[0]),
        dynamic_time_warping(warped, matched) / len(matched),
        max(0.0, -clearance),
        maximum_collision_distance(path, obstacle.signed_distance) + 0.0,  # never -0
        clearance,
        float(np.linalg.norm(x[-1] - problem.learned.goal)),
        sharpest_turn(x, TURN_ARC),
        rms_jerk(t, x, 0.05),  # the paper's 20 Hz
    ]


def joints_along(problem: Problem, plan: Plan) -> tuple[Array, ...]:
    """The arm's postures (N_i, n), rad, along a plan: its own, or those that track its paths, as the demonstrations."""
    if plan.joints is not None:
        return plan.joints
    return tuple(
        track(problem.robot, path, along[0]).q for path, along in zip(plan.paths, problem.postures, strict=True)
    )


def _ends(planner: Planner, place: RandomPlace) -> Array:
    """Where motions from the perturbed starts of a place end, (P, 3), metres."""
    if not len(place.perturbed):
        return place.perturbed
    try:
        return np.stack([path[-1] for path in planner(place.obstacle, place.perturbed).paths])
    except UnreachableError:
        return np.full_like(place.perturbed, np.inf)


def cells(method: str, task: str, arrays: Mapping[str, Array]) -> dict[str, dict[str, float | None]]:
    """The cells of a method's file, by column; None is unknown."""
    frechet, depth = PAPER[method][PAPER_TASKS.index(task)] if method in PAPER else (None, None)
    paper, found = {"frechet": frechet, "arm_depth": depth}, {}
    for column in COLUMNS:
        known = arrays[column] if np.isfinite(arrays[column]).all() else None
        worst = np.min if column in SMALLEST else np.max
        of_ours = {"mean": np.mean, "worst": worst}
        found[column] = {name: None if known is None else float(of(known)) for name, of in of_ours.items()}
        found[column]["paper"] = paper.get(column)
    return found


def _row(title: str, task: str, cells: Mapping[str, Mapping[str, float | None]]) -> Row:
    """Row of a method and a task, by their titles, in the printed table."""
    names = {column: f"{column} {UNITS[column][1]}" if column in UNITS else column for column in COLUMNS}
    return {"method": title, "task": task, **{names[column]: _cell(column, cells[column]) for column in COLUMNS}}


def _cell(column: str, cell: Mapping[str, float | None]) -> str:
    factor, _ = UNITS.get(column, (1e3, ""))
    digits = 3 if column == "seconds" else 0
    mean, worst, paper = ("–" if (v := cell[k]) is None else f"{factor * v:.{digits}f}" for k in cell)
    return f"{mean} ({worst})" + (f" [{paper}]" if cell["paper"] is not None else "")
