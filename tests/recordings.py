"""Recordings as files that the product reads."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dt_viz.learning.demonstrations import Demonstration


def save_demonstrations(path: Path, demonstrations: Sequence[Demonstration]) -> None:
    """Write demonstrations as npz: ``times_i``, ``positions_i`` and ``name_i`` for i = 0, 1, …."""
    arrays: dict[str, Any] = {
        f"{field}_{i}": np.asarray(getattr(demonstration, field))
        for i, demonstration in enumerate(demonstrations)
        for field in ("times", "positions", "name")
    }
    np.savez_compressed(path, **arrays)
