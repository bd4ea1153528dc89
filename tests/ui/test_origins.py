"""Whose pages may connect, by the headers that a browser sends."""

import pytest

from dt_viz.ui.origins import Origin, OriginError, Origins, address_of

LOCAL = Origins("127.0.0.1")
EVERYWHERE = Origins("0.0.0.0", [Origin.parse("https://demo.example.org")])


@pytest.mark.parametrize("host", ["localhost:8080", "127.0.0.1:8080", "[::1]:8080", "192.168.1.7:8080", "LOCALHOST"])
def test_names_that_cannot_resolve_elsewhere_are_known(host):
    assert LOCAL.knows(host)
    assert EVERYWHERE.knows(host)


FOREIGN = ["evil.example:8080", "localhost.evil.example", "127.0.0.1.evil.example", "localhost@evil.example"]
NO_HOSTS = ["", ":8080", "localhost:0x50", "localhost:99999", "127.0.0.1:8080/evil", "2130706433"]


@pytest.mark.parametrize("host", [*FOREIGN, *NO_HOSTS])
def test_names_that_anybody_may_have_resolve_to_this_server_are_not_known(host):
    assert not LOCAL.knows(host)
    assert not EVERYWHERE.knows(host)


def test_the_name_that_the_server_listens_on_and_allowed_ones_are_known():
    assert Origins("robot.lan").knows("robot.lan:8080")
    assert EVERYWHERE.knows("demo.example.org")
    assert not LOCAL.knows("demo.example.org")


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        ("http://127.0.0.1:8080", "127.0.0.1:8080"),
        ("http://localhost:8080", "127.0.0.1:8080"),
        ("http://[::1]:8080", "localhost:8080"),
        ("http://192.168.1.7:8080", "192.168.1.7:8080"),
        ("http://localhost:9000", "localhost:9000"),  # a tunnel from another port
        ("http://127.0.0.1", "127.0.0.1:80"),
        ("https://127.0.0.1", "127.0.0.1"),  # a proxy that speaks TLS
        ("https://127.0.0.1", "127.0.0.1:443"),
    ],
)
def test_the_page_of_the_server_itself_may_connect(origin, host):
    assert LOCAL.admits(origin, host)


OTHERS = ["https://evil.example", "http://1.2.3.4:8080", "http://127.0.0.1", "null", "", "file://"]
DISGUISED = ["http://127.0.0.1:8080@evil.example", "http://127.0.0.1:8080.evil.example"]


@pytest.mark.parametrize(
    ("origin", "host"),
    [
        *((origin, "127.0.0.1:8080") for origin in (*OTHERS, *DISGUISED)),
        ("http://localhost:3000", "localhost:8080"),  # another server of this machine
        ("http://192.168.1.8:8080", "192.168.1.7:8080"),
    ],
)
def test_the_pages_of_others_may_not(origin, host):
    assert not LOCAL.admits(origin, host)


def test_an_allowed_page_may_connect_whatever_the_proxy_makes_of_the_host():
    for host in ("demo.example.org", "127.0.0.1:8080"):
        assert EVERYWHERE.admits("https://demo.example.org", host)
        assert not EVERYWHERE.admits("https://other.example.org", host)
    assert not EVERYWHERE.admits("http://demo.example.org", "127.0.0.1:8080")  # anybody on the way may have written it


def test_an_origin_is_a_scheme_a_host_and_maybe_a_port():
    assert Origin.parse("https://Demo.example.org") == Origin("https", "demo.example.org", 443)
    assert Origin.parse("http://[::1]:8080/") == Origin("http", "::1", 8080)


@pytest.mark.parametrize(
    "text", ["demo.example.org", "*", "ftp://a.b", "http://", "http://a.b/path", "http://a.b:0", "http://a.b:x", "null"]
)
def test_what_is_no_origin_is_refused_with_what_would_be_accepted(text):
    with pytest.raises(OriginError, match=r"found .*accepted: http:// or https://"):
        Origin.parse(text)


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
