"""Bundles of rollouts: even sampling, and refinement that reaches its spacing and keeps what was there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.flows import rollouts
from dt_viz.flows.rollouts import ARRIVED, Bundle, Rays, evenly_sampled, refined
from dt_viz.flows.systems import Attractor

RAYS = Rays(
    np.array([[1.0, 0.0, 0.0], [0.0, 0.7, 0.2], [-0.5, -0.4, 0.3]]), Attractor(np.array([0.05, 0.02, -0.01]), 0.2, 0.05)
)


def bent(index, fraction):
    """Two levels: the rays, and above them the rays squeezed and stretched a hundredfold near x = 0.4."""
    z = RAYS.at(index, fraction)
    push = np.tanh(100 * (z[:, :1] - 0.4)) * np.array([0.0, 0.3, 0.1])
    return np.stack([z, z + push + 0.1 * np.sin(5 * z[:, ::-1])], axis=1)


def gaps(bundle):
    return [np.linalg.norm(np.diff(path, axis=0), axis=1) for path in bundle.paths]


def test_rays_run_straight_from_their_start_to_the_goal():
    index = np.arange(3)
    np.testing.assert_allclose(RAYS.at(index, np.zeros(3)), RAYS.z0, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(RAYS.at(index, np.ones(3)), np.tile(RAYS.base.goal, (3, 1)))
    np.testing.assert_allclose(RAYS.at(index, np.full(3, 0.5)), (RAYS.z0 + RAYS.base.goal) / 2, rtol=0, atol=1e-14)


def test_times_start_at_zero_increase_end_on_arrival_and_are_when_the_base_motion_is_there():
    for which in range(3):
        index, fraction = np.full(50, which), np.linspace(0, 1, 50)
        times = RAYS.times(index, fraction)
        assert times[0] == pytest.approx(0, abs=1e-12)
        assert (np.diff(times) > 0).all() and np.isfinite(times).all()
        flowed = RAYS.base.flow(RAYS.z0[which], times)
        np.testing.assert_allclose(flowed[:-1], RAYS.at(index, fraction)[:-1], rtol=0, atol=1e-9)
        assert np.linalg.norm(flowed[-1] - RAYS.base.goal) == pytest.approx(ARRIVED, rel=1e-6)


@given(st.lists(st.floats(1e-4, 0.9), min_size=3, max_size=8), st.floats(1e-8, 1e-2))
def test_samples_however_near_to_the_goal_have_times_of_their_own(left, nearest):
    """A stack may stretch them to a visible way."""
    per_ray = []
    for scale in (1.0, nearest, 1e-3):  # each ray has its own nearest sample
        remaining = scale * np.array(sorted(left, reverse=True))
        distinct = np.r_[True, remaining[1:] < 0.99 * remaining[:-1]]
        per_ray.append(np.r_[1.0, remaining[distinct], 0.0])
    index = np.repeat(np.arange(3), [len(remaining) for remaining in per_ray])
    fraction = 1 - np.concatenate(per_ray)
    times = RAYS.times(index, fraction)
    for which in range(3):
        assert np.isfinite(times).all() and (np.diff(times[index == which]) > 0).all()
    before = fraction < 1
    flowed = RAYS.base.flow(RAYS.z0[index[before]], times[before, None])[:, 0]
    np.testing.assert_allclose(flowed, RAYS.at(index[before], fraction[before]), rtol=0, atol=1e-9)


def straight(index, fraction):
    return RAYS.at(index, fraction)[:, None]


def test_even_samples_are_evenly_apart_from_start_to_goal():
    # a clock that runs ten times as fast at the end changes where samples are asked for, not where they land
    bundle = evenly_sampled(lambda i, u: straight(i, u**3), 3, 60)
    assert [len(path) for path in bundle.paths] == [60, 60, 60]
    for path, gap, start in zip(bundle.paths, gaps(bundle), RAYS.z0, strict=True):
        np.testing.assert_allclose(path[[0, -1]], [start, RAYS.base.goal], rtol=0, atol=1e-12)
        assert gap.max() < 1.05 * gap[2:].min()


def test_a_rollout_that_rests_is_sampled_at_even_fractions():
    bundle = evenly_sampled(lambda i, u: straight(i, u) * (i > 0)[:, None, None], 2, 5)
    np.testing.assert_array_equal(bundle.fraction[:5], np.linspace(0, 1, 5))
    np.testing.assert_allclose(bundle.fraction[5:], np.linspace(0, 1, 5), atol=1e-12)


def test_refinement_puts_no_more_samples_than_needed_where_gaps_are_alike():
    rough = evenly_sampled(straight, 3, 12)
    fine = refined(rough, straight, 0.01)
    lengths = np.concatenate(gaps(rough))
    assert len(fine.index) == len(rough.index) + (np.ceil(lengths / 0.01) - 1).sum()


@given(st.floats(0.002, 0.05))
def test_refinement_reaches_its_spacing_and_keeps_order_starts_goals_and_all_samples(spacing):
    rough = evenly_sampled(bent, 3, 12)
    fine = refined(rough, bent, spacing)
    assert max(gap.max() for gap in gaps(rough)) > spacing
    assert max(gap.max() for gap in gaps(fine)) <= spacing * (1 + 1e-12)
    assert (np.diff(fine.index) >= 0).all()
    for before, after in zip(rough.split(rough.fraction), fine.split(fine.fraction), strict=True):
        assert (np.diff(after) > 0).all()
        assert (after[0], after[-1]) == (0, 1)
        assert np.isin(before, after).all()
    np.testing.assert_allclose(fine.levels, bent(fine.index, fine.fraction), rtol=0, atol=1e-12)
    assert refined(rough, bent, 10.0) is rough


def test_refinement_ends_at_a_jump_that_no_sample_can_divide():
    def torn(index, fraction):
        z = RAYS.at(index, fraction)
        return (z + np.where(fraction > 1 / 3, 0.5, 0.0)[:, None])[:, None]

    fine = refined(evenly_sampled(torn, 1, 10), torn, 0.01)
    fraction = fine.fraction
    (wide,) = np.flatnonzero(gaps(fine)[0] > 0.01)
    assert fraction[wide] <= 1 / 3 <= fraction[wide + 1]
    assert fraction[wide + 1] - fraction[wide] < 1e-9


def test_a_path_that_is_stretched_without_limit_gets_no_more_samples_than_there_may_be(monkeypatch):
    monkeypatch.setattr(rollouts, "MAX_SAMPLES", 500)

    def evaluate(index, fraction):
        far = 1e6 * np.tanh((fraction - 0.5) * 1e3) * (index == 1) + fraction
        return np.stack([far, fraction, fraction], axis=1)[:, None]

    index, fraction = np.repeat([0, 1], 11), np.tile(np.linspace(0, 1, 11), 2)
    bundle = refined(Bundle(index, fraction, evaluate(index, fraction)), evaluate, 0.01)
    assert len(bundle.index) == 500
    assert (np.diff(bundle.index) >= 0).all()
    for own in bundle.split(bundle.fraction):
        assert (np.diff(own) > 0).all()
    again = refined(bundle, evaluate, 0.01)
    np.testing.assert_array_equal(again.fraction, bundle.fraction)
