"""Visitors at once, without browsers, and the measurement that opens the page and drags in it."""

import asyncio
import json
import socket
from argparse import Namespace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dt_viz.evaluate import load
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.options import as_text
from dt_viz.evaluate.protocol_client import ANSWERED, ROLLOUT
from dt_viz.evaluate.visit import SETTINGS, LoadSettings, Visit, places_of
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

NUM_VISITORS = 4
PATIENCE = 240.0
"""Seconds that anything may take: the machine may be busy."""


@pytest.fixture(autouse=True)
def patient(monkeypatch):
    monkeypatch.setattr(load, "SETTINGS", LoadSettings(first_picture=PATIENCE, settled=0.0, patience=PATIENCE))


@pytest.fixture(scope="module")
def url(fits, robot):
    """Address of a server in this process."""
    server = Server(TASKS, fits, robot, task="draw_s", port=0, max_sessions=NUM_VISITORS)
    yield f"ws://127.0.0.1:{server.port}"
    server.close()


@pytest.fixture
def visit():
    """A visitor who has sent four edits, 0.1 s apart, since 5 s."""
    client: Any = SimpleNamespace(nodes={ANSWERED: {}}, num_bytes=0)
    places = places_of(TASKS["draw_s"](), 0, 4)
    return Visit(client, {place: k for k, place in enumerate(places)}, [5.0, 5.1, 5.2, 5.3])


def show(visit, edit, now):
    """Send a picture of the rollouts for the place of an edit, of 1 kB."""
    visit.client.nodes[ANSWERED]["position"] = next(at for at, number in visit.edits.items() if number == edit)
    visit.client.num_bytes += 1000
    visit.see(ROLLOUT, {"vertices": None}, now)


def test_who_watches_sees_the_edits_of_another_answered(visit):
    client: Any = SimpleNamespace(nodes={ANSWERED: {}}, num_bytes=0)
    viewer = Visit(client)
    viewer.watch(visit)
    viewer.client.nodes[ANSWERED]["position"] = next(at for at, number in visit.edits.items() if number == 2)
    viewer.client.changed(ROLLOUT, {"vertices": None}, 5.25)
    figures = viewer.figures(0.4)
    assert figures["latency_ms"] == {"median": pytest.approx(50), "p95": pytest.approx(50), "worst": pytest.approx(50)}
    assert not viewer.last_shown and not visit.seen


def test_places_are_on_a_circle_in_the_slice_around_the_obstacle_and_none_comes_twice():
    task = TASKS["draw_s"]()
    places = places_of(task, 3, 500)
    offset = np.array(places) - task.obstacle_position
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), SETTINGS.radius, rtol=1e-3)
    np.testing.assert_allclose(offset @ np.cross(*task.slice.axes.T), 0, atol=1e-12)
    assert len(set(places) | set(places_of(task, 4, 500))) == 1000


def test_a_picture_answers_the_edit_of_its_place_and_only_new_answers_count(visit):
    show(visit, 0, 5.06)
    show(visit, 0, 5.08)  # refined
    show(visit, 2, 5.25)
    show(visit, 1, 5.26)  # older than what was shown
    visit.see(ROLLOUT, {"visible": True}, 5.27)
    visit.see("another", {"vertices": None}, 5.27)
    assert not visit.last_shown
    show(visit, 3, 5.35)
    assert visit.last_shown
    figures = visit.figures(0.3)
    assert figures["pictures_per_s"] == pytest.approx(2 / 0.3)  # the last came after the drag
    assert figures["gap_ms"] == pytest.approx({"median": 60.0, "p95": 177.0, "worst": 190.0})
    assert figures["latency_ms"] == pytest.approx({"median": 50.0, "p95": 59.0, "worst": 60.0})
    assert figures["bytes"] == 2000
    assert figures["answered"] == 1


def test_an_edit_is_answered_by_a_picture_of_it_or_of_a_later_one_in_time(visit):
    assert visit.answered == 0
    show(visit, 0, 5.06)
    show(visit, 2, 5.65)  # in time for edit 2, of 5.2 s, but not for edit 1
    assert visit.answered == pytest.approx(2 / 4)
    show(visit, 3, 5.81)
    assert visit.answered == pytest.approx(2 / 4)
    assert Visit(visit.client).answered is None


def test_in_a_lecture_a_quarter_drags_and_one_in_twenty_changes_the_task():
    rest, lecture, all_drag = (
        Namespace(rest=rest, lecture=lecture, present=False)
        for rest, lecture in ((True, False), (False, True), (False, False))
    )
    roles = [load.roles_of(options, 40) for options in (rest, lecture, all_drag)]
    assert [sum(role.name.startswith("DRAG") for role in each) for each in roles] == [0, 10, 40]
    assert [sum(role.name == "CHANGE_TASK" for role in each) for each in roles] == [0, 2, 0]
    for turn in (0, 1):  # two processes take visitors in turn
        assert 2 < sum(role.name.startswith("DRAG") for role in roles[1][turn::2]) < 8


@pytest.mark.anyio
async def test_who_has_dragged_nothing_waits_for_no_picture_and_drags_begin_out_of_step(visit, monkeypatch):
    assert Visit(visit.client).last_shown
    begun = []

    async def drag(self, places):
        begun.append(places)

    async def sleep(seconds):
        begun.append(seconds)

    monkeypatch.setattr(Visit, "drag", drag)
    monkeypatch.setattr(asyncio, "sleep", sleep)
    await visit.drag_in_bursts([(float(k), 0.0, 0.0) for k in range(200)], 0.5)
    waited, first, pause, second, _ = begun
    assert (waited, first[0][0], len(first), pause, second[0][0], len(second)) == (3.0, 60, 40, SETTINGS.pause, 180, 20)


def test_a_place_that_nobody_asked_for_answers_nothing(visit):
    visit.see(ROLLOUT, {"vertices": None}, 5.1)
    visit.client.nodes[ANSWERED]["position"] = (0.1, 0.2, 0.3)
    visit.see(ROLLOUT, {"vertices": None}, 5.2)
    figures = visit.figures(0.3)
    assert figures["pictures_per_s"] == 0 and figures["latency_ms"] is None and not figures["last_shown"]
    assert figures["gap_ms"]["worst"] == pytest.approx(300.0)  # nothing came for as long as it dragged


def test_who_is_lost_saw_nothing_for_the_rest_of_the_drag(visit):
    show(visit, 3, 5.35)
    assert visit.figures(10.0)["last_shown"]
    visit.lost = "gone"
    figures = visit.figures(10.0)
    assert figures["pictures_per_s"] == pytest.approx(0.1) and figures["gap_ms"]["worst"] == pytest.approx(9650.0)
    assert not figures["last_shown"]
    nothing = Visit(visit.client, lost="before the first edit").figures(10.0)
    assert nothing["pictures_per_s"] == 0 and nothing["gap_ms"]["worst"] == pytest.approx(1e4)


@pytest.mark.long
def test_all_visitors_who_come_and_drag_at_once_are_shown_their_last_edit(tmp_path, capsys, url):
    out = tmp_path / "load.json"
    arguments = ["--clients", "1", f"{NUM_VISITORS}", "--seconds", "0.5", "--url", url, "--out", str(out)]
    assert main(["load", *arguments]) == 0
    figures = json.loads(out.read_text())
    assert [len(visits["visitors"]) for visits in figures["visits"]] == [1, NUM_VISITORS]
    for visits in figures["visits"]:
        assert all(0 < first < PATIENCE for first in visits["first_picture_s"])
        assert 0 < visits["ping_ms"]["median"] <= visits["ping_ms"]["p95"] <= visits["ping_ms"]["worst"]
        for visitor in visits["visitors"]:
            assert visitor["last_shown"] and not visitor["lost"]
            assert 0 <= visitor["pictures_per_s"] <= SETTINGS.edits_per_second
            assert 0 < visitor["latency_ms"]["median"] <= visitor["latency_ms"]["p95"]
    assert figures["unit_ms"] > 0
    assert f"{NUM_VISITORS} of {NUM_VISITORS}" in capsys.readouterr().out


@pytest.mark.slow
def test_who_gives_way_is_chosen_and_visitors_of_a_started_server_who_look_on_cost_something(tmp_path, capsys):
    out = tmp_path / "rest.json"
    assert main(["load", "--rest", "--avoid", "off", "--clients", "1", "--seconds", "0.8", "--out", str(out)]) == 0
    (visits,) = json.loads(out.read_text())["visits"]
    assert 0 < visits["cores"] < 4 and visits["messages_per_s"] > 1 and visits["memory_mb"] > 50
    assert visits["visitors"] == [{"lost": ""}]
    assert as_text(visits["cores"]) in capsys.readouterr().out


def test_who_gets_no_picture_in_time_fails_the_measurement(monkeypatch, capsys, url):
    monkeypatch.setattr(load, "SETTINGS", LoadSettings(first_picture=0.0, settled=0.0))
    assert main(["load", "--clients", "1", "--seconds", "1", "--url", url]) == 1


def test_a_server_that_is_not_there_fails_the_measurement(capsys):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        unused = probe.getsockname()[1]
    assert main(["load", "--clients", "1", "--seconds", "1", "--url", f"ws://127.0.0.1:{unused}"]) == 1
    assert "a visitor was lost" in capsys.readouterr().err


def test_what_is_no_address_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["load", "--url", "127.0.0.1:8080"])
    assert "found '127.0.0.1:8080'; accepted: ws:// or wss://" in capsys.readouterr().err
