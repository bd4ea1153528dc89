"""Scenarios of the page in the library: the same motions, to the last bit, and the same file when they are saved."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import biases, changed, starts_at

import dt_viz as dt
from dt_viz import metrics as dt_metrics
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.motion.stack import FINE
from dt_viz.saving import is_motion, motion_task
from dt_viz.scenario.own import Own
from dt_viz.scenario.saved import Saved, encode
from dt_viz.scenario.scenario import Scenario
from dt_viz.scenario.tasks import TASKS, own_task
from dt_viz.ui.page import initial

BALL = dt.Sphere((0.05, -0.5, 0.40), 0.10)
AROUND = changed(
    Scenario("draw_s", starts=starts_at((0.1, -0.5, 0.6))),
    obstacles=(BALL,),
    layers=biases(BiasPoint((0.12, -0.5, 0.3))),
    space="task",
)
SCENARIOS = {
    "by hand, biased, with a start": AROUND,
    "warped": replace(AROUND, warp=1 / 3),
    "straight": replace(AROUND, imitation=False),
    "augmented": replace(AROUND, state="augmented"),
    "styled": replace(AROUND, task="draw_c", style="wavy", style_amount=0.5),
    "in space": Scenario("push_box", ()),
}


@pytest.fixture(autouse=True)
def _learned_here(cache, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(cache))


def written(folder, saved):
    path = folder / "a.json"
    path.write_text(encode(saved), encoding="utf-8")
    return path


def assert_moves_as(motion, solved):
    """To the last bit."""
    for name in ("positions", "index", "fraction"):
        ours, theirs = (getattr(bundle, name) for bundle in (motion.solution.bundle, solved.stack.bundle))
        assert ours.tobytes() == theirs.tobytes()
    paths = motion.rollouts()
    assert len(paths) == len(solved.nominal.status) and motion.dimension == 3
    for path, theirs in zip(paths, solved.stack.bundle.paths, strict=True):
        ends = theirs[[0, -1]] if theirs.ndim == 2 else theirs[[0, -1], 0]
        np.testing.assert_allclose(path.positions[[0, -1]], ends[:, :3], atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_scenario_moves_in_the_library_as_on_the_page_and_is_the_same_file_again(name, engine, tmp_path):
    scenario = SCENARIOS[name]
    path = written(tmp_path, Saved(scenario, ((1.0, -1.0, 1.0), (0.0, -0.5, 1 / 3))))
    motion = dt.Motion.load(path)
    assert_moves_as(motion, engine.solved(scenario, FINE))
    motion.save(tmp_path / "b.json")
    assert (tmp_path / "b.json").read_bytes() == path.read_bytes()


@pytest.mark.long
@pytest.mark.parametrize("task", ["draw_j", "push_box"])
def test_demonstrations_in_a_file_move_as_on_the_page(task, new_engine, tmp_path):
    engine = new_engine()
    given = own_task(TASKS[task]().demonstrations).placed(0.8, (0.1, 0.0, 1 / 3))
    own, _ = engine.bring(given)
    scenario = changed(Scenario(own.name), obstacles=(BALL,), space="task")
    motion = dt.Motion.load(written(tmp_path, Saved(scenario, own=Own.of(own))))
    assert_moves_as(motion, engine.solved(scenario, FINE))
    more = motion.stack(dt.BiasPoint((0.1, -0.4, 0.6)))
    more.save(tmp_path / "b.json")
    assert dt.Motion.load(tmp_path / "b.json").transforms == more.transforms


def test_what_the_page_could_not_open_is_not_saved_and_what_is_none_is_not_read(tmp_path):
    motion = dt.Motion.load(written(tmp_path, Saved(Scenario("draw_s"))))
    with pytest.raises(dt.DataError, match="Avoidance"):
        motion.stack(dt.Avoidance(BALL)).save(tmp_path / "b.json")
    assert not (tmp_path / "b.json").exists()
    for text, said in (('"warp":9.0', "warp: found 9"), ('"arm":"panda","warp":1.0', "arm: found 'panda'")):
        path = tmp_path / "c.json"
        path.write_text(encode(Saved(Scenario("draw_s"))).replace('"arm":"",', "").replace('"warp":1.0', text))
        with pytest.raises(dt.DataError, match=said):
            dt.Motion.load(path)


# --- saved motions on the page ---


def arcs(dim):
    s = np.linspace(0, 1, 40)
    start = np.array([-0.2, -0.4, 0.3])[:dim]
    for k in range(3):
        path = np.stack([0.35 * s, (0.4 + 0.1 * k) * s * (1 - s), 0.1 * s**2], axis=1)[:, :dim]
        yield dt.Demonstration(2 * s, start + path, f"arc {k}")


def on_page(motion, folder, new_engine):
    """The motion on the page, its task, and what is shown first."""
    motion.save(folder / "my_motion.npz")
    assert is_motion(folder / "my_motion.npz")
    task = motion_task(folder / "my_motion.npz")
    engine = new_engine()
    own, _ = engine.bring(task)
    scenario = initial(engine.task(own.name))
    return engine, own, scenario, engine.solved(scenario, FINE)


def test_a_saved_drawing_is_put_before_the_robot_with_its_obstacles(tmp_path, new_engine):
    motion = dt.fit([*arcs(2)], state="plain").stack(
        dt.Avoidance(dt.Box((0.0, -0.3, 0.0), (0.05, 0.1, 0.08)), margin=0.01)
    )
    _, own, scenario, solved = on_page(motion, tmp_path, new_engine)
    (box,) = scenario.obstacles
    np.testing.assert_allclose(box.position, own.to_world(np.array([0.0, -0.3])))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (50, 3)) + np.array([0.0, -0.3, 0.0])
    before = motion.scenario.obstacle.signed_distance(points)
    np.testing.assert_allclose(own.scale * before, box.signed_distance(own.to_world(points)), atol=1e-9)
    for path, theirs in zip(
        motion.rollouts(), dt.Motion.load(written(tmp_path, Saved(scenario, own=Own.of(own)))).rollouts(), strict=True
    ):
        assert dt_metrics.discrete_frechet(own.to_world(path.positions), theirs.positions) < 2e-3
    assert solved.stack.bundle.paths
