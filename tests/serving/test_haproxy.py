"""Two servers behind HAProxy, with the configuration that is shipped: one is drained, one is killed."""

import asyncio
import os
import shutil
import socket
import subprocess
import tempfile
import time
from contextlib import AsyncExitStack, ExitStack
from pathlib import Path

import pytest
from demo import PATIENCE, address, started

from dt_viz.evaluate.protocol_client import OBSTACLE, LostError, ProtocolClient
from dt_viz.serving.listening import listen

CONFIGURATION = Path(__file__).parents[2] / "assets" / "serving" / "haproxy.cfg"
PLACE = (0.1, -0.5, 0.345)
HAPROXY = shutil.which("haproxy", path=os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"]))
pytestmark = pytest.mark.skipif(
    HAPROXY is None and not os.environ.get("DT_VIZ_REQUIRE_BROWSER"), reason="HAProxy is not installed"
)


def free_port():
    with listen("127.0.0.1", 0) as unused:
        return unused.getsockname()[1]


def command(control, text):
    """Answer of HAProxy to a command."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.connect(str(control))
        connection.sendall(f"{text}\n".encode())
        return b"".join(iter(lambda: connection.recv(4096), b"")).decode()


def states(control):
    """State of each server, and how many connections it has."""
    lines = [line.split(",") for line in command(control, "show stat").splitlines()]
    return {line[1]: (line[17], int(line[4])) for line in lines if line[0] == "servers" and line[1] in ("one", "two")}


async def until(condition):
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline, "waited in vain"
        await asyncio.sleep(0.1)


async def with_picture(stack, url, storage=()):
    """A visitor whose browser has kept something."""
    client = ProtocolClient(url, origin=url.replace("ws", "http"))
    client.storage.update(storage)
    await stack.enter_async_context(client)
    await client.look()
    assert await client.wait_for(lambda: client.has_picture, PATIENCE)
    return client


async def visit(url, control, servers):
    await until(control.exists)
    await until(lambda: all(state == "UP" for state, _ in states(control).values()))
    async with AsyncExitStack() as stack:
        first = await with_picture(stack, url)
        kept, killed = sorted(servers, key=lambda name: states(control)[name][1], reverse=True)  # any of both is first
        second = await with_picture(stack, url)
        assert [num for _, num in states(control).values()] == [1, 1]  # where the fewest are
        command(control, f"set server servers/{kept} state drain")
        third = await with_picture(stack, url)
        assert states(control)[killed][1] == 2  # nobody comes to a server that is drained,
        for client in (first, second, third):
            assert not await client.wait_for(lambda client=client: client.lost, 1.0)  # and nobody is sent away
        command(control, f"set server servers/{kept} state ready")
        await second.grab()
        await second.move(PLACE)
        await second.release()
        await until(lambda: any("0.345" in text for text in second.storage.values()))
        servers[killed].kill()
        for client in (second, third):
            with pytest.raises(LostError):
                await client.wait_for(lambda: False, PATIENCE)
        await until(lambda: states(control)[killed][0] == "DOWN")
        again = await with_picture(stack, url, second.storage)
        assert again.nodes[OBSTACLE]["position"] == pytest.approx(PLACE)  # where he had put it
        await with_picture(stack, url)
        assert states(control)[kept][1] == 3
        assert not first.lost


@pytest.mark.long
def test_one_server_is_drained_and_one_is_killed(cache):
    assert HAPROXY is not None, "install it: apt-get install haproxy"
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))  # the name of a Unix socket is short
        control, port = folder / "control", free_port()
        origin = f"http://127.0.0.1:{port}"
        servers = {
            name: stack.enter_context(started(cache, "--processes", "1", "--allow-origin", origin))
            for name in ("one", "two")
        }
        text = CONFIGURATION.read_text().replace("/tmp/haproxy.sock", str(control))
        for number, server in zip((8081, 8082), servers.values(), strict=True):
            text = text.replace(f" 127.0.0.1:{number}", f" {address(server).removeprefix('ws://')}")
        (folder / "haproxy.cfg").write_text(text)
        proxy = stack.enter_context(
            subprocess.Popen(
                [HAPROXY, "-f", str(folder / "haproxy.cfg")],
                env=os.environ | {"BIND": f"127.0.0.1:{port}"},
                stderr=subprocess.PIPE,
            )
        )
        stack.callback(proxy.kill)
        asyncio.run(visit(f"ws://127.0.0.1:{port}", control, servers))
