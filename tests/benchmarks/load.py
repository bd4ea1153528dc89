"""Let visitors drag at once in a real server, as browsers do, and count every picture that each of them gets.

The server is a process of its own, a new one for each number of visitors; the visitors speak viser's protocol from this
process, and decode all messages. Each drags the first obstacle around its place, 20 edits a second, to a new place each
time; each picture of the rollouts carries the place that it is computed for, and so the edit that it answers. Pictures
that refine an answer are not counted. Gaps, latencies and pictures a second are those of the worst visitor; ``ping``
is the round trip of a WebSocket ping to the server's event loop; ``cores`` and ``MB`` are of all processes of the
server, shared memory once.

With ``--rest`` nobody drags: the visitors look on while the arm goes its round. With ``--lecture`` a quarter drags in
bursts, one in twenty changes the task again and again, and the others look on. With ``--present`` one more drags, who
presents the one scene that the visitors watch: their pictures answer its edits.
"""

from __future__ import annotations

import argparse
import asyncio
import os
import re
import subprocess
import sys
import time
from collections.abc import Awaitable, Iterable, Iterator, Mapping, Sequence
from contextlib import AsyncExitStack, contextmanager, suppress
from enum import Enum, auto
from pathlib import Path
from typing import IO, Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.evaluate.options import Row, positive_number, report, whole_number
from dt_viz.obstacles.shapes import Point
from dt_viz.scenario.tasks import TASKS, Task
from tests.benchmarks.options import add_out
from tests.benchmarks.visit import SETTINGS, Visit, places_of, spread
from tests.protocol_client import LostError, ProtocolClient

TASK = "draw_s"  # name of the task that the server begins with


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    parser.add_argument(
        "--visitors", "--clients", type=whole_number(1), nargs="+", default=(1, 2, 4, 8, 16), help="at once, in turn"
    )
    parser.add_argument("--processes", type=whole_number(1), help="of the server; its own choice unless given")
    parser.add_argument("--seconds", type=positive_number("seconds", 3600), default=20.0, help="to drag (default: 20)")
    settled = positive_number("seconds", 3600)
    parser.add_argument(
        "--after", type=settled, default=SETTINGS.settled, help="so long on the page (default: %(default)s)"
    )
    what = parser.add_mutually_exclusive_group()
    what.add_argument("--rest", action="store_true", help="drag nothing: measure what visitors cost who look on")
    what.add_argument("--lecture", action="store_true", help="most look on, some drag in bursts, few change the task")
    what.add_argument("--present", action="store_true", help="one more drags what all others watch")
    parser.add_argument("--url", type=_url, help="of a server that runs already, such as ws://127.0.0.1:8080")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if a visitor had no picture in time, was lost, or was not shown its last edit."""
    if options.present and options.url is not None:
        raise FormatError("--present", "with --url", "without it: the key is that of a server that is started here")
    visits, task = [], TASKS[TASK]()
    for number in options.visitors:
        with _server(options, number) as (url, process, key):
            visits.append(asyncio.run(_visited(options, url, process, key, task, number)))
    report([_row(figures) for figures in visits])
    last = [visitor.get("last_shown", not visitor["lost"]) for figures in visits for visitor in figures["visitors"]]
    return 0 if len(last) == sum(options.visitors) and all(last) else 1


async def _visited(
    options: argparse.Namespace, url: str, process: int | None, key: str, task: Task, number: int
) -> dict[str, Any]:
    """Open the page so many times, drag in all, and return the figures; see the module.

    With the key of a presenter one more page drags, and the others watch.
    """
    async with AsyncExitStack() as stack:
        presenter = await _presenter(stack, url, key) if key else None
        clients = [ProtocolClient(url) for _ in range(number)]
        began = time.perf_counter()
        firsts = await asyncio.gather(*(_first_picture(stack, client, options, began) for client in clients))
        figures: dict[str, Any] = {"clients": number, "first_picture_s": firsts, "visitors": []}
        if None in firsts:
            return figures
        await asyncio.sleep(options.after)
        visits, num_edits = [*map(Visit, clients)], max(1, round(SETTINGS.edits_per_second * options.seconds))
        before, began = used(process), time.perf_counter()
        roles = roles_of(options, number)
        beginnings = np.random.default_rng(SETTINGS.seed).random(number)
        doings = (
            _doing(options, visit, role, places_of(task, k, num_edits), first)
            for k, (visit, role, first) in enumerate(zip(visits, roles, beginnings, strict=True))
        )
        if presenter is not None:
            for visit in visits:
                visit.watch(presenter)
            doings = [presenter.drag(places_of(task, 0, num_edits)), *doings]
        await asyncio.gather(*map(_measured, [*([] if presenter is None else [presenter]), *visits], doings))
        elapsed, after = time.perf_counter() - began, used(process)
        for visit in visits:
            if not visit.sent:
                continue
            with suppress(LostError):
                await visit.client.wait_for(lambda visit=visit: visit.last_shown, SETTINGS.patience)
        seconds = num_edits / SETTINGS.edits_per_second
        return figures | {
            "visitors": [
                visit.figures(seconds) if visit.sent else {"lost": visit.lost}
                for visit, role in zip(visits, roles, strict=True)
            ],
            "ping_ms": spread(np.array([ping for visit in visits for ping in visit.pings])),
            "cores": None if before is None or after is None else (after[0] - before[0]) / elapsed,
            "memory_mb": None if after is None else after[1],
        }


async def _presenter(stack: AsyncExitStack, url: str, key: str) -> Visit:
    """Open the presenter's page; return what it does once it has a picture."""
    client = await stack.enter_async_context(ProtocolClient(url))
    await client.look()
    await client.wait_for(lambda: client.controls, SETTINGS.first_picture)
    await client.present(key)
    if not await client.wait_for(lambda: client.has_picture, SETTINGS.first_picture):
        raise LostError("the presenter has no picture")
    return Visit(client)


async def _first_picture(
    stack: AsyncExitStack, client: ProtocolClient, options: argparse.Namespace, began: float
) -> float | None:
    """Open a page; return the seconds until it has a picture, None if it has none in time."""
    try:
        await stack.enter_async_context(client)
        await client.look()
        watches = options.present  # who watches has no details of the status
        if await client.wait_for(
            lambda: client.has_rollouts if watches else client.has_picture, SETTINGS.first_picture
        ):
            return time.perf_counter() - began
    except (LostError, OSError) as error:
        print(f"a visitor was lost: {error}", file=sys.stderr)
    return None


class _Role(Enum):
    """What a visitor does."""

    DRAG = auto()
    DRAG_IN_BURSTS = auto()
    CHANGE_TASK = auto()
    LOOK_ON = auto()


def roles_of(options: argparse.Namespace, number: int) -> list[_Role]:
    """Return what each of so many visitors does: in a lecture at random, as processes take visitors in turn."""
    if not options.lecture:
        return [_Role.LOOK_ON if options.rest or options.present else _Role.DRAG] * number
    num_dragging, num_changing = (round(part * number) for part in (SETTINGS.dragging, SETTINGS.changing))
    roles = [_Role.DRAG_IN_BURSTS] * num_dragging + [_Role.CHANGE_TASK] * num_changing
    roles += [_Role.LOOK_ON] * (number - len(roles))
    return [roles[k] for k in np.random.default_rng(SETTINGS.seed).permutation(number)]


def _doing(
    options: argparse.Namespace, visit: Visit, role: _Role, places: Sequence[Point], first: float
) -> Awaitable[None]:
    """Return what a visitor does in its role, where it drags through places, from a part of a round on."""
    if role is _Role.DRAG:
        return visit.drag(places)
    if role is _Role.DRAG_IN_BURSTS:
        return visit.drag_in_bursts(places, first)
    return visit.change_task(options.seconds, first) if role is _Role.CHANGE_TASK else asyncio.sleep(options.seconds)


async def _measured(visit: Visit, doing: Awaitable[None]) -> None:
    """Have a visitor do something, and ping the server meanwhile."""

    async def ping() -> None:
        while True:
            visit.pings.append(await visit.client.ping())
            await asyncio.sleep(0.25)

    pinging = asyncio.create_task(ping())
    try:
        await doing
    except LostError as error:
        visit.lost = str(error)
    pinging.cancel()
    try:
        await pinging
    except LostError as error:
        visit.lost = str(error)
    except asyncio.CancelledError:
        pass


@contextmanager
def _server(options: argparse.Namespace, number: int) -> Iterator[tuple[str, int | None, str]]:
    """Yield the address of the WebSocket, the server's process if it is started here, and the presenter's key."""
    if options.url is not None:
        yield options.url, None, ""
        return
    arguments = ["--task", TASK, "--max-sessions", str(number)]
    if options.processes is not None:
        arguments += ["--processes", str(options.processes)]
    if options.present:
        arguments.append("--present")
    with started(arguments) as server:
        yield server


@contextmanager
def started(arguments: Sequence[str], log: IO[str] | None = None) -> Iterator[tuple[str, int, str]]:
    """Start a server on a free port; yield its WebSocket's address, its process, and its presenter's key, if any.

    Args:
        arguments: options of `dt-viz`.
        log: file that its log is written to; None for this process' own.

    Raises:
        FormatError: it does not start.
    """
    program = "from dt_viz.cli import main; raise SystemExit(main())"
    command = [sys.executable, "-c", program, "--port", "0", *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log, text=True, encoding="utf-8") as process:
        try:
            assert process.stdout is not None
            found = (re.search(r"DT-Viz is at http://(\S+)", line) for line in process.stdout)
            address = next((match[1] for match in found if match), None)
            if address is None:
                raise FormatError(" ".join(arguments), "a server that does not start", "one that does: see above")
            line = process.stdout.readline() if "--present" in arguments else ""
            key = re.search(r"present=([\w-]+)", line)
            yield f"ws://{address}", process.pid, "" if key is None else key[1]
        finally:
            process.terminate()


def used(process: int | None) -> tuple[float, float] | None:
    """Return the processor time of a process and of all it has started, s, and their memory, MB, shared memory once.

    Returns None if it is gone or the system does not say.
    """
    if process is None:
        return None
    seconds, megabytes, folders = 0.0, 0.0, [Path("/proc") / str(process)]
    try:
        for folder in folders:
            fields = (folder / "stat").read_text(encoding="ascii").rpartition(")")[2].split()
            seconds += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")  # with those that have ended
            memory = re.search(r"^Pss:\s*(\d+)", (folder / "smaps_rollup").read_text(encoding="ascii"), re.MULTILINE)
            megabytes += 0 if memory is None else int(memory[1]) / 1024
            for thread in (folder / "task").iterdir():
                children = (thread / "children").read_text(encoding="ascii").split()
                folders += [Path("/proc") / child for child in children]
    except OSError:
        return None
    return seconds, megabytes


def _row(figures: Mapping[str, Any]) -> Row:
    """Row of a number of visitors in the table: gaps and pictures of the worst of them."""
    firsts, visitors = figures["first_picture_s"], figures["visitors"]
    shown = [visitor for visitor in visitors if "last_shown" in visitor]
    rates = [visitor["pictures_per_s"] for visitor in shown]
    last = f"{sum(visitor['last_shown'] for visitor in shown)} of {len(shown)}" if shown else None
    return {
        "visitors": str(figures["clients"]),
        "first picture s": None if None in firsts else max(firsts),
        "pictures/s of each": f"{min(rates):.1f} to {max(rates):.1f}" if rates else None,
        "gap ms, median / 95 % / worst": _worst(visitor["gap_ms"] for visitor in shown),
        "edit → picture ms": _worst(visitor["latency_ms"] for visitor in shown),
        "edits answered in 0.5 s %": _percent([visitor["answered"] for visitor in shown]),
        "ping ms": _worst([figures.get("ping_ms")]),
        "cores": figures.get("cores"),
        "MB": figures.get("memory_mb"),
        "lost": sum(bool(visitor["lost"]) for visitor in visitors) + firsts.count(None),
        "last shown": last,
    }


def _percent(parts: Sequence[float | None]) -> float | None:
    """Mean of some parts in per cent; None without any."""
    known = [part for part in parts if part is not None]
    return 100 * float(np.mean(known)) if known else None


def _worst(spreads: Iterable[dict[str, float] | None]) -> str | None:
    """Text of the largest median, 95 % and worst of several spreads."""
    known = [spread.values() for spread in spreads if spread is not None]
    return " / ".join(f"{max(values):.0f}" for values in zip(*known, strict=True)) or None


def _url(text: str) -> str:
    if re.fullmatch(r"wss?://[^/\s]+(/\S*)?", text) is None:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: ws:// or wss:// and an address")
    return text
