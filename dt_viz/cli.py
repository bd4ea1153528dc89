"""The command line: the demo, and the measurements as its subcommand."""

from __future__ import annotations

import argparse
import logging
import os
import secrets
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from types import FrameType
from typing import IO, TYPE_CHECKING

from dt_viz.arguments import Parser
from dt_viz.evaluate.__main__ import main as evaluate
from dt_viz.picture import main as picture

if TYPE_CHECKING:
    from dt_viz.learning.store import FitStore
    from dt_viz.robot.robot import Robot
    from dt_viz.scenario.saved import Known, Saved
    from dt_viz.scenario.tasks import Task, TaskEntry
    from dt_viz.serving.board import Share
    from dt_viz.ui.server import Server

MAX_PORT = 65535
PROG = "dt-viz"
MAX_PROCESSES, MOST_BY_DEFAULT = 64, 4
"""Largest number of processes that may be asked for, and that are taken unasked."""
COMPILING = "Compiling for this processor, once"
LOADED = 2.0  # time within which compiled code is loaded and no message comes, seconds
MAX_SESSIONS, MAX_WATCHING = 8, 50
"""Largest numbers of visitors unless they are chosen: each with a private scene, and all with one."""
MEASURE, PICTURE = "evaluate", "picture"
"""Subcommands of the measurements and of pictures; without one the demo starts."""


@dataclass(frozen=True)
class _Offered:
    """What the server offers."""

    tasks: Mapping[str, TaskEntry]
    first: str  # name of the task that visitors begin with
    begins: Saved | None  # scenario that they begin with, if one is given
    scenarios: Mapping[str, Saved]  # scenarios that links may name


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the server until Ctrl-C or SIGTERM, or a subcommand; returns the process' exit status."""
    given = sys.argv[1:] if arguments is None else arguments
    if given and given[0] == MEASURE:
        return evaluate(given[1:], prog=f"{PROG} {MEASURE}")
    try:
        with _interruptible():
            if given and given[0] == PICTURE:
                return picture(given[1:], prog=f"{PROG} {PICTURE}")
            return _serve(given)
    except KeyboardInterrupt:
        return 0


def _serve(arguments: Sequence[str]) -> int:
    # read when numpy is first imported, perhaps by an option: visitors share the cores, and BLAS threads cost them time
    os.environ.update({"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"} | os.environ)
    options = _parser().parse_args(arguments)
    if unused := _unused(options):
        print(f"{PROG}: {unused}", file=sys.stderr)
        return 2
    from dt_viz.errors import DataError, FormatError  # noqa: PLC0415
    from dt_viz.folders import default_cache_folder  # noqa: PLC0415
    from dt_viz.kernels.compiled import compiling_elsewhere, is_complete  # noqa: PLC0415
    from dt_viz.learning.imitation import ImitationError  # noqa: PLC0415
    from dt_viz.learning.store import FitStore  # noqa: PLC0415
    from dt_viz.serving.board import Share  # noqa: PLC0415
    from dt_viz.serving.supervisor import AddressError, Supervisor, listen  # noqa: PLC0415
    from dt_viz.ui.gate import RateLimitFilter  # noqa: PLC0415
    from dt_viz.ui.server import MAX_WAITING, Server  # noqa: PLC0415

    handler = logging.StreamHandler()
    handler.addFilter(RateLimitFilter())
    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s", handlers=[handler])
    try:
        robot = _robot(options)
        offered = _offered(options, robot)
        fits = FitStore(default_cache_folder())
        if options.prepare_all or options.prepare_only:
            for entry in offered.tasks.values():
                task = entry()
                fits.get(task.demonstrations, progress=_Bar(f"Learning {task.title}"))
                print(f"Ready: {task.title}", flush=True)
            _compile(robot, threading.Event())
        if options.prepare_only:
            return 0
        listening = listen(options.host, options.port)
    except (DataError, FormatError, ImitationError, AddressError, FileNotFoundError) as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2

    def ready() -> None:
        host = f"[{options.host}]" if ":" in options.host else options.host
        address = f"http://{host}:{listening.getsockname()[1]}"
        print(f"DT-Viz is at {address} (Ctrl-C stops it)", flush=True)
        if key is not None:
            print(f"To present, open {address}/?present={key}; all others watch", flush=True)
        for name in offered.scenarios:
            print(f"{address}/?scenario={name}", flush=True)

    key = secrets.token_urlsafe(16) if options.present else None
    max_sessions = options.max_sessions or (MAX_WATCHING if options.present else MAX_SESSIONS)
    new_server = partial(
        Server,
        offered.tasks,
        fits,
        robot,
        task=offered.first,
        host=options.host,
        max_sessions=max_sessions,
        max_of_address=options.max_of_address,
        allowed=options.allow_origin,
        key=key,
        begins=offered.begins,
        scenarios=offered.scenarios,
    )
    prepare = partial(_prepare, fits, offered.tasks[offered.first](), robot)
    num_processes, num_connections = 1 if key else _num_processes(options.processes), max_sessions + MAX_WAITING
    if num_processes > 1 and is_complete():
        _compile(robot, threading.Event())  # processes that are forked from this one have it then, too
    with compiling_elsewhere(), listening:
        share = Share(num_processes, num_connections)
        if num_processes == 1:
            return _work(new_server, prepare, share, listening, ready)
        return Supervisor(listening, share, partial(_work, new_server, prepare), ready).run()


def _offered(options: argparse.Namespace, robot: Robot) -> _Offered:
    """Return what the server offers.

    A scenario's own task is among them unless it is placed for another arm: then each page brings it.

    Raises:
        DataError: what is given cannot be used.
        FormatError: there is no such task.
    """
    from dt_viz.errors import FormatError  # noqa: PLC0415
    from dt_viz.learning.store import FitStore  # noqa: PLC0415
    from dt_viz.scenario.tasks import OWN, TaskEntry, known_tasks  # noqa: PLC0415
    from dt_viz.session.arms import ArmStore  # noqa: PLC0415
    from dt_viz.ui.page import known_names  # noqa: PLC0415

    tasks, own = known_tasks(options.lasa), None
    known = known_names(tasks, ArmStore(tasks, FitStore(None), robot).titles)
    given, scenarios = _scenario(options, known), _scenarios(options, known)
    if given is not None and given.own is not None and not given.scenario.arm:
        own, given = replace(given.own.task, name=OWN), replace(given, own=None)
    elif given is None and options.files:
        own = _own(options, robot)
    if own is not None:
        stays = given is not None or own.demonstrations[0].dimension != 2
        tasks = {OWN: TaskEntry(own.title, lambda: own, stays), **tasks}
    wanted = options.task or (OWN if given is None and own is not None else "draw_s")
    if wanted not in tasks:
        raise FormatError("--task", repr(wanted), ", ".join(tasks))
    begins_with = wanted if given is None or given.scenario.task not in tasks else given.scenario.task
    return _Offered(tasks, begins_with, given, scenarios)


def _scenario(options: argparse.Namespace, known: Known) -> Saved | None:
    """Read the saved scenario that is given; None where the files are no scenario.

    Raises:
        DataError: it cannot be used, or something is given beside it.
    """
    from dt_viz.errors import DataError  # noqa: PLC0415
    from dt_viz.saving import is_scenario, read_scenario  # noqa: PLC0415

    found = [path for path in map(Path, options.files) if is_scenario(path)]
    if not found:
        return None
    if len(options.files) > 1:
        accepted = "it alone, or --scenarios FOLDER for several"
        raise DataError(found[0], "files", f"a saved scenario among {len(options.files)} files", accepted)
    names = ("task", "rate", "unit", "columns", "topic")
    unused = [f"--{name}" for name in names if getattr(options, name) is not None]
    if unused:
        raise DataError(found[0], ", ".join(unused), "an option beside a saved scenario", "the scenario alone")
    return read_scenario(found[0], known)


def _scenarios(options: argparse.Namespace, known: Known) -> Mapping[str, Saved]:
    """Read the scenarios that links may name, with a line for each that is refused. Raises DataError without any."""
    from dt_viz.saving import read_scenarios  # noqa: PLC0415

    if options.scenarios is None:
        return {}
    read, refused = read_scenarios(options.scenarios, known)
    for error in refused:
        print(f"{PROG}: {error}", file=sys.stderr)
    return read


def _own(options: argparse.Namespace, robot: Robot) -> Task:
    """Make a task of the files that are given: of demonstrations, or of a motion that the library has saved.

    Raises:
        DataError: they cannot be used.
    """
    from dt_viz.learning.demonstrations import load_demonstrations  # noqa: PLC0415
    from dt_viz.saving import is_motion, motion_task  # noqa: PLC0415
    from dt_viz.scenario.tasks import own_task  # noqa: PLC0415

    how = {name: getattr(options, name) for name in ("rate", "unit", "columns", "topic")}
    if len(options.files) == 1 and is_motion(Path(options.files[0])):
        return motion_task(Path(options.files[0]))
    return own_task(load_demonstrations(options.files, **how, arm=robot))


def _work(
    new_server: Callable[[socket.socket, Share], Server],
    prepare: Callable[[Share, threading.Event], None],
    share: Share,
    listening: socket.socket,
    ready: Callable[[], None] = lambda: None,
) -> int:
    """Serve in this process until it is interrupted; return the exit status where it cannot begin."""
    from dt_viz.folders import remove_abandoned  # noqa: PLC0415
    from dt_viz.ui.patches import GateError  # noqa: PLC0415

    remove_abandoned()
    try:
        server = new_server(listening, share)
    except GateError as error:
        print(f"{PROG}: {error}", file=sys.stderr)
        return 2
    ready()
    leaving = threading.Event()
    preparing = threading.Thread(target=prepare, args=(share, leaving), name="preparing")
    preparing.start()
    try:
        server.wait()
    finally:
        leaving.set()
        server.close()
        preparing.join()


def _num_processes(asked: int | None) -> int:
    """Return the number of processes: as many as asked for, or one for each core up to some, if the system can."""
    from dt_viz.serving.supervisor import several_reason  # noqa: PLC0415

    reason = several_reason()
    if asked is None:
        cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
        return 1 if reason else min(MOST_BY_DEFAULT, cores)
    if asked > 1 and reason:
        print(f"{PROG}: --processes: one process serves all, as {reason}", file=sys.stderr)
        return 1
    return asked


def _unused(options: argparse.Namespace) -> str:
    """Say which options do nothing without another one, or cannot be had with one; empty where there is none."""
    for names, needs, given in (
        (("end_effector", "home", "front", "srdf", "package_dir"), "--urdf", options.urdf),
        (("rate", "unit", "columns", "topic"), "FILE", options.files),
    ):
        unused = [f"--{name.replace('_', '-')}" for name in names if getattr(options, name) not in (None, [])]
        if unused and not given:
            return f"{', '.join(unused)}: found without {needs}; accepted: with {needs}"
    if options.present and (options.processes or 1) > 1:
        return f"--processes: found {options.processes}; accepted: 1 with --present, as one process has the scene"
    return ""


def _robot(options: argparse.Namespace) -> Robot:
    """Load the arm that is asked for. Raises DataError where it cannot be used, FileNotFoundError where it is gone."""
    from dt_viz.robot.models import load_arm, robot_from_urdf  # noqa: PLC0415

    bar = _Bar("Getting to know the arm, once")
    began = time.monotonic()

    def progress(fraction: float, message: str) -> None:
        if time.monotonic() - began > LOADED:
            bar(fraction, message)

    if options.urdf is None:
        return load_arm(options.arm, progress)
    given = (getattr(options, name) for name in ("urdf", "end_effector", "home", "front", "srdf", "package_dir"))
    return robot_from_urdf(*given, progress=progress)


@contextmanager
def _interruptible() -> Iterator[None]:
    """Have SIGTERM raise KeyboardInterrupt as Ctrl-C does, once: whoever asks again does not want to wait."""
    if threading.current_thread() is not threading.main_thread():
        yield  # only the main thread is told of signals
        return
    signals = signal.SIGINT, signal.SIGTERM

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        for number in signals:
            signal.signal(number, signal.SIG_DFL)
        raise KeyboardInterrupt

    before = [signal.signal(number, interrupt) for number in signals]
    try:
        yield
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


def _parser() -> argparse.ArgumentParser:
    parser = Parser(
        prog=PROG,
        description="Diffeomorphic transforms, live in the browser.",
        epilog=f"{PROG} {MEASURE} --help: the measurements of DT-Viz; {PROG} {PICTURE} --help: pictures of scenes",
    )
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=_port, default=8080, help="port to listen on (default: %(default)s)")
    parser.add_argument(
        "files",
        nargs="*",
        metavar="FILE",
        help="your own demonstrations: text, .npz, .npy, .mat, .json, .parquet, .hdf5, ROS bags, or folders of them; "
        "or one motion that the library has saved, or one scenario that the page has saved",
    )
    parser.add_argument(
        "--scenarios",
        type=Path,
        metavar="FOLDER",
        help="folder of scenarios that the page has saved: a link such as /?scenario=lesson-1 opens lesson-1.json",
    )
    parser.add_argument("--rate", type=float, metavar="HZ", help="samples per second of files without times")
    parser.add_argument("--unit", metavar="UNIT", help="units of the files, such as mm or cm,ms,deg, if not recognised")
    parser.add_argument("--columns", metavar="NAMES", help="names of the files' columns in order, such as t,x,y,z")
    parser.add_argument("--topic", metavar="TOPIC", help="topic of a bag, or frame of its transforms")
    arm = parser.add_argument_group("arm")
    which = arm.add_mutually_exclusive_group()
    which.add_argument(
        "--arm",
        default="jaco",
        metavar="NAME",
        help="jaco (default), panda, ur3, ur5, ur10, xarm7, z1, so100, so101, or a name of robot_descriptions",
    )
    which.add_argument("--urdf", type=Path, metavar="FILE", help="your own arm; what is not given below is found")
    arm.add_argument("--end-effector", metavar="FRAME", help="link of the URDF that is the tool's frame")
    arm.add_argument("--home", type=_angles, metavar="A,B,…", help="ready pose, rad: --home=0,-0.8,0,-2.4,0,1.6,0.8")
    arm.add_argument("--front", metavar="AXIS", help="x, -x, y or -y of the URDF's base: --front=-y")
    arm.add_argument("--srdf", type=Path, metavar="FILE", help="tool, poses, and links that may touch")
    arm.add_argument(
        "--package-dir", type=Path, action="append", default=[], metavar="DIR", help="folder of package:// addresses"
    )
    parser.add_argument("--task", help="task to begin with (default: your own data, else draw_s)")
    parser.add_argument(
        "--prepare-all",
        action="store_true",
        help="learn every task before the first visitor comes, not when it is chosen",
    )
    parser.add_argument(
        "--prepare-only", action="store_true", help="the same, and end: all is in the cache folder, as for an image"
    )
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument(
        "--max-sessions",
        type=_positive,
        metavar="N",
        help=f"visitors at a time; others wait (default: {MAX_SESSIONS}; {MAX_WATCHING} with --present)",
    )
    parser.add_argument(
        "--present",
        action="store_true",
        help="one scene for all: whoever opens the address with the key, which is printed, edits it; others watch",
    )
    parser.add_argument(
        "--max-of-address",
        type=_positive,
        metavar="N",
        help="visitors of one address that is not this machine's, as a room may share one (default: half of all; all "
        "with --present)",
    )
    parser.add_argument(
        "--processes",
        type=_processes,
        metavar="N",
        help=f"processes that share the visitors (default: one for each core, up to {MOST_BY_DEFAULT})",
    )
    parser.add_argument(
        "--allow-origin",
        type=_origin,
        action="append",
        default=[],
        metavar="URL",
        help="address under which browsers see the page, if it is not the server's own, such as that of a proxy: "
        "https://demo.example.org; can be given several times",
    )
    return parser


def _origin(text: str) -> str:
    from dt_viz.ui.gate import origin_of  # noqa: PLC0415 - imports numpy

    try:
        return origin_of(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def _port(text: str) -> int:
    port = int(text) if text.isdecimal() else -1
    if not 0 <= port <= MAX_PORT:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: 0 (any free port) to {MAX_PORT}")
    return port


def _angles(text: str) -> list[float]:
    try:
        return [float(angle) for angle in text.split(",")]
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: angles in rad, with commas between") from error


def _processes(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if not 1 <= number <= MAX_PROCESSES:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: 1 to {MAX_PROCESSES}")
    return number


def _positive(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: a whole number, 1 or more")
    return number


class _Bar:
    """Progress of what takes long the first time, on the terminal."""

    def __init__(self, title: str) -> None:
        self._title = title

    def __call__(self, fraction: float, message: str = "") -> None:
        print(f"\r{self._title}: {100 * fraction:3.0f} % {message:<40}", end="", flush=True)
        if fraction >= 1:
            print()


def _prepare(fits: FitStore, task: Task, robot: Robot, share: Share, leaving: threading.Event) -> None:
    """Compile the kernels that a drag calls and learn the first task, while the server answers.

    The first process does so for all; the others find both on disk.
    """
    from dt_viz.errors import UnwantedError  # noqa: PLC0415
    from dt_viz.kernels.compiled import READY  # noqa: PLC0415
    from dt_viz.learning.imitation import ImitationError  # noqa: PLC0415
    from dt_viz.learning.state import has_orientations  # noqa: PLC0415

    bar = _Bar(f"Learning {task.title}")

    def progress(fraction: float, message: str) -> None:
        if leaving.is_set():
            raise UnwantedError
        bar(fraction, message)

    try:
        while not share.may_prepare:
            if leaving.wait(0.1):
                return
        _compile_elsewhere(leaving)
        READY.set()
        if task.imitation is None and not has_orientations(task.demonstrations):  # else it is learned in milliseconds
            fits.get(task.demonstrations, progress=progress)
        _compile(robot, leaving)
        share.prepared()
    except UnwantedError:
        pass
    except ImitationError as error:
        print(f"{PROG}: {error}", file=sys.stderr)
    finally:
        READY.set()


def _compile_elsewhere(leaving: threading.Event) -> None:
    """Compile all kernels, unless they are cached, in a process: a compiler's memory is freed only with its process."""
    from dt_viz.files.processes import start_module  # noqa: PLC0415
    from dt_viz.kernels.compiled import is_wanted  # noqa: PLC0415

    if not is_wanted():
        return
    bar = _Bar(COMPILING)

    def follow(fractions: IO[bytes]) -> None:
        for line in fractions:
            bar(float(line))

    with start_module("dt_viz.avoidance", given=subprocess.PIPE, output=subprocess.PIPE) as process:
        threading.Thread(target=follow, args=(process.stdout,)).start()
        while process.poll() is None:
            if leaving.wait(0.1):
                process.kill()


def _compile(robot: Robot, leaving: threading.Event) -> None:
    """Load what a drag repeats; compile what is not kept."""
    from dt_viz.avoidance.arm import WholeArm  # noqa: PLC0415

    began, bar = time.monotonic(), _Bar(COMPILING)
    for fraction in WholeArm(robot).compiled():
        if time.monotonic() - began > LOADED:
            bar(fraction)
        if leaving.is_set():
            break
