"""EFlow: an exact inverse, exact Jacobians, motions that are those of its velocity, and stability by construction."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from plans import eflow_weights as weights

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.eflow import Coupling, EFlow, EFlowSystem, Speed
from dt_viz.evaluate.held_out import frechet
from dt_viz.flows.diffeomorphisms import Chain, round_trip_error
from dt_viz.flows.systems import stepped
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


def jacobian_error(transform, points, h=1e-6):
    """Largest difference of the Jacobian from central differences."""
    _, J = transform.jacobian(points)
    columns = [(transform.forward(points + e) - transform.forward(points - e)) / (2 * h) for e in h * np.eye(3)]
    return np.abs(J - np.stack(columns, axis=-1)).max()


def test_the_round_trip_is_exact(exact, points):
    assert round_trip_error(exact.transform, points) < 1e-12
    assert np.linalg.norm(exact.transform.forward(points) - points, axis=1).max() > 0.01  # it is not the identity


def test_in_single_precision_the_round_trip_is_exact_and_points_move_by_less_than_micrometres(task, exact, points):
    single = EFlowSystem.of(task, weights(task))
    assert round_trip_error(single.transform, points) < 1e-7
    off = np.abs(single.transform.forward(points) - exact.transform.forward(points)).max()
    assert 0 < off < 5e-6


def test_jacobians_are_those_of_finite_differences(exact, points):
    assert jacobian_error(exact.transform, points) < 1e-7
    _, J = exact.transform.jacobian(points)
    _, inverse = exact.transform.inverse_jacobian(exact.transform.forward(points))
    assert np.allclose(inverse @ J, np.eye(3), atol=1e-9)
    assert (np.linalg.det(J) > 0).all()


def test_a_wrong_slope_would_be_found(exact, points):
    first, *others = exact.transform.inner.parts
    assert isinstance(first, Coupling)
    wrong = replace(exact.transform, inner=Chain([replace(first, slopes=1.01 * first.slopes), *others]))
    assert jacobian_error(wrong, points) > 1e-5


def conjugacy_error(system, starts, spacing=3e-4):
    """Largest distance, metres, of rollouts from the same motions by stepping the velocity, over half of their times.

    Towards the goal the velocity turns ever faster, so that an oracle of equal steps is none there.
    """
    paths, times = system.rollouts(starts, spacing)
    worst = 0.0
    for path, t in zip(paths, times, strict=True):
        even = np.linspace(0, 0.5 * t[-1], 11)
        oracle = stepped(system.velocity, path[:1], even, 40)[0]
        at = np.stack([np.interp(even, t, axis) for axis in path.T], axis=1)
        worst = max(worst, np.linalg.norm(oracle - at, axis=1).max())
    return worst


def test_rollouts_are_motions_of_the_velocity(task, exact):
    assert conjugacy_error(exact, task.starts[:1]) < 2e-6


def test_a_velocity_of_another_speed_would_be_found(task, exact):
    *layers, (W, c) = exact.speed.layers
    quicker = replace(exact, speed=Speed([*layers, (W, c + 0.01)]))
    mixed = SimpleNamespace(rollouts=exact.rollouts, velocity=quicker.velocity)
    assert conjugacy_error(mixed, task.starts[:1]) > 2e-4


def num_stable(system, starts):
    """Number of motions whose Lyapunov value falls all the way, and that end at the goal."""
    paths, times = system.rollouts(starts, 0.02)
    falls = [(np.diff(system.lyapunov(path)) < 0).all() for path in paths]
    ends = [np.linalg.norm(path[-1] - system.goal) < 1e-6 for path in paths]
    later = [(np.diff(t) > 0).all() for t in times]
    return int(np.logical_and.reduce([falls, ends, later]).sum())


def test_motions_from_perturbed_starts_reach_the_goal_with_a_falling_potential(task, exact):
    starts = np.resize(task.starts, (40, 3)) + 0.05 * np.random.default_rng(2).normal(size=(40, 3))
    assert num_stable(exact, starts) == 40
    along = np.linalg.norm(exact.latent_goal - exact.transform.forward(starts), axis=1)
    rates = np.einsum("nd,nd->n", exact.velocity(starts), _gradient(exact, starts))
    assert np.allclose(rates, -exact.speed(exact.normalised(starts)), rtol=1e-6)
    assert (along > 0).all()


def test_another_goal_of_the_potential_would_be_found(task, exact):
    elsewhere = replace(exact, latent_goal=exact.latent_goal + np.array([0.1, 0.0, 0.1]))
    assert num_stable(elsewhere, task.starts) < len(task.starts)


def _gradient(system, y, h=1e-6):
    """The gradient (N, 3) of the potential, by central differences."""
    return np.stack([(system.lyapunov(y + e) - system.lyapunov(y - e)) / (2 * h) for e in h * np.eye(3)], axis=1)


def test_at_the_goal_it_rests(exact):
    assert np.abs(exact.velocity(exact.goal[None])).max() == 0


def test_an_array_of_another_shape_is_refused_by_name(task):
    arrays = weights(task)
    with pytest.raises(NotFittedError, match="array 'phases'"):
        EFlowSystem.of(task, {**arrays, "phases": arrays["phases"][:, :, 1:]})
    with pytest.raises(NotFittedError, match="array 'goal': found nothing"):
        EFlowSystem.of(task, {name: array for name, array in arrays.items() if name != "goal"})


def test_numpy_computes_what_torch_is_trained_on(task, exact, points):
    torch = pytest.importorskip("torch")
    from dt_viz.baselines.eflow_training import velocity

    arrays = {name: torch.tensor(array) for name, array in weights(task).items()}
    x = exact.normalised(points)
    scale, shift = weights(task)["normalisation"]
    goal = torch.tensor(weights(task)["goal"] * scale + shift)
    found = velocity(torch.tensor(x), goal, arrays, arrays).numpy() / scale
    in_frame = exact.transform.to_frame(points)
    if in_frame.shape[1] > x.shape[1]:
        in_plane = points - np.outer(in_frame[:, 2] * task.scale, task.axes[:, 2])
    else:
        in_plane = points
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


@pytest.mark.parametrize("path", sorted((ASSETS / "baselines").glob("eflow_*.npz")), ids=lambda path: path.stem)
def test_shipped_weights_fit_their_task_reach_its_goal_and_are_small(path):
    task = TASKS[path.stem.removeprefix("eflow_")]()
    assert path.stat().st_size <= 1e6
    system = EFlow().system(task)
    paths, times = system.rollouts(task.starts, 0.012)
    assert max(np.linalg.norm(path[-1] - system.goal) for path in paths) < 1e-6
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in task.paths]
    follows = frechet(paths, task.paths).mean() < 0.1 * np.mean(lengths)
    assert follows == (task.name != "draw_8")  # which crosses itself, as no motion of one field does
    durations = [d.times[-1] - d.times[0] for d in task.demonstrations]
    assert not follows or 0.5 < np.mean([t[-1] for t in times]) / np.mean(durations) < 2


def test_weights_ship_for_every_task():
    assert {path.stem for path in (ASSETS / "baselines").glob("eflow_*.npz")} == {f"eflow_{name}" for name in TASKS}
