"""Training of MPNet on a task's demonstrations. The only MPNet file with torch."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import torch  # pyright: ignore[reportMissingImports] - an extra

from dt_viz.baselines.base import NotFittedError, Problem
from dt_viz.baselines.mpnet import DROPOUT, ENCODER, LAYERS, NUM_CERTAIN, cloud
from dt_viz.flows.fields import Array
from dt_viz.metrics import resample_by_arc_length
from dt_viz.obstacles.union import Union

NUM_WAYPOINTS = 40
"""Number of postures of a demonstration, evenly along it in joint space: half of `mpnet.MAX_STEPS`."""
BATCH = 64
"""Number of steps in a batch."""
RATE = 1e-3
"""Learning rate of Adam."""
CONTRACTION = 1e-3
"""Weight of the encoder's squared weights in its loss, the authors' λ."""
NUM_ENCODER_STEPS = 2000
"""Number of steps of the encoder's training."""
LEAST_SCALE = 0.05
"""Least unit of a joint, rad, where it hardly moves."""
REPORT_EVERY = 100
"""Number of epochs between two reports."""


def train(problem: Problem, num_epochs: int, report: Callable[[str], None], seed: int = 0) -> dict[str, Array]:
    """Train MPNet on the demonstrations of a task, also backwards, as it plans from both ends.

    Args:
        problem: the task.
        num_epochs: number of passes through all steps.
        report: takes a line of progress.
        seed: of the initial weights, the dropout and the order of the steps.

    Returns:
        Arrays for `dt_viz.baselines.mpnet.MPNetModel.of`.

    Raises:
        NotFittedError: the demonstrations do not move the arm.
    """
    x, y, centre, scale = steps(problem)
    torch.manual_seed(seed)
    encoder = _encoder(report)
    with torch.no_grad():
        encoded = encoder(_empty())
    planning = _network(LAYERS, dropout=True)
    inputs = torch.cat([encoded.expand(len(x), -1), torch.tensor(x, dtype=torch.float32)], dim=1)
    targets = torch.tensor(y, dtype=torch.float32)
    optimiser = torch.optim.Adam(planning.parameters(), lr=RATE)
    for epoch in range(num_epochs):
        total = 0.0
        for rows in torch.randperm(len(x)).split(BATCH):
            loss = torch.nn.functional.mse_loss(planning(inputs[rows]), targets[rows])
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            total += len(rows) * loss.item() / len(x)
        if (epoch + 1) % REPORT_EVERY == 0:
            report(f"epoch {epoch + 1} of {num_epochs}, loss {total:.3g}")
    return {**arrays_of("encoder", encoder), **arrays_of("planning", planning), "centre": centre, "scale": scale}


def steps(problem: Problem) -> tuple[Array, Array, Array, Array]:
    """Steps to learn from.

    Returns:
        Postures and goals (N, 12), next postures (N, 6), both in the network's unit; centre and scale (6,) of the
        unit, rad.

    Raises:
        NotFittedError: the demonstrations do not move the arm.
    """
    if any(np.ptp(path, axis=0).max(initial=0) == 0 for path in problem.postures):
        raise NotFittedError("mpnet learns from the arm's steps, and there is a demonstration that does not move it")
    every = np.concatenate(problem.postures)
    centre = (every.max(axis=0) + every.min(axis=0)) / 2
    scale = np.maximum(np.ptp(every, axis=0) / 2, LEAST_SCALE)
    x, y = [], []
    for path in problem.postures:
        there = (resample_by_arc_length(path, NUM_WAYPOINTS) - centre) / scale
        for way in (there, there[::-1]):
            x.append(np.concatenate([way[:-1], np.broadcast_to(way[-1], way[1:].shape)], axis=1))
            y.append(way[1:])
    return np.concatenate(x), np.concatenate(y), centre, scale


def arrays_of(name: str, network: torch.nn.Sequential) -> dict[str, Array]:
    """The arrays of a network, for `dt_viz.baselines.mpnet.MPNetModel.of`."""
    linear = [layer for layer in network if isinstance(layer, torch.nn.Linear)]
    slopes = [layer.weight.item() for layer in network if isinstance(layer, torch.nn.PReLU)]
    arrays = {f"{name}_slopes": np.array(slopes)}
    for k, layer in enumerate(linear):
        arrays |= {f"{name}_W_{k}": layer.weight.detach().numpy(), f"{name}_c_{k}": layer.bias.detach().numpy()}
    return arrays


def _encoder(report: Callable[[str], None]) -> torch.nn.Sequential:
    """Train the contractive autoencoder on the only cloud that there is: that of no obstacle."""
    encoder, decoder = _network(ENCODER), _network(ENCODER[::-1])
    optimiser = torch.optim.Adam([*encoder.parameters(), *decoder.parameters()], lr=RATE)
    empty, loss = _empty(), torch.zeros(())
    for _ in range(NUM_ENCODER_STEPS):
        squares = sum(layer.weight.square().sum() for layer in encoder if isinstance(layer, torch.nn.Linear))
        loss = torch.nn.functional.mse_loss(decoder(encoder(empty)), empty) + CONTRACTION * squares
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    report(f"encoder of the empty cloud, loss {loss.item():.3g}")
    return encoder


def _empty() -> torch.Tensor:
    return torch.tensor(cloud(Union()).ravel(), dtype=torch.float32)


def _network(widths: tuple[int, ...], *, dropout: bool = False) -> torch.nn.Sequential:
    layers: list[torch.nn.Module] = []
    num = len(widths) - 1
    for k, (num_in, num_out) in enumerate(pairwise(widths)):
        layers.append(torch.nn.Linear(num_in, num_out))
        if k < num - 1:
            layers.append(torch.nn.PReLU())
        if dropout and k < num - NUM_CERTAIN:
            layers.append(torch.nn.Dropout(DROPOUT))
    return torch.nn.Sequential(*layers)
