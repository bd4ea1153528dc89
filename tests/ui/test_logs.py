"""The log: few records of a kind, and nothing of what visitors send."""

import io
import logging

import pytest

from dt_viz.ui.logs import RateLimitFilter

MAX_RECORDS, PERIOD = 5, 60.0


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def log(clock):
    """A logger and what it has written."""
    logger, written = logging.Logger("test"), io.StringIO()
    handler = logging.StreamHandler(written)
    handler.addFilter(RateLimitFilter(MAX_RECORDS, PERIOD, clock))
    logger.addHandler(handler)
    return logger, written


def test_an_exception_is_written_with_its_type_and_places_without_its_text(log):
    logger, written = log
    try:
        float("secret")
    except ValueError:
        logger.exception("a callback failed")
    assert "a callback failed" in written.getvalue()
    assert "ValueError" in written.getvalue()
    assert __file__ in written.getvalue()
    assert "secret" not in written.getvalue().replace('float("secret")', "")  # of the program it holds the line


def test_few_records_of_a_kind_are_written_in_a_period_and_how_many_were_left_out_in_the_next(log, clock):
    logger, written = log
    for k in range(MAX_RECORDS + 7):
        clock.now = PERIOD if k == MAX_RECORDS + 6 else 0.0
        logger.warning("number %d", k)
    logger.warning("another kind")
    last = f"number {MAX_RECORDS + 6} (and 6 more like this)"
    assert written.getvalue().splitlines() == [*(f"number {k}" for k in range(MAX_RECORDS)), last, "another kind"]


def test_the_same_line_with_another_exception_is_another_kind(log):
    logger, written = log
    for text in ("x", "y") * 10:
        for fail in (lambda: float(text), lambda: {}[text]):  # noqa: B023 - called at once
            try:
                fail()
            except (ValueError, KeyError):
                logger.exception("failed")
    assert written.getvalue().count("ValueError\n") == written.getvalue().count("KeyError\n") == MAX_RECORDS
