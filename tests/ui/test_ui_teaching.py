"""Teaching in the page: a press, a drag and a release on the board is a take; nothing forged becomes one."""

from types import SimpleNamespace

import numpy as np
import pytest
from pages import Page, frame_of

from dt_viz.learning.demonstrations import load_demonstrations
from dt_viz.session.teaching import board_of
from dt_viz.ui import patches, pen
from dt_viz.ui.tabs import opening

BOARD = "/teaching/board"
U = np.linspace(0, 1, 40)
S = np.stack([-0.11 * np.sin(1.5 * np.pi * (2 * U - 1)), -0.34 * (U - 0.5)], axis=1)


class Teaching:
    """A page, its visitor's clicks, and a clock that goes on by a twentieth of a second with each event."""

    def __init__(self, page: Page, robot, monkeypatch) -> None:
        self.page, self.board, self.told = page, board_of(robot), []
        self._now = 0.0
        monkeypatch.setattr(pen, "time", SimpleNamespace(monotonic=self._tick))
        monkeypatch.setattr(page.session, "say", lambda text, _severity: self.told.append(text))

    def _tick(self):
        self._now += 0.05
        return self._now

    def choose(self, label, value=True):
        self.page.claim(self.page[label], value)
        self.page.settle()

    def draw(self, places, name=BOARD):
        for k, place in enumerate(places):
            self.page.drag(name, places[0], place, "start" if k == 0 else "update")
        self.page.drag(name, places[0], places[-1], "end")
        self.page.settle()

    def draw_s(self, size=1.0):
        self.draw(self.board.at(size * S))

    @property
    def shown(self):
        return self.page.visitor.pictures

    @property
    def takes(self):
        return self.shown._takes

    @property
    def num_kept(self):
        return sum(len(lines.node.points) > 0 for lines in self.takes.learned)

    @property
    def grip(self):
        return self.page.visitor.robot.grip


@pytest.fixture(name="teaching")
def _teaching(opened_for, robot, monkeypatch):
    return Teaching(opened_for(None), robot, monkeypatch)


def is_shown(page, label):
    return any(handle.label == label and handle.visible for handle in page.inputs)


def test_three_takes_are_drawn_deleted_and_learned_as_a_task_of_ones_own(teaching):
    page = teaching.page
    assert not teaching.shown.board.visible
    teaching.choose("Draw your own")
    assert teaching.shown.board.visible and "Press on the board" in teaching.told[-1]
    assert page["Learn"].disabled and not is_shown(page, "Delete this take")
    for k in range(3):
        teaching.draw_s(1 + 0.03 * k)
        assert teaching.num_kept == k + 1
    assert teaching.takes.name.text == "drawn 3" and not page["Learn"].disabled
    drawn = teaching.board.at(S)
    on_line = np.linalg.norm(teaching.takes.drawn.node.points[:, :1] - drawn[None], axis=-1).min(axis=1)
    assert on_line.min() < 1e-3
    path = np.concatenate(teaching.takes.learned[0].node.points)
    assert np.linalg.norm(path[:, None] - drawn, axis=-1).min(axis=1).max() < 0.02
    teaching.choose("Take", "2 · drawn 2")
    teaching.choose("Delete this take")
    assert teaching.num_kept == 2 and page["Take"].options == ("1 · drawn 1", "2 · drawn 3")
    teaching.draw_s()
    assert teaching.takes.name.text == "drawn 4"
    teaching.choose("Learn")
    task = page.session.task
    assert page.session.scenario.task == "own_data_1" and len(task.demonstrations) == 3 and task.state == "augmented"
    np.testing.assert_allclose(task.paths[0][0], teaching.board.at(S)[0], atol=0.005)
    assert not teaching.shown.board.visible and not teaching.grip.guides
    page.session.undo()
    assert page.session.scenario.task == "draw_s"


def draw_and_learn(teaching, num):
    teaching.choose("Draw your own")
    for k in range(num):
        teaching.draw_s(1 + 0.03 * k)
    teaching.choose("Learn")
    return teaching.page.session.scenario.task


def shows_learned(teaching):
    session = teaching.page.session
    teaching.page.visitor._panel.bindings.report(frame_of(session.scenario, task=session.task))


def test_what_was_learned_from_is_put_back_while_its_task_is_shown_and_learned_again(teaching):
    page, session = teaching.page, teaching.page.session
    first = draw_and_learn(teaching, 3)
    shows_learned(teaching)
    assert not is_shown(page, "Download") and page["Learn"].disabled
    teaching.choose("Draw your own")
    assert teaching.num_kept == 3 and is_shown(page, "Download") and teaching.shown.board.visible
    np.testing.assert_allclose(teaching.takes.drawn.node.points[0, 0], teaching.board.at(S)[0], atol=1e-6)
    teaching.choose("Take", "2 · drawn 2")
    teaching.choose("Use this take", False)
    teaching.draw_s()
    assert page["Take"].options[-1] == "4 · drawn 4"
    teaching.choose("Learn")
    assert session.scenario.task != first and len(session.task.demonstrations) == 3
    shows_learned(teaching)
    teaching.choose("Draw your own")
    assert len(page["Take"].options) == 4 and teaching.num_kept == 3  # what was left out still is
    teaching.choose("Cancel")
    session.undo()
    shows_learned(teaching)
    assert session.scenario.task == first
    teaching.choose("Draw your own")
    assert page["Take"].options == ("1 · drawn 1", "2 · drawn 2", "3 · drawn 3") and teaching.num_kept == 3
    teaching.choose("Task", "Draw J")
    teaching.choose("Draw your own")
    assert teaching.num_kept == 0 and page["Learn"].disabled


def test_what_could_not_be_learned_is_put_back_beside_any_task_until_it_is(teaching):
    page, session = teaching.page, teaching.page.session
    draw_and_learn(teaching, 2)
    session.undo()  # as where learning is cancelled
    assert session.scenario.task == "draw_s"
    teaching.choose("Draw your own")
    assert teaching.num_kept == 2
    teaching.choose("Learn")
    shows_learned(teaching)
    session.undo()
    teaching.choose("Draw your own")
    assert teaching.num_kept == 0 and page["Learn"].disabled


def test_undo_takes_back_takes_while_teaching_and_leaves_the_scenario_alone(teaching):
    page, session = teaching.page, teaching.page.session
    session.step("Warp", warp=0.5)
    before = session.scenario

    def travels(button, takes, steps):
        page.claim(page["History" if button == "Undo" else button], button)
        page.settle()
        told = page.visitor._panel.status.steps.content
        assert tuple(f"{group} button {{ opacity" not in told for group in patches.STEP_GROUPS[:2]) == steps
        assert teaching.num_kept == takes and session.scenario == before and teaching.shown.board.visible

    teaching.choose("Draw your own")
    travels("Undo", 0, (False, False))
    for k in range(2):
        teaching.draw_s(1 + 0.03 * k)
    teaching.choose("Delete this take")
    travels("Undo", 2, (True, True))
    travels("Undo", 1, (True, True))
    travels("Redo", 2, (True, True))
    travels("Undo", 1, (True, True))
    travels("Undo", 0, (False, True))
    assert page["Learn"].disabled
    teaching.choose("Cancel")
    page.give(page.commands["Undo"])
    page.settle()
    assert session.scenario.warp == 1


def test_more_takes_than_a_task_may_have_are_refused(teaching, monkeypatch):
    monkeypatch.setattr(opening, "MAX_TAKES", 2)
    teaching.choose("Draw your own")
    for _ in range(3):
        teaching.draw_s()
    assert teaching.num_kept == 2 and "delete one first" in teaching.told[-1]


def test_cancel_escape_and_another_task_end_it(teaching):
    page = teaching.page
    for leave in (
        lambda: teaching.choose("Cancel"),
        lambda: page.give(page.commands["End the presentation, what is taught or opened, or else the tour"]),
        lambda: teaching.choose("Task", "Draw J"),
    ):
        teaching.choose("Draw your own")
        teaching.draw_s()
        assert teaching.num_kept == 1 and not teaching.shown._always[-1].visible
        leave()
        page.settle()
        assert not teaching.takes.visible and not teaching.shown.board.visible
        assert teaching.shown._always[-1].visible and not is_shown(page, "Delete this take")
        teaching.choose("Draw your own")
        assert teaching.num_kept == (page.session.scenario.task == "draw_j")  # where nobody gave them up they wait
        teaching.choose("Cancel")


def test_the_hand_is_guided_over_several_drags_until_the_take_is_done(teaching):
    teaching.choose("Draw your own")
    assert not teaching.grip.guides and not is_shown(teaching.page, "Take done")
    teaching.choose("Teach", "Guide the hand")
    assert teaching.grip.guides and teaching.grip.visible and not teaching.shown.board.plate.visible
    node = teaching.grip.node.name
    begin = np.array([0.0, -0.4, 0.4])
    teaching.draw([begin + np.array([0.0, 0.0, -0.01 * k]) for k in range(10)], node)
    teaching.draw([begin + np.array([0.0, -0.01 * k, -0.09]) for k in range(10)], node)
    assert teaching.num_kept == 0
    teaching.choose("Take done")
    assert teaching.num_kept == 1 and teaching.takes.name.text == "guided 1"
    teaching.choose("Cancel")
    assert not teaching.grip.guides


@pytest.mark.long
def test_what_is_no_take_is_said_and_ignored(teaching):
    teaching.draw_s()  # on a board that is not there
    assert not teaching.takes.visible and teaching.told == []
    teaching.choose("Draw your own")
    teaching.draw([teaching.board.centre])
    assert teaching.told[-1].startswith("drawn 1: take: found") and teaching.num_kept == 0
    teaching.draw(np.broadcast_to(teaching.board.centre, (50, 3)))
    assert "0 mm long" in teaching.told[-1]
    told = len(teaching.told)
    nowhere = teaching.board.centre + np.array([3.0, 0.0, 0.0])
    teaching.draw(np.broadcast_to(nowhere, (50, 3)))
    assert len(teaching.told) == told and teaching.num_kept == 0
    for place in ((np.nan, 0.0, 0.0), (np.inf, 0.0, 0.0), (1e300, 0.0, 0.0), ("x", 0.0, 0.0), ()):
        teaching.page.drag(BOARD, teaching.board.centre, place)
    teaching.draw_s()
    assert teaching.num_kept == 1
    assert np.isfinite(teaching.takes.drawn.node.points).all()
    teaching.choose("Cancel")
    teaching.draw_s()
    assert not teaching.takes.visible


def test_the_arm_follows_the_pen_and_minds_no_hidden_obstacle(teaching, monkeypatch):
    live, held, minded = teaching.page.visitor.robot.playback.live, [], []
    monkeypatch.setattr(live, "hold", held.append)
    monkeypatch.setattr(live, "see", minded.append)
    teaching.choose("Draw your own")
    assert minded == [None]
    teaching.draw_s()
    np.testing.assert_allclose(held[-1], teaching.board.at(S)[-1], atol=1e-6)
    released = []
    monkeypatch.setattr(live, "release", lambda: released.append(True))
    teaching.choose("Cancel")
    assert released == [True]


def test_taught_takes_are_downloaded_as_they_are_kept(teaching, monkeypatch, tmp_path):
    def download(name, content, **_how):
        (tmp_path / name).write_bytes(content)

    teaching.choose("Draw your own")
    assert not is_shown(teaching.page, "Download")
    teaching.draw_s()
    monkeypatch.setattr(teaching.page.client, "send_file_download", download)
    (kept,) = teaching.page.visitor._panel.opening._opened.kept
    for kind in ("csv", "npz"):
        teaching.choose("Download", kind)
        (again,) = load_demonstrations(tmp_path / f"dt-viz-draw_s-takes.{kind}")
        assert again.name == "drawn 1"
        np.testing.assert_allclose(again.positions, kept.positions, rtol=1e-8, atol=1e-12)
        np.testing.assert_allclose(again.times, kept.times, rtol=1e-8)
