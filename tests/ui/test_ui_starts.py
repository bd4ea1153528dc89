"""Added starts in the page: clicks on the slice, grids, and the balls in the scene."""

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from pages import Bound, frame_of
from scenes import avoiding, changed, places_of, starts_at

from dt_viz.motion.following import room_at_rest
from dt_viz.obstacles.shapes import Sphere
from dt_viz.scenario.scenario import MAX_STARTS, Start, View
from dt_viz.scenario.starts import APART, INNER, followed, struck, with_grid, with_moved_start, with_start
from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.tabs.world import add_starts


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
