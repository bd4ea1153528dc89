"""Most figures of the documents in one sitting, some with fewer runs: a table for each subject, as JSON.

Each command runs in a process of its own; what it prints as tables is put together, and what it writes is kept beside.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from dt_viz.arguments import Parser
from dt_viz.evaluate.__main__ import COMMANDS

LASA = "LASA"  # word in a command that stands for the files of `--lasa`


@dataclass(frozen=True)
class Subject:
    """What one dated table is of."""

    title: str
    commands: tuple[str, ...]  # each of `dt_viz.evaluate` or `tests.benchmarks`, without `--out`
    suffix: str  # suffix of what the commands write; empty where it is a folder
    num_rows: int = 0  # number of the last rows of a command's tables that are wanted; 0 for all


def _for_tasks(command: str, tasks: Sequence[str] = ("push_box", "lift_box", "draw_s")) -> tuple[str, ...]:
    return tuple(command.format(task) for task in tasks)


SUBJECTS: Mapping[str, Subject] = {
    "latency": Subject(
        "A drag: edit → frame ready",
        (
            *_for_tasks("latency --task {} --seconds 8"),
            "latency --task draw_s --obstacles 3 --seconds 8",
            "latency --task draw_s --drag bias --seconds 8",
            "latency --task draw_s --space task --seconds 8",
        ),
        ".json",
    ),
    "load": Subject(
        "Visitors at once",
        (
            "load --visitors 1 4 8 --seconds 20",
            "load --visitors 40 --lecture --after 40 --seconds 20",
            "load --rest --visitors 4 --seconds 15 --after 10",
            "load --present --visitors 50 --seconds 10 --after 8",
        ),
        ".json",
    ),
    "fairness": Subject("Beside somebody who takes all that he can get", ("fairness --rounds 2",), ".json"),
    "scenes": Subject("Scenes of the paper", ("scenes",), ".json"),
    "reactive": Subject(
        "The robot in the loop",
        (
            *_for_tasks("reactive --task {} --speed 0.2 --runs 10 --seed 201 --jobs 2"),
            *_for_tasks("reactive --task {} --speed 0.5 --runs 20 --seed 201 --jobs 2"),
            *_for_tasks("reactive --task {} --speed 1.0 --runs 20 --seed 901 --jobs 2"),
            *_for_tasks("reactive --task {} --speed 1.0 --runs 20 --obstacles 2 --seed 102 --jobs 2"),
            *_for_tasks("reactive --task {} --speed 1.0 --runs 20 --boxes --seed 103 --jobs 2"),
        ),
        ".npz",
    ),
    "imitation": Subject(
        "Learning",
        (
            "imitation LASA --leave-one-out --jobs 2",
            "imitation LASA --state augmented --leave-one-out --jobs 2",
            "imitation LASA --state auto --leave-one-out --jobs 2",
            "imitation LASA --objective velocity --jobs 2",
        ),
        "",
    ),
    "learning": Subject("Off the demonstrations", ("learning LASA", "learning LASA --state augmented"), ".json", 3),
    "around": Subject(
        "Avoidance",
        (
            *_for_tasks("around --task {} --count 20 --seed 0 --jobs 2"),
            *_for_tasks("around --task {} --count 11 --along 0,1 --shape any --size 0.06,0.25 --seed 2 --jobs 2"),
            *_for_tasks(
                "around --task {} --count 6 --along 0,1 --shape any --size 0.06,0.25 --number 2 --seed 7 --jobs 2"
            ),
            *_for_tasks("around --task {} --count 20 --along 0,1 --shape any --size 0.06,0.25 --seed 2 --space task"),
        ),
        ".npz",
        11,
    ),
    "table1": Subject("The paper's comparison", ("table1 --perturbed 60 --jobs 2",), ""),
}


def main(arguments: Sequence[str], prog: str) -> int:
    """Measure subjects; returns 1 if one of the commands failed."""
    parser = Parser(prog=prog, description="Measure most figures of the documents.")
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder for the tables")
    parser.add_argument("--only", nargs="+", choices=tuple(SUBJECTS), default=list(SUBJECTS), help="(default: all)")
    parser.add_argument(
        "--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files; without it these are left out"
    )
    options = parser.parse_args(arguments)
    files = [] if options.lasa is None else sorted(options.lasa.glob("*.mat"))
    statuses = [measured(name, SUBJECTS[name], options.out, files) for name in options.only]
    return max(statuses)


def measured(name: str, subject: Subject, out: Path, files: Sequence[Path]) -> int:
    """Run the commands of a subject, and write its table; returns 1 if one of them failed.

    Args:
        name: of the subject's files.
        subject: what is measured.
        out: folder for the table.
        files: LASA files; a command on them is left out where there are none.
    """
    results, began = [], time.monotonic()
    for k, command in enumerate(subject.commands):
        words = command.split()
        if LASA in words and not files:
            continue
        written = out / "arrays" / f"{name}-{k}{subject.suffix}"
        result = ran([part for word in words for part in (map(str, files) if word == LASA else [word])], written)
        result["command"] = f"python -m {package_of(words[0])} {command} --out {written.name}"
        result["rows"] = [row for table in result.pop("tables") for row in table][-subject.num_rows :]
        results.append(result)
        print(f"{result['command']}: {result['seconds']:.0f} s", flush=True)
    if not results:
        return 0
    machine = {"cores": os.cpu_count(), "machine": platform.machine(), "python": platform.python_version()}
    table = {"title": subject.title, "date": date.today().isoformat(), **machine, "results": results}
    path = out / f"{name}.json"
    path.write_text(json.dumps(table, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    print(f"{path} after {time.monotonic() - began:.0f} s", flush=True)
    return int(any(result["status"] for result in results))


def package_of(name: str) -> str:
    """Package whose `__main__` runs a command of this name."""
    return "dt_viz.evaluate" if name in COMMANDS else "tests.benchmarks"


def ran(words: Sequence[str], out: Path) -> dict[str, Any]:
    """Run a command, its name and options, in a process of its own.

    Returns:
        Its exit ``status``, the ``seconds`` that it took, and the ``tables`` that it printed, lists of rows.
    """
    tables = out.with_name(f"{out.stem}-tables.json")
    tables.parent.mkdir(parents=True, exist_ok=True)
    tables.unlink(missing_ok=True)
    began = time.monotonic()
    program = [sys.executable, "-m", package_of(words[0]), *words, "--out", str(out), "--tables", str(tables)]
    done = subprocess.run(program, stdout=subprocess.DEVNULL, check=False)
    text = tables.read_text(encoding="utf-8") if tables.exists() else ""
    tables.unlink(missing_ok=True)
    return {
        "status": done.returncode,
        "seconds": time.monotonic() - began,
        "tables": json.loads(text)["tables"] if text else [],
    }
