"""The process that accepts connections, hands each to the serving process with the fewest, and keeps these running.

It computes nothing itself and starts no threads, so that it can fork a process anew at once.
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
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import wait
from multiprocessing.process import BaseProcess
from typing import Any

from dt_viz.serving.board import Share

logger = logging.getLogger(__name__)

# times in seconds
TICK = 0.1  # between two looks at the processes
RECENT = 1.0  # for which a connection that was handed over counts, as it may not be on the board yet
HESITATION = 1.0  # without a beat, after which a process gets connections only if all others hesitate, too
SILENCE = 2.0  # without a beat, after which a process counts as stuck
BEGINNING = 10.0  # until the first beat of a process
PATIENCE = 2.5  # for processes to end, before they are killed
RESTART = 0.5  # at least, from one start of a process to the next one in its place
REQUEST = 10.0  # for an accepted connection to send its request
MAX_REQUESTS = 256  # largest number of connections whose request is awaited
LOOKED_AT = 4096  # number of bytes of a request that are looked at
BACKLOG = 256  # number of connections that wait until they are accepted
UPGRADE = b"upgrade: websocket"
ENDS = (signal.SIGINT, signal.SIGTERM)  # signals that end the server


class AddressError(OSError):
    """An address on which the server cannot listen; the message says why and what to do."""


def listen(host: str, port: int) -> socket.socket:
    """Return a socket that listens on an address; port 0 takes any free one. Raises AddressError."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        return socket.create_server((host, port), family=family, backlog=BACKLOG)
    except OSError as error:
        raise AddressError(
            f"cannot listen on {host}:{port}: {error.strerror or error}; "
            "choose another port with --port, or another address with --host"
        ) from error


def several_reason() -> str:
    """Return why this system cannot serve one address by several processes; empty where it can."""
    if sys.platform == "darwin":
        return "libraries of macOS do not survive a fork"
    if not hasattr(os, "fork") or not hasattr(socket, "send_fds"):
        return "it cannot hand connections from one process to another"
    return ""


class HandedOver(socket.socket):
    """A socket whose `accept` returns the connections that the supervisor has accepted and sent."""

    def __init__(self, channel: socket.socket, address: Any) -> None:  # noqa: ANN401 - as `socket.getsockname`
        """Take over the receiving end of a pair of Unix sockets, and the address listened on."""
        super().__init__(fileno=channel.detach())
        self._address = address

    def getsockname(self) -> Any:  # noqa: ANN401 - as of a socket
        """Return the address that the connections were made to."""
        return self._address

    def listen(self, backlog: int = 0) -> None:
        """Do nothing: the supervisor listens."""

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection and its other end.

        Raises:
            BlockingIOError: no connection waits, or the supervisor has ended.
            ConnectionAbortedError: the client has left meanwhile.
        """
        _, files, _, _ = socket.recv_fds(self, 1, 1)
        if not files:  # the supervisor has ended
            raise BlockingIOError
        connection = socket.socket(fileno=files[0])
        try:
            return connection, connection.getpeername()
        except OSError as error:
            connection.close()
            raise ConnectionAbortedError from error


Work = Callable[[Share, HandedOver], int]
"""Function that serves in each process until KeyboardInterrupt, given its row of the board and its connections;
returns the exit status."""


@dataclass
class _Worker:
    """A process that serves."""

    process: BaseProcess
    channel: socket.socket  # socket through which it is sent connections
    started: float
    handed: list[float] = field(default_factory=list)
    """Times at which it was sent its recent connections."""


class Supervisor:
    """Runs several processes that serve one address."""

    def __init__(
        self, listening: socket.socket, share: Share, work: Work, ready: Callable[[], None] = lambda: None
    ) -> None:
        """Take an address and what serves it.

        Args:
            listening: socket that listens.
            share: rows of the processes; work gets that of its process.
            work: function that runs in each process.
            ready: called once, when the first process serves.
        """
        self._listening, self._share, self._work, self._ready = listening, share, work, ready
        self._workers: list[_Worker | None] = [None] * len(share.rows)
        self._selector = selectors.DefaultSelector()
        """The listening socket, and accepted connections without a request yet, with the times when they came."""
        self._is_ready = False
        self._looked = self._woke = time.monotonic()
        """Times of the last look at the processes, and of the first one after the machine was suspended, if it was."""

    def run(self) -> int:
        """Serve until KeyboardInterrupt is raised, then end the processes.

        Returns:
            Exit status of a process that fails before it serves.
        """
        self._listening.setblocking(False)
        self._selector.register(self._listening, selectors.EVENT_READ, float("inf"))
        try:
            while not (status := self._look_after()):
                for key, _ in self._selector.select(TICK):
                    if key.fileobj is self._listening:
                        self._accept()
                    else:
                        self._dispatch(key.fileobj)  # pyright: ignore[reportArgumentType]
            return status
        finally:
            self._end()

    def _accept(self) -> None:
        with suppress(OSError):  # none waits, or it has left, or there are too many files
            while True:
                connection, _ = self._listening.accept()
                if len(self._selector.get_map()) > MAX_REQUESTS:
                    connection.close()
                    continue
                connection.setblocking(False)
                self._selector.register(connection, selectors.EVENT_READ, time.monotonic())

    def _dispatch(self, connection: socket.socket) -> None:
        """Hand a connection with a request to the process with the fewest connections."""
        try:
            request = connection.recv(LOOKED_AT, socket.MSG_PEEK)
        except OSError:
            request = b""
        running = [k for k, worker in enumerate(self._workers) if worker is not None and worker.process.is_alive()]
        if request and not running:
            return  # until a process has started
        self._selector.unregister(connection)
        for k in sorted(running, key=self._load) if request else ():
            worker = self._workers[k]
            assert worker is not None
            with suppress(OSError):  # the channel of a stuck process is full
                socket.send_fds(worker.channel, [b"."], [connection.fileno()])
                if UPGRADE in request.lower():
                    worker.handed.append(time.monotonic())
                break
        connection.close()

    def _load(self, number: int) -> tuple[bool, int]:
        """Return whether a process hesitates, and its number of connections, with those it was sent a moment ago."""
        worker, row, now = self._workers[number], self._share.rows[number], time.monotonic()
        assert worker is not None
        worker.handed = [then for then in worker.handed if then >= now - RECENT]
        return now - row["beat"] > HESITATION, int((row["connections"] != 0).sum()) + len(worker.handed)

    def _look_after(self) -> int:
        """Start missing processes, kill stuck ones, and close connections that send no request.

        Returns:
            Exit status of a process that failed before it served, as it would the next time; 0 without any.
        """
        before, self._looked = self._looked, (now := time.monotonic())
        if now - before > HESITATION:
            self._woke = now
        for key in [key for key in self._selector.get_map().values() if now - key.data > REQUEST]:
            self._selector.unregister(key.fileobj)
            key.fileobj.close()  # pyright: ignore[reportAttributeAccessIssue]
        for number, worker in enumerate(self._workers):
            if worker is None:
                self._start(number)
                continue
            beat = float(self._share.rows[number]["beat"])
            has_run = beat > worker.started
            if not worker.process.is_alive():
                status = worker.process.exitcode or 0
                if status > 0 and not has_run:
                    return status
                if now - worker.started > RESTART:
                    logger.warning("process %d has ended (%d): another one takes its place", worker.process.pid, status)
                    worker.channel.close()
                    self._share.rows[number]["counts"]["restarts"] += 1
                    self._start(number)
            elif now - max(self._woke, beat) > (SILENCE if has_run else BEGINNING):
                logger.warning("process %d does not answer: it is ended", worker.process.pid)
                worker.process.kill()
            elif has_run and not self._is_ready:
                self._is_ready = True
                self._ready()
        return 0

    def _start(self, number: int) -> None:
        ours, theirs = socket.socketpair()
        ours.setblocking(False)
        self._share.clear(number)
        started = float(self._share.rows[number]["beat"])
        context = multiprocessing.get_context("fork")
        process = context.Process(target=self._run, args=(number, ours, theirs), name=f"dt-viz {number}")
        # Python ignores what a signal's handler raises during a fork, and so would lose the signal
        signal.pthread_sigmask(signal.SIG_BLOCK, ENDS)
        try:
            process.start()
            theirs.close()
            self._workers[number] = _Worker(process, ours, started)
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)

    def _run(self, number: int, ours: socket.socket, theirs: socket.socket) -> None:
        address = self._listening.getsockname()
        asking: list[Any] = [key.fileobj for key in self._selector.get_map().values()]
        for inherited in (ours, *asking, *(one.channel for one in self._workers if one is not None)):
            inherited.close()
        self._selector.close()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all, and the parent ends this one
        parent = multiprocessing.parent_process()
        assert parent is not None
        threading.Thread(target=_end_after, args=(parent.sentinel,), daemon=True).start()
        with suppress(KeyboardInterrupt):
            signal.pthread_sigmask(signal.SIG_UNBLOCK, ENDS)
            sys.exit(self._work(self._share.of(number), HandedOver(theirs, address)))

    def _end(self) -> None:
        self._listening.close()
        processes = [worker.process for worker in self._workers if worker is not None]
        for process in processes:
            process.terminate()
        deadline = time.monotonic() + PATIENCE
        for process in processes:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                process.kill()
                process.join()


def _end_after(sentinel: int) -> None:
    wait([sentinel])
    os.kill(os.getpid(), signal.SIGTERM)
