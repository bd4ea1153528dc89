"""The demo in two processes: limits hold for both, a killed process loses no visitor and leaves nothing behind."""

import asyncio
import json
import os
import signal
import sys
import tempfile
import urllib.error
import urllib.request
from contextlib import AsyncExitStack
from pathlib import Path

import pytest
from browsing import take
from demo import PATIENCE, address, started, until
from protocol_client import LostError, ProtocolClient

from dt_viz.cli import _num_processes, main
from dt_viz.folders import PREFIX, TemporaryFolder
from dt_viz.serving import supervisor
from dt_viz.serving.supervisor import listen

pytestmark = pytest.mark.skipif(bool(supervisor.several_reason()), reason=supervisor.several_reason())


def health(url):
    """Status and content of the answer."""
    try:
        with urllib.request.urlopen(f"http{url.removeprefix('ws')}/health", timeout=PATIENCE) as response:
            return response.status, json.load(response)
    except urllib.error.HTTPError as error:
        with error:
            return error.code, json.load(error)


def workers(process):
    """Numbers of the processes that serve; only on Linux."""
    return [int(pid) for pid in Path(f"/proc/{process.pid}/task/{process.pid}/children").read_text().split()]


async def comes(stack, url):
    """A visitor who has asked for a page."""
    client = await stack.enter_async_context(ProtocolClient(url))
    await client.look()
    return client


async def fill_and_leave(url):
    """Two places in two processes; the third visitor has the place of whoever leaves, in whichever process."""
    async with AsyncExitStack() as all_stay:
        assert health(url)[0] == 200
        staying = await comes(all_stay, url)
        assert await staying.wait_for(lambda: staying.has_picture, PATIENCE)
        async with AsyncExitStack() as leaves:
            leaving = await comes(leaves, url)
            assert await leaving.wait_for(lambda: leaving.has_picture, PATIENCE)
            third = await comes(all_stay, url)
            await until(lambda: health(url)[1]["waiting"] == 1)
            status, told = health(url)
            assert (status, told["status"], told["visitors"], told["processes"]) == (503, "full", 2, 2)
            assert not await third.wait_for(lambda: third.has_picture, 2.0)
            assert any("All 2 places are taken" in control.get("_markdown", "") for control in third.controls.values())
        assert await third.wait_for(lambda: third.has_picture, PATIENCE)
        assert staying.has_picture


async def lose_and_return(process, url):
    """A process is killed: its visitor is lost, comes again, and has a picture; the other one feels nothing."""
    async with AsyncExitStack() as stack:
        clients = [await comes(stack, url) for _ in range(2)]
        for client in clients:
            assert await client.wait_for(lambda client=client: client.has_picture, PATIENCE)
        killed = workers(process)[0]
        os.kill(killed, signal.SIGKILL)
        lost = []
        for client in clients:
            try:
                await client.wait_for(lambda: False, 3.0)
            except LostError:
                lost.append(client)
        assert len(lost) == 1
        again = await comes(stack, url)
        assert await again.wait_for(lambda: again.has_picture, PATIENCE)
        await until(lambda: len({*workers(process)} - {killed}) == 2)
        assert health(url)[1]["visitors"] == 2
        assert next(client for client in clients if client not in lost).has_picture


@pytest.mark.long
@pytest.mark.skipif(not Path("/proc/self/task").exists(), reason="processes are looked up as Linux shows them")
def test_visitors_of_two_processes_share_the_places_and_lose_nothing_else_with_one_of_them(cache):
    with started(cache, "--processes", "2", "--max-sessions", "2") as process:
        url = address(process)
        asyncio.run(fill_and_leave(url))
        asyncio.run(until_empty(url))
        asyncio.run(lose_and_return(process, url))
        with urllib.request.urlopen(f"http{url.removeprefix('ws')}/metrics", timeout=PATIENCE) as response:
            assert b"\ndt_viz_process_restarts_total 1.0\n" in response.read()
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
        assert errors.count("\n") == 1
        assert "another one takes its place" in errors


async def until_empty(url):
    await until(lambda: health(url)[1]["visitors"] == 0)


def test_a_port_that_is_taken_is_said_in_one_line(capsys):
    with listen("127.0.0.1", 0) as listening:
        assert main(["--port", str(listening.getsockname()[1]), "--processes", "2"]) == 2
    errors = capsys.readouterr().err
    assert errors.count("\n") == 1
    assert "choose another port with --port" in errors


def test_where_the_system_has_no_several_processes_one_serves_and_it_is_said(monkeypatch, capsys):
    monkeypatch.setattr(supervisor, "several_reason", lambda: "there is no fork")
    assert (_num_processes(3), _num_processes(None), _num_processes(1)) == (1, 1, 1)
    assert capsys.readouterr().err == "dt-viz: --processes: one process serves all, as there is no fork\n"


def temporary():
    return set(Path(tempfile.gettempdir()).glob(f"{PREFIX}*"))


@pytest.mark.long
@pytest.mark.skipif(sys.platform != "linux", reason="folders are locked")
def test_what_a_killed_server_leaves_is_removed_at_the_next_start_and_nothing_of_a_living_one(cache):
    async def kill(process, before):
        async with ProtocolClient(address(process)) as client:
            assert await client.look_until_drawn(PATIENCE)
            await client.send_file("Open a file, or drop it here", "take.csv", take())
            assert await client.wait_for(lambda: temporary() > before, PATIENCE)
            process.send_signal(signal.SIGKILL)
            process.wait(PATIENCE)

    with TemporaryFolder() as living:
        before = temporary()
        with started(cache, "--processes", "1") as process:
            asyncio.run(kill(process, before))
        assert temporary() > before
        with started(cache) as process:
            address(process)
            assert temporary() == before
    assert temporary() == before - {Path(living)}
