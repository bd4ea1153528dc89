"""Frozen scenarios: a few, described by plain data that no change of the classes touches, and their rollouts.

They begin from the fits in `frozen/fits.npz`, so that neither a change of learning nor another machine's fit touches
them. A version that is to give other rollouts writes them anew, and the fits only where their format changes:

    PYTHONPATH=.:tests python tests/frozen_scenarios.py [fits]
"""

import json
import sys
from pathlib import Path

import numpy as np
from scenes import starts_at

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.hand import Avoidance
from dt_viz.files.npz import npz_bytes
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning.imitation import Imitation, fit
from dt_viz.learning.store import FitStore, fingerprint
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import plane_of
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage

FOLDER = Path(__file__).parent / "frozen"
DESCRIPTIONS = json.loads((FOLDER / "scenarios.json").read_text(encoding="utf-8"))
FITS, ROLLOUTS = FOLDER / "fits.npz", FOLDER / "rollouts.npz"
NUM_KEPT = 15  # number of samples that are kept of each path


class StoredFits(FitStore):
    """Gives the stored plain fits of the tasks of frozen scenarios, and no others."""

    def __init__(self):
        super().__init__(None)
        with np.load(FITS) as arrays:
            for task in {name.split("/")[0] for name in arrays.files}:
                own = {name.split("/")[1]: arrays[name] for name in arrays.files if name.startswith(f"{task}/")}
                self._memory[fingerprint(TASKS[task]().demonstrations, "")] = Imitation.from_arrays(own)

    def get(self, demonstrations, settings=None, progress=None):
        return self._memory[fingerprint(demonstrations, "")]


def frozen_rollouts(number, robot):
    """Evenly spread samples of the rollouts of a frozen scenario, by name."""
    found = rollouts_of(Engine(TASKS, StoredFits(), robot), DESCRIPTIONS[number])
    return {name: path[np.linspace(0, len(path) - 1, NUM_KEPT).round().astype(int)] for name, path in found.items()}


def scenario_of(engine, description):
    """The scenario that a description is about."""
    return Scenario(
        description["task"],
        _stack(engine.task(description["task"]), description),
        imitation=description["imitation"],
        objective=description["objective"],
        warp=description["warp"],
        starts=starts_at(*description["starts"]),
    )


def _stack(task, description):
    avoid, layers = description["avoid"], []
    for bias in description["biases"]:
        plane = plane_of(task) if bias["plane"] else None
        size = bias["radius"], bias["strength"]
        point = BiasPoint(tuple(bias["position"]), *size, plane, bias["moves_goal"])
        layers.append(Layer(point, on=bias["on"], name=bias["name"]))
    avoidance = Avoidance(
        map(_obstacle, description["obstacles"]),
        **{name: avoid[name] for name in ("space", "generator", "temperature", "margin", "duration")},
        integration=Integration(avoid["method"], avoid["steps"]),
    )
    layers.insert(description["level"], Layer(avoidance, on=avoid["on"], name="Avoidance"))
    return tuple(layers)


def _obstacle(description):
    position = tuple(description["position"])
    match description["kind"]:
        case "sphere":
            return Sphere(position, description["diameter"])
        case "box":
            return Box(position, tuple(description["sizes"]), tuple(description["wxyz"]))
        case _:
            return Cylinder(position, description["diameter"], description["height"], tuple(description["wxyz"]))


def rollouts_of(engine, description):
    """Rollouts of the refined frame, and those of the arm's motion, by name."""
    frames = engine.frames(scenario_of(engine, description))
    frame = next(frame for frame in frames if frame.stage is Stage.FINE)
    found = {f"rollout {k}": path for k, path in enumerate(frame.rollouts)}
    found |= {f"times {k}": times for k, times in enumerate(frame.times)}
    return found if frame.arm is None else {**found, "joints": frame.arm.q}


def main(*what):
    if what == ("fits",):
        fits = {task: fit(TASKS[task]().demonstrations) for task in sorted({d["task"] for d in DESCRIPTIONS.values()})}
        arrays = {f"{task}/{k}": array for task, found in fits.items() for k, array in found.to_arrays().items()}
        FITS.write_bytes(npz_bytes(arrays))
    robot = load_jaco()
    found = {number: frozen_rollouts(number, robot) for number in DESCRIPTIONS}
    arrays = {f"{number}/{name}": path for number, paths in found.items() for name, path in paths.items()}
    ROLLOUTS.write_bytes(npz_bytes(arrays))


if __name__ == "__main__":
    main(*sys.argv[1:])
