"""What lies on a slice, by what it promises: streamlines, colours, levels, occupancy, the warped grid, generators."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import biases, changed, frame_at, tilted
from scipy.spatial import KDTree

from dt_viz.avoidance.registry import bias_beside
from dt_viz.motion.stack import FINE, LIVE, build_stack, cut_off
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, Sphere
from dt_viz.pictures.slice_fields import (
    GRID_SPACING,
    LATTICE,
    MAX_OFFSET,
    MAX_POINTS,
    NEAR,
    SEPARATION,
    learned_occupancy,
    occupancy_picture,
)
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import BASE_PANEL, Slice
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


# what the occupancy maps believe


AREA = Slice(np.array([0.0, -0.5, 0.4]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T, (0.2, 0.15))
SHAPES = [
    Sphere((0.02, -0.5, 0.42), 0.14),
    Box((0.0, -0.51, 0.38), (0.2, 0.1, 0.06), (0.9, 0.1, 0.3, -0.3)),
    Cylinder((-0.03, -0.5, 0.4), 0.08, 0.2, (0.8, 0.6, 0.0, 0.0)),
]


@pytest.mark.parametrize("shape", SHAPES, ids=["sphere", "box", "cylinder"])
@pytest.mark.parametrize("coarse", [True, False])
def test_the_picture_shows_the_true_outline_and_what_is_learned_occupancy(shape, coarse):
    picture = occupancy_picture(AREA, (shape,), coarse=coarse)
    spacing = 0.010 if coarse else 0.004
    assert np.abs(shape.signed_distance(picture.outline)).max() < 0.3 * spacing
    assert np.abs(learned_occupancy(shape, picture.level.reshape(-1, 3)) - 0.5).max() < (0.2 if coarse else 0.05)
    assert np.abs(shape.signed_distance(picture.level)).max() < 0.25 * shape.radius  # it has learned the shape
    normal = np.cross(*AREA.axes.T)
    for segments in (picture.level, picture.outline):
        np.testing.assert_allclose((segments - AREA.centre) @ normal, 0, atol=1e-12)
    corner = AREA.centre - AREA.axes @ AREA.half_size
    assert picture.probability[0, 0] == pytest.approx(float(learned_occupancy(shape, corner[None])[0]), abs=1e-9)


def test_what_any_obstacle_is_believed_to_occupy_is_occupied():
    both = occupancy_picture(AREA, SHAPES[:2], coarse=True).probability
    each = [occupancy_picture(AREA, (shape,), coarse=True).probability for shape in SHAPES[:2]]
    assert (both >= np.maximum(*each) - 1e-12).all()
    nothing = occupancy_picture(AREA, (), coarse=True)
    assert nothing.probability.max() == 0 and len(nothing.level) == len(nothing.outline) == 0


@pytest.mark.long
def test_the_points_beside_the_slice_are_shown_on_it_with_their_labels():
    own = np.random.default_rng(4).uniform(-0.1, 0.1, (20_000, 3))
    cloud = Cloud(own, (np.linalg.norm(own, axis=1) < 0.06).astype(float))
    cloud = CloudObstacle((0.05, -0.5, 0.42), cloud, (0.9, 0.1, 0.3, -0.3))
    picture = occupancy_picture(AREA, (SHAPES[0], cloud), coarse=True)
    normal = np.cross(*AREA.axes.T)
    assert MAX_POINTS / 2 < len(picture.points) <= MAX_POINTS
    np.testing.assert_allclose((picture.points - AREA.centre) @ normal, 0, atol=1e-12)
    assert (np.abs((picture.points - AREA.centre) @ AREA.axes) < AREA.half_size).all()
    distance = np.linalg.norm(picture.points - cloud.position, axis=1)
    assert (distance[picture.occupied] < 0.06).all()
    assert (distance[~picture.occupied] > np.sqrt(0.06**2 - NEAR**2)).all()
    assert len(occupancy_picture(AREA, SHAPES, coarse=True).points) == 0


# pictures of ψ


ALL = View(generator=True, grid=True, panels=(BASE_PANEL,))


@pytest.fixture(name="pictured")
def _pictured(scenario):
    return replace(scenario, view=ALL)


def pictures_at(engine, scenario, wanted=Stage.FINE):
    return frame_at(engine, scenario, wanted).pictures


def bare(scenario):
    """The scenario without avoidance."""
    return changed(scenario, avoids=False)


def off_lattice(points, task, system):
    """Distances (N,) of points (N, 3) on the slice, metres, from where ψ takes them onto the grid's lattice."""
    z, J = system.transform.jacobian(points)
    across, axes = (z - system.base.goal) @ task.slice.axes / GRID_SPACING, task.slice.axes
    slope = np.linalg.norm(axes.T @ J @ axes, axis=2)
    return (GRID_SPACING * np.abs(across - across.round()) / slope).min(axis=1)


SHOWN_BY = {
    "generator": View(field=False, generator=True),
    "grid": View(field=False, grid=True),
    "panels": View(field=False, panels=(BASE_PANEL,)),
    "field": View(),
    "streamlines": View(field=False, streamlines=True),
    "colour": View(field=False, colour="det"),
    "occupancy": View(field=False, colour="occupancy"),
}
"""The view of each picture alone."""


@pytest.mark.parametrize("name", SHOWN_BY)
def test_a_picture_is_worked_out_only_while_it_is_shown_and_never_before_the_rollouts(engine, initial, name):
    scenario, others = (replace(initial("draw_s"), view=view) for view in (SHOWN_BY[name], View(field=False)))
    for shown, stage in ((others, Stage.LIVE), (scenario, Stage.ROLLOUTS), (scenario, Stage.LIVE)):
        made = getattr(pictures_at(engine, shown, stage), name)
        is_made = len(made) > 0 if isinstance(made, tuple) else made is not None
        assert is_made == (shown is scenario and stage is Stage.LIVE)
    assert not scenario.computes_like(others) and others.computes_like(scenario)


@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_of_the_identity_is_the_grid(engine, pictured, wanted):
    frame = frame_at(engine, bare(replace(pictured, imitation=False)), wanted)
    lines, spacing = frame.task.slice.across(frame.pictures.grid), GRID_SPACING
    along = np.abs(np.diff(lines, axis=1)[:, 0])
    np.testing.assert_allclose(along.min(axis=1), 0, atol=1e-8)
    for axis in range(2):
        across = np.unique(lines[along[:, axis] < 1e-8, 0, axis].round(7))
        np.testing.assert_allclose(np.diff(across), spacing, atol=1e-6)
        half = frame.task.slice.half_size[axis]
        assert across[0] < -half + spacing and across[-1] > half - spacing
    assert frame.pictures.generator is None  # nothing is learned that could be shown


@pytest.mark.long
@pytest.mark.parametrize("wanted", [Stage.LIVE, Stage.FINE])
def test_the_warped_grid_is_made_of_images_of_points_of_planes(engine, pictured, wanted):
    """ψ by another way, the forward side of the whole stack, leads back to the lattice, seen along the normal."""
    stack = build_stack(engine.nominal(pictured), pictured.active, LIVE if wanted is Stage.LIVE else FINE)
    points = pictures_at(engine, pictured, wanted).grid.reshape(-1, 3)
    outside = points[pictured.obstacle.signed_distance(points) > 0.005]  # nearer, ψ magnifies what the picture rounds
    off = off_lattice(outside, engine.task(pictured.task), stack.system)
    assert len(off) > 2000
    # between the samples of the lattice on the slice the coordinates are taken for linear
    assert np.quantile(off, 0.9) < (2e-3 if wanted is Stage.LIVE else 1e-3)


@pytest.mark.parametrize("moved", [False, True], ids=["", "tilted"])
def test_the_grid_covers_the_slice_wherever_it_is_and_is_smooth(engine, pictured, moved):
    pose = tilted(engine.task(pictured.task)) if moved else None
    frame = frame_at(engine, changed(pictured, avoids=False, view=View(grid=True, slice=pose)), Stage.FINE)
    area, lines = frame.slice, frame.pictures.grid
    points = lines.reshape(-1, 3)
    assert (np.abs(area.across(points)) <= np.array(area.half_size) + 1e-4).all()
    assert np.abs((points - area.centre) @ area.normal).max() < 3e-3  # between samples
    empty, _ = KDTree(points).query(area.lattice(0.03))
    assert np.quantile(empty, 0.95) < GRID_SPACING
    assert np.linalg.norm(np.diff(lines, axis=1), axis=2).max() <= 2 * LATTICE


def test_the_grid_keeps_out_of_the_obstacle_as_the_motions_do(engine, pictured):
    inside, inside_without = (
        (pictured.obstacle.signed_distance(lines) < -0.01).mean()
        for lines in (pictures_at(engine, one, Stage.LIVE).grid for one in (pictured, bare(pictured)))
    )
    assert inside < 0.25 * inside_without


def test_far_from_the_obstacle_the_grid_does_not_move(engine, pictured):
    away = changed(pictured, obstacles=(Sphere((0.0, 3.0, 3.0)),))
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
        ways = [path[-1] - path[0] for path in generator.motions]
        lengths = [np.linalg.norm(np.diff(path, axis=0), axis=1).sum() for path in generator.motions]
        bends.append(np.mean(lengths / np.linalg.norm(ways, axis=1)))
        if number == 1:
            for motion, path in zip(generator.motions, engine.task(scenario.task).paths, strict=True):
                np.testing.assert_allclose(motion[[0, -1]], path[[0, -1]], atol=1e-12)
    assert len(bends) >= 2
    assert (np.diff(bends) < 0).all()


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
