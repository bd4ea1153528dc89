"""The folder "Your data": what is opened is seen, chosen about, and learned by a click; nothing forged gets through."""

import io
import json
import math
import threading
import zipfile
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import viser  # noqa: TID251 - forges what a browser sends
from pages import PATIENCE, Page, frame_of

import dt_viz as dt
from dt_viz.errors import UnwantedError
from dt_viz.files.npz import npz_bytes
from dt_viz.files.values import packed
from dt_viz.motion.stack import FINE
from dt_viz.saving import SavedMotion, is_motion
from dt_viz.scenario.tasks import TASKS
from dt_viz.scheduler import Jobs
from dt_viz.session.progress import Progress
from dt_viz.ui.tabs.from_file import LANE, turn

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
        self.page.settle()

    def choose(self, label, value):
        self.page.claim(self[label], value)
        self.page.settle()

    @property
    def takes(self):
        return self.page.visitor.pictures._takes

    @property
    def num_drawn(self):
        return sum(len(lines.node.points) > 0 for lines in self.takes.learned)


@pytest.fixture(name="opened")
def _opened(opened_for, monkeypatch):
    page, told = opened_for(None), []
    monkeypatch.setattr(page.session, "say", lambda text, _severity: told.append(text))
    return Opening(page, told)


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
    opened.choose("Task", "Your data")
    assert session.scenario.task == task.name


@pytest.mark.long
def test_what_cannot_be_read_is_one_line_and_what_was_open_stays(opened):
    containers = opened.page.gui._container_handle_from_uuid.values()
    (folder,) = (each for each in containers if getattr(each, "label", "") == "Your data")
    too_large = "large.csv: files: found 50.0 MB in all; accepted: at most 50 MB; the command line takes more"
    for num, name, content, said in (
        (0, "a.csv", b"no numbers", "a: "),
        (1, "a.exe", b"MZ", "a.exe"),
        (2, "a.csv", b"t,x,y,z\n0,0,0,0\n1,nan,0,0\n", "nan"),
        (3, "large.csv", bytes(50 * 10**6), too_large),
    ):
        opened.add(name, content)
        assert said in opened.told.pop() and not opened.told and (not num or opened.num_drawn == num)
        assert folder.visible is opened.takes.visible is (num > 0)
        opened.add("good.csv", csv())
        assert opened.num_drawn == num + 1 and not opened.told


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
def test_one_of_several_goals_a_scale_and_what_columns_without_names_are_can_be_chosen(opened):
    far = GOAL + np.array([0.0, 0.1, 0.3])
    opened.add("a.zip", zipped(a=csv(), b=csv(far), c=csv(), d=csv(far)))
    assert opened["Goal"].options[0].startswith("1 · ") and len(opened["Goal"].options) == 2
    np.testing.assert_allclose(opened.takes.goal.position, GOAL, atol=0.01)
    opened.choose("Goal", opened["Goal"].options[1])
    np.testing.assert_allclose(opened.takes.goal.position, far, atol=0.01)
    assert opened.num_drawn == 2
    opened.choose("Cancel", True)
    opened.add("a.zip", zipped(a=csv(3 * GOAL), b=csv(3 * GOAL)))  # out of reach
    assert opened["Scale to fit"].value is False
    opened.choose("Scale to fit", True)
    assert 0 < np.linalg.norm(opened.takes.goal.position) < 2 * np.linalg.norm(GOAL)
    assert opened["Scale to fit"].value is True
    opened.choose("Cancel", True)
    u = np.linspace(0, 1, 100)
    rows = np.column_stack([0.3 * u, -0.5 + 0.1 * np.sin(3 * u), 0.3 + 0.1 * u**2])  # the first is as even as times are
    opened.add("a.csv", "\n".join(",".join(f"{value:.6f}" for value in row) for row in rows).encode())
    assert opened["First column"].value == "times" and "Rate" not in opened.labels()
    opened.choose("First column", opened["First column"].options[1])
    np.testing.assert_allclose(opened.takes.goal.position, rows[-1], atol=1e-4)
    assert opened["Rate"].value == "20 Hz"


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
                opened.page.settle()
                assert handle.value == before, (handle.label, claim)
    hidden = [
        handle
        for handle in opened.page.inputs
        if not handle.visible and handle.label in ("Cut pauses", "Topic", "Column of x")
    ]
    for handle in hidden:
        before = handle.value
        opened.page.claim(handle, False)
        opened.page.settle()
        assert handle.value == before and not handle.visible
    assert opened.num_drawn == 1 and opened.told == []


# --- motions that the library has saved ---


def arcs(dim=3):
    """Demonstrations of a motion in space, or of a drawing."""
    s = np.linspace(0, 1, 40)
    start = np.array([-0.2, -0.4, 0.3])[:dim]
    for k in range(7):
        path = np.stack([0.35 * s, (0.4 + 0.02 * k) * s * (1 - s), 0.1 * s**2], axis=1)[:, :dim]
        yield dt.Demonstration(2 * s, start + path, f"arc {k}")


QUICK = dt.ImitationSettings(num_layers=2)


def content_of(motion, folder):
    motion.save(folder / "my_motion.npz")
    return (folder / "my_motion.npz").read_bytes()


@pytest.mark.long
def test_a_saved_motion_is_the_same_on_the_page(opened, tmp_path, new_engine):
    box = dt.Box((-0.02, -0.31, 0.33), (0.05, 0.1, 0.08))
    motion = dt.fit([*arcs()], labels=[0, 1, 0, 1, 0, 1, 0]).stack(dt.Avoidance(box))
    opened.add("anything.bin", content_of(motion, tmp_path))
    session = opened.page.session
    assert opened.told == [] and len(session.task.demonstrations) == 7 and opened["Task"].value == "Your data"
    assert session.scenario.stack[0].transform == motion.transforms[0]
    engine = new_engine()
    engine.bring(session.task)
    solved = engine.solved(session.scenario, FINE)
    assert solved.stack.bundle.positions.tobytes() == motion.solution.bundle.positions.tobytes()
    session.undo()
    assert session.scenario.task == "draw_s"


@pytest.mark.long
def test_a_motion_that_is_not_read_is_one_line_and_changes_nothing(opened, tmp_path):
    def forged(motion):
        text = {"version": 1, **packed(motion, "motion", arrays := {})}
        return npz_bytes({"motion": np.array(json.dumps(text))} | arrays)

    opened.add("good.csv", csv())
    before, good = opened.page.session.scenario, content_of(dt.fit([*arcs(2)], settings=QUICK), tmp_path)
    slow = SavedMotion(tuple(arcs()), (), augmented=True, settings=dt.AugmentedSettings(num_paces=10**7))
    far = SavedMotion((dt.Demonstration(np.arange(3.0), 1e3 * np.eye(3), "far"),), (), augmented=True)
    for content, said in (
        (forged(slow), "settings of the augmented state: found others; accepted: the defaults on the page"),
        (forged(far), "positions of 'far': found 1000 m"),
        (good[: len(good) // 2], "file: found something that cannot be read"),
        (npz_bytes({"motion": np.array("[" * 300_001)}), "array 'motion': found 300001 characters; accepted: at most"),
        (zipped(".npz", a=good, b=good), "a motion that the library has saved; accepted: recordings; this file is op"),
    ):
        opened.told.clear()
        opened.add("a.npz" if content[:2] != b"PK" or is_motion(content) else "a.zip", content)
        assert len(opened.told) == 1 and said in opened.told[0] and "\n" not in opened.told[0]
        assert opened.page.session.scenario is before and opened.num_drawn == 1


# --- Files are read one at a time over all visitors ---


class Visitor:
    """Has a file read that goes on until it is let go."""

    def __init__(self) -> None:
        self.waits, self.reads, self.let_go, self.done = (threading.Event() for _ in range(4))
        self.errors: list[Exception] = []
        self.jobs = Jobs(self.errors.append)
        self.end = ""

    def read(self) -> None:
        try:
            with turn(lambda *_said: self.waits.set(), partial(self.jobs.superseded, LANE)):
                self.reads.set()
                assert self.let_go.wait(PATIENCE)
            self.end = "read"
        except UnwantedError:
            self.end = "left"
            raise
        finally:
            self.done.set()


@pytest.mark.parametrize("leaves", [None, 0, 1], ids=["nobody leaves", "who reads leaves", "who waits leaves"])
def test_a_second_visitor_is_told_to_wait_and_comes_next_and_who_leaves_is_not_waited_for(leaves):
    first, second = both = Visitor(), Visitor()
    first.jobs.submit(LANE, first.read)
    assert first.reads.wait(PATIENCE) and not first.waits.is_set()
    second.jobs.submit(LANE, second.read)
    assert second.waits.wait(PATIENCE) and not second.reads.wait(0.3)
    if leaves is not None:
        both[leaves].jobs.close()
    if leaves == 1:
        assert second.done.wait(PATIENCE) and second.end == "left" and not second.reads.is_set()
    first.let_go.set()
    assert first.done.wait(PATIENCE) and first.end == ("left" if leaves == 0 else "read")  # what was read is dropped
    second.let_go.set()
    assert second.done.wait(PATIENCE) and second.end == ("left" if leaves == 1 else "read")
    assert first.errors == second.errors == []
    first.jobs.close()
    second.jobs.close()
