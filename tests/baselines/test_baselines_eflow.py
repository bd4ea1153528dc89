"""EFlow beside the laws of its layers (tests/laws): stable by construction, and with a repulsion within its range."""

import numpy as np
import pytest
from oracles import central_differences, stepped
from plans import eflow_weights as weights

from dt_viz.baselines import repulsive
from dt_viz.baselines.eflow import EFlowSystem, load_system
from dt_viz.baselines.repulsive import plan, repulsion
from dt_viz.evaluate.held_out import frechet
from dt_viz.flows.diffeomorphisms import round_trip_error
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.obstacles.union import Union
from dt_viz.scenario.tasks import TASKS

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
        return np.linalg.norm(exact.transform.forward(y) - exact.latent_goal, axis=-1)

    starts = np.resize(task.starts, (40, 3)) + 0.05 * np.random.default_rng(2).normal(size=(40, 3))
    for path, times in zip(*exact.rollouts(starts, 0.02), strict=True):
        assert (np.diff(potential(path)) < 0).all() and (np.diff(times) > 0).all()
        np.testing.assert_allclose(path[-1], exact.goal, rtol=0, atol=1e-6)
    rates = np.einsum("nd,nd->n", exact.velocity(starts), central_differences(potential, starts, 1e-5))
    np.testing.assert_allclose(rates, -exact.speed(starts), rtol=1e-6)
    np.testing.assert_array_equal(exact.velocity(exact.goal[None]), 0)


def test_numpy_computes_what_torch_is_trained_on(task, exact, points):
    torch = pytest.importorskip("torch")
    from assets.eflow_training import velocity

    arrays = {name: torch.tensor(array) for name, array in weights(task).items()}
    scale, shift = weights(task)["normalisation"]
    x = exact.transform.to_frame(points)[:, : len(scale)] * scale + shift
    goal = torch.tensor(weights(task)["goal"] * scale + shift)
    found = velocity(torch.tensor(x), goal, arrays, arrays).numpy() / scale
    off_plane = exact.transform.to_frame(points)[:, x.shape[1] :]
    in_plane = points - task.scale * off_plane @ task.axes[:, x.shape[1] :].T
    expected = exact.velocity(in_plane) @ task.axes / task.scale
    assert np.allclose(found, expected[:, : x.shape[1]], rtol=1e-9, atol=1e-12)
    assert np.abs(found).max() > 0.01


@pytest.mark.parametrize("name", TASKS)
def test_shipped_weights_fit_their_task_and_reach_its_goal(name):
    task, system = TASKS[name](), load_system(TASKS[name]())
    paths, times = system.rollouts(task.starts, 0.012)
    assert max(np.linalg.norm(path[-1] - system.goal) for path in paths) < 1e-6
    lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in task.paths]
    follows = frechet(paths, task.paths).mean() < 0.1 * np.mean(lengths)
    assert follows == (name != "draw_8")  # which crosses itself, as no motion of one field does
    durations = [d.times[-1] - d.times[0] for d in task.demonstrations]
    assert not follows or 0.5 < np.mean([t[-1] for t in times]) / np.mean(durations) < 2


# with a repulsion


SPHERE = Union((Sphere((0.1, -0.5, 0.3), 0.15),))


def at_distances(distances):
    """Points (N, 3) at these distances from the sphere, in the direction x."""
    return np.array(SPHERE.parts[0].position) + np.outer(0.075 + np.array(distances), [1.0, 0.0, 0.0])


def test_the_repulsion_is_the_gradient_of_its_potential_up_to_a_bound_ends_at_its_range_and_leads_away_inside():
    def potential(y):
        return 0.5 * repulsive.GAIN * (1 / SPHERE.signed_distance(y) - 1 / repulsive.RANGE) ** 2

    near = at_distances(np.array([0.9, 0.7, 0.5, 0.3]) * repulsive.RANGE)
    expected = -central_differences(potential, near, 1e-5)
    np.testing.assert_allclose(repulsion(SPHERE, near)[1], expected, rtol=1e-4, atol=1e-9)
    distance, velocity = repulsion(SPHERE, at_distances([repulsive.RANGE + 1e-9, 2 * repulsive.RANGE, 1.0]))
    np.testing.assert_allclose(distance, [repulsive.RANGE, 2 * repulsive.RANGE, 1.0])
    assert not velocity.any()
    np.testing.assert_allclose(repulsion(SPHERE, at_distances([-0.01, -0.05]))[1], [[repulsive.STRONGEST, 0, 0]] * 2)


@pytest.fixture
def push():
    return TASKS["push_box"]()


@pytest.fixture
def system(push):
    arrays = weights(push, amplitude=0.003)
    arrays["speed_2"][:, -1] -= 1.5  # as slow as a demonstration
    return EFlowSystem.of(push, arrays)


def test_motions_that_stay_out_of_range_are_those_of_eflow(push, system):
    far = Union((Sphere((0.0, 0.0, 3.0), 0.15),))
    paths, times = system.rollouts(push.starts, LIVE.spacing)
    found = plan(system, far, push.starts)
    assert all(np.array_equal(a, b) for a, b in zip((*found.paths, *found.times), (*paths, *times), strict=True))


@pytest.fixture
def beside(system, push):
    """An obstacle beside the first motion."""
    (path,), _ = system.rollouts(push.starts[:1], 0.012)
    return Union((Sphere(as_point(path[len(path) // 2] + [0.0, 0.03, 0.03]), 0.06),))


def test_steps_follow_the_sum_of_both_velocities_and_eflow_goes_on_after_them(push, system, beside):
    found = plan(system, beside, push.starts[:1])
    path, times = found.paths[0], found.times[0]
    assert (np.diff(times) > 0).all()
    stepped = np.flatnonzero(np.isclose(np.diff(times), 0.05, rtol=0, atol=1e-12))
    assert len(stepped) > 10
    alone, pushed = system.velocity(path[stepped]), repulsion(beside, path[stepped])[1]
    np.testing.assert_allclose(path[stepped + 1], path[stepped] + 0.05 * (alone + pushed), atol=1e-6)
    assert np.abs(0.05 * pushed).max() > 1e-4
    assert np.linalg.norm(path[-1] - system.goal) < 1e-6


def test_before_an_obstacle_on_the_goal_a_motion_stops(push, system):
    found = plan(system, Union((Sphere(as_point(system.goal), 0.1),)), push.starts[:2])
    assert all(0.02 < np.linalg.norm(path[-1] - system.goal) < 0.2 for path in found.paths)
    assert max(t[-1] for t in found.times) < repulsive.LONGEST + 60
