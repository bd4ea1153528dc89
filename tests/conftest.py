"""What several test modules share: a robot, learned tasks in a temporary cache, scenarios."""

import atexit
import os
import re
import shutil
import tempfile
import threading
import time
from contextlib import suppress
from pathlib import Path

# Tests run beside each other, each on one core: read when numpy is imported, by its BLAS.
os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1", "MKL_NUM_THREADS": "1"} | os.environ)

# Compiled code is kept from one run to the next.
os.environ.setdefault(
    "NUMBA_CACHE_DIR", str(Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "dt-viz/kernels")
)

# Temporary files and caches of this process go with it.
OWN_FOLDER = Path(tempfile.mkdtemp(prefix="dt-viz-tests-", dir=os.environ.get("PYTEST_DEBUG_TEMPROOT")))
atexit.register(shutil.rmtree, OWN_FOLDER, ignore_errors=True)
tempfile.tempdir = os.environ["TMPDIR"] = str(OWN_FOLDER / "tmp")
os.environ["XDG_CACHE_HOME"] = str(OWN_FOLDER / "cache")
# Arms are made once for a whole run: workers are given the folder of the process that starts them.
ARMS = Path(os.environ.setdefault("DT_VIZ_TEST_ARMS", str(OWN_FOLDER / "arms")))
for folder in (tempfile.tempdir, ARMS, os.environ["XDG_CACHE_HOME"] + "/dt-viz"):
    Path(folder).mkdir(parents=True, exist_ok=True)
Path(os.environ["XDG_CACHE_HOME"], "dt-viz/arms").symlink_to(ARMS)

import pytest
from chromium import ARGUMENTS, CHROMIUM
from hypothesis import HealthCheck, settings
from scenes import avoiding, frame_at

from dt_viz.avoidance.arm import WholeArm
from dt_viz.learning.store import FitStore
from dt_viz.obstacles.shapes import Sphere
from dt_viz.robot.models import load_jaco
from dt_viz.robot.robot import Robot
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.engine import Engine

# Names of threads that a pool starts when it first needs one; a pool ends with the server that owns it.
OF_POOLS = re.compile(
    r"ThreadPoolExecutor|asyncio_\d|Dask-Offload|Thread-\d+ \(_do_work\)|pytest|execnet|hypothesis|playwright"
)

# Nothing here is timed, and a failure must come back on the next run.
settings.register_profile(
    "dt-viz", deadline=None, suppress_health_check=[HealthCheck.too_slow], derandomize=True, max_examples=25
)
settings.load_profile("dt-viz")


def pytest_sessionstart(session):
    """Compile once what workers then load, so that no test takes as long as compiling does."""
    if getattr(session.config.option, "numprocesses", None):
        list(WholeArm(load_jaco()).compiled())


def pytest_sessionfinish(session):
    """With `DT_VIZ_NO_SKIPS` in the environment, as in `.ci/run`, tests that are skipped fail the run."""
    reporter = session.config.pluginmanager.get_plugin("terminalreporter")
    if os.environ.get("DT_VIZ_NO_SKIPS") and reporter is not None and reporter.stats.get("skipped"):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(autouse=True)
def _leaves_no_threads():
    """A test fails some of whose threads have not ended 20 s after it."""
    before = set(threading.enumerate())
    yield
    deadline = time.monotonic() + 20.0
    while left := [thread for thread in set(threading.enumerate()) - before if not OF_POOLS.search(thread.name)]:
        assert time.monotonic() < deadline, f"left behind: {left}"
        time.sleep(0.02)


@pytest.fixture(scope="module")
def browser():
    from playwright.sync_api import sync_playwright  # takes long to load

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=ARGUMENTS)
        yield browser
        browser.close()


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_jaco()


@pytest.fixture(scope="session")
def cache(tmp_path_factory, request) -> Path:
    """Folder of caches, in which each task is learned once for the whole test run: workers, and servers that are
    processes of their own, share it."""
    is_worker = hasattr(request.config, "workerinput")
    folder = tmp_path_factory.getbasetemp()
    cache = (folder.parent if is_worker else folder) / "cache"
    (cache / "dt-viz").mkdir(parents=True, exist_ok=True)
    with suppress(FileExistsError):  # another worker was first
        (cache / "dt-viz/arms").symlink_to(ARMS)
    return cache


@pytest.fixture(scope="session")
def fits(cache) -> FitStore:
    """The learned tasks, where a process finds them whose `XDG_CACHE_HOME` is the folder of caches."""
    return FitStore(cache / "dt-viz")


@pytest.fixture(scope="session")
def new_engine(fits, robot):
    """Makes engines that have computed nothing yet."""
    return lambda: Engine(TASKS, fits, robot)


_shared: list[Engine] = []


@pytest.fixture(scope="session")
def engine(new_engine) -> Engine:
    """One engine for all tests: each begins with one that has shown nothing, so no obstacle is being dragged."""
    _shared.append(new_engine())
    return _shared[0]


@pytest.fixture(scope="module", autouse=True)
def _nothing_shown_before_a_module():
    for engine in _shared:
        engine._last.clear()


@pytest.fixture(autouse=True)
def _nothing_shown_before_a_test(_nothing_shown_before_a_module):
    for engine in _shared:
        engine._last.clear()


@pytest.fixture(scope="session")
def at_rest(engine):
    """The frame of a scenario at a stage, without history; each is computed once and must not be changed."""
    known = {}

    def frame(scenario, stage):
        if (scenario, stage) not in known:
            engine._last.clear()
            known[scenario, stage] = frame_at(engine, scenario, stage)
            engine._last.clear()
        return known[scenario, stage]

    return frame


@pytest.fixture(scope="session")
def initial(engine):
    """The scenario that a task begins with."""
    return lambda task: avoiding(task, Sphere(engine.task(task).obstacle_position))


@pytest.fixture(scope="module")
def server():
    """A page that nobody looks at: its scene and controls take handles all the same."""
    import viser  # noqa: TID251 - takes long to load

    server = viser.ViserServer(host="127.0.0.1", port=0, verbose=False)
    yield server
    server.stop()


@pytest.fixture
def scene(server):
    yield server.scene
    server.scene.reset()
