"""Biasing a motion towards a point: the reverse flow of a field of unit vectors away from it (sec. 4.6).

That flow gathers motions at the point, which they enter and leave in other directions: a corner. So they are shifted
first, all alike in the middle of the region, by the flow of a field that has one direction, and only what then is left
between them is gathered, by the field of unit vectors without its part along the motions: they have a waist there.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from dt_viz.avoidance.avoidance import clearing_duration
from dt_viz.avoidance.transform import MOST_DURATION, Anchored, Built, MotionBelow, axes_of
from dt_viz.errors import check_between
from dt_viz.flows.diffeomorphisms import AUTO, Chain, Diffeomorphism, Flow, Identity, Integration
from dt_viz.flows.fields import Array, GaussianGrid, GridRBF, PlacedField, PointField, Projected, VectorField
from dt_viz.kernels.fields import REGION, SHIFT, TERM, Terms
from dt_viz.obstacles.shapes import Point, as_point
from dt_viz.warning import Kind, MotionWarning

NUM_SAMPLES = 400
"""Number of unit vectors sampled in one octant of the region, or quadrant of the disc; the others mirror them."""
KERNEL_WIDTH = 0.4
"""Kernel width of the regression, in radii; about the size of the core in which it smooths the unit vectors, which are
singular at the target."""


@dataclass(frozen=True)
class RegionField(PointField):
    """A field on the unit ball (or on the cylinder over the unit disc) that fades out smoothly towards its border.

    V(s) = (1 − ‖u‖²)³·V_fit(u), u the first k coordinates of s; the others are not moved.
    """

    directions: GridRBF  # v_fit, in R^k

    def _terms(self) -> Terms:
        return self.directions.grid.terms(self.directions.weights, REGION)


@dataclass(frozen=True, eq=False)
class Shift(PointField):
    """A field of one direction on the unit ball (or on the cylinder over the unit disc): V(s) = (1 − ‖u‖²)³·n."""

    direction: Array  # n, (3,), a unit vector
    dim_of_region: int  # 3 for the ball, 2 for the cylinder

    def _terms(self) -> Terms:
        term = np.zeros(1, TERM)
        term["kind"], term["inward"] = SHIFT, np.diag([1.0, 1.0, self.dim_of_region - 2.0])
        term["outward"][0, :, 0] = self.direction
        return Terms(term, np.empty(0))


def shifting_time(u: float) -> float:
    """Time in which a shift carries a place from the distance u, in radii, to the target: ∫ du / (1 − u²)³."""
    room = 1 - u * u
    return u / (4 * room * room) + 3 * u / (8 * room) + 3 / 8 * math.atanh(u)


@lru_cache(maxsize=2)
def unit_field(dim: int) -> RegionField:
    """The field for the unit region, ridge regression of unit vectors away from the centre of the ball of `dim`.

    With every sample come its mirror images, so the centre is at rest and no sampling noise turns the field.
    """
    rng = np.random.default_rng(0)
    octant = np.abs(rng.normal(size=(NUM_SAMPLES, dim)))
    octant *= rng.uniform(size=(NUM_SAMPLES, 1)) ** (1 / dim) / np.linalg.norm(octant, axis=1, keepdims=True)
    samples = np.concatenate([octant * signs for signs in itertools.product((-1, 1), repeat=dim)])
    away = samples / np.linalg.norm(samples, axis=1, keepdims=True)
    grid = GaussianGrid.covering(np.stack([-np.ones(dim), np.ones(dim)]), KERNEL_WIDTH, pad=0)
    features = grid.features(samples)
    gram = features.T @ features / len(samples)
    gram[np.diag_indices_from(gram)] += 1e-3  # the ridge
    return RegionField(GridRBF(grid, cho_solve(cho_factor(gram), features.T @ away / len(samples))))


AIM = 0.0012
"""Largest distance from the target at which `auto` lets the motions pass, metres, at the checked samples."""
ACCEPTED = 0.002  # largest accepted distance from the target, metres, also between those samples
SAME_PLACE = 0.010
"""Distance up to which the target is at a start, at the goal or in the plane of the motions, metres."""
MAX_DURATION = 4.0
"""Longest flow time that is tried: a point that has not arrived by then hardly lies in the region."""
DEEPEST = 0.9  # distance from the target, in radii, from which on a shift takes too long
SNAPSHOT = 0.1
"""Interval of flow time between two checks of the distance: less than half of the time that halves it."""
LARGE, SMALL = 3.2, 1.5
"""Largest `auto` radius, relative to the distance of the farthest motion, and smallest one that leaves starts and goal
outside. On a straight path at 5 cm, these turn the motion by 10° and 40° on a centimetre."""
SMALLER, WIDER = 1.25, 1.5
"""Smallest radius, relative to that distance, in later attempts, and factor by which it grows in each one where starts
or goal are in the region anyway."""
MIN_RADIUS = 0.10  # lower bound of the `auto` radius, metres
OVERSHOOT = 2.0
"""Factor by which the next attempt prolongs the duration beyond what the last one needed."""
STEP = 2.2
"""Step of the flow, in flow time, for each fourth root of a metre of tolerance. The field is mild everywhere, so RK4
with equal steps is quicker here than steps of each point's own length, and there and back it errs less."""
MAX_TARGET_MISS = 0.013
"""Largest distance by which avoiding motions may miss the target without a warning, metres: a centimetre, and the
error of the arm's joints, interpolated between samples, during a drag."""


@dataclass(frozen=True, repr=False)
class BiasPoint(Anchored):
    """Motions are pulled towards a place.

    With the goal where it is, every motion passes the place on its way. If the goal moves, it does so to the place.
    It is made for the motions that have a demonstration: one that was started elsewhere changes nothing about it.

    Raises:
        FormatError: a number makes no sense, such as a negative radius.
    """

    position: Point
    """The target, metres."""
    radius: float | None = None
    """Radius of the region S around it in which the field acts, metres; None chooses it by the distance of the motion.
    """
    strength: float | None = None
    """t of the two flows, in which a point in the middle of the region moves by about t radii; None is the shortest
    after which every motion passes within two millimetres."""
    plane: tuple[Point, Point] | None = None
    """Two orthonormal vectors: the field acts along these only, and alike at every depth. None is in space."""
    moves_goal: bool = False
    """Whether the goal is pulled along, or stays where it is."""
    integration: Integration = AUTO
    """Integration of the flow."""

    def __post_init__(self) -> None:
        if self.radius is not None:
            check_between("radius", self.radius, 1e-3, 100.0)
        if self.strength is not None:
            check_between("strength", self.strength, 0.0, MOST_DURATION)

    def __repr__(self) -> str:
        radius = "auto" if self.radius is None else f"{self.radius:g} m"
        strength = "auto" if self.strength is None else f"{self.strength:g}"
        goal = ", moves the goal" if self.moves_goal else ""
        place = tuple(np.round(self.position, 4).tolist())
        return f"BiasPoint({place} m, radius {radius}, strength {strength}{goal})"

    def axes(self) -> Array:
        """(3, 3) orthonormal columns, those of the plane first."""
        return axes_of(self.plane)

    def field(self, radius: float) -> PlacedField:
        """The generator whose reverse flow leads to the target, from a regression done once for all targets."""
        unit = unit_field(3 if self.plane is None else 2)
        return PlacedField(unit, np.asarray(self.position), radius * self.axes())

    def offsets(self, s: Array) -> Array:
        """Offsets (*B, 2 or 3) from the target of the points `s` (*B, 3), metres, along the axes it acts on."""
        return (s - np.asarray(self.position)) @ self.axes()[:, : 3 if self.plane is None else 2]

    def build(self, motion: MotionBelow) -> Built:
        """The automatic strength is the smallest that brings every motion to the target."""
        point, motion, at_least = self, motion.demonstrated, motion.at_least
        if motion.above is not None:  # what is above must not lead the motion past the target again
            point = replace(point, position=as_point(motion.above.forward(np.asarray(point.position))))
        nearest, tangents = closest_points(point, motion)
        if point.moves_goal:
            nearest, tangents = motion.goal[None], np.zeros((1, 3))
        distance = float(np.linalg.norm(point.offsets(nearest), axis=1).max())
        ends, others = point._room(motion)
        radius = point.radius or point._auto_radius(motion.earlier, distance, ends, others)
        warnings = self._misplaced(motion, nearest, radius)

        # a shift carries starts and goal in the region along, and motions with them: then the paper's field acts alone
        part = 1.0 if at_least == 0 else min(max((ends / max(distance, AIM) - 1) / (SMALL - 1), 0.0), 1.0)
        along = part * tangents.mean(axis=0) * (at_least == 0)
        passing = point._passing(nearest, tangents, along)
        longest = MAX_DURATION if point.strength is None else point.strength
        shift, shifting = point._shift(passing.mean(axis=0), radius, part)
        shifting = min(shifting, longest)
        flows = [self._flow(shift, shifting, motion.tolerance)] if shifting > 0 else []
        passing = flows[0].inverse(passing) if flows else passing
        spread = float(np.linalg.norm(point.offsets(passing), axis=1).max())
        across = np.eye(3) - np.outer(along, along)
        waist = Projected(point.field(min(radius, max(MIN_RADIUS, LARGE * spread))), across)
        gathering, hopeless = longest - shifting, False
        if point.strength is None:
            least = max(at_least - shifting, 0.0)
            if at_least > 0:  # the motion itself was not where the places beside the target led
                moved = Chain([*flows, self._flow(waist, least, motion.tolerance)]).inverse(motion.positions)
                passing = closest_points(point, replace(motion, positions=moved))[0]
            # the approach to the target is exponential where it ends
            more = clearing_duration(
                waist,
                passing,
                lambda s, _: np.log(np.maximum(np.linalg.norm(point.offsets(s), axis=1), 1e-300) / AIM),
                SNAPSHOT,
                gathering - least,
            )
            hopeless = more is None
            if more is not None:
                # starts and goal in the region move the motion below, the farther the longer: converge sooner
                gathering = min(least + (OVERSHOOT if at_least > 0 else 1.0) * more, gathering)
        if gathering > 0:
            flows.append(self._flow(waist, gathering, motion.tolerance))
        duration = shifting + gathering
        if hopeless:
            warnings.append(_warning(motion, Kind.UNREACHED, _too_small(radius, distance)))
        transform = Chain(flows) if flows else Identity(3)
        goal = transform.inverse(motion.goal) if point.moves_goal else motion.goal
        chosen = {"strength": duration, "radius": radius}
        return Built(transform, duration, goal, hopeless, tuple(warnings), point.integration, chosen)

    def _passing(self, nearest: Array, tangents: Array, along: Array) -> Array:
        """Find where motions pass beside the target, (R, 3) metres: straight on from where they are nearest to it.

        Their directions there are `tangents` (R, 3), whose mean is `along` (3,).
        """
        speed = tangents @ along
        behind = (np.asarray(self.position) - nearest) @ along
        ahead = np.divide(behind, speed, out=np.zeros_like(speed), where=speed > 0.5)
        return nearest + ahead[:, None] * tangents

    def _shift(self, place: Array, radius: float, part: float) -> tuple[VectorField, float]:
        """Make the field whose reverse flow shifts a place (3,) straight to the target, and the time for a part."""
        offset = self.offsets(place)
        distance = float(np.linalg.norm(offset))
        direction = np.pad(offset, (0, 3 - len(offset))) / max(distance, 1e-12)
        field = PlacedField(Shift(direction, len(offset)), np.asarray(self.position), radius * self.axes())
        u = distance / radius
        if u >= DEEPEST:
            return field, MAX_DURATION
        return field, shifting_time(u) - shifting_time((1 - part) * u)

    def _flow(self, field: VectorField, duration: float, tolerance: float) -> Diffeomorphism:
        steps = max(1, math.ceil(duration / (STEP * tolerance**0.25)))
        return self.integration.of(Flow(field, duration, steps))

    def satisfied(self, motion: MotionBelow, top: Array) -> bool:
        """Whether every motion passes close to the target, at the top, where that is to be seen to."""
        if self.strength is not None:
            return True
        return bool((self.distances(replace(motion, positions=top)) <= ACCEPTED).all())

    def shortfall(self, motion: MotionBelow, made: Built, *, satisfied: bool) -> tuple[MotionWarning, ...]:
        if satisfied or made.hopeless:
            return ()
        does = "ends" if self.moves_goal else "passes"
        text = f"a motion {does} {1e3 * self.distances(motion).max():.0f} mm from it"
        if min(self._room(motion)) < made.chosen["radius"]:
            text += ": a start, the goal or another bias point is in its region"
        return (_warning(motion, Kind.UNREACHED, text),)

    def deflected(self, motion: MotionBelow, made: Built, who: str) -> tuple[MotionWarning, ...]:
        """Warnings about motions that pass beside the target to avoid an obstacle; see `Anchored`.

        In a drawing this counts the depth, too: a motion may leave the plane to get around the obstacle.
        """
        if self.strength is not None:
            return ()
        off_plane = any(warning.kind is Kind.OFF_PLANE for warning in made.warnings)
        point = self if off_plane else replace(self, plane=None)
        missed = float(point.distances(motion).max())
        if missed <= MAX_TARGET_MISS:
            return ()
        does = "ends" if self.moves_goal else "passes"
        text = f"{who} gives way to the obstacle and {does} {1e3 * missed:.0f} mm from it"
        return (_warning(motion, Kind.TARGET_MISSED, text),)

    def distances(self, motion: MotionBelow) -> Array:
        """(R,) metres from the target: of the motions that have a demonstration, or of their ends if the goal moves."""
        motion = motion.demonstrated
        if self.moves_goal:
            last = np.r_[np.flatnonzero(np.diff(motion.index)), len(motion.index) - 1]
            return np.linalg.norm(self.offsets(motion.positions[last]), axis=1)
        return np.linalg.norm(self.offsets(closest_points(self, motion)[0]), axis=1)

    def _auto_radius(self, earlier: Built | None, distance: float, ends: float, others: float) -> float:
        """Large for gentle turns, but such that what is to stay where it is stays outside, where that is possible."""
        if earlier is not None:  # ends in the region have moved the motion farther away: it must not grow with that
            grown = WIDER if ends < distance else 1.0
            return max(grown * earlier.chosen["radius"], SMALLER * distance)
        return max(MIN_RADIUS, min(LARGE * distance, max(SMALL * distance, min(ends, others))))

    def _room(self, motion: MotionBelow) -> tuple[float, float]:
        """Distances of the nearest start, or goal that stays, and of the nearest other bias point, metres."""
        ends = motion.starts if self.moves_goal else np.concatenate([motion.starts, motion.goal[None]])
        others = np.asarray(motion.targets).reshape(-1, 3)
        nearest = (np.linalg.norm(self.offsets(places), axis=1).min(initial=np.inf) for places in (ends, others))
        to_ends, to_others = map(float, nearest)
        return to_ends, to_others

    def _misplaced(self, motion: MotionBelow, nearest: Array, radius: float) -> list[MotionWarning]:
        texts = []
        if np.linalg.norm(self.offsets(motion.goal)) < SAME_PLACE:
            texts.append("the point is on the goal, where the motions end anyway")
        if (np.linalg.norm(self.offsets(motion.starts), axis=1) < SAME_PLACE).any():
            texts.append("the point is on a start, where the motion is anyway")
        if any(np.linalg.norm(self.offsets(np.asarray(other))) < 0.9 * radius for other in motion.targets):
            texts.append("the region covers a bias point below it in the stack: motions are pulled away from that")
        warnings = [_warning(motion, Kind.MISPLACED, text) for text in texts]
        depth = float(np.abs((nearest - self.position) @ self.axes()[:, 2]).max()) if self.plane else 0.0
        if depth > SAME_PLACE:
            text = f"the point lies {100 * depth:.0f} cm before or behind the plane: motions are not led to it"
            warnings.append(_warning(motion, Kind.OFF_PLANE, text))
        return warnings


def _warning(motion: MotionBelow, kind: Kind, text: str) -> MotionWarning:
    """A warning that begins with the name of the bias point, as there may be several."""
    return motion.warning(kind, f"{motion.name}: {text}")


def _too_small(radius: float, distance: float) -> str:
    sizes = f"the region of {100 * radius:.0f} cm is too small: a motion is {100 * distance:.0f} cm from the target"
    return sizes if distance >= radius else f"{sizes}, near the border, where the pull fades out"


def closest_points(point: BiasPoint, motion: MotionBelow) -> tuple[Array, Array]:
    """Find where each rollout, as a polyline, comes closest to the target.

    Returns:
        (R, 3) these places, metres, and (R, 3) its directions there, unit vectors along the axes that the bias acts on.
    """
    offset = point.offsets(motion.positions)
    start, step = offset[:-1], np.diff(offset, axis=0)
    squared = (step * step).sum(axis=1)
    same = np.diff(motion.index) == 0
    part = np.clip(-(start * step).sum(axis=1) / np.maximum(squared, 1e-300), 0, 1) * same
    miss = start + part[:, None] * step
    miss = np.where(same, (miss * miss).sum(axis=1), np.inf)
    first = np.flatnonzero(np.r_[True, ~same])
    last = np.r_[first[1:], len(offset)] - 1
    k = np.array([low + np.argmin(miss[low:high]) for low, high in zip(first, last, strict=True)])
    nearest = motion.positions[k] + part[k, None] * (motion.positions[k + 1] - motion.positions[k])
    tangents = step[k] @ point.axes()[:, : step.shape[1]].T / np.sqrt(np.maximum(squared[k], 1e-300))[:, None]
    return nearest, tangents
