"""Web pages that may connect to the server: its own pages, and those of allowed origins.

A page in the user's browser can reach every server that the user can reach, so the server checks the origin of a page.
The browser reports it in two headers that a page cannot change:

``Host``
    The name in the address that the browser connects to. A page can have a name of its own resolve to this server
    (DNS rebinding), and then counts as served by it; so only known names are accepted. Addresses and ``localhost``
    cannot be made to resolve elsewhere.
``Origin``
    The origin of the page. It must be the host and port that it connects to, or an allowed one.

A program that is no browser sends no ``Origin``. It acts with its own rights only, so it is accepted. ``--host`` and a
firewall decide who can reach the port at all.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

DEFAULT_PORTS = {"http": 80, "https": 443}
"""Default port of each scheme."""
LOOPBACK = "localhost"
"""Canonical name of the loopback addresses."""


class OriginError(ValueError):
    """A text that is no origin; the message says what was found and what would be accepted."""


@dataclass(frozen=True)
class Origin:
    """Scheme, host and port of a web page."""

    scheme: str
    host: str
    """Host in lower case; an IPv6 address without brackets."""
    port: int

    @classmethod
    def parse(cls, text: str) -> Origin:
        """Parse the origin from a text such as ``https://demo.example.org:8443``.

        Raises:
            OriginError: it is no origin, or has further parts.
        """
        parts = _split(text)
        if parts is None or parts.scheme not in DEFAULT_PORTS:
            raise OriginError(
                f"found {text!r}; accepted: http:// or https://, a name or an address, and maybe a port, "
                "such as https://demo.example.org"
            )
        assert parts.hostname is not None
        return cls(parts.scheme, parts.hostname, parts.port or DEFAULT_PORTS[parts.scheme])

    def __str__(self) -> str:
        return f"{self.scheme}://{f'[{self.host}]' if ':' in self.host else self.host}:{self.port}"


class Origins:
    """Rules for the requests and pages that are accepted."""

    def __init__(self, host: str, allowed: Iterable[Origin] = ()) -> None:
        """Accept the server's own pages and those of allowed origins.

        Args:
            host: name or address that the server listens on.
            allowed: further origins; their names count as names of this server, too.
        """
        self._allowed = frozenset(allowed)
        self._names = {LOOPBACK, host.lower(), *(origin.host for origin in self._allowed)}
        embedders = " ".join(["'self'", *sorted(map(str, self._allowed))])
        self.policy = (
            "default-src 'self' 'unsafe-inline' 'unsafe-eval' data: blob:; connect-src 'self' ws: wss: data: blob:; "
            f"object-src 'none'; base-uri 'none'; form-action 'none'; frame-ancestors {embedders}"
        )
        """Content policy of the page, as a header: it loads nothing from elsewhere, and only allowed pages embed it.
        viser's page is one file, which unpacks and evaluates its script."""

    def knows(self, host: str) -> bool:
        """Return whether a request to this host, the value of the header ``Host``, is meant for this server."""
        parts = _split(f"//{host}")
        return parts is not None and (parts.hostname in self._names or _address(parts.hostname) is not None)

    def admits(self, origin: str, host: str) -> bool:
        """Return whether a page may connect.

        Args:
            origin: value of its header ``Origin``.
            host: value of the header ``Host``, a known one.
        """
        try:
            page = Origin.parse(origin)
        except OriginError:  # also "null", the origin of local pages
            return False
        if page in self._allowed:
            return True
        parts = _split(f"//{host}")
        if parts is None or parts.hostname is None:
            return False
        port = parts.port or DEFAULT_PORTS[page.scheme]
        return (_canonical(page.host), page.port) == (_canonical(parts.hostname), port)


def address_of(peer: str, forwarded: Iterable[str]) -> str:
    """Return the address, of IPv6 the network, that a request is counted for; empty for this machine's own.

    Args:
        peer: the other end of the connection.
        forwarded: values of the header ``X-Forwarded-For``, to which a proxy adds who has connected to it, perhaps with
            a port. Only one on this machine is believed: anybody may send the header. What is no address counts as a
            name, so that nobody goes uncounted.
    """
    host, address = peer, _address(peer)
    if address is not None and address.is_loopback:
        host = ",".join(forwarded).rpartition(",")[2].strip()
        parts = _split(f"//{host}")  # None of an address of IPv6 without brackets, which has no port
        host = host if parts is None else parts.hostname or host
        address = _address(host)
    if address is None:
        return host
    network = ipaddress.ip_network((address, 64 if address.version == 6 else 32), strict=False)
    return "" if address.is_loopback else str(network)


def is_loopback(host: str | None) -> bool:
    """Return whether a host is this machine, as only itself sees it."""
    return host is not None and _canonical(host) == LOOPBACK


def _split(text: str) -> SplitResult | None:
    """Split a URL; return None if it has no host, an invalid port, or further parts."""
    try:
        parts = urlsplit(text)
        if not parts.hostname or parts.port == 0:
            return None
    except ValueError:
        return None
    more = "@" in parts.netloc or parts.path not in {"", "/"} or parts.query or parts.fragment
    return None if more else parts


def _address(host: str | None) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Parse an address; one of IPv4 that is written as one of IPv6, as dual-stack sockets do, is one of IPv4."""
    try:
        address = ipaddress.ip_address(host or "")
    except ValueError:
        return None
    return address if isinstance(address, ipaddress.IPv4Address) else address.ipv4_mapped or address


def _canonical(host: str) -> str:
    """Return the canonical name of a host."""
    address = _address(host)
    if address is None:
        return host
    return LOOPBACK if address.is_loopback else str(address)
