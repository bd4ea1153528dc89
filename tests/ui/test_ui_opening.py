"""The folder "Your data": what is opened is seen, chosen about, and learned by a click; nothing forged gets through."""

import io
import json
import math
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import viser  # noqa: TID251 - forges what a browser sends
from pages import PATIENCE, Page, frame_of, wait_until

import dt_viz as dt
from dt_viz.files import uploads
from dt_viz.files.npz import npz_bytes
from dt_viz.files.values import packed
from dt_viz.motion.stack import FINE
from dt_viz.saving import SavedMotion, is_motion
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.progress import Progress
from dt_viz.session.session import CHOICES
from dt_viz.ui.tabs.from_file import LANE
from dt_viz.ui.tabs.opening import CHOOSING, SEEING

RNG = np.random.default_rng(2)
GOAL = np.array([0.2, -0.45, 0.3])


def csv(goal=GOAL, timed=True, jitter=0.0, size=1.0, num=200):
    u = np.linspace(0, 1, num)
    start = np.array([-0.2, -0.4, 0.2]) + RNG.normal(scale=0.01, size=3)
    path = start + (3 * u**2 - 2 * u**3)[:, None] * (goal - start) + RNG.normal(scale=jitter, size=(num, 3))
    path[:, 2] += 0.1 * np.sin(np.pi * u)
    rows = np.column_stack([*([4 * u] if timed else []), size * path])
    header = "t,x,y,z" if timed else "x,y,z"
    return "\n".join([header, *(",".join(f"{value:.6f}" for value in row) for row in rows)]).encode()


def zipped(suffix=".csv", **files):
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        for name, content in files.items():
            archive.writestr(f"{name}{suffix}", content)
    return file.getvalue()


class Opening:
    """The folder of a page, and its visitor's clicks."""

    def __init__(self, page: Page, told: list[str]) -> None:
        self.page, self.told = page, told

    def __getitem__(self, label):
        return self.page[label]

    def labels(self):
        return {handle.label for handle in self.page.inputs if handle.visible}

    def add(self, name, content):
        self.page.claim(self["Open a file, or drop it here"], viser.UploadedFile(name, content))
        self.done()

    def choose(self, label, value):
        self.page.claim(self[label], value)
        self.done()

    def done(self):
        for lane in (CHOOSING, LANE, SEEING, CHOICES):
            assert self.page.session.jobs.wait_idle(lane, PATIENCE)

    @property
    def takes(self):
        return self.page.visitor.pictures._takes

    @property
    def num_drawn(self):
        return sum(len(lines.node.points) > 0 for lines in self.takes.learned)


@pytest.fixture(name="opened")
def _opened(server, robot, monkeypatch):
    monkeypatch.setattr(uploads, "_ready", uploads._Ready())
    page, told = Page(server, robot), []
    monkeypatch.setattr(page.session, "say", lambda text, _severity: told.append(text))
    opened = Opening(page, told)
    yield opened
    page.close()
    server.gui.reset()
    server.scene.reset()


@pytest.mark.long
def test_what_is_opened_is_seen_in_place_of_the_motion_until_it_is_cancelled(opened):
    assert not opened.takes.visible
    opened.add("a.csv", csv())
    assert opened.takes.visible and opened.num_drawn == 1 and not opened["Learn"].disabled
    opened.add("b.zip", zipped(b=csv(jitter=0.002), c=csv(GOAL + np.array([-0.3, 0.0, 0.2])), d=csv()))
    assert opened.num_drawn == 3 and len(opened.takes.left_out.node.points) > 0
    np.testing.assert_allclose(opened.takes.goal.position, GOAL, atol=0.01)
    assert {"Smooth jitter", "One goal only", "Use this take"} <= opened.labels()
    assert not {"Cut pauses", "Goal", "Unit", "Rate", "Topic", "Column of x", "Scale to fit"} & opened.labels()
    visible = opened.page.visitor.pictures._always[-1]
    assert not visible.visible
    opened.choose("Cancel", True)
    assert not opened.takes.visible and visible.visible
    assert {"Smooth jitter", "Use this take"}.isdisjoint(opened.labels())
    assert opened.page.session.scenario.task == "draw_s"


@pytest.mark.long
def test_switches_and_takes_are_chosen(opened):
    opened.add("b.zip", zipped(a=csv(), b=csv(jitter=0.002), c=csv(GOAL + np.array([-0.3, 0.0, 0.2]))))
    smooth = np.array(opened.takes.learned[1].node.points)
    opened.choose("Smooth jitter", False)
    rough = np.array(opened.takes.learned[1].node.points)
    assert np.abs(np.diff(rough[:, 0], axis=0)).sum() > 1.2 * np.abs(np.diff(smooth[:, 0], axis=0)).sum()
    assert opened["Smooth jitter"].value is False  # it stays, though nothing is done
    opened.choose("Take", "2 · b")
    assert opened.takes.name.text == "b"
    opened.choose("Use this take", False)
    assert opened.num_drawn == 1
    opened.choose("Take", "1 · a")
    assert opened["Use this take"].value is True
    opened.choose("Use this take", False)
    opened.choose("Take", "3 · c")
    assert opened.num_drawn == 1 and not opened["Learn"].disabled  # the one that ended elsewhere
    opened.choose("Use this take", False)
    assert opened.num_drawn == 0 and opened["Learn"].disabled


@pytest.mark.long
def test_a_click_learns_what_is_seen_and_undo_goes_back(opened):
    opened.add("a.zip", zipped(a=csv(jitter=0.002), b=csv(), c=csv()))
    opened.choose("Smooth jitter", False)
    opened.choose("Learn", True)
    session, dropdown = opened.page.session, opened["Task"]
    task = session.task
    assert session.scenario.task == task.name == "own_data_1" and len(task.demonstrations) == 3
    assert not task.preparation.smooth_jitter
    assert dropdown.value == "Your data" and dropdown.options == (*(e.title for e in TASKS.values()), "Your data")
    assert opened["Learn"].disabled and opened.takes.visible  # until the motion is there
    visitor = opened.page.visitor
    learning = Progress(session.scenario, shown=frame_of(session.scenario, task=task), learning=(0.5, "half"))
    visitor.tell(learning)
    assert opened.takes.visible
    visitor.tell(replace(learning, learning=None))
    assert not opened.takes.visible
    session.undo()
    assert session.scenario.task == "draw_s" and dropdown.value == "Draw S"
    session.redo()
    assert dropdown.value == "Your data"
    opened.choose("Task", "Draw J")
    opened.choose("Task", "Your data")
    assert session.scenario.task == task.name


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.exe", b"MZ", "a.exe"),
        ("a.csv", b"t,x,y,z\n0,0,0,0\n1,nan,0,0\n", "nan"),
    ],
)
def test_what_cannot_be_read_is_one_line_and_what_was_open_stays(opened, name, content, said):
    opened.add("good.csv", csv())
    opened.add(name, content)
    assert len(opened.told) == 1 and said in opened.told[0] and "\n" not in opened.told[0]
    assert opened.num_drawn == 1 and opened.takes.visible
    opened.add("more.csv", csv())
    assert opened.num_drawn == 2 and len(opened.told) == 1


def test_more_than_a_visitor_may_hold_is_refused(opened):
    opened.add("good.csv", csv())
    opened.add("large.csv", bytes(50 * 10**6))
    assert opened.told == [
        "large.csv: files: found 50.0 MB in all; accepted: at most 50 MB; the command line takes more"
    ]
    assert opened.num_drawn == 1


@pytest.mark.long
def test_what_is_not_clear_is_asked_for_and_answered(opened):
    opened.add("mm.csv", csv(size=1000.0, timed=False).replace(b"x,y,z", b"a,b,c"))
    assert {"Unit", "Rate", "Column of x", "Column of t"} <= opened.labels()
    assert (opened["Unit"].value, opened["Rate"].value, opened["Column of y"].value) == ("mm", "50 Hz", "b")
    np.testing.assert_allclose(opened.takes.goal.position, GOAL, atol=0.01)
    opened.choose("Unit", "cm")
    np.testing.assert_allclose(opened.takes.goal.position, 10 * GOAL, atol=0.1)
    opened.choose("Unit", "m")  # 200 m
    assert len(opened.told) == 1 and "millimetres" in opened.told[0]
    opened.choose("Unit", "mm")
    opened.choose("Rate", "100 Hz")
    opened.choose("Column of y", "c")
    opened.choose("Column of z", "b")
    np.testing.assert_allclose(opened.takes.goal.position, GOAL[[0, 2, 1]], atol=0.01)
    assert opened["Rate"].value == "100 Hz" and opened["Unit"].value == "mm"


@pytest.mark.long
def test_three_columns_without_names_can_be_told(opened):
    u = np.linspace(0, 1, 100)
    rows = np.column_stack([0.3 * u, -0.5 + 0.1 * np.sin(3 * u), 0.3 + 0.1 * u**2])  # the first is as even as times are
    opened.add("a.csv", "\n".join(",".join(f"{value:.6f}" for value in row) for row in rows).encode())
    assert opened["First column"].value == "times" and "Rate" not in opened.labels()
    opened.choose("First column", opened["First column"].options[1])
    np.testing.assert_allclose(opened.takes.goal.position, rows[-1], atol=1e-4)
    assert opened["Rate"].value == "20 Hz"


@pytest.mark.long
def test_several_goals_are_told_and_one_is_chosen(opened):
    far = GOAL + np.array([0.0, 0.1, 0.3])
    opened.add("a.zip", zipped(a=csv(), b=csv(far), c=csv(), d=csv(far)))
    assert opened["Goal"].options[0].startswith("1 · ") and len(opened["Goal"].options) == 2
    np.testing.assert_allclose(opened.takes.goal.position, GOAL, atol=0.01)
    opened.choose("Goal", opened["Goal"].options[1])
    np.testing.assert_allclose(opened.takes.goal.position, far, atol=0.01)
    assert opened.num_drawn == 2


@pytest.mark.long
def test_what_the_arm_cannot_reach_is_scaled_if_that_is_wanted(opened):
    opened.add("a.zip", zipped(a=csv(3 * GOAL), b=csv(3 * GOAL)))
    assert opened["Scale to fit"].value is False
    opened.choose("Scale to fit", True)
    assert 0 < np.linalg.norm(opened.takes.goal.position) < 2 * np.linalg.norm(GOAL)
    assert opened["Scale to fit"].value is True


@pytest.mark.long
def test_forged_values_are_refused(opened):
    opened.add(
        "a.zip", zipped(a=csv(timed=False, size=1000.0, jitter=0.002), b=csv(GOAL + 0.2, timed=False, size=1000.0))
    )
    shown = [handle for handle in opened.page.inputs if handle.visible]
    labels = {"Take", "Use this take", "Unit", "Rate", "Goal", "Smooth jitter"}
    assert labels <= {handle.label for handle in shown}
    for handle in shown:
        if handle.label in labels and not isinstance(handle, viser.GuiCheckboxHandle):  # viser makes booleans for those
            before = handle.value
            for claim in (math.nan, -1, 2**70, None, "", "x" * 10_000, "1 · nobody", [], {}, True, 3.5):
                opened.page.claim(handle, claim)
                opened.done()
                assert handle.value == before, (handle.label, claim)
    hidden = [
        handle
        for handle in opened.page.inputs
        if not handle.visible and handle.label in ("Cut pauses", "Topic", "Column of x")
    ]
    for handle in hidden:
        before = handle.value
        opened.page.claim(handle, False)
        opened.done()
        assert handle.value == before and not handle.visible
    assert opened.num_drawn == 1 and opened.told == []


def test_after_cancel_the_next_file_is_the_only_one(opened):
    opened.add("a.csv", csv())
    opened.choose("Cancel", True)
    assert not opened.takes.visible
    opened.add("b.csv", csv())
    assert opened.takes.visible and opened.num_drawn == 1 and opened.takes.name.text == "b"


@pytest.mark.long
def test_the_folder_goes_again_with_a_first_file_that_cannot_be_read(opened):
    opened.add("a.csv", b"no numbers")
    assert len(opened.told) == 1 and opened.told[0].startswith("a: ")
    containers = opened.page.gui._container_handle_from_uuid.values()
    (folder,) = (each for each in containers if getattr(each, "label", "") == "Your data")
    assert not folder.visible
    opened.add("b.csv", csv())
    assert folder.visible and opened.num_drawn == 1


# --- motions that the library has saved ---


def arcs(dim=3):
    """Demonstrations of a motion in space, or of a drawing."""
    s = np.linspace(0, 1, 40)
    start = np.array([-0.2, -0.4, 0.3])[:dim]
    for k in range(7):
        path = np.stack([0.35 * s, (0.4 + 0.02 * k) * s * (1 - s), 0.1 * s**2], axis=1)[:, :dim]
        yield dt.Demonstration(2 * s, start + path, f"arc {k}")


QUICK = dt.ImitationSettings(num_layers=2)
MOTIONS = {
    "in space": lambda: dt.fit([*arcs()], settings=QUICK, state="plain").stack(
        dt.BiasPoint((0.0, -0.25, 0.3)), dt.Avoidance(dt.Sphere((-0.02, -0.31, 0.33), 0.08), margin=0.01)
    ),
    "augmented, with labels of its own": lambda: dt.fit([*arcs()], labels=[0, 1, 0, 1, 0, 1, 0]).stack(
        dt.Avoidance(dt.Box((-0.02, -0.31, 0.33), (0.05, 0.1, 0.08)))
    ),
}


def content_of(motion, folder):
    motion.save(folder / "my_motion.npz")
    return (folder / "my_motion.npz").read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("name", MOTIONS)
def test_a_saved_motion_is_the_same_on_the_page(opened, tmp_path, new_engine, name):
    motion = MOTIONS[name]()
    opened.add("anything.bin", content_of(motion, tmp_path))
    session = opened.page.session
    assert opened.told == [] and len(session.task.demonstrations) == 7 and opened["Task"].value == "Your data"
    assert session.scenario.stack[0].transform == motion.transforms[0]
    engine = new_engine()
    engine.bring(session.task, "draw_s")
    solved = engine.solved(session.scenario, FINE)
    assert solved.stack.bundle.positions.tobytes() == motion.solution.bundle.positions.tobytes()
    session.undo()
    assert session.scenario.task == "draw_s"


@pytest.mark.long
def test_a_saved_drawing_is_on_the_board_with_its_obstacles_and_without_any_it_has_the_sphere(opened, tmp_path):
    box = dt.Box((0.0, -0.3, 0.0), (0.05, 0.1, 0.08))
    plain = dt.fit([*arcs(2)], settings=QUICK, state="plain")
    opened.add("a.npz", content_of(plain.stack(dt.Avoidance(box)), tmp_path))
    session = opened.page.session
    (there,) = session.scenario.obstacles
    np.testing.assert_allclose(there.position, session.task.to_world(np.array([0.0, -0.3])))
    assert session.task.draws
    opened.add("b.npz", content_of(plain, tmp_path))
    assert session.scenario.task == "own_data_2" and isinstance(session.scenario.obstacles[0], dt.Sphere)


def refused_motions():
    """Motions that are not read, by what is said of them."""
    ball, plain = dt.Sphere((-0.02, -0.31, 0.33), 0.08), MOTIONS["in space"]()
    slow = dt.AugmentedSettings(num_paces=10**7)
    yield plain.stack(dt.Avoidance(ball)), "transforms 'Avoidance': found 2; accepted: at most 1"
    saved = SavedMotion(tuple(arcs()), (), augmented=True, settings=slow)
    yield saved, "settings of the augmented state: found others; accepted: the defaults on the page"
    far = dt.Demonstration(np.arange(3.0), 1e3 * np.eye(3), "far")
    yield SavedMotion((far,), (), augmented=True), "positions of 'far': found 1000 m"


@pytest.mark.long
def test_a_motion_that_is_not_read_is_one_line_and_changes_nothing(opened, tmp_path):
    opened.add("good.csv", csv())
    before, good = opened.page.session.scenario, content_of(MOTIONS["in space"](), tmp_path)
    contents = []
    for motion, said in refused_motions():
        if isinstance(motion, SavedMotion):
            text = {"version": 1, **packed(motion, "motion", arrays := {})}
            contents.append((npz_bytes({"motion": np.array(json.dumps(text))} | arrays), said))
        else:
            contents.append((content_of(motion, tmp_path), said))
    for content, said in (
        *contents,
        (good[: len(good) // 2], "file: found something that cannot be read"),
        (npz_bytes({"motion": np.array("[" * 300_001)}), "array 'motion': found 300001 characters; accepted: at most"),
        (zipped(".npz", a=good, b=good), "a motion that the library has saved; accepted: recordings; this file is op"),
    ):
        opened.told.clear()
        opened.add("a.npz" if content[:2] != b"PK" or is_motion(content) else "a.zip", content)
        assert len(opened.told) == 1 and said in opened.told[0] and "\n" not in opened.told[0]
        assert opened.page.session.scenario is before and opened.num_drawn == 1


@pytest.mark.long
def test_another_task_ends_what_is_open(opened):
    opened.add("a.csv", csv())
    opened.choose("Task", "Draw J")
    assert not opened.takes.visible and opened.page.session.scenario.task == "draw_j"


@pytest.mark.long
def test_two_visitors_open_at_the_same_instant_and_each_sees_its_own(robot, opened):
    beside = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    other = Page(beside, robot)
    try:
        label = "Open a file, or drop it here"
        opened.page.claim(opened[label], viser.UploadedFile("a.csv", csv()))
        other.claim(other[label], viser.UploadedFile("b.zip", zipped(b=csv(), c=csv())))
        opened.done()
        for lane in (CHOOSING, LANE, SEEING):
            assert other.session.jobs.wait_idle(lane, PATIENCE)
        wait_until(lambda: opened.takes.visible and other.visitor.pictures._takes.visible)
        assert opened.takes.name.text == "a" and other.visitor.pictures._takes.name.text == "b"
    finally:
        other.close()
        beside.stop()
