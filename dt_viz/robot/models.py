"""Arms by name, and arms of any URDF: all that is known of one, found once and then kept in the user's cache folder."""

from __future__ import annotations

import importlib
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from importlib import metadata
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element

import numpy as np

from dt_viz.errors import naming
from dt_viz.files.npz import read_cached, write_cached
from dt_viz.folders import default_cache_folder
from dt_viz.kernels.arm import BODY_POINT
from dt_viz.memo import Memo
from dt_viz.robot import choices
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import CollisionModel
from dt_viz.robot.cover import CoverSettings, covering_tree, protrusion, usual_radius
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_shapes import read_shapes, resolved
from dt_viz.robot.robot import Robot
from dt_viz.robot.tool_chain import ArmChain, find_chain
from dt_viz.robot.urdf import ArmError, Description, LinkMesh, VisualMesh, constant, read_robot
from dt_viz.shipped import ASSETS

DISTRIBUTION = "example-robot-data"
HOME = (0.0, 3.2, 1.1, 0.0, 3.4, 0.0)
"""Ready pose of the JACO, rad: upper arm upright, elbow high, hand ahead of the base, 47° downwards."""
RING = (62, 66, 74)  # colour of the JACO's rings

FORMAT = 6
"""Version of what is found of an arm and of its file; raised with every change, so that older files are not used."""
MAX_BYTES = 500 * 10**6  # largest number of bytes that a file unpacks to
PER_JOINT = ("joint_names", "lower", "upper", "velocity_limits", "home", "levers")
SMALL = (*PER_JOINT, "joint_rotations", "joint_translations", "hand_axis", "hand_rotation", "end_effector_offset",
         "base", "num_fixed")  # fmt: skip
"""Fields of an arm that are arrays, and are stored as they are."""

Progress = Callable[[float, str], object]
"""Is told the fraction that is done, in [0, 1], and what is going on."""
EndEffector = str | tuple[str, Sequence[float]]
"""A link of a URDF, or one and a place in it, metres."""


@dataclass(frozen=True)
class KnownArm:
    """What is known of an arm beside its URDF; None is found."""

    title: str = ""  # its name where empty
    urdf: str = ""  # end of its path in the package example-robot-data
    srdf: str | None = None
    end_effector: EndEffector | None = None
    home: tuple[float, ...] | None = None  # ready pose, rad
    front: str | Sequence[float] | None = None
    levers: tuple[float, ...] | None = None  # motion of the hand for each joint's turning, m/rad
    body: str | None = None
    """File of its body points that ships with DT-Viz, as ``python -m assets.make_body_points`` makes it; None makes
    them, and looks for links that always touch."""


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
NUM_LOADED = 4  # number of arms that are kept: one takes 10 to 270 MB


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
    srdf = urdf_path(name, known.srdf) if known.srdf else None
    robot = _kept(urdf, name, known, srdf, (package_dir,), None, progress, stored=stored)
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
    known = KnownArm(end_effector=end_effector, home=posture, front=front)
    return _kept(urdf, name, known, semantic, folders, locked, progress, stored=stored)


def _kept(
    urdf: Path,
    name: str | None,
    known: KnownArm,
    srdf: Path | None,
    package_dirs: tuple[Path, ...],
    locked: Sequence[str] | Mapping[str, float] | None,
    progress: Progress | None,
    *,
    stored: bool,
) -> Robot:
    """Return the arm from the cache, or make it and put it there, unless only one that is `stored` is wanted."""
    tell = progress or (lambda _fraction, _message: None)
    tell(0.0, "reading the URDF")
    semantic = None if srdf is None else read_robot(srdf)
    with naming(ArmError, urdf):
        description = Description(urdf)
        chain = find_chain(description, known.end_effector, locked, semantic)
        text, files = resolved(description, package_dirs)
        limits = [joint.limits for joint in chain.joints]
    name = name or description.name
    given = {"name": name, "title": known.title or name, "urdf": urdf, "package_dirs": package_dirs}
    files += sorted(path for file in files if file.suffix.lower() == ".obj" for path in file.parent.glob("*.mtl"))
    files += [*([srdf] if srdf else []), *([ASSETS / known.body] if known.body else [])]
    parts = [text.encode(), repr((FORMAT, replace(known, title=""), chain.tool, chain.locked, limits)).encode()]
    parts += [file.read_bytes() for file in files]
    key = sha256(b"".join(sha256(part).digest() for part in parts)).hexdigest()
    path = default_cache_folder() / "arms" / f"{key}.npz"
    robot = read_cached(path, lambda arrays: from_arrays(arrays, given), MAX_BYTES)
    if robot is None:
        if stored:
            raise NotStoredError(name)
        with naming(ArmError, urdf):
            robot = _made(semantic, chain, text, known, given, tell)
        write_cached(path, to_arrays(robot))
    tell(1.0, "")
    return robot


def _made(
    semantic: Element | None, chain: ArmChain, text: str, known: KnownArm, given: Mapping[str, Any], tell: Progress
) -> Robot:
    tell(0.02, "reading the meshes")
    shapes = read_shapes(text, chain)
    lower, upper, velocity = np.array([joint.limits for joint in chain.joints]).T
    names = tuple(joint.name for joint in chain.joints)
    home = None if known.home is None else choices.checked_home(np.array(known.home), names, lower, upper)
    ranges = choices.Ranges.of(lower, upper)
    front, front_why = choices.find_front(shapes.kinematics, ranges, known.front, home)
    base = choices.to_front(front)
    arm, meshes, visuals = shapes.turned(base)
    upright = abs(arm.joint_rotations[0][2, 2]) > np.cos(np.radians(5))
    num_fixed = int(upright)  # a joint that turns about the vertical only spins its link
    solids = CollisionModel(arm, meshes, num_fixed)
    if known.body is None:
        covering = lambda part: tell(0.1 + 0.6 * part, "covering the links with spheres")  # noqa: E731
        radius = lambda mesh: usual_radius(mesh, arm.reach)  # noqa: E731
        body = BodyPoints(covering_tree(meshes, radius, CoverSettings(), covering))
        mean, most = protrusion(body.spheres, meshes)
        cover_why = f"they stick out of the meshes by {1e3 * mean:.1f} mm in the mean, {1e3 * most:.0f} mm at most"
        tell(0.75, "looking for links that always touch")
        touching, touching_why = choices.find_touching(solids, ranges, semantic, CoverSettings.protrusion)
    else:
        with np.load(ASSETS / known.body, allow_pickle=False) as arrays:
            body = BodyPoints.from_arrays(arrays)
        touching, touching_why, cover_why = frozenset(), "neighbours alone", "as shipped"
    tell(0.85, "looking for a ready pose")
    solids.touching = touching
    search = choices.HomeSearch(arm, body, solids, ranges)
    posture, home_why = choices.find_home(search, names, lower, upper, semantic) if home is None else (home, "given")
    levers = np.array(known.levers) if known.levers else choices.find_levers(arm, posture, lower, upper)
    locked = ", ".join(f"{joint} at {value:.3g}" for joint, value in chain.locked.items()) or "none"
    pairs = "; ".join(sorted(" and ".join(sorted(pair)) for pair in touching))
    return Robot(
        **{key: getattr(arm, key) for key in Kinematics.__dataclass_fields__},
        **given,
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
        found=(
            ("joints", f"{', '.join(names)}; limits of the URDF"),
            ("locked", locked),
            ("tool", f"{chain.tool}: {chain.why}"),
            ("front", f"({front[0]:.2f}, {front[1]:.2f}) in the URDF's base: {front_why}"),
            ("home", f"{np.round(posture, 3).tolist()} rad: {home_why}"),
            ("levers", f"{np.round(levers, 3).tolist()} m/rad: {'given' if known.levers else 'around home'}"),
            ("fixed links", f"{num_fixed}: joint 1 is {'' if upright else 'not '}vertical"),
            ("body", f"{len(body.joint)} points of {len(body.spheres)} spheres: {cover_why}"),
            ("may touch", f"{pairs or 'no other links'}: {touching_why}"),
        ),
    )


# --- Arms of the package robot_descriptions, where that is installed: nothing is ever downloaded ---


def description_of(name: str, others: str) -> tuple[Path, list[Path]]:
    """Return the URDF of an arm, such as "gen3", that the package knows and has downloaded, and folders of its meshes.

    The message of an error says that the `others` are accepted, too.

    Raises:
        ArmError: There is no such arm, it is not downloaded, or has no URDF.
    """
    accepted = f"{others}; or a name of the package robot_descriptions"
    try:
        cache, repositories = _part("_cache"), _part("_repositories").REPOSITORIES
    except ImportError as error:
        raise ArmError("arm", "name", repr(name), f"{accepted}: pip install robot_descriptions") from error

    def there(repository: str, **_: object) -> str:
        path = _folder(repositories[repository])
        if not path.is_dir():
            found = f"{name!r}, which is not on this machine yet"
            raise ArmError("arm", "name", found, f"after: robot_descriptions pull {name}")
        return str(path)

    cloning, cache.clone_to_cache = cache.clone_to_cache, there  # which its modules call: nothing is downloaded
    try:
        found = vars(_part(f"{name.removesuffix('_description')}_description"))
    except ModuleNotFoundError as error:
        raise ArmError("arm", "name", repr(name), accepted) from error
    finally:
        cache.clone_to_cache = cloning
    if "URDF_PATH" not in found:
        accepted = "a URDF; expand a xacro file first: xacro FILE"
        raise ArmError("arm", "name", f"{name!r}, a description without a URDF", accepted)
    folders = [Path(found[key]) for key in ("PACKAGE_PATH", "REPOSITORY_PATH") if key in found]
    return Path(found["URDF_PATH"]), [*folders, *(folder.parent for folder in folders)]


def local_descriptions() -> tuple[str, ...]:
    """Names of the arms that the package has downloaded; none without it."""
    try:
        listed, repositories = _part("_descriptions").DESCRIPTIONS, _part("_repositories").REPOSITORIES
    except ImportError:
        return ()
    return tuple(
        name.removesuffix("_description")
        for name, each in listed.items()
        if each.has_urdf and "arm" in each.tags and _folder(repositories.get(each.repository)).is_dir()
    )


def _part(name: str) -> Any:  # noqa: ANN401 - of that package, as `_folder`
    return importlib.import_module(f"robot_descriptions.{name}")


def _folder(repository: Any) -> Path:  # noqa: ANN401 - None is of no file
    """Return the folder of a repository, which is there once it was downloaded."""
    folder = Path(os.environ.get("ROBOT_DESCRIPTIONS_CACHE", "~/.cache/robot_descriptions")).expanduser()
    return folder / getattr(repository, "cache_path", "none")


# --- The cache ---


def to_arrays(robot: Robot) -> dict[str, np.ndarray]:
    """Return the arrays that an arm is stored as."""
    arrays = {name: np.array(getattr(robot, name)) for name in SMALL}
    arrays |= {f"body_{name}": robot.body.spheres[name] for name in BODY_POINT.names or ()}
    arrays["touching"] = np.array(sorted(map(sorted, robot.touching)), str).reshape(-1, 2)
    arrays["found"] = np.array(robot.found, str).reshape(-1, 2)
    for kind in ("meshes", "visuals"):
        meshes: Sequence[LinkMesh] = getattr(robot, kind)
        arrays[f"{kind}_names"] = np.array([mesh.name for mesh in meshes], str)
        arrays[f"{kind}_joints"] = np.array([mesh.joint for mesh in meshes], int)
        for k, mesh in enumerate(meshes):
            arrays |= {f"{kind}{k}_vertices": mesh.vertices, f"{kind}{k}_faces": mesh.faces.astype(np.int32)}
    arrays["colours"] = np.array([mesh.colour or (-1, -1, -1) for mesh in robot.visuals], int).reshape(-1, 3)
    return arrays


def from_arrays(arrays: Mapping[str, np.ndarray], given: Mapping[str, Any]) -> Robot:
    """Make an arm of its arrays and the other fields.

    Raises:
        Exception: of almost any kind, if some are missing or do not fit.
    """
    values: dict[str, Any] = {name: constant(arrays[name], arrays[name].dtype) for name in SMALL}
    values |= {"joint_names": tuple(arrays["joint_names"].tolist()), "num_fixed": int(arrays["num_fixed"])}
    colours = [None if min(colour) < 0 else tuple(colour) for colour in arrays["colours"].tolist()]
    robot = Robot(
        **values,
        **given,
        body=BodyPoints.from_arrays(arrays, "body_"),
        touching=frozenset(frozenset(pair) for pair in arrays["touching"].tolist()),
        found=tuple((what, why) for what, why in arrays["found"].tolist()),
        meshes=tuple(LinkMesh(*parts) for parts in _meshes(arrays, "meshes")),
        visuals=tuple(VisualMesh(*parts) for parts in _meshes(arrays, "visuals", colours)),
    )
    if {len(getattr(robot, name)) for name in PER_JOINT} != {robot.num_joints}:
        raise ValueError("arrays of different lengths")
    return robot


def _meshes(arrays: Mapping[str, np.ndarray], kind: str, *more: Sequence[Any]) -> Iterator[tuple[Any, ...]]:
    of_each = zip(arrays[f"{kind}_names"].tolist(), arrays[f"{kind}_joints"].tolist(), *more, strict=True)
    for k, (name, joint, *rest) in enumerate(of_each):
        yield name, joint, constant(arrays[f"{kind}{k}_vertices"]), constant(arrays[f"{kind}{k}_faces"], np.intp), *rest
