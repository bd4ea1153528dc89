"""Saved motions: read back to the last bit, written whole or not at all, and refused where they make no sense."""

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import hostile
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from twirl import shown_in_the_readme

import dt_viz as dt
from dt_viz.avoidance import registry
from dt_viz.avoidance.detour import DetourSettings
from dt_viz.avoidance.transform import Transform
from dt_viz.errors import never
from dt_viz.files import npz, triangles
from dt_viz.files.values import packed, unpacked
from dt_viz.learning.demonstrations import Demonstration
from dt_viz.obstacles import clouds, solids
from dt_viz.obstacles.shapes import SHAPES, Obstacle
from dt_viz.saving import FORMAT, MAX_ARRAYS, MAX_BYTES, MAX_TEXT, read_motion, sent_motion_task
from dt_viz.shipped import ASSETS

FROZEN = Path(__file__).parent / "frozen"

SHAPED = cast(dt.Avoidance, hostile.STACK[0]).obstacles  # an obstacle of each kind


def arcs(dim=2):
    s = np.linspace(0, 1, 30)
    for k in range(2):
        path = np.stack([0.5 * s, (0.4 + 0.1 * k) * s * (1 - s), 0.2 * s**2], axis=1)
        yield Demonstration(2 * s, path[:, :dim], f"arc {k}")


@pytest.fixture(scope="module", autouse=True)
def _coarsely():
    with hostile.coarsely():
        yield


@pytest.fixture(scope="module")
def flat() -> dt.Motion:
    return dt.fit(list(arcs()))


@pytest.fixture(scope="module")
def saved() -> bytes:
    return hostile.saved_motion()


@pytest.fixture(scope="module")
def motions(flat) -> dict[str, dt.Motion]:
    """A motion of each kind, with obstacles of all kinds and all transforms at once."""
    ball, bias = dt.Sphere((0.2, 0.06, 0.05), 0.05), dt.BiasPoint((0.3, 0.16, 0.08), radius=0.1)
    far = tuple(part.moved((0.1 + 0.2 * k, -0.25, 0.3), part.wxyz) for k, part in enumerate(SHAPED))
    near = SHAPED[3].moved((0.35, 0.03, 0.05), (0.9, 0.1, 0.3, -0.3))
    by_hand = dt.Avoidance(near, duration=0.5, generator="probability", integration=dt.Integration("rk4", 6))
    stack = dt.Avoidance((ball, *far), margin=0.02, temperature=4.0), bias, by_hand
    return {
        "space": dt.fit(list(arcs(3))).stack(*stack, dt.ArmAvoidance(ball)),
        "plane": flat.stack(*stack),
        "velocities": dt.fit(list(arcs()), "velocity").stack(stack[1], stack[0]),
    }


def assert_same(a: dt.Motion, b: dt.Motion):
    """To the last bit."""
    assert a.transforms == b.transforms and a.dimension == b.dimension
    lower, upper = a.goal - 0.1, a.goal + 0.1
    points = np.random.default_rng(0).uniform(lower, upper, (30, a.dimension))
    for starts in (None, points[:3]):
        for path, other in zip(a.rollouts(starts), b.rollouts(starts), strict=True):
            assert path.positions.tobytes() == other.positions.tobytes()
            assert path.times.tobytes() == other.times.tobytes()
    for place in (points, points[0]):
        assert a.velocity(place).tobytes() == b.velocity(place).tobytes()
    assert a.certificates() == b.certificates()


@pytest.mark.parametrize("name", ["space", "plane", "velocities"])
def test_a_motion_is_read_back_to_the_last_bit(motions, name, tmp_path):
    motions[name].save(tmp_path / "a.npz")
    again = dt.Motion.load(tmp_path / "a.npz")
    assert_same(motions[name], again)
    again.save(tmp_path / "b.npz")
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()


def test_layers_keep_their_names_and_whether_they_are_on(saved):
    assert read_motion(saved, "a.npz")[0].layers == hostile.LAYERS


POINTS = st.tuples(*3 * [st.floats(-1, 1)])
POSITIVE = st.floats(1e-3, 1, exclude_min=True)
INTEGRATIONS = st.builds(dt.Integration, st.sampled_from(["auto", "rk4", "euler"]), st.integers(1, 50))
PLANES = st.none() | st.tuples(POINTS, POINTS)
OBSTACLES = st.one_of(
    st.builds(dt.Sphere, POINTS, POSITIVE),
    st.builds(dt.Box, POINTS, st.tuples(*3 * [POSITIVE])),
    st.builds(dt.Cylinder, POINTS, POSITIVE, POSITIVE, st.tuples(POSITIVE, *3 * [st.floats(-1, 1)])),
    st.builds(lambda place, lengths: dt.Capsule(place, *sorted(lengths)), POINTS, st.tuples(POSITIVE, POSITIVE)),
    st.builds(replace, st.sampled_from(SHAPED[3:]), position=POINTS, scale=POSITIVE),
)
TRANSFORMS = st.one_of(
    st.builds(
        dt.Avoidance,
        st.lists(OBSTACLES, max_size=3),
        space=st.sampled_from(["task", "cspace"]),
        generator=st.sampled_from(["free-space", "probability"]),
        temperature=st.floats(0.5, 50),
        margin=st.floats(0, 0.5),
        duration=st.none() | st.floats(0, 5),
        integration=INTEGRATIONS,
        plane=PLANES,
    ),
    st.builds(
        dt.BiasPoint, POINTS, st.none() | POSITIVE, st.none() | st.floats(0, 5), PLANES, st.booleans(), INTEGRATIONS
    ),
)


@given(TRANSFORMS)
def test_equal_transforms_come_back_through_text(transform):
    arrays = {}
    text = json.dumps(packed(transform, "it", arrays), allow_nan=False)
    classes = {Transform: registry.KINDS, Obstacle: SHAPES}
    assert unpacked(json.loads(text), Transform, "it", arrays, classes) == transform


@pytest.mark.parametrize("name", ["motion_every_transform", "motion_augmented"])
def test_files_of_before_are_read(name):
    """Written by the version of 0.1.0 that had a codec of its own."""
    motion, imitation = read_motion((FROZEN / f"{name}.npz").read_bytes(), name)
    assert np.isfinite(imitation.starts).all()
    if name == "motion_augmented":
        assert imitation.state == "augmented"
        assert [layer.transform for layer in motion.layers] == [
            dt.BiasPoint((0.3, 0.16, 0.0), radius=0.1, plane=((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
        ]
    else:
        assert motion.layers == hostile.LAYERS


def test_a_new_transform_of_one_file_and_one_line_is_saved_without_code_of_its_own(flat, tmp_path, monkeypatch):
    twirl, kinds = shown_in_the_readme()
    turned = flat.stack(twirl((0.3, 0.1, 0.0), angle=np.float64(-0.3)), dt.BiasPoint((0.3, 0.2, 0.0)))
    path = tmp_path / "a.npz"
    with pytest.raises(dt.DataError, match=r"class: found 'Twirl'; accepted: HandAvoidance or ArmAvoidance or Bias"):
        turned.save(path)
    assert not path.exists()
    monkeypatch.setattr(registry, "KINDS", kinds)  # the one line
    turned.save(path)
    assert_same(turned, dt.Motion.load(path))
    monkeypatch.undo()
    with pytest.raises(dt.DataError, match=r"class: found 'Twirl'; accepted: HandAvoidance or ArmAvoidance or Bias"):
        dt.Motion.load(path)


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (dt.Avoidance(dt.Sphere((0.0, 1e9, 0.0))), "distance of an obstacle: found 1e+09; accepted: 0 to 100"),
        (dt.Avoidance(dt.Box((0.0, 0.0, 0.0), wxyz=(np.nan, 0.0, 0.0, 1.0))), "wxyz[0]: found nan; accepted: a finite"),
    ],
)
def test_what_could_not_be_read_is_not_written(flat, tmp_path, wrong, words):
    with pytest.raises(dt.DataError, match=re.escape(words)):
        flat.stack(wrong).save(tmp_path / "a.npz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: dt.Avoidance(margin=-0.01), "margin: found -0.01; accepted: 0 to 1"),
        (lambda: dt.Avoidance(temperature=0.0), "temperature"),
        (lambda: dt.Avoidance(space=cast(Any, "tsk")), "'tsk'; accepted: 'task' or 'cspace'"),
        (lambda: dt.Avoidance(detour=DetourSettings(staying=-1.0)), "detour.staying: found -1;"),
        (lambda: dt.Avoidance(duration=float("nan")), "duration"),
        (lambda: dt.BiasPoint((0.0, 0.0, 0.0), radius=-0.1), "radius"),
        (lambda: dt.BiasPoint((0.0, 0.0, 0.0), strength=1e9), "strength"),
        (lambda: dt.Integration("rk4", 10**9), "steps"),
        (lambda: dt.Sphere((0.0, 0.0, 0.0), diameter=-0.1), "diameter: found -0.1"),
        (lambda: dt.Box((0.0, 0.0, 0.0), (0.1, 0.0, 0.1)), "sizes: found 0"),
        (lambda: dt.Cylinder((0.0, 0.0, 0.0), height=float("inf")), "height: found inf"),
        (lambda: cast(Any, SHAPED[3]).resized(-1.0), "scale"),
    ],
)
def test_numbers_that_make_no_sense_are_refused_where_they_are_written(make, words):
    with pytest.raises(ValueError, match=words):
        make()


@pytest.mark.parametrize(("kind", "name"), [(str, "a.npz"), (Path, "a"), (str, "a.motion"), (Path, "a.b.NPZ")])
def test_the_file_has_the_name_that_is_given(flat, tmp_path, kind, name):
    path = kind(tmp_path / name)
    flat.save(path)
    assert [found.name for found in tmp_path.iterdir()] == [name]
    assert len(dt.Motion.load(path).rollouts()) == 2


@pytest.mark.parametrize("fails", ["write_bytes", "replace"])
def test_a_file_is_replaced_by_a_whole_one_or_stays(flat, tmp_path, monkeypatch, fails):
    path = tmp_path / "a.npz"
    flat.save(path)
    before = path.read_bytes()
    failing = getattr(Path, fails)

    def full(self, argument):
        if fails == "write_bytes":
            failing(self, argument[:100])
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as context, pytest.raises(OSError, match="No space left"):
        context.setattr(Path, fails, full)
        flat.stack(dt.BiasPoint((0.3, 0.2, 0.0))).save(path)
    assert path.read_bytes() == before and list(tmp_path.iterdir()) == [path]
    flat.stack(dt.BiasPoint((0.3, 0.2, 0.0))).save(path)
    assert len(dt.Motion.load(path).transforms) == 1 and list(tmp_path.iterdir()) == [path]


def changed(content, change, **arrays):
    """The file with its description changed in place, and with other arrays; None leaves one out."""
    path = hostile.io.BytesIO(content)
    with np.load(path) as archive:
        members = dict(archive)
    motion = json.loads(str(members["motion"]))
    change(motion)
    members |= {"motion": np.array(json.dumps(motion))} | arrays
    return npz.npz_bytes({name: array for name, array in members.items() if array is not None})


def setting(*keys):
    """Changes the value at this place of the description; the last of `keys` is the new one."""
    *place, last, value = keys

    def change(motion):
        for key in place:
            motion = motion[key]
        motion[last] = value

    return change


AVOIDANCE = ("layers", 0, "transform")
MESH = "motion.layers[0].transform.obstacles[3].mesh"
LEAVE = dict.copy  # changes nothing


def with_old_name(motion):
    """Name an avoidance as versions before two kinds did, in a space that there is not."""
    avoidance = motion["layers"][0]["transform"]
    avoidance |= {"class": "Avoidance", "space": "x"}


MANY_GAUSSIANS = {"imitation.layer_0_weights": np.zeros((10_000, 2))} | {
    "imitation.layer_0_axis_0": np.linspace(0.0, 1.0, 100),
    "imitation.layer_0_axis_1": np.linspace(0.0, 1.0, 100),
    "imitation.layer_0_ell_steps_forward": np.array([1.0, 250, 1]),
}
FORGED = {
    "another version": (setting("version", FORMAT + 1), {}, f"version: found 2; accepted: {FORMAT}; another version"),
    "no version": (lambda m: m.pop("version"), {}, "version: found None"),
    "an unknown class": (setting(*AVOIDANCE, "class", "eval"), {}, r"transform.class: found 'eval'; accepted: Hand"),
    "a class of another kind": (setting(*AVOIDANCE, "class", "Sphere"), {}, "class: found 'Sphere'"),
    "no class": (lambda m: m["layers"][0]["transform"].pop("class"), {}, "class: found None"),
    "a class that is no name": (setting(*AVOIDANCE, "class", []), {}, r"class: found \[\]"),
    "a value for an object": (setting(*AVOIDANCE, 3), {}, "transform: found 3; accepted: an object"),
    "an unknown field": (setting(*AVOIDANCE, "__init__", 1), {}, "fields of .*: found '__init__'"),
    "a field that is missing": (lambda m: m["layers"][1]["transform"].pop("position"), {}, "too few fields.*position"),
    "another literal": (setting(*AVOIDANCE, "generator", "x"), {}, "generator: found 'x'"),
    "another space": (with_old_name, {}, "space: found 'x'"),
    "not a number": (setting(*AVOIDANCE, "margin", float("nan")), {}, "margin: found nan"),
    "text for a number": (setting(*AVOIDANCE, "margin", "1"), {}, "margin: found '1'; accepted: a finite number"),
    "true for a number": (setting(*AVOIDANCE, "margin", True), {}, "margin: found True"),
    "a negative margin": (setting(*AVOIDANCE, "margin", -1), {}, r"margin: found -1; accepted: 0 to 1"),
    "no end of steps": (setting(*AVOIDANCE, "integration", "steps", 10**9), {}, "integration.steps: found 1e"),
    "a fraction of a step": (
        setting(*AVOIDANCE, "integration", "steps", 1.5),
        {},
        "steps: found 1.5; accepted: an int",
    ),
    "a number for truth": (setting("layers", 0, "on", 1), {}, "on: found 1; accepted: true or false"),
    "half a character": (setting("layers", 0, "name", "\ud800"), {}, "surrogates"),
    "two coordinates": (setting(*AVOIDANCE, "obstacles", 0, "position", [0, 0]), {}, "accepted: 3 values"),
    "a flat ball": (
        setting(*AVOIDANCE, "obstacles", 0, "diameter", 0),
        {},
        r"obstacles\[0\].diameter: found 0; accepted: 1e-06 to 100",
    ),
    "a far ball": (setting(*AVOIDANCE, "obstacles", 0, "position", 0, 1e9), {}, "distance of an obstacle: found 1e"),
    "no orientation": (setting(*AVOIDANCE, "obstacles", 1, "wxyz", [0, 0, 0, 0]), {}, "quaternion: found 0"),
    "no such array": (setting(*AVOIDANCE, "obstacles", 3, "mesh", "faces", "x"), {}, "faces: found 'x'; acc"),
    "text for an array": (setting(*AVOIDANCE, "obstacles", 3, "mesh", "faces", [1]), {}, "accepted: the name of an"),
    "an array used twice": (
        setting("demonstrations", 1, "times", "motion.demonstrations[0].times"),
        {},
        r"demonstrations\[1\].times: found 'motion.dem",
    ),
    "faces of no vertices": (LEAVE, {f"{MESH}.faces": np.full((4, 3), 9999)}, "mesh.faces: found vertex 9999"),
    "faces of four": (LEAVE, {f"{MESH}.faces": np.zeros((4, 4), int)}, "mesh.mesh: found shapes"),
    "faces of fractions": (LEAVE, {f"{MESH}.faces": np.zeros((4, 3))}, "array of finite int64"),
    "infinite vertices": (LEAVE, {f"{MESH}.vertices": np.full((4, 3), np.inf)}, "array of finite float64"),
    "a mesh that is a point": (LEAVE, {f"{MESH}.vertices": np.zeros((162, 3))}, "mesh.size: found 0"),
    "many faces": (LEAVE, {f"{MESH}.faces": np.zeros((600_000, 3), int)}, "at most 500000"),
    "small numbers": (LEAVE, {f"{MESH}.vertices": np.zeros((4, 3), np.float16)}, "values of type float16"),
    "huge arrays": (LEAVE, {f"{MESH}.vertices": np.zeros((MAX_BYTES // 24 + 1, 3))}, "bytes when unpacked"),
    "a point, very often": (
        lambda m: m["layers"][0]["transform"]["obstacles"][4]["cloud"].update(labels=None),
        {"motion.layers[0].transform.obstacles[4].cloud.points": np.zeros((9999, 3))},
        "points: found 1 different ones; accepted: at least 50",
    ),
    "no demonstration": (setting("demonstrations", []), {}, "demonstrations: found none"),
    "times that fall": (LEAVE, {"motion.demonstrations[0].times": -np.arange(20.0)}, "times of 'arc 0'"),
    "another dimension": (
        LEAVE,
        {f"motion.demonstrations[{k}].positions": np.random.default_rng(0).uniform(0, 1, (20, 3)) for k in range(2)},
        "dimension of the imitation: found 2, and demonstrations in 3",
    ),
    "no goal": (LEAVE, {"imitation.goal": None}, "goal: found"),
    "a long goal": (LEAVE, {"imitation.goal": np.zeros(5)}, "axis_2: found shape"),
    "no layers": (LEAVE, {"imitation.layer_0_weights": None}, "2 coordinates and 0 layers"),
    "other weights": (LEAVE, {"imitation.layer_0_weights": np.zeros((3, 2))}, r"layer_0_weights: found shape \(3, 2\)"),
    "no width": (LEAVE, {"imitation.layer_0_ell_steps_forward": np.array([0.0, 4, 1])}, "ℓ = 0 and 4 steps"),
    "many steps": (LEAVE, {"imitation.layer_0_ell_steps_forward": np.array([1, 1e9, 1])}, "1 to 1000 steps"),
    "backward time": (LEAVE, {"imitation.base_knots": np.arange(48.0)[::-1]}, "knots that do not increase"),
    "a certificate of nothing": (LEAVE, {"imitation.certificates": np.full(3, np.nan)}, "certificates: found"),
    "pickled arrays": (LEAVE, {"imitation.goal": np.array([{}], object)}, "pickled objects are never opened"),
    "a pickled description": (LEAVE, {"motion": np.array({}, object)}, "pickled objects are never opened"),
    "numbers for the description": (LEAVE, {"motion": np.zeros(3)}, "arrays: found no text that describes a motion"),
    "other text": (LEAVE, {"motion": np.array("motion")}, "something that cannot be read"),
    "long text": (
        LEAVE,
        {"motion": np.array(" " * (MAX_TEXT + 1))},
        "text: found 3000001 characters; accepted: at most",
    ),
    "many layers": (lambda m: m.update(layers=m["layers"][1:] * 101), {}, "layers: found 101; accepted: at most 100"),
    "many arrays": (
        LEAVE,
        {f"imitation.x{k}": np.zeros(0) for k in range(MAX_ARRAYS)},
        r"arrays: found \d+; accepted: ",
    ),
    "many Gaussians": (LEAVE, MANY_GAUSSIANS, "Gaussians of what was learned, in all steps: found 2500"),
    "deep text": (LEAVE, {"motion": np.array("[" * 100_000)}, "something that cannot be read"),
    "a list": (LEAVE, {"motion": np.array("[1]")}, "version: found None"),
}


def refusal(content) -> str:
    with pytest.raises(dt.DataError) as info:
        read_motion(content, "a.npz")
    message = str(info.value)
    assert message.startswith("a.npz: ") and ": found " in message and "; accepted: " in message
    assert "\n" not in message and len(message) < 600
    return message


@pytest.mark.parametrize("name", FORGED)
def test_a_forged_file_is_refused_in_a_sentence(saved, name):
    change, arrays, words = FORGED[name]
    assert re.search(words, refusal(changed(saved, change, **arrays)))


def test_a_file_from_before_a_field_was_added_is_read(saved):
    def without(motion):
        for name in ("margin", "plane", "integration"):
            del motion["layers"][0]["transform"][name]

    motion, _ = read_motion(changed(saved, without), "a.npz")
    assert motion.layers[0].transform == replace(hostile.STACK[0], integration=dt.Integration())


def test_other_files_are_refused(saved, tmp_path):
    for content in (b"", saved[:-1], saved[: len(saved) // 2], b"{}", hostile.npz(points=np.zeros((9, 3)))):
        refusal(content)
    assert "no text that describes a motion" in refusal((ASSETS / "push_box.npz").read_bytes())
    (tmp_path / "large").write_bytes(bytes(MAX_BYTES + 1))
    with pytest.raises(dt.DataError, match="at most 40 MB"):
        dt.Motion.load(tmp_path / "large")
    for path in (tmp_path, str(tmp_path / "nothing")):
        with pytest.raises(dt.DataError, match="found no such file; accepted: a readable file"):
            dt.Motion.load(path)


@pytest.mark.long
@pytest.mark.parametrize("num", [60, pytest.param(3000, marks=pytest.mark.slow)])
def test_mutated_files_are_read_or_refused(saved, num):
    """Some are read, and most are not."""
    mutations = (*hostile.EVERYWHERE, hostile.with_changed_members, *(hostile.with_changed_text,) * 12)
    num_read = 0
    for number in range(num):
        content = hostile.mutated(saved, mutations, np.random.default_rng((12, number)))
        try:
            motion, imitation = read_motion(content, "a.npz")
        except dt.DataError:
            refusal(content)
            continue
        num_read += 1
        assert all(isinstance(layer.transform, tuple(registry.KINDS)) for layer in motion.layers)
        assert np.isfinite(imitation.starts).all() and len(imitation.starts)
    assert 0.02 * num < num_read < 0.7 * num


@pytest.mark.long
def test_shapes_of_a_motion_that_a_visitor_has_sent_are_measured_in_another_process(monkeypatch):
    for kept in (solids._distances, clouds._solid):
        kept.cache_clear()
    monkeypatch.setattr(triangles, "inside_of_grid", None)  # not here
    task = sent_motion_task("a.npz", hostile.sent_motion(), never)
    assert [part.depth > 0 for layer in task.layers for part in layer.transform.avoided.parts] == [True] * len(SHAPED)
