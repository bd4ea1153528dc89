"""Lines and tables: read one at a time, and refused at the first that is wrong."""

import pytest

from dt_viz.errors import FormatError
from dt_viz.files.text import MAX_LENGTH, numbered_lines, read_table

HEADERS = (("x", "y"), ("name", "x", "y"))


def rows(content: bytes, max_rows: int = 100) -> list[tuple[int, list[str]]]:
    return list(read_table(content, HEADERS, max_rows=max_rows)[1])


@pytest.mark.parametrize("end", [b"\n", b"\r\n", b"\r"])
def test_lines_are_numbered_however_they_end(end):
    content = b"\xef\xbb\xbf" + end.join([b"a", b"", b"b"]) + end
    assert list(numbered_lines(content)) == [(1, "a"), (2, ""), (3, "b")]


def test_cells_are_stripped_and_empty_lines_left_out():
    assert rows(b"\n X , Y \n 1,2 \n\n,\n3,4\n") == [(3, ["1", "2"]), (6, ["3", "4"])]


def test_quoted_cells_may_hold_commas_but_do_not_go_on_in_the_next_line():
    assert rows(b'name,x,y\n"a, b",1,2\n') == [(2, ["a, b", "1", "2"])]
    with pytest.raises(FormatError, match="line 2"):
        rows(b'name,x,y\n"a\nb",1,2\n')


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"a,b\n" + b"1,2\n" * 5000 + b"\xff", "'a,b'"),  # the rest is not looked at
        (b"x,y\n1\n", "line 2: found 1 columns; accepted: 2"),
        (b"x,y\n1,2\n\0\n", "a zero byte"),
        ("x,y\n1,2\n".encode("utf-16-le"), "a zero byte"),
        (b"x,y\n1,\xff\n", "no text"),
        (b"x,y\n" + b"1" * (MAX_LENGTH + 1) + b",2\n", "line 2: found more than 100000 characters"),
        (b"," * 20_000_000, "line 1: found more than 100000 characters"),
        (b"x,y\n" + b"1,2\n" * 101, "more than 101 lines"),
        (b"\n" * 1000, "more than 101 lines"),
        (b"", "header line: found ''"),
    ],
)
def test_what_is_wrong_is_named(content, words):
    with pytest.raises(FormatError, match=words):
        rows(content)


def test_rows_are_read_when_they_are_asked_for():
    _, table = read_table(b"x,y\n1,2\n1\n", HEADERS, max_rows=9)
    assert next(table) == (2, ["1", "2"])
    with pytest.raises(FormatError, match="line 3"):
        next(table)
