"""Joint trajectories: what their files hold, by quintics of the test's own, against limits that pinocchio reads."""

import csv
from dataclasses import replace

import numpy as np
import pytest
import yaml
from pinocchio_arm import pinocchio_model
from scipy.optimize import minimize_scalar

import dt_viz as dt
from dt_viz.control.settings import ControllerSettings
from dt_viz.errors import DataError, FormatError
from dt_viz.library.arm import JointPath
from dt_viz.robot.joint_trajectory import FORMATS

BALL = dt.Sphere((0.0, -0.50, 0.22), diameter=0.12)
KINDS = ("hand", "whole arm", "augmented", "hurried")


class Held:
    """What a YAML file holds, followed as ROS's joint_trajectory_controller does: a quintic between two points."""

    def __init__(self, path):
        self.text = path.read_text()
        message = yaml.safe_load(self.text)
        assert set(message) == {"header", "joint_names", "points"}
        self.names, points = message["joint_names"], message["points"]
        since = [point["time_from_start"] for point in points]
        self.times = np.array([time["sec"] + 1e-9 * time["nanosec"] for time in since])
        states = ("positions", "velocities", "accelerations")
        self.q, self.v, self.a = (np.array([point[state] for point in points]) for state in states)

    def at(self, t):
        """Joint angles (T, n) at times (T,), by solving for the quintic's coefficients."""
        k = np.clip(np.searchsorted(self.times, t, side="right") - 1, 0, len(self.times) - 2)
        h, u = (self.times[k + 1] - self.times[k])[:, None], (t - self.times[k])[:, None]
        u = u / h
        q0, v0, a0 = self.q[k], h * self.v[k], h * h * self.a[k] / 2
        to = np.stack([self.q[k + 1] - q0 - v0 - a0, h * self.v[k + 1] - v0 - 2 * a0, h * h * self.a[k + 1] - 2 * a0])
        system = np.array([[1, 1, 1], [3, 4, 5], [6, 12, 20]])
        c3, c4, c5 = np.einsum("ij,jkl->ikl", np.linalg.inv(system), to)
        return q0 + u * (v0 + u * (a0 + u * (c3 + u * (c4 + u * c5))))


@pytest.fixture(scope="module")
def arm():
    return dt.load_arm("jaco")


@pytest.fixture(scope="module")
def motions(arm):
    """The motion of the joints of each kind."""
    plain, augmented = (dt.fit(dt.example("push_box"), state=state) for state in ("plain", "augmented"))
    whole = arm.rollouts(plain.stack(dt.ArmAvoidance(BALL)))[0]
    hand, remembering = (arm.follow(motion.rollouts()[0]) for motion in (plain, augmented))
    hurried = replace(whole, times=whole.times / 5)
    return dict(zip(KINDS, (hand, whole, remembering, hurried), strict=True))


@pytest.fixture(scope="module")
def held(arm, motions, tmp_path_factory):
    """What the file of each motion holds."""
    folder = tmp_path_factory.mktemp("held")
    for kind, joints in motions.items():
        arm.trajectory(joints).save(folder / f"{kind}.yaml")
    return {kind: Held(folder / f"{kind}.yaml") for kind in motions}


@pytest.mark.parametrize("kind", KINDS)
class TestFollowed:
    def test_it_is_within_the_limits_that_pinocchio_reads(self, kind, held):
        file, model = held[kind], pinocchio_model()[0]
        joints = [model.joints[model.getJointId(name)] for name in file.names]
        velocity_limits = np.array([model.velocityLimit[joint.idx_v] for joint in joints])
        step = 1e-3
        t = np.arange(0, file.times[-1], step)
        q = file.at(t)
        velocity, acceleration = np.diff(q, axis=0) / step, np.diff(q, 2, axis=0) / step**2
        assert np.abs(velocity / velocity_limits).max() <= 1
        assert np.abs(acceleration).max() <= ControllerSettings().acceleration
        assert (np.abs(file.v) <= velocity_limits).all()
        assert np.abs(file.a).max() <= ControllerSettings().acceleration
        bounded = [k for k, joint in enumerate(joints) if joint.nq == 1]
        assert bounded  # the others are continuous
        lower, upper = (
            np.array([limit[joints[k].idx_q] for k in bounded])
            for limit in (model.lowerPositionLimit, model.upperPositionLimit)
        )
        assert ((lower <= q[:, bounded]) & (q[:, bounded] <= upper)).all()

    def test_what_it_says_of_velocity_and_acceleration_is_how_it_moves(self, kind, held):
        file, step = held[kind], 1e-4
        t = file.times[1:-1]
        before, here, after = file.at(t - step), file.at(t), file.at(t + step)
        np.testing.assert_allclose((after - before) / (2 * step), file.v[1:-1], atol=1e-4)
        np.testing.assert_allclose((after - 2 * here + before) / step**2, file.a[1:-1], atol=2e-2)

    def test_it_begins_and_ends_at_rest_at_strictly_increasing_times(self, kind, held):
        file = held[kind]
        assert file.times[0] == 0 and (np.diff(file.times) > 1e-4).all()
        for end in (0, -1):
            assert not file.v[end].any() and not file.a[end].any()

    def test_it_passes_the_postures_of_the_motion_in_their_order(self, kind, held, motions):
        file, joints = held[kind], motions[kind]
        t = np.linspace(0, file.times[-1], 20_000)
        q, before = file.at(t), 0.0
        for posture in joints.q[::9]:
            near = t[np.abs(q - posture).max(axis=1).argmin()]
            off = lambda time, posture=posture: np.abs(file.at(np.clip([time], 0, t[-1])) - posture).max()  # noqa: E731
            found = minimize_scalar(off, bounds=(near - 2e-3, near + 2e-3), method="bounded", options={"xatol": 1e-12})
            assert min(found.fun, off(near)) < 1e-6
            assert near >= before
            before = near
        np.testing.assert_allclose(file.q[[0, -1]], joints.q[[0, -1]], atol=1e-9)

    @pytest.mark.long
    def test_it_is_nowhere_ahead_of_the_motion_and_not_much_later(self, kind, held, motions):
        slowest = {"hurried": 5.0}.get(kind, 1.2)
        assert motions[kind].times[-1] < held[kind].times[-1] < slowest * motions[kind].times[-1]


@pytest.mark.long
def test_the_file_names_the_joints_and_the_command_and_fits_it(held, arm):
    file = held["hand"]
    assert file.names == list(arm.joint_names)
    assert file.text.startswith(
        "# ros2 topic pub --once /joint_trajectory_controller/joint_trajectory trajectory_msgs/"
    )
    assert len(file.text) < 128 * 1024  # the longest argument of a command on Linux


def test_all_formats_hold_the_same(arm, motions, held, tmp_path):
    trajectory, file = arm.trajectory(motions["hand"]), held["hand"]
    for suffix in FORMATS:
        trajectory.save(tmp_path / f"motion{suffix}")
    head, *rows = csv.reader((tmp_path / "motion.csv").read_text().splitlines())
    assert head[:2] == ["time_s", f"{arm.joint_names[0]}_position_rad"]
    values = np.column_stack([file.times, file.q, file.v, file.a])
    np.testing.assert_allclose(np.array(rows, float), values, atol=1e-9)
    with np.load(tmp_path / "motion.npz") as arrays:
        assert arrays["joint_names"].tolist() == list(arm.joint_names)
        held_there = [arrays["times"][:, None], arrays["positions"], arrays["velocities"], arrays["accelerations"]]
    np.testing.assert_allclose(np.column_stack(held_there), values, atol=1e-9)


def test_continuous_joints_do_not_wrap_around(arm):
    """A joint that turns further than half a turn, and stays without a limit."""
    q = np.tile(arm.robot.home, (200, 1))
    q[:, 0] += np.linspace(0, 7.0, 200)
    trajectory = arm.trajectory(JointPath(q, np.linspace(0, 20, 200), np.zeros(200)))
    assert np.abs(np.diff(trajectory.positions[:, 0])).max() < 0.5
    assert np.ptp(trajectory.positions[:, 0]) == pytest.approx(7.0)


def moved(arm, change):
    q = np.tile(arm.robot.home, (50, 1)) + change(np.linspace(0, 1, 50)[:, None])
    return JointPath(q, np.linspace(0, 5, 50), np.zeros(50))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda u: 0 * u, "stands still"),
        (lambda u: np.where(u < 0.5, 0.0, 1.0), "a jump of 1 rad"),
        (lambda u: 9 * u * (np.arange(6) == 1), "beyond its range"),
    ],
)
def test_a_motion_that_no_arm_can_follow_has_no_trajectory(arm, change, said):
    with pytest.raises(FormatError, match=said) as raised:
        arm.trajectory(moved(arm, change))
    assert "\n" not in str(raised.value)


@pytest.mark.long
def test_a_path_out_of_reach_has_no_trajectory(arm):
    path = dt.fit(dt.example("push_box"), state="plain").rollouts()[0]
    far = replace(path, positions=path.positions * np.linspace(1, 3, len(path.positions))[:, None])
    with pytest.raises(FormatError, match=r"the path: found one beside which the hand is up to \d+ mm"):
        arm.trajectory(arm.follow(far))


@pytest.mark.parametrize(("name", "said"), [("motion.txt", "suffix: found '.txt'"), ("no/motion.csv", "No such file")])
def test_a_file_that_cannot_be_written_is_refused_in_one_line(arm, motions, tmp_path, name, said):
    with pytest.raises(DataError, match=said) as raised:
        arm.trajectory(motions["hand"]).save(tmp_path / name)
    assert "\n" not in str(raised.value) and not any(tmp_path.iterdir())


@pytest.mark.long
def test_it_can_be_slower_on_the_same_path(arm, motions):
    trajectory = arm.trajectory(motions["hand"])
    slower, t = trajectory.slower(1.5), np.linspace(0, trajectory.times[-1], 1000)
    np.testing.assert_allclose(slower.quintics(1.5 * t), trajectory.quintics(t), atol=1e-12)
