"""URDF files as trees of links and joints, checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
from numpy.typing import ArrayLike, DTypeLike, NDArray
from scipy.spatial.transform import Rotation

from dt_viz.errors import DataError, FormatError, parsing
from dt_viz.flows.fields import Array, Indices
from dt_viz.memo import cached_property

MAX_BYTES = 20_000_000  # size of the largest URDF that is read, bytes
TURNING = ("revolute", "continuous")  # types of joints that turn about an axis
MOVING = (*TURNING, "prismatic", "floating", "planar")  # types of joints that move
TREE = "a tree, where each link is carried by one joint"
USUAL_VELOCITY = 1.0  # velocity limit of joints for which a file gives none, rad/s


class ArmError(DataError):
    """A description of an arm that cannot be used."""


@dataclass(frozen=True)
class Joint:
    """A joint of a URDF."""

    name: str
    kind: str
    parent: str
    child: str
    element: Element

    @property
    def moves(self) -> bool:
        """Whether its type is one that moves."""
        return self.kind in MOVING

    @cached_property
    def axis(self) -> Array:
        """Unit vector (3,) that it turns about or moves along, in its own frame."""
        axis = numbers(self.element.find("axis"), "xyz", f"joint {self.name}: axis", (1.0, 0.0, 0.0))
        length = float(np.linalg.norm(axis))
        if not length > 0:
            raise FormatError(f"joint {self.name}: axis", "0 0 0", "a direction")
        return axis / length

    @cached_property
    def limits(self) -> tuple[float, float, float]:
        """Lower and upper limit, rad, infinite for a continuous joint, and the velocity's, rad/s."""
        limit, field = self.element.find("limit"), f"joint {self.name}: limit"
        lower, upper, velocity = (numbers(limit, key, field, (0.0,)).item() for key in ("lower", "upper", "velocity"))
        if self.kind == "continuous":
            lower, upper = -np.inf, np.inf
        elif limit is None or limit.get("lower") is None or limit.get("upper") is None:
            raise FormatError(field, "none", '<limit lower="…" upper="…" velocity="…"/>, or the type continuous')
        if not lower < upper:
            raise FormatError(field, f"lower {lower:g}, upper {upper:g}", "a lower limit below the upper one")
        return lower, upper, velocity if velocity > 0 else USUAL_VELOCITY

    @cached_property
    def origin(self) -> tuple[Array, Array]:
        """Rotation (3, 3) and translation (3,), metres, of its frame in the parent's."""
        rpy, xyz = (numbers(self.element.find("origin"), key, f"joint {self.name}: origin") for key in ("rpy", "xyz"))
        return Rotation.from_euler("xyz", rpy).as_matrix(), xyz


class Description:
    """A URDF as a tree of links and joints, checked.

    Attributes:
        path: the file.
        name: the robot's name, or the file's.
        materials: elements of the materials that links share.
        links: elements of the links, by name.
        joints: by name.
        into: the joint that carries each link but the root.
        root: name of the link that no joint carries.
    """

    def __init__(self, path: Path) -> None:
        """Read a URDF. Raises FormatError where it is none, ArmError where it is no XML of a robot."""
        robot = read_robot(path)
        self.path, self.name = path, robot.get("name") or path.stem
        self.materials = robot.findall("material")
        self.links = dict(_named(robot, "link"))
        if not self.links:
            raise FormatError("links", "none", "a robot with links and joints; expand a xacro file first: xacro FILE")
        self.joints = {name: _joint(name, element) for name, element in _named(robot, "joint")}
        self.into: dict[str, Joint] = {}
        for joint in self.joints.values():
            for link in (joint.parent, joint.child):
                if link not in self.links:
                    raise FormatError(f"joint {joint.name}", f"link {link!r}, which is not there", listed(self.links))
            if joint.child in self.into:
                found = f"two joints that carry it, {self.into[joint.child].name} and {joint.name}"
                raise FormatError(f"link {joint.child}", found, f"{TREE}: no loops")
            self.into[joint.child] = joint
        try:
            TopologicalSorter({link: [joint.parent] for link, joint in self.into.items()}).prepare()
        except CycleError as error:
            raise FormatError("links", "a loop of links", TREE) from error
        self.root, *others = (link for link in self.links if link not in self.into)
        if others:
            found = f"the roots {listed([self.root, *others], 5)}"
            raise FormatError("links", found, "a tree with one link that no joint carries")

    def to(self, link: str) -> list[Joint]:
        """List the joints from the root to a link."""
        joints: list[Joint] = []
        while link in self.into:
            joints.insert(0, self.into[link])
            link = joints[0].parent
        return joints


# --- Reading ---


class _Builder(ElementTree.TreeBuilder):
    """A builder of trees from files without entities."""

    def doctype(self, *_: object) -> None:
        """Refuse a document type."""
        raise FormatError("XML", "a document type or entities", "a URDF without them")


def read_robot(path: Path) -> Element:
    """Read a URDF or an SRDF. Raises ArmError where it is none."""
    with parsing(ArmError, path, "file", accepted := "a URDF: XML with the root <robot>"):
        try:
            size = path.stat().st_size
            data = path.read_bytes() if size <= MAX_BYTES else b""
        except OSError as error:
            raise FormatError("file", error.strerror or "an error", "a URDF file that can be read") from error
        if not data:
            raise FormatError("file", f"{size:,} bytes", f"a URDF of up to {MAX_BYTES:,} bytes")
        root = ElementTree.fromstring(data, ElementTree.XMLParser(target=_Builder()))
        if root.tag != "robot":
            raise FormatError("XML", f"the root <{root.tag}>", accepted)
        return root


def _named(robot: Element, tag: str) -> Iterator[tuple[str, Element]]:
    elements = robot.findall(tag)
    counts = Counter(element.get("name") for element in elements)
    for name, count in counts.items():
        if not name or count > 1:
            raise FormatError(tag, f"{count} named {name!r}" if name else "one without a name", "different names")
    yield from ((str(element.get("name")), element) for element in elements)


def _joint(name: str, element: Element) -> Joint:
    kind = element.get("type", "")
    if kind not in (*MOVING, "fixed"):
        raise FormatError(f"joint {name}: type", repr(kind), ", ".join((*MOVING, "fixed")))
    ends = {}
    for tag in ("parent", "child"):
        link = element.find(tag)
        if link is None or not link.get("link"):
            raise FormatError(f"joint {name}", f"no {tag} link", f'<{tag} link="…"/>')
        ends[tag] = str(link.get("link"))
    return Joint(name, kind, ends["parent"], ends["child"], element)


def numbers(element: Element | None, key: str, field: str, default: tuple[float, ...] = (0.0, 0.0, 0.0)) -> Array:
    """Read as many numbers as the default has from an attribute, which may be missing."""
    text = None if element is None else element.get(key)
    if text is None:
        return np.array(default)
    try:
        found = np.array([float(word) for word in text.split()])
    except ValueError:
        found = np.array([])
    if found.shape != (len(default),) or not np.isfinite(found).all():
        raise FormatError(field, f"{key}={text!r}", f"{len(default)} numbers" if len(default) > 1 else "a number")
    return found


def listed(names: Iterable[str], most: int = 40) -> str:
    """Join names, at most so many of them."""
    names = list(names)
    return ", ".join(names[:most]) + (f" and {len(names) - most} more" if len(names) > most else "")


T = TypeVar("T", bound="LinkMesh")


@dataclass(frozen=True, eq=False)
class LinkMesh:
    """Collision shape of a link; links that do not move, such as fingers, are those of the joint that carries them."""

    name: str  # name of the link in the URDF
    joint: int  # index of the joint that it moves with, −1 for the base
    vertices: Array  # (V, 3) metres, in the frame of that joint; of the base in the base frame
    faces: NDArray[np.intp]  # (F, 3) indices of vertices

    def turned(self: T, base: Array) -> T:
        """The same on a base that is turned by a rotation (3, 3): what is fixed to the base turns along."""
        return self if self.joint >= 0 else replace(self, vertices=constant(self.vertices @ base.T))


@dataclass(frozen=True, eq=False)
class VisualMesh(LinkMesh):
    """What is drawn of a link."""

    colour: tuple[int, int, int] | None = None
    """Red, green and blue up to 255; None is the page's colour of an arm."""


def cells(points: Array, size: float) -> Indices:
    """Number the cells of a grid (N,), in the order of their places, that points (N, 3) are in."""
    cell = np.floor(points / size).astype(np.intp)
    cell -= cell.min(axis=0)
    return np.asarray(np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1)))


def constant(values: ArrayLike, dtype: DTypeLike = float) -> NDArray[Any]:
    """Return a read-only copy."""
    array = np.array(values, dtype=dtype)
    array.flags.writeable = False
    return array
