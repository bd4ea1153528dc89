"""Let one visitor drag alone and beside another one who takes all that he can get, and compare what the first one sees.

    python -m tests.benchmarks fairness --seconds 5 --rounds 6 --out fairness.json

The server is a process of its own, and both speak viser's protocol from this one. The first visitor drags a sphere 20
times a second; he does so alone, beside the other one, alone and so on, as a machine is not as fast all the time. The
other one learns (opens demonstrations of his own and learns them, again and again), uploads (a mesh of 300,000 faces
every 4 s), drags one of five obstacles before the whole arm, or saves the scene (as SVG, PDF and HTML in turn). A gap
is the time from one picture to the next. Figures are medians over the rounds, and a ratio is that of a figure beside
the other one and its mean of just before and after.
"""

from __future__ import annotations

import argparse
import asyncio
from collections.abc import Callable, Coroutine, Mapping
from contextlib import suppress
from dataclasses import dataclass
from io import BytesIO
from itertools import count, cycle, pairwise
from typing import Any
from zipfile import ZipFile

import numpy as np

from dt_viz.evaluate.options import Row, positive_number, report, whole_number
from dt_viz.flows.fields import Array
from dt_viz.scenario.scenario import MAX_OBSTACLES
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.tabs.picture import CANCEL, SAVE_PICTURE
from tests.benchmarks.load import started
from tests.benchmarks.options import add_out
from tests.benchmarks.visit import SETTINGS, Visit, places_of
from tests.protocol_client import LostError, ProtocolClient


@dataclass(frozen=True)
class FairnessSettings:
    """What the other visitor does; times in seconds."""

    task: str = "draw_s"  # name of the task that both begin with
    learned: str = "lift_box"  # name of the task whose demonstrations, with noise, are learned
    noise: float = 1e-3  # standard deviation of that noise, metres
    upload_every: float = 4.0  # time from one upload to the next
    rings: tuple[int, int] = (375, 400)
    """Numbers of vertices around the two circles of the torus that is uploaded; it has twice their product of faces."""
    begun: float = 5.0  # time that the other one has to begin, and to come to rest when he does nothing any more


OTHER = FairnessSettings()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    add_out(parser)
    parser.add_argument("--seconds", type=positive_number("seconds", 3600), default=5.0, help="of a drag (default: 5)")
    parser.add_argument("--rounds", type=whole_number(1), default=6, help="(default: %(default)s)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if the first visitor was lost, or another one came to do nothing."""
    rows = []
    for processes in (1, 2):
        server = ["--task", OTHER.task, "--processes", str(processes)]
        for beside in DOINGS:
            with started(server) as (url, *_):
                rows.append({"processes": str(processes), **asyncio.run(_compared(url, beside, options))})
    report(rows)
    return 0 if all(row["done"] != "0" for row in rows) else 1


async def _compared(url: str, beside: str, options: argparse.Namespace) -> Row:
    """Measure the gaps of a visitor alone and beside one who does something; return a row of the table."""
    drags = count()
    async with ProtocolClient(url) as client, ProtocolClient(url) as another:
        await asyncio.gather(_arrive(client), _arrive(another))
        other = Other(another)
        alone, together = [await _gap(client, next(drags), options.seconds)], []
        for _ in range(options.rounds):
            doing = asyncio.create_task(DOINGS[beside](other))
            await asyncio.sleep(OTHER.begun)
            together.append(await _gap(client, next(drags), options.seconds))
            doing.cancel()
            with suppress(asyncio.CancelledError):
                await doing
            await asyncio.sleep(OTHER.begun)
            alone.append(await _gap(client, next(drags), options.seconds))
    own, both = np.array([np.add(*pair) / 2 for pair in pairwise(alone)]), np.array(together)
    ratios, alone, beside_him = (np.median(figures, axis=0).tolist() for figures in (both / own, own, both))
    return {
        "beside one who": beside,
        "alone: gap ms, median / 95 %": " / ".join(f"{gap:.0f}" for gap in alone),
        "beside": " / ".join(f"{gap:.0f}" for gap in beside_him),
        "× median": ratios[0],
        "× 95 %": ratios[1],
        "done": str(other.num_done),
    }


async def _arrive(client: ProtocolClient) -> None:
    """Open the page, and wait until it rests. Raises LostError."""
    if not await client.look_until_drawn(SETTINGS.first_picture):
        raise LostError("no picture in time")
    await asyncio.sleep(SETTINGS.settled)


async def _gap(client: ProtocolClient, number: int, seconds: float) -> Array:
    """Drag for so long; return the median gap and that of 95 %, (2,), ms."""
    visit, num_edits = Visit(client), round(SETTINGS.edits_per_second * seconds)
    await visit.drag(places_of(TASKS[OTHER.task](), number, num_edits))
    gap = visit.figures(seconds)["gap_ms"]
    return np.array([gap["median"], gap["p95"]])


class Other:
    """A visitor who takes all that he can get, until he is cancelled."""

    def __init__(self, client: ProtocolClient) -> None:
        self.client, self.num_done = client, 0
        """His connection, and how often he has begun to learn or upload, or has ended a lap of his drag or a file."""

    async def learn(self) -> None:
        """Open demonstrations of his own and learn them, again and again."""
        client, rng, demonstrations = self.client, np.random.default_rng(0), TASKS[OTHER.learned]().demonstrations
        while True:
            takes = BytesIO()
            with ZipFile(takes, "w") as archive:
                for number, own in enumerate(demonstrations):
                    noisy = own.positions + OTHER.noise * rng.normal(size=own.positions.shape)
                    rows = [",".join(f"{value:.5f}" for value in row) for row in np.column_stack([own.times, noisy])]
                    archive.writestr(f"{number}.csv", "\n".join(["t,x,y,z", *rows]))
            await client.send_file("Open a file, or drop it here", "takes.zip", takes.getvalue())
            learn = client.controls[client.find("Learn")]
            await client.wait_for(lambda learn=learn: not learn["disabled"], SETTINGS.patience)
            task = client.controls[client.find("Task")]
            before = task["value"]
            await client.set("Learn", True)
            self.num_done += 1
            await client.wait_for(lambda task=task, before=before: task["value"] != before, SETTINGS.patience)

    async def upload(self) -> None:
        """Upload a large mesh again and again, and take it away."""
        content = torus(*OTHER.rings)
        while True:
            await self.client.set("Reset", "Reset")
            await self.client.send_file("Mesh or point cloud", "torus.stl", content)
            self.num_done += 1
            await asyncio.sleep(OTHER.upload_every)

    async def drag(self) -> None:
        """Drag one of as many obstacles as there may be, before the whole arm."""
        await self.client.set("Avoid", "Arm")
        for _ in range(MAX_OBSTACLES - len(self.client.controls[self.client.find("Selected")]["options"])):
            await self.client.set("Add", "Sphere")
            await asyncio.sleep(0.5)
        num_edits = round(SETTINGS.edits_per_second * SETTINGS.lap)
        for lap in count():
            await Visit(self.client).drag(places_of(TASKS[OTHER.task](), lap, num_edits))
            self.num_done += 1

    async def save(self) -> None:
        """Save the scene in each format that the server makes, again and again."""
        button = self.client.controls[self.client.find(SAVE_PICTURE)]
        for suffix in cycle(("SVG", "PDF", "HTML")):
            await self.client.set("Save as", suffix)
            await self.client.set(SAVE_PICTURE, True)
            for label in (CANCEL, SAVE_PICTURE):
                await self.client.wait_for(lambda label=label: button["label"] == label, SETTINGS.patience)
            self.num_done += 1


DOINGS: Mapping[str, Callable[[Other], Coroutine[Any, Any, None]]] = {
    "learns": Other.learn,
    "uploads": Other.upload,
    "drags": Other.drag,
    "saves": Other.save,
}
"""What the other one does, by its name in the table."""


def torus(num_around: int, num_across: int) -> bytes:
    """Write a torus of a size of 16 cm as a binary STL file; its circles have so many vertices."""
    u, v = np.meshgrid(*(2 * np.pi * np.arange(num) / num for num in (num_around, num_across)), indexing="ij")
    ring = 0.06 + 0.02 * np.cos(v)
    p = np.stack([ring * np.cos(u), ring * np.sin(u), 0.02 * np.sin(v)], axis=-1)
    ahead = np.roll(p, -1, axis=0)
    corners = [(p, ahead, np.roll(ahead, -1, axis=1)), (p, np.roll(ahead, -1, axis=1), np.roll(p, -1, axis=1))]
    faces = np.zeros(2 * p[..., 0].size, [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
    faces["corners"] = np.concatenate([np.stack(each, axis=2).reshape(-1, 3, 3) for each in corners])
    return bytes(80) + np.uint32(len(faces)).tobytes() + faces.tobytes()
