"""Scenarios that the page has saved, in the library: their tasks are learned as the page learns them."""

from __future__ import annotations

from pathlib import Path

from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.learned import augmented_of, learned_of, styled
from dt_viz.motion.nominal import Learned
from dt_viz.scenario.saved import Saved, ScenarioError, check_shapes
from dt_viz.scenario.tasks import OWN, STYLES, TASKS, Task


def learned_for(saved: Saved, source: str | Path) -> Learned:
    """Learn what a scenario is stacked on; `source` is its file's name, for messages.

    Raises:
        ScenarioError: an obstacle is no solid, or the page has placed the task anew for the arm.
        ImitationError: nothing can be learned from the demonstrations.
    """
    scenario = saved.scenario
    check_shapes(scenario, str(source))
    if saved.own is None and scenario.arm:
        found = f"{scenario.arm!r}, in whose reach the page has placed {scenario.task!r}"
        raise ScenarioError(source, "arm", found, "the first one of a page, or demonstrations of your own")

    def task(name: str) -> Task:
        return saved.own.task if saved.own is not None and name == OWN else TASKS[name]()

    if scenario.style and scenario.imitation:
        own, usual, other = (augmented_of(task(name)) for name in (scenario.task, *STYLES[scenario.style]))
        return styled(task(scenario.task), own, usual, other, scenario.style_amount)
    return learned_of(scenario, task(scenario.task), FitStore(default_cache_folder()))
