"""Laws of base systems and of what a diffeomorphism makes of them, on an example of every class."""

import numpy as np
import pytest
from laws.registry import BASES, MAPS, ONLY_AT_A_MOMENT, bump, product_classes
from oracles import central_differences, stepped

from dt_viz.flows.augmented_systems import PhasedAttractor, Shear, on_places
from dt_viz.flows.diffeomorphisms import Chain
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem


def test_every_base_system_has_an_example():
    kinds = {kind for kind in product_classes() if issubclass(kind, Attractor)}
    assert {kind.__name__ for kind in kinds - {type(base) for base, _ in BASES.values()}} == ONLY_AT_A_MOMENT


@pytest.fixture(params=BASES, name="example")
def _example(request):
    return BASES[request.param]


def test_motions_of_the_base_are_a_flow(example):
    base, some = example
    z = some(8)
    for first, second in ((0.0, 0.7), (0.4, 1.1), (2.0, 3.0)):
        at_once = base.flow(z, np.array([first + second]))[:, 0]
        in_two = base.flow(base.flow(z, np.array([first]))[:, 0], np.array([second]))[:, 0]
        np.testing.assert_allclose(at_once, in_two, rtol=0, atol=1e-9)
    np.testing.assert_allclose(base.flow(z, np.zeros(1))[:, 0], z, rtol=0, atol=1e-9)


def test_the_velocity_is_the_derivative_of_motions(example):
    base, some = example
    z = some(20)

    def motion(t):
        return base.flow(z, 0.3 + t[0])[:, 0]

    there = motion(np.zeros((1, 1)))
    slope = central_differences(lambda t: np.asarray([motion(t)]), np.zeros((1, 1)), 1e-3)[0, ..., 0]
    np.testing.assert_allclose(base.velocity(there), slope, rtol=0, atol=2e-5)
    assert np.abs(slope).max() > 0.05


def test_the_potential_falls_to_nothing_at_the_goal_where_all_motions_end(example):
    base, some = example
    z = some(8)
    path = base.flow(z, np.linspace(0, 1, 40))
    assert (np.diff(base.potential(path), axis=1) < 0).all()
    assert base.potential(base.goal) == pytest.approx(0, abs=1e-15)
    np.testing.assert_allclose(base.velocity(base.goal), 0, atol=1e-12)
    end = base.flow(z, np.array([300.0]))[:, 0]
    np.testing.assert_allclose(base.distance(end), 0, rtol=0, atol=1e-9)


def test_times_are_when_that_much_is_left_of_the_way(example):
    base, some = example
    z = some(10)
    fraction = np.broadcast_to(np.linspace(1, 0.01, 9), (10, 9))
    times = base.times_at(z, fraction * base.left(z)[:, None])
    assert (np.diff(times, axis=1) > 0).all() and np.abs(times[:, 0]).max() < 1e-9
    np.testing.assert_allclose(base.flow(z, times), base.at_fraction(z, fraction), rtol=0, atol=1e-8)
    np.testing.assert_allclose(base.left(base.flow(z, times)), fraction * base.left(z)[:, None], rtol=0, atol=1e-8)


def stacked(base):
    """Diffeomorphisms to see a base system through."""
    if isinstance(base, PhasedAttractor):
        shear, num_rest = Shear(base.predictions), 1 + base.predictions.num_conditions
        return [shear, Chain([shear, *on_places([bump(base.predictions.dim)], num_rest)])]
    plain = (case.transform for name, case in MAPS.items() if case.points is None and name != "flow euler")
    return [transform for transform in plain if transform.dim == base.dim]


@pytest.mark.parametrize(
    ("base", "some", "transform"),
    [
        pytest.param(base, some, transform, id=f"{name}, {k}")
        for name, (base, some) in BASES.items()
        if name not in {"attractor in space", "timed"}
        for k, transform in enumerate(stacked(base))
    ],
)
class TestSystems:
    """What a diffeomorphism makes of a base system."""

    def test_exact_rollouts_are_what_stepping_converges_to(self, base, some, transform):
        system, y, times = DiffeomorphicSystem(transform, base), some(3), np.linspace(0, 0.5, 3)
        exact = system.rollout(y, times)
        coarse, fine = (np.abs(stepped(system.velocity, y, times, num) - exact).max() for num in (2, 10))
        assert fine < 5e-4 and (fine < coarse / 40 or coarse < 1e-5)
        np.testing.assert_allclose(exact[:, 0], y, rtol=0, atol=1e-5)

    def test_its_motions_are_conjugate_to_those_of_the_base_and_its_potential_falls(self, base, some, transform):
        system, y, times = DiffeomorphicSystem(transform, base), some(5), np.linspace(0, 1, 9)
        motion = system.rollout(y, times)
        expected = base.flow(transform.forward(y), times)
        np.testing.assert_allclose(transform.forward(motion), expected, rtol=0, atol=2e-6)
        assert (np.diff(system.lyapunov(motion), axis=-1) < 0).all()
        end = transform.forward(system.rollout(y, np.array([300.0]))[:, 0])
        np.testing.assert_allclose(base.distance(end), 0, rtol=0, atol=1e-5)
        z, J = transform.jacobian(y)
        np.testing.assert_allclose((J @ system.velocity(y)[..., None])[..., 0], base.velocity(z), rtol=0, atol=1e-7)
