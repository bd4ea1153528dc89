"""Arms made in a process of their own: covering one with spheres takes seconds, in which a server has others to serve.

The process stores the arm in the user's cache folder, from where it is loaded. It writes lines of JSON: the fraction
that is done and what is going on, and at the end nothing, or the four parts of a `DataError`.
"""

from __future__ import annotations

import json
import subprocess
import sys
import threading
from contextlib import suppress

from dt_viz.errors import DataError
from dt_viz.files.processes import stand_back, start_module
from dt_viz.robot.models import NotStoredError, Progress, load_arm
from dt_viz.robot.robot import Robot
from dt_viz.robot.urdf import ArmError

LOOK = 0.2  # time after which somebody who waits is asked again whether the arm is wanted, seconds
_one_arm = threading.Lock()  # lock of those who make an arm: one at a time


def load_aside(name: str, progress: Progress) -> Robot:
    """Load an arm as `load_arm`; one that is new is made in a process of its own, with low priority.

    `progress` is also called without news, and may raise an exception to cancel.

    Raises:
        ArmError: There is no such arm, or its description cannot be used.
        FileNotFoundError: The package example-robot-data is not installed, or its version has no such file.
    """
    with suppress(NotStoredError):
        return load_arm(name, progress, stored=True)
    while not _one_arm.acquire(timeout=LOOK):
        progress(0.0, "waits for another arm, which is being made")
    try:
        _make(name, progress)
    finally:
        _one_arm.release()
    return load_arm(name, progress)


def _make(name: str, progress: Progress) -> None:
    """Have a process make an arm and store it. Raises ArmError if that refuses it, or ends by something else."""
    process, told = start_module(__name__, name, output=subprocess.PIPE), [0.0, "starting"]
    pipe = process.stdout
    assert pipe is not None

    def listen() -> None:
        with suppress(ValueError):  # something else than JSON
            for line in pipe:
                told[:] = json.loads(line)

    listening = threading.Thread(target=listen, name="making", daemon=True)
    listening.start()
    try:
        while listening.is_alive():
            progress(*told)
            listening.join(LOOK)
        process.wait()
    finally:
        process.kill()
        listening.join()
        pipe.close()
        process.wait()
    if len(told) == len(ArmError("", "", "", "").args):
        raise ArmError(*told)
    if process.returncode:
        raise ArmError(name, "files", f"something that ended their reader ({process.returncode})", "whole files")


def main() -> None:
    """Make the arm of the name on the command line."""
    stand_back()

    def tell(*told: object) -> None:
        print(json.dumps(told), flush=True)

    try:
        load_arm(sys.argv[1], tell)
    except DataError as error:
        tell(*error.args)


if __name__ == "__main__":
    main()
