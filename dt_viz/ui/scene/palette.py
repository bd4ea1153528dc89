"""Colours of the page: from Okabe and Ito's set, which people with any kind of colour vision can tell apart."""

DEMONSTRATION = (86, 180, 233)
"""Thin lines."""
ROLLOUT = (213, 94, 0)
"""Bold lines."""
CHOSEN_ROLLOUT = (150, 45, 0)
"""The one that the arm follows."""
GHOST = (84, 88, 96)
"""Dashed lines."""
PUSHED = (118, 42, 131)
"""The path of the hand after a push."""
STALE = (158, 163, 171)
"""Rollouts that are not the scenario's."""
GOAL = (0, 158, 115)
START = (213, 94, 0)
OBSTACLE = (204, 121, 167)
BIAS = (230, 159, 0)
"""Bias points."""
REGION = (240, 196, 108)
"""That a bias point acts in."""
LEVEL = (0, 114, 178)
"""Rollouts on the selected level of the stack."""
ROLLOUT_BESIDE = (238, 178, 132)
"""Those of the whole stack beside them."""
SLICE = (120, 126, 136)
"""Frame around a slice that is not where the task has it."""
STREAMLINE = (92, 108, 138)
VOLUME = ((118, 42, 131), (194, 165, 207), (247, 247, 247), (166, 219, 160), (27, 120, 55))
"""det J from small to large; the middle one is 1."""
FOLDED = (230, 0, 38)
"""det J that is not above 0: no diffeomorphism."""
LYAPUNOV = ((255, 250, 210), (160, 215, 185), (65, 160, 190), (45, 80, 160), (30, 20, 90))
"""Lyapunov value from the goal up."""
LEVEL_LINE = (255, 255, 255)
"""Of the Lyapunov value."""
OCCUPANCY = (128, 100, 190)
OCCUPANCY_LEVEL = (84, 48, 140)
"""Where the map finds occupied and free equally likely."""
OUTLINE = (40, 44, 52)
"""Of the obstacles themselves on the slice."""
OCCUPIED, FREE = (56, 24, 98), (178, 184, 192)
"""Labelled points."""
ARROW_SLOW = (198, 205, 216)
ARROW_FAST = (64, 84, 120)
GENERATOR_WEAK = (246, 214, 150)
GENERATOR = (230, 159, 0)
"""Of the flows that ψ is made of."""
GRID = (0, 114, 178)
"""Thinnest lines."""
GRID_BESIDE = (158, 196, 222)
"""Beside rollouts of the same colour."""
INSET = (120, 126, 136)
POT = (176, 132, 98)
CARRIED = (240, 228, 66)
"""The ball that is dropped in a pot."""
TABLE = (226, 217, 204)
ARM = (206, 210, 216)
ARM_RING = (62, 66, 74)
ONION = (70, 116, 168)
"""Arms along the motion."""
BODY_POINT = (170, 178, 190)
BODY_POINT_MOVED = (0, 158, 115)
BODY_PATH = (0, 92, 66)
JOINTS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (0, 114, 178), (213, 94, 0), (204, 121, 167))
"""Curves of the six joints, base to hand."""
BRAND = (0, 114, 178)


def linear(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """The value that shows as this colour where the browser takes colours as linear light: lines and arrows."""
    red, green, blue = (round(255 * (c / 255) ** 2.2) for c in colour)
    return red, green, blue


def css(colour: tuple[int, int, int]) -> str:
    """The colour as a browser reads it."""
    return "rgb({}, {}, {})".format(*colour)
