"""What tests of compared methods share."""

import numpy as np

from dt_viz.baselines.eflow import MASKS


def joints_of(plan):
    """The postures of a plan, which has some."""
    assert plan.joints is not None
    return plan.joints


def eflow_weights(task, seed=0, amplitude=0.01):
    """Some weights, as training leaves them; the goal is that of the task."""
    rng = np.random.default_rng(seed)
    dim, goal = task.demonstrations[0].dimension, task.demonstrations[0].positions[-1]
    features, moved, num_hidden = (len(MASKS), 2, 200), (dim + 1) // 2, 100
    points = np.concatenate([d.positions for d in task.demonstrations])
    scale = 1 / np.ptp(points, axis=0)
    return {
        "frequencies": rng.normal(size=(*features, moved)) / 0.45,
        "phases": rng.uniform(0, 6.28, size=features),
        "weights": rng.normal(size=(*features, moved)) * amplitude,
        "normalisation": np.stack([scale, -points.min(axis=0) * scale - 0.5]),
        "goal": goal,
        "speed_0": rng.normal(size=(num_hidden, dim + 1)) * 0.1,
        "speed_1": rng.normal(size=(num_hidden, num_hidden + 1)) * 0.1,
        "speed_2": rng.normal(size=(1, num_hidden + 1)) * 0.1,
    }
