"""Imitation in the augmented state: demonstrations that cross, come back and wind, other starts, labels, bad input."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from crossings import crossings
from drawings import extent, frechet, from_one_start, path_from
from scenes import kinds

from dt_viz.avoidance.hand import Avoidance
from dt_viz.avoidance.registry import AVOIDANCE
from dt_viz.errors import FormatError
from dt_viz.learning.augmented import Style, fit_augmented
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import ImitationError, prepare
from dt_viz.metrics import resample_by_arc_length, rms_at_equal_times
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import STYLES, TASKS
from dt_viz.warning import Kind

CASES = crossings()


@lru_cache
def learned(task):
    return fit_augmented(TASKS[task]().demonstrations)


@pytest.mark.parametrize("name", CASES)
def test_what_crosses_comes_back_or_winds_is_followed(name):
    case = CASES[name]
    imitation = fit_augmented(case.demonstrations, case.labels)
    labels = case.labels or [None] * len(case.demonstrations)
    off = [
        frechet(path_from(imitation, d.positions[0], label), d.positions)
        for d, label in zip(case.demonstrations, labels, strict=True)
    ]
    assert max(off) <= (0.03 if case.labels else 0.04) * extent(case.demonstrations)


def drawn_often(num, seed=0):
    """An eight that is drawn `num` times in a row."""
    rng, u = np.random.default_rng(seed), np.linspace(0, 1, 60 * num + 1)
    angle = 2 * np.pi * num * u + 0.5 * (1 - u)
    eight = 0.1 * np.column_stack([np.sin(angle), np.sin(2 * angle) / 2])
    beside = 0.005 * rng.normal(size=(3, 2))
    return [Demonstration(4 * num * u, eight + (1 - u)[:, None] * b, "eight") for b in beside]


@pytest.mark.parametrize("num", [1, 4, 8, 16])
def test_a_figure_that_is_drawn_often_gets_the_knots_that_it_needs(num):
    demonstrations = drawn_often(num)

    def off(**settings):
        imitation, many = fit_augmented(demonstrations, settings=AugmentedSettings(**settings)), 100 * num
        paths = [path_from(imitation, d.positions[0], num=many) for d in demonstrations]
        distances = [frechet(path, d.positions, many) for path, d in zip(paths, demonstrations, strict=True)]
        return max(distances) / extent(demonstrations)

    assert off() < 0.05
    if num > 1:
        assert off(min_knots=30, max_knots=30) > 0.07


def test_the_size_of_demonstrations_does_not_depend_on_how_they_are_turned():
    demonstrations = TASKS["draw_w"]().demonstrations
    motions, start = prepare(demonstrations), demonstrations[0].positions[0]
    wanted = path_from(learned("draw_w"), start)
    for angle in np.linspace(0, np.pi, 7):
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        turned = [replace(d, positions=d.positions @ turn.T) for d in demonstrations]
        assert prepare(turned).extent == pytest.approx(motions.extent, rel=1e-9)
        np.testing.assert_allclose(path_from(fit_augmented(turned), start @ turn.T), wanted @ turn.T, atol=1e-9)
    assert 0.9 < motions.extent / extent(demonstrations) < 1.5


@pytest.mark.parametrize("task", ["draw_s", "draw_w", "push_box"])
def test_motions_begin_and_end_exactly_and_take_their_time(task):
    demonstrations, imitation = TASKS[task]().demonstrations, learned(task)
    for d in demonstrations:
        start = d.positions[0]
        path = path_from(imitation, start)
        np.testing.assert_allclose(path[0], start, atol=1e-12)
        np.testing.assert_allclose(path[-1], imitation.goal, atol=1e-12)
        times = np.linspace(0, d.times[-1] - d.times[0], 400)
        rollout = imitation.system.rollout(imitation.states(start), times)[:, : imitation.dim]
        assert rms_at_equal_times(times, rollout, d.times - d.times[0], d.positions) < 0.05 * extent(demonstrations)
        assert np.linalg.norm(rollout[-1] - imitation.goal) < 0.01 * extent(demonstrations)


@pytest.mark.long
def test_left_out_demonstrations_are_predicted_better_than_by_their_mean():
    off, trivial = [], []
    for task in ("draw_s", "draw_j", "draw_g"):
        demonstrations = TASKS[task]().demonstrations
        for k, held in enumerate(demonstrations):
            others = [d for i, d in enumerate(demonstrations) if i != k]
            start = held.positions[0]
            off.append(frechet(path_from(fit_augmented(others), start), held.positions))
            mean = np.mean([resample_by_arc_length(d.positions, 150) for d in others], axis=0)
            shifted = mean + np.linspace(1, 0, 150)[:, None] * (start - mean[0])
            trivial.append(frechet(shifted, held.positions))
    assert np.mean(off) < np.mean(trivial)


@pytest.mark.parametrize("away", [0.25, 0.5, 1.5])
def test_from_far_away_the_figure_is_drawn_shifted_and_not_in_a_hurry(away):
    demonstrations = TASKS["draw_s"]().demonstrations
    imitation, size = learned("draw_s"), extent(demonstrations)
    mean = np.mean([resample_by_arc_length(d.positions, 150) for d in demonstrations], axis=0)
    fastest = max(np.linalg.norm(np.gradient(d.positions, d.times, axis=0), axis=1).max() for d in demonstrations)
    direction = np.array([1.0, 0, 0, 1.0, -1.0, 0, 0, -1.0]).reshape(4, 2)
    axes = np.linalg.svd(mean - mean.mean(axis=0))[2][:2]
    for across in direction:
        start = mean[0] + away * size * across @ axes
        shifted = mean + np.linspace(1, 0, 150)[:, None] * (start - mean[0])
        assert frechet(path_from(imitation, start), shifted) < 0.06 * size
        times = np.linspace(0, 12, 1200)
        path = imitation.system.rollout(imitation.states(start), times)[:, : imitation.dim]
        assert np.linalg.norm(np.gradient(path, times, axis=0), axis=1).max() < (1.3 + 2 * max(away - 0.5, 0)) * fastest


def test_a_push_is_forgotten_and_the_rest_of_the_figure_is_drawn():
    demonstrations = CASES["wide eight"].demonstrations
    imitation, start = fit_augmented(demonstrations), demonstrations[0].positions[0]
    system, size = imitation.system, extent(demonstrations)
    z = system.base.at_fraction(system.transform.forward(imitation.states(start)), np.array([0.6]))
    state = system.transform.inverse(z)[0] + [0.2 * size, 0, 0, 0, 0, 0]
    z0 = system.transform.forward(state)
    pushed = system.transform.inverse(system.base.at_fraction(z0, np.linspace(1, 0, 300)))[:, :2]
    rest = system.transform.inverse(system.base.at_fraction(z[0], np.linspace(1, 0, 300)))[:, :2]
    drawn = np.linalg.norm(rest[:, None] - pushed, axis=2).min(axis=1) < 0.05 * size
    assert drawn.mean() > 0.6
    np.testing.assert_allclose(pushed[-1], imitation.goal, atol=1e-9)


def test_a_small_change_of_the_start_changes_the_motion_little():
    imitation = learned("draw_w")
    for start in imitation.starts:
        moved = path_from(imitation, start + 1e-5) - path_from(imitation, start)
        assert np.linalg.norm(moved, axis=1).max() < 3 * 1e-5 * np.sqrt(len(start))


# --- Bad input ---


def test_one_demonstration_is_followed_exactly():
    (d, *_) = TASKS["draw_s"]().demonstrations
    imitation = fit_augmented([d])
    assert frechet(path_from(imitation, d.positions[0]), d.positions) < 0.01 * extent([d])
    assert np.isfinite(path_from(imitation, d.positions[0] + 0.1)).all()


def test_demonstrations_that_contradict_in_time_give_a_time_between():
    (d, *_) = TASKS["draw_s"]().demonstrations
    beside = replace(d, positions=d.positions + np.linspace(1, 0, len(d.positions))[:, None] * [0.01, 0.01])
    motions = ((d, 1), (beside, 30))
    imitation = fit_augmented([replace(one, times=np.linspace(0, end, len(d.times))) for one, end in motions])
    states = (imitation.states(d.positions[0] + share * 0.01) for share in (0, 0.5))
    arrival = [imitation.system.base.times_at(state, np.array([1e-3 * imitation.top]))[0] for state in states]
    assert 0.9 < arrival[0] < arrival[1] < 30


def test_identical_starts_do_no_harm():
    alike = from_one_start(TASKS["draw_s"]().demonstrations)
    imitation, size, start = fit_augmented(alike), extent(alike), alike[0].positions[0]
    assert max(frechet(path_from(imitation, start), d.positions) for d in alike) < 0.15 * size
    elsewhere = path_from(imitation, start + 0.1 * size)
    assert np.linalg.norm(elsewhere - path_from(imitation, start), axis=1).max() < 0.3 * size


def test_a_start_on_the_goal_draws_the_whole_figure():
    demonstrations, imitation = TASKS["draw_s"]().demonstrations, learned("draw_s")
    path = path_from(imitation, imitation.goal)
    np.testing.assert_allclose(path[[0, -1]], np.stack([imitation.goal] * 2), atol=1e-12)
    assert np.ptp(path, axis=0).max() > 0.3 * extent(demonstrations)


@pytest.mark.parametrize("beside", [0.0, 1e-6, 1e-3, 1e-2])
def test_from_the_goal_it_is_not_in_a_hurry_where_the_way_is_straight(beside):
    u = np.linspace(0, 1, 100)[:, None]
    imitation = fit_augmented([Demonstration(3 * u[:, 0], (1 - u) * [0.3, 0.0], "straight")])
    state = imitation.states(np.add(imitation.goal, [beside, 0.0]))
    state[0] += 0.05  # pushed
    usual = imitation.states(np.array([0.3, 0.0]))
    usual[0] += 0.05
    speeds = [float(np.linalg.norm(imitation.system.velocity(one)[:2])) for one in (state, usual)]
    assert speeds[0] < 5 * speeds[1]


def test_labels_are_checked():
    case = CASES["left and right from one start"]
    with pytest.raises(ImitationError):
        fit_augmented([])  # nothing to learn from
    with pytest.raises(ImitationError, match="found 3; accepted: 2, one for each"):
        fit_augmented(case.demonstrations, (1, 2, 3))
    with pytest.raises(ImitationError, match=r"found .*nan.*; accepted: finite numbers"):
        fit_augmented(case.demonstrations, (1, float("nan")))
    imitation = fit_augmented(case.demonstrations, case.labels)
    start = case.demonstrations[0].positions[0]
    with pytest.raises(FormatError, match=r"label: found 7; accepted: -1, 1"):
        imitation.states(start, 7)
    plain = fit_augmented(case.demonstrations[:1])
    with pytest.raises(FormatError, match="the demonstrations have none"):
        plain.states(start, 1.0)
    one, other = (path_from(imitation, start, label) for label in (1.0, -1.0))
    assert one[:, 1].max() > 0.09 and other[:, 1].min() < -0.09


def test_labels_stay_with_their_demonstrations_where_one_is_left_out():
    case = CASES["left and right from one start"]
    assert case.labels is not None
    resting = Demonstration(np.linspace(0, 1, 10), np.tile(case.demonstrations[0].positions[-1], (10, 1)), "rests")
    imitation = fit_augmented([resting, *case.demonstrations], (5.0, *case.labels))
    starts = np.stack([d.positions[0] for d in (resting, *case.demonstrations)])
    labels = imitation.demonstrated(starts)[1:, -1]
    assert labels.tolist() == [1, 0]
    np.testing.assert_array_equal(labels, [imitation.states(starts[1], label)[-1] for label in case.labels])
    assert any("rests" in warning for warning in imitation.warnings)


# styles: what leads from one hand to another, taken off and put on


@pytest.fixture(scope="module", name="style")
def _style():
    return Style.between(*(learned(task) for task in STYLES["wavy"]))


def test_put_on_the_usual_motion_it_gives_the_styled_one(style):
    usual, styled = (learned(task) for task in STYLES["wavy"])
    given, without = (
        np.mean([frechet(path_from(one, start), path_from(styled, start)) for start in styled.starts])
        for one in (style.on(usual, 1.0), usual)
    )
    assert given < 0.6 * without  # the rest is how the demonstrations of one hand differ
    knots = usual.patterns[0].mean + usual.top * style.offsets - usual.goal
    wanted = (styled.patterns[0].mean - styled.goal) * usual.top / styled.top
    fading = np.linspace(1, 0, len(knots))[:, None] * (wanted - knots)[0]
    np.testing.assert_allclose(knots + fading, wanted, atol=1e-12)


@pytest.mark.parametrize("task", ["draw_c", "draw_w", "draw_8"])
def test_taken_off_again_nothing_is_left_and_ends_stay(style, task):
    own = learned(task)
    on = style.on(own, 0.7)
    start = own.starts[1]
    np.testing.assert_allclose(path_from(on, start)[[0, -1]], np.stack([start, own.goal]), atol=1e-12)
    np.testing.assert_allclose(path_from(style.on(on, -0.7), start), path_from(own, start), atol=1e-12)
    size = float(np.ptp(path_from(own, start), axis=0).max())
    assert frechet(path_from(on, start), path_from(own, start)) > 0.02 * size
    states = on.states(on.starts)
    states[:, on.dim] *= 0.4
    np.testing.assert_allclose(np.linalg.det(on.system.transform.jacobian(states)[1]), 1.0, atol=1e-9)


def test_hands_of_other_detail_give_a_style_too(style):
    usual = learned("draw_s")
    finer = fit_augmented(TASKS[STYLES["wavy"][1]]().demonstrations, settings=AugmentedSettings(min_knots=240))
    mixed, own = Style.between(usual, finer), learned("draw_c")
    assert len(mixed.offsets) == 240 and len(style.offsets) == 120
    for on in (style, mixed):
        path, wanted = (path_from(one.on(own, 1.0), own.starts[0]) for one in (on, style))
        assert np.linalg.norm(path - wanted, axis=1).max() < 0.05 * own.top


def test_a_hand_of_several_patterns_is_no_style_and_it_fits_motions_of_as_many_coordinates(style):
    usual, case = learned("draw_s"), crossings()["left and right from one start"]
    with pytest.raises(ImitationError, match="found a hand of 2 patterns; accepted: 1"):
        Style.between(usual, fit_augmented(case.demonstrations, case.labels))
    with pytest.raises(ImitationError, match="style: found a motion of 3 coordinates; accepted: 2"):
        style.on(learned("push_box"), 1.0)


def test_around_a_sphere_every_certificate_holds(engine):
    task = engine.task("draw_c")
    sphere = Sphere(as_point(task.mean_path[40]), 0.08)
    scenario = Scenario("draw_c", (Layer(Avoidance(sphere), name=AVOIDANCE.title),), style="wavy", style_amount=1.5)
    frame = list(engine.frames(scenario))[-1]
    known = frame.certificates
    assert kinds(known.warnings) <= {Kind.ARM_ENTERS} and known.lyapunov_falls is True
    assert known.min_det_jacobian is not None and known.min_det_jacobian > 0 and frame.remembers
    straight = replace(scenario, imitation=False)
    assert not list(engine.frames(straight))[-1].remembers
