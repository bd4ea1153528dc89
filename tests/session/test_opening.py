"""What is seen of a visitor's recordings before they are learned is what is learned from; tasks of one's own."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from other_arms import five_joints
from scipy.spatial.transform import Rotation

import dt_viz as dt
from dt_viz.avoidance.bias import BiasPoint
from dt_viz.errors import DataError
from dt_viz.files.recordings import Recordings
from dt_viz.files.takes import Take
from dt_viz.flows.rotations import quaternions
from dt_viz.learning.augmented import fit_augmented
from dt_viz.learning.demonstrations import Demonstration, DemonstrationError
from dt_viz.learning.preparation import prepare
from dt_viz.learning.store import FitStore
from dt_viz.motion.nominal import Learned
from dt_viz.scenario.scenario import Layer, Scenario
from dt_viz.scenario.tasks import TASKS, own_task
from dt_viz.session.engine import MOST_OWN, NOT_TURNED, Engine
from dt_viz.session.frame import Stage
from dt_viz.session.history import History
from dt_viz.session.opening import Choices, preview, read_motion, with_reach

GOAL = np.array([0.2, -0.45, 0.3])
RNG = np.random.default_rng(3)


def take(name="a", positions=None, times=None, joints=None, units=None, **options):
    values = joints if positions is None else positions
    assert values is not None
    times = 0.01 * np.arange(len(values)) if times is None else times
    names = () if joints is None else tuple(f"joint{k + 1}" for k in range(joints.shape[1]))
    return Take(name, times, positions, None, joints, names, units or {}, **options)


def motion(start=(-0.2, -0.4, 0.2), goal=GOAL, num=200, bend=0.1):
    u = np.linspace(0, 1, num)
    path = np.array(start) + (3 * u**2 - 2 * u**3)[:, None] * (goal - np.array(start))
    path[:, 2] += bend * np.sin(np.pi * u)
    return path


def six(goal_of_last=GOAL):
    """Takes with jitter, a pause and an end of its own."""
    paths = [motion(np.array([-0.2, -0.4, 0.2]) + RNG.normal(scale=0.02, size=3)) for _ in range(5)]
    paths.append(motion(goal=goal_of_last))
    paths[1] = np.concatenate([paths[1][:100], np.repeat(paths[1][100:101], 80, axis=0), paths[1][100:]])
    paths[2] = paths[2] + RNG.normal(scale=0.002, size=paths[2].shape)
    return Recordings(tuple(take(f"take {k}", path) for k, path in enumerate(paths)))


@pytest.mark.long
@pytest.mark.parametrize("dim", [2, 3])
def test_a_saved_drawing_is_put_where_the_arm_follows_it_and_a_motion_in_space_stays(robot, tmp_path, dim):
    paths = [motion(np.array([-0.2, -0.4, 0.2 + 0.01 * k]))[:, :dim] for k in range(3)]
    dt.fit(paths, state="augmented", rate=50).save(tmp_path / "a.npz")
    tasks = [read_motion("a.npz", (tmp_path / "a.npz").read_bytes(), arm) for arm in (robot, five_joints())]
    assert [len(task.moves) for task in tasks] == [0, dim == 2]


def kinds(seen, number):
    return {finding.kind for finding in seen.takes[number].inspection.findings}


@pytest.mark.parametrize("choices", [Choices(), Choices(left_out=frozenset([0, 3]))])
def test_what_is_seen_is_what_is_learned_from(robot, choices):
    far = GOAL + np.array([-0.3, 0.0, 0.15])
    seen = preview(six(far), choices, robot)
    assert [k for k, one in enumerate(seen.takes) if not one.is_chosen] == sorted(choices.left_out)
    assert "pause" in kinds(seen, 1) and "jitter" in kinds(seen, 2) and kinds(seen, 5) == {"elsewhere"}
    learned = [one.learned for one in seen.takes if one.learned is not None]
    assert len(learned) == 5 - len(choices.left_out) and seen.takes[5].learned is None
    assert seen.task is not None and seen.goal is not None
    motions = prepare(seen.task.demonstrations, seen.task.preparation)
    assert len(motions.positions) == len(seen.task.demonstrations) == len(learned)
    for path, one in zip(motions.positions, learned, strict=True):
        np.testing.assert_array_equal(path, one)
    np.testing.assert_array_equal(motions.goal, seen.goal)
    assert seen.task.seen == motions.warnings
    np.testing.assert_array_equal(seen.takes[5].given, six(far).takes[5].positions)  # of space: where it is


def test_the_recordings_stay_as_they_are_whatever_is_chosen(robot):
    recordings = Recordings((take("a", 1e3 * motion()), take("b", 1e3 * motion())))
    with pytest.raises(DemonstrationError, match="is the file in millimetres"):
        preview(recordings, Choices(unit="m"), robot)
    for unit in ("", "mm", "cm", "mm"):
        before = [np.array(one.positions) for one in recordings.takes]
        seen = preview(recordings, Choices(unit=unit), robot)
        assert seen.unit == (unit or "mm")
        size = {"": 1.0, "mm": 1.0, "cm": 10.0}.get(unit)
        if size is not None:
            np.testing.assert_allclose(seen.takes[0].given, size * motion())
        for one, given in zip(recordings.takes, before, strict=True):
            np.testing.assert_array_equal(one.positions, given)


def test_a_unit_that_a_file_says_is_not_asked_for(robot):
    said = Recordings((take("a", 1e3 * motion(), units={"length": 1e-3}),))
    seen = preview(said, Choices(unit="cm"), robot)
    assert seen.unit == "" and not seen.notes
    np.testing.assert_allclose(seen.takes[0].given, motion())
    assert preview(Recordings((take("a", motion()),)), Choices(), robot).unit == ""


def test_a_rate_is_guessed_and_asked_for_where_there_are_no_times(robot):
    untimed = Recordings(tuple(take(f"{k}", motion(num=num), is_timed=False) for k, num in enumerate((240, 260, 300))))
    seen = preview(untimed, Choices(), robot)
    assert seen.rate == 50.0 and seen.takes[2].inspection.duration == pytest.approx(299 / 50)
    seen = preview(untimed, Choices(rate=100.0), robot)
    assert seen.rate == 100.0 and seen.takes[2].inspection.duration == pytest.approx(2.99)
    mixed = Recordings((*untimed.takes, take("timed", motion())))
    assert preview(mixed, Choices(rate=10.0), robot).takes[3].inspection.duration == pytest.approx(1.99)


def test_takes_that_cannot_be_used_are_named_and_the_others_are_used(robot):
    bad = [
        take("nan", np.full((50, 3), np.nan)),
        take("one", motion()[:1]),
        take("still", np.repeat(motion()[:1], 50, axis=0)),
        take("back", motion(), times=np.zeros(200)),
        take("plane", motion()[:, :2]),
        take("angles", joints=np.linspace(robot.home, robot.home + 0.3, 50)),
    ]
    good = [take("a", motion()), take("b", motion((-0.2, -0.45, 0.2)))]
    seen = preview(Recordings((*bad[:3], *good, *bad[3:])), Choices(), robot)
    assert [one.inspection.name for one in seen.takes] == ["a", "b"] and seen.task is not None
    assert len(seen.notes) == 6 and all(note.startswith("not used: ") for note in seen.notes)
    assert [
        next(name for name in ("nan", "one", "still", "back", "plane", "angles") if name in note) for note in seen.notes
    ]
    with pytest.raises(DemonstrationError, match=r"^nan: "):
        preview(Recordings(tuple(bad[:3])), Choices(), robot)


def test_what_is_out_of_reach_is_said_with_the_scale_that_fits_and_scaled_if_wanted(robot):
    recordings = Recordings((take("near", motion()), take("far", motion((-1.3, -0.6, 0.2)))))
    seen = with_reach(preview(recordings, Choices(), robot), Choices(), robot)
    assert [one.is_far for one in seen.takes] == [False, True]
    assert seen.reach.startswith("1 of 2 takes leave the reach of JACO; the largest that fits is 0.")
    wanted = Choices(fits_reach=True)
    scaled = with_reach(preview(recordings, wanted, robot), wanted, robot)
    assert scaled.task is not None and seen.task is not None and scaled.task.scale < 1 == seen.task.scale
    np.testing.assert_allclose(scaled.task.paths[1], scaled.takes[1].given)
    near = Recordings((take("near", motion()),))
    seen = preview(near, Choices(), robot)
    assert with_reach(seen, Choices(), robot) is seen


def test_drawings_are_placed_as_they_will_be(robot):
    plane = Recordings(tuple(take(f"{k}", 3 * motion()[:, [0, 2]]) for k in range(3)))
    seen = preview(plane, Choices(), robot)
    assert seen.task is not None and seen.task.draws
    np.testing.assert_allclose(seen.takes[1].given, seen.task.paths[1])
    assert np.ptp(seen.takes[0].given, axis=0).max() == pytest.approx(0.4)


# --- tasks of one's own ---


def own(robot, bend=0.1):
    takes = tuple(take(f"{k}", motion((-0.2, -0.4 - 0.02 * k, 0.2), bend=bend)) for k in range(2))
    task = preview(Recordings(takes), Choices(), robot).task
    assert task is not None
    return task


def test_a_visitors_own_task_is_learned_for_that_visitor_alone(robot, fits):
    stored = dict(fits._memory)
    one, other = (Engine(TASKS, fits, robot) for _ in range(2))
    first, second = (engine.bring(own(robot, bend))[0] for engine, bend in ((one, 0.1), (other, -0.02)))
    assert first.name == second.name and first.title == "Your data"
    frames = [list(engine.frames(Scenario(first.name, stack=()))) for engine in (one, other)]
    ends = [each[-1] for each in frames]
    assert all(frame.stage is Stage.CERTIFIED and not frame.blocked for frame in ends)
    for frame, task in zip(ends, (first, second), strict=True):
        assert np.abs(frame.ghost[0] - task.paths[0][np.linspace(0, 199, len(frame.ghost[0])).astype(int)]).max() < 0.1
    heights = [frame.ghost[0][:, 2].max() for frame in ends]
    assert heights[0] > heights[1] + 0.04
    assert dict(fits._memory) == stored  # nothing of it is kept for others, or on the disk
    with pytest.raises(KeyError):
        Engine(TASKS, fits, robot).task(first.name)


def test_an_own_task_is_learned_as_it_was_seen_and_what_was_seen_is_no_warning(robot):
    kept = replace(Choices().preparation, cut_pauses=False, smooth_jitter=False)
    seen = preview(six(), replace(Choices(), preparation=kept), robot)
    assert seen.task is not None
    engine = Engine(TASKS, FitStore(None), robot)
    *_, frame = engine.frames(Scenario(engine.bring(seen.task)[0].name, stack=()))
    told = frame.motion.nominal.imitation.warnings
    assert any("jitters" in text and "smoothed" not in text for text in told)
    assert set(seen.task.seen) <= set(told)
    assert not {str(warning) for warning in frame.certificates.warnings} & set(seen.task.seen)


def test_own_tasks_stay_and_one_too_many_is_refused_unless_another_was_deleted(robot):
    engine = Engine(TASKS, FitStore(None), robot)
    tasks = [own(robot).placed(1.0, (0.01 * k, 0.0, 0.0)) for k in range(MOST_OWN + 2)]
    names = [engine.bring(task)[0].name for task in tasks[:MOST_OWN]]
    assert len(set(names)) == len(names) == MOST_OWN
    with pytest.raises(DataError, match="delete one first"):
        engine.bring(tasks[-2])
    assert [*engine.own] == names
    brought, gone = engine.bring(tasks[-2], deleted=names[1:3])
    assert gone == names[1] and [*engine.own] == [names[0], *names[2:], brought.name]
    assert brought.title == f"Your data {MOST_OWN + 1}"
    last, gone = engine.bring(tasks[-1], number=2, deleted=names[1:3])  # which another one had
    assert gone == names[2] and last.title == f"Your data {MOST_OWN + 2}"


def test_an_own_task_that_comes_again_is_the_one_that_is_there(robot):
    engine, ball = Engine(TASKS, FitStore(None), robot), (Layer(BiasPoint((0.1, -0.4, 0.3)), name="Bias point 1"),)
    first, _ = engine.bring(own(robot))
    assert engine.bring(own(robot)) == (first, None) and first is engine.task(first.name)
    others = [
        engine.bring(own(robot), "panda")[0],
        engine.bring(own(robot, 0.11))[0],
        engine.bring(own(robot).placed(1.0, (0.0, 0.0, 0.01)))[0],
        engine.bring(replace(own(robot), layers=ball))[0],
        engine.bring(replace(own(robot), state="augmented"), number=9)[0],
    ]
    assert [other.name for other in others] == [f"own_data_{k}" for k in (2, 3, 4, 5, 9)]


def test_undo_forgets_a_task_that_is_gone():
    history, scenarios = History(), [Scenario(name) for name in ("draw_s", "own_data_1", "draw_j")]
    for before, after in pairwise(scenarios):
        history.edited(after.task, before, after)
    history.forget("own_data_1")
    step = history.undone(scenarios[-1])
    assert step is not None and step.scenario == scenarios[0] and history.undone(scenarios[0]) is None


def test_places_are_followed_where_the_arm_cannot_turn_its_hand_as_demonstrated(robot):
    """Random tasks of an arm whose joints turn little: where turned hands are out of its reach and places are not."""
    narrow = replace(robot, name="narrow", lower=robot.home - 1.2, upper=robot.home + 1.2)
    engine, rng, along = Engine(TASKS, FitStore(None), narrow), np.random.default_rng(1), np.linspace(0, 1, 80)[:, None]
    given_up = []
    for _ in range(10):
        begin, end = (
            narrow.shoulder + narrow.reach * np.array([x, 0.1 * rng.normal() - 0.6, 0.1 * rng.normal() - 0.05])
            for x in (-0.3, 0.3)
        )
        by = Rotation.from_rotvec(along * rng.normal(0, 1.5, 3))
        turns = quaternions(Rotation.from_rotvec(rng.normal(0, 2, 3)) * by)
        starts = begin + 0.02 * rng.normal(size=(3, 3))
        takes = [Demonstration(4 * along[:, 0], start + along * (end - start), "take", turns) for start in starts]
        own, _ = engine.bring(own_task(tuple(takes)))
        learned = engine.nominal(Scenario(own.name)).learned
        turned = Learned.of(own, fit_augmented(takes), imitates=True)
        assert turned.poses is not None
        given_up.append(learned.poses is None)
        assert given_up[-1] is (NOT_TURNED in learned.imitation.warnings)
        if given_up[-1]:
            assert engine.follower.unreached(turned) and not engine.follower.unreached(learned)
    assert 0 < sum(given_up) < 10
