"""Time from the click on each scene of the paper until its first motions, its field and its certificates are there.

    python -m tests.benchmarks scenes --out scenes.json

Each scene begins in an engine that has shown its task before, as on the page.
"""

from __future__ import annotations

import argparse
import time

import numpy as np

from dt_viz.evaluate.options import report
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.memo import Memo
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.paper_scenes import SCENES, offered
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from tests.benchmarks.options import add_out

SHOWN = (Stage.ROLLOUTS, Stage.LIVE, Stage.CERTIFIED)  # stages that are timed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)


def run(_options: argparse.Namespace) -> int:
    """Run the command."""
    fits, shared, figures = FitStore(default_cache_folder()), Memo(), {}
    for scene in offered(TASKS):
        engine = Engine(TASKS, fits, load_jaco(), shared)
        task = engine.task(scene.task)
        _seconds(engine, Scenario(scene.task))  # as the page was before
        for other in scene.tasks:
            fits.get(TASKS[other]().demonstrations)
        figures[scene.name] = _seconds(engine, scene.scenario(task))
    certified = [times["certified_s"] for times in figures.values()]
    over_all = {"median": float(np.median(certified)), "worst": max(certified)}
    report(
        [
            *({"scene": SCENES[name].title, **times} for name, times in figures.items()),
            *({"scene": name, "certified_s": seconds} for name, seconds in over_all.items()),
        ]
    )
    return 0


def _seconds(engine: Engine, scenario: Scenario) -> dict[str, float]:
    """Times until the first frame of each stage."""
    began, times = time.perf_counter(), {}
    for frame in engine.frames(scenario):
        if frame.stage in SHOWN:
            times.setdefault(f"{frame.stage.name.lower()}_s", time.perf_counter() - began)
        if frame.stage is Stage.CERTIFIED:
            break
    return times
