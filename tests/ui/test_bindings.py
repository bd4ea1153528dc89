"""What goes out to a browser after an edit: what it changes, and not what the browser itself has moved."""

from dataclasses import replace

import pytest
import viser  # noqa: TID251 - looks at the messages to a browser
from pages import MIDDLE, Bound, frame_of
from scenes import avoiding
from viser import _messages as messages  # noqa: TID251

from dt_viz.scenario.scenario import View
from dt_viz.ui.bindings import Control
from dt_viz.ui.scene.picture import Look

SCENARIO = avoiding("draw_s", ())


@pytest.fixture(scope="module", name="page")
def _page(page):
    page.visitor.pictures.markers.slice.draw(frame_of(page.busy(), task=page.session.task), Look())
    return page


@pytest.fixture
def sent(server, monkeypatch):
    """Messages to the browser, but for those that are for others only, as viser has on the server's own page."""
    sent, queue = [], server._websock_server.queue_message

    def queued(message):
        queue(message)
        if message.excluded_self_client is None:
            sent.append(message)

    monkeypatch.setattr(server._websock_server, "queue_message", queued)
    return sent


def updates(sent, handle):
    """Of this handle: a page of another test may not be done with its own."""
    return [m.updates for m in sent if isinstance(m, messages.GuiUpdateMessage) and m.uuid == handle._impl.uuid]


@pytest.mark.parametrize("name", ["/obstacles/2", "/bias/0", "/slice"])
def test_a_gizmo_that_is_moved_is_not_echoed_to_the_browser_that_moves_it(page, sent, name):
    shown = {"selected": 2, "handles": True, "bias_handles": True, "move_slice": name == "/slice"}
    page.session.edit("select", view=replace(page.session.scenario.view, **shown))
    page.move(name, MIDDLE)
    before = page.session.scenario
    sent.clear()
    page.move(name, (0.12, -0.52, 0.41))
    assert page.session.scenario != before
    # its own thread, and pages of other tests, may send what their arms do meanwhile
    assert not any(str(getattr(message, "name", "")).startswith(name) for message in sent)


def test_an_input_that_is_moved_is_not_echoed_to_the_browser_that_moves_it(page, sent):
    page.session.edit("select", view=replace(page.session.scenario.view, selected=0))
    moved = []
    for handle in page.inputs:
        is_slider = isinstance(handle, viser.GuiSliderHandle)
        if handle.disabled or not (handle.visible and (is_slider or isinstance(handle, viser.GuiCheckboxHandle))):
            continue
        if is_slider:
            value = handle.min if handle.value != handle.min else handle.min + handle.step
        else:
            value = not handle.value
        before = page.session.scenario
        sent.clear()
        page.claim(handle, value)
        if page.session.scenario != before:
            moved.append(handle.label)
            assert not [update for update in updates(sent, handle) if "value" in update], handle.label
    assert len(moved) > 20


def test_an_edit_leaves_alone_what_a_browser_has_moved_meanwhile(server, sent):
    bound, slider = Bound(SCENARIO), server.gui.add_slider("Warp", 0.0, 1.0, 0.01, 1.0)
    bound.input(slider, lambda s: s.warp, lambda _s, value: {"warp": value})
    bound.adopt(SCENARIO)
    slider._impl.value = 0.3  # by a browser, whose edit comes next
    sent.clear()

    for changes, value, num_told in (
        ({"view": View(grid=True)}, 0.3, 0),
        ({"warp": 0.3}, 0.3, 0),
        ({"warp": 0.5}, 0.5, 1),
    ):
        bound.edited.edit("test", **changes)
        assert slider.value == value
        assert len(updates(sent, slider)) == num_told
    slider._impl.value = 0.9  # in vain
    bound.restore()
    assert slider.value == 0.5
    slider.remove()


def test_what_is_assigned_is_shown_and_calls_nothing_back(server):
    """A call back would wait for a loop that may have ended with the server."""
    slider, called = server.gui.add_slider("s", 0.0, 1.0, 0.1, 0.0), []
    slider.on_update(called.append)
    control = Control(slider, called.append)
    control.value = 0.5
    assert control.value == slider.value == 0.5
    assert called == []
