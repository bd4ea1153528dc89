"""What the gate refuses, one rule at a time: pages by their headers, files before they are held, records of the log."""

import io
import logging
from types import SimpleNamespace

import pytest

from dt_viz.errors import DataError
from dt_viz.ui import gate
from dt_viz.ui.gate import Origins, RateLimitFilter, Upload, address_of, origin_of

LOCAL, LISTENING = Origins("127.0.0.1"), Origins("robot.lan")
EVERYWHERE = Origins("0.0.0.0", [origin_of("https://demo.example.org")])


LOCALS = ["localhost:8080", "127.0.0.1:8080", "[::1]:8080", "192.168.1.7:8080", "LOCALHOST"]
FOREIGN = ["evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example", "localhost@evil.example"]
NO_HOSTS = ["", ":8080", "localhost:0x50", "localhost:99999", "127.0.0.1:8080/evil", "2130706433"]


@pytest.mark.parametrize(
    ("host", "known_by"),
    [
        *((host, [LOCAL, EVERYWHERE, LISTENING]) for host in LOCALS),
        *((host, []) for host in (*FOREIGN, *NO_HOSTS)),
        ("robot.lan:8080", [LISTENING]),
        ("demo.example.org", [EVERYWHERE]),
    ],
)
def test_names_that_cannot_resolve_elsewhere_and_allowed_ones_are_known(host, known_by):
    assert [origins for origins in (LOCAL, EVERYWHERE, LISTENING) if origins.knows(host)] == known_by


OTHERS = ["https://evil.example", "http://1.2.3.4:8080", "http://127.0.0.1", "null", "", "file://"]
DISGUISED = ["http://127.0.0.1:8080@evil.example", "http://127.0.0.1:8080.evil.example"]


@pytest.mark.parametrize(
    ("origins", "origin", "host", "admitted"),
    [
        (LOCAL, "http://127.0.0.1:8080", "127.0.0.1:8080", True),
        (LOCAL, "http://localhost:8080", "127.0.0.1:8080", True),
        (LOCAL, "http://[::1]:8080", "localhost:8080", True),
        (LOCAL, "http://192.168.1.7:8080", "192.168.1.7:8080", True),
        (LOCAL, "http://localhost:9000", "localhost:9000", True),  # a tunnel from another port
        (LOCAL, "http://127.0.0.1", "127.0.0.1:80", True),
        (LOCAL, "https://127.0.0.1", "127.0.0.1", True),  # a proxy that speaks TLS
        (LOCAL, "https://127.0.0.1", "127.0.0.1:443", True),
        *((LOCAL, origin, "127.0.0.1:8080", False) for origin in (*OTHERS, *DISGUISED)),
        (LOCAL, "http://localhost:3000", "localhost:8080", False),  # another server of this machine
        (LOCAL, "http://192.168.1.8:8080", "192.168.1.7:8080", False),
        (EVERYWHERE, "https://demo.example.org", "demo.example.org", True),
        (EVERYWHERE, "https://demo.example.org", "127.0.0.1:8080", True),  # whatever the proxy makes of the host
        (EVERYWHERE, "https://other.example.org", "demo.example.org", False),
        (EVERYWHERE, "https://other.example.org", "127.0.0.1:8080", False),
        (EVERYWHERE, "http://demo.example.org", "127.0.0.1:8080", False),  # anybody on the way may have written it
    ],
)
def test_the_page_of_the_server_itself_and_allowed_ones_may_connect_and_those_of_others_not(
    origins, origin, host, admitted
):
    assert origins.admits(origin, host) is admitted


def test_an_origin_is_a_scheme_a_host_and_maybe_a_port():
    assert origin_of("https://Demo.example.org") == "https://demo.example.org:443"
    assert origin_of("http://[::1]:8080/") == "http://[::1]:8080"


@pytest.mark.parametrize(
    "text", ["demo.example.org", "*", "ftp://a.b", "http://", "http://a.b/path", "http://a.b:0", "http://a.b:x", "null"]
)
def test_what_is_no_origin_is_refused_with_what_would_be_accepted(text):
    with pytest.raises(ValueError, match=r"found .*accepted: http:// or https://"):
        origin_of(text)


@pytest.mark.parametrize(
    ("peer", "forwarded", "counted"),
    [
        ("127.0.0.1", [], ""),
        ("::1", ["127.0.0.1"], ""),
        ("127.0.0.1", ["1.1.1.1, 203.0.113.7"], "203.0.113.7/32"),
        ("::ffff:127.0.0.1", ["1.1.1.1", "203.0.113.7:52011"], "203.0.113.7/32"),
        ("::1", ["[2001:db8::7]:52011"], "2001:db8::/64"),
        ("127.0.0.1", ["::ffff:203.0.113.7"], "203.0.113.7/32"),
        ("::ffff:203.0.113.7", [], "203.0.113.7/32"),
        ("::1", ["nonsense"], "nonsense"),
        ("203.0.113.7", ["1.1.1.1"], "203.0.113.7/32"),  # it may say what it likes
        ("2001:db8::7", [], "2001:db8::/64"),
    ],
)
def test_a_request_is_counted_for_who_has_sent_it(peer, forwarded, counted):
    assert address_of(peer, forwarded) == counted


@pytest.fixture
def upload(monkeypatch):
    monkeypatch.setattr(gate, "MAX_UPLOAD", 1000)
    return Upload()


def test_a_file_arrives_in_parts_in_any_order_and_nothing_else_is_wanted(upload):
    assert not upload.part("a", 0, 1)
    upload.start("a", "x.ply", 1000, 3)
    assert [upload.part("a", index, size) for index, size in ((2, 200), (0, 400), (1, 400))] == [True] * 3
    assert not upload.part("a", 1, 400)  # it is complete
    upload.start("a", "x.ply", 0, 0)
    assert not upload.part("a", 0, 0)


def test_a_file_that_is_announced_too_large_is_refused_and_nothing_of_it_is_wanted(upload):
    with pytest.raises(DataError, match=r"x\.ply: file: found 0\.0 MB; accepted: at most 0 MB"):
        upload.start("a", "x.ply", 1001, 1)
    assert not upload.part("a", 0, 1)


def test_a_new_file_takes_the_place_of_one_that_was_given_up(upload):
    upload.start("a", "x.ply", 1000, 2)
    assert upload.part("a", 0, 500)
    upload.start("b", "y.ply", 10, 1)
    assert not upload.part("a", 1, 500)
    assert upload.part("b", 0, 10)


@pytest.mark.parametrize(
    "parts", [[(0, 600), (1, 600)], [(0, 400), (1, 400)], [(0, 500), (0, 500)], [(2, 1)], [(-1, 1)]]
)
def test_parts_that_do_not_add_up_to_what_was_announced_come_from_no_page(upload, parts):
    upload.start("a", "x.ply", 1000, 2)
    with pytest.raises(ValueError, match="part"):
        for index, size in parts:
            upload.part("a", index, size)


@pytest.mark.parametrize(
    ("num_bytes", "num_parts"),
    [(-1, 1), (10, 0), (10, -1), (10, 11), (0, 1), (1000, 1001), (gate.MAX_PARTS + 1, gate.MAX_PARTS + 1)],
)
def test_numbers_of_parts_that_no_file_has_come_from_no_page(num_bytes, num_parts):
    with pytest.raises(ValueError, match="parts for"):
        Upload().start("a", "x.ply", num_bytes, num_parts)


@pytest.fixture
def clock(monkeypatch):
    """The time of the log, seconds."""
    now = SimpleNamespace(value=0.0)
    monkeypatch.setattr(gate, "time", SimpleNamespace(monotonic=lambda: now.value))
    return now


@pytest.fixture
def log(clock):
    """A logger and what it has written."""
    logger, written = logging.Logger("test"), io.StringIO()
    handler = logging.StreamHandler(written)
    handler.addFilter(RateLimitFilter())
    logger.addHandler(handler)
    return logger, written


def test_an_exception_is_written_with_its_type_and_places_without_its_text(log):
    logger, written = log
    try:
        float("secret")
    except ValueError:
        logger.exception("a callback failed")
    assert "a callback failed" in written.getvalue()
    assert "ValueError" in written.getvalue()
    assert __file__ in written.getvalue()
    assert "secret" not in written.getvalue().replace('float("secret")', "")  # of the program it holds the line


def test_few_records_of_a_kind_are_written_in_a_period_and_how_many_were_left_out_in_the_next(log, clock):
    logger, written = log
    for k in range(gate.MAX_RECORDS + 7):
        clock.value = gate.PERIOD if k == gate.MAX_RECORDS + 6 else 0.0
        logger.warning("number %d", k)
    logger.warning("another kind")
    last = f"number {gate.MAX_RECORDS + 6} (and 6 more like this)"
    assert written.getvalue().splitlines() == [*(f"number {k}" for k in range(gate.MAX_RECORDS)), last, "another kind"]
