"""The library, as `import dt_viz as dt` offers it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import dt_viz as dt
from dt_viz.examples import arm_controller, controller, plot
from dt_viz.examples.viser_scene import Scene
from dt_viz.library.motion import Motion
from dt_viz.robot.models import load_jaco
from dt_viz.shipped import ASSETS
from dt_viz.warning import Kind


@pytest.fixture(scope="module")
def push() -> Motion:
    return dt.fit(dt.load_demonstrations(ASSETS / "push_box.npz"), state="plain")


@pytest.fixture(scope="module")
def letter() -> Motion:
    return dt.fit(dt.load_demonstrations(ASSETS / "draw_s.npz"), state="plain")


BALL = dt.Sphere((0.10, -0.53, 0.15), diameter=0.15)


def middle_of(motion):
    """The middle of the first path."""
    (path, *_) = motion.rollouts()
    return path.positions[len(path.positions) // 2]


def test_every_name_is_there_and_documented():
    assert all(getattr(dt, name).__doc__ for name in dt.__all__)
    with pytest.raises(AttributeError):
        dt.no_such_name  # noqa: B018


def test_the_example_leads_motions_around_a_ball_and_the_arm_follows(push):
    around = push.stack(dt.Avoidance(BALL, margin=0.01))
    paths = around.rollouts(spacing=0.005)
    assert min(BALL.signed_distance(path.positions).min() for path in push.rollouts()) < -0.05
    assert min(BALL.signed_distance(path.positions).min() for path in paths) > 0.0085
    for path in paths:
        np.testing.assert_allclose(path.positions[-1], push.goal, atol=1e-6)
        assert (np.diff(path.times) > 0).all() and path.times[0] == 0
        assert np.linalg.norm(np.diff(path.positions, axis=0), axis=1).max() <= 0.0051
    known = around.certificates()
    assert known.lyapunov_falls and known.min_det_jacobian is not None and known.min_det_jacobian > 0
    assert known.warnings == ()
    joints = dt.load_jaco().follow(paths[0])
    assert joints.q.shape == (len(paths[0].times), 6) and joints.error.max() < 1e-3


@pytest.mark.long
def test_the_whole_arm_avoids_what_the_joints_are_told_to(push):
    arm, ball = dt.load_jaco(), dt.Sphere((0.0, -0.50, 0.22), diameter=0.12)
    around = push.stack(dt.Avoidance(ball, space="cspace"))
    for path, before in zip(around.rollouts(), push.rollouts(), strict=True):
        np.testing.assert_array_equal(path.positions, before.positions)  # the hand's own motion is not changed
    model, goal = load_jaco().collision, push.goal
    follows = [arm.follow(path) for path in push.rollouts()]
    assert min(model.nearest_to_obstacle(joints.q, ball).distance for joints in follows) < 0
    motions = arm.rollouts(around)
    assert min(model.nearest_to_obstacle(joints.q, ball).distance for joints in motions) > 0
    for joints, path in zip(motions, push.rollouts(), strict=True):
        hand = arm.robot.end_effector(joints.q)
        np.testing.assert_allclose(hand[[0, -1]], [path.positions[0], goal], atol=1e-3)
        assert (np.diff(joints.times) > 0).all() and joints.error.max() > 0.01
        speed = np.abs(np.diff(joints.q, axis=0)) / np.diff(joints.times)[:, None]
        assert (speed <= arm.robot.velocity_limits * (1 + 1e-9)).all()


def blocking(push, place):
    return push.stack(dt.Avoidance(dt.Sphere(tuple(place), diameter=0.15), space="cspace"))


def test_no_motion_of_the_arm_is_returned_unless_all_are(push, monkeypatch):
    arm, start = dt.load_jaco(), push.rollouts()[0].positions[0]
    for place, reason in ((push.goal, "goal"), (start, "start")):
        with pytest.raises(dt.BlockedError, match=reason):
            arm.rollouts(blocking(push, place))
    around, avoiding = blocking(push, (0.0, -0.50, 0.22)), arm._follower.whole_arm.avoiding
    num = len(push.rollouts())

    def never_from_the_third(lifted, *arguments, **options):
        found = avoiding(lifted, *arguments, **options)
        return replace(found, stuck=np.arange(num) == 2) if lifted.shaping.all() else found

    monkeypatch.setattr(arm._follower.whole_arm, "avoiding", never_from_the_third)
    with pytest.raises(dt.BlockedError, match="no way"):
        arm.rollouts(around)


def test_settings_of_the_controller_and_of_tracking_are_obeyed(push):
    arm, path = dt.load_jaco(), push.rollouts()[0]
    q = arm.follow(path).q
    for settings in (dt.ControllerSettings(acceleration=1.0), dt.ControllerSettings(acceleration=2.0)):
        loop = dt.Controller(push, arm, settings=settings)
        loop.begin(q[0])
        loop.displace(q[0] + 0.3)
        acceleration = np.diff(loop.steps(q[0], 0.01, 20), axis=0) / 0.01
        assert np.abs(acceleration).max() == pytest.approx(settings.acceleration)
    looser = dt.load_jaco(dt.TrackingSettings(direction_weight=0.1)).follow(path)
    assert looser.error.max() < 1e-3 and np.abs(looser.q - q).max() > 0.05


def test_the_arm_does_not_follow_a_drawing_that_has_no_place_in_space(letter):
    arm = dt.load_jaco()
    with pytest.raises(ValueError, match="in space"):
        arm.rollouts(letter)
    with pytest.raises(ValueError, match="in space"):
        arm.follow(letter.rollouts()[0])
    with pytest.raises(ValueError, match="3 coordinates"):
        dt.Controller(letter, arm)


def test_a_drawing_stays_in_its_plane_around_an_obstacle(letter):
    x, y = middle_of(letter)
    ball = dt.Sphere((float(x), float(y) + 0.02, 0.0), diameter=0.10)
    around = letter.stack(dt.Avoidance(ball))
    for path in around.rollouts():
        assert path.positions.shape[1] == 2
        flat = np.pad(path.positions, ((0, 0), (0, 1)))
        assert ball.signed_distance(flat).min() > 0.0085
        np.testing.assert_allclose(path.positions[-1], letter.goal, atol=1e-6)
    assert around.solution.bundle.positions[:, 2] == pytest.approx(0.0, abs=1e-12)
    assert around.certificates().warnings == ()


def test_a_covered_goal_of_a_drawing_is_left_in_the_plane(letter):
    x, y = letter.goal
    # the nearest way out would be across the plane, and in it the side that the motions come from
    box = dt.Box((float(x), float(y) + 0.005, 0.0), (0.12, 0.10, 0.02))
    around = letter.stack(dt.Avoidance(box))
    kinds = {warning.kind for warning in around.certificates().warnings}
    assert Kind.GOAL_COVERED in kinds
    end = np.append(around.goal, 0.0)
    assert abs(box.signed_distance(end)) < 2e-3 and 0.04 < np.linalg.norm(around.goal - letter.goal) < 0.07


def test_the_velocity_field_is_that_of_the_paths(push):
    around = push.stack(dt.Avoidance(BALL))
    rng = np.random.default_rng(0)
    starts = push.rollouts()[0].positions[:1] + rng.normal(0, 0.02, (5, 3))
    for path, start in zip(around.rollouts(starts, spacing=5e-4), starts, strict=True):
        np.testing.assert_allclose(path.positions[0], start, atol=1e-7)
        np.testing.assert_allclose(path.positions[-1], push.goal, atol=1e-6)
        k = len(path.times) // 3
        chord = (path.positions[k + 1] - path.positions[k - 1]) / (path.times[k + 1] - path.times[k - 1])
        np.testing.assert_allclose(around.velocity(path.positions[k]), chord, rtol=0.05, atol=2e-3)
    assert around.velocity(starts).shape == starts.shape


def test_the_example_of_the_readme_runs(monkeypatch, capsys, tmp_path):
    text = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")
    code = text.split("## As a library")[1].split("```python")[1].split("```")[0]
    (tmp_path / "push_box.npz").write_bytes((ASSETS / "push_box.npz").read_bytes())
    monkeypatch.chdir(tmp_path)
    found = {}
    exec(compile(code, "README.md", "exec"), found)
    assert found["ball"] == BALL and found["joints"].error.max() < 1e-3
    assert dt.Motion.load("around.npz").transforms == found["around"].transforms
    assert "Certificates(clearance " in capsys.readouterr().out


def test_the_controller_arrives_also_when_it_is_pushed(push):
    start = push.rollouts()[0].positions[0]
    passed = controller.run(push.stack(dt.Avoidance(BALL, margin=0.02)), start)
    assert np.linalg.norm(passed[-1] - push.goal) < controller.ARRIVED
    steps = np.linalg.norm(np.diff(passed, axis=0), axis=1)
    assert steps.argmax() == controller.PUSH_AT and steps.max() > 0.04
    assert BALL.signed_distance(passed).min() > 0


def test_the_controller_reads_the_motion_that_it_saved_and_moves_as_before(push, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(controller, "PERIOD", 0.1)
    printed = []
    for learn in (lambda _: push, lambda _: pytest.fail("learned again")):
        monkeypatch.setattr(dt, "fit", learn)
        controller.main(str(tmp_path / "around.npz"))
        printed.append(capsys.readouterr().out)
    assert printed[0] == printed[1] and "distance from the goal" in printed[0]


@pytest.mark.long
def test_the_plot_is_drawn(tmp_path, monkeypatch):
    monkeypatch.setenv("MPLBACKEND", "Agg")
    plot.main(str(tmp_path / "plot.png"))
    assert (tmp_path / "plot.png").stat().st_size > 20_000


def test_the_scene_draws_its_paths_around_the_ball_where_it_stands(server, push):
    scene = Scene(server, push)
    drawn = server.scene._handle_from_node_name
    before = drawn["/path/0"].points.copy()
    scene.handle.position = np.add(scene.handle.position, (0.0, 0.05, 0.0))
    scene.draw()
    assert before.shape != drawn["/path/0"].points.shape or np.abs(before - drawn["/path/0"].points).max() > 0.01
    server.scene.reset()


@pytest.mark.long
def test_the_arm_in_the_loop_gives_way_to_a_ball_that_crosses_and_arrives(push):
    arm, model = dt.load_jaco(), load_jaco().collision
    joints, places = arm_controller.run(push, arm)
    pairs = list(zip(joints, places, strict=True))[::10]
    balls = [dt.Sphere((x, y, z), diameter=0.15) for _, (x, y, z) in pairs]
    distances = [model.obstacle_distance(q[None], ball)[0][0] for (q, _), ball in zip(pairs, balls, strict=True)]
    assert 0.01 < min(distances) < 0.08  # it came near
    assert np.linalg.norm(arm.robot.end_effector(joints[-1]) - push.goal) < 1e-3


def test_recorded_joints_give_motions_of_the_hand_that_turn_it_as_recorded(tmp_path):
    arm, times = dt.load_arm("jaco"), np.linspace(0.0, 3.0, 120)
    course = (1 - np.cos(np.pi * times / times[-1])) / 2
    goal, ways = (
        arm.robot.home,
        np.array([0.5, 0.2, -0.3, 0.4, 0.3, 0.6]) + np.random.default_rng(3).normal(scale=0.05, size=(4, 6)),
    )
    for k, way in enumerate(ways):
        rows = np.column_stack([times, goal - (1 - course)[:, None] * way])
        np.savetxt(tmp_path / f"{k}.csv", rows, delimiter=",", header=",".join(["t", *arm.joint_names]), comments="")
    demonstrations = dt.load_demonstrations(tmp_path, arm=arm)
    recorded = np.array([take.orientations for take in demonstrations])
    np.testing.assert_allclose(recorded[0], arm.hand_orientation(goal - (1 - course)[:, None] * ways[0]), atol=1e-9)
    followed = arm.follow(dt.fit(demonstrations).rollouts()[0])
    assert followed.turned is not None and np.median(followed.turned) < 1.0 and followed.error.max() < 1e-3
    assert abs((recorded[0, 0] * recorded[0, -1]).sum()) < np.cos(0.1)  # the hand turns


def test_without_a_phase_the_field_of_an_augmented_motion_is_that_of_the_nearest_point_of_a_motion():
    motion = dt.fit(dt.example("push_box"), state="augmented").stack(dt.Avoidance(dt.Sphere((0.10, -0.53, 0.15), 0.15)))
    start = motion.rollouts()[2].positions[0]
    (path,) = motion.rollouts([start])
    y, along = path.positions[5:-5], np.gradient(path.positions, path.times, axis=0)[5:-5]
    for velocity in (motion.velocity(y), motion.velocity(y, start=start)):
        cosine = (velocity * along).sum(1) / np.linalg.norm(velocity, axis=1) / np.linalg.norm(along, axis=1)
        assert cosine.min() > 0.99
    np.testing.assert_allclose(motion.velocity(start, start=start), motion.velocity(start, 1.0, start), rtol=1e-9)
    with pytest.raises(dt.FormatError, match="label"):
        motion.velocity(start, label=7.0)
