"""One table of how things in the scene look: colours by the names of `Theme`'s fields, lengths in metres."""

from __future__ import annotations

from dataclasses import dataclass

from dt_viz.ui.scene.palette import Colour, Theme


@dataclass(frozen=True)
class Style:
    """Look of something of one colour: of it, what suits a line, a tube, vectors, a ball or a body."""

    colour: str
    width: float = 0.0
    """Width of a line."""
    dash: float = 0.0
    """Length of a dash and of the gap after it; 0 draws through."""
    radius: float = 0.0
    """Radius of a tube or a ball."""
    ball: float = 0.0
    """Radius of a ball at the beginning of a tube; 0 makes none."""
    opacity: float | None = None
    """Opacity of a tube or a body; None is opaque."""
    weak: str = ""
    """Colour of the shortest vectors: the larger ones are longer, and nearer to their colour."""
    length: float = 0.0
    """Length of the longest vectors."""
    thickness: float = 1.0
    """Thickness relative to the vector field's."""

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
