"""A session by its contract: the last picture belongs to the last scenario, and every edit can be taken back."""

import logging
import threading
import time
from dataclasses import dataclass, field, replace
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from scenes import avoiding, biases, changed, changing

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.passing import ANEW, Passing
from dt_viz.avoidance.registry import AVOIDANCE
from dt_viz.errors import end_if
from dt_viz.learning.demonstrations import DemonstrationError
from dt_viz.learning.imitation import ImitationError
from dt_viz.obstacles.shapes import Box, Sphere
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Scenario, View
from dt_viz.scenario.slices import SlicePose
from dt_viz.scenario.stack import IMITATION, with_added, without
from dt_viz.scenario.tasks import TASKS
from dt_viz.session import session as session_module
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.session.history import GESTURE_PAUSE, MAX_UNDO, Beside
from dt_viz.session.progress import READ
from dt_viz.session.session import Session
from dt_viz.warning import Severity

PATIENCE = 30.0


@dataclass(frozen=True)
class Sketch:
    """Stands in for a frame: what a session looks at, and what it was computed from."""

    scenario: Scenario
    stage: Stage
    passing: Passing = field(default_factory=Passing, compare=False)


class FakeEngine:
    """Computes at once; notes what it was asked for; fails on request; waits at a gate if there is one."""

    def __init__(self):
        self.asked = []
        self.begun, self.gate, self.queue = threading.Event(), None, None
        self.unlearned, self.learning = set(), threading.Event()
        self.seen, self.driven, self.drivers = [], [], set()
        self.endless, self.busy = None, threading.Event()

    def task(self, name):
        return SimpleNamespace(title=name)

    def title(self, name):
        return name

    def frames(self, scenario, progress, cancelled, newest, *, draw):
        self.begun.set()
        if self.queue is not None:
            assert self.queue.wait(PATIENCE)
            scenario = newest(scenario)
        self.asked.append(scenario)
        if self.gate is not None:
            assert self.gate.wait(PATIENCE)
        while scenario.task in self.unlearned:
            assert progress is not None
            progress(0.5, "half")
            self.learning.set()
            time.sleep(0.005)
        if scenario.task == "hopeless":
            raise ImitationError("they contradict each other")
        if scenario.avoidance.temperature == 13.0:
            raise DemonstrationError("unlucky.csv", "file", "13", "another")
        for stage in Stage:
            while stage is self.endless:
                self.busy.set()
                end_if(cancelled)
                time.sleep(0.001)
            if stage is Stage.LIVE and scenario.view.generator_layer == -9:
                raise IndexError("no such flow")
            frame = Sketch(scenario, stage)
            if stage <= Stage.LIVE:
                draw(frame)
            yield frame

    def see(self, scenario):
        self.seen.append(scenario)

    def drive(self, frame):
        self.driven.append(frame)
        self.drivers.add(threading.current_thread().name)


class Page:
    """A display that remembers."""

    def __init__(self):
        self.frames, self.paces, self.adopted = [], [], []
        self.errors, self.warnings = [], []
        self.progress = None

    def draw(self, frame, pace):
        self.frames.append(frame)
        self.paces.append(pace)

    def adopt(self, scenario):
        self.adopted.append(scenario)

    def tell(self, progress):
        before, self.progress = self.progress, progress
        message = progress.message
        if message is not None and (before is None or message is not before.message):
            {Severity.ALARM: self.errors, Severity.WARNING: self.warnings}[message.severity].append(message.text)


def fresh(task):
    if task == "broken":
        raise DemonstrationError("broken.csv", "lines", "none", "two or more")
    return avoiding(task, Sphere((0.1, 0.2, 0.3 if task == "draw_s" else 0.6)))


@dataclass
class Opened:
    session: Session
    engine: FakeEngine
    page: Page
    clock: list
    before: Scenario | None = None
    scene: Scenario | None = None

    def edit(self, gesture, **changes):
        self.session.edit(gesture, **changing(self.session.scenario, **changes))

    def settle(self):
        assert self.session.wait_idle(PATIENCE)

    @property
    def shown(self):
        return self.page.frames[-1].scenario


@pytest.fixture
def opened(monkeypatch):
    """A session that has shown its first picture, on a clock that only moves when told to."""
    clock = [100.0]
    monkeypatch.setattr(session_module.time, "monotonic", lambda: clock[0])
    monkeypatch.setattr(session_module, "REST", 0.0)
    engine, page = FakeEngine(), Page()
    session = Session(cast(Engine, engine), lambda _engine, task: fresh(task), "draw_s", page)
    result = Opened(session, engine, page, clock)
    result.settle()
    yield result
    session.close()


@pytest.fixture
def in_scene(opened):
    """The same, after a scene was loaded."""
    task = TASKS["draw_s"]()
    opened.engine.task = lambda name: task
    opened.session.edit("view", view=View(grid=True, speed=2.0, colour="det"))
    opened.before = opened.session.scenario
    opened.scene = SCENES["cloud"].scenario(task)
    opened.session.load("draw_s", SCENES["cloud"].scenario)
    return opened


class TestPassing:
    """Sides on which motions pass obstacles belong to the scenario: decided when it is computed, undone with it."""

    def test_motions_go_on_from_those_that_are_shown_and_a_view_keeps_what_is_decided(self, opened):
        assert opened.shown.passing is ANEW
        shown = opened.page.frames[-1].passing
        opened.edit("drag", obstacles=at(0.1))
        opened.settle()
        assert opened.shown.passing is opened.session.scenario.passing is shown
        opened.session.edit("view", view=View(grid=True))
        opened.settle()
        assert opened.shown.view.grid and opened.shown.passing is shown
        opened.session.edit("warp", warp=0.5)
        opened.settle()
        assert opened.shown.warp == 0.5 and opened.shown.passing is shown

    def test_undo_and_redo_bring_them_back(self, opened):
        decided = [opened.session.scenario.passing]
        for x in (0.1, 0.2, 0.3):
            opened.edit(f"drag {x}", obstacles=at(x))
            opened.settle()
            decided.append(opened.shown.passing)
        assert len(set(map(id, decided))) == 4
        for passing in decided[-2::-1]:
            opened.session.undo()
            opened.settle()
            assert opened.shown.passing is passing
        for passing in decided[1:]:
            opened.session.redo()
            opened.settle()
            assert opened.shown.passing is passing

    @pytest.mark.parametrize("begin", ["reset", "task", "imitation", "load"])
    def test_another_motion_and_a_beginning_choose_anew(self, opened, begin):
        opened.engine.task = lambda name: TASKS[name]()
        opened.edit("drag", obstacles=at(0.1))
        opened.settle()
        assert opened.shown.passing is not ANEW
        if begin == "reset":
            opened.session.reset()
        elif begin == "task":
            opened.session.choose_task("draw_j")
        elif begin == "load":
            opened.session.load("draw_s", lambda _: replace(fresh("draw_s"), passing=Passing(duration=1.0)))
        else:
            opened.session.edit("imitation", imitation=False)
        opened.settle()
        assert opened.shown.passing is ANEW is opened.session.scenario.passing

    def test_what_is_decided_reaches_a_scenario_whose_view_was_changed_meanwhile(self, opened):
        opened.engine.gate = threading.Event()
        opened.engine.begun.clear()
        opened.edit("drag", obstacles=at(0.1))
        assert opened.engine.begun.wait(PATIENCE)
        opened.edit("drag", obstacles=at(0.2))  # waits for the worker
        opened.session.edit("view", view=replace(opened.session.scenario.view, speed=2.0))  # needs no computation
        assert opened.session.scenario.passing is None
        opened.engine.gate.set()
        opened.settle()
        assert opened.session.scenario.view.speed == 2.0
        assert opened.session.scenario.passing is opened.shown.passing is not None


def at(x):
    return Sphere((x, 0.0, 0.0))


def test_a_session_begins_with_its_task_and_an_edit_is_adopted_computed_and_shown(opened):
    assert opened.page.adopted == [fresh("draw_s")] == [opened.session.scenario]
    assert opened.page.frames == [Sketch(fresh("draw_s"), stage) for stage in Stage]
    opened.edit("obstacle", obstacles=(at(1.0),))
    opened.settle()
    edited = changed(fresh("draw_s"), obstacles=(at(1.0),))
    assert opened.session.scenario == opened.page.adopted[-1] == opened.shown == edited
    assert opened.page.frames[-1].stage is max(Stage)
    assert all(pace.latency >= 0 for pace in opened.page.paces)
    shown = zip(opened.page.frames, opened.page.paces, strict=True)
    assert min(pace.rate for frame, pace in shown if frame.stage is Stage.LIVE) >= 1


def test_an_edit_that_changes_nothing_does_nothing(opened):
    before = (len(opened.engine.asked), len(opened.page.adopted))
    opened.edit("obstacle", obstacles=opened.session.scenario.obstacles)
    opened.settle()
    assert (len(opened.engine.asked), len(opened.page.adopted)) == before
    opened.session.undo()
    assert opened.session.scenario == fresh("draw_s")


@pytest.mark.parametrize("layer", ["ghost", "ghost_arm", "onion", "body_points", "joint_plots", "grid"])
def test_only_a_view_of_what_is_not_there_is_computed_and_all_are_adopted(opened, layer):
    asked, view = len(opened.engine.asked), replace(View(), **{layer: not getattr(View(), layer)})
    for other in (view, View(), replace(View(), generator_layer=2)):
        opened.edit(layer, view=other)
        opened.settle()
        assert opened.page.adopted[-1].view == opened.session.scenario.view == other
        assert len(opened.engine.asked) == asked + (layer == "grid")


@pytest.mark.parametrize("held", [False, True], ids=["a slider", "a drag, however slow"])
def test_one_gesture_is_one_step_of_undo(opened, held):
    if held:
        opened.session.begin_gesture()
    for x in np.linspace(0, 1, 20):
        opened.clock[0] += 10 * GESTURE_PAUSE if held else 0.05
        opened.edit("obstacle", obstacles=(at(x),))
    opened.session.end_gesture()
    opened.edit("obstacle", obstacles=(at(9.0),))
    opened.session.undo()
    assert opened.session.scenario.obstacles[0] == at(1.0)
    opened.session.undo()
    assert opened.session.scenario == fresh("draw_s")
    opened.session.redo()
    assert opened.session.scenario.obstacles[0] == at(1.0)


@pytest.mark.parametrize("ending", ["let go", "pause", "another control"])
def test_the_next_gesture_is_a_step_of_its_own(opened, ending):
    opened.edit("obstacle", obstacles=(at(1.0),))
    if ending == "let go":
        opened.session.end_gesture()
    if ending == "pause":
        opened.clock[0] += 1.1
    if ending == "another control":
        opened.edit("temperature", temperature=2.0)
    middle = opened.session.scenario
    opened.edit("obstacle", obstacles=(at(2.0),))
    opened.session.undo()
    assert opened.session.scenario == middle


def test_undo_and_redo_are_inverse_and_shown_until_a_new_edit(opened):
    states = [opened.session.scenario]
    for step in range(5):
        opened.edit(f"control {step}", temperature=2.0 + step)
        states.append(opened.session.scenario)
    for move, expected in (
        *((opened.session.undo, state) for state in (*reversed(states[:-1]), states[0])),
        *((opened.session.redo, state) for state in (*states[1:], states[-1])),
    ):
        move()
        opened.settle()
        assert opened.session.scenario == opened.shown == opened.page.adopted[-1] == expected
    opened.session.undo()
    opened.edit("another", temperature=1.5)
    edited = opened.session.scenario
    opened.session.redo()
    assert opened.session.scenario == edited
    opened.session.undo()
    assert opened.session.scenario == states[-2]


def test_history_does_not_grow_without_end(opened):
    for step in range(MAX_UNDO + 50):
        opened.edit(f"control {step}", temperature=20.0 + step)
    for _ in range(MAX_UNDO + 50):
        opened.session.undo()
    assert opened.session.scenario.avoidance.temperature == 20.0 + 49


def test_what_is_open_beside_the_scenario_is_undone_in_its_place(opened):
    session, told = opened.session, []
    opened.edit("drag", obstacles=at(0.1))
    before = session.scenario
    session.put_beside(Beside((False, True), lambda: told.append("undo"), lambda: told.append("redo")))
    session.undo()
    session.redo()
    assert told == ["undo", "redo"] and session.scenario == before
    assert (opened.page.progress.beside, opened.page.progress.steps) == ((False, True), (True, False))
    session.put_beside(None)
    session.undo()
    assert session.scenario != before and opened.page.progress.beside is None


def test_reset_goes_back_to_the_beginning_and_how_it_was_seen_and_all_of_it_can_be_undone(opened):
    opened.edit("ghost", view=View(ghost=False, playing=False, health_plots=True))
    opened.edit("a", temperature=2.0, obstacles=(at(1.0),), generator="probability")
    changed = opened.session.scenario
    opened.session.reset()
    opened.settle()
    assert opened.session.scenario == opened.shown == fresh("draw_s")
    opened.session.undo()
    assert opened.session.scenario == changed
    opened.session.redo()
    assert opened.session.scenario == fresh("draw_s")


def test_another_task_brings_its_place_and_its_slice_and_keeps_other_choices(opened):
    session, pose = opened.session, SlicePose((0.1, -0.4, 0.5), (0.6, 0.8, 0.0, 0.0))
    opened.edit("size", obstacles=(Sphere((0.0, 0.0, 0.0), 0.22),), temperature=3.0)
    session.edit("slice", view=replace(session.scenario.view, slice=pose))
    before = session.scenario
    session.choose_task("lift_box")
    opened.settle()
    scenario = session.scenario
    assert (scenario.task, scenario.avoidance.temperature, scenario.view.slice) == ("lift_box", 3.0, None)
    assert scenario.obstacles == (Sphere(fresh("lift_box").obstacles[0].position, 0.22),)
    assert opened.shown == scenario
    session.undo()
    assert session.scenario == before
    session.redo()
    assert session.scenario == scenario
    session.choose_task("lift_box")
    assert session.scenario == scenario  # the same one changes nothing


def test_another_task_begins_with_its_own_obstacle_in_the_shape_of_the_first_and_without_layers(opened):
    box = Box((0.0, 0.0, 0.0), (0.1, 0.2, 0.1), (0.6, 0.8, 0.0, 0.0))
    for obstacles in ((box,), (box, at(1.0), at(2.0))):
        opened.edit("shapes", obstacles=obstacles)
        opened.session.choose_task("lift_box")
        assert opened.session.scenario.obstacles == (replace(box, position=fresh("lift_box").obstacles[0].position),)
        opened.session.undo()
        assert opened.session.scenario.obstacles == obstacles
    opened.edit("shapes", obstacles=())
    opened.session.choose_task("lift_box")
    assert opened.session.scenario.obstacles == ()
    opened.session.choose_task("draw_s")
    opened.session.reset()
    opened.edit("scene", layers=biases(BiasPoint((0.2, -0.5, 0.4))), level=0, temperature=8.0)
    opened.session.choose_task("lift_box")
    assert opened.session.scenario == changed(fresh("lift_box"), temperature=8.0)
    opened.edit("scene", obstacles=(), space="cspace", scene="somewhere")
    opened.session.choose_task("draw_s")
    assert opened.session.scenario == fresh("draw_s")


def test_a_task_that_cannot_be_read_is_refused_and_the_session_stays(opened):
    with pytest.raises(DemonstrationError, match=r"broken\.csv"):
        opened.session.choose_task("broken")
    assert opened.session.scenario == fresh("draw_s")
    opened.edit("obstacle", obstacles=(at(1.0),))
    opened.settle()
    assert opened.shown.obstacles[0] == at(1.0)


def test_a_drag_whose_end_is_lost_ends_with_the_next_control(opened):
    opened.session.begin_gesture()
    opened.edit("obstacle", obstacles=(at(1.0),))
    for margin in (0.02, 0.03):
        opened.clock[0] += 2 * GESTURE_PAUSE
        opened.edit("margin", margin=margin)
    opened.session.undo()
    assert opened.session.scenario.avoidance.margin == 0.02
    opened.session.undo()
    assert opened.session.scenario == changed(fresh("draw_s"), obstacles=(at(1.0),))


def test_an_error_is_shown_once_and_the_session_goes_on(opened, caplog):
    with caplog.at_level(logging.CRITICAL):
        opened.edit("temperature", temperature=13.0)
        opened.settle()
    assert opened.page.errors == ["unlucky.csv: file: found 13; accepted: another"]
    opened.edit("temperature", temperature=5.0)
    opened.settle()
    assert opened.shown.avoidance.temperature == 5.0
    assert len(opened.page.errors) == 1


def test_a_message_stays_until_another_scenario_is_shown_and_passes_but_for_what_has_failed(opened):
    opened.session.fail(ValueError("it fails"))
    assert opened.page.progress.failed
    opened.session.undo()  # nothing to undo
    assert opened.page.progress.message.text == "ValueError: it fails"
    opened.edit("temperature", temperature=3.0)
    opened.settle()
    progress = opened.page.progress
    assert progress.message is None and not progress.failed and progress.complete and not progress.stale

    def text(after):
        opened.clock[0] += after
        opened.session.let_pass()
        return None if opened.page.progress.message is None else opened.page.progress.message.text

    opened.session.say("places left out", Severity.WARNING)
    assert text(READ - 1) == "places left out"
    assert text(1) is None
    opened.session.fail(ValueError("it fails"))
    assert text(2 * READ) == "ValueError: it fails"


def test_what_is_shown_is_stale_while_another_task_is_expected_read_or_learned(opened):
    assert opened.page.progress.complete
    for expected in (True, False):
        opened.session.expect(expected)
        assert opened.page.progress.stale == expected != opened.page.progress.complete
    opened.engine.gate = threading.Event()
    opened.session.choose_task("lift_box")
    assert opened.page.progress.stale
    opened.engine.gate.set()
    opened.settle()
    assert not opened.page.progress.stale
    before = opened.page.paces[-1].latency
    begin_learning(opened, "push_box")
    assert opened.page.progress.stale
    opened.engine.unlearned = set()
    opened.settle()
    assert opened.page.progress.complete and opened.page.progress.learning is None
    assert opened.page.paces[-1].latency == before  # to learn is not to rebuild


UNDRAWABLE = View(generator=True, generator_layer=-9, health_plots=True)


@pytest.mark.parametrize("meanwhile", [False, True])
def test_after_a_picture_that_failed_or_is_failing_any_choice_that_can_be_drawn_is(opened, caplog, meanwhile):
    """Also one that needs nothing but what was asked for before, and did not come."""
    opened.engine.gate = threading.Event()
    opened.engine.begun.clear()
    with caplog.at_level(logging.CRITICAL):
        opened.edit("view", view=UNDRAWABLE)
        assert opened.engine.begun.wait(PATIENCE)
        if not meanwhile:
            opened.engine.gate.set()
            opened.settle()
        opened.page.frames.clear()
        opened.edit("view", view=View())
        opened.engine.gate.set()
        opened.settle()
    assert opened.page.frames[-1] == Sketch(opened.session.scenario, Stage.CERTIFIED)


@pytest.mark.parametrize("stage", [Stage.ROLLOUTS, Stage.LIVE])
def test_a_session_that_closes_ends_what_it_computes_for_a_hand(opened, stage):
    opened.engine.endless = stage
    opened.edit("obstacle", obstacles=(at(1.0),))
    assert opened.engine.busy.wait(PATIENCE)
    opened.edit("obstacle", obstacles=(at(2.0),))
    assert not opened.session.wait_idle(0.2)  # a newer edit ends nothing that follows a hand
    opened.session.close()
    assert opened.session.jobs.wait_idle(timeout=PATIENCE)
    assert opened.page.errors == []


def test_edits_during_a_computation_are_overtaken_by_the_last(opened):
    opened.engine.begun.clear()
    opened.engine.gate = threading.Event()
    opened.edit("obstacle", obstacles=(at(0.0),))
    assert opened.engine.begun.wait(PATIENCE)
    for x in range(1, 8):
        opened.edit("obstacle", obstacles=(at(float(x)),))
    opened.engine.gate.set()
    opened.settle()
    assert [scenario.obstacles[0].position[0] for scenario in opened.engine.asked[1:]] == [0.0, 7.0]
    stages = [frame.stage for frame in opened.page.frames if frame.scenario.obstacles[0] == at(0.0)]
    # something is shown while dragging, field and arm unless they were drawn a moment ago; refined is only what rests
    assert stages in ([Stage.ROLLOUTS], [Stage.ROLLOUTS, Stage.LIVE])
    assert opened.page.paces[-1].num_skipped == 6


@pytest.mark.parametrize(
    "change", [{}, {"task": "draw_j"}, {"view": View(grid=True)}, {"warp": 0.5}], ids=["a drag", "task", "view", "warp"]
)
def test_the_newest_of_a_drag_is_computed_when_its_turn_comes_and_another_choice_waits_for_its_own(opened, change):
    opened.engine.begun.clear()
    opened.engine.queue = threading.Event()
    opened.edit("obstacle", obstacles=(at(0.0),))
    assert opened.engine.begun.wait(PATIENCE)
    for x in () if change else range(1, 8):
        opened.edit("obstacle", obstacles=(at(float(x)),))
    if change:
        opened.session.edit("another", **change)
    opened.engine.queue.set()
    opened.settle()
    asked = opened.engine.asked[1:]
    assert [scenario.obstacles[0] for scenario in asked] == [at(0.0)] * 2 if change else [at(7.0)]
    for scenario in asked:
        wanted = scenario is asked[-1]
        assert all((getattr(scenario, name) == to) == wanted for name, to in change.items())
    assert opened.shown == opened.session.scenario and opened.session.scenario.passing is not None


@pytest.mark.parametrize("seed", range(3))
def test_after_a_storm_from_several_threads_the_last_picture_is_that_of_the_last_scenario(opened, seed):
    plans = np.random.default_rng(seed)
    seeds = plans.integers(0, 2**32, 4)

    def storm(own_seed):
        rng = np.random.default_rng(own_seed)
        for _ in range(150):
            what = rng.integers(0, 7)
            if what <= 2:
                opened.edit("obstacle", obstacles=(at(float(rng.normal())),))
            elif what == 3:
                opened.edit("temperature", temperature=float(rng.uniform(1, 12)))
            elif what == 4:
                opened.session.undo()
            elif what == 5:
                opened.session.redo()
            else:
                opened.session.choose_task(str(rng.choice(["draw_s", "lift_box"])))

    threads = [threading.Thread(target=storm, args=(own,)) for own in seeds]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(PATIENCE)
    opened.settle()
    assert opened.page.errors == []
    assert opened.shown == opened.page.adopted[-1] == opened.session.scenario
    assert opened.page.frames[-1].stage is max(Stage)
    # frames come in the order of their computations, each computation's in the order of its stages; the first stage is
    # left out where the computation before was of the same motion
    last = [frame for frame in opened.page.frames if frame.scenario == opened.session.scenario][1 - len(Stage) :]
    assert [frame.stage for frame in last] == list(Stage)[1:]


def test_what_the_controls_show_last_is_the_last_scenario_also_from_several_threads(opened):
    """A slower page: controls must not end on a scenario that another thread has replaced meanwhile."""
    inside, release = threading.Event(), threading.Event()
    original = opened.page.adopt

    def slow_first(scenario):
        if scenario.obstacles[0] == at(1.0):
            inside.set()
            release.wait(1.0)
        original(scenario)

    opened.page.adopt = slow_first
    thread = threading.Thread(target=opened.edit, args=("obstacle",), kwargs={"obstacles": (at(1.0),)})
    thread.start()
    assert inside.wait(PATIENCE)
    second = threading.Thread(target=opened.edit, args=("obstacle",), kwargs={"obstacles": (at(2.0),)})
    second.start()
    second.join(0.2)
    release.set()
    thread.join(PATIENCE)
    second.join(PATIENCE)
    assert opened.page.adopted[-1] == opened.session.scenario


def begin_learning(opened, task="lift_box"):
    opened.engine.unlearned = {task}
    opened.session.choose_task(task)
    assert opened.engine.learning.wait(PATIENCE)


def test_cancelling_goes_back_to_what_was_shown_and_the_task_can_be_chosen_again(opened):
    opened.edit("obstacle", obstacles=(at(1.0),))
    opened.settle()
    before = opened.session.scenario
    opened.session.cancel()  # nothing is learned: there is nothing to cancel
    opened.settle()
    assert opened.session.scenario == before and opened.page.warnings == []
    begin_learning(opened)
    opened.session.cancel()
    opened.settle()
    assert opened.session.scenario == opened.shown == opened.page.adopted[-1] == before
    assert opened.page.warnings == ["Learning “lift_box” was cancelled. This is “draw_s” as before."]
    assert opened.page.errors == [] and opened.page.progress.learning is None
    opened.session.undo()  # as if the other task had never been chosen
    assert opened.session.scenario == fresh("draw_s")
    opened.engine.unlearned = set()
    opened.session.choose_task("lift_box")
    opened.settle()
    assert opened.shown.task == "lift_box"


def test_cancelling_keeps_the_view_and_forgets_what_was_edited_meanwhile(opened):
    begin_learning(opened)
    opened.edit("ghost", view=View(ghost=False))
    opened.edit("obstacle", obstacles=(at(2.0),))
    opened.session.cancel()
    opened.settle()
    assert opened.session.scenario == opened.shown == replace(fresh("draw_s"), view=View(ghost=False))


@pytest.mark.parametrize(
    ("choose", "task"),
    [
        (lambda session: session.choose_task("pots"), "pots"),
        (lambda session: session.undo(), "draw_s"),
        (lambda session: session.close(), "draw_s"),
    ],
    ids=["another task", "undo", "leaving"],
)
def test_another_choice_supersedes_learning_and_leaving_ends_it(opened, choose, task):
    begin_learning(opened)
    choose(opened.session)
    opened.settle()
    assert opened.shown.task == task and opened.page.errors == opened.page.warnings == []


def test_moving_the_obstacle_does_not_begin_learning_anew(opened):
    begin_learning(opened)
    for x in range(5):
        opened.edit("obstacle", obstacles=(at(float(x)),))
    opened.engine.learning.clear()
    assert opened.engine.learning.wait(PATIENCE)
    assert [scenario.task for scenario in opened.engine.asked].count("lift_box") == 1
    opened.engine.unlearned = set()
    opened.settle()
    assert opened.shown.obstacles[0] == at(4.0)


def test_the_first_task_can_be_cancelled_too_and_any_edit_begins_again():
    engine, page = FakeEngine(), Page()
    engine.unlearned = {"draw_s"}
    session = Session(cast(Engine, engine), lambda _engine, task: fresh(task), "draw_s", page)
    try:
        assert engine.learning.wait(PATIENCE)
        session.cancel()
        assert session.wait_idle(PATIENCE)
        (said,) = page.warnings
        assert said.startswith("Learning “draw_s” was cancelled. Choose another") and page.frames == []
        engine.unlearned = set()
        session.edit("obstacle", **changing(session.scenario, obstacles=(at(1.0),)))
        assert session.wait_idle(PATIENCE)
        assert page.frames[-1].scenario.obstacles[0] == at(1.0)
    finally:
        session.close()


def test_a_task_that_cannot_be_learned_leaves_the_picture_and_the_choice_before_it(opened, caplog):
    with caplog.at_level(logging.CRITICAL):
        opened.session.choose_task("hopeless")
        opened.settle()
    assert opened.page.errors == ["they contradict each other"]
    assert opened.session.scenario == opened.shown == opened.page.adopted[-1] == fresh("draw_s")


def test_a_scene_is_seen_as_it_wants_undo_brings_back_what_was_seen_before_and_reset_the_scene(in_scene):
    session, scene = in_scene.session, in_scene.scene
    in_scene.settle()
    assert in_scene.shown == replace(scene, view=replace(scene.view, speed=2.0))
    assert not scene.view.grid and scene.view.colour == "occupancy"
    session.undo()
    assert session.scenario == in_scene.before
    session.redo()
    loaded = session.scenario
    assert loaded.view == replace(scene.view, speed=2.0)
    in_scene.edit("size", obstacles=(at(1.0),), temperature=2.0)
    session.edit("view", view=View(grid=True))
    edited = session.scenario
    session.reset()
    assert session.scenario == replace(loaded, view=replace(loaded.view, speed=1.0))
    session.undo()
    assert session.scenario.choices == edited.choices


@pytest.mark.parametrize("leave", ["leave_scene", "choose_task"])
def test_a_scene_that_is_left_leaves_nothing_of_what_it_shows(in_scene, leave):
    session = in_scene.session
    for _ in range(2):  # left already, it stays left
        if leave == "leave_scene":
            session.leave_scene()
        else:
            session.choose_task("lift_box")
        left = fresh("draw_s" if leave == "leave_scene" else "lift_box")
        assert session.scenario == replace(left, view=replace(left.view, speed=2.0))
    session.undo()
    assert session.scenario.view.colour == "occupancy"


def test_moving_the_slice_is_a_step_for_undo(opened):
    session, poses = opened.session, [SlicePose((0.1 * k, -0.4, 0.5), (0.6, 0.8, 0.0, 0.0)) for k in range(3)]
    opened.edit("temperature", temperature=2.0)
    for first, second in ((poses[0], poses[1]), (poses[1], poses[2])):
        session.begin_gesture()
        for pose in (first, second):
            session.edit("slice", view=replace(session.scenario.view, slice=pose))
        session.end_gesture()
    session.edit("view", view=replace(session.scenario.view, grid=True))  # is none
    for expected in (poses[1], None):
        session.undo()
        assert session.scenario.view.slice == expected and session.scenario.view.grid
        assert session.scenario.avoidance.temperature == 2.0
    session.undo()
    assert session.scenario.avoidance.temperature != 2.0
    for _ in range(3):
        session.redo()
    assert session.scenario.view.slice == poses[2]
    session.reset()
    assert session.scenario.view.slice is None and not session.scenario.view.grid


# --- Levels of the stack ---


@pytest.mark.parametrize("back", ["delete", "undo"])
def test_a_level_that_is_gone_is_not_looked_at_when_another_gets_its_name(opened, back):
    session = opened.session
    stack, _ = with_added(session.scenario, BiasPoint((0.2, -0.5, 0.4)))
    session.edit("add", stack=stack)
    session.end_gesture()
    for level in (IMITATION, AVOIDANCE.title, "Bias 1"):
        session.edit("see", view=View(level=level))
        assert session.scenario.view.level == level
    if back == "undo":
        session.undo()
    else:
        session.edit("delete", stack=without(session.scenario, "Bias 1"))
        session.end_gesture()
    assert session.scenario.view.level == ""
    session.edit("add", stack=stack)
    opened.settle()
    assert opened.shown.stack == stack and opened.shown.view.level == ""


# --- The arm in the loop ---


def test_the_arm_is_driven_by_the_first_frame_of_each_motion_and_by_the_refined_one(opened):
    driven = opened.engine.driven
    assert [frame.stage for frame in driven] == [Stage.ROLLOUTS, Stage.FINE]
    opened.edit("obstacle", obstacles=(at(1.0),))
    opened.settle()
    assert [(frame.stage, frame.scenario) for frame in driven[2:]] == [
        (stage, opened.session.scenario) for stage in (Stage.ROLLOUTS, Stage.FINE)
    ]
    assert opened.engine.drivers == {"session"} and opened.engine.seen[-1] == opened.session.scenario
    opened.edit("grid", view=View(grid=True))  # the same motion: it was there before
    opened.settle()
    assert [frame.stage for frame in driven[4:]] == [Stage.FINE]
