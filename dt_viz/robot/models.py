"""Arms by name, and arms of any URDF: all that is known of one, found once and then kept in the user's cache folder."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from xml.etree.ElementTree import Element

import numpy as np

from dt_viz.errors import naming
from dt_viz.flows.fields import Array
from dt_viz.folders import default_cache_folder
from dt_viz.memo import Memo
from dt_viz.robot import arm_cache
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.choices import (
    ArmSearchSettings,
    HomeSearch,
    Ranges,
    checked_home,
    count_fixed,
    find_front,
    find_home,
    find_levers,
    find_touching,
    to_front,
)
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.cover import CoverSettings, covering_tree, protrusion, usual_radius
from dt_viz.robot.descriptions import description_of
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_shapes import Shapes, read_shapes, reduced
from dt_viz.robot.meshes import constant
from dt_viz.robot.robot import Robot
from dt_viz.robot.tool_chain import ArmChain, find_chain
from dt_viz.robot.urdf import ArmError, read_description, read_semantic
from dt_viz.shipped import ASSETS

DISTRIBUTION = "example-robot-data"
HOME = (0.0, 3.2, 1.1, 0.0, 3.4, 0.0)
"""Ready pose of the JACO, rad: upper arm upright, elbow high, hand ahead of the base, 47° downwards."""
RING = (62, 66, 74)
"""Colour of the JACO's rings."""

Progress = Callable[[float, str], object]
"""Is told the fraction that is done, in [0, 1], and what is going on."""
EndEffector = str | tuple[str, Sequence[float]]
"""A link of a URDF, or one and a place in it, metres."""


@dataclass(frozen=True)
class KnownArm:
    """What is known of an arm beside its URDF; None is found."""

    title: str
    urdf: str
    """End of its path in the package example-robot-data."""
    srdf: str | None = None
    end_effector: EndEffector | None = None
    home: tuple[float, ...] | None = None
    """Ready pose, rad."""
    front: str | None = None
    levers: tuple[float, ...] | None = None
    """Motion of the hand for each joint's turning, m/rad."""
    body: str | None = None
    """File of its body points that ships with DT-Viz."""


ARMS: Mapping[str, KnownArm] = {
    "jaco": KnownArm(
        "JACO",
        "kinova_description/robots/kinova.urdf",
        end_effector="j2s6s200_end_effector",
        home=HOME,
        front="-y",
        levers=(0.5, 0.5, 0.35, 0.12, 0.14, 0.05),
        body="body_points.npz",
    ),
    "panda": KnownArm("Franka Panda", "panda_description/urdf/panda.urdf", "panda_description/srdf/panda.srdf"),
    "ur3": KnownArm("UR3", "ur_description/urdf/ur3_robot.urdf"),
    "ur5": KnownArm("UR5", "ur_description/urdf/ur5_robot.urdf", "ur_description/srdf/ur5.srdf"),
    "ur10": KnownArm("UR10", "ur_description/urdf/ur10_robot.urdf"),
    "xarm7": KnownArm("xArm7", "xarm_description/urdf/xarm7.urdf", "xarm_description/srdf/xarm7.srdf"),
    "z1": KnownArm(
        "Unitree Z1",
        "z1_description/urdf/z1.urdf",
        "z1_description/srdf/z1.srdf",
        end_effector=("gripperStator", (0.14, 0.0, 0.0)),
    ),
    "so100": KnownArm("SO-100", "so_arm_description/urdf/so100.urdf", end_effector=("gripper", (0.0, -0.1, 0.0))),
    "so101": KnownArm("SO-101", "so_arm_description/urdf/so101.urdf"),
}
"""Arms of the package example-robot-data, by name."""


class NotStoredError(LookupError):
    """An arm that is not in the cache yet: making it takes seconds."""


def load_arm(name: str = "jaco", progress: Progress | None = None, *, stored: bool = False) -> Robot:
    """Load an arm, once; those loaded last are kept.

    Args:
        name: one of `ARMS`; or the name of one in the package robot_descriptions, such as "gen3", where that is
            installed and its files were downloaded before.
        progress: is told how much is done; see `robot_from_urdf`.
        stored: whether it is taken from the cache only.

    Raises:
        FileNotFoundError: The package example-robot-data is not installed, or its version has no such file.
        ArmError: There is no such arm, or its description cannot be used.
        NotStoredError: It is to be in the cache, and is not.
    """
    return _LOADED("arm", name, lambda: _load(name, progress, stored), newest=NUM_LOADED)


_LOADED = Memo()
NUM_LOADED = 4
"""Number of arms that are kept: one takes 10 to 270 MB."""


def load_jaco() -> Robot:
    """Load the JACO arm (j2s6s200: six joints, two fingers), once.

    Raises:
        FileNotFoundError: As `load_arm`.
    """
    return load_arm("jaco")


def urdf_path(name: str = "jaco", ending: str | None = None) -> Path:
    """Find the URDF of an arm, or another file by the end of its path, in the installed example-robot-data.

    Raises:
        FileNotFoundError: The package is not installed, or its version has no such file.
    """
    ending = ending or ARMS[name].urdf
    try:
        distribution = metadata.distribution(DISTRIBUTION)
    except metadata.PackageNotFoundError as error:
        title = ARMS[name].title
        raise FileNotFoundError(
            f"the {title} model needs the package {DISTRIBUTION}: pip install {DISTRIBUTION}"
        ) from error
    for file in distribution.files or ():
        path = Path(str(distribution.locate_file(file)))
        if file.as_posix().endswith(ending) and path.is_file():
            return path.resolve()
    raise FileNotFoundError(f"{DISTRIBUTION} {distribution.version} holds no {ending}; 6.0.0 does")


def _load(name: str, progress: Progress | None, stored: bool) -> Robot:
    if name not in ARMS:
        path, folders = description_of(name, ", ".join(ARMS))
        return robot_from_urdf(path, package_dirs=folders, name=name, progress=progress, stored=stored)
    known, urdf = ARMS[name], urdf_path(name)
    package_dir = next(folder.parent for folder in urdf.parents if folder.name == DISTRIBUTION)
    given = _Given(
        urdf, name, known.title, known.end_effector, known.home, known.front,
        urdf_path(name, known.srdf) if known.srdf else None, (package_dir,), levers=known.levers,
        body=None if known.body is None else ASSETS / known.body,
    )  # fmt: skip
    robot = given.load(progress, stored=stored)
    if name != "jaco":
        return robot
    visuals = (replace(mesh, colour=RING if mesh.name.startswith("ring") else None) for mesh in robot.visuals)
    return replace(robot, visuals=tuple(visuals))


def robot_from_urdf(
    path: str | Path,
    end_effector: EndEffector | None = None,
    home: Sequence[float] | None = None,
    front: str | Sequence[float] | None = None,
    srdf: str | Path | None = None,
    package_dirs: Sequence[str | Path] = (),
    locked: Sequence[str] | Mapping[str, float] | None = None,
    *,
    name: str | None = None,
    progress: Progress | None = None,
    stored: bool = False,
) -> Robot:
    """Load an arm from a URDF; what is not given is found, see `Robot.report`. It takes seconds for the first time.

    Args:
        path: the URDF, expanded if it comes from xacro.
        end_effector: link that is the tool frame, or (link, (x, y, z)) with the tool's place in it, metres. By default
            that of the SRDF, else a frame with a usual name (tcp, tool0 …), else the farthest one.
        home: (n,) ready pose, rad. By default a state of the SRDF that is one, else it is searched for.
        front: "x", "-x", "y", "-y" or a horizontal direction, in the base frame of the URDF.
        srdf: file that names the end effector, states, and pairs of links that may touch.
        package_dirs: folders in which the `package://` addresses of meshes resolve, beside the URDF's own ones.
        locked: joints that do not move, perhaps each with its value, rad or metres. By default those of grippers.
        name: of the arm; by default that in the URDF.
        progress: is told the fraction that is done, and what is going on; it may raise an exception to cancel.
        stored: whether it is taken from the cache only.

    Raises:
        ArmError: The URDF, a mesh, or what is given cannot be used.
        NotStoredError: It is to be in the cache, and is not.
    """
    folders = tuple(Path(folder).expanduser().resolve() for folder in package_dirs)
    urdf, semantic = Path(path).expanduser().resolve(), None if srdf is None else Path(srdf).expanduser().resolve()
    posture = None if home is None else tuple(float(angle) for angle in home)
    return _Given(urdf, name, name, end_effector, posture, front, semantic, folders, locked).load(
        progress, stored=stored
    )


@dataclass(frozen=True)
class _Given:
    """An arm's description, and what is given beside it."""

    urdf: Path
    name: str | None
    title: str | None
    end_effector: EndEffector | None
    home: tuple[float, ...] | None
    front: str | Sequence[float] | None
    srdf: Path | None
    package_dirs: tuple[Path, ...]
    locked: Sequence[str] | Mapping[str, float] | None = None
    levers: tuple[float, ...] | None = None
    body: Path | None = None
    """File of body points, as ``python -m assets.make_body_points`` makes it; None makes them, and looks for links that
    always touch."""
    choice: ArmSearchSettings = field(default=ArmSearchSettings())
    cover: CoverSettings = field(default=CoverSettings())

    def load(self, progress: Progress | None, *, stored: bool = False) -> Robot:
        """Return the arm from the cache, or make it and put it there, unless only one that is `stored` is wanted."""
        tell = progress or (lambda _fraction, _message: None)
        tell(0.0, "reading the URDF")
        semantic, chain, text, files, name = self._read()
        chosen = (
            self.end_effector,
            self.home,
            self.front,
            self.locked,
            self.levers,
            self.choice,
            self.cover,
            chain.tool,
        )
        told = [text.encode(), repr(chosen).encode(), self.srdf.read_bytes() if self.srdf else b""]
        told += [self.body.read_bytes()] if self.body else []
        materials = (path for file in files if file.suffix.lower() == ".obj" for path in file.parent.glob("*.mtl"))
        key = arm_cache.digest([*told, *(file.read_bytes() for file in (*files, *sorted(materials)))])
        path = default_cache_folder() / "arms" / f"{key}.npz"
        names = {"name": name, "title": self.title or name, "urdf": self.urdf, "package_dirs": self.package_dirs}
        robot = arm_cache.read(path, names)
        if robot is None:
            if stored:
                raise NotStoredError(name)
            robot = self._robot(semantic, chain, text, name, tell)
            arm_cache.write(path, robot)
        tell(1.0, "")
        return robot

    def _read(self) -> tuple[Element | None, ArmChain, str, tuple[Path, ...], str]:
        semantic = None if self.srdf is None else read_semantic(self.srdf)
        with naming(ArmError, self.urdf):
            description = read_description(self.urdf)
            chain = find_chain(description, self.end_effector, self.locked, semantic)
            text, files = reduced(description, chain, self.package_dirs)
        return semantic, chain, text, files, self.name or description.name

    def _robot(self, semantic: Element | None, chain: ArmChain, text: str, name: str, tell: Progress) -> Robot:
        with naming(ArmError, self.urdf):
            tell(0.02, "reading the meshes")
            shapes = read_shapes(text, chain)
            lower, upper, velocity = np.array([joint.limits for joint in chain.joints]).T
            names = tuple(joint.name for joint in chain.joints)
            home = None if self.home is None else checked_home(np.array(self.home), names, lower, upper)
            ranges = Ranges.of(lower, upper)
            front, front_why = find_front(shapes.kinematics, ranges, self.front, home, self.choice)
            base = to_front(front)
            arm, meshes, visuals = _turned(shapes, base)
            num_fixed, fixed_why = count_fixed(arm)
            solids = CollisionModel(arm, meshes, num_fixed)
            cover_why = "as shipped"
            if self.body is None:
                body = BodyPoints(
                    covering_tree(
                        meshes,
                        lambda mesh: usual_radius(mesh, arm.reach, self.cover),
                        self.cover,
                        lambda part: tell(0.1 + 0.6 * part, "covering the links with spheres"),
                    )
                )
                mean, most = protrusion(body.spheres, meshes)
                cover_why = (
                    f"they stick out of the meshes by {1e3 * mean:.1f} mm in the mean, {1e3 * most:.0f} mm at most"
                )
                tell(0.75, "looking for links that always touch")
                touching, touching_why = find_touching(
                    solids, meshes, ranges, semantic, self.cover.protrusion, self.choice
                )
            else:
                with np.load(self.body, allow_pickle=False) as arrays:
                    body = BodyPoints.from_arrays(arrays)
                touching, touching_why = frozenset(), "neighbours alone"
            tell(0.85, "looking for a ready pose")
            solids.touching = touching
            search = HomeSearch(arm, body, solids, ranges, self.choice)
            posture, home_why = find_home(search, names, lower, upper, home, semantic)
            levers = np.array(self.levers) if self.levers else find_levers(arm, posture, lower, upper, self.choice)
        locked = ", ".join(f"{joint} at {value:.3g}" for joint, value in chain.locked.items()) or "none"
        pairs = "; ".join(sorted(" and ".join(sorted(pair)) for pair in touching))
        return Robot(
            **{key: getattr(arm, key) for key in Kinematics.__dataclass_fields__},
            name=name,
            title=self.title or name,
            joint_names=names,
            lower=constant(lower),
            upper=constant(upper),
            velocity_limits=constant(velocity),
            home=constant(posture),
            levers=constant(levers),
            body=body,
            meshes=meshes,
            visuals=visuals,
            num_fixed=num_fixed,
            touching=touching,
            base=constant(base),
            urdf=self.urdf,
            package_dirs=self.package_dirs,
            found=(
                ("joints", f"{', '.join(names)}; limits of the URDF"),
                ("locked", locked),
                ("tool", f"{chain.tool}: {chain.why}"),
                ("front", f"({front[0]:.2f}, {front[1]:.2f}) in the URDF's base: {front_why}"),
                ("home", f"{np.round(posture, 3).tolist()} rad: {home_why}"),
                ("levers", f"{np.round(levers, 3).tolist()} m/rad: {'given' if self.levers else 'around home'}"),
                ("fixed links", f"{num_fixed}: {fixed_why}"),
                ("body", f"{len(body.joint)} points of {len(body.spheres)} spheres: {cover_why}"),
                ("may touch", f"{pairs or 'no other links'}: {touching_why}"),
            ),
        )


def _turned(shapes: Shapes, base: Array) -> Shapes:
    """Turn the base of an arm."""
    if np.array_equal(base, np.eye(3)):
        return shapes
    meshes, visuals = (mesh.turned(base) for mesh in shapes.meshes), (mesh.turned(base) for mesh in shapes.visuals)
    return Shapes(shapes.kinematics.turned(base), tuple(meshes), tuple(visuals))
