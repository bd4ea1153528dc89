"""Every public method says what it does; one that overrides another may leave that to what it overrides."""

import ast
import importlib
import inspect

import pytest

from tests.test_architecture import PACKAGE, SOURCES, named


def undocumented(cls: type) -> list[str]:
    """The public methods and properties of a class, not those it inherits, that have no docstring to show."""
    methods = {name: value for name, value in vars(cls).items() if not name.startswith("_")}
    own = {name: value for name, value in methods.items() if callable(value) or isinstance(value, property)}
    return [name for name in own if not inspect.getdoc(getattr(cls, name))]


def classes(source):
    """The public classes that a file defines at its top."""
    module = importlib.import_module(named(source))
    names = [node.name for node in ast.parse(source.read_text()).body if isinstance(node, ast.ClassDef)]
    return [getattr(module, name) for name in names if not name.startswith("_")]


@pytest.mark.parametrize("source", SOURCES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_public_methods_have_docstrings(source):
    found = {cls.__name__: undocumented(cls) for cls in classes(source)}
    assert not any(found.values()), found
