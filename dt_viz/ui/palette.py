"""Colours of the page: from Okabe and Ito's set, which people with any kind of colour vision can tell apart."""

DEMONSTRATION = (86, 180, 233)
"""Thin lines."""
ROLLOUT = (213, 94, 0)
"""Bold lines."""
CHOSEN_ROLLOUT = (150, 45, 0)
"""The one that the arm follows."""
GHOST = (120, 124, 132)
"""Dashed lines."""
GOAL = (0, 158, 115)
START = (213, 94, 0)
OBSTACLE = (204, 121, 167)
ARROW_SLOW = (198, 205, 216)
ARROW_FAST = (64, 84, 120)
TABLE = (226, 217, 204)
ARM = (206, 210, 216)
ARM_RING = (62, 66, 74)
BRAND = (0, 114, 178)
