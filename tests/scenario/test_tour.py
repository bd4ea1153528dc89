"""The steps of the tour: each scene is what its text says."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import frame_at

from dt_viz.avoidance.bias import MAX_TARGET_MISS
from dt_viz.metrics import distance_from_path
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import anchored
from dt_viz.scenario.tour import STEPS, TASK
from dt_viz.session.frame import Stage

ATTRACTOR, WARP, STABLE, OBSTACLE, ARM, ALL = STEPS


@pytest.fixture
def shown(engine):
    """The certified frame of a step, with changes of its scenario."""

    def frame(step, **changes):
        return frame_at(engine, replace(step.scenario(engine.task(TASK)), **changes), Stage.CERTIFIED)

    return frame


def from_chord(path):
    """Largest distance of a path from the straight line between its ends, metres."""
    along = (path[-1] - path[0]) / np.linalg.norm(path[-1] - path[0])
    offsets = path - path[0]
    return np.linalg.norm(offsets - np.outer(offsets @ along, along), axis=1).max()


@pytest.mark.parametrize("step", [ATTRACTOR, WARP], ids=lambda step: step.title)
def test_motions_are_straight_to_the_goal_where_nothing_is_warped(shown, step):
    frame = shown(step)
    assert max(map(from_chord, frame.rollouts)) < 1e-6
    assert max(np.linalg.norm(path[-1] - frame.goal) for path in frame.rollouts) < 1e-4


def test_the_full_warp_bends_them_to_the_seven_demonstrations_within_millimetres(shown):
    frame = shown(WARP, warp=1.0)
    misses = [distance_from_path(*pair).mean() for pair in zip(frame.rollouts, frame.task.paths, strict=True)]
    assert len(misses) == 7 and max(misses) < 0.01 and min(map(from_chord, frame.rollouts)) > 0.1
    assert WARP.grows and frame.certificates.min_det_jacobian > 0


def test_from_any_start_the_motion_ends_at_the_goal_and_the_lyapunov_value_falls(shown):
    frame = shown(STABLE)
    assert len(frame.rollouts) > len(frame.task.paths)
    assert max(np.linalg.norm(path[-1] - frame.goal) for path in frame.rollouts) < 1e-4
    assert frame.certificates.lyapunov_falls and frame.certificates.warnings == ()


def test_the_hand_flows_around_the_sphere_that_stands_in_its_way_to_the_same_goal(shown):
    frame, before = shown(OBSTACLE), shown(WARP, warp=1.0)
    assert max(path_depth(frame, path) for path in before.rollouts) > 0.05
    assert max(path_depth(frame, path) for path in frame.rollouts) < 0
    np.testing.assert_allclose(frame.goal, before.goal, atol=1e-6)
    assert frame.scenario.arm_avoidance is None


def path_depth(frame, path):
    """How deep a path is in the obstacles of a frame at most, metres; negative where it is clear."""
    return -frame.scenario.obstacle.signed_distance(path).min()


@pytest.mark.long
@pytest.mark.parametrize("step", [ARM, ALL], ids=lambda step: step.title)
def test_the_whole_arm_is_free_of_contact_and_every_check_holds(shown, step):
    frame = shown(step)
    collision = frame.certificates.collision
    assert frame.scenario.arm_avoidance is not None and frame.scenario.view.arm
    assert collision.obstacle.distance > 0
    assert frame.certificates.warnings == () and not frame.blocked


@pytest.mark.long
def test_at_the_end_the_motion_passes_the_bias_point_beside_the_demonstrations(shown):
    frame = shown(ALL)
    ((_, point),) = anchored(frame.scenario).items()
    target = np.array([point.position])
    assert max(distance_from_path(target, path).max() for path in frame.rollouts) < MAX_TARGET_MISS
    assert min(distance_from_path(target, path).min() for path in frame.task.paths) > 0.03


def test_there_are_six_steps_with_two_or_three_sentences_each(engine):
    assert len(STEPS) == len({step.title for step in STEPS}) == 6
    for step in STEPS:
        assert 2 <= step.text.count(".") <= 3 and step.formula and step.trial
        assert step.scenario(engine.task(TASK)) != Scenario(TASK)
