"""Straight lines in configuration space, from the start's posture to the demonstrated goal posture."""

from __future__ import annotations

import numpy as np

from dt_viz.baselines.base import Plan, Planner, Problem
from dt_viz.baselines.postures import Query, planned
from dt_viz.errors import Cancelled, never
from dt_viz.flows.fields import Array
from dt_viz.obstacles.union import Union


def fit(problem: Problem) -> Planner:
    """Take the task's postures."""

    def plan(obstacle: Union, starts: Array, cancelled: Cancelled = never) -> Plan:
        queries = [Query.of(problem, start) for start in starts]
        return planned(problem, queries, [np.stack([query.start, query.goal]) for query in queries])

    return plan
