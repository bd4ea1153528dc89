"""Training of EFlow: velocities regressed on positions, as its authors' code does it; the file of EFlow with torch.

An epoch is one step on all points, as theirs is with random Fourier features.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - only this needs it
from scipy.signal import savgol_filter

from dt_viz.baselines.base import NotFittedError, Problem
from dt_viz.baselines.eflow import MASKS, SLOPE, num_of
from dt_viz.flows.fields import Array
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.learning.preparation import ImitationError, prepare
from dt_viz.metrics import interpolate


@dataclass(frozen=True)
class TrainingSettings:
    """Size of the networks, the authors', what is learned from, and how quickly."""

    num_features: int = 200
    """Number of random Fourier features of each of a coupling layer's two functions."""
    length_scale: float = 0.45
    """Length scale of the features, in the unit of the normalised demonstrations: their extent along each axis is 1."""
    num_hidden: int = 100
    """Width of the two hidden layers of the speed."""
    rate: float = 1e-4
    """Learning rate of Adam."""
    decay: float = 1e-10
    """Weight decay of Adam."""
    largest_gradient: float = 0.1
    """Norm at which the gradient is clipped."""
    num_points: int = 150
    """Number of points of a demonstration, evenly in time."""
    window: int = 25
    """Number of points that are smoothed over, by cubic polynomials (Savitzky and Golay)."""
    learned: slice = field(default_factory=lambda: slice(6, -2, 2))
    """Points that are learned from: at the first and the last the polynomials of a motion at rest turn back. Every
    second tells as much as all, in half the time."""


SETTINGS = TrainingSettings()
Tensors = dict[str, "torch.Tensor"]


def train(problem: Problem, num_epochs: int, report: Callable[[str], None], seed: int = 0) -> dict[str, Array]:
    """Train EFlow on the demonstrations of a task, for a number of steps on all points each.

    Returns the arrays for `dt_viz.baselines.eflow.EFlowSystem.of` with the least loss; `report` takes lines of
    progress.

    Raises:
        NotFittedError: nothing can be learned from the demonstrations.
    """
    x, v, normalisation, goal = samples(problem.task.demonstrations)
    rng = np.random.default_rng(seed)
    fixed, learned = initial(x.shape[1], rng)
    points, velocities = (torch.tensor(array, dtype=torch.float32) for array in (x, v))
    centre = torch.tensor(goal * normalisation[0] + normalisation[1], dtype=torch.float32)
    optimiser = torch.optim.Adam(learned.values(), lr=SETTINGS.rate, weight_decay=SETTINGS.decay)
    best, least = learned, np.inf
    for epoch in range(num_epochs):
        loss = torch.nn.functional.smooth_l1_loss(velocity(points, centre, fixed, learned), velocities)
        if loss.item() < least:
            best, least = {name: tensor.detach().clone() for name, tensor in learned.items()}, loss.item()
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(learned.values(), SETTINGS.largest_gradient)
        optimiser.step()
        if (epoch + 1) % 25 == 0:
            report(f"epoch {epoch + 1} of {num_epochs}, loss {loss.item():.3g}")
    arrays = {name: tensor.detach().numpy().astype(float) for name, tensor in {**fixed, **best}.items()}
    return {**arrays, "normalisation": normalisation, "goal": goal}


def samples(demonstrations: tuple[Demonstration, ...]) -> tuple[Array, Array, Array, Array]:
    """Points and velocities to learn from.

    Returns:
        Normalised points (N, k) and their velocities (N, k), 1/s; scale and shift (2, k) of the normalisation, which
        maps the demonstrations' box to [−1/2, 1/2]; their common goal (k,), in their own unit.

    Raises:
        NotFittedError: they have no common goal, or do not move.
    """
    try:
        motions = prepare(demonstrations)
    except ImitationError as error:
        raise NotFittedError(str(error)) from error
    points, rates = [], []
    for times, positions in zip(motions.times, motions.positions, strict=True):
        even = np.linspace(times[0], times[-1], SETTINGS.num_points)
        path = np.asarray(savgol_filter(interpolate(even, times, positions), SETTINGS.window, 3, axis=0))
        points.append(path[:-1][SETTINGS.learned])
        rates.append(np.diff(path, axis=0)[SETTINGS.learned] / even[1])
    every = np.concatenate(points)
    lowest, extent = every.min(axis=0), np.ptp(every, axis=0)
    scale = 1 / np.maximum(extent, 1e-6 * extent.max())
    shift = -lowest * scale - 0.5
    return every * scale + shift, np.concatenate(rates) * scale, np.stack([scale, shift]), motions.goal


def initial(dim: int, rng: np.random.Generator) -> tuple[Tensors, Tensors]:
    """Fixed features, and what is learned: coupling layers that are the identity, a random speed."""
    features, num_moved = (len(MASKS), 2, SETTINGS.num_features), (dim + 1) // 2
    tensor = lambda array: torch.tensor(array, dtype=torch.float32)  # noqa: E731
    fixed = {
        "frequencies": tensor(rng.normal(size=(*features, num_moved)) / SETTINGS.length_scale),
        "phases": tensor(rng.uniform(0, 2 * np.pi, size=features)),
    }
    learned = {"weights": torch.zeros(*features, num_moved)}
    for k, (num_in, num_out) in enumerate(pairwise((dim, *2 * (SETTINGS.num_hidden,), 1))):
        bound = num_in**-0.5
        learned[f"speed_{k}"] = tensor(rng.uniform(-bound, bound, size=(num_out, num_in + 1)))
    return fixed, {name: value.requires_grad_() for name, value in learned.items()}


def velocity(x: torch.Tensor, goal: torch.Tensor, fixed: Tensors, learned: Tensors) -> torch.Tensor:
    """σ·J⁻¹·f (N, k) at the normalised points `x` (N, k), as `dt_viz.baselines.eflow.EFlowSystem.velocity`.

    J⁻¹ is applied layer by layer, from the last to the first: that of a coupling layer is triangular.
    """
    dim, z, passed = x.shape[1], torch.cat([x, goal[None]]), []
    for k, (a, b) in enumerate(MASKS):
        num_a, num_b = num_of(a, dim), num_of(b, dim)
        W, w = fixed["frequencies"][k, ..., :num_a], learned["weights"][k, ..., :num_b]
        phase = torch.addmm(fixed["phases"][k].flatten(), z[:, a], W.flatten(0, 1).T)
        cosine, sine = _CosineSine.apply(phase)
        stretch, shift = (cosine @ torch.block_diag(*w)).split(num_b, dim=1)
        slopes = -(w[..., None] * W[:, :, None]).flatten(2)
        derivatives = (sine @ torch.block_diag(*slopes)).unflatten(1, (2, num_b, num_a))
        passed.append((a, b, stretch[:-1], z[:-1, b], derivatives[:-1]))
        z = _put(z, b, z[:, b] * stretch.exp() + shift)
    U = -torch.nn.functional.normalize(z[:-1] - z[-1])
    for a, b, stretch, before, derivatives in reversed(passed):
        Ds, Dt = torch.einsum("nkba,na->knb", derivatives, U[:, a])
        U = _put(U, b, (U[:, b] - Dt) * torch.exp(-stretch) - before * Ds)
    for k in range(3):
        layer = learned[f"speed_{k}"]
        x = x @ layer[:, :-1].T + layer[:, -1]
        x = torch.nn.functional.leaky_relu(x, SLOPE) if k < 2 else x
    return x.exp() * U


class _CosineSine(torch.autograd.Function):
    """Cosine and sine of the same phases, each the other's derivative: neither is computed twice."""

    @staticmethod
    def forward(ctx: Any, phase: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:  # noqa: ANN401 - torch's
        """Compute both."""
        values = torch.cos(phase), torch.sin(phase)
        ctx.save_for_backward(*values)
        return values

    @staticmethod
    def backward(ctx: Any, *slopes: torch.Tensor) -> torch.Tensor:  # noqa: ANN401 - torch's
        """Chain rule."""
        (of_cosine, of_sine), (cosine, sine) = slopes, ctx.saved_tensors
        return of_sine * cosine - of_cosine * sine


def _put(x: torch.Tensor, columns: slice, values: torch.Tensor) -> torch.Tensor:
    """`x` with other columns."""
    x = x.clone()
    x[:, columns] = values
    return x
