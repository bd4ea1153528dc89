"""Colours of the page: a theme names one for each thing that is drawn."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

Colour = tuple[int, int, int]
"""Red, green and blue, sRGB from 0 to 255."""


@dataclass(frozen=True)
class Theme:
    """Colours of all that is drawn, from the set of Okabe and Ito, which is distinct for all kinds of colour vision.

    The fields are those of the light theme.
    """

    demonstration: Colour = (86, 180, 233)
    rollout: Colour = (213, 94, 0)
    added: Colour = (150, 98, 20)
    """Added starts, and rollouts from them."""
    ghost: Colour = (84, 88, 96)
    """Motions without avoidance."""
    way: Colour = (118, 42, 131)
    """Path of the hand that lies ahead of the arm in the loop, and the ball to hold it by."""
    way_faded: Colour = (214, 204, 222)
    """End of the trail that the hand leaves."""
    stale: Colour = (158, 163, 171)
    """Rollouts of an earlier scenario."""
    axes: tuple[Colour, ...] = ((200, 72, 72), (78, 150, 86), (72, 104, 196))
    """Axes x, y and z of the hand along a motion."""
    goal: Colour = (0, 158, 115)
    obstacle: Colour = (204, 121, 167)
    bias: Colour = (230, 159, 0)
    region: Colour = (240, 196, 108)
    """Region of influence of a bias point."""
    level: Colour = (0, 114, 178)
    """Rollouts on the selected level of the stack."""
    slice: Colour = (120, 126, 136)
    """Frame of a moved slice, and of panels."""
    streamline: Colour = (92, 108, 138)
    volume: tuple[Colour, ...] = ((118, 42, 131), (194, 165, 207), (247, 247, 247), (166, 219, 160), (27, 120, 55))
    """Anchors of the scale of det J, from small to large; the middle one is 1."""
    folded: Colour = (230, 0, 38)
    """Places with det J ≤ 0, where the map is no diffeomorphism."""
    lyapunov: tuple[Colour, ...] = ((255, 250, 210), (160, 215, 185), (65, 160, 190), (45, 80, 160), (30, 20, 90))
    """Anchors of the scale of the Lyapunov value, from the goal up."""
    level_line: Colour = (255, 255, 255)
    """Level lines of the Lyapunov value."""
    occupancy: Colour = (128, 100, 190)
    occupancy_level: Colour = (84, 48, 140)
    """Line where occupied and free are equally likely."""
    outline: Colour = (40, 44, 52)
    """True outline of the obstacles on the slice."""
    occupied: Colour = (56, 24, 98)
    """Points of clouds that are labelled so."""
    free: Colour = (178, 184, 192)
    """Points of clouds that are labelled so."""
    arrow_slow: Colour = (227, 231, 236)
    arrow_fast: Colour = (136, 154, 181)
    generator_weak: Colour = (246, 214, 150)
    generator: Colour = (230, 159, 0)
    """Largest arrows of ψ's generators."""
    grid: Colour = (0, 114, 178)
    """Warped grid."""
    grid_beside: Colour = (158, 196, 222)
    """Warped grid beside the rollouts of a level."""
    pot: Colour = (176, 132, 98)
    object: Colour = (240, 200, 90)
    """What the hand moves."""
    ink: Colour = (24, 44, 92)
    board: Colour = (40, 70, 80)
    table: Colour = (233, 231, 229)
    zenith: Colour = (205, 214, 227)
    horizon: Colour = (227, 227, 228)
    """Lower end of the background: the colour of the table in this light."""
    arm: Colour = (206, 210, 216)
    arm_ring: Colour = (62, 66, 74)
    onion: Colour = (70, 116, 168)
    """Arms along the motion."""
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
