"""Collision truth against brute force, trimesh and pinocchio."""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from functools import lru_cache

import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from laws.registry import TILTED, U_SHAPE, as_solid
from pinocchio_arm import pinocchio_configuration, pinocchio_model, placed_vertices, random_configurations

from dt_viz.obstacles.shapes import Box, Capsule, Cylinder, MeshObstacle, Sphere
from dt_viz.obstacles.union import Union
from dt_viz.robot.collision import NOTHING, SELF_REACH, CollisionModel, CollisionReport, Nearest
from dt_viz.robot.inverse_kinematics import inverse_kinematics, track
from dt_viz.robot.link_distances import RESOLUTION, SHAPE_TOLERANCE, TOLERANCE
from dt_viz.robot.models import load_jaco
from dt_viz.robot.urdf import LinkMesh
from dt_viz.warning import ARM, Kind, MotionWarning

FOLDED = np.array([0.0, np.pi, 0.5, 0.0, 5.7, 0.0])  # the hand in the upper arm
seeds = st.integers(0, 2**32 - 1)


@pytest.fixture(scope="module")
def model() -> CollisionModel:
    return load_jaco().collision


@lru_cache(maxsize=1)
def solids() -> tuple[trimesh.Trimesh, ...]:
    return tuple(trimesh.Trimesh(mesh.vertices, mesh.faces, process=False) for mesh in load_jaco().meshes)


def some_configurations(seed: int, num: int) -> np.ndarray:
    return random_configurations(load_jaco(), seed, (num,))


def random_path(seed: int, num: int = 12) -> np.ndarray:
    """Samples that lie up to 0.2 rad apart."""
    start, end = some_configurations(seed, 2)
    return start + np.linspace(0.0, 2.0 / np.abs(end - start).max(), num)[:, None] * (end - start)


def finely(q: np.ndarray, num: int = 600) -> np.ndarray:
    return np.stack([np.interp(np.linspace(0, len(q) - 1, num), np.arange(len(q)), angles) for angles in q.T], axis=1)


def in_frame(mesh: LinkMesh, q: np.ndarray, point: np.ndarray) -> np.ndarray:
    """A point (3,) of the base frame, in the frame of the link's joint."""
    if mesh.joint < 0:
        return point
    rotations, origins = load_jaco().collision.robot.forward_kinematics(q)
    return rotations[mesh.joint].T @ (point - origins[mesh.joint])


class TestObstacle:
    @pytest.mark.parametrize("seed", range(2))
    @pytest.mark.parametrize("diameter", [0.02, 0.15, 0.6])
    def test_distances_are_those_of_the_nearest_triangle(self, model, seed, diameter):
        """Also where the ball cuts a link, swallows one, or lies within one."""
        rng = np.random.default_rng(seed)
        q = some_configurations(seed, 6)
        vertices = [rng.choice(np.concatenate(placed_vertices(one))) for one in q]
        for one, vertex in zip(q, vertices, strict=True):
            centre = vertex + rng.normal(scale=0.03, size=3)
            local = [in_frame(mesh, one, centre) for mesh in load_jaco().meshes]
            expected = []
            for solid, point in zip(solids(), local, strict=True):
                gap = trimesh.proximity.closest_point_naive(solid, point[None])[1][0]
                inside = solid.ray.contains_points(point[None])[0]
                expected.append((0.0 if inside else gap) - diameter / 2)
            distance, nearest = model.obstacle_distance(one[None], Sphere(tuple(centre), diameter))
            np.testing.assert_allclose(distance[0], min(expected), atol=1e-6)
            np.testing.assert_allclose(expected[nearest[0]], min(expected), atol=1e-6)

    def test_a_ball_within_a_link_is_as_deep_as_it_can_be_and_one_far_away_is_clear(self, model, robot):
        rotations, origins = robot.forward_kinematics(robot.home)
        inside = origins[1] + rotations[1] @ model.links[2].centre
        report = model.report(robot.home[None], Sphere(tuple(inside), 0.01))
        assert report.obstacle == Nearest(-0.005, ("link 2",), 0.0)
        assert report.depth == 0.005
        far_away = model.report(robot.home[None], Sphere((2.0, 0.0, 0.0)))
        assert far_away.depth == 0.0 and far_away.obstacle.distance > 1.0
        assert far_away.warnings == ()


PLACES = [(0.0, 0.0, 0.0), (0.0, 0.0, 0.3), (0.12, 0.1, 0.1), (0.05, 0.0, 0.12)]
SHAPES = [
    Box((0.0, 0.0, 0.0), (0.15, 0.15, 0.15), TILTED),
    Box((0.0, 0.0, 0.0), (0.2, 0.2, 0.03), TILTED),
    Cylinder((0.0, 0.0, 0.0), 0.12, 0.2, TILTED),
    Capsule((0.0, 0.0, 0.0), 0.1, 0.24, TILTED),
    MeshObstacle((0.0, 0.0, 0.0), U_SHAPE, TILTED),
]


class TestShapes:
    @pytest.mark.parametrize(
        ("shape", "place"), [*((SHAPES[0], place) for place in PLACES), *zip(SHAPES[1:], PLACES, strict=True)]
    )
    def test_distances_are_those_of_dense_points(self, model, robot, shape, place):
        """Of the arm outside, and of random points within both inside."""
        centre = robot.end_effector(robot.home) + np.array(place)
        obstacle = shape.moved(tuple(centre), shape.wxyz)
        found = model.obstacle_distance(robot.home[None], obstacle)[0][0]
        blur = 2e-3 if isinstance(shape, MeshObstacle) else 1e-6
        rotations, origins = robot.forward_kinematics(robot.home)
        points = [solid.sample(4000, seed=0) for solid in solids()]  # on the surface
        inside = centre + np.random.default_rng(0).uniform(-1, 1, (3000, 3)) * obstacle.radius
        inside = inside[obstacle.signed_distance(inside) < -blur]
        common, outer = [], []
        for mesh, solid, surface in zip(load_jaco().meshes, solids(), points, strict=True):
            turn, origin = (np.eye(3), np.zeros(3)) if mesh.joint < 0 else (rotations[mesh.joint], origins[mesh.joint])
            outer.append(np.concatenate([np.asarray(surface), mesh.vertices]) @ turn.T + origin)
            local = (inside - origin) @ turn
            near = ((local > solid.bounds[0]) & (local < solid.bounds[1])).all(axis=1)
            common.append(inside[near][solid.ray.contains_points(local[near])] if near.any() else inside[:0])
        smallest = obstacle.signed_distance(np.concatenate(outer)).min()
        assert found <= smallest + (blur if smallest > 0 else RESOLUTION)
        deepest = obstacle.signed_distance(np.concatenate(common)).min(initial=np.inf)
        assert found <= deepest + RESOLUTION
        assert found >= min(smallest, deepest) - 5e-3  # the points are that dense
        assert (found > 0) == (min(smallest, deepest) > 0)

    @pytest.mark.long
    @pytest.mark.parametrize("kind", ["box", "mesh"])
    def test_shapes_within_a_link_and_around_the_hand(self, model, robot, kind):
        def cube(centre, size):
            if kind == "box":
                return Box(tuple(centre), (size, size, size))
            mesh = trimesh.creation.box((size, size, size))
            return MeshObstacle(tuple(centre), as_solid(mesh))

        rotations, origins = robot.forward_kinematics(robot.home)
        middle = origins[1] + rotations[1] @ model.links[2].centre
        within = model.report(robot.home[None], cube(middle, 0.02)).obstacle
        assert within.links == ("link 2",)
        np.testing.assert_allclose(within.distance, -0.01, atol=RESOLUTION)
        centre = robot.end_effector(robot.home)
        around = model.report(robot.home[None], cube(centre, 0.5)).obstacle
        assert -0.25 <= around.distance < -0.2

    @pytest.mark.parametrize("shape", SHAPES, ids=["cube", "plate", "cylinder", "capsule", "U"])
    def test_nothing_nearer_is_found_by_fine_sampling(self, model, robot, shape):
        for seed in range(2):
            q = random_path(seed)
            centre = robot.forward_kinematics(q[len(q) // 2])[1][seed] + np.array([0.1, 0.0, 0.05])
            obstacle = shape.moved(tuple(centre), shape.wxyz)
            found = model.nearest_to_obstacle(q, obstacle).distance
            fine = model.obstacle_distance(finely(q, 60), obstacle)[0].min()
            assert found <= fine + SHAPE_TOLERANCE + 1e-9
            assert found >= fine - 0.03  # between two of the fine samples


class TestBetweenSamples:
    @pytest.mark.long
    @settings(max_examples=15)
    @given(seed=seeds, diameter=st.floats(0.02, 0.4), growth=st.floats(0.001, 0.2))
    def test_nothing_nearer_is_found_by_fine_sampling_and_what_is_found_is_there(self, seed, diameter, growth):
        model, q = load_jaco().collision, random_path(seed)
        middle = model.robot.forward_kinematics(q[len(q) // 2])[1]
        ball = Sphere(tuple(middle[seed % 6] + np.array([0.1, 0.0, 0.05])), diameter)
        found = model.nearest_to_obstacle(q, ball)
        fine = model.obstacle_distance(finely(q), ball)[0].min()
        assert fine - 0.01 <= found.distance <= fine + TOLERANCE  # between two of the fine samples
        there = np.stack([np.interp([found.at], np.arange(len(q)), angles) for angles in q.T], axis=1)
        distance, nearest = model.obstacle_distance(there, ball)
        np.testing.assert_allclose(distance[0], found.distance, atol=1e-9)
        assert found.links == (model.links[nearest[0]].name,)
        larger = model.nearest_to_obstacle(q, Sphere(ball.position, diameter + growth)).distance
        np.testing.assert_allclose(found.distance - larger, growth / 2, atol=2 * TOLERANCE)

    @settings(max_examples=15)
    @given(seed=seeds, share=st.floats(0.0, 1.0), others=st.integers(0, 2))
    def test_only_what_is_below_a_distance_is_found_and_of_several_obstacles_the_nearest(self, seed, share, others):
        model, q = load_jaco().collision, random_path(seed)
        places = model.robot.forward_kinematics(q[len(q) // 2])[1][seed % 3 :]
        balls = [Sphere(tuple(place + np.array([0.1, 0.0, 0.05])), 0.1) for place in places[: 1 + others]]
        nearest = min((model.nearest_to_obstacle(q, ball) for ball in balls), key=lambda near: near.distance)
        found = model.nearest_to_obstacle(q, Union(tuple(balls)), nearest.distance + 1e-3 + 0.2 * share)
        np.testing.assert_allclose(found.distance, nearest.distance, atol=2 * TOLERANCE)
        assert model.nearest_to_obstacle(q, Union(tuple(balls)), nearest.distance - 1e-3 - 0.2 * share) is NOTHING

    def test_reach_bounds_the_distance_from_the_axes(self, model):
        largest = np.zeros_like(model.reach)
        rotations, origins = model.robot.forward_kinematics(some_configurations(0, 300))
        for k, link in enumerate(model.links):
            for i in range(link.frame):
                points = link.hull @ rotations[:, link.frame - 1].transpose(0, 2, 1) + origins[:, None, link.frame - 1]
                across = np.cross(rotations[:, None, i, :, 2], points - origins[:, None, i])
                largest[k, i] = np.linalg.norm(across, axis=-1).max()
        assert (largest <= model.reach + 1e-12).all()
        assert (largest >= 0.6 * model.reach).all()
        assert (np.diff(model.reach, axis=1) <= 0).all()


class TestItself:
    @pytest.mark.parametrize("seed", range(5))
    def test_distances_are_those_of_pinocchio(self, model, seed):
        pinocchio, data, shapes, shape_data = pinocchio_model()
        q = FOLDED + np.random.default_rng(seed).normal(scale=0.25, size=6)
        pin.computeDistances(pinocchio, data, shapes, shape_data, pinocchio_configuration(q))
        expected = max(0.0, min(result.min_distance for result in shape_data.distanceResults))
        found = model.nearest_to_itself(q[None])
        if expected >= SELF_REACH:
            assert found is None
        else:
            np.testing.assert_allclose(found.distance, expected, atol=1e-9)

    def test_folded_into_itself(self, model):
        report = model.report(FOLDED[None], Sphere((2.0, 0.0, 0.0)))
        assert report.itself == Nearest(0.0, ("link 2", "link 6"), 0.0)
        assert [str(warning) for warning in report.warnings] == ["link 6 hits link 2"]

    def test_found_between_samples(self, model):
        folded = np.array([0.0, np.pi, 0.5, np.pi, 1.5, 0.0])
        ends = folded + np.array([[-1.5], [1.5]]) * np.eye(6)[3]  # the wrist turns through the upper arm
        for end in ends:
            found = model.nearest_to_itself(end[None])
            assert found is None or found.distance > 0.02
        assert model.nearest_to_itself(ends).distance == 0.0

    @settings(max_examples=8)
    @given(seed=seeds)
    def test_nothing_nearer_is_found_by_fine_sampling(self, seed):
        model, q = load_jaco().collision, random_path(seed)
        found = model.nearest_to_itself(q)
        for one in finely(q, 30):
            alone = model.nearest_to_itself(one[None])
            if alone:
                assert found
                assert found.distance <= alone.distance + SHAPE_TOLERANCE


class TestTable:
    @settings(max_examples=10)
    @given(seed=seeds)
    def test_heights_are_those_of_the_vertices(self, seed):
        q = some_configurations(seed, 1)
        lowest = [vertices[:, 2].min() for vertices in placed_vertices(q[0])]
        found = load_jaco().collision.nearest_to_table(q)
        np.testing.assert_allclose(found.distance, min(lowest[2:]), atol=1e-9)

    def test_a_hand_below_the_table_is_named(self, model, robot):
        path = np.linspace([0.0, -0.5, 0.3], [0.0, -0.5, -0.05], 20)
        q = track(robot, path, inverse_kinematics(robot, path[0])).q
        report = model.report(q, Sphere((2.0, 0.0, 0.0)))
        assert report.table.links[0].startswith("finger tip")
        assert report.table.at == 19.0
        assert report.table.distance < -0.04
        (warning,) = report.warnings
        below = f"{-1e3 * report.table.distance:.0f} mm below the table"
        assert warning == MotionWarning(Kind.ARM_BELOW_TABLE, f"{report.table.links[0]} is {below}", ARM)

    @settings(max_examples=10)
    @given(seed=seeds)
    def test_nothing_lower_is_found_by_fine_sampling(self, seed):
        model, q = load_jaco().collision, random_path(seed)
        found = model.nearest_to_table(q).distance
        assert found <= min(model.nearest_to_table(one[None]).distance for one in finely(q, 40)) + TOLERANCE


def test_the_report_says_what_is_wrong():
    bad = CollisionReport(
        Nearest(-0.0124, ("link 3",), 1.0), Nearest(0.004, ("base", "link 5"), 0.0), Nearest(-0.03, ("link 6",), 2.5)
    )
    assert bad.depth == 0.0124
    assert bad.warnings == (
        MotionWarning(Kind.ARM_ENTERS, "link 3 enters the obstacle by 12 mm", ARM),
        MotionWarning(Kind.ARM_HITS_ITSELF, "link 5 comes within 4 mm of base", ARM),
        MotionWarning(Kind.ARM_BELOW_TABLE, "link 6 is 30 mm below the table", ARM),
    )
    good = CollisionReport(Nearest(0.02, ("link 3",), 1.0), Nearest(0.03, ("base", "link 5"), 0.0), bad.obstacle)
    assert good.depth == 0.0
