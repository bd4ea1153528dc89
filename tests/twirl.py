"""The kind of transform that dt_viz/README.md adds: its class and its registry, made from the text, and its field."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

import dt_viz
from dt_viz.avoidance.page import Number, PageEntry  # noqa: F401 - of the README's example
from dt_viz.avoidance.registry import KINDS
from dt_viz.avoidance.transform import Built, MotionBelow, Transform  # noqa: F401
from dt_viz.flows.diffeomorphisms import Flow  # noqa: F401
from dt_viz.flows.fields import Array


@dataclass(frozen=True)
class Whirl:
    """V(s) = exp(−‖s − c‖²/r²)·ẑ × (s − c): turns space around a vertical axis through c."""

    centre: Array
    radius: float

    dim = 3

    def __call__(self, s):
        offset = s - self.centre
        weight = np.exp(-(offset**2).sum(axis=1) / self.radius**2)
        return weight[:, None] * np.cross([0.0, 0.0, 1.0], offset)


def shown_in_the_readme():
    """The class that dt_viz/README.md shows, and the registry with the line that it shows."""
    text = (Path(dt_viz.__file__).parent / "README.md").read_text(encoding="utf-8")
    code, line = (part.split("```")[0] for part in text.split("## Adding a new transform")[1].split("```python")[1:3])
    names = dict(globals())
    exec(compile(f"from __future__ import annotations\n{code}\nADDED = {{{line}}}", "README.md", "exec"), names)
    return names["Twirl"], KINDS | names["ADDED"]
