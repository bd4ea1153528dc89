"""Have visitors edit at random for long, kill processes of the server meanwhile, and say what was lost.

    python -m tests.benchmarks soak --visitors 4 --kills 40 --seconds 600 --out soak.json

A visitor makes one edit after the other: mostly he drags the obstacle, sometimes he chooses another task or what gives
way. When his connection is lost he comes again, as a page does, with what his browser has kept. Then the task, what
gives way and the place of the obstacle are compared with all that he had, back from the last one:

back s
    from the loss to the first picture with something that he has had, of the page that has opened again.
edits lost
    number of times that not even the edit before the last one was found again whole.

Exit status 1: an edit was lost, a visitor did not come back, a connection was lost though no process was killed, or the
log has an error.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import random
import re
import signal
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import websockets

from dt_viz.evaluate.options import positive_number, report, whole_number
from dt_viz.flows.fields import Array
from tests.benchmarks.load import started, used
from tests.benchmarks.options import add_out
from tests.benchmarks.visit import spread
from tests.protocol_client import ANSWERED, OBSTACLE, LostError, ProtocolClient

State = tuple[str, str, tuple[float, ...]]  # task, what gives way, and place of the first obstacle, metres


@dataclass(frozen=True)
class SoakSettings:
    """How visitors edit; times in seconds."""

    moves: tuple[int, int] = (5, 40)  # smallest and largest number of places of a drag
    interval: float = 0.05  # time from one place to the next
    step: float = 0.004  # standard deviation of the way from one place to the next along each axis, metres
    rest: tuple[float, float] = (0.2, 1.5)  # shortest and longest time from one edit to the next
    choices: float = 0.15  # part of the edits that choose something
    settled: float = 5.0  # time after which the page has what was chosen
    recent: float = 5.0  # time after a kill in which a lost connection is its consequence
    told: float = 10.0  # time in which a slow browser answers what it keeps, while its page shows how it begins
    patience: float = 60.0  # longest time to wait for a page
    first_kill: float = 10.0  # time until all are there
    sample: float = 2.0  # time from one look at the memory to the next


SETTINGS = SoakSettings()


@dataclass
class Soaked:
    """One who edits, and what became of it."""

    url: str
    seed: int
    killed: Callable[[], float]  # returns when a process was killed last, seconds of `time.monotonic`
    had: list[tuple[float, int, State | None]] = field(default_factory=list)
    """Times, numbers of the edits, and states; None while it is unknown."""
    back: list[float] = field(default_factory=list)  # times from a loss to the page that has opened again, seconds
    num_edits: int = 0
    num_lost: int = 0  # number of edits before the last that were not found again
    reasons: list[str] = field(default_factory=list)  # what ended connections beside kills, and pages that did not open

    async def run(self, deadline: float) -> None:
        """Edit until a time of `time.monotonic`."""
        generator, storage, lost = random.Random(self.seed), dict[str, str](), 0.0
        while time.monotonic() < deadline:
            try:
                async with ProtocolClient(self.url) as client:
                    client.storage = storage
                    if not await client.look_until_drawn(SETTINGS.patience):
                        self.reasons.append("no picture in time")
                        return
                    if lost:
                        opened = time.monotonic()
                        known = await client.wait_for(lambda client=client: self.knows(state_of(client)), SETTINGS.told)
                        self.back.append((time.monotonic() if known else opened) - lost)
                        self.compare(state_of(client), lost)
                        lost = 0.0
                    self.had = [(time.monotonic(), self.num_edits, state_of(client))]
                    while time.monotonic() < deadline:
                        await self._edit(client, generator)
            except (LostError, OSError, websockets.InvalidHandshake) as error:
                now = time.monotonic()
                if now - self.killed() > SETTINGS.recent and not lost:
                    self.reasons.append(str(error) or type(error).__name__)
                lost = lost or min(now, max(self.killed(), now - SETTINGS.recent))
                await asyncio.sleep(0.1)
            else:
                return

    async def _edit(self, client: ProtocolClient, generator: random.Random) -> None:
        self.num_edits += 1
        if generator.random() < SETTINGS.choices:
            label = generator.choice(("Task", "Avoid"))
            self._has(None)
            await client.set(label, generator.choice(client.controls[client.find(label)]["options"]))
            await _rest(client, SETTINGS.settled)
            self._has(state_of(client))
        else:
            await self._drag(client, generator)
        await _rest(client, generator.uniform(*SETTINGS.rest))

    async def _drag(self, client: ProtocolClient, generator: random.Random) -> None:
        task, avoid, place = state_of(client)
        if self.had[-1][2] is not None:
            place = self.had[-1][2][2]
        await client.grab()
        for _ in range(generator.randint(*SETTINGS.moves)):
            place = tuple(x + generator.gauss(0.0, SETTINGS.step) for x in place)
            self._has((task, avoid, place))
            await client.move(place)
            await _rest(client, SETTINGS.interval)
        await client.release()

    def _has(self, state: State | None) -> None:
        self.had.append((time.monotonic(), self.num_edits, state))

    def knows(self, found: State) -> bool:
        """Return whether he has had what is found."""
        return any(state is not None and is_same(state, found) for _, _, state in self.had)

    def compare(self, found: State, lost: float) -> None:
        """Count what is not found again of what there was when the connection was lost."""
        had = [entry for entry in self.had if entry[0] <= lost] or self.had[:1]
        last = had[-1][1] if had else 0
        for k, (_, edit, state) in reversed([*enumerate(had)]):
            if state is None:  # just after he had chosen something: nothing can be compared
                return
            if is_same(state, found):
                whole = k == len(had) - 1 or had[k + 1][1] > edit
                if not (edit >= last or (edit == last - 1 and whole)):
                    self._loses(found, had, lost)
                return
        self._loses(found, had, lost)

    def _loses(self, found: State, had: Sequence[tuple[float, int, State | None]], lost: float) -> None:
        """Count an edit that was not found again, and tell what there was in the seconds before."""
        self.num_lost += 1
        lately = [f"{when - lost:.2f} s: edit {edit}, {state}" for when, edit, state in had if when > lost - 2]
        print(f"an edit was lost: found {found} of", *lately, sep="\n    ", file=sys.stderr)


async def _rest(client: ProtocolClient, seconds: float) -> None:
    """Wait so long. Raises LostError as soon as the connection is lost, not with what is sent next."""
    await client.wait_for(lambda: False, seconds)


def state_of(client: ProtocolClient) -> State:
    """Return the state that a page shows."""
    task, avoid = (str(client.controls[client.find(label)]["value"]) for label in ("Task", "Avoid"))
    place = client.nodes.get(ANSWERED, {}).get("position", client.nodes[OBSTACLE]["position"])
    return task, avoid, tuple(map(float, place))


def is_same(one: State, other: State) -> bool:
    """Return whether two states are the same, but for the rounding of places."""
    return one[:2] == other[:2] and bool(np.allclose(one[2], other[2], rtol=0.0, atol=1e-6))


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    parser.add_argument("--visitors", type=whole_number(1), default=4, help="at once (default: 4)")
    parser.add_argument("--kills", type=whole_number(0), default=40, help="of a process each (default: 40)")
    parser.add_argument("--seconds", type=positive_number("seconds", 24 * 3600), default=600.0, help="(default: 600)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of edits and kills (default: 0)")


def run(options: argparse.Namespace) -> int:
    """Run the command; see the module for its exit status."""
    arguments = ["--max-sessions", str(options.visitors), "--processes", "2"]
    with tempfile.TemporaryFile("w+", encoding="utf-8") as log:
        with started([*arguments, "--max-of-address", str(2 * options.visitors)], log) as (url, process, _):
            visitors, memory = asyncio.run(_soaked(options, url, process))
        log.seek(0)
        lines = log.read().splitlines()
    errors = [line for line in lines if re.match(r"ERROR|CRITICAL|Traceback", line)]
    reasons = [reason for visitor in visitors for reason in visitor.reasons]
    for line in (*reasons, *(lines if errors else ())):
        print(line, file=sys.stderr)
    third, fourth = np.array_split(memory[len(memory) // 2 :], 2)
    num_lost = sum(visitor.num_lost for visitor in visitors)
    row = {
        "visitors": options.visitors,
        "edits": sum(visitor.num_edits for visitor in visitors),
        "kills": options.kills,
        "losses": sum(len(visitor.back) for visitor in visitors),
        "back s": _spread([back for visitor in visitors for back in visitor.back]),
        "edits lost": num_lost,
        "lost otherwise": len(reasons),
        "errors in the log": len(errors),
        "MB, third and last quarter": f"{np.mean(third):.0f}, {np.mean(fourth):.0f}" if len(memory) > 3 else None,
    }
    report([row])
    return int(bool(errors or reasons or num_lost))


async def _soaked(options: argparse.Namespace, url: str, process: int) -> tuple[Sequence[Soaked], Array]:
    """Let visitors edit while processes are killed; return them, and the memory, MB, every now and then."""
    deadline, kills, memory = time.monotonic() + options.seconds, [-np.inf], list[float]()

    async def kill() -> None:
        generator = random.Random(options.seed)
        begin, pause = time.monotonic() + SETTINGS.first_kill, (options.seconds - SETTINGS.first_kill) / options.kills
        for k in range(options.kills):
            await asyncio.sleep(max(0.0, begin + (k + generator.random() / 2) * pause - time.monotonic()))
            os.kill(generator.choice(children(process)), signal.SIGKILL)
            kills.append(time.monotonic())

    async def look() -> None:
        while True:
            resources = used(process)
            if resources is not None:  # none while one of its processes ends
                memory.append(resources[1])
            await asyncio.sleep(SETTINGS.sample)

    visitors = [Soaked(url, options.seed + 1000 * k, lambda: kills[-1]) for k in range(options.visitors)]
    beside = [asyncio.create_task(look())] + [asyncio.create_task(kill())] * bool(options.kills)
    await asyncio.gather(*(visitor.run(deadline) for visitor in visitors))
    for task in beside:
        if task.done():
            task.result()
        task.cancel()
    return visitors, np.array(memory)


def children(process: int) -> list[int]:
    """Return the numbers of the processes that a process has started."""
    threads = (Path("/proc") / str(process) / "task").iterdir()
    return [int(child) for thread in threads for child in (thread / "children").read_text(encoding="ascii").split()]


def _spread(seconds: Sequence[float]) -> str | None:
    """Text of the median, 95 % and largest of times."""
    figures = spread(np.array(seconds))
    return None if figures is None else " / ".join(f"{value / 1e3:.2f}" for value in figures.values())
