"""Arms by name and from files: what is found of them holds, is kept, and two are there at once."""

# pyright: reportAttributeAccessIssue=false
# (coal has no stubs)

from dataclasses import replace
from pathlib import Path
from typing import Literal

import coal  # noqa: TID251, here it is the oracle
import numpy as np
import pinocchio as pin  # noqa: TID251, here it is the oracle
import pytest
import trimesh
from arm_files import link, random_postures, urdf, write
from scipy.spatial import KDTree

import dt_viz as dt
from dt_viz.control.controller import ArmController
from dt_viz.folders import default_cache_folder
from dt_viz.learning.store import FitStore
from dt_viz.motion.stack import LIVE
from dt_viz.robot import models, placement
from dt_viz.robot.body_points import PROTRUSION
from dt_viz.robot.choices import Ranges, find_touching, semantic_homes
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.cover import CoverSettings, cover, protrusion
from dt_viz.robot.inverse_kinematics import UnreachableError, track
from dt_viz.robot.models import ARMS, load_arm, load_jaco, robot_from_urdf, to_arrays, urdf_path
from dt_viz.robot.placement import follows, place
from dt_viz.robot.robot import Robot
from dt_viz.robot.urdf import LinkMesh, read_robot
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine
from dt_viz.session.tasks_in_reach import in_reach

QUICK = ("so100", "xarm7")
OTHERS = [name if name in QUICK else pytest.param(name, marks=pytest.mark.slow) for name in ARMS if name != "jaco"]
each_arm = pytest.mark.parametrize("name", OTHERS)


@pytest.fixture(scope="module", autouse=True)
def _arms_of_the_tests(cache):
    """Arms are made once for the whole test run."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield


def on_surface(mesh, num=20_000):
    """All vertices, and points spread evenly over the triangles."""
    rng, corners = np.random.default_rng(0), mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    chosen = corners[rng.choice(len(areas), num, p=areas / areas.sum())]
    return np.concatenate([mesh.vertices, np.einsum("nk,nkd->nd", rng.dirichlet(np.ones(3), num), chosen)])


def beyond(robot: Robot, mesh) -> float:
    """How far the surface of a link is outside the smallest spheres of its joint at most, metres."""
    spheres = robot.body.spheres
    own = spheres[(spheres["joint"] == mesh.joint) & (spheres["end"] == np.arange(len(spheres)) + 1)]
    points = on_surface(mesh)
    for num in (20, len(own)):  # most points are in one of the nearest
        _, near = KDTree(own["offset"]).query(points, min(num, len(own)))
        away = np.linalg.norm(points[:, None] - own["offset"][near], axis=2) - own["radius"][near]
        points = points[away.min(axis=1) > 0]
        if not len(points):
            return 0.0
    return float(away.min(axis=1).max())


@pytest.mark.long
@pytest.mark.parametrize("name", ["jaco", *OTHERS])
def test_spheres_hold_the_links_and_stick_out_by_little(name):
    robot = load_arm(name)
    assert max(beyond(robot, mesh) for mesh in robot.meshes) <= 1e-5  # between the points that the radii hold
    mean, most = protrusion(robot.body.spheres, robot.meshes, 1e-3 if name == "jaco" else 2e-3)
    if name == "jaco":
        assert mean < 3.5e-3 and most < PROTRUSION + 4e-4 and len(robot.body.joint) == 29
    else:
        assert mean < 5e-3 and most < 0.03 and f"{1e3 * mean:.1f} mm in the mean" in robot.report()
    wide = robot.body.spheres.copy()
    wide["radius"] += 3e-3
    assert protrusion(wide, robot.meshes)[0] > mean + 2e-3
    ends = robot.body.spheres["end"]
    assert (ends > np.arange(len(ends))).all() and (np.diff(robot.body.spheres["joint"]) >= 0).all()
    for k in np.flatnonzero(ends > np.arange(len(ends)) + 1):
        held, own = robot.body.spheres[k : ends[k]], robot.body.spheres[k]
        held = held[held["end"] == k + np.arange(len(held)) + 1]  # the smallest
        away = np.linalg.norm(held["offset"] - own["offset"], axis=1) + held["radius"]
        assert away.max() <= own["radius"] + 5e-5  # by rounding


@each_arm
def test_home_is_within_the_limits_ahead_and_free_of_the_arm_itself_on_the_true_shapes(name):
    robot = load_arm(name)
    assert ((robot.home > robot.lower) & (robot.home < robot.upper)).all()
    x, y, z = robot.end_effector(robot.home)
    assert -y > 0.25 * robot.reach and abs(x) < 0.3 * robot.reach and z > 0
    assert float(robot.chain(robot.home[:, None]).manipulability()[0]) > 0.05 * robot.reach**3
    rotations, origins = robot.forward_kinematics(robot.home)
    shapes = []
    for mesh in robot.meshes:  # triangles anew for coal: nothing of ours but the vertices
        solid = coal.BVHModelOBBRSS()
        solid.beginModel(len(mesh.faces), len(mesh.vertices))
        solid.addVertices(mesh.vertices)
        solid.addTriangles(mesh.faces)
        solid.endModel()
        turn, origin = (np.eye(3), np.zeros(3)) if mesh.joint < 0 else (rotations[mesh.joint], origins[mesh.joint])
        shapes.append((mesh, solid, coal.Transform3s(turn, origin)))
    compared = 0
    for k, (mesh, solid, at) in enumerate(shapes):
        for other, other_solid, other_at in shapes[:k]:
            if abs(mesh.joint - other.joint) > 1 and frozenset((mesh.name, other.name)) not in robot.touching:
                compared += 1
                assert not coal.collide(
                    solid, at, other_solid, other_at, coal.CollisionRequest(), coal.CollisionResult()
                )
    assert compared > 5


@each_arm
def test_levers_are_those_of_the_hand_near_home(name):
    robot = load_arm(name)
    assert (robot.levers >= 0.04 * robot.reach - 1e-12).all() and (robot.levers < robot.reach + 0.3).all()
    near = robot.clip(robot.home + 0.35 * np.random.default_rng(5).normal(size=(2000, robot.num_joints)))
    moved = np.sqrt((np.linalg.norm(robot.jacobian(near), axis=1) ** 2).mean(axis=0))
    np.testing.assert_allclose(robot.levers, np.maximum(moved, 0.04 * robot.reach), rtol=0.1)


@pytest.mark.long
@each_arm
def test_links_that_may_touch_are_few_and_the_others_are_apart_in_some_postures(name):
    robot = load_arm(name)
    names = {mesh.name for mesh in robot.meshes}
    assert all(pair <= names and len(pair) == 2 for pair in robot.touching) and len(robot.touching) < 8
    apart = [robot.collision.nearest_to_itself(q[None]) for q in random_postures(robot, 60)]
    assert sum(near is None or near.distance > 0.01 for near in apart) > 10


@pytest.mark.parametrize(("gap", "told"), [(0.012, True), (0.0205, True), (0.0225, False)])
def test_a_constant_gap_that_covers_take_for_contact_may_be_one(robot, gap, told):
    """The origin of the second joint turns about the axis that a ball on the base is on."""
    q = random_postures(robot, 1)
    middle = robot.forward_kinematics(q[0])[1][1]
    below = middle * [0, 0, 1] - [0, 0, 0.2]
    shape = trimesh.creation.icosphere(subdivisions=4, radius=0.04)
    distance = np.linalg.norm(middle - below) - 0.04
    wide = shape.vertices * (distance - gap) / 0.04
    balls = [LinkMesh("base", -1, wide + below, shape.faces), LinkMesh("arm", 1, shape.vertices, shape.faces)]
    solids = CollisionModel(robot, balls, 0)
    near = solids.nearest_to_itself(q)
    assert near is not None and near.distance == pytest.approx(gap, abs=1e-3)
    ranges = Ranges.of(robot.lower, robot.upper)
    assert bool(find_touching(solids, ranges, None, 5.5e-3, 30)[0]) is told
    assert bool(find_touching(solids, ranges, None, 0.0, 30)[0]) is (gap < 0.02 * robot.reach)


def test_courses_of_an_arm_whose_postures_are_not_unique_end_where_its_motions_do():
    robot = load_arm("xarm7")
    engine = Engine(in_reach(TASKS, robot), FitStore(default_cache_folder()), robot)
    follower, solved = engine.follower, engine.solved(Scenario("push_box"), LIVE)
    known, goal = follower.reference_postures(solved.nominal.learned), solved.nominal.goal
    straight = [track(robot, goal[None], posture, reference=posture).q[0] for posture in known.references]
    far = int(np.abs(straight - known.on_path[:, -1]).max(axis=1).argmax())
    assert np.abs(straight[far] - known.on_path[far, -1]).max() > 0.5  # another posture that is a best one, too
    posture = tuple(known.references[far].tolist())
    solved = replace(solved, nominal=replace(solved.nominal, posture=posture))
    *starts, end = follower.at_ends(solved.nominal)
    controller = ArmController(follower, solved)
    for rollout, start in enumerate(starts):
        controller.begin(start, rollout)
        np.testing.assert_allclose(controller.ahead[-1], end, atol=0.02)
    controller.home(2)
    np.testing.assert_allclose(controller.ahead[-1], starts[2], atol=0.02)


@pytest.mark.parametrize("task", ["push_box", "lift_box", "draw_s"])
@pytest.mark.parametrize("name", QUICK)
def test_tasks_are_placed_where_the_arm_follows_them(name, task):
    robot, paths = load_arm(name), TASKS[task]().paths
    placed = place(robot, paths)
    assert 0.4 * robot.size < placed.scale <= robot.size + 1e-12
    moved = placed(np.array([path[np.linspace(0, len(path) - 1, 60).astype(int)] for path in paths]))
    assert follows(robot, moved)


def test_a_task_that_is_too_large_is_refused_with_the_scale_that_fits(monkeypatch):
    robot, paths = load_arm("so100"), TASKS["push_box"]().paths
    for name, few in (("SCALES", (1.0, 0.4)), ("AHEAD", (0.0,)), ("UP", (0.0,))):
        monkeypatch.setattr(placement, name, few)
    with pytest.raises(UnreachableError, match=r"SO-100 .* at the scale 1\.04.*: the largest scale .* is about 0\.42"):
        place(robot, paths, 2.5 * robot.size)
    with pytest.raises(UnreachableError, match="anywhere ahead of it"):
        place(robot, paths, 20.0)


def test_the_jaco_has_its_tasks_where_they_are():
    for task in ("push_box", "draw_w"):
        placed = place(load_jaco(), TASKS[task]().paths)
        assert (placed.scale, placed.shift) == (1.0, (0.0, 0.0, 0.0))


def same(robot: Robot, other: Robot) -> None:
    a, b = to_arrays(robot), to_arrays(other)
    assert set(a) == set(b)
    for name in a:
        np.testing.assert_array_equal(a[name], b[name])


def forget(monkeypatch, folder: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(folder))


@pytest.mark.long
def test_an_arm_is_kept_and_found_again_and_made_anew_if_its_file_is_damaged(tmp_path, monkeypatch, caplog):
    forget(monkeypatch, tmp_path)
    path, made = write(tmp_path, urdf(4, shape=BALL)), []
    real = models.covering_tree
    monkeypatch.setattr(models, "covering_tree", lambda *given: made.append(1) or real(*given))
    told: list[tuple[float, str]] = []
    robot = robot_from_urdf(path, progress=lambda fraction, message: told.append((fraction, message)))
    fractions = [fraction for fraction, _ in told]
    assert fractions == sorted(fractions) and fractions[0] == 0 and fractions[-1] == 1 and len(told) > 8
    assert any("covering" in message for _, message in told)
    (file,) = (default_cache_folder() / "arms").glob("*.npz")
    same(robot, robot_from_urdf(path))
    assert len(made) == 1
    content = file.read_bytes()
    for damaged in (content[: len(content) // 2], b"", content[:1000] + bytes(200) + content[1200:]):
        file.write_bytes(damaged)
        same(robot, robot_from_urdf(path))
        assert file.read_bytes() == content and "damaged" in caplog.text
    assert len(made) == 4
    write(tmp_path, urdf(4, link("aside").replace("aside", "l9") + BRANCH, shape=BALL))  # another file: another arm
    assert len(robot_from_urdf(path).meshes) == 6 and len(made) == 5
    robot_from_urdf(path, home=(0.1, 0.5, 0.5, 0.1))
    assert len(made) == 6


BALL = '<geometry><sphere radius="0.03"/></geometry>'  # a shape that is covered quickly
BRANCH = '<joint name="on" type="fixed"><parent link="l0"/><child link="l9"/></joint>'


def test_what_was_chosen_is_said_with_reasons():
    report = load_arm("xarm7").report()
    words = ["xArm7: 7 joints, reach 0.82 m", "joint1, joint2", "limits of the URDF", "link_eef: its name"]
    words += ["by convention", "in the mean", "may touch"]
    words += ["searched for; not 'home' of the SRDF: it is nearly singular"]
    assert [word for word in words if word not in report] == []
    assert "29 points of 2572 spheres: as shipped" in load_jaco().report()


def test_states_of_an_srdf_are_homes_where_they_name_all_joints(tmp_path):
    panda = read_robot(urdf_path("panda", ARMS["panda"].srdf))
    (name, posture), *others = semantic_homes(panda, [f"panda_joint{k}" for k in range(1, 8)])
    assert name == "default" and not others
    np.testing.assert_allclose(posture, [0, -0.785398, 0, -2.35619, 0, 1.5707, 0.785398])
    assert semantic_homes(panda, ["panda_joint1", "another"]) == []
    state = '<group_state name="standing" group="base"><joint name="virtual" value="0 0 0 0 0 0 1"/></group_state>'
    semantic = write(tmp_path, f'<robot name="small">{state}</robot>', "arm.srdf")
    assert semantic_homes(read_robot(semantic), ["j0", "j1"]) == []  # a state of another group


@pytest.mark.long
def test_a_given_front_and_home_are_taken(tmp_path, monkeypatch):
    forget(monkeypatch, tmp_path)
    path, home = write(tmp_path, urdf(4, shape=BALL)), (0.2, 0.6, -0.4, 0.3)
    robot = robot_from_urdf(path, home=home, front="y", name="mine")
    np.testing.assert_array_equal(robot.home, home)
    np.testing.assert_allclose(robot.base @ [0, 1, 0], [0, -1, 0], atol=1e-15)
    assert robot.name == robot.title == "mine" and "front" in robot.report()
    plain = robot_from_urdf(path, home=home, front="-y")
    np.testing.assert_allclose(robot.end_effector(home), robot.base @ plain.end_effector(home), atol=1e-12)
    assert (
        robot_from_urdf(write(tmp_path, urdf(4, name="", shape=BALL), "anonymous.urdf"), home=home).name == "anonymous"
    )


def hollow(sides: int) -> LinkMesh:
    """A box of thin walls, 20 cm high, of which as many sides are open."""
    walls = [
        trimesh.creation.box(size, trimesh.transformations.translation_matrix(at))
        for size, at in (
            ((0.1, 0.1, 0.002), (0, 0, 0.1)), ((0.1, 0.1, 0.002), (0, 0, -0.1)),
            ((0.1, 0.002, 0.2), (0, 0.05, 0)), ((0.1, 0.002, 0.2), (0, -0.05, 0)),
            ((0.002, 0.1, 0.2), (0.05, 0, 0)), ((0.002, 0.1, 0.2), (-0.05, 0, 0)),
        )
    ]  # fmt: skip
    joined = trimesh.util.concatenate(walls[sides:])
    return LinkMesh("box", 0, np.array(joined.vertices), np.array(joined.faces))


@pytest.mark.long
def test_hollows_count_as_solid_unless_they_are_open_to_more_sides_than_one():
    closed, open_to_one, open_to_two = (cover(hollow(sides), CoverSettings()) for sides in range(3))
    for spheres in (closed, open_to_one):
        assert spheres[:, 3].max() > 0.05  # in the middle
    assert open_to_two[:, 3].max() < 0.02  # only the walls
    assert len(open_to_two) > 2 * len(closed)


@pytest.mark.long
@pytest.mark.parametrize("limits", [(0.5, 6.9), (0.0, 6.2832), (-7.0, -0.6), (-6.3, 6.3)])
def test_home_is_within_limits_wherever_they_are(tmp_path, limits):
    text = urdf(5).replace('lower="-2" upper="2"', 'lower="{}" upper="{}"'.format(*limits))
    robot = robot_from_urdf(write(tmp_path, text))
    assert (robot.home >= limits[0]).all() and (robot.home <= limits[1]).all()


@pytest.mark.long
@pytest.mark.parametrize("sizes", ["0.1 0.1 0", "0.1 0 0", "0.05 0.05 1e-9"])
def test_flat_links_are_measured_like_others(tmp_path, sizes):
    plate = f'<geometry><box size="{sizes}"/></geometry>'
    text = urdf(4).replace('<link name="tcp"/>', link("tcp", plate))
    robot = robot_from_urdf(write(tmp_path, text))
    assert np.isfinite(robot.collision.nearest_to_table(robot.home[None]).distance)


@pytest.mark.long
def test_a_material_that_has_changed_is_read_again(tmp_path):
    box = trimesh.creation.box((0.06, 0.06, 0.2))
    mesh, material = tmp_path / "box.obj", tmp_path / "box.mtl"
    lines = [f"v {x} {y} {z}" for x, y, z in box.vertices] + [f"f {a} {b} {c}" for a, b, c in box.faces + 1]
    mesh.write_text("\n".join(["mtllib box.mtl", "usemtl paint", *lines]))
    drawn = link("l3", f'<geometry><mesh filename="{mesh}"/></geometry>', "visual")
    path = write(tmp_path, urdf(4).replace(link("l3"), drawn))
    found = []
    for paint in ("1 0 0", "0 1 0"):
        material.write_text(f"newmtl paint\nKd {paint}\n")
        found.append([each.colour for each in robot_from_urdf(path).visuals if each.name == "box.obj"])
    assert found == [[(255, 0, 0)], [(0, 255, 0)]]


def near_home(arm, num, seed):
    near = arm.robot.home + 0.2 * np.random.default_rng(seed).normal(size=(num, arm.robot.num_joints))
    return arm.robot.clip(near)


@each_arm
def test_joints_are_where_pinocchio_has_them_in_the_frame_of_the_base(name):
    arm = dt.load_arm(name)
    model = pin.buildModelFromUrdf(str(arm.robot.urdf))
    data, number = model.createData(), [model.getJointId(joint) for joint in arm.robot.joint_names]
    for q in near_home(arm, 5, seed=1):
        angles = pin.neutral(model)
        angles[[model.joints[k].idx_q for k in number]] = q
        pin.forwardKinematics(model, data, angles)
        _, origins = arm.robot.forward_kinematics(q)
        np.testing.assert_allclose(origins, [data.oMi[k].translation for k in number], atol=1e-12)


@each_arm
def test_what_is_fixed_to_the_base_is_turned_along(name):
    """Distances from an obstacle, the same in both frames, by the body points and by the true shapes."""
    arm, page = dt.load_arm(name), dt.load_arm(name, frame="page")
    q, (x, y, z) = near_home(arm, 20, seed=2), 0.3 * arm.robot.reach * np.array([0.6, 0.3, 0.5])
    ball, turned = dt.Sphere((x, y, z)), dt.Sphere(tuple(page.robot.base @ (x, y, z)))
    expected = page.robot.body.clearance(page.robot, q, turned)
    np.testing.assert_allclose(arm.robot.body.clearance(arm.robot, q, ball), expected, atol=1e-9)
    here, there = arm.robot.collision.nearest_to_obstacle(q, ball), page.robot.collision.nearest_to_obstacle(q, turned)
    assert here.distance == pytest.approx(there.distance, abs=1e-9)
    fixed = arm.robot.body.of_joints(-1, 0).spheres["offset"]
    np.testing.assert_allclose(
        fixed @ page.robot.base.T, page.robot.body.of_joints(-1, 0).spheres["offset"], atol=1e-12
    )


@pytest.mark.long
@pytest.mark.parametrize("frame", ["base", "page"])
@each_arm
def test_files_of_angles_and_of_places_in_the_base_frame_agree(tmp_path, name, frame):
    arm, in_base = dt.load_arm(name, frame=frame), dt.load_arm(name)
    q = in_base.robot.home + np.linspace(0, 0.4, 60)[:, None] * np.ones(in_base.robot.num_joints)
    times = np.linspace(0, 3, 60)[:, None]
    header = ",".join(["t", *(f"joint{k}" for k in range(in_base.robot.num_joints))])
    np.savetxt(tmp_path / "angles.csv", np.hstack([times, q]), delimiter=",", header=header, comments="")
    places = np.hstack([times, in_base.robot.end_effector(q)])
    np.savetxt(tmp_path / "places.csv", places, delimiter=",", header="t,x,y,z", comments="")
    (by_angles,) = dt.load_demonstrations(tmp_path / "angles.csv", arm=arm)
    (by_places,) = dt.load_demonstrations(tmp_path / "places.csv", arm=arm)
    np.testing.assert_allclose(by_places.positions, by_angles.positions, atol=1e-12)
    np.testing.assert_allclose(arm.robot.end_effector(q), by_angles.positions, atol=1e-12)


def test_orientations_turn_along_with_places(tmp_path):
    half = np.sqrt(0.5)
    rows = [(t, 0.3 + 0.1 * t, 0.0, 0.4, 0.0, half, 0.0, half) for t in np.linspace(0, 1, 30)]  # the hand's z along x
    header = "t,x,y,z,qx,qy,qz,qw"
    np.savetxt(tmp_path / "poses.csv", rows, delimiter=",", header=header, comments="")
    frames: tuple[tuple[Literal["base", "page"], tuple[int, int, int]], ...]
    frames = ("base", (1, 0, 0)), ("page", (0, -1, 0))
    for frame, along in frames:
        (take,) = dt.load_demonstrations(tmp_path / "poses.csv", arm=dt.load_arm("xarm7", frame=frame))
        np.testing.assert_allclose(np.diff(take.positions, axis=0)[0] / 0.1 * 29, along, atol=1e-9)
        assert take.orientations is not None
        w, x, y, z = take.orientations[0]
        axis = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
        np.testing.assert_allclose(axis, along, atol=1e-9)


@each_arm
def test_the_whole_arm_moves_around_a_ball_in_the_frame_of_its_base(name):
    arm, (take, *others) = dt.load_arm(name), dt.example("push_box")[:3]
    upright = replace(take, orientations=np.tile([1.0, 0, 0, 0], (len(take.times), 1)))
    takes = arm.place([upright, *others])
    turn = dt.load_arm(name, frame="page").base.T
    assert takes[0].orientations is not None
    about = np.arctan2(turn[1, 0], turn[0, 0])
    np.testing.assert_allclose(np.abs(takes[0].orientations[0] @ [np.cos(about / 2), 0, 0, np.sin(about / 2)]), 1)
    x, y, z = (float(c) for c in takes[0].positions[len(takes[0].positions) // 2])
    ball = dt.Sphere((x, y, z), diameter=0.1 * arm.robot.size)
    motion = dt.fit([replace(one, orientations=None) for one in takes], state="plain")
    for path in arm.rollouts(motion.stack(dt.ArmAvoidance(ball, margin=0.01 * arm.robot.size))):
        assert arm.robot.body.clearance(arm.robot, path.q, ball).min() > 0.01 * arm.robot.size - 1.1e-3
        assert path.error[[0, -1]].max() < 1e-3 and path.error.max() > 0.02 * arm.robot.size


def test_another_frame_is_refused_with_a_line():
    with pytest.raises(ValueError, match=r"frame: found 'tool'; accepted: base, page"):
        dt.load_arm("jaco", frame="tool")  # pyright: ignore[reportArgumentType]
