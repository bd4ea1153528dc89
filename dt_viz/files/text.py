"""Readers of lines and tables, one line at a time: none takes more memory than the size of its file."""

from __future__ import annotations

import csv
import io
from collections.abc import Collection, Iterator, Sequence

from dt_viz.errors import FormatError
from dt_viz.files.checks import too_many

MAX_LINES = 2_000_000
"""Largest number of lines of a file, empty lines and comments included."""
MAX_LENGTH = 100_000
"""Largest number of characters in a line."""


def numbered_lines(content: bytes, *, errors: str = "strict", max_lines: int = MAX_LINES) -> Iterator[tuple[int, str]]:
    """Yield the lines of a text in UTF-8, each with its number from 1 and without the line break.

    Args:
        content: all bytes of the file.
        errors: treatment of bytes that are no UTF-8, as in `bytes.decode`.
        max_lines: largest number of lines.

    Raises:
        FormatError: it is no text in UTF-8, has more lines than that, or a line is longer than `MAX_LENGTH`.
    """
    if b"\0" in content:
        raise FormatError("file", "a zero byte", "text in UTF-8")
    file = io.TextIOWrapper(io.BytesIO(content), "utf-8-sig", errors)
    number = 0
    while True:
        try:
            line = file.readline(MAX_LENGTH + 2)
        except UnicodeDecodeError as error:
            raise FormatError("file", f"bytes that are no text after line {number}", "text in UTF-8") from error
        if not line:
            return
        number += 1
        if number > max_lines:
            raise too_many("file", max_lines, "lines")
        line = line.rstrip("\n")
        if len(line) > MAX_LENGTH:
            raise too_many(f"line {number}", MAX_LENGTH, "characters")
        yield number, line


def read_table(
    content: bytes, headers: Collection[tuple[str, ...]], *, max_rows: int
) -> tuple[tuple[str, ...], Iterator[tuple[int, list[str]]]]:
    """Read comma-separated text: the header line immediately, the rows during iteration.

    Args:
        content: all bytes of the file, UTF-8.
        headers: accepted headers, each the names of its columns in lower case.
        max_rows: largest number of lines after the header.

    Returns:
        The header of this table; and for each line that is not empty its number and its cells, stripped of blanks, as
        many as the header has.

    Raises:
        FormatError: the header is none of them; during iteration as `numbered_lines`, or if a line has another number
            of cells than the header.
    """
    rows = _rows(numbered_lines(content, max_lines=max_rows + 1))
    _, cells = next(rows, (1, []))
    header = tuple(cell.lower() for cell in cells)
    if header not in headers:
        found = repr(",".join(header)[:80])
        raise FormatError("header line", found, " or ".join(f"'{','.join(names)}'" for names in headers))
    return header, _of_width(rows, len(header))


def _rows(lines: Iterator[tuple[int, str]]) -> Iterator[tuple[int, list[str]]]:
    for number, line in lines:
        try:
            # one line each: no quoted cell goes on in the next
            row = next(csv.reader((line,), strict=True), []) if '"' in line else line.split(",")
        except csv.Error as error:
            raise FormatError(f"line {number}", repr(line[:60]), "comma-separated cells") from error
        cells = [cell.strip() for cell in row]
        if any(cells):
            yield number, cells


def _of_width(rows: Iterator[tuple[int, list[str]]], width: int) -> Iterator[tuple[int, list[str]]]:
    for number, cells in rows:
        if len(cells) != width:
            raise FormatError(f"line {number}", f"{len(cells)} columns", f"{width}, as in the header")
        yield number, cells


def decimal_numbers(cells: Sequence[str], line: int) -> list[float]:
    """Return the numbers in the cells of a line. Raises FormatError if one of them is none."""
    try:
        return [float(cell) for cell in cells]
    except ValueError as error:
        raise FormatError(f"line {line}", repr(",".join(cells)[:60]), "decimal numbers") from error
