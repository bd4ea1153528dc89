"""What is learned for a scenario: of its task, in its state and in its style."""

from __future__ import annotations

from dataclasses import replace

from dt_viz.learning.augmented import AugmentedImitation, fit_augmented
from dt_viz.learning.imitation import ImitationSettings, Progress
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.store import FitStore
from dt_viz.learning.style import Style
from dt_viz.motion.nominal import Learned
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN, Task


def learned_of(scenario: Scenario, task: Task, fits: FitStore, progress: Progress | None = None) -> Learned:
    """Learn the scenario's task without a style.

    Raises:
        ImitationError: nothing can be learned from its demonstrations.
    """
    state = task.state if scenario.state == "auto" else scenario.state
    state = state if scenario.imitation else "plain"  # without it there is nothing to remember
    settings, imitation = ImitationSettings(scenario.objective, preparation=task.preparation), task.imitation
    if imitation is None or imitation.state != state or scenario.objective != "trajectory":
        imitation = fits.learned(task.demonstrations, settings, state, progress)
    if imitation.state == "augmented" and scenario.state == "auto" and not imitation.reason:
        own = task.name.startswith(OWN)
        why = "it is learned at once" if own else "the plain state misses a demonstration of this task"
        imitation = replace(imitation, reason=why)
    return Learned.of(task, imitation, imitates=scenario.imitation)


def augmented_of(task: Task) -> AugmentedImitation:
    """Learn a task in the augmented state, to take or put on a style. Raises ImitationError."""
    return fit_augmented(task.demonstrations, settings=AugmentedSettings(preparation=task.preparation))


def styled(
    task: Task, own: AugmentedImitation, usual: AugmentedImitation, other: AugmentedImitation, amount: float
) -> Learned:
    """Put a part of what leads from the usual hand to the other one on what was learned of a task."""
    return Learned.of(task, Style.between(usual, other).on(own, amount), imitates=True)
