"""The command line of the measurements: one command for each file of this folder that measures something."""

from __future__ import annotations

import os
import sys
from collections.abc import Mapping, Sequence
from importlib import import_module
from pathlib import Path

from dt_viz.arguments import Parser
from dt_viz.evaluate import THREADS

BAD_INPUT = 2
"""Exit status for what the user can put right; argparse uses the same."""
COMMANDS = ("imitation", "around", "reactive", "table1", "train", "load")
FORMER: Mapping[str, tuple[str, ...]] = {
    "avoidance": ("around", "--space", "task"),
    "places": ("around",),
    "hand": ("around", "--space", "task"),
}
"""Former names of commands, and the arguments that they stand for."""
MOVED: Mapping[str, str] = {
    **{name: name for name in ("arms", "drag", "latency", "pictures", "scenes")},
    **dict.fromkeys(("rollouts", "starts", "velocity"), "exactness"),
}
"""Former commands that are for developers now, and the benchmark that each belongs to."""


def main(arguments: Sequence[str] | None = None, prog: str = "python -m dt_viz.evaluate") -> int:
    """Run one command; returns the process' exit status, or raises SystemExit where argparse does."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if given and given[0] in MOVED:
        benchmark = MOVED[given[0]]
        print(f"{prog}: {given[0]} is now, in a checkout: python -m tests.benchmarks {benchmark}", file=sys.stderr)
        return BAD_INPUT
    if given and given[0] in FORMER:
        stands_for = FORMER[given[0]]
        print(f"{prog}: {given[0]} is now: {' '.join(stands_for)}", file=sys.stderr)
        given[:1] = stands_for
    return run_command("dt_viz.evaluate", COMMANDS, given, prog)


def run_command(package: str, commands: Sequence[str], arguments: Sequence[str], prog: str) -> int:
    """Run one of the commands that modules of a package define; returns the exit status.

    Args:
        package: full name of the package.
        commands: names of its modules, each with `add_arguments`, `run`, a summary in its docstring, and in `OUT` what
            `--out` has to be, see `ready_to_write`; without that it has no such option, or one of its own.
        arguments: name and options of the command.
        prog: name of the program in messages.
    """
    # before numpy is imported; one thread is how the figures compare
    for variable in THREADS:
        os.environ.setdefault(variable, "1")
    from dt_viz.errors import DataError, FormatError  # noqa: PLC0415
    from dt_viz.evaluate.options import (  # noqa: PLC0415
        PRINTED,
        TABLES,
        ready_to_write,
        with_negative_values,
        write_tables,
    )
    from dt_viz.learning.imitation import ImitationError  # noqa: PLC0415

    parser = Parser(prog=prog, description="Measure DT-Viz.")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for name in commands:
        module = import_module(f"{package}.{name}")
        summary = (module.__doc__ or "").splitlines()[0]
        subparser = subparsers.add_parser(name, help=summary, description=summary)
        module.add_arguments(subparser)
        out = getattr(module, "OUT", None)
        if out is not None and out != TABLES:
            subparser.add_argument("--out", type=Path, required=True, metavar=out, help="what is written")
        names = ("--tables",) if out != TABLES else ("--out", "--tables")
        subparser.add_argument(*names, type=Path, dest="tables", metavar="FILE.json", help="also write what is printed")
        subparser.set_defaults(run=module.run, form=out)
    options = parser.parse_args(with_negative_values(arguments))
    PRINTED.clear()
    try:
        if options.form not in (None, TABLES):
            ready_to_write(options.out, options.form)
        tables = None if options.tables is None else ready_to_write(options.tables, "FILE.json")
        status = options.run(options)
        if tables is not None:
            write_tables(tables)
        return status
    except (DataError, ImitationError, FormatError) as error:
        print(f"{prog} {options.command}: {error}", file=sys.stderr)
        return BAD_INPUT


if __name__ == "__main__":
    raise SystemExit(main())
