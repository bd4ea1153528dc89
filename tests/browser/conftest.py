"""A server with the first task, pages of which nothing is complained, and what these ask the server for."""

from functools import wraps
from urllib.parse import SplitResult, urlsplit

import pytest
from browsing import OF_OTHERS, page_errors

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

requests: list[SplitResult] = []
"""Addresses that pages have asked a server for, beside their websockets."""


@pytest.fixture(scope="session")
def server(fits, robot):
    server = Server(TASKS, fits, robot, task="draw_s", port=0, max_sessions=2)
    yield server
    server.close()


@pytest.fixture(scope="module")
def browser(browser):
    """The browser, whose pages and contexts note what they ask for."""

    def watched(new):
        @wraps(new)
        def opened(*arguments, **options):
            page = new(*arguments, **options)
            page.on("request", lambda request: requests.append(urlsplit(request.url)))
            return page

        return opened

    with pytest.MonkeyPatch.context() as patch:
        for name in ("new_page", "new_context"):
            patch.setattr(browser, name, watched(getattr(browser, name)))
        yield browser


@pytest.fixture(autouse=True)
def _no_complaints():
    """What pages say of errors in their consoles fails the test."""
    page_errors.clear()
    yield
    assert [error for error in page_errors if not any(known in error for known in OF_OTHERS)] == []


@pytest.fixture(autouse=True)
def _all_on_one_connection():
    """A page that asks a server for more than itself fails the test: another process may answer."""
    requests.clear()
    yield
    asked = {url.path for url in requests if url.scheme in ("http", "https")}
    assert asked <= {"/"}, f"asked for {asked}"
