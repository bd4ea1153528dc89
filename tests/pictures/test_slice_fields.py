"""What lies on a slice, by what it promises: streamlines follow the velocity, colours are what they say, levels fit."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import biases, changed, frame_at, tilted

from dt_viz.avoidance.placement import bias_beside
from dt_viz.motion.stack import FINE, LIVE, build_stack, cut_off
from dt_viz.pictures.slice_fields import MAX_OFFSET, SEPARATION
from dt_viz.scenario.scenario import SLICE_COLOURS, View
from dt_viz.scenario.stack import levels, surroundings
from dt_viz.session.frame import Stage

TASK_NAMES = ["draw_s", "lift_box"]


@pytest.fixture(params=TASK_NAMES, name="scenario")
def _scenario(request, initial):
    return initial(request.param)


def shown(engine, scenario, wanted=Stage.FINE, **view):
    return frame_at(engine, replace(scenario, view=View(**view)), wanted)


def solved(engine, scenario, wanted=Stage.FINE):
    nominal = engine.nominal(scenario)
    return nominal, build_stack(nominal, scenario.active, LIVE if wanted is Stage.LIVE else FINE)


def with_bias(engine, scenario):
    return changed(scenario, layers=biases(bias_beside(surroundings(engine.task(scenario.task), scenario))))


@pytest.mark.parametrize("colour", ["det", "lyapunov", "occupancy"])
def test_everything_lies_on_the_slice_wherever_it_is(engine, scenario, colour):
    pose = tilted(engine.task(scenario.task))
    frame = shown(engine, scenario, Stage.LIVE, slice=pose, colour=colour)
    area, pictures = frame.slice, frame.pictures
    assert area.pose.position == pytest.approx(pose.position)
    made = pictures.occupancy if colour == "occupancy" else pictures.colour
    lines = (made.level, made.outline) if colour == "occupancy" else (made.lines,)
    assert made.area.key == area.key
    for points in (pictures.field.points, *(line.reshape(-1, 3) for line in lines)):
        np.testing.assert_allclose((points - area.centre) @ area.normal, 0, atol=1e-12)
        assert (np.abs(area.across(points)) <= np.array(area.half_size) + 1e-9).all()


def test_neither_another_slice_nor_another_rollout_for_the_arm_solves_anything_again(new_engine, initial, monkeypatch):
    engine, scenario = new_engine(), initial("lift_box")
    before = list(engine.frames(scenario))
    monkeypatch.setattr("dt_viz.session.engine.solve", lambda *_: pytest.fail("solved again"))
    monkeypatch.setattr("dt_viz.session.engine.certify", lambda *_: pytest.fail("certified again"))
    moved = replace(scenario, view=View(slice=tilted(engine.task(scenario.task)), level="Imitation"))
    for old, new in zip(before, engine.frames(moved), strict=True):
        assert new.scenario == moved and new.stage is old.stage and new.level == 0
        assert (new.certificates, new.durations) == (old.certificates, old.durations)
        for a, b in zip(old.rollouts, new.rollouts, strict=True):
            np.testing.assert_array_equal(a, b)
    other = frame_at(engine, replace(moved, arm_rollout=3), Stage.FINE)
    assert (before[-1].chosen, other.chosen) == (0, 3)
    assert not np.array_equal(before[-1].arm.q[0], other.arm.q[0])
    x, y, z = scenario.obstacles[0].position
    with pytest.raises(BaseException, match="solved again"):
        next(engine.frames(changed(moved, obstacles=(scenario.obstacles[0].moved((x, y, z + 0.01)),))))


def test_frames_of_a_changed_view_are_those_of_a_fresh_start(engine, new_engine, initial):
    scenario = initial("draw_s")
    view = {"slice": tilted(engine.task("draw_s"), 1), "colour": "lyapunov", "streamlines": True}
    frame_at(engine, scenario, Stage.FINE)
    again, fresh = (shown(e, scenario, **view).pictures for e in (engine, new_engine()))
    np.testing.assert_array_equal(again.field.velocities, fresh.field.velocities)
    np.testing.assert_array_equal(again.colour.values, fresh.colour.values)
    assert len(again.streamlines) == len(fresh.streamlines)


def test_what_is_not_shown_is_not_computed(engine, scenario):
    nothing = shown(engine, scenario, field=False).pictures
    assert (nothing.field, nothing.streamlines, nothing.colour, nothing.occupancy, nothing.grid) == (None,) * 5
    plain, pose = replace(scenario, view=View()), tilted(engine.task(scenario.task))
    for view in (View(streamlines=True), View(colour="det"), View(slice=pose), View(level="Imitation")):
        assert not replace(scenario, view=view).computes_like(plain)
    for colour in SLICE_COLOURS:
        assert plain.computes_like(replace(scenario, view=View(colour=colour)))


@pytest.mark.parametrize(("task", "wanted", "moved"), [("draw_s", Stage.FINE, False), ("lift_box", Stage.LIVE, True)])
def test_streamlines_follow_the_velocity_and_the_lyapunov_value_falls_along_them(engine, initial, task, wanted, moved):
    scenario = initial(task)
    view = {"slice": tilted(engine.task(scenario.task))} if moved else {}
    frame = shown(engine, scenario, wanted, streamlines=True, **view)
    system = solved(engine, scenario, wanted)[1].system
    lines, obstacle = frame.pictures.streamlines, scenario.obstacle
    assert len(lines) > 30
    cosines = []
    for line in lines:
        falls = np.diff(system.lyapunov(line)) < 0
        near = obstacle.signed_distance(line[1:]) < 0.02  # there ψ magnifies what the live picture rounds
        assert (falls if wanted is Stage.FINE else falls | near).all()
        step = np.diff(line, axis=0)
        middle, length = (line[1:] + line[:-1]) / 2, np.linalg.norm(step, axis=1)
        far = (obstacle.signed_distance(middle) > 0.03) & (length > 1e-4)
        velocity = system.velocity(middle[far])
        cosines.append((velocity * step[far]).sum(1) / np.linalg.norm(velocity, axis=1) / length[far])
    cosines = np.concatenate(cosines)
    assert np.quantile(cosines, 0.01) > (0.99 if wanted is Stage.LIVE else 0.998)
    assert np.median(cosines) > 0.9999


def test_streamlines_keep_apart_fill_the_slice_and_stay_over_it(engine, scenario):
    frame = shown(engine, scenario, streamlines=True)
    area, lines = frame.slice, frame.pictures.streamlines
    points = np.concatenate(lines)
    assert (np.abs((points - area.centre) @ area.normal) < 1.2 * MAX_OFFSET).all()
    starts = np.stack([line[0] for line in lines])
    for k, start in enumerate(starts):
        others = np.concatenate([line for j, line in enumerate(lines) if j != k])
        assert np.linalg.norm(others - start, axis=1).min() > 0.35 * SEPARATION
    free = area.lattice(0.02)
    free = free[scenario.obstacle.signed_distance(free) > 0.05]
    empty = np.array([np.linalg.norm(points - place, axis=1).min() for place in free])
    assert np.quantile(empty, 0.9) < 1.2 * SEPARATION


@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_colours_are_the_functions_that_they_say(engine, scenario, wanted):
    pose = tilted(engine.task(scenario.task), 2)
    system = solved(engine, scenario, wanted)[1].system
    rng = np.random.default_rng(3)
    for colour, direct in (
        ("det", lambda y: np.linalg.det(system.transform.jacobian(y)[1])),
        ("lyapunov", lambda y: system.base.potential(system.transform.forward(y))),
    ):
        frame = shown(engine, scenario, wanted, colour=colour, slice=pose)
        picture, field = frame.pictures.colour, frame.pictures.field
        far = scenario.obstacle.signed_distance(field.points) > 0.02
        velocity = system.velocity(field.points[far])  # where one lattice serves both, it comes from J
        np.testing.assert_allclose(field.velocities[far], velocity, rtol=0.01, atol=1e-3 * np.abs(velocity).max())
        n, m = picture.values.shape
        (w, h), area = frame.slice.half_size, frame.slice
        for i, j in zip(rng.integers(0, n, 12), rng.integers(0, m, 12), strict=True):
            y = area.at(np.array([np.linspace(-w, w, n)[i], np.linspace(-h, h, m)[j]]))
            room = float(scenario.obstacle.signed_distance(y[None])[0])
            assert picture.clearance[i, j] == pytest.approx(room, abs=1e-9)
            if room > 0:
                assert picture.values[i, j] == pytest.approx(float(direct(y[None])[0]), rel=1e-6)
            else:
                assert np.isnan(picture.values[i, j])


def test_det_j_of_the_identity_is_one_and_its_level_lines_are_circles(engine, scenario):
    plain = changed(scenario, imitation=False, avoids=False)
    np.testing.assert_allclose(shown(engine, plain, colour="det").pictures.colour.values, 1, atol=1e-12)
    frame = shown(engine, plain, colour="lyapunov")
    radii = np.linalg.norm(frame.pictures.colour.lines - frame.goal, axis=-1)
    off = np.abs(radii / 0.04 - np.round(radii / 0.04)) * 0.04
    assert off.max() < 5e-4 and len(np.unique(np.round(radii / 0.04))) > 5


def test_the_system_of_each_level_has_the_rollouts_of_that_level(engine, scenario):
    scenario = with_bias(engine, scenario)
    frame = shown(engine, scenario)
    nominal, solution = solved(engine, scenario)
    assert len(frame.levels) == len(levels(scenario)) == 3
    for level, paths in enumerate(frame.levels):
        system = cut_off(nominal, solution, level)
        for rollout, path in enumerate(paths):
            times = frame.times[rollout][:-1]
            expected = system.transform.inverse(solution.rays.base.flow(solution.rays.z0[rollout], times))
            np.testing.assert_allclose(path[:-1], expected, atol=2e-6)
            again = system.rollout(path[0], times)  # and from its first point by itself
            np.testing.assert_allclose(path[:-1], again, atol=2e-6)


def test_the_pictures_are_those_of_the_selected_level_if_it_is_in_the_stack(engine, initial):
    scenario = with_bias(engine, initial("draw_s"))
    values = np.empty(0)
    for level, name in enumerate(levels(scenario)):
        frame = shown(engine, scenario, Stage.FINE, level=name, colour="lyapunov")
        system = cut_off(*solved(engine, scenario), level)
        assert frame.level == level
        field, colour = frame.pictures.field, frame.pictures.colour
        np.testing.assert_allclose(field.velocities, system.velocity(field.points), rtol=1e-4, atol=1e-6)
        values = colour.values
        known = ~np.isnan(values)
        assert known.all() == (name != "Avoidance")  # only there the obstacle is in the way
    for name in ("", "Bias 7"):
        whole = shown(engine, scenario, Stage.FINE, level=name, colour="lyapunov")
        assert whole.level is None
        np.testing.assert_array_equal(whole.pictures.colour.values, values)
    without = changed(scenario, avoids=False)
    assert shown(engine, without, Stage.ROLLOUTS, level="Avoidance").level is None


def test_the_grid_of_the_imitation_is_that_of_the_stack_without_the_obstacle(engine, scenario):
    below = shown(engine, scenario, Stage.LIVE, grid=True, level="Imitation").pictures.grid
    without = shown(engine, changed(scenario, avoids=False), Stage.LIVE, grid=True).pictures.grid
    np.testing.assert_array_equal(below, without)


def test_the_slice_can_be_moved_while_there_is_no_motion(new_engine, initial):
    engine, scenario = new_engine(), changed(initial("draw_s"), space="cspace")
    frame_at(engine, scenario, Stage.LIVE)
    base = changed(scenario, obstacles=(scenario.obstacles[0].moved((0.0, 0.0, 0.1)),))
    blocked = next(engine.frames(base))
    assert blocked.blocked
    moved = shown(engine, base, Stage.LIVE, slice=tilted(engine.task("draw_s")), colour="lyapunov")
    assert moved.blocked
    assert moved.pictures.colour.area.key == moved.slice.key
