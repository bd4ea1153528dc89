"""Who may import whom: found in the sources, not in what happens to be loaded."""

import ast
from pathlib import Path

import pytest

import dt_viz

PACKAGE = Path(dt_viz.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
BROWSERLESS_UI = {"session.py", "worker.py"}
MAY_IMPORT_UI = ("cli.py", "evaluate")


def imported(path: Path) -> set[str]:
    """Full names of the modules that a file imports, anywhere in it; relative names resolved."""
    names = set()
    package = ["dt_viz", *path.relative_to(PACKAGE).parts[:-1]]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else []
            module = ".".join([*base, *([node.module] if node.module else [])])
            names.update({module, *(f"{module}.{alias.name}" for alias in node.names)})
    return names


def imports(path: Path, module: str) -> bool:
    return any(name == module or name.startswith(f"{module}.") for name in imported(path))


def importers(module: str) -> set[str]:
    return {path.relative_to(PACKAGE).as_posix() for path in SOURCES if imports(path, module)}


def test_only_the_ui_talks_to_the_browser():
    found = importers("viser")
    assert found
    assert all(name.startswith("ui/") for name in found)
    assert not {f"ui/{name}" for name in BROWSERLESS_UI} & found


def test_session_and_worker_reach_no_browser_through_their_imports():
    """Also not by way of what they import."""
    reached, todo = set(), [PACKAGE / "ui" / name for name in BROWSERLESS_UI]
    while todo:
        path = todo.pop()
        if path in reached:
            continue
        reached.add(path)
        for name in imported(path):
            candidate = PACKAGE.parent / Path(*name.split(".")).with_suffix(".py")
            if name.startswith("dt_viz") and candidate.exists():
                todo.append(candidate)
    assert PACKAGE / "engine.py" in reached
    assert not [path.name for path in reached if imports(path, "viser")]


def test_only_the_robot_talks_to_pinocchio():
    assert importers("pinocchio") == {"robot.py"}


def test_only_the_distances_of_links_talk_to_coal():
    assert importers("coal") == {"link_distances.py"}


def test_computing_never_imports_the_ui():
    outside = {name for name in importers("dt_viz.ui") if not name.startswith("ui/")}
    assert not [name for name in outside if not name.startswith(MAY_IMPORT_UI)]


@pytest.mark.parametrize("module", ["matplotlib", "torch", "jax", "pickle", "functools.cached_property"])
def test_nothing_imports(module):
    assert importers(module) == set()


def test_the_scenario_knows_no_engine():
    """Values are below what computes with them."""
    for name in ("fields.py", "integrate.py", "diffeo.py", "systems.py", "occupancy.py", "obstacles.py", "scenario.py"):
        for module in ("engine", "behaviours", "avoidance", "robot", "tasks", "fits"):
            if (name, module) == ("scenario.py", "behaviours"):
                continue  # layers are values of behaviours; only their type is known
            assert not imports(PACKAGE / name, f"dt_viz.{module}"), f"{name} imports {module}"
