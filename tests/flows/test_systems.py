"""The base attractor's closed form and the conjugate system against stepped integration."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Chain, Flow, Identity, Placed
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import euler, implicit_euler, rk4
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem, asinh_exp, log_sinh
from dt_viz.obstacles.shapes import Sphere
from dt_viz.obstacles.union import Union
from dt_viz.transforms.bias import BiasPoint

seeds = st.integers(0, 2**32 - 1)


def field(dim, seed=0, strength=0.25):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(dim)), 0.5 / 0.6**2)
    return GridRBF(grid, strength * np.random.default_rng(seed).normal(size=(grid.num_points, dim)))


ATTRACTOR = Attractor(np.array([0.2, -0.1]), speed=0.3, smoothing=0.2)
ROUNDING = 10 * np.finfo(float).eps * ATTRACTOR.speed * ATTRACTOR.smoothing
"""Ten times what is lost of the potential near the goal, where logarithms of about 1 cancel."""
TRANSFORMS = {
    "identity": Identity(2),
    "flow": Flow(field(2), 1.0, 20),
    "euler with exact inverse": Flow(field(2), 0.8, 6, implicit_euler, euler),
    "chain": Chain([Flow(field(2, 1), 0.6, 12), AdaptiveFlow(field(2, 2), -0.6, 1e-10)]),
    "placed": Placed(Flow(field(2), 0.8, 30), np.array([0.1, 0.2]), np.array([[0.6, -0.8], [0.8, 0.6]]), 0.8),
}


@pytest.fixture(params=TRANSFORMS, name="system")
def _system(request):
    return DiffeomorphicSystem(TRANSFORMS[request.param], ATTRACTOR)


def rk4_motion(velocity, y, times):
    motion = [y]
    for h in np.diff(times):
        k1 = velocity(y)
        k2 = velocity(y + h / 2 * k1)
        k3 = velocity(y + h / 2 * k2)
        y = y + h / 6 * (k1 + 2 * k2 + 2 * k3 + velocity(y + h * k3))
        motion.append(y)
    return np.stack(motion, axis=-2)


def test_the_closed_form_solves_the_attractor():
    z0 = np.random.default_rng(0).uniform(-1, 1, (6, 2))
    times = np.linspace(0, 4, 801)
    np.testing.assert_allclose(ATTRACTOR.flow(z0, times), rk4_motion(ATTRACTOR.velocity, z0, times), rtol=0, atol=1e-9)


def test_the_velocity_is_the_falling_gradient_of_the_potential():
    z, h = np.random.default_rng(1).uniform(-1, 1, (20, 2)), 1e-6
    gradient = [(ATTRACTOR.potential(z + e) - ATTRACTOR.potential(z - e)) / (2 * h) for e in h * np.eye(2)]
    np.testing.assert_allclose(ATTRACTOR.velocity(z), -np.stack(gradient, axis=-1), rtol=0, atol=1e-8)


@given(seeds, st.floats(0, 20), st.floats(0, 20))
def test_the_flow_is_a_one_parameter_group(seed, s, t):
    z0 = np.random.default_rng(seed).uniform(-2, 2, (5, 2))
    at_once = ATTRACTOR.flow(z0, np.array([s + t]))[:, 0]
    in_two = ATTRACTOR.flow(ATTRACTOR.flow(z0, np.array([s]))[:, 0], np.array([t]))[:, 0]
    np.testing.assert_allclose(at_once, in_two, rtol=0, atol=1e-12)


def test_far_from_the_goal_nothing_overflows_and_the_speed_is_the_chosen_one():
    far = Attractor(np.zeros(2), speed=0.1, smoothing=1e-3)  # r₀/ρ = 10⁴
    z0 = np.array([[10.0, 0.0], [0.0, -10.0]])
    motion = far.flow(z0, np.array([0.0, 10.0, 90.0, 120.0]))
    radius = np.linalg.norm(motion, axis=-1)
    np.testing.assert_allclose(motion[:, 0], z0, rtol=1e-14)
    np.testing.assert_allclose(radius[:, 1:3], [[9.0, 1.0]] * 2, rtol=1e-12)
    assert (radius[:, 3] < 1e-12).all()
    np.testing.assert_allclose(np.linalg.norm(far.velocity(z0), axis=-1), 0.1, rtol=1e-14)
    np.testing.assert_allclose(far.potential(z0), 0.1 * (10 - 1e-3 * np.log(2)), rtol=1e-12)


@given(seeds)
def test_the_potential_falls_strictly_along_the_motion(seed):
    z0 = np.random.default_rng(seed).uniform(-1, 1, (6, 2))
    values = ATTRACTOR.potential(ATTRACTOR.flow(z0, np.linspace(0, 8, 60)))
    assert (np.diff(values, axis=-1) < 0).all()


def test_the_potential_is_zero_at_the_goal_only():
    assert ATTRACTOR.potential(ATTRACTOR.goal) == pytest.approx(0, abs=ROUNDING)
    assert (ATTRACTOR.potential(ATTRACTOR.goal + 1e-3 * np.eye(2)) > 0).all()


def test_close_to_the_goal_the_potential_is_its_parabola():
    r = np.array([1e-3, 1e-5, 1e-7])
    z = ATTRACTOR.goal + r[:, None] * np.array([1.0, 0.0])
    parabola = ATTRACTOR.speed * r**2 / (2 * ATTRACTOR.smoothing)
    np.testing.assert_allclose(ATTRACTOR.potential(z), parabola, rtol=1e-4, atol=ROUNDING)


def test_the_goal_stays_where_it_is():
    np.testing.assert_array_equal(ATTRACTOR.velocity(ATTRACTOR.goal), 0)
    np.testing.assert_array_equal(ATTRACTOR.flow(ATTRACTOR.goal, np.array([0.0, 1.0, 100.0])), [ATTRACTOR.goal] * 3)


@given(seeds, st.floats(1e-4, 0.5))
def test_arrival_times_are_when_the_flow_is_there(seed, distance):
    z0 = np.random.default_rng(seed).uniform(-2, 2, (5, 2))
    times = ATTRACTOR.arrival_time(z0, distance)
    reached = ATTRACTOR.flow(z0, times[:, None])[:, 0]
    initial = np.linalg.norm(z0 - ATTRACTOR.goal, axis=-1)
    expected = np.minimum(initial, distance)
    np.testing.assert_allclose(np.linalg.norm(reached - ATTRACTOR.goal, axis=-1), expected, rtol=1e-9)
    assert (times >= 0).all() and (times[initial > 1.01 * distance] > 0).all()


@given(st.floats(1e-8, 300))
def test_logarithmic_hyperbolic_functions_are_inverse(a):
    assert log_sinh(np.array(a)) == pytest.approx(np.log(np.sinh(a)), abs=1e-12, rel=1e-12)
    assert asinh_exp(log_sinh(np.array(a))) == pytest.approx(a, rel=1e-12)


def test_logarithmic_hyperbolic_functions_do_not_overflow():
    assert asinh_exp(log_sinh(np.array(1e6))) == pytest.approx(1e6, rel=1e-14)
    assert log_sinh(np.array(0.0)) == -np.inf
    assert asinh_exp(np.array(-np.inf)) == 0


def test_exact_rollouts_are_what_stepping_converges_to_with_order_four(system):
    y0 = np.random.default_rng(2).uniform(-0.7, 0.7, (4, 2))
    times = np.linspace(0, 3, 4)
    exact = system.rollout(y0, times)
    assert exact.shape == (4, 4, 2)
    counts = np.array([4, 8, 16])
    errors = [np.abs(system.stepped_rollout(y0, times, int(n)) - exact).max() for n in counts]
    order = np.polyfit(np.log(counts), -np.log(errors), 1)[0]
    assert errors[-1] < 1e-5
    assert order == pytest.approx(4, abs=0.4)


def test_the_transform_is_a_conjugacy(system):
    """ψ(y(t)) moves exactly like the base."""
    y0 = np.random.default_rng(3).uniform(-0.7, 0.7, (5, 2))
    times = np.linspace(0, 5, 11)
    images = system.transform.forward(system.rollout(y0, times))
    np.testing.assert_allclose(images, system.base.flow(system.transform.forward(y0), times), rtol=0, atol=1e-7)


def test_the_velocity_solves_with_the_jacobian(system):
    y = np.random.default_rng(4).uniform(-0.7, 0.7, (3, 5, 2))
    z, J = system.transform.jacobian(y)
    solved = np.linalg.solve(J, system.base.velocity(z)[..., None])[..., 0]
    np.testing.assert_allclose(system.velocity(y), solved, rtol=0, atol=1e-7)


def test_the_velocity_is_the_derivative_of_the_rollout(system):
    y0, t, h = np.random.default_rng(5).uniform(-0.7, 0.7, (6, 2)), 0.8, 1e-4
    before, at, after = np.moveaxis(system.rollout(y0, np.array([t - h, t, t + h])), -2, 0)
    np.testing.assert_allclose(system.velocity(at), (after - before) / (2 * h), rtol=0, atol=1e-6)


def around_a_sphere(tolerance=2e-9):
    """Imitation-like flow with a sphere's avoidance and a bias point's pull on top, and places all around them."""
    rng = np.random.default_rng(9)
    grid = GaussianGrid(tuple(np.linspace(-0.3, 0.3, 5) for _ in range(3)), 0.5 / 0.1**2)
    bent = GridRBF(grid, 0.03 * rng.normal(size=(grid.num_points, 3)))
    sphere = Sphere((0.02, 0.03, -0.01), 0.15)
    pulled = BiasPoint((-0.1, 0.05, 0.02)).field(0.12)
    chain = Chain(
        [
            Flow(bent, 1.0, 4, implicit_euler, euler),
            AdaptiveFlow(Union((sphere,)).field("free-space", 3.0), 0.4, tolerance),
            Flow(pulled, 0.8, 32, rk4, sparse=True, tolerance=tolerance),
        ]
    )
    y = rng.uniform(-0.2, 0.2, (40, 3))
    return DiffeomorphicSystem(chain, Attractor(np.array([0.25, 0.1, 0.0]))), y[sphere.signed_distance(y) > 0.01]


def test_the_velocity_beside_obstacles_and_bias_points_is_the_derivative_of_exact_rollouts():
    system, y = around_a_sphere()
    h = 2e-4
    z = system.transform.forward(y)
    f = system.base.velocity(z)[:, None]
    far, near = (
        np.diff(system.transform.inverse(z[:, None] + np.array([[-step], [step]]) * f), axis=1)[:, 0] / (2 * step)
        for step in (2 * h, h)
    )
    velocity = system.velocity(y)
    speed = np.linalg.norm(velocity, axis=1, keepdims=True)
    assert np.abs((velocity - (4 * near - far) / 3) / speed).max() < 1e-4


def test_the_velocity_is_the_image_of_the_base_velocity_under_the_derivative_of_the_inverse():
    system, y = around_a_sphere()
    z = system.transform.forward(y)
    _, image = system.transform.inverse_tangents(z, system.base.velocity(z)[..., None])
    speed = np.linalg.norm(image[..., 0], axis=1, keepdims=True)
    assert np.abs((system.velocity(y) - image[..., 0]) / speed).max() < 1e-6


def test_the_velocity_at_one_point_is_that_in_a_batch():
    system, y = around_a_sphere()
    alone = np.stack([system.velocity(point) for point in y])
    np.testing.assert_allclose(alone, system.velocity(y), rtol=0, atol=1e-9)


def test_the_velocity_approaches_the_exact_one_with_the_tolerance():
    system, y = around_a_sphere(1e-10)
    exact = system.velocity(y)
    speed = np.linalg.norm(exact, axis=1, keepdims=True)
    errors = [np.abs((system.at_tolerance(h).velocity(y) - exact) / speed).max() for h in (1e-4, 1e-6, 1e-8)]
    assert errors[0] > 10 * errors[1] > 100 * errors[2]


def test_a_controllers_velocity_at_one_point_is_exact_to_a_thousandth():
    system, y = around_a_sphere(1e-10)
    exact, controlled = system.velocity(y), system.at_tolerance(1e-6)
    velocity = np.stack([controlled.velocity(point) for point in y])
    speed = np.linalg.norm(exact, axis=1, keepdims=True)
    assert 0 < np.abs((velocity - exact) / speed).max() < 1e-3


def test_the_lyapunov_value_falls_strictly_and_the_goal_is_reached(system):
    y0 = np.random.default_rng(6).uniform(-0.7, 0.7, (6, 2))
    motion = system.rollout(y0, np.append(np.linspace(0, 5, 50), 100.0))
    assert (np.diff(system.lyapunov(motion[:, :50]), axis=-1) < 0).all()
    goal = system.transform.inverse(system.base.goal)
    np.testing.assert_allclose(motion[:, -1], np.broadcast_to(goal, (6, 2)), rtol=0, atol=1e-12)
    np.testing.assert_allclose(system.velocity(goal), 0, rtol=0, atol=1e-7)


@pytest.mark.parametrize("batch", [(), (0,), (1,), (2, 3)])
def test_rollouts_take_any_batch(system, batch):
    y0 = np.random.default_rng(7).uniform(-0.5, 0.5, (*batch, 2))
    assert system.rollout(y0, np.linspace(0, 1, 4)).shape == (*batch, 4, 2)
    assert system.stepped_rollout(y0, np.linspace(0, 1, 4)).shape == (*batch, 4, 2)
    assert system.velocity(y0).shape == (*batch, 2)
    assert system.lyapunov(y0).shape == batch


def test_each_rollout_may_have_its_own_times(system):
    y0 = np.random.default_rng(8).uniform(-0.5, 0.5, (3, 2))
    times = np.array([[0.0, 1.0], [0.5, 2.0], [0.1, 9.0]])
    own = system.rollout(y0, times)
    for k in range(3):
        np.testing.assert_allclose(own[k], system.rollout(y0[k], times[k]), rtol=0, atol=1e-12)
