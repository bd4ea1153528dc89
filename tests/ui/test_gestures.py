"""What a visitor does on the page, from the browser's message to what is drawn: clicks, drags, checkboxes."""

from typing import Any

import numpy as np
import pytest
from pages import MIDDLE
from scenes import avoiding

from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.panels import BASE_PANEL
from dt_viz.scenario.scenario import OFFERS, View
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage
from dt_viz.session.progress import Pace
from dt_viz.ui.tabs.show import IN_SCENE

PACE = Pace(0.02, 10.0, 0)
AREA = TASKS["draw_s"]().slice
PLOTS = ("joint_plots", "health_plots")
SWITCHED = (*IN_SCENE, *PLOTS)
SWITCHES: dict[str, Any] = dict.fromkeys(set(SWITCHED) - {"panels"}, True)
NOTHING: dict[str, Any] = dict.fromkeys(SWITCHES, False)
EVERYTHING = View(**SWITCHES, panels=(BASE_PANEL,))
SCENARIO = avoiding("draw_s", Sphere(TASKS["draw_s"]().obstacle_position), view=EVERYTHING)


def test_a_click_on_an_obstacle_selects_it_and_shows_its_handles_and_another_hides_them(page):
    page.busy(selected=0)
    items = page.visitor.pictures.markers.obstacles.items
    for name, index, expected in (("/obstacles/2", 2, [0, 0, 1]), ("/obstacles/1", 1, [0, 1, 0]), ("", 1, [0, 0, 0])):
        page.click(f"{name or '/obstacles/1'}/surface")
        assert page.session.scenario.selected == index
        assert [item.has_handles for item in items] == expected
    assert page["Handles"].value is False


@pytest.fixture
def drawn(page, at_rest):
    """The page with a frame that holds all that can be shown, of which nothing is."""
    page.begin(SCENARIO)
    page.visitor.draw(at_rest(SCENARIO, Stage.LIVE), PACE)
    page.session.edit("test", view=View(**NOTHING))
    return page


def test_the_slice_moves_along_the_arrow_that_is_dragged(drawn):
    drawn.busy(move_slice=True)
    drawn.move("/slice", tuple(AREA.centre + 0.1 * AREA.normal), AREA.pose.wxyz)
    moved = AREA.posed(drawn.session.scenario.view.slice)
    np.testing.assert_allclose(moved.centre - AREA.centre, 0.1 * AREA.normal, atol=1e-9)
    np.testing.assert_allclose(moved.axes, AREA.axes, atol=1e-9)


@pytest.mark.parametrize("name", SWITCHED)
def test_each_layer_is_shown_while_its_checkbox_is_on(drawn, name):
    arms, show = drawn.visitor.robot.arms, drawn.visitor._panel.show
    beside_layers = {"arm": arms.arm, "ghost_arm": arms.ghost, "body_points": arms.body}
    beside_layers |= {"joint_plots": show.plots.joints[0], "health_plots": show.plots.health[0]}
    picture = beside_layers[name] if name in beside_layers else drawn.visitor.pictures.layer(name)
    assert not picture.visible
    drawn.claim(drawn[OFFERS[name].label], True)
    assert picture.visible
    if name not in {*PLOTS, "arm"}:
        arrays = shown_in(drawn, picture.node.name)
        assert all(np.isfinite(array.astype(float)).all() for array in arrays)
        assert name in {"ghost_arm", "table"} or max(np.ptp(array, axis=0).max() for array in arrays) > 0.05
    drawn.claim(drawn[OFFERS[name].label], False)
    assert not picture.visible


def test_the_past_stays_shown_while_its_task_is_edited_and_no_longer(drawn, at_rest):
    playback, home = drawn.visitor.robot.playback, drawn.session.robot.home
    for k in range(10):
        playback.recording.add(0.1, home + 0.1 * k, home, 0.0, seeks=True)
    assert playback.rewind()
    drawn.visitor.draw(at_rest(avoiding("draw_s", Sphere(MIDDLE)), Stage.LIVE), PACE)
    drawn.session.edit("test", warp=0.5)
    assert playback.player is playback.past
    drawn.visitor.draw(at_rest(avoiding("draw_j", ()), Stage.LIVE), PACE)
    assert playback.player is None


def shown_in(page, folder):
    """The points of a node and of those below it in the tree."""
    nodes = [node for name, node in page.nodes.items() if name == folder or name.startswith(f"{folder}/")]
    kinds = ("points", "vertices", "batched_positions")
    arrays = [getattr(node, kind).reshape(-1, 3) for node in nodes for kind in kinds if hasattr(node, kind)]
    return [array for array in arrays if len(array)]


def test_the_ball_at_the_hand_holds_the_arm_where_it_is_dragged_and_lets_go(page, monkeypatch):
    page.busy()
    told, live = [], page.visitor.robot.playback.live
    monkeypatch.setattr(live, "hold", told.append)
    monkeypatch.setattr(live, "release", lambda: told.append("released"))
    monkeypatch.setattr(type(page.visitor.robot), "hand", None)
    (ball,) = (name for name in page.nodes if name.endswith("/grip"))
    page.visitor.robot.grip.visible = True
    dragged = [MIDDLE, (0.15, -0.5, 0.45), (0.2, -0.5, 0.3)]  # parallel to the slice
    for phase, end in zip(("start", "update", "end"), dragged, strict=True):
        page.drag(ball, MIDDLE, end, phase)
    *places, released = told
    np.testing.assert_allclose(places, dragged)
    assert released == "released"
    told.clear()
    page.visitor.robot.grip.visible = False
    page.drag(ball, MIDDLE, dragged[-1])
    assert told == []
