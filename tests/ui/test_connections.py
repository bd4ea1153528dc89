"""Who gets in, and what gets in: real handshakes and messages, against the server that the demo starts."""

import asyncio
import functools
import logging
import os
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from contextlib import AsyncExitStack, asynccontextmanager, closing, contextmanager
from dataclasses import replace
from types import SimpleNamespace
from typing import get_type_hints

import msgspec
import numpy as np
import pytest
import viser  # noqa: TID251 - whose version the page has
import websockets.sync.client
from pages import wait_until
from viser._messages import ResetGuiMessage  # noqa: TID251
from viser.infra._async_message_buffer import AsyncMessageBuffer  # noqa: TID251
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from dt_viz.evaluate.protocol_client import OBSTACLE, ROLLOUT, LostError, ProtocolClient
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS
from dt_viz.serving.board import Board, Share
from dt_viz.serving.listening import listen
from dt_viz.session.cores import Cores, CoresSettings, Rank
from dt_viz.session.progress import Pace
from dt_viz.ui import gate, keeping
from dt_viz.ui import server as server_module
from dt_viz.ui import visitor as visitor_module
from dt_viz.ui.keeping import ATTEMPTS, KEY
from dt_viz.ui.origins import Origin
from dt_viz.ui.panel import MAX_UPLOAD
from dt_viz.ui.patches import GateError, connection_of
from dt_viz.ui.scripts import Ruler, told
from dt_viz.ui.server import Server

PATIENCE = 90.0
"""Seconds that anything may take: the machine may be busy."""
UPLOAD = "Mesh or point cloud"
NUM_PLACES, MAX_WAITING = 2, 8


class Client(ProtocolClient):
    """A visitor who may be sent away."""

    async def __aenter__(self):
        await super().__aenter__()
        return self

    async def is_lost(self) -> bool:
        """Whether the server closes the connection."""
        try:
            return await self.wait_for(lambda: False, PATIENCE)
        except LostError:
            return True


@pytest.fixture(scope="module")
def server(fits):
    allowed = [Origin.parse("https://demo.example.org")]
    places, waiting = NUM_PLACES, MAX_WAITING
    server = Server(
        TASKS, fits, load_jaco(), task="draw_s", port=0, max_sessions=places, max_waiting=waiting, allowed=allowed
    )
    yield server
    server.close()


@pytest.fixture
def url(server):
    """Of the WebSocket; nobody is left over from another test."""
    wait_until(lambda: not server._server.get_clients() and not server.visitors and not server._num_building, PATIENCE)
    return f"ws://127.0.0.1:{server.port}"


def asynchronous(test):
    """Runs a test on an event loop, for so long."""

    @functools.wraps(test)
    def run(**fixtures):
        asyncio.run(asyncio.wait_for(test(**fixtures), 2 * PATIENCE))

    return run


async def come_true(condition):
    await asyncio.to_thread(wait_until, condition, PATIENCE)


@asynccontextmanager
async def visiting(url):
    """A visitor who has the first picture."""
    async with Client(url) as client:
        await client.look()
        assert await client.wait_for(lambda: client.has_picture, PATIENCE)
        yield client


def grow_idle(server, seconds):
    """All visitors have done nothing for so long."""
    for client_id in server._server.get_clients():
        connection_of(server._server, client_id).active -= seconds


async def answers(client):
    """Whether the page still does what it is told."""

    def shown():
        return client.nodes["/table"].get("visible", True)

    wanted = not shown()
    await client.set("Table", wanted)
    return await client.wait_for(lambda: shown() == wanted, PATIENCE)


async def status_of(url, **options):
    """Of the handshake's answer; 101 where it became a connection."""
    protocols = [Subprotocol(f"viser-v{viser.__version__}")]
    try:
        async with connect(url, subprotocols=protocols, proxy=None, **options):
            return 101
    except websockets.InvalidStatus as error:
        return error.response.status_code


# --- whose pages ---


@pytest.mark.parametrize(
    ("origin", "status"),
    [(None, 101), ("http://127.0.0.1:{port}", 101), ("https://demo.example.org", 101), ("https://evil.example", 403)],
)
@asynchronous
async def test_programs_the_own_page_and_allowed_ones_may_connect_and_others_may_not(url, server, origin, status):
    assert await status_of(url, origin=origin and origin.format(port=server.port)) == status


@asynchronous
async def test_two_origins_are_one_too_many(url, server):
    own = f"http://127.0.0.1:{server.port}"
    assert await status_of(url, origin=own, additional_headers={"Origin": own}) == 403


@asynchronous
async def test_a_name_that_was_made_to_resolve_to_the_server_is_refused(server):
    """The browser connects to 127.0.0.1, and the page is from what it takes for the same server."""
    name = f"evil.example:{server.port}"
    sock = socket.create_connection(("127.0.0.1", server.port))
    assert await status_of(f"ws://{name}", sock=sock, origin=f"http://{name}") == 421


def test_the_page_is_not_given_out_under_such_a_name_either(url, server):
    page = f"http://127.0.0.1:{server.port}/"
    with urllib.request.urlopen(page) as answer:
        assert b"viser" in answer.read().lower()
        policy = answer.headers["Content-Security-Policy"]
        assert policy.endswith("frame-ancestors 'self' https://demo.example.org:443") and "default-src 'self'" in policy
        assert answer.headers["X-Content-Type-Options"] == "nosniff"
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(urllib.request.Request(page, headers={"Host": "evil.example"}))
    assert refused.value.code == 421
    assert b"--allow-origin" in refused.value.read()


def told_to_prometheus(server, host="127.0.0.1"):
    """Status of the answer, and its values by their names."""
    request = urllib.request.Request(f"http://127.0.0.1:{server.port}/metrics", headers={"Host": host})
    try:
        with urllib.request.urlopen(request) as answer:
            lines = [line.rsplit(" ", 1) for line in answer.read().decode().splitlines() if line[0] != "#"]
            return answer.status, {name: float(value) for name, value in lines}
    except urllib.error.HTTPError as error:
        return error.code, {}


@asynchronous
async def test_prometheus_is_told_what_visitors_do_and_nobody_is_under_a_foreign_name(url, server):
    pytest.importorskip("prometheus_client")
    assert (await asyncio.to_thread(told_to_prometheus, server, "evil.example"))[0] == 421
    status, at_first = await asyncio.to_thread(told_to_prometheus, server)
    async with visiting(url) as client:
        (visitor,) = server.visitors
        assert await asyncio.to_thread(visitor.session.wait_idle, PATIENCE)
        _, before = await asyncio.to_thread(told_to_prometheus, server)
        num_edits = visitor.session._edits.number
        await client.grab()
        for k in range(5):
            shown = client.nodes[ROLLOUT]["vertices"]
            await client.move((0.1, -0.5, 0.345 + 0.01 * k))
            assert await client.wait_for(lambda shown=shown: client.nodes[ROLLOUT]["vertices"] is not shown, PATIENCE)
        await client.release()
        assert await answers(client)
        assert await asyncio.to_thread(visitor.session.wait_idle, PATIENCE)
        _, after = await asyncio.to_thread(told_to_prometheus, server)
    assert await status_of(url, origin="https://evil.example") == 403
    _, refused = await asyncio.to_thread(told_to_prometheus, server)
    assert status == 200 and at_first["dt_viz_visitors"] == 0 and after["dt_viz_visitors"] == 1
    grown = {name: after[f"dt_viz_{name}"] - before[f"dt_viz_{name}"] for name in ("edits_total", "frames_total")}
    assert 5 <= grown["edits_total"] == visitor.session._edits.number - num_edits
    assert 2 <= grown["frames_total"] <= grown["edits_total"]
    assert after["dt_viz_latency_seconds_sum"] > before["dt_viz_latency_seconds_sum"]
    assert refused["dt_viz_refused_requests_total"] == after["dt_viz_refused_requests_total"] + 1


@asynchronous
async def test_a_page_of_another_version_is_told_so_as_viser_does(url, capfd):
    async with connect(url, subprotocols=[Subprotocol("viser-v0.0.1")], proxy=None) as client:
        with pytest.raises(websockets.ConnectionClosedError) as closed:
            await asyncio.wait_for(client.recv(), PATIENCE)
    assert closed.value.rcvd is not None and closed.value.rcvd.code == 1002
    assert "0.0.1" not in "".join(capfd.readouterr())


# --- how many ---


@asynchronous
async def test_there_are_only_so_many_connections(url, server):
    async with AsyncExitStack() as stack:
        for _ in range(NUM_PLACES + MAX_WAITING):
            await stack.enter_async_context(Client(url))
        assert await status_of(url) == 503
    await come_true(lambda: not server._server._websock_server._live_connections)
    assert await status_of(url) == 101


@asynchronous
async def test_no_address_takes_all_of_them(url, server, monkeypatch):
    """A proxy on this machine says who has connected to it; of IPv6 a network is one."""
    assert server.gate.limits.of_address == (NUM_PLACES + MAX_WAITING) // 2
    monkeypatch.setattr(server.gate, "limits", replace(server.gate.limits, of_address=2))
    networks = [["203.0.113.7", "8.8.8.8, 203.0.113.7", "203.0.113.7"], ["2001:db8::1", "2001:db8::2", "2001:db8::3"]]
    async with AsyncExitStack() as stack:
        for addresses in networks:
            headers = [{"X-Forwarded-For": address} for address in addresses]
            for each in headers[:2]:
                protocols = [Subprotocol(f"viser-v{viser.__version__}")]
                client = connect(url, subprotocols=protocols, proxy=None, additional_headers=each)
                await stack.enter_async_context(client)
            assert await status_of(url, additional_headers=headers[2]) == 429
        assert await status_of(url, additional_headers={"X-Forwarded-For": "203.0.113.8"}) == 101
        assert await status_of(url) == 101


@asynchronous
async def test_visitors_of_one_address_owe_what_any_of_them_uses(url, server):
    async with AsyncExitStack() as stack:
        for _ in range(NUM_PLACES):
            client, headers = Client(url), {"X-Forwarded-For": "203.0.113.7"}
            client._connect = functools.partial(client._connect, additional_headers=headers)
            await (await stack.enter_async_context(client)).look()
        await come_true(lambda: len(server.visitors) == NUM_PLACES)
        one, other = (visitor.session.jobs._account for visitor in server.visitors)
        one.charge(1000.0)
        assert one.debt > other.debt > 1
    await come_true(lambda: not server.visitors)
    async with visiting(url):
        (visitor,) = server.visitors
        assert not visitor.session.jobs._account.debt


@asynchronous
async def test_who_waits_is_told_so_and_has_the_next_place_that_is_free(url, server):
    def says(client, text):
        return any(text in str(control) for control in client.controls.values())

    def waits(client):
        return says(client, "places are taken")

    async with AsyncExitStack() as stack:
        seated, waiting = ([Client(url) for _ in range(number)] for number in (NUM_PLACES, 3))
        for client in seated:
            await (await stack.enter_async_context(client)).look()
        await come_true(lambda: len(server.visitors) == NUM_PLACES)
        for client in waiting:
            await (await stack.enter_async_context(client)).look()
            assert await client.wait_for(lambda c=client: waits(c), PATIENCE)
        gone, first, last = waiting
        server.attend()
        assert await last.wait_for(lambda: says(last, "2 before you"), PATIENCE)
        assert says(gone, "You are next")
        await gone.__aexit__(None, None, None)
        await come_true(lambda: len(server._server.get_clients()) == NUM_PLACES + 2)
        await come_true(lambda: server.attend() or says(last, "1 before you"))
        await seated[0].__aexit__(None, None, None)
        assert await first.wait_for(lambda: first.has_picture, PATIENCE)
        assert not waits(first) and waits(last) and len(server.visitors) == NUM_PLACES


@asynchronous
async def test_nobody_waits_for_who_came_before_to_another_process_while_both_have_a_place(url, server, monkeypatch):
    """Nobody attends to those who wait: they would have a place at last, one every half second."""
    board = Board(2, NUM_PLACES + MAX_WAITING)
    here, elsewhere = Share(board, 0), Share(board, 1)
    elsewhere.seat(0, [0.0])
    monkeypatch.setattr(server, "_share", here)
    async with visiting(url), Client(url) as waiting:
        await waiting.look()
        assert await waiting.wait_for(lambda: here.num_waiting == 2, PATIENCE)
        assert not await waiting.wait_for(lambda: waiting.has_picture, 0.5)
        elsewhere.seat(0, [])
        await asyncio.to_thread(server.attend)
        assert await waiting.wait_for(lambda: waiting.has_picture, PATIENCE)


@pytest.mark.long
@asynchronous
async def test_who_does_nothing_gives_his_place_to_one_who_waits_and_only_then(url, server):
    async with AsyncExitStack() as stack:
        idle, busy, waiting = [Client(url) for _ in range(NUM_PLACES + 1)]
        for client in (idle, busy):
            await (await stack.enter_async_context(client)).look()
            assert await client.wait_for(lambda c=client: c.has_picture, PATIENCE)
        await come_true(lambda: len(server.visitors) == NUM_PLACES)
        grow_idle(server, 2 * server_module.IDLE)
        server.attend()
        assert not await idle.wait_for(lambda: idle.lost, 0.5)  # nobody waits
        await (await stack.enter_async_context(waiting)).look()
        assert await waiting.wait_for(lambda: waiting.controls, PATIENCE)
        grow_idle(server, 2 * server_module.IDLE)  # what a page answers by itself counts, too
        await busy.look()
        assert await answers(busy)
        server.attend()
        with pytest.raises(LostError):
            await idle.wait_for(lambda: False, PATIENCE)
        assert server_module.LEAVING in idle.notices
        assert await waiting.wait_for(lambda: waiting.has_picture, PATIENCE)
        server.attend()
        assert not busy.lost and len(server.visitors) == NUM_PLACES


@asynchronous
@pytest.mark.parametrize(
    ("num_cores", "seconds", "expected"),
    [
        (1, 2 * server_module.NEGLECTED, [True, False]),
        (2, 2 * server_module.NEGLECTED, [False, False]),
        (2, 2 * server_module.IDLE, [True, False]),
    ],
)
async def test_the_arm_of_a_page_that_nobody_touches_rests_and_soon_where_many_are_here(
    url, server, monkeypatch, num_cores, seconds, expected
):
    monkeypatch.setattr(server_module.os, "cpu_count", lambda: num_cores)
    async with Client(url) as idle, Client(url) as busy:
        for client in (idle, busy):
            await client.look()
            assert await client.wait_for(lambda c=client: c.has_picture, PATIENCE)
        found = None
        for _ in range(5):  # a page may still answer by itself, which counts as its visitor's
            grow_idle(server, seconds)
            await busy.look()
            assert await answers(busy)
            server.attend()
            if (found := [visitor.robot.playback.neglected for visitor in server.visitors]) == expected:
                break
            await asyncio.sleep(0.2)
        assert found == expected
        await idle.look()
        assert await answers(idle)
        server.attend()
        assert not any(visitor.robot.playback.neglected for visitor in server.visitors)


@asynchronous
async def test_the_arm_of_a_page_moves_only_between_hands(url, server, monkeypatch):
    """Also one that takes another's place."""
    may_move, between_hands, asked = threading.Event(), Cores.between_hands, []
    may_move.set()

    @contextmanager
    def counted(cores):
        asked.append(True)
        with between_hands(cores):
            may_move.wait(PATIENCE)
            yield

    monkeypatch.setattr(Cores, "between_hands", counted)
    async with Client(url) as client:
        await client.look()
        assert await client.wait_for(lambda: client.has_picture, PATIENCE)
        (visitor,) = server.visitors
        for _ in range(2):
            robot, before = visitor.robot, len(asked)
            moments = lambda: robot.playback.recording.past.times[-1]  # noqa: B023, E731
            await asyncio.to_thread(wait_until, lambda: len(asked) > before + 5, PATIENCE)  # noqa: B023
            await asyncio.to_thread(wait_until, lambda: robot.playback.recording.past is not None, PATIENCE)  # noqa: B023
            may_move.clear()
            await asyncio.sleep(0.3)
            held = moments()
            await asyncio.sleep(0.5)
            assert moments() == held
            may_move.set()
            await asyncio.to_thread(wait_until, lambda: moments() > held, PATIENCE)  # noqa: B023
            await asyncio.to_thread(visitor._exchange, "")


@asynchronous
async def test_a_page_is_built_before_anybody_refines_and_after_first_pictures(url, monkeypatch):
    """While it asks the browser, no slot is taken: others need it, and a browser may not answer at all."""
    cores, asked, taken = Cores(2, CoresSettings(patience=10 * PATIENCE)), [], []
    slot = cores.slot
    monkeypatch.setattr(visitor_module, "CORES", cores)
    monkeypatch.setattr(cores, "slot", lambda rank=Rank.HAND, *more: (taken.append(rank), slot(rank, *more))[1])
    ask = keeping.Keeper._ask
    held = lambda: [place.rank for place in cores._held]  # noqa: E731
    monkeypatch.setattr(keeping.Keeper, "_ask", lambda keeper: (asked.extend(held()), ask(keeper))[1])
    async with Client(url) as client:
        with slot(Rank.BEGINNING):
            await client.look()
            await come_true(lambda: cores.queue)
            assert not await client.wait_for(lambda: client.controls, 0.5)
        assert await client.wait_for(lambda: client.has_picture, PATIENCE)
    assert (taken, asked) == ([Rank.PAGE], [Rank.BEGINNING])  # which is this test


@asynchronous
async def test_nobody_builds_the_page_of_who_has_left_while_it_waited(url, server, monkeypatch, caplog):
    cores, built = Cores(2, CoresSettings(patience=10 * PATIENCE)), []
    monkeypatch.setattr(visitor_module, "CORES", cores)
    monkeypatch.setattr(visitor_module, "ScenePictures", lambda *_what: built.append(True))
    with cores.slot(Rank.BEGINNING):
        async with Client(url) as client:
            await client.look()
            await come_true(lambda: cores.queue)
        await come_true(lambda: not cores.queue and not server._num_building)
    assert not built and not server.visitors
    assert not [record for record in caplog.records if record.levelno >= logging.ERROR]


@asynchronous
async def test_open_sockets_are_bounded_too(url, server, monkeypatch):
    def ended(sock):
        try:
            return sock.recv(1) == b""
        except ConnectionResetError:
            return True

    monkeypatch.setattr(server.gate, "limits", replace(server.gate.limits, sockets=3))
    async with AsyncExitStack() as stack:
        sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(4)]
        for each in sockets:
            stack.callback(each.close)
        sockets[-1].settimeout(PATIENCE)
        assert await asyncio.to_thread(ended, sockets[-1])


def test_who_leaves_before_the_page_is_built_keeps_no_place(server, url):
    """The callbacks of viser run in threads, in any order."""

    class Gone:
        client_id = 10**6

    server._farewell(Gone)
    server._welcome(Gone)
    assert Gone.client_id not in server._visitors


# --- what ---


@asynchronous
async def test_what_the_page_does_not_use_is_not_served(url, server, monkeypatch):
    asked = []
    for method in ("request_share_url", "disconnect_share_url"):
        monkeypatch.setattr(server._server, method, lambda method=method: asked.append(method))
    kept = server._server._websock_server._broadcast_buffer.message_from_id
    async with visiting(url) as client:
        before = len(kept)
        await client.send("ShareUrlRequest")
        await client.send("ShareUrlDisconnect")
        for k in range(50):
            await client.send("GuiFormDirtyMessage", uuid=f"{k}")
            await client.send("GuiFormSubmitMessage", uuid=f"{k}")
        await client.send("GuiCloseModalMessage", uuid="x")
        await client.send("NoSuchMessage", whatever=1)
        assert await answers(client)
    assert not asked
    assert len(kept) == before


def packed(kind, **content):
    return msgspec.msgpack.encode({"type": kind, **content})


MALFORMED = {
    "text": "hello",
    "no bytes": b"",
    "no map": b"\x93\x01\x02\x03",
    "cut off": b"\x82\xa4type\xb3ViewerCamera",
    "no kind": msgspec.msgpack.encode({"name": "x"}),
    "kind of another type": packed(7),
    "no text in a text": b"\x81\xa4type\xa2\xff\xff",
    "field of another type": packed("TransformControlsDragStartMessage", name=7, owner="secret"),
    "field that is missing": packed("TransformControlsUpdateMessage", name="secret"),
    "field that there is not": packed("TransformControlsDragStartMessage", name="secret", owner="", secret=1),
    "number too many": packed(
        "TransformControlsUpdateMessage", name="secret", wxyz=[1, 0, 0, 0], position=[1, 2, 3, 4]
    ),
    "other property of a control": packed("GuiUpdateMessage", uuid="secret", updates={"removed": True}),
    "value that no control has": packed("GuiUpdateMessage", uuid="secret", updates={"value": {"a": [1]}}),
    "nested deep": b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates" + b"\x91" * 50_000,
    "large": packed("SceneNodeClickMessage", name="secret" * 20_000),
    "kept of another type": packed(gate.STORED, value=["secret"], error=None, request_uuid=""),
    "kept without an answer": packed(gate.STORED, value="secret"),
}


@pytest.mark.parametrize("raw", MALFORMED.values(), ids=MALFORMED)
@asynchronous
async def test_a_message_that_no_page_sends_ends_its_connection(url, raw, caplog, capfd):
    async with Client(url) as client:
        await client.look()
        await client.send_raw(raw)
        assert await client.is_lost()
    printed = "".join(capfd.readouterr())
    assert "Traceback" not in caplog.text + printed
    assert "secret" not in caplog.text + printed


@pytest.mark.parametrize("text", ["{", "x" * 10**6], ids=["damaged", "too large for a message"])
@asynchronous
async def test_whatever_a_browser_keeps_the_page_opens_in_time_says_so_and_goes_on(url, server, text):
    async with Client(url) as client:
        client.storage = {KEY: text}
        await client.look()
        began = time.monotonic()
        await come_true(lambda: server.visitors)
        assert time.monotonic() - began < ATTEMPTS * keeping.PATIENCE / 2  # it is not asked again and again before
        assert await client.wait_for(lambda: client.has_picture and client.notices, PATIENCE)
        assert "begins anew" in " ".join(client.notices)
        await client.set("Warp", 0.5)
        await come_true(lambda: '"warp":0.5' in client.storage.get(KEY, ""))
        assert await answers(client)


@asynchronous
async def test_what_nobody_has_asked_a_browser_for_changes_nothing(url, server):
    async with visiting(url) as client:
        (visitor,) = server.visitors
        before = visitor.session.scenario
        for size in (10, 10**6):
            for error in (None, "forbidden"):
                await client.send(gate.STORED, value="x" * size, error=error, request_uuid="forged")
        assert await answers(client)
        assert visitor.session.scenario.choices == before.choices


@asynchronous
async def test_it_ends_no_other_connection(url):
    async with visiting(url) as client, Client(url) as other:
        await other.look()
        await other.send_raw(b"\xc1")
        assert await other.is_lost()
        assert await answers(client)


@asynchronous
async def test_forged_values_change_nothing_and_break_nothing(url, server):
    async with visiting(url) as client:
        (visitor,) = server.visitors
        before, camera = visitor.session.scenario, np.array(visitor.client.camera.position)
        forged = {"name": OBSTACLE, "owner": client.nodes[OBSTACLE]["owner"], "wxyz": [1, 0, 0, 0]}
        pose = {"wxyz": [1, 0, 0, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
        pose |= dict.fromkeys(("fov", "near", "far", "image_height", "image_width"), 1)
        for number in (float("nan"), float("inf"), -float("inf")):
            await client.send("TransformControlsUpdateMessage", **forged, position=[0, number, 0])
            await client.set("Margin [cm]", number)
            await client.send("ViewerCameraMessage", **pose, position=[number, 0, 0])
        await client.set("Margin [cm]", "no number")
        await client.send("TransformControlsUpdateMessage", **forged | {"owner": "another"}, position=[9, 9, 9])
        await client.send("TransformControlsUpdateMessage", **forged | {"name": "/nothing"}, position=[9, 9, 9])
        await client.send("GuiUpdateMessage", uuid="nothing", updates={"value": 1})
        await client.send("GetRenderResponseMessage", payload=b"", render_uuid="nothing")
        assert await answers(client)
        after = visitor.session.scenario
        assert (after.avoidance.margin, after.obstacles) == (before.avoidance.margin, before.obstacles)
        np.testing.assert_array_equal(visitor.client.camera.position, camera)


@pytest.mark.long
@asynchronous
async def test_a_flood_is_slowed_down(url, server):
    async with visiting(url) as client:
        began = time.monotonic()
        for _ in range(3 * int(server.gate.limits.rate)):
            await client.send("NoSuchMessage")
        assert await answers(client)
        assert time.monotonic() - began > 1  # the second that it began in may have been over at once


@pytest.mark.long
@asynchronous
async def test_what_callbacks_raise_is_in_the_log_without_what_was_sent(url, caplog, capfd):
    def of_the_gate():
        return [record for record in caplog.records if record.name == gate.logger.name]

    async with visiting(url) as client:
        caplog.clear()
        await client.set("Margin [cm]", "secret")
        assert await answers(client)
        await come_true(of_the_gate)
    (record,) = of_the_gate()
    assert record.levelno == logging.ERROR and record.exc_info
    assert "secret" not in record.getMessage() + "".join(capfd.readouterr())


@asynchronous
async def test_a_visitor_who_does_not_listen_costs_no_memory(url, server):
    """What is not sent yet is replaced by what is newer."""
    async with visiting(url) as client:
        (visitor,) = server.visitors
        (state,) = server._server._websock_server._client_state_from_id.values()
        client._receiving.cancel()
        await asyncio.gather(client._receiving, return_exceptions=True)
        client._socket.transport.pause_reading()
        visitor.client.add_notification("", os.urandom(2**23).hex())  # fills all buffers on the way
        drawn = visitor.shown.drawn
        frames = visitor.shown, replace(visitor.shown, drawn=replace(drawn, positions=drawn.positions + 0.01))
        held = []
        for frame in 10 * frames:
            visitor.draw(frame, Pace(0.02, 10.0, 0))
            held.append(len(state.message_buffer.message_from_id))
            await asyncio.sleep(0.01)
        assert 5 < max(held) < 50, held  # a frame has about ten messages; some are taken to be sent, and wait there
        client._socket.transport.abort()  # who does not listen says no goodbye either
        client._receiving = asyncio.create_task(asyncio.sleep(0))


# --- files ---


def uploads_of(visitor):
    return visitor.client.gui._current_file_upload_states


@pytest.mark.long
@pytest.mark.parametrize(
    ("content", "announced", "said"),
    [
        (bytes(3 * 2**20), MAX_UPLOAD + 1, "x.stl: file: found 50.0 MB; accepted: at most 50 MB"),
        (bytes(2**20), None, "x.stl: "),  # it arrives, and is no mesh
    ],
    ids=["announced too large", "no mesh"],
)
@asynchronous
async def test_what_is_wrong_with_a_file_is_said_and_none_of_it_is_held(url, server, content, announced, said):
    async with visiting(url) as client:
        kinds, apply = [], client._apply
        client._apply = lambda message, now: (kinds.append(message["type"]), apply(message, now))[1]
        await client.send_file(UPLOAD, "x.stl", content, announced=announced)
        assert await client.wait_for(lambda: client.notices, PATIENCE)
        assert client.notices[0].startswith(said) and len(client.notices) == 1
        # the page's own notice of an upload is hidden before it says that it was successful
        upload = [kind for kind in kinds if kind in {"FileTransferPartAck", "RemoveNotificationMessage"}]
        assert sorted(upload[-2:]) == ["FileTransferPartAck", "RemoveNotificationMessage"]
        assert await answers(client)
        assert not uploads_of(server.visitors[0])


@asynchronous
async def test_a_file_that_is_larger_than_announced_ends_the_connection(url):
    async with visiting(url) as client:
        with pytest.raises(LostError):
            await client.send_file(UPLOAD, "x.stl", bytes(3 * 2**20), announced=2**20 + 1)
            assert await client.is_lost()
            await client.look()


# --- viser ---


def a_gate():
    return gate.Gate(gate.Origins("127.0.0.1"), gate.Limits(1, 1, upload=1), lambda *_: None)


def test_a_viser_that_serves_in_another_way_is_refused(monkeypatch):
    stopped = []

    class Other:
        def __init__(self, **_options):
            pass

        def stop(self):
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Other)
    with (
        closing(listen("127.0.0.1", 0)) as listening,
        pytest.raises(GateError, match=r"viser .* has changed .*; accepted: viser 1\.1"),
    ):
        a_gate().open(listening, "")
    assert stopped


def test_who_comes_while_the_server_is_made_waits_for_it(monkeypatch, caplog):
    """As at a socket on which other processes have listened before."""
    clients = []

    def connect(_stop):  # which viser registers while it is half made
        protocol = Subprotocol(f"viser-v{viser.__version__}")
        clients.append(websockets.sync.client.connect(url, subprotocols=[protocol], proxy=None))
        time.sleep(0.5)

    monkeypatch.setattr("viser._viser.atexit", SimpleNamespace(register=connect, unregister=lambda _: None))
    with closing(listen("127.0.0.1", 0)) as listening:
        url = f"ws://127.0.0.1:{listening.getsockname()[1]}"
        server = a_gate().open(listening, "")
        try:
            assert clients[0].recv(PATIENCE)
            assert not [record for record in caplog.records if record.levelno >= logging.ERROR]
        finally:
            clients[0].close()
            server.stop()


@asynchronous
async def test_what_a_thread_tells_is_sent_also_just_before_the_loop_waits_for_it(server, monkeypatch):
    loop = asyncio.get_running_loop()
    buffer, new_future = AsyncMessageBuffer(loop, persistent_messages=False), loop.create_future

    def create_future():
        caller = sys._getframe(1)
        if caller.f_code is asyncio.Event.wait.__code__ and caller.f_locals["self"] is buffer.message_event:
            monkeypatch.undo()  # once: it has seen that the event is not set, and does not wait yet
            thread = threading.Thread(target=buffer.push, args=(ResetGuiMessage(),))
            thread.start()
            thread.join()
        return new_future()

    monkeypatch.setattr(loop, "create_future", create_future)
    windows = buffer.window_generator(0)
    assert [type(message) for message in await asyncio.wait_for(anext(windows), PATIENCE)] == [ResetGuiMessage]
    await windows.aclose()


@asynchronous
async def test_a_thread_wakes_nobody_itself_but_has_the_loop_do_so(server):
    buffer = AsyncMessageBuffer(asyncio.get_running_loop(), persistent_messages=False)
    thread = threading.Thread(target=buffer.push, args=(ResetGuiMessage(),))
    thread.start()
    thread.join()
    assert not buffer.message_event.is_set()
    await asyncio.wait_for(buffer.message_event.wait(), PATIENCE)
    buffer.message_event.clear()
    buffer.push(ResetGuiMessage())
    assert buffer.message_event.is_set()


def test_a_viser_with_other_messages_is_refused(monkeypatch):
    monkeypatch.delattr("viser._messages.SceneNodeDragMessage")
    with pytest.raises(GateError, match=r"SceneNodeDragMessage.*; accepted: viser 1\.1"):
        a_gate()


def test_the_types_of_properties_are_evaluated_once_for_each_class(server):
    scene = server._server.scene
    handles = [scene.add_frame("/typed"), scene.add_frame("/typed/too"), scene.add_label("/typed/label", "")]
    hints = [handle._prop_hints for handle in handles]
    assert hints[0] is hints[1] and hints == [get_type_hints(type(handle._impl.props)) for handle in handles]
    handles[0].remove()


@pytest.mark.parametrize("path", ["/", "/window/a", "/window/a/9999999", "/window/a/20", "/window/a b/390", "/390"])
def test_other_requests_tell_no_width(path):
    assert told("/window/a/390") == ("a", 390.0)
    assert told(path) is None


@asynchronous
async def test_a_browser_tells_the_width_of_its_own_window(server, url):
    async with visiting(url) as client:
        (visitor,) = server.visitors
        assert any(control.get("content") == visitor.ruler.html for control in client.controls.values())
        for ruler, width in ((Ruler(), None), (visitor.ruler, 390)):
            address = f"http://127.0.0.1:{server.port}/window/{ruler.token}/390"
            with await asyncio.to_thread(urllib.request.urlopen, address) as response:
                assert response.status == 204
            assert visitor._camera._width == width
