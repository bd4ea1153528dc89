"""The first picture of each task is one in which every check holds, along every rollout."""

import numpy as np
import pytest

from dt_viz.avoidance.arm_solver import MARGIN_TOLERANCE
from dt_viz.motion.certificates import MAX_ROUND_TRIP
from dt_viz.motion.stack import FINE
from dt_viz.robot.models import load_jaco
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage
from dt_viz.ui.visitor import initial_scenario


@pytest.mark.long
@pytest.mark.parametrize(
    "task", [pytest.param(name, marks=() if name == "draw_s" else pytest.mark.slow) for name in TASKS]
)
def test_every_check_of_the_first_picture_holds(engine, at_rest, robot, task):
    scenario = initial_scenario(engine, task)
    frame = at_rest(scenario, Stage.CERTIFIED)
    certificates, report = frame.certificates, frame.certificates.collision
    assert (frame.blocked, certificates.found) == ((), ())
    assert certificates.lyapunov_falls
    assert certificates.min_det_jacobian > 0
    assert certificates.round_trip_error < MAX_ROUND_TRIP
    assert report.itself is None
    assert report.table.distance > 0
    assert np.linalg.norm(frame.reached - frame.goal) < 1e-5
    # the report is of the motion that the arm shows: look at the meshes on all of them, where one was in the way
    arm, margin = engine.solved(scenario, FINE).arm, scenario.avoidance.margin
    assert np.unique(arm.index).tolist() == list(range(len(frame.task.paths)))

    def clearance(q):
        return min(load_jaco().collision.obstacle_distance(q, part)[0].min() for part in scenario.obstacles)

    if task != "drop_pots":  # there it stands beyond the pots
        assert clearance(arm.q) < margin - MARGIN_TOLERANCE
    assert clearance(arm.p) > margin - MARGIN_TOLERANCE
    assert np.all((robot.lower <= arm.p) & (arm.p <= robot.upper))
