"""Servers behind proxies with the configurations that are shipped.

nginx and Caddy ask for a password and end TLS; behind HAProxy one of two servers is drained, and one is killed.
"""

import asyncio
import os
import shutil
import socket
import ssl
import subprocess
import tempfile
import threading
import time
import urllib.error
from contextlib import AsyncExitStack, ExitStack
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.request import HTTPBasicAuthHandler, HTTPPasswordMgrWithPriorAuth, HTTPSHandler, Request, build_opener

import pytest
from demo import PATIENCE, address, free_port, started, until
from protocol_client import ANSWERED, OBSTACLE, LostError, ProtocolClient

FOLDER = Path(__file__).parents[2] / "assets" / "serving"
PATHS = os.pathsep.join([os.environ.get("PATH", ""), "/usr/sbin"])
COMMANDS = {name: shutil.which(name, path=PATHS) or "" for name in ("nginx", "caddy", "haproxy")}
NAME, PASSWORD = "lecturer", "attractor"
PLACE = (0.1, -0.5, 0.345)
FORGED = "203.0.113.9"


@pytest.fixture(scope="module")
def certificate(tmp_path_factory):
    """A certificate of this machine's name, and its key."""
    folder = tmp_path_factory.mktemp("certificate")
    certificate, key = folder / "localhost.pem", folder / "localhost.key"
    command = ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost"]
    where = ["-addext", "subjectAltName=DNS:localhost", "-out", str(certificate), "-keyout", str(key)]
    subprocess.run(command + where, check=True, capture_output=True)
    return certificate, key


def substituted(name, changes):
    """A shipped file with what its user puts into it; each must be there."""
    text = (FOLDER / name).read_text()
    for shipped, own in changes.items():
        assert shipped in text, f"{name} has no {shipped!r}"
        text = text.replace(shipped, own)
    return text


def nginx(folder, port, upstream, certificate, key):
    """Command that runs nginx with the shipped file."""
    made = subprocess.run(["openssl", "passwd", "-apr1", PASSWORD], check=True, capture_output=True, text=True)
    (folder / "htpasswd").write_text(f"{NAME}:{made.stdout}")
    changes = {
        "127.0.0.1:8081": upstream,
        "listen 443": f"listen 127.0.0.1:{port}",
        "/etc/ssl/demo.example.org.pem": str(certificate),
        "/etc/ssl/demo.example.org.key": str(key),
        "demo.example.org": "localhost",
        "/etc/nginx/dt-viz.htpasswd": str(folder / "htpasswd"),
        "/var/log/nginx/dt-viz.log": str(folder / "access.log"),
    }
    places = "".join(
        f"{kind}_temp_path {folder}/{kind};" for kind in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    around = f"daemon off; pid {folder}/pid; error_log stderr; events {{}} http {{ access_log off; {places}"
    owner = "user root;" if os.geteuid() == 0 else ""
    (folder / "nginx.conf").write_text(f"{owner} {around}\n{substituted('nginx.conf', changes)}\n}}")
    return [COMMANDS["nginx"], "-p", str(folder), "-c", str(folder / "nginx.conf"), "-e", "stderr"]


def caddy(folder, port, upstream, certificate, key):
    """Command that runs Caddy with the shipped file."""
    version = subprocess.run([COMMANDS["caddy"], "version"], check=True, capture_output=True, text=True).stdout
    hashed = [COMMANDS["caddy"], "hash-password", "--plaintext", PASSWORD]
    password = subprocess.run(hashed, check=True, capture_output=True, text=True).stdout.strip()
    old = [int(number) for number in version.split()[0].lstrip("v").split(".")[:2]] < [2, 8]
    changes = {
        "127.0.0.1:8081": upstream,
        "demo.example.org {": f"https://localhost:{port} {{\n\tbind 127.0.0.1\n\ttls {certificate} {key}",
        "$2a$14$REPLACE_WITH_THE_HASH": password,
        "basic_auth {": "basicauth {" if old else "basic_auth {",
    }
    own = "{\n\tadmin off\n\tauto_https disable_redirects\n}\n"
    (folder / "Caddyfile").write_text(own + substituted("Caddyfile", changes))
    return [COMMANDS["caddy"], "run", "--adapter", "caddyfile", "--config", str(folder / "Caddyfile")]


@pytest.fixture(params=["nginx", "caddy"])
def behind(request, tmp_path, certificate):
    """What runs the proxy before a server, and the port under which it answers."""
    kind = request.param
    if not COMMANDS[kind]:
        pytest.skip(f"{kind} is not installed")
    port = free_port()
    with ExitStack() as stack:

        def run(upstream):
            command = globals()[kind](tmp_path, port, upstream, *certificate)
            own = {"HOME": str(tmp_path), "XDG_DATA_HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
            log = stack.enter_context((tmp_path / "log").open("w"))
            process = stack.enter_context(subprocess.Popen(command, env=os.environ | own, stdout=log, stderr=log))
            stack.callback(process.terminate)
            deadline = time.monotonic() + PATIENCE
            while True:
                assert process.poll() is None and time.monotonic() < deadline, (tmp_path / "log").read_text()
                try:
                    return socket.create_connection(("127.0.0.1", port)).close()
                except ConnectionRefusedError:
                    time.sleep(0.05)

        yield run, port


def answer(port, certificate, path="/", password=PASSWORD, **headers):
    """Status, headers and content of a page behind the proxy."""
    passwords = HTTPPasswordMgrWithPriorAuth()
    page = f"https://localhost:{port}{path}"
    passwords.add_password(None, page, NAME, password, is_authenticated=True)
    context = ssl.create_default_context(cafile=str(certificate))
    opener = build_opener(HTTPSHandler(context=context), HTTPBasicAuthHandler(passwords))
    try:
        with opener.open(Request(page, headers=headers), timeout=PATIENCE) as response:
            return response.status, response.headers, response.read()
    except urllib.error.HTTPError as error:
        return error.code, error.headers, error.read()


class Telling(BaseHTTPRequestHandler):
    """A server that answers with the addresses that it is told."""

    def do_GET(self):
        content = "|".join(self.headers.get_all("X-Forwarded-For") or ()).encode()
        self.send_response(200)
        self.send_header("Content-Length", str(len(content)))
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, format, *args):
        pass


@pytest.mark.long
def test_nobody_gets_in_without_the_password_or_under_another_address(behind, certificate, tmp_path):
    run, port = behind
    with ThreadingHTTPServer(("127.0.0.1", 0), Telling) as telling:
        threading.Thread(target=telling.serve_forever).start()
        try:
            run(f"127.0.0.1:{telling.server_port}")
            told = answer(port, certificate[0], **{"X-Forwarded-For": FORGED})
            assert (told[0], told[2]) == (200, b"127.0.0.1")
            status, headers, _ = answer(port, certificate[0], password="wrong")
            assert status == 401 and headers["WWW-Authenticate"].startswith("Basic")
            assert answer(port, certificate[0], "/metrics")[0] == 404
            assert answer(port, certificate[0], "/?present=the-key")[0] == 200
        finally:
            telling.shutdown()
    logs = [log.read_text() for log in (tmp_path / "log", tmp_path / "access.log") if log.exists()]
    assert not any("the-key" in log for log in logs)


@pytest.mark.long
def test_a_visitor_drags_behind_it(behind, certificate, cache, monkeypatch):
    run, port = behind
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate[0]))
    origin = f"https://localhost:{port}"
    with started(cache, "--allow-origin", origin, patience=3 * PATIENCE) as server:
        run(address(server).removeprefix("ws://"))
        status, headers, content = answer(port, certificate[0])
        assert status == 200 and b'<div id="root">' in content and headers["X-Content-Type-Options"] == "nosniff"

        async def visit():
            async with ProtocolClient(f"wss://{NAME}:{PASSWORD}@localhost:{port}", origin=origin) as client:
                assert await client.look_until_drawn(PATIENCE)
                await client.grab()
                await client.move(PLACE)
                await client.release()
                assert await client.wait_for(lambda: client.nodes[ANSWERED]["position"] == pytest.approx(PLACE), 60.0)

        asyncio.run(visit())


# --- HAProxy ---


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


async def with_picture(stack, url, storage=()):
    """A visitor whose browser has kept something."""
    client = ProtocolClient(url, origin=url.replace("ws", "http"))
    client.storage.update(storage)
    await stack.enter_async_context(client)
    assert await client.look_until_drawn(PATIENCE)
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
@pytest.mark.skipif(not COMMANDS["haproxy"], reason="HAProxy is not installed")
def test_one_server_is_drained_and_one_is_killed(cache):
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))  # the name of a Unix socket is short
        control, port = folder / "control", free_port()
        origin = f"http://127.0.0.1:{port}"
        servers = {
            name: stack.enter_context(started(cache, "--processes", "1", "--allow-origin", origin))
            for name in ("one", "two")
        }
        text = (FOLDER / "haproxy.cfg").read_text().replace("/tmp/haproxy.sock", str(control))
        for number, server in zip((8081, 8082), servers.values(), strict=True):
            text = text.replace(f" 127.0.0.1:{number}", f" {address(server).removeprefix('ws://')}")
        (folder / "haproxy.cfg").write_text(text)
        proxy = stack.enter_context(
            subprocess.Popen(
                [COMMANDS["haproxy"], "-f", str(folder / "haproxy.cfg")],
                env=os.environ | {"BIND": f"127.0.0.1:{port}"},
                stderr=subprocess.PIPE,
            )
        )
        stack.callback(proxy.kill)
        asyncio.run(visit(f"ws://127.0.0.1:{port}", control, servers))
