"""Moving obstacles: their velocity from where they were seen, and the place where they will be."""

import numpy as np
import pytest

from dt_viz.control.obstacle_motion import NOTHING_SEEN, STALE, Sighting
from dt_viz.obstacles.shapes import Box, Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.transforms.base import ArmAvoidance

VELOCITY = np.array([0.1, -0.05, 0.02])
PERIOD = 0.03


def seen(places, period=PERIOD):
    sighting = NOTHING_SEEN
    for k, place in enumerate(places):
        sighting = sighting.then(ArmAvoidance(Union((Sphere(as_point(place), 0.1),)), margin=0.02), k * period)
    return sighting


def moving(num=20):
    return np.outer(PERIOD * np.arange(num), VELOCITY)


def test_a_steady_velocity_is_known_from_the_second_look_on():
    for num in (2, 3, 20):
        np.testing.assert_allclose(seen(moving(num)).velocities, [VELOCITY], atol=1e-12)
    assert seen(moving(1)).speed == 0


def test_the_obstacle_is_expected_ahead_with_more_room():
    places = moving()
    expected = seen(places).expected(0.2, 0.1)
    assert expected is not None
    np.testing.assert_allclose(expected.obstacle.parts[0].position, places[-1] + 0.2 * VELOCITY)
    assert expected.margin == pytest.approx(0.02 + 0.1 * np.linalg.norm(VELOCITY))


def test_what_is_put_elsewhere_or_replaced_is_not_moving():
    last = moving()[-1]
    assert seen([*moving(), last + 0.5]).speed == 0
    other = ArmAvoidance(Union((Box(as_point(last), (0.1, 0.1, 0.1)),)))
    assert seen(moving()).then(other, 20 * PERIOD).speed == 0
    assert seen(moving()).then(None, 20 * PERIOD).expected(1, 1) is None


def test_what_was_not_seen_for_a_while_counts_as_at_rest():
    sighting = seen(moving())
    assert sighting.then(sighting.avoidance, sighting.time + 1.01 * STALE).speed == 0
    assert sighting.then(sighting.avoidance, sighting.time).speed == sighting.speed  # no time has passed


def test_a_stop_is_noticed_within_a_fraction_of_a_second():
    assert seen([*moving(), *[moving()[-1]] * 8]).speed < 0.1 * np.linalg.norm(VELOCITY)


def test_nothing_seen_expects_nothing():
    assert isinstance(NOTHING_SEEN, Sighting) and NOTHING_SEEN.expected(1, 1) is None
