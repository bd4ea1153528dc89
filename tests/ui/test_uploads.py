"""What a visitor may send as a file, counted before it is held."""

import pytest

from dt_viz.errors import DataError
from dt_viz.ui.transfers import MalformedError, Upload


@pytest.fixture
def upload():
    return Upload(1000)


def test_a_file_arrives_in_parts_in_any_order_and_nothing_else_is_wanted(upload):
    assert not upload.part("a", 0, 1)
    upload.start("a", "x.ply", 1000, 3)
    assert [upload.part("a", index, size) for index, size in ((2, 200), (0, 400), (1, 400))] == [True] * 3
    assert not upload.part("a", 1, 400)  # it is complete
    upload.start("a", "x.ply", 0, 0)
    assert not upload.part("a", 0, 0)


def test_a_file_that_is_announced_too_large_is_refused_and_nothing_of_it_is_wanted(upload):
    with pytest.raises(DataError, match=r"x\.ply: file: found 0\.0 MB; accepted: at most 0 MB"):
        upload.start("a", "x.ply", 1001, 1)
    assert not upload.part("a", 0, 1)


def test_a_new_file_takes_the_place_of_one_that_was_given_up(upload):
    upload.start("a", "x.ply", 1000, 2)
    assert upload.part("a", 0, 500)
    upload.start("b", "y.ply", 10, 1)
    assert not upload.part("a", 1, 500)
    assert upload.part("b", 0, 10)


@pytest.mark.parametrize(
    "parts", [[(0, 600), (1, 600)], [(0, 400), (1, 400)], [(0, 500), (0, 500)], [(2, 1)], [(-1, 1)]]
)
def test_parts_that_do_not_add_up_to_what_was_announced_come_from_no_page(upload, parts):
    upload.start("a", "x.ply", 1000, 2)
    with pytest.raises(MalformedError):
        for index, size in parts:
            upload.part("a", index, size)


@pytest.mark.parametrize(
    ("num_bytes", "num_parts"),
    [(-1, 1), (10, 0), (10, -1), (10, 11), (0, 1), (1000, 1001), (Upload.max_parts + 1, Upload.max_parts + 1)],
)
def test_numbers_of_parts_that_no_file_has_come_from_no_page(num_bytes, num_parts):
    with pytest.raises(MalformedError):
        Upload(10**6).start("a", "x.ply", num_bytes, num_parts)
