"""EFlow beside the laws of its layers (tests/laws): motions that are those of its velocity, stable by construction."""

import numpy as np
import pytest
from oracles import central_differences, stepped
from plans import eflow_weights as weights

from dt_viz.baselines.eflow import EFlowSystem, load_system
from dt_viz.evaluate.held_out import frechet
from dt_viz.flows.diffeomorphisms import round_trip_error
from dt_viz.scenario.tasks import TASKS
from dt_viz.shipped import ASSETS

NAMES = ("draw_s", "push_box")


@pytest.fixture(params=NAMES)
def task(request):
    return TASKS[request.param]()


@pytest.fixture
def exact(task):
    """A system whose cosines are in double precision."""
    return EFlowSystem.of(task, weights(task), np.float64)


@pytest.fixture
def points(task):
    rng = np.random.default_rng(1)
    return np.concatenate(task.paths)[::20] + rng.normal(size=3) * 0.03


def test_in_single_precision_the_round_trip_is_exact_and_points_move_by_less_than_micrometres(task, exact, points):
    single = EFlowSystem.of(task, weights(task))
    assert round_trip_error(single.transform, points) < 1e-7
    off = np.abs(single.transform.forward(points) - exact.transform.forward(points)).max()
    assert 0 < off < 5e-6
    assert np.linalg.norm(exact.transform.forward(points) - points, axis=1).max() > 0.01  # it is not the identity


@pytest.mark.long
def test_rollouts_are_motions_of_the_velocity_until_it_turns_fast_near_the_goal(task, exact):
    (path,), (times,) = exact.rollouts(task.starts[:1], 3e-4)
    even = np.linspace(0, 0.5 * times[-1], 11)
    at = np.stack([np.interp(even, times, axis) for axis in path.T], axis=1)
    np.testing.assert_allclose(stepped(exact.velocity, path[:1], even, 40)[0], at, rtol=0, atol=2e-6)


def test_motions_from_perturbed_starts_reach_the_goal_and_rest_while_the_potential_falls_at_the_speed(task, exact):
    def potential(y):
        return np.linalg.norm(exact.transform.forward(y) - exact.latent_goal, axis=-1) / exact.scale

    starts = np.resize(task.starts, (40, 3)) + 0.05 * np.random.default_rng(2).normal(size=(40, 3))
    for path, times in zip(*exact.rollouts(starts, 0.02), strict=True):
        assert (np.diff(potential(path)) < 0).all() and (np.diff(times) > 0).all()
        np.testing.assert_allclose(path[-1], exact.goal, rtol=0, atol=1e-6)
    rates = np.einsum("nd,nd->n", exact.velocity(starts), central_differences(potential, starts, 1e-5))
    np.testing.assert_allclose(rates, -exact.speed(exact.normalised(starts)), rtol=1e-6)
    np.testing.assert_array_equal(exact.velocity(exact.goal[None]), 0)


def test_numpy_computes_what_torch_is_trained_on(task, exact, points):
    torch = pytest.importorskip("torch")
    from dt_viz.baselines.eflow_training import velocity

    arrays = {name: torch.tensor(array) for name, array in weights(task).items()}
    x = exact.normalised(points)
    scale, shift = weights(task)["normalisation"]
    goal = torch.tensor(weights(task)["goal"] * scale + shift)
    found = velocity(torch.tensor(x), goal, arrays, arrays).numpy() / scale
    off_plane = exact.transform.to_frame(points)[:, x.shape[1] :]
    in_plane = points - task.scale * off_plane @ task.axes[:, x.shape[1] :].T
    expected = exact.velocity(in_plane) @ task.axes / task.scale
    assert np.allclose(found, expected[:, : x.shape[1]], rtol=1e-9, atol=1e-12)
    assert np.abs(found).max() > 0.01


def test_the_gradient_that_training_follows_is_that_of_finite_differences(task):
    torch = pytest.importorskip("torch")
    from dt_viz.baselines.eflow_training import velocity

    arrays = {name: torch.tensor(array) for name, array in weights(task).items()}
    w, rng = arrays["weights"], np.random.default_rng(3)
    dim = task.demonstrations[0].dimension
    x, goal = torch.tensor(rng.uniform(-0.5, 0.5, (20, dim))), torch.zeros(dim, dtype=w.dtype)
    along, h = torch.tensor(rng.normal(size=w.shape)), 1e-6

    def size(weights):
        return velocity(x, goal, arrays, {**arrays, "weights": weights}).square().sum()

    (gradient,) = torch.autograd.grad(size(w.requires_grad_()), w)
    with torch.no_grad():
        slope = (size(w + h * along) - size(w - h * along)).item() / (2 * h)
    assert (gradient * along).sum().item() == pytest.approx(slope, rel=1e-5)


@pytest.mark.parametrize("name", TASKS)
def test_shipped_weights_fit_their_task_reach_its_goal_and_are_small(name):
    task, system = TASKS[name](), load_system(TASKS[name]())
    assert (ASSETS / "baselines" / f"eflow_{name}.npz").stat().st_size <= 1e6
    paths, times = system.rollouts(task.starts, 0.012)
    assert max(np.linalg.norm(path[-1] - system.goal) for path in paths) < 1e-6
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in task.paths]
    follows = frechet(paths, task.paths).mean() < 0.1 * np.mean(lengths)
    assert follows == (name != "draw_8")  # which crosses itself, as no motion of one field does
    durations = [d.times[-1] - d.times[0] for d in task.demonstrations]
    assert not follows or 0.5 < np.mean([t[-1] for t in times]) / np.mean(durations) < 2
