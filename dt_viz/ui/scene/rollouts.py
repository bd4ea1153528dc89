"""The rollouts as tubes, and the lines beside them: demonstrations and the undisturbed motion."""

from __future__ import annotations

import math
import time
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import viser
from scipy.spatial import KDTree

from dt_viz.flows.fields import Array
from dt_viz.session.frame import Frame, Stage
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.picture import Lines, Picture
from dt_viz.ui.scene.tubes import Tubes, middles_of

BOLD, THIN = 0.0034, 0.0020
"""Radius of the rollout that the arm follows, and of the others, metres."""
BESIDE = 0.7
"""Thickness of rollouts beside those of a level, relative to the usual one."""
OPACITY = 0.55
"""Opacity of the rollouts that the arm does not follow."""
COVERED = 0.0035
"""Distance of a line from the middle of a rollout up to which it counts as inside its tube, metres."""
BETWEEN = 5
"""Number of points from one ring of a tube to the next that lines are compared with."""
JUMP, FADING = 0.05, 0.15
"""Distance by which a rollout jumps, metres, where it then fades out where it was, and the time that takes, seconds."""
SPARSE = 3
"""Stride of the rings with which it is drawn there: the faces are sent, too, which other frames of a drag keep."""


@dataclass(frozen=True, eq=False)
class _Tubes:
    """Where the tubes of rollouts lie."""

    rollouts: tuple[Array, ...]
    """(T_i, 3), metres."""
    middles: Array
    """(R, K, 3), metres."""

    @cached_property
    def samples(self) -> KDTree:
        """Points along the middles."""
        part = np.arange(BETWEEN)[:, None] / BETWEEN
        pieces = self.middles[:, :-1, None] + part * np.diff(self.middles, axis=1)[:, :, None]
        return KDTree(np.concatenate([pieces.reshape(-1, 3), self.middles[:, -1]]))


class Middles:
    """The middles of the tubes that a frame's rollouts are drawn with, worked out once, and what the tubes cover."""

    def __init__(self) -> None:
        self.shown = True
        """Whether the tubes are shown; hidden ones cover nothing."""
        self._newest = _Tubes((), middles_of(()))

    def of(self, rollouts: tuple[Array, ...]) -> Array:
        """The middles (R, K, 3) of tubes around rollouts (T_i, 3), metres."""
        if rollouts is not self._newest.rollouts:
            self._newest = _Tubes(rollouts, middles_of(rollouts))
        return self._newest.middles

    def beside(self, segments: Array, distance: float = COVERED) -> Array:
        """Those of the segments (K, 2, 3) farther than a distance from the middles asked for last, all in metres."""
        newest = self._newest
        if not self.shown or not newest.rollouts:
            return segments
        away, _ = newest.samples.query(segments.mean(axis=1), distance_upper_bound=distance)
        return segments[np.isinf(away)]


class _Beside(Picture, ABC):
    """Lines where no rollout covers them; while a drag goes on they follow with the field."""

    def __init__(self, lines: Lines, middles: Middles) -> None:
        super().__init__(lines.node)
        self._lines, self._middles = lines, middles
        self._drawn: tuple[object, bool] | None = None
        """Task drawn last, and whether its rollouts covered something."""

    def draw(self, frame: Frame) -> None:
        drawn = frame.task, self._middles.shown
        if frame.stage is Stage.ROLLOUTS and drawn == self._drawn:
            return
        self._drawn = drawn
        self._middles.of(frame.rollouts)
        self._lines.show_segments(self._middles.beside(self._lines.segments(self._paths(frame))))

    @abstractmethod
    def _paths(self, frame: Frame) -> Sequence[Array]:
        """Return the paths (T_i, 3), metres."""


class Demonstrations(_Beside):
    """The demonstrations, as thin lines."""

    def __init__(self, scene: viser.SceneApi, middles: Middles) -> None:
        super().__init__(Lines(scene, "/demonstrations", palette.DEMONSTRATION, 0.0018), middles)

    def _paths(self, frame: Frame) -> Sequence[Array]:
        return frame.task.paths


class Ghost(_Beside):
    """The undisturbed motion of the rollout that the arm follows, dashed."""

    def __init__(self, scene: viser.SceneApi, middles: Middles) -> None:
        super().__init__(Lines(scene, "/ghost", palette.GHOST, 0.003, dash=0.012), middles)

    def _paths(self, frame: Frame) -> Sequence[Array]:
        own = frame.ghost[: len(frame.ghost) - frame.num_added]
        return own if frame.chosen is None else frame.ghost[frame.chosen : frame.chosen + 1]

    def dye(self, dark: bool) -> None:
        self._lines.dye(dark)


class Rollouts(Picture):
    """The rollouts as tubes: the one that the arm follows thick, the others thin and translucent.

    Where some of them jump elsewhere, as when a drag takes them past the other side of an obstacle, they fade out
    where they were.
    """

    def __init__(self, scene: viser.SceneApi, middles: Middles) -> None:
        super().__init__(scene.add_frame("/rollouts", show_axes=False))
        self._middles = middles
        self.hero = Tubes(scene, "/rollouts/followed", palette.ROLLOUT, BOLD, ball=2.4 * BOLD)
        self.others = Tubes(scene, "/rollouts/others", palette.ROLLOUT, THIN, ball=2.6 * THIN, opacity=OPACITY)
        self.added = Tubes(scene, "/rollouts/added", palette.ADDED, THIN)
        self.former = Tubes(scene, "/rollouts/former", palette.ROLLOUT, THIN, opacity=OPACITY)
        self._added = palette.ADDED
        self._drawn: tuple[object, Array] | None = None
        """Task and middles drawn last."""
        self._jumped = -math.inf
        """Time at which some jumped, seconds."""

    def draw(self, frame: Frame) -> None:
        middles = self._middles.of(frame.rollouts)
        number = np.arange(len(middles))
        followed = number == (frame.chosen if frame.level is None else None)
        added = number >= len(middles) - frame.num_added
        scale = 1.0 if frame.level is None else BESIDE
        self.hero.show(middles[followed])
        self.others.show(middles[~added & ~followed], scale=scale)
        self.added.show(middles[added & ~followed])
        for tubes, colour in (
            (self.hero, palette.ROLLOUT),
            (self.others, palette.ROLLOUT),
            (self.added, self._added),
        ):
            tubes.colour = palette.STALE if frame.blocked else colour
        self._fade_what_jumped(frame.task, middles)

    def dye(self, dark: bool) -> None:
        self._added = palette.shade(palette.ADDED, dark)

    def _fade_what_jumped(self, task: object, middles: Array) -> None:
        """Begin to let those fade that were drawn far from where they are now, of the same task."""
        before, self._drawn = self._drawn, (task, middles)
        if before is None or before[0] is not task or before[1].shape != middles.shape:
            return
        jumped = np.linalg.norm(before[1] - middles, axis=2).max(axis=1, initial=0) > JUMP
        if jumped.any():
            self.former.show(before[1][jumped, ::SPARSE])
            self._jumped = time.monotonic()

    def fade(self) -> None:
        """Let what has jumped fade; called again and again."""
        left = 1 - (time.monotonic() - self._jumped) / FADING
        self.former.node.visible = left > 0
        if left > 0:
            self.former.node.opacity = OPACITY * left
