"""One scene that the visitor with the key edits, and all others watch: frames are computed once for all.

The presenter's page is that of a visitor. A `Mirror` sends what is drawn in it to all clients, without its gizmos and
its clickable nodes, as viser would send those of `server.scene` to viewers, too. Viewers have no session, and none of
their messages changes the scene: a card says what is shown, and lets the camera follow the presenter's.
"""

from __future__ import annotations

import hmac
import html
import itertools
import logging
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any
from urllib.parse import urlsplit

import numpy as np
import segno
import viser

from dt_viz.ui import patches
from dt_viz.ui.bindings import Control
from dt_viz.ui.gate import is_loopback
from dt_viz.ui.page import Page
from dt_viz.ui.scene.camera import Framing, Pose, followed, window_size
from dt_viz.ui.scripts import Window, forget_html, report_window

logger = logging.getLogger(__name__)

PERIOD, WORDS = 0.1, 5
"""Shortest time between two moves of a camera that follows, seconds, and number of these between two texts."""
AWAY = "The presenter is away: this is the last scene."
NOT_YET = "The presenter has not come yet."
"""Texts of the card without a presenter, after one was there and before."""
WRONG = "This key is not the one that the server has printed. The page opens again, and you watch."
TAKEN = "Another page has taken over with the key: you watch."
OWN_MACHINE = "Only this machine gets there: start the server with --host 0.0.0.0."
"""Text beside the address in the presenter's page where others cannot reach it."""
CARD = Framing(panel=0.0, under=0.36)  # the window of a viewer: the card lies at its edge
ANYWHERE = ("", "0.0.0.0", "::")  # hosts that stand for all addresses of this machine
OVER_SCENE = """<div class='dt-address'><style>
.dt-address {
    visibility: visible; position: fixed; left: 3vw; top: 50%; transform: translateY(-50%); z-index: 5;
    padding: 1.2em; border-radius: 0.6em; background: #fff; color: #111; box-shadow: 0 2px 16px #0005;
    text-align: center; pointer-events: none; width: min(60vh, 44vw);
}
.dt-address svg { display: block; width: 100%; height: auto; }
.dt-address b { display: block; font-size: clamp(1rem, 2vw, 2.4rem); overflow-wrap: anywhere; }
</style>"""
"""Beginning of what shows an address over the scene, so large that a room can scan it."""
SMALL = """<div class='dt-qr'><style>
.dt-qr { margin: 0.4em 0.9em 0.8em; text-align: center; font-size: 0.85em; overflow-wrap: anywhere; }
.dt-qr svg { display: block; width: 10em; height: auto; margin: 0 auto; background: #fff; border-radius: 0.3em; }
@media (max-width: 36em) { .dt-qr { display: none; } }
</style>"""
"""Beginning of what shows it on a card; a phone, which has scanned it, has no room for it."""


@dataclass
class Viewer:
    """A visitor who watches, or waits for a place."""

    client: viser.ClientHandle
    width: float | None = None  # width of the window, CSS pixels; None before it is reported
    line: viser.GuiHtmlHandle | None = None
    """Text of the card that says what is shown; None while there is no card."""
    follow: Control | None = None  # whether the camera follows the presenter's
    seen: tuple[Pose, Framing] | None = None
    """View of the presenter that the camera was put to last; None where it is to be put again."""


@dataclass
class Presenter:
    """The visitor who edits the scene."""

    client: viser.ClientHandle
    mirror: patches.Mirror
    visitor: Page | None = None  # the page; None until it is built
    label: str = ""
    """Title of the panel, with the number of those who watch; empty until it is shown."""


class Lecture:
    """The presenter, and those who watch."""

    def __init__(self, key: str, host: str, page: Callable[[viser.ClientHandle], str]) -> None:
        """Begin without clients.

        Args:
            key: that of the presenter.
            host: name or address that the server listens on.
            page: returns the origin of a client's page, as `Gate.page`.
        """
        self._key, self._host, self._page = key, host, page
        self._lock = threading.RLock()  # viewers come and go in threads of their own
        self._viewers: dict[int, Viewer] = {}
        self._presenter: Presenter | None = None
        self._absence = NOT_YET  # text of the card without a presenter
        self._headline = _line(NOT_YET)
        self._closed = threading.Event()
        threading.Thread(target=self._run, name="lecture", daemon=True).start()

    @property
    def presenter(self) -> viser.ClientHandle | None:
        """Client that edits the scene; None without one."""
        with self._lock:
            return None if self._presenter is None else self._presenter.client

    def ask(self, client: viser.ClientHandle, claim: Callable[[str], None]) -> None:
        """Have a page that has come report its window; `claim` is called with the presenter's key, if it has one."""
        viewer = Viewer(client)

        def reported(window: Window) -> None:
            viewer.width, viewer.seen = window.width, None
            if window.key:
                claim(window.key)

        with self._lock:
            self._viewers[client.client_id] = viewer
        report_window(client, reported)

    def welcome(self, client: viser.ClientHandle) -> None:
        """Give a viewer a card."""
        with self._lock:
            viewer = self._viewers.get(client.client_id)
            if viewer is None or viewer.line is not None:
                return  # has left, or presents by now
            viewer.line = client.gui.add_html(self._headline)
            hint = "off: your own camera stays where you move it"
            box = client.gui.add_checkbox("Follow the presenter's camera", True, hint=hint)
            viewer.follow = Control(box, lambda _on: setattr(viewer, "seen", None))
            client.gui.add_html(f"{patches.PANEL}{SMALL}{self._address_html(client)}</div>")

    def claimed(self, client: viser.ClientHandle, key: str) -> tuple[Viewer | None, bool]:
        """Return the viewer of a client who claims to present, and whether the key is right.

        It is no viewer any more; there is none for a second claim.
        """
        with self._lock:
            return self._viewers.pop(client.client_id, None), hmac.compare_digest(self._key.encode(), key.encode())

    def take(self, server: viser.ViserServer, viewer: Viewer) -> viser.ClientHandle | None:
        """Let a viewer present from now on, whose page can then be built.

        Returns:
            The client that presented until now, whose connection is to end.
        """
        client = viewer.client
        with self._lock:
            client.gui.reset()
            before = self._leave()
            large = client.gui.add_html(f"{OVER_SCENE}{self._address_html(client)}</div>", visible=False)
            hint = "of those who watch, with a QR code, over the scene"
            box = client.gui.add_checkbox("Show address", False, hint=hint)
            Control(box, lambda on: setattr(large, "visible", on))
            self._presenter = Presenter(client, patches.Mirror(server, client))
        if before is not None:
            before.gui.add_html(forget_html())
        return before

    def begin(self, visitor: Page) -> None:
        """Take the page of the presenter, which is built."""
        with self._lock:
            if self._presenter is not None and self._presenter.client is visitor.client:
                self._presenter.visitor, self._absence = visitor, AWAY

    def farewell(self, client: viser.ClientHandle) -> None:
        """Forget a client that has left."""
        with self._lock:
            self._viewers.pop(client.client_id, None)
            if self.presenter is client:
                self._leave()

    def close(self) -> None:
        """Send no more texts and cameras."""
        self._closed.set()

    def _leave(self) -> viser.ClientHandle | None:
        """End the presentation; return the client that presented."""
        before, self._presenter = self._presenter, None
        if before is None:
            return None
        before.mirror.end()
        return before.client

    def _run(self) -> None:
        for number in itertools.count():
            if self._closed.wait(PERIOD):
                return
            try:
                self._move()
                if number % WORDS == 0:
                    self._write()
            except Exception:
                logger.exception("viewers could not be updated")

    def _move(self) -> None:
        with self._lock:
            presenter, viewers = self._presenter, list(self._viewers.values())
        if presenter is None or presenter.visitor is None or (seen := presenter.visitor.camera.seen) is None:
            return
        for viewer in viewers:
            if viewer.follow is not None and viewer.follow.value:
                _follow(viewer, seen)

    def _write(self) -> None:
        """Write what is shown on the viewers' cards, and their number in the title of the presenter's panel."""
        with self._lock:
            presenter, watching = self._presenter, [one for one in self._viewers.values() if one.line is not None]
            if presenter is None:
                self._headline = _line(self._absence)
            elif presenter.visitor is not None:
                self._headline = presenter.visitor.headline
                if (label := f"DT-Viz · {len(watching)} watching") != presenter.label:
                    presenter.label = label
                    presenter.client.gui.set_panel_label(label)
            for viewer in watching:
                if viewer.line is not None:
                    viewer.line.content = self._headline

    def _address_html(self, client: viser.ClientHandle) -> str:
        """Return the address of viewers as a QR code and as a text; see `reachable`."""
        address = reachable(self._page(client), self._host)
        code = segno.make(address, micro=False).svg_inline(omitsize=True, border=2)
        note = OWN_MACHINE if is_loopback(urlsplit(address).hostname) else ""
        return f"{code}<b>{html.escape(address)}</b>{note}"


def _line(text: str) -> str:
    return f"<div style='margin:0.4em 0.9em'>{text}</div>"


def _follow(viewer: Viewer, seen: tuple[Pose, Framing]) -> None:
    """Put a viewer's camera to where it shows what the presenter sees, if that is new."""
    if viewer.seen is not None and viewer.seen[1] == seen[1] and np.allclose(viewer.seen[0], seen[0]):
        return
    viewer.seen = seen
    own = Framing(window_size(viewer.client.camera, viewer.width), panel=CARD.panel, under=CARD.under)
    pose = followed(*seen, own)
    if np.isfinite(pose).all():
        camera: Any = viewer.client.camera
        with viewer.client.atomic():
            camera.position, camera.look_at = pose
            camera.fov = own.field_of_view


def reachable(page: str, host: str) -> str:
    """Return the address at which others get to the page that one browser sees at an origin.

    Args:
        page: origin of that browser's page.
        host: name or address that the server listens on. Where that is any of this machine, a page that this machine
            itself has opened is reached by the address of its network.
    """
    parts = urlsplit(page)
    if not is_loopback(parts.hostname) or host not in ANYWHERE:
        return f"{page}/"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sock:
        try:
            sock.connect(("192.0.2.1", 9))  # sends nothing: the system only chooses the network
        except OSError:
            return f"{page}/"
        return f"{parts.scheme}://{sock.getsockname()[0]}:{parts.port or 80}/"
