"""Many visitors at once, without browsers, and the measurement that opens and drags them."""

import asyncio
import json
from contextlib import AsyncExitStack

import numpy as np
import pytest

from dt_viz.evaluate import load
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.protocol_client import ProtocolClient
from dt_viz.scenario.tasks import TASKS
from dt_viz.ui.server import Server

NUM_VISITORS = 8
NUM_POSES = 12
"""Number of poses to drag to: more than a visitor's edits here."""
PATIENCE = 240.0
"""Seconds that anything may take: the machine may be busy."""


@pytest.fixture(scope="module", autouse=True)
def few(cache):
    """Fewer poses, as near to each other; and what is learned is known to the servers and the measurement."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(load, "RADIUS", load.RADIUS * NUM_POSES / load.NUM_POSES)
        patch.setattr(load, "NUM_POSES", NUM_POSES)
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


@pytest.fixture(scope="module")
def poses(few, engine):
    return load.Poses(engine, engine.task("draw_s"))


def shown(poses, index, *, finest=False):
    """The rollout of a pose as a visitor is shown them."""
    frames = poses._frames(index)
    frame = next(frames)
    if finest:
        *_, frame = frames
    return poses._middle(frame)


def test_a_pose_is_found_by_its_rollouts(poses):
    assert [poses.find(shown(poses, index)) for index in (0, 4, 11)] == [0, 4, 11]
    assert poses.find(shown(poses, 4) + np.float32(1e-3)) is None


@pytest.mark.parametrize("finest", [False, True])
def test_rollouts_are_of_their_own_pose_only(poses, finest):
    rollouts = shown(poses, 7, finest=finest)
    assert poses.has(7, rollouts)
    assert not poses.has(8, rollouts)
    assert not poses.has(7, None)


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


def test_visitors_drag_in_a_started_server_and_are_shown_the_last_pose(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(load, "FIRST_PICTURE", PATIENCE)
    monkeypatch.setattr(load, "PATIENCE", PATIENCE)
    monkeypatch.setattr(load, "REST", 0.0)
    out = tmp_path / "load.json"
    assert main(["load", "--clients", "2", "--seconds", "0.5", "--rounds", "2", "--out", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert np.array(figures["first_picture_s"]).shape == (2, 2)
    assert [visitor["last_shown"] for visitor in figures["visitors"]] == [True, True]
    assert figures["frames"] == sum(visitor["frames"] for visitor in figures["visitors"]) > 0
    assert 0 < figures["median_ms"] <= figures["p95_ms"]
    printed = capsys.readouterr().out
    assert "round 2: 2 of 2 have a picture" in printed
    assert f"median {figures['median_ms']:.0f} ms" in printed


def test_visitors_who_look_on_cost_something(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(load, "FIRST_PICTURE", PATIENCE)
    monkeypatch.setattr(load, "SETTLED", 0.0)
    out = tmp_path / "rest.json"
    assert main(["load", "--rest", "--clients", "1", "--seconds", "3", "--out", str(out)]) == 0
    figures = json.loads(out.read_text())
    assert 0 < figures["core_percent"] < 400 and figures["messages_per_s"] > 1
    assert f"{figures['core_percent']:.1f} % of a core" in capsys.readouterr().out


def test_the_cost_of_a_server_that_runs_elsewhere_is_unknown(capsys, url):
    assert main(["load", "--rest", "--url", url]) == 2
    assert "--rest" in capsys.readouterr().err


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
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def test_what_is_no_address_is_refused(capsys):
    with pytest.raises(SystemExit):
        main(["load", "--url", "127.0.0.1:8080"])
    assert "found '127.0.0.1:8080'; accepted: ws:// or wss://" in capsys.readouterr().err
