"""What controls and the pen may use of the page that they are on; `page.Page` is one."""

from __future__ import annotations

from typing import Protocol

import viser

from dt_viz.scenario.saved import Saved
from dt_viz.scenario.slices import Slice
from dt_viz.session.opening import Preview
from dt_viz.session.session import Session
from dt_viz.ui.scene.camera import CameraController, Pose
from dt_viz.ui.scene.export import Studio
from dt_viz.ui.scene.palette import Colour
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures


class Host(Protocol):
    """The page of one visitor."""

    client: viser.ClientHandle
    pictures: ScenePictures
    robot: RobotScene  # of the scenario's arm
    camera: CameraController
    studio: Studio
    session: Session  # once the controls are built

    def send(self, suffix: str, content: bytes) -> None:
        """Have the browser save a file, whose name ends like this."""

    def notify(self, text: str, colour: Colour) -> None:
        """Show a text for a moment over a corner of the scene."""

    def darken(self, dark: bool) -> None:
        """Begin the dark theme, or the light one, on the panel and in the scene."""

    def preview(self, seen: Preview | None, number: int | None) -> None:
        """Show takes that are not learned yet in place of the motion, and which of them is chosen.

        No preview ends it: at once or, with no take, when what is wanted is shown.
        """

    def face(self, board: Slice | None) -> None:
        """Move the camera straight before a board, or to where all is seen."""

    def save(self) -> None:
        """Send the scenario as a file, beside the server's event loop, or show why that cannot be."""

    def open(self, name: str, content: bytes) -> bool:
        """Go on with the scenario that a file holds; return whether it holds one. Raises as `saved.decode`."""
        ...

    def resume(self, saved: Saved) -> None:
        """Go on with what was saved, beside the server's event loop."""

    def began(self, saved: Saved) -> None:
        """Take note of what the session is about to go on with, its task named as on this page."""

    def came_back(self, pose: Pose | None) -> None:
        """Have the camera where it was before the tour or Reset, with the visitor's own scenario."""
