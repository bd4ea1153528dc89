"""Retiming for joint velocity limits: the limits hold, nothing is hurried, and no slow-down sets in abruptly."""

from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from oracles import used_fraction

from dt_viz.robot.joint_trajectory import NEGLIGIBLE, RAMP, within_velocity_limits

LIMITS = np.array([0.6, 0.6, 0.6, 0.8, 0.8, 0.8])


class Motion(NamedTuple):
    times: np.ndarray
    q: np.ndarray


@st.composite
def motions(draw, min_points=1):
    """Any pace from standing still to jumps; also samples that coincide in time, in place or in both."""
    num = draw(st.integers(min_points, 12))
    intervals = st.sampled_from([0.0, 1e-12, 1e-3, 0.02]) | st.floats(1e-12, 2.0)
    steps = st.sampled_from([0.0, 1e-9, 1e3]) | st.floats(-0.2, 0.2, allow_subnormal=False)
    start = draw(st.sampled_from([0.0, -3.7]))
    times = start + np.cumsum(np.append(0.0, draw(arrays(np.float64, num - 1, elements=intervals))))
    turns = draw(arrays(np.float64, (num - 1, len(LIMITS)), elements=steps))
    return Motion(times, np.cumsum(np.vstack([np.ones(len(LIMITS)), turns]), axis=0))


def rounding(*times):
    """What an interval of these times may be off by, seconds."""
    return 20 * np.finfo(float).eps * (1.0 + max(np.abs(t).max() for t in times))


def least_intervals(motion):
    return (np.abs(np.diff(motion.q, axis=0)) / LIMITS).max(axis=1)


def burst(num=2001, speed_up=3.0, duration=0.1):
    """Joint 2 at nine tenths of its limit for 4 s, and in the middle, from one sample to the next, much faster."""
    times = np.linspace(0.0, 4.0, num)
    fast = np.abs((times[1:] + times[:-1]) / 2 - 2.0) < duration / 2
    speed = 0.9 * LIMITS[1] * np.where(fast, speed_up, 1.0)
    q = np.zeros((num, len(LIMITS)))
    q[1:, 1] = np.cumsum(speed * np.diff(times))
    return Motion(times, q)


class TestRetiming:
    @given(motions())
    def test_no_segment_is_faster_than_the_limits_or_than_before(self, motion):
        new = within_velocity_limits(motion.times, motion.q, LIMITS)
        assert new.shape == motion.times.shape
        assert new[0] == motion.times[0]
        assert (np.diff(new) >= least_intervals(motion) * (1 - 1e-12) - rounding(new)).all()
        assert (np.diff(new) >= np.diff(motion.times) - rounding(new)).all()
        assert (np.diff(new) >= 0).all()

    @given(motions(min_points=3))
    def test_progress_speeds_up_and_slows_down_gradually(self, motion):
        """Means, over neighbouring intervals, of a rate whose slope is at most 1/RAMP."""
        new = within_velocity_limits(motion.times, motion.q, LIMITS)
        late = least_intervals(motion) - np.diff(motion.times)
        intervals, before = np.diff(new), np.diff(motion.times)
        counts = ((late <= 0) | (late > NEGLIGIBLE)) & (intervals > 1e-6)  # of the others rounding is too large a part
        rate = before[counts] / intervals[counts]
        middle = ((new[1:] + new[:-1]) / 2)[counts]
        error = rounding(new) / intervals[counts]
        assert (np.abs(np.diff(rate)) <= np.diff(middle) / RAMP + error[1:] + error[:-1] + 1e-9).all()

    @given(motions(), st.floats(1.0, 2.0))
    def test_a_motion_within_the_limits_is_unchanged(self, motion, slack):
        intervals = np.maximum(np.diff(motion.times), least_intervals(motion) * slack) * (1 + 1e-9)
        times = np.cumsum(np.append(0.0, intervals))
        assume((np.diff(times) >= least_intervals(motion)).all())  # a short one may be rounded below what it needs
        np.testing.assert_array_equal(within_velocity_limits(times, motion.q, LIMITS), times)

    @given(motions())
    def test_a_second_time_changes_nothing_more(self, motion):
        once = within_velocity_limits(motion.times, motion.q, LIMITS)
        twice = within_velocity_limits(once, motion.q, LIMITS)
        np.testing.assert_allclose(twice, once, rtol=1e-9, atol=1e-6)

    @pytest.mark.parametrize("speed_up", [1.3, 3.0, 30.0])
    def test_a_short_burst_is_led_up_to(self, speed_up):
        motion = burst(speed_up=speed_up)
        new = within_velocity_limits(motion.times, motion.q, LIMITS)
        stretch = np.diff(new) / np.diff(motion.times)
        assert stretch.max() == pytest.approx(0.9 * speed_up, rel=1e-9)
        # In 2 ms of the motion's own time, which the stretch makes longer: d(ln f)/dt = −dg/dt · f ≤ f²/RAMP.
        assert (np.abs(np.diff(np.log(stretch))) <= 1.05 * stretch[1:] * stretch[:-1] * 0.002 / RAMP).all()
        # Far from it nothing changes, and on both sides it is alike.
        assert (stretch[:900] < 1 + 1e-12).all()
        np.testing.assert_allclose(stretch, stretch[::-1], rtol=1e-6)
        # It is slowed down on each side for no longer than the ramp.
        needed = np.maximum(least_intervals(motion), np.diff(motion.times)).sum()
        assert needed < new[-1] < needed + RAMP

    def test_finer_samples_give_the_same_times(self):
        coarse, fine = burst(2001), burst(8001)
        new = within_velocity_limits(*coarse, LIMITS)
        np.testing.assert_allclose(within_velocity_limits(*fine, LIMITS)[::4], new, atol=2e-3)

    @pytest.mark.parametrize(
        ("times", "turns", "intervals"),
        [
            # a ramp that takes RAMP seconds covers RAMP/2 of the motion
            ([0.0, 1.0, 1.0, 2.0], [0.0, 0.0, 1.2, 1.2], [1.0 + RAMP / 2, 2.0, 1.0 + RAMP / 2]),
            ([0.0, 0.0, 0.1, 0.1], [0.0, 0.6, 0.6, 1.2], [1.0, 2 * np.sqrt(0.1 * RAMP), 1.0]),
            ([0.0, 0.0], [0.0, 1.2], [2.0]),
            ([0.0, 1e-300], [0.0, 1.2], [2.0]),
            ([0.0, 1.9], [0.0, 1.2], [2.0]),
            ([0.5], [0.0], []),
        ],
        ids=["a jump", "between two jumps", "two at once", "nearly at once", "two", "one"],
    )
    def test_a_jump_is_crossed_at_the_limit_from_rest_and_between_two_the_motion_goes_on(self, times, turns, intervals):
        q = np.repeat(np.array(turns)[:, None], len(LIMITS), axis=1)
        new = within_velocity_limits(np.array(times), q, LIMITS)
        assert new[0] == times[0]
        np.testing.assert_allclose(np.diff(new), intervals, rtol=1e-12)

    def test_noise_of_samples_at_one_time_slows_nothing_down(self):
        times, q = np.repeat(burst(101, 1.0).times, 2), np.repeat(burst(101, 1.0).q, 2, axis=0)
        q[1::2] += 1e-9
        new = within_velocity_limits(times, q, LIMITS)
        assert used_fraction(times, q, LIMITS) == np.inf
        assert used_fraction(new, q, LIMITS) < 1 + 1e-6
        np.testing.assert_allclose(new, times, atol=1e-6)
