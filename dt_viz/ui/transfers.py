"""Files that visitors send, counted part by part before any of it is held."""

from __future__ import annotations

from dataclasses import dataclass, field

from dt_viz.errors import DataError, naming
from dt_viz.files.checks import check_size


class MalformedError(ValueError):
    """A message that the page never sends."""


@dataclass
class Upload:
    """The file that one visitor is sending, counted before any of it is held: one at a time."""

    max_bytes: int
    """Largest size that may be announced, bytes."""
    max_parts: int = 1024
    uuid: str = ""
    """Name of the transfer under way; none if empty."""
    num_bytes: int = 0
    """Announced size, bytes."""
    num_parts: int = 0
    """Announced number of parts."""
    num_arrived: int = 0
    """Size of what has arrived, bytes."""
    arrived: set[int] = field(default_factory=set)
    """Numbers of the parts that have arrived."""

    def start(self, uuid: str, name: str, num_bytes: int, num_parts: int) -> None:
        """Begin a file that is announced; an incomplete one before it has been given up.

        Raises:
            DataError: it is too large; the message is for the user.
            MalformedError: no file of that size has so many parts.
        """
        self.uuid = ""
        with naming(DataError, name):
            check_size(num_bytes, self.max_bytes)
        if num_bytes < 0 or not min(num_bytes, 1) <= num_parts <= min(num_bytes, self.max_parts):
            raise MalformedError(f"{num_parts} parts for {num_bytes} bytes")
        self.uuid = uuid if num_parts else ""
        self.num_bytes, self.num_parts, self.num_arrived, self.arrived = num_bytes, num_parts, 0, set()

    def part(self, uuid: str, index: int, num_bytes: int) -> bool:
        """Count a part that arrives; return whether it belongs to the announced file.

        Raises:
            MalformedError: it has arrived before, or the parts do not add up to the announced size.
        """
        if not self.uuid or self.uuid != uuid:
            return False
        if index in self.arrived or not 0 <= index < self.num_parts:
            raise MalformedError(f"part {index} of {self.num_parts}")
        self.arrived.add(index)
        self.num_arrived += num_bytes
        complete = len(self.arrived) == self.num_parts
        if self.num_arrived > self.num_bytes or (complete and self.num_arrived < self.num_bytes):
            raise MalformedError(f"{self.num_arrived} bytes of {self.num_bytes}")
        if complete:
            self.uuid = ""
        return True
