"""The command line of the measurements: one command for each file of this folder that measures something."""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module

from dt_viz.arguments import Parser

BAD_INPUT = 2  # exit status for what the user can put right, as argparse's
COMMANDS = ("imitation", "around", "reactive", "table1")
DEVELOPERS = ("arms", "drag", "latency", "load", "pictures", "scenes")
MOVED: Mapping[str, str] = {
    **{name: f"found in a checkout as python -m tests.benchmarks {name}" for name in DEVELOPERS},
    **dict.fromkeys(("rollouts", "starts"), "found in a checkout as python -m tests.benchmarks exactness"),
    "train": "found in a checkout as python -m assets.train_baselines",
    **dict.fromkeys(("avoidance", "hand"), "found as dt-viz evaluate around --space task"),
    "places": "found as dt-viz evaluate around",
}  # former commands, and where they are now


def main(arguments: Sequence[str] | None = None, prog: str = "python -m dt_viz.evaluate") -> int:
    """Run one command; returns the process' exit status, or raises SystemExit where argparse does."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in MOVED:
        print(f"{prog} {given[0]}: {MOVED[given[0]]}", file=sys.stderr)
        return BAD_INPUT
    return run_command("dt_viz.evaluate", COMMANDS, given, prog)


def run_command(package: str, commands: Sequence[str], arguments: Sequence[str], prog: str) -> int:
    """Run one of the commands of a package; returns the exit status.

    Each is a module with `add_arguments`, `run`, and a summary in its docstring; `prog` names the program in messages.
    """
    # numerical libraries read these when they are first imported; one thread is how the figures compare
    for variable in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    from dt_viz.errors import DataError, FormatError  # noqa: PLC0415
    from dt_viz.evaluate.options import PRINTED, output, write_tables  # noqa: PLC0415
    from dt_viz.learning.imitation import ImitationError  # noqa: PLC0415

    parser = Parser(prog=prog, description="Measure DT-Viz.")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in commands:
        module = import_module(f"{package}.{name}")
        summary = (module.__doc__ or "").splitlines()[0]
        subparser = subparsers.add_parser(name, help=summary, description=summary)
        module.add_arguments(subparser)
        tables = "also write the tables that are printed"
        subparser.add_argument("--tables", type=output(".json"), metavar="FILE.json", help=tables)
        subparser.set_defaults(run=module.run)
    # a value such as -0.1,-0.5,0.4 is no option
    options = parser.parse_args([re.sub(r"^-(?=[\d.])", " -", argument) for argument in arguments])
    PRINTED.clear()
    try:
        status = options.run(options)
        if options.tables is not None:
            write_tables(options.tables)
        return status
    except (DataError, ImitationError, FormatError) as error:
        print(f"{prog} {options.command}: {error}", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
