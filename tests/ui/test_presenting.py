"""One presenter and those who watch: real connections to the server that `--present` starts."""

import asyncio
import contextlib
import functools
import json
import re
import urllib.error
import urllib.request

import numpy as np
import pytest
from pages import wait_until

from dt_viz.evaluate.protocol_client import OBSTACLE, ROLLOUT, LostError, ProtocolClient
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui import presenting
from dt_viz.ui.presenting import AWAY, NOT_YET, OWN_MACHINE, TAKEN, WRONG, reachable
from dt_viz.ui.scene.camera import Framing, followed
from dt_viz.ui.server import Server

KEY = "the-key"
PLACES = 4
FOLLOW = "Follow the presenter's camera"
PATIENCE = 90.0
"""Seconds that anything may take: the machine may be busy."""
CAMERA = ("SetCameraPositionMessage", "SetCameraLookAtMessage")


def asynchronous(test):
    """Runs a test on an event loop, for so long."""

    @functools.wraps(test)
    def run(**fixtures):
        asyncio.run(asyncio.wait_for(test(**fixtures), 2 * PATIENCE))

    return run


@pytest.fixture(scope="module")
def server(fits):
    server = Server(TASKS, fits, load_jaco(), task="draw_s", port=0, max_sessions=PLACES, key=KEY)
    yield server
    server.close()


@pytest.fixture
def url(server):
    """Of the WebSocket; nobody is left over from another test."""
    wait_until(lambda: not server._server.get_clients() and not server.visitors, PATIENCE)
    return f"ws://127.0.0.1:{server.port}"


class Guest(ProtocolClient):
    """Somebody with a page, whose camera is known, and who may tell a key as its script does."""

    def __init__(self, url, **options):
        super().__init__(url, **options)
        self.url, self.cameras, self.kinds = url, [], set()

    def _apply(self, message, now):
        self.kinds.add(message["type"])
        if message["type"] == CAMERA[0]:
            self.cameras.append(np.array(message["position"]))
        super()._apply(message, now)

    def says(self, text):
        return any(text in str(control.get("content", "")) for control in self.controls.values())

    @property
    def token(self):
        return next(
            found[1]
            for control in reversed(self.controls.values())
            if (found := re.search(r"window/([\w-]+)/present/", str(control.get("content", ""))))
        )

    async def claim(self, key):
        address = f"{self.url.replace('ws', 'http', 1)}/window/{self.token}/present/{key}"
        with contextlib.closing(await asyncio.to_thread(urllib.request.urlopen, address)) as answer:
            assert answer.status == 204


@contextlib.asynccontextmanager
async def watching(url):
    """A viewer with a card."""
    async with Guest(url) as guest:
        await guest.look()
        assert await guest.wait_for(lambda: guest.says("dt-qr"), PATIENCE)
        yield guest


@contextlib.asynccontextmanager
async def presenting_at(url):
    """The presenter, with the first picture."""
    async with watching(url) as guest:
        await guest.claim(KEY)
        assert await guest.wait_for(lambda: guest.has_picture, PATIENCE)
        yield guest


async def moved_to(presenter, place):
    """Drag the first obstacle there."""
    await presenter.grab()
    await presenter.move(place)
    await presenter.release()


def stands_at(guest, place):
    return np.allclose(guest.nodes.get(OBSTACLE, {}).get("position", 0), place)


def same(one, other):
    """Whether two pages show the same nodes, alike."""

    def told(nodes):
        return {name: {k: v for k, v in node.items() if k != "owner"} for name, node in nodes.items()}

    a, b = told(one.nodes), told(other.nodes)
    return a.keys() == b.keys() and all(
        a[name].keys() == b[name].keys() and all(np.array_equal(a[name][k], b[name][k]) for k in a[name]) for name in a
    )


@asynchronous
async def test_viewers_see_what_the_presenter_draws_early_or_late(url, server):
    async with watching(url) as early:
        assert early.says(NOT_YET) and not early.has_picture
        async with presenting_at(url) as presenter:
            await presenter.set("Pause", True)
            await moved_to(presenter, (0.12, -0.5, 0.4))
            assert await early.wait_for(lambda: stands_at(early, (0.12, -0.5, 0.4)), PATIENCE)
            assert await early.wait_for(lambda: early.says("✓ safe"), PATIENCE)
            assert np.ptp(early.nodes[ROLLOUT]["vertices"]) > 0
            async with watching(url) as late:
                assert await late.wait_for(lambda: same(early, late), 10)
                mine, theirs = presenter.nodes[ROLLOUT]["vertices"], late.nodes[ROLLOUT]["vertices"]
                assert np.array_equal(mine, theirs)
                assert early.says("Draw S") and late.says("Draw S")
