"""Saved scenarios: read back exactly; what no page can have saved is refused, by the name of what is wrong."""

import copy
import json
from contextlib import nullcontext
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import hostile
import numpy as np
import pytest
from scenes import biases, changed

from dt_viz.avoidance.bias import BiasPoint
from dt_viz.avoidance.passing import ANEW
from dt_viz.errors import DataError
from dt_viz.flows.diffeomorphisms import Integration
from dt_viz.learning.demonstrations import Demonstration, check_demonstrations
from dt_viz.learning.inspection import PreparationSettings
from dt_viz.obstacles.clouds import Cloud
from dt_viz.obstacles.shapes import Box, Capsule, CloudObstacle, Cylinder, MeshObstacle, Sphere, box_surface
from dt_viz.obstacles.solids import Solid
from dt_viz.scenario import saved as saved_module
from dt_viz.scenario.own import Own
from dt_viz.scenario.paper_scenes import CLOVER, bottle, offered
from dt_viz.scenario.saved import (
    MAX_BYTES,
    Known,
    Saved,
    ScenarioError,
    check_shapes,
    decode,
    encode,
    is_saved,
    portable,
)
from dt_viz.scenario.scenario import Scenario, Start, View
from dt_viz.scenario.slices import Panel, Slice, SlicePose
from dt_viz.scenario.stack import with_avoidance
from dt_viz.scenario.tasks import OWN, TASKS
from dt_viz.scenario.taught import MAX_POINTS, MAX_TAKES, Lesson, Taught

METHODS = ("eflow-repulsive", "linear", "modulation")
KNOWN = Known(tuple(TASKS), ("", "panda"), METHODS)
PLACE, TURN = (0.1, -0.5, 0.4), (0.8, 0.0, 0.6, 0.0)
DRAWING = ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
FROM_FILE = Solid(*box_surface(np.full(3, 0.05)))


def rich() -> Saved:
    """Something in each field."""
    obstacles = (Sphere(PLACE, 0.1), Box(PLACE, (0.1, 0.2, 0.3), TURN), Cylinder(PLACE, 0.08, 0.16, TURN))
    figures = (MeshObstacle(PLACE, bottle(), TURN, 0.7), CloudObstacle(PLACE, CLOVER.cloud, TURN, 1.2))
    points = BiasPoint(PLACE, 0.1, 0.5, DRAWING, True, Integration("rk4", 6)), BiasPoint(PLACE)
    avoidance = {"space": "task", "duration": 0.7, "temperature": 9.5, "margin": 0.03}
    view = View(
        slice=SlicePose(PLACE, TURN),
        colour="det",
        phase=0.25,
        compared=("linear", "modulation"),
        their_arm="linear",
        selected=3,
        panels=(Panel(), Panel("Bias 1", generator=True), Panel(task="draw_c", state="plain")),
        speed=0.5,
        start_label=0.5,
    )
    scenario = changed(
        Scenario("draw_s", warp=0.3, arm="panda", style="wavy", style_amount=-0.5, arm_rollout=7, state="augmented"),
        obstacles=(*obstacles, *figures),
        layers=biases(*points),
        starts=(Start(PLACE), Start(PLACE, -1.5)),
        view=view,
        **avoidance,
    )
    scenario = replace(scenario, stack=with_avoidance(scenario, plane=DRAWING))
    return Saved(scenario, (PLACE, (0.0, 0.0, 1 / 3)))


def assert_read_back(saved: Saved) -> None:
    text = encode(saved)
    again = decode(text, KNOWN)
    assert again == saved
    assert encode(again) == text
    assert len(text.encode()) <= MAX_BYTES


@pytest.mark.parametrize("scene", offered(TASKS), ids=lambda scene: scene.name)
def test_scenes_of_the_paper_are_read_back_with_their_shapes(scene):
    assert_read_back(Saved(scene.scenario(TASKS[scene.task]())))


def test_everything_is_read_back_exactly():
    saved = rich()
    assert_read_back(saved)
    usual = Scenario("draw_c")
    same = {
        field.name for field in fields(Scenario) if getattr(saved.scenario, field.name) == getattr(usual, field.name)
    }
    assert same == {"imitation", "objective", "scene", "passing"}


def test_numbers_of_numpy_are_numbers_and_a_capsule_is_an_obstacle():
    point: Any = tuple(np.array(PLACE))
    obstacles = Sphere(point, np.float64(0.1)), Capsule(PLACE, 0.1, 0.3, TURN)
    assert_read_back(Saved(changed(Scenario("draw_s"), obstacles=obstacles)))


def test_how_motions_pass_is_decided_anew():
    text = encode(Saved(Scenario("draw_s", passing=ANEW)))
    assert "passing" not in text and decode(text, KNOWN).scenario.passing is None


def test_shapes_from_files_are_left_out_and_counted():
    cloud = Cloud(np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3)))
    figures = MeshObstacle(PLACE, bottle()), Sphere(PLACE)
    scenario = changed(
        Scenario("draw_s"), obstacles=(MeshObstacle(PLACE, FROM_FILE), *figures, CloudObstacle(PLACE, cloud))
    )
    left, num = portable(scenario)
    assert (left.obstacles, num) == (figures, 2)
    assert_read_back(Saved(left))
    assert portable(left) == (left, 0)


# --- what does not ship ---


def brought(dim: int = 3) -> Own:
    """Demonstrations that a visitor has brought, with values that are no short decimals."""
    rng, s = np.random.default_rng(5), np.linspace(0, 1, 40)[:, None]
    turns = rng.normal(size=(40, 4))
    paths = [s * rng.normal(size=dim) * 0.2 + 0.05 * s * (1 - s) * rng.normal(size=dim) for _ in range(3)]
    given = [Demonstration(3 * s[:, 0] + s[:, 0] / 3, path, f"Größe <{k}>", turns) for k, path in enumerate(paths)]
    settings = PreparationSettings(goal=tuple(paths[0][-1].tolist()), cut_pauses=False)
    moves = (0.7, (0.1, -0.4, 1 / 3)), (1.3, (0.0, 0.0, 0.1))
    return Own(check_demonstrations(given, "test"), settings, ("‘0’ stands still",), moves)


def knots(num: int, rays: int = 1) -> dict[str, np.ndarray]:
    """The arrays of a timing with so many knots and rays."""
    rays_of = {"base_directions": np.ones((rays, 2)), "base_paces": np.ones((rays, num))}
    return {"base_knots": np.arange(float(num)), **rays_of}


LARGEST = {name: array for k in range(10) for name, array in hostile.flow_of((24, 30), 16, k).items()}
"""Ten flows of the most steps that a fit takes, each with the paper's 720 states."""


@pytest.mark.parametrize(
    ("num", "arrays"), [(50, LARGEST), (2, hostile.flow_of((50, 79), 500)), (1, hostile.flow_of((200, 50), 1))]
)
def test_what_was_learned_is_read_up_to_far_more_than_a_fit_has(num, arrays):
    text = encode(Saved(Scenario(OWN), own=hostile.with_learned(num, **arrays)))
    assert encode(decode(text, KNOWN)) == text


@pytest.mark.parametrize(
    ("num", "arrays", "found"),
    [
        (
            2,
            hostile.flow_of((650, 650), 900),
            r"Gaussians of what was learned, in all steps: found 380250\d{3}; accepted: ",
        ),
        (2, hostile.flow_of((50, 81), 500), "Gaussians of what was learned, in all steps: found 20"),
        (
            50,
            hostile.flow_of((50, 81), 100),
            "Gaussians of what was learned, in all steps of all demonstrations: found 20",
        ),
        (2, hostile.flow_of((4, 4), 998), "steps of what was learned: found 1002; accepted: at most 1000"),
        (2, knots(201), "base_knots: found 201; accepted: at most 200"),
        (2, knots(48, 1001), "base_directions: found 1001; accepted: at most 1000"),
    ],
)
def test_more_than_can_be_shown_soon_is_refused_by_its_name(num, arrays, found):
    with pytest.raises(DataError, match=found) as caught:
        decode(encode(Saved(Scenario(OWN), own=hostile.with_learned(num, **arrays))), KNOWN, "a file")
    assert str(caught.value).startswith("a file: ") and "\n" not in str(caught.value)


@pytest.mark.parametrize("dim", [2, 3])
def test_demonstrations_and_shapes_from_files_are_read_back_to_the_last_bit(dim):
    own, cloud = brought(dim), Cloud(np.random.default_rng(0).uniform(-0.1, 0.1, (60, 3)))
    obstacles = MeshObstacle(PLACE, FROM_FILE, TURN, 0.7), CloudObstacle(PLACE, cloud), MeshObstacle(PLACE, bottle())
    saved = Saved(changed(Scenario("own_data_3"), obstacles=obstacles), own=own)
    text = encode(saved)
    again = decode(text, KNOWN)
    assert encode(again) == text == encode(decode(text.encode(), KNOWN))
    assert again.scenario == replace(saved.scenario, task=OWN) and again.own is not None
    before, after = own.task, again.own.task
    for a, b in zip(before.demonstrations, after.demonstrations, strict=True):
        assert (a.name, a.times.tobytes(), a.positions.tobytes()) == (b.name, b.times.tobytes(), b.positions.tobytes())
        assert a.orientations is not None and b.orientations is not None
        assert a.orientations.tobytes() == b.orientations.tobytes()
    assert [path.tobytes() for path in before.paths] == [path.tobytes() for path in after.paths]
    assert (after.preparation, after.seen, after.size) == (own.preparation, own.seen, before.size)
    assert (after.camera, after.obstacle_position) == (before.camera, before.obstacle_position)
    assert is_saved(text.encode())


def test_a_text_of_the_first_version_is_read_and_saved_as_one_of_this():
    first = (Path(__file__).parent.parent / "frozen" / "scenario_version_1.json").read_text(encoding="utf-8")
    assert '"version":1' in first and is_saved(first.encode())
    saved = decode(first, KNOWN)
    assert saved == rich()
    assert '"version":2' in encode(saved)
    assert_read_back(saved)


def lesson(num: int = 2) -> Lesson:
    """Takes that were drawn, and one that was guided, with values that are no short decimals."""
    rng, s = np.random.default_rng(6), np.linspace(0, 1, 30)[:, None]
    board = Slice(np.array([0.1, -0.5, 1 / 3]), np.eye(3)[:, :2], (0.3, 0.2))

    def take(name: str, dim: int) -> Taught:
        path = s * rng.normal(size=dim) * 0.2
        kept = check_demonstrations([Demonstration(3 * s[:, 0] + s[:, 0] / 3, path, name)], "test")[0]
        return Taught(kept, rng.uniform(-0.3, 0.3, (20, 3)), board if dim == 2 else None)

    return Lesson((*(take(f"drawn {k + 1}", 2) for k in range(num)), take(f"guided {num + 1}", 3)), (1,))


@pytest.mark.parametrize("num", [1, MAX_TAKES - 1])
def test_takes_that_are_taught_are_read_back_to_the_last_bit_learned_or_not(num):
    own = replace(brought(), lesson=lesson(num))
    for saved in (Saved(rich().scenario, lesson=lesson(num)), Saved(Scenario("own_data_1"), own=own, lesson=lesson())):
        text = encode(saved)
        again = decode(text, KNOWN)
        assert encode(again) == text and '"version":3' in text
        assert again.lesson is not None and saved.lesson is not None
        for a, b in zip(saved.lesson.takes, again.lesson.takes, strict=True):
            assert (a.name, a.drawn.tobytes(), a.kept.times.tobytes()) == (
                b.name,
                b.drawn.tobytes(),
                b.kept.times.tobytes(),
            )
            assert a.kept.positions.tobytes() == b.kept.positions.tobytes()
            assert (a.board and a.board.key) == (b.board and b.board.key)
        assert again.lesson.left_out == (1,)
    assert again.own is not None and again.own.task.lesson == again.own.lesson is not None
    assert Own.of(again.own.task).lesson is again.own.lesson


def test_without_takes_that_are_taught_the_text_is_as_of_the_version_before():
    frozen = (Path(__file__).parent.parent / "frozen" / "scenario_version_2.json").read_text(encoding="utf-8")
    for saved in (rich(), Saved(Scenario("own_data_1"), own=brought())):
        assert '"version":2' in encode(saved) and "lesson" not in encode(saved)
    again = decode(frozen, KNOWN)
    assert encode(again) == frozen and again.lesson is None and again.own is not None and again.own.lesson is None


def taught(**changes: Any) -> Any:
    """Change the first of some takes, which was drawn: fields of it, of what is kept, and of its board."""

    def change(given: Lesson) -> Lesson:
        first, *others = given.takes
        fields = {part: set(getattr(first, part).__dataclass_fields__) for part in ("kept", "board")}
        parts = {
            part: replace(getattr(first, part), **{name: changes[name] for name in changes if name in fields[part]})
            for part in fields
        }
        own = {name: value for name, value in changes.items() if name in ("drawn", "board")}
        return replace(given, takes=(replace(first, **parts | own), *others))

    return change


PATH = np.linspace(0, 0.2, 30)[:, None]
LESSON_FORGERIES: list[tuple[Any, str]] = [
    (taught(name="guided 3"), "names of takes"),
    (taught(name="drawn ٣"), "name of a take"),
    (taught(name="drawn 0"), "name of a take"),
    (taught(name="drawn " + "9" * 400), "name of a take"),
    (taught(name="<script> 1"), "name of a take"),
    (taught(positions=PATH * [1, np.nan]), "positions"),
    (taught(positions=PATH * [1, 1000]), "positions"),
    (taught(positions=PATH * [0, 0]), "positions"),
    (taught(positions=PATH * [1, 1, 1]), "drawn 1"),
    (taught(orientations=np.full((30, 4), 0.5)), "drawn 1"),
    (taught(times=np.zeros(30)), "times"),
    (taught(board=None), "drawn 1"),
    (taught(drawn=np.zeros((0, 3))), "drawn"),
    (taught(drawn=np.zeros((20, 2))), "drawn"),
    (taught(drawn=np.zeros((MAX_POINTS + 1, 3))), "drawn"),
    (taught(drawn=np.full((20, 3), 1e9)), "drawn"),
    (taught(centre=np.zeros(2)), "board"),
    (taught(axes=np.eye(3)), "board"),
    (taught(centre=np.full(3, 9.0)), "centre"),
    (taught(axes=np.ones((3, 2))), "axes"),
    (taught(half_size=(0.0, 0.2)), "half_size"),
    (taught(half_size=(0.2, 1e3)), "half_size"),
    (lambda given: replace(given, takes=()), "number of takes"),
    (lambda given: replace(given, left_out=(3,)), "left_out"),
    (lambda given: replace(given, left_out=(1, 0)), "left_out"),
    (lambda given: replace(given, left_out=(1, 1)), "left_out"),
    (lambda given: replace(given, left_out=(-1,)), "left_out"),
]


@pytest.mark.parametrize("learned", [True, False])
@pytest.mark.parametrize(("forge", "field"), LESSON_FORGERIES)
def test_forged_takes_are_refused_by_the_name_of_what_is_wrong(forge, field, learned):
    forged = forge(lesson())
    saved = Saved(Scenario("own_data_1"), own=replace(brought(), lesson=forged)) if learned else None
    with pytest.raises(DataError) as caught:
        decode(encode(saved or Saved(rich().scenario, lesson=forged)), KNOWN, "a file")
    assert field in caught.value.field and str(caught.value).startswith("a file: "), caught.value


def test_more_takes_than_a_page_teaches_are_refused():
    with pytest.raises(DataError, match="takes"):
        decode(encode(Saved(Scenario("draw_s"), lesson=lesson(MAX_TAKES))), KNOWN)


@pytest.mark.long
def test_an_open_mesh_is_refused_and_a_closed_one_is_not():
    for faces, refused in ((FROM_FILE.faces, False), (FROM_FILE.faces[:5], True)):
        mesh = MeshObstacle(PLACE, Solid(FROM_FILE.vertices, faces))
        saved = decode(encode(Saved(changed(Scenario("draw_s"), obstacles=(mesh,)))), KNOWN)
        with pytest.raises(ScenarioError, match="mesh") if refused else nullcontext():
            check_shapes(saved.scenario)


def test_what_is_larger_than_can_be_read_is_not_saved(monkeypatch):
    monkeypatch.setattr(saved_module, "MAX_BYTES", 2000)
    with pytest.raises(ScenarioError, match="file"):
        encode(Saved(Scenario("own_data_1"), own=brought()))


OWN_FORGERIES: list[tuple[str, Any, str]] = [
    ("scenario.task", "draw_s", "task"),
    ("own.demonstrations", [], "arrays"),
    ("own.demonstrations.0.times", "saved.own.demonstrations[1].times", "times"),
    ("own.demonstrations.0.orientations", None, "arrays"),
    ("own.preparation.cutoff", 1e-9, "preparation"),
    ("own.preparation.goal", [0.0], "goal"),
    ("own.preparation.goal", [0.0, 1e9, 0.0], "goal"),
    ("own.seen", ["x"] * 1001, "seen"),
    ("own.moves", [[1.0, [0, 0, 0]]] * 21, "moves"),
    ("own.moves", [[0.0, [0, 0, 0]]], "scale"),
    ("own.moves", [[1.0, [0, 0, 9]]], "shift"),
    ("own.moves", [[10.0, [0, 0, 0]]] * 9, "farthest"),
    ("arrays", {}, "times"),
]


# --- what no page has saved ---


def at(path: str, plain: Any, value: Any) -> Any:
    """A copy of what JSON holds with another value at a place such as "scenario.starts.0.place"."""
    plain = copy.deepcopy(plain)
    *way, last = (int(key) if key.isdecimal() else key for key in path.split("."))
    owner = plain
    for key in way:
        owner = owner[key]
    owner[last] = value
    return plain


AVOIDANCE, BIAS, SPHERE = (
    "scenario.stack.2.transform",
    "scenario.stack.0.transform",
    "scenario.stack.2.transform.obstacles.0",
)
FORGERIES: list[tuple[str, Any, str]] = [
    ("version", 4, "version"),
    ("version", 0, "version"),
    ("version", None, "version"),
    ("scenario", None, "saved.scenario"),
    ("scenario.extra", 1, "fields of saved.scenario"),
    ("scenario.task", "own_data_1", "task"),
    ("scenario.task", 3, "saved.scenario.task"),
    ("scenario.arm", "no arm", "arm"),
    ("scenario.scene", "no scene", "scene"),
    ("scenario.scene", "lift", "scene"),
    ("scenario.style", "baroque", "style"),
    ("scenario.style_amount", 2.5, "style_amount"),
    ("scenario.warp", 1.0001, "warp"),
    ("scenario.warp", -1, "warp"),
    ("scenario.state", "nonsense", "state"),
    ("scenario.arm_rollout", -1, "arm_rollout"),
    ("scenario.arm_rollout", 10**6, "arm_rollout"),
    ("scenario.arm_rollout", 2**70, "arm_rollout"),
    ("scenario.passing", {"class": "Passing"}, "passing"),
    ("scenario.starts", [{"class": "Start", "place": PLACE}] * 37, "starts"),
    ("scenario.starts.0.place", [0, 0, 5.1], "place of a start"),
    ("scenario.stack", [{"class": "Layer"}], "stack[0]"),
    ("scenario.stack.0.name", "Bias 2", "name of a transform"),
    ("scenario.stack.0.name", "Bias ٣", "name of a transform"),
    ("scenario.stack.0.name", "<script>", "name of a transform"),
    ("scenario.stack.2.name", "Bias 3", "name of a transform"),
    ("scenario.stack.1.transform", {"class": "HandAvoidance"}, "transforms 'Avoidance'"),
    (f"{BIAS}.class", "Sphere", "class"),
    (f"{BIAS}.position", [0, 0, -5.1], "position"),
    (f"{BIAS}.radius", 3.0, "radius"),
    (f"{BIAS}.radius", -0.1, "radius"),
    (f"{BIAS}.strength", 4.1, "strength"),
    (f"{BIAS}.plane", [[1, 0, 0], [0.1, 0, 1]], "plane"),
    (f"{BIAS}.plane", [[1, 0, 0]], "plane"),
    (f"{BIAS}.integration.steps", 51, "steps"),
    (f"{BIAS}.integration.method", "leapfrog", "method"),
    (f"{AVOIDANCE}.temperature", 30.0, "temperature"),
    (f"{AVOIDANCE}.temperature", None, "temperature"),
    (f"{AVOIDANCE}.duration", 2.5, "duration"),
    (f"{AVOIDANCE}.margin", 0.06, "margin"),
    (f"{AVOIDANCE}.generator", "∇p", "generator"),
    (f"{AVOIDANCE}.detour.num_directions", 10_000, "detour"),
    (f"{AVOIDANCE}.obstacles", [{"class": "Sphere", "position": PLACE}] * 6, "obstacles"),
    (f"{AVOIDANCE}.obstacles.0", {"class": "MeshObstacle", "position": PLACE, "mesh": "a"}, "mesh"),
    ("arrays", {"a": {"shape": [1], "type": "float64", "data": "AAAAAAAAAAA="}}, "arrays"),
    (f"{AVOIDANCE}.obstacles.1.sizes", [0.1, 0.1, 1e-4], "depth"),
    (f"{AVOIDANCE}.obstacles.1.sizes", [0.1, 0.1, 5.0], "radius"),
    (f"{AVOIDANCE}.obstacles.1.wxyz", [0, 0, 0, 0], "wxyz"),
    (f"{AVOIDANCE}.obstacles.2.height", 0, "height"),
    (f"{AVOIDANCE}.obstacles.3.shape", "teapot", "shape"),
    (f"{AVOIDANCE}.obstacles.3.scale", 100.0, "scale"),
    (f"{SPHERE}.position", [1e3, 0, 0], "position"),
    (f"{SPHERE}.diameter", 50.0, "depth"),
    (f"{SPHERE}.diameter", -0.1, "diameter"),
    ("scenario.view.colour", "red", "colour"),
    ("scenario.view.phase", 1.1, "phase"),
    ("scenario.view.speed", 0.0, "speed"),
    ("scenario.view.selected", -1, "selected"),
    ("scenario.view.generator_layer", -9, "generator_layer"),
    ("scenario.view.compared", ["ours", "theirs"], "compared"),
    ("scenario.view.their_arm", "theirs", "compared"),
    ("scenario.view.panels", [{"class": "Panel"}] * 21, "panels"),
    ("scenario.view.panels.0.task", "own_data_1", "panel"),
    ("scenario.view.slice.position", [0, 9, 0], "slice"),
    ("scenario.view.slice.wxyz", [0.1, 0, 0, 0], "slice"),
    ("camera", [PLACE, PLACE], "sight"),
    ("camera", [PLACE, [2e4, 0, 0]], "camera"),
    ("camera", [PLACE], "camera"),
]


FORGED = [(rich(), *forgery) for forgery in FORGERIES]
FORGED += [(Saved(Scenario("own_data_1"), own=brought()), *forgery) for forgery in OWN_FORGERIES]


@pytest.mark.parametrize(
    ("saved", "path", "value", "field"), FORGED, ids=[f"{path}={value!r}"[:60] for _, path, value, _ in FORGED]
)
def test_what_no_page_can_have_saved_is_refused_by_its_name(saved, path, value, field):
    forged = at(path, json.loads(encode(saved)), value)
    with pytest.raises(ScenarioError if saved.own is None else DataError) as caught:
        decode(json.dumps(forged), KNOWN, "a browser")
    assert field in caught.value.field, caught.value
    assert str(caught.value).startswith("a browser: ")


TEXTS = {
    "empty": "",
    "no JSON": "hello",
    "a list": "[]",
    "null": "null",
    "not finite": encode(rich()).replace("0.3", "1e999", 1),
    "not a number": encode(rich()).replace("0.3", "NaN", 1),
    "deep": "[" * 30_000 + "]" * 30_000,
    "deep in it": encode(rich()).replace('"camera":', '"camera":' + "[" * 20_000, 1),
    "half a character": encode(rich()).replace("draw_s", "\ud800", 1),
    "half a character, escaped": encode(rich()).replace("draw_s", "\\ud800", 1),
    "too large": encode(rich()) + " " * MAX_BYTES,
    "too large in bytes": '"' + "ψ" * (MAX_BYTES // 2) + '"',
}


@pytest.mark.parametrize("text", TEXTS.values(), ids=TEXTS)
def test_texts_that_are_none_are_refused(text):
    with pytest.raises(ScenarioError):
        decode(text, KNOWN)


def leaves(plain: Any, path: str = "") -> Any:
    """Paths of all values in what JSON holds."""
    if isinstance(plain, dict | list):
        for key, value in plain.items() if isinstance(plain, dict) else enumerate(plain):
            yield from leaves(value, f"{path}.{key}" if path else str(key))
    yield path


@pytest.mark.long
def test_each_value_replaced_by_any_other_is_refused_or_makes_a_scenario():
    plain = json.loads(encode(rich()))
    paths = [path for path in leaves(plain) if path]
    assert len(paths) > 150
    values = (*hostile.VALUES, -1e-9, 1e6, "draw_c", {"class": "Start"}, PLACE)
    rng = np.random.default_rng(0)
    tried = [(path, values[k]) for path in paths for k in rng.choice(len(values), 6, replace=False)]
    read = 0
    for path, value in tried:
        try:
            saved = decode(json.dumps(at(path, plain, value)), KNOWN)
        except DataError as error:  # nothing else may be raised
            assert isinstance(error, ScenarioError) and error.field and error.accepted
            continue
        assert_read_back(saved)
        read += 1
    assert 0.01 < read / len(tried) < 0.5
