"""Checks that the readers of files share; what they refuse they describe by a FormatError."""

from __future__ import annotations

from collections.abc import Callable, Collection
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from dt_viz.errors import FormatError
from dt_viz.numerics import Array, Indices

MAX_FACES = 500_000  # largest number of triangles of a mesh


def read_bytes(path: Path, max_bytes: int) -> bytes:
    """Read a whole file.

    Raises:
        FormatError: there is no such file, or it is larger than `max_bytes`.
        OSError: it cannot be read.
    """
    if not path.is_file():
        raise FormatError("path", "no such file", "a readable file")
    check_size(path.stat().st_size, max_bytes)
    return path.read_bytes()


def checked_suffix(num_bytes: int, source: Path, accepted: Collection[str], max_bytes: int) -> str:
    """Return the suffix of a file's name in lower case.

    Raises:
        FormatError: the suffix is none of the `accepted` ones, or the file is empty or larger than `max_bytes`.
    """
    suffix = source.suffix.lower()
    if suffix not in accepted:
        raise FormatError("suffix", repr(source.suffix) if suffix else "no suffix", ", ".join(accepted))
    check_size(num_bytes, max_bytes)
    if not num_bytes:
        raise FormatError("file", "an empty file", f"a {suffix} file with content")
    return suffix


def check_size(num_bytes: int, max_bytes: int) -> None:
    """Raise FormatError if a file is larger than `max_bytes`."""
    if num_bytes > max_bytes:
        raise FormatError("file", f"{num_bytes / 1e6:.1f} MB", f"at most {max_bytes / 1e6:.0f} MB")


def check_at_most(field: str, num: int, limit: int, unit: str = "") -> None:
    """Raise FormatError if there are more than `limit`."""
    if num > limit:
        raise FormatError(field, f"{num} {unit}".rstrip(), f"at most {limit} {unit}".rstrip())


def check_at_least(field: str, num: int, least: int, unit: str = "") -> None:
    """Raise FormatError if there are fewer than `least`."""
    if num < least:
        raise FormatError(field, f"{num} {unit}".rstrip(), f"at least {least}")


def too_many(field: str, limit: int, unit: str = "") -> FormatError:
    """Return the error about a count that has passed its limit before all was counted."""
    return FormatError(field, f"more than {limit} {unit}".rstrip(), f"at most {limit} {unit}".rstrip())


def real_numbers(values: ArrayLike, field: str, kinds: str = "iuf") -> Array:
    """Return an array of integers or real numbers, `kinds` in numpy's letters, as float64; large ones become infinite.

    Raises:
        FormatError: values of the field are of another type.
    """
    array = np.asarray(values)
    if array.dtype.kind not in kinds:
        raise FormatError(field, f"values of type {array.dtype}", "integers or real numbers")
    with np.errstate(over="ignore", invalid="ignore"):
        return array.astype(np.float64)


def check_finite(values: Array, field: str, place: Callable[[int], str]) -> None:
    """Raise FormatError if one of the values (N, k) is infinite or NaN; `place` describes the place of its row."""
    if not np.isfinite(values).all():
        row, column = np.argwhere(~np.isfinite(values))[0]
        raise FormatError(field, f"{values[row, column]} {place(int(row))}", "finite numbers")


def check_triangles(vertices: Array, faces: Indices) -> None:
    """Raise FormatError unless these are finite vertices (V, 3) and at least one, but not too many, faces (F, 3)."""
    if vertices.ndim != 2 or faces.ndim != 2 or vertices.shape[1] != 3 or faces.shape[1] != 3:
        raise FormatError("mesh", f"shapes {vertices.shape} and {faces.shape}", "vertices (V, 3) and faces (F, 3)")
    if not len(faces):
        raise FormatError("faces", "none", "a closed mesh of triangles; a point cloud is loaded as a cloud")
    check_at_most("faces", len(faces), MAX_FACES)
    if faces.min() < 0 or faces.max() >= len(vertices):
        wrong = faces.min() if faces.min() < 0 else faces.max()
        raise FormatError("faces", f"vertex {wrong}", f"indices of the {len(vertices)} vertices")
    check_finite(vertices, "vertices", lambda row: f"in vertex {row + 1}")
