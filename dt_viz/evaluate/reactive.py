"""Let obstacles cross the motion of the robot in the loop, on random smooth paths, and measure how it dodges.

An obstacle's path has its middle at the hand of the undisturbed motion, and the obstacle is there when the hand would
be. The npz file holds for run i:

``q_i`` (T, n), ``t_i`` (T,), ``obstacle_i`` (T, 3), or (T, P, 3) for P > 1 obstacles
    joint angles, rad, seconds, and the obstacle's centre, metres, at each tick; NaN while it is not there.
``wxyz_i`` (P, 4)
    orientations of boxes.

and ``diameter``, metres.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from itertools import cycle, islice
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.control.section import Section
from dt_viz.control.settings import ControllerSettings
from dt_viz.evaluate.options import (
    Row,
    add_task,
    as_text,
    chosen_task,
    engine_of,
    positive_number,
    report,
    whole_number,
    write_npz,
)
from dt_viz.evaluate.sweep import Swept, add_workers, sweep
from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length, interpolate, resample_by_arc_length
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import UPRIGHT, Box, Obstacle, Quaternion, Sphere, as_point, as_quaternion
from dt_viz.scenario.stack import avoiding
from dt_viz.scenario.tasks import Task
from dt_viz.session.engine import Engine

OUT = "FILE.npz"


@dataclass(frozen=True)
class CrossingSettings:
    """How obstacles cross, and what is a success; lengths in metres, times in seconds."""

    tick: float = 0.01
    """Time between two ticks."""
    look_period: float = 0.03
    """Time between two looks at the obstacles."""
    half_length: float = 0.40
    """Half the length of an obstacle's path."""
    wiggle: float = 0.04
    """Amplitude of a path's waves."""
    wavelength: float = 0.5
    """Length of a path's waves."""
    box: tuple[float, float, float] = (1.0, 0.8, 0.6)
    """Sides of a box, in diameters."""
    pedestal_room: float = 0.10
    """Distance that a path keeps from the base and the first links, which no joint moves out of its way."""
    table_room: float = 0.01
    """Height of the obstacle above the table."""
    start_room: float = 0.05
    """Distance of the arm from an obstacle that comes, where the arm is undisturbed."""
    coming_room: float = 0.03
    """That distance from the arm as it is, which may have given way to another one: with less, others are drawn."""
    longest: float = 30.0
    """Time after the obstacle has gone within which the goal has to be reached."""
    at_goal: float = 1e-3
    """Distance from the goal that counts as reached."""


SETTINGS = CrossingSettings()
TICK = SETTINGS.tick


@dataclass(frozen=True, eq=False)
class Crossing:
    """Obstacles that cross a motion."""

    start: int
    """Rollout that the robot follows."""
    begins: float
    """Time at which the robot sets out, seconds."""
    places: Array
    """(T, P, 3) centres of the obstacles at each tick until all are gone, metres; NaN for those that are not there."""
    wxyz: Sequence[Quaternion]

    def at(self, tick: int) -> Array:
        """(P, 3) the centres, metres; NaN for those that are not there."""
        return self.places[tick] if tick < len(self.places) else np.full_like(self.places[0], np.nan)


@dataclass
class Run:
    """What happened."""

    q: list[Array] = field(default_factory=list)
    """(n,) joint angles at each tick, rad."""
    ticks: list[float] = field(default_factory=list)
    """Processor times of the ticks, seconds."""
    phases: set[Phase] = field(default_factory=set)


class Bench:
    """A task's robot."""

    def __init__(self, engine: Engine, task: str, diameter: float, margin: float, *, boxes: bool = False) -> None:
        self.diameter, self.margin, self.boxes = diameter, margin, boxes
        self.follower, self.robot = engine.follower, engine.follower.robot
        self.solved = engine.solved(avoiding(engine.task(task), ArmAvoidance((), margin=margin)), LIVE)
        self.goal = self.solved.nominal.goal
        section = Section(self.robot, self.follower.reference(self.solved.nominal))
        self.starts = section.postures(self.solved.nominal.starts[:, None])[:, 0]

    def shape(self, place: Array, wxyz: Quaternion = UPRIGHT) -> Obstacle:
        """The sphere, or box, with its centre at a place (3,), metres."""
        if self.boxes:
            a, b, c = (self.diameter * side for side in SETTINGS.box)
            return Box(as_point(place), (a, b, c), wxyz)
        return Sphere(as_point(place), self.diameter)

    def obstacles(self, crossing: Crossing, tick: int) -> tuple[Obstacle, ...]:
        """Those that are there at a tick."""
        places = zip(crossing.at(tick), crossing.wxyz, strict=True)
        return tuple(self.shape(place, wxyz) for place, wxyz in places if np.isfinite(place[0]))

    def undisturbed(self, start: int) -> tuple[Array, Array]:
        """The hand's places (T, 3), metres, and joints (T, n) at all ticks without a sphere."""
        joints = driven(ArmController(self.follower, self.solved), self.starts[start])
        return self.robot.end_effector(joints), joints


def new_bench(task: Task, diameter: float, margin: float, *, boxes: bool) -> Bench:
    """A bench with an engine of its own."""
    return Bench(engine_of(task), task.name, diameter, margin, boxes=boxes)


def driven(controller: ArmController, q: Array) -> Array:
    """Return the joints (T, n), rad, at all ticks of a robot from a posture q (n,) on until it rests at the goal."""
    passed = []
    while len(passed) < SETTINGS.longest / TICK:
        passed.append(q)
        q = q + TICK * controller.step(q, TICK)
        if controller.phase is Phase.RESTING:
            break
    return np.array(passed)


def crossings(bench: Bench, speed: float, seed: int, num: int = 1) -> Iterator[tuple[Crossing, float]]:
    """Obstacles that cross, so many at once, and the seconds that the robot takes without them; without an end."""
    rng, undisturbed = np.random.default_rng(seed), cache(bench.undisturbed)
    for start in cycle(range(len(bench.starts))):
        hand, joints = undisturbed(start)
        drawn = [_drawn(bench, hand, joints, speed, rng) for _ in range(num)]
        begins = max(0.0, *(-comes for comes, _, _ in drawn))
        durations = [arc_length(path)[-1] / speed for _, path, _ in drawn]
        gone = [begins + comes + duration for (comes, *_), duration in zip(drawn, durations, strict=True)]
        t = TICK * np.arange(np.ceil(max(gone) / TICK))
        places = np.full((len(t), num, 3), np.nan)
        for n, (comes, path, _) in enumerate(drawn):
            there = (begins + comes <= t) & (t < gone[n])
            passed = (t[there] - begins - comes) / durations[n]
            places[there, n] = interpolate(passed, np.linspace(0, 1, len(path)), path)
        yield Crossing(start, begins, places, [wxyz for *_, wxyz in drawn]), TICK * len(hand)


def _drawn(
    bench: Bench, hand: Array, joints: Array, speed: float, rng: np.random.Generator
) -> tuple[float, Array, Quaternion]:
    """Draw an obstacle that will be at the hand: when it comes, s after the robot sets out, its path (N, 3), its turn.

    Args:
        bench: its robot.
        hand: (T, 3) at all ticks of the undisturbed motion, metres.
        joints: (T, n) there, rad.
        speed: of the obstacle, m/s.
        rng: what it is drawn by.
    """
    body, wall = bench.follower.whole_arm, bench.robot.pedestal
    pedestal = wall.positions(bench.robot, bench.starts[0])
    while True:
        at = int(rng.uniform(0.25, 0.75) * len(hand))
        path = _path(hand[at] + rng.normal(scale=0.02, size=3), rng)
        first = bench.shape(path[0], as_quaternion(rng.normal(size=4)) if bench.boxes else UPRIGHT)
        length = float(arc_length(path)[-1])
        room = np.linalg.norm(path[:, None] - pedestal, axis=2) - wall.radius - first.radius
        passing = joints[max(0, at - round(length / 2 / speed / TICK))]
        if (
            path[:, 2].min() >= first.radius + SETTINGS.table_room
            and room.min() >= SETTINGS.pedestal_room
            and body.clearance(passing[None], first)[0] >= SETTINGS.start_room
        ):
            return at * TICK - length / 2 / speed, path, first.wxyz


def _path(middle: Array, rng: np.random.Generator) -> Array:
    """A wavy path (N, 3) through a place (3,), evenly sampled."""
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    s, phase = np.linspace(-SETTINGS.half_length, SETTINGS.half_length, 201), rng.uniform(0, 2 * np.pi)
    wave = SETTINGS.wiggle * (np.sin(2 * np.pi * s / SETTINGS.wavelength + phase) - np.sin(phase))
    return resample_by_arc_length(middle + np.outer(s, axes[:, 0]) + np.outer(wave, axes[:, 1]), 401)


def simulated(bench: Bench, crossing: Crossing) -> Run:
    """Run the arm until it rests at the goal, or so many seconds after the obstacles have gone.

    The controller looks at the obstacles now and then.
    """
    controller, run, q = ArmController(bench.follower, bench.solved), Run(), bench.starts[crossing.start].copy()
    controller.begin(q, crossing.start)
    controller.home(crossing.start)
    looks, went, present = 0.0, False, True
    for k in range(len(crossing.places) + int((crossing.begins + SETTINGS.longest) / TICK)):
        t = k * TICK
        run.q.append(q)
        if k >= len(crossing.places) and went and not present and controller.phase is Phase.RESTING:
            break
        if not went and t >= crossing.begins:
            controller.go()
            went = True
        parts = bench.obstacles(crossing, k)
        if t >= looks and (parts or present):
            present, looks = bool(parts), t + SETTINGS.look_period
            controller.see(ArmAvoidance(parts, margin=bench.margin))
        began = time.thread_time()
        q = q + TICK * controller.step(q, TICK)
        run.ticks.append(time.thread_time() - began)
        run.phases.add(controller.phase)
    return run


def room_at_coming(bench: Bench, run: Run, crossing: Crossing) -> float:
    """Smallest distance of the arm from an obstacle at the tick at which that comes, metres."""
    ticks = np.isfinite(crossing.places[:, :, 0]).argmax(axis=0)
    coming = [(run.q[k][None], bench.shape(crossing.places[k, n], crossing.wxyz[n])) for n, k in enumerate(ticks)]
    return min(float(bench.follower.whole_arm.clearance(q, obstacle)[0]) for q, obstacle in coming)


def smallest_distance(bench: Bench, run: Run, crossing: Crossing) -> float:
    """Smallest distance of the arm's meshes from the obstacles, at the ticks and at five places between two, metres."""
    cover, model, best = bench.robot.body, bench.robot.collision, np.inf
    for wxyz, centres in zip(crossing.wxyz, crossing.places.transpose(1, 0, 2), strict=True):
        (there,) = np.nonzero(np.isfinite(centres[:, 0]))
        finely = np.linspace(there[0], there[-1], 6 * (len(there) - 1) + 1)
        q, places = (interpolate(finely, there, values[there]) for values in (np.array(run.q), centres))
        points = cover.positions(bench.robot, q) - places[:, None]
        bounds = (bench.shape(np.zeros(3), wxyz).signed_distance(points) - cover.radius).min(axis=1)
        for k in np.argsort(bounds):  # the spheres cover the meshes
            if bounds[k] >= best:
                break
            best = min(best, float(model.obstacle_distance(q[[k]], bench.shape(places[k], wxyz))[0][0]))
    return best


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the subcommand's arguments."""
    add_task(parser)
    parser.add_argument("--speed", type=positive_number("m/s", 2), required=True, metavar="V", help="of the obstacle")
    parser.add_argument("--runs", type=whole_number(1), default=20, help="(default: %(default)s)")
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the paths (default: %(default)s)")
    parser.add_argument("--obstacles", type=whole_number(1), default=1, help="at once (default: %(default)s)")
    parser.add_argument("--boxes", action="store_true", help="boxes of D × 0.8 D × 0.6 D, turned, not spheres")
    parser.add_argument("--diameter", type=positive_number("metres", 1), default=0.15, metavar="D", help="metres")
    parser.add_argument("--margin", type=positive_number("metres", 1), default=0.03, metavar="M", help="metres")
    add_workers(parser)


def run(options: argparse.Namespace) -> int:
    """Run the subcommand."""
    _, task = chosen_task(options)
    arrays: dict[str, Any] = {"diameter": options.diameter}
    figures: list[dict[str, Any]] = []
    make = partial(new_bench, task, options.diameter, options.margin, boxes=options.boxes)
    with sweep(options, make) as (bench, swept):
        for crossing, found, figures_of_run in measured(bench, swept, options):
            i, ticks = len(figures), range(len(found.q))
            places = np.array([crossing.at(k) for k in ticks])
            figures.append(figures_of_run)
            arrays |= {f"q_{i}": found.q, f"t_{i}": TICK * np.array(ticks)}
            arrays |= {f"obstacle_{i}": places[:, 0] if options.obstacles == 1 else places}
            arrays[f"wxyz_{i}"] = crossing.wxyz
            values = (f"{name} {as_text(value)}" for name, value in figures[i].items() if name != "ticks")
            print(i, ", ".join(values), *sorted(phase.value for phase in found.phases), flush=True)
    write_npz(options.out, **arrays)
    shape = "box" if options.boxes else "sphere"
    size = f"{options.obstacles} {shape}(s) of {options.diameter:g} m"
    print(f"\n{task.name}, {size} at {options.speed:g} m/s, margin {options.margin:g} m")
    report([summary(figures)])
    return 0


def measured(bench: Bench, swept: Swept, options: argparse.Namespace) -> Iterator[tuple[Crossing, Run, dict[str, Any]]]:
    """Run crossings, as many at a time as are still wanted, until so many had the room to come; give their figures."""
    drawn, left = crossings(bench, options.speed, options.seed, options.obstacles), options.runs
    while left:
        for measured in swept(_measured, [*islice(drawn, left)]):
            if measured is not None:
                left -= 1
                yield measured


def _measured(bench: Bench, drawn: tuple[Crossing, float]) -> tuple[Crossing, Run, dict[str, Any]] | None:
    """Run one crossing; None without room for an obstacle to come."""
    crossing, seconds = drawn
    found = simulated(bench, crossing)
    if room_at_coming(bench, found, crossing) < SETTINGS.coming_room:
        return None
    return crossing, found, figures_of(bench, crossing, found, seconds)


def figures_of(bench: Bench, crossing: Crossing, run: Run, seconds: float) -> dict[str, Any]:
    """Measure a run: distances in mm and times in s; velocity and acceleration, at most, relative to the limits."""
    q = np.array(run.q)
    velocity = np.diff(q, axis=0, prepend=q[:1]) / TICK
    return {
        "clearance": 1e3 * smallest_distance(bench, run, crossing),
        "missed": 1e3 * float(np.linalg.norm(bench.robot.end_effector(q[-1]) - bench.goal)),
        "velocity": float((np.abs(velocity) / bench.robot.velocity_limits).max()),
        "acceleration": float(np.abs(np.diff(velocity, axis=0)).max() / TICK / ControllerSettings().acceleration),
        "lost": TICK * (len(q) - 1) - crossing.begins - seconds,  # beside the motion without obstacles
        "ticks": np.array(run.ticks),
    }


def summary(found: Sequence[Mapping[str, Any]]) -> Row:
    """Row of the table: the figures of all runs; velocity and acceleration relative to the limits."""
    by_name = {name: [figures[name] for figures in found] for name in found[0]}
    num, ticks = len(found), 1e3 * np.concatenate(by_name["ticks"])
    return {
        "": "in the loop",
        "without contact": f"{sum(clearance > 0 for clearance in by_name['clearance'])} of {num}",
        "clearance mm": f"{min(by_name['clearance']):.1f}",
        "goal reached": f"{sum(missed <= 1e3 * SETTINGS.at_goal for missed in by_name['missed'])} of {num}",
        "velocity": f"{max(by_name['velocity']):.3f}",
        "acceleration": f"{max(by_name['acceleration']):.3f}",
        "time lost s": f"{np.median(by_name['lost']):.1f} ({max(by_name['lost']):.1f})",
        "tick ms": f"{np.median(ticks):.2f} ({np.percentile(ticks, 95):.1f}, {ticks.max():.0f})",
    }
