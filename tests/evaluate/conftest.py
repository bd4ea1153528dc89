"""Measurements find what was learned where the tests store it."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def fits_of_the_tests(cache):
    (cache / "dt-viz").mkdir(parents=True, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("XDG_CACHE_HOME", str(cache))
        yield
