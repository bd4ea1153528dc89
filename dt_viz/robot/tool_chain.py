"""The chain of joints from an arm's base to its tool, found in a URDF."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from xml.etree.ElementTree import Element

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.kernels.blocks import MOST_JOINTS
from dt_viz.robot.robot import LEAST_JOINTS
from dt_viz.robot.urdf import TURNING, Description, Joint, listed, numbers

GRIPPER = ("finger", "gripper", "jaw", "knuckle", "thumb")
"""Words in the names of joints and links at the end of a chain that are a gripper's."""
TOOL_WORDS = ("tcp", "tool0", "ee_link", "end_effector", "link_eef", "gripper_frame", "grasp", "tool", "flange", "hand")
"""Words in the names of tool frames, the best first."""


@dataclass(frozen=True, eq=False)
class ArmChain:
    """The joints that an arm moves, and its tool."""

    joints: tuple[Joint, ...]
    tool: str  # link that is the tool frame
    locked: Mapping[str, float]  # values of the joints that do not move, rad or metres
    why: str  # reason for the tool
    offset: Array  # (3,) place of the tool in that link, metres


def find_chain(
    description: Description,
    end_effector: str | tuple[str, Sequence[float]] | None = None,
    locked: Sequence[str] | Mapping[str, float] | None = None,
    semantic: Element | None = None,
) -> ArmChain:
    """Find the joints from the base to the tool; all others are locked.

    Args:
        description: of the robot.
        end_effector: link that is the tool frame, or the joint that carries it, perhaps with the place (x, y, z) of the
            tool in it, metres. By default that of the SRDF, else one with a usual name, else the farthest one.
        locked: joints of the chain that do not move, perhaps each with its value, rad or metres. By default grippers.
        semantic: root of an SRDF.

    Raises:
        FormatError: There is no such frame, or a joint of the chain does not turn.
    """
    given = locked if isinstance(locked, Mapping) else {name: _resting(description, name) for name in locked or ()}
    frame, offset = (end_effector, (0.0, 0.0, 0.0)) if isinstance(end_effector, str | None) else end_effector
    place = np.array(offset, dtype=float)
    if place.shape != (3,) or not np.isfinite(place).all():
        raise FormatError("end effector", f"the place {offset!r}", "a link, or (link, (x, y, z)) in metres")
    tool, why = _tool(description, frame, given, semantic)
    path = _moving(description, tool, given)
    for joint in path:
        if joint.kind not in TURNING or joint.element.find("mimic") is not None:
            found = "a mimic joint" if joint.kind in TURNING else f"a {joint.kind} joint"
            accepted = f"revolute and continuous joints from {description.root} to {tool}, the tool"
            raise FormatError(f"joint {joint.name}", found, f"{accepted}; or lock it: locked=[{joint.name!r}]")
    if not LEAST_JOINTS <= len(path) <= MOST_JOINTS:
        accepted = f"{LEAST_JOINTS} to {MOST_JOINTS}; choose another end_effector=, or lock some: locked=[…]"
        raise FormatError(f"chain from {description.root} to {tool}", f"{len(path)} joints that move", accepted)
    names = {joint.name for joint in path}
    still = [name for name, joint in description.joints.items() if joint.moves and name not in names]
    values = {name: given.get(name, _resting(description, name)) for name in still}
    return ArmChain(tuple(path), tool, values, why, place)


def _tool(
    description: Description, end_effector: str | None, locked: Mapping[str, float], semantic: Element | None
) -> tuple[str, str]:
    links = description.links
    if end_effector is not None:
        joint = description.joints.get(end_effector)
        link = joint.child if joint and end_effector not in links else end_effector
        if link not in links:
            raise FormatError("end effector", f"no link {end_effector!r}", listed(links))
        return link, "given"
    for element in () if semantic is None else semantic.iter("end_effector"):
        link = element.get("parent_link", "")
        if link in links:
            return link, "end effector of the SRDF"
    chains = {link: _moving(description, link, locked) for link in links}
    most = max(map(len, chains.values()))
    last = {link: _distance(description, link, chain) for link, chain in chains.items() if len(chain) == most}
    ranks = {link: next((k for k, word in enumerate(TOOL_WORDS) if word in link.lower()), None) for link in last}
    named = [link for link, rank in ranks.items() if rank is not None]
    if named:
        return min(named, key=lambda link: (ranks[link], -last[link])), "its name, among what the last joint moves"
    return max(last, key=lambda link: last[link]), "farthest frame that the last joint moves"


def _moving(description: Description, link: str, locked: Mapping[str, float]) -> list[Joint]:
    """List the joints that move a link, without those of a gripper at the end."""
    path = [joint for joint in description.to(link) if joint.moves and joint.name not in locked]
    while path and _is_gripper(path[-1]):
        path.pop()
    return path


def _distance(description: Description, link: str, chain: list[Joint]) -> float:
    """Compute the distance of a link from the last joint of a chain, metres."""
    place, path = np.zeros(3), description.to(link)
    for joint in reversed(path[path.index(chain[-1]) + 1 :] if chain else path):
        turn, shift = joint.origin
        place = shift + turn @ place
    return float(np.linalg.norm(place))


def _is_gripper(joint: Joint) -> bool:
    return any(word in joint.name.lower() for word in GRIPPER)


def _resting(description: Description, name: str) -> float:
    """Choose the value of a locked joint: half open for a gripper, else 0 or what is nearest to it."""
    joint = description.joints.get(name)
    if joint is None:
        moving = [name for name, joint in description.joints.items() if joint.moves]
        raise FormatError("locked", f"no joint {name!r}", listed(moving))
    limit = joint.element.find("limit")
    if joint.kind not in ("revolute", "prismatic") or limit is None:
        return 0.0
    lower, upper = (float(numbers(limit, side, f"joint {name}: limit", (0.0,))[0]) for side in ("lower", "upper"))
    return (lower + upper) / 2 if _is_gripper(joint) else min(max(0.0, lower), upper)
