"""Tasks are placed where another arm can follow them; the JACO's stay."""

from dataclasses import replace

import numpy as np
import pytest
from other_arms import shorter

from dt_viz.robot.placement import follows, is_jaco
from dt_viz.scenario.paper_scenes import offered
from dt_viz.scenario.tasks import TASKS, Task, TaskEntry
from dt_viz.session.tasks_in_reach import in_reach


def test_tasks_of_the_jaco_stay_as_they_are(robot):
    assert in_reach(TASKS, robot) == TASKS


@pytest.mark.parametrize("name", ["draw_c", "push_box"])
def test_another_arm_follows_its_tasks(robot, name):
    arm = shorter(robot, 0.5)
    task = in_reach(TASKS, arm)[name]()
    paths = np.array([path[np.linspace(0, len(path) - 1, 30).astype(int)] for path in task.paths])
    assert follows(arm, paths)
    assert task.scale == pytest.approx(0.5 * TASKS[name]().scale)
    assert in_reach(TASKS, arm)[name].title == TASKS[name].title


def test_a_task_out_of_every_reach_stays_and_is_said(robot, caplog):
    far = TASKS["push_box"]()
    far = replace(far, origin=np.array([0.0, 0.0, -9.0]))
    entry = TaskEntry("Far", lambda: far)
    assert isinstance(found := in_reach({"far": entry}, shorter(robot, 0.5))["far"](), Task)
    assert found is far
    assert f"{far.title}: " in caplog.text
    assert "cannot follow the task anywhere" in caplog.text


def test_an_arm_is_the_jaco_by_its_shape_not_by_its_name(robot):
    assert is_jaco(replace(robot, name="mine"))
    other = replace(shorter(robot, 0.5), name="jaco")
    assert not is_jaco(other)
    assert in_reach(TASKS, other) != TASKS


def test_every_scene_that_another_arm_is_offered_can_be_made(robot):
    tasks = in_reach(TASKS, shorter(robot, 0.5))
    scenes = offered(tasks, jaco=False)
    assert {scene.name for scene in offered(tasks)} - {scene.name for scene in scenes} >= {"left_pot", "others_push"}
    for scene in scenes:
        assert scene.scenario(tasks[scene.task]()).task == scene.task
