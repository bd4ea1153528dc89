"""`benchmarks pictures` takes pictures of the page as a visitor sees it."""

import numpy as np
import pytest
from chromium import needs_chromium
from PIL import Image

from dt_viz.scenario.paper_scenes import SCENES
from tests.benchmarks.__main__ import main

pytestmark = [pytest.mark.browser, needs_chromium]


@pytest.mark.slow
def test_a_scene_is_seen_with_its_panels_and_nothing_is_complained_of(tmp_path, capsys, monkeypatch):
    """A picture of fig. 2 has the colours of rollouts and goals in each third of what the panel leaves."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    assert main(["pictures", "--only", "steps", "--size", "1280,720", "--out", str(tmp_path)]) == 0
    assert SCENES["steps"].title in capsys.readouterr().out
    image = np.asarray(Image.open(tmp_path / "steps.png").convert("RGB")).astype(int)
    assert image.shape == (720, 1280, 3)
    orange = (image[..., 0] - image[..., 2] > 80) & (image[..., 0] - image[..., 1] > 50)
    green = (image[..., 1] - image[..., 0] > 60) & (image[..., 1] - image[..., 2] > 20)
    third = (1280 - 350) // 3
    for k in range(3):
        part = slice(k * third, (k + 1) * third)
        assert orange[:, part].sum() > 100 and green[:, part].sum() > 20
