"""MPNet: a network that plans the arm's next posture (Qureshi et al., Motion Planning Networks, T-RO 2021).

An encoder takes an obstacle's point cloud to a latent vector Z; a planning network with dropout takes (Z, q, q_goal) to
the next posture. It plans from both ends in turn until a straight line between these is free, at most `MAX_STEPS`
steps; then waypoints that straight lines can do without are left out (lazy states contraction), and stretches that
collide are planned again, at most `MAX_ROUNDS` times. Dropout stays active: every attempt is another one.

It is trained on a task's few demonstrations (`dt_viz.baselines.mpnet_training`), as in the comparison of Zhi et al.
(L4DC 2022). These hold no obstacle, so that the encoder, a contractive autoencoder, is trained on a single cloud, the
empty one: contraction is all that its loss asks of it beyond one constant, and Z does not tell where an obstacle is.
MPNet avoids only as far as dropout happens to find a free way. A network trained on thousands of planned paths among
random obstacles, as its authors' is, would do better; that is another comparison.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import Method, NotFittedError, Plan, Planner, Problem
from dt_viz.baselines.postures import PlanningScene, Query, planned
from dt_viz.baselines.weights import FOLDER, load_weights
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import rotation
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import NUM_JOINTS

VERSION = 1
"""Version of the weights, raised with every change to what they mean."""
NUM_POINTS = 100
"""Number of points of a cloud."""
ENCODER = (3 * NUM_POINTS, 64, 28)
"""Widths of the encoder's layers, from the cloud to Z."""
LAYERS = (ENCODER[-1] + 2 * NUM_JOINTS, 256, 256, 128, 64, 32, NUM_JOINTS)
"""Widths of the planning network's layers, from (Z, q, q_goal) to the next posture; the authors' has twelve."""
NUM_CERTAIN = 2
"""Number of its last layers that no dropout comes before."""
DROPOUT = 0.5
"""Probability that a neuron is left out, in training and in planning."""
MAX_STEPS = 80
"""Largest number of postures planned for one stretch, from both ends together."""
MAX_ROUNDS = 3
"""Largest number of times that colliding stretches are planned again."""
SEED = 0
"""Seed of the dropout of each motion."""


@dataclass(frozen=True, eq=False)
class Network:
    """Linear layers with parametric rectifiers between them."""

    weights: tuple[Array, ...]
    """Of each layer, (out, in)."""
    biases: tuple[Array, ...]
    slopes: tuple[float, ...]
    """Slope of the rectifier after each layer but the last, below zero."""

    def __call__(self, x: Array, masks: Sequence[Array] = ()) -> Array:
        """Compute the output (out,) for `x` (in,).

        Args:
            x: the input.
            masks: factors for the outputs of the first layers: 0 where dropout leaves a neuron out, else 1/(1 − p).
        """
        for k, (W, c) in enumerate(zip(self.weights, self.biases, strict=True)):
            x = W @ x + c
            if k < len(self.slopes):
                x = np.where(x > 0, x, self.slopes[k] * x)
            if k < len(masks):
                x = x * masks[k]
        return x


@dataclass(frozen=True, eq=False)
class MPNetModel:
    """Encoder and planning network of one task."""

    encoder: Network
    planning: Network
    centre: Array
    """(6,) rad, the postures' place in the network's unit."""
    scale: Array
    """(6,) rad for one such unit."""

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> MPNetModel:
        """Make the networks that weights describe, as `dt_viz.baselines.mpnet_training.train` returns them.

        Raises:
            NotFittedError: an array is missing, or of another shape.
        """
        shapes: dict[str, tuple[int, ...]] = {"centre": (NUM_JOINTS,), "scale": (NUM_JOINTS,)}
        for name, widths in (("encoder", ENCODER), ("planning", LAYERS)):
            for k, (num_in, num_out) in enumerate(pairwise(widths)):
                shapes |= {f"{name}_W_{k}": (num_out, num_in), f"{name}_c_{k}": (num_out,)}
            shapes[f"{name}_slopes"] = (len(widths) - 2,)
        for name, shape in shapes.items():
            found = arrays[name].shape if name in arrays else "nothing"
            if found != shape:
                raise NotFittedError(f"mpnet: array {name!r}: found {found}; accepted: {shape}")

        def network(name: str, widths: tuple[int, ...]) -> Network:
            layers = range(len(widths) - 1)
            weights, biases = (tuple(arrays[f"{name}_{kind}_{k}"] for k in layers) for kind in "Wc")
            return Network(weights, biases, tuple(map(float, arrays[f"{name}_slopes"])))

        return cls(network("encoder", ENCODER), network("planning", LAYERS), arrays["centre"], arrays["scale"])

    def encoded(self, obstacle: Union) -> Array:
        """Z (28,) of an obstacle."""
        return self.encoder(cloud(obstacle).ravel())

    def next(self, encoded: Array, q: Array, goal: Array, rng: np.random.Generator) -> Array:
        """The next posture (6,), rad, on the way from q (6,) to a goal (6,).

        Args:
            encoded: Z (28,).
            q: posture, rad.
            goal: posture, rad.
            rng: draws the neurons that are left out.
        """
        widths = LAYERS[1:-NUM_CERTAIN]
        masks = [(rng.random(width) >= DROPOUT) / (1 - DROPOUT) for width in widths]
        x = np.concatenate([encoded, (q - self.centre) / self.scale, (goal - self.centre) / self.scale])
        return self.centre + self.scale * self.planning(x, masks)


def cloud(obstacle: Union) -> Array:
    """Points (`NUM_POINTS`, 3), metres, on the obstacle's surface; all at the origin if there is none."""
    if not obstacle.parts:
        return np.zeros((NUM_POINTS, 3))
    parts = [part.surface()[0] @ rotation(part.wxyz).T + np.asarray(part.position) for part in obstacle.parts]
    points = np.concatenate(parts)
    return points[np.linspace(0, len(points) - 1, NUM_POINTS).round().astype(int)]


Replan = Callable[[Array, Array], list[Array]]
"""Plans a stretch between two postures (6,) again: its postures, both ends among them."""


@dataclass(frozen=True, eq=False)
class Search:
    """The search for one motion."""

    model: MPNetModel
    encoded: Array
    """Z (28,) of the obstacle."""
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
        """Plan from both ends in turn until they can be joined; after `MAX_STEPS` they are joined all the same."""
        own, other = [start], [goal]
        for _ in range(MAX_STEPS):
            robot = self.surroundings.robot
            own.append(robot.clip(self.model.next(self.encoded, own[-1], other[-1], self.rng)))
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
            found += [end] if self.free(start, end) else replan(start, end)[1:]
        return found

    def is_free(self, way: list[Array]) -> bool:
        """Decide whether a whole way is free."""
        return all(self.free(*piece) for piece in pairwise(way))

    def way(self, query: Query) -> list[Array]:
        """Plan a motion; it may collide."""
        way = self.contracted(self.bidirectional(query.start, query.goal))
        for _ in range(MAX_ROUNDS):
            if self.is_free(way):
                break
            way = self.contracted(self.replanned(way, self.bidirectional))
        return way


@dataclass(frozen=True, eq=False)
class MPNetPlanner:
    """MPNet for one task; see `Planner`."""

    problem: Problem
    model: MPNetModel

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan around an obstacle as far as that succeeds; see `Planner`."""
        encoded, surroundings = self.model.encoded(obstacle), PlanningScene.of(self.problem.robot, obstacle)
        queries, ways, warnings = [], [], []
        for number, start in enumerate(starts):
            query = Query.of(self.problem, start)
            search = Search(self.model, encoded, surroundings, np.random.default_rng(SEED), cancelled)
            way = self.way(search, query)
            if not search.is_free(way):
                warnings.append(f"the motion from start {number + 1} collides: no free way was found")
            queries.append(query)
            ways.append(np.stack(way))
        return planned(self.problem, queries, ways, tuple(warnings))

    def way(self, search: Search, query: Query) -> list[Array]:
        """Plan one motion; it may collide."""
        return search.way(query)


class MPNet(Method):
    """MPNet with neural replanning."""

    name, title = "mpnet", "MPNet"
    promise = (
        "A path planned once, which ends at the goal, through the obstacle where no free way is found: trained on "
        "demonstrations alone, it has seen no obstacle."
    )
    stable, whole_arm, live = False, True, False

    def __init__(self, folder: Path = FOLDER) -> None:
        """Choose the folder of the weights."""
        self.folder = folder

    def fit(self, problem: Problem) -> Planner:
        """Load the task's weights; see `Method`."""
        return MPNetPlanner(problem, self.model(problem))

    def model(self, problem: Problem) -> MPNetModel:
        """Load the task's networks. Raises NotFittedError as `Method.fit`."""
        return MPNetModel.of(load_weights(MPNet.name, VERSION, problem.task, self.folder))
