"""What tests of the page share: a visitor's page, and a panel without one."""

from typing import Any

import pytest
from pages import Page, panel_of


@pytest.fixture(scope="module")
def page(server, robot):
    page = Page(server, robot)
    yield page
    page.close()


@pytest.fixture
def panel(server):
    panel = panel_of(server)
    yield panel
    server.gui.reset()


@pytest.fixture
def opened_for(server, robot):
    """Opens pages for browsers."""
    pages = []

    def opens(browser: Any, **offered: Any) -> Page:
        server.gui.reset()
        server.scene.reset()
        pages.append(Page(server, robot, kept=browser, **offered))
        return pages[-1]

    yield opens
    for page in pages:
        page.close()
    server.gui.reset()
    server.scene.reset()
