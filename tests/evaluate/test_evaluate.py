"""The command line of the measurements, each subcommand from arguments to files, on small settings."""

import argparse
import json
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
import scipy.io
from PIL import Image

from dt_viz.arm.body_points import load_body_points
from dt_viz.arm.collision import load_collision_model
from dt_viz.control.settings import ControllerSettings
from dt_viz.engine.engine import Engine
from dt_viz.engine.frame import Stage
from dt_viz.evaluate import drag, imitation, latency, reactive, rollouts, starts, velocity
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.choose import Grid, choose, measure
from dt_viz.evaluate.held_out import WAYS, HeldOut, follow
from dt_viz.evaluate.latency import Recorder
from dt_viz.evaluate.off_course import off_course
from dt_viz.evaluate.places import hand_room, shortest_shift
from dt_viz.evaluate.rollouts import compare, stepped_adaptively
from dt_viz.evaluate.starts import MAX_DEPARTURE, stepped_beside
from dt_viz.evaluate.worst import Case, worst_of
from dt_viz.flows.diffeomorphisms import Identity
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.learning import augmented
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration, save_demonstrations
from dt_viz.learning.imitation import fit, grown_grid
from dt_viz.learning.timing import TimedAttractor
from dt_viz.metrics import discrete_frechet, distance_from_path, resample_by_arc_length, rms_at_equal_times
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.tasks import TASKS, lasa_tasks

NUM_DEMONSTRATIONS = 2


def hook(i):
    """A hook some 50 mm wide that ends in the origin: seconds (T,) and millimetres (T, 2)."""
    s = np.linspace(0, 1, 80 + 7 * i)
    progress = s**2 * (3 - 2 * s)
    angle = 2.2 * (1 - progress)
    radius = 25 + 6 * i * (1 - progress)
    positions = radius[:, None] * np.stack([np.cos(angle) - 1, np.sin(angle)], axis=1)
    positions[:, 0] -= 20 * (1 - progress)
    return (3 + 0.4 * i) * s, positions


def write_mat(path):
    cells = np.empty((1, NUM_DEMONSTRATIONS), dtype=object)
    for i in range(NUM_DEMONSTRATIONS):
        times, positions = hook(i)
        cells[0, i] = {"t": times[None], "pos": positions.T, "dt": times[1]}
    scipy.io.savemat(path, {"demos": cells, "dt": 0.04})
    return path


@pytest.fixture
def measured(lasa, tmp_path, capsys):
    """Runs a subcommand on the hook: what it writes, and what it prints."""

    def run(subcommand, options, form="npz"):
        out = tmp_path / f"{subcommand}.{form}"
        assert main([subcommand, "--task", "Hook", "--lasa", str(lasa), *options.split(), "--out", str(out)]) == 0
        printed = capsys.readouterr().out
        if form == "json":
            return json.loads(out.read_text()), printed
        with np.load(out) as arrays:
            return dict(arrays), printed

    return run


@pytest.fixture(scope="module")
def lasa(tmp_path_factory):
    folder = tmp_path_factory.mktemp("lasa")
    write_mat(folder / "Hook.mat")
    return folder


def number_after(text, label):
    """The number that first follows `label` in `text`."""
    return float(text.split(label)[1].split()[0])


def apart(path, other):
    """Fréchet distance of two paths."""
    return float(discrete_frechet(resample_by_arc_length(path, 400), resample_by_arc_length(other, 400)))


# --- imitation ---


@pytest.fixture(scope="module")
def imitated(lasa, tmp_path_factory):
    """Its folder."""
    out = tmp_path_factory.mktemp("out") / "new"
    assert main(["imitation", str(lasa / "Hook.mat"), "--out", str(out)]) == 0
    return out


def test_imitation_writes_each_rollout_in_the_unit_of_the_file_from_start_to_goal(imitated):
    with np.load(imitated / "Hook.npz") as arrays:
        assert arrays["fit_seconds"] > 0 and f"rollout_{NUM_DEMONSTRATIONS}" not in arrays
        for i in range(NUM_DEMONSTRATIONS):
            rollout, times = arrays[f"rollout_{i}"], arrays[f"times_{i}"]
            assert rollout.shape == (len(times), 2) and times[0] == 0 and (np.diff(times) > 0).all()
            np.testing.assert_allclose(rollout[0], hook(i)[1][0], atol=1e-6)
            assert np.linalg.norm(rollout[-1]) < 0.1  # millimetres
    with Image.open(imitated / "shapes.png") as image:
        red, green, _ = np.moveaxis(np.asarray(image.convert("RGB")).astype(int), -1, 0)
    assert (green - red > 50).sum() > 500 and (red - green > 100).sum() > 500  # demonstrations and rollouts


def test_the_figures_of_imitation_can_be_computed_again_from_the_arrays(imitated):
    (figures,) = json.loads((imitated / "figures.json").read_text())["shapes"]
    motions = [hook(i) for i in range(NUM_DEMONSTRATIONS)]
    with np.load(imitated / "Hook.npz") as arrays:
        frechet = [apart(arrays[f"rollout_{i}"], positions) for i, (_, positions) in enumerate(motions)]
        rms = [
            rms_at_equal_times(arrays[f"times_{i}"], arrays[f"rollout_{i}"], *motion)
            for i, motion in enumerate(motions)
        ]
        extent = np.ptp(np.concatenate([positions for _, positions in motions]), axis=0).max()
        assert figures["round_trip_of_extent"] == pytest.approx(arrays["round_trip_error"] / extent)
        assert figures["min_det_jacobian"] == arrays["min_det_jacobian"]
    assert figures["frechet_mean_mm"] == pytest.approx(np.mean(frechet), rel=1e-6)
    assert figures["frechet_max_mm"] == pytest.approx(np.max(frechet), rel=1e-6)
    assert figures["rms_mm"] == pytest.approx(np.mean(rms), rel=1e-6)


def test_imitation_takes_other_files_in_metres_and_in_space(tmp_path):
    times, positions = hook(0)
    lifted = np.column_stack([positions, 10 * np.linspace(1, 0, len(times)) ** 2]) / 100  # some 0.5 m
    lines = [",".join(map(str, row)) for row in np.column_stack([times, positions / 1000])]
    (tmp_path / "plane.csv").write_text("\n".join(["t,x,y", *lines]))
    save_demonstrations(tmp_path / "space.npz", [Demonstration(times, lifted, "lifted")])
    files = [str(tmp_path / "plane.csv"), str(tmp_path / "space.npz")]
    assert main(["imitation", *files, "--out", str(tmp_path / "out")]) == 0
    for name, start in {"plane": positions[0] / 1000, "space": lifted[0]}.items():
        with np.load(tmp_path / "out" / f"{name}.npz") as arrays:
            np.testing.assert_allclose(arrays["rollout_0"][0], start, atol=1e-9)
            assert np.linalg.norm(arrays["rollout_0"][-1]) < 1e-4


def test_the_grid_of_the_certificates_covers_the_box_and_half_its_size_on_every_side():
    grid = grown_grid(np.array([[0.0, 0.0], [2.0, 4.0]]), 3)
    np.testing.assert_allclose([grid.min(axis=0), grid.max(axis=0)], [[-1, -2], [3, 6]])


@pytest.fixture(scope="module")
def left_out(lasa, tmp_path_factory):
    """Its folder."""
    out = tmp_path_factory.mktemp("left_out")
    assert main(["imitation", str(lasa / "Hook.mat"), "--leave-one-out", "--out", str(out)]) == 0
    return out


def test_held_out_demonstrations_are_followed_by_what_the_others_teach(left_out):
    """Of two demonstrations the other one is the mean of the others and the nearest, shifted to this start."""
    (figures,) = json.loads((left_out / "figures.json").read_text())["held_out"]
    assert figures["folds"] == NUM_DEMONSTRATIONS
    with np.load(left_out / "Hook-held-out.npz") as arrays:
        for way in WAYS:
            distances, at_equal_times = [], []
            for i in range(NUM_DEMONSTRATIONS):
                (times, positions), path, moments = hook(i), arrays[f"{way}_{i}"], arrays[f"{way}_times_{i}"]
                np.testing.assert_allclose(path[0], positions[0], atol=1e-6)
                assert moments[0] == 0 and (np.diff(moments) >= 0).all()
                distances.append(apart(path, positions))
                at_equal_times.append(rms_at_equal_times(moments, path, times - times[0], positions))
            assert figures[f"{way}_mm"] == pytest.approx(np.mean(distances), rel=1e-6)
            assert figures[f"{way}_rms_mm"] == pytest.approx(np.mean(at_equal_times), rel=1e-5)
        other = resample_by_arc_length(hook(1)[1], 400)
        offset = hook(0)[1][0] - other[0]
        np.testing.assert_allclose(arrays["mean_0"], other + np.linspace(1, 0, 400)[:, None] * offset, atol=1e-6)
    in_sample = json.loads((left_out / "figures.json").read_text())["shapes"][0]["frechet_mean_mm"]
    assert figures["learned_mm"] > 2 * in_sample  # it has not seen what it is compared with


def test_the_worst_of_what_was_held_out_is_drawn(left_out):
    panels = list(ElementTree.parse(left_out / "worst.svg").iterfind("{*}g"))
    distances = [float("".join(panel.itertext()).split("  ")[1].split(" mm")[0]) for panel in panels]
    (figures,) = json.loads((left_out / "figures.json").read_text())["held_out"]
    assert np.mean(distances) == pytest.approx(figures["learned_mm"], abs=0.06)
    assert distances == sorted(distances, reverse=True)  # of one shape, in which all have one extent
    learned, goal = (panels[0].findall(f"{{*}}{kind}")[-1].attrib for kind in ("polyline", "circle"))
    end = learned["points"].split()[-1].split(",")
    assert [float(x) for x in end] == pytest.approx([float(goal["cx"]), float(goal["cy"])], abs=0.3)


def test_the_worst_cases_are_the_farthest_off_for_their_size():
    def case(name, off, size):
        path = np.column_stack([np.linspace(0, size, 20), np.zeros(20)])
        return Case(name, path, [path], dict.fromkeys(WAYS, path + np.array([0.0, off])), 1.0)

    cases = [case("large", 3.0, 100.0), case("small", 1.0, 10.0), case("met", 0.1, 10.0)]
    assert [c.name for c in worst_of(cases, 2)] == ["small", "large"]


def test_constants_are_chosen_on_one_half_and_measured_on_the_other():
    """Where each half of the shapes has a best setting of its own, it is chosen, and bad on the other half."""
    grid, names = Grid({"NOISE": (0.2, augmented.NOISE)}, "learned_mm"), ["a", "b", "c", "d"]
    first, _ = choose(grid, {setting: np.zeros(4) for setting in grid.settings}, names, seed=3)
    on = np.array([name in first.chosen_on for name in names])
    other, shipped = (("NOISE", 0.2),), grid.shipped
    one, two = choose(grid, {shipped: np.where(on, 2.0, 1.0), other: np.where(on, 1.0, 4.0)}, names, seed=3)
    assert (one.chosen, one.others_mm, one.shipped_mm, one.best_mm) == (other, 4.0, 1.0, 1.0)
    assert (two.chosen, two.others_mm, two.shipped_mm, two.best_mm) == (shipped, 2.0, 2.0, 1.0)
    assert set(one.chosen_on) | set(two.chosen_on) == set(names) and not set(one.chosen_on) & set(two.chosen_on)


def test_settings_are_in_force_while_they_are_measured_only():
    before, found = augmented.NOISE, []

    def measured():
        found.append(augmented.NOISE)
        return [HeldOut("a", 2, *([augmented.NOISE] * 6))]

    grid = Grid({"NOISE": (0.2, before, 1.2)}, "learned_mm")
    values = measure(grid, measured)
    assert found == [before, 0.2, 1.2] == [float(values[setting][0]) for setting in grid.settings]
    assert before == augmented.NOISE


def test_choices_are_written(lasa, tmp_path, monkeypatch):
    monkeypatch.setattr(imitation, "GRIDS", (Grid({"NOISE": (augmented.NOISE, 3.0)}, "learned_mm"),))
    write_mat(tmp_path / "Other.mat")
    files, out = [str(lasa / "Hook.mat"), str(tmp_path / "Other.mat")], tmp_path / "out"
    assert main(["imitation", *files, "--state", "augmented", "--choose", "1", "--out", str(out)]) == 0
    choices = json.loads((out / "choices.json").read_text())["choices"]
    assert [len(choice["chosen_on"]) for choice in choices] == [1, 1]


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


def test_augmented_imitation_is_measured_as_plain_is(lasa, tmp_path):
    files, out = [str(lasa / "Hook.mat")], tmp_path / "out"
    assert main(["imitation", *files, "--state", "augmented", "--leave-one-out", "--crossings", "--out", str(out)]) == 0
    figures = json.loads((out / "figures.json").read_text())
    assert figures["state"] == "augmented"
    (shape,) = figures["shapes"]
    assert shape["min_det_jacobian"] == pytest.approx(1.0) and shape["round_trip_of_extent"] < 1e-12
    assert set(figures["off_course"][0]) == {"name", "shape_error", "speed", "drawn"}
    assert (out / "crossings.png").stat().st_size > 10_000


def test_what_is_held_out_is_not_learned_from():
    recorded = [hook(i) for i in range(4)]
    demonstrations = [Demonstration(times, path / 1000, str(i)) for i, (times, path) in enumerate(recorded)]
    learned_from = []

    def learn(others):
        learned_from.append([d.name for d in others])
        return fit(others)

    followed = follow(demonstrations, learn, folds=2)
    assert learned_from == [["1", "3"], ["0", "2"]]
    nearest = resample_by_arc_length(demonstrations[1].positions, 400)  # the nearest start of 1 and 3
    np.testing.assert_allclose(
        followed[0]["nearest"] - nearest,
        np.linspace(1, 0, 400)[:, None] * (demonstrations[0].positions[0] - nearest[0]),
        atol=1e-12,
    )


# --- latency ---


@pytest.mark.parametrize("dragged", ["obstacle", "bias --obstacles 0"])
def test_latency_counts_every_edit_and_reports_both_stages(measured, dragged, monkeypatch):
    recorder, frames = Recorder(), Engine.frames

    def while_dragging(*scenario, **others):
        return (frame for frame in frames(*scenario, **others) if frame.stage <= Stage.LIVE)

    monkeypatch.setattr(Engine, "frames", while_dragging)  # what rests is refined, which is not measured
    monkeypatch.setattr(latency, "Recorder", lambda: recorder)
    monkeypatch.setattr(latency, "WARM_UP_SECONDS", 0.1)
    figures, _ = measured("latency", f"--drag {dragged} --seconds 0.3", "json")
    assert figures["settings"]["edits"] == 18 == figures["frames"] + figures["skipped"]
    assert 0 < figures["rebuild_median_ms"] <= figures["median_ms"] <= figures["p95_ms"]
    assert figures["rebuild_median_ms"] < figures["whole_median_ms"] <= figures["whole_p95_ms"]
    live = [1e3 * seconds for stage, seconds, _ in recorder.frames if stage is Stage.LIVE]
    assert 0 < np.median(live) == figures["live_median_ms"] <= figures["live_p95_ms"]
    assert figures["settings"]["rollouts"] == NUM_DEMONSTRATIONS


# --- velocity ---


def test_velocity_measures_its_time(lasa, measured, monkeypatch):
    every = velocity._stacks(lasa_tasks(lasa)["Hook"]())
    assert len(every) == len(set(every.values())) == 11
    few = {name: every[name] for name in ("imitation", "bias point and sphere")}
    monkeypatch.setattr(velocity, "_stacks", lambda _task: few)
    for stack in measured("velocity", "--points 9", "json")[0]["stacks"].values():
        assert 0 < stack["median_ms"] <= stack["p95_ms"]


# --- avoidance ---


@pytest.fixture(scope="module")
def middle(lasa):
    """The middle of the mean demonstration in the world, metres."""
    from dt_viz.learning.demonstrations import load_demonstrations
    from dt_viz.scenario.tasks import drawing_task

    paths = drawing_task("Hook", "", "", load_demonstrations(lasa / "Hook.mat")).paths
    return np.mean([resample_by_arc_length(path, 101)[50] for path in paths], axis=0)


@pytest.fixture
def avoid(measured):
    """Runs the subcommand with a sphere of 10 cm at a centre: what it writes, and what it prints."""

    def run(centre, more=""):
        where = ",".join(f"{value:.6f}" for value in centre)
        return measured("avoidance", f"--obstacle {where} --diameter 0.1 {more}")

    return run


def test_avoidance_writes_angles_end_effector_and_demonstration_that_belong_together(avoid, middle, robot):
    arrays, printed = avoid(middle)
    distances, clearances = [], []
    for i in range(NUM_DEMONSTRATIONS):
        q, x, demo = arrays[f"q_{i}"], arrays[f"x_{i}"], arrays[f"demo_{i}"]
        assert q.shape == (len(x), 6) and x.shape[1] == demo.shape[1] == 3
        np.testing.assert_allclose(robot.end_effector(q), x, atol=1e-12)
        assert np.abs(np.diff(q, axis=0)).max() < 1  # unwrapped
        assert len(demo) == len(hook(i)[0])
        clearances.append(np.linalg.norm(x - middle, axis=1).min() - 0.05)
        distances.append(apart(x, demo))
    assert min(clearances) > 0
    assert number_after(printed, "F.D. mean") == pytest.approx(1e3 * np.mean(distances), abs=0.06)
    assert number_after(printed, "; clearance") == pytest.approx(1e3 * min(clearances), abs=0.06)
    assert number_after(printed, "M.C.D. of the end effector") == 0

    arrays, printed = avoid(middle, "--no-avoidance")
    deepest = max(0.05 - np.linalg.norm(arrays[f"x_{i}"] - middle, axis=1).min() for i in range(NUM_DEMONSTRATIONS))
    assert deepest > 0.03
    # sampled points may lie a little less deep than the line between them
    assert number_after(printed, "M.C.D. of the end effector") == pytest.approx(1e3 * deepest, abs=1.0)


def test_a_start_inside_the_obstacle_is_said_for_the_hand_and_left_out_for_the_arm(avoid):
    away, printed = avoid([0.5, -0.5, 0.9])
    assert "warning" not in printed
    start = away["demo_0"][0]
    assert "warning: start 1 is inside the obstacle" in avoid(start)[1]
    arrays, printed = avoid(start, "--space cspace")
    assert "warning: start" in printed
    left = [name[2:] for name in arrays if name.startswith("q_")]
    assert 0 < len(left) < NUM_DEMONSTRATIONS and "0" not in left
    for name in left:
        np.testing.assert_allclose(arrays[f"x_{name}"][0], arrays[f"demo_{name}"][0], atol=0.01)


def test_the_whole_arm_avoids_what_the_hand_alone_does_not(avoid, middle):
    depth = {}
    for space in ("task", "cspace"):
        arrays, printed = avoid(middle, f"--space {space}")
        depth[space] = number_after(printed, "M.C.D. of the whole arm")
        assert number_after(printed, "goal missed by") < 1 and "joint-limit violations: 0 " in printed
        for i in range(NUM_DEMONSTRATIONS):
            assert np.linalg.norm(arrays[f"x_{i}"] - middle, axis=1).min() > 0.05
    assert depth["task"] > 20 and depth["cspace"] == 0


def test_avoidance_says_why_there_is_no_motion(avoid, lasa, tmp_path, capsys):
    goal = avoid([0.5, -0.5, 0.9])[0]["demo_0"][-1]
    task = ["--task", "Hook", "--lasa", str(lasa), "--space", "cspace", "--out", str(tmp_path / "a.npz")]
    for where, reason in {
        ",".join(map(str, goal)): "the goal is inside the obstacle",
        "0,0,0.1": "the obstacle touches the arm's base",
    }.items():
        assert main(["avoidance", *task, "--obstacle", where, "--diameter", "0.15"]) == 1
        assert f"no motion: {reason}" in capsys.readouterr().err


def test_places_are_measured_on_the_meshes(measured):
    arrays, printed = measured("places", "--count 2 --size 0.1")
    assert np.linalg.norm(arrays["places"] - arrays["places"][0], axis=2).max() <= 0.05
    assert arrays["arm_depth"].shape == (3, NUM_DEMONSTRATIONS)
    assert number_after(printed, "at least 9 mm kept") == (np.nanmin(arrays["arm_clearance"], axis=1) >= 9e-3).sum()
    assert np.nanmax(arrays["arm_depth"]) == number_after(printed, "M.C.D. of the whole arm") == 0
    assert np.nanmin(arrays["depth_without"]) > 0
    _, printed = measured("places", "--count 2 --size 0.1 --no-avoidance")
    assert number_after(printed, "M.C.D. of the whole arm") > 30


def test_places_of_the_hand_are_measured_at_its_point(measured):
    arrays, printed = measured("places", "--count 2 --size 0.1 --space task")
    assert arrays["clearance"].shape == arrays["turn"].shape == (3, NUM_DEMONSTRATIONS)
    assert arrays["ends"].shape == (3, NUM_DEMONSTRATIONS + 1)
    assert arrays["clearance_without"].min() < -0.02
    assert number_after(printed, "at least 9 mm kept") == (arrays["clearance"].min(axis=1) >= 9e-3).sum() == 3
    forced = np.median(arrays["frechet"].max(axis=1) / (0.01 - arrays["clearance_without"].min(axis=1)))
    assert number_after(printed.replace(",", " "), "F.D. / forced  median") == pytest.approx(forced, abs=0.006)
    without, _ = measured("places", "--count 2 --size 0.1 --space task --no-avoidance")
    np.testing.assert_allclose(without["clearance"], without["clearance_without"], atol=1e-4)
    assert without["frechet"].max() < 1e-3 and not np.allclose(without["turn"], arrays["turn"])


@pytest.mark.parametrize("beside", [0.0, 0.06, 0.5])
def test_no_shift_of_the_arm_is_much_shorter_than_the_shortest(robot, beside):
    body, q = load_body_points().on_moving_links, robot.home[None] + 0.05 * np.eye(6)[:3]
    hand = robot.end_effector(q[0])
    obstacle = Union((Sphere(as_point(hand + np.array([0.0, 0.0, beside])), 0.1),))
    found, clearance = shortest_shift(robot, obstacle, q, 0.003), 0.003
    directions = np.random.default_rng(0).normal(size=(300, 1, 1, 3))
    directions /= np.linalg.norm(directions, axis=3, keepdims=True)
    points, tried = body.positions(robot, q), np.linspace(0, 0.4, 81)
    free = [
        ((obstacle.signed_distance(points + s * directions) - body.radius) >= clearance).all(axis=(1, 2)) for s in tried
    ]
    least = tried[np.array(free).any(axis=1).argmax()]
    assert least - 0.005 - 1e-9 <= found <= 1.06 * least + 1e-3
    assert (found == 0) == (beside == 0.5)


def test_places_are_any_shapes_of_any_size_along_the_whole_motion(lasa, measured):
    shapes = "--shape any --number 2 --size 0.06,0.25 --only-blocked"
    arrays, printed = measured("places", f"--count 12 --along 0,1 --spread 0 {shapes}")
    mean = lasa_tasks(lasa)["Hook"]().mean_path
    places, sizes = arrays["places"][1:], arrays["sizes"][1:]
    assert places.shape == sizes.shape == (12, 2, 3)
    assert set(arrays["shapes"][1:].ravel()) == {"sphere", "box", "cylinder"}
    assert 0.06 <= sizes.min() < 0.1 and 0.2 < sizes.max() <= 0.25
    nearest = np.linalg.norm(places[:, :, None] - mean, axis=3).argmin(axis=2)
    assert nearest.min() < 25 and nearest.max() > 75
    assert distance_from_path(places.reshape(-1, 3), mean).max() < 1e-9
    free = (arrays["hand_room"] > 0).all(axis=1)
    assert number_after(printed, "called blocked:") == (arrays["blocked"] & free).sum()


def test_the_hand_has_room_where_some_orientation_of_it_has(robot):
    far, near, inside = (
        hand_room(robot, Union((Sphere((0.0, -0.5, 0.3), size),)), np.array([[0.0, -0.4, 0.3]]))[0]
        for size in (0.02, 0.15, 0.3)
    )
    assert far > near > 0 > inside
    assert far - near == pytest.approx(0.065, abs=0.01)  # the hand points at the ball, whatever its size


# --- drag ---


def test_drag_writes_every_step_and_counts_its_jumps(measured, middle, monkeypatch):
    monkeypatch.setattr(drag, "JUMP", 0.015)
    begin, end = (",".join(f"{value:.6f}" for value in np.add(middle, [0, 0, height])) for height in (0.03, -0.03))
    where = f"--from {begin} --to {end} --step 0.004 --diameter 0.1 --points 20"
    arrays, printed = measured("drag", f"--avoid hand {where}")
    rollouts, places = arrays["rollouts"], arrays["places"]
    assert rollouts.shape == (16, NUM_DEMONSTRATIONS, 20, 3) and not arrays["blocked"].any()
    np.testing.assert_allclose(places, middle + np.linspace(0.03, -0.03, 16)[:, None] * [0, 0, 1], atol=1e-6)
    moved = discrete_frechet(rollouts[1:], rollouts[:-1])
    np.testing.assert_allclose(arrays["moved"], [np.full(NUM_DEMONSTRATIONS, np.nan), *moved], rtol=0, atol=1e-12)
    assert number_after(printed, "a rollout jumps") == (moved > 0.015).any(axis=1).sum() > 0
    np.testing.assert_allclose(arrays["rested"], arrays["fresh"], rtol=0, atol=1e-3)


def test_random_drags_go_through_the_motion_and_repeat(lasa, tmp_path):
    task, options = lasa_tasks(lasa)["Hook"](), argparse.Namespace(begin=None, end=None, drags=6, seed=3, step=0.001)
    first, second = (list(drag.paths(task, options)) for _ in range(2))
    assert len(first) == 6
    for places, same in zip(first, second, strict=True):
        np.testing.assert_array_equal(places, same)
        assert np.linalg.norm(np.diff(places, axis=0), axis=1).max() <= 0.001 + 1e-12
        assert np.linalg.norm(places[0] - places[-1]) >= drag.REACH
        assert distance_from_path(task.mean_path, places[[0, -1]]).min() < 5e-3 or len(places) < 160


# --- reactive ---


def test_reactive_writes_what_its_figures_are_computed_from_and_repeats(measured, robot):
    arrays, printed = measured("reactive", "--speed 0.4 --runs 1 --beside")
    row = printed.split("\nin the loop")[1].splitlines()[0].split()
    q, t, places = arrays["q_0"], arrays["t_0"], arrays["obstacle_0"]
    assert q.shape == (len(t), 6) and places.shape == (len(t), 3)
    velocity = np.diff(q, axis=0, prepend=q[:1]) / 0.01
    assert (np.abs(velocity) < robot.velocity_limits + 1e-9).all()
    assert np.abs(np.diff(velocity, axis=0)).max() < ControllerSettings().acceleration * 0.01 + 1e-9
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    np.testing.assert_allclose(steps[np.isfinite(steps)], 0.004, rtol=0.02)
    for kind in ("potential_", "stepped_"):
        assert len(arrays[f"{kind}q_0"]) == len(arrays[f"{kind}t_0"]) > 100
    there = np.isfinite(places[:, 0])
    closest = nearest(q[there], places[there], float(arrays["diameter"]))
    assert float(row[3]) == pytest.approx(1e3 * closest, abs=2)  # it looks between ticks, too
    assert row[:3] == ["1", "of", "1"] and row[4:7] == ["1", "of", "1"]
    again, _ = measured("reactive", "--speed 0.4 --runs 1")
    np.testing.assert_array_equal(again["q_0"], q)


def nearest(q, places, diameter):
    """Smallest distance of the arm's meshes from a sphere at one of its places for each posture."""
    model = load_collision_model()
    return min(
        model.obstacle_distance(joints[None], Sphere(as_point(place), diameter))[0][0]
        for joints, place in zip(q, places, strict=True)
    )


@pytest.fixture(scope="module")
def bench(engine):
    return reactive.Bench(engine, "draw_s", 0.15, 0.03)


@pytest.mark.parametrize(("speed", "num"), [(0.1, 1), (1.0, 1), (0.5, 2)])
def test_spheres_cross_the_motion_when_the_hand_is_there(bench, speed, num):
    found = list(reactive.crossings(bench, speed, 3, seed=1, num=num))
    assert [crossing.start for crossing, _ in found] == [0, 1, 2]
    for crossing, seconds in found:
        hand, joints = bench.undisturbed(crossing.start)
        assert seconds == pytest.approx(len(hand) * reactive.TICK) and len(crossing.passages) == num
        assert np.linalg.norm(hand[-1] - bench.goal) < 1e-3
        assert 0 in [crossing.begins, *(passage.comes for passage in crossing.passages)]  # no time is lost
        for passage in crossing.passages:
            step = np.linalg.norm(np.diff(passage.path, axis=0), axis=1)
            assert step.sum() == pytest.approx(passage.length) and np.ptp(step) < 0.01 * step.max()
            assert passage.gone - passage.comes == pytest.approx(passage.length / speed)
            assert 0.8 < passage.length < 1.2
            middle = (passage.comes + passage.gone) / 2
            tick = round((middle - crossing.begins) / reactive.TICK)
            assert 0.2 * len(hand) < tick < 0.8 * len(hand)
            assert np.linalg.norm(passage.at(middle) - hand[tick]) < 0.08
            np.testing.assert_allclose(passage.at(passage.comes), passage.path[0])
            np.testing.assert_allclose(passage.at(passage.gone - 1e-9), passage.path[-1], atol=1e-6)
            assert np.isnan(passage.at(passage.gone)).all() and np.isnan(passage.at(passage.comes - 1e-9)).all()
            there = joints[max(0, int((passage.comes - crossing.begins) / reactive.TICK))]
            gap = bench.follower.whole_arm.clearance(there[None], bench.shape(passage.path[0]))[0]
            assert gap >= reactive.START_ROOM - 0.01
            assert passage.path[:, 2].min() >= 0.075 + reactive.TABLE_ROOM


def test_a_second_obstacle_and_a_turned_box_count(engine):
    boxes = reactive.Bench(engine, "draw_s", 0.15, 0.03, boxes=True)
    ((crossing, _),) = reactive.crossings(boxes, 0.5, 1, seed=2, num=2)
    t = max(passage.comes for passage in crossing.passages)
    parts = boxes.obstacles(crossing, t)
    assert len(parts) == 2 and parts[0].wxyz == crossing.passages[0].wxyz != parts[1].wxyz
    np.testing.assert_allclose([part.position for part in parts], crossing.at(t))
    q, model = boxes.starts[:1], load_collision_model()
    run = reactive.Run(q=[q[0]], obstacle=[crossing.at(t)])
    expected = min(float(model.obstacle_distance(q, part)[0][0]) for part in parts)
    assert reactive.smallest_distance(boxes, run, crossing) == pytest.approx(expected, abs=1e-9)


def test_the_smallest_distance_is_found_between_ticks_too(bench):
    q = np.stack([bench.starts[0]] * 4)
    hand = bench.robot.end_effector(q[0])
    places = hand + np.array([[0.5, 0, 0], [0.2, 0, 0.0], [-0.2, 0, 0], [0.0, 0.0, 0.0]])
    places[3] = np.nan  # gone
    fine = np.linspace(0, 1, 7)[:, None]
    dense = np.concatenate([(1 - fine) * a + fine * b for a, b in ((places[0], places[1]), (places[1], places[2]))])
    least = nearest(np.repeat(q[:1], len(dense), axis=0), dense, bench.diameter)
    crossing = reactive.Crossing(0, 0.0, (reactive.Passage(places, 0.0, 1.0, 1.0),))
    found = reactive.smallest_distance(bench, reactive.Run(q=list(q), obstacle=list(places[:, None])), crossing)
    assert found == pytest.approx(least, abs=1e-9)
    assert found < nearest(q[:3], places[:3], bench.diameter) - 0.01


def test_figures_of_a_run_are_relative_to_the_limits(bench):
    q = bench.starts[0] + np.cumsum([[0.0], [0.01], [0.03], [0.03]], axis=0) * np.eye(6)[0]
    away = [np.array([[3.0, 0.0, 0.0]])] * 4
    run = reactive.Run(list(q), [0.0, 0.01, 0.02, 0.03], away, [0.001, 0.003])
    found = reactive.Figures.of(
        bench, reactive.Crossing(0, 0.01, (reactive.Passage(np.zeros((2, 3)), 0.0, 1.0, 1.0),)), run, 0.005
    )
    assert found.velocity == pytest.approx(3.0 / bench.robot.velocity_limits[0])
    assert found.acceleration == pytest.approx(200 / ControllerSettings().acceleration)
    assert found.lost == pytest.approx(0.015) and found.distance > 2
    assert found.missed == pytest.approx(np.linalg.norm(bench.robot.end_effector(q[-1]) - bench.goal))
    touched = replace(found, distance=-0.002, missed=1e-4, lost=0.215)
    assert reactive.summary([found, touched, touched])[:3] == ("1 of 3", "-2.0", "2 of 3")
    assert reactive.summary([found, touched, touched])[5:] == ("0.2 (0.2)", "2.00 (3.0, 3)")


def test_the_potential_field_pushes_what_is_near_away_from_the_sphere(bench):
    arm, q = reactive.Potential(bench), bench.starts[0]
    hand = bench.robot.end_effector(q)
    far, beside = (bench.shape(hand + np.array([0.0, -away, 0.0])) for away in (1.0, 0.14))
    assert not arm._away(q, None).any() and not arm._away(q, far).any()
    step = 1e-4
    pushed = bench.robot.end_effector(q + step * arm._away(q, beside)) - hand
    assert pushed[1] > 0.5 * np.linalg.norm(pushed) > 1e-7
    nearer = bench.robot.end_effector(q + step * arm._away(q, bench.shape(hand - [0.0, 0.12, 0.0]))) - hand
    assert nearer[1] > pushed[1]
    np.testing.assert_allclose(arm._at(q, beside), arm._at(q, None) + arm._away(q, beside), atol=1e-12)
    free = bench.robot.end_effector(q + step * arm._at(q, None)) - hand
    np.testing.assert_allclose(free / step, arm._hand.velocity(hand), atol=0.02)


# --- starts ---


def test_starts_are_spread_over_the_grown_box_and_arrive(lasa, measured):
    arrays, printed = measured("starts", "--count 600 --stepped 3")  # more than a chunk
    starts, ends, goal, det = (arrays[name] for name in ("starts", "ends", "goal", "min_det_jacobian"))
    assert arrays["stepped"].shape == (3, 5, 3) and arrays["departures"].max() < 1e-3
    assert starts.shape == ends.shape == (600, 3) and det.shape == (600,)
    box = np.concatenate(lasa_tasks(lasa)["Hook"]().paths)
    middle, size = (box.min(axis=0) + box.max(axis=0)) / 2, np.ptp(box, axis=0)
    np.testing.assert_allclose(np.abs(starts - middle).max(axis=0), size, atol=0.02)  # twice as large
    assert np.linalg.norm(ends - goal, axis=1).max() < 1e-4
    assert number_after(printed, "smallest det J on the rollouts") == pytest.approx(det.min(), rel=1e-3) != 0
    assert "600 of 600" in printed and "3 of 3" in printed.split("stepped by eq. (1)")[1]


def test_the_same_seed_gives_the_same_starts(measured):
    first, same, other = (measured("starts", f"--count 5 --stepped 0 --seed {seed}")[0]["starts"] for seed in (3, 3, 4))
    assert (first == same).all() and (first != other).any()


@pytest.mark.parametrize(("limit", "value"), [("MAX_DEPARTURE", 1e-12), ("ARRIVED", 1e-9)])
def test_a_motion_that_departs_or_does_not_arrive_fails_the_measurement(lasa, monkeypatch, limit, value):
    monkeypatch.setattr(starts, limit, value)
    monkeypatch.setattr(starts, "STEP_TOLERANCE", 1e-4)
    assert main(["starts", "--task", "Hook", "--lasa", str(lasa), "--count", "1", "--stepped", "1"]) == 1


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


# --- rollouts ---


def test_rollouts_reports_both_sides_at_the_accuracy_asked_for(measured, middle, monkeypatch):
    for name, value in {"NUM_POINTS": 6, "NUM_ROLLOUTS": 2, "FINER": 0.01}.items():
        monkeypatch.setattr(rollouts, name, value)
    timed = []

    def seconds(motion, repeats):
        timed.append(motion())
        return 1.5 ** len(timed)

    monkeypatch.setattr(rollouts, "_median_seconds", seconds)
    beside = ",".join(map(str, np.add(middle, [0, 0.045, 0])))  # a little way into the motion: cheap to step through
    where = f"--obstacle {beside} --diameter 0.1"
    figures, _ = measured("rollouts", f"{where} --accuracy 0.02 --repeats 1", "json")
    for scene, last in (("no obstacle", len(timed) // 2), ("obstacle", len(timed))):
        exact, stepped, apart = (figures[scene][name] for name in ("exact", "stepped", "ratios_apart"))
        assert 0 <= exact["error"] <= 0.02 and 0 < stepped["error"] <= 0.02
        assert figures[scene]["ratio"] == pytest.approx(stepped["seconds"] / exact["seconds"])
        ratios = apart["one rollout at a time"], apart["one point at a time"]
        assert ratios == pytest.approx([stepped["seconds"] / 1.5**k for k in (last - 1, last)])
        whole, one_by_one, by_points = timed[last - len(timed) // 2], timed[last - 2], timed[last - 1]
        assert whole.shape == (2, 6, 3)  # all that is timed is one motion
        np.testing.assert_allclose(one_by_one, whole, atol=1e-9)
        np.testing.assert_allclose(by_points.reshape(whole.shape), whole, atol=1e-9)


def straight():
    return DiffeomorphicSystem(Identity(3), Attractor(np.zeros(3), 0.1, 0.05))


def test_stepping_adaptively_is_as_accurate_as_asked_for():
    starts, times = np.array([[0.3, 0.0, 0.1], [0.0, -0.2, 0.2]]), np.linspace(0, 3, 20)
    exact = straight().rollout(starts, times)
    errors = [np.abs(stepped_adaptively(straight(), starts, times, t) - exact).max() for t in (1e-4, 1e-7, 1e-10)]
    assert (np.array(errors) < [1e-3, 1e-6, 1e-9]).all()


def test_the_cheapest_stepping_is_no_finer_than_needed():
    coarse, fine = (compare(lambda _: straight(), np.array([[0.3, 0.0, 0.1]]), error, 1)[1] for error in (1e-3, 1e-9))
    assert coarse.accurate and fine.accurate and coarse.error > fine.error


# --- bad input ---


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("imitation missing.mat --out out", "missing.mat: path: found no such file or folder; accepted: "),
        ("imitation Hook.mat Hook.csv --out out", "SHAPE: found 'Hook.mat' and 'Hook.csv'"),
        ("imitation Hook.mat --out file/below", "--out: found 'file/below', which cannot be made"),
        ("imitation Hook.mat --folds 2 --out out", "--folds: found 2; accepted: it together with"),
        ("imitation Hook.mat --folds 1 --out out", "argument --folds: found '1'; accepted: a whole number"),
        ("imitation Hook.mat --choose 0 --out out", "--choose: found 0; accepted: it with --state aug"),
        (
            "imitation Hook.mat --state augmented --regularisation 1e-4 --out out",
            "--regularisation: found 0.0001; accepted: none with --state augmented",
        ),
        ("imitation Hook.mat", "the following arguments are required: --out"),
        ("latency --task none --seconds 1 --out a.json", "--task: found 'none'; accepted: draw_s,"),
        ("latency --task draw_s --seconds 1 --out a.txt", "--out: found 'a.txt'; accepted: a file that ends in .json"),
        ("latency --task draw_s --lasa no --seconds 1 --out a.json", "no: folder: found something that cannot"),
        ("latency --task draw_s --seconds 0 --out a.json", "argument --seconds: found '0'; accepted: seconds, "),
        ("latency --task draw_s --seconds nan --out a.json", "argument --seconds: found 'nan'"),
        ("avoidance --task draw_s --obstacle 0,0,0 --diameter 1 --out file/a.npz", "'file/a.npz', which cannot be wri"),
        ("avoidance --task draw_s --obstacle 0,0 --diameter 1", "argument --obstacle: found '0,0'; accepted: "),
        ("avoidance --task draw_s --obstacle -0,inf,0 --diameter 1", "argument --obstacle: found '-0,inf,0'"),
        ("avoidance --task draw_s --obstacle 0,0,0 --diameter -1", "argument --diameter: found '-1'; accepted"),
        ("starts --task draw_s --out folder.npz", "--out: found 'folder.npz', which cannot be written"),
        ("starts --task draw_s --count many", "argument --count: found 'many'; accepted: a whole number, 1 or more"),
        ("drag --task draw_s --from 0,0,0 --out a.npz", "--from, --to: found one of them; accepted: both"),
        ("places --task draw_s --size 0.2,0.1 --out a.npz", "--size: found '0.2,0.1'; accepted: a number"),
        ("places --task draw_s --along 0,1.1 --out a.npz", "--along: found '0,1.1'; accepted: a number"),
        ("places --task draw_s --spread -1 --out a.npz", "--spread: found '-1'; accepted: metres, at"),
        ("", "the following arguments are required: SUBCOMMAND"),
    ],
)
def test_what_cannot_be_used_is_named(tmp_path, monkeypatch, capsys, arguments, message):
    monkeypatch.chdir(tmp_path)
    write_mat(tmp_path / "Hook.mat")
    (tmp_path / "file").touch()
    (tmp_path / "folder.npz").mkdir()
    try:
        status = main(arguments.split())
    except SystemExit as ended:  # by argparse
        status = ended.code
    assert status == 2
    assert message in capsys.readouterr().err


def test_a_shape_that_cannot_be_fitted_does_not_keep_the_others_from_it(lasa, tmp_path, monkeypatch, capsys):
    from dt_viz.learning.imitation import ImitationError

    def fit_only_in_the_plane(demonstrations, settings):
        if demonstrations[0].dimension == 3:
            raise ImitationError("demonstration 'lifted' is too strange")
        return real(demonstrations, settings)

    real = imitation.fit
    monkeypatch.setattr(imitation, "fit", fit_only_in_the_plane)
    times, positions = hook(0)
    space = tmp_path / "space.npz"
    save_demonstrations(space, [Demonstration(times, np.column_stack([positions, times]) / 1000, "lifted")])
    assert main(["imitation", str(space), str(lasa / "Hook.mat"), "--out", str(tmp_path / "out")]) == 2
    assert f"{space}: demonstration 'lifted' is too strange" in capsys.readouterr().err
    assert (tmp_path / "out" / "Hook.npz").exists() and not (tmp_path / "out" / "space.npz").exists()
