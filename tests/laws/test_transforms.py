"""Laws of transforms: what every layer does to a motion, on examples of every kind."""

from dataclasses import replace

import numpy as np
import pytest
from laws.registry import TRANSFORMS
from oracles import stepped

from dt_viz.avoidance.avoidance import ArmAvoidance  # its flow is one of joints: see tests/avoidance/test_arm.py
from dt_viz.avoidance.registry import KINDS
from dt_viz.avoidance.transform import Anchored, MotionBelow
from dt_viz.flows.diffeomorphisms import Chain, Flow, Integration, min_det_jacobian, round_trip_error
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, IMPLICIT_EULER
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem
from dt_viz.scenario.scenario import Layer, Scenario

GOAL = np.array([0.25, -0.42, 0.3])
STARTS = np.array([-0.25, -0.4, 0.32]) + np.array([[0.0, 0.0, 0.0], [0.01, 0.01, -0.01], [-0.01, 0.0, 0.01]])
TIMES = np.linspace(0, 6, 301)


def below() -> DiffeomorphicSystem:
    """A bent motion from left to right, as what was learned."""
    grid = GaussianGrid(tuple(np.linspace(c - 0.3, c + 0.3, 4) for c in (0.0, -0.42, 0.3)), 0.5 / 0.2**2)
    field = GridRBF(grid, 0.03 * np.random.default_rng(9).normal(size=(grid.num_points, 3)))
    psi = Flow(field, 1.0, 4, IMPLICIT_EULER, EULER)
    return DiffeomorphicSystem(psi, Attractor(psi.forward(GOAL), 0.15, 0.03))


def motion(positions=None, **changes) -> MotionBelow:
    """The rollouts of that system, or what became of them."""
    rollouts = below().rollout(STARTS, TIMES)
    index = np.repeat(np.arange(len(STARTS)), len(TIMES))
    samples = rollouts.reshape(-1, 3) if positions is None else positions
    return MotionBelow(STARTS, GOAL, index, samples, name="layer", tolerance=1e-8, **changes)


def test_every_kind_of_transform_has_an_example():
    assert set(KINDS) - {ArmAvoidance} == {type(transform) for transform in TRANSFORMS.values()}


@pytest.fixture(params=TRANSFORMS, name="transform")
def _transform(request):
    return TRANSFORMS[request.param]


@pytest.fixture(scope="module", name="built")
def _built():
    made = {transform: transform.build(motion()) for transform in TRANSFORMS.values()}
    return made.__getitem__


def test_what_is_built_is_a_diffeomorphism_of_the_motions_that_it_makes(transform, built):
    psi = built(transform).transform
    y = psi.inverse(motion().positions[::10])
    assert built(transform).warnings == () and not built(transform).hopeless
    assert np.linalg.norm(y - motion().positions[::10], axis=1).max() > 0.02
    assert min_det_jacobian(psi.jacobian, y) > 0
    assert round_trip_error(psi, y) < 1e-6


def test_after_it_the_motion_behaves_as_wanted(transform, built):
    made = built(transform)
    after = replace(motion(), positions=made.transform.inverse(motion().positions))
    assert transform.satisfied(after, after.positions)
    assert transform.shortfall(after, made, satisfied=True) == ()
    assert transform.satisfied(motion(), motion().positions) == (transform is TRANSFORMS["bias of a chosen strength"])


def test_the_flow_time_is_that_of_its_flows_and_as_chosen(transform, built):
    made = built(transform)
    flows = [part for part in Chain([made.transform]).parts if isinstance(part, Flow)]
    assert made.duration == pytest.approx(sum(flow.duration for flow in flows)) and made.duration > 0
    assert made.duration in made.chosen.values()


def test_the_goal_stays_or_moves_along(transform, built):
    made = built(transform)
    ends_at = transform.position if isinstance(transform, Anchored) and transform.moves_goal else None
    stays = motion().keeps_goal and ends_at is None
    expected = GOAL if stays else made.transform.inverse(GOAL)
    np.testing.assert_allclose(made.goal, expected, rtol=0, atol=1e-12)
    if ends_at is not None:
        assert np.linalg.norm(made.goal - np.array(ends_at)) < 0.01


def test_in_a_plane_nothing_leaves_it(transform, built):
    plane = getattr(transform, "plane", None)
    y = motion().positions[::5]
    moved = built(transform).transform.inverse(y) - y
    normal = np.cross(*plane) if plane else np.zeros(3)
    assert np.abs(moved @ normal).max() < 1e-12


@pytest.mark.long
def test_the_system_with_it_is_conjugate_to_the_one_without_and_its_motions_are_those_of_its_velocity(transform, built):
    psi = Chain([below().transform, built(transform).transform])
    system = DiffeomorphicSystem(psi, replace(below().base, goal=psi.forward(built(transform).goal)))
    starts, times = built(transform).transform.inverse(STARTS[:2]), np.linspace(0.0, 2.0, 3)
    exact = system.rollout(starts, times)
    np.testing.assert_allclose(stepped(system.velocity, starts, times, 10), exact, rtol=0, atol=5e-4)
    np.testing.assert_allclose(exact[:, 0], starts, rtol=0, atol=1e-6)
    end = system.rollout(starts, np.array([300.0]))[:, 0]
    np.testing.assert_allclose(end, np.broadcast_to(built(transform).goal, end.shape), rtol=0, atol=1e-6)
    assert (np.diff(system.lyapunov(exact)) < 0).all()


def test_another_attempt_needs_no_less_flow_time(transform, built):
    earlier = built(transform)
    again = transform.build(motion(earlier=earlier))
    assert again.duration >= earlier.duration - 1e-12
    moves_goal = isinstance(transform, Anchored) and transform.moves_goal
    np.testing.assert_array_equal(GOAL if moves_goal else again.goal, GOAL)


def test_other_steps_are_taken_where_they_are_chosen(transform, built):
    by_euler = replace(transform, integration=Integration("euler", 7)).build(motion())
    flows = [part for part in Chain([by_euler.transform]).parts if isinstance(part, Flow)]
    assert {(flow.method, flow.steps) for flow in flows} == {(EULER, 7)}
    assert by_euler.integration == Integration("euler", 7)


def test_switched_off_it_is_not_in_the_stack(transform):
    layer = Layer(transform, name="layer")
    assert [found.transform for _, found in Scenario("any", (layer,)).active] == [transform]
    assert Scenario("any", (replace(layer, on=False),)).active == ()
    assert replace(transform) == transform and hash(replace(transform)) == hash(transform)
