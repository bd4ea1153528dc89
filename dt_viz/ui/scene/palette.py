"""Colours of the page: a theme names one for each thing that is drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace

from dt_viz.memo import cached_property

Colour = tuple[int, int, int]  # red, green and blue, sRGB from 0 to 255


@dataclass(frozen=True)
class Theme:
    """Colours of all that is drawn, from the set of Okabe and Ito, which is distinct for all kinds of colour vision.

    The fields are those of the light theme.
    """

    demonstration: Colour = (86, 180, 233)
    rollout: Colour = (213, 94, 0)
    added: Colour = (150, 98, 20)  # added starts, and rollouts from them
    ghost: Colour = (84, 88, 96)  # motions without avoidance
    way: Colour = (118, 42, 131)
    """Path of the hand that lies ahead of the arm in the loop, and the ball to hold it by."""
    way_faded: Colour = (214, 204, 222)  # end of the trail that the hand leaves
    stale: Colour = (158, 163, 171)  # rollouts of an earlier scenario
    axes: tuple[Colour, ...] = ((200, 72, 72), (78, 150, 86), (72, 104, 196))
    """Axes x, y and z of the hand along a motion."""
    goal: Colour = (0, 158, 115)
    obstacle: Colour = (204, 121, 167)
    bias: Colour = (230, 159, 0)
    region: Colour = (240, 196, 108)  # region of influence of a bias point
    level: Colour = (0, 114, 178)  # rollouts on the selected level of the stack
    slice: Colour = (120, 126, 136)  # frame of a moved slice, and of panels
    streamline: Colour = (92, 108, 138)
    volume: tuple[Colour, ...] = ((118, 42, 131), (194, 165, 207), (247, 247, 247), (166, 219, 160), (27, 120, 55))
    """Anchors of the scale of det J, from small to large; the middle one is 1."""
    folded: Colour = (230, 0, 38)  # places with det J ≤ 0, where the map is no diffeomorphism
    lyapunov: tuple[Colour, ...] = ((255, 250, 210), (160, 215, 185), (65, 160, 190), (45, 80, 160), (30, 20, 90))
    """Anchors of the scale of the Lyapunov value, from the goal up."""
    level_line: Colour = (255, 255, 255)  # level lines of the Lyapunov value
    occupancy: Colour = (128, 100, 190)
    occupancy_level: Colour = (84, 48, 140)  # line where occupied and free are equally likely
    outline: Colour = (40, 44, 52)  # True outline of the obstacles on the slice
    occupied: Colour = (56, 24, 98)  # points of clouds that are labelled so
    free: Colour = (178, 184, 192)  # points of clouds that are labelled so
    arrow_slow: Colour = (227, 231, 236)
    arrow_fast: Colour = (136, 154, 181)
    generator_weak: Colour = (246, 214, 150)
    generator: Colour = (230, 159, 0)  # largest arrows of ψ's generators
    grid: Colour = (0, 114, 178)  # warped grid
    grid_beside: Colour = (158, 196, 222)  # warped grid beside the rollouts of a level
    pot: Colour = (176, 132, 98)
    object: Colour = (240, 200, 90)  # what the hand moves
    ink: Colour = (24, 44, 92)
    board: Colour = (40, 70, 80)
    table: Colour = (233, 231, 229)
    zenith: Colour = (205, 214, 227)
    horizon: Colour = (227, 227, 228)
    """Lower end of the background: the colour of the table in this light."""
    arm: Colour = (206, 210, 216)
    arm_ring: Colour = (62, 66, 74)
    onion: Colour = (70, 116, 168)  # arms along the motion
    body_point: Colour = (170, 178, 190)
    body_point_moved: Colour = (0, 158, 115)
    body_path: Colour = (0, 92, 66)
    joints: tuple[Colour, ...] = (bias, demonstration, goal, level, rollout, obstacle, free, generator)
    """Curves of the joints, base to hand; those of more begin again."""
    compared: tuple[Colour, ...] = (
        (120, 94, 200),
        (51, 34, 136),
        (17, 119, 51),
        (136, 34, 85),
        (204, 102, 119),
        (140, 130, 40),
        (0, 140, 150),
    )
    """Motions of methods beside ours, in the order of the tables: after the muted set of Tol."""
    takes: tuple[Colour, ...] = (level, bias, goal, rollout, obstacle, demonstration, (120, 94, 200))
    """Takes that are seen before they are learned; those of more begin again."""
    brand: Colour = (0, 114, 178)

    @cached_property
    def without_motion(self) -> Theme:
        """The theme where the scenario has no motion: those of an earlier one are grey."""
        return replace(self, rollout=self.stale, added=self.stale, level=self.stale)


LIGHT = Theme()
DARK = Theme(
    added=(206, 152, 66),
    ghost=(190, 194, 202),
    way=(198, 134, 212),
    way_faded=(66, 58, 74),
    outline=(214, 218, 226),
    streamline=(146, 164, 198),
    arrow_slow=(144, 152, 168),
    arrow_fast=(211, 223, 242),
    grid=(76, 152, 206),
    grid_beside=(62, 92, 118),
    ink=(226, 232, 240),
    compared=(
        (168, 148, 236),
        (136, 128, 230),
        (72, 186, 112),
        (214, 96, 152),
        (204, 102, 119),
        (200, 190, 92),
        (0, 140, 150),
    ),
    table=(38, 40, 46),
    zenith=(16, 19, 26),
    horizon=(58, 61, 71),
)


def linear(colour: Colour) -> Colour:
    """Return the value that shows as this colour on lines and arrows of many colours: linear light."""
    red, green, blue = (round(255 * (c / 255) ** 2.2) for c in colour)
    return red, green, blue


def ink(colour: Colour) -> str:
    """Return a dark colour of text in CSS, lighter where the panel is dark."""
    red, green, blue = (round(c + 0.62 * (255 - c)) for c in colour)
    return f"light-dark({css(colour)}, {css((red, green, blue))})"


def paper(colour: Colour, text: Colour) -> str:
    """Return a pale background of text in CSS: where the panel is dark it is a dark one of the text's colour."""
    red, green, blue = (round(0.45 * c) for c in text)
    return f"light-dark({css(colour)}, {css((red, green, blue))})"


def css(colour: Colour) -> str:
    """Return the colour in CSS."""
    return "rgb({}, {}, {})".format(*colour)


@dataclass(frozen=True)
class Style:
    """Look of something of one colour: of it, what suits a line, a tube, vectors, a ball or a body."""

    colour: str
    width: float = 0.0  # width of a line
    dash: float = 0.0  # length of a dash and of the gap after it; 0 draws through
    radius: float = 0.0  # radius of a tube or a ball
    ball: float = 0.0  # radius of a ball at the beginning of a tube; 0 makes none
    opacity: float | None = None  # opacity of a tube or a body; None is opaque
    weak: str = ""
    """Colour of the shortest vectors: the larger ones are longer, and nearer to their colour."""
    length: float = 0.0  # length of the longest vectors
    thickness: float = 1.0  # thickness relative to the vector field's

    def on(self, theme: Theme, number: int = 0) -> Colour:
        """Return the colour in a theme; `number` tells those apart of which the theme has several of the name."""
        colour = getattr(theme, self.colour)
        return colour if isinstance(colour[0], int) else colour[number % len(colour)]


class STYLES:
    """All of them: a line inside a tube is thinner than it, what a user moves is easy to hit."""

    # lines
    demonstration = Style("demonstration", width=0.0018)
    ghost = Style("ghost", width=0.003, dash=0.012)
    take = Style("takes", width=0.0042)
    take_given = Style("slice", width=0.0012)
    take_left_out = Style("stale", width=0.0026, dash=0.012)
    drawn = Style("ghost", width=0.0014, dash=0.003)
    pen = Style("level", width=0.005)
    far = Style("folded", width=0.0064)
    teaching_lines = Style("slice", width=0.0008)
    way = Style("way", width=0.0055)
    trail = Style("way", width=0.005)
    ink = Style("ink", width=0.005)
    compared_followed = Style("compared", width=0.0055)
    compared = Style("compared", width=0.0014)
    hand_axis = Style("axes", width=0.0022)
    streamline = Style("streamline", width=0.0015)
    grid = Style("grid", width=0.0011)
    grid_beside = Style("grid_beside", width=0.0007)
    generator_motion = Style("generator", width=0.0026)
    slice_border = Style("slice", width=0.0022)
    level_line = Style("level_line", width=0.0012)
    occupancy_level = Style("occupancy_level", width=0.0025)
    outline = Style("outline", width=0.0030)
    body_path = Style("body_path", width=0.004)
    panel_border = Style("slice", width=0.0016)
    panel_grid = Style("grid", width=0.0010)
    panel_streamline = Style("streamline", width=0.0011)

    # paths
    followed = Style("rollout", radius=0.0034, ball=0.00816)
    rollout = Style("rollout", radius=0.0020, ball=0.0052, opacity=0.55)
    added = Style("added", radius=0.0020)
    level = Style("level", radius=0.0026, ball=0.006)
    panel_rollout = Style("rollout", radius=0.0022, ball=0.0055)

    # vectors
    field = Style("arrow_fast", weak="arrow_slow", length=0.024)
    streamline_head = Style("streamline", weak="streamline", length=0.012)
    generator = Style("generator", weak="generator_weak", length=0.030, thickness=1.25)
    panel_generator = Style("generator", weak="generator_weak", length=0.030)

    # places
    goal = Style("goal", radius=0.012)
    end = Style("rollout", radius=0.009)
    level_end = Style("level", radius=0.009)
    panel_goal = Style("goal", radius=0.009)
    start = Style("added", radius=0.010)
    bias = Style("bias", radius=0.011)
    grip = Style("way", radius=0.016)

    # bodies
    obstacle = Style("obstacle", opacity=0.8)
    obstacle_faint = Style("obstacle", opacity=0.3)
    obstacle_opened = Style("obstacle", opacity=0.12)
    arm_stale = Style("arm", opacity=0.4)
    arm_ghost = Style("ghost", opacity=0.5)
    body_points = Style("body_point", opacity=0.25)
    board = Style("board", opacity=0.06)
    teaching_board = Style("board", opacity=0.22)
