"""The initial guess of a fit: motions are unbent, or sheared where they wind around an axis."""

from itertools import pairwise

import numpy as np
import pytest
from drawings import extent, frechet

from dt_viz.learning import initial_guess as module
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.imitation import fit
from dt_viz.learning.initial_guess import unbending
from dt_viz.learning.preparation import prepare
from dt_viz.metrics import resample_by_arc_length
from dt_viz.scenario.tasks import TASKS


def helix(turns, num=3, pitch=0.25, seed=0):
    """Upright helices 16 cm wide, each a little different."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, 200)
    angle = 2 * np.pi * turns * s
    path = np.column_stack([0.08 * np.cos(angle), 0.08 * np.sin(angle), pitch * s])
    return [Demonstration(4 * s, path + 0.01 * rng.normal(size=3) * (1 - s)[:, None], f"helix {k}") for k in range(num)]


def drawing(seed, dim):
    """A smooth random motion, as a hand draws it: turns add up to half a turn to both sides."""
    rng = np.random.default_rng(seed)
    s = np.linspace(0, 1, 200)
    wave = [np.sin(np.pi * rng.uniform(0.5, 1.5) * s + rng.uniform(0, 6)) for _ in range(dim)]
    path = np.column_stack(wave) * rng.uniform(0.3, 1.0, dim)
    return [Demonstration(s, path * (1 + 0.05 * k), f"drawing {k}") for k in range(3)]


def guess(demonstrations):
    """The shapes of the initial guess."""
    motions = prepare(demonstrations)
    points = motions.resampled(60)
    return unbending((points - points.mean(axis=(0, 1))) / motions.spread, 2, 3.2, 9)


def without_shear(demonstrations, monkeypatch):
    """The same without a shear."""
    with monkeypatch.context() as patch:
        patch.setattr(module, "_axis", lambda _mean: None)
        return guess(demonstrations)


def same(one, other):
    return len(one) == len(other) and all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


@pytest.mark.long
@pytest.mark.parametrize("turns", [2, 3])
def test_what_winds_is_followed_on_a_map_that_does_not_fold(turns):
    demonstrations = helix(turns)
    imitation = fit(demonstrations)
    assert imitation.min_det_jacobian > 0 and imitation.round_trip_error < 1e-12
    for d in demonstrations:
        path = imitation.system.rollout(d.positions[0], np.linspace(0, 8, 1000))
        assert frechet(path, d.positions) < 0.04 * extent(demonstrations)


MANY = {
    "shipped": lambda: [make().demonstrations for make in TASKS.values()],
    "drawings in the plane": lambda: [drawing(seed, 2) for seed in range(30)],
    "drawings in space": lambda: [drawing(seed, 3) for seed in range(30)],
}


@pytest.mark.long
@pytest.mark.parametrize("many", MANY)
def test_shipped_demonstrations_and_drawings_are_unbent(many, monkeypatch):
    for demonstrations in MANY[many]():
        assert same(guess(demonstrations), without_shear(demonstrations, monkeypatch)), demonstrations[0].name


def test_nothing_in_the_plane_is_sheared():
    """What always advances along an axis of the plane turns less than half a turn."""
    s = np.linspace(0, 1, 60)
    for turns in np.linspace(0.5, 5, 19):
        for drift in (0.1, 1.0, 4.0):
            angle = 2 * np.pi * turns * s
            cycloid = np.column_stack([np.sin(angle) + drift * angle, np.cos(angle)])
            assert module._axis(cycloid) is None


def test_what_turns_too_little_or_comes_back_is_not_sheared():
    sheared = [turns for turns in np.arange(0.25, 4.1, 0.25) if module._axis(mean_of(helix(turns))) is not None]
    assert sheared == list(np.arange(min(sheared), 4.1, 0.25)) and 1 < min(sheared) <= 1.5
    there_and_back = mean_of(helix(3))
    there_and_back = np.concatenate([there_and_back[::2], there_and_back[::-2]])
    assert module._axis(there_and_back) is None


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("sides", [[1], [1, -1]])
def test_unbending_ends_in_the_motions_and_begins_with_straight_rays(dim, sides):
    one = np.stack([resample_by_arc_length(d.positions - d.positions[-1], 40) for d in drawing(0, dim)])
    motions = np.concatenate([side * one for side in sides])
    shapes = np.stack(unbending(motions, 2, 3.0, 8))
    np.testing.assert_allclose(shapes[-1], motions, atol=1e-9)
    np.testing.assert_allclose(shapes[:, :, -1], 0, atol=1e-9)
    np.testing.assert_allclose(shapes[0], np.linspace(1, 0, 40)[:, None] * shapes[0, :, :1], atol=1e-9)
    assert np.linalg.norm(shapes[0, :, 0], axis=1).min() > 0.1


@pytest.mark.parametrize("turns", [2, 3])
def test_a_shear_begins_with_straight_rays_moves_little_and_ends_in_the_motions(turns, monkeypatch):
    shapes, unbent = guess(helix(turns)), without_shear(helix(turns), monkeypatch)
    assert not same(shapes, unbent)
    np.testing.assert_allclose(shapes[-1], unbent[-1], atol=1e-12)
    straight = shapes[1].mean(axis=0) - shapes[1].mean(axis=0)[-1]
    assert np.linalg.svd(straight)[1][1] < 1e-9  # the mean lies on a line
    travelled = [max(np.linalg.norm(b - a, axis=-1).max() for a, b in pairwise(s)) for s in (shapes, unbent)]
    assert travelled[0] < travelled[1] / 2


def mean_of(demonstrations):
    """(60, d)."""
    return np.mean([resample_by_arc_length(d.positions, 60) for d in demonstrations], axis=0)
