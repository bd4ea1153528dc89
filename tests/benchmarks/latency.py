"""Drag an obstacle or a bias point through a motion and measure the time from each edit until its frame is ready.

Session, worker and engine are the real ones; a display that records replaces the page.

    python -m tests.benchmarks latency --task draw_s --seconds 8 --out latency.json

Median and 95 % are those of the time from an edit until its rollouts are ready (stage ROLLOUTS), and until the vector
field is, too (LIVE); and of computing these alone, with what the robot in the loop is given. A unit is the time of a
fixed piece of numpy work, in which figures of different machines compare.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import SPACES, Avoidance
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.errors import FormatError
from dt_viz.evaluate.options import (
    add_task,
    chosen_task,
    new_engine,
    positive_number,
    report,
    whole_number,
)
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import anchored, avoiding, plane_of, with_added, with_avoidance, with_transform
from dt_viz.scenario.tasks import Task, known_tasks
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Frame, Stage
from dt_viz.session.progress import Display, Pace, Progress
from dt_viz.session.session import Session
from tests.benchmarks.options import add_out

EDITS_PER_SECOND = 60
WARM_UP_SECONDS = 1.0


@dataclass
class Recorder(Display):
    """A display that only records."""

    frames: list[tuple[Stage, float, float]] = field(default_factory=list)
    """Stage, seconds from the edit until the frame was ready, and seconds of computing alone, of each frame."""
    seconds: float = 0.0  # time of computing the frame that is drawn, seconds; see `_timed`
    error: str = ""

    def draw(self, frame: Frame, pace: Pace) -> None:
        self.frames.append((frame.stage, pace.latency, self.seconds))

    def tell(self, progress: Progress) -> None:
        if progress.failed and progress.message is not None:
            self.error = progress.message.text


def _timed(engine: Engine, shown: Recorder) -> Engine:
    """Return an engine that tells the recorder how long it computes what follows a hand, without what draws it."""
    frames = engine.frames

    def timed(*scenario: Any, draw: Callable[[Frame], None] = lambda frame: None, **others: Any) -> Iterator[Frame]:
        began = time.perf_counter()

        def draw_timed(frame: Frame) -> None:
            nonlocal began
            now = time.perf_counter()
            shown.seconds = now - began
            draw(frame)
            began += time.perf_counter() - now

        for frame in frames(*scenario, draw=draw_timed, **others):
            now = time.perf_counter()
            yield frame
            began += time.perf_counter() - now

    engine.frames = timed
    return engine


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    add_task(parser)
    parser.add_argument("--space", choices=SPACES, default="cspace", help="what avoids (default: %(default)s)")
    parser.add_argument("--drag", choices=("obstacle", "bias"), default="obstacle", help="what (default: %(default)s)")
    parser.add_argument(
        "--obstacles", type=whole_number(0), default=1, help="in the scene, along the path (default: %(default)s)"
    )
    parser.add_argument("--seconds", type=positive_number("seconds", 3600), required=True, help="to measure")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if the session reported an error."""
    tasks, task = known_tasks(options.lasa), chosen_task(options)
    scenario, shown = _scenario(task, options), Recorder()
    engine = _timed(new_engine(tasks), shown)
    engine.nominal(scenario)  # learned before
    session = Session(engine, lambda *_: scenario, task.name, shown)
    positions = moving_through(task)
    try:
        _settle(session)
        _drag(session, positions, WARM_UP_SECONDS)
        _settle(session)
        shown.frames.clear()
        _drag(session, positions, options.seconds)
        _settle(session)
    finally:
        session.close()
    if shown.error:
        print(f"the session failed: {shown.error}", file=sys.stderr)
        return 1
    first, live = (np.array([f[1:] for f in shown.frames if f[0] is stage]) for stage in (Stage.ROLLOUTS, Stage.LIVE))
    unit, rows = unit_ms(), []
    seconds = {"rollouts": first[:, 0], "also the field": live[:, 0]}
    seconds |= {"computing rollouts": first[:, 1], "computing all": live[:, 1]}
    for name, values in seconds.items():
        median, p95 = 1e3 * np.percentile(values, [50, 95])
        row = {"edit → frame": name, "median ms": float(median), "p95 ms": float(p95)}
        rows.append(row | {"in units": float(median / unit)})
    report(rows)
    return 0


def unit_ms() -> float:
    """Measure a fixed piece of numpy work: 3,000 calls of exp and einsum on small arrays, the best of ten, ms."""
    rows, best = np.linspace(-1, 1, 24).reshape(8, 3), np.inf
    for _ in range(10):
        began = time.perf_counter()
        for _ in range(1500):
            np.einsum("ij,ij->i", rows, np.exp(rows))
        best = min(best, time.perf_counter() - began)
    return 1e3 * best


def moving_through(task: Task) -> Callable[[float], tuple[float, float, float]]:
    """Return a smooth closed curve, (3,) at a time in seconds, around the middle of the mean demonstration."""
    middle, amplitude, periods = task.mean_path[50], 0.06, np.array([2.9, 4.3])  # whose ratio is not simple

    def position(seconds: float) -> tuple[float, float, float]:
        return as_point(middle + task.slice.axes @ (amplitude * np.sin(2 * np.pi * seconds / periods)))

    return position


def _scenario(task: Task, options: argparse.Namespace) -> Scenario:
    """Return the initial scenario: obstacles along the mean path, and a bias point if that is dragged."""
    places = np.linspace(0, 100, options.obstacles + 2).round().astype(int)[1:-1]
    diameter = Sphere(task.obstacle_position).diameter / max(1, options.obstacles)
    if options.drag == "obstacle" and options.obstacles == 0:
        raise FormatError("--obstacles", "0", "1 or more, or --drag bias")
    obstacles = tuple(Sphere(as_point(place), diameter) for place in task.mean_path[places])
    scenario = avoiding(task, Avoidance(obstacles, space=options.space))
    if options.drag == "obstacle":
        return scenario
    bias = BiasPoint(task.obstacle_position, plane=plane_of(task))
    return replace(scenario, stack=with_added(scenario, bias)[0])


def _moved(scenario: Scenario, place: tuple[float, float, float]) -> dict[str, Any]:
    """Return the changed fields of the scenario after the drag to a place."""
    for name, point in anchored(scenario).items():
        return {"stack": with_transform(scenario, name, replace(point, position=place))}
    first, *others = scenario.avoidance.obstacles
    return {"stack": with_avoidance(scenario, obstacles=(first.moved(place), *others))}


def _drag(session: Session, position: Callable[[float], tuple[float, float, float]], seconds: float) -> None:
    """Edit at `EDITS_PER_SECOND` from this thread."""
    began = time.perf_counter()
    for tick in range(1, max(1, round(EDITS_PER_SECOND * seconds)) + 1):
        time.sleep(max(0.0, began + tick / EDITS_PER_SECOND - time.perf_counter()))
        session.edit("drag", **_moved(session.scenario, position(tick / EDITS_PER_SECOND)))


def _settle(session: Session) -> None:
    """Wait until nothing is left to compute."""
    if not session.wait_idle(timeout := 120.0):
        raise FormatError("--task", f"frames that take more than {timeout:g} s", "a task that can be shown live")
