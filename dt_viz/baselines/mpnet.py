"""MPNet: a network that plans the arm's next posture (Qureshi et al., Motion Planning Networks, T-RO 2021).

A planning network with dropout takes (Z, q, q_goal), with Z an encoding of the obstacle's point cloud, to the next
posture. It plans from both ends in turn until a straight line between these is free; then waypoints that straight lines
can do without are left out (lazy states contraction), and stretches that collide are planned again. Dropout stays
active, so that every attempt differs.

It is trained on a task's few demonstrations (`assets.mpnet_training`), as in the comparison of Zhi et al.
(L4DC 2022). These hold no obstacle: the encoder, a contractive autoencoder, would see a single cloud, the empty one,
and its loss is least where all of its weights are zero. Z is then a constant, part of the bias of the first layer, and
there is no encoder here. MPNet avoids only as far as dropout happens to find a free way. A network trained on thousands
of planned paths among random obstacles, as its authors' is, would do better; that is another comparison.

With hybrid replanning (sec. IV) a stretch that collides is planned again by OMPL's RRT-Connect (Kuffner and LaValle,
2000), which is complete in probability: where there is a way, it finds one if it is given the time. It knows nothing of
the demonstrations.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.baselines.base import FOLDER, NotFittedError, Plan, Planner, Problem, load_weights
from dt_viz.baselines.postures import PlanningScene, Query, planned
from dt_viz.errors import Cancelled, end_if, never
from dt_viz.flows.fields import Array
from dt_viz.obstacles.union import Union
from dt_viz.robot.robot import Robot

TRAINED_FOR = "jaco"  # name of the arm whose postures the weights are for
_one_at_a_time = threading.Lock()  # OMPL's random numbers have one seed for the whole process
VERSION = 2  # version of the weights, raised with every change to what they mean
NUM_CERTAIN = 2  # number of the network's last layers that no dropout comes before
DROPOUT = 0.5  # probability that a neuron is left out, in training and in planning
MAX_STEPS = 80  # largest number of postures planned for one stretch, from both ends together
MAX_ROUNDS = 3  # largest number of times that colliding stretches are planned again
SEED = 0  # seed of the dropout of each motion


@dataclass(frozen=True, eq=False)
class Network:
    """Linear layers with parametric rectifiers between them, and dropout after the first of these."""

    weights: Sequence[Array]  # of each layer, (out, in)
    biases: Sequence[Array]
    slopes: Array  # slope of the rectifier after each layer but the last, below zero
    centre: Array  # (n,) rad, the postures' place in the network's unit
    scale: Array  # (n,) rad for one such unit

    @classmethod
    def of(cls, arrays: Mapping[str, Array]) -> Network:
        """Make the network of arrays as `assets.mpnet_training.train` returns them."""
        weights, biases = ([arrays[f"{kind}_{k}"] for k in range(len(arrays["slopes"]) + 1)] for kind in "Wc")
        return cls(weights, biases, arrays["slopes"], arrays["centre"], arrays["scale"])

    def masks(self, rng: np.random.Generator, num: int) -> list[Array]:
        """Factors (num, out) for the outputs of the first layers: 0 for neurons that are left out, else 1/(1 − p)."""
        kept = 1 - DROPOUT
        return [(rng.random((num, len(c))) < kept) / kept for c in self.biases[:-NUM_CERTAIN]]

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
    known: dict[bytes, bool] = field(default_factory=dict)  # lines that were decided

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
        for again in (*[Search.bidirectional] * MAX_ROUNDS, *([replan] if replan else [])):
            if self.is_free(way):
                break
            way = self.contracted(self.replanned(way, again))
        return way


def fit(problem: Problem, replan: Replan | None = None, folder: Path = FOLDER) -> Planner:
    """Load the task's network, and `replan`, which plans again what the network finds no free way for.

    Raises:
        NotFittedError: there are no weights that can be used, or it is another arm.
    """
    if problem.robot.name != TRAINED_FOR:
        raise NotFittedError(f"trained for the {TRAINED_FOR.upper()} only")
    model = Network.of(load_weights("mpnet", VERSION, problem.task, folder))

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        surroundings = PlanningScene(problem.robot, obstacle)
        queries, ways, colliding = [Query.of(problem, start) for start in starts], [], 0
        for query in queries:
            search = Search(model, surroundings, np.random.default_rng(SEED), cancelled)
            way = search.way(query, replan)
            colliding += not search.is_free(way)
            ways.append(np.stack(way))
        warning = f"motions from {colliding} of {len(starts)} starts collide: no free way was found"
        return planned(problem, queries, ways, (warning,) * (colliding > 0))

    return plan


def fit_rrt(problem: Problem, seconds: float = 10.0) -> Planner:
    """Load MPNet's weights; a stretch for which RRT-Connect finds no way in these seconds stays in collision."""

    def replan(search: Search, start: Array, goal: Array) -> list[Array]:
        ends_are_free = search.free(start, start) and search.free(goal, goal)
        found = ends_are_free and rrt_connect(search.free, problem.robot, start, goal, seconds)
        return found or [start, goal]

    return fit(problem, replan)


def rrt_connect(
    free: Callable[[Array, Array], bool], robot: Robot, start: Array, goal: Array, seconds: float
) -> list[Array]:
    """Find a way between two postures (n,), rad, of lines that are `free`, seeded; empty if there is none in time."""
    deadline, raised = time.monotonic() + seconds, []

    def is_over() -> bool:
        return bool(raised) or time.monotonic() > deadline

    def is_free(start: Array, end: Array) -> bool:
        """Ask `free`, whose exceptions are kept: they must not pass through OMPL's loops."""
        try:
            return not is_over() and free(start, end)
        except BaseException as error:
            raised.append(error)
            return False

    with _one_at_a_time:
        found = _planned(is_free, is_over, robot, start, goal)
    if raised:
        raise raised[0]  # not within OMPL's frames, which its traceback would keep
    return found


def _planned(
    is_free: Callable[[Array, Array], bool], is_over: Callable[[], bool], robot: Robot, start: Array, goal: Array
) -> list[Array]:
    from ompl import base, geometric, util  # noqa: PLC0415  # pyright: ignore[reportMissingImports] - an extra

    class Motions(base.MotionValidator):
        """Checks straight lines at every point of them, not at samples."""

        def checkMotion(self, start: object, end: object) -> bool:
            return is_free(posture(start), posture(end))

    def posture(state: Any) -> Array:  # noqa: ANN401 - OMPL's
        return np.array([state[joint] for joint in range(robot.num_joints)])

    util.setLogLevel(util.LOG_NONE)
    util.RNG.setSeed(SEED + 1)  # 0 would be random
    space, bounds = base.RealVectorStateSpace(robot.num_joints), base.RealVectorBounds(robot.num_joints)
    for joint, ends in enumerate(zip(robot.lower, robot.upper, start, goal, strict=True)):
        low, high, *both = map(float, ends)
        bounds.setLow(joint, low if np.isfinite(low) else min(both) - np.pi)
        bounds.setHigh(joint, high if np.isfinite(high) else max(both) + np.pi)
    space.setBounds(bounds)
    setup = geometric.SimpleSetup(space)
    information = setup.getSpaceInformation()
    motions = Motions(information)  # OMPL does not keep it
    setup.setStateValidityChecker(lambda state: is_free(posture(state), posture(state)))
    information.setMotionValidator(motions)
    setup.setPlanner(geometric.RRTConnect(information))
    states: Any = space.allocState(), space.allocState()
    for state, q in zip(states, (start, goal), strict=True):
        for joint, angle in enumerate(q):
            state[joint] = float(angle)  # copyFromReals of ompl 2.0.1 crashes
    setup.setStartAndGoalStates(*states)
    setup.solve(base.PlannerTerminationCondition(is_over))
    if not setup.haveExactSolutionPath():
        return []
    path = setup.getSolutionPath()  # owns its states
    return [start, *(posture(state) for state in path.getStates()[1:-1]), goal]
