"""The scene of a visitor in the colours of a theme, and as pictures of it are rendered."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager

from dt_viz.ui.scene.palette import LIGHT
from dt_viz.ui.scene.robot_scene import RobotScene
from dt_viz.ui.scene.scene import ScenePictures


class Studio:
    """Paints a visitor's scene; what is rendered is in light colours, without handles."""

    def __init__(
        self,
        pictures: ScenePictures,
        robot: Callable[[], RobotScene],
        changing: Callable[[], AbstractContextManager[object]],
    ) -> None:
        """Take the scene; `changing` returns a block within which no other thread changes the arm."""
        self.theme = LIGHT
        """Theme of the page."""
        self.drawing = threading.Lock()
        """Held while a frame is drawn, or a video is made."""
        self._pictures, self._robot, self._changing = pictures, robot, changing
        self._renders = False

    def paint(self) -> None:
        """Paint all in the colours of the page, or of what is rendered now."""
        theme = LIGHT if self._renders else self.theme
        with self._changing():
            self._pictures.paint(theme)
            self._robot().paint(theme)

    @contextmanager
    def rendering(self) -> Iterator[None]:
        """Show the scene as pictures of it are, on white, for as long as they take."""
        self._renders = True
        self.paint()
        try:
            with self._pictures.without_handles(), self._robot().grip.hidden():
                yield
        finally:
            self._renders = False
            self.paint()
