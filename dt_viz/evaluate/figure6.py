"""Figure 6: distance to the demonstration and collision depth along the normalised arc length, for all methods."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.metrics import distance_from_path, resample_by_arc_length
from dt_viz.obstacles.shapes import Sphere, as_point

NUM_SAMPLES = 300
"""Number of samples of each curve."""
FORMATS = ("svg", "png")


@dataclass(frozen=True)
class _Plotting:
    module: str

    @property
    def missing(self) -> tuple[str, ...]:
        """The module, if it is not installed."""
        return () if find_spec(self.module) else (self.module,)


MATPLOTLIB = _Plotting("matplotlib")
"""What the figures need."""


def curves(arrays: Mapping[str, Array], place: int, rollout: int) -> tuple[Array, Array]:
    """Distance to the demonstration and depth of the hand in the sphere, at `NUM_SAMPLES` even places of the path.

    Args:
        arrays: of a method's file, see `dt_viz.evaluate.table1`.
        place: number of the place.
        rollout: number of the start.

    Returns:
        Two arrays (`NUM_SAMPLES`,), metres; a depth is 0 outside.
    """
    path = arrays[f"x_{place}_{rollout}"]
    x = resample_by_arc_length(path if len(path) > 1 else np.repeat(path, 2, axis=0), NUM_SAMPLES)
    *centre, diameter = arrays[f"obstacle_{place}"]
    depth = np.maximum(-Sphere(as_point(np.array(centre)), float(diameter)).signed_distance(x), 0.0)
    return distance_from_path(x, arrays[f"demo_{rollout}"]), depth


def draw(
    path: Path, title: str, by_method: Mapping[str, Mapping[str, Array]], place: int = 0, rollout: int = 0
) -> None:
    """Draw the figure of one task to files of this name, one for each of `FORMATS`.

    Args:
        path: where, without a suffix.
        title: of the task.
        by_method: arrays of each method's file, by its title.
        place: number of the place.
        rollout: number of the start.
    """
    from matplotlib.figure import Figure  # noqa: PLC0415 - an extra

    figure = Figure(figsize=(9, 3.6), layout="constrained")
    axes = figure.subplots(1, 2, sharex=True)
    along = np.linspace(0, 1, NUM_SAMPLES)
    for name, arrays in by_method.items():
        for axis, values in zip(axes, curves(arrays, place, rollout), strict=True):
            axis.plot(along, values, label=name, linewidth=1.4)
    for axis, label in zip(axes, ("distance to the demonstration [m]", "depth of the hand [m]"), strict=True):
        axis.set(xlabel="normalised arc length", ylabel=label)
        axis.grid(alpha=0.3)
    figure.suptitle(title)
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside right center", fontsize="small")
    for suffix in FORMATS:
        figure.savefig(path.with_suffix(f".{suffix}"), dpi=150)
