"""Errors about data that cannot be used, and the end of computations that nobody wants any more."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np

Cancelled = Callable[[], bool]  # returns whether the result is not wanted any more


class UnwantedError(Exception):
    """Nobody wants any more what was being computed."""


def never() -> bool:
    """Say that what is being computed is wanted."""
    return False


def end_if(cancelled: Cancelled) -> None:
    """End a computation between two of its parts: raise UnwantedError if it is cancelled."""
    if cancelled():
        raise UnwantedError


class DataError(ValueError):
    """Data from outside that cannot be used.

    Attributes:
        source: the file, folder or recording.
        field: the part of it that is wrong.
        found: what is there.
        accepted: what would be right.
    """

    def __init__(self, source: str | Path, field: str, found: str, accepted: str) -> None:
        super().__init__(source, field, found, accepted)
        self.source, self.field, self.found, self.accepted = str(source), field, found, accepted

    def __str__(self) -> str:
        return f"{self.source}: {self.field}: found {self.found}; accepted: {self.accepted}"


class FormatError(ValueError):
    """Data that are not in the expected format; `naming` and `parsing` add their source.

    Attributes:
        field: the part of them that is wrong.
        found: what is there.
        accepted: what would be right.
    """

    def __init__(self, field: str, found: str, accepted: str) -> None:
        super().__init__(field, found, accepted)
        self.field, self.found, self.accepted = field, found, accepted

    def __str__(self) -> str:
        return f"{self.field}: found {self.found}; accepted: {self.accepted}"


class UnclearError(FormatError):
    """Data of which something has to be asked, such as which columns are places.

    Attributes:
        question: "columns" (which of the choices are t, x, y, z), "reading" or "topic" (one of the choices).
        choices: what may be answered.
    """

    def __init__(self, field: str, found: str, accepted: str, question: str, choices: Sequence[str]) -> None:
        super().__init__(field, found, accepted)
        self.question, self.choices = question, tuple(choices)


def check_between(field: str, value: float, low: float, high: float) -> None:
    """Raise FormatError unless a number lies between two others, these included; NaN does not."""
    if not low <= value <= high:
        raise FormatError(field, f"{value:g}", f"{low:g} to {high:g}")


@contextmanager
def naming(kind: type[DataError], source: str | Path) -> Iterator[None]:
    """Turn a FormatError into an error of one kind that names the source, too."""
    try:
        yield
    except FormatError as error:
        raise kind(source, error.field, error.found, error.accepted) from error


@contextmanager
def parsing(kind: type[DataError], source: str | Path, field: str, accepted: str) -> Iterator[None]:
    """Turn whatever a reader raises on hostile bytes into one kind of error.

    Args:
        kind: of the error.
        source: the file.
        field: the part of it that is read, unless a FormatError says better.
        accepted: what it should be, unless a FormatError says better.

    Raises:
        DataError: of that kind.
    """
    try:
        with (
            np.errstate(all="ignore"),
            naming(kind, source),
        ):  # what overflows is refused as not finite, or as too large
            yield
    except (DataError, UnwantedError):
        raise
    except Exception as error:  # no reader lists what corrupt bytes make it raise
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise kind(source, field, f"something that cannot be read ({reason})", accepted) from error
