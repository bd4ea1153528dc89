"""A server with the first task, and pages of which nothing is complained."""

import pytest
from browsing import OF_OTHERS, page_errors

from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server


@pytest.fixture(scope="session")
def server(fits, robot):
    server = Server(TASKS, fits, robot, task="draw_s", port=0, max_sessions=2)
    yield server
    server.close()


@pytest.fixture(autouse=True)
def _no_complaints():
    """What pages say of errors in their consoles fails the test."""
    page_errors.clear()
    yield
    assert [error for error in page_errors if not any(known in error for known in OF_OTHERS)] == []
