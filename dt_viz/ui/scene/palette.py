"""Colours of the page, from the set of Okabe and Ito, which is distinct for all kinds of colour vision."""

DEMONSTRATION = (86, 180, 233)
ROLLOUT = (213, 94, 0)
ADDED = (150, 98, 20)
"""Rollouts from added starts, and these."""
GHOST = (84, 88, 96)
"""Motions without avoidance."""
WAY = (118, 42, 131)
"""Way of the hand that lies ahead of the arm in the loop, and the ball to hold it by."""
WAY_FADED = (214, 204, 222)
"""End of the trail that it leaves."""
STALE = (158, 163, 171)
"""Rollouts of an earlier scenario."""
GOAL = (0, 158, 115)
OBSTACLE = (204, 121, 167)
BIAS = (230, 159, 0)
REGION = (240, 196, 108)
"""Region of influence of a bias point."""
LEVEL = (0, 114, 178)
"""Rollouts on the selected level of the stack."""
SLICE = (120, 126, 136)
"""Frame of a moved slice."""
STREAMLINE = (92, 108, 138)
VOLUME = ((118, 42, 131), (194, 165, 207), (247, 247, 247), (166, 219, 160), (27, 120, 55))
"""Anchors of the scale of det J, from small to large; the middle one is 1."""
FOLDED = (230, 0, 38)
"""Places with det J ≤ 0, where the map is no diffeomorphism."""
LYAPUNOV = ((255, 250, 210), (160, 215, 185), (65, 160, 190), (45, 80, 160), (30, 20, 90))
"""Anchors of the scale of the Lyapunov value, from the goal up."""
LEVEL_LINE = (255, 255, 255)
"""Level lines of the Lyapunov value."""
OCCUPANCY = (128, 100, 190)
OCCUPANCY_LEVEL = (84, 48, 140)
"""Line where occupied and free are equally likely."""
OUTLINE = (40, 44, 52)
"""True outline of the obstacles on the slice."""
OCCUPIED, FREE = (56, 24, 98), (178, 184, 192)
"""Labelled points of clouds."""
ARROW_SLOW = (198, 205, 216)
ARROW_FAST = (64, 84, 120)
GENERATOR_WEAK = (246, 214, 150)
GENERATOR = (230, 159, 0)
"""Largest arrows of ψ's generators."""
GRID = (0, 114, 178)
GRID_BESIDE = (158, 196, 222)
"""Warped grid, and the same beside the rollouts of a level."""
PANEL = (120, 126, 136)
POT = (176, 132, 98)
OBJECT = (240, 200, 90)
"""What the hand moves."""
INK, BOARD = (24, 44, 92), (40, 70, 80)
TABLE = (233, 231, 229)
ZENITH, HORIZON = (205, 214, 227), (227, 227, 228)
"""Background, from above down to the horizon: that is the colour of the table in this light."""
ARM = (206, 210, 216)
ARM_RING = (62, 66, 74)
ONION = (70, 116, 168)
"""Arms along the motion."""
BODY_POINT = (170, 178, 190)
BODY_POINT_MOVED = (0, 158, 115)
BODY_PATH = (0, 92, 66)
JOINTS = ((230, 159, 0), (86, 180, 233), (0, 158, 115), (0, 114, 178), (213, 94, 0), (204, 121, 167))
"""Curves of the six joints, base to hand."""
COMPARED = (
    (120, 94, 200),
    (51, 34, 136),
    (17, 119, 51),
    (136, 34, 85),
    (204, 102, 119),
    (140, 130, 40),
    (0, 140, 150),
)
"""Motions of methods beside ours, in the order of the tables: after the muted set of Tol."""
BRAND = (0, 114, 178)
ON_DARK = {
    ADDED: (206, 152, 66),
    GHOST: (190, 194, 202),
    WAY: (198, 134, 212),
    WAY_FADED: (66, 58, 74),
    OUTLINE: (214, 218, 226),
    STREAMLINE: (146, 164, 198),
    ARROW_SLOW: (72, 82, 102),
    ARROW_FAST: (168, 190, 228),
    GRID: (76, 152, 206),
    GRID_BESIDE: (62, 92, 118),
    INK: (226, 232, 240),
    COMPARED[0]: (168, 148, 236),
    COMPARED[1]: (136, 128, 230),
    COMPARED[2]: (72, 186, 112),
    COMPARED[3]: (214, 96, 152),
    COMPARED[5]: (200, 190, 92),
    TABLE: (38, 40, 46),
    ZENITH: (16, 19, 26),
    HORIZON: (58, 61, 71),
}
"""Colours of the dark theme, by those of the light one that they replace; all others are for both."""


def shade(colour: tuple[int, int, int], dark: bool) -> tuple[int, int, int]:
    """Return a colour of the light theme as the theme has it."""
    return ON_DARK.get(colour, colour) if dark else colour


def linear(colour: tuple[int, int, int]) -> tuple[int, int, int]:
    """Return the value that shows as this colour on lines and arrows of many colours: linear light."""
    red, green, blue = (round(255 * (c / 255) ** 2.2) for c in colour)
    return red, green, blue


def ink(colour: tuple[int, int, int]) -> str:
    """Return a dark colour of text in CSS, lighter where the panel is dark."""
    red, green, blue = (round(c + 0.62 * (255 - c)) for c in colour)
    return f"light-dark({css(colour)}, {css((red, green, blue))})"


def paper(colour: tuple[int, int, int], text: tuple[int, int, int]) -> str:
    """Return a pale background of text in CSS: where the panel is dark it is a dark one of the text's colour."""
    red, green, blue = (round(0.45 * c) for c in text)
    return f"light-dark({css(colour)}, {css((red, green, blue))})"


def css(colour: tuple[int, int, int]) -> str:
    """Return the colour in CSS."""
    return "rgb({}, {}, {})".format(*colour)
