"""Let obstacles cross the motion of the robot in the loop, on random smooth paths, and measure how it dodges.

An obstacle's path has its middle at the hand of the undisturbed motion, where the obstacle is when the hand would be.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from itertools import cycle, islice
from typing import Any

import numpy as np

from dt_viz.avoidance.avoidance import ArmAvoidance
from dt_viz.control.controller import ArmController, Phase
from dt_viz.control.courses import Section
from dt_viz.control.settings import ControllerSettings
from dt_viz.evaluate import options as shared
from dt_viz.flows.fields import Array
from dt_viz.metrics import arc_length, interpolate, resample_by_arc_length
from dt_viz.motion.stack import LIVE
from dt_viz.obstacles.shapes import ORIGIN, UPRIGHT, Box, Obstacle, Sphere, as_point, as_quaternion
from dt_viz.scenario.stack import avoiding
from dt_viz.session.engine import Engine

TICK = 0.01  # s from one tick to the next
LOOK_PERIOD = 0.03  # s from one look at the obstacles to the next
HALF_LENGTH = 0.40  # m, half the length of an obstacle's path
WIGGLE, WAVELENGTH = 0.04, 0.5  # m, amplitude and length of a path's waves
BOX = np.array([1.0, 0.8, 0.6])  # sides of a box, in diameters
PEDESTAL_ROOM = 0.10  # m from a path to the base and the first links, which no joint moves out of its way
TABLE_ROOM = 0.01  # m from the obstacle down to the table
START_ROOM = 0.05  # m from the undisturbed arm to an obstacle that comes
COMING_ROOM = 0.03  # m from the arm as it is to an obstacle that comes; with less room, other obstacles are drawn
LONGEST = 30.0  # s after the obstacles have gone within which the goal has to be reached
AT_GOAL = 1e-3  # m from the goal that count as reached


@dataclass(frozen=True, eq=False)
class Crossing:
    """Obstacles that cross a motion."""

    start: int  # of the rollout that the robot follows
    seconds: float  # that the robot takes without obstacles
    begins: float  # time at which the robot sets out, seconds
    places: Array  # (T, P, 3) centres at each tick until all are gone, metres; NaN for obstacles that are not there
    shapes: Sequence[Obstacle]  # the P obstacles, turned as they are on all their way

    def at(self, tick: int) -> tuple[Obstacle, ...]:
        """Return the obstacles that are there at a tick."""
        if tick >= len(self.places):
            return ()
        there = zip(self.shapes, self.places[tick], strict=True)
        return tuple(_moved(shape, place) for shape, place in there if np.isfinite(place[0]))


def _moved(shape: Obstacle, place: Array) -> Obstacle:
    return shape.moved(as_point(place), shape.wxyz)


class Bench:
    """A task's robot."""

    def __init__(self, engine: Engine, task: str, margin: float) -> None:
        self.margin, self.follower, self.robot = margin, engine.follower, engine.follower.robot
        self.solved = engine.solved(avoiding(engine.task(task), ArmAvoidance((), margin=margin)), LIVE)
        self.goal = self.solved.nominal.goal
        section = Section(self.robot, self.follower.reference(self.solved.nominal))
        self.starts = section.postures(self.solved.nominal.starts[:, None])[:, 0]

    def undisturbed(self, start: int) -> tuple[Array, Array]:
        """Return the hand's places (T, 3), m, and joints (T, n), rad, at all ticks without an obstacle, to the goal."""
        controller, q, passed = ArmController(self.follower, self.solved), self.starts[start], []
        while not passed or (controller.phase is not Phase.RESTING and len(passed) < LONGEST / TICK):
            passed.append(q)
            q = q + TICK * controller.step(q, TICK)
        return self.robot.end_effector(np.array(passed)), np.array(passed)


def crossings(bench: Bench, shape: Obstacle, speed: float, seed: int, num: int = 1) -> Iterator[Crossing]:
    """Yield crossings of so many obstacles of a shape at once, at a speed, m/s, without an end."""
    rng, undisturbed = np.random.default_rng(seed), cache(bench.undisturbed)
    for start in cycle(range(len(bench.starts))):
        hand, joints = undisturbed(start)
        drawn = [_drawn(bench, shape, hand, joints, speed, rng) for _ in range(num)]
        begins = max(0.0, *(-comes for comes, *_ in drawn))
        t = TICK * np.arange(np.ceil((begins + max(goes for _, goes, *_ in drawn)) / TICK)) - begins
        places = []
        for comes, goes, path, _ in drawn:
            places.append(interpolate(t, np.linspace(comes, goes, len(path)), path))
            places[-1][(t < comes) | (t >= goes)] = np.nan
        shapes = [shape for *_, shape in drawn]
        yield Crossing(start, TICK * len(hand), begins, np.stack(places, axis=1), shapes)


def _drawn(
    bench: Bench, shape: Obstacle, hand: Array, joints: Array, speed: float, rng: np.random.Generator
) -> tuple[float, float, Array, Obstacle]:
    """Draw an obstacle that crosses the hand (T, 3), m, and joints (T, n), rad, of an undisturbed motion.

    Returns when it comes and goes, s after the robot sets out, its path (N, 3), metres, and it where that begins.
    """
    body, wall = bench.follower.whole_arm, bench.robot.pedestal
    pedestal = wall.positions(bench.robot, bench.starts[0])
    while True:
        at = int(rng.uniform(0.25, 0.75) * len(hand))
        path = _path(hand[at] + rng.normal(scale=0.02, size=3), rng)
        turn = UPRIGHT if isinstance(shape, Sphere) else as_quaternion(rng.normal(size=4))
        first = shape.moved(as_point(path[0]), turn)
        half = float(arc_length(path)[-1]) / 2 / speed  # s
        room = np.linalg.norm(path[:, None] - pedestal, axis=2) - wall.radius - first.radius
        passing = joints[max(0, at - round(half / TICK))]
        if (
            path[:, 2].min() >= first.radius + TABLE_ROOM
            and room.min() >= PEDESTAL_ROOM
            and body.clearance(passing[None], first)[0] >= START_ROOM
        ):
            return at * TICK - half, at * TICK + half, path, first


def _path(middle: Array, rng: np.random.Generator) -> Array:
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    s, phase = np.linspace(-HALF_LENGTH, HALF_LENGTH, 201), rng.uniform(0, 2 * np.pi)
    wave = WIGGLE * (np.sin(2 * np.pi * s / WAVELENGTH + phase) - np.sin(phase))
    return resample_by_arc_length(middle + np.outer(s, axes[:, 0]) + np.outer(wave, axes[:, 1]), 401)


def simulated(bench: Bench, crossing: Crossing) -> tuple[Array, Array, set[Phase]]:
    """Run the arm, which looks at the obstacles now and then, until it rests at the goal, or for too long.

    Returns its joint angles (T, n), rad, processor times of the ticks, seconds, and phases of the motion.
    """
    controller, q, phases = ArmController(bench.follower, bench.solved), bench.starts[crossing.start].copy(), set()
    passed, seconds = [], []
    controller.begin(q, crossing.start)
    controller.home(crossing.start)
    looks, went, present = 0.0, False, True
    for k in range(len(crossing.places) + int((crossing.begins + LONGEST) / TICK)):
        t = k * TICK
        passed.append(q)
        if k >= len(crossing.places) and not present and controller.phase is Phase.RESTING:
            break
        if not went and t >= crossing.begins:
            controller.go()
            went = True
        parts = crossing.at(k)
        if t >= looks and (parts or present):
            present, looks = bool(parts), t + LOOK_PERIOD
            controller.see(ArmAvoidance(parts, margin=bench.margin))
        began = time.thread_time()
        q = q + TICK * controller.step(q, TICK)
        seconds.append(time.thread_time() - began)
        phases.add(controller.phase)
    return np.array(passed), np.array(seconds), phases


def room_at_coming(bench: Bench, q: Array, crossing: Crossing) -> float:
    """Return the smallest distance of the arm, q (T, n), from an obstacle at the tick at which that comes, metres."""
    ticks = np.isfinite(crossing.places[:, :, 0]).argmax(axis=0)
    coming = [(q[[k]], _moved(crossing.shapes[n], crossing.places[k, n])) for n, k in enumerate(ticks)]
    return min(float(bench.follower.whole_arm.clearance(*each)[0]) for each in coming)


def smallest_distance(bench: Bench, passed: Array, crossing: Crossing) -> float:
    """Return the smallest distance of the arm's meshes from the obstacles, at and at five places between ticks, m."""
    cover, model, best = bench.robot.body, bench.robot.collision, np.inf
    for shape, centres in zip(crossing.shapes, crossing.places.transpose(1, 0, 2), strict=True):
        (there,) = np.nonzero(np.isfinite(centres[:, 0]))
        finely = np.linspace(there[0], there[-1], 6 * (len(there) - 1) + 1)
        q, places = (interpolate(finely, there, values[there]) for values in (passed, centres))
        points = cover.positions(bench.robot, q) - places[:, None]
        bounds = (_moved(shape, np.zeros(3)).signed_distance(points) - cover.radius).min(axis=1)
        for k in np.argsort(bounds):  # the spheres cover the meshes
            if bounds[k] >= best:
                break
            best = min(best, float(model.obstacle_distance(q[[k]], _moved(shape, places[k]))[0][0]))
    return best


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    metres, speed = shared.positive_number("metres", 1), shared.positive_number("m/s", 2)
    shared.add_task(parser)
    parser.add_argument("--speed", type=speed, required=True, metavar="V", help="of obstacles")
    parser.add_argument("--runs", type=shared.whole_number(1), default=20, help="(default: %(default)s)")
    parser.add_argument("--seed", type=shared.whole_number(0), default=0, help="of the paths (default: %(default)s)")
    parser.add_argument("--obstacles", type=shared.whole_number(1), default=1, help="at once (default: %(default)s)")
    parser.add_argument("--boxes", action="store_true", help="boxes of D × 0.8 D × 0.6 D, turned, not spheres")
    parser.add_argument("--diameter", type=metres, default=0.15, metavar="D", help="metres (default: %(default)s)")
    parser.add_argument("--margin", type=metres, default=0.03, metavar="M", help="metres (default: %(default)s)")
    shared.add_output(parser, ".npz")


def run(options: argparse.Namespace) -> int:
    """Run the command."""
    task, margin, shape = shared.chosen_task(options), options.margin, Sphere(ORIGIN, options.diameter)
    if options.boxes:
        shape = Box.of_extents(as_point(options.diameter * BOX))
    bench = shared.Made(lambda: Bench(shared.engine_of(task), task.name, margin))
    drawn = crossings(bench(), shape, options.speed, options.seed, options.obstacles)
    arrays: dict[str, Any] = {"diameter": options.diameter}
    figures: list[dict[str, Any]] = []
    while len(figures) < options.runs:  # obstacles that had no room to come are not counted
        wanted = [*islice(drawn, options.runs - len(figures))]
        for crossing, found in zip(wanted, shared.computed(options, partial(_measured, bench), wanted), strict=True):
            if found is None:
                continue
            i, (q, phases, of_run) = len(figures), found
            gone = np.full((len(q), *crossing.places.shape[1:]), np.nan)
            places = np.concatenate([crossing.places, gone])[: len(q)]
            arrays |= {f"q_{i}": q, f"t_{i}": TICK * np.arange(len(q))}
            arrays |= {f"wxyz_{i}": [one.wxyz for one in crossing.shapes]}
            arrays |= {f"obstacle_{i}": places[:, 0] if options.obstacles == 1 else places}
            values = (f"{name} {shared.as_text(value)}" for name, value in of_run.items() if name != "ticks")
            print(i, ", ".join(values), *sorted(phase.value for phase in phases), flush=True)
            figures.append(of_run)
    shared.write_npz(options.out, arrays)
    size = f"{options.obstacles} {'box' if options.boxes else 'sphere'}(s) of {options.diameter:g} m"
    print(f"\n{task.name}, {size} at {options.speed:g} m/s, margin {margin:g} m")
    shared.report([summary(figures)])
    return 0


def _measured(bench: shared.Made[Bench], crossing: Crossing) -> tuple[Array, set[Phase], dict[str, Any]] | None:
    """Run one crossing; None without room for an obstacle to come."""
    q, seconds, phases = simulated(bench(), crossing)
    if room_at_coming(bench(), q, crossing) < COMING_ROOM:
        return None
    return q, phases, figures_of(bench(), crossing, q) | {"ticks": seconds}


def figures_of(bench: Bench, crossing: Crossing, q: Array) -> dict[str, Any]:
    """Measure a run q (T, n): distances, mm; times, s; velocity and acceleration, at most, relative to the limits."""
    velocity = np.diff(q, axis=0, prepend=q[:1]) / TICK
    return {
        "clearance": 1e3 * smallest_distance(bench, q, crossing),
        "missed": 1e3 * float(np.linalg.norm(bench.robot.end_effector(q[-1]) - bench.goal)),
        "velocity": float((np.abs(velocity) / bench.robot.velocity_limits).max()),
        "acceleration": float(np.abs(np.diff(velocity, axis=0)).max() / TICK / ControllerSettings().acceleration),
        "lost": TICK * (len(q) - 1) - crossing.begins - crossing.seconds,  # beside the motion without obstacles
    }


def summary(found: Sequence[Mapping[str, Any]]) -> shared.Row:
    """Return the row of the table: the figures of all runs; velocity and acceleration relative to the limits."""
    by_name = {name: [figures[name] for figures in found] for name in found[0]}
    num, ticks = len(found), 1e3 * np.concatenate(by_name["ticks"])
    return {
        "": "in the loop",
        "without contact": f"{sum(clearance > 0 for clearance in by_name['clearance'])} of {num}",
        "clearance mm": f"{min(by_name['clearance']):.1f}",
        "goal reached": f"{sum(missed <= 1e3 * AT_GOAL for missed in by_name['missed'])} of {num}",
        "velocity": f"{max(by_name['velocity']):.3f}",
        "acceleration": f"{max(by_name['acceleration']):.3f}",
        "time lost s": f"{np.median(by_name['lost']):.1f} ({max(by_name['lost']):.1f})",
        "tick ms": f"{np.median(ticks):.2f} ({np.percentile(ticks, 95):.1f}, {ticks.max():.0f})",
    }
