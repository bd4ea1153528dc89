"""The arm: its motions along and around what was learned, and in the loop."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.control.controller import ArmController
from dt_viz.control.settings import ControllerSettings
from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.flows.rotations import apart, turned
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.library.motion import NUM_COORDINATES, Motion
from dt_viz.library.motion import Path as HandPath
from dt_viz.motion.following import MAX_TRACKING_ERROR, Follower
from dt_viz.motion.solve import Solved, solve
from dt_viz.motion.stack import FINE, LIVE
from dt_viz.robot.inverse_kinematics import UnreachableError, best_start, inverse_kinematics, track
from dt_viz.robot.joint_trajectory import JointTrajectory, rest_to_rest, within_velocity_limits
from dt_viz.robot.models import EndEffector, robot_from_urdf
from dt_viz.robot.models import load_arm as load_robot
from dt_viz.robot.placement import place
from dt_viz.robot.robot import Robot, TrackingSettings
from dt_viz.warning import in_millimetres

Frame = Literal["base", "page"]


@dataclass(frozen=True, eq=False)
class JointPath:
    """A motion of the arm's joints."""

    q: Array
    """(T, n) joint angles, rad; continuous joints unwrapped."""
    times: Array
    """(T,) seconds, later than the path's where the joints' velocity limits ask for it."""
    error: Array
    """(T,) distances of the hand from the path, metres: what it misses, or gives way by."""
    turned: Array | None = None
    """(T,) angles of the hand from the path's orientations, degrees; None where it has none."""
    gives_way: bool = False
    """Whether the hand leaves the path to avoid something, not because it cannot follow."""

    def __repr__(self) -> str:
        off = in_millimetres(float(self.error.max()))
        samples = f"{len(self.q)} samples of {self.q.shape[1]} joints, {self.times[-1]:.3g} s"
        turned = "" if self.turned is None else f" and {self.turned.max():.1f}° beside its orientation"
        return f"JointPath({samples}, hand up to {off} beside its path{turned})"


class BlockedError(Exception):
    """The whole arm finds no motion around an obstacle."""


class Arm:
    """A robot arm of three to eight revolute joints."""

    def __init__(self, robot: Robot, frame: Frame = "base") -> None:
        """Wrap a robot; see `load_arm` and `from_urdf`.

        Args:
            robot: the arm with its front at −y.
            frame: that of all places of this arm: "base", its URDF's, or "page", that of the page, in which the front
                is −y; for the JACO they are one.

        Raises:
            ValueError: there is no such frame.
        """
        if frame not in get_args(Frame):
            raise ValueError(f"frame: found {frame!r}; accepted: {', '.join(get_args(Frame))}")
        self._on_page = robot
        self.robot = robot.in_base_frame() if frame == "base" else robot
        self._follower = Follower(self.robot)

    @classmethod
    def from_urdf(
        cls,
        path: str | os.PathLike[str],
        end_effector: EndEffector | None = None,
        home: Sequence[float] | None = None,
        front: str | Sequence[float] | None = None,
        srdf: str | os.PathLike[str] | None = None,
        package_dirs: Sequence[str | os.PathLike[str]] = (),
        locked: Sequence[str] | Mapping[str, float] | None = None,
        frame: Frame = "base",
    ) -> Arm:
        """Load an arm from a URDF; what is not given is found, and `report` says why. It takes seconds the first time.

        Args:
            path: the URDF, expanded if it comes from xacro.
            end_effector: link that is the tool frame, or (link, (x, y, z)) with the tool's place in it, metres.
            home: (n,) ready pose, rad.
            front: "x", "-x", "y", "-y" or a horizontal direction, in the URDF's base frame.
            srdf: file that names the end effector, states, and pairs of links that may touch.
            package_dirs: folders in which the `package://` addresses of meshes resolve.
            locked: joints that do not move, perhaps each with its value, rad or metres; None locks grippers.
            frame: see `Arm`.

        Raises:
            DataError: the URDF, a mesh, or what is given cannot be used.
        """
        folders = [Path(folder) for folder in package_dirs]
        semantic = None if srdf is None else Path(srdf)
        return cls(robot_from_urdf(Path(path), end_effector, home, front, semantic, folders, locked), frame)

    @property
    def joint_names(self) -> tuple[str, ...]:
        """Names of the n joints, from the base to the hand."""
        return self.robot.joint_names

    @property
    def base(self) -> Array:
        """(3, 3) rotation from the frame of the URDF's base to that of this arm's places."""
        return self.robot.base

    def end_effector(self, q: ArrayLike) -> Array:
        """Compute the positions (*B, 3) of the hand, metres, at joint angles q (*B, n), rad."""
        return self.robot.end_effector(q)

    def hand_orientation(self, q: ArrayLike) -> Array:
        """Compute the orientations (*B, 4) of the hand, unit quaternions wxyz, at joint angles q (*B, n), rad."""
        return self.robot.hand_orientation(q)

    def report(self) -> str:
        """Say what was chosen of the arm and why, a line for each: joints, tool, front, ready pose, body, limits."""
        return self.robot.report()

    def place(self, demonstrations: Sequence[Demonstration], scale: float | None = None) -> tuple[Demonstration, ...]:
        """Move, scale and turn demonstrations in space, made for an arm of the JACO's size, into reach.

        Args:
            demonstrations: with three coordinates, the arm's front at −y as in `dt_viz.example`. Where the arm cannot
                follow the hand's orientations at any place, positions alone decide.
            scale: the scale that is wanted; None takes the largest that fits, up to the arm's reach by the JACO's.

        Raises:
            UnreachableError: no place fits; it says the largest scale that does.
            ValueError: demonstrations lie in a plane that has no place in space.
        """
        if demonstrations and demonstrations[0].dimension != NUM_COORDINATES:
            raise ValueError(f"the arm follows motions in space, with 3 coordinates, not {demonstrations[0].dimension}")
        paths, turns = [one.positions for one in demonstrations], [one.orientations for one in demonstrations]
        given = [wxyz for wxyz in turns if wxyz is not None]
        wanted = given if given and len(given) == len(turns) else None
        try:
            placed = place(self._on_page, paths, scale, orientations=wanted)
        except UnreachableError:
            if wanted is None:
                raise
            placed = place(self._on_page, paths, scale)
        turn = self.robot.base @ self._on_page.base.T

        def in_reach(one: Demonstration) -> Demonstration:
            wxyz = None if one.orientations is None else turned(turn, one.orientations)
            return replace(one, positions=placed(one.positions) @ turn.T, orientations=wxyz)

        return tuple(map(in_reach, demonstrations))

    def __repr__(self) -> str:
        return f"Arm({self.robot.title}: {self.robot.num_joints} joints, reach {self.robot.reach:.2f} m)"

    def follow(self, path: HandPath) -> JointPath:
        """The joints along a path of the hand, and its orientations where it has them.

        Args:
            path: in space, in the frame of the arm's base.

        Raises:
            UnreachableError: the arm cannot get to where the path starts.
            ValueError: the path lies in a plane that has no place in space.
        """
        if path.positions.shape[1] != NUM_COORDINATES:
            raise ValueError(f"the arm follows paths in space, with 3 coordinates, not {path.positions.shape[1]}")
        wanted = path.orientations
        if wanted is None:
            start = inverse_kinematics(self.robot, path.positions[0])
        else:
            start = best_start(self.robot, path.positions, wanted)
        tracked = track(self.robot, path.positions, start, orientations=wanted)
        times = within_velocity_limits(path.times, tracked.q, self.robot.velocity_limits)
        return JointPath(tracked.q, times, tracked.error, self._turned(tracked.q, wanted))

    def trajectory(self, joints: JointPath, acceleration: float = ControllerSettings.acceleration) -> JointTrajectory:
        """Time a motion of the joints for a controller: from rest to rest, within the arm's limits, on the same path.

            arm.trajectory(joints).save("motion.yaml")  # of ROS 2; or .csv, .npz

        Args:
            joints: the motion, which is nowhere hurried.
            acceleration: limit for each joint, rad/s²; a URDF names none.

        Raises:
            FormatError: the arm cannot follow the motion, or stands still.
        """
        missed = float(joints.error.max())
        if not joints.gives_way and missed > MAX_TRACKING_ERROR:
            found = f"one beside which the hand is up to {in_millimetres(missed)}"
            raise FormatError("the path", found, f"paths that the arm follows to {in_millimetres(MAX_TRACKING_ERROR)}")
        return rest_to_rest(self.robot, joints.times, joints.q, acceleration)

    def _turned(self, q: Array, orientations: Array | None) -> Array | None:
        """Angles (T,), degrees, of the hand at postures (T, n) from orientations (T, 4)."""
        return None if orientations is None else np.rad2deg(apart(self.robot.hand_orientation(q), orientations))

    def rollouts(self, motion: Motion, *, spacing: float = 0.005) -> tuple[JointPath, ...]:
        """Motions of the whole arm from the demonstrations' starts, around what the motion tells it to avoid.

        Args:
            motion: in space, in the frame of the arm's base.
            spacing: largest distance between neighbouring samples of the hand, metres.

        Raises:
            BlockedError: an obstacle leaves no room at a start or at the goal, or no way between them.
            UnreachableError: the arm cannot get to where the motions start.
            ValueError: the motion is one in a plane that has no place in space.
        """
        if motion.dimension != NUM_COORDINATES:
            raise ValueError(f"the arm follows motions in space, with 3 coordinates, not {motion.dimension}")
        scenario, nominal = motion.scenario, motion.nominal
        avoidance = scenario.arm_avoidance
        if avoidance is None:
            return tuple(self.follow(path) for path in motion.rollouts(spacing=spacing))
        admission = self._follower.admission(nominal, avoidance)
        in_the_way = admission.blocked or admission.nominal.warnings
        if in_the_way:
            raise BlockedError("; ".join(warning.text for warning in in_the_way))
        solved = solve(scenario, admission.nominal, replace(FINE, spacing=spacing), self._follower)
        arm = solved.arm
        assert arm is not None
        if not (solved.nominal.moving.all() and arm.cleared):
            raise BlockedError("the arm finds no way around the obstacle")
        due = solved.stack.rays.times(arm.index, arm.fraction)
        away = self.robot.end_effector(arm.p) - solved.stack.positions_at(arm.index, arm.fraction)
        rows = [arm.index == rollout for rollout in range(len(nominal.starts))]
        turned = self._turned(arm.p, nominal.orientations_at(arm.index, arm.fraction))
        limits = self.robot.velocity_limits
        return tuple(
            JointPath(
                arm.p[row],
                within_velocity_limits(due[row], arm.p[row], limits),
                np.linalg.norm(away[row], axis=1),
                None if turned is None else turned[row],
                gives_way=True,
            )
            for row in rows
        )


class Controller(ArmController):
    """The joint velocities of an arm in the loop, wherever it is: see `dt_viz.control.controller`.

        controller = dt.Controller(motion, arm)
        q_velocity = controller.step(q, dt)

    The arm goes to the goal around what the motion avoids by hand, and by the whole arm (`Avoidance(space="cspace")`).
    """

    def __init__(
        self, motion: Motion, arm: Arm, label: float | None = None, settings: ControllerSettings | None = None
    ) -> None:
        """Take a motion and the arm.

        Args:
            motion: in space, in the frame of the arm's base.
            arm: the arm that follows it.
            label: of the pattern that is drawn; None takes that of the demonstration that begins nearest to the hand.
            settings: what may be chosen; None are the defaults.

        Raises:
            FormatError: no demonstration has such a label.
            UnreachableError: the arm cannot get to where the motion starts.
            ValueError: the motion is one in a plane that has no place in space.
        """
        rollout = None if label is None else int(motion.labelled(label)[0])
        super().__init__(arm._follower, _live(motion), settings, rollout)
        self._motion = motion

    def __repr__(self) -> str:
        return f"Controller({self._motion!r})"

    @property
    def motion(self) -> Motion:
        """What it follows; another one, such as one with its obstacle elsewhere, takes over at the next `step`.

        Raises:
            UnreachableError, ValueError: as `Controller`.
        """
        return self._motion

    @motion.setter
    def motion(self, motion: Motion) -> None:
        self.follow(_live(motion))
        self._motion = motion


def _live(motion: Motion) -> Solved:
    """The stack of a motion in space, as exactly as a controller needs it."""
    if motion.dimension != NUM_COORDINATES:
        raise ValueError(f"the arm follows motions in space, with 3 coordinates, not {motion.dimension}")
    return solve(motion.scenario, motion.nominal, LIVE)


def load_arm(name: str = "jaco", tracking: TrackingSettings | None = None, frame: Frame = "base") -> Arm:
    """Load an arm by its name.

    Args:
        name: jaco, panda, ur3, ur5, ur10, xarm7, z1, so100 or so101; or a name of the package robot_descriptions, such
            as "gen3", where that is installed and has downloaded it.
        tracking: settings of its inverse kinematics; None are the defaults.
        frame: see `Arm`.

    Raises:
        DataError: there is no such arm; the message lists those that there are.
    """
    robot = load_robot(name)
    return Arm(robot if tracking is None else replace(robot, tracking=tracking), frame)


def load_jaco(tracking: TrackingSettings | None = None) -> Arm:
    """The JACO arm: `load_arm("jaco")`."""
    return load_arm("jaco", tracking)
