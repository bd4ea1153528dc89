"""Arm → Model on a page that nobody looks at: what is drawn and offered is the chosen arm's."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import viser  # noqa: TID251 - forges what a browser sends
from other_arms import seven_joints
from pages import NoFrames

from dt_viz.robot.placement import is_jaco
from dt_viz.scenario.paper_scenes import SCENES

TITLES = {"": "JACO", "panda": "Franka Panda"}
OF_JACO = {scene.title for scene in SCENES.values() if scene.of_jaco}


def taller():
    arm = seven_joints()
    shifts = arm.joint_translations.copy()
    shifts[0] += (0.0, 0.0, 0.05)
    return replace(arm, joint_translations=shifts)


@pytest.fixture
def page(opened_for):
    return opened_for(None, arms=cast(Any, SimpleNamespace(titles=TITLES, engine=lambda *_: NoFrames(taller()))))


def choose(page, title):
    page.claim(page["Model"], title)
    page.settle()


def num_joints(page):
    return max(name.count("joint_") for name in page.nodes if name.startswith("/arm/"))


@pytest.mark.long
def test_joints_scenes_plots_and_the_loop_are_those_of_the_arm(page):
    visitor, scenes = page.visitor, page["Scene"].options
    assert num_joints(page) == 6 and set(scenes) >= OF_JACO
    live, onion = visitor.robot.playback.live, visitor.pictures.layer("onion")
    assert page["Model"].options == tuple(TITLES.values()) and page["Model"].value == "JACO"
    choose(page, "Franka Panda")
    visitor._exchange("panda")
    robot = page.session.robot
    assert robot.num_joints == 7 and not is_jaco(robot)
    assert num_joints(page) == 7 and visitor.robot.playback.live is page.session.engine.arm is not live
    assert visitor.pictures.layer("onion") is not onion
    assert not OF_JACO & set(page["Scene"].options) and set(page["Scene"].options) < set(scenes)
    plots = visitor._panel.show.plots.joints[0]
    assert len(plots.speeds.series) == len(plots.speeds.data) == 1 + 7 + 1
    assert visitor.camera.framing.arm_size == robot.size
    visitor.robot.arms.pose(robot.home, robot.home)
    visitor.adopt(page.session.scenario)
    page.session.undo()
    assert page.session.scenario.arm == "" and page["Model"].value == "JACO"
    visitor._exchange("")
    assert num_joints(page) == 6 and visitor.robot.playback.live is live
    assert page["Scene"].options == scenes and len(plots.speeds.series) == 8


def test_a_scene_of_the_jaco_says_so_with_another_arm(page):
    choose(page, "Franka Panda")
    page.visitor._exchange("panda")
    title = next(title for title in page.commands if title in OF_JACO)
    page.give(page.commands[title])
    page.settle()
    said = page.session._screen.progress.message
    assert said is not None and said.text == f"“{title}” is made for the JACO: choose it in Arm → Model."
    assert page.session.scenario.scene == ""


def test_push_reaches_the_arm_that_is_drawn(page):
    pushed = []
    choose(page, "Franka Panda")
    page.session.engine.arm.push = lambda: pushed.append("panda")
    page["Push the hand"].disabled = False
    page.claim(page["Push the hand"], True)
    assert pushed == ["panda"] and np.array_equal(page.session.robot.home, taller().home)


def open_recording(page, robot, *others):
    """Open a file of the joint angles of an arm, and what else it has; return its rows."""
    u = np.linspace(0, 1, 100)
    rows = np.column_stack([3 * u, robot.home + np.outer(u - 1, np.linspace(0.3, 0.1, 6)), *others])
    header = ",".join(["t", *(f"joint{k}" for k in range(1, len(rows[0])))])
    content = "\n".join([header, *(",".join(map(str, row)) for row in rows)]).encode()
    page.settle()
    page.claim(page["Open a file, or drop it here"], viser.UploadedFile("a.csv", content))
    page.settle()
    return rows


@pytest.mark.long
def test_takes_that_are_open_are_read_again_for_another_arm(page):
    robot = page.session.robot
    rows = open_recording(page, robot, np.full(100, 0.5))  # six and a gripper, or seven
    takes = page.visitor.pictures._takes
    np.testing.assert_allclose(takes.goal.position, robot.end_effector(rows[-1:, 1:7])[0], atol=0.01)
    choose(page, "Franka Panda")
    page.visitor._exchange("panda")
    np.testing.assert_allclose(takes.goal.position, taller().end_effector(rows[-1:, 1:])[0], atol=0.01)
    assert takes.visible and page.visitor.robot._aside and not page["Learn"].disabled


@pytest.mark.long
def test_takes_of_another_arm_that_are_open_cannot_be_learned_for_this_one(page):
    open_recording(page, page.session.robot)
    for title, learns in (("JACO", True), ("Franka Panda", False), ("JACO", True)):
        choose(page, title)
        assert page["Learn"].disabled is not learns
    said = page.session._screen.progress.message
    assert said is not None and "angles of 6 joints" in said.text
