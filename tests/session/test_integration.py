"""Integrators chosen by hand: what they cost is measured and said, and nothing is said where they cost nothing."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from scenes import avoiding, biases, changed, random_scenario

from dt_viz.avoidance.registry import AVOIDANCE, bias_beside
from dt_viz.flows.diffeomorphisms import AUTO, Chain, Conjugated, Flow, Integration
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.flows.integrators import EULER, RK4
from dt_viz.motion.diagnostics import fold_warnings, integration_warnings
from dt_viz.scenario.stack import WHOLE_ARM, surroundings
from dt_viz.session.frame import Stage
from dt_viz.warning import ARM, Kind, MotionWarning


def field(strength=0.5):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(3)), 0.5 / 0.6**2)
    return GridRBF(grid, strength * np.random.default_rng(0).normal(size=(grid.num_points, 3)))


Y = np.random.default_rng(1).uniform(-0.8, 0.8, (200, 3))


def test_auto_leaves_a_flow_as_it_is_and_others_take_their_steps():
    for flow in (Flow(field(), 0.7, 13), Flow.adaptive(field(), 0.7)):
        assert AUTO.of(flow) is flow
        assert Integration("euler", 3).of(flow) == Flow(flow.field, 0.7, 3, EULER)
        assert Integration("rk4", 5).of(flow) == Flow(flow.field, 0.7, 5, RK4)


@pytest.mark.parametrize("steps", [2, 6])
def test_what_euler_loses_there_and_back_is_said_in_millimetres(steps):
    chosen = Integration("euler", steps)
    flow = chosen.of(Flow(field(0.2), 1.0))
    lost = 1e3 * np.linalg.norm(flow.inverse(flow.forward(Y)) - Y, axis=1).max()
    X = flow.forward(Y)
    assert integration_warnings("It", flow, AUTO, Y, X) == ()
    text = f"It: Euler in {steps} steps loses {lost:.0f} mm in a round trip"
    assert integration_warnings("It", flow, chosen, Y, X) == (MotionWarning(Kind.INEXACT_INVERSE, text, "It"),)
    (small,) = integration_warnings("It", flow, chosen, Y, X, unit=1e-3)
    assert f"{1e-3 * lost:.2g} mm" in small.text


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
        (folds,) = fold_warnings("It", flow, coarse, y[[row]], x[[row]])
        assert f"(det {np.linalg.det(drawn[row]):.2g})" in folds.text
    assert fold_warnings("It", flow, coarse, y[fine], x[fine]) == ()
    by = Flow(field(0.2), 1.0, 20)  # the same in other coordinates
    conjugated = Conjugated(flow, by)
    assert fold_warnings("It", conjugated, coarse, by.inverse(y[missed]), by.inverse(x[missed]))
    assert fold_warnings("It", conjugated, coarse, by.inverse(y[fine]), by.inverse(x[fine])) == ()
    inner, outer = Flow.adaptive(field(0.3), 1.0), Flow.adaptive(field(0.25), -1.0)  # and in a chain with others
    chain, ends = Chain([inner, flow, outer]), (outer.inverse(y), inner.forward(x))
    assert fold_warnings("It", chain, coarse, ends[0][missed], ends[1][missed])
    assert fold_warnings("It", chain, coarse, ends[0][fine], ends[1][fine]) == ()
    unasked = Mock(dim=3, side_effect=AssertionError)  # the field of a flow without equal steps
    assert fold_warnings("It", Flow.adaptive(unasked, 1.0), coarse, y, x) == ()


def certified(engine, scenario):
    """The live certificates and those of the last frame."""
    frames = list(engine.frames(scenario))
    live = next(frame for frame in frames if frame.stage is Stage.LIVE)
    return live.certificates, frames[-1].certificates


def of_kind(certificates, *kinds):
    """The warnings of these kinds that are told, with whom they are about."""
    return [(warning.kind, warning.source) for warning in certificates.warnings if warning.kind in kinds]


@pytest.mark.parametrize(("duration", "folds"), [(None, True), (0.1, False)])
def test_euler_in_few_steps_is_warned_of_during_a_drag_and_certificates_agree(engine, initial, duration, folds):
    coarse = {"integration": Integration("euler", 3), "generator": "probability", "duration": duration}
    scenario = changed(initial("draw_s"), **coarse)
    live, last = certified(engine, scenario)
    kinds = [Kind.FOLDS, Kind.INEXACT_INVERSE] if folds else [Kind.INEXACT_INVERSE]
    expected = [(kind, AVOIDANCE.title) for kind in kinds]
    assert (last.min_det_jacobian < 0) == folds
    assert last.round_trip_error > 1e-3
    if folds:
        assert last.lyapunov_falls is False
    # a certificate does not repeat what has a cause
    consequences = Kind.NO_DIFFEOMORPHISM, Kind.ROUND_TRIP, Kind.NOT_FALLING
    for certificates in (live, last):
        assert of_kind(certificates, Kind.FOLDS, Kind.INEXACT_INVERSE, *consequences) == expected
    assert {warning.kind for warning in last.found} >= {Kind.ROUND_TRIP}  # it was found, though
    assert not any("no way to the goal" in warning.text for warning in last.warnings)


def test_a_fold_of_what_is_drawn_is_said_and_certified(engine):
    """Here ψ keeps its orientation along the rollouts, and ψ⁻¹, which draws them, does not."""
    coarse = {"integration": Integration("euler", 1), "generator": "probability"}
    scenario = changed(random_scenario(engine, 300), **coarse)
    live, last = certified(engine, scenario)
    assert of_kind(live, Kind.FOLDS) == [(Kind.FOLDS, AVOIDANCE.title)]
    assert last.min_det_jacobian < 0
    assert of_kind(last, Kind.FOLDS, Kind.NO_DIFFEOMORPHISM) == [(Kind.FOLDS, AVOIDANCE.title)]


def test_rk4_with_many_steps_of_a_mild_flow_is_as_good_as_auto(engine, initial):
    scenario = initial("push_box")
    live, last = certified(engine, changed(scenario, integration=Integration("rk4", 20)))
    *_, exact = engine.frames(scenario)
    warnings = (*live.warnings, *last.warnings)
    assert [warning for warning in warnings if warning.source != ARM] == []  # the fingers do not avoid
    assert last.min_det_jacobian == pytest.approx(exact.certificates.min_det_jacobian, rel=1e-2)
    assert last.clearance == pytest.approx(exact.certificates.clearance, abs=1e-4)


@pytest.mark.parametrize(("strength", "folds"), [(2.5, True), (0.1, False)])
def test_a_bias_point_has_an_integrator_of_its_own(engine, strength, folds):
    plain = avoiding("draw_s")
    point = replace(bias_beside(surroundings(engine.task("draw_s"), plain)), strength=strength)
    coarse = replace(point, integration=Integration("euler", 1))
    assert certified(engine, changed(plain, layers=biases(point)))[0].warnings == ()
    live, last = certified(engine, changed(plain, layers=biases(coarse)))
    assert of_kind(live, Kind.FOLDS) == [(Kind.FOLDS, "Bias 1")] * folds
    assert of_kind(live, Kind.INEXACT_INVERSE) == [(Kind.INEXACT_INVERSE, "Bias 1")]
    assert last.round_trip_error > 1e-4


@pytest.mark.parametrize(("steps", "folds"), [(1, True), (8, False)])
def test_the_whole_arm_says_what_euler_loses_and_certificates_find_its_folds(engine, initial, steps, folds):
    scenario = changed(initial("push_box"), space="cspace", temperature=3.0, integration=Integration("euler", steps))
    live, last = certified(engine, scenario)
    assert of_kind(live, Kind.INEXACT_INVERSE) == [(Kind.INEXACT_INVERSE, WHOLE_ARM)]
    assert of_kind(live, Kind.FOLDS) == []  # too slow to be looked for while the hand moves
    assert of_kind(last, Kind.FOLDS) == [(Kind.FOLDS, WHOLE_ARM)] * folds
    assert (last.min_det_jacobian < 0) == folds and last.round_trip_error > 1e-3


def test_a_place_that_auto_would_choose_for_is_not_searched_for_without_end(engine, initial):
    """More time does not mend what coarse steps spoil: the duration is that of the exact flow."""
    scenario = initial("push_box")
    (exact,) = next(engine.frames(scenario)).durations.values()
    (coarse,) = next(engine.frames(changed(scenario, integration=Integration("euler", 1)))).durations.values()
    assert coarse == pytest.approx(exact, rel=0.05)
