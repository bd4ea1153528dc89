"""Command lines that answer a mistake by one line."""

from __future__ import annotations

import argparse
import re
from typing import NoReturn


class Parser(argparse.ArgumentParser):
    """A parser that says what is accepted, and not all that there is; `--help` says that."""

    def error(self, message: str) -> NoReturn:
        found = re.sub(r"^argument (-[^/:\s]+)[^:\s]*:", r"\1:", message)  # an option by the first of its names
        self.exit(2, f"{self.prog}: {found} ({self.prog} --help says more)\n")
