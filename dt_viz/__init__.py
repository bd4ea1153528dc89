"""DT-Viz: diffeomorphic transforms for generalised imitation learning, live in the browser, and as a library.

    import dt_viz as dt

    motion = dt.fit(dt.example("push_box"))
    around = motion.stack(dt.Avoidance(dt.Sphere((0.10, -0.53, 0.15), diameter=0.15)))
    paths = around.rollouts()

Names are loaded when they are first used: whoever starts the page sets the number of threads before that.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from dt_viz.avoidance.avoidance import ArmAvoidance
    from dt_viz.avoidance.bias import BiasPoint
    from dt_viz.avoidance.hand import Avoidance, HandAvoidance
    from dt_viz.avoidance.transform import Transform
    from dt_viz.control.settings import ControllerSettings
    from dt_viz.errors import DataError, FormatError
    from dt_viz.flows.diffeomorphisms import Integration
    from dt_viz.learning.demonstrations import Demonstration, load_demonstrations
    from dt_viz.learning.imitation import ImitationSettings
    from dt_viz.learning.inspection import Finding, Inspection, PreparationSettings
    from dt_viz.learning.patterns import AugmentedSettings
    from dt_viz.learning.preparation import DemonstrationWarning, ImitationError
    from dt_viz.library.arm import Arm, BlockedError, Controller, JointPath, load_arm, load_jaco
    from dt_viz.library.hand import HandController
    from dt_viz.library.motion import Motion, Path, fit
    from dt_viz.library.takes import example
    from dt_viz.motion.certificates import Certificates
    from dt_viz.obstacles.shapes import Box, Capsule, Cylinder, Sphere
    from dt_viz.robot.robot import TrackingSettings
    from dt_viz.warning import MotionWarning

__all__ = [
    "Arm",
    "ArmAvoidance",
    "AugmentedSettings",
    "Avoidance",
    "BiasPoint",
    "BlockedError",
    "Box",
    "Capsule",
    "Certificates",
    "Controller",
    "ControllerSettings",
    "Cylinder",
    "DataError",
    "Demonstration",
    "DemonstrationWarning",
    "Finding",
    "FormatError",
    "HandAvoidance",
    "HandController",
    "ImitationError",
    "ImitationSettings",
    "Inspection",
    "Integration",
    "JointPath",
    "Motion",
    "MotionWarning",
    "Path",
    "PreparationSettings",
    "Sphere",
    "TrackingSettings",
    "Transform",
    "example",
    "fit",
    "load_arm",
    "load_demonstrations",
    "load_jaco",
]

_MODULES = {
    "control.settings": ("ControllerSettings",),
    "errors": ("DataError", "FormatError"),
    "flows.diffeomorphisms": ("Integration",),
    "learning.demonstrations": ("Demonstration", "load_demonstrations"),
    "learning.imitation": ("ImitationSettings",),
    "learning.patterns": ("AugmentedSettings",),
    "learning.inspection": ("Finding", "Inspection", "PreparationSettings"),
    "learning.preparation": ("DemonstrationWarning", "ImitationError"),
    "library.arm": ("Arm", "BlockedError", "Controller", "JointPath", "load_arm", "load_jaco"),
    "library.hand": ("HandController",),
    "library.motion": ("Motion", "Path", "fit"),
    "library.takes": ("example",),
    "motion.certificates": ("Certificates",),
    "obstacles.shapes": ("Box", "Capsule", "Cylinder", "Sphere"),
    "avoidance.avoidance": ("ArmAvoidance",),
    "avoidance.hand": ("Avoidance", "HandAvoidance"),
    "robot.robot": ("TrackingSettings",),
    "avoidance.transform": ("Transform",),
    "avoidance.bias": ("BiasPoint",),
    "warning": ("MotionWarning",),
}
"""Names by the module that defines them."""
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:  # noqa: ANN401 - classes and functions
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__() -> list[str]:
    return sorted(__all__)
