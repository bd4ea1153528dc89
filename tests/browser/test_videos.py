"""A video that a real browser renders and downloads."""

from dataclasses import replace

import numpy as np
import pytest
from browsing import LIGHT, PATIENCE, begin, close_page, open_page, open_tab, press, wait_until
from chromium import needs_chromium
from decoding import decoded

from dt_viz.ui.scene.export import RESOLUTIONS
from dt_viz.ui.scene.film import FilmSettings

pytestmark = [pytest.mark.browser, needs_chromium]

SIZE = 320, 180
FEW = FilmSettings(rate=1, motion=2.0, turn=3.0, rest=0.0, patience=PATIENCE)


def test_a_motion_and_a_turn_are_rendered_and_downloaded(browser, server, initial, monkeypatch, tmp_path):
    monkeypatch.setitem(RESOLUTIONS, "1280 × 720", SIZE)
    for module in ("visitor", "scene.film"):
        monkeypatch.setattr(f"dt_viz.ui.{module}.SETTINGS", FEW)
    page, visitor = open_page(browser, server, (640, 480))
    begin(visitor, replace(initial("draw_s"), view=replace(LIGHT, handles=False, rollouts=True, arm=True)))
    scenario, camera = visitor.session.scenario, np.array(visitor.client.camera.position)
    page.evaluate("isLookedAt = true")
    open_tab(page, "Picture")
    assert not page.get_by_label("Video of", exact=True).is_visible()

    def choose(label, option):
        press(page.get_by_label(label, exact=True))
        press(page.get_by_role("option", name=option, exact=True))

    def saved(what):
        choose("Video of", what)
        with page.expect_download() as download:
            press(page.get_by_role("button", name="Save video"))
        assert download.value.suggested_filename == "dt-viz-draw_s.mp4"
        download.value.save_as(tmp_path / what)
        _, frames = decoded(tmp_path / what)
        return frames.astype(int)

    choose("Save as", "MP4")
    frames = saved("Motion")
    assert frames.shape == (3, SIZE[1], SIZE[0], 3)
    turn = saved("Turntable")
    assert turn.shape == (3, SIZE[1], SIZE[0], 3)
    for shown in (frames, turn):
        assert (shown > 240).all(axis=3).mean() > 0.3 and shown.std() > 15  # on white
        assert all((np.abs(a - b).max(axis=2) > 60).sum() > 100 for a, b in zip(shown[1:], shown[:-1], strict=True))
    assert visitor.session.scenario is scenario and np.array_equal(visitor.client.camera.position, camera)
    wait_until(lambda: visitor.robot.playback.film is None, "the robot to go on")
    close_page(page, server, visitor)
