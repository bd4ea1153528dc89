"""The JACO: kinematics, tracking, configuration space and collision."""
