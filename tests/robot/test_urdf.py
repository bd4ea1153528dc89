"""Arms from URDF files: kinematics against pinocchio, what is found in them, and files that cannot be used."""

import numpy as np
import pytest
from arm_files import BOX, joint, link, pinocchio_tool, urdf, write

from dt_viz.errors import naming
from dt_viz.robot.link_shapes import read_shapes, resolved
from dt_viz.robot.models import ARMS, DISTRIBUTION, robot_from_urdf, urdf_path
from dt_viz.robot.tool_chain import find_chain
from dt_viz.robot.urdf import ArmError, Description, read_robot

FINGERS = (
    joint("left_finger_joint", "l4", "left", "prismatic")
    + joint("right_finger_joint", "l4", "right", "prismatic", '<mimic joint="left_finger_joint"/>')
    + link("left")
    + link("right")
)


def chain_of(path, *given, srdf=None):
    description = Description(path)
    return description, find_chain(description, *given, semantic=None if srdf is None else read_robot(srdf))


def assert_as_pinocchio_has_it(path, description, chain):
    """At random angles: the place of the tool and its Jacobian."""
    arm = read_shapes(resolved(description, ())[0], chain).kinematics
    rng = np.random.default_rng(0)
    for q in rng.uniform(-3, 3, (20, arm.num_joints)):
        values = {own.name: angle for own, angle in zip(chain.joints, q, strict=True)} | dict(chain.locked)
        place, J = pinocchio_tool(path, values, chain.tool, chain.offset)
        np.testing.assert_allclose(arm.end_effector(q), place, rtol=0, atol=1e-12)
        np.testing.assert_allclose(arm.jacobian(q), J[:, : arm.num_joints], rtol=0, atol=1e-12)


HEAVY = {"so101", "z1"}


@pytest.mark.long
@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) if name in HEAVY else name for name in ARMS]
)
def test_kinematics_of_the_arms_are_those_of_pinocchio(name):
    known, path = ARMS[name], urdf_path(name)
    srdf = urdf_path(name, known.srdf) if known.srdf else None
    assert_as_pinocchio_has_it(path, *chain_of(path, known.end_effector, srdf=srdf))


@pytest.mark.parametrize("num", [3, 5, 7])
@pytest.mark.parametrize("tool", [None, ("l3", (0.1, -0.2, 0.3))])
def test_joints_may_turn_about_any_axis(tmp_path, num, tool):
    path = write(tmp_path, urdf(num))
    assert_as_pinocchio_has_it(path, *chain_of(path, tool))


def test_grippers_and_branches_are_locked_and_may_be_given_values(tmp_path):
    branch = joint("aside", "l1", "b1") + link("b1") + joint("loose", "b1", "b2", "floating") + link("b2")
    path = write(tmp_path, urdf(4, FINGERS + branch))
    description, chain = chain_of(path)
    assert [own.name for own in chain.joints] == ["j0", "j1", "j2", "j3"]
    assert dict(chain.locked) == {"left_finger_joint": 0, "right_finger_joint": 0, "aside": 0, "loose": 0}
    _, chain = chain_of(path, "tcp", {"j3": 0.7, "aside": -1.1})
    assert len(chain.joints) == 3 and chain.locked["j3"] == 0.7
    assert_as_pinocchio_has_it(path, description, chain)
    meshes = read_shapes(resolved(description, ())[0], chain).meshes
    assert {mesh.name: mesh.joint for mesh in meshes} == {
        "l0": -1, "l1": 0, "b1": 0, "b2": 0, "l2": 1, "l3": 2, "l4": 2, "left": 2, "right": 2,
    }  # fmt: skip


TOLD = '<end_effector name="e" parent_link="l4" group="g"/>'


@pytest.mark.parametrize(
    ("given", "srdf", "tool", "why"),
    [("l3", TOLD, "l3", "given"), (None, TOLD, "l4", "end effector of the SRDF"), (None, "", "tcp", "its name")],
)
def test_the_tool_is_given_or_told_by_the_srdf_or_by_its_name(tmp_path, given, srdf, tool, why):
    semantic = write(tmp_path, f'<robot name="small">{srdf}</robot>', "arm.srdf")
    _, chain = chain_of(write(tmp_path, urdf(4)), given, srdf=semantic)
    assert chain.tool == tool and chain.why.startswith(why)


def test_without_a_usual_name_the_tool_is_the_farthest_frame(tmp_path):
    text = urdf(4, link("far", "") + joint("on", "end", "far", "fixed")).replace("tcp", "end")
    _, chain = chain_of(write(tmp_path, text))
    assert (chain.tool, chain.why) == ("far", "farthest frame that the last joint moves")


def test_all_kinds_of_shapes_are_read_and_visuals_where_there_is_nothing_else(tmp_path):
    shapes = ('<cylinder radius="0.03" length="0.2"/>', '<sphere radius="0.05"/>', '<box size="0.1 0.02 0.2"/>')
    for shape, volume in zip(shapes, (np.pi * 0.03**2 * 0.2, 4 / 3 * np.pi * 0.05**3, 0.0004), strict=True):
        for tag in ("collision", "visual"):
            text = urdf(3, shape=f"<geometry>{shape}</geometry>").replace("collision", tag)
            description, chain = chain_of(write(tmp_path, text))
            found = read_shapes(resolved(description, ())[0], chain)
            assert [mesh.name for mesh in found.meshes] == ["l0", "l1", "l2", "l3"]
            assert [mesh.joint for mesh in found.visuals] == [-1, 0, 1, 2]  # what collides where nothing is drawn
            corners = found.meshes[1].vertices[found.meshes[1].faces]
            enclosed = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
            assert 0.98 * volume < enclosed < 1.001 * volume


BOMB = '<!DOCTYPE r [<!ENTITY a "aaaaaaaaaa">' + "".join(
    f'<!ENTITY {chr(98 + k)} "{"&" + chr(97 + k) + ";"}{"&" + chr(97 + k) + ";"}">' for k in range(20)
)
TWO_ROOTS = '<robot name="a"><link name="a"/><link name="b"/></robot>'
LOOP = f'<robot name="a">{link("a")}{link("b")}{joint("j", "a", "b")}{joint("k", "b", "a")}</robot>'
MISSING = '<geometry><mesh filename="package://mine/meshes/hand.stl"/></geometry>'
BAD = {
    "no file": (None, ["No such file", "URDF"]),
    "an empty file": ("", ["0 bytes"]),
    "binary": (b"\x00\x01solid\xff" * 100, ["XML", "<robot>"]),
    "another XML": ("<mujoco/>", ["<mujoco>", "<robot>"]),
    "entities": (BOMB + "]><robot>&u;</robot>", ["document type or entities"]),
    "an external entity": ('<!DOCTYPE r [<!ENTITY a SYSTEM "file:///etc/passwd">]><robot>&a;</robot>', ["entities"]),
    "an empty robot": ("<robot/>", ["links", "none", "xacro"]),
    "no shapes": (urdf(4, shape="").replace(BOX, ""), ["neither collision shapes nor visuals"]),
    "shapes of the base alone": (
        urdf(4, shape="").replace('<link name="l0"></link>', link("l0")),
        ["beyond the first joint", "links with shapes"],
    ),
    "millimetres": (urdf(4, shape='<geometry><box size="60 60 200"/></geometry>'), ["200 m across", 'scale="0.001']),
    "a missing mesh": (urdf(4, shape=MISSING), ["package://mine/meshes/hand.stl", "package_dirs="]),
    "another shape": (urdf(4, shape='<geometry><capsule radius="1" length="1"/></geometry>'), ["capsule", "mesh"]),
    "a prismatic joint": (
        urdf(4).replace('"j1" type="revolute"', '"j1" type="prismatic"'),
        ["j1", "prismatic", "locked="],
    ),
    "a floating joint": (urdf(4).replace('"j2" type="revolute"', '"j2" type="floating"'), ["j2", "a floating joint"]),
    "a mimic joint": (urdf(4).replace("<limit", '<mimic joint="j0"/><limit', 2), ["a mimic joint", "locked="]),
    "a kind nobody knows": (urdf(4).replace('"j1" type="revolute"', '"j1" type="ball"'), ["'ball'", "continuous"]),
    "a loop": (LOOP, ["loop"]),
    "two roots": (TWO_ROOTS, ["roots a, b"]),
    "two parents": (urdf(4, joint("again", "l0", "l3")), ["link l3", "j2 and again", "no loops"]),
    "a link that is not there": (urdf(4, joint("again", "l0", "nobody")), ["'nobody'", "l0, l1"]),
    "100 joints": (urdf(100), ["100 joints", "end_effector="]),
    "two joints": (urdf(2), ["2 joints"]),
    "no limits": (urdf(4).replace("<limit", "<other"), ["limit", "none", "continuous"]),
    "limits the wrong way": (urdf(4).replace('lower="-2"', 'lower="3"'), ["lower 3, upper 2"]),
    "no number": (urdf(4).replace('xyz="0 0 0.2"', 'xyz="0 zero 0.2"'), ["0 zero 0.2", "3 numbers"]),
    "NaN": (urdf(4).replace('upper="2"', 'upper="nan"'), ["nan", "a number"]),
    "NaN in an origin": (urdf(4).replace('xyz="0 0 0.2"', 'xyz="nan 0 0.2"'), ["origin", "numbers"]),
    "no axis": (urdf(4).replace('axis xyz="0 1 0"', 'axis xyz="0 0 0"'), ["axis", "0 0 0"]),
    "names twice": (urdf(4, link("l1")), ["2 named 'l1'"]),
}


@pytest.mark.parametrize("kind", BAD)
def test_what_cannot_be_used_is_told_in_one_line(tmp_path, kind):
    text, words = BAD[kind]
    path = tmp_path / "arm.urdf" if text is None else write(tmp_path, text)
    with pytest.raises(ArmError) as told:
        robot_from_urdf(path)
    message = str(told.value)
    assert message.startswith(f"{path}: ") and "found " in message and "accepted: " in message and "\n" not in message
    assert [word for word in words if word not in message] == [], message


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ({"end_effector": "palm"}, ["no link 'palm'", "l0, l1, l2, l3, l4, tcp"]),
        ({"end_effector": ("tcp", (1, 2))}, ["(1, 2)", "in metres"]),
        ({"locked": ["j9"]}, ["no joint 'j9'", "j0, j1"]),
        ({"home": (0, 0)}, ["(2,)", "4 angles"]),
        ({"home": (0, 0, 0, 3)}, ["j3 from -2.00 to 2.00"]),
        ({"front": "up"}, ["'up'", "-y"]),
        ({"front": (0, 0)}, ["horizontal direction"]),
    ],
)
def test_what_is_given_is_checked(tmp_path, given, words):
    path = write(tmp_path, urdf(4))
    with pytest.raises(ArmError) as told:
        robot_from_urdf(path, **given)
    assert [word for word in words if word not in str(told.value)] == [], told.value


def test_a_damaged_mesh_is_told(tmp_path):
    write(tmp_path, b"solid nothing" * 10, "broken.stl")
    with pytest.raises(ArmError, match=r"mesh: found .*; accepted: "):
        robot_from_urdf(write(tmp_path, urdf(4, shape='<geometry><mesh filename="broken.stl"/></geometry>')))


def test_the_package_holds_every_arm_and_a_xacro_without_links_is_told():
    assert all(urdf_path(name).is_file() for name in ARMS)
    empty = urdf_path("ur3", "ur_description/urdf/ur3.urdf")  # as shipped: nothing but a comment, and no name
    with pytest.raises(ArmError, match="links: found none"), naming(ArmError, empty):
        Description(empty)
    assert DISTRIBUTION in str(empty)
