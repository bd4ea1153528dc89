"""Other methods beside ours on a page: what is worked out when, and what the panel and the scene show of it."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from pages import Page, frame_of
from scenes import avoiding, changed

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.registry import METHODS, others, problem_of
from dt_viz.errors import UnwantedError
from dt_viz.evaluate.held_out import frechet
from dt_viz.evaluate.table1 import drawn
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.paper_scenes import FIG_6_PLACES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.tasks import TASKS, TaskEntry, drawing_task
from dt_viz.session.comparison import WAITS, curves, scored
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.ui.bindings import Bindings
from dt_viz.ui.scene.comparison import APART, ComparedMotions, colour_of
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.tabs.compare import ComparePanel, hint, table_html

LIVE, SLOW = "linear", "mpnet"


def shown(scenario, *names, their_arm=""):
    return replace(scenario, view=replace(scenario.view, compared=names, their_arm=their_arm))


def by_name(frame):
    return {compared.method.name: compared for compared in frame.comparison}


def straight(problem):
    """In the place of MPNet's planner, which takes seconds to find most of the same motions."""
    return METHODS[LIVE].fit(problem)


@pytest.fixture
def quick(monkeypatch):
    """The slow method plans at once; it waits for its turn all the same."""
    monkeypatch.setitem(vars(METHODS["mpnet"]), "fit", straight)


@pytest.fixture(scope="module")
def beside(new_engine, initial):
    """Frames of a new engine for ours beside two methods, and the engine."""
    engine = new_engine()
    scenario = shown(changed(initial("push_box"), space="cspace"), LIVE, SLOW)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(vars(METHODS["mpnet"]), "fit", straight)
        return engine, scenario, list(engine.frames(scenario))


@pytest.mark.long
def test_quick_methods_follow_a_drag_and_slow_ones_come_one_after_the_other(beside):
    _, _, frames = beside
    assert [frame.stage for frame in frames[:4]] == list(Stage)
    assert {frame.stage for frame in frames[4:]} == {Stage.CERTIFIED}
    assert frames[0].comparison == ()
    live, last = by_name(frames[1]), by_name(frames[-1])
    assert list(live) == list(last) == ["ours", SLOW, LIVE]  # in the order of the tables
    assert live[LIVE].paths and live[SLOW].note == WAITS and not live[SLOW].paths
    assert all(len(compared.paths) == 7 and compared.scores.arm_depth is not None for compared in last.values())
    told = [sum(c.scores is not None and c.scores.arm_depth is not None for c in frame.comparison) for frame in frames]
    assert told == sorted(told) and told[3] == 0 and set(told) == {0, 1, 2, 3}


@pytest.mark.usefixtures("quick")
def test_an_edit_ends_the_planning_of_a_slow_method_at_once(new_engine, initial):
    engine, scenario = new_engine(), shown(initial("push_box"), SLOW)
    frames, wanted = [], [True]

    with pytest.raises(UnwantedError):
        for frame in engine.frames(scenario, cancelled=lambda: not wanted[0]):
            frames.append(frame)
            wanted[0] = not by_name(frame).get(SLOW) or "planning" not in by_name(frame)[SLOW].note
    assert by_name(frames[-1])[SLOW].note == "planning … (1 of 1)"


def test_scores_are_those_of_the_motions(beside):
    engine, scenario, frames = beside
    last, task, goal = by_name(frames[-1]), frames[-1].task, frames[-1].goal
    (sphere,) = scenario.obstacles
    for compared in last.values():
        found = frechet(compared.paths, task.paths).mean()
        assert compared.scores.frechet == pytest.approx(found, abs=3e-3)
        inside = max(float(-sphere.signed_distance(path).min()) for path in compared.paths)
        assert compared.scores.hand_depth == pytest.approx(max(0.0, inside), abs=1e-3)
        ends = max(np.linalg.norm(path[-1] - goal) for path in compared.paths)
        assert compared.scores.goal_error == pytest.approx(ends, abs=1e-9)
    planner = METHODS[LIVE].fit(problem_of(engine.nominal(scenario).learned, engine.follower))
    joints = planner(scenario.obstacle, task.starts).joints
    assert joints is not None
    nearest = min(load_jaco().collision.nearest_to_obstacle(q, scenario.obstacle).distance for q in joints)
    assert last[LIVE].scores.arm_depth == pytest.approx(max(0.0, -nearest), abs=1e-3)
    assert last["ours"].scores.arm_depth == 0.0


def test_scores_and_curves_find_what_is_wrong_with_a_motion(engine):
    task = engine.task("push_box")
    middle = task.paths[0][len(task.paths[0]) // 2]
    through, away = Union((Sphere(as_point(middle), 0.1),)), Union((Sphere((2.0, 2.0, 2.0), 0.1),))
    perfect = scored(task.paths, task, task.paths[0][-1], away)
    assert perfect.frechet < 1e-3 and perfect.hand_depth == 0 and perfect.goal_error < 0.05
    assert scored(task.paths, task, task.paths[0][-1], through).hand_depth == pytest.approx(0.05, abs=2e-3)
    shifted = tuple(path + np.array([0, 0, 0.03]) for path in task.paths)
    assert scored(shifted, task, task.paths[0][-1], away).frechet == pytest.approx(0.03, abs=1e-3)
    ended = tuple(path[: len(path) // 2] for path in task.paths)
    assert scored(ended, task, task.paths[0][-1], away).goal_error > 0.1
    distance, depth = curves(shifted[0], task.paths[0], through).T
    assert distance.max() == pytest.approx(0.03, abs=1e-3) and 0 < depth.max() <= 0.05
    assert curves(task.paths[0], task.paths[0], Union())[:, 1].max() == 0


def test_what_an_edit_leaves_unchanged_is_not_planned_again(beside, monkeypatch):
    engine, scenario, _ = beside
    monkeypatch.setattr(type(engine.comparison), "_planned", lambda *_: pytest.fail("planned again"))
    *_, frame = engine.frames(replace(scenario, arm_rollout=2))
    assert by_name(frame)[SLOW].rollout == 2
    *_, frame = engine.frames(shown(scenario, SLOW))
    assert list(by_name(frame)) == ["ours", SLOW]


def test_without_a_motion_of_ours_the_others_are_shown_all_the_same(engine):
    base = Sphere((0.0, 0.0, 0.2), 0.4)
    *_, frame = engine.frames(shown(changed(Scenario("push_box"), obstacles=(base,), space="cspace"), LIVE))
    found = by_name(frame)
    assert frame.blocked and found["ours"].note and not found["ours"].paths
    assert found[LIVE].paths and found[LIVE].scores.arm_depth > 0.01


def test_their_arm_runs_along_their_motion(engine, initial, robot):
    *_, frame = engine.frames(shown(initial("push_box"), LIVE, "modulation", their_arm="modulation"))
    found = by_name(frame)
    assert found[LIVE].arm is None and found["ours"].arm is None
    theirs = found["modulation"]
    path = theirs.paths[theirs.rollout]
    hand = robot.end_effector(theirs.arm.q)
    assert max(np.linalg.norm(path - place, axis=1).min() for place in hand) < 5e-3
    assert (np.diff(theirs.arm.times) > 0).all()


@pytest.mark.parametrize("why", ["of another task", "needs x_y_z_not_there"])
def test_a_method_that_cannot_plan_says_why(new_engine, initial, monkeypatch, why):
    def fit(*_):
        raise NotFittedError(why)

    if why.startswith("needs"):
        monkeypatch.setitem(vars(METHODS["eflow"]), "needs", ("x_y_z_not_there",))
    else:
        monkeypatch.setitem(vars(METHODS["eflow"]), "fit", fit)
    *_, frame = new_engine().frames(shown(initial("push_box"), "eflow", LIVE))
    found = by_name(frame)
    assert why in found["eflow"].note and not found["eflow"].paths and found["eflow"].scores is None
    assert found[LIVE].scores.arm_depth is not None


def test_of_a_single_demonstration_by_the_user_what_can_be_fitted_is_and_the_rest_is_left_out(fits, robot):
    (demonstration, *_) = TASKS["draw_j"]().demonstrations
    own = TaskEntry("Mine", lambda: drawing_task("mine", "Mine", "", (demonstration,)))
    engine = Engine({"mine": own}, fits, robot)
    *_, frame = engine.frames(shown(avoiding("mine"), "eflow", "eflow-repulsive", "mpnet", LIVE, "modulation"))
    found = by_name(frame)
    assert list(found) == ["ours", LIVE, "modulation"]
    for compared in found.values():
        assert len(compared.paths) == 1 and not compared.note
    *_, frame = engine.frames(shown(avoiding("mine"), "eflow", "mpnet-rrt"))
    assert frame.comparison == ()


@pytest.mark.long
@pytest.mark.usefixtures("quick")
def test_interrupted_between_or_within_steps_it_goes_on_later(new_engine, initial):
    engine, scenario, frames = new_engine(), shown(initial("push_box"), LIVE, SLOW), []
    for patience in 2 ** np.arange(20):
        left = iter(range(patience))
        with suppress(UnwantedError):
            frames = list(engine.frames(scenario, cancelled=lambda left=left: next(left, None) is None))
            break
    assert frames, "never done"
    *_, alone = new_engine().frames(scenario)
    for name, compared in by_name(alone).items():
        assert by_name(frames[-1])[name].scores == compared.scores


@pytest.mark.parametrize("name", FIG_6_PLACES)
def test_figure_6_is_at_the_first_place_of_table_1(engine, name):
    (place,) = drawn(problem_of(engine.nominal(Scenario(name)).learned, engine.follower), 1, 0, 0)
    np.testing.assert_allclose(FIG_6_PLACES[name], place.sphere.position, atol=1e-4)
    assert place.sphere.diameter == Sphere.diameter


# --- The page ---


def test_the_table_tells_promises_and_marks_what_collides(beside):
    _, _, frames = beside
    comparison = frames[-1].comparison
    table = table_html(comparison)
    for compared in comparison:
        assert compared.method.title in table and compared.method.promise in table
    assert "color:light-dark" not in table  # nothing collides
    deep = replace(comparison[1], scores=replace(comparison[1].scores, hand_depth=0.012), note="<b>fails</b>")
    marked = table_html((comparison[0], deep))
    assert marked.count("color:light-dark") == 1 and ">12<" in marked and "&lt;b&gt;fails" in marked
    assert "–" in table_html(frames[1].comparison)  # not known yet


@pytest.fixture
def page(server, robot):
    page = Page(server, robot)
    yield page
    page.close()
    server.gui.reset()
    server.scene.reset()


@pytest.mark.usefixtures("quick")
def test_methods_are_ticked_in_the_order_of_the_tables_and_their_arm_with_them(page, beside):
    engine, scenario, _ = beside
    for label, value, compared, theirs in (
        ("Linear", True, ("linear",), ""),
        ("EFlow", True, ("eflow", "linear"), ""),
        ("EFlow", False, ("linear",), ""),
        ("Their arm", "Modulation", ("linear", "modulation"), "modulation"),
        ("Linear", False, ("modulation",), "modulation"),
        ("Modulation", False, (), ""),
        ("Their arm", "MPNet", ("mpnet",), "mpnet"),
    ):
        page.claim(page[label], value)
        assert (page.session.scenario.view.compared, page.session.scenario.view.their_arm) == (compared, theirs)
    drawn = page.visitor.robot
    assert not drawn.their_arm.node.visible
    *_, frame = engine.frames(shown(scenario, SLOW, their_arm=SLOW))
    drawn.draw(frame, Look())
    assert drawn.their_arm.node.visible


def test_what_is_not_installed_is_grey_with_the_command(server, monkeypatch):
    monkeypatch.setattr("dt_viz.baselines.base.find_spec", lambda _module: None)
    panel = ComparePanel(server.gui, Bindings(), lambda _suffix, _content: None)
    assert not panel.table.visible
    boxes = {box.label: box for box in server.gui._gui_input_handle_from_uuid.values() if hasattr(box, "label")}
    assert boxes["MPNet-RRT"].disabled and not boxes["Modulation"].disabled
    assert 'pip install "dt-viz[baselines]"' in hint(METHODS["mpnet-rrt"])
    server.gui.reset()


def test_methods_that_are_trained_in_advance_are_off_for_tasks_of_the_users_own(server, monkeypatch):
    monkeypatch.setattr("dt_viz.baselines.base.find_spec", lambda _module: True)
    bound, trained = Bindings(), {method.title for method in others() if method.weights}
    note = ComparePanel(server.gui, bound, lambda _suffix, _content: None).note
    handles = list(server.gui._gui_input_handle_from_uuid.values())
    boxes = {box.label: box for box in handles if getattr(box, "label", "") in {method.title for method in others()}}
    (their_arm,) = (handle for handle in handles if getattr(handle, "label", "") == "Their arm")
    view = View(compared=("eflow", "linear"), their_arm="eflow")
    for task, off in (("draw_s", set()), ("own_data_1", trained), ("draw_s", set())):
        bound.adopt(Scenario(task, view=view))
        assert {title for title, box in boxes.items() if box.disabled} == off
        assert {title for title, box in boxes.items() if box.value} == {"EFlow", "Linear"} - off
        assert not off & set(their_arm.options) and len(their_arm.options) == 1 + len(boxes) - len(off)
        assert their_arm.value == ("–" if off else "EFlow")
        assert note.visible == bool(off)
    assert "only for the shipped tasks" in note.content and all(title in note.content for title in trained)
    server.gui.reset()


def test_plots_have_a_curve_for_each_method_that_moves(server, beside):
    _, _, frames = beside
    panel = ComparePanel(server.gui, bound := Bindings(), lambda _suffix, _content: None)
    scenario, plots = frames[-1].scenario, [plot for each in panel.plots for plot in each.plots]
    bound.adopt(scenario)
    bound.report(frames[1])
    assert [len(plot.data) for plot in plots] == [3, 3, 2, 2]  # the slow one is not there yet; the window is hidden
    bound.report(frames[-1])
    assert [len(plot.data) for plot in plots] == [4, 4, 2, 2]
    bound.adopt(replace(scenario, view=replace(scenario.view, large_plots=True)))
    assert [len(plot.data) for plot in plots] == [len(plot.series) for plot in plots] == [4] * 4
    in_tab, in_window = (each.plots[1].data for each in panel.plots)
    np.testing.assert_array_equal(in_tab, in_window)
    named = [compared.method.title for compared in frames[-1].comparison]
    assert all(title in each.key.content for title in named for each in panel.plots)
    bound.report(replace(frames[-1], comparison=()))
    assert len(plots[-1].data) == 4
    server.gui.reset()


def test_motions_are_drawn_in_colours_of_their_own_with_names_apart(scene, beside):
    assert len({colour_of(method) for method in METHODS.values()}) == len(METHODS)
    _, scenario, frames = beside
    picture = ComparedMotions(scene)
    picture.draw(frames[-1], Look())
    assert list(picture.motions) == [METHODS[SLOW], METHODS[LIVE]]
    for method, motions in picture.motions.items():
        assert motions.node.visible
        for lines in (motions.followed, motions.others):
            np.testing.assert_array_equal(lines.node.colors, colour_of(method))
    apart = np.subtract(*(motions.label.position for motions in picture.motions.values()))
    assert np.linalg.norm(apart) > 0.8 * APART
    picture.draw(frame_of(scenario, rollouts=frames[-1].rollouts, goal=frames[-1].goal), Look())
    assert not any(motions.node.visible for motions in picture.motions.values())
