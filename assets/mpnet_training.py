"""Training of MPNet on a task's demonstrations, by Adam on batches of their steps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from dt_viz.baselines.base import NotFittedError, Problem
from dt_viz.baselines.mpnet import Network
from dt_viz.flows.fields import Array
from dt_viz.metrics import resample_by_arc_length


@dataclass(frozen=True)
class TrainingSettings:
    """What is learned from, and how quickly."""

    hidden: tuple[int, ...] = (112, 96, 64, 32)
    """Widths of the hidden layers; the authors' network has eleven, up to 1280 wide."""
    num_waypoints: int = 40
    """Number of postures of a demonstration, evenly along it in joint space: half of a search's steps."""
    batch: int = 64
    """Number of steps in a batch."""
    rate: float = 1e-3
    """Learning rate of Adam."""
    least_scale: float = 0.05
    """Least unit of a joint, rad, where it hardly moves."""


SETTINGS = TrainingSettings()


def train(problem: Problem, num_epochs: int, report: Callable[[str], None], seed: int = 0) -> dict[str, Array]:
    """Train MPNet on a task's demonstrations, also backwards, as it plans from both ends; an epoch passes all steps.

    Returns the arrays for `dt_viz.baselines.mpnet.Network.of`; `report` takes lines of progress.

    Raises:
        NotFittedError: the demonstrations do not move the arm.
    """
    x, y, centre, scale = steps(problem)
    rng = np.random.default_rng(seed)
    arrays, unit = initial(problem.robot.num_joints, rng), {"centre": centre, "scale": scale}
    mean, spread = ({name: np.zeros_like(array) for name, array in arrays.items()} for _ in range(2))
    num_steps = 0
    for epoch in range(num_epochs):
        total = 0.0
        for rows in np.split(rng.permutation(len(x)), range(SETTINGS.batch, len(x), SETTINGS.batch)):
            loss, slopes = loss_and_gradient(arrays | unit, x[rows], y[rows], rng)
            total += len(rows) * loss / len(x)
            num_steps += 1
            for name, slope in slopes.items():  # Adam (Kingma and Ba, 2015) with its usual rates of decay
                mean[name] = 0.9 * mean[name] + 0.1 * slope
                spread[name] = 0.999 * spread[name] + 0.001 * slope**2
                size = np.sqrt(spread[name] / (1 - 0.999**num_steps)) + 1e-8
                arrays[name] = arrays[name] - SETTINGS.rate * mean[name] / (1 - 0.9**num_steps) / size
        if (epoch + 1) % 100 == 0:
            report(f"epoch {epoch + 1} of {num_epochs}, loss {total:.3g}")
    return arrays | unit


def steps(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Steps to learn from.

    Returns:
        Postures and goals (N, 2n), next postures (N, n), both in the network's unit; centre and scale (n,) of the
        unit, rad.

    Raises:
        NotFittedError: the demonstrations do not move the arm.
    """
    if any(np.ptp(path, axis=0).max(initial=0) == 0 for path in problem.postures):
        raise NotFittedError("mpnet learns from the arm's steps, and there is a demonstration that does not move it")
    every = np.concatenate(problem.postures)
    centre = (every.max(axis=0) + every.min(axis=0)) / 2
    scale = np.maximum(np.ptp(every, axis=0) / 2, SETTINGS.least_scale)
    x, y = [], []
    for path in problem.postures:
        there = (resample_by_arc_length(path, SETTINGS.num_waypoints) - centre) / scale
        for way in (there, there[::-1]):
            x.append(np.concatenate([way[:-1], np.broadcast_to(way[-1], way[1:].shape)], axis=1))
            y.append(way[1:])
    return np.concatenate(x), np.concatenate(y), centre, scale


def initial(num_joints: int, rng: np.random.Generator) -> dict[str, Array]:
    """Random arrays of a network from (q, q_goal) to the next posture, uniform within 1/√inputs."""
    arrays: dict[str, Array] = {"slopes": np.full(len(SETTINGS.hidden), 0.25)}
    for k, (num_in, num_out) in enumerate(pairwise((2 * num_joints, *SETTINGS.hidden, num_joints))):
        for name, shape in ((f"W_{k}", (num_out, num_in)), (f"c_{k}", (num_out,))):
            arrays[name] = rng.uniform(-(num_in**-0.5), num_in**-0.5, shape)
    return arrays


def loss_and_gradient(
    arrays: dict[str, Array], x: Array, y: Array, rng: np.random.Generator
) -> tuple[float, dict[str, Array]]:
    """Mean squared error of a network's outputs with dropout for `x` (N, in), `y` (N, out), and its gradient."""
    network = Network.of(arrays)
    masks = network.masks(rng, len(x))
    inputs, sums = network.traced(x, masks)
    error = sums[-1] - y
    slopes: dict[str, Array] = {"slopes": np.zeros(len(network.slopes))}
    behind = 2 * error / error.size
    for k in reversed(range(len(sums))):
        if k < len(network.slopes):
            if k < len(masks):
                behind = behind * masks[k]
            below = sums[k] <= 0
            slopes["slopes"][k] = (behind * sums[k])[below].sum()
            behind = np.where(below, network.slopes[k] * behind, behind)
        slopes |= {f"W_{k}": behind.T @ inputs[k], f"c_{k}": behind.sum(axis=0)}
        behind = behind @ network.weights[k]
    return float((error**2).mean()), slopes
