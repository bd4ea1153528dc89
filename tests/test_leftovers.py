"""What a test leaves behind is found."""

import socket
import subprocess
import sys
import tempfile
import threading
from pathlib import Path

import leftovers
import pytest


@pytest.fixture(autouse=True)
def _soon(monkeypatch):
    """Nothing here goes by itself, so nothing is waited for."""
    monkeypatch.setattr(leftovers, "PATIENCE", 0.1)


def test_a_thread_is_found_and_nothing_where_nothing_is_left():
    began, before, end = leftovers.now(), leftovers.found(), threading.Event()
    assert leftovers.left_behind(before, began) == set()
    thread = threading.Thread(target=end.wait, name="forgotten")
    thread.start()
    (left,) = leftovers.left_behind(before, began)
    end.set()
    thread.join()
    assert left.startswith("thread forgotten")


@pytest.mark.skipif(not leftovers.PROC.exists(), reason="processes and ports are found in Linux's way")
def test_a_process_and_a_port_are_found():
    began, before = leftovers.now() - 0.1, leftovers.found()
    command = [sys.executable, "-c", "input()"]
    with socket.create_server(("127.0.0.1", 0)) as server, subprocess.Popen(command, stdin=subprocess.PIPE) as process:
        port = server.getsockname()[1]
        left = leftovers.left_behind(before, began)
        later = leftovers.left_behind(before, leftovers.now() + 1)
        process.communicate(b"\n")
    assert f"port {port}" in left
    assert any(words.startswith(f"process {process.pid}: ") for words in left)
    assert not any(words.startswith("process") for words in later)


def test_a_file_is_found():
    began, before = leftovers.now(), leftovers.found()
    file = Path(tempfile.gettempdir()) / "forgotten"
    file.touch()
    left = leftovers.left_behind(before, began)
    file.unlink()
    assert left == {f"file {file}"}
