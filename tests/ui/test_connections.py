"""Who gets in, and what gets in: real handshakes and messages, against the server that the demo starts."""

import asyncio
import functools
import logging
import math
import os
import socket
import time
import urllib.error
import urllib.request
from contextlib import AsyncExitStack
from dataclasses import replace

import msgspec
import numpy as np
import pytest
import viser  # noqa: TID251 - whose version the page has
import websockets
from websockets.asyncio.client import connect
from websockets.typing import Subprotocol

from dt_viz.engine.session import Pace
from dt_viz.evaluate.protocol_client import OBSTACLE, LostError, ProtocolClient
from dt_viz.obstacles.files import MAX_BYTES
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui import gate
from dt_viz.ui.origins import Origin
from dt_viz.ui.ruler import Ruler
from dt_viz.ui.server import MAX_WAITING, Server

PART = 512 * 1024
"""Size of a part of an upload, bytes, as in viser's own page."""
PATIENCE = 90.0
"""Seconds that anything may take: the machine may be busy."""
UPLOAD = "Mesh or point cloud"
NUM_PLACES = 2


class Client(ProtocolClient):
    """A visitor who also sets controls and sends files."""

    async def upload(
        self, label: str, name: str, content: bytes, *, announced: int | None = None, transfer: str = "transfer"
    ) -> None:
        """Send a file with an upload button.

        Args:
            label: label of the button.
            name: name of the file.
            content: all its bytes.
            announced: announced number of bytes; the true one if None.
            transfer: identifier of the transfer.
        """
        size = len(content) if announced is None else announced
        common = {"source_component_uuid": self.find(label), "transfer_uuid": transfer}
        parts = [content[k : k + PART] for k in range(0, len(content), PART)]
        await self.send(
            "FileTransferStartUpload",
            **common,
            filename=name,
            mime_type="",
            part_count=math.ceil(size / PART),
            size_bytes=size,
        )
        for index, part in enumerate(parts):
            await self.send("FileTransferPart", **common, part_index=index, content=part)

    async def wait_until_lost(self, seconds: float) -> bool:
        """Wait until the server has closed the connection; False if it does not in time."""
        try:
            return await self.wait_for(lambda: False, seconds)
        except LostError:
            return True


@pytest.fixture(scope="module")
def server(fits):
    allowed = [Origin.parse("https://demo.example.org")]
    server = Server(TASKS, fits, task="draw_s", port=0, max_sessions=NUM_PLACES, allowed=allowed)
    yield server
    server.close()


@pytest.fixture
def url(server):
    """Of the WebSocket; nobody is left over from another test."""
    wait_until(lambda: not server._server.get_clients() and not server.visitors)
    return f"ws://127.0.0.1:{server.port}"


def asynchronous(test):
    """Runs a test on an event loop, for so long."""

    @functools.wraps(test)
    def run(**fixtures):
        asyncio.run(asyncio.wait_for(test(**fixtures), 2 * PATIENCE))

    return run


def wait_until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


async def come_true(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        await asyncio.sleep(0.02)


async def open_page(client):
    """Wait for the first picture."""
    await client.look()
    assert await client.wait_for(lambda: client.has_picture, PATIENCE)


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


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", None])
@asynchronous
async def test_the_own_page_and_programs_may_connect(url, server, host):
    origin = None if host is None else f"http://{host}:{server.port}"
    assert await status_of(url, origin=origin) == 101


@asynchronous
async def test_an_allowed_page_may_connect(url):
    assert await status_of(url, origin="https://demo.example.org") == 101


@pytest.mark.parametrize("origin", ["https://evil.example", "http://localhost:1", "null"])
@asynchronous
async def test_pages_of_other_servers_may_not_connect(url, origin):
    assert await status_of(url, origin=origin) == 403


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
    with pytest.raises(urllib.error.HTTPError) as refused:
        urllib.request.urlopen(urllib.request.Request(page, headers={"Host": "evil.example"}))
    assert refused.value.code == 421
    assert b"--allow-origin" in refused.value.read()


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
async def test_who_waits_is_told_so_and_has_the_next_place_that_is_free(url, server):
    def waits(client):
        return any("places are taken" in str(control) for control in client.controls.values())

    async with AsyncExitStack() as stack:
        seated, waiting = ([Client(url) for _ in range(number)] for number in (NUM_PLACES, 3))
        for client in seated:
            await (await stack.enter_async_context(client)).look()
        await come_true(lambda: len(server.visitors) == NUM_PLACES)
        for client in waiting:
            await (await stack.enter_async_context(client)).look()
            assert await client.wait_for(lambda c=client: waits(c), PATIENCE)
        gone, first, last = waiting
        await gone.__aexit__(None, None, None)
        await come_true(lambda: len(server._server.get_clients()) == NUM_PLACES + 2)
        await seated[0].__aexit__(None, None, None)
        assert await first.wait_for(lambda: first.has_picture, PATIENCE)
        assert not waits(first) and waits(last) and len(server.visitors) == NUM_PLACES


@asynchronous
async def test_open_sockets_are_bounded_too(url, server, monkeypatch):
    monkeypatch.setattr(gate, "MAX_SOCKETS", 3)
    async with AsyncExitStack() as stack:
        sockets = [socket.create_connection(("127.0.0.1", server.port)) for _ in range(4)]
        for each in sockets:
            stack.callback(each.close)
        sockets[-1].settimeout(PATIENCE)
        assert await asyncio.to_thread(_ended, sockets[-1])


def _ended(sock):
    try:
        return sock.recv(1) == b""
    except ConnectionResetError:
        return True


def test_who_leaves_before_the_page_is_built_keeps_no_place(server, url, monkeypatch):
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
    monkeypatch.setattr(server._server, "request_share_url", lambda: asked.append("share"))
    monkeypatch.setattr(server._server, "disconnect_share_url", lambda: asked.append("unshare"))
    kept = server._server._websock_server._broadcast_buffer.message_from_id
    async with Client(url) as client:
        await open_page(client)
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


MALFORMED = {
    "text": "hello",
    "no bytes": b"",
    "no map": b"\x93\x01\x02\x03",
    "cut off": b"\x82\xa4type\xb3ViewerCamera",
    "no kind": msgspec.msgpack.encode({"name": "x"}),
    "kind of another type": msgspec.msgpack.encode({"type": 7}),
    "no text in a text": b"\x81\xa4type\xa2\xff\xff",
    "field of another type": msgspec.msgpack.encode(
        {"type": "TransformControlsDragStartMessage", "name": 7, "owner": "secret"}
    ),
    "field that is missing": msgspec.msgpack.encode({"type": "TransformControlsUpdateMessage", "name": "secret"}),
    "field that there is not": msgspec.msgpack.encode(
        {"type": "TransformControlsDragStartMessage", "name": "secret", "owner": "", "secret": 1}
    ),
    "number too many": msgspec.msgpack.encode(
        {"type": "TransformControlsUpdateMessage", "name": "secret", "wxyz": [1, 0, 0, 0], "position": [1, 2, 3, 4]}
    ),
    "other property of a control": msgspec.msgpack.encode(
        {"type": "GuiUpdateMessage", "uuid": "secret", "updates": {"removed": True}}
    ),
    "value that no control has": msgspec.msgpack.encode(
        {"type": "GuiUpdateMessage", "uuid": "secret", "updates": {"value": {"a": [1]}}}
    ),
    "nested deep": b"\x82\xa4type\xb0GuiUpdateMessage\xa7updates" + b"\x91" * 50_000,
    "large": msgspec.msgpack.encode({"type": "SceneNodeClickMessage", "name": "secret" * 20_000}),
}


@pytest.mark.parametrize("raw", MALFORMED.values(), ids=MALFORMED)
@asynchronous
async def test_a_message_that_no_page_sends_ends_its_connection(url, raw, caplog, capfd):
    async with Client(url) as client:
        await client.look()
        await client.send_raw(raw)
        assert await client.wait_until_lost(PATIENCE)
    printed = "".join(capfd.readouterr())
    assert "Traceback" not in caplog.text + printed
    assert "secret" not in caplog.text + printed


@asynchronous
async def test_it_ends_no_other_connection(url):
    async with Client(url) as client, Client(url) as other:
        await open_page(client)
        await other.look()
        await other.send_raw(b"\xc1")
        assert await other.wait_until_lost(PATIENCE)
        assert await answers(client)


@asynchronous
async def test_forged_values_change_nothing_and_break_nothing(url, server):
    async with Client(url) as client:
        await open_page(client)
        (visitor,) = server.visitors
        before = visitor.session.scenario
        camera = np.array(visitor.client.camera.position)
        forged = {"name": OBSTACLE, "owner": client.nodes[OBSTACLE]["owner"], "wxyz": [1, 0, 0, 0]}
        for number in (float("nan"), float("inf"), -float("inf")):
            await client.send("TransformControlsUpdateMessage", **forged, position=[0, number, 0])
            await client.set("Margin [cm]", number)
            await client.send(
                "ViewerCameraMessage",
                wxyz=[1, 0, 0, 0],
                position=[number, 0, 0],
                fov=1,
                near=1,
                far=1,
                image_height=1,
                image_width=1,
                look_at=[0, 0, 0],
                up_direction=[0, 0, 1],
            )
        await client.set("Margin [cm]", "no number")
        await client.send("TransformControlsUpdateMessage", **forged | {"owner": "another"}, position=[9, 9, 9])
        await client.send("TransformControlsUpdateMessage", **forged | {"name": "/nothing"}, position=[9, 9, 9])
        await client.send("GuiUpdateMessage", uuid="nothing", updates={"value": 1})
        await client.send("GetRenderResponseMessage", payload=b"", render_uuid="nothing")
        assert await answers(client)
        after = visitor.session.scenario
        assert (after.avoidance.margin, after.obstacles[0].position) == (
            before.avoidance.margin,
            before.obstacles[0].position,
        )
        np.testing.assert_array_equal(visitor.client.camera.position, camera)


@asynchronous
async def test_a_flood_is_slowed_down(url):
    async with Client(url) as client:
        await open_page(client)
        began = time.monotonic()
        for _ in range(3 * gate.MAX_RATE):
            await client.send("NoSuchMessage")
        assert await answers(client)
        assert time.monotonic() - began > 1  # the second that it began in may have been over at once


@asynchronous
async def test_what_callbacks_raise_is_in_the_log_without_what_was_sent(url, caplog, capfd):
    async with Client(url) as client:
        await open_page(client)
        caplog.clear()
        await client.set("Margin [cm]", "secret")
        assert await answers(client)
        await come_true(lambda: any(record.name == gate.logger.name for record in caplog.records))
    (record,) = (record for record in caplog.records if record.name == gate.logger.name)
    assert record.levelno == logging.ERROR and record.exc_info
    assert "secret" not in record.getMessage()
    assert "secret" not in "".join(capfd.readouterr())


@asynchronous
async def test_a_visitor_who_does_not_listen_costs_no_memory(url, server):
    """What is not sent yet is replaced by what is newer."""
    async with Client(url) as client:
        await open_page(client)
        (visitor,) = server.visitors
        (state,) = server._server._websock_server._client_state_from_id.values()
        client._receiving.cancel()
        await asyncio.gather(client._receiving, return_exceptions=True)
        client._socket.transport.pause_reading()
        visitor.client.add_notification("", os.urandom(2**23).hex())  # fills all buffers on the way
        frames = visitor.shown, replace(visitor.shown, rollouts=tuple(path + 0.01 for path in visitor.shown.rollouts))
        held = []
        for frame in 10 * frames:
            visitor.draw(frame, Pace(0.02, 10.0, 0))
            held.append(len(state.message_buffer.message_from_id))
            await asyncio.sleep(0.01)
        assert 5 < held[-1] < 50, held  # a frame has about ten messages
        client._socket.transport.abort()  # who does not listen says no goodbye either
        client._receiving = asyncio.create_task(asyncio.sleep(0))


# --- files ---


def parts_held(server):
    return sum(
        len(part)
        for visitor in server.visitors
        for state in visitor.client.gui._current_file_upload_states.values()
        for part in state["parts"].values()
    )


@asynchronous
async def test_a_file_that_is_announced_too_large_is_refused_before_any_of_it_is_held(url, server):
    async with Client(url) as client:
        await open_page(client)
        await client.upload(UPLOAD, "large.stl", bytes(3 * 2**20), announced=MAX_BYTES + 1)
        assert await client.wait_for(lambda: client.notices, PATIENCE)
        assert client.notices == ["large.stl: file: found 20.0 MB; accepted: at most 20 MB"]
        assert await answers(client)
        assert not server.visitors[0].client.gui._current_file_upload_states


@asynchronous
async def test_a_file_that_is_larger_than_announced_ends_the_connection(url):
    async with Client(url) as client:
        await open_page(client)
        with pytest.raises(LostError):
            await client.upload(UPLOAD, "x.stl", bytes(3 * 2**20), announced=2**20 + 1)
            assert await client.wait_until_lost(PATIENCE)
            await client.look()


@asynchronous
async def test_files_that_were_given_up_are_not_held(url, server):
    async with Client(url) as client:
        await open_page(client)
        for k in range(10):
            await client.upload(UPLOAD, "x.stl", bytes(2**20), announced=2**21, transfer=f"{k}")
        await client.send(
            "FileTransferPart", source_component_uuid=client.find(UPLOAD), transfer_uuid="0", part_index=3, content=b"x"
        )
        assert await answers(client)
        assert parts_held(server) == 2**20


@asynchronous
async def test_a_file_that_keeps_to_it_arrives(url, server):
    """The panel says what is wrong with it: it is no mesh."""
    async with Client(url) as client:
        await open_page(client)
        await client.upload(UPLOAD, "x.stl", bytes(2**20))
        assert await client.wait_for(lambda: client.notices, PATIENCE)
        assert "x.stl" in client.notices[0]
        assert not server.visitors[0].client.gui._current_file_upload_states


# --- viser ---


def test_a_viser_that_serves_in_another_way_is_refused(monkeypatch):
    stopped = []

    class Other:
        def __init__(self, **_options):
            pass

        def stop(self):
            stopped.append(self)

    monkeypatch.setattr(viser, "ViserServer", Other)
    guard = gate.Gate(gate.Origins("127.0.0.1"), max_connections=1, max_upload=1, refused=lambda *_: None)
    with pytest.raises(gate.GateError, match=r"viser .* has changed .*; accepted: viser 1\.1"):
        guard.open("127.0.0.1", 0, "")
    assert stopped


def test_a_viser_with_other_messages_is_refused(monkeypatch):
    monkeypatch.delattr("viser._messages.SceneNodeDragMessage")
    with pytest.raises(gate.GateError, match=r"SceneNodeDragMessage.*; accepted: viser 1\.1"):
        gate.Gate(gate.Origins("127.0.0.1"), max_connections=1, max_upload=1, refused=lambda *_: None)


@asynchronous
async def test_a_browser_that_asks_for_the_picture_of_its_window_tells_its_width(server, url):
    async with Client(url) as client:
        await open_page(client)
        (visitor,) = server.visitors
        html = next(
            control["content"] for control in client.controls.values() if "<picture" in control.get("content", "")
        )

        async def ask(path):
            page = f"http://127.0.0.1:{server.port}{path}"
            response = await asyncio.to_thread(urllib.request.urlopen, page)
            return response.status, response.headers["Cache-Control"]

        assert visitor.ruler.html == html
        assert await ask(f"/window/{Ruler().token}/390") == (204, "no-store")
        assert visitor._tripod.width is None
        assert await ask(f"/window/{visitor.ruler.token}/390") == (204, "no-store")
        assert visitor._tripod.width == 390
