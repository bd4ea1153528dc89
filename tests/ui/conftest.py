"""What tests of the page share: a visitor's page, and a panel without one."""

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
