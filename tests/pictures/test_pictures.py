"""Pictures of ψ by what they promise: points of the warped grid are images of points of straight lines, and so on."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import changed, frame_at, tilted
from scipy.spatial import KDTree

from dt_viz.motion.stack import FINE, LIVE, build_stack
from dt_viz.obstacles.shapes import Sphere
from dt_viz.pictures.slice_fields import GRID_SPACING, LATTICE
from dt_viz.scenario.panels import BASE_PANEL
from dt_viz.scenario.scenario import View
from dt_viz.session.frame import Stage

TASK_NAMES = ["draw_s", "lift_box"]
ALL = View(generator=True, grid=True, panels=(BASE_PANEL,))


@pytest.fixture(params=TASK_NAMES, name="scenario")
def _scenario(request, initial):
    return replace(initial(request.param), view=ALL)


def pictures_at(engine, scenario, wanted=Stage.FINE):
    return frame_at(engine, scenario, wanted).pictures


def bare(scenario):
    """The scenario without avoidance."""
    return changed(scenario, avoids=False)


def on_slice(task, points):
    """Coordinates (N, 3) in the slice and along its normal."""
    axes = task.slice.axes
    return (points - task.slice.centre) @ np.column_stack([axes, np.cross(*axes.T)])


def off_lattice(points, task, system):
    """Distances (N,) of points (N, 3) on the slice, metres, from where ψ takes them onto the grid's lattice."""
    z, J = system.transform.jacobian(points)
    across, axes = (z - system.base.goal) @ task.slice.axes / GRID_SPACING, task.slice.axes
    slope = np.linalg.norm(axes.T @ J @ axes, axis=2)
    return (GRID_SPACING * np.abs(across - across.round()) / slope).min(axis=1)


def test_pictures_are_worked_out_only_while_they_are_shown_and_never_before_the_rollouts(engine, scenario):
    for shown, stage in ((False, Stage.LIVE), (True, Stage.ROLLOUTS), (True, Stage.LIVE)):
        pictures = pictures_at(engine, scenario if shown else replace(scenario, view=View()), stage)
        made = (pictures.generator, pictures.grid, pictures.panels or None)
        assert all((picture is not None) == (shown and stage is Stage.LIVE) for picture in made)


@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_of_the_identity_is_the_grid(engine, scenario, wanted):
    frame = frame_at(engine, bare(replace(scenario, imitation=False)), wanted)
    lines, spacing = on_slice(frame.task, frame.pictures.grid), GRID_SPACING
    along = np.abs(np.diff(lines, axis=1)[:, 0, :2])
    np.testing.assert_allclose(along.min(axis=1), 0, atol=1e-8)
    for axis in range(2):
        across = np.unique(lines[along[:, axis] < 1e-8, 0, axis].round(7))
        np.testing.assert_allclose(np.diff(across), spacing, atol=1e-6)
        half = frame.task.slice.half_size[axis]
        assert across[0] < -half + spacing and across[-1] > half - spacing
    assert frame.pictures.generator is None  # nothing is learned that could be shown


@pytest.mark.long
@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_is_made_of_images_of_points_of_planes(engine, scenario, wanted):
    """ψ by another way, the forward side of the whole stack, leads back to the lattice, seen along the normal."""
    stack = build_stack(engine.nominal(scenario), scenario.active, LIVE if wanted is Stage.LIVE else FINE)
    points = pictures_at(engine, scenario, wanted).grid.reshape(-1, 3)
    outside = points[scenario.obstacle.signed_distance(points) > 0.005]  # nearer, ψ magnifies what the picture rounds
    off = off_lattice(outside, engine.task(scenario.task), stack.system)
    assert len(off) > 2000
    # between the samples of the lattice on the slice the coordinates are taken for linear
    assert np.quantile(off, 0.9) < (2e-3 if wanted is Stage.LIVE else 1e-3)


@pytest.mark.parametrize("moved", [False, True], ids=["", "tilted"])
def test_the_grid_covers_the_slice_wherever_it_is_and_is_smooth(engine, scenario, moved):
    pose = tilted(engine.task(scenario.task)) if moved else None
    frame = frame_at(engine, changed(scenario, avoids=False, view=View(grid=True, slice=pose)), Stage.FINE)
    area, lines = frame.slice, frame.pictures.grid
    points = lines.reshape(-1, 3)
    assert (np.abs(area.across(points)) <= np.array(area.half_size) + 1e-4).all()
    assert np.abs((points - area.centre) @ area.normal).max() < 3e-3  # between samples
    empty, _ = KDTree(points).query(area.lattice(0.03))
    assert np.quantile(empty, 0.95) < GRID_SPACING
    assert np.linalg.norm(np.diff(lines, axis=1), axis=2).max() <= 2 * LATTICE


def test_the_grid_keeps_out_of_the_obstacle_as_the_motions_do(engine, scenario):
    inside, inside_without = (
        (scenario.obstacle.signed_distance(lines) < -0.01).mean()
        for lines in (pictures_at(engine, one, Stage.LIVE).grid for one in (scenario, bare(scenario)))
    )
    assert inside < 0.25 * inside_without


def test_far_from_the_obstacle_the_grid_does_not_move(engine, scenario):
    away = changed(scenario, obstacles=(Sphere((0.0, 3.0, 3.0)),))
    moved, still = (pictures_at(engine, one, Stage.LIVE).grid for one in (away, bare(away)))
    np.testing.assert_allclose(moved, still, atol=1e-9)


def test_following_the_generators_one_after_the_other_straightens_the_demonstrations(engine, scenario):
    """The motions that are shown with a flow's generator are bent less from flow to flow."""
    bends = []
    for number in range(1, 20):
        shown = replace(scenario, view=View(generator=True, generator_layer=number))
        generator = pictures_at(engine, shown, Stage.LIVE).generator
        if number > generator.num_flows:
            break
        bends.append(np.mean([turned(path) for path in generator.motions]))
        if number == 1:
            for motion, path in zip(generator.motions, engine.task(scenario.task).paths, strict=True):
                np.testing.assert_allclose(motion[[0, -1]], path[[0, -1]], atol=1e-12)
    assert len(bends) >= 2
    assert (np.diff(bends) < 0).all()


def turned(path):
    """How much longer a path is than the way from its start to its end."""
    return np.linalg.norm(np.diff(path, axis=0), axis=1).sum() / np.linalg.norm(path[-1] - path[0])


def test_the_mean_generator_is_the_mean_of_the_flows(engine, initial):
    scenario = initial("draw_s")
    imitation = engine.nominal(scenario).imitation
    task, mean = engine.task("draw_s"), pictures_at(engine, replace(scenario, view=ALL), Stage.LIVE).generator
    u = ((mean.points - task.origin) @ task.axes / task.scale)[:, :2]
    expected = np.mean([flow.duration * flow.field(u) for flow in imitation.transform.parts], axis=0)
    np.testing.assert_allclose(mean.displacements @ task.axes[:, :2] / task.scale, expected, atol=1e-12)
    assert mean.motions == ()


def test_a_flow_that_there_is_not_is_the_last(engine, scenario):
    """The slider may stand higher than another task has flows."""
    many = pictures_at(engine, replace(scenario, view=replace(ALL, generator_layer=99)), Stage.LIVE).generator
    last = replace(scenario, view=replace(ALL, generator_layer=many.num_flows))
    assert pictures_at(engine, last, Stage.LIVE).generator is many


def test_pictures_are_remembered_where_the_obstacle_does_not_matter(engine, scenario):
    x, y, z = scenario.obstacles[0].position
    elsewhere = changed(scenario, obstacles=(Sphere((x, y, z + 0.02)),))
    first, moved = (pictures_at(engine, one, Stage.LIVE) for one in (scenario, elsewhere))
    assert moved.generator is first.generator
    for a, b in zip(moved.panels[0].streamlines, first.panels[0].streamlines, strict=True):
        np.testing.assert_array_equal(a, b)
