"""What Prometheus reads: with its own parser, from a board of several processes."""

import re
import sys
from pathlib import Path

import pytest

from dt_viz.serving.board import Board, Share
from dt_viz.serving.reports import metrics

pytest.importorskip("prometheus_client")


def samples(text):
    """Values by their names, and labels."""
    from prometheus_client.parser import text_string_to_metric_families

    found = [sample for family in text_string_to_metric_families(text) for sample in family.samples]
    return {(name, *labels.values()): value for name, labels, value, *_ in found}


def test_figures_are_those_of_all_processes():
    board = Board(2, 4)
    first, second = Share(board, 0), Share(board, 1)
    first.seat(2, [])
    second.seat(1, [5.0, 6.0])
    for share in (first, second, second):
        share.connect("a")
        share.edited(4)
    for share, latency in ((first, 0.01), (second, 0.2), (second, 7.0)):
        share.answered(latency)
    first.refused()
    board.rows[1]["counts"]["restarts"] = 2
    report = metrics(first, 8)
    assert (report.status, report.kind.partition(";")[0]) == (200, "text/plain")
    found = samples(report.text)
    expected = {"visitors": 3, "places": 8, "waiting": 2, "connections": 3, "processes": 2, "edits_total": 12}
    expected |= {"frames_total": 3, "refused_requests_total": 1, "process_restarts_total": 2}
    expected |= {"latency_seconds_count": 3, "latency_seconds_sum": pytest.approx(7.21)}
    assert {name: found[f"dt_viz_{name}",] for name in expected} == expected
    classes = {bound: value for (name, *labels), value in found.items() if "bucket" in name for bound in labels}
    assert [classes[bound] for bound in ("0.01", "0.1", "0.25", "5.0", "+Inf")] == [1, 1, 2, 2, 3]
    assert report.text == metrics(second, 8).text


def test_without_the_package_the_answer_is_a_line_that_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    report = metrics(Share(Board(1, 1), 0), 8)
    assert report.status == 501
    assert report.text.count("\n") == 1 and "pip install 'dt-viz[metrics]'" in report.text


def test_the_shipped_configuration_asks_where_metrics_are():
    text = (Path(__file__).parents[2] / "assets" / "serving" / "prometheus.yml").read_text()
    assert re.search(r"job_name: dt-viz\n +static_configs:\n +- targets: \[127\.0\.0\.1:8081", text)
