"""A task that is registered by one function and one entry is in library, page, saved files and exported pictures."""

import re
from dataclasses import replace

import numpy as np
import pytest
from pages import Page, wait_until

import dt_viz as dt
from dt_viz.cli import main
from dt_viz.scenario.saved import Known, decode, encode
from dt_viz.scenario.tasks import TASKS, TaskEntry, drawing_task, known_tasks

NAME, TITLE = "draw_u", "Draw U"


def takes():
    """Three drawings of a U, metres, from starts beside each other to one goal."""
    s = np.linspace(0, 1, 60)
    bows = [np.column_stack([0.3 * s, (s - 0.5) ** 2 + shift * (1 - s)]) for shift in (-0.03, 0.0, 0.03)]
    return tuple(dt.Demonstration(2 * s, bow, f"take {k}") for k, bow in enumerate(bows, start=1))


def draw_u():
    return replace(drawing_task(NAME, TITLE, "Drag the sphere through the U.", takes()), state="augmented")


@pytest.fixture(autouse=True)
def _registered(monkeypatch):
    monkeypatch.setitem(TASKS, NAME, TaskEntry(TITLE, draw_u))


@pytest.fixture
def page(server, robot, monkeypatch):
    monkeypatch.setattr("pages.TITLES", {name: entry.title for name, entry in known_tasks(None).items()})
    page = Page(server, robot)
    yield page
    page.close()


def test_the_library_has_it_as_an_example_and_lists_it():
    for given, own in zip(dt.example(NAME), takes(), strict=True):
        np.testing.assert_array_equal(given.positions, own.positions)
    with pytest.raises(dt.FormatError, match=NAME):
        dt.example("nowhere")
    assert "3 takes in the plane" in repr(dt.fit(dt.example(NAME), state="augmented"))


def test_the_page_offers_it_and_what_is_made_there_is_saved_opened_and_drawn(page, tmp_path, cache, monkeypatch):
    assert TITLE in page["Task"].options and page.session.scenario.task != NAME
    page.claim(page["Task"], TITLE)
    wait_until(lambda: page.session.scenario.task == NAME)
    made = page.session.scenario
    assert made.obstacle.parts[0].position == draw_u().obstacle_position
    saved = page.visitor._made(TASKS)
    assert saved.own is None  # its name is enough
    assert decode(encode(saved), Known(known_tasks(None), ("",), ())).scenario == made
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))
    (tmp_path / "a.json").write_text(encode(saved))
    for given, file in (("a.json", "a.svg"), (NAME, "b.svg")):
        assert main(["picture", str(tmp_path / given) if "." in given else given, "--out", str(tmp_path / file)]) == 0
        texts = set(re.findall(r"<text[^>]*>([^<]*)</text>", (tmp_path / file).read_text()))
        assert {"demonstrations", "rollouts", "obstacle", "goal"} <= texts
