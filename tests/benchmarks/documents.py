"""Put the tables of a sitting into the documents.

    python -m tests.benchmarks --out DIR --lasa DIR && python -m tests.benchmarks documents DIR

In a document, the table after `<!-- measured: NAME -->` is made from rows that the sitting has written to DIR. They are
then kept beside this module, so that a test tells a document that was changed.
"""

from __future__ import annotations

import argparse
import json
import re
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, starmap
from pathlib import Path
from typing import Any

from dt_viz.evaluate.options import as_text

KEPT = Path(__file__).parent / "measured"
"""Folder of the rows from which the documents' tables are made, a file for each subject."""
ROOT = Path(__file__).parents[2]
DOCUMENTS = (ROOT / "README.md", ROOT / "dt_viz" / "evaluate" / "README.md")
Row = Mapping[str, Any]
Result = tuple[str, Sequence[Row]]  # A command with its options, and the rows that it has printed
Cell = tuple[str, str, str]  # row and column of a document's table, and the text of that cell
LOAD = (
    "first picture s",
    "pictures/s of each",
    "gap ms, median / 95 % / worst",
    "edit → picture ms",
    "edits answered in 0.5 s %",
    "ping ms",
    "cores",
    "MB",
)
"""Columns of `load` that a document shows."""


def _load(command: str, rows: Sequence[Row]) -> Iterator[Cell]:
    kinds = {"--lecture": ", lecture", "--rest": " who look on", "--present": " who watch one more"}
    kind = next((kind for option, kind in kinds.items() if option in command), "")
    for row in rows:
        for column in LOAD:
            yield row["visitors"] + kind, column, as_text(row[column])


def _table1(_command: str, rows: Sequence[Row]) -> Iterator[Cell]:
    for row in rows:
        columns = ("frechet", "arm_depth", "hand_depth", "turn °", "reached %", "seconds s")
        yield row["method"], row["task"], "; ".join(row[column] for column in columns)


def _reactive(command: str, rows: Sequence[Row]) -> Iterator[Cell]:
    for row in rows:
        columns = ("without contact", "clearance mm", "time lost s", "tick ms")
        yield _crossing(command), _option(command, "task"), "; ".join(row[column] for column in columns)


def _crossing(command: str) -> str:
    others = ", two spheres" * ("--obstacles 2" in command) + ", box" * ("--boxes" in command)
    return f"{_option(command, 'speed')} m/s{others}"


def _imitation(command: str, rows: Sequence[Row]) -> Iterator[Cell]:
    state = "plain, by velocities" if "--objective velocity" in command else _option(command, "state", "plain")
    for row in rows:
        if row["name"] != "mean":
            continue
        if "learned_mm" not in row:
            figure = "{frechet_mean_mm:.2f}, {frechet_max_mm:.2f}".format(**row)
            yield "in-sample, and the worst of each file", state, figure
            continue
        for measure, suffix in {"held out": "", "held out, RMS at equal times": "_rms"}.items():
            yield measure, state, f"{row[f'learned{suffix}_mm']:.2f}"
            yield measure, "shifted mean of the others", f"{row[f'mean{suffix}_mm']:.2f}"
            yield measure, "nearest start, shifted", f"{row[f'nearest{suffix}_mm']:.2f}"


def _around(command: str, rows: Sequence[Row]) -> Iterator[Cell]:
    found = {row["figure"]: row["value"].partition(" (")[0] for row in rows if "figure" in row}
    figures = ("blocked between free ends", "from some of the starts only", "collisions", "at least 9 mm kept")
    places = re.sub(r"around --task \S+ ", "", _short(command))
    yield f"`{places}`", _option(command, "task"), "; ".join(found[name] for name in figures)


def _click(rows: Sequence[Row]) -> str:
    median, worst = (row["certified_s"] for row in rows[-2:])
    return f"click → certified {median:.2f} s, at most {worst:.1f} s"


def _gaps(rows: Sequence[Row]) -> str:
    return "; ".join("{processes}, {beside one who}: {× median:.1f}, {× 95 %:.1f}".format(**row) for row in rows)


def _shape_errors(rows: Sequence[Row]) -> str:
    return "shape error {shape error at 25%:.3f}, {shape error at 50%:.3f}; drawn {drawn after a push:.2f}".format(
        **rows[0]
    )


def _of_load(results: Sequence[Result]) -> Iterator[Cell]:
    command, rows = results[0]
    measured = "pictures a second for each of 1, 4, 8 visitors who drag a sphere before the whole arm, two processes"
    yield from _summed_up(measured, "; ".join(row["pictures/s of each"] for row in rows), command)


def _of_imitation(results: Sequence[Result]) -> Iterator[Cell]:
    figures: dict[str, float] = {}
    for command, rows in results:
        for row in rows:
            if row["name"] == "mean" and "learned_mm" in row:
                figures[_option(command, "state", "plain")] = row["learned_mm"]
                figures["the others' shifted mean"] = row["mean_mm"]
    text = ", ".join(f"{name} {figure:.2f}" for name, figure in figures.items())
    measured = "Fréchet distance of held-out demonstrations, 17 LASA files, states and what needs no learning"
    yield from _summed_up(measured, f"{text} mm", results[0][0])


def _of_table1(results: Sequence[Result]) -> Iterator[Cell]:
    command, rows = results[0]
    for method in ("Ours", "EFlow (repulsive)"):
        cells = [(row["frechet"], row["arm_depth"]) for row in rows if row["method"] == method]
        distances, depths = (
            ", ".join(cell.partition(" ")[0] for cell in column) for column in zip(*cells, strict=True)
        )
        measured = f"Fréchet distance around a 15 cm sphere, push, lift, draw S; depth of the arm in it: {method}"
        yield from _summed_up(measured, f"{distances}; {depths} mm", command)


def _of_latency(results: Sequence[Result]) -> Iterator[Cell]:
    figures: dict[str, list[str]] = {}
    for command, rows in results:
        text = "{median ms:.0f} / {p95 ms:.0f} ms, {in units:.1f} units".format(**rows[1])
        others = re.sub(r"--task \S+", "--task …", _short(command))
        figures.setdefault(f"`{others}`", []).append(f"{_option(command, 'task')} {text}")
    for row, texts in figures.items():
        yield row, "figure", "; ".join(texts)


def _of_reactive(results: Sequence[Result]) -> Iterator[Cell]:
    passages: dict[str, list[list[int]]] = {}
    for command, rows in results:
        for row in rows:
            passages.setdefault(_crossing(command), []).append(
                [int(number) for number in row["without contact"].split(" of ")]
            )
    figures = (
        "{} of {} at {}".format(*map(sum, zip(*found, strict=True)), crossing) for crossing, found in passages.items()
    )
    yield from _summed_up(
        "a sphere crosses the robot's way: passages without contact (the command is that of one task and speed)",
        "; ".join(figures),
        results[0][0],
    )


def _summed_up(measured: str, figure: str, command: str) -> Iterator[Cell]:
    yield measured, "figure", figure
    called = re.sub(r"^(?:python -m dt_viz\.evaluate|(python -m \S+)) .*", r"\1", command) or "dt-viz evaluate"
    yield measured, "command", f"`{called} {_short(command)} --out F{Path(command.rsplit(maxsplit=1)[-1]).suffix}`"


Table = Callable[[Sequence[Result]], Iterator[Cell]]


def _each(of_command: Callable[[str, Sequence[Row]], Iterator[Cell]]) -> Table:
    """What each of the commands says."""
    return lambda results: chain.from_iterable(starmap(of_command, results))


def _figure(text: Callable[[Sequence[Row]], str]) -> Table:
    """What each of the commands says in one column."""
    return _each(lambda command, rows: iter([(f"`{_short(command)}`", "figure", text(rows))]))


TABLES_OF: Mapping[str, Mapping[str, Table]] = {
    "summary": {"load": _of_load, "imitation": _of_imitation, "table1": _of_table1, "reactive": _of_reactive},
    "load": {"load": _each(_load)},
    "table1": {"table1": _each(_table1)},
    "reactive": {"reactive": _each(_reactive)},
    "imitation": {"imitation": _each(_imitation)},
    "around": {"around": _each(_around)},
    "developers": {
        "latency": _of_latency,
        "scenes": _figure(_click),
        "learning": _figure(_shape_errors),
        "fairness": _figure(_gaps),
    },
}
"""What the results of subjects are in the table of a document, by its name."""
CORNERS = {
    "summary": "measured",
    "imitation": "mm",
    "developers": "command",
    "table1": "method",
    "load": "visitors",
}
"""Headings of the first columns."""


def _option(command: str, name: str, default: str = "") -> str:
    """Value of an option of a command."""
    found = re.search(rf"--{name} (\S+)", command)
    return found[1] if found else default


def _short(command: str) -> str:
    """The command without its program, and where and on how many processors it computes."""
    return re.sub(r"^python -m \S+ | --jobs \d+| --out \S+$", "", command).replace("LASA", "LASA/*.mat")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("folder", type=Path, nargs="?", default=KEPT, metavar="DIR", help="what a sitting has written")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    if options.folder.resolve() != KEPT:
        shutil.copytree(options.folder, KEPT, ignore=shutil.ignore_patterns("arrays"), dirs_exist_ok=True)
    for document in DOCUMENTS:
        document.write_text(filled(document.read_text(encoding="utf-8")), encoding="utf-8")
    return 0


def filled(document: str) -> str:
    """Return a document with the tables of the rows that are kept."""

    def table(match: re.Match[str]) -> str:
        return f"{match[1]}\n\n{made(match[2])}"

    return re.sub(r"(<!-- measured: (\w+) -->)(?:\n\n\|.*(?:\n\|.*)*)?", table, document)


def made(name: str) -> str:
    """Return a document's table as Markdown."""
    cells: dict[str, dict[str, str]] = {}
    for subject, of_results in TABLES_OF[name].items():
        kept = json.loads((KEPT / f"{subject}.json").read_text(encoding="utf-8"))["results"]
        for row, column, text in of_results([(result["command"], result["rows"]) for result in kept]):
            cells.setdefault(row, {})[column] = text
    columns = list(dict.fromkeys(column for row in cells.values() for column in row))
    lines = [[CORNERS.get(name, ""), *columns], ["---"] * (len(columns) + 1)]
    lines += [[row, *(texts.get(column, "") for column in columns)] for row, texts in cells.items()]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)
