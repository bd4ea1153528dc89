"""The store of fits: by content, once, and never from a file that is not whole."""

import os
import threading
import time
from dataclasses import replace
from io import BytesIO
from pathlib import Path

import numpy as np
import pytest

import dt_viz.learning.store
from dt_viz.folders import default_cache_folder
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import ImitationError, ImitationSettings, fit
from dt_viz.learning.store import FitStore

SETTINGS = ImitationSettings(num_layers=2, num_points=12, max_iterations=2)


def arcs(bend=1.0, num=2):
    s = np.linspace(0, 1, 30)
    return tuple(
        Demonstration(2 * s, np.stack([s - 1, (bend + 0.1 * k) * s * (1 - s)], axis=1), f"arc {k}") for k in range(num)
    )


@pytest.fixture(scope="module")
def learned():
    return fit(arcs(), SETTINGS)


@pytest.fixture
def counted(monkeypatch, learned):
    """Counts the fits; each gives the same result without the work."""
    calls = []

    def quick(demonstrations, settings, progress):
        calls.append(demonstrations)
        if progress is not None:
            progress(1.0, "done")
        return learned

    monkeypatch.setattr(dt_viz.learning.store, "fit", quick)
    return calls


def same(a, b):
    first, second = a.to_arrays(), b.to_arrays()
    return first.keys() == second.keys() and all(np.array_equal(first[k], second[k]) for k in first)


def stored(folder) -> Path:
    (path,) = folder.iterdir()
    return path


@pytest.mark.parametrize("in_memory_only", [True, False])
def test_a_fit_is_remembered_and_progress_reported_for_new_ones_only(tmp_path, counted, in_memory_only):
    store, reports = FitStore(None if in_memory_only else tmp_path), []
    first, again = (store.get(arcs(), SETTINGS, lambda *report: reports.append(report)) for _ in range(2))
    assert again is first
    assert len(counted) == 1 and reports == [(1.0, "done")]


def test_a_fit_is_read_back_exactly_by_the_next_process(tmp_path, counted):
    first, again = (FitStore(tmp_path).get(arcs(), SETTINGS) for _ in range(2))
    assert len(counted) == 1
    assert again is not first and same(again, first)
    times = np.linspace(0, 3, 9)
    expected = first.system.rollout(first.starts, times)
    np.testing.assert_array_equal(again.system.rollout(again.starts, times), expected)


def changed_position(demonstrations):
    positions = demonstrations[0].positions.copy()
    positions[3, 1] = np.nextafter(positions[3, 1], 1)
    return (replace(demonstrations[0], positions=positions), *demonstrations[1:])


@pytest.mark.parametrize(
    ("change", "settings", "num"),
    [
        (changed_position, SETTINGS, 2),
        (lambda d: (replace(d[0], times=1.001 * d[0].times), *d[1:]), SETTINGS, 2),
        (lambda d: d[:1], SETTINGS, 2),
        (lambda d: (*d, d[0]), SETTINGS, 2),
        (lambda d: d[::-1], SETTINGS, 2),
        (tuple, ImitationSettings(num_layers=3), 2),
        (lambda demonstrations: tuple(replace(d, name="other") for d in demonstrations), SETTINGS, 1),
    ],
    ids=["position", "times", "one less", "one more", "order", "settings", "names"],
)
def test_other_demonstrations_or_settings_are_another_entry_and_names_are_not(tmp_path, counted, change, settings, num):
    store = FitStore(tmp_path)
    store.get(arcs(), SETTINGS)
    store.get(change(arcs()), settings)
    assert len(counted) == len(list(tmp_path.iterdir())) == num


def rewrite(path, **changes):
    with np.load(path) as arrays:
        content = {name: arrays[name] for name in arrays.files}
    content.update(changes)
    np.savez(path, **{name: value for name, value in content.items() if value is not None})


def one_array():
    file = BytesIO()
    np.save(file, np.zeros(3))
    return file.getvalue()


DAMAGES = {
    "empty": lambda path: path.write_bytes(b""),
    "garbage": lambda path: path.write_bytes(np.random.default_rng(0).bytes(5000)),
    "truncated": lambda path: path.write_bytes(path.read_bytes()[: path.stat().st_size // 2]),
    "without its end": lambda path: path.write_bytes(path.read_bytes()[:-1]),
    "pickled": lambda path: np.savez(path, goal=np.array([{"a": 1}], dtype=object)),
    "one array, no archive": lambda path: path.write_bytes(one_array()),
    "another archive": lambda path: np.savez(path, something=np.zeros(3)),
    "a number instead of the goal": lambda path: rewrite(path, goal=np.array(1.0)),
    "a short base": lambda path: rewrite(path, base=np.zeros(1)),
    "no layer": lambda path: rewrite(path, layer_0_weights=None),
    "another dimension": lambda path: rewrite(path, goal=np.zeros(3)),
    "a folder": lambda path: (path.unlink(), path.mkdir()),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_file_is_fitted_anew_said_and_replaced_by_a_whole_one(tmp_path, counted, learned, caplog, damage):
    FitStore(tmp_path).get(arcs(), SETTINGS)
    DAMAGES[damage](stored(tmp_path))
    assert same(FitStore(tmp_path).get(arcs(), SETTINGS), learned)
    assert len(counted) == 2
    assert "damaged" in caplog.text
    if stored(tmp_path).is_file():  # nothing else is left
        FitStore(tmp_path).get(arcs(), SETTINGS)
        assert len(counted) == 2


def test_a_flipped_weight_is_noticed_even_where_numpy_reads_no_checksum(tmp_path, counted, learned, caplog):
    FitStore(tmp_path).get(arcs(), SETTINGS)
    path = stored(tmp_path)
    rewrite(path)  # the same, uncompressed: every flip changes a number and breaks no stream
    content = bytearray(path.read_bytes())
    place = content.find(learned.to_arrays()["layer_0_weights"].tobytes())
    content[place + 6] ^= 0x08
    path.write_bytes(bytes(content))
    assert same(FitStore(tmp_path).get(arcs(), SETTINGS), learned)
    assert len(counted) == 2


def test_a_folder_that_cannot_be_made_does_not_stop_the_fit(tmp_path, counted, learned, caplog):
    file = tmp_path / "file"
    file.write_text("in the way")
    assert FitStore(file / "folder").get(arcs(), SETTINGS) is learned
    assert "not cached" in caplog.text


def test_a_full_disk_does_not_stop_the_fit_and_leaves_nothing_behind(tmp_path, counted, learned, monkeypatch, caplog):
    def full(file, **_):
        file.write(b"half")
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(dt_viz.learning.store.np, "savez_compressed", full)
    assert FitStore(tmp_path).get(arcs(), SETTINGS) is learned
    assert "No space left" in caplog.text
    assert list(tmp_path.iterdir()) == []


def test_a_failed_fit_is_tried_again(tmp_path, monkeypatch, learned):
    answers = [ImitationError("too short"), learned]

    def failing(*_):
        if isinstance(answers[0], Exception):
            raise answers.pop(0)
        return answers[0]

    monkeypatch.setattr(dt_viz.learning.store, "fit", failing)
    store = FitStore(tmp_path)
    with pytest.raises(ImitationError, match="too short"):
        store.get(arcs(), SETTINGS)
    assert list(tmp_path.iterdir()) == []
    assert store.get(arcs(), SETTINGS) is learned


class Cancelled(Exception):
    """What a visitor's progress raises."""


@pytest.fixture
def gated(monkeypatch, learned):
    """Fits that report until they are let go on; one gate for each number of demonstrations."""
    gates = {num: threading.Event() for num in (1, 2)}
    noted = {"ended": threading.Semaphore(0), "calls": []}

    def slow(demonstrations, settings, progress):
        noted["calls"].append(len(demonstrations))
        try:
            while not gates[len(demonstrations)].wait(0.01):
                progress(0.5, "half")
            return learned
        finally:
            noted["ended"].release()

    monkeypatch.setattr(dt_viz.learning.store, "fit", slow)
    yield gates, noted
    for gate in gates.values():
        gate.set()


class Visitor:
    """Waits for a fit on a thread of its own, and may give up."""

    def __init__(self, store, num):
        self.result = self.error = None
        self.gives_up, self.reported = threading.Event(), threading.Event()
        self.thread = threading.Thread(target=self._run, args=(store, num))
        self.thread.start()

    def _run(self, store, num):
        try:
            self.result = store.get(arcs(num=num), SETTINGS, self._progress)
        except Cancelled as error:
            self.error = error

    def _progress(self, _fraction, message):
        if self.gives_up.is_set():
            raise Cancelled
        if message == "half":
            self.reported.set()

    def join(self):
        self.thread.join(30)
        assert not self.thread.is_alive()


def test_a_known_fit_does_not_wait_for_a_strangers_new_one(tmp_path, gated, learned):
    gates, _ = gated
    store = FitStore(tmp_path)
    gates[2].set()
    store.get(arcs(num=2), SETTINGS)
    stranger = Visitor(store, 1)
    assert stranger.reported.wait(30)
    for known in (store, FitStore(tmp_path)):  # in memory, and in the folder
        quick = Visitor(known, 2)
        quick.join()
        assert quick.result is not None
    assert stranger.thread.is_alive()
    gates[1].set()
    stranger.join()
    assert stranger.result is learned


@pytest.mark.parametrize("leaves", ["the maker", "another"])
def test_a_fit_is_made_once_for_all_who_wait_and_by_another_where_its_maker_gives_up(tmp_path, gated, learned, leaves):
    gates, noted = gated
    store = FitStore(tmp_path)
    visitors = []
    for _ in range(4):
        visitors.append(Visitor(store, 2))
        assert visitors[-1].reported.wait(30)  # each is told how far the fit is that the first one makes
    left = visitors.pop(0 if leaves == "the maker" else 1)
    left.gives_up.set()
    left.join()
    assert isinstance(left.error, Cancelled) and all(visitor.thread.is_alive() for visitor in visitors)
    gates[2].set()
    for visitor in visitors:
        visitor.join()
        assert visitor.result is learned
    assert noted["calls"] == ([2, 2] if leaves == "the maker" else [2])
    for _ in noted["calls"]:
        assert noted["ended"].acquire(timeout=30)  # what was given up does not go on
    assert [path.suffix for path in tmp_path.iterdir()] == [".npz"]


def test_who_waits_can_give_up_although_the_fit_says_nothing(tmp_path, monkeypatch, learned):
    release, begun = threading.Event(), threading.Event()

    def silent(*_):
        begun.set()
        assert release.wait(30)
        return learned

    monkeypatch.setattr(dt_viz.learning.store, "fit", silent)
    store = FitStore(tmp_path)
    maker = Visitor(store, 2)
    assert begun.wait(30)
    visitor = Visitor(store, 2)
    visitor.gives_up.set()
    visitor.join()
    assert isinstance(visitor.error, Cancelled)
    release.set()
    maker.join()
    assert maker.result is learned


def test_what_a_server_left_half_written_an_hour_ago_is_removed_at_the_next_start(tmp_path):
    left, fresh, whole = (tmp_path / name for name in ("a.1-2.partial", "b.3-4.partial", "c.npz"))
    for path, age in ((left, 3700), (fresh, 3500), (whole, 10**6)):
        path.touch()
        os.utime(path, (time.time() - age, time.time() - age))
    FitStore(tmp_path)
    assert set(tmp_path.iterdir()) == {fresh, whole}


def test_the_cache_folder_is_the_users(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_cache_folder() == tmp_path / "dt-viz"
    monkeypatch.setenv("XDG_CACHE_HOME", "")
    monkeypatch.setenv("HOME", str(tmp_path / "home"))
    assert default_cache_folder() == tmp_path / "home" / ".cache" / "dt-viz"
