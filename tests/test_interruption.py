"""Long computations call the checkpoint of their own thread, and only within its block."""

import threading

import numpy as np
import pytest

from dt_viz.flows.diffeomorphisms import AdaptiveFlow, Flow
from dt_viz.flows.fields import GaussianGrid, GridRBF
from dt_viz.interruption import checkpoint, interruptible

GRID = GaussianGrid.covering(np.array([[-1.0, -1.0], [1.0, 1.0]]), 0.5)
FIELD = GridRBF(GRID, np.random.default_rng(0).normal(size=(GRID.num_points, 2)))
POINTS = np.random.default_rng(1).uniform(-1, 1, (20, 2))


class StoppedError(Exception):
    pass


@pytest.fixture(params=[Flow(FIELD, steps=7), AdaptiveFlow(FIELD, 1.0)], ids=["equal steps", "adaptive"], name="flow")
def _flow(request):
    return request.param


def test_a_flow_passes_checkpoints_on_its_way_in_both_directions(flow):
    for run in (flow.forward, flow.inverse, flow.jacobian):
        calls = []
        with interruptible(lambda: calls.append(run)):  # noqa: B023 - called at once
            run(POINTS)
        assert len(calls) >= 7


def test_what_a_checkpoint_raises_ends_the_flow(flow):
    def stop():
        raise StoppedError

    expected = flow.forward(POINTS)
    with pytest.raises(StoppedError), interruptible(stop):
        flow.forward(POINTS)
    np.testing.assert_array_equal(flow.forward(POINTS), expected)  # after the block nothing is called


def test_of_nested_blocks_both_count_until_they_end_and_other_threads_are_not_concerned():
    calls = []
    with interruptible(lambda: calls.append("outer")):
        with interruptible(lambda: calls.append("inner")):
            checkpoint()
            other = threading.Thread(target=checkpoint)
            other.start()
            other.join()
        assert calls == ["outer", "inner"]
        checkpoint()
    checkpoint()
    assert calls == ["outer", "inner", "outer"]
