"""Occupancy maps against the shapes they were learned from, and flows out of what is occupied."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from oracles import central_differences
from scipy.special import expit

from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.obstacles.occupancy import GENERATORS, AvoidanceField, fit_occupancy, sample_labels, unit_map
from dt_viz.obstacles.shapes import ORIGIN, Sphere, as_point
from dt_viz.obstacles.union import Union

seeds = st.integers(0, 2**32 - 1)
BALL = unit_map(Sphere(ORIGIN, 2.0))


def directions(num, dim=3, seed=0):
    v = np.random.default_rng(seed).normal(size=(num, dim))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


def in_ball(num, radius=1.0, seed=0):
    """Uniform points of a ball, the very middle left out: there a symmetric field has to vanish."""
    share = np.random.default_rng(seed).uniform(0.05**3, 1, (num, 1)) ** (1 / 3)
    return radius * share * directions(num, seed=seed + 1)


def test_the_probability_is_that_of_the_logit_which_is_a_sum_of_gaussians():
    s = in_ball(50, 2.0)
    np.testing.assert_allclose(BALL.logit(s), BALL.grid.features(s) @ BALL.weights + BALL.bias, rtol=0, atol=1e-12)
    np.testing.assert_allclose(BALL.probability(s), 1 / (1 + np.exp(-BALL.logit(s))), rtol=1e-12)


@pytest.mark.parametrize("generator", GENERATORS)
@pytest.mark.parametrize("temperature", [1.0, 3.0, 12.0])
def test_the_generator_is_the_gradient_of_its_potential(generator, temperature):
    V = AvoidanceField(BALL, generator, temperature)
    width_squared = 0.5 / BALL.grid.ell
    s = in_ball(40, 2.0)

    def potential(points):
        if generator == "probability":
            return BALL.probability(points)
        logit = np.maximum(BALL.logit(points), BALL.bias)  # constant where the map knows of nothing
        return temperature * np.logaddexp(0, logit / temperature) - logit * expit(BALL.bias / temperature)

    np.testing.assert_allclose(V(s), width_squared * central_differences(potential, s, 1e-4), rtol=0, atol=1e-8)
    DV = V.with_jacobian(s)[1]
    np.testing.assert_allclose(DV, DV.transpose(0, 2, 1), rtol=0, atol=1e-12)


@pytest.mark.parametrize("generator", GENERATORS)
@pytest.mark.parametrize("temperature", [1.0, 6.0, 20.0])
def test_the_generator_ends_and_leaves_what_is_far_away_where_it_is(generator, temperature):
    V = AvoidanceField(BALL, generator, temperature)
    assert np.linalg.norm(V(12.0 * directions(60)), axis=1).max() < 1e-12
    assert np.linalg.norm(V(5.0 * directions(60)), axis=1).max() < 1e-4
    assert np.linalg.norm(V(directions(60)), axis=1).min() > 0.1


def test_at_temperature_one_the_generator_is_free_space_but_for_the_chance_of_meeting_something_far_away():
    s = in_ball(40, 1.5)
    gradient = central_differences(lambda points: -np.log1p(-BALL.probability(points)), s, 1e-4)
    expected = 0.5 / BALL.grid.ell * gradient
    far = expit(BALL.bias) * 0.5 / BALL.grid.ell * central_differences(BALL.logit, s, 1e-4)
    np.testing.assert_allclose(AvoidanceField(BALL, temperature=1.0)(s), expected - far, rtol=0, atol=1e-6)
    assert expit(BALL.bias) < 1e-3


def test_the_learned_boundary_is_near_the_true_one():
    for direction in directions(30):
        radii = np.linspace(0, 2, 401)
        occupied = BALL.logit(radii[:, None] * direction) > 0
        assert occupied[0] and np.diff(occupied.astype(int)).sum() == -1  # one crossing, outwards
        assert radii[occupied][-1] == pytest.approx(1, abs=0.06)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_box_is_learned_from_its_labels(dim):
    half = np.array([1.0, 0.5, 0.7][:dim])

    def labelled(num, seed):
        in_box = lambda s: np.all(np.abs(s) < half, axis=1)  # noqa: E731
        return sample_labels(in_box, -half, half, num, np.random.default_rng(seed))

    learned = fit_occupancy(*labelled(3000, 0), 0.4, regularisation=1.0)
    fresh, truth = labelled(2000, 99)
    wrong = (learned.logit(fresh) > 0) != (truth > 0.5)
    assert wrong.mean() < 0.06
    # what is wrong is close to the boundary, or in a corner that a Gaussian rounds
    outside = np.abs(fresh[wrong]) - half
    assert np.abs(outside.max(axis=1)).max() < 0.25


@given(seeds)
def test_the_fit_is_the_maximum_of_its_penalised_likelihood(seed):
    """Convex: a zero gradient is the only optimum."""
    rng = np.random.default_rng(seed)
    samples = rng.uniform(-2, 2, (300, 2))
    labels = (np.linalg.norm(samples - rng.normal(size=2) * 0.3, axis=1) < 1).astype(float)
    learned = fit_occupancy(samples, labels, 0.7, regularisation=0.5)
    residual = labels - learned.probability(samples)
    gradient = learned.grid.features(samples).T @ residual - 0.5 * learned.weights
    assert np.abs(gradient).max() < 1e-5
    assert residual.sum() - 1e-3 * learned.bias == pytest.approx(0, abs=1e-5)


@pytest.mark.parametrize(("label", "word"), [(0.0, "free"), (1.0, "occupied")])
def test_labels_of_one_kind_are_refused(label, word):
    with pytest.raises(ValueError, match=f"all 50 samples are {word}"):
        fit_occupancy(np.random.default_rng(0).normal(size=(50, 3)), np.full(50, label), 0.5)


def test_samples_lie_in_the_grown_box_and_half_of_them_close_to_the_shape():
    lower, upper = np.array([0.0, 1.0]), np.array([1.0, 3.0])
    samples, labels = sample_labels(lambda s: np.asarray(s[:, 0] > 0.5), lower, upper, 1000, np.random.default_rng(0))
    offset = np.abs(samples - (lower + upper) / 2) / ((upper - lower) / 2)
    assert samples.shape == (1000, 2)
    assert offset.max() <= 3.0
    assert (offset.max(axis=1) <= 1.25).mean() > 0.5
    np.testing.assert_array_equal(labels, samples[:, 0] > 0.5)


@pytest.mark.parametrize("generator", GENERATORS)
def test_occupancy_never_rises_along_the_reverse_flow(generator):
    V = AvoidanceField(BALL, generator)
    s = in_ball(200, 1.5)
    logits = [BALL.logit(s)]
    for _ in range(20):
        s = Flow.adaptive(V, 0.1, 1e-7).inverse(s)
        logits.append(BALL.logit(s))
    assert np.diff(logits, axis=0).max() <= 1e-9
    assert np.diff(logits, axis=0).min() < -0.1


@given(seeds, st.floats(0.04, 0.3), st.sampled_from(GENERATORS))
def test_a_moved_and_grown_sphere_has_the_moved_and_grown_field(seed, diameter, generator):
    rng = np.random.default_rng(seed)
    x, y, z = (float(c) for c in rng.normal(size=3))
    local = rng.uniform(-1.5, 1.5, (20, 3))
    field = Sphere((x, y, z), diameter).field(generator, 6.0)
    expected = diameter / 2 * AvoidanceField(BALL, generator, 6.0)(local)
    np.testing.assert_allclose(field(np.array([x, y, z]) + diameter / 2 * local), expected, rtol=0, atol=1e-12)


# unions beside the laws (tests/laws)


@pytest.mark.long
@given(st.integers(0, 2**32 - 1), st.integers(2, 4))
def test_it_is_moved_hardly_farther_than_to_the_nearest_place(seed, num):
    """Also where two spheres hardly overlap, and where leaving one leads deeper into the next."""
    rng = np.random.default_rng(seed)
    spheres = [Sphere(as_point(rng.normal(0, 0.05, 3)), float(rng.uniform(0.08, 0.2))) for _ in range(num)]
    together, directions = Union(tuple(spheres)), rng.normal(size=(3000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    surfaces = np.concatenate([sphere.position + sphere.radius * directions for sphere in spheres])
    surface = surfaces[together.signed_distance(surfaces) >= -1e-6]
    points = rng.normal(0, 0.05, (50, 3))
    points = points[together.signed_distance(points) < 0]
    free = together.nearest_free(points)
    assert (together.signed_distance(free) >= -1e-6).all()
    moved = np.linalg.norm(free - points, axis=1)
    nearest = np.linalg.norm(surface - points[:, None], axis=-1).min(axis=1)
    assert (moved < 1.1 * nearest + 0.002).all()
