"""Panels beside the scene: what they show is what they say, and nothing hides anything else."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import avoiding, biases, changed, frame_at

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.flows.rollouts import Rays
from dt_viz.flows.systems import Attractor
from dt_viz.motion.stack import LIVE, build_stack
from dt_viz.pictures.panels import Fit
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import BASE_PANEL, Panel, directions, offsets
from dt_viz.scenario.stack import IMITATION, plane_of, side_by_side, switched
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage
from dt_viz.ui.scene.palette import DARK, LIGHT
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.slice_layers import Panels

BIAS = "Bias 1"


def biased(engine, initial):
    """An S that is biased, and then led around a sphere."""
    point = BiasPoint((0.05, -0.5, 0.25), plane=plane_of(engine.task("draw_s")))
    return changed(initial("draw_s"), layers=biases(point), space="task")


def frame_of(engine, scenario, *panels, **view):
    """The live frame, with these panels and what else is to be seen."""
    view = View(panels=panels, **view) if panels else scenario.view
    return frame_at(engine, replace(scenario, view=view), Stage.LIVE)


def lines_towards(lines, goal):
    """The largest sine of the angle between steps of lines and the way to a goal."""
    sines = [0.0]
    for line in lines:
        step, way = np.diff(line, axis=0), goal - line[:-1]
        size = np.linalg.norm(step, axis=1) * np.linalg.norm(way, axis=1)
        assert (np.einsum("ij,ij->i", step, way) > -1e-12).all()
        sines.append((np.linalg.norm(np.cross(step, way), axis=1) / np.maximum(size, 1e-9)).max())
    return max(sines)


@pytest.mark.parametrize("name", TASKS)
@pytest.mark.parametrize("num", [1, 2, 5, 7])
def test_panels_lie_apart_in_reading_order_before_the_scene(name, num):
    task = TASKS[name]()
    half = np.array(task.slice.half_size) * [1.1, 1.2]
    right, up = directions(task.slice, task.camera)
    cells = np.concatenate([offsets(task.slice, half, num, task.camera), np.zeros((1, 3))])
    across, upwards = cells @ right, cells @ up
    np.testing.assert_allclose(cells, across[:, None] * right + upwards[:, None] * up, atol=1e-12)
    for k in range(num + 1):
        for other in range(k):
            gap = np.abs([across[k] - across[other], upwards[k] - upwards[other]]) - 2 * half
            assert gap.max() > 0.05
            below = upwards[other] - upwards[k] > half[1]
            assert below or (across[k] > across[other] and abs(upwards[k] - upwards[other]) < 1e-9)
    eye, target = (np.array(place) for place in task.camera)
    assert np.cross(target - eye, [0, 0, 1.0]) @ right > 0


@pytest.mark.parametrize("seed", range(5))
def test_base_space_is_scaled_until_its_rays_fit_and_never_enlarged(seed):
    rng, area = np.random.default_rng(seed), TASKS["draw_s"]().slice
    rays = Rays(area.at(rng.normal(0, 10.0 ** rng.uniform(-2, 1), (5, 2))), Attractor(area.at(rng.normal(0, 0.2, 2))))
    fit = Fit.of(rays, area)
    assert 0 < fit.scale <= 1
    across = area.across(fit(np.concatenate([rays.z0, [rays.base.goal]])))
    assert (np.abs(across) < area.half_size).all()
    np.testing.assert_allclose(fit(fit.base_area.border), area.border, atol=1e-9)


@pytest.mark.parametrize("name", ["draw_s", "lift_box"])
def test_the_base_attractor_has_straight_motions_and_a_lattice(engine, initial, name):
    base, own = frame_of(engine, initial(name), BASE_PANEL, field=False, grid=True).pictures.panels
    assert len(base.rollouts) == len(engine.task(name).demonstrations)
    assert len(base.streamlines) > 20 and len(base.grid) > 5
    assert lines_towards([*base.rollouts, *base.streamlines], base.goal) < 1e-6
    half = np.array(base.area.half_size) + 1e-9
    for line in (*base.rollouts, *base.grid):
        assert (np.abs(base.area.across(line)) <= half).all()
    assert min(np.ptp(base.area.across(line), axis=0).min() for line in base.grid) < 1e-9
    np.testing.assert_array_equal(own.area.centre, engine.task(name).slice.centre)
    assert len(frame_of(engine, initial(name), BASE_PANEL, field=False).pictures.panels[0].grid) == 0


def test_each_level_has_its_own_rollouts_and_streamlines(engine, initial):
    scenario = biased(engine, initial)
    frame = frame_of(engine, scenario, *side_by_side(scenario), Panel("Avoidance"), streamlines=True)
    _, imitation, bias, avoidance, own = frame.pictures.panels
    titles = [panel.title for panel in frame.pictures.panels]
    assert titles == ["base attractor", "imitation", "+ bias 1", "+ avoidance", "+ avoidance"]
    for panel, paths in ((imitation, frame.ghost), (bias, frame.levels[1]), (avoidance, frame.levels[2])):
        assert panel.area.key == own.area.key and np.linalg.norm(panel.offset) > own.area.half_size[0]
        for path, wanted in zip(panel.rollouts, paths, strict=True):
            np.testing.assert_allclose(path, wanted, atol=1e-9)
    assert not len(imitation.outlines) and len(avoidance.outlines)
    for line, wanted in zip(avoidance.streamlines, frame.pictures.streamlines, strict=True):
        np.testing.assert_allclose(line, wanted, atol=1e-9)
    assert len(bias.streamlines) > 20 and len(imitation.streamlines) > 20
    np.testing.assert_allclose(scenario.obstacle.signed_distance(avoidance.outlines.reshape(-1, 3)), 0, atol=1e-3)


@pytest.mark.parametrize("level", [IMITATION, BIAS])
def test_the_field_between_two_levels_leads_from_one_to_the_other(engine, initial, level):
    scenario = biased(engine, initial)
    panel, own = frame_of(engine, scenario, Panel(level, generator=True)).pictures.panels
    points = panel.points
    nominal = engine.nominal(scenario)
    (bias, _) = build_stack(nominal, scenario.active, LIVE).built
    transform = nominal.system.transform if level == IMITATION else bias.made.transform
    part = 1e-4
    led = transform.scaled(part).inverse(points) - points
    size = np.linalg.norm(panel.vectors, axis=1)
    scale = np.einsum("ij,ij->", led, panel.vectors) / (size**2).sum()
    assert scale > 0 and len(points) >= 30
    np.testing.assert_allclose(led, scale * panel.vectors, atol=0.02 * np.linalg.norm(led, axis=1).max())
    assert (np.abs(own.area.across(points)) < own.area.half_size).all()


def test_a_level_that_is_off_has_no_panel(engine, initial):
    scenario, shown = biased(engine, initial), (Panel(BIAS), Panel(BIAS, generator=True), BASE_PANEL)
    off = replace(scenario, stack=switched(scenario, BIAS))
    assert [panel.title for panel in frame_of(engine, off, *shown).pictures.panels] == ["base attractor", "+ avoidance"]
    assert len(frame_of(engine, scenario, *shown).pictures.panels) == 4


def test_other_tasks_are_shown_as_they_were_learned(engine, initial):
    names = ("draw_j", "lift_box")
    *others, own = frame_of(engine, avoiding("draw_s"), *(Panel(task=name) for name in names)).pictures.panels
    assert own.title == "Draw S"
    for panel, name in zip(others, names, strict=True):
        task, nominal = engine.task(name), engine.nominal(initial(name))
        np.testing.assert_array_equal(panel.area.centre, task.slice.centre)
        for path, wanted in zip(panel.rollouts, nominal.paths, strict=True):
            np.testing.assert_allclose(path, wanted, atol=1e-9)
        assert len(panel.demonstrations) == len(task.paths)


def test_side_by_side_are_the_base_attractor_and_the_levels_below_the_top(engine, initial):
    scenario = biased(engine, initial)
    assert side_by_side(scenario) == (BASE_PANEL, Panel(IMITATION), Panel(BIAS))
    assert side_by_side(replace(scenario, imitation=False)) == (BASE_PANEL, Panel(BIAS))
    assert side_by_side(avoiding("draw_s", ())) == (BASE_PANEL,)


def test_panels_take_the_theme_also_those_that_are_drawn_later_and_are_hidden_when_there_are_fewer(
    engine, initial, scene
):
    panels, scenario = Panels(scene), biased(engine, initial)
    for theme, shown in ((DARK, [BASE_PANEL]), (LIGHT, [BASE_PANEL, Panel(BIAS)]), (DARK, [BASE_PANEL])):
        panels.draw(frame_of(engine, scenario, *shown), Look(theme))
        visible = [nodes for nodes in panels.panels if nodes.frame.visible]
        assert len(visible) == len(shown) + 1
        assert {tuple(nodes.lines["streamlines"].node.colors) for nodes in visible} == {theme.streamline}


def test_rollouts_on_panels_are_grey_while_there_is_no_motion(engine, initial, scene):
    panels, frame = Panels(scene), frame_of(engine, biased(engine, initial), BASE_PANEL, Panel(IMITATION))
    for theme, colour in ((LIGHT, LIGHT.rollout), (LIGHT.without_motion, LIGHT.stale), (LIGHT, LIGHT.rollout)):
        panels.draw(frame, Look(theme))
        assert {tuple(nodes.rollouts.node.color) for nodes in panels.panels} == {colour}
