"""Compile what a drag repeats for a server, which waits; ends with the server. Prints the part done, line by line.

The argument `backwards` has it begin with the last kernel.
"""

import os
import sys
import threading

from dt_viz.avoidance.arm import WholeArm
from dt_viz.kernels.compiled import complete, wait_for_nobody
from dt_viz.robot.models import load_jaco


def _end_with_server() -> None:
    sys.stdin.read()  # it gets nothing
    os._exit(1)


def main() -> None:
    """Compile."""
    threading.Thread(target=_end_with_server, daemon=True).start()
    wait_for_nobody()
    for fraction in WholeArm(load_jaco()).compiled(backwards=sys.argv[1:] == ["backwards"]):
        print(fraction, flush=True)
    complete()


if __name__ == "__main__":
    main()
