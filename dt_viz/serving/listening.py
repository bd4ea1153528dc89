"""Sockets that take connections: one that listens, and one whose connections another process accepts and hands over."""

from __future__ import annotations

import socket
from typing import Any

BACKLOG = 256
"""Number of connections that wait until they are accepted."""


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


class HandedOver(socket.socket):
    """Takes the connections that another process accepts and sends, as if it had listened itself."""

    def __init__(self, channel: socket.socket, address: Any) -> None:  # noqa: ANN401 - as `socket.getsockname`
        """Take the receiving end of a stream of Unix sockets, which this replaces, and the address listened on."""
        super().__init__(fileno=channel.detach())
        self._address = address

    def getsockname(self) -> Any:  # noqa: ANN401 - as of a socket
        """Return the address that the connections were made to."""
        return self._address

    def listen(self, backlog: int = 0) -> None:
        """Do nothing: the other process listens."""

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection and its other end. Raises BlockingIOError if none waits, also for ever."""
        _, files, _, _ = socket.recv_fds(self, 1, 1)
        if not files:  # the other process has ended
            raise BlockingIOError
        connection = socket.socket(fileno=files[0])
        try:
            return connection, connection.getpeername()
        except OSError as error:  # its client has left meanwhile
            connection.close()
            raise ConnectionAbortedError from error


def hand_over(channel: socket.socket, connection: socket.socket) -> None:
    """Send a connection to the process at the other end of a channel, and close it here.

    Raises:
        OSError: it takes none now, or has ended; the connection stays open.
    """
    socket.send_fds(channel, [b"."], [connection.fileno()])
    connection.close()
