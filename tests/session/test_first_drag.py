"""What a drag calls is compiled before the first visitor comes: a first drag does not stand still for seconds.

As a program it loads what is compiled, drags an obstacle, and prints the kernels that had to be compiled.
"""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from numba.core.registry import CPUDispatcher

from dt_viz.evaluate.options import engine_of
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.stack import with_avoidance
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.page import initial
from dt_viz.ui.scene.tubes import NUM_SIDES, middles_of, tubes


def compiled() -> set[tuple[str, str]]:
    """Names of all kernels that have been called, with the types of their arguments."""
    modules = [module for name, module in sys.modules.items() if name.startswith("dt_viz.kernels.")]
    kernels = {kernel for module in modules for kernel in vars(module).values() if isinstance(kernel, CPUDispatcher)}
    return {(kernel.py_func.__qualname__, str(types)) for kernel in kernels for types in kernel.signatures}


def drag(engine, scenario, num) -> None:
    """Show a scenario, then drag its obstacle while the arm moves."""
    place = np.array(scenario.obstacles[0].position)
    for k in range(num):
        obstacle = Sphere(as_point(place + k * np.array([0.004, 0.002, 0.0])), 0.12)
        scenario = replace(scenario, stack=with_avoidance(scenario, obstacles=(obstacle,)))
        engine.see(scenario)
        for _ in range(2):
            engine.arm.advance(0.05, moves=True)
        for _, frame in zip(range(2 if k else 3), engine.frames(scenario), strict=False):
            engine.drive(frame)
            tubes(middles_of([path for path in frame.rollouts if len(path)]), 3e-3, 7e-3, NUM_SIDES)


@pytest.mark.long
def test_nothing_is_compiled_in_the_first_drag():
    done = subprocess.run([sys.executable, __file__], capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("[]", "")


if __name__ == "__main__":
    its_engine = engine_of(TASKS["draw_s"]())
    for _ in its_engine.follower.whole_arm.compiled():
        pass
    before = compiled()
    drag(its_engine, initial(its_engine.task("draw_s")), 20)
    print(sorted({name for name, _ in compiled() - before}))
