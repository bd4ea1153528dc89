"""The process that accepts connections, hands each to the serving process with the fewest, and sees that these run.

It computes nothing itself, and starts no threads, so that a process that ends can be forked anew in no time.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import selectors
import signal
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess

from dt_viz.serving.board import Board, Share
from dt_viz.serving.listening import HandedOver, hand_over

logger = logging.getLogger(__name__)


@dataclass(frozen=True)
class SupervisorSettings:
    """How long processes and connections are waited for; times in seconds."""

    tick: float = 0.1
    """Time between two looks at the processes."""
    recent: float = 1.0
    """Time for which a connection that was handed over counts, as it may not be on the board yet."""
    hesitation: float = 1.0
    """Time without a beat after which a process gets connections only if all others hesitate, too."""
    silence: float = 2.0
    """Time without a beat after which a process counts as stuck."""
    beginning: float = 10.0
    """Time that a process has for its first beat."""
    patience: float = 2.5
    """Time that processes have to end before they are killed."""
    restart: float = 0.5
    """Shortest time from one start of a process to the next one in its place."""
    request: float = 10.0
    """Time that an accepted connection has to say what it wants."""
    max_requests: int = 256
    """Largest number of those that have not said it yet."""
    looked_at: int = 4096
    """Number of bytes of a request that are looked at."""


UPGRADE = b"upgrade: websocket"
ENDS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end the server."""

Work = Callable[[Share, HandedOver], int]
"""What each process does until it is interrupted, with its row of the board, and with the connections that it gets;
returns the exit status."""


def several_reason() -> str:
    """Return why this system has no several processes for one address; empty where it has."""
    if sys.platform == "darwin":
        return "libraries of macOS do not survive a fork"
    if not hasattr(os, "fork") or not hasattr(socket, "send_fds"):
        return "it cannot hand connections from one process to another"
    return ""


@dataclass
class _Worker:
    """A process that serves."""

    process: BaseProcess
    channel: socket.socket
    """Where connections are handed to it."""
    started: float
    handed: deque[float] = field(default_factory=deque)
    """When connections were handed to it, those that are recent."""


class Supervisor:
    """Runs several processes that serve one address."""

    def __init__(
        self,
        listening: socket.socket,
        board: Board,
        work: Work,
        ready: Callable[[], None] = lambda: None,
        settings: SupervisorSettings = SupervisorSettings(),
    ) -> None:
        """Take an address, a board with a row for each process, and what each does.

        Args:
            listening: socket that listens.
            board: its number of rows is that of the processes.
            work: runs in each process, until KeyboardInterrupt.
            ready: called once, when the first process serves.
            settings: how long it waits.
        """
        self._listening, self._board, self._work, self._ready = listening, board, work, ready
        self._settings = settings
        self._workers: list[_Worker | None] = [None] * len(board.rows)
        self._asking: dict[socket.socket, float] = {}
        """Accepted connections that have not said yet what they want, and when they came."""
        self._selector = selectors.DefaultSelector()
        self._is_ready = False
        self._looked = self._woke = time.monotonic()
        """Times of the last look at the processes, and of the first one after the machine was suspended, if it was."""

    def run(self) -> int:
        """Serve until KeyboardInterrupt is raised, then end the processes.

        Returns:
            Exit status of a process that cannot even begin.
        """
        self._listening.setblocking(False)
        self._selector.register(self._listening, selectors.EVENT_READ)
        try:
            while not (status := self._look_after()):
                for key, _ in self._selector.select(self._settings.tick):
                    if key.fileobj is self._listening:
                        self._accept()
                    else:
                        self._dispatch(key.fileobj)  # pyright: ignore[reportArgumentType]
            return status
        finally:
            self._end()

    def _accept(self) -> None:
        while True:
            try:
                connection, _ = self._listening.accept()
            except OSError:  # none waits, or it has left, or there are too many files
                return
            if len(self._asking) >= self._settings.max_requests:
                connection.close()
                continue
            connection.setblocking(False)
            self._asking[connection] = time.monotonic()
            self._selector.register(connection, selectors.EVENT_READ)

    def _dispatch(self, connection: socket.socket) -> None:
        """Hand a connection that asks for something to the process with the fewest."""
        try:
            request = connection.recv(self._settings.looked_at, socket.MSG_PEEK)
        except OSError:
            request = b""
        if not request:
            self._forget(connection)
            connection.close()
            return
        running = [k for k, worker in enumerate(self._workers) if worker is not None and worker.process.is_alive()]
        if not running:
            return  # it is served as soon as another one has begun
        for k in sorted(running, key=self._load):
            worker = self._workers[k]
            assert worker is not None
            with suppress(OSError):  # one that is stuck takes no more
                self._forget(connection)
                hand_over(worker.channel, connection)
                if UPGRADE in request.lower():
                    worker.handed.append(time.monotonic())
                return
        connection.close()

    def _load(self, number: int) -> tuple[bool, int]:
        """Return whether a process hesitates, and its number of connections, with those it was handed a moment ago."""
        worker, row, now = self._workers[number], self._board.rows[number], time.monotonic()
        assert worker is not None
        while worker.handed and worker.handed[0] < now - self._settings.recent:
            worker.handed.popleft()
        return now - row["beat"] > self._settings.hesitation, int((row["connections"] != 0).sum()) + len(worker.handed)

    def _forget(self, connection: socket.socket) -> None:
        if self._asking.pop(connection, None) is not None:
            self._selector.unregister(connection)

    def _look_after(self) -> int:
        """Start processes that are missing, end stuck ones, and close connections that never ask for anything.

        Returns:
            Exit status of a process that could not even begin, and would not the next time; 0 without any.
        """
        before, self._looked = self._looked, (now := time.monotonic())
        if now - before > self._settings.hesitation:
            self._woke = now
        for connection in [one for one, came in self._asking.items() if now - came > self._settings.request]:
            self._forget(connection)
            connection.close()
        for number, worker in enumerate(self._workers):
            if worker is None:
                self._start(number)
            elif not worker.process.is_alive():
                status = worker.process.exitcode or 0
                if status > 0 and not self._has_run(number, worker):
                    return status
                if now - worker.started > self._settings.restart:
                    logger.warning("process %d has ended (%d): another one takes its place", worker.process.pid, status)
                    worker.channel.close()
                    self._board.rows[number]["counts"]["restarts"] += 1
                    self._start(number)
            elif self._is_silent(number, worker, now):
                logger.warning("process %d does not answer: it is ended", worker.process.pid)
                worker.process.kill()
            elif not self._is_ready and self._has_run(number, worker):
                self._is_ready = True
                self._ready()
        return 0

    def _is_silent(self, number: int, worker: _Worker, now: float) -> bool:
        """Return whether the last beat of a process is too long ago, time of a suspended machine not counted."""
        longest = self._settings.silence if self._has_run(number, worker) else self._settings.beginning
        return now - max(self._woke, float(self._board.rows[number]["beat"])) > longest

    def _has_run(self, number: int, worker: _Worker) -> bool:
        """Return whether the event loop of a process has run."""
        return self._board.rows[number]["beat"] > worker.started

    def _start(self, number: int) -> None:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._board.clear(number)
        started = float(self._board.rows[number]["beat"])
        context = multiprocessing.get_context("fork")
        process = context.Process(target=self._run, args=(number, ours, theirs), name=f"dt-viz {number}")
        # what a signal's handler raises while Python forks is ignored, and so would be the signal
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)
        try:
            process.start()
            theirs.close()
            self._workers[number] = _Worker(process, ours, started)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)

    def _run(self, number: int, ours: socket.socket, theirs: socket.socket) -> None:
        """Do the work, in a new process."""
        address = self._listening.getsockname()
        inherited = [ours, self._listening, *self._asking, *(one.channel for one in self._workers if one is not None)]
        for connection in inherited:
            connection.close()
        self._selector.close()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all, and the parent ends this one
        parent = multiprocessing.parent_process()
        assert parent is not None
        threading.Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()
        with suppress(KeyboardInterrupt):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)
            sys.exit(self._work(Share(self._board, number), HandedOver(theirs, address)))

    def _end(self) -> None:
        """End all processes, by force where they do not end in time."""
        self._listening.close()
        processes = [worker.process for worker in self._workers if worker is not None]
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + self._settings.patience
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()


def _end_after(sentinel: int) -> None:
    """End this process when that of the sentinel has ended."""
    wait([sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
