"""Moving obstacles: their velocity from where they were seen, and the place where they will be."""

import numpy as np
import pytest

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.obstacle_motion import NOTHING_SEEN, ObstacleMotion, Sighting
from dt_viz.control.settings import ControllerSettings
from dt_viz.obstacles.shapes import Box, Sphere, as_point

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


def test_a_steady_velocity_is_known_from_the_second_look_on():
    for num in (2, 3, 20):
        np.testing.assert_allclose(seen(moving(num)).velocities, [VELOCITY], atol=1e-12)
    assert seen(moving(1)).speed == 0


def test_the_obstacle_is_expected_ahead_with_more_room():
    places = moving()
    expected = seen(places).expected(0.2, 0.1, RATE)
    assert expected is not None
    np.testing.assert_allclose(expected.avoided.parts[0].position, places[-1] + 0.2 * VELOCITY)
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


def test_what_is_put_elsewhere_or_replaced_is_not_moving():
    last = moving()[-1]
    assert seen([*moving(), last + 0.5]).speed == 0
    other = ArmAvoidance((Box(as_point(last), (0.1, 0.1, 0.1)),))
    assert seen(moving()).then(other, 20 * PERIOD, SETTINGS).speed == 0
    assert seen(moving()).then(None, 20 * PERIOD, SETTINGS).expected(1, 1, RATE) is None


def test_what_was_not_seen_for_a_while_counts_as_at_rest():
    sighting = seen(moving())
    assert sighting.then(sighting.avoidance, sighting.time + 1.01 * SETTINGS.stale, SETTINGS).speed == 0
    assert sighting.then(sighting.avoidance, sighting.time, SETTINGS).speed == sighting.speed  # no time has passed


def test_a_stop_is_noticed_within_a_fraction_of_a_second():
    assert seen([*moving(), *[moving()[-1]] * 8]).speed < 0.1 * np.linalg.norm(VELOCITY)


def test_nothing_seen_expects_nothing():
    assert isinstance(NOTHING_SEEN, Sighting) and NOTHING_SEEN.expected(1, 1, RATE) is None
