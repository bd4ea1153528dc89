"""Who may import whom: found in the sources, not in what happens to be loaded."""

import ast
import graphlib
import re
from collections.abc import Mapping
from functools import cache
from pathlib import Path

import pytest

import dt_viz

PACKAGE = Path(dt_viz.__file__).parent
SOURCES = sorted(PACKAGE.rglob("*.py"))
FOUNDATION = {
    "arguments",
    "errors",
    "folders",
    "memo",
    "metrics",
    "numerics",
    "scheduler",
    "shipped",
    "warning",
}
"""Modules of no package, which import each other only."""
BELOW_SCENARIO = {"foundation", "flows", "files", "learning", "obstacles", "robot", "avoidance"}
BELOW_SESSION = BELOW_SCENARIO | {"scenario", "motion", "control", "pictures"}
MAY_IMPORT: Mapping[str, set[str]] = {
    "foundation": set(),
    "kernels": {"foundation"},
    "flows": {"foundation", "kernels"},
    "files": {"foundation"},
    "learning": {"foundation", "flows", "files"},
    "obstacles": {"foundation", "kernels", "flows", "files"},
    "robot": {"foundation", "kernels", "flows", "files", "obstacles"},
    "avoidance": {"foundation", "kernels", "flows", "learning", "obstacles", "robot"},
    "scenario": BELOW_SCENARIO - {"robot"},
    "motion": BELOW_SCENARIO | {"scenario"},
    "control": BELOW_SCENARIO | {"kernels", "scenario", "motion"},
    "pictures": BELOW_SCENARIO | {"scenario"},
    "saving": BELOW_SCENARIO | {"scenario"},
    "library": BELOW_SESSION - {"pictures", "files"} | {"saving"},
    "session": BELOW_SESSION | {"baselines", "saving"},
    "baselines": BELOW_SESSION - {"pictures"},
    "serving": set(),
    "ui": BELOW_SESSION | {"kernels", "session", "baselines", "serving", "saving"},
    "evaluate": BELOW_SESSION | {"session", "baselines"},
    "examples": {"foundation"},
    "picture_making": BELOW_SESSION | {"saving", "session", "ui"},
    "picture": {"foundation", "picture_making"},
    "cli": BELOW_SESSION | {"kernels", "session", "serving", "ui", "evaluate", "saving", "picture"},
    "__main__": {"cli"},
}
"""The packages from the bottom up, and which of those below each may import."""
ONLY_IMPORTERS: Mapping[str, set[str]] = {
    "pinocchio": {"robot/link_shapes.py"},
    "coal": {"robot/link_distances.py"},
    "matplotlib": {"examples/plot.py", "pictures/figures.py"},
    "torch": set(),
    "ompl": {"baselines/mpnet.py"},
    "imageio_ffmpeg": {"pictures/video.py"},
    "joblib": {"evaluate/options.py"},
    "distributed": {"evaluate/options.py"},
    "prometheus_client": {"serving/board.py"},
    "jax": set(),
    "numba": {"kernels/compiled.py"},
}
"""Modules that only these files import."""


def named(path: Path) -> str:
    """The full name of a file's module."""
    return ".".join(["dt_viz", *path.relative_to(PACKAGE).with_suffix("").parts])


MODULES = {named(path).removesuffix(".__init__"): path for path in SOURCES}


@cache
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


def our_modules(path: Path) -> set[str]:
    """Names of this project's modules that a file imports, packages themselves left out."""
    return {name for name in imported(path) if name in MODULES and MODULES[name].name != "__init__.py"}


def package_of(path: Path) -> str:
    first, *others = path.relative_to(PACKAGE).parts
    name = first if others else path.stem
    return "foundation" if name in FOUNDATION else name


def importers(module: str) -> set[str]:
    return {
        path.relative_to(PACKAGE).as_posix()
        for path in SOURCES
        if any(name == module or name.startswith(f"{module}.") for name in imported(path))
    }


def test_every_module_has_a_package():
    assert {package_of(path) for path in SOURCES} - {"__init__"} == set(MAY_IMPORT)


@pytest.mark.parametrize("path", SOURCES, ids=lambda path: path.relative_to(PACKAGE).as_posix())
def test_a_module_imports_only_what_is_below_it(path):
    own = package_of(path)
    if own == "__init__":
        assert our_modules(path) <= {*MODULES} - {name for name in MODULES if name.startswith("dt_viz.ui")}
        return
    upwards = {name for name in our_modules(path) if package_of(MODULES[name]) not in MAY_IMPORT[own] | {own}}
    assert not upwards


def test_what_lies_in_the_scene_knows_no_controls():
    in_scene = [path for path in SOURCES if path.is_relative_to(PACKAGE / "ui" / "scene")]
    assert in_scene
    assert not [
        name
        for path in in_scene
        for name in our_modules(path)
        if name.startswith(("dt_viz.ui.panel", "dt_viz.ui.tabs"))
    ]


def test_neither_modules_nor_packages_import_each_other_in_a_circle():
    for graph in ({name: our_modules(path) for name, path in MODULES.items()}, MAY_IMPORT):
        tuple(graphlib.TopologicalSorter(graph).static_order())


def test_only_the_page_talks_to_the_browser():
    found = importers("viser")
    assert found
    assert all(name.startswith("ui/") for name in found - {"examples/viser_scene.py"})


def test_what_viser_keeps_to_itself_is_used_in_one_file():
    private = re.compile(
        r"viser\._(?!_)|\._impl\b|\._queue_update\b|\._websock|websockets\.asyncio\.server\.serve|:has\(|mantine-[A-Z]"
    )
    page = [path for path in SOURCES if path.parent in {PACKAGE / "ui", PACKAGE / "ui" / "tabs"}]
    assert [path.name for path in page if private.search(path.read_text(encoding="utf-8"))] == ["patches.py"]


@pytest.mark.parametrize("module", ONLY_IMPORTERS)
def test_only_one_place_talks_to(module):
    assert importers(module) == ONLY_IMPORTERS[module]


def test_no_property_locks_all_instances_while_it_is_computed():
    """As `functools.cached_property` does in Python 3.10 and 3.11; `dt_viz.memo.cached_property` has no lock."""
    assert importers("functools.cached_property") == set()
    assert [path.name for path in SOURCES if "@functools.cached_property" in path.read_text(encoding="utf-8")] == []


def attributes_of(node: ast.ClassDef) -> set[str]:
    """Names of a class's instance attributes: its fields, and what is assigned to `self`."""
    fields = {
        part.target.id for part in node.body if isinstance(part, ast.AnnAssign) and isinstance(part.target, ast.Name)
    }
    stored = [part for part in ast.walk(node) if isinstance(part, ast.Attribute) and isinstance(part.ctx, ast.Store)]
    return fields | {part.attr for part in stored if isinstance(part.value, ast.Name) and part.value.id == "self"}


def test_only_frozen_values_have_more_than_twelve_attributes():
    nodes = [node for path in SOURCES for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))]
    classes = [node for node in nodes if isinstance(node, ast.ClassDef)]
    large = [node for node in classes if len(attributes_of(node)) > 12]
    assert {"Scenario", "View"} <= {node.name for node in large}
    told = {node.name: " ".join(map(ast.unparse, [*node.decorator_list, *node.bases])) for node in large}
    assert [name for name, kind in told.items() if "frozen=True" not in kind and kind != "NamedTuple"] == []


BUDGET: Mapping[str, tuple[int, int]] = {
    "": (2013, 15),
    "avoidance": (2411, 15),
    "baselines": (1043, 9),
    "control": (1263, 6),
    "evaluate": (1441, 8),
    "examples": (200, 5),
    "files": (2822, 19),
    "flows": (1295, 8),
    "kernels": (2826, 14),
    "learning": (3497, 15),
    "library": (1180, 6),
    "motion": (1507, 8),
    "obstacles": (1390, 7),
    "pictures": (1075, 6),
    "robot": (3493, 16),
    "scenario": (2539, 14),
    "serving": (506, 3),
    "session": (2958, 15),
    "tests": (37355, 192),
    "ui": (10785, 49),
    "whole": (44244, 238),
}
"""Largest numbers of lines and of files of each package; "" has the modules of none. They only go down."""
SLACK = 0.02  # part of a budget of lines that may be unused before the budget goes down, too


def folder_of(path):
    """Name of a file's package; empty for a module of none."""
    return "" if path.parent == PACKAGE else path.relative_to(PACKAGE).parts[0]


def counted(name):
    """Numbers of lines and of files of a package, of the whole product, or of the tests."""
    if name == "tests":
        paths = sorted(Path(__file__).parent.rglob("*.py"))
    elif name == "whole":
        paths = SOURCES
    else:
        paths = [path for path in SOURCES if name == folder_of(path)]
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths), len(paths)


def test_each_package_has_a_budget():
    assert {*BUDGET} == {*map(folder_of, SOURCES), "whole", "tests"}


@pytest.mark.parametrize("name", BUDGET)
def test_a_package_keeps_within_its_budget_and_its_budget_follows_it_down(name):
    (lines, files), (most_lines, most_files) = counted(name), BUDGET[name]
    assert lines <= most_lines and files <= most_files, f"{name!r} has {lines} lines in {files} files"
    is_used = lines >= (1 - SLACK) * most_lines - 20 and files == most_files
    assert is_used, f"lower the budget of {name!r} to {lines, files}"
