"""The section that lifts the end effector's motion: the best postures with the hand in place, exactly."""

import numpy as np

from dt_viz.control.section import Section
from dt_viz.robot.inverse_kinematics import track
from dt_viz.scenario.scenario import Scenario


def test_it_is_what_tracking_computes_and_nothing_beside_it_with_the_hand_in_place_is_better(engine, robot):
    nominal = engine.nominal(Scenario("push_box"))
    lifted = engine.follower.undisturbed(nominal)
    section, q = Section(robot, lifted.reference), lifted.tracked.q
    assert np.abs(section.postures(robot.end_effector(q)) - q).max() < 1e-3  # where a waypoint of `track` is done
    paths = nominal.bundle.positions.reshape(len(q), -1, 3)
    exact = section.postures(paths)
    np.testing.assert_allclose(robot.end_effector(exact), paths, rtol=0, atol=1e-13)
    # tracking that begins there goes nowhere, but for the damping of its pseudo-inverse
    start = np.broadcast_to(lifted.reference, q[:, 0].shape)
    tracked = track(robot, paths[:, ::10], start, exact[:, ::10], reference=start).q
    np.testing.assert_allclose(tracked, exact[:, ::10], rtol=0, atol=1e-5)
