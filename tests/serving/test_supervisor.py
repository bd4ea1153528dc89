"""Several processes serve one address: who gets a connection, and what happens when one of them ends or hangs."""

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from contextlib import closing, contextmanager, suppress
from pathlib import Path

import pytest
from pages import PATIENCE, wait_until
from serving.small_server import RECENT

from dt_viz.serving.supervisor import several_reason

pytestmark = pytest.mark.skipif(bool(several_reason()), reason=several_reason())
SMALL = Path(__file__).with_name("small_server.py")  # program that it is tried with


@contextmanager
def serving(*arguments):
    """The process that accepts, and visits to it."""
    program = [sys.executable, str(SMALL), *arguments]
    with subprocess.Popen(program, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        patience = threading.Timer(4 * PATIENCE, process.kill)  # of who reads a line that never comes
        patience.start()
        try:
            assert process.stdout is not None
            with closing(Visits(int(process.stdout.readline()))) as visits:
                yield process, visits
        finally:
            patience.cancel()
            process.terminate()
            process.wait(PATIENCE)


class Visits:
    """Connections to a port, all closed in the end."""

    def __init__(self, port):
        self.port, self._open = port, []

    def close(self):
        for connection in self._open:
            connection.close()
        self._open.clear()

    def connected(self, patience=PATIENCE):
        connection = socket.create_connection(("127.0.0.1", self.port), timeout=patience)
        self._open.append(connection)
        return connection

    def asked(self, *, held=False, patience=PATIENCE):
        """Number of the process that answers; it holds the connection until it is closed, or ends it."""
        connection = self.connected(patience)
        connection.sendall(b"GET / HTTP/1.1\r\n" + held * b"Upgrade: WebSocket\r\n" + b"\r\n")
        return answer(connection)

    def holders(self, number):
        """How many connections each process holds; all ask before any is answered."""
        held = [self.connected() for _ in range(number)]
        for connection in held:
            connection.sendall(b"GET / HTTP/1.1\r\nUpgrade: websocket\r\n\r\n")
        return Counter(map(answer, held))

    def both(self):
        """The numbers of both processes."""
        found = [self.asked(held=True) for _ in range(2)]
        self.close()
        assert len({*found}) == 2
        return found

    def all_ended(self):
        return all(connection.recv(100) == b"" for connection in self._open)


def answer(connection):
    pid, peer = connection.recv(100).split()
    assert peer == b"127.0.0.1"  # known to the process that answers, not only to the one that accepts
    return int(pid)


def is_alive(pid):
    with suppress(ProcessLookupError):
        os.kill(pid, 0)
        return True
    return False


@pytest.mark.long
def test_visitors_who_come_at_once_are_spread_evenly():
    with serving() as (_, visits):
        assert sorted(visits.holders(20).values()) == [10, 10]


@pytest.mark.long
def test_who_comes_goes_where_the_fewest_are_whatever_was_requested_between():
    with serving() as (_, visits):
        busy = visits.asked(held=True)
        with closing(Visits(visits.port)) as others:
            for _ in range(3):
                time.sleep(2 * RECENT)  # what was handed over a moment ago counts no more, only who is there
                others.asked()
                assert others.asked(held=True) != busy
                others.close()


@pytest.mark.long
def test_another_process_takes_the_place_of_one_that_is_killed_while_the_other_serves():
    with serving() as (process, visits):
        for _ in range(2):
            time.sleep(2 * RECENT)
            killed, other = visits.both()
            os.kill(killed, signal.SIGKILL)
            wait_until(lambda killed=killed: not is_alive(killed))
            for _ in range(5):
                visits.asked(patience=5.0)
            wait_until(lambda killed=killed: killed not in {visits.asked(held=True), visits.asked(held=True)})
            visits.close()
            time.sleep(2 * RECENT)
            assert {other} < {*visits.both()} - {killed}
        process.terminate()
        assert process.stderr is not None
        assert process.stderr.read().count("another one takes its place") == 2


@pytest.mark.long
def test_a_process_that_does_not_answer_gets_nobody_and_is_replaced():
    with serving("", "4") as (_, visits):
        time.sleep(2 * RECENT)
        visits.asked(held=True)  # the fewest are where nothing answers
        stuck = visits.asked()
        os.kill(stuck, signal.SIGSTOP)
        time.sleep(1.5)
        for _ in range(10):
            visits.asked()  # what the stuck one is given ends unanswered, with it
        visits.close()
        wait_until(lambda: not is_alive(stuck))
        time.sleep(2 * RECENT)
        assert stuck not in visits.both()


def test_a_process_that_begins_slowly_is_no_stuck_one():
    with serving("slow", "0.5") as (_, visits):
        assert all(map(is_alive, visits.both()))


@pytest.mark.parametrize("stopped", [True, False])
def test_where_all_stood_still_none_is_a_stuck_one(stopped):
    """As where a machine, or a container, is suspended for a while."""
    with serving("", "1.2") as (process, visits):
        both = visits.both()
        for signal_ in (signal.SIGSTOP, signal.SIGCONT):
            for pid in (*[process.pid] * stopped, *both):  # at first the one that looks after the others
                with suppress(ProcessLookupError):
                    os.kill(pid, signal_)
            time.sleep(2.0)
        assert [is_alive(pid) for pid in both] == [stopped, stopped]


def test_processes_that_cannot_begin_end_all_with_their_status():
    program = [sys.executable, str(SMALL), "fails"]
    assert subprocess.run(program, check=False, timeout=PATIENCE).returncode == 3


def test_a_signal_while_a_process_is_forked_ends_all_in_time():
    result = subprocess.run(
        [sys.executable, str(SMALL), "signalled"], check=False, timeout=PATIENCE, capture_output=True
    )
    assert (result.returncode, result.stdout, result.stderr) == (0, b"", b"")


@pytest.mark.long
@pytest.mark.parametrize("kind", ["", "stubborn"])
def test_a_signal_ends_all_in_time(kind):
    with serving(kind) as (process, visits):
        pids = visits.both()
        visits.holders(4)
        began = time.monotonic()
        process.terminate()
        assert process.wait(PATIENCE) == 0
        assert time.monotonic() - began < 20  # 3 s where nothing else runs
        assert not any(map(is_alive, pids))
        assert visits.all_ended()


@pytest.mark.long
def test_no_process_outlives_the_one_that_accepts():
    with serving() as (process, visits):
        pids = visits.both()
        process.kill()
        wait_until(lambda: not any(map(is_alive, pids)))


def test_who_connects_and_asks_for_nothing_holds_up_nobody():
    with serving() as (_, visits):
        for _ in range(250):
            visits.connected()
        assert visits.asked()
