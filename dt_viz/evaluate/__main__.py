"""The command line of the measurements: one subcommand for each file of this folder that measures something."""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Sequence

BAD_INPUT = 2
"""Exit status for what the user can put right; argparse uses the same."""


def main(arguments: Sequence[str] | None = None, prog: str = "python -m dt_viz.evaluate") -> int:
    """Run one subcommand; returns the process' exit status, or raises SystemExit where argparse does."""
    # numerical libraries read these when they are first imported; one thread is how the figures compare
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from dt_viz.errors import DataError  # noqa: PLC0415
    from dt_viz.evaluate import (  # noqa: PLC0415
        avoidance,
        drag,
        imitation,
        latency,
        load,
        pictures,
        places,
        reactive,
        rollouts,
        scenes,
        starts,
        table1,
        train,
        velocity,
    )
    from dt_viz.evaluate.options import InputError, with_negative_values  # noqa: PLC0415
    from dt_viz.learning.imitation import ImitationError  # noqa: PLC0415

    parser = argparse.ArgumentParser(prog=prog, description="Measure DT-Viz.")
    subcommands = parser.add_subparsers(dest="subcommand", metavar="SUBCOMMAND", required=True)
    for name, module in {
        "imitation": imitation,
        "latency": latency,
        "load": load,
        "avoidance": avoidance,
        "drag": drag,
        "pictures": pictures,
        "places": places,
        "reactive": reactive,
        "rollouts": rollouts,
        "scenes": scenes,
        "starts": starts,
        "table1": table1,
        "train": train,
        "velocity": velocity,
    }.items():
        summary = (module.__doc__ or "").splitlines()[0]
        subcommand = subcommands.add_parser(name, help=summary, description=summary)
        module.add_arguments(subcommand)
        subcommand.set_defaults(run=module.run)
    options = parser.parse_args(with_negative_values(sys.argv[1:] if arguments is None else arguments))
    try:
        return options.run(options)
    except (DataError, ImitationError, InputError) as error:
        print(f"{prog} {options.subcommand}: {error}", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
