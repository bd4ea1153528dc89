"""The rows that processes share: limits that hold for all, a lock that no killed process keeps, and the reports."""

import multiprocessing
import os
import re
import signal
import sys
from pathlib import Path

import pytest

from dt_viz.serving.board import Share, metrics

FORK = "fork" in multiprocessing.get_all_start_methods()


@pytest.fixture
def shares():
    share = Share(3, 4)
    return [share.of(number) for number in range(3)]


def test_connections_of_all_processes_count_and_so_do_those_of_an_address(shares):
    numbers = [share.connect(address) for share, address in zip(shares, ("a", "b", "a"), strict=True)]
    second = shares[0].connect("a")
    for share in shares:
        assert (share.num_connections(), share.num_connections("a"), share.num_connections("c")) == (4, 3, 0)
    shares[0].disconnect(second)
    assert shares[2].num_connections("a") == 2
    for share, number in zip(shares, numbers, strict=True):
        share.disconnect(number)
    assert not shares[1].num_connections()


def test_no_address_is_no_connection_and_an_empty_one_counts(shares):
    number = shares[0].connect("")
    assert shares[1].num_connections() == 1
    shares[0].disconnect(number)
    assert shares[1].num_connections() == 0


def test_the_next_place_is_for_who_has_waited_longest_wherever(shares):
    first, second, third = shares
    first.seat(1, [5.0, 6.0])
    second.seat(0, [3.0])
    assert [first.num_before(came) for came in (3.0, 5.0, 6.0)] == [0, 1, 2]
    for share, expected in ((first, False), (second, True), (third, False)):
        with share.next_place(2) as is_free:
            assert is_free == expected
    second.seat(1, [])
    with first.next_place(2) as is_free:
        assert not is_free  # all places are taken
    assert (third.num_visitors, third.num_waiting) == (2, 2)
    assert [third.num_before(came) for came in (5.0, 6.0)] == [0, 1]
    second.seat(0, [])
    with first.next_place(2) as is_free:
        assert is_free


@pytest.mark.parametrize("num_places", range(1, 7))
def test_who_came_before_in_another_process_is_waited_for_only_where_he_needs_the_place(shares, num_places):
    first, second, third = shares
    first.seat(1, [5.0, 6.0])
    second.seat(0, [3.0, 4.0])
    for share, num_before in ((second, 0), (first, 2)):
        with share.next_place(num_places) as is_free:
            assert is_free == (1 + num_before < num_places)
    third.seat(1, [])
    with first.next_place(num_places) as is_free:
        assert is_free == (num_places > 4)


def test_the_row_of_a_process_that_has_ended_counts_no_more(shares):
    shares[1].seat(2, [1.0])
    shares[1].connect("a")
    shares[0].clear(1)
    assert (shares[0].num_visitors, shares[0].num_waiting, shares[0].num_connections()) == (0, 0, 0)


def test_counts_only_grow_also_where_a_process_takes_the_place_of_another(shares):
    for share in shares[:2]:
        share.count("edits", 3)
        share.answered(0.03)
    shares[1].count("refused")
    shares[0].clear(1)
    total = shares[0].total
    assert (total("edits"), total("refused"), total("latency")) == (6, 1, pytest.approx(0.06))
    assert total("latencies").tolist() == [0, 0, 2, *[0] * 7]
    shares[1].count("edits")
    assert total("edits") == 7


@pytest.mark.skipif(not FORK, reason="no fork here")
def test_a_process_that_is_killed_with_the_lock_keeps_nobody_waiting(shares):
    context = multiprocessing.get_context("fork")
    has_it = context.Event()

    def hold():
        with shares[1].next_place(1):
            has_it.set()
            signal.pause()

    process = context.Process(target=hold)
    process.start()
    assert has_it.wait(30)
    assert process.pid is not None
    os.kill(process.pid, signal.SIGKILL)
    process.join(30)
    with shares[0].next_place(1) as is_free:
        assert is_free


def samples(text):
    """Values by their names, and labels, found by Prometheus' own parser."""
    parser = pytest.importorskip("prometheus_client.parser")
    found = [sample for family in parser.text_string_to_metric_families(text) for sample in family.samples]
    return {(name, *labels.values()): value for name, labels, value, *_ in found}


def test_figures_are_those_of_all_processes():
    first = Share(2, 4)
    second = first.of(1)
    first.seat(2, [])
    second.seat(1, [5.0, 6.0])
    for share in (first, second, second):
        share.connect("a")
        share.count("edits", 4)
    for share, latency in ((first, 0.01), (second, 0.2), (second, 7.0)):
        share.answered(latency)
    first.count("refused")
    first.rows[1]["counts"]["restarts"] = 2
    report = metrics(first, 8)
    found = samples(report.text)
    assert (report.status, report.kind.partition(";")[0]) == (200, "text/plain")
    expected = {"visitors": 3, "places": 8, "waiting": 2, "connections": 3, "processes": 2, "edits_total": 12}
    expected |= {"frames_total": 3, "refused_requests_total": 1, "process_restarts_total": 2}
    expected |= {"latency_seconds_count": 3, "latency_seconds_sum": pytest.approx(7.21)}
    assert {name: found[f"dt_viz_{name}",] for name in expected} == expected
    classes = {bound: value for (name, *labels), value in found.items() if "bucket" in name for bound in labels}
    assert [classes[bound] for bound in ("0.01", "0.1", "0.25", "5.0", "+Inf")] == [1, 1, 2, 2, 3]
    assert report.text == metrics(second, 8).text


def test_without_the_package_the_answer_is_a_line_that_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "prometheus_client", None)
    report = metrics(Share(1, 1), 8)
    assert report.status == 501
    assert report.text.count("\n") == 1 and "pip install 'dt-viz[metrics]'" in report.text


def test_the_shipped_configuration_asks_where_metrics_are():
    text = (Path(__file__).parents[2] / "assets" / "serving" / "prometheus.yml").read_text()
    assert re.search(r"job_name: dt-viz\n +static_configs:\n +- targets: \[127\.0\.0\.1:8081", text)
