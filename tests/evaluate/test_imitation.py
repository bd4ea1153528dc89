"""What was learned of files, beside what was demonstrated, in-sample and held out."""

import json
import sys
from dataclasses import replace

import numpy as np
import pytest
from hook import NUM_DEMONSTRATIONS, apart, hook
from PIL import Image
from scipy.spatial.transform import Rotation
from turning import turning_takes

from dt_viz.evaluate import imitation
from dt_viz.evaluate.__main__ import main
from dt_viz.evaluate.held_out import WAYS, degrees_off, folds_of, follow
from dt_viz.flows.rotations import quaternions, rotation
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration, save_demonstrations
from dt_viz.learning.imitation import fit, grown_grid
from dt_viz.metrics import resample_by_arc_length, rms_at_equal_times
from dt_viz.pictures import figures
from dt_viz.pictures.figures import FigurePanel


@pytest.fixture(scope="module")
def imitated(lasa, tmp_path_factory):
    """Its folder."""
    out = tmp_path_factory.mktemp("out") / "new"
    assert main(["imitation", str(lasa / "Hook.mat"), "--out", str(out)]) == 0
    return out


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


@pytest.mark.long
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


def test_a_panel_is_drawn_from_the_broadest_side_under_its_name():
    path = np.column_stack([np.linspace(0, 3, 20), np.linspace(0, 4, 20), np.linspace(0, 1, 20)])
    figure = figures.panels(
        [
            FigurePanel("A", {"demonstration": [path], "learned": [path]}),
            FigurePanel("B", {"demonstration": [path], "learned": [path[:2]]}),
        ]
    )
    first, second = figure.axes
    assert (first.get_title(), second.get_title()) == ("A", "B")
    np.testing.assert_allclose(np.array(first.lines[0].get_xydata())[-1], [5, 1])  # 5 m wide and 1 m high


def test_without_matplotlib_all_but_the_figures_is_written_and_one_line_says_so(lasa, tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    assert main(["imitation", str(lasa / "Hook.mat"), "--out", str(tmp_path)]) == 0
    assert capsys.readouterr().err == (
        "no figures: matplotlib: found not installed; accepted: pip install 'dt-viz[figures]'\n"
    )
    assert sorted(path.name for path in tmp_path.iterdir()) == ["Hook.npz", "figures.json"]


def test_augmented_imitation_is_measured_as_plain_is(lasa, tmp_path):
    files = [str(lasa / "Hook.mat")]
    assert main(["imitation", *files, "--state", "augmented", "--folds", "2", "--out", str(tmp_path)]) == 0
    written = json.loads((tmp_path / "figures.json").read_text())
    assert written["state"] == "augmented" and written["held_out"][0]["folds"] == 2
    (shape,) = written["shapes"]
    assert shape["min_det_jacobian"] == pytest.approx(1.0) and shape["round_trip_of_extent"] < 1e-12


def test_what_is_held_out_is_not_learned_from():
    recorded = [hook(i) for i in range(4)]
    demonstrations = [Demonstration(times, path / 1000, str(i)) for i, (times, path) in enumerate(recorded)]
    learned_from = []

    def learn(others):
        learned_from.append([d.name for d in others])
        return fit(others)

    followed = [f for held in folds_of(4, 2) for f in follow(demonstrations, learn, held)]
    assert learned_from == [["1", "3"], ["0", "2"]]
    assert [(f.number, f.demonstration.name) for f in followed] == [(0, "0"), (2, "2"), (1, "1"), (3, "3")]
    nearest = resample_by_arc_length(demonstrations[1].positions, 400)  # the nearest start of 1 and 3
    np.testing.assert_allclose(
        followed[0].motions["nearest"][0] - nearest,
        np.linspace(1, 0, 400)[:, None] * (demonstrations[0].positions[0] - nearest[0]),
        atol=1e-12,
    )


def test_a_shape_that_cannot_be_fitted_does_not_keep_the_others_from_it(lasa, tmp_path, monkeypatch, capsys):
    from dt_viz.learning.imitation import ImitationError

    def learn_only_in_the_plane(demonstrations, **settings):
        if demonstrations[0].dimension == 3:
            raise ImitationError("demonstration 'lifted' is too strange")
        return real(demonstrations, **settings)

    real = imitation.learn_in_state
    monkeypatch.setattr(imitation, "learn_in_state", learn_only_in_the_plane)
    times, positions = hook(0)
    space = tmp_path / "space.npz"
    save_demonstrations(space, [Demonstration(times, np.column_stack([positions, times]) / 1000, "lifted")])
    assert main(["imitation", str(space), str(lasa / "Hook.mat"), "--out", str(tmp_path / "out")]) == 2
    assert f"{space}: demonstration 'lifted' is too strange" in capsys.readouterr().err
    assert (tmp_path / "out" / "Hook.npz").exists() and not (tmp_path / "out" / "space.npz").exists()


@pytest.mark.long
def test_the_hands_orientation_is_measured_beside_the_mean_of_the_others(tmp_path, capsys):
    takes = turning_takes(4)
    save_demonstrations(tmp_path / "turning.npz", takes)
    run = ["imitation", str(tmp_path / "turning.npz"), "--state", "auto", "--leave-one-out", "--out", str(tmp_path)]
    assert main(run) == 0
    (row,) = json.loads((tmp_path / "figures.json").read_text())["turns"]
    assert "degrees from the demonstration's" in capsys.readouterr().out
    with np.load(tmp_path / "turning-held-out.npz") as arrays:
        for title, way in (("held_out", "learned"), ("mean_of_others", "mean")):
            off = np.stack([arrays[f"{way}_degrees_{i}"] for i in range(4)])
            assert row[f"{title}_median"] == pytest.approx(np.median(off))
            assert row[f"{title}_largest"] == pytest.approx(off.max())
    assert row["in_sample_median"] < 1 < row["held_out_median"] < 1.5 * row["mean_of_others_median"]
    own = fit_augmented(takes)
    aside = Rotation.from_rotvec([0.0, 0.0, np.deg2rad(10)])
    turned = [replace(take, orientations=quaternions(aside * rotation(take.orientations))) for take in takes]
    off = degrees_off(own, takes, turned[0])
    assert np.median(off["learned"]) == pytest.approx(10, abs=1)
