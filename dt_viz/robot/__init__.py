"""An arm: kinematics, shapes, inverse kinematics, tracking and collision."""
