"""Many visitors at once, without browsers, and the measurement that opens and drags them."""

import asyncio
import json
import socket
from contextlib import AsyncExitStack
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dt_viz.engine.frame import Stage
from dt_viz.evaluate import load
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.protocol_client import ROLLOUT, ProtocolClient
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

NUM_VISITORS = 4
NUM_POSES = 12
"""Number of poses to drag to: more than a visitor's edits here."""
PATIENCE = 240.0
"""Seconds that anything may take: the machine may be busy."""


@pytest.fixture(scope="module", autouse=True)
def few():
    """Fewer poses, as near to each other."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(load, "RADIUS", load.RADIUS * NUM_POSES / load.NUM_POSES)
        patch.setattr(load, "NUM_POSES", NUM_POSES)
        yield


class Displacing:
    """An engine whose rollouts pass 0.1 m beside the obstacle, a centimetre higher once they are refined."""

    def frames(self, scenario):
        path = np.array(scenario.obstacles[0].position) + np.linspace([-0.2, 0.1, 0], [0.2, 0.1, 0], 30)
        for stage in Stage:
            assert stage <= Stage.FINE, "nothing finer changes the rollouts"
            lifted = path + np.array([0, 0, 0.01 * (stage >= Stage.FINE)])
            yield SimpleNamespace(stage=stage, rollouts=(path + 1, lifted), chosen=1)


@pytest.fixture(scope="module")
def poses():
    engine: Any = Displacing()
    return load.Poses(engine, TASKS["draw_s"]())


def shown(poses, index, stage=Stage.ROLLOUTS):
    """The rollout of a pose as a visitor is shown it."""
    return poses._middle(next(frame for frame in poses._frames(index) if frame.stage is stage))


def test_poses_are_on_a_circle_in_the_slice_around_the_place_of_the_obstacle(poses):
    task = TASKS["draw_s"]()
    offset = np.array(poses.positions) - task.obstacle_position
    np.testing.assert_allclose(np.linalg.norm(offset, axis=1), load.RADIUS, rtol=1e-9)
    np.testing.assert_allclose(offset @ np.cross(*task.slice.axes.T), 0, atol=1e-12)
    assert len(np.unique(np.round(offset, 6), axis=0)) == NUM_POSES


def test_a_pose_is_found_by_its_first_rollouts_and_has_those_of_all_its_frames(poses):
    assert [poses.find(shown(poses, index)) for index in (0, 4, 11)] == [0, 4, 11]
    assert poses.find(shown(poses, 4) + np.float32(1e-3)) is None
    for stage in (Stage.ROLLOUTS, Stage.FINE):
        assert poses.has(7, shown(poses, 7, stage))
        assert not poses.has(8, shown(poses, 7, stage))
    assert not poses.has(7, None)


def test_the_latency_of_a_picture_is_the_time_since_the_edit_whose_pose_it_shows(poses):
    client: Any = SimpleNamespace(rollout=None)
    visit = load.Visit(client, poses, first=10, edits=[5.0, 5.1, 5.2, 5.3])
    for pose, stage in ((11, Stage.ROLLOUTS), (1, Stage.ROLLOUTS), (1, Stage.FINE), (9, Stage.ROLLOUTS)):
        client.rollout = shown(poses, pose, stage)  # edits are of the poses 10, 11, 0 and 1; 9 was before all
        visit._see(ROLLOUT, {"vertices": None}, 5.35)
    visit._see(ROLLOUT, {"visible": True}, 5.4)
    visit._see("another", {"vertices": None}, 5.4)
    np.testing.assert_allclose(visit.latencies, [0.25, 0.05])
    assert (visit.num_frames, visit.num_others) == (3, 1)
    client.rollout = shown(poses, 1, Stage.FINE)
    assert visit.shows_the_last_pose()
    client.rollout = shown(poses, 0)
    assert not visit.shows_the_last_pose()


async def first_pictures(url):
    """Whether each of several visitors that come at the same instant is shown something."""
    async with AsyncExitStack() as stack:
        clients = [ProtocolClient(url) for _ in range(NUM_VISITORS)]
        await asyncio.gather(*(stack.enter_async_context(client) for client in clients))
        await asyncio.gather(*(client.look() for client in clients))
        return await asyncio.gather(*(client.wait_for(lambda c=client: c.has_picture, PATIENCE) for client in clients))


@pytest.fixture(scope="module")
def url(fits):
    """Address of a server in this process."""
    server = Server(TASKS, fits, task="draw_s", port=0, max_sessions=NUM_VISITORS)
    yield f"ws://127.0.0.1:{server.port}"
    server.close()


def test_all_who_come_at_the_same_instant_get_their_picture(url):
    assert all(asyncio.run(first_pictures(url)))


def test_visitors_drag_and_are_shown_the_last_pose(tmp_path, monkeypatch, capsys, url):
    monkeypatch.setattr(load, "FIRST_PICTURE", PATIENCE)
    monkeypatch.setattr(load, "PATIENCE", PATIENCE)
    monkeypatch.setattr(load, "REST", 0.0)
    monkeypatch.setattr(load, "NUM_POSES", 6)
    out = tmp_path / "load.json"
    few = ["--clients", "2", "--seconds", "0.25", "--rounds", "2", "--url", url]
    assert main(["load", *few, "--out", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert np.array(figures["first_picture_s"]).shape == (2, 2)
    assert [visitor["last_shown"] for visitor in figures["visitors"]] == [True, True]
    assert figures["frames"] == sum(visitor["frames"] for visitor in figures["visitors"]) > 0
    assert 0 < figures["median_ms"] <= figures["p95_ms"]
    printed = capsys.readouterr().out
    assert "round 2: 2 of 2 have a picture" in printed
    assert f"median {figures['median_ms']:.0f} ms" in printed


def test_visitors_of_a_started_server_who_look_on_cost_something(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(load, "FIRST_PICTURE", PATIENCE)
    monkeypatch.setattr(load, "SETTLED", 0.0)
    out = tmp_path / "rest.json"
    assert main(["load", "--rest", "--clients", "1", "--seconds", "0.8", "--out", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert 0 < figures["core_percent"] < 400 and figures["messages_per_s"] > 1 and figures["peak_memory_mb"] > 50
    assert f"{figures['core_percent']:.1f} % of a core" in capsys.readouterr().out


def test_who_gets_no_picture_fails_the_measurement(monkeypatch, capsys, url):
    monkeypatch.setattr(load, "NUM_POSES", 1)
    monkeypatch.setattr(load, "FIRST_PICTURE", 0.0)
    assert main(["load", "--clients", "1", "--seconds", "1", "--url", url]) == 1
    assert "round 1: 0 of 1 have a picture" in capsys.readouterr().out


def test_a_server_that_is_not_there_fails_the_measurement(monkeypatch, capsys, unused_port):
    monkeypatch.setattr(load, "NUM_POSES", 1)
    assert main(["load", "--clients", "1", "--seconds", "1", "--url", f"ws://127.0.0.1:{unused_port}"]) == 1
    assert "a visitor was lost" in capsys.readouterr().err


@pytest.fixture
def unused_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_what_is_no_address_or_has_no_known_cost_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["load", "--url", "127.0.0.1:8080"])
    assert "found '127.0.0.1:8080'; accepted: ws:// or wss://" in capsys.readouterr().err
    assert main(["load", "--rest", "--url", "ws://127.0.0.1:8080"]) == 2  # of a server that runs elsewhere
    assert "--rest" in capsys.readouterr().err
