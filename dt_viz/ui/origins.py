"""Which web pages may talk to the server: those that it served itself, and those of other names that are allowed.

A page that is open in the same browser can reach every server that the user can reach, so the server asks where a page
is from. The browser says so in two headers that a page cannot change:

``Host``
    The name in the address that the browser connects to. A page can have a name of its own resolve to this server
    (DNS rebinding), and then counts as served by it; so a name must be known. Addresses and ``localhost`` cannot be
    made to resolve elsewhere.
``Origin``
    Where the page is from. It must be the very host and port that it connects to, or an allowed one.

A program that is no browser sends no ``Origin``. It has no rights but its own, and needs no page to misuse; it is let
in. Who may reach the port at all is the matter of ``--host`` and of a firewall.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable
from dataclasses import dataclass
from urllib.parse import SplitResult, urlsplit

DEFAULT_PORTS = {"http": 80, "https": 443}
"""Port of an address that names none, by scheme."""
LOOPBACK = "localhost"
"""Name that stands for all names and addresses of the machine itself."""


class OriginError(ValueError):
    """A text is no origin; the message says what was found and what would be accepted."""


@dataclass(frozen=True)
class Origin:
    """Scheme, host and port of a web page."""

    scheme: str
    host: str
    """In lower case; an IPv6 address without brackets."""
    port: int

    @classmethod
    def parse(cls, text: str) -> Origin:
        """The origin that a text such as ``https://demo.example.org:8443`` names.

        Raises:
            OriginError: it names none, or more than that.
        """
        parts = _split(text)
        if parts is None or parts.scheme not in DEFAULT_PORTS:
            raise OriginError(
                f"found {text!r}; accepted: http:// or https://, a name or an address, and maybe a port, "
                "such as https://demo.example.org"
            )
        assert parts.hostname is not None
        return cls(parts.scheme, parts.hostname, parts.port or DEFAULT_PORTS[parts.scheme])


class Origins:
    """Says whom to answer."""

    def __init__(self, host: str, allowed: Iterable[Origin] = ()) -> None:
        """Answer pages of the server itself, and allowed ones.

        Args:
            host: name or address that the server listens on.
            allowed: further pages; their names may be those of this server, too.
        """
        self._allowed = frozenset(allowed)
        self._names = {LOOPBACK, host.lower(), *(origin.host for origin in self._allowed)}

    def knows(self, host: str) -> bool:
        """Whether a request to this host, the value of the header ``Host``, is meant for this server."""
        parts = _split(f"//{host}")
        return parts is not None and (parts.hostname in self._names or _address(parts.hostname) is not None)

    def admits(self, origin: str, host: str) -> bool:
        """Whether a page may connect.

        Args:
            origin: value of its header ``Origin``.
            host: value of the header ``Host``, which is known.
        """
        try:
            page = Origin.parse(origin)
        except OriginError:  # also "null", of pages that come from nowhere
            return False
        if page in self._allowed:
            return True
        parts = _split(f"//{host}")
        if parts is None or parts.hostname is None:
            return False
        port = parts.port or DEFAULT_PORTS[page.scheme]
        return (_canonical(page.host), page.port) == (_canonical(parts.hostname), port)


def _split(text: str) -> SplitResult | None:
    """The parts of a URL, or None where there is no host or no valid port, and where there is more than both."""
    try:
        parts = urlsplit(text)
        if not parts.hostname or parts.port == 0:
            return None
    except ValueError:
        return None
    more = "@" in parts.netloc or parts.path not in {"", "/"} or parts.query or parts.fragment
    return None if more else parts


def _address(host: str | None) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    try:
        return ipaddress.ip_address(host or "")
    except ValueError:
        return None


def _canonical(host: str) -> str:
    """The host by the one name that it has here."""
    address = _address(host)
    if address is None:
        return host
    return LOOPBACK if address.is_loopback else str(address)
