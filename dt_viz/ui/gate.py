"""The gate of the server: what a browser sends is checked before viser, which has no limits, sees it.

- A request must be meant for this server, and a connection come from its own or an allowed page; see `Origins`. The
  number of connections is limited, in all and for each address. Answers say what the page may load and who embeds it.
- A message is passed on if this page uses its kind, all fields are as viser declares them, and all numbers are finite.
  Other kinds are dropped: some would be stored and sent to everybody (a form that changes), and some request what no
  visitor may decide (a tunnel to the internet). A malformed message ends its connection.
- A file is counted before any of it is held; see `Upload`. The log has nothing of what is sent; see `RateLimitFilter`.

What a value means is checked where it is bound: by `bindings.Control`, `scene.markers` and `scene.camera`.
"""

from __future__ import annotations

import asyncio
import dataclasses
import ipaddress
import logging
import math
import socket
import time
import traceback
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import partial
from typing import Any, get_type_hints
from urllib.parse import SplitResult, urlsplit

import msgspec
import viser
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from dt_viz.errors import DataError, naming
from dt_viz.files.checks import check_size
from dt_viz.serving.board import REPORTS, Share
from dt_viz.ui import patches

logger = logging.getLogger(__name__)

UNKNOWN = "This server is not known by that name. To use it, start it with --allow-origin and the address of the page."
FOREIGN = "Pages of other servers may not connect. To let one, start this server with --allow-origin and its address."
FULL = "All places are taken, and those to wait, too."
CROWDED = "Too many pages are open from your address. Close one, or have this server started with --max-of-address."
LONGEST_METHOD = 16  # number of bytes within which a request's method ends
NOT_ALLOWED = b"HTTP/1.1 405 Method Not Allowed\r\nAllow: GET, HEAD\r\nContent-Length: 0\r\nConnection: close\r\n\r\n"
PORTS = {"http": 80, "https": 443}  # default port of each scheme

MAX_SOCKETS = 256  # largest number of open sockets, with or without a request
MAX_RATE = 400.0  # messages of a connection, 1/s, beyond which they wait; a page sends 20 of a kind
MAX_UPLOAD, MAX_PARTS = 50 * 10**6, 1024  # largest size of a file, bytes, and number of its parts
SMALL, PART, IMAGE = 2**16, 2**20, 2**24  # largest sizes of messages, bytes; a page sends half a PART
STORED = "LocalStorageGetItemResponseMessage"  # message with what a browser has kept
SIZES: Mapping[str, int] = {
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
    STORED: PART,
    "FileTransferStartUpload": SMALL,
    "FileTransferPart": PART,
}
"""Messages that this page uses, by viser's name, and the largest size of each, bytes."""

BEAT = 0.25  # time after which a process reports again that its event loop runs, seconds
LAST_WORDS = 0.5  # time in which a client is sent the reason why its connection ends, seconds
MAX_RECORDS, PERIOD = 5, 60.0  # largest number of records of a kind in the log, in so many seconds


def origin_of(text: str) -> str:
    """Return scheme, host and port of a page, as `https://a.org:443`. Raises ValueError if the text is no origin."""
    parts = _split(text)
    if parts is None or parts.scheme not in PORTS:
        raise ValueError(
            f"found {text!r}; accepted: http:// or https://, a name or an address, and maybe a port, "
            "such as https://demo.example.org"
        )
    host = f"[{parts.hostname}]" if ":" in (parts.hostname or "") else parts.hostname
    return f"{parts.scheme}://{host}:{parts.port or PORTS[parts.scheme]}"


class Origins:
    """Hosts and pages that are accepted, by two headers that a page cannot change.

    `Host` is the name in the address that the browser connects to. A page can have a name of its own resolve to this
    server (DNS rebinding); so only known names are accepted, addresses and `localhost`, which resolve nowhere else.
    `Origin` must be the host and port that the page connects to, or an allowed origin. A program that is no browser
    sends none and is accepted: it acts with its own rights only.
    """

    def __init__(self, host: str, allowed: Sequence[str] = ()) -> None:
        """Accept the pages of the server, which listens on this host, and of allowed origins, as of `origin_of`."""
        self._allowed, self._names = allowed, {"localhost", host.lower(), *(urlsplit(one).hostname for one in allowed)}
        # viser's page is one file, which unpacks and evaluates its script; it loads nothing from elsewhere
        self.policy = (
            "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' ws: wss: data: blob:; "
            "object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors "
        ) + " ".join(["'self'", *sorted({*allowed})])
        """Content policy of the page, as a header."""

    def knows(self, host: str) -> bool:
        """Return whether a value of the header `Host` names this server."""
        parts = _split(f"//{host}")
        return parts is not None and (parts.hostname in self._names or _address(parts.hostname) is not None)

    def admits(self, origin: str, host: str) -> bool:
        """Return whether a page may connect, by its headers `Origin` and `Host`, a known one."""
        try:
            page = origin_of(origin)
            own = origin_of(f"{urlsplit(page).scheme}://{host}")
        except ValueError:  # also "null", the origin of local pages
            return False
        at, here = ((_canonical(parts.hostname), parts.port) for parts in map(urlsplit, (page, own)))
        return page in self._allowed or at == here


def address_of(peer: str, forwarded: Iterable[str]) -> str:
    """Return the address, of IPv6 the network, that a request is counted for; empty for this machine's own.

    Args:
        peer: the other end of the connection.
        forwarded: values of the header `X-Forwarded-For`, to which a proxy adds its client, perhaps with a port. Only
            a proxy on this machine is believed. What is no address counts as a name, so that it is counted, too.
    """
    host, address = peer, _address(peer)
    if address is not None and address.is_loopback:
        host = ",".join(forwarded).rpartition(",")[2].strip()
        parts = _split(f"//{host}")  # None of an address of IPv6 without brackets, which has no port
        host = host if parts is None else parts.hostname or host
        address = _address(host)
    if address is None:
        return host
    network = ipaddress.ip_network((address, 64 if address.version == 6 else 32), strict=False)
    return "" if address.is_loopback else str(network)


def is_loopback(host: str | None) -> bool:
    """Return whether a host is this machine, as only itself sees it."""
    return _canonical(host) == "localhost"


def _canonical(host: str | None) -> str | None:
    address = _address(host)
    return host if address is None else "localhost" if address.is_loopback else str(address)


def _split(text: str) -> SplitResult | None:
    """Split a URL; return None if it has no host, an invalid port, or further parts."""
    try:
        parts = urlsplit(text)
        if not parts.hostname or parts.port == 0:
            return None
    except ValueError:
        return None
    more = "@" in parts.netloc or parts.path not in {"", "/"} or parts.query or parts.fragment
    return None if more else parts


def _address(host: str | None) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Parse an address; one of IPv4 that is written as one of IPv6, as dual-stack sockets do, is one of IPv4."""
    try:
        address = ipaddress.ip_address(host or "")
    except ValueError:
        return None
    return address if isinstance(address, ipaddress.IPv4Address) else address.ipv4_mapped or address


class Upload:
    """The file that one connection sends, one at a time, counted before any of it is held."""

    def __init__(self) -> None:
        self.missing = set[int]()  # numbers of the announced parts that have not arrived
        self._uuid, self._num_bytes = "", 0  # name of the transfer, and number of missing bytes

    def start(self, uuid: str, name: str, num_bytes: int, num_parts: int) -> None:
        """Begin a file. Raises DataError, for the user, if it is too large, ValueError if the numbers do not fit."""
        self.missing = set()
        with naming(DataError, name):
            check_size(num_bytes, MAX_UPLOAD)
        if not 0 <= min(num_bytes, 1) <= num_parts <= min(num_bytes, MAX_PARTS):
            raise ValueError(f"{num_parts} parts for {num_bytes} bytes")
        self.missing, self._uuid, self._num_bytes = {*range(num_parts)}, uuid, num_bytes

    def part(self, uuid: str, index: int, num_bytes: int) -> bool:
        """Count a part; return whether it belongs to the file. Raises ValueError if the parts do not add up."""
        if not self.missing or self._uuid != uuid:
            return False
        rest, left = self.missing - {index}, self._num_bytes - num_bytes
        if index not in self.missing or left < 0 or (left > 0 and not rest):
            raise ValueError(f"part {index}, with {-left} bytes too many")
        self.missing, self._num_bytes = rest, left
        return True


class _Value(msgspec.Struct, forbid_unknown_fields=True):
    """Permitted changes of a control; viser would set any property that is named."""

    value: bool | int | float | str


class _Kind(msgspec.Struct):
    type: str


class _Connection(ServerConnection):
    """A connection that passes on the messages that the gate accepts."""

    def __init__(self, gate: Gate, *arguments: Any, **options: Any) -> None:  # noqa: ANN401 - of websockets
        super().__init__(*arguments, **options)
        self.upload, self.active = Upload(), time.monotonic()  # time of the last message, seconds
        self.number = -1  # of the connection on the board, once it is counted
        self.method, self._begun = b"", b""  # of the request; what was received before the method was known
        self._gate, self._second, self._num_received = gate, 0.0, 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        if len(self.server.handlers) > MAX_SOCKETS:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        """Pass on what is received, with GET in place of HEAD; websockets answers no other method than GET."""
        if not self.method:
            self._begun += data
            method, space, _ = self._begun.partition(b" ")
            if not space and len(self._begun) < LONGEST_METHOD:
                return
            data, self.method = self._begun, method if method.isalpha() and method.isupper() else b"GET"
            if self.method == b"HEAD":
                data = data.replace(b"HEAD", b"GET", 1)
            elif self.method != b"GET":
                self.transport.write(NOT_ALLOWED)
                self.transport.write_eof()
        if self.method in (b"GET", b"HEAD"):
            super().data_received(data)

    def connection_lost(self, exc: Exception | None) -> None:
        super().connection_lost(exc)
        if self.number >= 0:
            self._gate.share.disconnect(self.number)

    async def recv(self, decode: bool | None = None) -> Any:  # noqa: ANN401 - as in websockets
        """Return the next accepted message; raises ConnectionClosed as the base class."""
        while True:
            raw, now = await super().recv(decode), time.monotonic()
            if now - self._second >= 1:
                self._second, self._num_received = now, 0
            self._num_received += 1
            if self._num_received > MAX_RATE:
                await asyncio.sleep(self._second + 1 - now)
            try:
                if self._gate.passes(self, raw):
                    self.active = time.monotonic()
                    return raw
            except (ValueError, msgspec.MsgspecError, RecursionError):
                logger.warning("a connection is closed: it sent what no page sends")
                await self.close(1008, "malformed message")


class Gate:
    """Starts viser's server behind its checks."""

    def __init__(
        self,
        listening: socket.socket,
        origins: Origins,
        places: int,
        connections: int,
        of_address: int,
        refused: Callable[[viser.ClientHandle, str], None],
        share: Share,
    ) -> None:
        """Start viser's server behind the gate.

        Args:
            listening: socket whose connections it serves.
            origins: pages that may connect.
            places: largest number of visitors.
            connections: largest number of simultaneous connections, of visitors and of those who wait.
            of_address: largest number of connections of one `address_of`.
            refused: called with a visitor and the reason when a file is not accepted.
            share: row of this process.

        Raises:
            GateError: this version of viser has other messages, or does not start its server as expected.
        """
        self.places, self.connections, self.of_address = places, connections, of_address
        self._origins, self._refused, self.share = origins, refused, share
        self.server: Any = None  # of viser, once it is open
        try:
            self._decoders = {name: msgspec.msgpack.Decoder(_strict(name)) for name in SIZES}
        except (AttributeError, TypeError) as error:
            raise patches.GateError(str(error)) from error
        patches.report_failures(lambda error: logger.error("a callback failed", exc_info=error))
        self.server = patches.open_server(self._guarded, listening, label="DT-Viz", verbose=False)

    def _guarded(self, handler: Any, options: dict[str, Any]) -> tuple[Any, dict[str, Any]]:  # noqa: ANN401
        """Put the gate between websockets and viser's handler of connections."""

        def beat() -> None:
            self.share.beat()
            self._loop.call_later(BEAT, beat)

        async def handle(connection: ServerConnection) -> None:
            if connection.subprotocol == f"viser-v{viser.__version__}":
                await handler(connection)
            else:  # as viser does, but not on the terminal: the page says so
                await connection.close(1002, f"Version mismatch. Server: {viser.__version__}. Reload the page.")

        def report(_loop: asyncio.AbstractEventLoop, context: Mapping[str, Any]) -> None:
            logger.error("on the event loop: %s", context.get("message"), exc_info=context.get("exception"))

        self._loop = asyncio.get_running_loop()
        self._loop.set_exception_handler(report)
        beat()
        return handle, {
            **options,
            "process_request": partial(self._answer, options["process_request"]),
            "create_connection": partial(_Connection, self),
            "max_size": IMAGE,
        }

    def page(self, client: viser.ClientHandle) -> str:
        """Return the origin of a client's page in its browser, such as http://10.0.0.1:8080; empty if it has left."""
        connection = patches.connection_of(self.server, client.client_id)
        headers = {} if connection is None else connection.request.headers
        return headers.get("Origin") or (f"http://{headers['Host']}" if headers else "")

    def idle(self, client: viser.ClientHandle) -> float:
        """Return the time since a client sent something, seconds; 0 if it has left."""
        connection = patches.connection_of(self.server, client.client_id)
        return 0.0 if connection is None else time.monotonic() - connection.active

    def disconnect(self, client: viser.ClientHandle) -> None:
        """End the connection of a client after `LAST_WORDS`; its page comes again by itself."""

        async def close() -> None:
            await asyncio.sleep(LAST_WORDS)
            await connection.close()

        connection = patches.connection_of(self.server, client.client_id)
        if connection is not None:
            connection.active = time.monotonic()  # once is enough
            asyncio.run_coroutine_threadsafe(close(), self._loop)

    def _answer(self, answer: Any, connection: _Connection, request: Request) -> Response | None:  # noqa: ANN401
        """Answer a request as viser's `answer` does, or return None to let it become a connection."""
        refusal, report = self._refusal(connection, request), REPORTS.get(request.path)
        if refusal is not None:
            self.share.count("refused")
            logger.warning("a request was refused: %s", refusal[1])
            response = connection.respond(*refusal)
        elif report is not None:
            found = report(self.share, self.places)
            response = connection.respond(found.status, found.text)
            del response.headers["Content-Type"]
            response.headers["Content-Type"] = found.kind
        else:
            response = answer(connection, request)
        if response is not None:
            response.headers["Content-Security-Policy"] = self._origins.policy
            response.headers.update({"X-Content-Type-Options": "nosniff", "Referrer-Policy": "no-referrer"})
            if connection.method == b"HEAD":
                response.body = b""
        return response

    def _refusal(self, connection: _Connection, request: Request) -> tuple[int, str] | None:
        """Return why a request is refused; None takes it, and counts it if it asks for a connection."""
        hosts, origins, upgrades = (request.headers.get_all(name) for name in ("Host", "Origin", "Upgrade"))
        if len(hosts) != 1 or not self._origins.knows(hosts[0]):
            return 421, UNKNOWN
        if "websocket" not in ",".join(upgrades).lower():
            return None
        if len(origins) > 1 or (origins and not self._origins.admits(origins[0], hosts[0])):  # none: no browser
            return 403, FOREIGN
        if self.share.num_connections() >= self.connections:
            return 503, FULL
        address = address_of(connection.remote_address[0], request.headers.get_all("X-Forwarded-For"))
        if address and self.share.num_connections(address) >= self.of_address:
            return 429, CROWDED
        connection.number = self.share.connect(address)
        return None

    def passes(self, connection: _Connection, raw: bytes | str) -> bool:
        """Return whether viser gets a message; raises ValueError, MsgspecError or RecursionError if it is malformed."""
        if isinstance(raw, str):
            raise ValueError("text")
        name = msgspec.msgpack.decode(raw, type=_Kind).type
        if name not in SIZES or (name == STORED and len(raw) > PART):
            return False  # another page of the same origin may have stored it
        if len(raw) > SIZES[name]:
            raise ValueError(f"{len(raw)} bytes")
        message: Any = self._decoders[name].decode(raw)
        if not name.startswith("FileTransfer"):
            return _is_finite(message)
        client, upload = self.server and patches.client_of(self.server, connection), connection.upload
        if client is None:
            return False  # there is no page yet that could send it
        if name == "FileTransferPart":
            belongs = upload.part(message.transfer_uuid, message.part_index, len(message.content))
            if belongs and not upload.missing:
                patches.hide_upload(client, message.transfer_uuid)  # whether it can be used, the page says itself
            return belongs
        patches.drop_uploads(client)
        try:
            upload.start(message.transfer_uuid, message.filename, message.size_bytes, message.part_count)
        except DataError as error:
            patches.refuse_upload(client, message)
            self._refused(client, str(error))
            return False
        return True


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


def _is_finite(value: Any) -> bool:  # noqa: ANN401 - a message, or what it holds
    if isinstance(value, msgspec.Struct):
        value = msgspec.structs.astuple(value)
    if isinstance(value, tuple):
        return all(map(_is_finite, value))
    return not isinstance(value, float) or math.isfinite(value)


class RateLimitFilter(logging.Filter):
    """Filter that passes few records of each place in the program, and of exceptions the traceback but not the text.

    The first record after a period says how many were left out.
    """

    def __init__(self) -> None:
        super().__init__()
        self._counts: dict[tuple[str, int, str], tuple[float, int]] = {}  # start of a period, and records since

    def filter(self, record: logging.LogRecord) -> bool:
        """Return whether to write the record, after removing its confidential parts."""
        place, left_out = "", 0
        if record.exc_info and record.exc_info[0] is not None:
            error, _, trace = record.exc_info
            frames = traceback.extract_tb(trace)
            place = error.__name__ + (f" {frames[-1].filename}:{frames[-1].lineno}" if frames else "")
            record.exc_text = "".join(traceback.format_list(frames)) + error.__name__
            record.exc_info = None
        kind, now = (record.pathname, record.lineno, place), time.monotonic()
        began, count = self._counts.get(kind, (now, 0))  # of two threads at once one may count for both
        if now - began >= PERIOD:
            began, count, left_out = now, 0, max(0, count - MAX_RECORDS)
        self._counts[kind] = began, count + 1
        if left_out:
            record.msg, record.args = f"{record.getMessage()} (and {left_out} more like this)", ()
        return count < MAX_RECORDS
