"""URDF files as trees of links and joints, checked."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from xml.etree import ElementTree
from xml.etree.ElementTree import Element
from xml.parsers import expat

import numpy as np
from scipy.spatial.transform import Rotation

from dt_viz.errors import DataError, FormatError, naming
from dt_viz.flows.fields import Array

MAX_BYTES = 20_000_000
"""Size of the largest URDF that is read, bytes."""
TURNING = ("revolute", "continuous")
"""Types of joints that turn about an axis."""
MOVING = (*TURNING, "prismatic", "floating", "planar")
"""Types of joints that move."""
USUAL_VELOCITY = 1.0
"""Velocity limit of joints for which a file gives none, rad/s."""


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
        if self.kind == "continuous":
            lower, upper = -np.inf, np.inf
        elif limit is None or limit.get("lower") is None or limit.get("upper") is None:
            raise FormatError(field, "none", '<limit lower="…" upper="…" velocity="…"/>, or the type continuous')
        else:
            lower, upper = (float(numbers(limit, side, field, (0.0,))[0]) for side in ("lower", "upper"))
        if not lower < upper:
            raise FormatError(field, f"lower {lower:g}, upper {upper:g}", "a lower limit below the upper one")
        velocity = float(numbers(limit, "velocity", field, (0.0,))[0])
        return lower, upper, velocity if velocity > 0 else USUAL_VELOCITY

    def moved(self, value: float) -> tuple[Array, Array]:
        """Compute its rotation (3, 3) and translation (3,), metres, at a value, rad or metres."""
        origin = self.element.find("origin")
        turn = Rotation.from_euler("xyz", numbers(origin, "rpy", f"joint {self.name}: origin"))
        place = numbers(origin, "xyz", f"joint {self.name}: origin")
        if self.kind == "fixed" or not value:
            return turn.as_matrix(), place
        if self.kind in TURNING:
            return (turn * Rotation.from_rotvec(value * self.axis)).as_matrix(), place
        return turn.as_matrix(), place + turn.apply(value * self.axis)


class Description:
    """A URDF as a tree of links and joints, checked.

    Attributes:
        path: the file.
        name: the robot's name, or the file's.
        materials: elements of the materials that links share.
        links: elements of the links, by name.
        joints: by name.
        into: the joint that carries each link but the root.
        root: name of the link that nothing carries.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        robot = _parsed(path)
        self.name = robot.get("name") or path.stem
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
                raise FormatError(
                    f"link {joint.child}", found, "a tree, where each link is carried by one joint: no loops"
                )
            self.into[joint.child] = joint
        roots = [link for link in self.links if link not in self.into]
        if len(roots) != 1:
            found = f"the roots {', '.join(roots[:5])}" if roots else "a loop of links"
            raise FormatError("links", found, "a tree with one link that no joint carries")
        self.root = roots[0]
        if sum(1 for _ in self.below(self.root)) < len(self.links):
            raise FormatError("links", "a loop of links", "a tree, where each link is carried by one joint")

    def to(self, link: str) -> list[Joint]:
        """List the joints from the root to a link."""
        joints: list[Joint] = []
        while link in self.into:
            joints.insert(0, self.into[link])
            link = joints[0].parent
        return joints

    @cached_property
    def _children(self) -> dict[str, list[str]]:
        children: dict[str, list[str]] = {link: [] for link in self.links}
        for joint in self.joints.values():
            children[joint.parent].append(joint.child)
        return children

    def below(self, link: str) -> Iterator[str]:
        """Yield a link and all that it carries."""
        waiting = [link]
        while waiting:
            link = waiting.pop()
            yield link
            waiting += self._children[link]


# --- Reading ---


def _parsed(path: Path) -> Element:
    """Parse a file, without entities."""
    try:
        size = path.stat().st_size
        data = path.read_bytes() if size <= MAX_BYTES else b""
    except OSError as error:
        raise FormatError("file", error.strerror or "an error", "a URDF file that can be read") from error
    if not data:
        raise FormatError("file", f"{size:,} bytes", f"a URDF of up to {MAX_BYTES:,} bytes")

    def refuse(*_: object) -> None:
        raise FormatError("XML", "a document type or entities", "a URDF without them")

    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = refuse
    try:
        parser.Parse(data, True)
        root = ElementTree.fromstring(data)
    except (expat.ExpatError, ElementTree.ParseError, ValueError, LookupError) as error:
        if isinstance(error, FormatError):
            raise
        raise FormatError("XML", f"something else ({error})", "a URDF: XML with the root <robot>") from error
    if root.tag != "robot":
        raise FormatError("XML", f"the root <{root.tag}>", "a URDF: XML with the root <robot>")
    return root


def read_semantic(path: Path) -> Element:
    """Read an SRDF.

    Raises:
        ArmError: It is none.
    """
    with naming(ArmError, path):
        return _parsed(path)


def read_description(path: Path) -> Description:
    """Read a URDF.

    Raises:
        ArmError: It is none.
    """
    with naming(ArmError, path):
        return Description(path)


def _named(robot: Element, tag: str) -> Iterator[tuple[str, Element]]:
    """Yield the elements of a kind with their names, which differ."""
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
