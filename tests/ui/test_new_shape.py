"""A kind of obstacle that is registered, and nothing else, is in library, page, saved files and measurements."""

from typing import Any, cast

import numpy as np
import pytest
from pages import Bound
from scenes import avoiding

import dt_viz as dt
from dt_viz.evaluate.__main__ import main
from dt_viz.obstacles.shapes import SHAPES, Cylinder, Length
from dt_viz.robot.models import load_arm
from dt_viz.scenario.relocation import Relocation
from dt_viz.scenario.saved import Known, Saved, decode, encode
from dt_viz.scenario.scenario import View
from dt_viz.ui.scene.draggables import shaded
from dt_viz.ui.tabs.world import add, add_obstacles, name_of

PLACE = (0.1, -0.5, 0.3)


class Puck(Cylinder):
    """A flat cylinder, which has no slider for its diameter."""

    offered = {"Puck": (0.2, 0.2, 0.04)}  # noqa: RUF012
    lengths = (Length("Thickness", 0.01, 0.10, (2,)),)


@pytest.fixture(name="puck")
def _puck():
    SHAPES.append(Puck)
    yield Puck(PLACE, 0.2, 0.04)
    SHAPES.remove(Puck)


def test_the_page_has_its_button_and_its_slider(puck, server):
    bound = Bound(avoiding("draw_s", (), view=View(handles=True)))
    add_obstacles(server.gui, bound)
    add(cast(Any, bound.edited), Puck.of_extents(Puck.offered["Puck"]))
    bound.set("Thickness [cm]", 6.0)
    (added,) = bound.edited.scenario.obstacles
    assert isinstance(added, Puck) and added.extents == (0.2, 0.2, 0.06) and name_of(added) == "puck"
    assert len(shaded(added)[1]) > 100


def test_a_saved_scenario_has_it(puck):
    scenario, known = avoiding("draw_s", (puck,)), Known(("draw_s",), ("",), ())
    assert decode(encode(Saved(scenario)), known).scenario.obstacles == (puck,)


def test_a_saved_motion_of_the_library_has_it(puck, tmp_path):
    s = np.linspace(0, 1, 40)
    bows = [np.column_stack([0.4 * s, bow * s * (1 - s), 0.2 * s]) for bow in (0.4, 0.5)]
    dt.fit(bows, rate=20).stack(dt.Avoidance(puck)).save(tmp_path / "motion.npz")
    (layer,) = dt.Motion.load(tmp_path / "motion.npz").transforms
    assert layer.avoided.parts == (puck,)


def test_collisions_are_measured_from_it_and_another_arm_has_it_in_its_size(puck):
    robot = load_arm("jaco")
    hand = robot.end_effector(robot.home)
    distances, *_ = robot.collision.obstacle_distance(robot.home[None], puck.moved((hand[0], hand[1], hand[2] + 0.3)))
    assert 0.05 < distances[0] < 0.3
    assert Relocation(0.5, (0.0, 0.0, 0.0)).obstacle(puck) == Puck((0.05, -0.25, 0.15), 0.2, 0.02)


def test_measurements_place_it(puck, tmp_path):
    arguments = ["around", "--task", "draw_s", "--shape", "puck", "--count", "1", "--out", str(tmp_path / "x.npz")]
    assert main(arguments) == 0
    assert set(np.load(tmp_path / "x.npz")["shapes"].ravel()) == {"puck"}


def test_a_kind_without_a_formula_is_an_error(puck, monkeypatch):
    monkeypatch.setattr(Puck, "kind", 99)
    with pytest.raises(ValueError, match="Puck: no formula of kind 99"):
        Puck(PLACE).signed_distance(np.zeros((1, 3)))
