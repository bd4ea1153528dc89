"""Limits of uploads: one file at a time, no larger than announced, and announced no larger than allowed."""

from __future__ import annotations

from dataclasses import dataclass, field

from dt_viz.errors import DataError, naming
from dt_viz.files.checks import check_size

MAX_PARTS = 1024
"""Largest number of parts of a file; the page sends parts of half a megabyte."""


class MalformedError(ValueError):
    """A message that the page never sends."""


@dataclass
class _Transfer:
    uuid: str
    num_bytes: int
    num_parts: int
    arrived: set[int] = field(default_factory=set)
    num_arrived: int = 0


class Upload:
    """The file that one visitor is sending, counted before any of it is held."""

    def __init__(self, max_bytes: int) -> None:
        """Wait for a file of at most `max_bytes` bytes."""
        self._max_bytes = max_bytes
        self._transfer: _Transfer | None = None

    def start(self, uuid: str, name: str, num_bytes: int, num_parts: int) -> None:
        """Begin a file that is announced; an incomplete one before it has been given up.

        Raises:
            DataError: it is too large; the message is for the user.
            MalformedError: no file of that size has so many parts.
        """
        self._transfer = None
        with naming(DataError, name):
            check_size(num_bytes, self._max_bytes)
        if num_bytes < 0 or not min(num_bytes, 1) <= num_parts <= min(num_bytes, MAX_PARTS):
            raise MalformedError(f"{num_parts} parts for {num_bytes} bytes")
        if num_parts:
            self._transfer = _Transfer(uuid, num_bytes, num_parts)

    def part(self, uuid: str, index: int, num_bytes: int) -> bool:
        """Count a part that arrives; return whether it belongs to the announced file.

        Raises:
            MalformedError: it has arrived before, or the parts do not add up to the announced size.
        """
        transfer = self._transfer
        if transfer is None or transfer.uuid != uuid:
            return False
        if index in transfer.arrived or not 0 <= index < transfer.num_parts:
            raise MalformedError(f"part {index} of {transfer.num_parts}")
        transfer.arrived.add(index)
        transfer.num_arrived += num_bytes
        complete = len(transfer.arrived) == transfer.num_parts
        if transfer.num_arrived > transfer.num_bytes or (complete and transfer.num_arrived < transfer.num_bytes):
            raise MalformedError(f"{transfer.num_arrived} bytes of {transfer.num_bytes}")
        if complete:
            self._transfer = None
        return True
