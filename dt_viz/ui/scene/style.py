"""One table of how things in the scene look: colours by the names of `Theme`'s fields, lengths in metres."""

from __future__ import annotations

from dataclasses import dataclass

from dt_viz.ui.scene.palette import Colour, Theme


@dataclass(frozen=True)
class Style:
    """Look of something of one colour."""

    colour: str

    def on(self, theme: Theme, number: int = 0) -> Colour:
        """Return the colour in a theme; `number` tells those apart of which the theme has several of the name."""
        colour = getattr(theme, self.colour)
        return colour if isinstance(colour[0], int) else colour[number % len(colour)]


@dataclass(frozen=True)
class LineStyle(Style):
    """Look of lines."""

    width: float
    dash: float = 0.0
    """Length of a dash and of the gap after it; 0 draws through."""


@dataclass(frozen=True)
class TubeStyle(Style):
    """Look of paths as tubes."""

    radius: float
    ball: float = 0.0
    """Radius of a ball at the beginning; 0 makes none."""
    opacity: float | None = None


@dataclass(frozen=True)
class ArrowStyle(Style):
    """Look of vectors: the larger, the longer and nearer to their colour."""

    weak: str
    """Colour of the shortest."""
    length: float
    """Length of the longest."""
    thickness: float = 1.0
    """Thickness relative to the vector field's."""


@dataclass(frozen=True)
class BallStyle(Style):
    """Look of a ball that marks a place."""

    radius: float


@dataclass(frozen=True)
class SurfaceStyle(Style):
    """Look of a body that is not opaque."""

    opacity: float


@dataclass(frozen=True)
class Styles:
    """All of them: a line inside a tube is thinner than it, what a user moves is easy to hit."""

    # lines
    demonstration: LineStyle = LineStyle("demonstration", 0.0018)
    ghost: LineStyle = LineStyle("ghost", 0.003, dash=0.012)
    take: LineStyle = LineStyle("takes", 0.0042)
    take_given: LineStyle = LineStyle("slice", 0.0012)
    take_left_out: LineStyle = LineStyle("stale", 0.0026, dash=0.012)
    way: LineStyle = LineStyle("way", 0.0055)
    trail: LineStyle = LineStyle("way", 0.005)
    ink: LineStyle = LineStyle("ink", 0.005)
    compared_followed: LineStyle = LineStyle("compared", 0.0055)
    compared: LineStyle = LineStyle("compared", 0.0014)
    hand_axis: LineStyle = LineStyle("axes", 0.0022)
    streamline: LineStyle = LineStyle("streamline", 0.0015)
    grid: LineStyle = LineStyle("grid", 0.0011)
    grid_beside: LineStyle = LineStyle("grid_beside", 0.0007)
    generator_motion: LineStyle = LineStyle("generator", 0.0026)
    slice_border: LineStyle = LineStyle("slice", 0.0022)
    level_line: LineStyle = LineStyle("level_line", 0.0012)
    occupancy_level: LineStyle = LineStyle("occupancy_level", 0.0025)
    outline: LineStyle = LineStyle("outline", 0.0030)
    body_path: LineStyle = LineStyle("body_path", 0.004)
    panel_border: LineStyle = LineStyle("slice", 0.0016)
    panel_grid: LineStyle = LineStyle("grid", 0.0010)
    panel_streamline: LineStyle = LineStyle("streamline", 0.0011)

    # paths
    followed: TubeStyle = TubeStyle("rollout", 0.0034, ball=0.00816)
    rollout: TubeStyle = TubeStyle("rollout", 0.0020, ball=0.0052, opacity=0.55)
    added: TubeStyle = TubeStyle("added", 0.0020)
    level: TubeStyle = TubeStyle("level", 0.0026, ball=0.006)
    panel_rollout: TubeStyle = TubeStyle("rollout", 0.0022, ball=0.0055)

    # vectors
    field: ArrowStyle = ArrowStyle("arrow_fast", "arrow_slow", 0.024)
    streamline_head: ArrowStyle = ArrowStyle("streamline", "streamline", 0.012)
    generator: ArrowStyle = ArrowStyle("generator", "generator_weak", 0.030, thickness=1.25)
    panel_generator: ArrowStyle = ArrowStyle("generator", "generator_weak", 0.030)

    # places
    goal: BallStyle = BallStyle("goal", 0.012)
    end: BallStyle = BallStyle("rollout", 0.009)
    level_end: BallStyle = BallStyle("level", 0.009)
    panel_goal: BallStyle = BallStyle("goal", 0.009)
    start: BallStyle = BallStyle("added", 0.010)
    bias: BallStyle = BallStyle("bias", 0.011)
    grip: BallStyle = BallStyle("way", 0.016)

    # bodies
    obstacle: SurfaceStyle = SurfaceStyle("obstacle", 0.8)
    obstacle_faint: SurfaceStyle = SurfaceStyle("obstacle", 0.3)
    obstacle_opened: SurfaceStyle = SurfaceStyle("obstacle", 0.12)
    arm_stale: SurfaceStyle = SurfaceStyle("arm", 0.4)
    arm_ghost: SurfaceStyle = SurfaceStyle("ghost", 0.5)
    body_points: SurfaceStyle = SurfaceStyle("body_point", 0.25)
    board: SurfaceStyle = SurfaceStyle("board", 0.06)


STYLES = Styles()
