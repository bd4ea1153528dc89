"""The robot in the loop: where it is to be, and the joint velocities that take it there within limits."""
