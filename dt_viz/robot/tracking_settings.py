"""What may be chosen about inverse kinematics and tracking."""

from __future__ import annotations

import math
from dataclasses import dataclass

from dt_viz.robot.sizing import scales


@dataclass(frozen=True)
class TrackingSettings:
    """Settings of `dt_viz.robot.inverse_kinematics`, which compiled loops take, too.

    `scales` marks what is given for an arm as large as the JACO, and scales with an arm's reach.
    """

    direction_weight: float = 1.5
    """Weight w_d of the hand's direction (unit vectors) against joint angles (rad). Much above 2, the best posture
    stops being unique and tracked joints jump between wrist postures."""
    asked_direction_weight: float = 40.0
    """Weight w_d where inverse kinematics is given a direction: it chooses one posture and need not be continuous."""
    orientation_weight: float = 1000.0
    """Weight w_o of the hand's orientation (rad), where one is wanted, against joint angles (rad). Its place comes
    first."""
    first_orientation_weight: float = 30.0
    """That weight until postures have settled: with the whole of it they find their branch of the wrist less often."""
    as_well_turned: float = 0.05
    """Angle by which the hand may be turned farther beside its orientations along a path from a start of a better
    posture, rad."""
    turning_sweeps: int = 30
    """Largest number of sweeps that improve the posture where orientations are wanted."""
    turn_length: float = scales(0.2)
    """Length that a turn of the hand by one radian counts along a path, metres."""
    limit_weight: float = 50.0
    """Weight of the springs before the joint limits, against 1 for staying near the reference."""
    limit_margin: float = 0.15
    """Distance from the limit at which those springs start, rad."""
    damping_floor: float = scales(1e-6, 2)
    """Least damping λ₀² of the pseudo-inverse, m²: bounds the step at a singularity, is negligible elsewhere."""
    damping_per_error: float = scales(0.2)
    """Growth of λ² with the remaining error, m: about half the curvature of the forward kinematics."""
    curvature: float = scales(0.1)
    """Curvature of the forward kinematics along the null space, m per rad²; see `dt_viz.kernels.tracking`."""
    step_limit: float = 0.4
    """Largest joint motion in one step, rad; beyond it the linear model is invalid."""
    stride: float = scales(0.08)
    """Distance along the path that a cold start covers in one step, metres."""
    max_sweeps: int = 8
    """Largest number of sweeps that improve the posture, too."""
    final_sweeps: int = 3
    """Largest number of sweeps after them, which keep the posture and only correct the positions."""
    step_tolerance: float = 1e-3
    """Step, rad, below which a waypoint is done: the remaining error is about its square times the reach."""
    jump_per_root_metre: float = scales(4.0, -0.5)
    """Joint motion over the root of the hand's, rad/√m, above which a warm start has lost its branch. The stretched arm
    follows the root: 0.4 rad bend it by 2 cm."""
    singular_manipulability: float = scales(3e-3, 3)
    """Manipulability, m³, below which the damping takes about 1 % or more of a step; the workspace has 0.05 to 0.2."""
    hand_pitch: float = math.radians(40.0)
    """Angle of the hand below horizontal, rad, where inverse kinematics is asked for no other."""
    num_restarts: int = 24
    """Number of postures that inverse kinematics begins from."""
    max_iterations: int = 60
    """Largest number of its steps."""
    tolerance: float = 1e-5
    """Distance from its target, metres, below which that counts as reached."""
    floor_weight: float = scales(100.0, -1)
    """Cost per metre of a joint below the table, where it chooses among its solutions."""
