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
