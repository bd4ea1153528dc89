"""The feasible velocities of a tick, and the one of them that a robot takes: a quadratic programme (daqp)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import daqp
import numpy as np

from dt_viz.avoidance.arm import WholeArm
from dt_viz.control.obstacle_flow import Sighting
from dt_viz.control.settings import ControllerSettings
from dt_viz.flows.fields import Array, Indices
from dt_viz.kernels.dodging import Forecast, LimitedArm, dodge
from dt_viz.kernels.limits import STEADIEST, barrier, velocity_bounds
from dt_viz.kernels.proximity import contacts, least_contacts, proximity
from dt_viz.obstacles.shapes import records
from dt_viz.robot.robot import Robot

JOINTS_BETWEEN = 3
"""Number of joints between two parts of the arm from which on they can touch: fewer do not fold them that far."""


@dataclass(frozen=True)
class ObstacleLimit:
    """No part of the arm comes nearer to an obstacle than it can stop: a control barrier for each body point.

    With h the distance of what its sphere holds beyond the clearance, ḣ ≥ −γh (Ames et al., "Control Barrier Functions:
    Theory and Applications", 2019), where ḣ counts the obstacle's own velocity: what approaches moves a robot at rest,
    too.
    """

    arm: WholeArm
    clearance: float  # distance that is kept, metres
    gain: float  # γ, 1/s
    reach: float  # distance from which on a body point has a barrier, metres

    def rows(self, q: Array, seen: Sighting, dt: float) -> tuple[Array, Array, float]:
        """Slopes s (K, n) and bounds b (K,) with s·q̇ ≥ b at q (n,), and the distance from the nearest obstacle."""
        if seen.avoidance is None or not seen.avoidance.avoided.parts:
            return np.empty((0, len(q))), np.empty(0), np.inf
        shapes, values = records(seen.avoidance.avoided.parts)
        robot, links = self.arm.robot, self.arm.robot.links
        part, distance, slopes, outward = proximity(robot.records, links.spheres, shapes, values, q, self.reach)
        if not len(distance):
            return slopes, distance, np.inf
        h = distance - min(self.clearance, seen.avoidance.margin / 2)
        near, bounds = barrier(h, slopes, self.gain, dt)
        approach = (outward[near] * seen.velocities[part[near]]).sum(axis=1)
        return slopes[near], approach + bounds, float(distance.min())


@dataclass(frozen=True, eq=False)
class ContactLimit:
    """The arm touches neither the table nor itself: a control barrier for pairs of body points, as of obstacles.

    No pair needs to be farther apart than in the undisturbed motion, which may slide along the table.
    """

    name: str  # what is not touched
    robot: Robot
    pairs: Indices  # (M, 2) as in `dt_viz.kernels.proximity.contacts`
    clearance: float  # distance that is kept, metres
    gain: float  # γ, 1/s

    @classmethod
    def table(cls, robot: Robot, clearance: float, gain: float) -> ContactLimit:
        """Limit of the links above the table z = 0."""
        links = robot.body.indices[robot.body.joint >= robot.num_fixed]
        return cls("the table", robot, np.stack([np.full(len(links), -1), links], axis=1), clearance, gain)

    @classmethod
    def itself(cls, robot: Robot, clearance: float, gain: float) -> ContactLimit:
        """Limit of the links' distances from each other and the base."""
        return cls("itself", robot, robot.pairs(JOINTS_BETWEEN), clearance, gain)

    def kept(self, q: Array) -> Array:
        """Distances (M,) to keep in a motion whose undisturbed postures are q (N, n), metres."""
        spheres, postures = self.robot.body.spheres, np.array(q, order="C")
        return least_contacts(self.robot.records, spheres, self.pairs, postures, self.clearance)

    def rows(self, q: Array, kept: Array, dt: float) -> tuple[Array, Array]:
        """Slopes s (K, n) and bounds b (K,) with s·q̇ ≥ b at q (n,) where distances (M,) are kept."""
        reach = self.clearance + self.robot.top_speed / min(self.gain, STEADIEST / dt)
        which, apart, slopes = contacts(self.robot.records, self.robot.body.spheres, self.pairs, q, reach)
        near, bounds = barrier(apart - kept[which], slopes, self.gain, dt)
        return slopes[near], bounds


SOFT = 8  # daqp's mark of a constraint that may be violated where there is no other way


@dataclass(frozen=True, eq=False)
class Tick:
    """What came of a tick."""

    q: Array  # (n,) where the robot was, rad
    wanted: Array  # (n,) velocity that was asked for, rad/s
    velocity: Array  # (n,) that was found, rad/s
    evasive: Array | None
    """(n,) velocity that evades obstacles which move, rad/s; None where the wanted one leads past them."""
    contacts: list[tuple[Array, Array]]
    """Rows of the table's and the arm's own limits; see `ContactLimit.rows`."""
    clearance: float  # distance of the arm from the nearest obstacle, about, metres


class FeasibleVelocities:
    """Finds the velocity nearest to a wanted one that all limits allow (`dt_viz.control.feasible`)."""

    def __init__(self, arm: WholeArm, settings: ControllerSettings) -> None:
        """Make the limits of an arm."""
        robot = self._robot = arm.robot
        self._settings = settings
        self._barrier = ObstacleLimit(arm, settings.clearance, settings.barrier_gain, settings.barrier_reach)
        self._contacts = tuple(
            make(robot, settings.clearance, settings.contact_gain) for make in (ContactLimit.table, ContactLimit.itself)
        )
        self._kept: tuple[Array, ...] = ()  # distances that are kept, for each of these
        bounds = robot.lower, robot.upper, robot.velocity_limits
        self._limited = LimitedArm(robot.records, robot.links.spheres, *bounds, settings.acceleration)

    def keep(self, q: Array) -> None:
        """Keep the distances from the table, and of the arm's parts, of a motion along postures q (N, n)."""
        self._kept = tuple(limit.kept(q) for limit in self._contacts)

    def tick(self, q: Array, wanted: Array, dt: float, before: Tick | None, seen: Sighting, late: float) -> Tick:
        """Find the velocity for a tick of `dt` seconds after the one before, at q (n,), rad, nearest to a wanted one.

        The obstacles were seen `late` seconds ago. Before the first tick the robot stands still.
        """
        velocity = np.zeros(len(q)) if before is None else before.velocity
        lower, upper = velocity_bounds(self._limited, q, velocity, dt)
        contacts = [limit.rows(q, least, dt) for limit, least in zip(self._contacts, self._kept, strict=True)]
        moved = seen.speed > 0  # replacing takes as long as the rows
        there = replace(seen, avoidance=seen.expected(late, 0.0, self._settings.returning)) if moved else seen
        *barrier, clearance = self._barrier.rows(q, there, dt)
        nearest = _nearest(wanted, lower, upper, [*contacts, barrier])
        previous = None if before is None else before.evasive
        evasive = self._evasive(q, velocity, nearest, previous, seen, late, float(self._kept[0].min()))
        if evasive is not None:
            nearest = _nearest(evasive, lower, upper, contacts)
        return Tick(q, wanted, nearest, evasive, contacts, clearance)

    def _evasive(
        self, q: Array, velocity: Array, wanted: Array, before: Array | None, seen: Sighting, late: float, floor: float
    ) -> Array | None:
        """Find the velocity (n,) that leads past obstacles which move; None where the wanted one does.

        Each of some velocities is foreseen for a short time: the joints turn to it as fast as they may and keep it, the
        obstacles go on as `ObstacleMotion` says. How near they come, in deviations of the obstacles from there, is its
        worth. Choosing anew in each tick, that is model predictive control with one move, by enumeration. A distance
        `floor` from the table, metres, is kept.
        """
        settings = self._settings
        if seen.avoidance is None or seen.speed <= settings.slow:
            return None
        speeds = np.linalg.norm(seen.velocities, axis=1)
        moving = np.flatnonzero(speeds > settings.slow)
        times = np.linspace(0, settings.horizon, settings.num_ahead + 1)[1:]
        moved = np.stack([seen.motions[k].ahead(times + late, settings.returning) for k in moving], axis=1)
        deviation = np.outer(settings.unsure + settings.doubt * times, speeds[moving])
        kept = settings.clearance, floor, settings.floor_depth
        forecast = Forecast(
            *records(tuple(seen.avoidance.avoided.parts[k] for k in moving)), times, moved, deviation, *kept
        )
        before = wanted if before is None else before
        clear, found = dodge(self._limited, forecast, q, velocity, wanted, before, settings.staying)
        return None if clear else found

    def active(self, tick: Tick) -> str:
        """Say which limit kept a robot from the velocity that it wanted, in words; empty if none did."""
        still = self._settings.at_rest
        for limit, (slopes, bounds) in zip(self._contacts, tick.contacts, strict=True):
            if ((slopes @ tick.wanted < bounds - still) & (slopes @ tick.velocity < bounds + still)).any():
                return f"kept from {limit.name}"
        room = np.where(tick.wanted < 0, tick.q - self._robot.lower, self._robot.upper - tick.q)
        at_end = room < self._settings.range_tolerance
        (ended,) = np.nonzero(at_end & (np.abs(tick.wanted) > still + np.abs(tick.velocity)))
        return f"joint {ended[0] + 1} is at its limit" if len(ended) else ""


def _nearest(wanted: Array, lower: Array, upper: Array, rows: Sequence[Sequence[Array]]) -> Array:
    """Find the velocity nearest to a wanted one (n,), min ‖q̇ − q̇*‖².

    Bounds (n,) are hard; rows of slopes s and bounds b, s·q̇ ≥ b, give way where there is no other way.
    """
    nearest = _within(wanted, lower, upper)
    if all((slopes @ nearest >= bounds).all() for slopes, bounds in rows):
        return nearest
    slopes, bounds = (np.concatenate(parts) for parts in zip(*rows, strict=True))
    solution, _, flag, _ = daqp.solve(
        np.eye(len(wanted)),
        -wanted,
        np.ascontiguousarray(slopes),
        np.concatenate([upper, np.full(len(bounds), 1e30)]),
        np.concatenate([lower, bounds]),
        np.repeat(np.array([0, SOFT], np.int32), (len(wanted), len(bounds))),
    )
    return _within(solution if flag > 0 else np.zeros(len(wanted)), lower, upper)


def _within(values: Array, lower: Array, upper: Array) -> Array:
    """Clip values (n,); for so few `np.clip` takes five times as long."""
    return np.minimum(np.maximum(values, lower), upper)
