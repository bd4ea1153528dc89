"""What is used of viser and websockets beyond what they document, and changed in them; nothing else does either.

Each function names the public hook that would replace it. What it needs is checked when the server starts. Styles of
elements of viser's page are HTML that is to stand on it; each would be replaced by an option of its elements.
"""

from __future__ import annotations

import asyncio
import copy
import functools
import io
import socket
import threading
from collections import OrderedDict
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import ExitStack, contextmanager, redirect_stdout, suppress
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import viser
import viser._assignable_props_api
import viser._messages
import viser._scene_api
import viser._viser
import viser.infra._async_message_buffer
import websockets.asyncio.server

Options = Callable[[Any, dict[str, Any]], tuple[Any, dict[str, Any]]]
"""Function of a handler of connections and of options of `websockets.serve`, which returns others."""

PANEL = """<style>
[data-dock-tab] { padding: 0 0.45em !important; }
@media (max-width: 36em) {
    .mantine-Paper-root:has([role="status"]), .mantine-ScrollArea-content > div:has([role="status"]) {
        width: 100% !important;
    }
}
</style>"""
"""Style of the panel: all tabs lie in one row, and on a phone it is as wide as the window."""
ROW = (
    "<style>div:has(> .dt-row) + div > div > :first-child { width: auto !important; }</style><div class='dt-row'></div>"
)
"""Mark and style of a group of buttons that needs the room beside its label to lie in one row."""
ALONE = """<style>
.mantine-Paper-root:has(.dt-caption) { visibility: hidden; }
.dt-caption, div:has(> .dt-caption) + div { visibility: visible; position: fixed; bottom: 0; box-sizing: border-box; }
.dt-caption {
    left: 0; right: 0; padding: 2.2em 13em 1.2em 2.4em; pointer-events: none; color: var(--mantine-color-text);
    background: linear-gradient(to top, var(--mantine-color-body) 35%, transparent);
}
.dt-caption h1 { margin: 0; font-size: clamp(1.5rem, 3.2vw, 4rem); line-height: 1.2; font-weight: 650; }
.dt-caption p { margin: 0.2em 0 0; font-size: clamp(1rem, 1.7vw, 2.2rem); line-height: 1.3; }
div:has(> .dt-caption) + div { right: 1em; width: 11.5em; padding: 0 0 1em; }
div:has(> .dt-caption) + div label { display: none; }
div:has(> .dt-caption) + div > div > :first-child { display: none; }
@media (max-width: 700px) { .dt-caption { padding: 1.6em 1.2em 3.4em; } }
</style>"""
"""Style that hides the panel around the caption, and puts that and the buttons after it at the foot of the window."""
AT_THE_FOOT = """<style>@media (max-width: 576px) {
  div:has(> .mantine-Tabs-root .dt-timeline) {
    position: sticky; bottom: 0; z-index: 1; background: var(--mantine-color-body);
  }
}</style><div class='dt-timeline'></div>"""
"""Mark and style of a window that stays at the foot on a phone, where it is a part of the sheet."""


class GateError(RuntimeError):
    """A version of viser whose internals differ from what is relied on."""

    def __init__(self, what: str) -> None:
        super().__init__(f"viser {viser.__version__} has changed ({what}); accepted: viser 1.1")


def declared(name: str) -> type:
    """Return the dataclass of a kind of messages; AttributeError if there is none. Hook: a public list of them."""
    return getattr(viser._messages, name)


def open_server(options: Options, listening: socket.socket, **arguments: Any) -> viser.ViserServer:  # noqa: ANN401
    """Start a server of viser. Hook: options of `ViserServer` that are passed on to `websockets.serve`.

    Args:
        options: function of viser's handler of connections and of its options for `websockets.serve`; it returns
            those that are used instead.
        listening: socket whose connections it serves; viser itself would take the next port where one is taken.
        **arguments: those of `viser.ViserServer`.

    Raises:
        GateError: viser does not start its server as expected.
    """
    module: Any = websockets.asyncio.server
    original, used, whole = module.serve, [], threading.Event()

    def serve(handler: Any, *_where: Any, **given: Any) -> Any:  # noqa: ANN401
        async def once_whole(connection: Any) -> None:  # noqa: ANN401
            if not whole.is_set():  # viser serves before it is complete, and the socket may have connections waiting
                await asyncio.to_thread(whole.wait)
            await handler(connection)

        used.append(True)
        taken, given = options(once_whole, given)
        return original(taken, sock=listening, **given)

    module.serve = serve
    try:
        with redirect_stdout(io.StringIO()):  # an address, as seen by viser
            server = viser.ViserServer(**arguments)
    finally:
        module.serve = original
        whole.set()
    connections = getattr(getattr(server, "_websock_server", None), "_live_connections", None)
    if not used or not isinstance(connections, dict):
        server.stop()
        raise GateError("its server" if not used else "its connections")
    return server


def report_failures(report: Callable[[BaseException], None]) -> None:
    """Have `report` called with what viser's callbacks raise, which it would print. Hook: `on_callback_error`."""

    def report_task(task: Any) -> None:  # noqa: ANN401 - a future, or a task
        if not task.cancelled() and task.exception() is not None:
            report(task.exception())

    reports = {
        "print_threadpool_errors": report_task,
        "print_task_error": report_task,
        "print_awaited_callback_error": report,
    }
    for module in (viser._gui_api, viser._scene_api, viser._viser):
        for name in reports.keys() & vars(module):
            setattr(module, name, reports[name])


class _Event(asyncio.Event):
    """An event that only its own loop sets: in other threads `set` does nothing, as viser then has the loop set it."""

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own = loop

    def set(self) -> None:
        with suppress(RuntimeError):  # no loop runs on this thread
            if asyncio.get_running_loop() is self._own:
                super().set()


def tell_from_threads() -> None:
    """Let any thread queue messages: viser sets an asyncio event in that thread, and once more in the loop.

    Where a thread sets it just before the loop waits for it, the loop sleeps, later calls of `set` do nothing as it is
    set, and the page stands still for ever. Hook: none is needed where viser sets it in its loop alone.
    """
    buffer: Any = viser.infra._async_message_buffer.AsyncMessageBuffer
    original = buffer.__init__

    @functools.wraps(original)
    def initialise(self: Any, *arguments: Any, **options: Any) -> None:  # noqa: ANN401
        original(self, *arguments, **options)
        self.message_event = _Event(self.event_loop)

    if not hasattr(original, "__wrapped__"):
        buffer.__init__ = initialise


def evaluate_hints_once() -> None:
    """Have viser evaluate the types of properties once for each class, not for each handle: a third of a page's time.

    Hook: none is needed where viser caches them by class.
    """
    base: Any = viser._assignable_props_api.AssignablePropsBase
    if isinstance(vars(base).get("_prop_hints"), functools.cached_property):
        hints = functools.cache(get_type_hints)
        base._prop_hints = property(lambda handle: hints(type(handle._impl.props)))


def client_of(server: viser.ViserServer, connection: Any) -> viser.ClientHandle | None:  # noqa: ANN401
    """Return the client of a connection; None before its page has told a camera. Hook: `ClientHandle.connection`."""
    live = server._websock_server._live_connections
    ids = [client_id for client_id, other in live.items() if other is connection]
    return server.get_clients().get(ids[0]) if ids else None


def connection_of(server: viser.ViserServer, client_id: int) -> Any:  # noqa: ANN401 - of websockets
    """Return the connection of a client; None if it has left. Hook: `ClientHandle.connection`."""
    return server._websock_server._live_connections.get(client_id)


def name_of(handle: Any) -> str:  # noqa: ANN401
    """Return the name of a control in the page. Hook: `handle.uuid`."""
    return handle._impl.uuid


def drop_uploads(client: viser.ClientHandle) -> None:
    """Let go of files that a client has not sent to the end. Hook: a limit of uploads that are under way."""
    client.gui._drop_uploads_from_client(client._websock_connection.client_id)  # pyright: ignore[reportArgumentType]


def refuse_upload(client: viser.ClientHandle, message: Any) -> None:  # noqa: ANN401 - FileTransferStartUpload
    """Have the page end an upload, which it shows until all of it is acknowledged. Hook: an upload that is refused."""
    size, uuid = message.size_bytes, message.transfer_uuid
    acknowledged = viser._messages.FileTransferPartAck(message.source_component_uuid, uuid, size, size)
    client._websock_connection.queue_message(acknowledged)
    hide_upload(client, uuid)


def hide_upload(client: viser.ClientHandle, uuid: str) -> None:
    """Have the page no longer show an upload, which it would call a success. Hook: a text of one's own for its end."""
    client._websock_connection.queue_message(viser._messages.RemoveNotificationMessage(f"upload-{uuid}"))


def put_back(handle: Any, value: Any, *, shown: bool) -> None:  # noqa: ANN401
    """Assign the value of a control, and show it in the browser if `shown`. Hook: a setter that calls nothing back.

    viser's own casts to the type of the browser's claim, and calls back on a loop that may have ended.
    """
    handle._impl.value = value
    if shown:
        handle._queue_update("value", value)


def put_back_pose(gizmo: viser.TransformControlsHandle, position: Any, wxyz: Any) -> None:  # noqa: ANN401
    """Show a pose in the browser, also where it was assigned last. Hook: a handler that may refuse a pose.

    viser stores whatever the browser sent, and skips values that it has already.
    """
    gizmo._impl.position, gizmo._impl.wxyz = np.full(3, np.nan), np.full(4, np.nan)
    gizmo.position, gizmo.wxyz = position, wxyz


def steps_html(steps: tuple[bool, bool]) -> str:
    """Return what dims the first two of the buttons after it, Undo and Redo, where there is no such step."""
    idle = (f"div:has(> .dt-steps) + div button:nth-of-type({k})" for k, step in enumerate(steps, start=1) if not step)
    style = "".join(f"{button} {{ opacity: 0.35; pointer-events: none; }}" for button in idle)
    return f"<style>{style}</style><div class='dt-steps'></div>"


NUM_ENCODED = 16
"""Number of the newest windows of messages that are kept as they are sent."""


def encode_once() -> None:
    """Encode what all clients of a server are sent once for all that are sent the same, not anew for each.

    Hook: a cache in viser's producer of messages.

    Raises:
        GateError: viser does not produce them as expected.
    """
    module: Any = viser.infra._infra
    if not hasattr(module, "_message_producer"):
        raise GateError("its producer of messages")
    original = module._message_producer

    @functools.wraps(original)
    async def produce(websocket: Any, buffer: Any, client_id: int, backlog_done_message: Any = None) -> None:  # noqa: ANN401
        if not buffer.persistent_messages:  # those of one client
            return await original(websocket, buffer, client_id, backlog_done_message)
        # windows, so that their names stay theirs, and bytes
        known = vars(buffer).setdefault("_encoded", OrderedDict())
        windows = buffer.window_generator(client_id, backlog_done_message=backlog_done_message)
        try:
            async for window in windows:
                name = tuple(map(id, window))
                if name not in known:
                    known[name] = window, await encoded(window)
                    while len(known) > NUM_ENCODED:
                        known.popitem(last=False)
                await websocket.send(known[name][1])
        finally:
            await windows.aclose()

    async def encoded(window: Any) -> bytes:  # noqa: ANN401
        """Return what viser sends of one window."""
        sent: list[bytes] = []

        async def once(_client_id: int, backlog_done_message: None) -> AsyncIterator[Any]:
            yield window

        async def send(raw: bytes) -> None:
            sent.append(raw)

        await original(SimpleNamespace(send=send), SimpleNamespace(done=False, window_generator=once), 0)
        return sent[0]

    if not hasattr(original, "__wrapped__"):
        module._message_producer = produce


SEEN_BY_ALL = ("BackgroundImageMessage", "EnvironmentMapMessage", "EnableLightsMessage", "ThemeConfigurationMessage")
"""Messages beside those of the scene's nodes that a `Mirror` passes on, by viser's name."""


class Mirror:
    """The scene of one client as all others see it, also later ones: what is drawn in it is drawn once for all.

    Nothing in the copy can be clicked or dragged, and viser's server knows no node of it: gizmos are plain frames, and
    what a client listens to, its panel and its camera are not passed on.

    Hook: nodes that are drawn in one scope, and handled in another one.
    """

    def __init__(self, server: viser.ViserServer, client: viser.ClientHandle) -> None:
        """Begin with an empty scene, in place of what was mirrored before; then all that the client is sent counts."""
        self._shared, self._connection = server._websock_server, client._websock_connection
        self._excluded, self._gizmos = client.client_id, set[str]()
        buffer = self._shared.get_message_buffer()
        with buffer.buffer_lock:
            nodes = [one for one in buffer.message_from_id.values() if one.entity_type == "scene"]
        names = {one.name for one in nodes if one.lifecycle_phase == "create"}  # pyright: ignore[reportAttributeAccessIssue]
        self._before = names - server.scene._handle_from_node_name.keys()
        with self._shared.atomic():
            for name in self._before:
                self._shared.queue_message(viser._messages.RemoveSceneNodeMessage(name))
        self._alone = self._connection.atomic
        replaced: Any = self._connection
        with self._connection._record_lock:
            replaced._record_handles.append(self)
            replaced.atomic = self._atomic

    def end(self) -> None:
        """Leave the copy as it is."""
        replaced: Any = self._connection
        with self._connection._record_lock:
            replaced._record_handles.remove(self)
            replaced.atomic = self._alone

    @contextmanager
    def _atomic(self) -> Iterator[None]:
        with ExitStack() as stack:
            stack.enter_context(self._alone())
            stack.enter_context(self._shared.atomic())
            yield

    def _insert_message(self, message: Any) -> None:  # noqa: ANN401 - of viser, which calls this for each
        """Pass on a message that the client is sent, if all may see what it draws."""
        messages, name = viser._messages, getattr(message, "name", "")
        if message.entity_type != "scene" and type(message).__name__ not in SEEN_BY_ALL:
            return
        if message.lifecycle_phase in ("create", "remove"):
            self._gizmos.discard(name)
        if isinstance(message, messages.TransformControlsMessage):
            self._gizmos.add(name)
            look = {"show_axes": False, "axes_length": 0.0, "axes_radius": 0.0, "origin_radius": 0.0}
            copied: Any = messages.FrameMessage(name, messages.FrameProps(**look, origin_color=(0, 0, 0), scale=1.0))
        elif name in self._gizmos and isinstance(message, messages.SceneNodeUpdateMessage):
            return  # how large the handles are, and which
        else:
            copied = copy.copy(message)
        if message.entity_type == "scene":
            copied.owner = ""
        copied.excluded_self_client = self._excluded
        if message.lifecycle_phase == "create":
            self._shared.get_message_buffer().remove_entity_state_from_buffer("scene", name)
        self._shared.queue_message(copied)
        if message.lifecycle_phase == "create" and name in self._before:  # a browser would leave it where it was
            for pose in (
                messages.SetOrientationMessage(name, (1.0, 0.0, 0.0, 0.0)),
                messages.SetPositionMessage(name, (0.0, 0.0, 0.0)),
            ):
                self._shared.queue_message(pose)


class Tape(viser.infra.WebsockMessageHandler):
    """A scene of its own that no browser is connected to: what is drawn in it is recorded.

    Hook: a `SceneApi`, and its serializer, without a server.
    """

    def __init__(self) -> None:
        super().__init__()
        nothing: Any = None  # nobody answers: no loop calls anything back
        self._unsent = viser.infra._async_message_buffer.AsyncMessageBuffer(nothing, persistent_messages=False)
        lock = SimpleNamespace(_scene_lifecycle_lock=threading.RLock())
        owner: Any = SimpleNamespace(_websock_connection=self, _viser_server=lock, client_id="")
        self._serializer = self.get_message_serializer(lambda message: message.include_in_scene_serialization)
        self.scene = viser.SceneApi(owner, nothing, nothing)
        self.camera = viser._viser.InitialCameraConfig(self.queue_message)
        """Where the camera is at first."""

    def get_message_buffer(self) -> Any:  # noqa: ANN401 - of what is sent, which is nothing
        """Return where messages wait that are to be sent, which none are."""
        return self._unsent

    def queue_message(self, message: Any) -> None:  # noqa: ANN401 - of viser
        """Record a message of the scene."""
        self._serializer._insert_message(message)

    @contextmanager
    def atomic(self) -> Iterator[None]:
        """Do nothing: what is drawn at a moment of the recording is shown together anyway."""
        yield

    def wait(self, seconds: float) -> None:
        """Let some time of the recording pass."""
        self._serializer.insert_sleep(seconds)

    def html(self) -> str:
        """End it; return a page that plays it again and again, with all that it needs."""
        return self._serializer.as_html()
