"""The whole arm's motions around an obstacle: what each of them promises, and what the joints follow."""

from dataclasses import replace

import numpy as np
import pytest

from dt_viz.collision import load_collision_model
from dt_viz.diffeo import Identity
from dt_viz.following import Follower
from dt_viz.metrics import resample_by_arc_length
from dt_viz.obstacles import Sphere
from dt_viz.scenario import Scenario
from dt_viz.solving import FINE, LIVE
from dt_viz.tasks import TASKS
from dt_viz.whole_arm import ROUNDING, ArmSolution, Lift, WholeArm

ELBOW = Sphere((0.04, -0.37, 0.38), 0.08)
"""In the way of the forearm that pushes the box, far from where the hand goes."""


class Case:
    """A task's motion, and what the arm makes of it."""

    def __init__(self, engine, robot, task):
        mean = np.mean([resample_by_arc_length(path, 101) for path in engine.task(task).paths], axis=0)
        x, y, z = mean[50]
        self.robot = robot
        self.scenario = Scenario(task, Sphere((float(x), float(y), float(z)), 0.15), space="cspace")
        self.ground = engine._ground(self.scenario, None)
        self.follower = Follower(robot)
        self.arm: WholeArm = self.follower.whole_arm
        self.lifted: Lift = self.follower.undisturbed(self.ground)
        self._known: dict[tuple[Scenario, bool], ArmSolution] = {}

    def avoiding(self, *, coarse=False, **changes) -> ArmSolution:
        scenario = replace(self.scenario, **changes)
        if (scenario, coarse) not in self._known:
            spacing = LIVE.spacing if coarse else FINE.spacing
            self._known[scenario, coarse] = self.arm.avoiding(self.lifted, scenario, spacing, coarse=coarse)
        return self._known[scenario, coarse]

    def truth(self, postures, obstacle) -> float:
        """Distance of the meshes from the obstacle on the motions through these postures, between them, too."""
        model = load_collision_model()
        return min(model.nearest_to_obstacle(q, obstacle).distance for q in postures)

    def beside(self, clearance, diameter=0.1) -> Sphere:
        """An obstacle that the arm passes at this distance."""
        x, y, z = self.scenario.obstacle.position
        q = self.lifted.tracked.q.reshape(-1, 6)
        low, high = 0.0, 1.0
        for _ in range(25):
            middle = (low + high) / 2
            near = self.arm.clearance(q, Sphere((x, y - middle, z), diameter)).min()
            low, high = (low, middle) if near > clearance else (middle, high)
        return Sphere((x, y - low, z), diameter)


@pytest.fixture(scope="module", params=list(TASKS), name="case")
def _case(request, engine, robot):
    return Case(engine, robot, request.param)


@pytest.fixture(scope="module", name="push")
def _push(engine, robot):
    return Case(engine, robot, "push_box")


def ends(solution):
    """Which samples are the first or the last of a rollout."""
    change = np.diff(solution.index) > 0
    return np.r_[True, change] | np.r_[change, True]


def split(solution, values):
    return np.split(values, np.flatnonzero(np.diff(solution.index)) + 1)


class TestNearMisses:
    @pytest.mark.parametrize("margin", [0.0, 0.01])
    @pytest.mark.parametrize("clearance", [0.0005, 0.002, 0.008])
    def test_what_comes_too_near_without_touching_is_taken_farther_away_or_left(self, case, margin, clearance):
        solution = case.avoiding(obstacle=case.beside(clearance), margin=margin, coarse=True)
        assert np.isfinite(solution.p).all()
        assert solution.clearance > min(clearance, 0.002) - ROUNDING

    def test_motions_that_are_to_avoid_nothing_may_collide(self, case):
        solution = case.arm.undisturbed(case.lifted, case.scenario, LIVE.spacing)
        assert not solution.cleared and solution.clearance < -0.05
        np.testing.assert_allclose(solution.p, solution.q, rtol=0, atol=1e-14)
        assert isinstance(solution.transform, Identity) and solution.duration == 0
