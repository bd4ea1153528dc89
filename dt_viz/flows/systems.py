"""Dynamical systems: the base attractor and the same attractor seen through a diffeomorphism (sec. 3, eq. (1))."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.flows.diffeomorphisms import Diffeomorphism
from dt_viz.flows.fields import Array
from dt_viz.numerics import ZERO, divisor


@dataclass(frozen=True)
class Attractor:
    """The base system ż = −∇Φ(z) = −v·tanh(r/ρ)·r̂ with r = ‖z − z_e‖ and Φ = v·ρ·log cosh(r/ρ).

    Smooth everywhere, and for ρ → 0 the paper's ‖z − z_e‖. It has the closed form
    sinh(r(t)/ρ) = sinh(r₀/ρ)·exp(−v·t/ρ) on the straight ray from z(0) to the goal.
    """

    goal: Array  # z_e, (d,), metres
    speed: float = 0.1  # v far from the goal, m/s
    smoothing: float = 0.01  # ρ, metres: inside this distance the motion slows down to a stop

    @property
    def dim(self) -> int:
        """Dimension d of the space."""
        return len(self.goal)

    def states(self, places: Array, label: float | None = None, like: Array | None = None) -> Array:
        """The states (*B, d) in which motions from places (*B, d), metres, begin: the places themselves.

        A system that tells motions apart takes their label, or that of a motion in base space, `like` (d,).

        Raises:
            FormatError: no demonstration has such a label.
        """
        if label is not None:
            raise FormatError("label", f"{label!r}", "none, in the plain state")
        del like
        return places

    def demonstrated(self, starts: Array) -> Array:
        """The states (R, d) in which the motions of the demonstrations begin, from their starts (R, d)."""
        return starts

    def caught(self, state: Array, below: Array) -> Array:
        """The state (d,) from which a motion goes on that was pushed to a `state` (d,): that one.

        A system with a phase chooses it again by the place `below` (3,) to which the stack on it takes the place.
        """
        del below
        return state

    def distance(self, z: Array) -> Array:
        """Distance from the goal, (*B,), metres, which falls along every motion."""
        return np.linalg.norm(z - self.goal, axis=-1)

    def potential(self, z: Array) -> Array:
        """Φ(z), (*B,): zero at the goal, growing away from it, falling along every motion."""
        return self.potential_at(self.distance(z))

    def potential_at(self, distance: Array | float) -> Array:
        """Φ at distances (*B,) from the goal, metres."""
        ratio = distance / self.smoothing
        log_cosh = ratio + np.log1p(np.exp(-2 * ratio)) - np.log(2)
        return self.speed * self.smoothing * log_cosh

    def velocity(self, z: Array) -> Array:
        """ż, (*B, d), m/s."""
        offset = z - self.goal
        r = np.linalg.norm(offset, axis=-1, keepdims=True)
        # tanh(r/ρ)/r tends to 1/ρ at the goal
        gain = np.where(r > ZERO, np.tanh(r / self.smoothing) / divisor(r), 1 / self.smoothing)
        return -self.speed * gain * offset

    def flow(self, z0: Array, times: Array) -> Array:
        """z(t), (*B, T, d), from `z0` (*B, d) at `times` (T,) or (*B, T) in seconds, in closed form."""
        r0 = np.linalg.norm(z0 - self.goal, axis=-1, keepdims=True)
        clock = log_sinh(r0 / self.smoothing) - self.speed * times / self.smoothing  # (*B, T)
        r = self.smoothing * asinh_exp(clock)
        return self.at_fraction(z0, np.divide(r, r0, out=np.zeros_like(r), where=r0 > 0))

    def at_fraction(self, z0: Array, fraction: Array) -> Array:
        """Points (*B, T, d) of motions from `z0` (*B, d) where a `fraction` (*B, T) of their way is left."""
        return self.goal + fraction[..., None] * (z0 - self.goal)[..., None, :]

    def left(self, z: Array) -> Array:
        """What is left of the way of motions from `z` (*B, d), (*B,), metres: falls in proportion to the fraction."""
        return self.distance(z)

    def times_at(self, z0: Array, distances: Array) -> Array:
        """Times (*B, T), seconds, at which `distances` (*B, T), metres, are `left` to motions from `z0` (*B, d).

        Zero where no more is left at the start.
        """
        r0 = np.linalg.norm(z0 - self.goal, axis=-1, keepdims=True)
        farther = np.maximum(r0, distances)
        return self.smoothing / self.speed * (log_sinh(farther / self.smoothing) - log_sinh(distances / self.smoothing))

    def arrival_time(self, z0: Array, distance: float) -> Array:
        """Times (*B,), seconds, until the motion from `z0` (*B, d) is within `distance` (metres) of the goal."""
        return self.times_at(z0, np.full((*z0.shape[:-1], 1), distance))[..., 0]


@dataclass(frozen=True)
class DiffeomorphicSystem:
    """The natural gradient system ẏ = J(y)⁻¹·f(ψ(y)), f the base attractor (eq. (1) in exact form).

    ψ is a conjugacy: z = ψ(y) obeys ż = f(z) exactly, so it is as stable as its base, whose motions are mapped to its.
    """

    transform: Diffeomorphism  # ψ, from the space of the motion to the space of the base attractor
    base: Attractor

    def velocity(self, y: Array) -> Array:
        """ẏ, (*B, d), m/s, from one pass through ψ that carries its Jacobian along."""
        z, J = self.transform.jacobian(y)
        return np.linalg.solve(J, self.base.velocity(z)[..., None])[..., 0]

    def lyapunov(self, y: Array) -> Array:
        """Φ(ψ(y)), (*B,): strictly falling along every motion until the goal."""
        return self.base.potential(self.transform.forward(y))

    def rollout(self, y0: Array, times: Array) -> Array:
        """y(t) = ψ⁻¹(z(t)), (*B, T, d), from `y0` (*B, d) at `times` (T,) or (*B, T): exact, all at once."""
        return self.transform.inverse(self.base.flow(self.transform.forward(y0), times))


def log_sinh(a: Array) -> Array:
    """Logarithm of sinh(a), for a ≥ 0 without overflow; −inf at 0."""
    with np.errstate(divide="ignore"):
        return a + np.log(-np.expm1(-2 * a)) - np.log(2)


def asinh_exp(b: Array) -> Array:
    """asinh(exp(b)) without overflow."""
    large = np.maximum(b, 0)
    return np.where(b > 0, large + np.log1p(np.sqrt(1 + np.exp(-2 * large))), np.arcsinh(np.exp(np.minimum(b, 0))))
