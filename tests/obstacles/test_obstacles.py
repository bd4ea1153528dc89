"""What every obstacle promises, on one list of them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from dt_viz.flows.integrators import integrate_adaptive
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import (
    MAX_BALLS,
    UPRIGHT,
    Box,
    CloudObstacle,
    Cylinder,
    MeshObstacle,
    Obstacle,
    Quaternion,
    Sphere,
    rotation,
)
from dt_viz.obstacles.solids import Solid
from dt_viz.transforms.avoidance import clearing_duration

TILTED: Quaternion = tuple(np.roll(Rotation.from_rotvec([0.4, -0.7, 1.1]).as_quat(), 1).tolist())
PLACE = (0.1, -0.4, 0.3)


def as_solid(mesh: trimesh.Trimesh) -> Solid:
    return Solid(mesh.vertices, mesh.faces)


def extruded(corners: list[tuple[float, float]], cap: list[tuple[int, int, int]], height: float) -> Solid:
    """A prism around the origin, from its floor's corners and triangles, both counterclockwise."""
    flat, n = np.array(corners) - np.mean([np.min(corners, axis=0), np.max(corners, axis=0)], axis=0), len(corners)
    vertices = np.concatenate([np.insert(flat, 2, z, axis=1) for z in (-height / 2, height / 2)])
    walls = [[[k, (k + 1) % n, (k + 1) % n + n], [k, (k + 1) % n + n, k + n]] for k in range(n)]
    return Solid(vertices, np.concatenate([np.array(cap)[:, ::-1], np.array(cap) + n, np.reshape(walls, (-1, 3))]))


ANGLE = extruded(
    [(0.05, 0.05), (0.05, 0.15), (0.0, 0.15), (0.0, 0.0), (0.15, 0.0), (0.15, 0.05)],
    [(0, 1, 2), (0, 2, 3), (0, 3, 4), (0, 4, 5)],
    0.06,
)
U_SHAPE = extruded(
    [(0, 0), (0.15, 0), (0.15, 0.15), (0.11, 0.15), (0.11, 0.04), (0.04, 0.04), (0.04, 0.15), (0, 0.15)],
    [(0, 1, 4), (0, 4, 5), (1, 2, 4), (2, 3, 4), (0, 5, 7), (5, 6, 7)],
    0.1,
)
SCAN = Cloud(trimesh.sample.sample_surface(trimesh.creation.icosphere(4, 0.075), 3000, seed=0)[0])
SAMPLES = np.random.default_rng(0).uniform(-0.12, 0.12, (6000, 3))
LABELLED = Cloud(SAMPLES, np.abs(SAMPLES).max(axis=1) < 0.06)  # pyright: ignore[reportArgumentType]

OBSTACLES: dict[str, Obstacle] = {
    "sphere": Sphere(PLACE),
    "cube": Box(PLACE, wxyz=TILTED),
    "box 3:1": Box(PLACE, (0.3, 0.1, 0.1), TILTED),
    "plate": Box(PLACE, (0.2, 0.2, 0.03), TILTED),
    "rod": Box(PLACE, (0.04, 0.4, 0.04)),
    "cylinder": Cylinder(PLACE, 0.12, 0.2, TILTED),
    "disc": Cylinder(PLACE, 0.2, 0.03, TILTED),
    "pole": Cylinder(PLACE, 0.05, 0.4),
    "round mesh": MeshObstacle(PLACE, as_solid(trimesh.creation.icosphere(4, 0.075)), TILTED),
    "capsule": MeshObstacle(PLACE, as_solid(trimesh.creation.capsule(0.1, 0.04)), TILTED),
    "torus": MeshObstacle(PLACE, as_solid(trimesh.creation.torus(0.06, 0.025)), TILTED),
    "angle": MeshObstacle(PLACE, ANGLE),
    "U": MeshObstacle(PLACE, U_SHAPE, TILTED),
    "scan": CloudObstacle(PLACE, SCAN, TILTED),
    "labelled cloud": CloudObstacle(PLACE, LABELLED),
    "smaller U": MeshObstacle(PLACE, U_SHAPE, TILTED, 0.6),
    "larger cloud": CloudObstacle(PLACE, LABELLED, TILTED).resized(0.2),
}
obstacles = pytest.mark.parametrize("obstacle", OBSTACLES.values(), ids=OBSTACLES)


def around(obstacle: Obstacle, num: int, reach: float = 2.5, seed: int = 0) -> np.ndarray:
    """Points in the box around the ball that holds it, grown."""
    uniform = np.random.default_rng(seed).uniform(-1, 1, (num, 3))
    return np.asarray(obstacle.position) + reach * obstacle.radius * uniform


def within(obstacle: Obstacle, num: int, seed: int = 0) -> np.ndarray:
    points = around(obstacle, 40_000, 1.0, seed)
    return points[obstacle.signed_distance(points) < 0][:num]


def solid(obstacle: Obstacle) -> trimesh.Trimesh:
    """As it is drawn, in the world."""
    vertices, faces = obstacle.surface()
    return trimesh.Trimesh(vertices @ rotation(obstacle.wxyz).T + obstacle.position, faces, process=False)


@obstacles
def test_the_distance_changes_no_faster_than_the_point_moves(obstacle):
    rng = np.random.default_rng(1)
    points = around(obstacle, 2000)
    for step in (1e-4, 1e-3, 1e-2, 0.1):
        moved = points + step * rng.normal(size=points.shape)
        change = np.abs(obstacle.signed_distance(moved) - obstacle.signed_distance(points))
        steepest = 1.02 if isinstance(obstacle, MeshObstacle | CloudObstacle) else 1.0
        assert (change <= steepest * np.linalg.norm(moved - points, axis=1) + 1e-12).all()


@obstacles
def test_inside_is_where_the_drawn_surface_has_it(obstacle):
    drawn = solid(obstacle)
    assert (np.bincount(drawn.edges_unique_inverse) % 2 == 0).all()  # closed
    assert drawn.volume > 0
    points = around(obstacle, 1500, 1.2)
    distance = obstacle.signed_distance(points)
    clear = np.abs(distance) > 2e-3  # a drawn circle is a polygon
    np.testing.assert_array_equal(drawn.contains(points[clear]), distance[clear] < 0)


@obstacles
def test_the_surface_lies_on_the_surface(obstacle):
    drawn = solid(obstacle)
    points = trimesh.sample.sample_surface(drawn, 500, seed=0)[0]
    assert np.abs(obstacle.signed_distance(np.asarray(points))).max() < 1.5e-3


@obstacles
def test_a_moved_obstacle_has_the_moved_distance(obstacle):
    there = obstacle.moved((0.5, 0.2, -0.3), TILTED)
    own = np.random.default_rng(0).uniform(-0.3, 0.3, (200, 3))
    placed = own @ rotation(there.wxyz).T + there.position
    expected = obstacle.moved((0.0, 0.0, 0.0), UPRIGHT).signed_distance(own)
    np.testing.assert_allclose(there.signed_distance(placed), expected, rtol=0, atol=1e-12)
    assert type(there) is type(obstacle)
    assert there.position == (0.5, 0.2, -0.3)
    assert there.radius == obstacle.radius


@obstacles
def test_complex_steps_give_the_slope(obstacle):
    points = around(obstacle, 300, 1.5)
    h = 1e-6
    for axis in np.eye(3):
        exact = obstacle.signed_distance(points + 1e-30j * axis).imag / 1e-30
        forward = obstacle.signed_distance(points + h * axis) - obstacle.signed_distance(points)
        backward = obstacle.signed_distance(points) - obstacle.signed_distance(points - h * axis)
        smooth = np.abs(forward - backward) < 1e-3 * h  # no edge between the two
        assert smooth.mean() > 0.95
        np.testing.assert_allclose(exact[smooth], (forward + backward)[smooth] / (2 * h), rtol=0, atol=1e-3)


@obstacles
def test_the_distance_of_complex_points_is_that_of_their_real_part(obstacle):
    points = around(obstacle, 300).reshape(3, 100, 3)
    shifted = obstacle.signed_distance(points + 1e-30j)
    assert shifted.shape == (3, 100)
    np.testing.assert_allclose(shifted.real, obstacle.signed_distance(points), rtol=0, atol=1e-14)


@obstacles
def test_a_distance_does_not_depend_on_how_many_are_asked_for(obstacle):
    """More than are worked out at once, or one."""
    points = around(obstacle, 5000)
    together = obstacle.signed_distance(points)
    for k in (0, 1, 2047, 2048, 4999):
        np.testing.assert_allclose(obstacle.signed_distance(points[k : k + 1]), together[k : k + 1], rtol=0, atol=1e-12)


@obstacles
def test_the_nearest_free_place_is_free_and_near(obstacle):
    inside = within(obstacle, 200)
    moved = obstacle.nearest_free(inside)
    depth = -obstacle.signed_distance(inside)
    assert np.abs(obstacle.signed_distance(moved)).max() < 1e-6
    travel = np.linalg.norm(moved - inside, axis=1)
    assert (travel >= depth - 1e-9).all()
    assert (travel <= depth + 3e-3).mean() > 0.95
    outside = around(obstacle, 200, 2.0)
    outside = outside[obstacle.signed_distance(outside) >= 0]
    np.testing.assert_array_equal(obstacle.nearest_free(outside), outside)
    one = obstacle.nearest_free(np.asarray(obstacle.position))
    assert one.shape == (3,)
    assert obstacle.signed_distance(one) > -1e-6


@obstacles
def test_the_cover_covers_and_the_radius_holds(obstacle):
    centres, radii = obstacle.cover()
    inside = np.concatenate([within(obstacle, 2000), solid(obstacle).vertices])
    assert 1 <= len(centres) == len(radii) <= MAX_BALLS
    apart = np.linalg.norm(inside[:, None] - centres, axis=-1) - radii
    assert apart.min(axis=1).max() < 1e-9
    assert np.linalg.norm(inside - obstacle.position, axis=1).max() <= obstacle.radius + 1e-9
    assert (radii <= obstacle.radius + 1e-9).all()


@obstacles
def test_the_depth_is_that_of_the_deepest_point(obstacle):
    deepest = -obstacle.signed_distance(within(obstacle, 40_000)).min()
    assert 0.8 * obstacle.depth < deepest <= obstacle.depth + 1e-9


@obstacles
@pytest.mark.parametrize("temperature", [1.0, 3.0, 12.0])
def test_every_point_inside_leaves_along_the_reverse_flow(obstacle, temperature):
    field = obstacle.field("free-space", temperature)
    ends, _ = integrate_adaptive(field, within(obstacle, 300), None, -4.0, 1e-5)
    assert obstacle.signed_distance(ends).min() > 0


@obstacles
def test_a_motion_through_it_is_cleared(obstacle):
    along = np.array([0.6, 0.64, 0.48])
    path = np.asarray(obstacle.position) + np.array([1e-3, 2e-3, 1e-3]) + np.linspace(-0.4, 0.4, 401)[:, None] * along
    duration = clearing_duration(obstacle.field("free-space", 3.0), obstacle, path, 0.01)
    assert duration is not None
    assert 0 < duration < 2.5


@obstacles
def test_the_field_moves_and_turns_with_the_obstacle(obstacle):
    there = obstacle.moved((0.5, 0.2, -0.3), TILTED)
    here = obstacle.moved((0.0, 0.0, 0.0), UPRIGHT)
    turn = rotation(there.wxyz)
    own = np.random.default_rng(0).uniform(-0.2, 0.2, (50, 3))
    expected = here.field("free-space", 3.0)(own) @ turn.T
    found = there.field("free-space", 3.0)(own @ turn.T + there.position)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-12 if there.wxyz != UPRIGHT else 1e-2)


@obstacles
def test_derivatives_of_the_field_are_derivatives(obstacle):
    field = obstacle.field("free-space", 3.0)
    points, h = around(obstacle, 50, 1.2), 1e-6
    value, DV = field.with_jacobian(points)
    np.testing.assert_allclose(value, field(points), rtol=0, atol=1e-12)
    for i, axis in enumerate(np.eye(3)):
        difference = (field(points + h * axis) - field(points - h * axis)) / (2 * h)
        np.testing.assert_allclose(DV[..., i], difference, rtol=0, atol=1e-5)


@obstacles
def test_equal_obstacles_are_equal_and_others_are_not(obstacle):
    same = replace(obstacle)
    assert same == obstacle
    assert hash(same) == hash(obstacle)
    assert len({obstacle, same, obstacle.moved((0.0, 0.0, 0.0))}) == 2
    assert all(other == obstacle for other in OBSTACLES.values() if other is obstacle)
    assert sum(other == obstacle for other in OBSTACLES.values()) == 1


@pytest.mark.parametrize("name", list(OBSTACLES))
def test_distances_outside_and_inside_are_those_of_trimesh(name):
    obstacle = OBSTACLES[name]
    points = around(obstacle, 300, 1.5)
    expected = -trimesh.proximity.signed_distance(solid(obstacle), points)
    near = np.abs(expected) < 0.03
    np.testing.assert_allclose(obstacle.signed_distance(points)[near], expected[near], rtol=0, atol=2e-3)
    if not isinstance(obstacle, MeshObstacle | CloudObstacle):
        np.testing.assert_allclose(obstacle.signed_distance(points), expected, rtol=0, atol=1e-3)
    assert (obstacle.signed_distance(points) < expected + 3e-3).all()  # never much more


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
    assert one.inner.occupancy is other.inner.occupancy  # pyright: ignore[reportAttributeAccessIssue]
