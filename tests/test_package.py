"""The package as others get it: built, installed by pip into an empty environment, started far from the checkout."""

import io
import os
import re
import subprocess
import sys
import time
import venv
import zipfile
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from browsing import UNHURRIED
from chromium import needs_chromium
from PIL import Image

from dt_viz.ui.scene.palette import LIGHT

ROOT = Path(__file__).parents[1]
PATIENCE = 900.0  # seconds that anything may take: the machine may be busy
EVERYTHING = """
import pkgutil, dt_viz
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS
for module in pkgutil.walk_packages(dt_viz.__path__, "dt_viz."):
    __import__(module.name)
for task in TASKS.values():
    task()
load_jaco().body
print(dt_viz.__file__)
"""
"""Imports every module, and reads every file that ships."""

pytestmark = pytest.mark.package


UNREACHABLE = re.compile("NewConnectionError|NameResolutionError|ConnectTimeoutError|ProxyError|Network is unreachable")
"""What pip says where there is no way to the package index, rather than that a package is not in it."""


def run(*command, cwd):
    """What a command prints, with nothing of the checkout on its path; skips where it needs a network and has none."""
    environment = {name: value for name, value in os.environ.items() if not name.startswith("PYTHON")}
    done = subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, check=False)
    printed = done.stdout + done.stderr
    if done.returncode != 0 and (found := UNREACHABLE.search(printed)):
        pytest.skip(f"the package index cannot be reached: {found[0]}")
    assert done.returncode == 0, printed
    return done.stdout


@pytest.fixture(scope="module")
def wheel(tmp_path_factory):
    folder = tmp_path_factory.mktemp("dist")
    run(sys.executable, "-m", "build", "--outdir", folder, ROOT, cwd=folder)  # the sdist, and the wheel from it
    (wheel,) = folder.glob("*.whl")
    return wheel


@pytest.fixture(scope="module")
def environment(wheel, tmp_path_factory):
    """Folder of a virtual environment with nothing but the wheel and what it depends on."""
    folder = tmp_path_factory.mktemp("empty")
    venv.create(folder, with_pip=True)
    run(folder / "bin" / "python", "-m", "pip", "install", "-q", "--no-compile", wheel, cwd=folder)
    return folder


@pytest.fixture
def without(environment):
    """Takes a file of the installed package away for a test."""
    moved = []

    def take(name):
        (path,) = environment.glob(f"lib/python*/site-packages/dt_viz/assets/{name}")
        moved.append((path.rename(environment / name), path))

    yield take
    for kept, path in moved:
        kept.rename(path)


@contextmanager
def started(environment, cache):
    """The address that the installed command prints, and all that it has printed once it has ended."""
    process = subprocess.Popen(
        [environment / "bin" / "dt-viz", "--port", "0"],
        cwd=cache,
        env={"XDG_CACHE_HOME": str(cache), "PYTHONUNBUFFERED": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    assert process.stdout is not None
    printed = []
    try:
        for line in process.stdout:
            printed.append(line)
            if found := re.search(r"DT-Viz is at (http://\S+)", line):
                yield found[1], printed
                return
        pytest.fail(f"dt-viz has ended: {''.join(printed)}")
    finally:
        process.terminate()
        printed.append(process.communicate()[0])


def see_the_motion(browser, address, patience):
    """Waits for the certificates in the panel and the rollouts in the picture; fails without them."""
    deadline = time.monotonic() + patience
    page = browser.new_page(viewport={"width": 900, "height": 560})
    try:
        page.set_default_timeout(1000 * patience)
        page.add_init_script(UNHURRIED)
        page.goto(address)
        page.get_by_text("· stable").wait_for()
        page.evaluate("isLookedAt = true")
        while num_rollout_pixels(page.screenshot()) < 300:
            if time.monotonic() > deadline:
                pytest.fail("the picture shows no rollout")
    finally:
        page.close()


def num_rollout_pixels(screenshot):
    pixels = np.asarray(Image.open(io.BytesIO(screenshot)).convert("RGB")).astype(int)
    return (np.abs(pixels - LIGHT.rollout).max(axis=-1) < 20).sum()


def test_the_wheel_holds_the_modules_and_the_files_that_they_read_and_nothing_else(wheel):
    modules = {path.relative_to(ROOT).as_posix() for path in (ROOT / "dt_viz").rglob("*.py")}
    files = {f"dt_viz/{path.relative_to(ROOT).as_posix()}" for path in (ROOT / "assets").rglob("*.npz")}
    names = zipfile.ZipFile(wheel).namelist()
    assert {name for name in names if ".dist-info/" not in name} == modules | files | {"dt_viz/py.typed"}
    assert any(name.endswith(".dist-info/licenses/LICENSE") for name in names)
    assert wheel.stat().st_size < 3e6


def test_every_module_and_file_is_found_in_the_environment(environment, tmp_path):
    where = run(environment / "bin" / "python", "-c", EVERYTHING, cwd=tmp_path)
    assert Path(where.strip()).is_relative_to(environment)


def test_the_package_is_a_command_too(environment, tmp_path):
    usage = run(environment / "bin" / "python", "-m", "dt_viz", "--help", cwd=tmp_path)
    assert usage == run(environment / "bin" / "dt-viz", "--help", cwd=tmp_path) != ""


@needs_chromium
def test_the_page_of_the_installed_command_shows_the_motion(environment, tmp_path, browser):
    with started(environment, tmp_path) as (address, _):
        see_the_motion(browser, address, PATIENCE)
    assert [*(tmp_path / "dt-viz" / "kernels").glob("*/complete-*")]  # what it waited for was compiled for all


@pytest.mark.parametrize(("name", "in_a_line"), [("draw_s.npz", False), ("body_points.npz", True)])
def test_without_a_file_the_command_ends_and_says_why(environment, tmp_path, without, name, in_a_line):
    without(name)
    with pytest.raises(pytest.fail.Exception, match=re.escape(name)) as ended, started(environment, tmp_path):
        pass
    assert not (in_a_line and "Traceback" in str(ended.value))
