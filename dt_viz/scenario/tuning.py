"""The flow of each transform of the stack and its settings: pure functions, as in `stacking`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.scenario.scenario import MAX_MANUAL_DURATION, Scenario
from dt_viz.scenario.stack import AVOIDANCE, IMITATION, WHOLE_ARM, bias_points, visible_names, with_changed_point
from dt_viz.transforms.bias import MAX_DURATION as MAX_STRENGTH


@dataclass(frozen=True)
class FlowSettings:
    """What the user chooses of a transform's flow."""

    duration: float | None
    """t; None is `auto`."""
    integration: Integration
    max_duration: float
    """That can be chosen."""


def transforms(scenario: Scenario) -> tuple[str, ...]:
    """Names of all transforms, also of those that are off, from the outermost to the imitation."""
    arm = (WHOLE_ARM,) if scenario.space != "task" and scenario.obstacles else ()
    return (*arm, *reversed(visible_names(scenario)), IMITATION)


def tuned(scenario: Scenario) -> str:
    """The transform whose settings the page shows: the one chosen, or else the outermost."""
    names = transforms(scenario)
    return scenario.view.tuned if scenario.view.tuned in names else names[0]


def avoids(name: str) -> bool:
    """Whether this transform is one of those that avoid obstacles; they share their settings."""
    return name in {AVOIDANCE, WHOLE_ARM}


def flow_settings(scenario: Scenario, name: str) -> FlowSettings | None:
    """Of the transform of this name; None where there is nothing to choose."""
    if avoids(name):
        return FlowSettings(scenario.duration, scenario.integration, MAX_MANUAL_DURATION)
    point = bias_points(scenario.layers).get(name)
    return None if point is None else FlowSettings(point.strength, point.integration, MAX_STRENGTH)


def with_flow(scenario: Scenario, name: str, **changes: Any) -> Mapping[str, Any]:  # noqa: ANN401 - fields of FlowSettings
    """The fields of a scenario that change with these settings of a transform's flow."""
    before = flow_settings(scenario, name)
    if before is None:
        return {}
    settings = replace(before, **changes)
    if avoids(name):
        return {"duration": settings.duration, "integration": settings.integration}
    point = replace(bias_points(scenario.layers)[name], strength=settings.duration, integration=settings.integration)
    return {"layers": with_changed_point(scenario.layers, name, point)}
