"""Remedies: edits of the scenario that mend what the status gives as its reason, each as a button."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import avoidance_layer, avoiding_with, transform_of, with_avoidance, with_transform
from dt_viz.session.frame import Frame
from dt_viz.ui.panel.verdict import concerns
from dt_viz.warning import Kind

INTEGRATION = frozenset({Kind.FOLDS, Kind.INEXACT_INVERSE})
"""Kinds of warnings about an integrator that was chosen by hand."""
FLOW = frozenset({Kind.STAYS_INSIDE, Kind.ENTERS, Kind.TOO_NEAR, Kind.ROLLOUT_ENTERS, Kind.ARM_TOO_NEAR})
"""Kinds of warnings that another flow of the avoidance may mend."""


@dataclass(frozen=True)
class Remedy:
    """An edit that mends something."""

    label: str
    """Label of its button."""
    changes: Mapping[str, Any]
    """Fields of the scenario that it replaces."""


def remedy(frame: Frame, adopted: Scenario) -> Remedy | None:
    """Return what mends the reason that matters most; None if nothing is known to, or the frame is of another motion.

    Args:
        frame: the newest frame.
        adopted: the scenario that is wanted now, which the remedy changes.
    """
    if frame.blocked or frame.scenario.choices != adopted.choices:
        return None
    if adopted.warp < 1:
        return Remedy("Complete the warp", {"warp": 1.0})
    told = concerns(frame, adopted.view)
    return _against(told[0].kind, told[0].source, adopted) if told else None


def _against(kind: Kind, source: str, scenario: Scenario) -> Remedy | None:
    if kind in INTEGRATION:
        return _integrated_automatically(scenario, source)
    enters = kind is Kind.ARM_ENTERS and scenario.arm_avoidance is None and scenario.view.arm
    if enters or (kind in FLOW and not avoidance_layer(scenario).on):
        whole = scenario.view.arm
        label = "Let the whole arm avoid" if whole else "Let the hand avoid"
        return Remedy(label, {"stack": avoiding_with(scenario, "cspace" if whole else "task")})
    return _with_another_flow(scenario) if kind in FLOW else None


def _with_another_flow(scenario: Scenario) -> Remedy | None:
    """Return the first choice by hand about the flow of the avoidance that can be left to the automatic one."""
    avoidance = scenario.avoidance
    if avoidance.duration is not None:
        return Remedy("Choose the flow time automatically", {"stack": with_avoidance(scenario, duration=None)})
    if avoidance.integration.by_hand:
        return _integrated_automatically(scenario, avoidance_layer(scenario).name)
    if avoidance.generator == "probability":
        return Remedy("Use the free-space generator", {"stack": with_avoidance(scenario, generator="free-space")})
    return None


def _integrated_automatically(scenario: Scenario, name: str) -> Remedy:
    transform: Any = transform_of(scenario, name)
    automatic = replace(transform, integration=replace(transform.integration, method="auto"))
    return Remedy("Integrate automatically", {"stack": with_transform(scenario, name, automatic)})
