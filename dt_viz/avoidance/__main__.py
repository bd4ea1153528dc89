"""Compile all kernels that a drag calls, for a server; ends with the server. Prints the fraction done, line by line."""

import os
import sys
import threading

from dt_viz.avoidance.arm import WholeArm
from dt_viz.robot.models import load_jaco


def _end_with_server() -> None:
    sys.stdin.read()  # until the server ends
    os._exit(1)


def main() -> None:
    """Compile."""
    threading.Thread(target=_end_with_server, daemon=True).start()
    for fraction in WholeArm(load_jaco()).compiled():
        print(fraction, flush=True)


if __name__ == "__main__":
    main()
