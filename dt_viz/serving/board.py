"""Memory that the processes of one address share, with a row of numbers for each, and the reports made from it.

Each process writes its own row only; a limit that holds for all processes together is looked up in all rows.
"""

from __future__ import annotations

import copy
import json
import mmap
import tempfile
import threading
import time
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from http import HTTPStatus
from importlib.metadata import version
from typing import Any, NamedTuple

import numpy as np

try:
    import fcntl
except ImportError:  # on Windows, where one process serves
    fcntl = None

NEVER = np.inf  # time in the row of a visitor who does not exist
BOUNDS = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0)
"""Upper bounds of the classes of latencies, seconds; one more class holds larger latencies."""
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


class Share:
    """The rows of all processes, and which one of them is written here."""

    def __init__(self, num_processes: int, num_connections: int) -> None:
        """Make empty rows, which processes that are forked later share, for the first process.

        Args:
            num_processes: number of processes.
            num_connections: largest number of connections of one process.
        """
        row = np.dtype(
            [
                ("beat", float),  # time of `time.monotonic` when its event loop was last known to run
                ("visitors", np.int64),  # visitors with a place
                ("came", float, num_connections),  # when each visitor who waits for a place came; else `NEVER`
                ("is_prepared", np.int64),
                ("is_closing", np.int64),
                ("connections", np.int64, num_connections),  # digest of the address of each connection; 0 for none
                ("counts", COUNTS),
            ]
        )
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - open while these rows exist
        self.rows = np.ndarray(num_processes, row, mmap.mmap(-1, num_processes * row.itemsize))
        weakref.finalize(self.rows, self._file.close)
        for number in range(num_processes):
            self.clear(number)
        self._number, self.own = 0, self.rows[:1]  # number of this process, and its row
        self._counting = threading.Lock()

    def of(self, number: int) -> Share:
        """Return the same rows for the process with this number."""
        other = copy.copy(self)
        other._number, other.own = number, self.rows[number : number + 1]
        return other

    def clear(self, number: int) -> None:
        """Empty the row of a process that begins or has ended, except for its counts."""
        self.rows[number] = (time.monotonic(), 0, NEVER, 0, 0, 0, self.rows[number]["counts"])

    @property
    def num_visitors(self) -> int:
        """Number of visitors with a place, in all processes."""
        return int(self.rows["visitors"].sum())

    @property
    def num_waiting(self) -> int:
        """Number of visitors who wait for a place, in all processes."""
        return self.num_before(NEVER)

    def num_before(self, came: float) -> int:
        """Return the number of visitors, in all processes, who wait since before a time of `time.monotonic`."""
        return int((self.rows["came"] < came).sum())

    @property
    def may_prepare(self) -> bool:
        """Whether it is the turn of this process to prepare what is kept on disk: the first one's, then all others'."""
        return self._number == 0 or bool(self.rows["is_prepared"][0])

    def prepared(self) -> None:
        """Record that this process is prepared."""
        self.own["is_prepared"] = 1

    def beat(self) -> None:
        """Record that the event loop runs."""
        self.own["beat"] = time.monotonic()

    def close(self) -> None:
        """Record that this process ends."""
        self.own["is_closing"] = 1

    def seat(self, num_visitors: int, waiting: list[float]) -> None:
        """Record the number of visitors here, and when those who wait came, seconds of `time.monotonic`."""
        self.own["visitors"] = num_visitors
        came = self.own["came"][0]
        came[: len(waiting)], came[len(waiting) :] = waiting, NEVER

    @contextmanager
    def next_place(self, num_places: int) -> Iterator[bool]:
        """Yield whether places suffice for the visitor who waits longest here and all who came before elsewhere.

        Other processes, not other threads, are locked out meanwhile, so that `seat` can take the place; the system
        frees the lock of a process that is killed.
        """
        if fcntl is not None:
            fcntl.lockf(self._file, fcntl.LOCK_EX)
        try:
            yield self.num_visitors + self.num_before(self.own["came"].min()) < num_places
        finally:
            if fcntl is not None:
                fcntl.lockf(self._file, fcntl.LOCK_UN)

    def num_connections(self, address: str | None = None) -> int:
        """Return the number of connections, in all processes, of an address or of all."""
        connections = self.rows["connections"]
        return int((connections != 0 if address is None else connections == _digest(address)).sum())

    def connect(self, address: str) -> int:
        """Count a connection of an address; return its number, for `disconnect`."""
        number = int(np.flatnonzero(self.own["connections"][0] == 0)[0])
        self.own["connections"][0, number] = _digest(address)
        return number

    def disconnect(self, number: int) -> None:
        """Stop counting a connection."""
        self.own["connections"][0, number] = 0

    def total(self, name: str) -> Any:  # noqa: ANN401 - a number, or numbers
        """Return the sum of one of `COUNTS` over all processes."""
        return self.rows["counts"][name].sum(axis=0)

    def count(self, name: str, by: Any = 1) -> None:  # noqa: ANN401 - a number, or numbers
        """Add to one of `COUNTS`."""
        with self._counting:
            self.own["counts"][name] += by

    def answered(self, latency: float) -> None:
        """Count a picture of rollouts and its time since the edit, seconds."""
        self.count("latencies", np.arange(len(BOUNDS) + 1) == np.searchsorted(BOUNDS, latency))
        self.count("latency", latency)


def _digest(address: str) -> int:
    """Return a number of fixed size for an address, different from 0; forked processes have the same."""
    return hash(address) or 1


class Report(NamedTuple):
    """Answer to a request."""

    text: str
    status: HTTPStatus = HTTPStatus.OK
    kind: str = "text/plain; charset=utf-8"  # media type of the text


def health(share: Share, num_places: int) -> Report:
    """Report the server's state in JSON, with status 503 where a proxy should send no more visitors.

    Args:
        share: row of the process that is asked.
        num_places: largest number of visitors.
    """
    state = "closing" if share.own["is_closing"][0] else "full" if share.num_visitors >= num_places else "ok"
    known = {"visitors": share.num_visitors, "places": num_places, "waiting": share.num_waiting}
    known = {"status": state, **known, "processes": len(share.rows), "version": version("dt-viz")}
    status = HTTPStatus.OK if state == "ok" else HTTPStatus.SERVICE_UNAVAILABLE
    return Report(json.dumps(known, separators=(",", ":")), status, "application/json")


def metrics(share: Share, num_places: int) -> Report:
    """Report the figures in the format of Prometheus, or status 501 without prometheus-client; see `health`."""
    try:
        import prometheus_client as prometheus  # noqa: PLC0415 - of an extra
    except ImportError:
        text = "/metrics: found no package prometheus-client; accepted: after pip install 'dt-viz[metrics]'\n"
        return Report(text, HTTPStatus.NOT_IMPLEMENTED)

    class Figures(prometheus.registry.Collector):
        """The figures of one look at the board."""

        def collect(self) -> Iterator[prometheus.Metric]:
            core, total = prometheus.metrics_core, share.total
            gauge, counter = core.GaugeMetricFamily, core.CounterMetricFamily
            numbers = np.cumsum(total("latencies")).tolist()
            replaced = "Processes started in the place of one that had ended"
            for family, name, text, value in (
                (gauge, "visitors", "Visitors with a place", share.num_visitors),
                (gauge, "places", "Largest number of visitors", num_places),
                (gauge, "waiting", "Visitors who wait for a place", share.num_waiting),
                (gauge, "connections", "Connections of visitors and of those who wait", share.num_connections()),
                (gauge, "processes", "Processes that serve", len(share.rows)),
                (counter, "edits", "Edits that change what is computed", total("edits")),
                (counter, "frames", "Pictures of rollouts sent", numbers[-1]),
                (counter, "refused_requests", "Requests refused by their host, origin or number", total("refused")),
                (counter, "process_restarts", replaced, total("restarts")),
            ):
                yield family(f"dt_viz_{name}", text, value)
            text = "Time from an edit until its picture of rollouts is sent"
            classes = list(zip([*map(str, BOUNDS), "+Inf"], numbers, strict=True))
            yield core.HistogramMetricFamily("dt_viz_latency_seconds", text, classes, float(total("latency")))

    registry = prometheus.CollectorRegistry()
    registry.register(Figures())
    return Report(prometheus.generate_latest(registry).decode(), kind=prometheus.CONTENT_TYPE_LATEST)


REPORTS: Mapping[str, Callable[[Share, int], Report]] = {"/health": health, "/metrics": metrics}
"""Reports by their paths."""
