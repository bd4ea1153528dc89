"""Files of weights: what is written is read, and what belongs elsewhere is refused by name."""

import numpy as np
import pytest

from dt_viz.baselines.base import NotFittedError
from dt_viz.baselines.weights import load_weights, save_weights, weights_file
from dt_viz.scenario.tasks import TASKS

ARRAYS = {"W": np.linspace(-1, 1, 12).reshape(3, 4), "count": np.array(7)}


@pytest.fixture
def saved(tmp_path):
    path = weights_file(tmp_path, "eflow", TASKS["draw_s"]())
    save_weights(path, "eflow", 3, TASKS["draw_s"](), ARRAYS)
    return path


def test_weights_are_read_in_double_precision_as_they_were_written(saved):
    read = load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)
    assert read.keys() == ARRAYS.keys()
    assert read["W"].dtype == np.float64
    assert np.allclose(read["W"], ARRAYS["W"], rtol=1e-7, atol=0)
    assert read["count"] == 7


def test_another_version_is_refused(saved):
    with pytest.raises(NotFittedError, match="version: found 3; accepted: 4"):
        load_weights("eflow", 4, TASKS["draw_s"](), saved.parent)


def test_another_method_is_refused(saved):
    saved.rename(weights_file(saved.parent, "mpnet", TASKS["draw_s"]()))
    with pytest.raises(NotFittedError, match="method: found 'eflow'; accepted: 'mpnet'"):
        load_weights("mpnet", 3, TASKS["draw_s"](), saved.parent)


def test_weights_of_another_task_are_refused(saved):
    saved.rename(weights_file(saved.parent, "eflow", TASKS["draw_j"]()))
    with pytest.raises(NotFittedError, match="demonstrations: found"):
        load_weights("eflow", 3, TASKS["draw_j"](), saved.parent)


def test_missing_weights_are_refused_with_the_command_that_makes_them(tmp_path):
    with pytest.raises(NotFittedError, match="train --method eflow --task draw_s"):
        load_weights("eflow", 3, TASKS["draw_s"](), tmp_path)


@pytest.mark.parametrize("damage", [lambda b: b[: len(b) // 2], lambda b: b"PK" + b[:-2], lambda b: b""])
def test_a_damaged_file_is_refused_by_name(saved, damage):
    saved.write_bytes(damage(saved.read_bytes()))
    with pytest.raises(NotFittedError, match=r"eflow_draw_s\.npz"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


def test_a_flipped_byte_is_refused(saved):
    content = bytearray(saved.read_bytes())
    at = content.index(b"W.npy") + 80
    content[at] ^= 0xFF
    saved.write_bytes(content)
    with pytest.raises(NotFittedError, match=r"eflow_draw_s\.npz"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


@pytest.mark.parametrize("value", [np.array([np.nan]), np.array(["text"])])
def test_what_is_no_finite_number_is_refused(saved, value):
    save_weights(saved, "eflow", 3, TASKS["draw_s"](), {"W": value})
    with pytest.raises(NotFittedError, match="array 'W'"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)


def test_a_file_without_its_stamp_is_refused(saved):
    np.savez(saved, **ARRAYS)
    with pytest.raises(NotFittedError, match=r"eflow_draw_s\.npz"):
        load_weights("eflow", 3, TASKS["draw_s"](), saved.parent)
