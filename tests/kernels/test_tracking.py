"""Compiled tracking: the same steps as array operations, for random postures, in blocks of any size."""

import numpy as np
import plain_tracking
import pytest
from scipy.spatial.transform import Rotation

from dt_viz.kernels.blocks import LANES
from dt_viz.kernels.tracking import Postures, settle, walk
from dt_viz.robot.inverse_kinematics import soft_limits
from dt_viz.robot.models import load_jaco

ROBOT = load_jaco()
ARM = ROBOT.tracking_arm


def postures(num, seed=0):
    """Random objectives, and postures and targets to begin from; some at their limits, some out of reach."""
    rng = np.random.default_rng(seed)
    q = ROBOT.clip(ROBOT.home + rng.normal(0, 0.7, (num, 6)))
    reference = ROBOT.clip(ROBOT.home + rng.normal(0, 0.4, (num, 6)))
    direction = rng.normal(size=(num, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    lower, upper = (np.array(bound) for bound in soft_limits(ROBOT, reference, at_reference=False))
    objectives = Postures(reference, direction, lower, upper, rng.uniform(1, 40, num))
    return objectives, q, ROBOT.end_effector(q) + rng.normal(0, 0.2, (num, 3))


@pytest.mark.long
@pytest.mark.parametrize("gain", [0, 1])
@pytest.mark.parametrize("num", [1, LANES - 1, LANES, 3 * LANES + 5])
def test_a_step_is_that_of_array_operations(num, gain):
    objectives, q, targets = postures(num)
    expected = plain_tracking.newton(ROBOT, q, targets, objectives, gain)
    stepped = settle(ARM, objectives, q, targets, np.arange(num), gain, 1 - gain, -1.0)
    assert np.abs(stepped - q).max(axis=1).min() > 1e-3
    np.testing.assert_allclose(stepped, expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize("gain", [0, 1])
@pytest.mark.parametrize("num", [1, LANES + 3])
def test_a_step_that_turns_the_hand_is_that_of_array_operations(num, gain):
    objectives, q, places = postures(num, seed=4)
    turns = Rotation.from_quat(np.random.default_rng(5).normal(size=(num, 4)))
    targets = np.hstack([places, turns.as_matrix().transpose(0, 2, 1).reshape(num, 9)])
    expected = plain_tracking.newton(ROBOT, q, places, objectives, gain, turns)
    stepped = settle(ARM, objectives, q, targets, np.arange(num), gain, 1 - gain, -1.0)
    np.testing.assert_allclose(stepped, expected, rtol=0, atol=1e-10)
    assert np.abs(stepped - settle(ARM, objectives, q, places, np.arange(num), gain, 1 - gain, -1.0)).max() > 1e-3


def test_postures_settle_one_by_one():
    objectives, q, targets = postures(40, seed=1)
    expected, moving = q.copy(), np.full(40, True)
    for step in range(11):
        part = Postures(*(field[moving] for field in objectives))
        moved = plain_tracking.newton(ROBOT, expected[moving], targets[moving], part, float(step < 8))
        large = np.abs(moved - expected[moving]).max(axis=1) > 1e-2
        expected[moving] = moved
        moving[np.flatnonzero(moving)[~large]] = False
    assert 0 < moving.sum() < 40  # some are out of reach
    settled = settle(ARM, objectives, q, targets, np.arange(40), 8, 3, 1e-2)
    np.testing.assert_allclose(settled, expected, rtol=0, atol=1e-10)
    again = settle(ARM, objectives, q[::-1].copy(), targets[::-1].copy(), np.arange(40)[::-1].copy(), 8, 3, 1e-2)
    np.testing.assert_array_equal(again[::-1], settled)  # whatever is beside it in a block


@pytest.mark.long
def test_a_walk_takes_a_step_a_stride():
    objectives, q, _ = postures(LANES + 3, seed=2)
    rng = np.random.default_rng(3)
    places = ROBOT.end_effector(q)[:, None] + np.cumsum(rng.normal(0, 0.03, (len(q), 6, 3)), axis=1)
    lines = np.concatenate([ROBOT.end_effector(q)[:, None], places], axis=1)
    lengths = np.cumsum(np.linalg.norm(np.diff(lines, axis=1, prepend=lines[:, :1]), axis=2), axis=1)
    at, reached = q, [q]
    for stride in (1, 2, 3, 4):
        on_line = [
            [np.interp(stride / 4 * length[-1], length, axis) for axis in line.T]
            for line, length in zip(lines, lengths, strict=True)
        ]
        at = plain_tracking.newton(ROBOT, at, np.array(on_line), objectives, 1.0)
        reached.append(at)
    expected = np.empty((len(q), 6, 6))
    for row, length in enumerate(lengths):
        for joint in range(6):
            angles = [stride[row, joint] for stride in reached]
            expected[row, :, joint] = np.interp(length[1:] / length[-1] * 4, range(5), angles)
    np.testing.assert_allclose(walk(ARM, objectives, lines, lengths, q, 4), expected, rtol=0, atol=1e-11)
