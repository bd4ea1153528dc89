"""Gate of the server: checks connections and messages before viser sees them.

viser answers every client, handles every message that it can decode, and has no limits. It starts a server of the
package websockets; the gate is inserted there, so that it sees each request before viser answers it and each message
before viser decodes it:

- Requests must be meant for this server, and connections come from its own or allowed pages; see `Origins`. The number
  of connections is limited, in all and for each address. Answers say what the page may load and who may embed it.
- Messages of the kinds that this page uses are passed on, if they are exactly as viser declares them. Other kinds are
  dropped: some would be stored and sent to everybody (a form that changes), and some request what no visitor may decide
  (a tunnel to the internet). A malformed message ends its connection.
- The size of files is checked before they are stored; see `Upload`.
- Failures are logged at a limited rate and without the received content; see `RateLimitFilter`.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import socket
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from http import HTTPStatus
from typing import Any, get_type_hints

import msgspec
import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from dt_viz.errors import DataError
from dt_viz.serving.board import Share, own_share
from dt_viz.serving.reports import REPORTS, Report
from dt_viz.ui import patches, scripts
from dt_viz.ui.origins import Origins, address_of
from dt_viz.ui.transfers import MalformedError, Upload

logger = logging.getLogger(__name__)

Refusal = tuple[HTTPStatus, str]
"""Status of the answer to a request that is refused, and what it says."""
MISDIRECTED: Refusal = (
    HTTPStatus.MISDIRECTED_REQUEST,
    "This server is not known by that name. To use it, start it with --allow-origin and the address of the page.",
)
FOREIGN: Refusal = (
    HTTPStatus.FORBIDDEN,
    "Pages of other servers may not connect. To let one, start this server with --allow-origin and its address.",
)
FULL: Refusal = HTTPStatus.SERVICE_UNAVAILABLE, "All places are taken, and those to wait, too."
CROWDED: Refusal = (
    HTTPStatus.TOO_MANY_REQUESTS,
    "Too many pages are open from your address. Close one, or have this server started with --max-of-address.",
)
STORED = "LocalStorageGetItemResponseMessage"
"""Message with what a browser has kept."""
KINDS: Mapping[str, str] = {
    "ViewerCameraMessage": "message",
    "GuiUpdateMessage": "message",
    "CommandTriggerMessage": "message",
    "TransformControlsDragStartMessage": "message",
    "TransformControlsUpdateMessage": "message",
    "TransformControlsDragEndMessage": "message",
    "SceneNodeClickMessage": "message",
    "SceneNodeDragMessage": "message",
    "ScenePointerMessage": "message",
    "GetRenderResponseMessage": "image",
    STORED: "part",
    "FileTransferStartUpload": "message",
    "FileTransferPart": "part",
}
"""Messages that this page uses, by viser's name, and which of the `Limits` of size each has."""

BEAT = 0.25
"""Time after which a process tells again that its event loop runs, seconds."""
LAST_WORDS = 0.5
"""Time until a connection is ended, in which its client is sent the reason, seconds."""

Answer = Callable[[ServerConnection, Request], Response | None]
"""Callback that answers a request, or returns None to let it become a connection."""
Refused = Callable[[viser.ClientHandle, str], None]
"""Callback that tells a visitor why a file is not accepted."""


@dataclass(frozen=True)
class Limits:
    """Limits of what a server takes from its visitors."""

    places: int
    """Largest number of visitors."""
    connections: int
    """Largest number of simultaneous connections, of visitors and of those who wait."""
    upload: int
    """Largest size of a file, bytes."""
    of_address: int = 8
    """Largest number of connections of one `address_of`."""
    sockets: int = 256
    """Largest number of open sockets, with or without a request."""
    rate: float = 400.0
    """Largest rate of messages of a connection, 1/s, beyond which they wait; a page sends at most 20 of a kind."""
    message: int = 64 * 1024
    """Largest size of most messages, bytes."""
    part: int = 2**20
    """Largest size of a message with a part of a file, of which the page sends half, or with what was kept, bytes."""
    image: int = 16 * 2**20
    """Largest size of a message with a rendered image, bytes, and so of any."""


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """Permitted changes of a control; viser would set any property that is named."""

    value: bool | int | float | str


class _Kind(msgspec.Struct):
    type: str


class _Connection(ServerConnection):
    """A connection that passes on the messages that the gate accepts."""

    def __init__(self, gate: Gate, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 - of websockets
        super().__init__(*arguments, **options)
        self.upload = Upload(gate.limits.upload)
        self.active = time.monotonic()
        """When it sent the last message, seconds."""
        self._gate = gate
        self._second, self._num_received = 0.0, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self.server.handlers) > self._gate.limits.sockets:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        self._gate.leave(self)

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ANN401 - as in websockets
        """Return the next accepted message; raises ConnectionClosed as the base class."""
        while True:
            raw = await super().recv(decode)
            await self._keep_pace()
            try:
                if self._gate.passes(self, raw):
                    self.active = time.monotonic()
                    return raw
            except MalformedError:
                logger.warning("a connection is closed: it sent what no page sends")
                await self.close(1008, "malformed message")

    async def _keep_pace(self) -> None:
        now = time.monotonic()
        if now - self._second >= 1:
            self._second, self._num_received = now, 0
        self._num_received += 1
        if self._num_received > self._gate.limits.rate:
            await asyncio.sleep(self._second + 1 - now)


class Gate:
    """Starts viser's server behind its checks."""

    def __init__(
        self,
        origins: Origins,
        limits: Limits,
        refused: Refused,
        told: scripts.Told = lambda _token, _what: None,
        share: Share | None = None,
    ) -> None:
        """Prepare the checks.

        Args:
            origins: pages that may connect.
            limits: limits of what visitors send.
            refused: called with a visitor and the reason when a file is not accepted.
            told: called with what a `Ruler` measures and reads. It must only take note.
            share: what other processes for the same address tell; None if there are none.

        Raises:
            GateError: viser's messages differ from the expected ones.
        """
        self.limits = limits
        self._origins, self._refused, self._told = origins, refused, told
        self._share = share or own_share(limits.connections)
        self._connections: dict[ServerConnection, tuple[int, str]] = {}
        """The connections here, the number of each on the board, and its `address_of`."""
        self._headers = {
            "Content-Security-Policy": origins.policy,
            "X-Content-Type-Options": "nosniff",
            "Referrer-Policy": "no-referrer",
        }
        self._server: viser.ViserServer | None = None
        self._protocol = f"viser-v{viser.__version__}"
        try:
            self._decoders = {name: msgspec.msgpack.Decoder(_strict(name)) for name in KINDS}
        except (AttributeError, TypeError) as error:
            raise patches.GateError(str(error)) from error

    def open(self, listening: socket.socket, label: str) -> viser.ViserServer:
        """Start viser's server behind the gate, for the connections of a socket that listens.

        Raises:
            GateError: viser does not start its server as expected.
        """
        patches.tell_from_threads()
        patches.evaluate_hints_once()
        patches.report_failures(lambda error: logger.error("a callback failed", exc_info=error))
        self._server = patches.open_server(self._guarded, listening, label=label, verbose=False)
        return self._server

    def _guarded(self, handler: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:  # noqa: ANN401
        """Put the gate between websockets and viser's handler of connections."""
        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(_report_loop)
        self._beat()
        return partial(self._handle, handler), {
            **options,
            "process_request": partial(self._answer, options["process_request"]),
            "create_connection": partial(_Connection, self),
            "max_size": self.limits.image,
        }

    def _beat(self) -> None:
        """Tell again and again that the event loop runs."""
        self._share.beat()
        self._loop.call_later(BEAT, self._beat)

    def address(self, client: viser.ClientHandle) -> str:
        """Return the `address_of` a client; empty for this machine's own, and if it has left."""
        connection = None if self._server is None else patches.connection_of(self._server, client.client_id)
        return "" if connection is None else self._connections.get(connection, (0, ""))[1]

    def page(self, client: viser.ClientHandle) -> str:
        """Return the origin of a client's page in its browser, such as http://10.0.0.1:8080; empty if it has left."""
        connection = None if self._server is None else patches.connection_of(self._server, client.client_id)
        if connection is None:
            return ""
        headers = connection.request.headers
        return headers.get("Origin") or f"http://{headers.get('Host', '')}"

    def idle(self, client: viser.ClientHandle) -> float:
        """Return the time since a client sent something, seconds; 0 if it has left."""
        connection = None if self._server is None else patches.connection_of(self._server, client.client_id)
        return 0.0 if connection is None else time.monotonic() - connection.active

    def disconnect(self, client: viser.ClientHandle) -> None:
        """End the connection of a client when it has been sent what it was told; its page comes again by itself."""
        connection = None if self._server is None else patches.connection_of(self._server, client.client_id)
        if connection is not None:
            connection.active = time.monotonic()  # once is enough
            asyncio.run_coroutine_threadsafe(_closed(connection), self._loop)

    def _answer(self, answer: Answer, connection: ServerConnection, request: Request) -> Response | None:
        refusal = self._refusal(connection, request)
        if refusal is not None:
            self._share.refused()
            logger.warning("a request was refused: %s", refusal[1])
            return connection.respond(*refusal)
        if (told := scripts.told(request.path)) is not None:
            self._told(*told)
            return connection.respond(HTTPStatus.NO_CONTENT, "")
        if (report := REPORTS.get(request.path)) is not None:
            response = _response(connection, report(self._share, self.limits.places))
        else:
            response = answer(connection, request)
        if response is not None:
            response.headers.update(self._headers)
        return response

    def _refusal(self, connection: ServerConnection, request: Request) -> Refusal | None:
        """Return why a request is refused; None takes it, and counts it if it asks for a connection."""
        hosts, origins, upgrades = (request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade"))
        if len(hosts) != 1 or not self._origins.knows(hosts[0]):
            return MISDIRECTED
        if "websocket" not in ",".join(upgrades).lower():
            return None
        if len(origins) > 1 or (origins and not self._origins.admits(origins[0], hosts[0])):  # none: no browser
            return FOREIGN
        if self._share.num_connections() >= self.limits.connections:
            return FULL
        address = address_of(connection.remote_address[0], request.headers.get_all("X-Forwarded-For"))
        if address and self._share.num_connections(address) >= self.limits.of_address:
            return CROWDED
        self._connections[connection] = self._share.connect(address), address
        return None

    async def _handle(self, handler: Callable[[ServerConnection], Any], connection: ServerConnection) -> None:
        if connection.subprotocol == self._protocol:
            await handler(connection)
        else:  # as viser does, but not on the terminal: the page says so
            await connection.close(1002, f"Version mismatch. Server: {viser.__version__}. Reload the page.")

    def leave(self, connection: ServerConnection) -> None:
        """Forget a lost connection."""
        if (known := self._connections.pop(connection, None)) is not None:
            self._share.disconnect(known[0])

    def passes(self, connection: _Connection, raw: Any) -> bool:  # noqa: ANN401 - bytes, or what no page sends
        """Return whether a message is passed on to viser.

        Raises:
            MalformedError: no page sends such a message.
        """
        if not isinstance(raw, bytes):
            raise MalformedError("text")
        try:
            name = msgspec.msgpack.decode(raw, type=_Kind).type
            if name not in KINDS:
                return False
            too_large = len(raw) > getattr(self.limits, KINDS[name])
            if too_large and name == STORED:
                return False  # the page may have been told to keep it by whoever shares its origin
            if too_large:
                raise MalformedError(f"{len(raw)} bytes")
            message: Any = self._decoders[name].decode(raw)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise MalformedError from error
        if name == "FileTransferPart":
            return self._continues(connection, message)
        if name == "FileTransferStartUpload":
            return self._begins(connection, message)
        return _is_finite(message)

    def _begins(self, connection: _Connection, message: Any) -> bool:  # noqa: ANN401 - FileTransferStartUpload
        """Return whether a file is accepted; tell the visitor if not."""
        client = None if self._server is None else patches.client_of(self._server, connection)
        if client is None:
            return False  # there is no page yet that could send it
        patches.drop_uploads(client)
        try:
            connection.upload.start(message.transfer_uuid, message.filename, message.size_bytes, message.part_count)
        except DataError as error:
            patches.refuse_upload(client, message)
            self._refused(client, str(error))
            return False
        return True

    def _continues(self, connection: _Connection, message: Any) -> bool:  # noqa: ANN401 - FileTransferPart
        """Return whether a part belongs to the file that is sent; whether that can be used, the page says itself."""
        belongs = connection.upload.part(message.transfer_uuid, message.part_index, len(message.content))
        client = None if self._server is None else patches.client_of(self._server, connection)
        if belongs and client is not None and not connection.upload.uuid:
            patches.hide_upload(client, message.transfer_uuid)
        return belongs


def _strict(name: str) -> type[msgspec.Struct]:
    """Return the strict type of one of viser's messages: all declared fields, of their types, and no others."""
    declared = patches.declared(name)
    hints = get_type_hints(declared)
    if name == "GuiUpdateMessage":
        hints["updates"] = _Value
    fields = [
        (one.name, hints[one.name], *(() if one.default is dataclasses.MISSING else (one.default,)))
        for one in dataclasses.fields(declared)
    ]
    return msgspec.defstruct(name, fields, tag_field="type", tag=name, forbid_unknown_fields=True)


def _response(connection: ServerConnection, report: Report) -> Response:
    response = connection.respond(report.status, report.text)
    del response.headers["Content-Type"]
    response.headers["Content-Type"] = report.kind
    return response


async def _closed(connection: ServerConnection) -> None:
    await asyncio.sleep(LAST_WORDS)
    await connection.close()


def _report_loop(_loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
    logger.error("on the event loop: %s", context.get("message"), exc_info=context.get("exception"))


def _is_finite(value: Any) -> bool:  # noqa: ANN401 - a message, or what it holds
    """Return whether all its numbers are finite."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        return all(_is_finite(item) for item in value)
    return not isinstance(value, float) or math.isfinite(value)
