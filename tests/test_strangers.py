"""The library as a stranger uses it: whatever holds demonstrations is taken, what is odd is said, words are short."""

import re
import warnings
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from corrupted import corrupted

import dt_viz as dt
from dt_viz.learning.demonstrations import save_demonstrations
from dt_viz.library.takes import demonstrations_of
from dt_viz.warning import Kind

S = np.linspace(0.0, 1.0, 101)
PATH = np.column_stack([0.3 * S, 0.1 * np.sin(3 * S)])
DEEP = np.column_stack([PATH, 0.2 * S**2])
TIMES = S * 100 / 25


def flat(x: float, y: float) -> Any:
    """A place of the plane."""
    return x, y


class Table(dict):
    """What a pandas.DataFrame is to the library: columns by their names."""

    @property
    def columns(self) -> list[str]:
        return list(self)


@pytest.fixture(scope="module")
def drawing() -> dt.Motion:
    return dt.fit(PATH, rate=25)


@pytest.fixture(scope="module")
def deep() -> dt.Motion:
    return dt.fit([DEEP, 1.001 * DEEP - 0.001 * DEEP[-1]], rate=25)


# ---- what is taken ----


@pytest.mark.parametrize(
    ("given", "num"),
    [
        (PATH, 1),
        (PATH.tolist(), 1),
        (np.stack([PATH, PATH]), 2),
        ([PATH, PATH.tolist()], 2),
        (iter([PATH, PATH]), 2),
        (np.array([PATH, PATH[:, :]], dtype=object), 2),
        ((TIMES, PATH), 1),
        ([(TIMES, PATH), (TIMES.tolist(), PATH.tolist())], 2),
        (dt.Demonstration(TIMES, PATH), 1),
        ([dt.Demonstration(TIMES, PATH), PATH], 2),
        ({"left": PATH, "right": PATH}, 2),
        (Table(x=PATH[:, 0], y=PATH[:, 1]), 1),
        (Table(t=7 + TIMES, X=PATH[:, 0], y=PATH[:, 1]), 1),
        (Table(time=np.datetime64("2026-01-01") + (1e9 * TIMES).astype("m8[ns]"), x=PATH[:, 0], y=PATH[:, 1]), 1),
        (Table(demo=[*"ab" * 101], **{"x": np.repeat(PATH[:, 0], 2), "y": np.repeat(PATH[:, 1], 2)}), 2),
        (Table(t=[*TIMES, *TIMES], demo=[*"a" * 101, *"b" * 101], x=[*PATH[:, 0]] * 2, y=[*PATH[:, 1]] * 2), 2),
    ],
)
def test_whatever_holds_demonstrations_is_taken(given, num):
    takes = demonstrations_of(given, 25)
    assert len(takes) == len({take.name for take in takes}) == num
    for take in takes:
        np.testing.assert_allclose(take.times, TIMES, atol=1e-9)
        np.testing.assert_array_equal(take.positions, PATH)


def test_files_and_folders_are_taken(tmp_path):
    save_demonstrations(tmp_path / "a.npz", [dt.Demonstration(TIMES, PATH, "first")])
    np.savetxt(tmp_path / "b.csv", np.column_stack([TIMES, PATH]), delimiter=",", header="t,x,y", comments="")
    for given, names in (
        (tmp_path / "a.npz", ["first"]),
        (str(tmp_path / "b.csv"), ["b"]),
        ([tmp_path / "b.csv", tmp_path / "a.npz"], ["b", "first"]),
    ):
        takes = demonstrations_of(given)
        assert [take.name for take in takes] == names
        np.testing.assert_allclose(takes[0].positions, PATH)
    (tmp_path / "a.npz").unlink()
    assert [take.name for take in demonstrations_of(tmp_path)] == ["b"]


def test_takes_without_times_or_a_rate_last_five_seconds_which_is_said():
    with pytest.warns(dt.DemonstrationWarning, match=r"no times and no rate: .* 5 s long; rate=…, Hz"):
        (take,) = demonstrations_of(PATH)
    assert take.duration == 5.0


def test_the_examples_are_the_shipped_tasks():
    assert len(dt.example("push_box")) > 5 and dt.example("draw_s")[0].dimension == 2
    with pytest.raises(dt.FormatError, match=r"example: found 'box'; accepted: draw_s, .*push_box"):
        dt.example("box")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ([], "takes: found none; accepted: arrays"),
        ({}, "takes: found none"),
        ([[]], "takes: found none"),
        (None, "found None"),
        ([PATH, None], "found None"),
        (object(), "values of type object"),
        (5, r"shape \(\)"),
        (np.zeros(3), r"shape \(3,\); accepted: arrays \(T, 2\) or \(T, 3\), metres"),
        ((0.1, 0.2, 0.3), r"shape \(3,\)"),
        (PATH.T, r"shape \(2, 101\).*positions\.T"),
        (np.zeros((50, 6)), r"shape \(50, 6\).*joint angles: positions = arm\.end_effector\(q\)"),
        (np.zeros((3, 50, 7)), "joint angles.*poses"),
        (np.zeros((50, 4)), "the first column is time"),
        (PATH * np.nan, "found nan at sample 1; accepted: finite numbers"),
        (PATH * 1e3, r"found 300 m in 'take 1'; accepted: metres.*positions / 1000"),
        ([PATH, DEEP], "dimension: found 2 in 'take 1' but 3 in 'take 2'"),
        ("nowhere.csv", "no such file"),
        (["a", "b"], "no such file"),
        (b"bytes", "found an array of shape"),
        (PATH.astype(str), "values of type ndarray"),
        ([[1, 2], [3]], "points of different dimension"),
        ((TIMES[::-1], PATH), "times that increase"),
        (dt.Demonstration(cast(Any, None), PATH), "times of 'take 1'"),
        (Table(a=S, b=S), "columns: found a, b; accepted: x, y and perhaps z, t and demo"),
        (Table(x=["a", "b"], y=["c", "d"]), "x, y or z with text"),
    ],
)
def test_what_is_no_demonstration_is_refused_in_one_line_with_a_way_out(given, words):
    with pytest.raises(dt.DataError, match=words) as caught:
        dt.fit(given, rate=25)
    assert "\n" not in str(caught.value) and "0x" not in str(caught.value) and len(str(caught.value)) < 250


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"rate": 0}, "rate: found 0; accepted: samples a second, above 0"),
        ({"rate": "fast"}, "rate: found 'fast'"),
        ({"rate": 25, "goal": (1, 1, 1)}, r"goal: found \(1, 1, 1\); accepted: \(x, y\), metres"),
        ({"rate": 25, "goal": "goal"}, "goal: found 'goal'"),
        ({"rate": 25, "goal": (3, 3)}, r"goal: found \(3, 3\) m, at which no demonstration ends; accepted: a place"),
        ({"rate": 25, "labels": [1, 2]}, "labels: found 2; accepted: 1"),
    ],
)
def test_options_that_make_no_sense_are_refused(options, words):
    with pytest.raises(ValueError, match=words):
        dt.fit(PATH, **options)


# ---- what is said ----


def test_changes_are_warned_about_and_reported_take_by_take(tmp_path):
    clean = dt.example("draw_j")[:4]
    takes = corrupted(clean, ["noise", "outliers"], 100, seed=2)
    takes[3] = dt.Demonstration(takes[3].times, takes[3].positions + 0.5)
    with pytest.warns(dt.DemonstrationWarning) as caught:
        motion = dt.fit(takes)
    texts = [str(warning.message) for warning in caught]
    assert all(warning.filename == __file__ for warning in caught)
    for words in (
        r"far off; left out \(and",
        r"jitters by .* mm; smoothed \(and 3 more",
        "'take 4' ends .*; it is left out",
    ):
        assert any(re.search(words, text) for text in texts)
    assert [each.kept for each in motion.inspections] == [True, True, True, False]
    report = motion.report().splitlines()
    assert report.pop(0) == repr(motion)
    assert re.match(r"(plain|augmented) state: .* left out: plain .* mm \(.* × the shifted mean\)", report.pop(0))
    assert re.fullmatch(
        r"'draw J 0': \d.* s, \d+ samples, [\d.]+ Hz: has .*\(left out\);.* is up to .* mm off", report[0]
    )
    assert "ends" in report[3] and "mm off" not in report[3]
    assert len(motion.rollouts()) == 4  # also from the start of the take that is left out
    motion.save(tmp_path / "motion")
    again = dt.Motion.load(tmp_path / "motion")
    assert again.report() == motion.report()


@pytest.mark.long
def test_clean_takes_are_learned_without_a_warning():
    takes = dt.example("draw_j")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        motion = dt.fit(takes)
    assert motion.report().count("as it should be") == len(takes)


def test_the_goal_can_be_chosen_among_the_ends_and_labels_do_not_stand_for_goals(tmp_path):
    takes = [PATH, PATH, PATH + 0.3, PATH + 0.3]
    with pytest.raises(dt.ImitationError, match=r"'take 1', 'take 2' at .*; 'take 3', 'take 4' at .*goal=…"):
        dt.fit(takes, rate=25)
    with pytest.warns(dt.DemonstrationWarning, match="'take 1' ends 424 mm from the goal; it is left out"):
        motion = dt.fit(takes, rate=25, goal=PATH[-1] + 0.3, state="augmented")
    np.testing.assert_allclose(motion.goal, PATH[-1] + 0.3, rtol=1e-12)
    motion.save(tmp_path / "motion")
    np.testing.assert_array_equal(dt.Motion.load(tmp_path / "motion").goal, motion.goal)
    with pytest.raises(dt.FormatError, match="labels: found 1 for takes that end elsewhere"):
        dt.fit([PATH, *takes], rate=25, labels=[0, 0, 0, 1, 1])


def test_values_say_in_one_line_what_they_are(drawing, deep):
    ball = dt.Sphere((0.1, 0.0, 0.0), diameter=0.05)
    around = deep.stack(dt.Avoidance(ball), dt.BiasPoint((0.2, 0.1, 0.1)))
    arm = dt.load_jaco()
    push = dt.fit(dt.example("push_box")[:2], state="augmented")
    path = push.rollouts()[0]
    for value, words in (
        (drawing, r"Motion\(1 take in the plane, plain state, goal \(0.3, 0.0141\) m\)"),
        (around, r"Motion\(2 takes in space, plain state, goal .*, Avoidance 1, Bias 1\)"),
        (around.rollouts()[0], r"Path\(\d+ samples, 0\.\d+ m in 4\.?\d* s\)"),
        (around.certificates(), r"Certificates\(clearance .* mm, det J ≥ .*, Lyapunov value falls, no warnings\)"),
        (dt.Avoidance(ball, space="cspace"), r"ArmAvoidance\(Sphere at \(0.1, 0.0, 0.0\) m; margin 10 mm, .*auto\)"),
        (dt.BiasPoint(flat(0.2, 0.1)), r"BiasPoint\(\(0.2, 0.1\) m, radius auto, strength auto\)"),
        (dt.Demonstration(TIMES, PATH, "one"), r"Demonstration\('one': 101×2 positions, metres, 4 s\)"),
        (arm, r"Arm\(.*6 joints.*\)"),
        (arm.follow(path), r"JointPath\(\d+ samples of 6 joints, .* s, hand up to .* mm beside its path\)"),
        (dt.Controller(push, arm), r"Controller\(Motion\(.*\)\)"),
        (dt.HandController(push, path.positions[0]), r"HandController\(phase 1\.00 of Motion\(.*\)\)"),
    ):
        assert re.fullmatch(words, repr(value)), repr(value)
        assert len(repr(value)) < 250
    assert repr(dt.Demonstration(cast(Any, None), cast(Any, None))) == "Demonstration('':  positions, metres)"
    for value in (ball, dt.ControllerSettings(), dt.ImitationSettings(), dt.TrackingSettings(), dt.Integration()):
        assert "\n" not in repr(value) and "0x" not in repr(value) and "array" not in repr(value)


# ---- places of the plane ----


def test_motions_in_the_plane_take_places_of_the_plane(drawing):
    x, y = drawing.rollouts()[0].positions[80]
    near, same = dt.BiasPoint(flat(x, y + 0.02)), dt.BiasPoint((x, y + 0.02, 0.0))
    np.testing.assert_array_equal(
        drawing.stack(near).rollouts()[0].positions, drawing.stack(same).rollouts()[0].positions
    )
    around = drawing.stack(near, dt.Avoidance([dt.Sphere(flat(x, y), 0.05), dt.Box(flat(0.0, 0.3), (0.1, 0.1, 0.1))]))
    assert around.certificates().clearance > 0.0085
    assert around.transforms[1].avoided.parts[1].position == (0.0, 0.3, 0.0)


@pytest.mark.parametrize(
    ("transform", "words"),
    [
        (dt.BiasPoint(flat(0.1, 0.2)), r"position of BiasPoint: found \(0.1, 0.2\); accepted: \(x, y, z\), metres"),
        (dt.Avoidance(dt.Sphere(flat(0.1, 0.2))), r"position of Sphere: found \(0.1, 0.2\); accepted: \(x, y, z\)"),
        (dt.BiasPoint(cast(Any, "abc")), "position of BiasPoint: found 'abc'"),
        (dt.BiasPoint((0.0, np.inf, 0.0)), "found .*inf"),
    ],
)
def test_motions_in_space_take_places_in_space_only(deep, transform, words):
    with pytest.raises(dt.FormatError, match=words):
        deep.stack(transform)


def test_four_coordinates_are_no_place_in_the_plane(drawing):
    with pytest.raises(dt.FormatError, match=r"accepted: \(x, y\), metres: the motion is in the plane"):
        drawing.stack(dt.BiasPoint(cast(Any, (0.1, 0.2, 0.0, 0.0))))


def test_a_point_before_the_plane_is_still_said(drawing):
    above = replace(dt.BiasPoint((0.15, 0.05, 0.0)), position=(0.15, 0.05, 0.1))
    assert Kind.OFF_PLANE in {warning.kind for warning in drawing.stack(above).certificates().warnings}


def test_an_end_stays_where_it_is_unless_ends_are_moved_and_a_goal_may_be_an_array():
    goal = PATH[-1]
    settings = dt.PreparationSettings(goal=goal, move_ends=False, smooth_jitter=False)
    noisy = PATH + np.random.default_rng(0).normal(0, 2e-3, PATH.shape)
    with pytest.warns(dt.DemonstrationWarning):
        motion = dt.fit(
            [PATH, PATH, noisy], rate=25, settings=dt.ImitationSettings(preparation=settings), state="augmented"
        )
    assert [each.kept for each in motion.inspections] == [True, True, False]
