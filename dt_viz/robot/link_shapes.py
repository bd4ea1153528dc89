"""Shapes of an arm's links, read from a URDF: solids for collisions, and coloured meshes that are drawn.

Pinocchio reads the URDF, in which addresses of meshes are paths, and locks joints that are no part of the chain
(grippers, other branches). Links without collision shapes have those that are drawn.
"""

# pyright: reportAttributeAccessIssue=false
# (pinocchio has no stubs)

from __future__ import annotations

import copy
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from dt_viz.errors import FormatError
from dt_viz.flows.fields import Array, Indices
from dt_viz.robot.kinematics import Kinematics
from dt_viz.robot.tool_chain import ArmChain
from dt_viz.robot.urdf import Description, LinkMesh, VisualMesh, constant

SHAPES = ("box", "cylinder", "sphere", "mesh")
COLOURED = (".dae", ".obj", ".glb", ".gltf", ".ply")
"""Suffixes of files of meshes that have colours of their own."""
LARGEST = 50.0
"""Largest extent of a link, in reaches of the arm: a mesh in millimetres is a thousand times too large."""
SHORTEST_HAND = 0.03
"""Least distance of the tool from the last joint for that to be the hand's direction, metres; else that is its z."""


def resolved(description: Description, package_dirs: Sequence[Path]) -> tuple[str, list[Path]]:
    """Return a URDF's text with its meshes as paths, and these; they are looked for in the folders, too.

    It has what `read_shapes` needs, and no limits.

    Raises:
        FormatError: A mesh is missing, or a shape is of another kind.
    """
    root, files = ElementTree.Element("robot", name=description.name), []
    for name, element in description.links.items():
        link = ElementTree.SubElement(root, "link", name=name)
        for shape in copy.deepcopy([*element.findall("collision"), *element.findall("visual")]):
            kind, field = shape.find("geometry/*"), f"link {name}: {shape.tag}"
            if kind is None or kind.tag not in SHAPES:
                raise FormatError(field, "nothing" if kind is None else kind.tag, ", ".join(SHAPES))
            if kind.tag == "mesh":
                files.append(_mesh_file(kind.get("filename", ""), description.path, package_dirs, field))
                kind.set("filename", str(files[-1]))
            link.append(shape)
    for name, joint in description.joints.items():
        kept = ElementTree.SubElement(root, "joint", name=f"joint {name}", type=joint.kind)  # a link may have its name
        kept.extend(part for tag in ("parent", "child", "origin") for part in joint.element.iterfind(tag))
        if joint.moves:
            ElementTree.SubElement(kept, "axis", xyz=" ".join(map(repr, joint.axis.tolist())))
            ElementTree.SubElement(kept, "limit", lower="0", upper="0", velocity="0", effort="0")
    root.extend(description.materials)
    return ElementTree.tostring(root, encoding="unicode"), list(dict.fromkeys(files))


def _mesh_file(address: str, urdf: Path, package_dirs: Sequence[Path], field: str) -> Path:
    scheme, _, rest = address.rpartition("://")
    if scheme in ("package", "model"):
        inside = Path(*Path(rest).parts[1:])  # of the package, whose folder may have another name
        candidates = [folder / rest for folder in (*package_dirs, *urdf.parents)]
        candidates += [folder / inside for folder in package_dirs]
    else:
        candidates = [urdf.parent / rest]
    for path in filter(Path.is_file, candidates):
        return path.resolve()
    others = " and others; name its package_dirs=" if len(candidates) > 1 else ""
    raise FormatError(field, f"no mesh {address!r}", f"a file; looked in {candidates[0]}{others}")


class Shapes(NamedTuple):
    """What moves with the joints of a chain, in the URDF's base frame and with joints about z."""

    kinematics: Kinematics
    meshes: tuple[LinkMesh, ...]  # collision shapes, one for each link, by joint
    visuals: tuple[VisualMesh, ...]

    def turned(self, base: Array) -> Shapes:
        """The same on a base that is turned by a rotation (3, 3)."""
        meshes, visuals = (mesh.turned(base) for mesh in self.meshes), (mesh.turned(base) for mesh in self.visuals)
        return Shapes(self.kinematics.turned(base), tuple(meshes), tuple(visuals))


def read_shapes(text: str, chain: ArmChain) -> Shapes:
    """Read kinematics and shapes of a `resolved` URDF, reduced to a chain.

    With A_i e_z the axis of joint i in its own frame in the URDF, R_i' = A_{i-1}ᵀ R_i A_i, t_i' = A_{i-1}ᵀ t_i, and
    what moves with the joint is turned by A_iᵀ.

    Raises:
        FormatError: A mesh cannot be read, or no link has a shape.
    """
    model, (collisions, drawn) = _reduced(text, chain.locked)
    turns = [_to_axis(joint.axis) for joint in chain.joints]
    before = [np.eye(3), *turns]
    places = model.jointPlacements[1:]
    hand = model.frames[model.getFrameId(chain.tool, pin.FrameType.BODY)].placement
    offset = (hand.translation + hand.rotation @ chain.offset) @ turns[-1]
    far = float(np.linalg.norm(offset)) > SHORTEST_HAND
    axis = offset if far else hand.rotation[:, 2] @ turns[-1]
    joints = list(zip(places, before, turns, strict=False))
    kinematics = Kinematics(
        constant([first.T @ place.rotation @ turn for place, first, turn in joints]),
        constant([place.translation @ first for place, first, _ in joints]),
        constant(offset),
        constant(axis),
        constant(_with_z_along(turns[-1].T @ hand.rotation, axis)),
    )
    solids: dict[str, LinkMesh] = {}
    with_solid = {name for name, _ in collisions}
    for name, shape in [*collisions, *((name, shape) for name, shape in drawn if name not in with_solid)]:
        mesh = LinkMesh(name, shape.parentJoint - 1, *_placed(*_triangles(shape.geometry), shape, before))
        solids[name] = _joined(solids[name], mesh) if name in solids else mesh
    if not any(mesh.joint > 0 for mesh in solids.values()):
        found = "neither collision shapes nor visuals beyond the first joint"
        raise FormatError("links", found, f"links with shapes: {', '.join(SHAPES)}")
    for name, mesh in solids.items():
        if (size := float(np.ptp(mesh.vertices, axis=0).max())) > LARGEST * kinematics.reach:
            accepted = 'metres; of a mesh in millimetres: <mesh … scale="0.001 0.001 0.001"/>'
            raise FormatError(f"link {name}", f"{size:.3g} m across", accepted)
    visuals = []
    for _, shape in drawn:
        for name, vertices, faces, colour in _coloured(shape):
            visuals.append(VisualMesh(name, shape.parentJoint - 1, *_placed(vertices, faces, shape, before), colour))
    by_joint = sorted(solids.values(), key=lambda mesh: mesh.joint)
    if not any(mesh.joint > 0 for mesh in visuals):  # what is not drawn is shown by what collides
        visuals += [VisualMesh(mesh.name, mesh.joint, mesh.vertices, mesh.faces) for mesh in by_joint]
    return Shapes(kinematics, tuple(by_joint), tuple(visuals))


def _reduced(text: str, locked: Mapping[str, float]) -> tuple[Any, list[list[tuple[str, Any]]]]:
    """Return the model without locked joints, and its collision shapes and visuals with the names of their links."""
    try:
        whole = pin.buildModelFromXML(text)
        kinds = (pin.GeometryType.COLLISION, pin.GeometryType.VISUAL)
        shapes = [pin.buildGeomFromUrdfString(whole, text, kind, package_dirs=[]) for kind in kinds]
    except (ValueError, RuntimeError) as error:
        accepted = "origins of numbers; STL, OBJ, DAE with triangles"
        raise FormatError("joint or mesh", " ".join(str(error).split())[:200], accepted) from error
    q, numbers = pin.neutral(whole), [whole.getJointId(f"joint {name}") for name in locked]
    for number, value in zip(numbers, locked.values(), strict=True):
        joint = whole.joints[number]
        if joint.nv == 1:
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else value
    names = [[whole.frames[shape.parentFrame].name for shape in each.geometryObjects] for each in shapes]
    model, placed = pin.buildReducedModel(whole, shapes, numbers, q)
    return model, [
        list(zip(*each, strict=True)) for each in zip(names, (s.geometryObjects for s in placed), strict=True)
    ]


def _to_axis(axis: Array) -> Array:
    """Return a rotation (3, 3) of e_z to an axis (3,): of the coordinates where it is along one."""
    k = int(np.abs(axis).argmax())
    if np.abs(axis)[k] == 1.0 and axis[k] > 0:
        return np.roll(np.eye(3), k - 2, axis=1).T.copy()
    return Rotation.align_vectors(axis[None], [[0.0, 0.0, 1.0]])[0].as_matrix()


def _with_z_along(frame: Array, axis: Array) -> Array:
    """Turn a frame (3, 3) by right angles so that, of its axes, z is the one nearest to a direction (3,)."""
    along = frame.T @ axis
    nearest = int(np.abs(along).argmax())
    side, turn = float(np.sign(along[nearest])), np.eye(3)
    if nearest == 2:
        turn[1, 1] = turn[2, 2] = side
    else:
        turn[:, 2], turn[:, nearest] = side * turn[:, nearest], -side * turn[:, 2]
    return frame @ turn


def _placed(vertices: Array, faces: Indices, shape: Any, turns: Sequence[Array]) -> tuple[Array, NDArray[np.intp]]:  # noqa: ANN401
    """Place a shape in the frame of its joint."""
    placed = vertices @ shape.placement.rotation.T + shape.placement.translation
    return constant(placed @ turns[shape.parentJoint]), constant(faces, np.intp)


def _joined(mesh: LinkMesh, other: LinkMesh) -> LinkMesh:
    faces = constant(np.concatenate([mesh.faces, other.faces + len(mesh.vertices)]), np.intp)
    return LinkMesh(mesh.name, mesh.joint, constant(np.concatenate([mesh.vertices, other.vertices])), faces)


def _triangles(shape: Any) -> tuple[Array, Indices]:  # noqa: ANN401 - no stubs
    """Return vertices (V, 3), metres, and faces (F, 3) of a shape."""
    kind = type(shape).__name__
    if hasattr(shape, "num_tris"):
        triangles = (shape.tri_indices(i) for i in range(shape.num_tris))
        return shape.vertices(), np.array([[triangle[k] for k in range(3)] for triangle in triangles])
    made: dict[str, Callable[[], trimesh.Trimesh]] = {
        "Box": lambda: trimesh.creation.box(2 * shape.halfSide),
        "Sphere": lambda: trimesh.creation.icosphere(3, shape.radius),
        "Cylinder": lambda: trimesh.creation.cylinder(shape.radius, 2 * shape.halfLength, sections=48),
    }
    solid = made[kind]()
    return np.array(solid.vertices), np.array(solid.faces)


def _coloured(shape: Any) -> Iterator[tuple[str, Array, Indices, tuple[int, int, int]]]:  # noqa: ANN401 - no stubs
    """Yield the parts of a drawn shape, each with a name and a colour: that of the file, or of the URDF."""
    path, (vertices, faces) = Path(shape.meshPath), _triangles(shape.geometry)
    if path.suffix.lower() in COLOURED and hasattr(shape.geometry, "num_tris"):
        parts = _coloured_parts(path, np.asarray(shape.meshScale))
        every = np.concatenate([part[1] for part in parts]) if parts else np.full((1, 3), np.inf)
        if np.allclose(_bounds(vertices), _bounds(every), atol=1e-3):  # other readers scale and turn some otherwise
            yield from parts
            return
    red, green, blue = (round(255 * float(value)) for value in shape.meshColor[:3])
    yield path.name, vertices, faces, (red, green, blue)


def _bounds(points: Array) -> Array:
    return np.array([points.min(axis=0), points.max(axis=0)])


def _coloured_parts(path: Path, scale: Array) -> list[tuple[str, Array, Indices, tuple[int, int, int]]]:
    """Read the parts of a file of meshes with their colours; none where that is not possible."""
    try:
        found = trimesh.load_scene(path).dump()
    except Exception:  # of whatever reader the file needs: its triangles are there without colours, too
        return []
    parts = []
    for mesh in found:
        if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces):
            colour = getattr(getattr(mesh.visual, "material", None), "main_color", None)
            colour = (230, 230, 230) if colour is None else colour
            red, green, blue = (int(value) for value in colour[:3])
            parts.append((path.name, np.array(mesh.vertices) * scale, np.array(mesh.faces), (red, green, blue)))
    return parts
