"""Pictures of whole-arm avoidance: the body points, the ghost without avoidance, and arms along the motion."""

from __future__ import annotations

import threading

import numpy as np
import trimesh
import viser
from viser import transforms

from dt_viz.flows.fields import Array
from dt_viz.robot.body_points import load_body_points
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import View
from dt_viz.session.engine import ArmMotion
from dt_viz.session.frame import Frame
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.arm import PEDESTAL, ArmPicture, GhostArm
from dt_viz.ui.scene.links import light_shells
from dt_viz.ui.scene.picture import Following, Picture, Shown, rgb

NUM_ARMS = 6
"""Number of arms along the motion, start and goal included."""
FAINTEST, STRONGEST = 0.12, 0.5
"""Opacities of the first and the last arm."""
FAR = 0.1
"""Distance by which a body point with the full colour is moved, metres."""
IDENTITY = (1.0, 0.0, 0.0, 0.0)


def evenly_along(path: Array, num: int) -> Array:
    """Return `num` places, in samples from the start, evenly along a path (T, d), its ends included."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps + 1e-9)])  # strictly increasing, also where the path rests
    return np.interp(np.linspace(0, length[-1], num), length, np.arange(len(path)))


def arms_along(robot: Robot, motion: ArmMotion, num: int = NUM_ARMS) -> Array:
    """Return joint angles (num, 6), rad, at places evenly along the path of the hand."""
    places = evenly_along(robot.end_effector(motion.q), num)
    samples = np.arange(len(motion.q))
    return np.stack([np.interp(places, samples, angle) for angle in motion.q.T], axis=1)


class Onion(Following, Picture):
    """Several arms along the motion, from faint at its start to strong at its end; a drag sends only their poses."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        super().__init__(scene.add_frame("/onion", show_axes=False, visible=False))
        self._robot = robot
        opacities = np.linspace(FAINTEST, STRONGEST, NUM_ARMS, dtype=np.float32)
        self.links = tuple(
            scene.add_batched_meshes_simple(
                f"/onion/link_{index}",
                shell.vertices,
                shell.faces,
                np.tile(IDENTITY, (NUM_ARMS, 1)),
                np.zeros((NUM_ARMS, 3)),
                batched_colors=np.array(palette.linear(palette.ONION), np.uint8),
                batched_opacities=opacities,
                lod="off",
                cast_shadow=False,
                receive_shadow=False,
            )
            for index, shell in list(enumerate(light_shells(robot.joint_names)))[PEDESTAL:]
        )

    def draw(self, frame: Frame) -> None:
        self.follow(frame.arm)

    def _show(self, motion: ArmMotion) -> None:
        rotations, origins = self._robot.forward_kinematics(arms_along(self._robot, motion))
        wxyzs = transforms.SO3.from_matrix(rotations).wxyz
        for joint, link in enumerate(self.links, start=PEDESTAL - 1):
            # the browser blends nodes from far to near by their own positions
            link.position = middle = origins[:, joint].mean(axis=0)
            link.batched_positions = (origins[:, joint] - middle).astype(np.float32)
            link.batched_wxyzs = wxyzs[:, joint].astype(np.float32)


class BodySpheres(Shown):
    """The spheres that cover the arm, with their displacements by avoidance: the larger, the stronger the colour."""

    def __init__(self, scene: viser.SceneApi, radius: Array) -> None:
        """Make spheres of these radii (P,), metres."""
        super().__init__(scene.add_frame("/body_points", show_axes=False, visible=False))
        num = len(radius)
        ball = trimesh.creation.icosphere(subdivisions=2)
        self.spheres = scene.add_batched_meshes_simple(
            "/body_points/spheres",
            ball.vertices,
            ball.faces,
            np.tile(IDENTITY, (num, 1)),
            np.zeros((num, 3)),
            batched_scales=radius.astype(np.float32),
            batched_colors=np.zeros((num, 3), np.uint8),
            opacity=0.25,
            lod="off",
            cast_shadow=False,
            receive_shadow=False,
        )
        self.paths = scene.add_line_segments(
            "/body_points/paths",
            np.zeros((num, 2, 3), np.float32),
            rgb(palette.BODY_PATH, (num, 2, 3)),
            thickness=0.004,
        )

    def pose(self, positions: Array, without: Array) -> None:
        """Show the spheres at `positions` (P, 3), with lines from those `without` avoidance (P, 3), metres."""
        moved = np.linalg.norm(positions - without, axis=1, keepdims=True)
        still, far = (np.array(palette.linear(c)) for c in (palette.BODY_POINT, palette.BODY_POINT_MOVED))
        self.spheres.position = middle = positions.mean(axis=0)
        self.spheres.batched_positions = (positions - middle).astype(np.float32)
        self.spheres.batched_colors = (still + np.minimum(moved / FAR, 1) * (far - still)).astype(np.uint8)
        self.paths.points = np.stack([without, positions], axis=1).astype(np.float32)


class Arms:
    """The arm, its ghost without avoidance, and its body points, which move with the playback."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._robot = robot
        self._points = load_body_points()
        self.arm = ArmPicture(scene, robot)
        self.ghost = GhostArm(scene, robot)
        self.body = BodySpheres(scene, self._points.radius)
        self._now = (robot.home, robot.home)
        self._posing = threading.Lock()  # the playback poses, another thread shows and hides

    def pose(self, q: Array, without: Array) -> None:
        """Show the joint angles `q` (6,), rad, and those `without` avoidance (6,), rad."""
        with self._posing:
            self._now = (q, without)
            self.arm.pose(q)
            self._pose_beside()

    def show(self, view: View) -> None:
        """Show and hide the parts as the view says."""
        with self._posing:
            self.arm.show(whole=view.arm, pedestal=view.ghost_arm or view.onion)
            self.ghost.visible, self.body.visible = view.ghost_arm, view.body_points
            self._pose_beside()

    def _pose_beside(self) -> None:
        """Pose the visible parts beside the arm; hidden ones are posed when they are shown."""
        q, without = self._now
        if self.ghost.visible:
            self.ghost.pose(q, without)
        if self.body.visible:
            self.body.pose(*self._points.positions(self._robot, np.stack([q, without])))
