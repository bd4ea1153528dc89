"""The slice in the page, without a browser: handles, colours and their legend, and what is shown beside a level."""

from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest
from pages import Bound, frame_of, ignored, painted_at
from PIL import Image
from scenes import avoiding, changed

from dt_viz.obstacles.shapes import Sphere, rotation
from dt_viz.pictures.sketchbook import Pictures
from dt_viz.pictures.slice_fields import ColourPicture, FieldPicture
from dt_viz.scenario.scenario import View
from dt_viz.scenario.slices import SlicePose
from dt_viz.scenario.tasks import TASKS
from dt_viz.session.frame import Stage
from dt_viz.ui.scene.colour_scale import NUM_SHADES, from_oklab, oklab, ramp
from dt_viz.ui.scene.draggables import MovableSlice, Obstacles
from dt_viz.ui.scene.legend import Legend, explained
from dt_viz.ui.scene.palette import LIGHT, css
from dt_viz.ui.scene.picture import Look
from dt_viz.ui.scene.rollouts import Rollouts
from dt_viz.ui.scene.slice_layers import (
    OCCUPANCY,
    OPACITY,
    VOLUME,
    ColourSlice,
    FieldArrows,
    Streamlines,
    inked,
    legend_of,
    painted,
    scale_of,
)
from dt_viz.ui.scene.tubes import NUM_SIDES, RolloutTubes
from dt_viz.ui.tabs.show import WHOLE_ARM_NOTE, ShowTab

SCENARIO = avoiding("draw_s", (Sphere((0.0, -0.5, 0.4)),))
POSE = SlicePose((0.1, -0.4, 0.5), (0.6, 0.8, 0.0, 0.0))
TASK = TASKS["draw_s"]()


def frame(scenario=SCENARIO, **changes):
    line = np.linspace([0.0, 0, 0], [0, 0, 1.0], 5)
    given: dict[str, Any] = {"task": TASK, "stage": Stage.LIVE, "rollouts": (line, line + 0.1), "chosen": 0}
    return frame_of(scenario, **(given | changes))


def seen(**view):
    return replace(SCENARIO, view=View(**view))


# --- Moving it ---


def test_the_frame_lies_where_the_slice_does_and_only_while_it_is_of_use(scene):
    picture = MovableSlice(scene, ignored)
    picture.adopt(seen(move_slice=True))  # before the task is known
    assert not picture.visible
    picture.draw(frame(), Look())
    for view, pose in (({"move_slice": True}, TASK.slice.pose), ({"slice": POSE}, POSE)):
        picture.adopt(seen(**view))
        assert picture.visible
        w, x, y, z = (float(c) for c in picture.node.wxyz)
        border = picture.border.node.points[:, 0] @ rotation((w, x, y, z)).T + picture.node.position
        np.testing.assert_allclose(border, TASK.slice.posed(pose).border[:-1], atol=1e-6)
        assert (picture.node.opacity > 0) == ("move_slice" in view)
    picture.adopt(SCENARIO)
    assert not picture.visible


def test_one_thing_at_a_time_has_handles_and_none_in_a_picture(scene):
    picture, obstacles = MovableSlice(scene, ignored), Obstacles(scene, ignored)
    picture.draw(frame(), Look())
    for moving in (True, False):
        for each in (picture, obstacles):
            each.adopt(seen(move_slice=moving, handles=True))
        assert obstacles.items[0].has_handles is not moving
    picture.adopt(seen(move_slice=True))
    with picture.without_handles():
        assert picture.node.opacity == 0 and picture.visible
    assert picture.node.opacity == 1


# --- What lies on it ---


def test_arrows_and_streamlines_show_what_they_are_given(scene):
    points = TASK.slice.lattice(0.1)
    velocities = np.tile([0.1, 0.0, 0.0], (len(points), 1))
    line = np.linspace([0.0, 0, 0], [0.3, 0, 0], 7)
    arrows, streams = FieldArrows(scene), Streamlines(scene)
    shown = frame(pictures=Pictures(field=FieldPicture(points, velocities), streamlines=(line, line + 1.0)))
    arrows.draw(shown, Look())
    streams.draw(shown, Look())
    np.testing.assert_allclose(arrows.arrows.node.points.mean(axis=1), points, atol=1e-6)
    np.testing.assert_allclose(streams.lines.node.points[:6, 0], line[:-1], atol=1e-6)
    heads = streams.heads.node.points
    assert len(heads) == 2
    np.testing.assert_allclose(heads.mean(axis=1), [line[3], line[3] + 1.0], atol=1e-6)
    assert ((heads[:, 1] - heads[:, 0])[:, 0] > 0).all()  # the way that the motion goes
    before = streams.lines.node.points.copy()
    streams.draw(frame(), Look())  # not worked out yet: they stay
    np.testing.assert_array_equal(streams.lines.node.points, before)


def picture_of(values, what="det", clearance=None):
    room = np.full(values.shape, 1.0) if clearance is None else clearance
    return ColourPicture(cast(Any, what), TASK.slice, values, room, np.empty((0, 2, 3)))


def on_white(pixels):
    """Colours that pixels (..., 4) have on white, were they as opaque as their colour allows."""
    return 255 - (255.0 - pixels[..., :3]) * pixels[..., 3:] / (255 * OPACITY)


def test_ink_looks_alike_on_white_and_whitens_nothing_behind_it():
    colours = VOLUME.reshape(-1, 3)
    ink, opacity = inked(colours)
    np.testing.assert_allclose(255 - (255.0 - ink) * opacity[:, None], colours, atol=0.6)
    black = ink * opacity[:, None]
    assert (black.min(axis=1) < 1).all()  # at least one of red, green and blue stays as it is behind
    assert opacity.min() < 0.1 and opacity.max() > 0.5


def test_colours_say_the_value_at_their_place():
    n, m = 21, 25
    decades = np.linspace(-3, 3, n)
    pixels = painted(picture_of(np.repeat(10 ** decades[:, None], m, axis=1)))
    assert (pixels[..., :3] == pixels[:, :1, :3]).all()
    middle = (np.arange(len(pixels)) + 0.5) / len(pixels) * 6 - 3
    expected = VOLUME[np.round((np.clip(middle, -2, 2) + 2) / 4 * (NUM_SHADES - 1)).astype(int)]
    seen = on_white(pixels[:, 0])
    assert np.abs(seen - expected).max() <= 7
    np.testing.assert_allclose(seen[[0, -1]], [LIGHT.volume[0], LIGHT.volume[-1]], atol=1.5)


def test_a_fold_jumps_out_and_nothing_is_shown_where_no_motion_comes():
    values, room = np.ones((21, 25)), np.full((21, 25), 0.1)
    values[:5], values[-5:], room[-5:] = -0.2, np.nan, -0.1
    pixels = painted(picture_of(values, clearance=room))
    np.testing.assert_array_equal(pixels[2, 5], [*LIGHT.folded, 255])
    assert pixels[-2, 5, 3] == 0
    middle = pixels[len(pixels) // 2, 5]
    assert on_white(middle).min() > 235 and middle[3] < 0.1 * 255  # det J = 1 has no colour, and veils nothing
    assert (painted(picture_of(np.full((4, 5), np.nan)))[..., 3] == 0).all()


def test_the_image_follows_the_slice(scene):
    shown = ColourSlice(scene)
    corner = np.ones((21, 25))
    corner[-3:, -3:] = 100.0  # far along both axes
    for pose in (None, POSE):
        area = TASK.slice.posed(pose)
        shown.draw(frame(pictures=Pictures(colour=replace(picture_of(corner), area=area))), Look())
        handle = shown.image.handle
        dark = (np.abs(on_white(handle.image) - LIGHT.volume[-1]) < 2).all(axis=-1)
        place = painted_at(handle, area.half_size, dark)
        assert (area.across(place) > 0.8 * np.array(area.half_size)).all()
        assert abs((place - area.centre) @ area.normal) < 1e-9


def test_rollouts_of_the_whole_stack_are_translucent_and_thinner_beside_a_level(scene):
    def widths():
        meshes = (tubes.node.vertices for tubes in (rollouts.followed, rollouts.others))
        return [np.ptp(mesh[-2 * NUM_SIDES :, 1]) for mesh in meshes]  # at the end

    rollouts, look = Rollouts(scene), Look(tubes=RolloutTubes(frame().rollouts))
    rollouts.draw(frame(), look)
    hero, others = widths()
    assert hero > others > 0
    rollouts.draw(frame(level=0), look)
    assert len(rollouts.followed.node.vertices) == 3 and widths()[1] < others
    rollouts.draw(frame(), look)
    assert widths() == [hero, others]


# --- Scales ---


def test_oklab_goes_round_and_steps_of_a_scale_look_equally_large():
    colours = np.random.default_rng(0).uniform(0, 255, (50, 3))
    np.testing.assert_allclose(from_oklab(oklab(colours)), colours, atol=1e-3)
    np.testing.assert_allclose(oklab(np.array([255.0, 255, 255])), [1, 0, 0], atol=1e-3)
    for anchors in (LIGHT.lyapunov, LIGHT.volume):
        shades = ramp(anchors)
        np.testing.assert_array_equal(shades[[0, -1]], [anchors[0], anchors[-1]])
        steps = np.linalg.norm(np.diff(oklab(shades[::8].astype(float)), axis=0), axis=1)
        assert steps.std() < 0.15 * steps.mean()


def test_the_lyapunov_value_grows_darker_and_one_has_no_colour():
    lightness = oklab(ramp(LIGHT.lyapunov).astype(float))[:, 0]
    assert (np.diff(lightness) < 0.004).all() and lightness[0] - lightness[-1] > 0.6
    middle = oklab(VOLUME[NUM_SHADES // 2 - 1 : NUM_SHADES // 2 + 1].astype(float))
    assert np.abs(middle[:, 1:]).max() < 0.02


@pytest.mark.parametrize(("largest", "top"), [(0.0173, 200.0), (0.0042, 50.0), (0.01, 100.0), (0.014, 150.0)])
def test_the_legend_has_round_numbers_with_a_unit_that_reach_the_largest_value(largest, top):
    picture = picture_of(np.linspace(0, largest, 20).reshape(4, 5), "lyapunov")
    assert scale_of(picture).high == pytest.approx(top)
    said = legend_of(picture).html
    assert "square cm per second" in said and f">{top:g}<" in said and ">0<" in said


def test_the_legend_of_det_j_names_the_colour_of_folds():
    said = LEGENDS["det"].html
    assert all(f">{number}<" in said for number in ("0.01", "0.1", "1", "10", "100"))
    assert "0 or less" in said and css(LIGHT.folded) in said


LEGENDS = {
    "det": legend_of(picture_of(np.ones((4, 5)))),
    "lyapunov": legend_of(picture_of(np.ones((4, 5)), "lyapunov")),
    "occupancy": OCCUPANCY,
}


@pytest.mark.parametrize(("what", "height"), [("det", 540), ("lyapunov", 720), ("occupancy", 1080)])
def test_a_saved_picture_has_the_legend_in_its_corner_and_nothing_else_is_changed(what, height):
    legend, blank = LEGENDS[what], Image.new("RGBA", (height * 16 // 9, height))
    pixels = np.asarray(explained(blank, [legend], transparent=True))
    rows, columns = np.nonzero(pixels[..., 3])
    assert rows.min() > 0.8 * height and columns.max() < 0.65 * height
    assert np.asarray(blank)[..., 3].max() == 0
    # both ends of the scale are there, the first to the left of the last
    assert legend.scale is not None
    ends = legend.scale.shades[[0, -1]].astype(int)
    found = [np.nonzero((np.abs(pixels[..., :3] - end).max(axis=-1) <= 2) & (pixels[..., 3] == 255)) for end in ends]
    assert found[0][1].min() < found[1][1].max()
    for text in (legend.title, *(name for name, _ in legend.names), *(text for _, text in legend.ticks)):
        assert text.isascii()  # the font has no other letters


def test_a_saved_picture_is_white_behind_or_transparent():
    blank = Image.new("RGBA", (320, 180))
    for legends in ([], [OCCUPANCY]):
        white, clear = (explained(blank, legends, transparent=transparent) for transparent in (False, True))
        assert (white.mode, clear.mode) == ("RGB", "RGBA")
        assert white.getpixel((300, 10)) == (255, 255, 255) and clear.getpixel((300, 10)) == (0, 0, 0, 0)
        assert (np.asarray(white).min() < 255) == bool(legends)


def test_the_key_of_methods_stands_above_the_legend_of_colours():
    key, blank = Legend((("Ours", (200, 80, 0)), ("EFlow", (0, 90, 200)))), Image.new("RGBA", (1280, 720))
    both, alone = (
        np.asarray(explained(blank, legends, transparent=True)) for legends in ([OCCUPANCY, key], [OCCUPANCY])
    )
    rows = [np.nonzero((both[..., :3] == colour).all(axis=-1))[0].mean() for _, colour in key.names]
    top = np.nonzero(alone[..., 3])[0].min()
    assert rows[0] < rows[1] < top and (both[top:] == alone[top:]).all()


# --- The panel ---


@pytest.fixture
def opened(server):
    bound = Bound(SCENARIO)
    yield ShowTab(server.gui, bound, lambda _suffix, _content: None), bound
    server.gui.reset()


def test_the_colour_is_one_choice(opened):
    _, bound = opened
    for name in ("None", "det J", "Lyapunov value", "Learned occupancy"):
        bound.set("Slice colour", name)
        assert bound["Slice colour"].read(bound.edited.scenario) == name
    assert bound["Move the slice"].change(SCENARIO, True)["view"] == View(move_slice=True)


def test_the_panel_says_what_the_colours_mean_and_what_is_not_in_them(opened):
    panel, bound = opened
    bound.adopt(SCENARIO)
    assert not (panel.key.visible or panel.note.visible or panel.back.visible)
    bound.adopt(seen(colour="det", slice=POSE))
    bound.report(frame(pictures=Pictures(colour=picture_of(np.ones((4, 5))))))
    assert panel.key.visible and "det J" in panel.key.content and panel.back.visible
    bound.adopt(seen(colour="occupancy"))
    bound.report(frame(pictures=Pictures(colour=picture_of(np.ones((4, 5))))))  # on its way when another was chosen
    assert "Learned occupancy" in panel.key.content
    bound.adopt(changed(SCENARIO, space="cspace"))
    assert panel.note.visible and WHOLE_ARM_NOTE in panel.note.content
    assert not panel.key.visible
    bound.adopt(changed(SCENARIO, space="cspace", avoids=False))
    assert not panel.note.visible
