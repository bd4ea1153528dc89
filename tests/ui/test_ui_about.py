"""The foot of the panel, without a browser."""

import re

from dt_viz.ui.scene import palette
from dt_viz.ui.tabs.about import LEGEND, Command, keys_html, legend_html, numbered


def test_the_legend_has_each_colour_that_is_drawn_once():
    colours = re.findall(r"background:(rgb[^']*)'", legend_html())
    assert colours == [palette.css(colour) for colour in LEGEND.values()] and len(set(colours)) == len(colours)
    wanted = {"demonstration", "rollout", "ghost", "obstacle", "goal", "way"}
    assert {getattr(palette.LIGHT, name) for name in wanted} <= set(LEGEND.values())


def test_the_keys_are_those_of_the_commands():
    undo = Command("Undo", lambda _: None, "Z"), Command("Redo", lambda _: None, "Z", shifted=True)
    scenes = numbered([f"scene {k}" for k in range(1, 12)], lambda *_: None)
    assert [scene.key for scene in scenes] == [*map(str, range(1, 10)), "", ""]
    rows = re.findall(r"font-weight:600'>([^<]*)</td><td>([^<]*)</td>", keys_html((*undo, *scenes)))
    assert rows == [
        ("Z", "Undo"),
        ("Shift Z", "Redo"),
        ("← →", "previous and next step of the tour"),
        ("1 – 9", "scenes, in their order"),
        ("Ctrl K", "all commands by name"),
    ]


def test_what_is_told_is_in_folders_that_are_closed_at_first(panel, server):
    folders = {
        folder.label: folder for folder in server.gui._container_handle_from_uuid.values() if hasattr(folder, "label")
    }
    assert not any(folders[label].expand_by_default for label in ("About: paper, colours, keys", "Details"))
