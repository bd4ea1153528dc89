"""What a fit must give, whatever the demonstrations: a stable, invertible system that ends at the goal."""

import re
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from drawings import extent, frechet

from dt_viz.errors import FormatError
from dt_viz.flows.diffeomorphisms import Flow, min_det_jacobian
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER, carried
from dt_viz.learning import initial_guess
from dt_viz.learning.demonstrations import Demonstration, load_demonstrations
from dt_viz.learning.flow_chain import FlowChain, FlowLayer, equally_spaced_grid, min_step_determinant
from dt_viz.learning.imitation import Imitation, ImitationSettings, fit
from dt_viz.learning.preparation import ImitationError
from dt_viz.learning.velocity import VelocityFit
from dt_viz.metrics import resample_by_arc_length
from dt_viz.shipped import ASSETS


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


def test_it_ends_at_the_goal_is_invertible_and_is_saved_as_arrays(learned):
    _, imitation = learned
    ends = imitation.system.rollout(imitation.starts, np.array([0.0, 60.0]))
    np.testing.assert_allclose(ends[:, 0], imitation.starts, atol=1e-12)
    np.testing.assert_allclose(ends[:, 1], np.broadcast_to(imitation.goal, ends[:, 1].shape), atol=1e-6)
    np.testing.assert_allclose(imitation.system.velocity(imitation.goal), 0, atol=1e-11)
    assert imitation.min_det_jacobian > 0
    assert imitation.round_trip_error < 1e-12
    again, times = Imitation.from_arrays(imitation.to_arrays()), np.linspace(0, 3, 20)
    expected = imitation.system.rollout(imitation.starts, times)
    np.testing.assert_array_equal(again.system.rollout(again.starts, times), expected)
    assert again.warnings == imitation.warnings


def test_inducing_points_that_are_not_evenly_spaced_are_refused(learned):
    arrays = learned[1].to_arrays() | {"layer_1_axis_0": np.array([0.0, 0.1, 0.25])}
    with pytest.raises(FormatError, match=r"layer_1_axis_0.*uneven"):
        Imitation.from_arrays(arrays)


def test_progress_never_goes_back():
    done, fitting = [], []

    def note(part, text):
        done.append(part)
        fitting.append(text.startswith("fitting"))

    fit(load_demonstrations(ASSETS / "draw_s.npz"), progress=note)
    assert sum(fitting) > ImitationSettings().max_iterations  # it begins anew, as it would fold
    assert done == sorted(done) and done[-1] == 1.0


def test_rollouts_are_where_the_demonstrations_were_at_equal_times(learned):
    demonstrations, imitation = learned
    for demonstration in demonstrations:
        rollout = imitation.system.rollout(demonstration.positions[0], demonstration.times)
        assert np.sqrt(((rollout - demonstration.positions) ** 2).sum(axis=1).mean()) < 0.004


def test_every_motion_from_around_the_demonstrations_reaches_the_goal(learned):
    demonstrations, imitation = learned
    points = np.concatenate([d.positions for d in demonstrations])
    lower, upper = points.min(axis=0), points.max(axis=0)
    starts = np.random.default_rng(0).uniform(
        1.25 * lower - 0.25 * upper, 1.25 * upper - 0.25 * lower, (2000, len(lower))
    )
    ends = imitation.system.rollout(starts, np.array([100.0]))[:, 0]
    assert np.linalg.norm(ends - imitation.goal, axis=1).max() < 1e-6
    assert min_det_jacobian(imitation.transform.jacobian, starts) > 0


def mean_error(demonstrations, imitation):
    """Mean distance of the rollouts to the demonstrations at equal times."""
    rollouts = [imitation.system.rollout(d.positions[0], d.times) for d in demonstrations]
    off = [np.linalg.norm(path - d.positions, axis=1) for path, d in zip(rollouts, demonstrations, strict=True)]
    return np.mean([each.mean() for each in off])


@pytest.mark.long
def test_units_and_place_do_not_matter(learned):
    demonstrations, small = learned
    shift = np.arange(1.0, len(small.goal) + 1)
    large = fit([Demonstration(d.times, 25 * d.positions + shift, d.name) for d in demonstrations])
    times = np.linspace(0, 3, 30)
    expected = 25 * small.system.rollout(small.starts, times) + shift
    np.testing.assert_allclose(large.system.rollout(large.starts, times), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("groups", "largest_error"),
    [(hooks(2, num=1), 0.002), (hooks(2, num=3) + hooks(2, num=3, seed=1, scale=-1.0), 0.003)],
)
def test_a_single_demonstration_and_starts_on_opposite_sides_of_one_goal_are_enough(groups, largest_error):
    assert mean_error(groups, fit(groups)) < largest_error


@pytest.mark.long
def test_a_motion_that_turns_twice_round_gets_more_layers():
    s = np.linspace(0, 1, 300)
    angle, radius = 4 * np.pi * (1 - s), 0.02 + 0.08 * (1 - s)
    path = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    spiral = [Demonstration(4 * s, path * (1 + 0.02 * k), f"spiral {k}") for k in range(3)]
    imitation = fit(spiral)
    assert len(imitation.transform.parts) > len(fit(hooks(2)).transform.parts)
    assert mean_error(spiral, imitation) < 0.004


def helix(turns, num=3, pitch=0.25, seed=0):
    """Upright helices 16 cm wide, each a little different."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, 200)
    angle = 2 * np.pi * turns * s
    path = np.column_stack([0.08 * np.cos(angle), 0.08 * np.sin(angle), pitch * s])
    return [Demonstration(4 * s, path + 0.01 * rng.normal(size=3) * (1 - s)[:, None], f"helix {k}") for k in range(num)]


@pytest.mark.long
@pytest.mark.parametrize("turns", [2, 3])
def test_what_winds_is_followed_on_a_map_that_does_not_fold(turns):
    demonstrations = helix(turns)
    imitation = fit(demonstrations)
    assert imitation.min_det_jacobian > 0 and imitation.round_trip_error < 1e-12
    for d in demonstrations:
        path = imitation.system.rollout(d.positions[0], np.linspace(0, 8, 1000))
        assert frechet(path, d.positions) < 0.04 * extent(demonstrations)


def mean_of(demonstrations):
    """(60, d)."""
    return np.mean([resample_by_arc_length(d.positions, 60) for d in demonstrations], axis=0)


def test_nothing_in_the_plane_is_sheared():
    """What always advances along an axis of the plane turns less than half a turn."""
    s = np.linspace(0, 1, 60)
    for turns in np.linspace(0.5, 5, 19):
        for drift in (0.1, 1.0, 4.0):
            angle = 2 * np.pi * turns * s
            cycloid = np.column_stack([np.sin(angle) + drift * angle, np.cos(angle)])
            assert initial_guess._axis(cycloid) is None


def test_what_turns_too_little_or_comes_back_is_not_sheared():
    sheared = [turns for turns in np.arange(0.25, 4.1, 0.25) if initial_guess._axis(mean_of(helix(turns))) is not None]
    assert sheared == list(np.arange(min(sheared), 4.1, 0.25)) and 1 < min(sheared) <= 1.5
    there_and_back = mean_of(helix(3))
    there_and_back = np.concatenate([there_and_back[::2], there_and_back[::-2]])
    assert initial_guess._axis(there_and_back) is None


@pytest.mark.parametrize("dim", [2, 3])
def test_the_fitted_chain_is_the_transform_and_sensitivities_are_the_derivatives_of_its_inverse(dim):
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, dim))
    layer = FlowLayer.near(points, 1.0, spacing=1.0, reach=1.0)
    chain = FlowChain((layer, layer), steps=3)
    thetas = [0.3 * rng.normal(size=(layer.num_features, dim)) for _ in range(2)]
    x, by_z, by_theta = chain.images_with_sensitivity(points, thetas)
    np.testing.assert_allclose(x, chain.images(points, thetas), atol=1e-14)
    direction, shift, h = rng.normal(size=by_theta.shape[-1]), rng.normal(size=points.shape), 1e-6
    vector = chain.join(thetas)
    ahead, back = (chain.images(points + t * shift, chain.split(vector + t * direction)) for t in (h, -h))
    slope = by_theta @ direction + (by_z @ shift[..., None])[..., 0]
    np.testing.assert_allclose(slope, (ahead - back) / (2 * h), atol=1e-7)
    centre, scale = np.arange(3.0, 3.0 + dim), 0.05
    transform = chain.transform(thetas, centre, scale)
    np.testing.assert_allclose(transform.inverse(centre + scale * points), centre + scale * x, atol=1e-14)


@pytest.mark.parametrize("dim", [2, 3])
def test_velocity_objective_has_its_exact_gradient(dim):
    rng = np.random.default_rng(0)
    grid = GaussianGrid.covering(rng.normal(size=(50, dim)), 0.8)
    x, v = rng.normal(size=(2, 20, dim))
    problem = VelocityFit(grid, x, v, np.zeros(dim), 1.0, 0.3, 1e-3, 5, 0.05)
    weights, direction = 0.3 * rng.normal(size=(2, grid.num_points, dim))
    ahead, back = (problem.cost_and_gradient(weights + h * direction)[0] for h in (1e-6, -1e-6))
    slope = (problem.cost_and_gradient(weights)[1] * direction).sum()
    assert (ahead - back) / 2e-6 == pytest.approx(slope, rel=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("dim", [2, 3])
def test_velocity_objective_gives_a_stable_invertible_system_too(dim):
    imitation = fit(hooks(dim), ImitationSettings("velocity", max_iterations=5))
    assert imitation.min_det_jacobian > 0
    assert imitation.round_trip_error < 1e-12
    ends = imitation.system.rollout(imitation.starts, np.array([100.0]))[:, 0]
    np.testing.assert_allclose(ends, np.broadcast_to(imitation.goal, ends.shape), atol=1e-6)
    again = Imitation.from_arrays(imitation.to_arrays()).transform
    np.testing.assert_array_equal(again.forward(imitation.starts), imitation.transform.forward(imitation.starts))


@pytest.mark.long
@pytest.mark.parametrize("objective", ["trajectory", "velocity"])
def test_the_papers_preset_runs(objective):
    # ℓ = 0.005 for LASA in millimetres
    preset = ImitationSettings(objective, ell=0.005e6, num_inducing=720, max_iterations=3)
    imitation = fit(hooks(2, num=2, scale=0.3), preset)
    flow = imitation.transform.parts[0]
    assert isinstance(flow, Flow) and isinstance(flow.field, GridRBF)
    assert flow.field.grid.num_points == 720
    assert flow.field.grid.ell == pytest.approx(0.005 / 0.001**2)
    assert imitation.min_det_jacobian > 0


@pytest.mark.parametrize(("num", "dim"), [(720, 2), (720, 3), (100, 2)])
def test_equally_spaced_grids_have_the_number_of_points_asked_for(num, dim):
    grid = equally_spaced_grid(np.random.default_rng(0).uniform(size=(50, dim)), num, 50.0)
    spacings = [axis[1] - axis[0] for axis in grid.axes]
    assert grid.num_points == num
    assert max(spacings) < 1.5 * min(spacings)


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
    assert min_step_determinant(field, 200.0) < 0
    x, _ = carried(field, y, None, EULER, h)
    assert np.abs(carried(field, x, None, IMPLICIT_EULER, -h)[0] - y).max() < 1e-12


# ---- input that is not as it should be ----


def changed(index, positions=None, times=None):
    """Hooks of which one has other positions or times."""
    demonstrations = hooks(2)
    old = demonstrations[index]
    positions, times = (old.positions if positions is None else positions), (old.times if times is None else times)
    demonstrations[index] = Demonstration(times, positions, old.name)
    return demonstrations


def loop():
    s = np.linspace(0, 1, 200)
    return Demonstration(3 * s, 0.1 * np.stack([1 - np.cos(2 * np.pi * s), np.sin(2 * np.pi * s)], axis=1), "loop")


def eight():
    s = np.linspace(0, 1, 300)
    path = 0.1 * np.stack([np.sin(6.6 * (1 - s)), 0.5 * np.sin(13.2 * (1 - s)) + 0.3 * (1 - s)], axis=1)
    return Demonstration(3 * s, path, "eight")


def still(place=0.3):
    return Demonstration(np.linspace(0, 1, 50), np.full((50, 2), place), "still")


@pytest.mark.long
@pytest.mark.parametrize(
    ("demonstrations", "warning", "num_left", "largest_error"),
    [
        (changed(1, hooks(2)[1].positions + np.array([0.004, 0.0])), "'hook 1'.*moved", 4, 0.005),
        (changed(2, hooks(2)[2].positions + np.array([0.3, 0.0])), "'hook 2'.*left out", 3, np.inf),
        ([loop()], "'loop' starts at the goal", 1, np.inf),
        ([*hooks(2), still()], "'still' never moves", 4, np.inf),
        ([eight()], "'eight' crosses itself", 1, np.inf),
    ],
    ids=["ends nearly agree", "ends elsewhere", "starts at the goal", "never moves", "crosses itself"],
)
def test_what_is_odd_is_named_and_the_rest_is_learned(demonstrations, warning, num_left, largest_error):
    imitation = fit(demonstrations)
    assert any(re.search(warning, text) for text in imitation.warnings)
    assert len(imitation.starts) == num_left
    assert mean_error(demonstrations, imitation) < largest_error
    assert imitation.min_det_jacobian > 0


def with_nan():
    path = hooks(2)[1].positions.copy()
    path[7, 1] = np.nan
    return changed(1, path)


def apart():
    """Demonstrations that end in different places."""
    aside = [0.3 * np.array([np.cos(k), np.sin(k)]) for k in range(4)]
    return [replace(d, positions=d.positions + by) for d, by in zip(hooks(2), aside, strict=True)]


@pytest.mark.parametrize(
    ("demonstrations", "words"),
    [
        (apart(), "no common goal"),
        ([still()], "moves"),
        ([still(0.0)], "moves"),
        (with_nan(), r"'hook 1': found .* at sample 8"),
        ([], "demonstrations: found none"),
    ],
)
def test_what_cannot_be_learned_is_refused_by_name(demonstrations, words):
    with pytest.raises(ImitationError, match=words):
        fit(demonstrations)


def test_an_objective_that_there_is_not_is_refused_before_anything_is_fitted():
    with pytest.raises(ImitationError, match=r"objective: found 'nonsense'; accepted: trajectory or velocity"):
        ImitationSettings(cast(Any, "nonsense"))
