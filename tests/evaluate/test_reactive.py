"""Obstacles that cross the motion of the robot in the loop: where they go, and what is measured."""

from itertools import islice

import numpy as np
import pytest

from dt_viz.control.settings import ControllerSettings
from dt_viz.evaluate import reactive
from dt_viz.obstacles.shapes import ORIGIN, Box, Sphere, as_point
from dt_viz.robot.models import load_jaco

BALL = Sphere(ORIGIN, 0.15)


@pytest.mark.long
def test_reactive_writes_what_its_figures_are_computed_from_and_repeats(measured, robot):
    arrays, (rows,) = measured("reactive", "--speed 0.4 --runs 1")
    row = rows[0]
    q, t, places = arrays["q_0"], arrays["t_0"], arrays["obstacle_0"]
    assert q.shape == (len(t), 6) and places.shape == (len(t), 3)
    velocity = np.diff(q, axis=0, prepend=q[:1]) / 0.01
    assert (np.abs(velocity) < robot.velocity_limits + 1e-9).all()
    assert np.abs(np.diff(velocity, axis=0)).max() < ControllerSettings().acceleration * 0.01 + 1e-9
    steps = np.linalg.norm(np.diff(places, axis=0), axis=1)
    np.testing.assert_allclose(steps[np.isfinite(steps)], 0.004, rtol=0.02)
    there = np.isfinite(places[:, 0])
    closest = nearest(q[there], places[there], float(arrays["diameter"]))
    assert float(row["clearance mm"]) == pytest.approx(1e3 * closest, abs=2)  # it looks between ticks, too
    assert row["without contact"] == row["goal reached"] == "1 of 1"
    again, _ = measured("reactive", "--speed 0.4 --runs 1")
    np.testing.assert_array_equal(again["q_0"], q)


def nearest(q, places, diameter):
    """Smallest distance of the arm's meshes from a sphere at one of its places for each posture."""
    model = load_jaco().collision
    return min(
        model.obstacle_distance(joints[None], Sphere(as_point(place), diameter))[0][0]
        for joints, place in zip(q, places, strict=True)
    )


@pytest.fixture(scope="module")
def bench(engine):
    return reactive.Bench(engine, "draw_s", 0.03)


@pytest.mark.long
@pytest.mark.parametrize(("speed", "num"), [(0.1, 1), (1.0, 1), (0.5, 2)])
def test_spheres_cross_the_motion_when_the_hand_is_there(bench, speed, num):
    found = list(islice(reactive.crossings(bench, BALL, speed, seed=1, num=num), 3))
    assert [crossing.start for crossing in found] == [0, 1, 2]
    for crossing in found:
        hand, joints = bench.undisturbed(crossing.start)
        assert crossing.seconds == pytest.approx(len(hand) * reactive.TICK) and crossing.places.shape[1] == num
        assert np.linalg.norm(hand[-1] - bench.goal) < 1e-3
        comes = np.isfinite(crossing.places[..., 0]).argmax(axis=0)
        assert crossing.begins == 0 or comes.min() == 0  # no time is lost
        for first, places in zip(comes, crossing.places.transpose(1, 0, 2), strict=True):
            path = places[np.isfinite(places[:, 0])]
            step = np.linalg.norm(np.diff(path, axis=0), axis=1)
            np.testing.assert_allclose(step, speed * reactive.TICK, rtol=0.01)
            assert 0.75 < step.sum() < 1.2
            tick = round(first + len(path) / 2 - crossing.begins / reactive.TICK)
            assert 0.2 * len(hand) < tick < 0.8 * len(hand)
            assert np.linalg.norm(path[len(path) // 2] - hand[tick]) < 0.08
            there = joints[max(0, int(first - crossing.begins / reactive.TICK))]
            gap = bench.follower.whole_arm.clearance(there[None], BALL.moved(as_point(path[0])))[0]
            assert gap >= reactive.START_ROOM - 0.02
            assert path[:, 2].min() >= 0.075 + reactive.TABLE_ROOM
        assert crossing.at(len(crossing.places)) == ()


def test_a_second_obstacle_and_a_turned_box_count(bench):
    box = Box(ORIGIN, (0.15, 0.12, 0.09))
    crossing = next(reactive.crossings(bench, box, 0.5, seed=2, num=2))
    t = int(np.isfinite(crossing.places[..., 0]).argmax(axis=0).max())
    parts = crossing.at(t)
    assert len(parts) == 2 and parts[0].wxyz == crossing.shapes[0].wxyz != parts[1].wxyz
    np.testing.assert_allclose([part.position for part in parts], crossing.places[t])
    q, model = bench.starts[:1], load_jaco().collision
    alone = reactive.Crossing(0, 0.0, 0.0, crossing.places[[t]], crossing.shapes)
    expected = min(float(model.obstacle_distance(q, part)[0][0]) for part in parts)
    assert reactive.smallest_distance(bench, q, alone) == pytest.approx(expected, abs=1e-9)


def test_the_smallest_distance_is_found_between_ticks_too(bench):
    q = np.stack([bench.starts[0]] * 4)
    hand = bench.robot.end_effector(q[0])
    places = hand + np.array([[0.5, 0, 0], [0.2, 0, 0.0], [-0.2, 0, 0], [0.0, 0.0, 0.0]])
    places[3] = np.nan  # gone
    fine = np.linspace(0, 1, 7)[:, None]
    dense = np.concatenate([(1 - fine) * a + fine * b for a, b in ((places[0], places[1]), (places[1], places[2]))])
    least = nearest(np.repeat(q[:1], len(dense), axis=0), dense, BALL.diameter)
    crossing = reactive.Crossing(0, 0.0, 0.0, places[:, None], [BALL])
    found = reactive.smallest_distance(bench, q, crossing)
    assert found == pytest.approx(least, abs=1e-9)
    assert found < nearest(q[:3], places[:3], BALL.diameter) - 0.01


def test_the_room_of_an_obstacle_that_comes_is_that_of_the_arm_as_it_is_then(bench):
    q = np.stack([bench.starts[0], bench.starts[0] + 0.5])
    hands = bench.robot.end_effector(q)
    gone, far = np.full(3, np.nan), np.array([3.0, 0.0, 0.0])

    def room(*centres):
        crossing = reactive.Crossing(0, 0.0, 0.0, np.array(centres), 2 * [BALL])
        return reactive.room_at_coming(bench, q, crossing)

    assert room([far, gone], [hands[0], far]) > 1  # one has come before, the other is not there yet
    assert room([far, gone], [far, hands[1]]) < 0
    expected = bench.follower.whole_arm.clearance(q[1:], BALL.moved(as_point(hands[0])))[0]
    assert room([far, gone], [far, hands[0]]) == pytest.approx(expected)


def test_figures_of_a_run_are_relative_to_the_limits(bench):
    q = bench.starts[0] + np.cumsum([[0.0], [0.01], [0.03], [0.03]], axis=0) * np.eye(6)[0]
    crossing = reactive.Crossing(0, 0.005, 0.01, np.array(4 * [[[3.0, 0.0, 0.0]]]), [BALL])
    found = reactive.figures_of(bench, crossing, q) | {"ticks": np.array([0.001, 0.003])}
    assert found["velocity"] == pytest.approx(3.0 / bench.robot.velocity_limits[0])
    assert found["acceleration"] == pytest.approx(200 / ControllerSettings().acceleration)
    assert found["lost"] == pytest.approx(0.015) and found["clearance"] > 2e3
    assert found["missed"] == pytest.approx(1e3 * np.linalg.norm(bench.robot.end_effector(q[-1]) - bench.goal))
    touched = found | {"clearance": -2.0, "missed": 0.1, "lost": 0.215}
    row = reactive.summary([found, touched, touched])
    assert [row[name] for name in ("without contact", "clearance mm", "goal reached")] == ["1 of 3", "-2.0", "2 of 3"]
    assert [row[name] for name in ("time lost s", "tick ms")] == ["0.2 (0.2)", "2.00 (3.0, 3)"]
