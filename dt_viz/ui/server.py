"""The web server: one private page for each visitor."""

from __future__ import annotations

import logging
import os
import socket
import threading
import time
import warnings
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from types import MappingProxyType
from typing import NoReturn

import viser

from dt_viz.errors import UnwantedError
from dt_viz.learning.store import FitStore
from dt_viz.robot.robot import Robot
from dt_viz.scenario.saved import Saved
from dt_viz.scenario.tasks import TaskEntry
from dt_viz.serving.board import Share
from dt_viz.serving.supervisor import listen
from dt_viz.session.arms import ArmStore
from dt_viz.ui.gate import LAST_WORDS, Gate, Origins
from dt_viz.ui.keeping import KEY
from dt_viz.ui.page import Page, notify
from dt_viz.ui.presenting import TAKEN, WRONG, Lecture, Viewer
from dt_viz.ui.scripts import forget_html
from dt_viz.ui.tabs.status import COLOURS
from dt_viz.warning import Severity

logger = logging.getLogger(__name__)

MAX_WAITING = 8  # largest number of visitors who wait for a place, unless it is chosen
IDLE = 600.0
"""Time after which the arm of a visitor who does nothing rests, and he gives his place to one who waits, seconds."""
NEGLECTED = 30.0
"""Time after which the arm of a visitor who does nothing rests where visitors are more than cores, seconds."""
LEAVING = "Others wait for a place, and you have done nothing for a while: you are in line again."
"""What he is told."""
CLOSING = "The server ends. This page opens again by itself when it is back."
"""What visitors are told when it ends."""

# a visitor may leave between two pictures of the arm; a picture without a receiver is no problem
warnings.filterwarnings("ignore", message="Queued a .* on a closed connection", category=UserWarning)


class Server:
    """Serves the page until it is closed."""

    def __init__(
        self,
        tasks: Mapping[str, TaskEntry],
        fits: FitStore,
        robot: Robot,
        listening: socket.socket | None = None,
        share: Share | None = None,
        *,
        task: str,
        host: str = "127.0.0.1",
        port: int = 8080,
        max_sessions: int = 8,
        max_waiting: int = MAX_WAITING,
        max_of_address: int | None = None,
        allowed: Sequence[str] = (),
        key: str | None = None,
        begins: Saved | None = None,
        scenarios: Mapping[str, Saved] = MappingProxyType({}),
    ) -> None:
        """Listen and wait for visitors.

        Args:
            tasks: tasks by name, made for the JACO.
            fits: store shared by all visitors.
            robot: the arm.
            listening: socket whose connections it serves; None listens on the port of the host.
            share: what other processes for the same address tell; limits hold for all. None if there are none.
            task: first task of each visitor.
            host: address to listen on.
            port: port to listen on; 0 takes any free one.
            max_sessions: largest number of visitors; further ones wait until one leaves.
            max_waiting: largest number of those who wait; any more are refused.
            max_of_address: largest number of visitors, also waiting ones, of one address; None is half of all, and all
                with a key, as a lecture hall may have one address.
            allowed: origins of other pages that may connect, as of `origin_of`.
            key: makes all visitors watch the one who has it; see `Lecture`. Without one each has a private scene.
            begins: scenario of each new visitor, whose names these tasks and arms have; None is as the task begins.
            scenarios: scenarios that links may name, such as `/?scenario=lesson-1`, with such names, too.

        Raises:
            AddressError: the address is not available.
            GateError: this version of viser is not supported.
        """
        listening = listening or listen(host, port)
        titles, arms = {name: entry.title for name, entry in tasks.items()}, ArmStore(tasks, fits, robot)
        self._new_visitor: Callable[[viser.ClientHandle], Page] = lambda client: Page(
            client,
            arms.engine(),
            robot,
            titles,
            task,
            arms,
            self._share,
            begins,
            scenarios,
            lambda: self._closed or client.client_id not in self._visitors,
        )
        self._lock = threading.Condition()
        self._visitors: dict[int, Page | None] = {}
        """Those with a page, and None for those whose page is being built."""
        self._waiting: dict[int, tuple[viser.ClientHandle, viser.GuiMarkdownHandle | None, float]] = {}
        """Those who wait for a place, what their page says meanwhile, and when they came, the first one first."""
        self._num_building = 0
        """Number of pages that are being built, also for visitors who have left meanwhile."""
        self._closed = False
        connections = max_sessions + max_waiting
        most = max(2, connections // 2) if key is None else connections
        self._share, origins, most = share or Share(1, connections), Origins(host, allowed), max_of_address or most
        refuse = partial(notify, colour=COLOURS[Severity.ALARM][0])
        self.gate = Gate(listening, origins, max_sessions, connections, most, refuse, self._share)
        self._lecture = None if key is None else Lecture(key, host, self.gate.page)
        self._server: viser.ViserServer = self.gate.server
        self.host, self.port = host, self._server.get_port()
        self._server.gui.configure_theme(show_logo=False, show_share_button=False)
        self._server.on_client_connect(self._welcome)
        self._server.on_client_disconnect(self._farewell)

    @property
    def visitors(self) -> tuple[Page, ...]:
        """Visitors with a page of their own."""
        return tuple(visitor for visitor in self._visitors.values() if visitor is not None)

    def wait(self) -> NoReturn:
        """Serve until a signal handler raises an exception.

        Only this thread runs signal handlers, and a signal that arrives just before a sleep, or on another thread, is
        handled after it.
        """
        while True:
            time.sleep(0.5)
            self.attend()

    def attend(self) -> None:
        """See to those who wait, as a place may be free in another process, and to those who do nothing.

        The arms of those who do nothing rest, and soon where visitors are more than cores; where others wait, the
        quietest gives his place.
        """
        self._admit()
        many = len(self.visitors) > (os.cpu_count() or 1)
        for visitor in self.visitors:
            visitor.robot.playback.neglected = self.gate.idle(visitor.client) > (NEGLECTED if many else IDLE)
        with self._lock:
            for _, said, came in self._waiting.values():
                if said is not None:
                    said.content = self._full(came)
        if self._lecture is None and self._share.num_waiting and self._share.num_visitors >= self.gate.places:
            quietest = max(self.visitors, key=lambda visitor: self.gate.idle(visitor.client), default=None)
            if quietest is not None and self.gate.idle(quietest.client) > IDLE:
                notify(quietest.client, LEAVING, COLOURS[Severity.WARNING][0])
                self.gate.disconnect(quietest.client)

    def _full(self, came: float) -> str:
        """Return what somebody who came then is told while all places are taken."""
        num_before = self._share.num_before(came)
        line = f"**{num_before} before you.** " if num_before else "**You are next.** "
        return (
            f"**All {self.gate.places} places are taken.** {line}This page opens by itself when a place is "
            "free: close another tab of this demo, or wait. Whoever runs the server can allow more with "
            "`--max-sessions`."
        )

    def close(self) -> None:
        """Close all pages and stop listening."""
        patience = 2.0  # seconds
        self._share.close()
        if self._lecture is not None:
            self._lecture.close()
        clients = self._server.get_clients().values()
        for client in clients:
            notify(client, CLOSING, COLOURS[Severity.WARNING][0])
        notified = time.monotonic()
        with self._lock:
            self._closed = True
            self._lock.wait_for(lambda: not self._num_building, patience)  # a page that is being built needs the server
        visitors = self.visitors
        for visitor in visitors:
            visitor.close()
        for visitor in visitors:  # and so does what they are drawing
            visitor.session.jobs.wait_idle(timeout=patience)
        if clients:
            time.sleep(max(0.0, notified + LAST_WORDS - time.monotonic()))  # until the notice is sent
        self._server.stop()

    def _welcome(self, client: viser.ClientHandle) -> None:
        with self._lock:
            if self._closed or client.client_id not in self._server.get_clients():
                return  # left before its turn came
            came = time.monotonic()
            is_full = self._share.num_visitors + self._share.num_before(came) >= self.gate.places
            said = client.gui.add_markdown(self._full(came)) if is_full else None
            self._waiting[client.client_id] = client, said, came
            self._tell()
            if self._lecture is not None:
                self._lecture.ask(client, partial(self._claimed, client))
        self._admit()

    def _tell(self) -> None:
        self._share.seat(len(self._visitors), [came for *_, came in self._waiting.values()])

    def _admit(self) -> None:
        """Build the page of the visitor who has waited longest, if there is a place."""
        with self._lock:
            if self._closed or not self._waiting:
                return
            with self._share.next_place(self.gate.places) as is_free:
                if not is_free:
                    return
                client, said, _ = self._waiting.pop(next(iter(self._waiting)))
                self._visitors[client.client_id] = None  # a place is taken before the page is built
                self._tell()
            self._num_building += 1
        try:
            if said is not None:
                said.remove()
            if self._lecture is None:
                self._build_page(client)
            else:
                self._lecture.welcome(client)
        finally:
            self._built()

    def _built(self) -> None:
        with self._lock:
            self._num_building -= 1
            self._lock.notify_all()

    def _present(self, lecture: Lecture, viewer: Viewer) -> None:
        """Build the presenter's page in place of a viewer's; it takes a place, also if none is free."""
        client = viewer.client
        with self._lock:
            if self._closed or client.client_id not in self._server.get_clients():
                return
            self._waiting.pop(client.client_id, None)
            self._visitors[client.client_id] = None
            self._tell()
            self._num_building += 1
        try:
            before = lecture.take(self._server, viewer)
            if before is not None:
                notify(before, TAKEN, COLOURS[Severity.WARNING][0])
                self.gate.disconnect(before)
            self._build_page(client)
        finally:
            self._built()

    def _build_page(self, client: viser.ClientHandle) -> None:
        try:
            visitor = self._new_visitor(client)
        except UnwantedError:
            return  # left while the page was to be built
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
                if self._lecture is not None:
                    self._lecture.begin(visitor)
                return
        visitor.close()  # left while the page was being built

    def _claimed(self, client: viser.ClientHandle, key: str) -> None:
        """Let a client with the right key present, beside the server's event loop; disconnect one with a wrong key."""
        if self._lecture is None:
            return
        viewer, is_right = self._lecture.claimed(client, key)
        if viewer is None:
            return
        if is_right:
            threading.Thread(target=self._present, args=(self._lecture, viewer), name="presenting").start()
        else:
            notify(client, WRONG, COLOURS[Severity.WARNING][0])
            client.gui.add_html(forget_html())
            self.gate.disconnect(client)

    def _farewell(self, client: viser.ClientHandle) -> None:
        with self._lock:
            visitor = self._visitors.pop(client.client_id, None)
            self._waiting.pop(client.client_id, None)
            self._tell()
            if self._lecture is not None:
                self._lecture.farewell(client)
        if visitor is not None:
            visitor.close()
        self._admit()
