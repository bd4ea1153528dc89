"""The documents: every command in them is one that the programs take. `.ci/run` builds the site from them."""

import argparse
import re
import shlex
from pathlib import Path

import pytest

from dt_viz.cli import PROG, main
from tests.benchmarks import __main__ as benchmarks

ROOT = Path(__file__).parents[1]
PARTS = ("dt_viz", "assets", "docs")
DOCUMENTS = [*ROOT.glob("*.md"), *(page for part in PARTS for page in ROOT.glob(f"{part}/**/*.md"))]
PROGRAMS = {f"{PROG} ": main, f"{benchmarks.PROG} ": benchmarks.main}


class Parsed(Exception):
    """What a program was called with has been understood."""


def commands(text):
    """The commands in code blocks and in lines, without comments, without those that stand for others or are a name."""
    blocks = re.findall(r"^(?: {4}|\t)(.+)$", text, re.MULTILINE)
    spans = re.findall(r"`([^`\n]+)`", text)
    for command in (part.strip() for code in (*blocks, *spans) for part in code.partition(" #")[0].split("&&")):
        for program, run in PROGRAMS.items():
            if command.startswith(program) and not re.search(r"[…|]|NAME", command):
                yield run, shlex.split(command[len(program) :])


def test_programs_take_the_commands_of_the_documents(monkeypatch):
    parse, taken = argparse.ArgumentParser.parse_args, []

    def parse_only(parser, arguments=None, namespace=None):
        parse(parser, arguments, namespace)
        raise Parsed

    monkeypatch.setattr(argparse.ArgumentParser, "parse_args", parse_only)
    for document in DOCUMENTS:
        for run, arguments in commands(document.read_text(encoding="utf-8")):
            expected = SystemExit if "--help" in arguments else Parsed
            with pytest.raises(expected) as ended:
                run(arguments)
            assert getattr(ended.value, "code", 0) in {0, None}, (document, arguments)
            taken.append(arguments)
    assert len(taken) > 15


@pytest.mark.parametrize("command", ["dt-viz --no-such-option", "dt-viz --arm", "dt-viz picture fig-4"])
def test_a_command_that_is_wrong_is_noticed(command):
    ((run, arguments),) = commands(f"    {command}   # as it was called once")
    with pytest.raises(SystemExit) as ended:
        run(arguments)
    assert ended.value.code == 2
