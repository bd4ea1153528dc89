"""Who gets in, and what gets in: real handshakes and messages, against the server that the demo starts."""

import asyncio
import contextlib
import itertools
import os
import re
import socket
import sys
import threading
import time
import urllib.error
import urllib.request
from concurrent.futures import Future
from contextlib import AsyncExitStack, asynccontextmanager, closing
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import numpy as np
import pytest
import viser  # noqa: TID251 - whose version the page has
import websockets.sync.client
from pages import asynchronous, come_true, wait_until
from protocol_client import OBSTACLE, LostError, ProtocolClient
from viser._messages import ResetGuiMessage  # noqa: TID251
from viser.infra._async_message_buffer import AsyncMessageBuffer  # noqa: TID251
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS
from dt_viz.serving.board import Share
from dt_viz.serving.supervisor import listen
from dt_viz.session.progress import Pace
from dt_viz.ui import gate
from dt_viz.ui import server as server_module
from dt_viz.ui.keeping import KEY
from dt_viz.ui.patches import GateError, connection_of
from dt_viz.ui.server import Server

PATIENCE = 90.0  # seconds that anything may take: the machine may be busy
UPLOAD = "Mesh or point cloud"
NUM_PLACES, MAX_WAITING = 2, 8


class Client(ProtocolClient):
    """A visitor who may be sent away."""

    async def is_lost(self) -> bool:
        """Whether the server closes the connection."""
        try:
            return await self.wait_for(lambda: False, PATIENCE)
        except LostError:
            return True


@pytest.fixture(scope="module")
def server(fits):
    allowed = [gate.origin_of("https://demo.example.org")]
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


@asynccontextmanager
async def visiting(url):
    """A visitor who has the first picture."""
    async with Client(url) as client:
        assert await client.look_until_drawn(PATIENCE)
        yield client


async def only_visitor(server):
    await come_true(lambda: server.visitors)  # the first picture may be there before the page is built
    (visitor,) = server.visitors
    return visitor


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
    ("host", "origins", "status"),
    [
        ("127.0.0.1", [], 101),
        ("127.0.0.1", ["http://127.0.0.1:{port}"], 101),
        ("127.0.0.1", ["https://demo.example.org"], 101),
        ("127.0.0.1", ["https://evil.example"], 403),
        ("127.0.0.1", 2 * ["http://127.0.0.1:{port}"], 403),
        ("evil.example", ["http://evil.example:{port}"], 421),  # a name that was made to resolve to the server
    ],
)
@asynchronous
async def test_programs_the_own_page_and_allowed_ones_may_connect_and_others_may_not(
    url, server, host, origins, status
):
    headers = [("Origin", origin.format(port=server.port)) for origin in origins]
    sock = socket.create_connection(("127.0.0.1", server.port))
    assert await status_of(f"ws://{host}:{server.port}", sock=sock, additional_headers=headers) == status


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
    told = lambda *host: asyncio.to_thread(told_to_prometheus, server, *host)  # noqa: E731
    assert (await told("evil.example"))[0] == 421
    async with visiting(url) as client:
        visitor = await only_visitor(server)
        assert await asyncio.to_thread(visitor.session.wait_idle, PATIENCE)
        (_, before), num_edits = await told(), visitor.session._screen.num_edits
        await client.set("Warp", 0.5)
        await come_true(lambda: visitor.shown is not None and visitor.shown.scenario.warp == 0.5)
        assert await asyncio.to_thread(visitor.session.wait_idle, PATIENCE)
        status, after = await told()
    assert await status_of(url, origin="https://evil.example") == 403
    await come_true(lambda: not server.visitors)
    _, refused = await told()
    assert status == 200 and after["dt_viz_visitors"] == 1 and refused["dt_viz_visitors"] == 0
    grown = {name: after[f"dt_viz_{name}"] - before[f"dt_viz_{name}"] for name in ("edits_total", "frames_total")}
    assert 1 <= grown["frames_total"] <= grown["edits_total"] == visitor.session._screen.num_edits - num_edits
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
    assert server.gate.of_address == (NUM_PLACES + MAX_WAITING) // 2
    monkeypatch.setattr(server.gate, "of_address", 2)
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


@pytest.mark.long
@asynchronous
async def test_who_does_nothing_gives_his_place_to_one_who_waits_and_only_then(url, server):
    async with AsyncExitStack() as stack:
        idle, busy, waiting = [Client(url) for _ in range(NUM_PLACES + 1)]
        for client in (idle, busy):
            assert await (await stack.enter_async_context(client)).look_until_drawn(PATIENCE)
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

    def neglected():
        server.attend()
        return [visitor.robot.playback.neglected for visitor in server.visitors]

    async with visiting(url) as idle, visiting(url) as busy:

        async def rests():  # a page may still answer by itself, which counts as its visitor's
            grow_idle(server, seconds)
            await busy.look()
            assert await answers(busy)
            return neglected() == expected

        assert any([await rests() for _ in range(3)])
        await idle.look()
        assert await answers(idle)
        assert not any(neglected())


@asynchronous
async def test_open_sockets_are_bounded_too(url, server, monkeypatch):
    def ended(sock):
        try:
            return sock.recv(1) == b""
        except ConnectionResetError:
            return True

    monkeypatch.setattr(gate, "MAX_SOCKETS", 3)
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


AT = {"start_position": [0, 0, 0], "end_position": [0, 0, 0], "start_screen_pos": [0, 0], "end_screen_pos": [0, 0]}
DRAG = {"phase": "end", "name": OBSTACLE, "instance_index": None, "button": "left", "modifier": None, **AT}
POSE = {"wxyz": [1, 0, 0, 0], "position": [0, 0, 0], "look_at": [0, 0, 0], "up_direction": [0, 0, 1]}
POSE |= dict.fromkeys(("fov", "near", "far", "image_height", "image_width"), 1)
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
    **{
        kind: packed("TransformControlsUpdateMessage", name="secret", wxyz=[1, 0, 0, 0], position=position)
        for kind, position in (
            ("number too many", [1, 2, 3, 4]),
            ("number too few", [1, 2]),
            ("no number", ["secret"] * 3),
        )
    },
    "no place": packed("ScenePointerMessage", event_type="click", ray_origin=[], ray_direction="secret", screen_pos=[]),
    "no camera": packed("ViewerCameraMessage", **POSE | {"position": ["secret", 0, 0]}),
    "no window": packed("ViewerCameraMessage", **POSE | {"image_width": "secret"}),
    "no phase of a drag": packed("SceneNodeDragMessage", **DRAG | {"phase": "secret"}),
    "no turn": packed("TransformControlsUpdateMessage", name="secret", wxyz=None, position=[1, 2, 3]),
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
    failed = [record for record in caplog.records if record.exc_info and record.name != "websockets.server"]
    assert not failed and "Traceback" not in printed  # of websockets' are connections of other tests that just ended
    assert "secret" not in caplog.text + printed


@asynchronous
async def test_whatever_a_browser_keeps_the_page_opens_says_so_and_goes_on(url, server):
    async with Client(url) as client:
        client.storage = {KEY: "x" * 10**6}  # too large for a message
        await client.look()
        assert await client.wait_for(lambda: client.has_picture and client.notices, PATIENCE)
        assert "begins anew" in " ".join(client.notices)
        await client.set("Warp", 0.5)
        await come_true(lambda: '"warp":0.5' in client.storage.get(KEY, ""))
        assert await answers(client)


@asynchronous
async def test_what_nobody_has_asked_a_browser_for_changes_nothing(url, server):
    async with visiting(url) as client:
        visitor = await only_visitor(server)
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
        visitor = await only_visitor(server)
        before, camera = visitor.session.scenario, np.array(visitor.client.camera.position)
        forged = {"name": OBSTACLE, "owner": client.nodes[OBSTACLE]["owner"], "wxyz": [1, 0, 0, 0]}
        for number in (float("nan"), float("inf"), -float("inf")):
            await client.send("TransformControlsUpdateMessage", **forged, position=[0, number, 0])
            await client.set("Margin [cm]", number)
            await client.send("ViewerCameraMessage", **POSE | {"position": [number, 0, 0]})
            await client.send("SceneNodeDragMessage", **DRAG | {"end_position": [0, number, 0]})
        await client.set("Margin [cm]", "no number")
        await client.set("Margin [cm]", "nan")  # viser makes it a number
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
        for _ in range(3 * int(gate.MAX_RATE)):
            await client.send("NoSuchMessage")
        assert await answers(client)
        assert time.monotonic() - began > 1  # the second that it began in may have been over at once


@asynchronous
async def test_a_visitor_who_does_not_listen_costs_no_memory(url, server):
    """What is not sent yet is replaced by what is newer."""
    async with visiting(url) as client:
        visitor = await only_visitor(server)
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
        (bytes(3 * 2**20), gate.MAX_UPLOAD + 1, "x.stl: file: found 50.0 MB; accepted: at most 50 MB"),
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
async def test_a_file_that_is_not_sent_to_the_end_is_forgotten_where_the_next_one_begins(url, server):
    async with visiting(url) as client:
        for number in range(3):
            await client.send_file(UPLOAD, "x.stl", b"", announced=2**20, transfer=f"unfinished-{number}")
            assert await answers(client)
        assert [*uploads_of(server.visitors[0])] == ["unfinished-2"]


@asynchronous
async def test_a_file_that_is_larger_than_announced_ends_the_connection(url):
    async with visiting(url) as client:
        with pytest.raises(LostError):
            await client.send_file(UPLOAD, "x.stl", bytes(3 * 2**20), announced=2**20 + 1)
            assert await client.is_lost()
            await client.look()


# --- viser ---


def gate_at(listening):
    return gate.Gate(listening, gate.Origins("127.0.0.1"), 1, 1, 1, lambda *_: None, Share(1, 1))


def test_a_viser_that_serves_in_another_way_is_refused(monkeypatch):
    stopped = []
    monkeypatch.setattr(viser, "ViserServer", lambda **_options: SimpleNamespace(stop=lambda: stopped.append(True)))
    with (
        closing(listen("127.0.0.1", 0)) as listening,
        pytest.raises(GateError, match=r"viser .* has changed .*; accepted: viser 1\.1"),
    ):
        gate_at(listening)
    assert stopped


def test_what_callbacks_of_viser_raise_is_logged_and_not_printed(server, caplog, capsys):
    error, failed, modules = ValueError("of a callback"), Future(), cast(Any, viser)
    failed.set_exception(error)
    modules._viser.print_threadpool_errors(failed)
    modules._gui_handles.print_task_error(failed)
    modules._scene_api.print_awaited_callback_error(error)
    logged = [record.exc_info for record in caplog.records if record.getMessage() == "a callback failed"]
    assert [info is not None and info[1] for info in logged] == 3 * [error]
    assert capsys.readouterr() == ("", "")


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


def test_the_patches_were_tried_with_this_version_of_viser():
    """Another version is added after a trial of tests/ui and tests/browser with it.

    With 1.1.0 alone, a page that plays is larger than tests/ui/test_recording.py allows.
    """
    assert viser.__version__ in {"1.1.0", "1.1.1"}


def test_a_viser_with_other_messages_is_refused(monkeypatch):
    monkeypatch.delattr("viser._messages.SceneNodeDragMessage")
    with pytest.raises(GateError, match=r"SceneNodeDragMessage.*; accepted: viser 1\.1"):
        gate_at(None)


BAD_REPORTS = ["", "390", "{", '{"width": 20}', '{"width": 99999}', '{"width": "390"}', '{"width": 390.5}', "\ud800",
    '{"width": 390, "link": {"kind": "file", "name": "a"}}', '{"width": 390, "link": {"kind": "scene", "name": 4}}',
    '{"width": 390, "link": {"kind": "scene", "name": "%s"}}' % ("a" * 101), '{"width": 390, "key": 1}']  # fmt: skip


@asynchronous
async def test_a_page_reports_its_link_and_the_width_of_its_window_and_nothing_else_is_taken_for_it(server, url):
    async with visiting(url) as client:
        visitor = await only_visitor(server)
        for text in BAD_REPORTS:
            with contextlib.suppress(UnicodeEncodeError):  # a browser cannot send it
                await client.set("Window", text)
        await client.set("Warp", 0.5)
        assert await client.wait_for(lambda: visitor.session.scenario.warp == 0.5, PATIENCE)
        assert visitor.camera._width is None and visitor.session.scenario.task == "draw_s"
        await client.report(width=390, link={"kind": "task", "name": "draw_j"})
        assert await client.wait_for(lambda: visitor.session.scenario.task == "draw_j", PATIENCE)
        assert visitor.camera._width == 390


def answer(server, request):
    """All bytes that the server answers to a request, until it closes the connection."""
    with socket.create_connection(("127.0.0.1", server.port), timeout=PATIENCE) as sock:
        for part in request:
            sock.sendall(part)
        received = b""
        while piece := sock.recv(65536):
            received += piece
    return received


HOST = b"/health HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"


@pytest.mark.parametrize("parts", [[b"HEAD " + HOST], [b"H", b"EAD ", HOST]], ids=["whole", "in pieces"])
def test_head_is_answered_as_get_is_without_the_body(server, parts):
    head, got = answer(server, parts), answer(server, [b"GET " + HOST])
    headers, body = got.split(b"\r\n\r\n")
    assert head.startswith(b"HTTP/1.1 200") and body.startswith(b"{")

    def undated(text):
        return [line for line in text.split(b"\r\n") if not line.startswith(b"Date")]

    assert undated(head) == [*undated(headers), b"", b""]


REFUSED = {
    "foreign host": ([b"HEAD / HTTP/1.1\r\nHost: evil.example\r\n\r\n"], rb"HTTP/1\.1 421"),
    "no request": ([b"\x16\x03\x01" + bytes(60)], rb"$"),
}
for method, body in itertools.product((b"POST", b"OPTIONS", b"PUT", b"DELETE", b"PROPFIND"), (b"", b"a=1" * 1000)):
    head = method + b" / HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Length: %d\r\n\r\n" % len(body)
    REFUSED[f"{method.decode()} {len(body)}"] = [head, body], rb"(?s)HTTP/1\.1 405.*Allow: GET, HEAD\r\n"


@pytest.mark.parametrize(("parts", "said"), REFUSED.values(), ids=REFUSED)
def test_other_requests_are_refused_with_the_methods_that_are_allowed(server, parts, said):
    assert re.match(said, answer(server, parts))
