"""The documents: quick commands in them are run, the others are such as the programs take; `.ci/run` builds the site.

Code blocks in Python are run by `test_library.py` (that of the README) and `twirl.py` (those of `dt_viz/README.md`).
"""

import argparse
import re
import shlex
from pathlib import Path

import pytest

from assets import train_baselines
from dt_viz.cli import PROG, main
from dt_viz.evaluate.__main__ import COMMANDS
from dt_viz.evaluate.__main__ import main as evaluate
from tests.benchmarks import __main__ as benchmarks
from tests.benchmarks import documents as tables

ROOT = Path(__file__).parents[1]
PARTS = ("dt_viz", "assets", "docs")
DOCUMENTS = [*ROOT.glob("*.md"), *(page for part in PARTS for page in ROOT.glob(f"{part}/**/*.md"))]
PROGRAMS = {f"{PROG} ": main, f"{benchmarks.PROG} ": benchmarks.main, f"{train_baselines.PROG} ": train_baselines.main}
MEASUREMENTS = dict.fromkeys(COMMANDS, evaluate) | dict.fromkeys(benchmarks.NAMES, benchmarks.main)
"""Programs whose names the tables of measurements leave out, by the name of what is measured."""
QUICK = re.compile(r"picture [\w-]+ --out \S+\.(svg|pdf|html)")
"""Arguments of the commands that are run: they take seconds and need no browser.

The others serve until they are stopped, render by a browser, measure for minutes, or read files that are not there.
"""


class Parsed(Exception):
    """What a program was called with has been understood."""


def commands(text):
    """The commands in code blocks and in lines, without comments, without those that stand for others or are a name."""
    blocks = re.findall(r"^(?: {4}|\t)(.+)$", text, re.MULTILINE)
    spans = re.findall(r"`([^`\n]+)`", text)
    for command in (part.strip() for code in (*blocks, *spans) for part in code.partition(" #")[0].split("&&")):
        if re.search(r"[…|]|NAME", command):
            continue
        for program, run in PROGRAMS.items():
            if command.startswith(program):
                yield run, shlex.split(command[len(program) :])
        name, _, _ = command.partition(" ")
        if name in MEASUREMENTS and " --" in command:
            yield MEASUREMENTS[name], shlex.split(command)


TOLD = [command for document in DOCUMENTS for command in commands(document.read_text(encoding="utf-8"))]
"""Those of all documents: programs and their arguments."""
RUN = [shlex.join(arguments) for run, arguments in TOLD if run is main and QUICK.fullmatch(shlex.join(arguments))]


def test_programs_take_the_commands_of_the_documents(monkeypatch):
    parse = argparse.ArgumentParser.parse_args

    def parse_only(parser, arguments=None, namespace=None):
        parse(parser, arguments, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    for run, arguments in TOLD:
        expected = SystemExit if "--help" in arguments else Parsed
        with pytest.raises(expected) as ended:
            run(arguments)
        assert getattr(ended.value, "code", 0) in {0, None}, arguments
    assert len(TOLD) > 30 and len(RUN) > 1


@pytest.mark.parametrize("document", tables.DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_the_tables_of_a_document_are_those_of_the_sitting_that_is_kept(document):
    text = document.read_text(encoding="utf-8")
    assert text == tables.filled(text)


@pytest.mark.long
@pytest.mark.parametrize("command", RUN)
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of matplotlib's own parts
@pytest.mark.usefixtures("fits")
def test_quick_commands_make_what_they_say(command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(shlex.split(command)) == 0
    (made,) = tmp_path.iterdir()
    assert command.endswith(f" --out {made.name}") and made.stat().st_size > 10_000
