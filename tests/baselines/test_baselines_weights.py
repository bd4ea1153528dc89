"""Files of weights: what is written is read, and what belongs elsewhere is refused by name."""

from io import BytesIO

import numpy as np
import pytest

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.weights import load_weights, save_weights, weights_file
from dt_viz.scenario.tasks import TASKS

ARRAYS = {"W": np.linspace(-1, 1, 240).reshape(60, 4), "scale": np.linspace(-1, 1, 12), "count": np.array(7)}


@pytest.fixture
def saved(tmp_path):
    path = weights_file(tmp_path, "eflow", TASKS["draw_s"]())
    save_weights(path, "eflow", 3, TASKS["draw_s"](), ARRAYS)
    return path


def test_weights_are_read_in_double_precision_of_large_arrays_three_digits(saved):
    read = load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)
    assert read.keys() == ARRAYS.keys()
    assert read["W"].dtype == np.float64
    assert np.allclose(read["scale"], ARRAYS["scale"], rtol=1e-7, atol=0)
    assert np.allclose(read["W"], ARRAYS["W"], rtol=5e-4, atol=0)
    assert read["count"] == 7


@pytest.mark.parametrize(
    ("method", "version", "task", "message"),
    [
        ("eflow", 4, "draw_s", "version: found 3; accepted: 4"),
        ("mpnet", 3, "draw_s", "method: found 'eflow'; accepted: 'mpnet'"),
        ("eflow", 3, "draw_j", "demonstrations: found"),
    ],
)
def test_weights_of_another_version_method_or_task_are_refused(saved, method, version, task, message):
    saved.rename(weights_file(saved.parent, method, TASKS[task]()))
    with pytest.raises(NotFittedError, match=message):
        load_weights(method, version, TASKS[task](), saved.parent)


def flipped(content):
    """The content with one byte of the first array flipped."""
    at = content.index(b"W.npy") + 80
    return content[:at] + bytes([content[at] ^ 0xFF]) + content[at + 1 :]


def without_stamp(_content):
    file = BytesIO()
    np.savez(file, **ARRAYS)
    return file.getvalue()


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda b: b"PK" + b[:-2], lambda b: b"", flipped, without_stamp]
)
def test_a_damaged_file_is_refused_by_name(saved, damage):
    saved.write_bytes(damage(saved.read_bytes()))
    with pytest.raises(NotFittedError, match=r"eflow_draw_s\.npz"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


@pytest.mark.parametrize("value", [np.array([np.nan]), np.array(["text"])])
def test_what_is_no_finite_number_is_refused(saved, value):
    save_weights(saved, "eflow", 3, TASKS["draw_s"](), {"W": value})
    with pytest.raises(NotFittedError, match="array 'W'"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)
