"""Style: how one hand's motions differ from another's, taken off one action and put on a third (the paper's sec. 6).

ψ_A and ψ_B of two augmented imitations are shears along motions over the same phase (see `flows.augmented_systems`), so
that ψ_A∘ψ_B⁻¹, which leads from the one hand to the other, is one, too: along the difference of their mean motions,
(y, s) ↦ (y + d(s), s). Put on a third motion, whole or in part, it is as stable, and det J stays 1.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from dt_viz.flows.augmented_systems import PhaseCurve
from dt_viz.flows.fields import Array
from dt_viz.learning.augmented import AugmentedImitation
from dt_viz.learning.preparation import ImitationError


@dataclass(frozen=True, eq=False)
class Style:
    """How a styled motion differs from a plain-handed one of the same action."""

    offsets: Array
    """(K, d) d at the knots of a motion, from its start, in units of s_max; zero at both ends, which stay."""

    @classmethod
    def between(cls, usual: AugmentedImitation, styled: AugmentedImitation) -> Style:
        """What leads from the usual motion of an action to the styled one.

        Raises:
            ImitationError: they do not have as many coordinates, or one shows several patterns: it has no mean motion.
        """
        _check(len(usual.goal), len(styled.goal))
        num = max(len(one.patterns) for one in (usual, styled))
        if num > 1:
            raise ImitationError(f"style: found a hand of {num} patterns; accepted: 1, demonstrations of one figure")
        means = [one.patterns[0].mean / one.top for one in (usual, styled)]
        num_knots = max(len(mean) for mean in means)
        before, after = (_at_knots(mean, num_knots) for mean in means)
        offsets = (after - after[-1]) - (before - before[-1])
        return cls(offsets - np.linspace(1, 0, len(offsets))[:, None] * offsets[0])

    def on(self, imitation: AugmentedImitation, amount: float) -> AugmentedImitation:
        """A motion of any action in this style, of which a part is put on; a negative amount is taken off.

        Raises:
            ImitationError: it has more or fewer coordinates.
        """
        _check(self.offsets.shape[1], len(imitation.goal))
        moved = amount * imitation.top * _at_knots(self.offsets, len(imitation.patterns[0].mean))
        patterns = tuple(replace(pattern, mean=pattern.mean + moved) for pattern in imitation.patterns)
        return replace(imitation, patterns=patterns, reason="a style is put on it")


def _at_knots(values: Array, num: int) -> Array:
    """Values (K, d) at even knots, at `num` of them."""
    return PhaseCurve.through(np.linspace(0, 1, len(values)), values).at(np.linspace(0, 1, num))


def _check(wanted: int, found: int) -> None:
    if found != wanted:
        raise ImitationError(f"style: found a motion of {found} coordinates; accepted: {wanted}, as the style has")
