"""Say what very many visitors need: cores, memory, bandwidth and cost, on paper and by simulation.

    python -m tests.benchmarks capacity --visitors 1000 100000 --out capacity.json

A visitor is as in the lecture of `evaluate load`: some drag in bursts, all others look on. What a picture and a visitor
cost is measured by `evaluate load --visitors 1 --seconds 15` and `--rest --visitors 8 --after 45 --processes 1`, and
given by options, whose defaults are of a shared core; prices are made up. A process computes on one core, one picture
after the other, for each who drags in turn, so that an edit is answered after a random part of a round, and a picture.

of a process
    largest number of visitors of a process of whose edits a part (`--answered`) is answered in time (`--within`): on
    paper, where the number of those who drag is binomial, and in a simulation of an hour, which counts.
cores
    one for each process.
GB, Gbit/s
    memory of all processes, and what they send.
€ a month
    of cores, and of what is sent, at prices that are options: look up your own.

Memory and cores grow with the number of visitors alone: a process knows nothing of others but some numbers of the
machine that it runs on.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass

import numpy as np
from scipy.stats import binom

from dt_viz.evaluate.options import TABLES, positive_number, report, whole_number
from dt_viz.evaluate.visit import SETTINGS
from dt_viz.flows.fields import Array

OUT = TABLES
MONTH = 30 * 24 * 3600
"""Number of seconds of a month."""
HOUR = 3600.0
"""Simulated time, seconds."""


@dataclass(frozen=True)
class Cost:
    """What visitors cost a process, and how they behave; times in seconds of one core."""

    picture: float
    """Time to compute and send a picture."""
    looking: float
    """Part of a core that each visitor takes who looks on."""
    dragging: float
    """Part of the visitors that drag at a moment, on average."""
    burst: float = SETTINGS.burst
    """Time that somebody drags without a pause."""
    rate: float = SETTINGS.edits_per_second
    """Number of edits in a second of dragging."""

    def slowed(self, num_visitors: int) -> float:
        """Return the time from one picture to the next beside what looking on takes; inf where that takes all."""
        left = 1.0 - self.looking * num_visitors
        return self.picture / left if left > 0.0 else np.inf

    def answered(self, num_visitors: int, within: float) -> float:
        """Return the part of the edits of a process' visitors that are answered in time, on paper."""
        picture, dragging = self.slowed(num_visitors), np.arange(1, num_visitors + 1)
        if not np.isfinite(picture):
            return 0.0
        edits = dragging * binom.pmf(dragging, num_visitors, self.dragging)  # of so many who drag, not normalised
        in_time = np.clip((within - picture) / (dragging * picture), 0.0, 1.0)
        return float(edits @ in_time / edits.sum())

    def pictures_per_s(self, num_visitors: int) -> float:
        """Return the number of pictures that a process sends in a second."""
        dragging = np.arange(num_visitors + 1)
        shown = np.minimum(dragging * self.rate, (dragging > 0) / self.slowed(num_visitors))
        return float(binom.pmf(dragging, num_visitors, self.dragging) @ shown)

    def largest(self, answered: float, within: float) -> int:
        """Return the largest number of visitors of a process of whose edits such a part is answered in time."""
        number = 0
        while self.answered(number + 1, within) >= answered:
            number += 1
        return number


def simulated(cost: Cost, num_visitors: int, within: float, generator: np.random.Generator) -> float:
    """Return the part of the edits that a process answers in time within an hour, picture by picture.

    Bursts and pauses have exponential lengths. Edits that a newer one has replaced are answered by its picture.
    """
    pause = cost.burst * (1.0 - cost.dragging) / cost.dragging
    picture = cost.slowed(num_visitors)
    edits = [_edits(cost, pause, generator) for _ in range(num_visitors)]
    next_edit = np.zeros(num_visitors, int)
    """Number of each visitor's first edit that is not answered yet."""
    now, turn, num_in_time = 0.0, 0, 0
    while now < HOUR:
        due = np.array([times[k] if k < len(times) else np.inf for times, k in zip(edits, next_edit, strict=True)])
        waiting = np.flatnonzero(due <= now)
        if not len(waiting):
            now = due.min()
            continue
        turn = int(waiting[np.searchsorted(waiting, turn + 1) % len(waiting)])
        begin, end = next_edit[turn], int(np.searchsorted(edits[turn], now, side="right"))
        now += picture
        num_in_time += int((now - edits[turn][begin:end] <= within).sum())
        next_edit[turn] = end
    return num_in_time / max(1, int(next_edit.sum()))


def _edits(cost: Cost, pause: float, generator: np.random.Generator) -> Array:
    """Times of a visitor's edits within the hour, seconds."""
    num = int(2 * HOUR / (cost.burst + pause)) + 50
    gaps = np.stack([generator.exponential(pause, num), generator.exponential(cost.burst, num)], axis=1)
    ends = np.cumsum(gaps).reshape(num, 2)
    bursts = [np.arange(begin, end, 1.0 / cost.rate) for begin, end in ends if begin < HOUR]
    return np.concatenate(bursts)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Define the command's arguments."""
    parser.add_argument("--visitors", type=whole_number(1), nargs="+", default=(1000, 100_000), help="at once")
    for name, default, text in (
        ("picture", 0.042, "time of one core for a picture, seconds"),
        ("looking", 0.006, "part of a core for each who looks on"),
        ("dragging", 0.083, "part of the visitors who drag at a moment"),
        ("answered", 0.95, "part of the edits that are answered in time"),
        ("within", 0.5, "that time, seconds"),
        ("kilobytes", 60.0, "size of a picture, kB"),
        ("process", 380.0, "memory of a process, MB"),
        ("visitor", 13.0, "memory of a visitor, MB"),
        ("core-price", 10.0, "price of a core and its memory for a month, €"),
        ("gigabyte-price", 0.02, "price of a GB that is sent, €"),
    ):
        told = f"{text} (default: {default})"
        parser.add_argument(f"--{name}", type=positive_number(name, 1e6), default=default, help=told)
    parser.add_argument("--seed", type=whole_number(0), default=0, help="of the simulation (default: 0)")


def run(options: argparse.Namespace) -> int:
    """Run the command; 1 if not even one visitor's edits are answered in time."""
    cost = Cost(options.picture, options.looking, options.dragging)
    number = cost.largest(options.answered, options.within)
    if not number:
        print("a process answers not even one visitor in time")
        return 1
    on_paper, part = number, 0.0
    while number and part < options.answered:  # what a drag asks for last is answered after it, which paper leaves out
        part = simulated(cost, number, options.within, np.random.default_rng(options.seed))
        number -= part < options.answered
    number = max(number, 1)
    rows = []
    for visitors in options.visitors:
        cores = -(-visitors // number)
        sent = cores * cost.pictures_per_s(number) * options.kilobytes * 1e3
        rows.append(
            {
                "visitors": str(visitors),
                "of a process, on paper": str(on_paper),
                "simulated": str(number),
                "answered in time %": 100 * part,
                "cores": str(cores),
                "GB": (cores * options.process + visitors * options.visitor) / 1e3,
                "Gbit/s": sent * 8 / 1e9,
                "cores, € a month": cores * options.core_price,
                "sent, € a month": sent * MONTH / 1e9 * options.gigabyte_price,
            }
        )
    report(rows)
    return 0
