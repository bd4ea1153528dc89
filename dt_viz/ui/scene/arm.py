"""The arm in the browser, its ghost without avoidance, its body points, and arms along the motion.

Meshes are sent once, then a rotation for each joint for each posture.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import trimesh
import viser
from viser import transforms

from dt_viz.flows.fields import Array
from dt_viz.metrics import interpolate
from dt_viz.robot.robot import Robot
from dt_viz.scenario.scenario import View
from dt_viz.session.engine import ArmMotion
from dt_viz.session.frame import Frame
from dt_viz.ui.scene.palette import LIGHT, STYLES, Colour, linear
from dt_viz.ui.scene.picture import Following, Lines, Look, Picture, Shown, add_label

GRAIN = 2.0**-16
"""Rounding of all vertices, metres: unseen, and what is sent or saved of them is a quarter smaller."""
CELL = 0.005  # edge length of the cells in which a light mesh keeps one vertex, metres


@dataclass(frozen=True)
class Body:
    """The meshes that move with one joint, or those of the base."""

    placement: Array
    """(4, 4) pose in the frame of the joint before, that of the base in the world; all joint angles zero, metres."""
    parts: tuple[tuple[Colour, trimesh.Trimesh], ...]
    """What has one colour, with it; none where nothing is drawn."""


@lru_cache(maxsize=4)
def bodies(robot: Robot) -> tuple[Body, ...]:
    """Join the meshes of the base and of each link with everything fixed to it, once for all visitors."""
    result, still = [], (np.eye(3)[None], np.zeros((1, 3)))
    turns, shifts = map(np.concatenate, zip(still, (robot.joint_rotations, robot.joint_translations), strict=True))
    for joint, (turn, shift) in enumerate(zip(turns, shifts, strict=True), start=-1):
        placement = np.eye(4)
        placement[:3, :3], placement[:3, 3] = turn, shift
        found: dict[Colour | None, list[trimesh.Trimesh]] = {}
        for mesh in robot.visuals:
            if mesh.joint == joint:
                shape = trimesh.Trimesh(GRAIN * np.round(mesh.vertices / GRAIN), mesh.faces, process=False)
                found.setdefault(mesh.colour, []).append(shape)
        merged = {colour: _merged(meshes) for colour, meshes in found.items()}
        result.append(Body(placement, tuple((colour or LIGHT.arm, mesh) for colour, mesh in merged.items())))
    return tuple(result)


@lru_cache(maxsize=4)
def light_links(robot: Robot) -> dict[int, trimesh.Trimesh]:
    """Meshes with at most a third of the triangles, by joint, of what motions move away from something.

    Parts with a colour of their own, beside others in the arm's, are left out.
    """
    links = {}
    for joint, body in enumerate(bodies(robot)[1:]):
        plain = [mesh for colour, mesh in body.parts if colour == LIGHT.arm]
        if joint >= robot.num_fixed and body.parts:
            links[joint] = simplified(_merged(plain or [mesh for _, mesh in body.parts]), CELL)
    return links


def simplified(mesh: trimesh.Trimesh, cell: float) -> trimesh.Trimesh:
    """Replace all vertices in a cell of a grid, of edge length `cell`, metres, by their mean."""
    _, cluster = np.unique(np.floor(mesh.vertices / cell).astype(int), axis=0, return_inverse=True)
    cluster = cluster.ravel()
    sums = np.zeros((cluster.max() + 1, 3))
    np.add.at(sums, cluster, mesh.vertices)
    vertices = sums / np.bincount(cluster)[:, None]
    faces = cluster[mesh.faces]
    corners = np.sort(faces, axis=1)
    whole = (np.diff(corners, axis=1) > 0).all(axis=1)
    _, first = np.unique(corners[whole], axis=0, return_index=True)
    return trimesh.Trimesh(vertices, faces[whole][first], process=False)


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    merged = trimesh.util.concatenate(meshes)
    assert isinstance(merged, trimesh.Trimesh)
    merged.merge_vertices()
    return merged


SEEN = 4e-4
"""Smallest motion of the hand by a joint that is drawn, metres: a third of a pixel, about."""
MIN_APART = 0.006
"""Smallest distance of a link from its ghost at which the ghost is shown, metres: coinciding surfaces flicker."""


class ArmFrames:
    """The frames of the base and the links as a tree in the scene of one visitor."""

    def __init__(self, scene: viser.SceneApi, robot: Robot, name: str) -> None:
        unturned_and_half_turned = np.broadcast_to(np.array([[0.0], [np.pi]]), (2, robot.num_joints))
        self._unturned, self._half_turned = robot.joint_frames(unturned_and_half_turned)
        self._seen, self._drawn = SEEN / robot.levers, np.full(robot.num_joints, np.inf)
        self.frames: list[viser.FrameHandle] = []
        for index, body in enumerate(bodies(robot)):
            name += f"/joint_{index}" if index else ""
            pose = transforms.SE3.from_matrix(body.placement)
            self.frames.append(
                scene.add_frame(name, show_axes=False, wxyz=pose.rotation().wxyz, position=pose.translation())
            )

    def pose(self, q: Array) -> None:
        """Take the joint angles `q` (n,), rad, as far as the change is seen: each joint is a message to the browser."""
        turned = np.abs(q - self._drawn) > self._seen
        self._drawn = np.where(turned, q, self._drawn)
        c, s = np.cos(q / 2)[:, None], np.sin(q / 2)[:, None]
        wxyzs = c * self._unturned + s * self._half_turned  # a quaternion is linear in both
        for joint in np.flatnonzero(turned):
            self.frames[joint + 1].wxyz = wxyzs[joint]


class ArmPicture(ArmFrames):
    """The arm with its meshes."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        super().__init__(scene, robot, "/arm")
        self.meshes: list[viser.MeshHandle] = []
        self._moving = self.frames[1 + robot.num_fixed]
        """Frame of the first link that motions move away from something."""
        for frame, body in zip(self.frames, bodies(robot), strict=True):
            for k, (colour, mesh) in enumerate(body.parts):
                name = f"{frame.name}/part_{k}"
                self.meshes.append(scene.add_mesh_simple(name, mesh.vertices, mesh.faces, color=colour))
        self._note = add_label(scene, f"{self.frames[-1].name}/note", "last good motion", visible=False)
        self.pose(robot.home)

    def show(self, *, whole: bool, pedestal: bool) -> None:
        """Show the whole arm, or only the pedestal under other pictures of it, or nothing."""
        self.frames[0].visible = whole or pedestal
        self._moving.visible = whole

    @property
    def visible(self) -> bool:
        """Whether the whole arm is shown."""
        return self.frames[0].visible and self._moving.visible

    @property
    def stale(self) -> bool:
        """Whether its motion is not the scenario's; then it is translucent and labelled."""
        return self._note.visible

    @stale.setter
    def stale(self, stale: bool) -> None:
        if stale == self.stale:
            return  # each mesh would be a message
        self._note.visible = stale
        for mesh in self.meshes:
            mesh.opacity = STYLES.arm_stale.opacity if stale else None


class GhostArm(Shown):
    """A translucent arm, such as that without avoidance; links that coincide with the arm's are hidden."""

    def __init__(self, scene: viser.SceneApi, robot: Robot, name: str = "/ghost_arm") -> None:
        """Make the arm, hidden, under a name in the scene tree."""
        self._robot, shells = robot, light_links(robot)
        self._tree = ArmFrames(scene, robot, name)
        super().__init__(self._tree.frames[0])
        self.visible = False
        self._joints = list(shells)
        self._corners = np.stack([trimesh.bounds.corners(shell.bounds) for shell in shells.values()])  # (L, 8, 3)
        self.links = tuple(
            scene.add_mesh_simple(
                f"{self._tree.frames[joint + 1].name}/shell",
                shell.vertices,
                shell.faces,
                color=STYLES.arm_ghost.on(LIGHT),
                opacity=STYLES.arm_ghost.opacity,
                cast_shadow=False,
                receive_shadow=False,
            )
            for joint, shell in shells.items()
        )

    def pose(self, q: Array, without: Array) -> None:
        """Show the joint angles `without` (n,), rad, beside an arm at `q` (n,), rad."""
        self._tree.pose(without)
        rotations, origins = self._robot.forward_kinematics(np.stack([q, without]))
        turned = self._corners @ rotations[:, self._joints].swapaxes(-1, -2)
        corners = turned + origins[:, self._joints, None]  # (2, L, 8, 3)
        moved = np.linalg.norm(corners[1] - corners[0], axis=-1).max(axis=-1)
        for link, distance in zip(self.links, moved, strict=True):
            link.visible = bool(distance > MIN_APART)


NUM_ARMS = 6  # number of arms along the motion, start and goal included


def arms_along(robot: Robot, motion: ArmMotion, num: int = NUM_ARMS) -> Array:
    """Return joint angles (num, n), rad, evenly along the path of the hand, its ends included."""
    steps = np.linalg.norm(np.diff(robot.end_effector(motion.q), axis=0), axis=1)
    length = np.concatenate([[0.0], np.cumsum(steps + 1e-9)])  # strictly increasing, also where the hand rests
    return interpolate(np.linspace(0, length[-1], num), length, motion.q)


def _add_copies(
    scene: viser.SceneApi,
    name: str,
    mesh: trimesh.Trimesh,
    num: int,
    **look: Any,  # noqa: ANN401 - as viser's
) -> viser.BatchedMeshHandle:
    """Add so many copies of a mesh that are moved one by one, with viser's further options."""
    unturned = np.tile((1.0, 0.0, 0.0, 0.0), (num, 1))
    look |= {"lod": "off", "cast_shadow": False, "receive_shadow": False}
    return scene.add_batched_meshes_simple(name, mesh.vertices, mesh.faces, unturned, np.zeros((num, 3)), **look)


class ArmSequence(Following[ArmMotion], Picture):
    """Several arms along the motion, from faint at its start to strong at its end; a drag sends only their poses."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        super().__init__(scene.add_frame("/onion", show_axes=False, visible=False))
        self._robot = robot
        colour = np.array(linear(LIGHT.onion), np.uint8)
        opacities = np.linspace(0.12, 0.5, NUM_ARMS, dtype=np.float32)
        look = {"batched_colors": colour, "batched_opacities": opacities}
        self.links = {
            joint: _add_copies(scene, f"/onion/link_{joint + 1}", shell, NUM_ARMS, **look)
            for joint, shell in light_links(robot).items()
        }
        """Pictures of the links, by joint."""

    def draw(self, frame: Frame, look: Look) -> None:
        self.follow(frame.arm)

    def _show(self, newest: ArmMotion) -> None:
        rotations, origins = self._robot.forward_kinematics(arms_along(self._robot, newest))
        wxyzs = transforms.SO3.from_matrix(rotations).wxyz
        for joint, link in self.links.items():
            # the browser blends nodes from far to near by their own positions
            link.position = middle = origins[:, joint].mean(axis=0)
            link.batched_positions = (origins[:, joint] - middle).astype(np.float32)
            link.batched_wxyzs = wxyzs[:, joint].astype(np.float32)


class BodySpheres(Shown):
    """The spheres that cover the arm, with their displacements by avoidance: the larger, the stronger the colour."""

    def __init__(self, scene: viser.SceneApi, radius: Array) -> None:
        """Make spheres of these radii (P,), metres."""
        super().__init__(scene.add_frame("/body_points", show_axes=False, visible=False))
        self.spheres = _add_copies(
            scene,
            "/body_points/spheres",
            trimesh.creation.icosphere(subdivisions=2),
            len(radius),
            batched_scales=radius.astype(np.float32),
            batched_colors=np.zeros((len(radius), 3), np.uint8),
            opacity=STYLES.body_points.opacity,
        )
        self.paths = Lines(scene, "/body_points/paths", STYLES.body_path)

    def pose(self, positions: Array, without: Array) -> None:
        """Show the spheres at `positions` (P, 3), with lines from those `without` avoidance (P, 3), metres."""
        moved = np.linalg.norm(positions - without, axis=1, keepdims=True)
        still, far = (np.array(linear(colour)) for colour in (LIGHT.body_point, LIGHT.body_point_moved))
        relative = np.minimum(moved / 0.1, 1)  # moved by a decimetre, they have the full colour
        self.spheres.position = middle = positions.mean(axis=0)
        self.spheres.batched_positions = (positions - middle).astype(np.float32)
        self.spheres.batched_colors = (still + relative * (far - still)).astype(np.uint8)
        self.paths.show_segments(np.stack([without, positions], axis=1), LIGHT)


class Arms:
    """The arm, its ghost without avoidance, and its body points, which move with the playback."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._robot = robot
        self.arm = ArmPicture(scene, robot)
        self.ghost = GhostArm(scene, robot)
        self.body = BodySpheres(scene, robot.body.radius)
        self._now = (robot.home, robot.home)
        self._posing = threading.Lock()  # the playback poses, another thread shows and hides

    def pose(self, q: Array, without: Array) -> None:
        """Show the joint angles `q` (n,), rad, and those `without` avoidance (n,), rad."""
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
            self.body.pose(*self._robot.body.positions(self._robot, np.stack([q, without])))
