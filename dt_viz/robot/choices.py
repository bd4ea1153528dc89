"""What an arm's description does not say, chosen automatically: front, home, levers, links that may touch.

Each choice comes with the reason for it. Lengths are metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import SELF_MARGIN, CollisionModel
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import BetweenLinks, Poses
from dt_viz.robot.meshes import LinkMesh
from dt_viz.robot.urdf import listed, numbers

AXES = {"x": (1.0, 0.0), "-x": (-1.0, 0.0), "y": (0.0, 1.0), "-y": (0.0, -1.0)}


@dataclass(frozen=True)
class ArmSearchSettings:
    """Settings of what is found of an arm; lengths are parts of its reach."""

    pitch: float = 0.8
    """Angle of the hand below horizontal at home, rad."""
    ahead: tuple[float, float] = (0.6, 0.05)
    """Place of the hand at home, ahead of and above the second joint."""
    manipulability: float = 0.12
    """Manipulability at home above which more is no better, in reach³."""
    least_manipulability: float = 0.05
    """Manipulability below which a home of the SRDF is not taken, in reach³."""
    least_ahead: float = 0.25
    """Distance of the hand ahead of the base below which a home of the SRDF is not taken."""
    room: float = 0.01
    """Distance of links from each other and the table that is kept at home."""
    num_candidates: int = 20_000
    """Number of random postures that the search for home begins with."""
    num_descending: int = 60
    """Number of those that are improved."""
    num_steps: int = 300
    """Number of random steps of the improvement."""
    num_postures: int = 150
    """Number of random postures in which distances of links are compared."""
    near: float = 0.02
    """Distance below which two links count as near, at least."""
    always: float = 0.9
    """Part of the postures in which links are near that may touch."""
    spread: float = 0.35
    """Standard deviation of the postures near home for which levers are computed, rad."""
    least_lever: float = 0.04
    """Least lever of a joint."""
    one_sided: float = 0.15
    """Mean place of the hand over all postures beyond which the arm has a front."""


class Ranges(NamedTuple):
    """Ranges of angles in which an arm's postures differ."""

    lower: Array  # (n,) rad
    upper: Array

    @classmethod
    def of(cls, lower: Array, upper: Array) -> Ranges:
        """Cut limits off at one turn, the one that is nearest to 0."""
        wide = ~(upper - lower < 2 * np.pi)
        middle = np.clip(0.0, lower + np.pi, upper - np.pi)
        return cls(np.where(wide, middle - np.pi, lower), np.where(wide, middle + np.pi, upper))

    def random(self, rng: np.random.Generator, num: int) -> Array:
        """Draw postures (num, n) that leave a tenth of each range at its ends."""
        return self.lower + (self.upper - self.lower) * (0.1 + 0.8 * rng.random((num, len(self.lower))))


def find_front(
    kinematics: Kinematics,
    ranges: Ranges,
    given: str | Sequence[float] | None,
    home: Array | None,
    settings: ArmSearchSettings,
) -> tuple[Array, str]:
    """Find the horizontal unit vector (2,) ahead of the arm in the base frame of its URDF, and say why.

    What is given is "x", "-x", "y", "-y" or a direction; None finds one, by the given `home` (n,), rad, if there is
    one.

    Raises:
        FormatError: what is given is no horizontal direction.
    """
    if given is not None:
        front = np.array(AXES.get(given, ()) if isinstance(given, str) else given, dtype=float)
        if front.shape not in {(2,), (3,)} or not np.isfinite(front).all() or not np.linalg.norm(front[:2]) > 0:
            raise FormatError("front", repr(given), f"{', '.join(AXES)} or a horizontal direction (x, y)")
        return front[:2] / np.linalg.norm(front[:2]), "given"
    if home is not None:
        hand, why = kinematics.end_effector(home)[:2], "where the hand is at the given home"
    else:
        postures = ranges.random(np.random.default_rng(0), 2000)
        hand, why = (
            kinematics.end_effector(postures)[:, :2].mean(axis=0),
            "where the hand is in the mean of all postures",
        )
    if np.linalg.norm(hand) < settings.one_sided * kinematics.reach:
        return np.array(AXES["x"]), "x, by convention: the arm reaches to all sides"
    front = hand / np.linalg.norm(hand)
    nearest = max(AXES.values(), key=lambda axis: float(front @ axis))
    return (np.array(nearest), f"{why}, about") if front @ nearest > np.cos(np.pi / 6) else (front, why)


def to_front(front: Array) -> Array:
    """Return the rotation (3, 3) about the vertical that turns a horizontal unit vector (2,) to −y."""
    x, y = front
    return np.array([[-y, x, 0.0], [-x, -y, 0.0], [0.0, 0.0, 1.0]]) + 0.0


def count_fixed(kinematics: Kinematics) -> tuple[int, str]:
    """Count the first joints whose links stay where they are: one that turns about the vertical only spins its link."""
    upright = abs(float(kinematics.joint_rotations[0][2, 2])) > np.cos(np.radians(5))
    return int(upright), f"joint 1 is {'' if upright else 'not '}vertical"


def find_touching(
    solids: CollisionModel,
    meshes: Sequence[LinkMesh],
    ranges: Ranges,
    semantic: Element | None,
    protrusion: float,
    settings: ArmSearchSettings,
) -> tuple[frozenset[frozenset[str]], str]:
    """Find pairs of links, besides neighbours, that may touch, by name, and say why.

    Those are pairs that an SRDF does not compare although they could meet, and pairs that are near in nearly all of
    many random postures: a constant gap is no danger. Spheres that stick out of the links by `protrusion`, metres, take
    one for less than `SELF_MARGIN` that is wider by twice this.
    """
    arm, rng = solids.robot, np.random.default_rng(2)
    told = [] if semantic is None else list(semantic.iter("disable_collisions"))
    excepted = {
        frozenset((str(pair.get("link1")), str(pair.get("link2")))) for pair in told if pair.get("reason") != "Never"
    }
    pairs = [
        frozenset((a.name, b.name)) for a, b in combinations(meshes, 2) if b.joint - a.joint > 1
    ]  # as `BetweenLinks` has them
    named = frozenset(pairs) & excepted
    pairs = [pair for pair in pairs if pair not in named]
    measure, near = BetweenLinks(solids.links, named), max(settings.near * arm.reach, SELF_MARGIN + 2 * protrusion)
    left, counts = np.arange(len(pairs)), np.zeros(len(pairs), int)
    for num, q in enumerate(ranges.random(rng, settings.num_postures), start=1):
        if not len(left):
            break
        poses = Poses.of(arm, q[None])
        for item in left[measure.lower(poses, np.zeros(len(left), np.intp), left) < near]:
            counts[item] += measure.distance(poses, 0, int(item), near) < near
        left = left[counts[left] >= settings.always * num - 1]  # the others are apart often enough
    always = {pairs[item] for item in left if counts[item] >= settings.always * settings.num_postures}
    reasons = [f"{len(named)} of the SRDF"] if told else []
    reasons.append(f"{len(always)} nearer than {1e3 * near:.0f} mm in {settings.always:.0%} of random postures")
    return frozenset(named | always), ", ".join(reasons)


class HomeSearch:
    """Search for a ready posture: joints in the middle, hand ahead, elbow up, free of itself and the table.

    Its costs are those of an arm whose front is −y.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        body: BodyPoints,
        solids: CollisionModel,
        ranges: Ranges,
        settings: ArmSearchSettings,
    ) -> None:
        self._arm, self._body, self._solids, self._ranges, self._settings = kinematics, body, solids, ranges, settings
        self._shoulder = kinematics.forward_kinematics(np.zeros(kinematics.num_joints))[1][1]

    def run(self) -> Array:
        """Find the posture (n,), rad."""
        settings, (lower, upper) = self._settings, self._ranges
        rng = np.random.default_rng(1)
        q = self._ranges.random(rng, settings.num_candidates)
        q = q[np.argsort(self.cost(q))[: settings.num_descending]]
        cost, step = self.cost(q), settings.spread
        for _ in range(settings.num_steps):
            trial = np.clip(q + step * rng.normal(size=q.shape) * (rng.random(q.shape) < 0.5), lower, upper)
            found = self.cost(trial)
            better = found < cost
            q[better], cost[better] = trial[better], found[better]
            step = max(0.02, 0.985 * step)
        order = np.argsort(cost)
        return q[next((k for k in order if self.objection(q[k]) is None), order[0])]

    def cost(self, q: Array) -> Array:
        """Compute the costs (N,) of postures (N, n)."""
        settings, (lower, upper), reach = self._settings, self._ranges, self._arm.reach
        chain = self._arm.chain(q.T)
        ahead, above = settings.ahead
        hand = chain.position - (self._shoulder + reach * np.array([0.0, -ahead, above]))[:, None]
        tilt = chain.direction - np.array([0.0, -np.cos(settings.pitch), -np.sin(settings.pitch)])[:, None]
        bounded = upper - lower < 2 * np.pi
        middle = ((((q - (lower + upper) / 2) / (upper - lower)) ** 2) * bounded).sum(axis=1)
        moving = self._body.joint >= self._solids.num_fixed
        heights = (self._body.of_chain(chain)[moving, 2] - self._body.radius[moving, None]).min(axis=0)
        aside = np.abs(chain.origins[:, 0] - self._shoulder[0]).mean(axis=0)
        return (
            20 * (hand**2).sum(axis=0) / reach**2
            + (tilt**2).sum(axis=0)
            + middle
            - 6 * np.minimum(chain.manipulability() / reach**3, settings.manipulability)
            + 30 * np.maximum(0.0, 2 * settings.room - heights / reach)
            - 0.7 * chain.origins[:, 2].max(axis=0) / reach
            + 3 * aside / reach
        )

    def objection(self, q: Array) -> str | None:
        """Say why a posture (n,) is no home, or None."""
        settings, reach = self._settings, self._arm.reach
        chain, room = self._arm.chain(q[:, None]), settings.room * reach
        near = self._solids.nearest_to_itself(q[None])
        if near is not None and near.distance < min(room, 0.01):
            return f"{near.links[0]} and {near.links[1]} are {1e3 * near.distance:.0f} mm apart"
        if self._solids.nearest_to_table(q[None]).distance < 0:
            return "the arm is below the table"
        if -chain.position[1, 0] < settings.least_ahead * reach:
            return "the hand is not ahead of the base"
        if float(chain.manipulability()[0]) < settings.least_manipulability * reach**3:
            return "it is nearly singular"
        return None


def semantic_homes(semantic: Element | None, joint_names: Sequence[str]) -> list[tuple[str, Array]]:
    """List the states of an SRDF that give all of an arm's joints, by name."""
    found = []
    for state in () if semantic is None else semantic.iter("group_state"):
        values = {
            str(joint.get("name")): float(numbers(joint, "value", "SRDF: group_state", (0.0,))[0])
            for joint in state.iterfind("joint")
            if joint.get("name") in joint_names
        }
        if set(joint_names) <= set(values):
            found.append((state.get("name", ""), np.array([values[name] for name in joint_names])))
    return found


def checked_home(given: Array, joint_names: Sequence[str], lower: Array, upper: Array) -> Array:
    """Return a posture (n,), rad, that is given; raises FormatError if it is none within the limits."""
    if given.shape != lower.shape or not np.isfinite(given).all():
        raise FormatError("home", f"{given.shape} numbers", f"{len(lower)} angles, rad, of {listed(joint_names)}")
    outside = [name for name, bad in zip(joint_names, (given < lower) | (given > upper), strict=True) if bad]
    if outside:
        ranges = zip(joint_names, lower, upper, strict=True)
        accepted = ", ".join(f"{name} from {low:.2f} to {high:.2f}" for name, low, high in ranges if name in outside)
        raise FormatError("home", f"{given.round(3).tolist()} rad", accepted)
    return given


def find_home(
    search: HomeSearch,
    joint_names: Sequence[str],
    lower: Array,
    upper: Array,
    given: Array | None,
    semantic: Element | None,
) -> tuple[Array, str]:
    """Find the ready posture (n,), rad: given, a state of the SRDF, or searched for; and say why."""
    if given is not None:
        return given, "given"
    told = []
    for name, posture in semantic_homes(semantic, joint_names):
        objection = (
            "it is outside the limits" if ((posture < lower) | (posture > upper)).any() else search.objection(posture)
        )
        if objection is None:
            return posture, f"state {name!r} of the SRDF"
        told.append(f"not {name!r} of the SRDF: {objection}")
    q = search.run()
    objection = search.objection(q)
    return q, "; ".join(["searched for", *told, *([f"but {objection}"] if objection else [])])


def find_levers(kinematics: Kinematics, home: Array, lower: Array, upper: Array, settings: ArmSearchSettings) -> Array:
    """Compute how far the hand moves for each joint's turning, (n,) m/rad, root mean square over postures near home."""
    near = np.clip(home + settings.spread * np.random.default_rng(0).normal(size=(400, len(home))), lower, upper)
    moved = np.linalg.norm(kinematics.chain(near.T).position_jacobian(), axis=1)
    return np.maximum(np.sqrt((moved**2).mean(axis=1)), settings.least_lever * kinematics.reach)
