"""Drag a sphere straight through a motion in small steps, and measure where rollouts jump from one frame to the next.

Every step is a frame of precision LIVE from one engine, as while a visitor drags; after the last one the sphere rests,
and the frame of stage FINE is compared with that of an engine that has seen nothing of the drag. A jump is a discrete
Fréchet distance of more than `JUMP` between one rollout in two successive frames, both at N points evenly spaced by arc
length. While the motion is blocked the last one is shown, as on the page. Without ``--from`` and ``--to`` the drags are
random: through a point of the middle of the mean demonstration, every second one in the plane of the task's slice,
from outside the motion to anywhere in or beyond it.

The npz file holds for each step, drag after drag:

``rollouts`` (S, R, N, 3)
    the end effector's rollouts by the numbers of their starts, metres; NaN for a start that is left out.
``places`` (S, 3), ``drag`` (S,)
    the sphere's centre, metres, and the number of the drag.
``moved`` (S, R)
    Fréchet distance from the frame before, metres; NaN for the first of a drag.
``blocked`` (S,), ``seconds`` (S,)
    whether there was no motion, and the time until the rollouts were ready.
``rested`` (D, R, N, 3), ``fresh`` (D, R, N, 3)
    the rollouts at the end of each drag, refined, and those of an engine that has not seen the drag.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from dt_viz.arm.robot import load_jaco
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Frame, Stage
from dt_viz.evaluate.options import (
    InputError,
    add_task,
    avoiding,
    chosen_task,
    number,
    point,
    positive_number,
    print_table,
    ready_to_write,
    whole_number,
    write_npz,
)
from dt_viz.flows.fields import Array, Mask
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.metrics import discrete_frechet, resample_by_arc_length
from dt_viz.motion.stack import FINE, LIVE, Precision
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.avoidance import Avoidance, Space

SPACE: Mapping[str, Space] = {"hand": "task", "arm": "cspace"}
"""Spaces of the avoidance."""
JUMP = 0.05
"""Fréchet distance of a rollout from the one in the frame before beyond which it jumps, metres."""
ELSEWHERE = 1e-3
"""Fréchet distance of a rollout from that of an engine that has not seen the drag beyond which it differs, metres."""
ALONG = (0.2, 0.8)
"""Part of the mean demonstration's length that random drags go through."""
REACH = 0.15
"""Distance from the mean demonstration at which random drags begin, and largest one at which they end, metres."""


@dataclass(frozen=True)
class Drag:
    """What was measured along one drag."""

    places: Array
    """(S, 3) the sphere's centre, metres."""
    rollouts: Array
    """(S, R, N, 3), metres."""
    blocked: Array
    """(S,) bool."""
    seconds: Array
    """(S,) until the rollouts were ready."""
    rested: Array
    """(R, N, 3) after the drag, refined, metres."""
    fresh: Array
    """(R, N, 3) the same where nothing was dragged, metres."""

    @property
    def moved(self) -> Array:
        """(S, R) distance of each rollout from that in the frame before, metres; NaN in the first frame."""
        moved = discrete_frechet(self.rollouts[1:], self.rollouts[:-1])
        return np.concatenate([np.full_like(moved[:1], np.nan), moved])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--avoid", choices=tuple(SPACE), default="arm", help="who gives way (default: %(default)s)")
    parser.add_argument("--from", dest="begin", type=point, metavar="X,Y,Z", help="where the drag begins, metres")
    parser.add_argument("--to", dest="end", type=point, metavar="X,Y,Z", help="where it ends")
    parser.add_argument("--drags", type=whole_number(1), default=5, help="random ones, else (default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of these (default: %(default)s)")
    parser.add_argument("--step", type=positive_number("metres", 1), default=1e-3, help="metres (default: %(default)s)")
    parser.add_argument("--diameter", type=positive_number("metres", 1), metavar="D", default=0.15, help="metres")
    parser.add_argument("--margin", type=number("metres", 0, 1), default=0.01, help="metres (default: %(default)s)")
    parser.add_argument("--points", type=whole_number(2), default=100, help="N of a rollout (default: %(default)s)")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE.npz")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    tasks, task = chosen_task(options)
    out = ready_to_write(options.out, ".npz")
    fits, robot = FitStore(default_cache_folder()), load_jaco()
    drags = []
    for places in paths(task, options):
        drags.append(_measured(Engine(tasks, fits, robot), Engine(tasks, fits, robot), task, places, options))
    moved = [drag.moved for drag in drags]
    write_npz(
        out,
        **{name: np.concatenate([getattr(d, name) for d in drags]) for name in ("rollouts", "places", "blocked")},
        seconds=np.concatenate([d.seconds for d in drags]),
        drag=np.repeat(np.arange(len(drags)), [len(d.places) for d in drags]),
        moved=np.concatenate(moved),
        rested=np.stack([d.rested for d in drags]),
        fresh=np.stack([d.fresh for d in drags]),
    )
    print(f"{task.name}, {options.avoid} avoids, sphere of {options.diameter:g} m in steps of {options.step:g} m")
    header = ("drag", "frames", "blocked", "jumps", "of all rollouts", "largest mm", "at rest off mm", "median ms")
    rows = [(str(k), *_row([drag], [by])) for k, (drag, by) in enumerate(zip(drags, moved, strict=True))]
    print_table(header, [*rows, ("all", *_row(drags, moved))])
    frames, jumps = sum(len(by) - 1 for by in moved), sum(int(_jumps(by).sum()) for by in moved)
    print(f"frames in which a rollout jumps {jumps} of {frames} ({100 * jumps / frames:.2f} %)")
    elsewhere = sum(_off_at_rest(drag) > ELSEWHERE for drag in drags)
    print(f"drags after which rest is elsewhere than without the drag {elsewhere} of {len(drags)}")
    return 0


def paths(task: Task, options: argparse.Namespace) -> Iterator[Array]:
    """The places (S, 3) of each drag, metres."""
    if (options.begin is None) != (options.end is None):
        raise InputError("--from, --to", "one of them", "both, or none of them for random drags")
    if options.begin is not None:
        yield _straight(np.array(options.begin), np.array(options.end), options.step)
        return
    rng = np.random.default_rng(options.seed)
    path = task.mean_path
    for k in range(options.drags):
        through = path[round(rng.uniform(*ALONG) * (len(path) - 1))]
        direction = rng.normal(size=3)
        if k % 2 == 0:
            direction = task.slice.axes @ (task.slice.axes.T @ direction)
        direction /= np.linalg.norm(direction)
        yield _straight(through - REACH * direction, through + rng.uniform(0, REACH) * direction, options.step)


def _straight(begin: Array, end: Array, step: float) -> Array:
    """Places (S, 3) from one to another, at most `step` apart, metres."""
    num = int(np.ceil(np.linalg.norm(end - begin) / step - 1e-9)) + 1
    return np.linspace(begin, end, max(num, 2))


def _measured(dragged: Engine, fresh: Engine, task: Task, places: Array, options: argparse.Namespace) -> Drag:
    """Drag the sphere with one engine, and look at its last place with another one, too."""
    space, margin = SPACE[options.avoid], options.margin
    spheres = [Sphere(as_point(place), options.diameter) for place in places]
    scenarios = [_scenario(task, Avoidance(sphere, space=space, margin=margin)) for sphere in spheres]
    points, rollouts, blocked, seconds = options.points, [], [], []
    undisturbed = _by_number(next(fresh.frames(_scenario(task, Avoidance()))), range(len(task.paths)), points, task)
    for scenario in scenarios:
        first, frame = _frames(dragged, scenario, Stage.LIVE)
        blocked.append(bool(frame.blocked))
        seconds.append(first.seconds)
        shown = rollouts[-1] if rollouts else undisturbed
        rollouts.append(shown if frame.blocked else _numbered(dragged, scenario, LIVE, frame, points))
    _, rest = _frames(dragged, scenarios[-1], Stage.FINE)
    _, alone = _frames(fresh, scenarios[-1], Stage.FINE)
    shown = rollouts[-1]
    return Drag(
        places,
        np.stack(rollouts),
        np.array(blocked),
        np.array(seconds),
        shown if rest.blocked else _numbered(dragged, scenarios[-1], FINE, rest, points),
        shown if alone.blocked else _numbered(fresh, scenarios[-1], FINE, alone, points),
    )


def _scenario(task: Task, avoidance: Avoidance) -> Scenario:
    """The scenario of an avoidance, without pictures on the slice."""
    return replace(avoiding(task, avoidance), view=View(field=False))


def _frames(engine: Engine, scenario: Scenario, last: Stage) -> tuple[Frame, Frame]:
    """The first frame of a scenario, and that of the last stage that is wanted."""
    frames = engine.frames(scenario)
    first = frame = next(frames)
    while frame.stage < last:
        frame = next(frames)
    return first, frame


def _numbered(engine: Engine, scenario: Scenario, precision: Precision, frame: Frame, points: int) -> Array:
    """The rollouts of a frame that is not blocked, see `_by_number`."""
    return _by_number(frame, engine.solved(scenario, precision).nominal.numbers, points, frame.task)


def _by_number(frame: Frame, numbers: Sequence[int], points: int, task: Task) -> Array:
    """The rollouts (R, N, 3) by the numbers of their starts, metres; NaN for starts without one."""
    rollouts = np.full((len(task.paths), points, 3), np.nan)
    for rollout, path in zip(numbers, frame.rollouts, strict=True):
        rollouts[rollout] = resample_by_arc_length(path, points)
    return rollouts


def _jumps(moved: Array) -> Mask:
    """Which frames (S,) a rollout jumps in."""
    return np.any(moved > JUMP, axis=1)


def _off_at_rest(drag: Drag) -> float:
    """Largest distance of a rollout at rest from that without the drag, metres."""
    return float(np.nanmax(discrete_frechet(drag.rested, drag.fresh), initial=0.0))


def _row(drags: Sequence[Drag], moved: Sequence[Array]) -> tuple[str, ...]:
    """The row of some drags in the table."""
    of_all, seconds = np.concatenate(moved), np.concatenate([drag.seconds for drag in drags])
    whole = np.all((of_all > JUMP) | np.isnan(of_all), axis=1) & _jumps(of_all)
    return (
        str(len(of_all) - len(drags)),
        str(sum(int(drag.blocked.sum()) for drag in drags)),
        str(_jumps(of_all).sum()),
        str(whole.sum()),
        f"{1e3 * np.nanmax(of_all, initial=0.0):.0f}",
        f"{1e3 * max(_off_at_rest(drag) for drag in drags):.1f}",
        f"{1e3 * np.median(seconds):.1f}",
    )
