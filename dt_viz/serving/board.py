"""What the processes of a server tell each other: a row of numbers each, in memory that they share.

Each process writes its own row only; limits that hold for all together are looked up in all rows.
"""

from __future__ import annotations

import hashlib
import mmap
import tempfile
import threading
import time
import weakref
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

try:
    import fcntl
except ImportError:  # where there are no several processes either
    fcntl = None

NEVER = np.inf
"""Time of what has not happened."""
BOUNDS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
"""Upper bounds of the classes of latencies, seconds; a last class holds those above."""
COUNTS = np.dtype(
    [
        ("edits", np.int64),
        ("latencies", np.int64, len(BOUNDS) + 1),  # number of pictures of rollouts, by the class of their latency
        ("latency", float),  # sum of these latencies, seconds
        ("refused", np.int64),
        ("restarts", np.int64),  # of the process with this row
    ]
)
"""Counts that only grow."""


class Board:
    """The rows of all processes."""

    def __init__(self, num_processes: int, num_connections: int) -> None:
        """Make empty rows, which processes that are forked later share.

        Args:
            num_processes: number of processes.
            num_connections: largest number of connections of one process.
        """
        row = np.dtype(
            [
                ("beat", float),  # time of `time.monotonic` when its event loop was last known to run
                ("visitors", np.int64),  # visitors with a place
                ("came", float, num_connections),  # when each of those who wait for one came; `NEVER` for none
                ("is_prepared", np.int64),
                ("is_closing", np.int64),
                ("connections", np.int64, num_connections),  # digest of the address of each connection; 0 for none
                ("counts", COUNTS),
            ]
        )
        self._memory = mmap.mmap(-1, num_processes * row.itemsize)
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open as long as this board is there
        weakref.finalize(self, self._file.close)
        self.rows = np.ndarray(num_processes, row, self._memory)
        for number in range(num_processes):
            self.clear(number)

    def clear(self, number: int) -> None:
        """Empty the row of a process that has ended, or that begins now, but for its counts: the next one goes on."""
        self.rows[number] = (time.monotonic(), 0, NEVER, 0, 0, 0, self.rows[number]["counts"])

    @contextmanager
    def locked(self) -> Iterator[None]:
        """Keep other processes waiting; the lock of one that is killed is free. Threads need another lock."""
        if fcntl is None:
            yield
            return
        fcntl.lockf(self._file, fcntl.LOCK_EX)
        try:
            yield
        finally:
            fcntl.lockf(self._file, fcntl.LOCK_UN)


class Share:
    """The row of one process, and what it knows of all."""

    def __init__(self, board: Board, number: int) -> None:
        """Take the row with this number."""
        self._board, self._is_first = board, number == 0
        self._row = board.rows[number : number + 1]
        self._counting = threading.Lock()

    @property
    def num_processes(self) -> int:
        """Number of processes."""
        return len(self._board.rows)

    @property
    def num_visitors(self) -> int:
        """Number of visitors with a place, in all processes."""
        return int(self._board.rows["visitors"].sum())

    @property
    def num_waiting(self) -> int:
        """Number of visitors who wait for a place, in all processes."""
        return int(np.isfinite(self._board.rows["came"]).sum())

    def num_before(self, came: float) -> int:
        """Return the number of visitors, in all processes, who have waited for longer than who came then."""
        return int((self._board.rows["came"] < came).sum())

    @property
    def is_closing(self) -> bool:
        """Whether this process ends."""
        return bool(self._row["is_closing"][0])

    @property
    def may_prepare(self) -> bool:
        """Whether it is the turn of this process to prepare what is kept on disk: the first one's, then all others'."""
        return self._is_first or bool(self._board.rows["is_prepared"][0])

    def prepared(self) -> None:
        """Tell that this process is prepared."""
        self._row["is_prepared"] = 1

    def beat(self) -> None:
        """Tell that the event loop runs."""
        self._row["beat"] = time.monotonic()

    def close(self) -> None:
        """Tell that this process ends."""
        self._row["is_closing"] = 1

    def seat(self, num_visitors: int, waiting: list[float]) -> None:
        """Tell how many visitors there are here, and when those who wait came, seconds of `time.monotonic`."""
        self._row["visitors"] = num_visitors
        came = self._row["came"][0]
        came[: len(waiting)], came[len(waiting) :] = waiting, NEVER

    @contextmanager
    def next_place(self, num_places: int) -> Iterator[bool]:
        """Yield whether there is a place for who waits longest here, and for all who came before him elsewhere.

        Until it is told who takes it, no other may.
        """
        with self._board.locked():
            yield self.num_visitors + self.num_before(self._row["came"].min()) < num_places

    def num_connections(self, address: str | None = None) -> int:
        """Return the number of connections, in all processes, of an address or of all."""
        connections = self._board.rows["connections"]
        return int((connections != 0 if address is None else connections == _digest(address)).sum())

    def connect(self, address: str) -> int:
        """Count a connection of an address; return its number, for `disconnect`."""
        number = int(np.flatnonzero(self._row["connections"][0] == 0)[0])
        self._row["connections"][0, number] = _digest(address)
        return number

    def disconnect(self, number: int) -> None:
        """Count a connection no more."""
        self._row["connections"][0, number] = 0

    @property
    def counts(self) -> np.void:
        """Sums of the `COUNTS` of all processes."""
        counts = self._board.rows["counts"]
        return np.array([tuple(counts[name].sum(axis=0) for name in COUNTS.names or ())], COUNTS)[0]

    def refused(self) -> None:
        """Count a request that is refused."""
        with self._counting:
            self._row["counts"]["refused"] += 1

    def edited(self, num_edits: int) -> None:
        """Count edits."""
        with self._counting:
            self._row["counts"]["edits"] += num_edits

    def answered(self, latency: float) -> None:
        """Count a picture of rollouts, this long after its edit, seconds."""
        with self._counting:
            self._row["counts"]["latencies"][0, np.searchsorted(BOUNDS, latency)] += 1
            self._row["counts"]["latency"] += latency


def _digest(address: str) -> int:
    """Number of an address, not 0: as good as the address, and of one size."""
    return int.from_bytes(hashlib.blake2b(address.encode(), digest_size=7).digest(), "big") + 1


def own_share(num_connections: int) -> Share:
    """The row of a process that is alone."""
    return Share(Board(1, num_connections), 0)
