"""Reader of npz archives that never takes more memory than the caller allows, and a writer.

`numpy.load` believes what an archive says of itself, unpacks members that need gigabytes for a few bytes (bzip2, LZMA)
and evaluates their headers. This reader takes only stored or deflated members, counts their bytes while it unpacks
them, and compares their headers with what numpy writes. Nothing is ever unpickled.
"""

from __future__ import annotations

import io
import math
import os
import re
import threading
import zipfile
from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import IO, Any

import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, too_many

MAX_MEMBERS = 10_000
"""Largest number of members of an archive."""
MAX_NPY_HEADER = 1000
"""Largest number of bytes in the header of a member; numpy writes some 120."""
MAX_AXES = 8
CHUNK = 2**18
"""Number of bytes that are unpacked in one step."""
DIRECTORY_ENTRY = b"PK\x01\x02"
ENCRYPTED = 0x1
"""Flag of an encrypted member."""
NPY_HEADER = re.compile(
    r"\{'descr': '([<>|]?)([biuf][1248]|U\d{1,6})', 'fortran_order': (True|False), 'shape': \(([\d, ]*)\),? *\} *\n?"
)
"""Pattern of the header of plain numbers or text, as numpy and others write it."""
REAL_NUMBERS = {"b1", "i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f2", "f4", "f8"}
"""Types of real numbers in numpy's notation, without their byte order."""


class NpzFile:
    """The arrays of an archive; each is unpacked when it is read."""

    def __init__(self, content: bytes, *, max_bytes: int) -> None:
        """Read the directory of the archive.

        Args:
            content: all bytes of the file.
            max_bytes: largest number of bytes that the arrays read may unpack to, all together.

        Raises:
            FormatError: it has too many members, or two of one name.
            Exception: of almost any kind, as `zipfile.ZipFile`, if it is no archive or damaged.
        """
        if content.count(DIRECTORY_ENTRY) > MAX_MEMBERS:  # before the directory is read
            raise too_many("file", MAX_MEMBERS, "members")
        self._archive = zipfile.ZipFile(io.BytesIO(content))
        self._members: dict[str, zipfile.ZipInfo] = {}
        for member in self._archive.infolist():
            name = member.filename.removesuffix(".npy")
            if name in self._members:
                raise FormatError("arrays", f"{name[:40]!r} twice", "arrays of different names")
            self._members[name] = member
        self._max_bytes = self._left = max_bytes

    @property
    def names(self) -> Collection[str]:
        """Names of the arrays, in the order of the file."""
        return self._members.keys()

    def read(self, name: str) -> np.ndarray:
        """Unpack an array of real numbers or of text (boolean, integer, floating point or Unicode).

        Raises:
            FormatError: it is packed in another way, too large, or holds anything else.
            Exception: of almost any kind, as `zipfile.ZipFile.open`, if it is damaged.
        """
        field, member = f"array {name[:40]!r}", self._members[name]
        if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED) or member.flag_bits & ENCRYPTED:
            method = "an encrypted member" if member.flag_bits & ENCRYPTED else f"method {member.compress_type}"
            raise FormatError(field, f"{method} of compression", "stored or deflated members, as numpy writes them")
        with self._archive.open(member) as file:
            return self._array(_Bytes(file, field), field)

    def _array(self, file: _Bytes, field: str) -> np.ndarray:
        kind, order, fortran, shape = _npy_header(file, field)
        if kind not in REAL_NUMBERS and not kind.startswith("U"):
            raise FormatError(field, f"values of type {kind}", "integers or real numbers")
        dtype = np.dtype(order + kind)
        size = math.prod(shape) * dtype.itemsize
        if size > self._left:
            found = f"{self._max_bytes - self._left + size} bytes when unpacked"
            raise FormatError("file", found, f"at most {self._max_bytes} bytes")
        self._left -= size
        data = file.take(size)
        if file.take(1, or_less=True):  # at the end of the member zipfile compares its checksum
            raise FormatError(field, f"more than the {size} bytes of its header", "an array as numpy writes it")
        return np.frombuffer(data, dtype).reshape(shape, order="F" if fortran else "C")


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


class _Bytes:
    """Reads the bytes of a member while it is unpacked."""

    def __init__(self, file: IO[bytes], field: str) -> None:
        self._file = file
        self._field = field

    def take(self, size: int, *, or_less: bool = False) -> bytes:
        """Return the next `size` bytes; memory is taken for those that are there only."""
        data = bytearray()
        while len(data) < size:
            chunk = self._file.read(min(size - len(data), CHUNK))
            if not chunk:
                break
            data += chunk
        if len(data) < size and not or_less:
            raise FormatError(self._field, "data that end too early", f"{size - len(data)} bytes more")
        return bytes(data)


def _npy_header(file: _Bytes, field: str) -> tuple[str, str, bool, tuple[int, ...]]:
    """Return the type of numbers, the byte order, whether the first axis is the fastest, and the shape."""
    start = file.take(8)
    if start[:6] != b"\x93NUMPY" or start[6] not in (1, 2, 3):
        raise FormatError(field, f"{start[:8]!r}", "an array as numpy writes it")
    length = int.from_bytes(file.take(2 if start[6] == 1 else 4), "little")
    check_at_most(field, length, MAX_NPY_HEADER, "bytes of a header")
    text = file.take(length).decode("latin-1")
    match = NPY_HEADER.fullmatch(text)
    if match is None:
        accepted = "an array of integers or real numbers, as numpy writes it; pickled objects are never opened"
        raise FormatError(field, f"the header {text.strip()[:80]!r}", accepted)
    order, kind, fortran, axes = match.groups()
    shape = tuple(int(axis) for axis in axes.replace(" ", "").split(",") if axis)
    check_at_most(field, len(shape), MAX_AXES, "axes")
    return kind, order, fortran == "True", shape
