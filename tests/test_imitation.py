"""What a fit must give, whatever the demonstrations: a stable, invertible system that ends at the goal."""

import numpy as np
import pytest

from dt_viz.demos import Demonstration
from dt_viz.imitation import Imitation, fit


def hooks(dim, num=4, seed=0, scale=1.0):
    """Demonstrations that swing round three quarters of a circle; in space they rise on the way."""
    rng = np.random.default_rng(seed)
    demonstrations = []
    for index in range(num):
        s = np.linspace(0, 1, 80 + 20 * index)
        angle = 1.5 * np.pi * (1 - s**1.2)
        radius = 0.1 * (1 + 0.12 * rng.normal() * (1 - s))
        path = np.stack([radius * np.cos(angle), radius * np.sin(angle), 0.15 * s**2], axis=1)[:, :dim]
        demonstrations.append(Demonstration((2 + 0.2 * index) * s, scale * (path - path[-1]), f"hook {index}"))
    return demonstrations


@pytest.fixture(scope="module", params=[2, 3])
def learned(request):
    demonstrations = hooks(request.param)
    return demonstrations, fit(demonstrations)


def test_rollouts_follow_the_demonstrations_and_end_at_the_goal(learned):
    _, imitation = learned
    ends = imitation.system.rollout(imitation.starts, np.array([0.0, 60.0]))
    assert np.allclose(ends[:, 0], imitation.starts, atol=1e-12)
    assert np.allclose(ends[:, 1], imitation.goal, atol=1e-6)


def test_the_map_is_invertible(learned):
    _, imitation = learned
    assert imitation.min_det_jacobian > 0
    assert imitation.round_trip_error < 1e-12


def test_arrays_give_the_same_system_back(learned):
    _, imitation = learned
    again = Imitation.from_arrays(imitation.to_arrays())
    times = np.linspace(0, 3, 20)
    assert np.array_equal(again.system.rollout(again.starts, times), imitation.system.rollout(imitation.starts, times))
    assert again.warnings == imitation.warnings


def test_progress_can_cancel():
    class CancelledError(Exception):
        pass

    def cancel(fraction, _message):
        if fraction > 0.1:
            raise CancelledError

    with pytest.raises(CancelledError):
        fit(hooks(2), progress=cancel)


def test_rollouts_are_where_the_demonstrations_were_at_equal_times(learned):
    demonstrations, imitation = learned
    for demonstration in demonstrations:
        rollout = imitation.system.rollout(demonstration.positions[0], demonstration.times)
        assert np.sqrt(((rollout - demonstration.positions) ** 2).sum(axis=1).mean()) < 0.004


def test_exact_rollouts_with_learned_timing_agree_with_stepping(learned):
    _, imitation = learned
    times = np.linspace(0, 1.5, 31)
    exact = imitation.system.rollout(imitation.starts[:1], times)
    stepped = imitation.system.stepped_rollout(imitation.starts[:1], times, substeps=8)
    assert np.abs(exact - stepped).max() < 5e-5


def test_learned_timing_is_a_flow(learned):
    _, imitation = learned
    base, z0 = imitation.base, imitation.system.transform.forward(imitation.starts)
    halfway = base.flow(z0, np.array([0.7]))[:, 0]
    assert np.allclose(base.flow(halfway, np.array([0.9]))[:, 0], base.flow(z0, np.array([1.6]))[:, 0], atol=1e-12)


def test_velocity_is_the_derivative_of_the_flow(learned):
    _, imitation = learned
    rng = np.random.default_rng(0)
    z0 = imitation.base.goal + rng.normal(0, 0.2, (50, imitation.base.dim))
    h = 1e-6
    ahead = imitation.base.flow(z0, np.array([-h, h]))
    assert np.allclose((ahead[:, 1] - ahead[:, 0]) / (2 * h), imitation.base.velocity(z0), rtol=1e-4, atol=1e-7)


def test_arrival_time_is_when_the_flow_arrives(learned):
    _, imitation = learned
    base, z0 = imitation.base, imitation.system.transform.forward(imitation.starts)
    arrival = base.arrival_time(z0, 1e-4)
    z = base.flow(z0, arrival[:, None])[:, 0]
    assert np.allclose(np.linalg.norm(z - base.goal, axis=1), 1e-4, rtol=1e-6)


def test_lyapunov_value_falls_along_motions_from_anywhere(learned):
    demonstrations, imitation = learned
    rng = np.random.default_rng(1)
    points = np.concatenate([demonstration.positions for demonstration in demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    starts = rng.uniform(1.5 * lower - 0.5 * upper, 1.5 * upper - 0.5 * lower, (100, len(lower)))
    motions = imitation.system.rollout(starts, np.linspace(0, 4, 60))
    values = imitation.system.lyapunov(motions)
    assert (np.diff(values, axis=1)[values[:, 1:] > 1e-12] < 0).all()


def test_a_motion_from_the_goal_stays_there(learned):
    _, imitation = learned
    assert np.allclose(imitation.system.rollout(imitation.goal, np.array([0.0, 1.0])), imitation.goal, atol=1e-12)
    assert np.allclose(imitation.system.velocity(imitation.goal), 0, atol=1e-12)
