"""Takes that are taught: a spline keeps the times and takes out noise; what is no take is one line; the task stays."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.files.recordings import Recordings
from dt_viz.learning.demonstrations import DemonstrationError
from dt_viz.motion.nominal import learned_of
from dt_viz.robot.models import load_arm
from dt_viz.scenario.own import Own
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.taught import Lesson
from dt_viz.session import opening
from dt_viz.session.opening import Choices, Opened
from dt_viz.session.teaching import (
    SETTINGS,
    Stroke,
    board_of,
    crosses_itself,
    drawn_beyond,
    out_of_reach,
    smoothed,
    taught,
)

T = 3.0


def curve(u, kind="S"):
    """An S, or an 8 that ends beside its start, (N, 2), metres."""
    eased = 3 * u**2 - 2 * u**3
    turn = 2 * np.pi * eased
    if kind == "8":
        return np.stack([0.12 * np.sin(2 * turn), 0.16 * np.cos(turn) + 0.05 * eased], axis=1)
    return np.stack([-0.11 * np.sin(1.5 * np.pi * (2 * eased - 1)), -0.34 * (eased - 0.5)], axis=1)


def times_of(rng, num=61):
    """What a page sends in three seconds: 20 points a second, each some milliseconds late."""
    return np.sort(np.clip(np.linspace(0, T, num) + rng.normal(scale=0.003, size=num), 0, T))


def stroke(seed=0, kind="S", board=None, noise=0.001):
    rng = np.random.default_rng(seed)
    times = times_of(rng)
    points = curve(times / T, kind) + rng.normal(scale=noise, size=(len(times), 2)) + rng.normal(scale=0.004, size=2)
    drawn = Stroke()
    for moment, place in zip(
        times, np.pad(points, [(0, 0), (0, 1)]) if board is None else board.at(points), strict=True
    ):
        drawn.add(1000.0 + moment, place)
    return drawn


def three(robot, kind="S"):
    board = board_of(robot)
    return tuple(taught(f"drawn {k + 1}", stroke(k, kind, board), board) for k in range(3))


@pytest.mark.parametrize("noise", [0.0, 0.0005, 0.001, 0.003])
def test_a_spline_is_nearer_to_the_curve_than_the_polyline_through_its_points(noise):
    off = []
    for seed in range(8):
        rng = np.random.default_rng(seed)
        times = times_of(rng)
        points = curve(times / T) + rng.normal(scale=noise, size=(len(times), 2))
        even, kept = smoothed(times, points)
        true = curve((even + times[0]) / T)
        straight = np.stack([np.interp(even + times[0], times, x) for x in points.T], axis=1)
        off.append([np.sqrt(((path - true) ** 2).sum(axis=1).mean()) for path in (kept, straight)])
    spline, polyline = np.mean(off, axis=0)
    assert spline < 0.75 * polyline
    assert spline < 0.7 * noise + 0.0002


def test_the_spline_keeps_the_times_also_where_the_pointer_stood_still():
    moving = np.arange(0, 1.001, 0.05)
    points = np.concatenate([curve(moving / 2), curve(0.5 + moving / 2)])
    even, kept = smoothed(np.concatenate([moving, 3.0 + moving]), points)  # it sends nothing while it stands
    assert even[-1] == pytest.approx(4.0) and np.diff(even) == pytest.approx(1 / SETTINGS.rate, rel=0.02)
    stands = kept[(even > 1.3) & (even < 2.7)]
    np.testing.assert_allclose(stands, np.broadcast_to(points[20], stands.shape), atol=0.003)


def test_a_line_that_is_straight_stays_straight():
    times = np.arange(0, 1.001, 0.05)
    even, kept = smoothed(times, times[:, None] * [0.0, 0.2])
    np.testing.assert_allclose(kept, even[:, None] * [0.0, 0.2], atol=1e-9)


def test_ten_thousand_points_are_thinned():
    times = np.linspace(0, T, 10_000)
    even, kept = smoothed(times, curve(times / T))
    assert len(even) == T * SETTINGS.rate + 1
    np.testing.assert_allclose(kept, curve(even / T), atol=0.001)
    long = Stroke()
    for moment in np.arange(10_000):
        long.add(float(moment), np.zeros(3))
    assert SETTINGS.most_recorded / 2 <= len(long.moments) < SETTINGS.most_recorded and long.moments[0] == 0.0
    assert len(long.points) == len(long.moments)


def test_points_that_arrive_together_count_once():
    times = np.repeat(np.arange(0, T + 0.001, 0.05), 2)
    even, kept = smoothed(times, curve(times / T))
    assert np.isfinite(kept).all()
    np.testing.assert_allclose(kept, curve(even / T), atol=0.001)


@pytest.mark.parametrize(
    ("points", "said"),
    [
        (np.zeros((0, 2)), "0 points"),
        (np.zeros((1, 2)), "1 point,"),
        (np.zeros((50, 2)), "0 mm long"),
        (curve(np.linspace(0, 1, 4)), "4 points"),
        (np.full((50, 2), np.nan), "not finite"),
        (np.where(np.arange(50)[:, None] == 7, np.inf, curve(np.linspace(0, 1, 50))), "not finite"),
    ],
)
def test_what_is_no_take_is_one_line(points, said):
    given = Stroke()
    for k, place in enumerate(points):
        given.add(0.05 * k, np.append(place, 0.0))
    with pytest.raises(DemonstrationError, match=said) as error:
        taught("drawn 1", given)
    assert "\n" not in str(error.value) and "accepted" in str(error.value)


def test_a_stroke_that_goes_on_counts_no_time_in_between():
    given = Stroke()
    given.add(10.0, np.zeros(3), begins=True)
    given.add(10.1, np.ones(3))
    given.add(70.0, np.ones(3), begins=True)
    given.add(70.1, np.ones(3))
    np.testing.assert_allclose(np.diff(given.moments), [0.1, SETTINGS.interval, 0.1])


def test_a_drawing_stays_where_it_was_drawn_whatever_its_size(robot):
    for size in (0.3, 1.0):
        board, given = board_of(robot), Stroke()
        for moment, place in zip(np.linspace(0, T, 61), curve(np.linspace(0, 1, 61)), strict=True):
            given.add(moment, board.at(size * place + [0.1, 0.05]))
        kept = taught("drawn 1", given, board)
        seen = opening.preview(Recordings(), Choices(), robot, [kept])
        np.testing.assert_allclose(seen.takes[0].given[[0, -1]], given.points[[0, -1]], atol=1e-3)
        np.testing.assert_array_equal(seen.drawn[0], given.points)
        assert seen.task is not None
        again = Own.of(seen.task).checked("kept").task
        np.testing.assert_allclose(again.paths[0], seen.task.paths[0], atol=1e-12)
        assert again.state == "augmented"


def test_what_crosses_itself_is_said_and_learned(robot, fits):
    assert [crosses_itself(curve(np.linspace(0, 1, 100), kind)) for kind in ("S", "8")] == [False, True]
    u = np.linspace(0, 1, 400)
    assert not crosses_itself(curve(u) + 0.003 * np.stack([np.sin(90 * u), np.cos(90 * u)], axis=1))  # small loops
    plain = opening.preview(Recordings(), Choices(), robot, three(robot))
    assert not any("crosses" in note for note in plain.notes)
    seen = opening.preview(Recordings(), Choices(), robot, three(robot, "8"))
    assert any("crosses itself (drawn 1, drawn 2, drawn 3)" in note for note in seen.notes)
    assert seen.task is not None
    learned = learned_of(Scenario("own_data_1"), seen.task, fits)
    assert learned.imitation.state == "augmented"


def in_space(kind, depth=0.0):
    """A path in space that is a curve as seen along a direction, and as deep along it, (N, 3), metres."""
    u = np.linspace(0, 1, 100)
    flat = np.concatenate([curve(u, kind), depth * u[:, None]], axis=1)
    return flat @ np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0] + [0.0, -0.4, 0.4]


def test_what_is_guided_across_itself_is_said_too_and_passing_far_behind_is_no_crossing(robot):
    assert [crosses_itself(in_space(kind)) for kind in ("S", "8")] == [False, True]
    assert [crosses_itself(in_space("8", depth)) for depth in (0.02, 0.5)] == [True, False]
    there_and_back = np.abs(np.linspace(-1, 1, 100))[:, None] * [0.1, 0.2, 0.3]
    assert not crosses_itself(there_and_back)
    hand = Stroke([*np.linspace(0, T, 100)], [*in_space("8")])
    seen = opening.preview(Recordings(), Choices(), robot, [taught("guided 1", hand)])
    assert any("crosses itself (guided 1)" in note for note in seen.notes)


def test_a_take_of_which_points_are_left_out_for_its_length_is_named(robot):
    board = board_of(robot)
    for duration, thinned in ((SETTINGS.longest - 0.5, False), (SETTINGS.longest + 5.0, True)):
        times = np.arange(0, duration, SETTINGS.interval)
        long = taught("drawn 1", Stroke([*times], [*board.at(curve(times / times[-1]))]), board)
        seen = opening.preview(Recordings(), Choices(), robot, [long])
        assert any("drawn 1 (20 s), 300 points" in note for note in seen.notes) == thinned
        assert (len(times) > SETTINGS.most_points) == thinned


def test_places_out_of_reach_are_red_and_the_take_is_scaled_if_that_is_wanted(robot):
    board = board_of(robot)
    away = board.centre + np.array([0.0, -0.55, 0.0])  # of the arm
    far = Stroke([k * 0.05 for k in range(40)], list(np.linspace(board.centre, away, 40)))
    assert not out_of_reach(robot, board.centre) and out_of_reach(robot, away)
    assert out_of_reach(robot, np.array([0.0, -0.3, -0.01]))
    (piece,) = drawn_beyond(robot, [far.points])
    assert 3 < len(piece) < 40 and out_of_reach(robot, piece[1:]).all()
    kept = taught("guided 1", far)
    seen = opening.with_reach(opening.preview(Recordings(), Choices(), robot, [kept]), Choices(), robot)
    assert seen.reach and seen.takes[0].is_far and len(seen.beyond) == 1
    choices = Choices(fits_reach=True)
    scaled = opening.with_reach(opening.preview(Recordings(), choices, robot, [kept]), choices, robot)
    assert not scaled.beyond and np.linalg.norm(scaled.drawn[0][-1]) < np.linalg.norm(away) - 0.05


def test_a_board_is_in_the_reach_of_other_arms(robot):
    for arm in (robot, load_arm("so100")):
        assert not out_of_reach(arm, board_of(arm).at(curve(np.linspace(0, 1, 50)) * arm.size)).any()


def test_a_take_is_deleted_and_the_others_keep_what_was_chosen_for_them(robot):
    opened = Opened(taught=three(robot), choices=Choices(left_out=frozenset([0, 2])))
    rest = opened.without(1, "drawn 2")
    assert [each.name for each in rest.taught] == ["drawn 1", "drawn 3"]
    assert rest.choices.left_out == {0, 1}
    assert opened.without(0, "drawn 1").choices.left_out == {1}
    assert opened.without(1, "a file's") is opened


def test_takes_that_are_added_and_deleted_are_undone_and_redone_with_what_is_left_out(robot):
    first, second, third = three(robot)
    states = [Opened(files=(("a.csv", b""),), choices=Choices(goal=1))]
    states.append(states[-1].with_take(first))
    states.append(states[-1].with_take(second))
    states[-1] = replace(states[-1], choices=replace(states[-1].choices, left_out=frozenset([1])))
    states.append(states[-1].without(0, "drawn 1"))
    states.append(states[-1].with_take(third))
    opened = states[-1]
    assert opened.steps == (True, False) and opened.without(0, "a file's") is opened is opened.redone()
    for state in reversed(states[:-1]):
        opened = opened.undone()
        assert (opened.lesson, opened.files, opened.choices.goal) == (state.lesson, state.files, 1)
    assert opened.steps == (False, True) and opened.undone() is opened
    for state in states[1:]:
        opened = opened.redone()
        assert opened.lesson == state.lesson
    assert opened.undone().with_take(third).steps == (True, False)
    assert Opened.again(opened.lesson).lesson == opened.lesson


def test_a_task_knows_what_was_taught_for_it(robot):
    takes = three(robot)
    choices = Choices(left_out=frozenset([1]))
    task = opening.preview(Recordings(), choices, robot, takes).task
    assert task is not None and task.lesson == Lesson(takes, (1,)) and len(task.demonstrations) == 2
    placed = task.placed(0.7, (0.0, 0.1, 0.0))
    assert placed.lesson == task.lesson
    files = Recordings(takes=tuple(each.take for each in takes))
    beside = opening.preview(files, choices, robot, takes[:1]).task
    assert beside is not None and beside.lesson == Lesson(takes[:1])  # numbers of others mean nothing
    alone = opening.preview(files, choices, robot).task
    assert alone is not None and alone.lesson is None
