"""A visitor without a browser: speaks viser's protocol, keeps the state of the page, and drags and sets things.

A frame of the WebSocket from the server has two lengths (little-endian, 8 bytes each), a msgpack map compressed with
zstd, and the arrays for which that map has placeholders, each at a multiple of 8 bytes. A message to the server is one
msgpack map.
"""

from __future__ import annotations

import asyncio
import math
import time
from collections.abc import Callable, Mapping
from functools import partial
from importlib.metadata import version
from types import TracebackType
from typing import Any, TypeVar
from uuid import uuid4

import msgspec
import numpy as np
import websockets
import zstandard
from numpy.typing import ArrayLike
from websockets.asyncio.client import ClientConnection, connect
from websockets.typing import Subprotocol

from dt_viz.obstacles.shapes import UPRIGHT

ROLLOUT, OBSTACLE = "/rollouts/followed", "/obstacles/0"
"""Names of the tube of the rollout that the arm follows and of the first obstacle's gizmo in the scene tree."""
ANSWERED = "/obstacles/answered"
"""Name of the node at the place of the first obstacle for which the rollouts are computed."""
STATUS = "Smallest det J"  # text in the details of every frame's status
MAX_MESSAGE = 64 * 2**20  # largest size of a message from the server, bytes
PART = 512 * 1024  # size of a part of a file, bytes, as in viser's own page

Client = TypeVar("Client", bound="ProtocolClient")


class LostError(ConnectionError):
    """A connection that the server has closed."""


class ProtocolClient:
    """A visitor: an asynchronous context manager that is connected inside its block."""

    def __init__(self, url: str, *, origin: str | None = None, protocol: str | None = None) -> None:
        """Visit a server.

        Args:
            url: address of the WebSocket, such as ``ws://127.0.0.1:8080``.
            origin: origin of the page that it imitates; None sends none.
            protocol: WebSocket subprotocol; that of the installed viser if None.
        """
        self._connect = partial(
            connect,
            url,
            origin=None if origin is None else websockets.Origin(origin),
            subprotocols=[Subprotocol(protocol or f"viser-v{version('viser')}")],
            compression=None,
            max_size=MAX_MESSAGE,
            proxy=None,
        )
        self.nodes: dict[str, dict[str, Any]] = {}  # properties of the scene's nodes, by name; arrays are flat
        self.controls: dict[str, dict[str, Any]] = {}  # properties of the panel's controls, by identifier
        self.storage: dict[str, str] = {}  # what the browser keeps, by name
        self.notices: list[str] = []  # texts of the notifications
        self.changed: Callable[[str, Mapping[str, Any], float], None] = lambda _name, _changes, _now: None
        """Called for each new or changed node with its name, properties, and the time of `time.perf_counter`."""
        self._news = asyncio.Event()
        self._ended: Exception | None = None

    async def __aenter__(self: Client) -> Client:
        self._socket: ClientConnection = await self._connect()
        self._receiving = asyncio.create_task(self._receive())
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self._socket.close()
        await self._receiving

    async def ping(self) -> float:
        """Ping the server; return the seconds until its event loop has answered. Raises LostError."""
        try:
            return await (await self._socket.ping())
        except websockets.ConnectionClosed as error:
            raise LostError(str(error)) from error

    async def send(self, kind: str, **fields: Any) -> None:
        """Send a message. Raises LostError."""
        await self.send_raw(msgspec.msgpack.encode({"type": kind, **fields}))

    async def send_raw(self, raw: bytes | str) -> None:
        """Send anything. Raises LostError."""
        try:
            await self._socket.send(raw)
        except websockets.ConnectionClosed as error:
            raise LostError(str(error)) from error

    async def look(self, width: int = 1280, height: int = 720) -> None:
        """Report the camera; the server then builds the page."""
        where = {"position": (0.0, -2.0, 1.0), "look_at": (0.0, 0.0, 0.0), "up_direction": (0.0, 0.0, 1.0)}
        image = {"fov": 0.75, "near": 0.01, "far": 1000.0, "image_height": height, "image_width": width}
        await self.send("ViewerCameraMessage", wxyz=UPRIGHT, **where, **image)

    async def look_until_drawn(self, seconds: float) -> bool:
        """Have the page built, and wait for its first picture; return False if it does not come in time."""
        await self.look()
        return await self.wait_for(lambda: self.has_picture, seconds)

    async def wait_for(self, condition: Callable[[], object], seconds: float) -> bool:
        """Wait until a condition on the page holds; return False if it does not in time.

        Raises:
            LostError: the connection ended first.
        """
        deadline = time.monotonic() + seconds
        while not condition():
            if self._ended is not None:
                raise LostError(str(self._ended))
            self._news.clear()
            try:
                await asyncio.wait_for(self._news.wait(), max(0.0, deadline - time.monotonic()))
            except asyncio.TimeoutError:
                return bool(condition())
        return True

    @property
    def status(self) -> str:
        """The details of the status, as HTML; empty before there are some."""
        texts = (str(control.get("content", "")) for control in self.controls.values())
        return next((text for text in texts if STATUS in text), "")

    @property
    def lost(self) -> bool:
        """Whether the connection has ended."""
        return self._ended is not None

    @property
    def has_rollouts(self) -> bool:
        """Whether rollouts are on the page; before the first there is a triangle without size."""
        return bool(np.ptp(self.nodes.get(ROLLOUT, {}).get("vertices", 0)) > 0)

    @property
    def has_picture(self) -> bool:
        """Whether rollouts and their status are on the page."""
        return self.has_rollouts and bool(self.status)

    def find(self, label: str) -> str:
        """Return the identifier of the control with this label, of several the first that is shown. Raises KeyError."""
        shown = {uuid: one.get("visible", True) for uuid, one in self.controls.items() if one.get("label") == label}
        if not shown:
            raise KeyError(label)
        return max(shown, key=shown.__getitem__)

    async def report(self, *, width: int = 1280, **found: object) -> None:
        """Report the window's width, CSS pixels, and the link or key that was found, as a script on the page does."""
        await self.set("Window", msgspec.json.encode({"width": width, **found}).decode())

    async def present(self, key: str) -> None:
        """Claim to be the presenter of a server that has one scene for all."""
        await self.report(key=key)

    async def set(self, label: str, value: bool | float | str) -> None:
        """Set the value of a control; the page shows it at once, since the server does not send it back."""
        uuid = self.find(label)
        self.controls[uuid]["value"] = value
        await self.send("GuiUpdateMessage", uuid=uuid, updates={"value": value})

    async def send_file(
        self, label: str, name: str, content: bytes, *, announced: int | None = None, transfer: str = ""
    ) -> None:
        """Send a file with the upload button of this label.

        Args:
            label: of the button.
            name: of the file.
            content: all bytes of it.
            announced: number of bytes that it is said to have; the true one if None.
            transfer: identifier of the transfer; a new one if empty.
        """
        size = len(content) if announced is None else announced
        common = {"source_component_uuid": self.find(label), "transfer_uuid": transfer or uuid4().hex}
        what = {"filename": name, "mime_type": "", "part_count": math.ceil(size / PART), "size_bytes": size}
        await self.send("FileTransferStartUpload", **common, **what)
        for index, begin in enumerate(range(0, len(content), PART)):
            part = content[begin : begin + PART]
            await self.send("FileTransferPart", **common, part_index=index, content=part)

    async def grab(self, name: str = OBSTACLE) -> None:
        """Show the handles of the obstacle, and begin to drag a gizmo."""
        await self.set("Handles", True)
        await self._drag("DragStart", name)

    async def move(self, position: ArrayLike, name: str = OBSTACLE) -> None:
        """Drag a gizmo to a place (3,), metres."""
        await self._drag("Update", name, wxyz=UPRIGHT, position=np.asarray(position, float).tolist())

    async def release(self, name: str = OBSTACLE) -> None:
        """End the drag of a gizmo."""
        await self._drag("DragEnd", name)

    async def _drag(self, what: str, name: str, **pose: Any) -> None:
        await self.send(f"TransformControls{what}Message", name=name, owner=self.nodes[name]["owner"], **pose)

    async def _receive(self) -> None:
        try:
            async for raw in self._socket:
                assert isinstance(raw, bytes)
                now = time.perf_counter()
                for message in decoded(raw):
                    self._apply(message, now)
                    if message["type"] == "LocalStorageGetItemRequestMessage":
                        told = {"value": self.storage.get(message["key"]), "request_uuid": message["request_uuid"]}
                        await self.send("LocalStorageGetItemResponseMessage", error=None, **told)
                self._news.set()
            self._ended = LostError("the server closed the connection")
        except (websockets.ConnectionClosed, LostError) as error:
            self._ended = error
        finally:
            self._news.set()

    def _apply(self, message: Mapping[str, Any], now: float) -> None:
        """Update the state of the page by a message."""
        kind = message["type"]
        if kind == "NotificationShowMessage":
            self.notices.append(message["props"]["body"])
        elif kind == "LocalStorageSetItemMessage":
            self.storage[message["key"]] = message["value"]
        elif kind == "LocalStorageRemoveItemMessage":
            self.storage.pop(message["key"], None)
        elif kind == "SceneNodeUpdateMessage":
            self.nodes.setdefault(message["name"], {}).update(message["updates"])
            self.changed(message["name"], message["updates"], now)
        elif kind == "SetPositionMessage":
            self.nodes.setdefault(message["name"], {})["position"] = message["position"]
        elif kind == "SetSceneNodeVisibilityMessage":
            self.nodes.setdefault(message["name"], {})["visible"] = message["visible"]
        elif kind == "RemoveSceneNodeMessage":
            self.nodes.pop(message["name"], None)
        elif kind == "GuiUpdateMessage":
            self.controls.setdefault(message["uuid"], {}).update(message["updates"])
        elif kind == "GuiRemoveMessage":
            self.controls.pop(message["uuid"], None)
        elif "props" in message and "name" in message:
            self.nodes.setdefault(message["name"], {}).update(message["props"], owner=message["owner"])
            self.changed(message["name"], message["props"], now)
        elif "props" in message and "uuid" in message:
            self.controls[message["uuid"]] = {"kind": kind, "value": message.get("value"), **message["props"]}


def decoded(raw: bytes) -> list[dict[str, Any]]:
    """Decode the messages in a frame from the server; their arrays are flat."""
    num_packed = int.from_bytes(raw[8:16], "little")
    unpacked = zstandard.ZstdDecompressor().decompress(
        raw[16 : 16 + num_packed], max_output_size=int.from_bytes(raw[:8], "little")
    )
    content = msgspec.msgpack.decode(unpacked)
    arrays, offset = [], 16 + num_packed
    for length in content["binaryBufferLengths"]:
        offset += -offset % 8
        arrays.append(raw[offset : offset + length])
        offset += length

    def filled(value: Any) -> Any:
        if isinstance(value, dict):
            if "__binary_index" in value:
                return np.frombuffer(arrays[value["__binary_index"]], value["dtype"])
            return {key: filled(item) for key, item in value.items()}
        return [filled(item) for item in value] if isinstance(value, list) else value

    return [filled(message) for message in content["messages"]]
