"""Archives of arrays as numpy writes them, never unpickled."""

from __future__ import annotations

import io
import logging
import os
import threading
import zipfile
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most
from dt_viz.numerics import Array, Indices

logger = logging.getLogger(__name__)
T = TypeVar("T")
MAX_ARRAYS = 10_000  # largest number of arrays of an archive from a visitor


@dataclass(frozen=True, eq=False)
class Archive:
    """Arrays of an archive from a visitor, by their names; see `read_archive`."""

    numbers: Mapping[str, Array]
    integers: Mapping[str, Indices]
    texts: Mapping[str, str]  # texts; arrays of several are left out


def arrays_of(
    content: bytes | Path, *, max_bytes: int, max_arrays: int | None = None, names: Collection[str] | None = None
) -> dict[str, np.ndarray]:
    """Read the arrays of an npz archive, its bytes or its path: some by their names, None reads all.

    Raises:
        FormatError: it unpacks to more than `max_bytes`, or has more than `max_arrays`, as its directory says.
        Exception: of almost any kind, if it is no archive, damaged, or holds pickled objects.
    """
    file = io.BytesIO(content) if isinstance(content, bytes) else content
    with zipfile.ZipFile(file) as archive:
        members = archive.infolist()
    size = sum(member.file_size for member in members)
    if max_arrays is not None:
        check_at_most("arrays", len(members), max_arrays)
    if size > max_bytes:
        raise FormatError("file", f"{size} bytes when unpacked", f"at most {max_bytes} bytes")
    if names is not None and not names:
        return {}
    if isinstance(file, io.BytesIO):
        file.seek(0)
    arrays = {}
    with np.load(file, allow_pickle=False) as archive:
        for name in archive.files if names is None else [name for name in names if name in archive.files]:
            accepted = "numbers or text as numpy writes them; pickled objects are never opened"
            try:
                arrays[name] = archive[name]
            except ValueError as error:
                raise FormatError(f"array {name[:40]!r}", str(error)[:200], accepted) from error
            if not isinstance(arrays[name], np.ndarray):  # numpy gives other members as their bytes
                raise FormatError(f"array {name[:40]!r}", "another member", accepted)
    return arrays


def read_archive(files: Sequence[tuple[str, bytes]], max_bytes: int, max_text: int) -> Archive:
    """Read the arrays of one archive, its name and its content, in the process of `dt_viz.files.reading`.

    Raises:
        FormatError: it unpacks to more than `max_bytes`, a text has more than `max_text` characters, or there are other
            values than float64, int64 and text.
        Exception: as `arrays_of`.
    """
    ((_name, content),) = files
    arrays = arrays_of(content, max_bytes=max_bytes, max_arrays=MAX_ARRAYS)
    texts = {name: str(array) for name, array in arrays.items() if array.dtype.kind == "U" and not array.ndim}
    for name, text in texts.items():
        check_at_most(f"array {name[:40]!r}", len(text), max_text, "characters")
    check_types(arrays)
    numbers, integers = (
        {name: array for name, array in arrays.items() if array.dtype == kind} for kind in (np.float64, np.int64)
    )
    return Archive(numbers, integers, texts)


def check_types(arrays: Mapping[str, np.ndarray]) -> None:
    """Raise FormatError where an array has smaller numbers, which would grow eightfold when they are used."""
    for name, array in arrays.items():
        if array.dtype not in (np.float64, np.int64) and array.dtype.kind != "U":
            raise FormatError(f"array {name[:40]!r}", f"values of type {array.dtype}", "float64, int64 or text")


def npz_bytes(arrays: Mapping[str, Any]) -> bytes:
    """Return an archive of arrays of numbers or text."""
    file = io.BytesIO()
    np.savez_compressed(file, **arrays)
    return file.getvalue()


def write_whole(path: Path, content: bytes) -> None:
    """Write a file beside its place and move it there when it is whole, so that nobody ever finds half of it.

    Raises:
        OSError: it cannot be written; nothing is left behind, and a file that was there before stays.
    """
    partial = path.with_name(f"{path.name}.{os.getpid()}-{threading.get_ident()}.partial")
    try:
        partial.write_bytes(content)
        partial.replace(path)
    finally:
        with suppress(OSError):  # it has been moved
            partial.unlink()


def write_cached(path: Path, arrays: Mapping[str, Any]) -> None:
    """Store arrays in a cache; a folder that cannot be written to is only logged."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, npz_bytes(arrays))
    except OSError as error:
        logger.warning("%s was not cached: %s", path, error)


def read_cached(path: Path, make: Callable[[dict[str, np.ndarray]], T], max_bytes: int) -> T | None:
    """Make something of arrays from a cache; None where there are none, or, which is logged, they are damaged."""
    if not path.exists():
        return None
    try:
        return make(arrays_of(path.read_bytes(), max_bytes=max_bytes))
    except Exception as error:  # damaged bytes make zipfile and zlib raise almost anything
        logger.warning("%s is damaged and will be made anew: %s", path, error)
        return None
