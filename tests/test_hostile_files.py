"""Hostile files: whatever the bytes, all loaders end soon, in bounded memory, with what they hold or a clear error."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import pytest
from hostile import PROCESS, hostile_file, seeds

pytestmark = pytest.mark.skipif(not PROCESS.exists(), reason="memory is measured in Linux's way")

MAX_MEGABYTES = 500
"""Of the whole process, of which more than 100 are the libraries that it loads."""
MAX_SECONDS = 5
"""Of processor time, so that other work on the machine does not count."""


@dataclass(frozen=True)
class Outcome:
    message: str
    """Why the file was refused; empty if it was read."""
    seconds: float
    megabytes: float


class ReadingProcess:
    """The program that reads; see `hostile.py`."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process

    def read(self, kind: str, name: str, content: bytes) -> Outcome:
        """Have a file read. Fails the test if that ends the program."""
        assert self._process.stdin is not None and self._process.stdout is not None
        try:
            self._process.stdin.write(json.dumps([kind, name, len(content)]).encode() + b"\n" + content)
            self._process.stdin.flush()
        except BrokenPipeError:
            pass
        line = self._process.stdout.readline()
        assert line, (
            f"{kind} {name} of {len(content)} bytes ended the program: {self._process.communicate()[1].decode()}"
        )
        return Outcome(*json.loads(line))


@contextmanager
def reading(*arguments: str) -> Iterator[ReadingProcess]:
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(filter(None, sys.path)), "OMP_NUM_THREADS": "1"}
    environment["OPENBLAS_NUM_THREADS"] = "1"
    command = [sys.executable, "-W", "error", str(Path(__file__).with_name("hostile.py")), *arguments]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, env=environment, **pipes) as process:
        try:
            yield ReadingProcess(process)
        finally:
            process.kill()


def check(outcome: Outcome, name: str) -> None:
    if outcome.message:
        assert outcome.message.startswith(f"{name}: ")
        assert ": found " in outcome.message and "; accepted: " in outcome.message
        assert len(outcome.message) < 600
    assert outcome.megabytes < MAX_MEGABYTES
    assert outcome.seconds < MAX_SECONDS


def read_all(num: int, *arguments: str) -> None:
    slowest, largest, num_read = 0.0, 0.0, 0
    with reading(*arguments) as process:
        for number in range(num):
            kind, name, content = hostile_file(number)
            outcome = process.read(kind, name, content)
            check(outcome, name)
            if outcome.seconds > slowest or outcome.megabytes > largest:
                print(f"file {number}, {kind} {name}, {len(content)} bytes: {outcome}")
            slowest, largest = max(slowest, outcome.seconds), max(largest, outcome.megabytes)
            num_read += not outcome.message
    print(f"{num_read} of {num} were read; at most {slowest:.2f} s and {largest:.0f} MB")
    assert 0.02 * num < num_read < 0.9 * num  # the mutations are neither all fatal nor all harmless


def test_the_good_files_are_read():
    with reading("--coarse") as process:
        for kind, name, content, _ in seeds():
            assert process.read(kind, name, content).message == ""


def test_mutated_files_are_read_or_refused():
    read_all(210, "--coarse")


@pytest.mark.slow
def test_very_many_mutated_files_are_read_or_refused():
    read_all(3000)
