"""Drag a sphere straight through a motion in small steps, and measure where rollouts jump from one frame to the next.

Every step is a frame of precision LIVE from one engine, as while a visitor drags. A jump is a discrete
Fréchet distance of more than `JUMP` between one rollout in two successive frames, both at N points evenly spaced by arc
length. While the motion is blocked the last one is shown, as on the page. Drags are random: through a point of the
middle of the mean demonstration, every second one in the plane of the task's slice, from outside the motion to anywhere
in or beyond it.

    python -m tests.benchmarks drag --task push_box --avoid hand --seed 1 --out drag.npz

The npz file holds for each step, drag after drag:

``rollouts`` (S, R, N, 3)
    the end effector's rollouts from the task's starts, metres; NaN for a start that is left out.
``places`` (S, 3), ``drag`` (S,)
    the sphere's centre, metres, and the number of the drag.
``moved`` (S, R)
    Fréchet distance from the frame before, metres; NaN for the first of a drag.
``blocked`` (S,)
    whether there was no motion.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dt_viz.avoidance.avoidance import Avoidance, Space
from dt_viz.avoidance.passing import ANEW
from dt_viz.evaluate.options import (
    Row,
    add_task,
    chosen_task,
    new_engine,
    output,
    positive_number,
    report,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array
from dt_viz.metrics import discrete_frechet, resample_by_arc_length
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import View
from dt_viz.scenario.stack import avoiding
from dt_viz.scenario.tasks import Task, known_tasks
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage

SPACE: Mapping[str, Space] = {"hand": "task", "arm": "cspace"}  # spaces of the avoidance
JUMP = 0.05  # fréchet distance of a rollout from the one in the frame before beyond which it jumps, metres
NUM_POINTS = 100  # number N of points of a rollout
REACH = 0.15
"""Distance from the mean demonstration at which random drags begin, and largest one at which they end, metres."""


@dataclass(frozen=True)
class Drag:
    """What was measured along one drag."""

    places: Array  # (S, 3) the sphere's centre, metres
    rollouts: Array  # (S, R, N, 3), metres
    blocked: Array  # (S,) bool

    @property
    def moved(self) -> Array:
        """(S, R) distance of each rollout from that in the frame before, metres; NaN in the first frame."""
        moved = discrete_frechet(self.rollouts[1:], self.rollouts[:-1])
        return np.concatenate([np.full_like(moved[:1], np.nan), moved])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_task(parser)
    parser.add_argument("--out", type=output(".npz"), required=True, metavar="FILE.npz", help="what is written")
    parser.add_argument("--avoid", choices=tuple(SPACE), default="arm", help="who gives way (default: %(default)s)")
    parser.add_argument("--drags", type=whole_number(1), default=5, help="(default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of these (default: %(default)s)")
    parser.add_argument("--step", type=positive_number("metres", 1), default=1e-3, help="metres (default: %(default)s)")
    parser.add_argument("--diameter", type=positive_number("metres", 1), metavar="D", default=0.15, help="metres")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    tasks, task = known_tasks(options.lasa), chosen_task(options)
    drags = [_measured(new_engine(tasks), task, places, options) for places in paths(task, options)]
    moved = [drag.moved for drag in drags]
    arrays = {name: np.concatenate([getattr(d, name) for d in drags]) for name in ("rollouts", "places", "blocked")}
    arrays |= {"moved": np.concatenate(moved)}
    arrays["drag"] = np.repeat(np.arange(len(drags)), [len(d.places) for d in drags])
    write_npz(options.out, arrays)
    print(f"{task.name}, {options.avoid} avoids, sphere of {options.diameter:g} m in steps of {options.step:g} m")
    by_name = {str(k): ([drag], [by]) for k, (drag, by) in enumerate(zip(drags, moved, strict=True))}
    report([_row(name, *of_row) for name, of_row in {**by_name, "all": (drags, moved)}.items()])
    return 0


def paths(task: Task, options: argparse.Namespace) -> Iterator[Array]:
    """The places (S, 3) of each drag, metres."""
    rng = np.random.default_rng(options.seed)
    path = task.mean_path
    for k in range(options.drags):
        through = path[round(rng.uniform(0.2, 0.8) * (len(path) - 1))]
        direction = rng.normal(size=3)
        if k % 2 == 0:
            direction = task.slice.axes @ (task.slice.axes.T @ direction)
        direction /= np.linalg.norm(direction)
        length = REACH + rng.uniform(0, REACH)
        num = int(np.ceil(length / options.step - 1e-9)) + 1
        yield through + np.linspace(-REACH, length - REACH, max(num, 2))[:, None] * direction


def _measured(engine: Engine, task: Task, places: Array, options: argparse.Namespace) -> Drag:
    """Drag the sphere through places (S, 3), metres."""
    without = replace(avoiding(task, Avoidance()), view=View(field=False))
    rollouts = [_by_start(next(engine.frames(without)), task)]
    blocked, passing = [], ANEW
    for place in places:
        avoidance = Avoidance(Sphere(as_point(place), options.diameter), space=SPACE[options.avoid])
        scenario = replace(avoiding(task, avoidance), view=View(field=False), passing=passing)
        frame = next(frame for frame in engine.frames(scenario) if frame.stage is Stage.LIVE)
        passing = frame.passing
        blocked.append(bool(frame.blocked))
        rollouts.append(rollouts[-1] if frame.blocked else _by_start(frame, task))
    return Drag(places, np.stack(rollouts[1:]), np.array(blocked))


def _by_start(frame: Frame, task: Task) -> Array:
    """The rollouts (R, N, 3) from the task's starts, metres; NaN for starts without one."""
    nothing, own = np.full((NUM_POINTS, 3), np.nan), frame.rollouts[: len(task.paths)]
    return np.stack([resample_by_arc_length(path, NUM_POINTS) if len(path) else nothing for path in own])


def _row(name: str, drags: Sequence[Drag], moved: Sequence[Array]) -> Row:
    """Row of some drags in the table."""
    of_all, frames = np.concatenate(moved), sum(len(by) - 1 for by in moved)
    jumps = int(np.any(of_all > JUMP, axis=1).sum())
    return {
        "drag": name,
        "frames": frames,
        "blocked": sum(int(drag.blocked.sum()) for drag in drags),
        "frames in which a rollout jumps": jumps,
        "% of frames": 100 * jumps / frames,
        "largest step mm": 1e3 * float(np.nanmax(of_all, initial=0.0)),
    }
