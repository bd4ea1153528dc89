"""The arm in the loop: a ball crosses its motion, it steps aside, and goes on to the goal.

Run it: python -m dt_viz.examples.arm_controller. The motion is learned first, which takes some seconds.
"""

from __future__ import annotations

import numpy as np

import dt_viz as dt

PERIOD = 0.01  # time between two commands, seconds: 100 Hz
SEEN = 4  # number of commands between two looks at the ball
BALL, VELOCITY = np.array([0.35, -0.53, 0.20]), np.array([-0.1, 0.0, 0.0])
"""Where the ball is at first, metres, and its velocity, m/s."""
MARGIN = 0.03  # clearance that is asked for, metres


def run(motion: dt.Motion, arm: dt.Arm, seconds: float = 12.0) -> tuple[np.ndarray, np.ndarray]:
    """Joint angles (T, n), rad, and places (T, 3) of the ball, metres, at all commands."""
    controller = dt.Controller(motion, arm)
    q = arm.follow(motion.rollouts()[0]).q[0]
    joints, places = [], []
    for command in range(round(seconds / PERIOD)):
        place = BALL + PERIOD * command * VELOCITY
        if command % SEEN == 0:
            ball = dt.Sphere((place[0], place[1], place[2]), diameter=0.15)
            controller.motion = motion.stack(dt.ArmAvoidance(ball, margin=MARGIN))
        joints.append(q)
        places.append(place)
        q = q + PERIOD * controller.step(q, PERIOD)  # a robot would be told the velocity, and tell where it is
    return np.array(joints), np.array(places)


def main() -> None:
    """Print how near the ball came, and where the hand is in the end."""
    arm, motion = dt.load_jaco(), dt.fit(dt.example("push_box"))
    joints, places = run(motion, arm)
    hand = arm.robot.end_effector(joints)
    distance = np.linalg.norm(hand - places, axis=1).min() - 0.075
    print(f"smallest distance of the hand from the ball: {1e3 * distance:.0f} mm")
    print(f"distance from the goal: {1e3 * np.linalg.norm(hand[-1] - motion.goal):.2f} mm")


if __name__ == "__main__":
    main()
