"""The dark theme: what is drawn on it can be seen, and the light one comes back as it was."""

import re

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dt_viz.session.frame import Stage
from dt_viz.session.progress import Pace
from dt_viz.ui.scene import palette
from dt_viz.ui.scene.export import Order
from dt_viz.ui.scene.palette import DARK
from dt_viz.ui.scene.stage import background
from dt_viz.ui.tabs.about import LEGEND, legend_html

LINES = ("demonstration", "rollout", "added", "ghost", "way", "goal", "obstacle", "bias", "streamline", "arrow_fast")
SEEN = 2.7  # smallest contrast with table and sky (WCAG 2.1 measures it so)


def luminance(colour):
    value = np.array(colour) / 255
    return float(np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722))


def contrast(one, other):
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("name", [*LINES, "grid", "ink", "outline"])
def test_lines_are_seen_on_the_dark_background(name):
    for ground in (DARK.zenith, DARK.horizon, DARK.table):
        assert contrast(getattr(DARK, name), ground) >= SEEN


def colours(page):
    """Those of all nodes, by name and property."""
    found = {}
    for name, node in page.nodes.items():
        for kind in ("color", "colors"):
            if hasattr(node, kind):
                found[name, kind] = np.array(getattr(node, kind)).tolist()
    return found


def choose(page, dark):
    page.claim(page["Dark theme"], dark)
    page.done()


@pytest.fixture(autouse=True)
def _drawn(page, initial, at_rest):
    page.busy()
    page.visitor.draw(at_rest(initial("draw_s"), Stage.LIVE), Pace(0.02, 10.0, 0))


def test_the_light_theme_comes_back_as_it_was(page, monkeypatch):
    themes, before = [], colours(page)
    monkeypatch.setattr(page.gui, "configure_theme", lambda **theme: themes.append(theme["dark_mode"]))
    choose(page, True)
    changed = {name for name, colour in colours(page).items() if colour != before[name]}
    assert {("/table", "color"), ("/ghost", "colors"), ("/way/ahead", "colors"), ("/ink", "colors")} <= changed
    choose(page, False)
    assert colours(page) == before
    assert themes == [True, False]


def test_a_picture_is_saved_in_light_colours_and_the_dark_theme_stays(page, monkeypatch):
    light, taken, grounds = colours(page), [], []
    choose(page, True)
    dark = colours(page)

    monkeypatch.setattr(page.scene, "set_background_image", lambda image, *_: grounds.append(image))

    def render(height, width, **_how):
        taken.append((colours(page), grounds[-1]))
        return np.zeros((height, width, 4), np.uint8)

    monkeypatch.setattr(page.client, "get_render", render)
    page.visitor.studio.picture(Order(".png"))
    assert taken == [(light, None)] and colours(page) == dark != light
    assert np.array_equal(grounds[-1], background(DARK))
    choose(page, False)


def test_a_picture_by_itself_looks_as_a_saved_camera_beside_the_panel(page, monkeypatch):
    shots, (position, look_at) = [], np.array([[1.0, -2.0, 1.5], [0.1, -0.3, 0.2]])

    def render(height, width, **how):
        shots.append(how)
        return np.zeros((height, width, 4), np.uint8)

    monkeypatch.setattr(page.client, "get_render", render)
    page.visitor.studio.picture(Order(".png", alone=True, pose=(position, look_at)))
    (shot,) = shots
    right, _down, ahead = Rotation.from_quat(np.roll(shot["wxyz"], -1)).as_matrix().T
    depth = np.linalg.norm(look_at - position)
    np.testing.assert_allclose(ahead, (look_at - position) / depth)
    offset = shot["position"] - position
    np.testing.assert_allclose(offset, (offset @ right) * right, atol=1e-9)
    assert -0.3 * depth < offset @ right < 0


# --- The foot of the panel ---


def test_the_legend_has_each_colour_that_is_drawn_once():
    colours = re.findall(r"background:(rgb[^']*)'", legend_html())
    assert colours == [palette.css(colour) for colour in LEGEND.values()] and len(set(colours)) == len(colours)
    wanted = {"demonstration", "rollout", "ghost", "obstacle", "goal", "way"}
    assert {getattr(palette.LIGHT, name) for name in wanted} <= set(LEGEND.values())
