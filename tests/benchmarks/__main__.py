"""Measure for developers: one benchmark by its name, or without a name most figures of the documents in one sitting.

python -m tests.benchmarks latency --task draw_s --seconds 8 --out latency.json
python -m tests.benchmarks --out DIR [--lasa DIR] [--only TABLE ...]
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from dt_viz.evaluate.__main__ import run_command
from tests.benchmarks import sitting

NAMES = (
    "latency",
    "drag",
    "scenes",
    "arms",
    "exactness",
    "learning",
    "pictures",
    "fairness",
    "soak",
    "documents",
    "load",
)
PROG = "python -m tests.benchmarks"


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one benchmark, or all; returns the exit status, or raises SystemExit where argparse does."""
    given = list(sys.argv[1:] if arguments is None else arguments)
    if not given or given[0].startswith("--"):
        return sitting.main(given, PROG)
    return run_command("tests.benchmarks", NAMES, given, PROG)


if __name__ == "__main__":
    raise SystemExit(main())
