"""Style: what leads from one hand to another, taken off and put on, keeps ends, stability and det J = 1."""

from dataclasses import replace
from functools import lru_cache

import numpy as np
import pytest
from crossings import crossings
from drawings import frechet, path_from
from scenes import kinds

from dt_viz.avoidance.hand import Avoidance
from dt_viz.avoidance.registry import AVOIDANCE
from dt_viz.flows.augmented_systems import Shear
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.patterns import AugmentedSettings
from dt_viz.learning.preparation import ImitationError
from dt_viz.learning.style import Style
from dt_viz.obstacles.shapes import Sphere, as_point
from dt_viz.scenario.paper_scenes import SCENES
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import STYLES, TASKS
from dt_viz.warning import Kind


@lru_cache
def learned(task):
    return fit_augmented(TASKS[task]().demonstrations)


@pytest.fixture(scope="module", name="style")
def _style():
    return Style.between(*(learned(task) for task in STYLES["wavy"]))


def test_put_on_the_usual_motion_it_gives_the_styled_one(style):
    usual, styled = (learned(task) for task in STYLES["wavy"])
    given, without = (
        np.mean([frechet(path_from(one, start), path_from(styled, start)) for start in styled.starts])
        for one in (style.on(usual, 1.0), usual)
    )
    assert given < 0.6 * without  # the rest is how the demonstrations of one hand differ
    knots = usual.patterns[0].mean + usual.top * style.offsets - usual.goal
    wanted = (styled.patterns[0].mean - styled.goal) * usual.top / styled.top
    fading = np.linspace(1, 0, len(knots))[:, None] * (wanted - knots)[0]
    np.testing.assert_allclose(knots + fading, wanted, atol=1e-12)


def test_it_is_the_composition_of_the_two_shears(style):
    usual, styled = (learned(task) for task in STYLES["wavy"])
    # both means begin and end at one place then, in units of s_max, so that only the style is between them
    at_one = []
    for imitation in (usual, styled):
        mean = (imitation.patterns[0].mean - imitation.goal) / imitation.top
        mean = mean - np.linspace(1, 0, len(mean))[:, None] * mean[0]
        pattern = replace(imitation.patterns[0], mean=mean * imitation.top + imitation.goal)
        moved = replace(imitation, patterns=(pattern,))
        at_one.append(moved.placed(-imitation.goal / imitation.top, np.eye(2), 1 / imitation.top))
    phases = np.linspace(0.02, 0.98, 20)
    start = np.zeros(2)
    own = [imitation.patterns[0].shapes.at(start) for imitation in at_one]  # what the starts add, which is no style
    states = np.column_stack([np.random.default_rng(0).normal(size=(20, 2)), phases, np.zeros((20, 3))])
    one, other = (Shear(imitation) for imitation in at_one)
    moved = other.inverse(one.forward(states))[:, :2] - states[:, :2]
    knots = np.linspace(1, 0, len(style.offsets))
    expected = style.offsets + own[1] - own[0]
    wanted = np.stack([np.interp(phases, knots[::-1], column[::-1]) for column in expected.T], axis=1)
    np.testing.assert_allclose(moved, wanted, atol=0.02)
    assert np.abs(wanted).max() > 0.05


@pytest.mark.parametrize("task", ["draw_c", "draw_w", "draw_8"])
def test_taken_off_again_nothing_is_left_and_ends_stay(style, task):
    own = learned(task)
    on = style.on(own, 0.7)
    start = own.starts[1]
    np.testing.assert_allclose(path_from(on, start)[[0, -1]], np.stack([start, own.goal]), atol=1e-12)
    np.testing.assert_allclose(path_from(style.on(on, -0.7), start), path_from(own, start), atol=1e-12)
    size = float(np.ptp(path_from(own, start), axis=0).max())
    assert frechet(path_from(on, start), path_from(own, start)) > 0.02 * size
    states = on.states(on.starts)
    states[:, on.dim] *= 0.4
    np.testing.assert_allclose(np.linalg.det(on.system.transform.jacobian(states)[1]), 1.0, atol=1e-9)


def test_hands_of_other_detail_give_a_style_too(style):
    usual = learned("draw_s")
    finer = fit_augmented(TASKS[STYLES["wavy"][1]]().demonstrations, settings=AugmentedSettings(min_knots=240))
    mixed, own = Style.between(usual, finer), learned("draw_c")
    assert len(mixed.offsets) == 240 and len(style.offsets) == 120
    for on in (style, mixed):
        path, wanted = (path_from(one.on(own, 1.0), own.starts[0]) for one in (on, style))
        assert np.linalg.norm(path - wanted, axis=1).max() < 0.05 * own.top


def test_a_hand_of_several_patterns_is_no_style_and_it_fits_motions_of_as_many_coordinates(style):
    usual, case = learned("draw_s"), crossings()["left and right from one start"]
    with pytest.raises(ImitationError, match="found a hand of 2 patterns; accepted: 1"):
        Style.between(usual, fit_augmented(case.demonstrations, case.labels))
    with pytest.raises(ImitationError, match="style: found a motion of 3 coordinates; accepted: 2"):
        style.on(learned("push_box"), 1.0)


def test_around_a_sphere_every_certificate_holds(engine):
    task = engine.task("draw_c")
    sphere = Sphere(as_point(task.mean_path[40]), 0.08)
    scenario = Scenario("draw_c", (Layer(Avoidance(sphere), name=AVOIDANCE.title),), style="wavy", style_amount=1.5)
    frame = list(engine.frames(scenario))[-1]
    known = frame.certificates
    assert kinds(known.warnings) <= {Kind.ARM_ENTERS} and known.lyapunov_falls is True
    assert known.min_det_jacobian is not None and known.min_det_jacobian > 0 and frame.remembers
    straight = replace(scenario, imitation=False)
    assert not list(engine.frames(straight))[-1].remembers


def test_the_scene_has_three_letters(engine):
    frame = list(engine.frames(SCENES["style"].scenario(engine.task("draw_c"))))[-1]
    assert [panel.title for panel in frame.pictures.panels] == ["Draw S", "Draw wavy S", "Draw C, wavy × 1"]
    assert not frame.certificates.warnings
    off = [frechet(path, d) for path, d in zip(frame.rollouts, frame.task.paths, strict=True)]
    assert 0.01 < max(off) < 0.06
