"""Every module can be imported, on each Python, without any extra."""

import importlib
import pkgutil

import pytest

import dt_viz


@pytest.mark.parametrize("name", [module.name for module in pkgutil.walk_packages(dt_viz.__path__, "dt_viz.")])
def test_every_module_can_be_imported(name):
    assert importlib.import_module(name).__name__ == name
