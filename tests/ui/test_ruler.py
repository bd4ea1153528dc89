"""The ruler: what the browser asks for tells the width of its window, and nothing else does."""

import re

import pytest

from dt_viz.ui.ruler import STEP, WIDTHS, Ruler, told


def asked_for(html, width):
    """Path that a browser with a window of this width, CSS pixels, takes: the first source whose condition holds."""
    sources = re.findall(r'<source media="\(min-width: (\d+)px\)" srcset="([^"]+)">', html)
    (otherwise,) = re.findall(r'<img src="([^"]+)"', html)
    return "/" + next((path for least, path in sources if width >= int(least)), otherwise)


@pytest.mark.parametrize("width", [240, 320, 390, 576, 844, 1280, 1920, 3840, 7680])
def test_a_window_is_told_apart_from_others_that_differ_by_the_step(width):
    ruler = Ruler()
    measured = told(asked_for(ruler.html, width))
    assert measured is not None
    token, least = measured
    assert token == ruler.token and least <= width < least * STEP + 1


@pytest.mark.parametrize("path", ["/", "/window/a", "/window/a/391", "/window/a/9999999", "/window/a b/390", "/390"])
def test_other_requests_tell_nothing(path):
    assert WIDTHS[0] == 240 and 390 in WIDTHS
    assert told(path) is None


def test_two_windows_have_different_names():
    assert Ruler().token != Ruler().token
