"""What an arm's description does not say, chosen automatically: front, home, levers, links that may touch.

Each choice comes with the reason for it. Lengths are metres, angles radians.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple
from xml.etree.ElementTree import Element

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array
from dt_viz.robot.body_points import BodyPoints
from dt_viz.robot.collision import SELF_MARGIN, CollisionModel
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.link_distances import BetweenLinks, Poses
from dt_viz.robot.urdf import listed, numbers

AXES = {"x": (1.0, 0.0), "-x": (-1.0, 0.0), "y": (0.0, 1.0), "-y": (0.0, -1.0)}
# Lengths are parts of the arm's reach where nothing else is stated.
PITCH = 0.8  # angle of the hand below horizontal at home, rad
AHEAD, ABOVE = 0.6, 0.05  # place of the hand at home, from the second joint
MANIPULABILITY = 0.12  # manipulability at home above which more is no better, in reach³
LEAST_MANIPULABILITY = 0.05  # manipulability below which a home of the SRDF is not taken, in reach³
LEAST_AHEAD = 0.25  # distance of the hand ahead of the base below which a home of the SRDF is not taken
ROOM = 0.01  # distance of links from each other and the table that is kept at home
NUM_CANDIDATES = 20_000  # number of random postures that the search for home begins with
NUM_DESCENDING = 60  # number of those that are improved
NUM_STEPS = 300  # number of random steps of the improvement
NUM_POSTURES = 150  # number of random postures in which distances of links are compared
NEAR = 0.02  # distance below which two links count as near, at least
ALWAYS = 0.9  # part of the postures in which links are near that may touch
SPREAD = 0.35  # standard deviation of the postures near home for which levers are computed, rad
LEAST_LEVER = 0.04  # least lever of a joint
ONE_SIDED = 0.15  # mean place of the hand over all postures beyond which the arm has a front


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
    kinematics: Kinematics, ranges: Ranges, given: str | Sequence[float] | None, home: Array | None
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
        hand = kinematics.end_effector(postures)[:, :2].mean(axis=0)
        why = "where the hand is in the mean of all postures"
    if np.linalg.norm(hand) < ONE_SIDED * kinematics.reach:
        return np.array(AXES["x"]), "x, by convention: the arm reaches to all sides"
    front = hand / np.linalg.norm(hand)
    nearest = max(AXES.values(), key=lambda axis: float(front @ axis))
    return (np.array(nearest), f"{why}, about") if front @ nearest > np.cos(np.pi / 6) else (front, why)


def to_front(front: Array) -> Array:
    """Return the rotation (3, 3) about the vertical that turns a horizontal unit vector (2,) to −y."""
    x, y = front
    return np.array([[-y, x, 0.0], [-x, -y, 0.0], [0.0, 0.0, 1.0]]) + 0.0


def find_touching(
    solids: CollisionModel, ranges: Ranges, semantic: Element | None, protrusion: float, num: int = NUM_POSTURES
) -> tuple[frozenset[frozenset[str]], str]:
    """Find pairs of links, besides neighbours, that may touch, by name, and say why.

    Those are pairs that an SRDF does not compare although they could meet, and pairs that are near in nearly all of
    many random postures: a constant gap is no danger. Spheres that stick out of the links by `protrusion`, metres, take
    one for less than `SELF_MARGIN` that is wider by twice this.
    """
    arm, rng = solids.robot, np.random.default_rng(2)
    given = [] if semantic is None else list(semantic.iter("disable_collisions"))
    excepted = {frozenset((pair.get("link1"), pair.get("link2"))) for pair in given if pair.get("reason") != "Never"}
    named = frozenset(BetweenLinks(solids.links, frozenset()).pairs) & excepted
    measure, near = BetweenLinks(solids.links, named), max(NEAR * arm.reach, SELF_MARGIN + 2 * protrusion)
    left, counts = np.arange(len(measure.pairs)), np.zeros(len(measure.pairs), int)
    for k, q in enumerate(ranges.random(rng, num), start=1):
        if not len(left):
            break
        poses = Poses.of(arm, q[None])
        for item in left[measure.lower(poses, np.zeros(len(left), np.intp), left) < near]:
            counts[item] += measure.distance(poses, 0, int(item), near) < near
        left = left[counts[left] >= ALWAYS * k - 1]  # the others are apart often enough
    always = {measure.pairs[item] for item in left if counts[item] >= ALWAYS * num}
    reasons = [f"{len(named)} of the SRDF"] if given else []
    reasons.append(f"{len(always)} nearer than {1e3 * near:.0f} mm in {ALWAYS:.0%} of random postures")
    return frozenset(named | always), ", ".join(reasons)


class HomeSearch:
    """Search for a ready posture: joints in the middle, hand ahead, elbow up, free of itself and the table.

    Its costs are those of an arm whose front is −y.
    """

    def __init__(self, kinematics: Kinematics, body: BodyPoints, solids: CollisionModel, ranges: Ranges) -> None:
        self._arm, self._body, self._solids, self._ranges = kinematics, body, solids, ranges
        self._shoulder = kinematics.forward_kinematics(np.zeros(kinematics.num_joints))[1][1]

    def run(self) -> Array:
        """Find the posture (n,), rad."""
        lower, upper = self._ranges
        rng = np.random.default_rng(1)
        q = self._ranges.random(rng, NUM_CANDIDATES)
        q = q[np.argsort(self.cost(q))[:NUM_DESCENDING]]
        cost, step = self.cost(q), SPREAD
        for _ in range(NUM_STEPS):
            trial = np.clip(q + step * rng.normal(size=q.shape) * (rng.random(q.shape) < 0.5), lower, upper)
            found = self.cost(trial)
            better = found < cost
            q[better], cost[better] = trial[better], found[better]
            step = max(0.02, 0.985 * step)
        order = np.argsort(cost)
        return q[next((k for k in order if self.objection(q[k]) is None), order[0])]

    def cost(self, q: Array) -> Array:
        """Compute the costs (N,) of postures (N, n)."""
        (lower, upper), reach = self._ranges, self._arm.reach
        chain = self._arm.chain(q.T)
        hand = chain.position - (self._shoulder + reach * np.array([0.0, -AHEAD, ABOVE]))[:, None]
        tilt = chain.direction - np.array([0.0, -np.cos(PITCH), -np.sin(PITCH)])[:, None]
        bounded = upper - lower < 2 * np.pi
        middle = ((((q - (lower + upper) / 2) / (upper - lower)) ** 2) * bounded).sum(axis=1)
        moving = self._body.joint >= self._solids.num_fixed
        heights = (self._body.of_chain(chain)[moving, 2] - self._body.radius[moving, None]).min(axis=0)
        aside = np.abs(chain.origins[:, 0] - self._shoulder[0]).mean(axis=0)
        return (
            20 * (hand**2).sum(axis=0) / reach**2
            + (tilt**2).sum(axis=0)
            + middle
            - 6 * np.minimum(chain.manipulability() / reach**3, MANIPULABILITY)
            + 30 * np.maximum(0.0, 2 * ROOM - heights / reach)
            - 0.7 * chain.origins[:, 2].max(axis=0) / reach
            + 3 * aside / reach
        )

    def objection(self, q: Array) -> str | None:
        """Say why a posture (n,) is no home, or None."""
        reach, chain = self._arm.reach, self._arm.chain(q[:, None])
        near = self._solids.nearest_to_itself(q[None])
        if near is not None and near.distance < min(ROOM * reach, 0.01):
            return f"{near.links[0]} and {near.links[1]} are {1e3 * near.distance:.0f} mm apart"
        if self._solids.nearest_to_table(q[None]).distance < 0:
            return "the arm is below the table"
        if -chain.position[1, 0] < LEAST_AHEAD * reach:
            return "the hand is not ahead of the base"
        if float(chain.manipulability()[0]) < LEAST_MANIPULABILITY * reach**3:
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
    search: HomeSearch, joint_names: Sequence[str], lower: Array, upper: Array, semantic: Element | None
) -> tuple[Array, str]:
    """Find the ready posture (n,), rad: a state of the SRDF, or searched for; and say why."""
    refused = []
    for name, posture in semantic_homes(semantic, joint_names):
        outside = ((posture < lower) | (posture > upper)).any()
        objection = "it is outside the limits" if outside else search.objection(posture)
        if objection is None:
            return posture, f"state {name!r} of the SRDF"
        refused.append(f"not {name!r} of the SRDF: {objection}")
    q = search.run()
    objection = search.objection(q)
    return q, "; ".join(["searched for", *refused, *([f"but {objection}"] if objection else [])])


def find_levers(kinematics: Kinematics, home: Array, lower: Array, upper: Array) -> Array:
    """Compute how far the hand moves for each joint's turning, (n,) m/rad, root mean square over postures near home."""
    near = np.clip(home + SPREAD * np.random.default_rng(0).normal(size=(400, len(home))), lower, upper)
    moved = np.linalg.norm(kinematics.chain(near.T).position_jacobian(), axis=1)
    return np.maximum(np.sqrt((moved**2).mean(axis=1)), LEAST_LEVER * kinematics.reach)
