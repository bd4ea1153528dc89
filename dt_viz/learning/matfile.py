"""Reader of one variable in a MATLAB v5 to v7 file: numbers, cells and structures, all that a demonstration needs.

On some damaged files scipy's ``loadmat`` crashes the whole process, which a server that takes uploads cannot afford.
This reader is plain Python and returns a value or raises, in bounded memory, whatever the bytes.
The layout is that of the "MAT-File Level 5 File Format" (The MathWorks).
"""

import itertools
import math
import struct
import zlib
from collections.abc import Iterator
from typing import TypeAlias, Union

import numpy as np

# Numbers are an array. A cell array is the list of its values, a structure array the list of its structures, both in
# column-major order. What a demonstration does not need (text, sparse or complex numbers, objects) is None.
Value: TypeAlias = Union[np.ndarray, "list[Value]", "dict[str, Value]", None]

MAX_UNPACKED_BYTES = 16 * 2**20
MAX_VARIABLES = 1000  # number of variables before and including the one that is read
MAX_VALUES = 100_000  # number of nested matrices, cells and structures in the variable
MAX_DEPTH = 8  # depth of nested cells and structures
MAX_AXES = 32
MAX_FIELDS = 1000  # number of fields of a structure
HEADER_BYTES = 128
BYTE_ORDERS = {b"\x00\x01IM": "<", b"\x01\x00MI": ">"}  # byte order by the last four bytes of the header
MATRIX, COMPRESSED = 14, 15  # types of elements; the others are numbers:
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
CELL, STRUCTURE, NUMERIC = 1, 2, range(6, 16)  # classes of matrices
COMPLEX = 0x800  # flag of complex matrices


class MatFileError(ValueError):
    """Bytes that are no MATLAB v5 to v7 file, or a damaged one."""


def read_variable(content: bytes, name: str) -> Value:
    """Return the value of a variable.

    Args:
        content: all bytes of the file.
        name: name of the variable.

    Raises:
        MatFileError: the bytes are no MATLAB v5 to v7 file (7.3 is another format), or damaged.
        KeyError: the file has no such variable.
    """
    order = BYTE_ORDERS.get(content[HEADER_BYTES - 4 : HEADER_BYTES])
    if order is None:
        raise MatFileError("no header of MATLAB version 5 to 7")
    for matrix in _variables(content, order):
        kind, shape, found = matrix.header()
        if found == name:
            return matrix.value(kind, shape, MAX_DEPTH)
    raise KeyError(name)


def _variables(content: bytes, order: str) -> Iterator["_Elements"]:
    """Yield the content of each variable, unpacked."""
    left = MAX_UNPACKED_BYTES
    elements = _Elements(memoryview(content)[HEADER_BYTES:], order)
    for num in itertools.count(1):
        if not elements.data:
            return
        if num > MAX_VARIABLES:
            raise MatFileError(f"more than {MAX_VARIABLES} variables")
        kind, data = elements.take()
        if kind == COMPRESSED:
            try:
                plain = zlib.decompressobj().decompress(data, left + 1)
            except zlib.error as error:
                raise MatFileError("damaged compressed data") from error
            left -= len(plain)
            if left < 0:
                raise MatFileError(f"more than {MAX_UNPACKED_BYTES} bytes when unpacked")
            kind, data = _Elements(memoryview(plain), order).take()
        if kind != MATRIX:
            raise MatFileError(f"an element of type {kind} where a variable should be")
        yield _Elements(data, order, iter(range(MAX_VALUES)))


class _Elements:
    """Successive elements, each a type, a number of bytes and the bytes, padded to a multiple of 8.

    Attributes:
        data: the bytes that have not been taken yet.
    """

    def __init__(self, data: memoryview, order: str, tickets: Iterator[int] | None = None) -> None:
        self.data = data
        self._order = order  # byte order of numbers, as struct and numpy write it
        self._tickets = tickets or iter(())  # one for each value that may still be made

    def take(self) -> tuple[int, memoryview]:
        """Take the next element's type and bytes."""
        if len(self.data) < 8:
            raise MatFileError("it ends too early")
        kind, size = struct.unpack(f"{self._order}II", self.data[:8])
        start = 8
        if kind >> 16:  # up to four bytes are stored in the tag itself
            kind, size, start = kind & 0xFFFF, kind >> 16, 4
        end = start + size
        if end > (8 if start == 4 else len(self.data)):
            raise MatFileError("it ends too early")
        taken = self.data[start:end]
        self.data = self.data[end if kind == COMPRESSED else end + -end % 8 :]
        return kind, taken

    def numbers(self) -> np.ndarray:
        """Take an element of numbers, shape ``(N,)``."""
        kind, data = self.take()
        if kind not in NUMBERS:
            raise MatFileError(f"an element of type {kind} where numbers should be")
        dtype = np.dtype(self._order + NUMBERS[kind])
        if len(data) % dtype.itemsize:
            raise MatFileError("numbers of broken length")
        return np.frombuffer(data, dtype)

    def integers(self) -> list[int]:
        """Take an element of a few whole numbers."""
        numbers = self.numbers()
        if numbers.dtype.kind == "f" or len(numbers) > MAX_AXES:
            raise MatFileError("not the few whole numbers that should be there")
        return numbers.tolist()

    def header(self) -> tuple[int, tuple[int, ...], str]:
        """Take the head of a matrix: its class (0 for one that is not read), its shape and its name."""
        if not self.data:
            return NUMERIC[0], (0, 0), ""  # an empty matrix may have no elements at all
        flags, shape = self.integers(), tuple(self.integers())
        if not flags or not shape or min(shape) < 0:
            raise MatFileError("a matrix without class or shape")
        name = self.numbers().tobytes().decode("latin-1")
        return 0 if flags[0] & COMPLEX else flags[0] & 0xFF, shape, name

    def value(self, kind: int, shape: tuple[int, ...], depth: int) -> Value:
        """Take the rest of a matrix after its header; it may nest ``depth`` more levels."""
        count = math.prod(shape)
        if kind in NUMERIC:
            numbers = self.numbers() if self.data or count else np.empty(0)
            if len(numbers) != count:
                raise MatFileError(f"{len(numbers)} numbers for a matrix of {count}")
            try:
                return numbers.reshape(shape, order="F")
            except ValueError as error:  # axes that numpy cannot have beside an empty one
                raise MatFileError("a matrix of impossible shape") from error
        if kind not in (CELL, STRUCTURE):
            return None
        if depth == 0:
            raise MatFileError(f"more than {MAX_DEPTH} levels of cells and structures")
        names = self._field_names() if kind == STRUCTURE else [""]
        if count * len(names) > len(self.data) // 8:  # each of them takes at least 8 bytes
            raise MatFileError("it ends too early")
        if kind == CELL:
            return [self._matrix(depth - 1) for _ in range(count)]
        return [{name: self._matrix(depth - 1) for name in names} for _ in range(count if names else 0)]

    def _matrix(self, depth: int) -> Value:
        if next(self._tickets, None) is None:
            raise MatFileError(f"more than {MAX_VALUES} values")
        kind, data = self.take()
        if kind != MATRIX:
            raise MatFileError(f"an element of type {kind} where a matrix should be")
        inside = _Elements(data, self._order, self._tickets)
        kind, shape, _ = inside.header()
        return inside.value(kind, shape, depth)

    def _field_names(self) -> list[str]:
        size, text = self.integers(), self.numbers().tobytes()
        if len(size) != 1 or size[0] < 1 or len(text) > size[0] * MAX_FIELDS:
            raise MatFileError(f"a structure without names of fields, or with more than {MAX_FIELDS}")
        return [text[i : i + size[0]].split(b"\0")[0].decode("latin-1") for i in range(0, len(text), size[0])]
