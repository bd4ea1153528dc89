"""Laws of obstacles, on examples of every shape and on unions of them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from laws.registry import OBSTACLES, PLACE, SIMILAR, TILTED
from oracles import central_differences

from dt_viz.avoidance.avoidance import clearing_duration
from dt_viz.flows.diffeomorphisms import Flow
from dt_viz.obstacles.shapes import SHAPES, UPRIGHT, Box, CloudObstacle, MeshObstacle, Obstacle, rotation
from dt_viz.obstacles.solids import MAX_BALLS
from dt_viz.obstacles.union import Union


def test_every_shape_has_an_example():
    assert set(SHAPES) == {type(obstacle) for obstacle in OBSTACLES.values()}


@pytest.fixture(
    params=[pytest.param(name, marks=[pytest.mark.slow] * (name in SIMILAR)) for name in OBSTACLES], name="obstacle"
)
def _obstacle(request) -> Obstacle:
    return OBSTACLES[request.param]


def around(obstacle: Obstacle, num: int, reach: float = 2.5) -> np.ndarray:
    """Points in the box around the ball that holds it, grown."""
    return np.asarray(obstacle.position) + reach * obstacle.radius * np.random.default_rng(0).uniform(-1, 1, (num, 3))


def within(obstacle: Obstacle, num: int) -> np.ndarray:
    points = around(obstacle, 20 * num, 1.0)
    points = points[obstacle.signed_distance(points) < 0][:num]
    assert len(points) > num / 8
    return points


def drawn(obstacle: Obstacle) -> trimesh.Trimesh:
    """As it is drawn, in the world."""
    vertices, faces = obstacle.surface()
    return trimesh.Trimesh(vertices @ rotation(obstacle.wxyz).T + obstacle.position, faces, process=False)


def steepest(obstacle) -> float:
    parts = obstacle.parts if isinstance(obstacle, Union) else (obstacle,)
    return 1.02 if any(isinstance(part, MeshObstacle | CloudObstacle) for part in parts) else 1.0


def assert_no_steeper(obstacle, points):
    before, rng = obstacle.signed_distance(points), np.random.default_rng(1)
    for step in (1e-4, 1e-2, 0.1):
        moved = points + step * rng.normal(size=points.shape)
        change = np.abs(obstacle.signed_distance(moved) - before)
        assert (change <= steepest(obstacle) * np.linalg.norm(moved - points, axis=1) + 1e-12).all()


@pytest.mark.long
def test_the_distance_changes_no_faster_than_the_point_moves(obstacle):
    assert_no_steeper(obstacle, around(obstacle, 600))


def test_inside_is_where_the_drawn_surface_has_it_and_the_surface_lies_on_the_surface(obstacle):
    surface = drawn(obstacle)
    assert (np.bincount(surface.edges_unique_inverse) % 2 == 0).all()  # closed
    assert surface.volume > 0
    points = around(obstacle, 600, 1.2)
    distance = obstacle.signed_distance(points)
    clear = np.abs(distance) > 2e-3  # a drawn circle is a polygon
    np.testing.assert_array_equal(surface.contains(points[clear]), distance[clear] < 0)
    on_it = np.asarray(trimesh.sample.sample_surface(surface, 500, seed=0)[0])
    assert np.abs(obstacle.signed_distance(on_it)).max() < 1.5e-3


@pytest.mark.long
def test_distances_are_those_of_trimesh(obstacle):
    points = around(obstacle, 120, 1.5)
    expected = -trimesh.proximity.signed_distance(drawn(obstacle), points)
    found = obstacle.signed_distance(points)
    near = np.abs(expected) < (0.03 if steepest(obstacle) > 1 else np.inf)
    np.testing.assert_allclose(found[near], expected[near], rtol=0, atol=2e-3 if steepest(obstacle) > 1 else 1e-3)
    assert (found < expected + 3e-3).all()  # never much more


@pytest.mark.long
def test_complex_steps_give_the_slope_and_change_nothing_else(obstacle):
    points = around(obstacle, 300, 1.5).reshape(3, 100, 3)
    distance, h = obstacle.signed_distance(points), 1e-6
    for axis in np.eye(3):
        shifted = obstacle.signed_distance(points + 1e-30j * axis)
        np.testing.assert_allclose(shifted.real, distance, rtol=0, atol=1e-14)
        forward = obstacle.signed_distance(points + h * axis) - distance
        backward = distance - obstacle.signed_distance(points - h * axis)
        smooth = np.abs(forward - backward) < 1e-3 * h  # no edge between the two
        assert smooth.mean() > 0.95
        slope = (forward + backward)[smooth] / (2 * h)
        np.testing.assert_allclose(shifted.imag[smooth] / 1e-30, slope, rtol=0, atol=1e-3)


def test_a_distance_does_not_depend_on_how_many_are_asked_for(obstacle):
    """More than are worked out at once, or one."""
    points = around(obstacle, 2100)
    together = obstacle.signed_distance(points)
    for k in (0, 2047, 2048):
        np.testing.assert_allclose(obstacle.signed_distance(points[k : k + 1]), together[k : k + 1], rtol=0, atol=1e-12)


@pytest.mark.long
def test_the_nearest_free_place_is_free_and_near(obstacle):
    inside = within(obstacle, 200)
    moved = Union((obstacle,)).nearest_free(inside)
    depth = -obstacle.signed_distance(inside)
    assert np.abs(obstacle.signed_distance(moved)).max() < 1e-6
    travel = np.linalg.norm(moved - inside, axis=1)
    assert (travel >= depth - 1e-9).all()
    assert (travel <= depth + 3e-3).mean() > 0.95
    outside = around(obstacle, 200, 2.0)
    outside = outside[obstacle.signed_distance(outside) >= 0]
    np.testing.assert_array_equal(Union((obstacle,)).nearest_free(outside), outside)
    one = Union((obstacle,)).nearest_free(np.asarray(obstacle.position))
    assert one.shape == (3,)
    assert obstacle.signed_distance(one) > -1e-6


def test_the_cover_covers_the_radius_holds_and_the_depth_is_that_of_the_deepest_point(obstacle):
    centres, radii = obstacle.cover()
    samples = within(obstacle, 1500)
    inside = np.concatenate([samples, drawn(obstacle).vertices])
    assert 1 <= len(centres) == len(radii) <= MAX_BALLS
    assert (np.linalg.norm(inside[:, None] - centres, axis=-1) - radii).min(axis=1).max() < 1e-9
    assert np.linalg.norm(inside - obstacle.position, axis=1).max() <= obstacle.radius + 1e-9
    assert (radii <= obstacle.radius + 1e-9).all()
    assert 0.75 * obstacle.depth < -obstacle.signed_distance(samples).min() <= obstacle.depth + 1e-9


def test_distance_and_field_move_and_turn_with_the_obstacle(obstacle):
    there, here = obstacle.moved((0.5, 0.2, -0.3), TILTED), obstacle.moved((0.0, 0.0, 0.0), UPRIGHT)
    assert type(there) is type(obstacle) and there.position == (0.5, 0.2, -0.3) and there.radius == obstacle.radius
    turn, own = rotation(there.wxyz), np.random.default_rng(0).uniform(-0.25, 0.25, (100, 3))
    placed = own @ turn.T + there.position
    np.testing.assert_allclose(there.signed_distance(placed), here.signed_distance(own), rtol=0, atol=1e-12)
    found, expected = there.field("free-space", 3.0)(placed), here.field("free-space", 3.0)(own) @ turn.T
    # the map of a ball is learned from samples, hence not quite as round
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 if there.wxyz != UPRIGHT else 1e-2)


def test_derivatives_of_the_field_are_derivatives(obstacle):
    field, points = obstacle.field("free-space", 3.0), around(obstacle, 40, 1.2)
    value, DV = field.with_jacobian(points)
    np.testing.assert_allclose(value, field(points), rtol=0, atol=1e-12)
    np.testing.assert_allclose(DV, central_differences(field, points, 1e-6), rtol=0, atol=1e-5)


@pytest.mark.parametrize("temperature", [1.0, pytest.param(3.0, marks=pytest.mark.slow), 12.0])
def test_every_point_inside_leaves_along_the_reverse_flow(obstacle, temperature):
    field = obstacle.field("free-space", temperature)
    ends = Flow.adaptive(field, 4.0, 1e-5).inverse(within(obstacle, 200))
    assert obstacle.signed_distance(ends).min() > 0


@pytest.mark.long
def test_a_motion_through_it_is_cleared(obstacle):
    along = np.array([0.6, 0.64, 0.48])
    path = np.asarray(obstacle.position) + np.array([1e-3, 2e-3, 1e-3]) + np.linspace(-0.4, 0.4, 401)[:, None] * along
    field = obstacle.field("free-space", 3.0)
    duration = clearing_duration(field, path, lambda s, _: 0.01 - obstacle.signed_distance(s), 0.05, 2.5)
    assert duration is not None and 0 < duration < 2.5


def test_equal_obstacles_are_equal_and_others_are_not(obstacle):
    same = replace(obstacle)  # pyright: ignore[reportArgumentType]
    assert same == obstacle and hash(same) == hash(obstacle)
    assert len({obstacle, same, obstacle.moved((0.0, 0.0, 0.0))}) == 2
    assert sum(other == obstacle for other in OBSTACLES.values()) == 1


@pytest.mark.parametrize("name", ["U", "scan"])
def test_what_is_resized_is_as_large_as_that_and_keeps_place_shape_and_all_that_was_computed(name):
    shape = OBSTACLES[name]
    assert isinstance(shape, MeshObstacle | CloudObstacle)
    half = shape.resized(shape.size / 2)
    assert half.size == pytest.approx(shape.size / 2) and (half.position, half.wxyz) == (shape.position, shape.wxyz)
    assert half.resized(shape.size).signed_distance(around(shape, 50)) == pytest.approx(
        shape.signed_distance(around(shape, 50)), abs=1e-12
    )
    assert np.ptp(half.surface()[0], axis=0).max() == pytest.approx(half.size)
    assert half.solid is shape.solid
    offset = around(shape, 200) - shape.position
    for quantity in (lambda o, s: o.signed_distance(s), lambda o, s: o.field("free-space", 3.0)(s)):
        whole = quantity(shape, shape.position + offset)
        np.testing.assert_allclose(quantity(half, half.position + offset / 2), whole / 2, rtol=0, atol=1e-9)


def test_boxes_of_the_same_proportions_share_one_map():
    one, other = (Box(PLACE, sizes).field("free-space", 3.0).inner for sizes in ((0.1, 0.2, 0.3), (0.15, 0.15, 0.1)))
    assert one.occupancy is other.occupancy  # pyright: ignore[reportAttributeAccessIssue]


UNIONS = {
    "of nothing else": ("cube",),
    "of blocks": ("sphere", "cylinder", "plate"),
    "of two spheres": ("sphere", "sphere"),
    "of all kinds": ("sphere", "plate", "disc", "U"),
}


@pytest.fixture(params=UNIONS, name="union")
def _union(request) -> Union:
    offsets = np.random.default_rng(3).uniform(-0.08, 0.08, (9, 3))
    places = [tuple((np.array(PLACE) + offset).tolist()) for offset in offsets]
    return Union(
        tuple(OBSTACLES[name].moved(place, TILTED) for name, place in zip(UNIONS[request.param], places, strict=False))
    )


def near_union(num):
    return np.asarray(PLACE) + np.random.default_rng(0).uniform(-0.3, 0.3, (num, 3))


def test_the_distance_of_a_union_is_that_of_its_nearest_part(union):
    points = near_union(400)
    apart = np.stack([part.signed_distance(points) for part in union.parts])
    np.testing.assert_array_equal(union.signed_distance(points), apart.min(axis=0))
    assert_no_steeper(union, points)
    assert np.isinf(Union().signed_distance(points)).all()


def test_a_union_is_left_for_free_places_and_covered_by_balls(union):
    points = near_union(300)
    inside = union.signed_distance(points) < 0
    free = union.nearest_free(points)
    assert inside.any() and union.signed_distance(free).min() >= -1e-6
    np.testing.assert_array_equal(free[~inside], points[~inside])
    centres, radii = union.cover()
    assert (np.linalg.norm(points[inside, None] - centres, axis=2) - radii).min(axis=1).max() <= 1e-6


def test_the_field_of_a_union_is_the_sum_of_its_parts(union):
    points, fields = near_union(60), [part.field("free-space", 6.0) for part in union.parts]
    value, derivative = union.field("free-space", 6.0).with_jacobian(points)
    np.testing.assert_allclose(union.field("free-space", 6.0)(points), value, rtol=0, atol=1e-12)
    np.testing.assert_allclose(value, sum(field(points) for field in fields), rtol=0, atol=1e-12)
    expected = sum(field.with_jacobian(points)[1] for field in fields)
    np.testing.assert_allclose(derivative, expected, rtol=0, atol=1e-11)
