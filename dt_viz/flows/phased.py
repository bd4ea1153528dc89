"""Phased systems: motions in the augmented state (y, s), where a phase s runs down to 0 by itself.

A shear along a curve, (y, s) ↦ (y − c(s), s), takes the motion c to the axis of phases. It is the exact flow of
V(y, s) = (−c(s), 0), which depends on s alone: its derivative has determinant 1, and its inverse is exact. So motions
may cross, come back and wind: at another phase the same place is another state. Augmented states are the paper's
outlook (sec. 6).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.interpolate import CubicSpline

from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array
from dt_viz.flows.systems import Attractor

NUM_BISECTIONS = 60
"""Number of halvings with which the phase at a distance is found."""


@dataclass(frozen=True, eq=False)
class PhaseCurve:
    """A smooth curve over the phase, continued straight beyond its ends."""

    spline: CubicSpline
    """From phases between the first and the last knot to points (d,)."""

    @classmethod
    def through(cls, phases: Array, points: Array) -> PhaseCurve:
        """The curve through points (K, d) at increasing phases (K,)."""
        return cls(CubicSpline(phases, points))

    @property
    def dim(self) -> int:
        """Dimension d of the points."""
        return self.spline.c.shape[-1]

    def at(self, phase: Array) -> Array:
        """Points (*B, d) at phases (*B,)."""
        inside = self._inside(phase)
        return self.spline(inside) + (phase - inside)[..., None] * self.spline(inside, 1)

    def slope(self, phase: Array) -> Array:
        """Derivatives (*B, d) with respect to the phase, at phases (*B,)."""
        return self.spline(self._inside(phase), 1)

    def _inside(self, phase: Array) -> Array:
        return np.clip(phase, self.spline.x[0], self.spline.x[-1])


@dataclass(frozen=True, eq=False)
class Shear(Diffeomorphism):
    """(y, s) ↦ (y − c(s), s) in R^(d+1); its Jacobian has determinant 1 everywhere."""

    curve: PhaseCurve
    """c."""
    amount: float = 1.0
    """Part of c that is taken away."""

    @property
    def dim(self) -> int:
        """Dimension d + 1 of the space."""
        return self.curve.dim + 1

    def scaled(self, fraction: float) -> Shear:
        """See `Diffeomorphism`."""
        return replace(self, amount=fraction * self.amount)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        sign = self.amount if inverse else -self.amount
        image = s.copy()
        image[:, :-1] += sign * self.curve.at(s[:, -1])
        if U is None:
            return image, None
        V = U.copy()
        V[:, :-1] += sign * self.curve.slope(s[:, -1])[..., None] * U[:, -1:]
        return image, V


@dataclass(frozen=True, eq=False)
class AtAnyPhase(Diffeomorphism):
    """A diffeomorphism of R^d in R^(d+1): (y, s) ↦ (ψ(y), s), so that it can be stacked on phased motions."""

    transform: Diffeomorphism
    """ψ."""

    @property
    def dim(self) -> int:
        """Dimension d + 1 of the space."""
        return self.transform.dim + 1

    def scaled(self, fraction: float) -> AtAnyPhase:
        """See `Diffeomorphism`."""
        return replace(self, transform=self.transform.scaled(fraction))

    def at_tolerance(self, tolerance: float) -> AtAnyPhase:
        """See `Diffeomorphism`."""
        return replace(self, transform=self.transform.at_tolerance(tolerance))

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        place, phase = s[:, :-1], s[:, -1:]
        if U is None:
            image = self.transform.inverse(place) if inverse else self.transform.forward(place)
            return np.concatenate([image, phase], axis=1), None
        tangents = self.transform.inverse_tangents if inverse else self.transform.forward_tangents
        image, V = tangents(place, U[:, :-1])
        return np.concatenate([image, phase], axis=1), np.concatenate([V, U[:, -1:]], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PhasedAttractor(Attractor):
    """The base system of phased motions: s runs down on a clock of its own, and x − x_e fades with (s/s₀)^p.

    Motions are known in closed form, and ‖(x − x_e, s)‖ falls along all of them. `goal` is (x_e, 0).
    """

    clock: Attractor
    """Attractor (of one dimension, its goal 0) that s is a motion of; it may be a timed one."""
    power: float = 3.0
    """p: with a large one, what leads off the motion fades early."""

    def velocity(self, z: Array) -> Array:
        """Compute ẋ and ṡ, (*B, d + 1), m/s."""
        phase = z[..., -1:]
        rate = self._rate(phase)
        return np.concatenate([self.power * rate * (z - self.goal)[..., :-1], rate * phase], axis=-1)

    def flow(self, z0: Array, times: Array) -> Array:
        """Compute z(t), (*B, T, d + 1), from `z0` (*B, d + 1) at `times` (T,) or (*B, T), seconds, in closed form."""
        return self.at_fraction(z0, self.fraction_at(z0, times))

    def fraction_at(self, z0: Array, times: Array) -> Array:
        """Compute s(t)/s₀, (*B, T), from `z0` (*B, d + 1) at `times` (T,) or (*B, T), seconds."""
        # from phase 0 all fades as it does near phase 0, where s runs down exponentially
        start = np.maximum(z0[..., -1:], np.finfo(float).tiny ** 0.5)
        return self.clock.flow(start, times)[..., 0] / start

    def at_fraction(self, z0: Array, fraction: Array) -> Array:
        """Compute points (*B, T, d + 1) of motions from `z0` (*B, d + 1) where s/s₀ is `fraction` (*B, T)."""
        offset = (z0 - self.goal)[..., None, :]
        faded = np.concatenate(
            [fraction[..., None] ** self.power * offset[..., :-1], fraction[..., None] * offset[..., -1:]], -1
        )
        return self.goal + faded

    def times_at_fraction(self, z0: Array, fraction: Array) -> Array:
        """Compute times (*B, T), seconds, at which s/s₀ is `fraction` (*B, T), on motions from `z0` (*B, d + 1)."""
        return self.clock.times_at(z0[..., -1:], fraction * z0[..., -1:])

    def times_at(self, z0: Array, distances: Array) -> Array:
        """Compute when, (*B, T), s, motions from `z0` (*B, d + 1) come within `distances` (*B, T), m, of the goal."""
        offset = z0 - self.goal
        aside, phase = np.linalg.norm(offset[..., :-1], axis=-1)[..., None], offset[..., -1:]
        low, high = np.zeros(np.broadcast_shapes(distances.shape, phase.shape)), np.ones(1)
        for _ in range(NUM_BISECTIONS):
            middle = (low + high) / 2
            far = np.hypot(middle**self.power * aside, middle * phase) > distances
            low, high = np.where(far, low, middle), np.where(far, middle, high)
        return self.times_at_fraction(z0, low)

    def _rate(self, phase: Array) -> Array:
        """Compute ṡ/s (*B, 1), 1/s, at phases (*B, 1)."""
        safe = np.maximum(np.abs(phase), 1e-9 * self.clock.smoothing)
        return self.clock.velocity(safe) / safe


def lifted(transforms: Sequence[Diffeomorphism]) -> list[Any]:
    """Transforms of R^d as transforms of R^(d+1) that leave the phase as it is."""
    return [AtAnyPhase(transform) for transform in transforms]
