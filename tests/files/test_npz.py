"""Archives of arrays: numpy's, within a limit, and never unpickled."""

import io
import zipfile

import numpy as np
import pytest

from dt_viz.errors import FormatError
from dt_viz.files.npz import arrays_of, npz_bytes

ARRAYS = {"numbers": np.arange(6.0).reshape(2, 3), "text": np.array("Größe"), "whole": np.arange(3)}


def test_arrays_come_back():
    found = arrays_of(npz_bytes(ARRAYS), max_bytes=10**4)
    assert list(found) == list(ARRAYS)
    for name, array in ARRAYS.items():
        np.testing.assert_array_equal(found[name], array)
    assert list(arrays_of(npz_bytes(ARRAYS), max_bytes=10**4, names=("text", "other"))) == ["text"]


def test_what_unpacks_to_more_is_not_unpacked():
    with pytest.raises(FormatError, match="8000128 bytes when unpacked; accepted: at most 1000000 bytes"):
        arrays_of(npz_bytes({"zeros": np.zeros(10**6)}), max_bytes=10**6)


def test_pickled_objects_and_other_members_are_refused():
    with pytest.raises(FormatError, match=r"array 'x'.*never opened"):
        arrays_of(npz_bytes({"x": np.array([{}], object)}), max_bytes=10**6)
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("notes.txt", "ours")
    with pytest.raises(FormatError, match="another member"):
        arrays_of(file.getvalue(), max_bytes=10**6)
