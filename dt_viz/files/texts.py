"""JSON texts with arrays, read in bounded memory whatever they hold.

A text is one object. Its field `arrays` has for each array, by its name, `shape`, `type` ("float64" or "int64") and
`data`, its bytes in C order, little endian, in base64: so it is read back to the last bit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, Literal

import msgspec
import numpy as np

from dt_viz.errors import FormatError
from dt_viz.files.checks import check_at_most, check_size

MAX_DIMENSIONS, MAX_ARRAYS = 2, 5000  # largest number of axes of an array, and of arrays


class _Array(msgspec.Struct, forbid_unknown_fields=True):
    shape: tuple[int, ...]
    type: Literal["float64", "int64"]
    data: bytes


def encoded(plain: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return the text of what JSON can hold, numbers of numpy too, and of arrays of float64 and int64."""
    held = {
        name: _Array(array.shape, array.dtype.name, array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())
        for name, array in arrays.items()
    }
    whole = {**plain, "arrays": held} if held else plain
    return msgspec.json.encode(whole, enc_hook=lambda number: number.item())


def decoded(
    content: bytes, fields: tuple[str, ...], *, max_bytes: int, max_plain: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Read what `encoded` wrote.

    Args:
        content: the text.
        fields: names of all fields that it may have, beside `arrays`.
        max_bytes: largest number of bytes of the text.
        max_plain: largest number of bytes of all but its arrays, whose values may need fifty times as much memory.

    Raises:
        FormatError: it is larger, has another field, or arrays that are none.
        Exception: of almost any kind, if it is no such text.
    """
    check_size(len(content), max_bytes)
    raw = [(name, msgspec.Raw, msgspec.Raw()) for name in (*fields, "arrays")]
    try:
        whole = msgspec.json.decode(content, type=msgspec.defstruct("Text", raw, forbid_unknown_fields=True))
    except msgspec.ValidationError as error:
        raise FormatError("fields", str(error), ", ".join((*fields, "arrays"))) from error
    parts = {name: bytes(part) for name, part in msgspec.structs.asdict(whole).items() if bytes(part)}
    arrays = parts.pop("arrays", b"{}")
    check_at_most("text", sum(map(len, parts.values())), max_plain, "bytes beside its arrays")
    plain = {name: msgspec.json.decode(part) for name, part in parts.items()}
    held = msgspec.json.decode(arrays, type=dict[str, msgspec.Raw])
    check_at_most("arrays", len(held), MAX_ARRAYS)
    return plain, {name: _array(name, array) for name, array in held.items()}


def _array(name: str, raw: msgspec.Raw) -> np.ndarray:
    held = msgspec.json.decode(raw, type=_Array)
    if (
        len(held.shape) > MAX_DIMENSIONS
        or min(held.shape, default=0) < 0
        or math.prod(held.shape) * 8 != len(held.data)
    ):
        found = f"shape {str(held.shape[:20])[:40]} for {len(held.data)} bytes"
        raise FormatError(f"array {name[:80]!r}", found, "a shape of one or two axes, and 8 bytes for each value")
    values = np.frombuffer(held.data, np.dtype(held.type).newbyteorder("<"))
    return values.astype(held.type, copy=False).reshape(held.shape)
