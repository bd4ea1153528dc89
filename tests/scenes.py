"""Scenarios with one avoidance, written in one line: its fields beside those of the scenario."""

from dataclasses import fields, replace

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import Avoidance
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere, as_point
from dt_viz.scenario.scenario import Layer, Scenario, Start
from dt_viz.scenario.slices import SlicePose
from dt_viz.scenario.stack import avoidance_layer, with_avoidance

RANDOM_TASKS = ("draw_s", "lift_box", "push_box")
OF_AVOIDANCE = {field.name for field in fields(Avoidance)} | {"space"}


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
    stack_changes = own or (avoids, layers, level) != (None, None, None)
    return {"stack": scenario.stack, **changes} if stack_changes else changes


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


def random_scenario(engine, seed):
    """Up to three obstacles and two bias points near the motion of a task."""
    rng = np.random.default_rng(seed)
    task = engine.task(RANDOM_TASKS[seed % len(RANDOM_TASKS)])

    def place():
        path = task.paths[int(rng.integers(len(task.paths)))]
        x, y, z = path[int(rng.integers(len(path)))] + rng.normal(scale=0.06, size=3)
        return float(x), float(y), float(z)

    def obstacle():
        turn = rng.normal(size=4)
        w, x, y, z = (float(c) for c in turn / np.linalg.norm(turn))
        a, b, c = (float(size) for size in rng.uniform(0.04, 0.16, 3))
        kind = rng.integers(3)
        if kind == 0:
            return Sphere(place(), a)
        return Box(place(), (a, b, c), (w, x, y, z)) if kind == 1 else Cylinder(place(), a, b, (w, x, y, z))

    layers = biases(*(BiasPoint(place(), moves_goal=bool(rng.integers(4) == 0)) for _ in range(rng.integers(3))))
    return avoiding(
        task.name,
        tuple(obstacle() for _ in range(rng.integers(4))),
        layers=layers,
        level=int(rng.integers(len(layers) + 1)),
        temperature=float(rng.uniform(2, 12)),
    )


def tilted(task, seed=0):
    """A pose of the slice a little beside the task's, by random numbers."""
    rng, home = np.random.default_rng(seed), task.slice.pose
    turn = Rotation.from_rotvec(rng.uniform(-0.6, 0.6, 3)) * Rotation.from_quat(np.roll(home.wxyz, -1))
    x, y, z = (np.asarray(home.position) + rng.uniform(-0.04, 0.04, 3)).tolist()
    w, i, j, k = np.roll(turn.as_quat(), 1).tolist()
    return SlicePose((x, y, z), (w, i, j, k))


def frame_at(engine, scenario, stage):
    """The frame of a scenario at a stage; nothing finer is computed."""
    frames = engine.frames(scenario)
    frame = next(frame for frame in frames if frame.stage is stage)
    frames.close()
    return frame
