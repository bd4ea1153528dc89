"""Long computations that can be interrupted, wherever they are in the middle of.

Who wants to interrupt and what takes long are many calls apart, with values and pure functions in between: here a
page's worker, there the steps of an integration. So what is called between those steps is a setting of the thread, as
`numpy.errstate` is.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

Checkpoint = Callable[[], None]
"""Called often in long computations; raises what is to end them, and may take its time to let others go first."""


class UnwantedError(Exception):
    """Nobody wants any more what is being computed; raised by a checkpoint."""


_current: ContextVar[Checkpoint] = ContextVar("_current", default=lambda: None)


@contextmanager
def interruptible(checkpoint: Checkpoint) -> Iterator[None]:
    """Within this block long computations of this thread call `checkpoint` between their steps.

    Blocks nest: the checkpoints of those around it are called, too, the outermost first.
    """
    outer = _current.get()

    def both() -> None:
        outer()
        checkpoint()

    token = _current.set(both)
    try:
        yield
    finally:
        _current.reset(token)


def checkpoint() -> None:
    """Call the function given to `interruptible`, if inside one; to be used between steps that take milliseconds."""
    _current.get()()
