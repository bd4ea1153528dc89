"""Archives of arrays: what numpy writes is read, and nothing makes them take more room than is allowed."""

import io
import struct
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import array_shapes, arrays

from dt_viz.errors import FormatError
from dt_viz.files.npz import MAX_MEMBERS, MAX_NPY_HEADER, NpzFile

MB = 10**6
NUMBERS = [
    "?",
    *(order + kind for order in "<>" for kind in ("i1", "i2", "i4", "i8", "u1", "u2", "u4", "u8", "f4", "f8")),
]


def archive(*members: tuple[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w", method) as written:
        for name, data in members:
            written.writestr(name, data)
    return file.getvalue()


def npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array)
    return file.getvalue()


def with_header(text: str, data: bytes = b"") -> bytes:
    return archive(("x.npy", b"\x93NUMPY\2\0" + struct.pack("<I", len(text)) + text.encode() + data))


def read(content: bytes, max_bytes: int = MB) -> np.ndarray:
    return NpzFile(content, max_bytes=max_bytes).read("x")


@given(
    st.sampled_from(NUMBERS).flatmap(lambda dtype: arrays(dtype, array_shapes(min_dims=0, min_side=0, max_side=4))),
    st.booleans(),
    st.booleans(),
)
def test_arrays_come_back_as_numpy_wrote_them(array, compressed, fortran):
    file = io.BytesIO()
    (np.savez_compressed if compressed else np.savez)(file, x=np.asfortranarray(array) if fortran else array)
    found = read(file.getvalue())
    assert found.dtype == array.dtype
    np.testing.assert_array_equal(found, array)


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compression_than_numpys_is_refused(method):
    with pytest.raises(FormatError, match="stored or deflated"):
        read(archive(("x.npy", npy(np.zeros(10))), method=method))


def test_an_array_larger_than_is_allowed_is_refused_by_its_header():
    with pytest.raises(FormatError, match="8000000 bytes when unpacked; accepted: at most 1000000 bytes"):
        read(archive(("x.npy", npy(np.zeros(MB)))))


def test_all_arrays_together_are_bounded():
    content = archive(*((f"{name}.npy", npy(np.zeros(60_000))) for name in "xyz"))
    file = NpzFile(content, max_bytes=MB)
    assert [len(file.read(name)) for name in "xy"] == [60_000, 60_000]
    with pytest.raises(FormatError, match="1440000 bytes when unpacked"):
        file.read("z")


def test_no_room_is_made_for_data_that_a_header_only_promises():
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (100000000,), }"
    with pytest.raises(FormatError, match=r"end too early; accepted: 799\d{6} bytes more"):
        read(with_header(header, bytes(1000)), max_bytes=10**9)


def test_data_beyond_its_header_is_not_unpacked():
    with pytest.raises(FormatError, match="more than the 80 bytes of its header"):
        read(archive(("x.npy", npy(np.zeros(10)) + bytes(100 * MB))))


def test_a_directory_that_lies_about_a_size_is_found_out():
    content = archive(("x.npy", npy(np.arange(10.0))))
    place = content.index(b"PK\x01\x02") + 24  # the unpacked size, in the directory
    short = content[:place] + struct.pack("<I", 190) + content[place + 4 :]
    with pytest.raises((FormatError, zipfile.BadZipFile)):
        read(short)
    long = content[:place] + struct.pack("<I", 2**31) + content[place + 4 :]
    np.testing.assert_array_equal(read(long), np.arange(10.0))  # what is counted is what is there


@pytest.mark.parametrize(
    "text",
    [
        "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<c16', 'fortran_order': False, 'shape': (1,), }",
        "{'descr': [('a', '<f8')], 'fortran_order': False, 'shape': (1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (-1,), }",
        "{'descr': '<f8', 'fortran_order': False, 'shape': (1e3,), }",
        "__import__('os').system('true')",
        "(" * 900,
    ],
)
def test_headers_are_compared_with_what_numpy_writes_and_never_evaluated(text):
    with pytest.raises(FormatError, match="never opened"):
        read(with_header(text, bytes(8)))


def test_a_long_header_is_not_even_read():
    with pytest.raises(FormatError, match=f"100000000 bytes of a header; accepted: at most {MAX_NPY_HEADER}"):
        read(with_header("(" * 100 * MB))


def test_impossible_shapes_are_refused():
    with pytest.raises(FormatError, match="33 axes"):
        read(with_header(f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({'1, ' * 33}), }}", bytes(8)))


def test_two_arrays_of_one_name_are_refused():
    with pytest.warns(UserWarning, match="Duplicate"):
        content = archive(("x.npy", npy(np.zeros(1))), ("x.npy", npy(np.ones(1))))
    with pytest.raises(FormatError, match="'x' twice"):
        NpzFile(content, max_bytes=MB)


def test_very_many_members_are_counted_before_the_directory_is_read():
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as written:
        for k in range(MAX_MEMBERS + 1):
            written.writestr(zipfile.ZipInfo(f"{k}"), b"")
    with pytest.raises(FormatError, match=f"more than {MAX_MEMBERS} members"):
        NpzFile(file.getvalue(), max_bytes=MB)


def test_a_flipped_byte_is_noticed_by_the_checksum():
    content = bytearray(archive(("x.npy", npy(np.arange(10.0))), method=zipfile.ZIP_STORED))
    content[content.index(b"PK\x01\x02") - 3] ^= 1
    with pytest.raises(zipfile.BadZipFile, match="CRC"):
        read(bytes(content))
