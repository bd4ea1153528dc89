"""The command line of the demo."""

from __future__ import annotations

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from pathlib import Path

MAX_PORT = 65535


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the server; returns the process' exit status."""
    options = _parser().parse_args(arguments)
    # several visitors share the cores; BLAS threads for small matrices cost more than they gain
    os.environ.setdefault("OMP_NUM_THREADS", "1")
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    # numerical libraries read these when they are first imported
    from dt_viz.errors import DataError  # noqa: PLC0415
    from dt_viz.fits import FitStore, default_cache_folder  # noqa: PLC0415
    from dt_viz.imitation import ImitationError  # noqa: PLC0415
    from dt_viz.obstacles import unit_sphere_map  # noqa: PLC0415
    from dt_viz.tasks import TASKS, lasa_tasks  # noqa: PLC0415
    from dt_viz.ui.server import AddressError, Server  # noqa: PLC0415

    logging.basicConfig(level=logging.WARNING, format="%(levelname)s %(name)s: %(message)s")
    try:
        tasks = {**TASKS, **(lasa_tasks(options.lasa) if options.lasa is not None else {})}
        if options.task not in tasks:
            print(f"app.py: --task: found {options.task!r}; accepted: {', '.join(tasks)}", file=sys.stderr)
            return 2
        fits = FitStore(default_cache_folder())
        first = tasks[options.task]()
        fits.get(first.demonstrations, progress=_Bar(first.title))
        unit_sphere_map()
        server = Server(
            tasks,
            fits,
            task=options.task,
            host=options.host,
            port=options.port,
            max_sessions=options.max_sessions,
        )
    except (DataError, ImitationError, AddressError) as error:
        print(f"app.py: {error}", file=sys.stderr)
        return 2
    host = f"[{server.host}]" if ":" in server.host else server.host
    print(f"DT-Viz is at http://{host}:{server.port} (Ctrl-C stops it)", flush=True)
    try:
        server.wait()
    except KeyboardInterrupt:
        server.close()
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="app.py", description="Diffeomorphic transforms, live in the browser.")
    parser.add_argument("--host", default="127.0.0.1", help="address to listen on (default: %(default)s)")
    parser.add_argument("--port", type=_port, default=8080, help="port to listen on (default: %(default)s)")
    parser.add_argument("--task", default="draw_s", help="task to begin with (default: %(default)s)")
    parser.add_argument("--lasa", type=Path, metavar="DIR", help="folder of LASA .mat files, each becomes a task")
    parser.add_argument(
        "--max-sessions", type=_positive, default=8, help="visitors at a time, each with a scene (default: %(default)s)"
    )
    return parser


def _port(text: str) -> int:
    port = int(text) if text.isdecimal() else -1
    if not 0 <= port <= MAX_PORT:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: 0 (any free port) to {MAX_PORT}")
    return port


def _positive(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if number < 1:
        raise argparse.ArgumentTypeError(f"found {text!r}; accepted: a whole number, 1 or more")
    return number


class _Bar:
    """Progress of the first fit, on the terminal."""

    def __init__(self, title: str) -> None:
        self._title = title

    def __call__(self, fraction: float, message: str) -> None:
        print(f"\rLearning {self._title}: {100 * fraction:3.0f} % {message:<40}", end="", flush=True)
        if fraction >= 1:
            print()
