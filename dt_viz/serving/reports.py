"""What a server tells of itself, for all its processes together: to proxies, and to Prometheus."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from http import HTTPStatus
from importlib.metadata import version

import numpy as np

from dt_viz.serving.board import BOUNDS, Share

MISSING = "/metrics: found no package prometheus-client; accepted: after pip install 'dt-viz[metrics]'\n"
"""Answer where it is not installed."""


@dataclass(frozen=True)
class Report:
    """Answer to a request."""

    text: str
    status: HTTPStatus = HTTPStatus.OK
    kind: str = "text/plain; charset=utf-8"
    """Media type of the text."""


def health(share: Share, num_places: int) -> Report:
    """Say how the server is, in JSON; with 503 if nobody else should be sent here.

    Args:
        share: row of the process that is asked.
        num_places: largest number of visitors.
    """
    state = "closing" if share.is_closing else "full" if share.num_visitors >= num_places else "ok"
    known = {"visitors": share.num_visitors, "places": num_places, "waiting": share.num_waiting}
    told = {"status": state, **known, "processes": share.num_processes, "version": version("dt-viz")}
    status = HTTPStatus.OK if state == "ok" else HTTPStatus.SERVICE_UNAVAILABLE
    return Report(json.dumps(told, separators=(",", ":")), status, "application/json")


def metrics(share: Share, num_places: int) -> Report:
    """Say the server's figures in the format of Prometheus; with 501 without prometheus-client. Arguments: `health`."""
    try:
        import prometheus_client  # noqa: PLC0415 - of an extra
        from prometheus_client.core import (  # noqa: PLC0415
            CounterMetricFamily,
            GaugeMetricFamily,
            HistogramMetricFamily,
            Metric,
        )
        from prometheus_client.registry import Collector  # noqa: PLC0415
    except ImportError:
        return Report(MISSING, HTTPStatus.NOT_IMPLEMENTED)

    class Told(Collector):
        """The figures of one look at the board."""

        def collect(self) -> Iterator[Metric]:
            counts = share.counts
            numbers = np.cumsum(counts["latencies"]).tolist()
            for name, text, value in (
                ("visitors", "Visitors with a place", share.num_visitors),
                ("places", "Largest number of visitors", num_places),
                ("waiting", "Visitors who wait for a place", share.num_waiting),
                ("connections", "Connections of visitors and of those who wait", share.num_connections()),
                ("processes", "Processes that serve", share.num_processes),
            ):
                yield GaugeMetricFamily(f"dt_viz_{name}", text, value)
            for name, text, value in (
                ("edits", "Edits that change what is computed", counts["edits"]),
                ("frames", "Pictures of rollouts sent", numbers[-1]),
                ("refused_requests", "Requests refused by their host, origin or number", counts["refused"]),
                ("process_restarts", "Processes started in the place of one that had ended", counts["restarts"]),
            ):
                yield CounterMetricFamily(f"dt_viz_{name}", text, value)
            classes = list(zip([*map(str, BOUNDS), "+Inf"], numbers, strict=True))
            text = "Time from an edit until its picture of rollouts is sent"
            yield HistogramMetricFamily("dt_viz_latency_seconds", text, classes, float(counts["latency"]))

    registry = prometheus_client.CollectorRegistry()
    registry.register(Told())
    text = prometheus_client.generate_latest(registry).decode()
    return Report(text, kind=prometheus_client.CONTENT_TYPE_LATEST)


REPORTS: Mapping[str, Callable[[Share, int], Report]] = {"/health": health, "/metrics": metrics}
"""Reports by their paths."""
