"""Let several visitors drag at once in a real server, as browsers do, and measure how soon each sees its edits.

The server is a separate process; the visitors speak viser's protocol from this one, and decode all messages. Each drags
the obstacle around its place, 20 edits a second. The obstacle's pose in a picture is found by comparing the rollouts
with those that the engine computes here for each pose. The JSON file holds:

``first_picture_s``
    for each round and visitor, from the start of all until its rollouts and status line arrive; null if they do not.
``median_ms``, ``p95_ms``
    from the edit that a picture shows until it is decoded, over all pictures of all visitors while they drag.
``visitors``
    for each: ``frames`` (pictures of a pose that it dragged to), ``others`` (finer pictures at rest), ``median_ms``,
    ``p95_ms``, ``megabytes`` received, and ``last_shown``, whether the last picture is of the last pose.
``peak_memory_mb``, ``threads``
    of the server; null if its process is unknown, or the system does not report them.

With ``--rest`` nobody drags: the visitors look on while the arm goes its round, and the file holds beside the memory

``core_percent``, ``messages_per_s``
    processor time of the server for each visitor, in percent of a core; and what each receives.
"""

from __future__ import annotations

import argparse
import asyncio
import math
import os
import platform
import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dt_viz.arm.robot import load_jaco
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Frame, Stage
from dt_viz.evaluate.options import (
    InputError,
    add_lasa,
    avoiding,
    chosen_task,
    positive_number,
    print_table,
    ready_to_write,
    whole_number,
    write_json,
)
from dt_viz.evaluate.protocol_client import ROLLOUT, LostError, ProtocolClient
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.obstacles.shapes import Point, Sphere, as_point
from dt_viz.scenario.tasks import Task
from dt_viz.transforms.avoidance import Avoidance
from dt_viz.ui.scene.tubes import evenly_bent

EDITS_PER_SECOND = 20
"""Rate of a drag's edits; no page sends more."""
NUM_POSES, RADIUS = 100, 0.06
"""Number of poses on the circle around the obstacle's place, in the task's slice, and its radius, metres."""
FIRST_PICTURE = 20.0
"""Longest accepted time until a visitor has a picture, seconds."""
REST = 3.0
"""Time after the drag until the picture is final, seconds."""
SETTLED = 10.0
"""Time after the first picture until nothing is refined any more, seconds."""
PATIENCE = 60.0
"""Longest time to wait for the last pose, seconds."""
SAME = 1e-4
"""Largest distance between equal rollouts, metres; those of neighbouring poses differ by 1 mm."""

Middle = NDArray[np.float32]
"""Points (K, 3) of the rollout that the arm follows, metres."""


class Poses:
    """Poses that the obstacle is dragged to, with the rollout that the arm follows for each; the whole arm avoids."""

    def __init__(self, engine: Engine, task: Task) -> None:
        self._engine, self._task = engine, task
        angles = 2 * np.pi * np.arange(NUM_POSES) / NUM_POSES
        circle = RADIUS * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        centre = np.asarray(task.obstacle_position)
        self.positions: list[Point] = [as_point(place) for place in centre + circle @ task.slice.axes.T]
        """Positions of the obstacle's centre, metres."""
        self._coarse = [self._middle(next(self._frames(index))) for index in range(NUM_POSES)]

    def find(self, shown: Middle) -> int | None:
        """Return the index of the pose whose first frame has this rollout."""
        return next((index for index, middle in enumerate(self._coarse) if _same(middle, shown)), None)

    def has(self, index: int, shown: Middle | None) -> bool:
        """Return whether this rollout is of this pose, in any of its frames."""
        for frame in self._frames(index):
            if shown is not None and _same(self._middle(frame), shown):
                return True
            if frame.stage >= Stage.FINE:
                break
        return False

    def _frames(self, index: int) -> Iterator[Frame]:
        return self._engine.frames(avoiding(self._task, Avoidance(Sphere(self.positions[index]), space="cspace")))

    def _middle(self, frame: Frame) -> Middle:
        return evenly_bent(frame.rollouts[frame.chosen or 0]).astype(np.float32)


@dataclass
class Visit:
    """One visitor in the last round."""

    client: ProtocolClient
    poses: Poses
    first: int
    """Index of the pose that its drag begins with."""
    edits: list[float] = field(default_factory=list)
    """Times at which they were sent, seconds of `time.perf_counter`."""
    latencies: list[float] = field(default_factory=list)
    """Latency of each picture of a pose, seconds."""
    num_frames: int = 0
    num_others: int = 0
    num_bytes: int = 0
    """Number of bytes received before the drag."""
    lost: str = ""
    """Reason for the end of the connection; empty while it lasts."""

    def pose(self, edit: int) -> int:
        """Return the index of an edit's pose."""
        return (self.first + edit) % NUM_POSES

    async def drag(self, seconds: float) -> None:
        """Drag the obstacle, release it, and wait for the final picture."""
        self.num_bytes = self.client.num_bytes
        self.client.changed = self._see
        try:
            await self.client.grab()
            began = time.perf_counter()
            for edit in range(max(1, round(EDITS_PER_SECOND * seconds))):
                await asyncio.sleep(max(0.0, began + edit / EDITS_PER_SECOND - time.perf_counter()))
                self.edits.append(time.perf_counter())
                await self.client.move(self.poses.positions[self.pose(edit)])
            await self.client.release()
            await self.client.wait_for(lambda: self._latest == self.pose(len(self.edits) - 1), PATIENCE)
            await asyncio.sleep(REST)
        except LostError as error:
            self.lost = str(error)

    def shows_the_last_pose(self) -> bool:
        """Return whether the current picture is of the last edit."""
        return not self.lost and self.poses.has(self.pose(len(self.edits) - 1), self.client.rollout)

    _latest: int | None = None

    def _see(self, name: str, changes: Any, now: float) -> None:  # noqa: ANN401 - properties of a node
        """Find the edit that a new picture shows."""
        if name != ROLLOUT or "vertices" not in changes:
            return
        shown = self.client.rollout
        self._latest = None if shown is None else self.poses.find(shown)
        if self._latest is None:
            self.num_others += 1
            return
        self.num_frames += 1
        newest = len(self.edits) - 1
        edit = newest - (self.pose(newest) - self._latest) % NUM_POSES
        if edit >= 0:
            self.latencies.append(now - self.edits[edit])


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    parser.add_argument("--task", default="draw_s", help="that the server begins with (default: %(default)s)")
    add_lasa(parser)
    parser.add_argument("--clients", type=whole_number(1), default=8, help="visitors at once (default: %(default)s)")
    parser.add_argument("--seconds", type=positive_number("seconds", 3600), default=60.0, help="to drag (default: 60)")
    parser.add_argument(
        "--rounds", type=whole_number(1), default=1, help="that all open the page; in the last they drag (default: 1)"
    )
    parser.add_argument("--rest", action="store_true", help="drag nothing: measure what a visitor costs who looks on")
    parser.add_argument("--url", type=_url, help="of a server that runs already, such as ws://127.0.0.1:8080")
    parser.add_argument("--out", type=Path, metavar="FILE.json")


def run(options: argparse.Namespace) -> int:
    """Run the subcommand; 1 if a visitor had no picture in time, or was not shown the last pose."""
    tasks, task = chosen_task(options)
    out = None if options.out is None else ready_to_write(options.out, ".json")
    if options.rest:
        return _run_at_rest(options, out)
    fits = FitStore(default_cache_folder())
    fits.get(task.demonstrations)
    poses = Poses(Engine(tasks, fits, load_jaco()), task)
    with _server(options) as (url, process):
        firsts, visits, num_threads = asyncio.run(_visit(options, url, process, poses))
        memory = _status(process, "VmHWM")
    shown = [visit.shows_the_last_pose() for visit in visits]
    latencies = np.array([latency for visit in visits for latency in visit.latencies])
    figures = {
        "first_picture_s": firsts,
        **_percentiles(latencies),
        "frames": sum(visit.num_frames for visit in visits),
        "visitors": [
            {
                "first_picture_s": first,
                "frames": visit.num_frames,
                "others": visit.num_others,
                **_percentiles(np.array(visit.latencies)),
                "megabytes": (visit.client.num_bytes - visit.num_bytes) / 1e6,
                "last_shown": last,
                "lost": visit.lost,
            }
            for first, visit, last in zip(firsts[-1], visits, shown, strict=bool(visits))
        ],
        "peak_memory_mb": None if memory is None else memory / 1024,
        "threads": num_threads,
        "settings": {
            "task": task.name,
            "clients": options.clients,
            "seconds": options.seconds,
            "rounds": options.rounds,
            "edits_per_second": EDITS_PER_SECOND,
            "cores": os.cpu_count(),
            "python": platform.python_version(),
        },
    }
    if out is not None:
        write_json(out, figures)
    _print(figures)
    complete = all(first is not None and first <= FIRST_PICTURE for round_ in firsts for first in round_)
    return 0 if complete and all(shown) else 1


def _run_at_rest(options: argparse.Namespace, out: Path | None) -> int:
    """Measure the server while nobody edits anything; 1 if a visitor had no picture in time, or was lost."""
    with _server(options) as (url, process):
        if process is None or _processor_seconds(process) is None:
            raise InputError(
                "--rest", "a server whose processor time is unknown", "one started by this command, on Linux"
            )
        figures = asyncio.run(_look_on(options, url, process))
        memory = _status(process, "VmHWM")
    if figures is None:
        return 1
    figures["peak_memory_mb"] = None if memory is None else memory / 1024
    if out is not None:
        write_json(out, figures)
    print(
        f"{options.task}, {options.clients} visitors who look on for {options.seconds:g} s: "
        f"{figures['core_percent']:.1f} % of a core and {figures['messages_per_s']:.1f} messages a second for each"
    )
    return 0


async def _look_on(options: argparse.Namespace, url: str, process: int) -> dict[str, float | None] | None:
    """The figures of visitors who only look on; None if one has no picture in time, or is lost."""
    async with AsyncExitStack() as stack:
        clients, began = [ProtocolClient(url) for _ in range(options.clients)], time.perf_counter()
        if None in await asyncio.gather(*(_first_picture(stack, client, began) for client in clients)):
            return None
        await asyncio.sleep(SETTLED)
        before, spent = sum(client.num_messages for client in clients), _processor_seconds(process)
        began = time.perf_counter()
        await asyncio.sleep(options.seconds)
        each = (time.perf_counter() - began) * options.clients
        after, finally_spent = sum(client.num_messages for client in clients), _processor_seconds(process)
        if spent is None or finally_spent is None or any(client.lost for client in clients):
            return None
        return {"core_percent": 100 * (finally_spent - spent) / each, "messages_per_s": (after - before) / each}


async def _visit(
    options: argparse.Namespace, url: str, process: int | None, poses: Poses
) -> tuple[list[list[float | None]], list[Visit], int | None]:
    """Run all rounds; return seconds until each visitor's first picture, the last visits, and the most threads."""
    firsts = []
    num_threads = [_status(process, "Threads")]
    for last in [False] * (options.rounds - 1) + [True]:
        async with AsyncExitStack() as stack:
            clients = [ProtocolClient(url) for _ in range(options.clients)]
            began = time.perf_counter()
            firsts.append(await asyncio.gather(*(_first_picture(stack, client, began) for client in clients)))
            num_threads.append(_status(process, "Threads"))
            if not last:
                continue
            if None in firsts[-1]:
                break
            visits = [Visit(client, poses, k * NUM_POSES // options.clients) for k, client in enumerate(clients)]
            await asyncio.gather(*(visit.drag(options.seconds) for visit in visits))
            num_threads.append(_status(process, "Threads"))
            return firsts, visits, max((n for n in num_threads if n is not None), default=None)
    return firsts, [], max((n for n in num_threads if n is not None), default=None)


async def _first_picture(stack: AsyncExitStack, client: ProtocolClient, began: float) -> float | None:
    """Open a page; return the seconds until it has a picture, None if it has none in time."""
    try:
        await stack.enter_async_context(client)
        await client.look()
        if await client.wait_for(lambda: client.has_picture, FIRST_PICTURE):
            return time.perf_counter() - began
    except (LostError, OSError) as error:
        print(f"a visitor was lost: {error}", file=sys.stderr)
    return None


@contextmanager
def _server(options: argparse.Namespace) -> Iterator[tuple[str, int | None]]:
    """Yield the address of the WebSocket, and the server's process if it is started here."""
    if options.url is not None:
        yield options.url, None
        return
    arguments = ["--port", "0", "--task", options.task, "--max-sessions", str(options.clients)]
    if options.lasa is not None:
        arguments += ["--lasa", str(options.lasa)]
    program = "from dt_viz.cli import main; raise SystemExit(main())"
    with subprocess.Popen(
        [sys.executable, "-c", program, *arguments], stdout=subprocess.PIPE, text=True, encoding="utf-8"
    ) as process:
        try:
            assert process.stdout is not None
            found = (re.search(r"DT-Viz is at http://(\S+)", line) for line in process.stdout)
            address = next((match[1] for match in found if match), None)
            if address is None:
                raise InputError("--task", "a server that does not start", "one that does: see above")
            yield f"ws://{address}", process.pid
        finally:
            process.terminate()


def _status(process: int | None, name: str) -> int | None:
    """Read a number of /proc/PID/status, kB or a count; None if there is none."""
    try:
        text = Path(f"/proc/{process}/status").read_text(encoding="ascii")
    except OSError:
        return None
    found = re.search(rf"^{name}:\s*(\d+)", text, re.MULTILINE)
    return None if found is None else int(found[1])


def _processor_seconds(process: int) -> float | None:
    """Processor time that a process has used, seconds; None if it is gone, or the system does not report it."""
    try:
        fields = Path(f"/proc/{process}/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    except OSError:
        return None
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _same(expected: Middle, shown: Middle) -> bool:
    return expected.shape == shown.shape and bool(np.abs(expected - shown).max() < SAME)


def _percentiles(latencies: NDArray[np.float64]) -> dict[str, float | None]:
    if not len(latencies):
        return {"median_ms": None, "p95_ms": None}
    return {"median_ms": 1e3 * float(np.median(latencies)), "p95_ms": 1e3 * float(np.percentile(latencies, 95))}


def _print(figures: dict[str, Any]) -> None:
    settings = figures["settings"]
    for number, firsts in enumerate(figures["first_picture_s"], 1):
        in_time = [first for first in firsts if first is not None]
        slowest = f", the last after {max(in_time):.1f} s" if in_time else ""
        print(f"round {number}: {len(in_time)} of {len(firsts)} have a picture{slowest}")
    header = ("visitor", "first picture s", "frames/s", "median ms", "95 % ms", "others", "MB", "last pose shown")
    rows = [
        (
            f"{number}",
            _text(visitor["first_picture_s"], ".1f"),
            _text(visitor["frames"] / settings["seconds"], ".1f"),
            _text(visitor["median_ms"], ".0f"),
            _text(visitor["p95_ms"], ".0f"),
            f"{visitor['others']}",
            _text(visitor["megabytes"], ".1f"),
            visitor["lost"] or ("yes" if visitor["last_shown"] else "no"),
        )
        for number, visitor in enumerate(figures["visitors"], 1)
    ]
    print_table(header, rows)
    print(
        f"edit → picture of it: median {_text(figures['median_ms'], '.0f')} ms, "
        f"95 % {_text(figures['p95_ms'], '.0f')} ms, {figures['frames']} pictures; "
        f"server: {_text(figures['peak_memory_mb'], '.0f')} MB at most, {_text(figures['threads'], 'd')} threads"
    )


def _text(number: float | None, form: str) -> str:
    return "–" if number is None or not math.isfinite(number) else format(number, form)


def _url(text: str) -> str:
    if re.fullmatch(r"wss?://[^/\s]+(/\S*)?", text) is None:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: ws:// or wss:// and an address")
    return text
