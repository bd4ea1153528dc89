"""Scenarios with one avoidance, written in one line: its fields beside those of the scenario."""

from dataclasses import fields, replace

import numpy as np

from dt_viz.obstacles.shapes import as_point
from dt_viz.scenario.scenario import Layer, Scenario, Start
from dt_viz.scenario.stack import avoidance_layer, with_avoidance
from dt_viz.transforms.avoidance import Avoidance

OF_AVOIDANCE = {field.name for field in fields(Avoidance)}


def changing(scenario, *, avoids=None, layers=None, level=None, **changes):
    """The fields of a scenario that change.

    Args:
        scenario: before.
        avoids: whether the avoidance is on; None leaves it as it is.
        layers: the layers beside the avoidance, from the inside out; None leaves them.
        level: how many of these the avoidance is stacked on; None is all of them, or leaves the stack as it is.
        **changes: fields of `Scenario` and of `Avoidance`.
    """
    own = {name: changes.pop(name) for name in OF_AVOIDANCE & set(changes)}
    if own:
        scenario = replace(scenario, stack=with_avoidance(scenario, **own))
    avoidance = avoidance_layer(scenario)
    if avoids is not None:
        switched = replace(avoidance, on=avoids)
        stack = tuple(switched if layer is avoidance else layer for layer in scenario.stack)
        scenario, avoidance = replace(scenario, stack=stack), switched
    if layers is not None or level is not None:
        others = list(beside(scenario) if layers is None else layers)
        others.insert(len(others) if level is None else level, avoidance)
        scenario = replace(scenario, stack=tuple(others))
    return (
        {"stack": scenario.stack, **changes}
        if own or avoids is not None or layers is not None or level is not None
        else changes
    )


def changed(scenario, **changes):
    """The scenario with these `changing`."""
    return replace(scenario, **changing(scenario, **changes))


def avoiding(task, obstacles=(), **changes):
    """A scenario of a task that avoids obstacles, with these `changing`."""
    return changed(Scenario(task), **{"obstacles": obstacles, "space": "task", **changes})


def beside(scenario):
    """The layers beside the avoidance."""
    return tuple(layer for layer in scenario.stack if layer is not avoidance_layer(scenario))


def kinds(warnings):
    """The kinds of warnings, each once."""
    return {warning.kind for warning in warnings}


def biases(*points):
    """Layers of bias points, named as on the page."""
    return tuple(Layer(point, name=f"Bias {k}") for k, point in enumerate(points, 1))


def starts_at(*places):
    """Added starts at places (3,), metres."""
    return tuple(Start(as_point(place)) for place in places)


def places_of(starts):
    """Places (N, 3), metres, of added starts."""
    return np.array([start.place for start in starts]).reshape(-1, 3)


def says(frame, words):
    """Whether some warning of a frame has these words."""
    return any(words in warning.text for warning in frame.certificates.warnings)
