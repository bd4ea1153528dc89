"""Straight lines in configuration space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from dt_viz.baselines.base import Method, Plan, Planner, Problem
from dt_viz.baselines.postures import Query, planned
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.obstacles.union import Union


@dataclass(frozen=True, eq=False)
class _Planner:
    problem: Problem

    def plan(self, obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        """Plan without regard to the obstacle; see `Planner`."""
        queries = []
        for start in starts:
            queries.append(Query.of(self.problem, start))
        return planned(self.problem, queries, [np.stack([query.start, query.goal]) for query in queries])


class Linear(Method):
    """The straight line from the start's posture to the demonstrated goal posture, in the demonstrated duration."""

    name, title = "linear", "Linear"
    promise = "A path planned once, straight in the joints to the goal. It neither imitates nor avoids."
    stable, whole_arm, live = False, False, True
    avoids = False

    def fit(self, problem: Problem) -> Planner:
        """Take the task's postures; see `Method`."""
        return _Planner(problem)
