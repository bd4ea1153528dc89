"""Takes in which the hand turns on its way."""

import numpy as np

from dt_viz.flows.rotations import exponential
from dt_viz.learning.demonstrations import Demonstration

GOAL = np.array([0.1, 0.9, -0.3, 0.2]) / np.linalg.norm([0.1, 0.9, -0.3, 0.2])
"""Orientation (4,) at the goal, wxyz: the hand points down, about."""


def turning_takes(num=5, turn=1.5, seed=3, goal=(0.0, 0.0, 0.0)):
    """Takes that bend on their way to a goal and turn the hand by about `turn` rad, each a little else."""
    rng, u, takes = np.random.default_rng(seed), np.linspace(1.0, 0.0, 150), []
    for k in range(num):
        start = np.array([0.4, 0.1, 0.2]) + 0.03 * rng.normal(size=3)
        path = goal + u[:, None] * start + 0.1 * np.sin(np.pi * u)[:, None] * np.array([0.0, 1.0, 0.5])
        axis = np.array([0.3, 1.0, 0.2]) + 0.1 * rng.normal(size=3)
        vectors = turn * (u**1.3)[:, None] * axis / np.linalg.norm(axis) + 0.1 * np.sin(3 * u)[:, None] * [0, 0, 1]
        vectors += 0.03 * (1 - u[:, None]) ** 2 * rng.normal(size=3)  # each ends turned a little beside the others
        takes.append(Demonstration(np.linspace(0, 4, 150), path, f"{k}", exponential(GOAL, vectors)))
    return tuple(takes)


def in_reach():
    """Such takes before the JACO."""
    return turning_takes(turn=0.9, goal=(-0.2, -0.5, 0.15))
