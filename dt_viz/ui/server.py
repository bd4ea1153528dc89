"""The web server: one private page for each visitor."""

from __future__ import annotations

import logging
import socket
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from typing import NoReturn

import viser

from dt_viz.learning.store import FitStore
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import TaskEntry
from dt_viz.session.arms import ArmStore
from dt_viz.ui.gate import Gate, Limits
from dt_viz.ui.keeping import KEY
from dt_viz.ui.origins import Origin, Origins
from dt_viz.ui.panel import MAX_UPLOAD
from dt_viz.ui.tabs.status import COLOURS
from dt_viz.ui.visitor import Visitor, notify
from dt_viz.warning import Severity

logger = logging.getLogger(__name__)


# a visitor may leave between two pictures of the arm; a picture without a receiver is no problem
warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)


class AddressError(OSError):
    """An address on which the server cannot listen; the message says why and what to do."""


class Server:
    """Serves the page until it is closed."""

    def __init__(
        self,
        tasks: Mapping[str, TaskEntry],
        fits: FitStore,
        robot: Robot,
        *,
        task: str,
        host: str = "127.0.0.1",
        port: int = 8080,
        max_sessions: int = 8,
        max_waiting: int = 8,
        allowed: Sequence[Origin] = (),
    ) -> None:
        """Listen and wait for visitors.

        Args:
            tasks: tasks by name, made for the JACO.
            fits: store shared by all visitors.
            robot: the arm.
            task: first task of each visitor.
            host: address to listen on.
            port: port to listen on; 0 takes any free one.
            max_sessions: largest number of visitors; further ones wait until one leaves.
            max_waiting: largest number of those who wait; any more are refused.
            allowed: origins of other pages that may connect; see `Origins`.

        Raises:
            AddressError: the address is not available.
            GateError: this version of viser is not supported.
        """
        port = _checked_port(host, port)
        titles, arms = {name: entry.title for name, entry in tasks.items()}, ArmStore(tasks, fits, robot)
        self._new_visitor: Callable[[viser.ClientHandle], Visitor] = lambda client: Visitor(
            client, arms.engine(), robot, titles, task, arms
        )
        self._max_sessions = max_sessions
        self._lock = threading.Condition()
        self._visitors: dict[int, Visitor | None] = {}
        """Those with a page, and None for those whose page is being built."""
        self._waiting: dict[int, tuple[viser.ClientHandle, viser.GuiMarkdownHandle | None]] = {}
        """Those who wait for a place, in the order in which they came, and what their page says meanwhile."""
        self._num_building = 0
        """Number of pages that are being built, also for visitors who have left meanwhile."""
        self._closed = False
        places = max_sessions + max_waiting
        limits = Limits(places, upload=MAX_UPLOAD, of_address=max(2, places // 2))
        self.gate = Gate(Origins(host, allowed), limits, _refuse, self._measured)
        self._server = self.gate.open(host, port, "DT-Viz")
        if self._server.get_port() != port:  # another program was faster than the check
            self._server.stop()
            raise AddressError(f"port {port} on {host} was taken a moment ago; choose another with --port")
        self.host, self.port = host, port
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._farewell)

    @property
    def visitors(self) -> tuple[Visitor, ...]:
        """Visitors with a page of their own."""
        return tuple(visitor for visitor in self._visitors.values() if visitor is not None)

    def wait(self) -> NoReturn:
        """Serve until a signal handler raises an exception.

        Only this thread runs signal handlers, and a signal that arrives just before a sleep, or on another thread, is
        handled after it.
        """
        while True:
            time.sleep(0.5)

    def close(self) -> None:
        """Close all pages and stop listening."""
        patience = 2.0  # seconds
        with self._lock:
            self._closed = True
            self._lock.wait_for(lambda: not self._num_building, patience)  # a page that is being built needs the server
        visitors = self.visitors
        for visitor in visitors:
            visitor.close()
        for visitor in visitors:  # and so does what they are drawing
            visitor.session.jobs.wait_idle(timeout=patience)
        self._server.stop()

    def _welcome(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if self._closed or client.client_id not in self._server.get_clients():
                return  # left before its turn came
            full = (
                f"**All {self._max_sessions} places are taken.** This page opens by itself when a place is free: close "
                "another tab of this demo, or wait. Whoever runs the server can allow more with `--max-sessions`."
            )
            said = client.gui.add_markdown(full) if len(self._visitors) >= self._max_sessions else None
            self._waiting[client.client_id] = client, said
        self._admit()

    def _admit(self) -> None:
        """Build the page of the visitor who has waited longest, if there is a place."""
        with self._lock:
            if self._closed or not self._waiting or len(self._visitors) >= self._max_sessions:
                return
            client, said = self._waiting.pop(next(iter(self._waiting)))
            self._visitors[client.client_id] = None  # a place is taken before the page is built
            self._num_building += 1
        try:
            if said is not None:
                said.remove()
            self._build_page(client)
        finally:
            with self._lock:
                self._num_building -= 1
                self._lock.notify_all()

    def _build_page(self, client: viser.ClientHandle) -> None:
        try:
            visitor = self._new_visitor(client)
        except Exception as error:
            logger.exception("the page of visitor %d could not be built", client.client_id)
            client.gui.add_markdown(f"**The page could not be built.** {type(error).__name__}: {error}")
            client.local_storage.remove_item(KEY)  # it may be what it began with: it begins anew after a reload
            self._farewell(client)
            return
        with self._lock:
            if client.client_id in self._visitors:
                self._visitors[client.client_id] = visitor
                visitor.measure()
                return
        visitor.close()  # left while the page was being built

    def _measured(self, token: str, width: float) -> None:
        for visitor in self.visitors:
            if visitor.ruler.token == token:
                visitor.measured(width)

    def _farewell(self, client: viser.ClientHandle) -> None:
        with self._lock:
            visitor = self._visitors.pop(client.client_id, None)
            self._waiting.pop(client.client_id, None)
        if visitor is not None:
            visitor.close()
        self._admit()


def _refuse(client: viser.ClientHandle, text: str) -> None:
    notify(client, text, COLOURS[Severity.ALARM][0])


def _checked_port(host: str, port: int) -> int:
    """Return the port to listen on, if it is free; viser itself would silently take the next one."""
    with socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError as error:
            raise AddressError(
                f"cannot listen on {host}:{port}: {error.strerror or error}; "
                "choose another port with --port, or another address with --host"
            ) from error
        return probe.getsockname()[1]
