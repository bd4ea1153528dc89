"""The tour: six steps from an attractor to a whole arm that imitates, avoids and is biased."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance, Avoidance
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.obstacles.shapes import as_point
from dt_viz.scenario.scenario import Scenario, Start, View
from dt_viz.scenario.stack import avoiding, plane_of, with_added
from dt_viz.scenario.tasks import Task

TASK = "draw_s"  # name of the task of all steps
BIAS_AT, BIAS_OFFSET = 20, (-0.05, 0.04)
"""Percent of the mean demonstration's length beside which the bias point lies, and how far, right and up, metres."""
NEW_STARTS = ((-0.9, 0.6), (-0.3, -0.9), (0.4, 0.9), (0.9, 0.2))
"""Places of added starts on the slice, right and up, relative to half its size."""
FLAT = {"arm": False, "table": False, "ghost": False}
"""View of the steps that are about the hand alone."""


@dataclass(frozen=True)
class TourStep:
    """A step of the tour: a scenario, and what is said of it."""

    title: str
    text: str  # two or three sentences
    formula: str  # the one formula, HTML
    trial: str  # what to try
    make: Callable[[Task], Scenario]
    view: Mapping[str, Any]  # fields of `View` that differ from the defaults
    grows: bool = False
    """Whether the warp is moved beside the text, and grows from 0 to 1 once by itself."""

    def scenario(self, task: Task) -> Scenario:
        """Return the scenario for the task of the tour."""
        return replace(self.make(task), view=replace(View(), **self.view))

    def ended(self, task: Task) -> Scenario:
        """Return the scenario once its warp has grown."""
        scenario = self.scenario(task)
        return replace(scenario, warp=1.0) if self.grows else scenario


def _unwarped(task: Task) -> Scenario:
    return Scenario(task.name, (), warp=0.0)


def _from_elsewhere(task: Task) -> Scenario:
    area = task.slice
    places = area.centre + np.array(NEW_STARTS) * area.half_size @ area.axes.T
    return Scenario(task.name, (), starts=tuple(Start(as_point(place)) for place in places))


def _arm_avoids(task: Task) -> Scenario:
    return avoiding(task, ArmAvoidance(task.sphere()))


def _all_at_once(task: Task) -> Scenario:
    scenario = _arm_avoids(task)
    place = task.mean_path[BIAS_AT] + task.size * task.slice.axes @ BIAS_OFFSET
    return replace(scenario, stack=with_added(scenario, BiasPoint(as_point(place), plane=plane_of(task)))[0])


STEPS = (
    TourStep(
        "An attractor",
        "Every motion runs straight to the goal, the green ball. Nothing is learned yet: this is the simplest stable "
        "system there is.",
        "ż = −∇Φ(z)",
        "Drag the view to turn it, scroll to come nearer.",
        _unwarped,
        FLAT | {"demonstrations": False, "field": False, "streamlines": True},
    ),
    TourStep(
        "A warp, learned",
        "Seven drawings of an S (blue) show how the motion should look. A warp ψ of space, learned from them, bends "
        "the straight lines to them, and the grid with it; space never folds or tears.",
        "y(t) = ψ⁻¹(z(t))",
        "Move the slider: 0 is the attractor, 1 the learned motion.",
        _unwarped,
        FLAT | {"field": False, "grid": True},
        grows=True,
    ),
    TourStep(
        "Stable by construction",
        "ψ has an exact inverse, so from any start the motion still ends at the goal. The colour is the Lyapunov "
        "value, like the height in a valley: it falls along every motion.",
        "d/dt Φ(ψ(y(t))) &lt; 0",
        "Click on the plane: a motion starts there.",
        _from_elsewhere,
        FLAT | {"demonstrations": False, "field": False, "colour": "lyapunov", "click_to_start": True},
    ),
    TourStep(
        "An obstacle",
        "A second warp ψₒ pushes space out of the sphere, so the motions of the hand flow around it. They "
        "end at the same goal; dashed is the S without the sphere.",
        "z = ψ<sub>i</sub>(ψ<sub>o</sub>(y))",
        "Drag the sphere through the S.",
        lambda task: avoiding(task, Avoidance(task.sphere(), plane=plane_of(task))),
        FLAT | {"ghost": True, "demonstrations": False},
    ),
    TourStep(
        "The whole arm",
        "An arm is more than its hand: forearm and fingers must not touch the sphere either. So this warp acts in the "
        "configuration space, on the joint angles q, and the hand draws what it can of the S.",
        "p(t) = ψ<sub>q</sub><sup>−1</sup>(q(t))",
        "Drag the sphere to the elbow.",
        _arm_avoids,
        {"demonstrations": False},
    ),
    TourStep(
        "All at once",
        "A bias point, the amber ball, pulls the motion through itself by one more warp. Warps are applied one after "
        "the other, so the arm imitates, avoids and is biased at once.",
        "z = ψ<sub>i</sub>(ψ<sub>b</sub>(fk(ψ<sub>q</sub>(q))))",
        "Drag the ball, then the sphere. “World” adds more of both.",
        _all_at_once,
        {"demonstrations": False},
    ),
)
"""The steps in their order."""
