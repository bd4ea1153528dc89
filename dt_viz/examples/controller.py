"""A controller that follows the velocity field: wherever it is pushed to, the motion goes on to the goal.

Run it: python -m dt_viz.examples.controller [FILE.npz]. The motion is learned once, and then read from the file.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

import dt_viz as dt

PERIOD = 0.01  # time between two commands, seconds: 100 Hz
PUSH_AT, PUSH = 100, np.array([0.03, 0.0, 0.04])
"""Number of the command at which somebody pushes the hand, and by how much, metres."""
ARRIVED = 2e-3  # distance from the goal at which the controller stops, metres


def run(motion: dt.Motion, start: np.ndarray, longest: float = 60.0) -> np.ndarray:
    """Positions (T, 3), metres, of a hand from `start` (3,) until it arrives, or `longest` seconds have gone."""
    controller = dt.HandController(motion, start)
    position, passed = start.copy(), [start.copy()]
    for command in range(round(longest / PERIOD)):
        if np.linalg.norm(position - motion.goal) < ARRIVED:
            break
        velocity = controller.step(position, PERIOD)  # from where the hand is, not from where it should be
        position = position + PERIOD * velocity
        if command == PUSH_AT:
            position = position + PUSH
        passed.append(position.copy())
    return np.array(passed)


def main(file: str | None = None) -> None:
    """Push a box around a ball, and be pushed."""
    ball = dt.Sphere((0.10, -0.53, 0.15), diameter=0.15)
    if file is not None and Path(file).exists():
        around = dt.Motion.load(file)
    else:
        motion = dt.fit(dt.example("push_box"))
        around = motion.stack(dt.Avoidance(ball, margin=0.02))
        if file is not None:
            around.save(file)
    start = around.rollouts()[0].positions[0]
    passed = run(around, start)
    print(f"{len(passed)} commands in {PERIOD * len(passed):.1f} s of motion")
    print(f"smallest distance from the ball: {1e3 * ball.signed_distance(passed).min():.1f} mm")
    print(f"distance from the goal: {1e3 * np.linalg.norm(passed[-1] - around.goal):.1f} mm")


if __name__ == "__main__":
    main(*sys.argv[1:2])
