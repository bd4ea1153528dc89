"""What developers measure: latency, drags, exactness, off the demonstrations, and most figures in one sitting."""

import argparse
import asyncio
import json
from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hook import NUM_DEMONSTRATIONS

from dt_viz.evaluate.__main__ import main as evaluate
from dt_viz.evaluate.load import started
from dt_viz.evaluate.protocol_client import ProtocolClient
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.imitation import fit
from dt_viz.learning.timing import TimedAttractor
from dt_viz.metrics import discrete_frechet, distance_from_path
from dt_viz.obstacles import solids
from dt_viz.obstacles.files import read_mesh
from dt_viz.scenario.tasks import TASKS, known_tasks
from dt_viz.session.engine import Engine
from dt_viz.session.frame import Stage
from tests.benchmarks import drag, exactness, fairness, latency, sitting
from tests.benchmarks.__main__ import main
from tests.benchmarks.capacity import Cost, simulated
from tests.benchmarks.exactness import MAX_DEPARTURE, compare, stepped_adaptively, stepped_beside
from tests.benchmarks.latency import Recorder
from tests.benchmarks.learning import off_course
from tests.benchmarks.sitting import Subject
from tests.benchmarks.soak import Soaked

# --- soak ---

FIRST, SECOND, THIRD, MOVED = (("task", "arm", (x, 0.0, 0.0)) for x in (0.1, 0.2, 0.3, 0.4))


@pytest.mark.parametrize(
    ("found", "num_lost", "ages"),
    [
        (MOVED, 0, [0.0]),
        (THIRD, 0, [0.5]),  # the last edit, in part
        (SECOND, 0, [1.5]),  # the one before, whole
        (FIRST, 1, [2.5]),  # the one before, in part
        (("task", "arm", (0.5, 0.0, 0.0)), 1, []),  # what never was
        (("task", "hand", MOVED[2]), 1, []),
    ],
)
def test_the_edit_before_the_last_one_must_be_found_again_whole(found, num_lost, ages):
    visitor = Soaked("", 0, lambda: 0.0)
    visitor.had = [(10.0, 4, FIRST), (11.0, 4, SECOND), (12.0, 5, THIRD), (13.0, 5, MOVED), (14.0, 5, FIRST)]
    visitor.compare(found, lost=13.5)
    assert (visitor.num_lost, visitor.ages, visitor.num_unknown) == (num_lost, ages, 0)


def test_what_is_found_again_just_after_a_choice_is_not_compared():
    visitor = Soaked("", 0, lambda: 0.0)
    visitor.had = [(10.0, 4, FIRST), (11.0, 5, None)]
    visitor.compare(SECOND, lost=11.5)
    assert (visitor.num_lost, visitor.ages, visitor.num_unknown) == (0, [], 1)


# --- capacity ---


@pytest.mark.long
@pytest.mark.parametrize("num_visitors", [1, 12])
def test_a_simulated_process_answers_as_many_in_time_as_on_paper_while_it_has_time(num_visitors):
    cost = Cost(picture=0.04, looking=0.01, dragging=0.05)
    for within in (0.1, 0.5):
        part = simulated(cost, num_visitors, within, np.random.default_rng(num_visitors))
        assert part == pytest.approx(cost.answered(num_visitors, within), abs=0.12)


def test_more_visitors_of_a_process_are_answered_later_until_it_has_no_time_at_all():
    cost = Cost(picture=0.04, looking=0.02, dragging=0.1)
    parts = [cost.answered(number, 0.5) for number in range(1, 51)]
    assert parts[0] == pytest.approx(1) and max(np.diff(parts)) < 1e-12 and parts[-1] == 0
    largest = cost.largest(0.95, 0.5)
    assert parts[largest - 1] >= 0.95 > parts[largest]
    assert Cost(picture=0.6, looking=0.0, dragging=0.1).largest(0.95, 0.5) == 0


# --- latency, drag, scenes ---


@pytest.mark.long
@pytest.mark.parametrize("dragged", ["obstacle", pytest.param("bias --obstacles 0", marks=pytest.mark.slow)])
def test_latency_counts_every_edit_and_reports_both_stages(measured, dragged, monkeypatch):
    recorder, frames = Recorder(), Engine.frames

    def while_dragging(*scenario, **others):
        return (frame for frame in frames(*scenario, **others) if frame.stage <= Stage.LIVE)

    monkeypatch.setattr(Engine, "frames", while_dragging)  # what rests is refined, which is not measured
    monkeypatch.setattr(latency, "Recorder", lambda: recorder)
    monkeypatch.setattr(latency, "WARM_UP_SECONDS", 0.1)
    rows, ((counts,)) = measured("latency", f"--drag {dragged} --seconds 0.3", "json")
    assert counts["edits"] == 18 == counts["frames"] + counts["skipped"]
    by_stage = {stage: [frame[1:] for frame in recorder.frames if frame[0] is stage] for stage in Stage}
    expected = [1e3 * np.percentile(by_stage[stage], [50, 95], axis=0) for stage in (Stage.ROLLOUTS, Stage.LIVE)]
    for row, spread in zip(rows, np.concatenate([[each[:, k] for each in expected] for k in (0, 1)]), strict=True):
        assert [row["median ms"], row["p95 ms"]] == pytest.approx(spread)
        assert row["in units"] / row["median ms"] == pytest.approx(rows[0]["in units"] / rows[0]["median ms"])
    pairs = [pair for pair in pairwise(recorder.frames) if pair[1][0] is Stage.LIVE]
    assert pairs and all(before[2] < after[2] for before, after in pairs)  # seconds of the rollouts, of all of a frame


@pytest.mark.parametrize("shape", latency.SHAPES)
def test_an_obstacle_of_any_shape_is_dragged_by_its_middle(shape, monkeypatch):
    monkeypatch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=20_000))
    place, size = (0.1, -0.4, 0.3), 0.15
    vertices, _ = (obstacle := latency.SHAPES[shape](place, size)).surface()
    np.testing.assert_allclose((vertices.min(axis=0) + vertices.max(axis=0)) / 2, 0, atol=1e-3)
    assert obstacle.position == place and obstacle.signed_distance(np.array(place)) < -0.02
    if shape in ("sphere", "mesh"):
        on_sphere = np.array(place) + size / 2 * np.eye(3)
        np.testing.assert_allclose(obstacle.signed_distance(on_sphere), 0, atol=2e-3)


def test_a_drag_writes_every_step_and_counts_its_jumps(measured, monkeypatch):
    monkeypatch.setattr(drag, "JUMP", 0.015)
    monkeypatch.setattr(drag, "NUM_POINTS", 20)
    arrays, (rows,) = measured("drag", "--avoid hand --drags 1 --seed 0 --step 0.012 --diameter 0.1")
    rollouts, places = arrays["rollouts"], arrays["places"]
    assert rollouts.shape == (len(places), NUM_DEMONSTRATIONS, 20, 3)
    step = np.linalg.norm(np.diff(places, axis=0), axis=1)
    assert step.max() <= 0.012 + 1e-12 and np.ptp(step) < 1e-9
    moved = discrete_frechet(rollouts[1:], rollouts[:-1])
    np.testing.assert_allclose(arrays["moved"], [np.full(NUM_DEMONSTRATIONS, np.nan), *moved], rtol=0, atol=1e-12)
    assert rows[-1]["frames in which a rollout jumps"] == (moved > 0.015).any(axis=1).sum() > 0
    assert rows[-1]["largest step mm"] == pytest.approx(1e3 * moved.max())
    assert rows[-1]["frames"] == len(places) - 1 and rows[-1]["blocked"] == arrays["blocked"].sum()


def test_random_drags_go_through_the_motion_and_repeat(lasa):
    task, options = known_tasks(lasa)["Hook"](), argparse.Namespace(drags=6, seed=3, step=0.001)
    drags, again = (list(drag.paths(task, options)) for _ in range(2))
    assert len(drags) == 6
    for places, same in zip(drags, again, strict=True):
        np.testing.assert_array_equal(places, same)
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= 0.001 + 1e-12
        assert drag.REACH <= np.linalg.norm(places[-1] - places[0]) <= 2 * drag.REACH
        assert distance_from_path(places, task.mean_path).min() < 0.001


def test_a_scene_is_timed_until_each_stage(tmp_path):
    assert main(["scenes", "--only", "steps", "--out", str(tmp_path / "scenes.json")]) == 0
    ((times, median, worst),) = json.loads((tmp_path / "scenes.json").read_text())["tables"]
    assert 0 < times["rollouts_s"] < times["live_s"] < times["certified_s"]
    assert median["certified_s"] == worst["certified_s"] == times["certified_s"]


# --- exactness ---


@pytest.fixture
def exact(measured):
    """Runs a part of it on the hook: its rows."""
    return lambda part, options="": measured("exactness", f"--parts {part} {options}", "json")[0]


def test_starts_are_spread_over_the_grown_box(lasa):
    task = known_tasks(lasa)["Hook"]()
    starts, box = exactness.random_starts(task, 600, 0), np.concatenate(task.paths)
    middle, size = (box.min(axis=0) + box.max(axis=0)) / 2, np.ptp(box, axis=0)
    corners = [middle - size, middle + size]  # of a box twice as large
    np.testing.assert_allclose([starts.min(axis=0), starts.max(axis=0)], corners, atol=0.02)
    np.testing.assert_array_equal(starts, exactness.random_starts(task, 600, 0))
    assert (starts != exactness.random_starts(task, 600, 1)).any()


def test_all_starts_arrive_in_closed_form_and_stepped(exact):
    (row,) = exact("starts", "--count 600 --stepped 3")  # more than a chunk
    assert row["arrived"] == row["starts"] == 600 and row["stepped, arrived"] == row["stepped"] == 3
    assert row["farthest at the end mm"] < 0.1 and row["stepped, farthest from exact mm"] < 1
    assert row["smallest det J"] > 0 and row["round trip mm"] < 1e-6


@pytest.mark.parametrize(("limit", "stepped"), [("MAX_DEPARTURE", "1"), ("ARRIVED", "0")])
def test_a_motion_that_departs_or_does_not_arrive_fails_the_measurement(lasa, monkeypatch, limit, stepped):
    monkeypatch.setattr(exactness, limit, 1e-12)
    monkeypatch.setattr(exactness, "STEP_TOLERANCE", 1e-4)
    few = ["--parts", "starts", "--count", "1", "--stepped", stepped]
    assert main(["exactness", "--task", "Hook", "--lasa", str(lasa), *few]) == 1


@pytest.mark.parametrize("wrong", ["velocity", "flow"])
def test_stepping_leads_elsewhere_than_the_closed_form_where_either_is_wrong(fits, monkeypatch, wrong):
    """Arrival alone would not tell."""
    learned = fits.get(TASKS["draw_s"]().demonstrations).system
    system = replace(learned, transform=Identity(2))
    begin, durations = learned.base.goal + np.array([[0.3, 0.1], [0.0, -0.2]]), np.array([3.0, 2.5])
    assert stepped_beside(system, begin, durations)[1].max() < 1e-4
    real = getattr(TimedAttractor, wrong)
    slower = {"velocity": lambda self, z: 0.97 * real(self, z), "flow": lambda self, z, t: real(self, z, 0.97 * t)}
    monkeypatch.setattr(TimedAttractor, wrong, slower[wrong])
    assert stepped_beside(system, begin, durations)[1].min() > MAX_DEPARTURE


class Skewed(Identity):
    """Gives a derivative that is not its own."""

    def _map(self, s, U, *, inverse):
        return s, U if U is None else U + 0.05 * U[:, ::-1]


def test_a_wrong_jacobian_leads_stepped_motions_astray():
    begin, durations = np.array([[0.3, 0.0, 0.1], [0.0, -0.2, 0.2]]), np.array([3.0, 2.5])
    right, wrong = straight(), DiffeomorphicSystem(Skewed(3), straight().base)
    assert stepped_beside(right, begin, durations)[1].max() < 1e-5
    assert stepped_beside(wrong, begin, durations)[1].min() > MAX_DEPARTURE


def straight():
    return DiffeomorphicSystem(Identity(3), Attractor(np.zeros(3), 0.1, 0.05))


def test_stepping_adaptively_is_as_accurate_as_asked_for():
    starts, times = np.array([[0.3, 0.0, 0.1], [0.0, -0.2, 0.2]]), np.linspace(0, 3, 20)
    exact = straight().rollout(starts, times)
    errors = [np.abs(stepped_adaptively(straight(), starts, times, t) - exact).max() for t in (1e-4, 1e-7, 1e-10)]
    assert (np.array(errors) < [1e-3, 1e-6, 1e-9]).all()


def test_velocity_is_timed_for_each_kind_of_stack(lasa, exact, monkeypatch):
    every = exactness.stacks(known_tasks(lasa)["Hook"]())
    assert len(every) == len(set(every.values()))
    few = {name: every[name] for name in ("imitation", "bias point and sphere")}
    monkeypatch.setattr(exactness, "stacks", lambda _task: few)
    rows = exact("velocity", "--points 9")
    assert [row["stack"] for row in rows] == [*few]
    assert all(0 < row["median_ms"] <= row["p95_ms"] for row in rows)


def test_both_sides_are_timed_at_the_accuracy_asked_for_and_all_that_is_timed_is_one_motion(monkeypatch):
    monkeypatch.setattr(exactness, "NUM_POINTS", 6)
    timed = []

    def seconds(motion, repeats):
        timed.append(motion())
        return 1.5 ** len(timed)

    monkeypatch.setattr(exactness, "_median_seconds", seconds)
    starts = np.array([[0.3, 0.0, 0.1], [0.0, -0.2, 0.2]])
    sides = compare(lambda _: straight(), starts, 1e-3, 1)
    assert [*sides] == ["exact", "one rollout at a time", "one point at a time", "stepped"]
    assert all(side.accurate and side.error <= 1e-3 for side in sides.values())
    whole, *_, one_by_one, by_points = timed
    assert whole.shape == (2, 6, 3)
    np.testing.assert_allclose(one_by_one, whole, atol=1e-9)
    np.testing.assert_allclose(by_points, whole, atol=1e-9)
    assert sides["one point at a time"].seconds == 1.5 ** len(timed) > sides["exact"].seconds == 1.5


def test_the_cheapest_stepping_is_no_finer_than_needed():
    start = np.array([[0.3, 0.0, 0.1]])
    coarse, fine = (compare(lambda _: straight(), start, accuracy, 1)["stepped"] for accuracy in (1e-3, 1e-9))
    assert coarse.accurate and fine.accurate and coarse.error > fine.error


def test_a_setting_that_is_too_coarse_is_not_taken(monkeypatch):
    def off_by_its_tolerance(system, starts, times, tolerance):
        return system.rollout(starts, times) + tolerance / 2

    monkeypatch.setattr(exactness, "stepped_adaptively", off_by_its_tolerance)
    monkeypatch.setattr(exactness, "in_steps", lambda _, starts, times, __: straight().rollout(starts, times) + 1)
    sides = compare(lambda _: straight(), np.array([[0.3, 0.0, 0.1]]), 1e-3, 1)
    assert sides["stepped"].setting == "DOP853 to 1e-03 m" and sides["stepped"].error < 1e-3


@pytest.mark.slow
def test_rollouts_are_compared_without_and_with_an_obstacle(exact):
    rows = exact("rollouts", "--accuracy 0.02 --diameter 0.05 --repeats 1")
    assert [row["scene"] for row in rows] == 4 * ["no obstacle"] + 4 * ["obstacle"]
    assert all(row["accurate"] for row in rows)
    stepped = {row["scene"]: row["seconds"] for row in rows if row["side"] == "stepped"}
    for row in rows:
        assert row["× faster"] == pytest.approx(stepped[row["scene"]] / row["seconds"])


# --- off the demonstrations ---


@pytest.mark.long
def test_what_is_off_course_is_told_of_a_motion_that_is_spoilt():
    demonstrations = TASKS["draw_s"]().demonstrations
    good = off_course("S", demonstrations, fit_augmented(demonstrations))
    assert max(good.shape_error) < 0.05 and max(good.speed) < 1.5 and good.drawn > 0.6
    hurried = [replace(d, times=d.times / 3) for d in demonstrations]
    assert min(off_course("S", demonstrations, fit_augmented(hurried)).speed) > 2
    bent = [replace(d, positions=d.positions * [1, 0.5]) for d in demonstrations]
    assert min(off_course("S", demonstrations, fit_augmented(bent)).shape_error) > 0.05
    plain = off_course("S", demonstrations, fit(demonstrations))
    assert plain.shape_error[1] > good.shape_error[1] and plain.drawn < good.drawn


# --- most in one sitting ---


@pytest.fixture
def ran(monkeypatch):
    """Commands that were run, with the files that they were to write; each prints two tables, one of them fails."""
    commands = []

    def run(words, out):
        commands.append((words, out))
        rows = [{"task": "a", "mm": 1.25}, {"task": "all", "mm": 2.5}]
        return {"status": int("fails" in words), "seconds": 1.0, "tables": [rows, [{"figure": "F.D.", "value": "3"}]]}

    monkeypatch.setattr(sitting, "ran", run)
    return commands


def test_a_subject_becomes_a_dated_table_of_all_that_its_commands_print(ran, tmp_path):
    subject = Subject("Visitors", ("load --clients 1", "latency --task draw_s"), ".json")
    assert sitting.measured("load", subject, tmp_path, []) == 0
    assert [out.name for _, out in ran] == ["load-0.json", "load-1.json"]
    table, text = json.loads((tmp_path / "load.json").read_text()), (tmp_path / "load.md").read_text()
    assert f"\n{table['date']}, " in text and table["title"] == "Visitors"
    assert [result["rows"][1] for result in table["results"]] == 2 * [{"task": "all", "mm": 2.5}]
    assert "    python -m dt_viz.evaluate load --clients 1 --out" in text
    assert "    python -m tests.benchmarks latency --task draw_s --out" in text
    assert text.count("| task | mm |") == text.count("| all | 2.5 |") == text.count("| F.D. | 3 |") == 2


def test_rows_that_are_not_wanted_are_left_out_and_files_of_lasa_put_in(ran, tmp_path):
    subject = Subject("Learning", ("imitation LASA", "imitation assets/lift_box.npz"), "", 1)
    assert sitting.measured("imitation", subject, tmp_path, []) == 0
    assert [words for words, _ in ran] == [["imitation", "assets/lift_box.npz"]]
    assert sitting.measured("imitation", subject, tmp_path, [tmp_path / "A 1.mat", tmp_path / "B.mat"]) == 0
    assert ran[1][0] == ["imitation", f"{tmp_path}/A 1.mat", f"{tmp_path}/B.mat"]
    assert [result["rows"] for result in json.loads((tmp_path / "imitation.json").read_text())["results"]] == 2 * [
        [{"figure": "F.D.", "value": "3"}]
    ]


def test_a_command_that_fails_is_written_down_the_others_are_measured_and_the_sitting_fails(ran, tmp_path, monkeypatch):
    subjects = {"one": Subject("One", ("load fails",), ".json"), "two": Subject("Two", ("load",), ".json")}
    monkeypatch.setattr(sitting, "SUBJECTS", subjects)
    assert main(["--out", str(tmp_path)]) == 1
    assert "ended with status 1" in (tmp_path / "one.md").read_text()
    assert "ended with" not in (tmp_path / "two.md").read_text()
    assert main(["--out", str(tmp_path), "--only", "two"]) == 0


@pytest.mark.long
def test_commands_run_in_processes_of_their_own_and_their_tables_come_back(lasa, tmp_path):
    result = sitting.ran(["imitation", str(lasa / "Hook.mat")], tmp_path / "imitation-0")
    assert result["status"] == 0 and result["seconds"] > 0 and result["tables"][0][0]["name"] == "Hook"
    assert (tmp_path / "imitation-0" / "Hook.npz").exists()


@pytest.mark.parametrize("name", sitting.SUBJECTS)
def test_every_command_of_the_sitting_is_one_that_there_is(name, lasa, tmp_path, monkeypatch):
    """Each is read by its own options; nothing is measured."""
    subject, files = sitting.SUBJECTS[name], [lasa / "Hook.mat"]
    read = []
    monkeypatch.setattr(
        argparse.ArgumentParser, "parse_args", refuse_to_measure(read, argparse.ArgumentParser.parse_args)
    )
    for command in subject.commands:
        arguments = [
            *command.replace(sitting.LASA, str(files[0])).split(),
            "--out",
            str(tmp_path / f"a{subject.suffix}"),
        ]
        run = main if sitting.package_of(arguments[0]) == "tests.benchmarks" else evaluate
        assert run(arguments) == 0
    assert len(read) == len(subject.commands)


def refuse_to_measure(read, parse):
    def parse_only(parser, arguments):
        options = parse(parser, arguments)
        read.append(options)
        options.run = lambda _: 0
        return options

    return parse_only


# --- fairness ---


def test_gaps_beside_are_compared_with_those_just_before_and_after(monkeypatch):
    gaps = iter([[40, 80], [90, 150], [50, 70], [120, 400], [70, 90]])  # alone, beside, alone, …
    begun = []

    async def gap(*_):
        await asyncio.sleep(0.01)
        return np.array(next(gaps), float)

    async def act(other):
        begun.append(other)
        other.num_done += 1
        await asyncio.sleep(60)

    async def arrive(_client):
        pass

    monkeypatch.setattr(fairness, "ProtocolClient", lambda _url: nullcontext())
    monkeypatch.setattr(fairness, "_arrive", arrive)
    monkeypatch.setattr(fairness, "_gap", gap)
    monkeypatch.setattr(fairness, "OTHER", replace(fairness.OTHER, begun=0.0))
    monkeypatch.setattr(fairness, "DOINGS", {"acts": act})
    row = asyncio.run(fairness._compared("", "acts", argparse.Namespace(seconds=1.0, rounds=2)))
    assert (row["× median"], row["× 95 %"]) == (2.0, pytest.approx((2.0 + 5.0) / 2))
    assert (row["alone: gap ms, median / 95 %"], row["beside"]) == ("52 / 78", "105 / 275")
    assert row["done"] == "2" and len(begun) == 2


def test_the_torus_is_a_closed_mesh_of_so_many_faces(monkeypatch):
    monkeypatch.setattr(solids, "SETTINGS", solids.GridSettings(num_nodes=1000))
    solid, notes = read_mesh(fairness.torus(20, 30), "torus.stl")
    assert len(solid.faces) == 1200 and notes == ()
    np.testing.assert_allclose(np.ptp(solid.vertices, axis=0), [0.16, 0.16, 0.04], rtol=0.02)


async def act(url, name, is_done):
    async with ProtocolClient(url) as client:
        await client.look()
        assert await client.wait_for(lambda: client.has_picture, 120)
        doing = asyncio.create_task(fairness.DOINGS[name](fairness.Other(client)))
        assert await client.wait_for(lambda: doing.done() or is_done(client), 120)
        assert not doing.done() or doing.result()
        doing.cancel()


def value(client, label, field):
    return client.controls[client.find(label)][field]


@pytest.mark.slow
def test_the_other_visitor_does_what_he_is_to_do(monkeypatch):
    monkeypatch.setattr(fairness, "OTHER", replace(fairness.OTHER, rings=(20, 30)))
    with started(["--task", "draw_s", "--processes", "1"]) as (url, _):
        asyncio.run(act(url, "learns", lambda client: value(client, "Task", "value") == "Your data 2"))
        asyncio.run(act(url, "uploads", lambda client: "2: mesh" in value(client, "Selected", "options")))
        asyncio.run(act(url, "saves", lambda client: client.controls[client.find("Save as")]["value"] == "PDF"))
        asyncio.run(act(url, "drags", lambda client: len(value(client, "Selected", "options")) == 5))
