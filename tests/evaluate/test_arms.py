"""The table of arms: clearances are those of the true shapes, and balls that no arm can pass are told from others."""

# pyright: reportAttributeAccessIssue=false
# (coal and pinocchio have no stubs)

import json
from dataclasses import replace

import coal  # noqa: TID251, here it is the oracle
import numpy as np
import pinocchio as pin  # noqa: TID251
import pytest

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.evaluate.around import measured
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.models import load_arm, urdf_path
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.tasks_in_reach import in_reach
from tests.benchmarks import arms
from tests.benchmarks.__main__ import main
from tests.benchmarks.arms import Passage
from tests.benchmarks.passable import PassableSettings, has_way, postures_at

TASK = "push_box"


@pytest.fixture(scope="module")
def small(fits_of_the_tests):
    return load_arm("so100")


@pytest.fixture(scope="module")
def small_engine(small, fits):
    return Engine(in_reach(TASKS, small), fits, small)


@pytest.fixture(scope="module")
def ball(small, small_engine):
    """A ball in the way of the small arm's hand."""
    middle = small_engine.task(TASK).mean_path[50] + [0, 0, 0.06 * small.size]
    return Sphere(as_point(middle), 0.1 * small.size)


def on_urdf(robot, q, ball):
    """Smallest distance of the URDF's collision shapes, as pinocchio reads them, from a ball at postures q (T, n)."""
    path = urdf_path(robot.name)
    model = pin.buildModelFromUrdf(str(path))
    folders = [str(folder) for folder in robot.package_dirs]
    shapes = pin.buildGeomFromUrdf(model, str(path), pin.GeometryType.COLLISION, package_dirs=folders)
    data, placed, centre = model.createData(), pin.GeometryData(shapes), robot.base.T @ np.asarray(ball.position)
    joints, full, least = [model.joints[model.getJointId(name)] for name in robot.joint_names], pin.neutral(model), []
    for posture in q:
        for joint, angle in zip(joints, posture, strict=True):
            values = [np.cos(angle), np.sin(angle)] if joint.nq == 2 else [angle]
            full[joint.idx_q : joint.idx_q + joint.nq] = values
        pin.updateGeometryPlacements(model, data, shapes, placed, full)
        for shape, at in zip(shapes.geometryObjects, placed.oMg, strict=True):
            place = coal.Transform3s(at.rotation, at.translation)
            where = coal.Transform3s(np.eye(3), centre)
            asked, told = coal.DistanceRequest(), coal.DistanceResult()
            least.append(coal.distance(shape.geometry, place, coal.Sphere(ball.radius), where, asked, told))
    return min(least)


@pytest.mark.long
def test_clearance_is_that_of_the_urdfs_shapes_whatever_the_spheres_are_that_the_arm_avoids_with(robot, engine, fits):
    task = engine.task(TASK)
    ball = Sphere(as_point(task.mean_path[50] + [0, 0, 0.14]), 0.1)
    place = measured(engine, task, ArmAvoidance(ball))
    q = np.concatenate([motion.q for motion in place.motions.values()])[::5]
    assert place.without < 0 and place.clearance > 9e-3
    assert on_urdf(robot, q, ball) == pytest.approx(place.clearance, abs=1e-3)

    thin = robot.body.spheres.copy()
    thin["radius"] *= 0.3
    deceived = replace(robot, body=BodyPoints(thin))
    place = measured(Engine(TASKS, fits, deceived), task, ArmAvoidance(ball))
    q = np.concatenate([motion.q for motion in place.motions.values()])[::5]
    assert deceived.body.clearance(deceived, q, ball).min() > 8e-3  # so it believes
    assert place.clearance < 5e-3 and on_urdf(robot, q, ball) == pytest.approx(place.clearance, abs=2e-3)


@pytest.mark.long
def test_the_command_has_a_row_for_each_arm_and_writes_what_it_is_made_from(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(arms, "NUM_FRAMES", 4)
    out, tables = tmp_path / "arms.npz", tmp_path / "tables.json"
    given = ["--arm", "jaco", "so100", "--task", TASK, "--count", "2", "--seed", "5", "--out", str(out)]
    assert main(["arms", *given, "--tables", str(tables)]) == 0
    ((first, second),) = json.loads(tables.read_text())["tables"]
    assert (first["arm"], first["joints"], second["arm"], second["joints"]) == ("JACO", 6, "SO-100", 5)
    lines = capsys.readouterr().out.splitlines()
    assert sum(line.startswith(("jaco ", "so100 ")) for line in lines) == 4
    assert [line[:2] for line in lines[-4:]] == ["| "] * 4 and set(lines[-3]) <= set("| -:")
    with np.load(out) as written:
        arrays = dict(written)
    for name, row in (("jaco", first), ("so100", second)):
        robot = load_arm(name)
        assert row["tasks followed"] == "1 of 1" and row["off mm"] < 1 and row["first s"] is None
        assert 0 < row["frame × JACO"] < 5 and 2 < row["cover mm"] < 5
        moving, starts, clearance = (arrays[f"{name}_{key}"] for key in ("num_moving", "num_starts", "clearance"))
        assert row["cleared"] == f"{((moving == starts) & (clearance >= 9e-3)).sum()} of 2"
        assert row["least mm"] == pytest.approx(1e3 * clearance.min())
        assert row["loop at goal"] == f"{(arrays[f'{name}_missed'] < 1e-3).sum()} of 2"
        diameters = 2 * arrays[f"{name}_ball"][:, 3] / robot.size
        assert ((diameters > 0.06) & (diameters < 0.16)).all()


def test_what_is_missed_counts_against_an_arm():
    cleared = Passage("draw_s", (0.0, 0.0, 0.0, 0.1), 0, 7, 7, -1e-3, 0.011, 1e-5, 0.012)
    others = (
        replace(cleared, lacking=1.1e-3, clearance=8.9e-3),
        replace(cleared, num_moving=6),
        replace(cleared, num_moving=0, lacking=np.nan, clearance=np.nan, missed=np.nan, loop=np.nan, has_way=True),
    )
    assert cleared.is_cleared and not any(passage.is_cleared for passage in others)
    row = arms._row([cleared, *others, replace(cleared, missed=2e-3, loop=-1e-3, drawn_again=3)])
    assert row["cleared"] == "2 of 5" and row["loop at goal"] == "3 of 5" and row["least mm"] == pytest.approx(8.9)
    assert (row["some starts"], row["no way"], row["others with a way"], row["drawn again"]) == (1, 1, None, 3)
    assert row["loop least mm"] == pytest.approx(-1)
    none = replace(others[-1], has_way=False)  # no motion at all
    row = arms._row([none, *(replace(other, has_way=True) for other in others)])
    assert (row["others with a way"], arms._row([cleared])["others with a way"]) == (3, 0)
    assert np.isnan(arms._row([none])["least mm"]) and arms._row([none])["others with a way"] == 0


@pytest.mark.long
def test_balls_at_the_goal_the_base_or_around_the_hand_are_told_from_those_that_can_be_passed(
    small, small_engine, ball
):
    ends = small_engine.nominal(Scenario(TASK)).learned.demonstrated.ends
    few = PassableSettings(num_postures=100, seconds=5.0)

    def found(ball):
        return postures_at(small, ends, ArmAvoidance(ball), np.random.default_rng(0), few)

    postures = found(ball)
    assert postures is not None and len(postures) == len(ends)
    np.testing.assert_allclose(small.end_effector(postures), ends, atol=1e-3)
    assert small.collision.obstacle_distance(postures, ball)[0].min() >= 0.01 - 1e-4
    size = 0.1 * small.size
    assert found(Sphere(as_point(ends[-1]), size)) is None and found(Sphere(as_point(ends[2]), size)) is None
    assert found(Sphere((0.0, 0.0, 0.02), size)) is None  # in the base
    away = ends[-1] + (small.shoulder - ends[-1]) / np.linalg.norm(small.shoulder - ends[-1]) * 0.06
    assert found(Sphere(as_point(away), 0.1)) is None  # where the wrist has to be


def test_a_planner_that_knows_nothing_of_ours_tells_whether_there_is_a_way(small, small_engine, ball):
    pytest.importorskip("ompl", reason="ompl is an extra")
    ends = small_engine.nominal(Scenario(TASK)).learned.demonstrated.ends
    few = PassableSettings(num_postures=100, seconds=5.0)
    postures = postures_at(small, ends, ArmAvoidance(ball), np.random.default_rng(0), few)
    assert postures is not None and has_way(small, ball, 0.01, postures, few)
    walls = Sphere(ball.position, 4 * np.linalg.norm(ends[-1] - ends[0]))
    assert not has_way(small, walls, 0.01, postures, replace(few, seconds=0.3))
