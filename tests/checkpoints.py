"""What happens at the checkpoints of long computations."""

from contextlib import contextmanager
from unittest.mock import patch

from dt_viz import scheduler


@contextmanager
def asked_at_checkpoints(ask):
    """Have a function called at each checkpoint of this thread, which may raise."""
    with patch.object(scheduler.SCHEDULER, "pause", ask), patch.object(scheduler._thread, "pauses", True):
        yield
