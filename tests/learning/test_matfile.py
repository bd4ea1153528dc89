"""The MATLAB reader against what scipy writes and reads."""

import io
import struct
import zlib
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
import scipy.io
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from dt_viz.learning.matfile import MAX_UNPACKED_BYTES, MatFileError, read_variable

NUMBERS = [np.float64, np.float32, np.int8, np.uint8, np.int16, np.uint16, np.int32, np.uint32, np.int64, np.uint64]


def written(compressed=False, **variables):
    file = io.BytesIO()
    scipy.io.savemat(file, variables, do_compression=compressed)
    return file.getvalue()


def nested(levels):
    value = np.eye(2)
    for _ in range(levels):
        cell = np.empty((1, 1), dtype=object)
        cell[0, 0] = value
        value = cell
    return value


@given(
    st.sampled_from(NUMBERS).flatmap(lambda dtype: arrays(dtype, array_shapes(min_dims=2, min_side=0, max_side=4))),
    st.booleans(),
)
def test_numbers_come_back_as_they_were_written(array, compressed):
    value = read_variable(written(compressed, before=1.0, x=array), "x")
    assert isinstance(value, np.ndarray)
    np.testing.assert_array_equal(value, array)


def test_structures_and_cells_become_dictionaries_and_lists():
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = {"t": np.eye(2), "label": "left"}, np.zeros((0, 0))
    value: Any = read_variable(written(x=cells), "x")
    first, second = value
    np.testing.assert_array_equal(first[0]["t"], np.eye(2))
    assert first[0]["label"] is None
    assert second.shape == (0, 0)


def test_structure_arrays_become_one_dictionary_each():
    structures = np.array([(1.0,), (2.0,)], dtype=[("t", object)])
    value: Any = read_variable(written(x=structures), "x")
    assert [structure["t"].item() for structure in value] == [1.0, 2.0]


def big_endian(shape, numbers):
    """Return a file with a matrix x of doubles, in the byte order that scipy does not write."""

    def element(kind, data):
        return struct.pack(">II", kind, len(data)) + data + bytes(-len(data) % 8)

    sizes, values = struct.pack(f">{len(shape)}i", *shape), struct.pack(f">{len(numbers)}d", *numbers)
    parts = [element(6, struct.pack(">II", 6, 0)), element(5, sizes), element(1, b"x"), element(9, values)]
    return bytes(124) + b"\x01\x00MI" + element(14, b"".join(parts))


def test_the_other_byte_order_is_read():
    np.testing.assert_array_equal(read_variable(big_endian((1, 2), (1.5, -2.0)), "x"), [[1.5, -2.0]])


@pytest.mark.parametrize(("shape", "numbers"), [((1,) * 99, [1]), ((2**31 - 1,) * 5 + (0,), []), ((-1, -1), [1])])
def test_impossible_shapes_are_refused(shape, numbers):
    with pytest.raises(MatFileError, match=r"shape|few"):
        read_variable(big_endian(shape, numbers), "x")


@pytest.mark.parametrize("value", ["text", 1j * np.eye(2), scipy.sparse.eye_array(3).tocsc()])
def test_what_is_not_read_is_none(value):
    assert read_variable(written(x=value), "x") is None


def test_a_missing_variable_is_named():
    with pytest.raises(KeyError, match="demos"):
        read_variable(written(x=1.0), "demos")


@pytest.mark.parametrize("content", [b"", b"MATLAB", bytes(200), written(x=np.eye(9))[:-1], written(True, x=1.0)[:-1]])
def test_other_and_truncated_files_are_refused(content):
    with pytest.raises(MatFileError):
        read_variable(content, "x")


def test_more_than_the_limit_is_not_unpacked():
    packed = zlib.compress(bytes(MAX_UNPACKED_BYTES + 1))
    content = bytes(124) + b"\x00\x01IM" + struct.pack("<II", 15, len(packed)) + packed
    with pytest.raises(MatFileError, match="when unpacked"):
        read_variable(content, "x")


def test_depth_is_limited():
    assert read_variable(written(x=nested(8)), "x")
    with pytest.raises(MatFileError, match="levels"):
        read_variable(written(x=nested(9)), "x")


@given(data=st.data(), compressed=st.booleans())
@settings(max_examples=300)
def test_damaged_files_are_refused_or_read(data, compressed):
    cells = np.empty((1, 2), dtype=object)
    cells[0, 0], cells[0, 1] = {"t": np.eye(2), "pos": np.ones((1, 3), dtype=np.uint8)}, "text"
    content = bytearray(written(x=cells)[128:])
    for place in data.draw(st.lists(st.integers(0, len(content) - 1), max_size=6)):
        content[place] = data.draw(st.sampled_from([0, 1, 2, 14, 15, 127, 255]))
    if compressed:
        packed = zlib.compress(content)
        content = struct.pack("<II", 15, len(packed)) + packed
    with suppress(MatFileError, KeyError):
        read_variable(bytes(124) + b"\x00\x01IM" + bytes(content), "x")
