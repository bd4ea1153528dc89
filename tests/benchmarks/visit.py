"""What a visitor of the page does and sees who is measured."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from dt_viz.flows.fields import Array
from dt_viz.obstacles.shapes import Point, as_point
from dt_viz.scenario.tasks import Task
from tests.protocol_client import ANSWERED, ROLLOUT, ProtocolClient


@dataclass(frozen=True)
class LoadSettings:
    """How visitors drag, and how long they wait; times in seconds."""

    edits_per_second: int = 20  # rate of a drag's edits; no page sends more
    radius: float = 0.06  # radius of the circle around the obstacle's place, in the task's slice, metres
    lap: float = 5.0  # time for one lap of it
    first_picture: float = 60.0  # longest accepted time until a visitor has a picture
    settled: float = 10.0  # time after the first pictures until nothing is refined any more
    patience: float = 60.0  # longest time to wait for the picture of the last edit
    burst: float = 2.0  # time that somebody in a lecture drags
    pause: float = 4.0  # time from there to the next drag, and from one change of the task to the next
    dragging: float = 1 / 4  # part of a lecture's visitors that drags
    changing: float = 1 / 20  # part of them that changes the task; the others look on
    seed: int = 0  # seed of who does what in a lecture, and of when each begins
    answered: float = 0.5  # time within which an edit counts as answered


SETTINGS = LoadSettings()


@dataclass
class Visit:
    """What one visitor sends and sees."""

    client: ProtocolClient
    edits: dict[Point, int] = field(default_factory=dict)  # numbers of the edits by their places
    sent: list[float] = field(default_factory=list)  # times at which they were sent, seconds of `time.perf_counter`
    seen: list[tuple[int, float]] = field(default_factory=list)
    """For each picture that answers an edit newer than before: the edit's number, and when it was there."""
    pings: list[float] = field(default_factory=list)  # round trips, seconds
    lost: str = ""  # reason for the end of the connection; empty while it lasts

    def see(self, name: str, changes: Mapping[str, Any], now: float) -> None:
        """Take a change of the page; see `ProtocolClient.changed`."""
        if name != ROLLOUT or "vertices" not in changes:
            return
        place = self.client.nodes[ANSWERED].get("position")
        edit = -1 if place is None else self.edits.get(as_point(place), -1)
        if edit > (self.seen[-1][0] if self.seen else -1):
            self.seen.append((edit, now))

    def watch(self, presenter: Visit) -> None:
        """See what answers the edits of another visitor, now and later."""
        self.edits, self.sent, self.client.changed = presenter.edits, presenter.sent, self.see

    async def drag(self, places: Sequence[Point]) -> None:
        """Drag the obstacle through places, and let it go."""
        self.client.changed = self.see
        await self.client.grab()
        began = time.perf_counter()
        for number, place in enumerate(places):
            await asyncio.sleep(max(0.0, began + number / SETTINGS.edits_per_second - time.perf_counter()))
            self.edits[place] = len(self.sent)
            self.sent.append(time.perf_counter())
            await self.client.move(place)
        await self.client.release()

    async def drag_in_bursts(self, places: Sequence[Point], first: float) -> None:
        """Drag the obstacle through some of the places, with pauses, in the time that all of them would take.

        The first drag begins after a part of the time from one drag to the next, as nobody is in step with others.
        """
        size = round(SETTINGS.edits_per_second * SETTINGS.burst)
        step = size + round(SETTINGS.edits_per_second * SETTINGS.pause)
        await asyncio.sleep(first * step / SETTINGS.edits_per_second)
        for begin in range(round(first * step), len(places), step):
            await self.drag(places[begin : begin + size])
            await asyncio.sleep(SETTINGS.pause)

    async def change_task(self, seconds: float, first: float) -> None:
        """Choose another task again and again, for some seconds, first after a part of a pause."""
        deadline = time.perf_counter() + seconds
        await asyncio.sleep(first * SETTINGS.pause)
        for number in itertools.count(1):
            titles = self.client.controls[self.client.find("Task")]["options"]
            await self.client.set("Task", titles[number % len(titles)])
            await asyncio.sleep(SETTINGS.pause)
            if time.perf_counter() > deadline:
                return

    @property
    def last_shown(self) -> bool:
        """Whether the last edit, if there is one, is answered."""
        return (self.seen[-1][0] if self.seen else -1) == len(self.sent) - 1

    @property
    def answered(self) -> float | None:
        """Part of the edits that are answered in time; None without any."""
        if not self.sent:
            return None
        edits, times = np.array(self.seen or [(-1, np.inf)]).T
        place = np.searchsorted(edits, np.arange(len(self.sent)))
        shown = np.append(times, np.inf)[place]
        return float(np.mean(shown - np.array(self.sent) <= SETTINGS.answered))

    def figures(self, seconds: float) -> dict[str, Any]:
        """The figures of a visitor that was to drag for so long; see the module. Later pictures do not count."""
        began = self.sent[0] if self.sent else 0.0
        during = [now for _, now in self.seen if now <= began + seconds]
        return {
            "pictures_per_s": len(during) / seconds,
            "gap_ms": spread(np.diff([began, *during, began + seconds])),
            "latency_ms": spread(np.array([now - self.sent[edit] for edit, now in self.seen])),
            "answered": self.answered,
            "last_shown": self.last_shown and not self.lost,
            "lost": self.lost,
        }


def places_of(task: Task, number: int, num_edits: int) -> list[Point]:
    """Return where one of several visitors drags the obstacle: a circle in the task's slice, no place twice."""
    edits = np.arange(num_edits)
    angles = 2 * np.pi * edits / (SETTINGS.edits_per_second * SETTINGS.lap) + number
    widening = 1e-7 * edits  # so that no place comes twice, metres
    circle = (SETTINGS.radius + widening)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return [as_point(place) for place in np.asarray(task.obstacle_position) + circle @ task.slice.axes.T]


def spread(seconds: Array) -> dict[str, float] | None:
    """Median, 95 % and largest of times, ms; None without any."""
    if not len(seconds):
        return None
    median, p95, worst = 1e3 * np.percentile(seconds, [50, 95, 100])
    return {"median": float(median), "p95": float(p95), "worst": float(worst)}
