"""The JACO arm in the browser: its meshes are sent once, then six rotations for each posture."""

from __future__ import annotations

import numpy as np
import trimesh
import viser
from viser import transforms

from dt_viz.avoidance.arm_field import LEVERS
from dt_viz.flows.fields import Array
from dt_viz.robot.robot import NUM_JOINTS, Robot
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.links import bodies, light_shells
from dt_viz.ui.scene.picture import Colour, Shown

PEDESTAL = 2
"""Number of bodies that no motion moves away: the base, and link 1, which only spins."""
STALE_OPACITY = 0.4
"""Opacity of the arm while its motion is not the scenario's."""
GHOST_OPACITY = 0.5
SEEN = 4e-4
"""Smallest motion of the hand by a joint that is drawn, metres: a third of a pixel, about."""
MIN_APART = 0.006
"""Smallest distance of a link from its ghost at which the ghost is shown, metres: coinciding surfaces flicker."""


class ArmFrames:
    """The frames of the base and the six links as a tree in the scene of one visitor."""

    def __init__(self, scene: viser.SceneApi, robot: Robot, name: str) -> None:
        unturned_and_half_turned = np.broadcast_to(np.array([[0.0], [np.pi]]), (2, NUM_JOINTS))
        self._unturned, self._half_turned = robot.joint_frames(unturned_and_half_turned)
        self._drawn = np.full(NUM_JOINTS, np.inf)
        self.frames: list[viser.FrameHandle] = []
        for index, body in enumerate(bodies(robot.joint_names)):
            name += f"/joint_{index}" if index else ""
            pose = transforms.SE3.from_matrix(body.placement)
            self.frames.append(
                scene.add_frame(name, show_axes=False, wxyz=pose.rotation().wxyz, position=pose.translation())
            )

    def pose(self, q: Array) -> None:
        """Take the joint angles `q` (6,), rad, as far as the change is seen: each joint is a message to the browser."""
        turned = LEVERS * np.abs(q - self._drawn) > SEEN
        self._drawn = np.where(turned, q, self._drawn)
        c, s = np.cos(q / 2)[:, None], np.sin(q / 2)[:, None]
        wxyzs = c * self._unturned + s * self._half_turned  # a quaternion is linear in both
        for joint in np.flatnonzero(turned):
            self.frames[joint + 1].wxyz = wxyzs[joint]


class ArmPicture:
    """The arm with its meshes."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._tree = ArmFrames(scene, robot, "/arm")
        self.frames = self._tree.frames
        self.meshes: list[viser.MeshHandle] = []
        for frame, body in zip(self.frames, bodies(robot.joint_names), strict=True):
            for part, mesh, colour in (("shell", body.shell, palette.ARM), ("rings", body.rings, palette.ARM_RING)):
                if mesh is not None:
                    self.meshes.append(
                        scene.add_mesh_simple(f"{frame.name}/{part}", mesh.vertices, mesh.faces, color=colour)
                    )
        self._note = scene.add_label(
            f"{self.frames[-1].name}/note",
            "last good motion",
            anchor="bottom-center",
            font_screen_scale=0.8,
            visible=False,
        )
        self.pose(robot.home)

    def pose(self, q: Array) -> None:
        """Show the joint angles `q` (6,), rad."""
        self._tree.pose(q)

    def show(self, *, whole: bool, pedestal: bool) -> None:
        """Show the whole arm, or only the pedestal under other pictures of it, or nothing."""
        self.frames[0].visible = whole or pedestal
        self.frames[PEDESTAL].visible = whole

    @property
    def visible(self) -> bool:
        """Whether the whole arm is shown."""
        return self.frames[0].visible and self.frames[PEDESTAL].visible

    @property
    def stale(self) -> bool:
        """Whether its motion is not the scenario's; then it is translucent and labelled."""
        return self._note.visible

    @stale.setter
    def stale(self, stale: bool) -> None:
        self._note.visible = stale
        for mesh in self.meshes:
            mesh.opacity = STALE_OPACITY if stale else None


class GhostArm(Shown):
    """A translucent arm, such as that without avoidance; links that coincide with the arm's are hidden."""

    def __init__(
        self, scene: viser.SceneApi, robot: Robot, name: str = "/ghost_arm", colour: Colour = palette.GHOST
    ) -> None:
        """Make the arm, hidden, under a name in the scene tree."""
        self._robot = robot
        self._tree = ArmFrames(scene, robot, name)
        super().__init__(self._tree.frames[0])
        self.visible = False
        shells = light_shells(robot.joint_names)[PEDESTAL:]
        self._corners = np.stack([trimesh.bounds.corners(shell.bounds) for shell in shells])  # (5, 8, 3)
        self.links = tuple(
            scene.add_mesh_simple(
                f"{frame.name}/shell",
                shell.vertices,
                shell.faces,
                color=colour,
                opacity=GHOST_OPACITY,
                cast_shadow=False,
                receive_shadow=False,
            )
            for frame, shell in zip(self._tree.frames[PEDESTAL:], shells, strict=True)
        )

    def pose(self, q: Array, without: Array) -> None:
        """Show the joint angles `without` (6,), rad, beside an arm at `q` (6,), rad."""
        self._tree.pose(without)
        rotations, origins = self._robot.forward_kinematics(np.stack([q, without]))
        carried = slice(PEDESTAL - 1, None)
        corners = self._corners @ rotations[:, carried].swapaxes(-1, -2) + origins[:, carried, None]  # (2, 5, 8, 3)
        moved = np.linalg.norm(corners[1] - corners[0], axis=-1).max(axis=-1)
        for link, distance in zip(self.links, moved, strict=True):
            link.visible = bool(distance > MIN_APART)
