"""EFlow: natural gradient descent seen through affine coupling layers (Rana et al., Euclideanizing Flows, L4DC 2020).

ẏ = −σ(y)·J(y)⁻¹·∇‖ψ(y) − ψ(y_e)‖ with a learned speed σ > 0. In the latent space the motions are straight rays, so a
rollout is one pass of ψ⁻¹ along a ray, and its times are the integral of 1/σ.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.baselines.base import FOLDER, Plan, Planner, Problem, load_weights
from dt_viz.errors import Cancelled, never
from dt_viz.flows.diffeomorphisms import Chain, Diffeomorphism, Placed
from dt_viz.flows.fields import Array, Indices
from dt_viz.flows.rollouts import evenly_sampled, refined
from dt_viz.motion.stack import LIVE
from dt_viz.numerics import unit
from dt_viz.obstacles.union import Union
from dt_viz.scenario.tasks import Task

VERSION = 1  # version of the weights, raised with every change to what they mean
SLOPE = 0.01  # slope below zero of the leaky rectifiers between the layers of the speed
ODD, EVEN = slice(1, None, 2), slice(0, None, 2)
MASKS = ((ODD, EVEN), (EVEN, ODD)) * 5
"""Coordinates that each of the authors' ten coupling layers reads, and those that it moves."""


def num_of(coordinates: slice, dim: int) -> int:
    """Number of these coordinates among `dim`."""
    return len(range(dim)[coordinates])


@dataclass(frozen=True, eq=False)
class Coupling(Diffeomorphism):
    """Affine coupling layer y_b = x_b·exp(s(x_a)) + t(x_a), y_a = x_a; s and t are sums of cosines cos(Wᵀx_a + φ)."""

    SCALED = ("amplitudes", "slopes")  # s and t in proportion: not a group, as that of a flow is
    given: slice  # coordinates a that s and t read
    moved: slice  # all other coordinates, b
    frequencies: Array
    """W over φ (|a| + 1, 2F), of s before those of t; its precision is that of the cosines."""
    amplitudes: Array
    """(2F, 2|b|) of the cosines in s and in t; zero where a feature of the one would meet the other."""
    slopes: Array  # (2F, 2|b|·|a|) of their sines in the derivatives of s and of t

    @classmethod
    def of(cls, given: slice, moved: slice, W: Array, phases: Array, weights: Array) -> Coupling:
        """Make a layer of frequencies W (2, F, |a|) and phases (2, F) of s and t, and their weights (2, F, |b|)."""
        num = W.shape[1]
        amplitudes = np.zeros((2, num, 2, weights.shape[2]), W.dtype)
        amplitudes[0, :, 0], amplitudes[1, :, 1] = weights
        flat, frequencies = amplitudes.reshape(2 * num, -1), W.reshape(2 * num, -1)
        slopes = (-flat[:, :, None] * frequencies[:, None, :]).reshape(2 * num, -1)
        return cls(given, moved, np.vstack([frequencies.T, phases.reshape(-1)]), flat, slopes)

    @property
    def dim(self) -> int:
        return len(self.frequencies) - 1 + self.amplitudes.shape[1] // 2

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        a, b, num = self.given, self.moved, self.amplitudes.shape[1] // 2
        values, slopes = self._functions(s[:, a], with_slopes=U is not None)
        stretch, shift = values[:, :num], values[:, num:]
        factor = np.exp(-stretch if inverse else stretch)
        x = s.copy()
        x[:, b] = (s[:, b] - shift) * factor if inverse else s[:, b] * factor + shift
        if U is None:
            return x, None
        V, derivatives = U.copy(), slopes @ U[:, a]
        Ds, Dt = derivatives[:, :num], derivatives[:, num:]
        if inverse:
            V[:, b] = factor[..., None] * (U[:, b] - Dt) - x[:, b, None] * Ds
        else:
            V[:, b] = factor[..., None] * (U[:, b] + s[:, b, None] * Ds) + Dt
        return x, V

    def _functions(self, x: Array, *, with_slopes: bool) -> tuple[Array, Array]:
        """Compute s and t (N, 2|b|) and, if asked for, their derivatives (N, 2|b|, |a|), at `x` (N, |a|)."""
        extended = np.ones((len(x), len(self.frequencies)), self.frequencies.dtype)
        extended[:, :-1] = x
        values = np.empty((len(x), self.amplitudes.shape[1]))
        slopes = np.empty((len(x) if with_slopes else 0, self.slopes.shape[1]))
        num = 100  # points whose cosines stay in the processor's cache
        for k in range(0, len(x), num):
            phase = extended[k : k + num] @ self.frequencies
            if with_slopes:
                slopes[k : k + num] = np.sin(phase) @ self.slopes
            values[k : k + num] = np.cos(phase, out=phase) @ self.amplitudes
        return values, slopes.reshape(len(slopes), values.shape[1], len(self.frequencies) - 1)


@dataclass(frozen=True, eq=False)
class Normalisation(Diffeomorphism):
    """The affine map y ↦ scale·y + shift, coordinate by coordinate: a change of units, never scaled."""

    scale: Array
    shift: Array

    @property
    def dim(self) -> int:
        return len(self.scale)

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        scale = 1 / self.scale if inverse else self.scale
        image = (s - self.shift) * scale if inverse else s * scale + self.shift
        return image, None if U is None else U * scale[:, None]


@dataclass(frozen=True, eq=False)
class EFlowSystem:
    """A learned EFlow in the world; stable by construction: ‖ψ(y) − ψ(y_e)‖ falls at the rate σ along every motion."""

    transform: Diffeomorphism  # ψ from the world to the latent space, in the world's frame
    speed: Callable[[Array], Array]  # σ (N,), m/s, at points (N, 3), metres
    goal: Array  # y_e (3,), metres
    latent_goal: Array  # ψ(y_e) (3,)

    @classmethod
    def of(cls, task: Task, arrays: Mapping[str, Array], precision: Any = np.float32) -> EFlowSystem:  # noqa: ANN401 - a numpy type
        """Make the system of weights as `assets.eflow_training.train` returns them for a task.

        Cosines in single precision cost less than a micrometre.
        """
        dim = task.demonstrations[0].dimension
        couplings = [
            Coupling.of(a, b, W[..., : num_of(a, dim)], phases, w[..., : num_of(b, dim)])
            for (a, b), W, phases, w in zip(
                MASKS,
                *(arrays[name].astype(precision) for name in ("frequencies", "phases", "weights")),
                strict=True,
            )
        ]
        normalisation = Normalisation(*arrays["normalisation"])
        transform = Placed(Chain([*couplings[::-1], normalisation]), task.origin, task.axes, task.scale)

        def speed(y: Array) -> Array:
            x = normalisation.forward(transform.to_frame(y)[:, :dim])
            for k in range(3):
                layer = arrays[f"speed_{k}"]  # weights and biases (out, in + 1)
                x = x @ layer[:, :-1].T + layer[:, -1]
                x = np.maximum(x, SLOPE * x) if k < 2 else x
            return task.scale * np.exp(x)[:, 0]

        goal = task.to_world(arrays["goal"])
        return cls(transform, speed, goal, transform.forward(goal))

    def velocity(self, y: Array) -> Array:
        """ẏ (N, 3), m/s, at `y` (N, 3), metres."""
        z, J = self.transform.jacobian(y)
        descent = unit(self.latent_goal - z)
        return self.speed(y)[:, None] * np.linalg.solve(J, descent[..., None])[..., 0]

    def rollouts(self, starts: Array, spacing: float) -> tuple[tuple[Array, ...], tuple[Array, ...]]:
        """Motions from starts (R, 3), metres: paths (T, 3), sampled no farther than `spacing` apart, and times (T,), s.

        They are exact but for the times, whose integral is a sum of trapezia.
        """
        rays = self.transform.forward(starts) - self.latent_goal

        def evaluate(index: Indices, fraction: Array) -> Array:
            return self.transform.inverse(self.latent_goal + (1 - fraction)[:, None] * rays[index])[:, None]

        bundle = refined(evenly_sampled(evaluate, len(starts), 50), evaluate, spacing)
        slowness, lengths = bundle.split(1 / self.speed(bundle.positions)), np.linalg.norm(rays, axis=1)
        steps = (
            length * np.diff(fraction) * (slow[1:] + slow[:-1]) / 2
            for length, fraction, slow in zip(lengths, bundle.split(bundle.fraction), slowness, strict=True)
        )
        return bundle.paths, tuple(np.append(0.0, np.cumsum(step)) for step in steps)


def load_system(task: Task, folder: Path = FOLDER) -> EFlowSystem:
    """Load the weights of a task. Raises NotFittedError as `fit`."""
    return EFlowSystem.of(task, load_weights("eflow", VERSION, task, folder))


def fit(problem: Problem, folder: Path = FOLDER) -> Planner:
    """Load the task's weights; motions are the same around all obstacles.

    Raises:
        NotFittedError: there are none that can be used.
    """
    system = load_system(problem.task, folder)

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        return Plan(*system.rollouts(starts, LIVE.spacing))

    return plan
