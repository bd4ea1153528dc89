"""Rollouts of random scenarios, kept to be compared with those of another version.

Scenarios are described by plain data (`frozen/scenarios.json`), which no change of the classes touches. All sixty are
compared on one machine, where versions that compute the same agree to rounding:

    PYTHONPATH=. python tests/frozen_scenarios.py write before.npz        # in a checkout of the version before
    PYTHONPATH=. python tests/frozen_scenarios.py compare before.npz      # here: metres, largest difference first

`test_frozen_scenarios.py` compares some of them with `frozen/rollouts.npz`. These begin from the fits in
`frozen/fits.npz`, so that neither a change of learning nor another machine's fit touches them. A version that is to
give other rollouts writes them anew, and the fits only if their format changes:

    PYTHONPATH=. python tests/frozen_scenarios.py freeze
    PYTHONPATH=. python tests/frozen_scenarios.py freeze-fits
"""

import json
import sys
import tempfile
from pathlib import Path

import numpy as np
from scenes import starts_at

from dt_viz.arm.robot import load_jaco
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Stage
from dt_viz.files.npz import npz_bytes
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning.imitation import Imitation, fit
from dt_viz.learning.store import FitStore, fingerprint
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.stack import plane_of
from dt_viz.scenario.tasks import TASKS
from dt_viz.transforms.avoidance import Avoidance
from dt_viz.transforms.bias import BiasPoint

FOLDER = Path(__file__).parent / "frozen"
DESCRIPTIONS = json.loads((FOLDER / "scenarios.json").read_text(encoding="utf-8"))
FITS, ROLLOUTS = FOLDER / "fits.npz", FOLDER / "rollouts.npz"
FROZEN = (3, 9, 12, 17, 18, 27, 39, 57)
"""Numbers of the scenarios in `ROLLOUTS`: of the hand, of the whole arm, with bias points, added starts and a warp."""
NUM_KEPT = 15
"""Number of samples that are kept of each path."""


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


def all_rollouts(fits, robot):
    """The same of many scenarios, each by an engine that has computed nothing yet."""
    found = {}
    for number, description in enumerate(DESCRIPTIONS):
        print(number, end=" ", flush=True)
        paths = rollouts_of(Engine(TASKS, fits, robot), description)
        found |= {f"{number}/{name}": path for name, path in paths.items()}
    return found


def freeze(robot):
    found = {number: frozen_rollouts(number, robot) for number in FROZEN}
    ROLLOUTS.write_bytes(
        npz_bytes({f"{number}/{name}": path for number, paths in found.items() for name, path in paths.items()})
    )


def freeze_fits():
    fits = {task: fit(TASKS[task]().demonstrations) for task in sorted({DESCRIPTIONS[n]["task"] for n in FROZEN})}
    FITS.write_bytes(
        npz_bytes({f"{task}/{k}": v for task, found in fits.items() for k, v in found.to_arrays().items()})
    )


def main(command, file=None):
    if command.startswith("freeze"):
        freeze_fits() if command == "freeze-fits" else freeze(load_jaco())
        return
    with tempfile.TemporaryDirectory() as folder:
        found = all_rollouts(FitStore(Path(folder)), load_jaco())
    if command == "write":
        np.savez_compressed(file, **found)
        return
    with np.load(file) as before:
        assert set(before.files) == set(found)
        off = {name: float(np.abs(before[name] - path).max(initial=0)) for name, path in found.items()}
    print(*(f"\n{name}: {by:.1e}" for name, by in sorted(off.items(), key=lambda item: -item[1])[:20]))


if __name__ == "__main__":
    main(*sys.argv[1:])
