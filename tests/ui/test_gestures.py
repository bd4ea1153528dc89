"""What a visitor does on the page, from the browser's message to what is drawn: clicks, drags, checkboxes."""

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from pages import MIDDLE, Bound, frame_of
from scenes import avoiding, changed, places_of, starts_at

from dt_viz.motion.following import room_at_rest
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import MAX_STARTS, OFFERS, Start, View
from dt_viz.scenario.slices import BASE_PANEL
from dt_viz.scenario.starts import APART, INNER, followed, struck, with_grid, with_moved_start, with_start
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage
from dt_viz.session.progress import Pace
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.tabs.show import IN_SCENE
from dt_viz.ui.tabs.world import add_starts

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


# --- Added starts ---


def test_a_ray_meets_the_slice_where_it_is_seen(engine):
    area, rng = engine.task("drop_pots").slice, np.random.default_rng(0)
    for _ in range(20):
        place = area.at(rng.uniform(-1, 1, 2) * area.half_size)
        eye = place + rng.normal(size=3)
        hit = struck(area, eye, 3.0 * (place - eye))
        assert hit is not None
        np.testing.assert_allclose(hit, place, atol=1e-9)
        assert struck(area, eye, eye - place) is None  # behind the eye
        outside = area.at(np.array([1.2, 0.0]) * area.half_size)
        assert struck(area, eye, outside - eye) is None
    assert struck(area, area.centre + area.normal, area.axes[:, 0]) is None  # along the slice


def no_arm(_places):
    raise AssertionError("the hand alone avoids")


def test_a_grid_leaves_out_where_the_arm_that_is_to_avoid_the_obstacle_touches_it(engine, initial, robot):
    task, scenario = engine.task("draw_s"), changed(initial("draw_s"), space="cspace")
    arm_room = partial(room_at_rest, robot, task, scenario.obstacle)
    grid = with_grid(scenario, task.slice, arm_room, robot.reaches)
    hand_only = with_grid(changed(scenario, space="task"), task.slice, no_arm, robot.reaches)
    assert set(grid.starts) < set(hand_only.starts) and grid.num_blocked > hand_only.num_blocked
    nominal = engine.nominal(replace(scenario, starts=grid.starts))
    assert engine.follower.admission(nominal, scenario.arm_avoidance).nominal.moving.all()
    postures = engine.follower.undisturbed(nominal).tracked.q[7:, 0]
    room = engine.follower.whole_arm.clearance(postures, scenario.obstacle)
    np.testing.assert_allclose(room, arm_room(places_of(grid.starts)), atol=1e-3)


def test_a_grid_leaves_out_what_is_in_the_obstacle_or_out_of_reach_and_places_that_are_taken(engine, initial, robot):
    area = engine.task("draw_s").slice
    x, y, z = area.at(np.array([INNER, INNER / 3]) * area.half_size)
    scenario = changed(initial("draw_s"), obstacles=(Sphere((float(x), float(y), float(z))),))
    grid = with_grid(scenario, area, no_arm, robot.reaches)
    assert len(grid.starts) + grid.num_blocked + grid.num_far == 16 and grid.num_blocked > 0
    assert (scenario.obstacle.signed_distance(places_of(grid.starts)) >= scenario.avoidance.margin).all()
    np.testing.assert_allclose((places_of(grid.starts) - area.centre) @ area.normal, 0, atol=1e-9)
    again = with_grid(replace(scenario, starts=grid.starts), area, no_arm, robot.reaches)
    assert again.starts == grid.starts
    far = with_grid(scenario, replace(area, centre=area.centre + np.array([0.0, -2.0, 0.0])), no_arm, robot.reaches)
    assert far.starts == () and far.num_far == 16


def test_starts_are_added_up_to_a_limit_apart_from_each_other_and_moved(initial):
    scenario = initial("draw_s")
    for k in range(MAX_STARTS + 5):
        scenario = replace(scenario, starts=with_start(scenario, np.array([0.03 * k, -0.5, 0.4])))
    assert len(scenario.starts) == MAX_STARTS
    one = replace(scenario, starts=scenario.starts[:1])
    assert with_start(one, np.array(one.starts[0].place) + APART / 2) == one.starts
    assert with_moved_start(one, 0, np.ones(3)) == starts_at(np.ones(3))
    assert with_moved_start(one, 5, np.ones(3)) == one.starts  # it was removed a moment ago


@pytest.mark.parametrize("arm_rollout", [0, 3, 6, 7, 9, 40])
def test_the_arm_follows_the_same_rollout_when_starts_are_added(engine, initial, arm_rollout):
    """Also where the scenario counts round, as after starts have gone."""
    scenario = replace(initial("draw_s"), arm_rollout=arm_rollout)
    before = next(engine.frames(scenario)).chosen
    added = with_start(scenario, np.array([0.1, -0.5, 0.4]))
    after = replace(scenario, starts=added, arm_rollout=followed(scenario, engine.task("draw_s")))
    assert next(engine.frames(after)).chosen == before < 7
    assert followed(after, engine.task("draw_s")) == before


@pytest.fixture
def area(page):
    """The slice, of which the page knows."""
    task = page.session.task
    page.visitor.pictures.markers.starts.draw(frame_of(page.session.scenario, task=task), Look())
    return task.slice


def test_a_click_adds_a_start_only_while_it_is_asked_for_and_not_on_a_ball_or_beside_the_slice(page, area):
    eye = np.array([0.8, -1.6, 0.8])
    behind, place = (area.at(np.array(across)) for across in ((0.05, 0.1), (-0.1, -0.05)))
    ball = behind + 0.1 * (eye - behind)
    for asked, expected in ((False, [ball]), (True, [ball, place])):
        page.begin(avoiding("draw_s", starts=starts_at(ball), view=View(click_to_start=asked)))
        for seen in (place, ball, area.centre + np.array([2.0, 0.0, 0.0])):
            page.point(tuple(eye), tuple(seen - eye))
        np.testing.assert_allclose(places_of(page.session.scenario.starts), expected, atol=1e-9)


def test_balls_stand_where_the_starts_are_and_are_dragged_parallel_to_the_slice(page, area):
    places = [area.at(np.array(across)) for across in ((0.0, 0.1), (0.1, 0.0))]
    page.begin(avoiding("draw_s", starts=starts_at(*places)))
    for number, place in enumerate(places):
        np.testing.assert_allclose(page.nodes[f"/starts/{number}"].position, place)
        assert page.nodes[f"/starts/{number}/label"].text == str(number + 1)
    eye, target = np.array(page.camera.position), area.at(np.array([0.02, -0.12]))
    for phase, pointer in (("start", places[1]), ("update", target), ("end", eye + 0.7 * (target - eye))):
        page.drag("/starts/1", tuple(places[1]), tuple(pointer), phase)  # whatever the depth of the pointer
    np.testing.assert_allclose(places_of(page.session.scenario.starts), [places[0], target], atol=1e-9)
    page.click("/starts/1")
    assert page.session.scenario.arm_rollout == len(page.session.task.demonstrations) + 1
    page.session.edit("test", starts=page.session.scenario.starts[:1])
    assert [name for name in page.nodes if name in ("/starts/0", "/starts/1")] == ["/starts/0"]


def test_balls_are_grey_while_nothing_moves_from_them(page):
    page.begin(avoiding("draw_s", starts=starts_at((0.1, -0.5, 0.4), (0.2, -0.5, 0.4))))
    pictures, goal = page.visitor.pictures, np.zeros(3)
    for blocked, colour in ((("no way",), LIGHT.stale), ((), LIGHT.added)):
        scenario = page.session.scenario
        pictures.draw(frame_of(scenario, task=page.session.task, blocked=blocked, goal=goal, reached=goal))
        assert [item.node.color for item in pictures.markers.starts.items] == [colour] * 2


def test_a_label_is_chosen_for_new_starts_and_for_the_one_that_the_arm_follows(server):
    scenario = avoiding("draw_s")
    bound = Bound(scenario)
    add_starts(server.gui, bound)
    num = len(bound.edited.task.demonstrations)
    bound.adopt(scenario)
    (control,) = bound.inputs("Label", visible=False)  # nothing is known to have labels
    handle = control.control.handle
    low, high = "−1: as 1", "1: as 2, 3, 4 …"
    bound.report(frame_of(scenario, task=bound.edited.task, labels=(-1.0, 1.0, 1.0, 1.0, 1.0)))
    assert handle.visible and handle.options == ("nearest", low, high) and handle.value == "nearest"
    bound.set("Label", high)
    assert handle.value == high
    for x in (0.1, 0.2):
        bound.edited.edit("add start", starts=with_start(bound.edited.scenario, np.array([x, -0.5, 0.4])))
        bound.set("Label", low)
    assert [start.label for start in bound.edited.scenario.starts] == [1.0, -1.0]
    bound.edited.edit("Follows rollout", arm_rollout=num)  # the first of them
    assert handle.value == high
    bound.set("Label", "nearest")
    assert [start.label for start in bound.edited.scenario.starts] == [None, -1.0]
    moved = with_moved_start(bound.edited.scenario, 1, np.ones(3))
    assert moved[1] == Start((1.0, 1.0, 1.0), -1.0)
    bound.set("Label", "7")  # forged, or gone meanwhile
    assert handle.value == "nearest"
    bound.report(frame_of(scenario, task=bound.edited.task))
    assert not handle.visible
