"""What is said of data that cannot be used."""

from __future__ import annotations

from pathlib import Path


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
