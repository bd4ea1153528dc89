"""What is used of viser and websockets beyond what they document, and changed in them; no other module does either.

Each docstring names the issue or pull request of github.com/viser-project/viser that it waits for, or says what viser
lacks where there is none. `open_server` checks what it needs. Styles are HTML that is to stand on viser's page.
"""

from __future__ import annotations

import asyncio
import copy
import functools
import io
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, wait
from contextlib import contextmanager, redirect_stdout, suppress
from types import SimpleNamespace
from typing import Any, get_type_hints
from uuid import uuid4

import numpy as np
import viser
import viser._assignable_props_api
import viser._messages
import viser._scene_api
import viser._viser
import viser.infra._async_message_buffer
import websockets.asyncio.server

from dt_viz.errors import FormatError

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
"""Style of the panel: all tabs lie in one row, and on a phone it is as wide as the window. Waits for #617."""
ROW = (
    "<style>div:has(> .dt-row) + div > div > :first-child { width: auto !important; }</style><div class='dt-row'></div>"
)
"""Mark and style of a group of buttons that needs the room beside its label to lie in one row. Waits for #655."""
UNSEEN = "<style>div:has(> .dt-unseen) + div { display: none; }</style><div class='dt-unseen'></div>"
"""Mark and style that hide the control after it, which a script writes to; viser lacks messages of a page's script."""
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
"""Style that hides the panel around the caption, and puts that and the buttons after it at the foot of the window.

Waits for #617.
"""
AT_THE_FOOT = """<style>@media (max-width: 576px) {
  div:has(> .mantine-Tabs-root .dt-timeline) {
    position: sticky; bottom: 0; z-index: 1; background: var(--mantine-color-body);
  }
}</style><div class='dt-timeline'></div>"""
"""Mark and style of a window that stays at the foot on a phone, where it is a part of the sheet. Waits for #617."""


class GateError(RuntimeError):
    """A version of viser whose internals differ from what is relied on."""

    def __init__(self, what: str) -> None:
        super().__init__(f"viser {viser.__version__} has changed ({what}); accepted: viser 1.1")


def declared(name: str) -> type:
    """Return the dataclass of a kind of messages; viser lacks a public list of them. Raises AttributeError."""
    return getattr(viser._messages, name)


def open_server(options: Options, listening: socket.socket, **arguments: Any) -> viser.ViserServer:  # noqa: ANN401
    """Start a server of viser; `ViserServer` lacks options that are passed on to `websockets.serve`.

    Args:
        options: function of viser's handler of connections and of its options for `websockets.serve`; it returns
            those that are used instead.
        listening: socket whose connections it serves; viser itself would take the next port where one is taken.
        **arguments: those of `viser.ViserServer`.

    Raises:
        GateError: viser does not start its server as expected.
    """
    _correct()
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
        with redirect_stdout(io.StringIO()):  # viser prints its address, which is not that of the supervisor
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
    """Have `report` called with what viser's callbacks raise.

    viser prints it, since #377; it lacks a callback for these errors.
    """

    def report_task(task: Any) -> None:  # noqa: ANN401 - a future, or a task
        if not task.cancelled() and task.exception() is not None:
            report(task.exception())

    reports = {
        "print_threadpool_errors": report_task,
        "print_task_error": report_task,
        "print_awaited_callback_error": report,
    }
    for module in (viser._gui_api, viser._gui_handles, viser._scene_api, viser._viser):
        vars(module).update(reports)


class _Event(asyncio.Event):
    """An event that only its own loop sets: in other threads `set` does nothing, as viser then has the loop set it.

    Else a thread may set it just before the loop begins to wait; then the loop's own `set` does nothing, and the page
    receives no more messages. #223 locks the buffer, but not this event.
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        super().__init__()
        self._own = loop

    def set(self) -> None:
        with suppress(RuntimeError):  # no loop runs on this thread
            if asyncio.get_running_loop() is self._own:
                super().set()


@functools.cache
def _correct() -> None:
    """Correct viser for all servers of this process.

    viser evaluates the types of properties for each handle, a third of the time that a page takes; it lacks a cache.
    """
    buffer: Any = viser.infra._async_message_buffer.AsyncMessageBuffer
    base: Any = viser._assignable_props_api.AssignablePropsBase
    initialise, hints = buffer.__init__, functools.cache(get_type_hints)

    def initialise_with_event(self: Any, *arguments: Any, **options: Any) -> None:  # noqa: ANN401
        initialise(self, *arguments, **options)
        self.message_event = _Event(self.event_loop)

    buffer.__init__ = initialise_with_event
    base._prop_hints = property(lambda handle: hints(type(handle._impl.props)))


def client_of(server: viser.ViserServer, connection: Any) -> viser.ClientHandle | None:  # noqa: ANN401
    """Return the client of a connection; None before its page has sent a camera. `ClientHandle` lacks a connection."""
    ids = [number for number, other in server._websock_server._live_connections.items() if other is connection]
    return server.get_clients().get(ids[0]) if ids else None


def connection_of(server: viser.ViserServer, client_id: int) -> Any:  # noqa: ANN401 - of websockets
    """Return the connection of a client; None if it has left. `ClientHandle` lacks it."""
    return server._websock_server._live_connections.get(client_id)


def rendered(client: viser.ClientHandle, size: tuple[int, int], shot: Mapping[str, Any], timeout: float) -> bytes:
    """Have a browser render its scene as a PNG; return its answer, which may be any bytes.

    `ClientHandle.get_render`, also since #751, decodes pictures of any format and size; it lacks a way not to.

    Args:
        client: the browser; the server's event loop must not call this.
        size: width and height, pixels.
        shot: `wxyz`, `position` and `fov` of the camera.
        timeout: longest time to wait, seconds.

    Raises:
        FormatError: the browser has left.
        TimeoutError: the browser did not answer.
    """
    messages, connection, uuid = viser._messages, client._websock_connection, uuid4().hex
    answer, deadline = Future[bytes](), time.monotonic() + timeout

    def take(_client_id: int, message: Any) -> None:  # noqa: ANN401 - GetRenderResponseMessage
        if message.render_uuid == uuid and not answer.done():
            answer.set_result(message.payload)

    numbers: dict[str, Any] = {name: np.asarray(value, float).tolist() for name, value in shot.items()}
    width, height = size
    connection.register_handler(messages.GetRenderResponseMessage, take)
    try:
        client._viser_server.flush()
        asked = messages.GetRenderRequestMessage("image/png", height, width, 80, **numbers, render_uuid=uuid)
        connection.queue_message(asked)
        client.flush()
        while not wait([answer], 0.1).done:
            if client.client_id not in client._viser_server.get_clients():
                raise FormatError("the browser", "one that has left", "a page that stays open")
            if time.monotonic() > deadline:
                raise TimeoutError(f"the browser drew nothing within {timeout:g} s")
    finally:
        connection.unregister_handler(messages.GetRenderResponseMessage, take)
    return answer.result()


def name_of(handle: Any) -> str:  # noqa: ANN401
    """Return the name of a control in the page; handles lack it."""
    return handle._impl.uuid


def drop_uploads(client: viser.ClientHandle) -> None:
    """Forget files that a client has not sent to the end; viser, since #168, lacks a limit of unfinished uploads."""
    client.gui._drop_uploads_from_client(client._websock_connection.client_id)  # pyright: ignore[reportArgumentType]


def refuse_upload(client: viser.ClientHandle, message: Any) -> None:  # noqa: ANN401 - FileTransferStartUpload
    """Have the page end an upload, which it shows until all of it is acknowledged; viser lacks a refusal."""
    size, uuid = message.size_bytes, message.transfer_uuid
    acknowledged = viser._messages.FileTransferPartAck(message.source_component_uuid, uuid, size, size)
    client._websock_connection.queue_message(acknowledged)
    hide_upload(client, uuid)


def hide_upload(client: viser.ClientHandle, uuid: str) -> None:
    """Have the page no longer show an upload, which it would call a success; viser lacks a text for its end."""
    client._websock_connection.queue_message(viser._messages.RemoveNotificationMessage(f"upload-{uuid}"))


def put_back(handle: Any, value: Any, *, shown: bool) -> None:  # noqa: ANN401
    """Assign the value of a control, and show it in the browser if `shown`; viser lacks a setter that only does this.

    Its own casts to the type of the browser's claim, and calls back on a loop that may have ended.
    """
    handle._impl.value = value
    if shown:
        handle._queue_update("value", value)


def put_back_pose(gizmo: viser.TransformControlsHandle, position: Any, wxyz: Any) -> None:  # noqa: ANN401
    """Show a pose in the browser, also where it was assigned last; viser lacks a handler that may refuse a pose.

    It stores any pose from the browser, and skips values that it has already.
    """
    gizmo._impl.position, gizmo._impl.wxyz = np.full(3, np.nan), np.full(4, np.nan)
    gizmo.position, gizmo.wxyz = position, wxyz


STEP_GROUPS = [f"div:has(> .dt-steps){' + div' * k}" for k in range(1, 5)]
"""Selectors of the four groups of one button after `steps_html`."""
_WIDE = "(100% - 7.25em - 2 * var(--mantine-spacing-xs) - 3 * 0.375em) / 4"
IN_A_ROW = f"""
{", ".join(STEP_GROUPS)} {{ display: inline-block; vertical-align: top; width: calc({_WIDE} + 0.375em);
  padding-inline: 0.375em 0 !important; }}
{STEP_GROUPS[0]} {{ width: calc({_WIDE} + 7.25em + var(--mantine-spacing-xs));
  padding-inline: var(--mantine-spacing-xs) 0 !important; }}
{", ".join(f"{group} > div > :first-child" for group in STEP_GROUPS[1:])} {{ display: none; }}
{", ".join(f"{group} button" for group in STEP_GROUPS)} {{ padding: 0; }}
"""
"""Style that lays these groups in a row behind the label of the first one, as viser lays the buttons of one group."""


def steps_html(steps: tuple[bool, bool]) -> str:
    """Return HTML that lays the four groups of one button after it in a row; waits for #655 (in work: #717).

    One group of viser has one hint. The first two, Undo and Redo, are pale where there is no such step.
    """
    idle = (f"{group} button" for group, step in zip(STEP_GROUPS, steps, strict=False) if not step)
    style = "".join(f"{button} {{ opacity: 0.35; pointer-events: none; }}" for button in idle)
    return f"<style>{IN_A_ROW}{style}</style><div class='dt-steps'></div>"


SEEN_BY_ALL = ("BackgroundImageMessage", "EnvironmentMapMessage", "EnableLightsMessage", "ThemeConfigurationMessage")
"""Messages beside those of the scene's nodes that a `Mirror` passes on, by viser's name."""


class Mirror:
    """Copy of one client's scene for all other clients, also for those that connect later.

    Nothing in the copy can be clicked or dragged, and viser's server knows no node of it: gizmos are plain frames, and
    bindings of clicks and drags, the panel and the camera of the client are not passed on.

    Scopes, since #758, are those of one client or of all; viser lacks nodes that all see and one client handles.
    """

    def __init__(self, server: viser.ViserServer, client: viser.ClientHandle) -> None:
        """Copy what the client is sent from now on, in place of the last copy."""
        self._shared, self._gizmos = server._websock_server, set[str]()
        self._connection: Any = client._websock_connection
        alone, shared = self._connection.atomic, self._shared.atomic

        @contextmanager
        def atomic() -> Iterator[None]:
            with alone(), shared():
                yield

        buffer = self._shared.get_message_buffer()
        with buffer.buffer_lock:
            nodes: list[Any] = [one for one in buffer.message_from_id.values() if one.entity_type == "scene"]
        names = {one.name for one in nodes if one.lifecycle_phase == "create"}
        with shared():
            for name in names - server.scene._handle_from_node_name.keys():
                self._shared.queue_message(viser._messages.RemoveSceneNodeMessage(name))
        with self._connection._record_lock:
            self._connection._record_handles.append(self)
            self._connection.atomic = atomic

    def end(self) -> None:
        """Leave the copy as it is."""
        with self._connection._record_lock:
            self._connection._record_handles.remove(self)
            del self._connection.atomic  # that of its class is used again

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
        copies = [copied]
        if message.entity_type == "scene":
            copied.owner = ""
        if message.lifecycle_phase == "create":  # a browser leaves a node of this name where it was
            self._shared.get_message_buffer().remove_entity_state_from_buffer("scene", name)
            copies += (
                messages.SetOrientationMessage(name, (1.0, 0.0, 0.0, 0.0)),
                messages.SetPositionMessage(name, (0.0,) * 3),
            )
        for one in copies:
            one.excluded_self_client = self._connection.client_id
            self._shared.queue_message(one)


class Tape(viser.infra.WebsockMessageHandler):
    """A scene that no browser is connected to, and the recording of what is drawn in it.

    viser lacks a `SceneApi`, and its serializer, without a server.
    """

    def __init__(self) -> None:
        super().__init__()
        nothing: Any = None  # without a browser no loop calls anything back
        self._unsent = viser.infra._async_message_buffer.AsyncMessageBuffer(nothing, persistent_messages=False)
        lock = SimpleNamespace(_scene_lifecycle_lock=threading.RLock())
        owner: Any = SimpleNamespace(_websock_connection=self, _viser_server=lock, client_id="")
        self.recording = self.get_message_serializer(lambda message: message.include_in_scene_serialization)
        """Recording, whose `insert_sleep` passes time, and whose `as_html` ends it and returns a page that plays it."""
        self.scene = viser.SceneApi(owner, nothing, nothing)
        self.camera = viser._viser.InitialCameraConfig(self.queue_message)
        """First pose of the camera."""

    def get_message_buffer(self) -> Any:  # noqa: ANN401
        """Return viser's buffer of messages to be sent, which stays empty."""
        return self._unsent

    def queue_message(self, message: Any) -> None:  # noqa: ANN401 - of viser
        """Record a message of the scene."""
        self.recording._insert_message(message)

    @contextmanager
    def atomic(self) -> Iterator[None]:
        """Do nothing: what is drawn at a moment of the recording is shown together anyway."""
        yield
