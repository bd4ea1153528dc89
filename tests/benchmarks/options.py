"""Options that benchmarks share."""

from __future__ import annotations

import argparse

from dt_viz.evaluate.options import output


def add_out(parser: argparse.ArgumentParser) -> None:
    """Define `--out` of a benchmark that writes nothing but the tables that it prints."""
    parser.add_argument("--out", type=output(".json"), dest="tables", metavar="FILE.json", help="the same as --tables")
