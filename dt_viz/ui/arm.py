"""The JACO arm in the browser: its meshes once, then six rotations a picture."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import trimesh
import viser
import yourdfpy
from viser import transforms

from dt_viz.fields import Array
from dt_viz.robot import Robot, package_folder, urdf_path
from dt_viz.ui import palette


@dataclass(frozen=True)
class _Body:
    """What moves with one joint."""

    placement: Array
    """(4, 4) pose in the parent link, that of the base in the world; all joint angles zero, metres."""
    shell: trimesh.Trimesh
    rings: trimesh.Trimesh | None


@lru_cache(maxsize=1)
def _bodies(joint_names: tuple[str, ...]) -> tuple[_Body, ...]:
    """The base and the six links with all that is fixed to them, read once for all visitors."""
    urdf = yourdfpy.URDF.load(
        str(urdf_path()), filename_handler=lambda fname: str(fname).replace("package://", f"{package_folder()}/")
    )
    scene = urdf.scene
    assert scene is not None
    moving = [urdf.joint_map[name] for name in joint_names]
    links = [moving[0].parent, *(joint.child for joint in moving)]
    parents = scene.graph.transforms.parents
    shells: list[list[trimesh.Trimesh]] = [[] for _ in links]
    rings: list[list[trimesh.Trimesh]] = [[] for _ in links]
    for name, mesh in scene.geometry.items():
        link = parents[name]
        while link not in links:
            link = parents[link]
        placed = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        placed.apply_transform(urdf.get_transform(name, link))
        (rings if name.startswith("ring") else shells)[links.index(link)].append(placed)
    bodies = []
    for index, link in enumerate(links):
        placement = urdf.get_transform(link, links[index - 1] if index else scene.graph.base_frame)
        bodies.append(_Body(placement, _merged(shells[index]), _merged(rings[index]) if rings[index] else None))
    return tuple(bodies)


def _merged(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    merged = trimesh.util.concatenate(meshes)
    assert isinstance(merged, trimesh.Trimesh)
    merged.merge_vertices()
    return merged


class ArmPicture:
    """The arm as a tree of frames, one for each joint, in the scene of one visitor."""

    def __init__(self, scene: viser.SceneApi, robot: Robot) -> None:
        self._robot = robot
        self._frames: list[viser.FrameHandle] = []
        name = ""
        for index, body in enumerate(_bodies(robot.joint_names)):
            name += f"/joint_{index}" if index else "/arm"
            pose = transforms.SE3.from_matrix(body.placement)
            self._frames.append(
                scene.add_frame(name, show_axes=False, wxyz=pose.rotation().wxyz, position=pose.translation())
            )
            scene.add_mesh_simple(f"{name}/shell", body.shell.vertices, body.shell.faces, color=palette.ARM)
            if body.rings is not None:
                scene.add_mesh_simple(f"{name}/rings", body.rings.vertices, body.rings.faces, color=palette.ARM_RING)
        self.pose(robot.home)

    def pose(self, q: Array) -> None:
        """Show the joint angles `q` (6,), rad."""
        for frame, wxyz in zip(self._frames[1:], self._robot.joint_frames(q), strict=True):
            frame.wxyz = wxyz

    @property
    def visible(self) -> bool:
        """Whether the arm is shown."""
        return self._frames[0].visible

    @visible.setter
    def visible(self, visible: bool) -> None:
        self._frames[0].visible = visible
