"""The flow around obstacles of the robot's own motion: it clears what is ahead, and changes gradually."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.clearing import Clearing, checked, clearing
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Sphere, as_point

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


def test_nothing_near_or_nothing_to_avoid_changes_nothing(arm, q):
    for avoidance in (None, around(arm, q[50], (0, 0, 0.6))):
        found, p = made(arm, q, avoidance)
        assert found.field is None
        np.testing.assert_array_equal(p, q)


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
