"""The flow around obstacles of the robot's own motion: it clears what is ahead, and changes gradually."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.obstacle_flow import NOTHING_SEEN, Clearing, ObstacleMotion, checked, clearing
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Box, Sphere, as_point

MARGIN = 0.03
RESTS = np.zeros((1, 3))


@pytest.fixture(scope="module", name="arm")
def _arm(engine):
    return engine.follower.whole_arm


@pytest.fixture(scope="module", name="q")
def _q(engine, initial):
    return engine.follower.undisturbed(engine.nominal(initial("push_box"))).tracked.q[0]


def around(arm, posture, offset=(0, 0, 0), diameter=0.15):
    place = arm.robot.end_effector(posture) + np.asarray(offset)
    return ArmAvoidance((Sphere(as_point(place), diameter),), margin=MARGIN)


def made(arm, q, avoidance, before=None, turn=0.0, velocities: Array = RESTS):
    """The way around, and the images of the postures under it."""
    end = None if velocities.any() else q[-1]
    found = clearing(arm, q, avoidance, velocities, before or Clearing(), turn, end)
    return found, found.transform(arm, found.duration).inverse(arm.limits.inside(q))


def chosen(direction):
    """A way around an obstacle in this direction."""
    return Clearing(directions=(direction,))


def way_out(found):
    (way,) = found.directions
    assert way is not None
    return way


def test_all_that_lies_ahead_is_cleared_and_the_end_stays(arm, q):
    avoidance = around(arm, q[50])
    found, p = made(arm, q, avoidance)
    assert found.cleared and arm.clearance(q, avoidance.avoided).min() < -0.05
    assert arm.clearance(p, avoidance.avoided).min() == pytest.approx(MARGIN, abs=1.5e-3)
    np.testing.assert_allclose(p[-1], q[-1], atol=1e-9)


def test_a_way_that_carries_clear_postures_into_the_obstacle_is_left_for_another_one(arm, q):
    kept, wrong = 5e-3, 0
    for offset in ((0, 0, 0), (0, 0, -0.12), (0.1, 0, 0), (0, 0.1, 0.05)):
        avoidance = around(arm, q[50], offset)
        for way in (*np.eye(3), *-np.eye(3)):
            bad, p = made(arm, q, avoidance, chosen(way))
            found = checked(arm, bad, q, avoidance, chosen(way), q[-1], kept)
            if not bad.cleared:
                continue
            if arm.clearance(p, avoidance.avoided).min() > kept:
                assert found is bad
                continue
            p = found.transform(arm, found.duration).inverse(arm.limits.inside(q))
            assert found.cleared and arm.clearance(p, avoidance.avoided).min() > kept
            wrong += 1
    assert wrong > 2


def test_a_margin_wider_than_all_that_is_looked_at_turns_to_a_way_out(arm, q):
    """That of an obstacle that is fast and still far away."""
    avoidance = around(arm, q[50], (0, -0.5, 0.0))
    away = arm.clearance(q, avoidance.avoided).min()
    assert away > arm.settings.beside
    up = np.array([0.0, 0.0, 1.0])
    found, _ = made(arm, q, replace(avoidance, margin=away + 0.05), chosen(up), 0.1, np.array([[0.0, 3.0, 0.0]]))
    assert way_out(found) @ up > np.cos(0.11)


def test_a_margin_wider_than_the_reach_of_the_temperature_is_kept(arm, q):
    avoidance = replace(around(arm, q[50], (0, -0.14, 0.1)), margin=0.1, temperature=0.5)
    found, p = made(arm, q, avoidance)
    assert 0.02 < arm.clearance(q, avoidance.avoided).min() < avoidance.margin
    assert found.cleared and arm.clearance(p, avoidance.avoided).min() > 0.1 - 2e-3


def test_the_way_out_turns_no_further_than_it_may(arm, q):
    avoidance = around(arm, q[50])
    best, _ = made(arm, q, avoidance)
    way = way_out(best)
    across = np.cross(way, [0.3, 0.5, 0.8])
    other = chosen(across / np.linalg.norm(across))
    turned = way_out(made(arm, q, avoidance, other, turn=0.1)[0])
    assert np.arccos(turned @ way_out(other)) == pytest.approx(0.1, abs=1e-6)
    assert turned @ way > way_out(other) @ way
    there = way_out(made(arm, q, avoidance, other, turn=np.pi)[0])
    np.testing.assert_allclose(there, way, atol=1e-9)


def test_a_way_out_that_has_to_turn_round_turns_over_the_top(arm, q):
    avoidance = around(arm, q[50])
    best, _ = made(arm, q, avoidance)
    opposite = -way_out(best)
    turned = way_out(made(arm, q, avoidance, chosen(opposite), turn=0.3)[0])
    assert np.arccos(turned @ opposite) == pytest.approx(0.3, abs=1e-6)
    assert turned[2] > opposite[2] + 0.1


def test_images_move_as_gradually_as_the_obstacle(arm, q):
    """While it crosses the motion, no posture jumps."""
    before, last = Clearing(), None
    for x in np.arange(-0.12, 0.0, 0.002):
        before, p = made(arm, q, around(arm, q[50], (0, x, 0.05)), before, turn=0.02)
        if last is not None:
            hand = arm.robot.end_effector(p) - arm.robot.end_effector(last)
            assert np.linalg.norm(hand, axis=1).max() < 0.03
        last = p


def test_a_moving_obstacle_is_not_run_away_from_along_its_way(arm, q):
    avoidance = around(arm, q[50])
    way = way_out(made(arm, q, avoidance)[0])
    across = way_out(made(arm, q, avoidance, velocities=0.2 * way[None])[0])
    assert across @ way < 0.3


def test_a_free_end_with_less_room_than_the_margin_stays(arm, q):
    gap = 0.02
    direction = np.array([0.0, -0.6, 0.8])
    places = np.linspace(0.05, 0.3, 500)
    free = [arm.clearance(q[-1:], around(arm, q[-1], d * direction).avoided)[0] for d in places]
    avoidance = around(arm, q[-1], places[int(np.argmin(np.abs(np.array(free) - gap)))] * direction)
    _, p = made(arm, q[[-1, -1]], avoidance)
    np.testing.assert_allclose(p[-1], q[-1], atol=1e-9)
    moved = made(arm, q[[-1, -1]], avoidance, velocities=np.array([[0.0, 0.0, -0.1]]))[1]
    assert np.abs(moved[-1] - q[-1]).max() > 0.01


# moving obstacles: their velocity from where they were seen, and where they will be


VELOCITY = np.array([0.1, -0.05, 0.02])
PERIOD = 0.03
SETTINGS = ControllerSettings()
RATE = SETTINGS.returning


def seen(places, period=PERIOD):
    sighting = NOTHING_SEEN
    for k, place in enumerate(places):
        avoidance = ArmAvoidance((Sphere(as_point(place), 0.1),), margin=0.02)
        sighting = sighting.then(avoidance, k * period, SETTINGS)
    return sighting


def moving(num=20):
    return np.outer(PERIOD * np.arange(num), VELOCITY)


def test_a_steady_velocity_is_known_from_the_second_look_on_and_the_obstacle_expected_ahead_with_more_room():
    assert NOTHING_SEEN.expected(1, 1, RATE) is None and seen(moving(1)).speed == 0
    for num in (2, 3, 20):
        np.testing.assert_allclose(seen(moving(num)).velocities, [VELOCITY], atol=1e-12)
    expected = seen(moving()).expected(0.2, 0.1, RATE)
    assert expected is not None
    np.testing.assert_allclose(expected.avoided.parts[0].position, moving()[-1] + 0.2 * VELOCITY)
    assert expected.margin == pytest.approx(0.02 + 0.1 * np.linalg.norm(VELOCITY))


def test_a_deviation_from_the_mean_velocity_returns_as_a_critically_damped_one():
    """As stepping its equation d̈ + 2λḋ + λ²d = 0 finds it."""
    rng, step = np.random.default_rng(0), 1e-5
    velocity, acceleration, mean = rng.normal(size=(3, 3))
    d, rate, place = velocity - mean, acceleration.copy(), np.zeros(3)
    for _ in range(round(0.3 / step)):
        place += step * (mean + d)
        d, rate = d + step * rate, rate - step * (2 * RATE * rate + RATE**2 * d)
    found = ObstacleMotion(velocity, acceleration, mean, 1.0).ahead(np.array([0.3]), RATE)
    np.testing.assert_allclose(found, [place], atol=1e-4)


def test_a_bend_is_followed_better_than_straight_on():
    """A circle of 10 cm at 0.5 m/s."""
    angles = 5.0 * PERIOD * np.arange(20)
    places = 0.1 * np.stack([np.cos(angles), np.sin(angles), np.zeros(20)], axis=1)
    (motion,) = seen(places[:-3]).motions
    ahead = 3 * PERIOD
    straight = places[-4] + ahead * motion.velocity
    bent = places[-4] + motion.ahead(np.array([ahead]), RATE)[0]
    assert np.linalg.norm(bent - places[-1]) < 0.8 * np.linalg.norm(straight - places[-1])


def test_obstacles_keep_their_motion_while_others_come_and_go():
    sighting = seen(moving())
    assert sighting.avoidance is not None
    (known,) = sighting.avoidance.avoided.parts
    another = Sphere(as_point(np.asarray(known.position) + 0.3), 0.1)
    both = sighting.then(ArmAvoidance((another, known)), sighting.time + PERIOD / 10, SETTINGS)
    assert not both.velocities[0].any() and both.motions[1].age > sighting.motions[0].age
    alone = both.then(sighting.avoidance, both.time, SETTINGS)
    assert alone.motions[0] is both.motions[1]


def test_what_is_put_elsewhere_or_replaced_or_was_not_seen_for_a_while_is_not_moving_nor_what_has_stopped():
    last, sighting = moving()[-1], seen(moving())
    assert seen([*moving(), last + 0.5]).speed == 0
    other = ArmAvoidance((Box(as_point(last), (0.1, 0.1, 0.1)),))
    assert seen(moving()).then(other, 20 * PERIOD, SETTINGS).speed == 0
    assert seen(moving()).then(None, 20 * PERIOD, SETTINGS).expected(1, 1, RATE) is None

    assert sighting.then(sighting.avoidance, sighting.time + 1.01 * SETTINGS.stale, SETTINGS).speed == 0
    assert sighting.then(sighting.avoidance, sighting.time, SETTINGS).speed == sighting.speed  # no time has passed

    assert seen([*moving(), *[last] * 8]).speed < 0.1 * np.linalg.norm(VELOCITY)
