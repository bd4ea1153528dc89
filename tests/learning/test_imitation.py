"""What a fit must give, whatever the demonstrations: a stable, invertible system that ends at the goal."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import euler, implicit_euler
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.flow_chain import Layer, Stack, equally_spaced_grid, min_step_determinant
from dt_viz.learning.imitation import Imitation, ImitationSettings, fit
from dt_viz.learning.preparation import ImitationError
from dt_viz.learning.unbending import unbending
from dt_viz.learning.velocity import VelocityFit


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
    assert np.allclose(imitation.system.velocity(imitation.goal), 0, atol=1e-11)


def mean_error(demonstrations, imitation):
    """Mean distance of the rollouts to the demonstrations at equal times."""
    return np.mean(
        [
            np.linalg.norm(imitation.system.rollout(d.positions[0], d.times) - d.positions, axis=1).mean()
            for d in demonstrations
        ]
    )


@pytest.mark.parametrize("dim", [2, 3])
def test_units_and_place_do_not_matter(dim):
    small, shift = fit(hooks(dim)), np.arange(1.0, dim + 1)
    moved = [Demonstration(d.times, 25 * d.positions + shift, d.name) for d in hooks(dim)]
    large = fit(moved)
    times = np.linspace(0, 3, 30)
    expected = 25 * small.system.rollout(small.starts, times) + shift
    assert np.allclose(large.system.rollout(large.starts, times), expected, atol=1e-5)


def test_the_order_of_the_demonstrations_does_not_matter():
    one, other = fit(hooks(2)), fit(hooks(2)[::-1])
    times = np.linspace(0, 3, 30)
    assert np.allclose(one.system.rollout(one.starts, times), other.system.rollout(one.starts, times), atol=1e-4)


@pytest.mark.parametrize("dim", [2, 3])
def test_every_motion_from_around_the_demonstrations_reaches_the_goal(dim):
    demonstrations = hooks(dim)
    imitation = fit(demonstrations)
    points = np.concatenate([d.positions for d in demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    rng = np.random.default_rng(0)
    starts = rng.uniform(1.25 * lower - 0.25 * upper, 1.25 * upper - 0.25 * lower, (2000, dim))
    ends = imitation.system.rollout(starts, np.array([100.0]))[:, 0]
    assert np.linalg.norm(ends - imitation.goal, axis=1).max() < 1e-6
    assert (np.linalg.det(imitation.transform.jacobian(starts)[1]) > 0).all()


def test_a_single_demonstration_is_enough():
    demonstrations = hooks(2, num=1)
    assert mean_error(demonstrations, fit(demonstrations)) < 0.002


def test_groups_of_starts_on_opposite_sides_share_one_goal():
    one = hooks(2, num=3)
    other = [Demonstration(d.times, -d.positions, d.name + " turned") for d in hooks(2, num=3, seed=1)]
    assert mean_error(one + other, fit(one + other)) < 0.003


def test_a_motion_that_turns_twice_round_gets_more_layers():
    s = np.linspace(0, 1, 300)
    angle, radius = 4 * np.pi * (1 - s), 0.02 + 0.08 * (1 - s)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    spiral = [Demonstration(4 * s, path * (1 + 0.02 * k), f"spiral {k}") for k in range(3)]
    imitation = fit(spiral)
    assert len(imitation.transform.parts) > len(fit(hooks(2)).transform.parts)
    assert mean_error(spiral, imitation) < 0.004


@pytest.mark.parametrize("dim", [2, 3])
def test_sensitivities_are_the_derivatives_of_the_inverse(dim):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, dim))
    layer = Layer.near(points, 1.0, spacing=1.0, reach=1.0)
    stack = Stack((layer, layer), steps=3)
    thetas = [0.3 * rng.normal(size=(layer.num_features, dim)) for _ in range(2)]
    x, by_z, by_theta = stack.inverse_with_sensitivity(points, thetas)
    assert np.allclose(x, stack.inverse(points, thetas), atol=1e-14)
    direction, shift, h = rng.normal(size=by_theta.shape[-1]), rng.normal(size=points.shape), 1e-6
    vector = stack.join(thetas)

    def moved(t):
        return stack.inverse(points + t * shift, stack.split(vector + t * direction))

    expected = (moved(h) - moved(-h)) / (2 * h)
    assert np.allclose(by_theta @ direction + (by_z @ shift[..., None])[..., 0], expected, atol=1e-7)


def test_the_fitted_chain_is_the_transform():
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 2))
    layer = Layer.near(points, 1.0, spacing=1.0, reach=1.0)
    stack = Stack((layer, layer), steps=3)
    thetas = [0.2 * rng.normal(size=(layer.num_features, 2)) for _ in range(2)]
    centre, scale = np.array([3.0, -1.0]), 0.05
    transform = stack.transform(thetas, centre, scale)
    expected = centre + scale * stack.inverse(points, thetas)
    assert np.allclose(transform.inverse(centre + scale * points), expected, atol=1e-14)


def test_unbending_ends_in_the_motions_and_begins_with_straight_rays():
    motions = np.stack([d.positions[:: len(d.positions) // 40][:40] for d in hooks(2)])
    motions[:, -1] = 0
    motions /= 0.1
    shapes = unbending(motions, 2, 3.0, 8)
    assert np.allclose(shapes[-1], motions, atol=1e-9)
    assert all(np.allclose(shape[:, -1], 0, atol=1e-9) for shape in shapes)
    offsets = shapes[0] - shapes[0][:, -1:]
    assert np.allclose(offsets, np.linspace(1, 0, 40)[:, None] * offsets[:, :1], atol=1e-9)


@pytest.mark.parametrize("dim", [2, 3])
def test_velocity_objective_has_its_exact_gradient(dim):
    rng = np.random.default_rng(0)
    grid = GaussianGrid.covering(rng.normal(size=(50, dim)), 0.8)
    x, v = rng.normal(size=(2, 20, dim))
    problem = VelocityFit(grid, x, v, np.zeros(dim), 1.0, 0.3, 1e-3, 5)
    weights, direction = 0.3 * rng.normal(size=(2, grid.num_points, dim))
    h = 1e-6
    difference = (
        problem.cost_and_gradient(weights + h * direction)[0] - problem.cost_and_gradient(weights - h * direction)[0]
    )
    assert difference / (2 * h) == pytest.approx((problem.cost_and_gradient(weights)[1] * direction).sum(), rel=1e-7)


@pytest.mark.parametrize("dim", [2, 3])
def test_velocity_objective_gives_a_stable_invertible_system_too(dim):
    demonstrations = hooks(dim)
    settings = ImitationSettings("velocity", max_iterations=5)
    imitation = fit(demonstrations, settings)
    assert imitation.min_det_jacobian > 0
    assert imitation.round_trip_error < 1e-12
    assert np.allclose(imitation.system.rollout(imitation.starts, np.array([100.0]))[:, 0], imitation.goal, atol=1e-6)
    again = Imitation.from_arrays(imitation.to_arrays())
    assert np.array_equal(again.transform.forward(imitation.starts), imitation.transform.forward(imitation.starts))


@pytest.mark.parametrize("objective", ["trajectory", "velocity"])
def test_the_papers_preset_runs(objective):
    preset = ImitationSettings(objective, ell=0.005e6, num_inducing=720)  # ℓ = 0.005 for LASA in millimetres
    demonstrations = hooks(2, num=2, scale=0.3)
    imitation = fit(demonstrations, replace(preset, max_iterations=3))
    flow = imitation.transform.parts[0]
    assert isinstance(flow, Flow)
    assert isinstance(flow.field, GridRBF)
    field = flow.field
    assert field.grid.num_points == 720
    assert field.grid.ell == pytest.approx(0.005 / 0.001**2)
    assert imitation.min_det_jacobian > 0


@pytest.mark.parametrize(("num", "dim"), [(720, 2), (720, 3), (100, 2)])
def test_equally_spaced_grids_have_the_number_of_points_asked_for(num, dim):
    grid = equally_spaced_grid(np.random.default_rng(0).uniform(size=(50, dim)), num, 50.0)
    spacings = [axis[1] - axis[0] for axis in grid.axes]
    assert grid.num_points == num
    assert max(spacings) < 1.5 * min(spacings)


def test_a_step_that_folds_is_found():
    grid = GaussianGrid((np.array([-1.0, 0.0, 1.0]), np.array([-1.0, 0.0, 1.0])), 0.5)
    layer = Layer.of(grid)
    gentle = layer.field(0.1 * np.ones((9, 2)))
    assert min_step_determinant(gentle, 0.25) > 0.5
    assert min_step_determinant(gentle, 200.0) < 0


def test_motions_from_far_away_do_not_take_the_slow_start_of_the_demonstrations():
    slow = [
        Demonstration(np.append(0.0, d.times + 2.0), np.concatenate([d.positions[:1], d.positions]), d.name)
        for d in hooks(2)
    ]
    base = fit(slow).base
    z0 = base.goal + 2 * base.directions * 0.4
    assert base.arrival_time(z0, 1e-3).max() < 20.0


@pytest.mark.parametrize("seed", [0, 1, 3, 36])
def test_a_step_that_nearly_folds_is_still_inverted_exactly(seed):
    rng = np.random.default_rng(seed)
    grid = GaussianGrid((np.linspace(-1, 1, 5), np.linspace(-1, 1, 5)), 2.0)
    field, h = GridRBF(grid, rng.normal(size=(25, 2))), 1.0
    while min_step_determinant(field, h) < 0.05:
        h *= 0.9
    y = rng.uniform(-2, 2, (2000, 2))
    x, _ = euler(field, y, None, h)
    assert np.abs(implicit_euler(field, x, None, -h)[0] - y).max() < 1e-12


# ---- input that is not as it should be ----


def changed(index, positions=None, times=None, dim=2):
    demonstrations = hooks(dim)
    old = demonstrations[index]
    new = Demonstration(
        old.times if times is None else times, old.positions if positions is None else positions, old.name
    )
    return [*demonstrations[:index], new, *demonstrations[index + 1 :]]


def test_ends_that_nearly_agree_are_moved_together_and_named():
    demonstrations = changed(1, hooks(2)[1].positions + np.array([0.004, 0.0]))
    imitation = fit(demonstrations)
    assert any("hook 1" in warning and "moved" in warning for warning in imitation.warnings)
    assert mean_error(demonstrations, imitation) < 0.005


def test_a_demonstration_that_ends_elsewhere_is_left_out_and_named():
    imitation = fit(changed(2, hooks(2)[2].positions + np.array([0.3, 0.0])))
    assert any("hook 2" in warning and "left out" in warning for warning in imitation.warnings)
    assert len(imitation.starts) == 3


def test_demonstrations_without_a_common_goal_are_refused():
    demonstrations = [
        Demonstration(d.times, d.positions + 0.3 * np.array([np.cos(k), np.sin(k)]), d.name)
        for k, d in enumerate(hooks(2))
    ]
    with pytest.raises(ImitationError, match="no common goal"):
        fit(demonstrations)


def test_a_demonstration_that_starts_at_the_goal_loses_its_beginning():
    s = np.linspace(0, 1, 200)
    loop = 0.1 * np.stack([1 - np.cos(2 * np.pi * s), np.sin(2 * np.pi * s)], axis=1)
    imitation = fit([Demonstration(3 * s, loop, "loop")])
    assert any("'loop' starts at the goal" in warning for warning in imitation.warnings)
    assert imitation.min_det_jacobian > 0


def test_an_objective_that_there_is_not_is_refused_before_anything_is_fitted():
    with pytest.raises(ImitationError, match=r"objective: found 'nonsense'; accepted: trajectory or velocity"):
        ImitationSettings(cast(Any, "nonsense"))


@pytest.mark.parametrize("path", [np.zeros((50, 2)), np.full((50, 2), 0.3)])
def test_demonstrations_that_never_move_are_refused_or_left_out(path):
    still = Demonstration(np.linspace(0, 1, 50), path, "still")
    with pytest.raises(ImitationError, match="moves"):
        fit([still])
    imitation = fit([*hooks(2), still])
    assert any("'still' never moves" in warning for warning in imitation.warnings)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused_by_name(value):
    path = hooks(2)[1].positions.copy()
    path[7, 1] = value
    with pytest.raises(ImitationError, match=r"'hook 1': found .* at sample 8"):
        fit(changed(1, path))


def test_times_that_do_not_increase_are_refused_by_name():
    times = hooks(2)[3].times.copy()
    times[5] = times[4]
    with pytest.raises(ImitationError, match=r"'hook 3': found .* at sample 6"):
        fit(changed(3, times=times))


def test_no_demonstrations_are_refused():
    with pytest.raises(ImitationError, match="demonstrations: found none"):
        fit([])


def test_repeated_points_and_a_pause_are_fitted():
    old = hooks(2)[0]
    middle = len(old.times) // 2
    path = np.concatenate(
        [old.positions[:middle], np.repeat(old.positions[[middle]], 60, axis=0), old.positions[middle:]]
    )
    demonstrations = changed(0, path, np.linspace(0, 4, len(path)))
    imitation = fit(demonstrations)
    assert any("'hook 0' stands still" in warning for warning in imitation.warnings)
    assert mean_error(demonstrations, imitation) < 0.003


def test_a_crossing_is_said_and_the_map_stays_invertible():
    s = np.linspace(0, 1, 300)
    path = 0.1 * np.stack([np.sin(6.6 * (1 - s)), 0.5 * np.sin(13.2 * (1 - s)) + 0.3 * (1 - s)], axis=1)
    imitation = fit([Demonstration(3 * s, path, "eight")])
    assert any("'eight' crosses itself" in warning for warning in imitation.warnings)
    assert imitation.min_det_jacobian > 0
