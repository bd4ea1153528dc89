"""What the occupancy maps believe, as a picture: by its level line, its outline and what it is near."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import frame_at

from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import Box, CloudObstacle, Cylinder, Sphere
from dt_viz.obstacles.union import Union
from dt_viz.pictures.occupancy import MAX_POINTS, NEAR, learned_occupancy, occupancy_picture
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import Slice
from dt_viz.session.frame import Stage

AREA = Slice(np.array([0.0, -0.5, 0.4]), np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]).T, (0.2, 0.15))
SHAPES = [
    Sphere((0.02, -0.5, 0.42), 0.14),
    Box((0.0, -0.51, 0.38), (0.2, 0.1, 0.06), (0.9, 0.1, 0.3, -0.3)),
    Cylinder((-0.03, -0.5, 0.4), 0.08, 0.2, (0.8, 0.6, 0.0, 0.0)),
]


@pytest.mark.parametrize("shape", SHAPES, ids=["sphere", "box", "cylinder"])
@pytest.mark.parametrize("coarse", [True, False])
def test_the_picture_shows_the_true_outline_and_what_is_learned_occupancy(shape, coarse):
    picture = occupancy_picture(AREA, (shape,), coarse=coarse)
    spacing = 0.010 if coarse else 0.004
    assert np.abs(shape.signed_distance(picture.outline)).max() < 0.3 * spacing
    assert np.abs(learned_occupancy(shape, picture.level.reshape(-1, 3)) - 0.5).max() < (0.2 if coarse else 0.05)
    assert np.abs(shape.signed_distance(picture.level)).max() < 0.25 * shape.radius  # it has learned the shape
    normal = np.cross(*AREA.axes.T)
    for segments in (picture.level, picture.outline):
        np.testing.assert_allclose((segments - AREA.centre) @ normal, 0, atol=1e-12)
    corner = AREA.centre - AREA.axes @ AREA.half_size
    assert picture.probability[0, 0] == pytest.approx(float(learned_occupancy(shape, corner[None])[0]), abs=1e-9)


def test_what_any_obstacle_is_believed_to_occupy_is_occupied():
    both = occupancy_picture(AREA, SHAPES[:2], coarse=True).probability
    each = [occupancy_picture(AREA, (shape,), coarse=True).probability for shape in SHAPES[:2]]
    assert (both >= np.maximum(*each) - 1e-12).all()
    nothing = occupancy_picture(AREA, (), coarse=True)
    assert nothing.probability.max() == 0 and len(nothing.level) == len(nothing.outline) == 0


@pytest.mark.long
def test_the_points_beside_the_slice_are_shown_on_it_with_their_labels():
    own = np.random.default_rng(4).uniform(-0.1, 0.1, (20_000, 3))
    cloud = Cloud(own, (np.linalg.norm(own, axis=1) < 0.06).astype(float))
    cloud = CloudObstacle((0.05, -0.5, 0.42), cloud, (0.9, 0.1, 0.3, -0.3))
    picture = occupancy_picture(AREA, (SHAPES[0], cloud), coarse=True)
    normal = np.cross(*AREA.axes.T)
    assert MAX_POINTS / 2 < len(picture.points) <= MAX_POINTS
    np.testing.assert_allclose((picture.points - AREA.centre) @ normal, 0, atol=1e-12)
    assert (np.abs((picture.points - AREA.centre) @ AREA.axes) < AREA.half_size).all()
    distance = np.linalg.norm(picture.points - cloud.position, axis=1)
    assert (distance[picture.occupied] < 0.06).all()
    assert (distance[~picture.occupied] > np.sqrt(0.06**2 - NEAR**2)).all()
    assert len(occupancy_picture(AREA, SHAPES, coarse=True).points) == 0


def test_the_picture_is_worked_out_only_while_it_is_shown(engine, initial):
    scenario = initial("draw_s")
    shown = replace(scenario, view=View(colour="occupancy"))
    assert not shown.computes_like(scenario)
    assert frame_at(engine, scenario, Stage.LIVE).pictures.occupancy is None
    assert frame_at(engine, shown, Stage.ROLLOUTS).pictures.occupancy is None
    outline = frame_at(engine, shown, Stage.LIVE).pictures.occupancy.outline
    assert np.abs(Union(scenario.obstacles).signed_distance(outline)).max() < 1e-3
