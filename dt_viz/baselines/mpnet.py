"""MPNet: a network that plans the arm's next posture (Qureshi et al., Motion Planning Networks, T-RO 2021).

A planning network with dropout takes (Z, q, q_goal), with Z an encoding of the obstacle's point cloud, to the next
posture. It plans from both ends in turn until a straight line between these is free; then waypoints that straight lines
can do without are left out (lazy states contraction), and stretches that collide are planned again. Dropout stays
active, so that every attempt differs.

It is trained on a task's few demonstrations (`dt_viz.baselines.mpnet_training`), as in the comparison of Zhi et al.
(L4DC 2022). These hold no obstacle: the encoder, a contractive autoencoder, would see a single cloud, the empty one,
and its loss is least where all of its weights are zero. Z is then a constant, part of the bias of the first layer, and
there is no encoder here. MPNet avoids only as far as dropout happens to find a free way. A network trained on thousands
of planned paths among random obstacles, as its authors' is, would do better; that is another comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import NotFittedError, Plan, Planner, Problem
from dt_viz.baselines.postures import PlanningScene, Query, planned
from dt_viz.baselines.weights import FOLDER, load_weights
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.obstacles.union import Union

TRAINED_FOR = "jaco"
"""Name of the arm whose postures the weights are for."""
VERSION = 2
"""Version of the weights, raised with every change to what they mean."""


@dataclass(frozen=True)
class MPNetSettings:
    """Architecture of the planning network, and bounds of the search."""

    hidden: tuple[int, ...] = (112, 96, 64, 32)
    """Widths of the hidden layers; the authors' network has eleven, up to 1280 wide."""
    num_certain: int = 2
    """Number of its last layers that no dropout comes before."""
    dropout: float = 0.5
    """Probability that a neuron is left out, in training and in planning."""
    max_steps: int = 80
    """Largest number of postures planned for one stretch, from both ends together."""
    max_rounds: int = 3
    """Largest number of times that colliding stretches are planned again."""
    seed: int = 0
    """Seed of the dropout of each motion."""

    def widths(self, num_joints: int) -> tuple[int, ...]:
        """Widths of all layers, from (q, q_goal) to the next posture."""
        return 2 * num_joints, *self.hidden, num_joints


ARCHITECTURE = MPNetSettings()


@dataclass(frozen=True, eq=False)
class Network:
    """Linear layers with parametric rectifiers between them, and dropout after the first of these."""

    weights: Sequence[Array]
    """Of each layer, (out, in)."""
    biases: Sequence[Array]
    slopes: Array
    """Slope of the rectifier after each layer but the last, below zero."""
    centre: Array
    """(n,) rad, the postures' place in the network's unit."""
    scale: Array
    """(n,) rad for one such unit."""

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Network:
        """Make the network of arrays as `dt_viz.baselines.mpnet_training.train` returns them."""
        weights, biases = ([arrays[f"{kind}_{k}"] for k in range(len(arrays["slopes"]) + 1)] for kind in "Wc")
        return cls(weights, biases, arrays["slopes"], arrays["centre"], arrays["scale"])

    def masks(self, rng: np.random.Generator, num: int) -> list[Array]:
        """Factors (num, out) for the outputs of the first layers: 0 for neurons that are left out, else 1/(1 − p)."""
        kept = 1 - ARCHITECTURE.dropout
        return [(rng.random((num, len(c))) < kept) / kept for c in self.biases[: -ARCHITECTURE.num_certain]]

    def traced(self, x: Array, masks: Sequence[Array]) -> tuple[list[Array], list[Array]]:
        """Compute each layer's inputs (N, in) and sums (N, out) for `x` (N, in); the last sums are the output."""
        inputs, sums = [], []
        for k, (W, c) in enumerate(zip(self.weights, self.biases, strict=True)):
            inputs.append(x)
            sums.append(x @ W.T + c)
            if k < len(self.slopes):
                x = np.where(sums[k] > 0, sums[k], self.slopes[k] * sums[k])
            if k < len(masks):
                x = x * masks[k]
        return inputs, sums

    def next(self, q: Array, goal: Array, rng: np.random.Generator) -> Array:
        """The next posture (n,), rad, on the way from q (n,) to a goal (n,); `rng` draws the neurons left out."""
        x = np.concatenate([(q - self.centre) / self.scale, (goal - self.centre) / self.scale])
        _, sums = self.traced(x[None], self.masks(rng, 1))
        return self.centre + self.scale * sums[-1][0]


Replan = Callable[["Search", Array, Array], list[Array]]
"""Plans a stretch between two postures (n,) again: its postures, both ends among them."""


@dataclass(frozen=True, eq=False)
class Search:
    """The search for one motion."""

    model: Network
    surroundings: PlanningScene
    rng: np.random.Generator
    cancelled: Cancelled = never
    known: dict[bytes, bool] = field(default_factory=dict)
    """Lines that were decided."""

    def free(self, start: Array, end: Array) -> bool:
        """Decide whether the straight line between two postures is free."""
        end_if(self.cancelled)
        line = start.tobytes() + end.tobytes()
        if line not in self.known:
            self.known[line] = self.surroundings.is_free(start, end)
        return self.known[line]

    def bidirectional(self, start: Array, goal: Array) -> list[Array]:
        """Plan from both ends in turn until they can be joined; after `max_steps` they are joined all the same."""
        own, other = [start], [goal]
        for _ in range(ARCHITECTURE.max_steps):
            robot = self.surroundings.robot
            own.append(robot.clip(self.model.next(own[-1], other[-1], self.rng)))
            joined = self.free(own[-1], other[-1])
            own, other = other, own
            if joined:
                break
        if own[0] is not start:
            own, other = other, own
        return own + other[::-1]

    def contracted(self, way: list[Array]) -> list[Array]:
        """Leave out the postures that free straight lines can do without: go on to the last that one reaches."""
        kept, at = [way[0]], 0
        while at < len(way) - 1:
            ahead = range(len(way) - 1, at + 1, -1)
            at = next((k for k in ahead if self.free(way[at], way[k])), at + 1)
            kept.append(way[at])
        return kept

    def replanned(self, way: list[Array], replan: Replan) -> list[Array]:
        """Plan stretches that collide again, leaving out postures inside something."""
        ends = [way[0], *(q for q in way[1:-1] if self.free(q, q)), way[-1]]
        found = [ends[0]]
        for start, end in pairwise(ends):
            found += [end] if self.free(start, end) else replan(self, start, end)[1:]
        return found

    def is_free(self, way: list[Array]) -> bool:
        """Decide whether a whole way is free."""
        return all(self.free(*piece) for piece in pairwise(way))

    def way(self, query: Query, replan: Replan | None) -> list[Array]:
        """Plan a motion, in the end by `replan` where that is given; it may collide."""
        way = self.contracted(self.bidirectional(query.start, query.goal))
        for again in (*[Search.bidirectional] * ARCHITECTURE.max_rounds, *([replan] if replan else [])):
            if self.is_free(way):
                break
            way = self.contracted(self.replanned(way, again))
        return way


@dataclass(frozen=True, eq=False)
class MPNetPlanner:
    """MPNet for one task; see `Planner`."""

    problem: Problem
    model: Network
    replan: Replan | None

    def __call__(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan around an obstacle as far as that succeeds; see `Planner`."""
        surroundings = PlanningScene(self.problem.robot, obstacle)
        queries, ways, colliding = [], [], 0
        for start in starts:
            query = Query.of(self.problem, start)
            search = Search(self.model, surroundings, np.random.default_rng(ARCHITECTURE.seed), cancelled)
            way = search.way(query, self.replan)
            colliding += not search.is_free(way)
            queries.append(query)
            ways.append(np.stack(way))
        warning = f"motions from {colliding} of {len(starts)} starts collide: no free way was found"
        return planned(self.problem, queries, ways, (warning,) * (colliding > 0))


def fit(problem: Problem, replan: Replan | None = None, folder: Path = FOLDER) -> Planner:
    """Load the task's network, and `replan`, which plans again what the network finds no free way for.

    Raises:
        NotFittedError: there are no weights that can be used, or it is another arm.
    """
    if problem.robot.name != TRAINED_FOR:
        raise NotFittedError(f"trained for the {TRAINED_FOR.upper()} only")
    return MPNetPlanner(problem, Network.of(load_weights("mpnet", VERSION, problem.task, folder)), replan)
