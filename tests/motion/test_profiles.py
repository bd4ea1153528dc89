"""Profiles along a path must agree with what is measured otherwise, and say the same at every sampling."""

from dataclasses import replace

import numpy as np
import pytest
from body_spheres import cover
from hypothesis import given
from hypothesis import strategies as st
from scenes import changed, frame_at

from dt_viz.metrics import discrete_frechet, distance_from_path, maximum_collision_distance, resample_by_arc_length
from dt_viz.motion import profiles as profiles_module
from dt_viz.motion.profiles import NUM_SAMPLES
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Stage
from dt_viz.ui.tabs.plots import HealthPlots

SHOWN = View(field=False, health_plots=True)


def profiled(engine, scenario):
    """The frame of stage FINE with profiles, and these."""
    frame = frame_at(engine, replace(scenario, view=SHOWN), Stage.FINE)
    assert frame.profiles is not None
    return frame, frame.profiles


@pytest.fixture(scope="module", params=["task", "cspace"])
def shown(request, engine, initial):
    return profiled(engine, changed(initial("draw_s"), space=request.param, arm_rollout=1))


# --- Distance from a polyline ---


@given(st.integers(0, 10**6))
def test_the_distance_from_a_path_is_never_more_than_from_its_points_and_the_limit_of_finer_ones(seed):
    rng = np.random.default_rng(seed)
    path, points = rng.normal(size=(5, 3)), rng.normal(size=(7, 3))
    distance = distance_from_path(points, path)
    fine = resample_by_arc_length(path, 4000)
    nearest = np.linalg.norm(points[:, None] - fine, axis=2).min(axis=1)
    assert (distance <= nearest + 1e-9).all()
    np.testing.assert_allclose(distance, nearest, atol=0.02)


# --- Of a frame ---


def test_the_lyapunov_value_falls_strictly_from_one_to_about_zero(shown):
    _, profiles = shown
    for profile in (profiles.shown, profiles.undisturbed):
        assert profile.lyapunov[0] == 1
        assert (np.diff(profile.lyapunov) < 0).all()
        assert abs(profile.lyapunov[-1]) < 1e-4


def test_distances_agree_with_the_metrics(shown):
    frame, profiles = shown
    demonstration = frame.task.paths[1]
    b = resample_by_arc_length(demonstration, NUM_SAMPLES)
    for path, profile in ((frame.rollouts[1], profiles.shown), (frame.ghost[1], profiles.undisturbed)):
        a = resample_by_arc_length(path, NUM_SAMPLES)
        np.testing.assert_allclose(profile.distance, distance_from_path(a, demonstration), atol=1e-12)
        assert profile.frechet == discrete_frechet(a, b)
        assert profile.distance.max() <= profile.frechet
    assert profiles.undisturbed.frechet < 0.02 < profiles.shown.frechet


def test_clearance_agrees_with_the_signed_distance(shown, robot):
    frame, profiles = shown
    obstacle = frame.scenario.obstacle
    assert profiles.of_body == (frame.scenario.avoidance.space != "task")
    assert profiles.shown.clearance.min() >= frame.certificates.clearance - 1e-9
    assert profiles.shown.clearance.min() == pytest.approx(frame.certificates.clearance, abs=0.03)
    assert profiles.undisturbed.depth > 0.03 and profiles.shown.depth < 1e-3
    if profiles.of_body:
        points, q = cover(load_jaco().links), frame.arm.q[[0]]
        first = (obstacle.signed_distance(points.positions(robot, q[0])) - points.radius).min()
        assert profiles.shown.clearance[0] == pytest.approx(first, abs=1e-9)
        return
    for path, profile in ((frame.rollouts[1], profiles.shown), (frame.ghost[1], profiles.undisturbed)):
        a = resample_by_arc_length(path, NUM_SAMPLES)
        # between two samples 5 mm apart the distance from a sphere bends a little
        np.testing.assert_allclose(profile.clearance, obstacle.signed_distance(a), atol=2e-4)
        assert profile.depth == pytest.approx(maximum_collision_distance(path, obstacle.signed_distance))


def test_without_obstacles_the_clearance_is_infinite_and_nothing_is_entered(engine, initial):
    _, profiles = profiled(engine, changed(initial("draw_s"), obstacles=()))
    for profile in (profiles.shown, profiles.undisturbed):
        assert np.isinf(profile.clearance).all() and profile.depth == 0
    np.testing.assert_allclose(profiles.shown.distance, profiles.undisturbed.distance, atol=2e-4)


def test_profiles_are_computed_only_while_shown_and_not_while_dragging(engine, initial):
    scenario = replace(initial("draw_s"), view=View(field=False))
    assert frame_at(engine, scenario, Stage.FINE).profiles is None
    assert frame_at(engine, replace(scenario, view=SHOWN), Stage.LIVE).profiles is None
    assert frame_at(engine, replace(scenario, view=SHOWN), Stage.FINE).profiles is not None
    assert replace(scenario, view=SHOWN).computes_like(scenario) is False
    assert scenario.computes_like(replace(scenario, view=SHOWN))


# --- Of a motion ---


def test_a_motion_that_rests_on_its_way_has_a_profile():
    path = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.1, 0, 0], [0.2, 0, 0]])
    found = profiles_module.profile(path, path, np.array([4.0, 2, 1.5, 0]), np.array([0.3, 0.1, -0.02, 0.3]), 0.02)
    assert found.depth == 0.02 and found.frechet == 0
    np.testing.assert_allclose(found.distance, 0, atol=1e-12)
    assert np.isfinite(found.lyapunov).all() and (np.diff(found.lyapunov) < 0).all()


# --- In the panel ---


def test_the_plots_and_the_table_show_what_the_profiles_hold(shown, server):
    _, profiles = shown
    plots = HealthPlots(server.gui)
    assert not plots.visible
    plots.follow(profiles)
    assert not plots.table.content  # it is not sent while it is hidden
    plots.visible = True
    for plot in (plots.lyapunov, plots.distance, plots.clearance):
        assert len(plot.data) == len(plot.series) and all(len(column) == NUM_SAMPLES for column in plot.data)
    np.testing.assert_allclose(plots.clearance.data[1], 1e3 * profiles.shown.clearance)
    np.testing.assert_allclose(plots.distance.data[2], 1e3 * profiles.undisturbed.distance)
    for profile in (profiles.shown, profiles.undisturbed):
        assert f"{1e3 * profile.frechet:.1f} mm" in plots.table.content
        assert f"{1e3 * profile.depth:.1f} mm" in plots.table.content
    before = plots.lyapunov.data
    plots.follow(None)
    assert plots.lyapunov.data is before and plots.clearance.visible
    nowhere = replace(profiles.shown, clearance=np.full(NUM_SAMPLES, np.inf))
    plots.follow(replace(profiles, shown=nowhere, undisturbed=nowhere))
    assert not plots.clearance.visible
    assert plots.table.content.count("–") == 2
