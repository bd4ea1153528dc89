"""Gate of the server: checks connections and messages; the only module that relies on viser's internals.

viser answers every client, handles every message that it can decode, and has no limits. It starts a server of the
package websockets; the gate is inserted there, so that it sees each request before viser answers it and each message
before viser decodes it:

- Requests must be meant for this server, and connections come from its own or allowed pages; see `Origins`. The number
  of connections is limited.
- Messages of the kinds that this page uses are passed on, if they are exactly as viser declares them. Other kinds are
  dropped: some would be stored and sent to everybody (a form that changes), and some request what no visitor may decide
  (a tunnel to the internet). A malformed message ends its connection.
- The size of files is checked before they are stored; see `Upload`.
- Failures are logged at a limited rate and without the received content; see `Terse`.

The undocumented parts of viser that are used are checked when the server starts.
"""

from __future__ import annotations

import asyncio
import dataclasses
import logging
import math
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from http import HTTPStatus
from typing import Any, get_type_hints

import msgspec
import viser
import viser._messages
import viser._scene_api
import viser._viser
import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from dt_viz.errors import DataError
from dt_viz.ui import ruler
from dt_viz.ui.origins import Origins
from dt_viz.ui.uploads import MalformedError, Upload

logger = logging.getLogger(__name__)

SMALL, PART, IMAGE = 64 * 1024, 2**20, 16 * 2**20
"""Largest sizes of messages, bytes: of most kinds, with a part of a file, and with a rendered image."""
MAX_SIZES: Mapping[str, int] = {
    "ViewerCameraMessage": SMALL,
    "GuiUpdateMessage": SMALL,
    "CommandTriggerMessage": SMALL,
    "TransformControlsDragStartMessage": SMALL,
    "TransformControlsUpdateMessage": SMALL,
    "TransformControlsDragEndMessage": SMALL,
    "SceneNodeClickMessage": SMALL,
    "SceneNodeDragMessage": SMALL,
    "ScenePointerMessage": SMALL,
    "GetRenderResponseMessage": IMAGE,
    "FileTransferStartUpload": SMALL,
    "FileTransferPart": PART,
}
"""Largest sizes, bytes, of the messages that this page uses, by viser's name."""
MAX_RATE = 400
"""Largest rate of messages of a connection, 1/s, beyond which they wait; a page sends at most 20 of a kind."""
MAX_SOCKETS = 256
"""Largest number of open sockets, with or without a request."""
MISDIRECTED = (
    "This server is not known by that name. To use it, start it with --allow-origin and the address of the page."
)
FOREIGN = "Pages of other servers may not connect. To let one, start this server with --allow-origin and its address."
FULL = "All places are taken, and those to wait, too."

Answer = Callable[[ServerConnection, Request], Response | None]
"""Callback that answers a request, or returns None to let it become a connection."""
Refused = Callable[[viser.ClientHandle, str], None]
"""Callback that tells a visitor why a file is not accepted."""


class GateError(RuntimeError):
    """A version of viser whose internals differ from what the gate relies on."""

    def __init__(self, what: str) -> None:
        super().__init__(f"viser {viser.__version__} has changed ({what}); accepted: viser 1.1")


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """Permitted changes of a control; viser would set any property that is named."""

    value: bool | int | float | str


class _Kind(msgspec.Struct):
    type: str


class _Connection(ServerConnection):
    """A connection that passes on the messages that the gate accepts."""

    def __init__(self, gate: Gate, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 - of websockets
        super().__init__(*arguments, **options)
        self.upload = Upload(gate.max_upload)
        self._gate = gate
        self._second, self._num_received = 0.0, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self.server.handlers) > MAX_SOCKETS:
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
                    return raw
            except MalformedError:
                logger.warning("a connection is closed: it sent what no page sends")
                await self.close(1008, "malformed message")

    async def _keep_pace(self) -> None:
        now = time.monotonic()
        if now - self._second >= 1:
            self._second, self._num_received = now, 0
        self._num_received += 1
        if self._num_received > MAX_RATE:
            await asyncio.sleep(self._second + 1 - now)


class Gate:
    """Starts viser's server behind its checks."""

    def __init__(
        self,
        origins: Origins,
        *,
        max_connections: int,
        max_upload: int,
        refused: Refused,
        measured: ruler.Measured = lambda _token, _width: None,
    ) -> None:
        """Prepare the checks.

        Args:
            origins: pages that may connect.
            max_connections: largest number of simultaneous connections.
            max_upload: largest size of a file, bytes.
            refused: called with a visitor and the reason when a file is not accepted.
            measured: called with what a `Ruler` measures. It must only take note.

        Raises:
            GateError: viser's messages differ from the expected ones.
        """
        self.max_upload = max_upload
        self._origins, self._max_connections, self._refused = origins, max_connections, refused
        self._measured = measured
        self._connections: set[ServerConnection] = set()
        self._server: viser.ViserServer | None = None
        self._protocol = f"viser-v{viser.__version__}"
        try:
            self._decoders = {name: msgspec.msgpack.Decoder(_strict(name)) for name in MAX_SIZES}
        except (AttributeError, TypeError) as error:
            raise GateError(str(error)) from error

    def open(self, host: str, port: int, label: str) -> viser.ViserServer:
        """Start viser's server behind the gate; the arguments are those of `viser.ViserServer`.

        Raises:
            GateError: viser does not start its server as expected.
        """
        _report_to_the_log()
        with self._put_into_websockets() as used:
            server = viser.ViserServer(host=host, port=port, label=label, verbose=False)
        connections = getattr(getattr(server, "_websock_server", None), "_live_connections", None)
        if not used or not isinstance(connections, dict):
            server.stop()
            raise GateError("its server" if not used else "its connections")
        self._server = server
        return server

    @contextmanager
    def _put_into_websockets(self) -> Iterator[list[bool]]:
        """Make servers of websockets start with this gate; the yielded list is not empty once one did."""
        module: Any = websockets.asyncio.server
        original = module.serve
        used: list[bool] = []

        def serve(handler: Any, *arguments: Any, process_request: Answer, **options: Any) -> Any:  # noqa: ANN401
            used.append(True)
            asyncio.get_running_loop().set_exception_handler(_report_loop)
            options |= {
                "process_request": partial(self._answer, process_request),
                "create_connection": partial(_Connection, self),
                "max_size": IMAGE,
            }
            return original(partial(self._handle, handler), *arguments, **options)

        module.serve = serve
        try:
            yield used
        finally:
            module.serve = original

    def _answer(self, answer: Answer, connection: ServerConnection, request: Request) -> Response | None:
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._origins.knows(hosts[0]):
            logger.warning("a request under a foreign name was refused; --allow-origin lets a name be used")
            return connection.respond(HTTPStatus.MISDIRECTED_REQUEST, MISDIRECTED)
        if "websocket" in ",".join(request.headers.get_all("Upgrade")).lower():
            origins = request.headers.get_all("Origin")  # none: no browser
            if len(origins) > 1 or (origins and not self._origins.admits(origins[0], hosts[0])):
                logger.warning("a page of another server was refused; --allow-origin lets it connect")
                return connection.respond(HTTPStatus.FORBIDDEN, FOREIGN)
            if len(self._connections) >= self._max_connections:
                logger.warning("a connection was refused: there are %d", len(self._connections))
                return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, FULL)
            self._connections.add(connection)
        elif (told := ruler.told(request.path)) is not None:
            self._measured(*told)
            response = connection.respond(HTTPStatus.NO_CONTENT, "")
            response.headers["Cache-Control"] = "no-store"  # so that it is asked for each time
            return response
        return answer(connection, request)

    async def _handle(self, handler: Callable[[ServerConnection], Any], connection: ServerConnection) -> None:
        if connection.subprotocol == self._protocol:
            await handler(connection)
        else:  # as viser does, but not on the terminal: the page says so
            await connection.close(1002, f"Version mismatch. Server: {viser.__version__}. Reload the page.")

    def leave(self, connection: ServerConnection) -> None:
        """Forget a lost connection."""
        self._connections.discard(connection)

    def passes(self, connection: _Connection, raw: Any) -> bool:  # noqa: ANN401 - bytes, or what no page sends
        """Return whether a message is passed on to viser.

        Raises:
            MalformedError: no page sends such a message.
        """
        if not isinstance(raw, bytes):
            raise MalformedError("text")
        try:
            name = msgspec.msgpack.decode(raw, type=_Kind).type
            if name not in MAX_SIZES:
                return False
            if len(raw) > MAX_SIZES[name]:
                raise MalformedError(f"{len(raw)} bytes")
            message: Any = self._decoders[name].decode(raw)
        except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError) as error:
            raise MalformedError from error
        if name == "FileTransferPart":
            return connection.upload.part(message.transfer_uuid, message.part_index, len(message.content))
        if name == "FileTransferStartUpload":
            return self._begins(connection, message)
        return _is_finite(message)

    def _begins(self, connection: _Connection, message: Any) -> bool:  # noqa: ANN401 - FileTransferStartUpload
        """Return whether a file is accepted; tell the visitor if not."""
        client = self._client_of(connection)
        if client is None:
            return False  # there is no page yet that could send it
        client.gui._drop_uploads_from_client(client._websock_connection.client_id)  # pyright: ignore[reportArgumentType]
        try:
            connection.upload.start(message.transfer_uuid, message.filename, message.size_bytes, message.part_count)
        except DataError as error:
            # the page shows an upload in progress until all of it is acknowledged
            for told in (
                viser._messages.FileTransferPartAck(
                    message.source_component_uuid, message.transfer_uuid, message.size_bytes, message.size_bytes
                ),
                viser._messages.RemoveNotificationMessage(f"upload-{message.transfer_uuid}"),
            ):
                client._websock_connection.queue_message(told)
            self._refused(client, str(error))
            return False
        return True

    def _client_of(self, connection: ServerConnection) -> viser.ClientHandle | None:
        """Return the client of a connection; None before its page has reported a camera."""
        if self._server is None:
            return None
        live = self._server._websock_server._live_connections
        ids = [client_id for client_id, other in live.items() if other is connection]
        return self._server.get_clients().get(ids[0]) if ids else None


def _strict(name: str) -> type[msgspec.Struct]:
    """Return the strict type of one of viser's messages: all declared fields, of their types, and no others."""
    declared = getattr(viser._messages, name)
    hints = get_type_hints(declared)
    if name == "GuiUpdateMessage":
        hints["updates"] = _Value
    fields = [
        (field.name, hints[field.name], *(() if field.default is dataclasses.MISSING else (field.default,)))
        for field in dataclasses.fields(declared)
    ]
    return msgspec.defstruct(name, fields, tag_field="type", tag=name, forbid_unknown_fields=True)


def _is_finite(value: Any) -> bool:  # noqa: ANN401 - a message, or what it holds
    """Return whether all its numbers are finite."""
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        return all(_is_finite(item) for item in value)
    return not isinstance(value, float) or math.isfinite(value)


def _report_to_the_log() -> None:
    """Make viser log what its callbacks raise, which it would print, however often."""
    reports = {
        "print_threadpool_errors": _report_task,
        "print_task_error": _report_task,
        "print_awaited_callback_error": _report,
    }
    for module in (viser._gui_api, viser._scene_api, viser._viser):
        for name, report in reports.items():
            if hasattr(module, name):
                setattr(module, name, report)


def _report(error: BaseException) -> None:
    logger.error("a callback failed", exc_info=error)


def _report_task(task: Any) -> None:  # noqa: ANN401 - a future, or a task
    if not task.cancelled() and task.exception() is not None:
        _report(task.exception())


def _report_loop(_loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
    logger.error("on the event loop: %s", context.get("message"), exc_info=context.get("exception"))
