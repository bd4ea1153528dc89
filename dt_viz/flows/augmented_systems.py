"""Phased systems: motions in the augmented state (y, s, a), where a phase s runs down to 0 by itself.

The state is the place y, the phase s, and a condition a that a motion keeps: where it began, say. A shear along the
curve that is predicted for the condition, ψ(y, s, a) = (y − c(s; a), s, a), takes that motion to the axis of phases.
It is the exact flow of V(y, s, a) = (−c(s; a), 0, 0), which depends on s and a alone: its derivative has determinant 1,
and its inverse is exact. So motions may cross, come back and wind: at another phase, or for another condition, the same
place is another state. Augmented states are the paper's outlook (sec. 6).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor, DiffeomorphicSystem


@dataclass(frozen=True, eq=False)
class PhaseCurve:
    """A smooth curve over the phase, continued straight beyond its ends."""

    spline: CubicSpline  # from phases between the first and the last knot to values (*V,)

    @classmethod
    def through(cls, phases: Array, values: Array) -> PhaseCurve:
        """The curve through values (K, *V) at increasing phases (K,)."""
        return cls(CubicSpline(phases, values))

    def at(self, phase: Array) -> Array:
        """Values (N, *V) at phases (N,)."""
        inside = self._inside(phase)
        beyond = phase - inside
        values = self.spline(inside)
        if beyond.any():
            values += beyond.reshape(-1, *[1] * (values.ndim - 1)) * self.spline(inside, 1)
        return values

    def slope(self, phase: Array) -> Array:
        """Derivatives (N, *V) with respect to the phase, at phases (N,)."""
        return self.spline(self._inside(phase), 1)

    def _inside(self, phase: Array) -> Array:
        return np.clip(phase, self.spline.x[0], self.spline.x[-1])


class Predictions(Protocol):
    """What is known of motions before they begin: the curve that each follows, and the clock of its phase."""

    @property
    def dim(self) -> int:
        """Dimension d of the places."""
        ...

    @property
    def num_conditions(self) -> int:
        """Number c of the numbers that a condition consists of."""
        ...

    def states(self, places: Array, label: float | None = None) -> Array:
        """The states (*B, d + 1 + c) in which motions from places (*B, d) begin."""
        ...

    def demonstrated(self, starts: Array) -> Array:
        """The states (R, d + 1 + c) in which the motions of the demonstrations begin, from their starts (R, d)."""
        ...

    def caught(self, state: Array) -> float:
        """The phase at which a motion goes on that was pushed to a state (d + 1 + c,), metres."""
        ...

    def curve(self, condition: Array) -> PhaseCurve:
        """The curve c(s; a), with values (d,), for a condition a (c,)."""
        ...

    def sensitivity(self, condition: Array) -> PhaseCurve:
        """Its derivative with respect to the condition, with values (d, c)."""
        ...

    def clock(self, condition: Array) -> Attractor:
        """The attractor (of one dimension, its goal 0) that the phase is a motion of."""
        ...


@dataclass(frozen=True, eq=False)
class Shear(Diffeomorphism):
    """(y, s, a) ↦ (y − c(s; a), s, a); its Jacobian has determinant 1 everywhere."""

    SCALED = ("amount",)
    predictions: Predictions  # they give c
    amount: float = 1.0  # part of c that is taken away

    @property
    def dim(self) -> int:
        return self.predictions.dim + 1 + self.predictions.num_conditions

    def at(self, rest: Array) -> Translation:
        """The map of places at one phase and for one condition, `rest` (1 + c,)."""
        return Translation(-self.amount * self.predictions.curve(rest[1:]).at(rest[:1])[0])

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        d, sign = self.predictions.dim, self.amount if inverse else -self.amount
        image, V = s.copy(), None if U is None else U.copy()
        for row, condition in _alike(s[:, d + 1 :]):
            phase = s[row, d]
            curve = self.predictions.curve(condition)
            image[row, :d] += sign * curve.at(phase)
            if U is None or V is None:
                continue
            V[row, :d] += sign * curve.slope(phase)[..., None] * U[row, d : d + 1]
            if U[row, d + 1 :].any():
                V[row, :d] += sign * self.predictions.sensitivity(condition).at(phase) @ U[row, d + 1 :]
        return image, V


@dataclass(frozen=True, eq=False)
class Translation(Diffeomorphism):
    """y ↦ y + shift."""

    SCALED = ("shift",)
    shift: Array  # (d,), metres

    @property
    def dim(self) -> int:
        return len(self.shift)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return (s - self.shift if inverse else s + self.shift), None if U is None else U.copy()


@dataclass(frozen=True, eq=False)
class OnPlaces(Diffeomorphism):
    """A diffeomorphism of places as one of states, (y, s, a) ↦ (ψ(y), s, a), so that it can be stacked on a shear."""

    SCALED = ("transform",)
    transform: Diffeomorphism  # ψ
    num_rest: int  # number of the coordinates that stay

    @property
    def dim(self) -> int:
        return self.transform.dim + self.num_rest

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        d = self.transform.dim
        image, V = self.transform._map(s[:, :d], None if U is None else U[:, :d], inverse=inverse)
        image = np.concatenate([image, s[:, d:]], axis=1)
        return image, None if U is None or V is None else np.concatenate([V, U[:, d:]], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PhasedAttractor(Attractor):
    """The base system of phased motions: s runs down on a clock of its own, and x − x_e fades with (s/s₀)^p.

    Motions are known in closed form, and ‖(x − x_e, s)‖ falls along all of them. `goal` is (x_e, 0), and any condition.
    """

    predictions: Predictions  # they give the clocks
    power: float = 3.0  # p: with a large one, what leads off the motion fades early

    def states(self, places: Array, label: float | None = None, like: Array | None = None) -> Array:
        states, end = self.predictions.states(places, label), 2 * self.predictions.dim + 1
        if like is not None:
            states[..., end:] = like[end:]  # ψ leaves phase and condition as they are
        return states

    def demonstrated(self, starts: Array) -> Array:
        return self.predictions.demonstrated(starts)

    def caught(self, state: Array, below: Array) -> Array:
        d = self.predictions.dim
        phase = self.predictions.caught(np.concatenate([below, state[d:]]))
        return np.concatenate([state[:d], [phase], state[d + 1 :]])

    def distance(self, z: Array) -> Array:
        """Compute ‖(x − x_e, s)‖, (*B,), metres."""
        num = self.predictions.dim + 1
        return np.linalg.norm(z[..., :num] - self.goal[:num], axis=-1)

    def left(self, z: Array) -> Array:
        """The phase (*B,), metres."""
        return z[..., self.predictions.dim]

    def velocity(self, z: Array) -> Array:
        """Compute ẋ, ṡ and ȧ = 0, (*B, d + 1 + c), m/s."""
        d, rate = self.predictions.dim, self._rate(z)[..., None]
        moved = np.zeros_like(z)
        moved[..., :d] = self.power * rate * (z - self.goal)[..., :d]
        moved[..., d : d + 1] = rate * z[..., d : d + 1]
        return moved

    def flow(self, z0: Array, times: Array) -> Array:
        # from phase 0 all fades as it does near phase 0, where s runs down exponentially
        start = np.maximum(self.left(z0), np.finfo(float).tiny ** 0.5)[..., None]
        when = np.broadcast_to(times, (*z0.shape[:-1], np.shape(times)[-1]))
        left = self._by_clock(z0, lambda clock, s, t: clock.flow(s, t)[..., 0], start, when)
        return self.at_fraction(z0, left / start)

    def at_fraction(self, z0: Array, fraction: Array) -> Array:
        d = self.predictions.dim
        z = np.broadcast_to(
            z0[..., None, :],
            (*np.broadcast_shapes(z0.shape[:-1], fraction.shape[:-1]), fraction.shape[-1], z0.shape[-1]),
        ).copy()
        faded = fraction[..., None] ** self.power
        z[..., :d] = self.goal[:d] + faded * (z[..., :d] - self.goal[:d])
        z[..., d] *= fraction
        return z

    def times_at(self, z0: Array, distances: Array) -> Array:
        return self._by_clock(
            z0, lambda clock, s, phases: clock.times_at(s, phases), self.left(z0)[..., None], distances
        )

    def frozen(self, rest: Array, slope: Array) -> Frozen:
        """The base system of places at one phase, metres, and for one condition, `rest` (1 + c,).

        The curve that the places are relative to has the derivative `slope` (d,) there.
        """
        d = self.predictions.dim
        state = np.concatenate([self.goal[:d], rest])
        rate = float(self._rate(state))
        gain = -self.power * rate
        return Frozen(
            goal=self.goal[:d] + slope * rate * rest[0] / gain,
            speed=self.speed,
            smoothing=self.smoothing,
            gain=gain,
            moving=self,
            rest=rest,
        )

    def _rate(self, z: Array) -> Array:
        """Compute ṡ/s (*B,), 1/s, at states (*B, d + 1 + c)."""
        safe = np.maximum(np.abs(self.left(z)), 1e-9 * self.smoothing)[..., None]
        return self._by_clock(z, lambda clock, s, _: clock.velocity(s), safe, safe)[..., 0] / safe[..., 0]

    def _by_clock(
        self, z: Array, compute: Callable[[Attractor, Array, Array], Array], phases: Array, of: Array
    ) -> Array:
        """Compute something of phases (*B, 1), and of an array (*B, T), by the clock of each state (*B, d + 1 + c)."""
        flat, starts = z.reshape(-1, z.shape[-1]), phases.reshape(-1, 1)
        rows = np.broadcast_to(of, (*z.shape[:-1], np.shape(of)[-1])).reshape(len(flat), -1)
        result = np.empty_like(rows, dtype=float)
        for row, condition in _alike(flat[:, self.predictions.dim + 1 :]):
            result[row] = compute(self.predictions.clock(condition), starts[row], rows[row])
        return result.reshape(*z.shape[:-1], -1)


@dataclass(frozen=True, kw_only=True, eq=False)
class Frozen(Attractor):
    """The base system of places while phase and condition are held: ẋ = −gain·(x − goal), the phase's motion included.

    Its streamlines, straight rays again, show where a motion at this phase is heading, not where it ends.
    """

    gain: float  # 1/s
    moving: PhasedAttractor  # the whole system, whose potential is meant
    rest: Array  # (1 + c,) phase, metres, and condition

    def potential(self, z: Array) -> Array:
        """Φ of the whole system at this phase, (*B,)."""
        return self.moving.potential(
            np.concatenate([z, np.broadcast_to(self.rest, (*z.shape[:-1], len(self.rest)))], -1)
        )

    def potential_at(self, distance: Array | float) -> Array:
        """At distances (*B,) from where the whole system's motions end, at this phase."""
        return self.moving.potential_at(np.hypot(distance, self.rest[0]))

    def velocity(self, z: Array) -> Array:
        return -self.gain * (z - self.goal)


def on_places(transforms: Sequence[Diffeomorphism], num_rest: int) -> list[Diffeomorphism]:
    """Transforms of places as transforms of states with so many coordinates besides the place; see `OnPlaces`."""
    if not num_rest:
        return list(transforms)
    parts = Chain(transforms).parts if transforms else ()
    return [OnPlaces(part, num_rest) for part in parts]


def frozen(system: DiffeomorphicSystem, rest: Array) -> DiffeomorphicSystem:
    """The system of places (d,) at one phase and for one condition, `rest` (1 + c,): what a motion does at that moment.

    It is ẏ of the whole system as a function of the place alone. A system without a phase is returned as it is.
    """
    base = system.base
    if not isinstance(base, PhasedAttractor):
        return system
    parts: list[Diffeomorphism] = []
    slope = np.zeros(base.predictions.dim)
    for part in Chain([system.transform]).parts:
        if isinstance(part, Shear):
            parts.append(part.at(rest))
            slope += part.amount * base.predictions.curve(rest[1:]).slope(rest[:1])[0]
        else:
            assert isinstance(part, OnPlaces)
            parts.append(part.transform)
    return DiffeomorphicSystem(Chain(parts), base.frozen(rest, slope))


def _alike(conditions: Array) -> Iterator[tuple[slice, Array]]:
    """Runs of neighbouring rows with the same condition (c,) among (N, c), each with that condition."""
    if not len(conditions):
        return
    ends = np.flatnonzero((conditions[1:] != conditions[:-1]).any(axis=1)) + 1
    for begin, end in zip([0, *ends], [*ends, len(conditions)], strict=True):
        yield slice(begin, end), conditions[begin]
