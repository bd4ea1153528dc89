"""The demo as its users start it, and a visitor whose browser sends what no page sends: it costs the others nothing."""

import asyncio
import io
import re
import struct
import zlib
from contextlib import asynccontextmanager
from pathlib import Path
from uuid import uuid4

import numpy as np
import pytest
from demo import PATIENCE, address, started
from hostile import flow_of, with_learned
from pages import png_of
from PIL import Image
from protocol_client import ROLLOUT, ProtocolClient

from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import OWN
from dt_viz.ui.tabs.picture import SAVE_PICTURE

SIZE = 1280, 720  # width and height of the page's smallest picture, pixels
LARGEST_GROWTH = 100.0
"""Largest growth of the memory of all processes while hostile answers are refused, MB."""
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="memory is read as Linux shows it"),
]


class Client(ProtocolClient):
    """A client that answers requests for pictures as the test wants."""

    def __init__(self, url):
        super().__init__(url)
        self.asked, self.files = [], []
        """Identifiers of the pictures that are asked for, and names of the files that are sent."""

    def _apply(self, message, now):
        super()._apply(message, now)
        if message["type"] == "GetRenderRequestMessage":
            self.asked.append(message["render_uuid"])
        elif message["type"] == "FileTransferStartDownload":
            self.files.append(message["filename"])

    async def answer(self, uuid, payload):
        await self.send("GetRenderResponseMessage", payload=payload, render_uuid=uuid)

    async def asks(self):
        """Save a picture; return the identifier of what the browser is asked for."""
        num, idle = len(self.asked), lambda: any(one.get("label") == SAVE_PICTURE for one in self.controls.values())
        for _ in range(4):  # a press that comes just when the last one is done is lost
            assert await self.wait_for(idle, PATIENCE / 4)
            await self.send("GuiUpdateMessage", uuid=self.find(SAVE_PICTURE), updates={"value": True})
            if await self.wait_for(lambda: len(self.asked) > num, PATIENCE / 8):
                break
        return self.asked[num]

    def text_with(self, words):
        """The text in the panel that has such words, without its markup; None if there is none."""
        texts = (re.sub("<[^>]*>", " ", str(control.get("content", ""))) for control in self.controls.values())
        return next((found[0] for text in texts if (found := re.search(words, text)) is not None), None)

    async def hears(self, words):
        assert await self.wait_for(lambda: self.text_with(words), PATIENCE / 4), words


@asynccontextmanager
async def visiting(url):
    async with Client(url) as client:
        assert await client.look_until_drawn(PATIENCE)
        yield client


def largest_memory(process):
    """Largest memory so far of a process and of all that it has started, MB."""
    kilobytes, folders = 0, [Path("/proc") / str(process)]
    for folder in folders:
        (found,) = re.findall(r"VmHWM:\s+(\d+) kB", (folder / "status").read_text())
        kilobytes += int(found)
        for thread in (folder / "task").iterdir():
            folders += [Path("/proc") / child for child in (thread / "children").read_text().split()]
    return kilobytes / 1024


def huge_png(side=13_300):
    """A transparent PNG, 0.7 MB, whose pixels take 0.7 GB."""

    def chunk(kind, data):
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packed, row = zlib.compressobj(), bytes(1 + 4 * side)
    rows = b"".join(packed.compress(row) for _ in range(side)) + packed.flush()
    header = struct.pack(">IIBBBBB", side, side, 8, 6, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


def a_gif():
    file = io.BytesIO()
    Image.new("L", SIZE).save(file, "GIF")
    return file.getvalue()


async def answers_what_was_not_asked_for(url, process):
    picture, huge = png_of(np.zeros((SIZE[1], SIZE[0], 4), np.uint8)), huge_png()
    async with visiting(url) as client:
        await client.answer(await client.asks(), picture)
        assert await client.wait_for(lambda: client.files, PATIENCE / 4)
        before = largest_memory(process.pid)
        for uuid in (uuid4().hex, client.asked[-1]):  # never asked for, and answered before
            for _ in range(4):
                await client.answer(uuid, huge)
        for payload, found in (
            (huge, "a PNG of 13300x13300 pixels"),
            (b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 1280 720\nshowpage\n", "no PNG"),
            (a_gif(), "no PNG"),
            (b"", "no PNG"),
            (picture[:60], "a damaged PNG"),
        ):
            await client.answer(await client.asks(), payload)
            await client.hears(f"Save picture: the browser: found {found}; accepted: an RGBA PNG of 1280x720 pixels")
        assert len(client.files) == 1
        assert largest_memory(process.pid) - before < LARGEST_GROWTH
        await client.answer(await client.asks(), picture)
        assert await client.wait_for(lambda: len(client.files) == 2, PATIENCE / 4)


async def brings_more_than_can_be_computed(url):
    content = encode(Saved(Scenario(OWN), own=with_learned(2, **flow_of((650, 650), 900)))).encode()
    async with visiting(url) as client, visiting(url) as other:
        await client.send_file("Open a file, or drop it here", "hostile.json", content)
        await client.hears(
            r"hostile\.json: Gaussians of what was learned, in all steps: found 380\d{6}; accepted: at most"
        )
        before, task = other.nodes[ROLLOUT]["vertices"], other.controls[other.find("Task")]
        await other.set("Task", next(title for title in task["options"] if title != task["value"]))
        drawn = lambda: not np.array_equal(other.nodes[ROLLOUT]["vertices"], before)  # noqa: E731
        assert await other.wait_for(drawn, PATIENCE / 2)


def test_a_picture_of_another_size_or_kind_or_that_was_not_asked_for_is_refused_before_it_is_decoded(cache):
    with started(cache, program=("-m", "dt_viz")) as process:
        asyncio.run(answers_what_was_not_asked_for(address(process), process))


def test_a_scenario_that_could_not_be_computed_is_refused_and_others_get_their_pictures(cache):
    with started(cache, program=("-m", "dt_viz")) as process:
        asyncio.run(brings_more_than_can_be_computed(address(process)))
