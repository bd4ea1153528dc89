"""Pictures of ψ by what they promise: points of the warped grid are images of points of straight lines, and so on."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import changed, frame_at
from scipy.spatial.transform import Rotation

from dt_viz.engine.frame import Stage
from dt_viz.motion.stack import FINE, LIVE, build_stack
from dt_viz.obstacles.shapes import Sphere
from dt_viz.pictures.sketchbook import FINE_SPACING, LINE_SPACING
from dt_viz.scenario.panels import BASE_PANEL
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import SlicePose

TASK_NAMES = ["draw_s", "lift_box"]
ALL = View(generator=True, grid=True, panels=(BASE_PANEL,))


@pytest.fixture(params=TASK_NAMES, name="scenario")
def _scenario(request, initial):
    return replace(initial(request.param), view=ALL)


def picture_at(engine, scenario, wanted=Stage.FINE):
    frame = frame_at(engine, scenario, wanted)
    return frame, frame.pictures


def on_slice(task, points):
    """Coordinates (N, 3) in the slice and along its normal."""
    axes = task.slice.axes
    return (points - task.slice.centre) @ np.column_stack([axes, np.cross(*axes.T)])


def straightness(lines):
    """By how much points of lines leave the straight line along an axis of the slice."""
    return max(np.ptp(line, axis=0)[:2].min() for line in lines)


def test_pictures_are_worked_out_only_while_they_are_shown_and_never_before_the_rollouts(engine, scenario):
    for shown, stage in ((False, Stage.LIVE), (True, Stage.ROLLOUTS), (True, Stage.LIVE)):
        pictures = frame_at(engine, scenario if shown else replace(scenario, view=View()), stage).pictures
        made = (pictures.generator, pictures.grid, pictures.panels or None)
        assert all((picture is not None) == (shown and stage is Stage.LIVE) for picture in made)


@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_of_the_identity_is_the_grid(engine, scenario, wanted):
    frame, pictures = picture_at(engine, changed(scenario, imitation=False, avoids=False), wanted)
    lines = [on_slice(frame.task, line) for line in pictures.grid.lines]
    assert straightness(lines) < 1e-9
    for axis in range(2):
        across = np.sort([line[0, axis] for line in lines if np.ptp(line[:, axis]) < 1e-9])
        np.testing.assert_allclose(np.diff(across), LINE_SPACING, atol=1e-9)
        half = frame.task.slice.half_size[axis]
        assert across[0] < -half + LINE_SPACING and across[-1] > half - LINE_SPACING
    assert pictures.generator is None  # nothing is learned that could be shown


@pytest.mark.parametrize("avoidance", [pytest.param(False, marks=pytest.mark.slow), True])
@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_is_made_of_images_of_points_of_planes(engine, scenario, wanted, avoidance):
    """ψ by another way, the forward side of the whole stack, makes the lines straight again, seen along the normal."""
    scenario = changed(scenario, avoids=avoidance)
    frame, pictures = picture_at(engine, scenario, wanted)
    stack = build_stack(engine.nominal(scenario), scenario.active, LIVE if wanted is Stage.LIVE else FINE)
    middle, obstacle = [], scenario.obstacle
    for line in pictures.grid.lines:
        outside = line[obstacle.signed_distance(line) > 0.005]  # nearer, ψ magnifies what the picture rounds
        if len(outside) > 1:
            middle.append(on_slice(frame.task, stack.transform.forward(outside)))
    assert len(middle) > 20
    close = 2.5e-3 if wanted is Stage.LIVE else 5e-4  # ψ of the live stack itself is no more exact
    assert straightness(middle) < close


def test_the_live_grid_is_the_same_before_and_after_the_fine_one(new_engine, initial):
    """And so it does not jump between the first drag and the next."""
    engine, scenario = new_engine(), replace(initial("draw_s"), view=View(grid=True))
    first, again = (picture_at(engine, scenario, stage)[1].grid.lines for stage in (Stage.LIVE, Stage.FINE))
    assert sum(map(len, first)) < sum(map(len, again))
    again = picture_at(engine, scenario, Stage.LIVE)[1].grid.lines
    assert len(first) == len(again)
    for line, same in zip(first, again, strict=True):
        np.testing.assert_allclose(line, same, atol=1e-9)


def test_the_grid_lies_over_the_slice_and_is_smooth(engine, scenario):
    frame, pictures = picture_at(engine, changed(scenario, avoids=False))
    points = on_slice(frame.task, np.concatenate(pictures.grid.lines))
    assert (np.abs(points[:, :2]) <= np.array(frame.task.slice.half_size) + 1e-4).all()
    assert np.abs(points[:, 2]).max() < 3e-3  # between samples
    # what the clipping leaves covers the slice: motions are everywhere among the lines
    for axis in range(2):
        assert np.ptp(points[:, axis]) > 1.8 * frame.task.slice.half_size[axis]
    for line in pictures.grid.lines:
        assert np.linalg.norm(np.diff(line, axis=0), axis=1).max() <= 3 * FINE_SPACING


def test_the_grid_covers_the_slice_also_where_it_is_tilted(engine, initial):
    for name in TASK_NAMES:
        scenario = changed(initial(name), avoids=False)
        home = engine.task(name).slice
        turn = Rotation.from_rotvec([0.0, 0.1, 0.5]) * Rotation.from_quat(np.roll(home.pose.wxyz, -1))
        x, y, z = (float(c) for c in home.centre + 0.03)
        w, i, j, k = (float(c) for c in np.roll(turn.as_quat(), 1))
        tilted = View(field=False, grid=True, slice=SlicePose((x, y, z), (w, i, j, k)))
        frame, pictures = picture_at(engine, replace(scenario, view=tilted))
        area = frame.slice
        points = np.concatenate(pictures.grid.lines)
        assert np.abs((points - area.centre) @ area.normal).max() < 3e-3
        empty = [np.linalg.norm(points - place, axis=1).min() for place in area.lattice(0.03)]
        assert np.quantile(empty, 0.95) < LINE_SPACING


def test_the_grid_keeps_out_of_the_obstacle_as_the_motions_do(engine, scenario):
    scenario = replace(scenario, view=View(grid=True))
    _, pictures = picture_at(engine, scenario, Stage.LIVE)
    points = np.concatenate(pictures.grid.lines)
    inside = (scenario.obstacle.signed_distance(points) < -0.01).mean()
    bare = np.concatenate(picture_at(engine, changed(scenario, avoids=False), Stage.LIVE)[1].grid.lines)
    assert inside < 0.25 * (scenario.obstacle.signed_distance(bare) < -0.01).mean()


def test_far_from_the_obstacle_the_grid_does_not_move(engine, scenario):
    away = changed(scenario, obstacles=(Sphere((0.0, 3.0, 3.0)),))
    moved = picture_at(engine, away, Stage.LIVE)[1].grid.lines
    still = picture_at(engine, changed(away, avoids=False), Stage.LIVE)[1].grid.lines
    for a, b in zip(moved, still, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-9)


def test_following_the_generators_one_after_the_other_straightens_the_demonstrations(engine, scenario):
    """The motions that are shown with a flow's generator are bent less from flow to flow."""
    bends = []
    for number in range(1, 20):
        frame, pictures = picture_at(engine, replace(scenario, view=replace(ALL, generator_layer=number)), Stage.LIVE)
        if number > pictures.generator.num_flows:
            break
        bends.append(np.mean([turned(path) for path in pictures.generator.motions]))
        if number == 1:
            for motion, path in zip(pictures.generator.motions, frame.task.paths, strict=True):
                np.testing.assert_allclose(motion[[0, -1]], path[[0, -1]], atol=1e-12)
    assert len(bends) >= 2
    assert (np.diff(bends) < 0).all()


def turned(path):
    """How much longer a path is than the way from its start to its end."""
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / np.linalg.norm(path[-1] - path[0])


def test_the_mean_generator_is_the_mean_of_the_flows(engine, initial):
    scenario = initial("draw_s")
    imitation = engine.nominal(scenario).imitation
    _, pictures = picture_at(engine, replace(scenario, view=ALL), Stage.LIVE)
    task, mean = engine.task("draw_s"), pictures.generator
    u = ((mean.points - task.origin) @ task.axes / task.scale)[:, :2]
    expected = np.mean([flow.duration * flow.field(u) for flow in imitation.transform.parts], axis=0)
    np.testing.assert_allclose(mean.displacements @ task.axes[:, :2] / task.scale, expected, atol=1e-12)
    assert mean.motions == ()


def test_a_flow_that_there_is_not_is_the_last(engine, scenario):
    """The slider may stand higher than another task has flows."""
    many = picture_at(engine, replace(scenario, view=replace(ALL, generator_layer=99)), Stage.LIVE)[1].generator
    last = replace(scenario, view=replace(ALL, generator_layer=many.num_flows))
    assert picture_at(engine, last, Stage.LIVE)[1].generator is many


def test_pictures_are_remembered_where_the_obstacle_does_not_matter(engine, scenario):
    first = picture_at(engine, scenario, Stage.LIVE)[1]
    x, y, z = scenario.obstacles[0].position
    moved = picture_at(engine, changed(scenario, obstacles=(Sphere((x, y, z + 0.02)),)), Stage.LIVE)[1]
    assert moved.generator is first.generator
    for a, b in zip(moved.panels[0].streamlines, first.panels[0].streamlines, strict=True):
        np.testing.assert_array_equal(a, b)
