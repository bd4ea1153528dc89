"""How a motion fares along its path (fig. 6): Lyapunov value, distance to its demonstration, clearance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.metrics import (
    arc_length,
    discrete_frechet,
    distance_from_path,
    maximum_collision_distance,
    resample_by_arc_length,
)
from dt_viz.motion.certificates import DrawnSamples
from dt_viz.motion.following import Follower
from dt_viz.motion.solve import Solved

NUM_SAMPLES = 120  # number of samples at even distances along a path, start and goal included


@dataclass(frozen=True)
class Profile:
    """One motion along its normalised path, at N even distances from start (0) to goal (1)."""

    lyapunov: Array  # (N,) Φ(ψ(y)) over its value at the start
    distance: Array  # (N,) of the end effector from the nearest point of its demonstration, metres
    clearance: Array
    """(N,) distance from the obstacles of what avoids them, metres, negative inside; infinite where there are none."""
    frechet: float  # discrete Fréchet distance of the end effector to its demonstration, metres
    depth: float
    """How deep what avoids the obstacles enters them (M.C.D.), metres; 0 when it is clear."""


@dataclass(frozen=True)
class Profiles:
    """A motion and what it would be without any behaviour."""

    shown: Profile
    undisturbed: Profile
    of_body: bool = False
    """Whether clearance and depth are of the spheres that cover the arm, not of the end effector."""
    of_mean: bool = False
    """Whether the distances are to the mean demonstration: the motion begins at an added start."""

    @property
    def along(self) -> Array:
        """(N,) of the path, from 0 to 1."""
        return np.linspace(0, 1, len(self.shown.lyapunov))


def profiles(motion: Solved, drawn: DrawnSamples, rollout: int, follower: Follower) -> Profiles:
    """Profiles of a rollout, by its place among those that are drawn, with and without behaviours."""
    nominal, arm, task, rows = motion.nominal, motion.arm, motion.nominal.task, drawn.index == rollout
    obstacle, of_mean = motion.scenario.obstacle, bool(nominal.added[rollout])
    demonstration = task.mean_path if of_mean else task.paths[rollout]
    paths, below = (drawn.positions[rows], nominal.paths[rollout]), drawn.positions[rows]
    index, fraction = np.full(len(nominal.paths[rollout]), rollout), nominal.trajectories[rollout].fraction
    if arm is None:
        clearances = [obstacle.signed_distance(path) for path in paths]
        depths = [maximum_collision_distance(path, obstacle.signed_distance) for path in paths]
    else:
        q = follower.undisturbed(nominal).at(index, fraction)
        below = follower.robot.end_effector(arm.transform.forward(arm.p[rows]))
        clearances = [follower.whole_arm.clearance(postures, obstacle) for postures in (arm.p[rows], q)]
        depths = [-float(clearance.min()) for clearance in clearances]
    samples = (
        (motion.stack.system, motion.stack.rays.at(drawn.index[rows], drawn.fraction[rows]), below),
        (nominal.system, nominal.rays.at(index, fraction), nominal.paths[rollout]),
    )
    values = [system.lyapunov(np.concatenate([places, at[:, 3:]], axis=1)) for system, at, places in samples]
    shown, undisturbed = (
        profile(path, demonstration, potential, clearance, depth)
        for path, potential, clearance, depth in zip(paths, values, clearances, depths, strict=True)
    )
    return Profiles(shown, undisturbed, of_body=arm is not None, of_mean=of_mean)


def profile(path: Array, demonstration: Array, potential: Array, clearance: Array, depth: float) -> Profile:
    """Profile of one motion of the end effector, with T samples, and its demonstration (M, 3), metres.

    Of what avoids the obstacles, the clearance is at the samples, and the depth negative where it is clear, metres.
    """
    length = arc_length(path)
    moves = np.r_[True, np.diff(length) > 0]
    places = np.linspace(0, length[-1], NUM_SAMPLES)

    def along(values: Array) -> Array:
        return np.interp(places, length[moves], values[moves])

    a, b = (resample_by_arc_length(points, NUM_SAMPLES) for points in (path, demonstration))
    return Profile(
        lyapunov=along(potential) / (potential[0] or 1.0),  # a motion from the goal has none to lose
        distance=distance_from_path(a, demonstration),
        clearance=along(clearance) if np.isfinite(clearance).all() else np.full(NUM_SAMPLES, np.inf),
        frechet=float(discrete_frechet(a, b)),
        depth=max(0.0, depth),
    )
