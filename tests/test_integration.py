"""Integrators chosen by hand: what they cost is measured and said, and nothing is said where they cost nothing."""

from dataclasses import replace

import numpy as np
import pytest
from test_stacks import random_scenario

from dt_viz.engine.frame import Stage
from dt_viz.flows.diffeomorphisms import AUTO, METHODS, AdaptiveFlow, Conjugated, Flow, Integration
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import euler, rk4
from dt_viz.motion.health import fold_doubts, integration_doubts
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.stack import AVOIDANCE, WHOLE_ARM, place_beside, with_bias_point


def field(strength=0.5):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(3)), 0.5 / 0.6**2)
    return GridRBF(grid, strength * np.random.default_rng(0).normal(size=(grid.num_points, 3)))


Y = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3))


def test_auto_leaves_a_flow_as_it_is_and_others_take_their_steps():
    for flow in (Flow(field(), 0.7, 13, sparse=True), AdaptiveFlow(field(), 0.7)):
        assert AUTO.of(flow) is flow
        assert Integration("euler", 3).of(flow) == Flow(flow.field, 0.7, 3, euler)
        assert Integration("rk4", 5).of(flow) == Flow(flow.field, 0.7, 5, rk4)


def test_names_are_those_of_the_page():
    assert [str(Integration(method, 3)) for method in METHODS] == ["auto", "RK4 in 3 steps", "Euler in 3 steps"]
    assert str(Integration("euler", 1)) == "Euler in 1 step"


@pytest.mark.parametrize("steps", [2, 6])
def test_what_euler_loses_there_and_back_is_said_in_millimetres(steps):
    chosen = Integration("euler", steps)
    flow = chosen.of(Flow(field(0.2), 1.0))
    lost = 1e3 * np.linalg.norm(flow.inverse(flow.forward(Y)) - Y, axis=1).max()
    X = flow.forward(Y)
    assert integration_doubts("It", flow, AUTO, Y, X) == ()
    (doubt,) = integration_doubts("It", flow, chosen, Y, X)
    assert doubt == f"It: Euler in {steps} steps loses {lost:.0f} mm there and back"
    (small,) = integration_doubts("It", flow, chosen, Y, X, unit=1e-3)
    assert f"{1e-3 * lost:.2g} mm" in small


def test_a_step_that_folds_is_said_and_enough_steps_are_not_doubted():
    coarse, fine = Integration("euler", 1), Integration("rk4", 50)
    folding, exact = coarse.of(Flow(field(8.0), 1.0)), fine.of(Flow(field(), 1.0))
    (doubt,) = integration_doubts("It", folding, coarse, folding.inverse(Y), Y)  # one cause is said once
    assert "a step of Euler in 1 step folds space (det -" in doubt
    assert integration_doubts("It", exact, fine, exact.inverse(Y), Y) == ()


def test_a_fold_of_what_is_drawn_is_found_where_there_is_none_on_the_way_back():
    """A coarse ψ leads drawn samples elsewhere: there ψ⁻¹ may be as it should."""
    coarse = Integration("euler", 1)
    flow = coarse.of(Flow(field(2.0), 1.0))
    x = np.random.default_rng(2).uniform(-0.8, 0.8, (4000, 3))
    y, drawn = flow.inverse_jacobian(x)
    back, forward = flow.jacobian(y)
    elsewhere = flow.inverse_jacobian(back)[1]
    sound = (np.linalg.det(forward) > 0) & (np.linalg.det(elsewhere) > 0)
    folded = np.linalg.det(drawn) <= 0
    missed, fine = sound & folded, sound & ~folded
    assert missed.sum() > 5 and fine.sum() > 5
    for row in np.flatnonzero(missed)[:5]:
        (doubt,) = fold_doubts("It", flow, coarse, y[[row]], x[[row]])
        assert f"(det {np.linalg.det(drawn[row]):.2g})" in doubt
    assert fold_doubts("It", flow, coarse, y[fine], x[fine]) == ()
    by = Flow(field(0.2), 1.0, 20)  # the same in other coordinates
    conjugated = Conjugated(flow, by)
    assert fold_doubts("It", conjugated, coarse, by.inverse(y[missed]), by.inverse(x[missed]))
    assert fold_doubts("It", conjugated, coarse, by.inverse(y[fine]), by.inverse(x[fine])) == ()


def certified(engine, scenario):
    """The live doubts and the last frame."""
    frames = list(engine.frames(scenario))
    live = next(frame for frame in frames if frame.stage is Stage.LIVE)
    return live.health.doubts, frames[-1]


@pytest.mark.parametrize(("duration", "folds"), [(None, True), (0.1, False)])
def test_euler_in_few_steps_is_doubted_while_the_hand_moves_and_certificates_agree(engine, initial, duration, folds):
    scenario = replace(initial("draw_s"), integration=Integration("euler", 3), duration=duration)
    live, last = certified(engine, scenario)
    assert any(f"{AVOIDANCE}: a step of Euler in 3 steps folds space" in doubt for doubt in live) == folds
    assert (last.health.min_det_jacobian < 0) == folds
    assert any("loses" in doubt and "mm there and back" in doubt for doubt in live)
    assert last.health.round_trip_error > 1e-3
    assert sum(doubt.startswith(AVOIDANCE) for doubt in last.health.doubts) == 1
    if folds:
        assert last.health.lyapunov_falls is False and not any("Lyapunov" in doubt for doubt in last.health.doubts)
    for words in ("folds", "there and back"):  # a certificate does not repeat what has a cause
        assert sum(words in doubt for doubt in last.health.doubts) == sum(words in doubt for doubt in live)
    assert not any("no way to the goal" in doubt for doubt in last.health.doubts)


def test_a_fold_of_what_is_drawn_is_said_and_certified(engine):
    """Here ψ keeps its orientation along the rollouts, and ψ⁻¹, which draws them, does not."""
    scenario = replace(random_scenario(engine, 300), integration=Integration("euler", 1))
    live, last = certified(engine, scenario)
    assert any(f"{AVOIDANCE}: a step of Euler in 1 step folds space" in doubt for doubt in live)
    assert last.health.min_det_jacobian < 0
    assert sum("folds" in doubt for doubt in last.health.doubts) == 1


def test_rk4_with_many_steps_of_a_mild_flow_is_as_good_as_auto(engine, initial):
    scenario = initial("push_box")
    live, last = certified(engine, replace(scenario, integration=Integration("rk4", 20)))
    *_, exact = engine.frames(scenario)
    assert live == last.health.doubts == ()
    assert last.health.min_det_jacobian == pytest.approx(exact.health.min_det_jacobian, rel=1e-2)
    assert last.health.clearance == pytest.approx(exact.health.clearance, abs=1e-4)


@pytest.mark.parametrize(("strength", "folds"), [(2.5, True), (0.1, False)])
def test_a_bias_point_has_an_integrator_of_its_own(engine, strength, folds):
    plain = Scenario("draw_s", ())
    point = replace(place_beside(engine.task("draw_s"), plain), strength=strength)
    exact = replace(plain, layers=with_bias_point((), point))
    coarse = replace(plain, layers=with_bias_point((), replace(point, integration=Integration("euler", 1))))
    assert certified(engine, exact)[0] == ()
    live, last = certified(engine, coarse)
    assert any("Bias 1: a step of Euler in 1 step folds space" in doubt for doubt in live) == folds
    assert any("Bias 1: " in doubt and "loses" in doubt for doubt in live)
    assert last.health.round_trip_error > 1e-4


def test_the_whole_arm_says_what_euler_loses(engine, initial):
    scenario = replace(initial("push_box"), space="cspace")
    live, last = certified(engine, replace(scenario, integration=Integration("euler", 2)))
    assert any(f"{WHOLE_ARM}: Euler in 2 steps loses" in doubt for doubt in live)
    assert last.health.round_trip_error > 1e-3


@pytest.mark.parametrize(("steps", "folds"), [(1, True), (8, False)])
def test_certificates_find_folds_of_the_whole_arm(engine, initial, steps, folds):
    scenario = replace(initial("push_box"), space="cspace", temperature=3.0, integration=Integration("euler", steps))
    live, last = certified(engine, scenario)
    assert not any("folds" in doubt for doubt in live)  # too slow to be looked for while the hand moves
    assert any(f"{WHOLE_ARM}: a step of Euler" in doubt and "folds" in doubt for doubt in last.health.doubts) == folds
    assert (last.health.min_det_jacobian < 0) == folds


def test_a_place_that_auto_would_choose_for_is_not_searched_for_without_end(engine, initial):
    """More time does not mend what coarse steps spoil: the duration is that of the exact flow."""
    scenario = initial("push_box")
    exact = next(engine.frames(scenario)).health.duration
    coarse = next(engine.frames(replace(scenario, integration=Integration("euler", 1)))).health.duration
    assert coarse == pytest.approx(exact, rel=0.05)
