"""Another arm in place: chosen, loaded by a process of its own, with all that is there; or one line why not."""

import json
import sys
import threading
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from arm_files import urdf, write
from other_arms import shorter
from pages import NoFrames
from scenes import avoiding

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.errors import UnwantedError
from dt_viz.memo import Memo
from dt_viz.obstacles.shapes import Box, Cylinder, Sphere
from dt_viz.robot import making, models
from dt_viz.robot.models import ARMS, NotStoredError, load_arm
from dt_viz.robot.placement import follows, is_jaco, resampled
from dt_viz.robot.urdf import ArmError
from dt_viz.scenario.paper_scenes import SCENES, offered
from dt_viz.scenario.relocation import Relocation, relocated
from dt_viz.scenario.scenario import Layer, Scenario, Start
from dt_viz.scenario.slices import SlicePose
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry
from dt_viz.session.arms import ArmStore, Engines
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from dt_viz.session.session import CHOICES, Session
from dt_viz.session.tasks_in_reach import in_reach

PATIENCE = 30.0


class Sketch:
    """A frame with nothing in it."""

    def __init__(self, scenario, stage):
        self.scenario, self.stage, self.passing = scenario, stage, None


class Sketches(NoFrames):
    """An engine whose frames are empty."""

    def __init__(self, robot, tasks=TASKS):
        super().__init__(robot)
        self.tasks, self.seen = tasks, []

    def task(self, name):
        return self.own[name][0] if name in self.own else self.tasks[name]()

    def see(self, scenario):
        self.seen.append(scenario.arm)

    def drive(self, frame):
        pass

    def frames(self, *what, draw):
        for stage in Stage:
            frame = Sketch(what[0], stage)
            if stage <= Stage.LIVE:
                draw(frame)
            yield frame


class Display:
    def __init__(self):
        self.shown, self.said, self.told = [], [], []

    def draw(self, frame, _pace):
        self.shown.append(frame.scenario)

    def adopt(self, _scenario):
        pass

    def tell(self, progress):
        self.told += [progress.learning] if progress.learning else []
        if progress.message is not None and progress.message.text not in self.said:
            self.said.append(progress.message.text)


def smaller(name):
    """A task as it is placed for an arm of half the size."""
    return replace(TASKS[name], load=lambda: TASKS[name]().placed(0.5, (0.1, -0.05, 0.0)))


@pytest.fixture
def opened(robot):
    """A session that can choose a small arm, one that cannot be loaded, and one that takes its time."""
    loading, gate = threading.Event(), threading.Event()

    def new(name, progress):
        if name == "broken":
            raise ArmError("broken.urdf", "mesh", "nothing", "a file")
        while name == "slow" and not gate.is_set():
            loading.set()
            progress(0.3, "covering the links with spheres")
        return engines[name]

    other = replace(robot, name="other")
    engines: Any = {"": Sketches(robot), "small": Sketches(other, {name: smaller(name) for name in TASKS})}
    engines["slow"] = engines["small"]
    display = Display()
    fresh = lambda engine, task: avoiding(task, Sphere(engine.task(task).obstacle_position))  # noqa: E731
    session = Session(engines[""], fresh, "draw_s", cast(Any, display), new)
    session.wait_idle(PATIENCE)
    yield session, display, engines, loading
    gate.set()
    session.close()
    session.jobs.wait_idle(timeout=PATIENCE)


def choose(session, name):
    session.jobs.submit(CHOICES, lambda: session.choose_arm(name), latest=True)
    assert session.jobs.wait_idle(CHOICES, PATIENCE) and session.wait_idle(PATIENCE)


class TestChoosing:
    def test_all_that_is_there_goes_along_is_undone_and_done_again(self, opened):
        session, display, engines, _ = opened
        start, bias = (0.1, -0.5, 0.4), BiasPoint((0.05, -0.5, 0.4), radius=0.1)
        session.step("test", starts=(Start(start),), stack=(*session.scenario.stack, Layer(bias, name="Bias 1")))
        before = session.scenario
        choose(session, "small")
        now = session.scenario
        assert now.arm == "small" and now == display.shown[-1] and engines["small"].seen[-1] == "small"
        assert session.engine is engines["small"] and session.robot.name == "other"
        assert now.starts[0].place == pytest.approx(0.5 * np.array(start) + (0.1, -0.05, 0.0))
        assert now.obstacles[0].position == pytest.approx(engines["small"].task("draw_s").obstacle_position)
        assert now.obstacles[0].diameter == pytest.approx(before.obstacles[0].diameter / 2)
        there = now.stack[-1].transform
        assert (there.radius, there.position) == (0.05, pytest.approx((0.125, -0.3, 0.2)))
        session.undo()
        assert session.scenario == before and session.wait_idle(PATIENCE) and session.engine is engines[""]
        session.redo()
        assert session.scenario == now and session.wait_idle(PATIENCE) and display.shown[-1] == now
        choose(session, "")
        back = session.scenario
        assert back.starts == before.starts and back.stack[-1] == before.stack[-1]
        assert back.obstacles[0].position == pytest.approx(before.obstacles[0].position, abs=1e-6)

    def test_a_task_and_reset_keep_the_arm(self, opened):
        session, _, engines, _ = opened
        choose(session, "small")
        session.choose_task("draw_c")
        assert session.scenario.arm == "small"
        session.edit("test", stack=())
        session.reset()
        assert session.scenario.arm == "small"
        assert session.scenario.obstacles[0].position == engines["small"].task("draw_c").obstacle_position

    def test_what_is_out_of_reach_is_left_out_with_a_line(self, opened):
        session, display, _, _ = opened
        session.step("test", starts=(Start((0.1, -0.5, 0.4)), Start((0.0, -0.5, -0.2)), Start((0.0, -5.0, 0.4))))
        choose(session, "small")
        assert len(session.scenario.starts) == 1
        assert display.said == ["Out of reach of the JACO, and left out: start 2, start 3."]

    def test_one_that_cannot_be_loaded_gives_a_line_and_the_old_one_stays(self, opened):
        session, display, engines, _ = opened
        before = session.scenario
        choose(session, "broken")
        assert session.scenario is before and session.engine is engines[""]
        assert display.said == ["broken.urdf: mesh: found nothing; accepted: a file"]
        choose(session, "small")
        assert session.scenario.arm == "small"

    @pytest.mark.parametrize("by", ["cancel", "another"])
    def test_loading_shows_progress_and_ends_when_it_is_cancelled(self, opened, by):
        session, display, _, loading = opened
        session.jobs.submit(CHOICES, lambda: session.choose_arm("slow"), latest=True)
        assert loading.wait(PATIENCE)
        session.cancel() if by == "cancel" else choose(session, "small")
        assert session.jobs.wait_idle(CHOICES, PATIENCE) and session.wait_idle(PATIENCE)
        assert session.scenario.arm == ("" if by == "cancel" else "small")
        assert (0.3, "Loading the arm: covering the links with spheres") in display.told
        assert session._screen.progress.learning is None

    def test_a_scene_begins_anew_with_an_arm_that_has_it_unless_it_was_changed(self, opened):
        session, _, engines, _ = opened
        session.load("draw_s", SCENES["steps"].scenario)
        choose(session, "small")
        after = engines["small"].task("draw_s")
        assert session.scenario.scene == "steps" and not SCENES["steps"].is_changed(session.scenario, after)
        session.load("push_box", SCENES["others_push"].scenario)
        session.choose_arm("")
        assert session.scenario.scene == "others_push"

    def test_what_is_learned_and_passed_belongs_to_an_arm(self):
        one = Scenario("draw_s")
        other = replace(one, arm="panda")
        assert (one.fit, one.learned, one.full) != (other.fit, other.learned, other.full)
        assert one.fit != other.fit and one.learned != other.learned and not one.begins_like(other)

    def test_own_tasks_are_those_of_every_arm_also_of_one_that_is_chosen_later(self, opened):
        session, display, engines, _ = opened
        session.choose_arm("small")
        own = session.bring(TASKS["draw_c"]())
        assert session.engine.task(own.name) is own and session.taught[own.name] == (own, "small")
        session.choose_task(own.name)
        session.choose_arm("")
        assert session.scenario.task == own.name and session.task is own
        assert not any("follows it" in text for text in display.said)
        last = session.bring(TASKS["draw_j"]())
        assert {own.name, last.name} == session.taught.keys() == engines["small"].own.keys()

    def test_an_own_task_that_is_moved_for_an_arm_is_said(self, opened):
        session, display, engines, _ = opened
        own = session.bring(TASKS["draw_c"]())
        engines["small"].task = lambda _name: own.placed(0.5, (0.1, -0.05, 0.0))
        session.choose_task(own.name)
        choose(session, "small")
        assert "“Your data” is moved to where the JACO follows it, 0.5 × as large." in display.said


class TestRelocation:
    def test_shapes_keep_their_bounds_and_files_their_size(self):
        to = Relocation(0.2, (0.1, 0.0, 0.0))
        assert to.obstacle(Sphere((1.0, 0.0, 0.0), 0.1)) == Sphere((0.3, 0.0, 0.0), 0.04)
        box, cylinder = to.obstacle(Box((0.0, 0.0, 0.0), (0.3, 0.2, 0.1))), to.obstacle(Cylinder((0.0, 0.0, 0.0)))
        assert (box, cylinder) == (Box((0.1, 0.0, 0.0), (0.06, 0.04, 0.03)), Cylinder((0.1, 0.0, 0.0), 0.04, 0.04))
        cloud = SCENES["cloud"].scenario(TASKS["draw_s"]()).obstacles[0]
        assert replace(cast(Any, to.obstacle(cloud)), position=cloud.position) == cloud

    def test_an_obstacle_that_nobody_has_moved_is_where_the_task_has_it(self):
        before = TASKS["drop_pots"]()
        after = replace(before.placed(0.5, (0.1, 0.0, 0.0)), obstacle_position=(0.2, -0.4, 0.3))
        to = Relocation.between(before, after)
        assert to.obstacle(Sphere(before.obstacle_position)).position == after.obstacle_position
        assert to.obstacle(Sphere((0.0, -0.5, 0.4))).position == (0.1, -0.25, 0.2)

    def test_the_slice_and_the_followed_rollout_go_along(self):
        before, after = TASKS["draw_s"](), smaller("draw_s")()
        view = replace(Scenario("draw_s").view, slice=SlicePose((0.2, -0.4, 0.4), (1.0, 0.0, 0.0, 0.0)))
        scenario = Scenario("draw_s", view=view, starts=(Start((0.0, -0.5, 0.4)),), arm_rollout=7)
        there, gone = relocated(scenario, before, after, lambda _place: np.array(True))
        assert there.view.slice == SlicePose((0.2, -0.25, 0.2), (1.0, 0.0, 0.0, 0.0))
        assert there.arm_rollout == 7 and gone == ()
        there, gone = relocated(scenario, before, after, lambda _place: np.array(False))
        assert there.arm_rollout == 0 and gone == ("start 1",)


class TestStore:
    def test_it_offers_the_known_arms_each_once_that_of_the_server_first(self, robot, fits):
        titles = ArmStore(TASKS, fits, robot).titles
        assert list(titles.values()) == ["JACO", *(arm.title for name, arm in ARMS.items() if name != "jaco")]
        assert next(iter(titles)) == "" and len(set(titles.values())) == len(titles)
        own = ArmStore(TASKS, fits, replace(robot, name="mine", title="UR5")).titles
        assert own[""] == "UR5 (given)" and own["ur5"] == "UR5" and own["jaco"] == "JACO"

    def test_recordings_in_space_stay_where_they_are_while_the_arm_follows_them_there(self, robot):
        entry, small = TaskEntry("Own", TASKS["lift_box"], is_recorded=True), shorter(robot, 0.5)
        assert in_reach({"own": entry}, small)["own"] is entry
        kept, moved = (in_reach({"own": entry}, arm, moves_recorded=True)["own"]() for arm in (robot, small))
        assert kept is entry()
        assert moved.scale < kept.scale and moved.demonstrations is kept.demonstrations
        assert follows(small, np.array([resampled(path, 40) for path in moved.paths]))
        assert not follows(small, np.array([resampled(path, 40) for path in kept.paths]))

    @pytest.mark.long
    def test_an_own_task_is_as_it_was_opened_for_that_arm_and_in_reach_of_another(self, robot, fits):
        first, other = (
            Engine(TASKS, fits, arm, name=name) for name, arm in (("", robot), ("small", shorter(robot, 0.5)))
        )
        engines = Engines(first, lambda _name, _progress: other)
        own, _ = first.bring(TASKS["lift_box"]())
        assert engines("small") is other and first.task(own.name) is own
        placed = other.task(own.name)
        assert placed is other.task(own.name) and placed.scale < own.scale and placed.title == own.title
        large, _ = other.bring(TASKS["draw_s"]().placed(2.0, (0.0, 0.0, 0.0)), "small")  # as it was asked for
        assert other.task(large.name) is large and first.task(large.name).scale < large.scale

    def test_a_task_on_the_table_takes_its_objects_along(self):
        task = TASKS["drop_pots"]()
        placed = task.placed(0.5, (0.1, 0.2, 0.0))
        (ball,) = placed.objects
        assert [(pot.x, pot.y, pot.height) for pot in placed.pots] == [
            pytest.approx((0.5 * pot.x + 0.1, 0.5 * pot.y + 0.2, 0.5 * pot.height)) for pot in task.pots
        ]
        assert cast(Any, ball).pots == placed.pots and placed.hint == task.hint
        lifted = task.placed(0.5, (0.1, 0.2, 0.03))
        assert (lifted.pots, lifted.objects) == ((), ()) and lifted.hint != task.hint
        for name in ("push_box", "lift_box"):
            (before,), (after,) = TASKS[name]().objects, TASKS[name]().placed(0.5, (0.1, 0.2, 0.0)).objects
            assert after.start == pytest.approx(0.5 * cast(Any, before.start) + (0.1, 0.2, 0.0))
            sizes = [np.ptp(thing.surface()[0], axis=0) for thing in (before, after)]
            assert sizes[1] == pytest.approx(0.5 * sizes[0], abs=3e-3)  # walls are as thick


# --- tasks are placed where another arm can follow them ---


def test_tasks_of_the_jaco_stay_as_they_are(robot):
    assert in_reach(TASKS, robot) == TASKS


@pytest.mark.parametrize("name", ["draw_c", "push_box"])
def test_another_arm_follows_its_tasks(robot, name):
    arm = shorter(robot, 0.5)
    task = in_reach(TASKS, arm)[name]()
    paths = np.array([path[np.linspace(0, len(path) - 1, 30).astype(int)] for path in task.paths])
    assert follows(arm, paths)
    assert task.scale == pytest.approx(0.5 * TASKS[name]().scale)
    assert in_reach(TASKS, arm)[name].title == TASKS[name].title


def test_a_task_out_of_every_reach_stays_and_is_said(robot, caplog):
    far = TASKS["push_box"]()
    far = replace(far, origin=np.array([0.0, 0.0, -9.0]))
    entry = TaskEntry("Far", lambda: far)
    assert isinstance(found := in_reach({"far": entry}, shorter(robot, 0.5))["far"](), Task)
    assert found is far
    assert f"{far.title}: " in caplog.text
    assert "cannot follow the task anywhere" in caplog.text


def test_an_arm_is_the_jaco_by_its_shape_not_by_its_name(robot):
    assert is_jaco(replace(robot, name="mine"))
    other = replace(shorter(robot, 0.5), name="jaco")
    assert not is_jaco(other)
    assert in_reach(TASKS, other) != TASKS


def test_every_scene_that_another_arm_is_offered_can_be_made(robot):
    tasks = in_reach(TASKS, shorter(robot, 0.5))
    scenes = offered(tasks, jaco=False)
    assert {scene.name for scene in offered(tasks)} - {scene.name for scene in scenes} >= {"left_pot", "others_push"}
    for scene in scenes:
        assert scene.scenario(tasks[scene.task]()).task == scene.task


DESCRIPTIONS = """
class Description:
    has_urdf, repository = True, None
    def __init__(self, repository, tags=("arm",)): self.repository, self.tags = repository, tags
DESCRIPTIONS = {"small_description": Description("small"), "away_description": Description("away"),
                "dog_description": Description("small", ("quadruped",)), "bad_description": Description("small")}
"""
REPOSITORIES = """
class Repository:
    def __init__(self, path): self.cache_path = path
REPOSITORIES = {name: Repository(name) for name in ("small", "away")}
"""
DESCRIPTION = """
from ._cache import clone_to_cache
URDF_PATH = clone_to_cache("FOLDER", commit=None) + "/FILE"
"""
BALL = '<geometry><sphere radius="0.06"/></geometry>'


@pytest.fixture
def descriptions(tmp_path, monkeypatch):
    """A package robot_descriptions that other processes find, too, with a small arm and a bad one; an empty cache."""
    folder = tmp_path / "packages" / "robot_descriptions"
    folder.mkdir(parents=True)
    files = {"__init__.py": "", "_cache.py": "def clone_to_cache(name, commit=None): raise AssertionError"}
    files |= {"_descriptions.py": DESCRIPTIONS, "_repositories.py": REPOSITORIES}
    files["macro_description.py"] = "XACRO_PATH = 'x'"
    for name, there in (("small", "small"), ("bad", "small"), ("away", "away")):
        text = DESCRIPTION.replace("FOLDER", there).replace("FILE", f"{name}.urdf")
        files[f"{name}_description.py"] = text
    (tmp_path / "files" / "small").mkdir(parents=True)
    write(tmp_path / "files" / "small", urdf(4, shape=BALL), "small.urdf")
    write(tmp_path / "files" / "small", "<robot", "bad.urdf")
    for name, text in files.items():
        write(folder, text, name)
    monkeypatch.syspath_prepend(tmp_path / "packages")
    monkeypatch.setenv("ROBOT_DESCRIPTIONS_CACHE", str(tmp_path / "files"))
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(models, "_LOADED", Memo())
    yield
    for name in [name for name in sys.modules if name.startswith("robot_descriptions")]:
        del sys.modules[name]


class TestMaking:
    @pytest.mark.long
    def test_a_new_arm_is_made_in_another_process_and_then_loaded(self, descriptions, robot, fits, monkeypatch):
        titles = ArmStore(TASKS, fits, robot).titles
        assert titles["small"] == "small" and not {"away", "dog"} & set(titles)
        with pytest.raises(NotStoredError):
            load_arm("small", stored=True)
        told = []
        small = making.load_aside("small", lambda *what: told.append(what))
        assert (small.name, small.num_joints) == ("small", 4)
        assert {fraction for fraction, _ in told} > {0.0, 1.0}
        monkeypatch.setattr(making, "_make", lambda *_: pytest.fail("made again"))
        assert making.load_aside("small", lambda *_: None) is small

    @pytest.mark.parametrize(
        ("name", "words"), [("away", "descriptions pull away"), ("macro", "xacro"), ("nothing", "found 'nothing'")]
    )
    def test_what_is_not_there_is_never_downloaded(self, descriptions, name, words):
        with pytest.raises(ArmError, match=words):
            load_arm(name)

    def test_what_it_refuses_is_one_line(self, descriptions):
        with pytest.raises(ArmError, match=r"bad\.urdf: .*accepted: "):
            making.load_aside("bad", lambda *_: None)

    def test_a_process_that_dies_is_one_line(self, descriptions, monkeypatch):
        write_to = making.start_module
        monkeypatch.setattr(making, "start_module", lambda name, *_, **how: write_to("json.tool", "/nowhere", **how))
        with pytest.raises(ArmError, match=r"something that ended their reader"):
            making.load_aside("small", lambda *_: None)

    def test_arms_are_made_one_at_a_time_and_who_waits_may_leave(self, descriptions):
        said = []

        def leave(*what):
            said.append(what)
            if what[1].startswith("waits"):
                raise UnwantedError

        with making._one_arm, pytest.raises(UnwantedError):
            making.load_aside("small", leave)
        assert json.dumps(said[-1]).count("another arm") == 1
