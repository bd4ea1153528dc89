"""Checkpoints of long computations, between whose parts others come first: what is below does not know who they are."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


class _Thread(threading.local):
    asks: Callable[[], object] | None = None


_thread = _Thread()


@contextmanager
def checked(ask: Callable[[], object]) -> Iterator[None]:
    """Have `ask` called at each checkpoint of this thread within the block: it may wait, or raise an error."""
    before, _thread.asks = _thread.asks, ask
    try:
        yield
    finally:
        _thread.asks = before


def checkpoint() -> None:
    """Let others go first, or end what nobody wants any more, where somebody has asked for that: see `checked`."""
    if _thread.asks is not None:
        _thread.asks()
