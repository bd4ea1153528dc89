"""Weights of trained methods: files that say which method, version and demonstrations they belong to."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path

import numpy as np

from dt_viz.baselines.base import NotFittedError
from dt_viz.errors import DataError, FormatError, parsing
from dt_viz.files.npz import npz_bytes, write_whole
from dt_viz.flows.fields import Array
from dt_viz.learning.store import fingerprint
from dt_viz.scenario.tasks import Task
from dt_viz.shipped import ASSETS

FOLDER = ASSETS / "baselines"
"""Folder of the weights that ship with DT-Viz."""
HALF_FROM = 100
"""Number of numbers from which on an array is stored in half precision; single goals and scales need more digits."""
MADE_BY = "python -m dt_viz.evaluate train"
"""Command that makes the weights."""


class WeightsError(DataError):
    """A file of weights that cannot be read."""


def save_weights(path: Path, method: str, version: int, task: Task, arrays: Mapping[str, Array]) -> None:
    """Write the weights of a method for a task, floats in single precision, large arrays of them in half.

    Numbers are finite, and no array's name begins with an underscore; `weights_file` names the path that is read again.
    Raises OSError where the file cannot be written.
    """
    stored = {
        name: array.astype(np.float32 if array.size < HALF_FROM else np.float16) if array.dtype.kind == "f" else array
        for name, array in arrays.items()
    }
    write_whole(path, npz_bytes({**_stamp(method, version, task), **stored}))


def load_weights(method: str, version: int, task: Task, folder: Path = FOLDER) -> dict[str, Array]:
    """Read the weights of a method for a task, floats in double precision.

    Raises:
        NotFittedError: there are none, the file is damaged, or it is of another method, version or task.
    """
    path = weights_file(folder, method, task)
    accepted = f"weights as {MADE_BY!r} writes them"
    if not path.is_file():
        text = f"{method} has not been trained for {task.title!r}; {MADE_BY} --method {method} --task {task.name}"
        raise NotFittedError(text)
    try:
        with parsing(WeightsError, path, "file", accepted):
            with np.load(BytesIO(path.read_bytes()), allow_pickle=False) as archive:
                arrays = dict(archive)
            for field, wanted in _stamp(method, version, task).items():
                found = arrays.pop(field).item()
                if found != wanted:
                    raise FormatError(field[1:], repr(found)[:80], repr(wanted))
            for name, array in arrays.items():
                if array.dtype.kind not in "fiub" or not np.isfinite(array).all():
                    raise FormatError(f"array {name!r}", "text, or numbers that are not finite", "finite numbers")
    except WeightsError as error:
        raise NotFittedError(str(error)) from error
    return {name: array.astype(float) if array.dtype.kind == "f" else array for name, array in arrays.items()}


def weights_file(folder: Path, method: str, task: Task) -> Path:
    """The file of a method's weights for a task."""
    return folder / f"{method}_{task.name}.npz"


def _stamp(method: str, version: int, task: Task) -> dict[str, str | int]:
    """What a file says about itself: method, version, and a digest of the task's demonstrations."""
    return {"_method": method, "_version": version, "_demonstrations": fingerprint(task.demonstrations, "weights")}
