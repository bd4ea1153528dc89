"""A scene of your own in the browser: the paths around a ball that is dragged.

Run it: python -m dt_viz.examples.viser_scene, and open the address that it prints.
"""

from __future__ import annotations

import time

import numpy as np
import viser

import dt_viz as dt

DIAMETER = 0.15  # diameter of the ball, metres


class Scene:
    """The paths of a motion, and the ball that they lead around."""

    def __init__(self, server: viser.ViserServer, motion: dt.Motion) -> None:
        """Draw the motion with the ball on the middle of its first path."""
        self.server, self.motion = server, motion
        path = motion.rollouts()[0].positions
        self.handle = server.scene.add_transform_controls("/ball", disable_rotations=True, scale=0.2)
        self.handle.position = path[len(path) // 2]
        server.scene.add_icosphere("/ball/surface", radius=DIAMETER / 2, color=(204, 121, 167))
        self.handle.on_update(lambda _: self.draw())
        self.draw()

    def draw(self) -> None:
        """Draw the paths around the ball where it stands."""
        x, y, z = (float(c) for c in self.handle.position)
        around = self.motion.stack(dt.Avoidance(dt.Sphere((x, y, z), DIAMETER)))
        for k, path in enumerate(around.rollouts(spacing=0.01)):
            segments = np.stack([path.positions[:-1], path.positions[1:]], axis=1)
            self.server.scene.add_line_segments(f"/path/{k}", segments, (213, 94, 0), thickness=0.005)


def main() -> None:
    """Serve the scene until it is interrupted."""
    motion = dt.fit(dt.example("lift_box"))
    Scene(viser.ViserServer(), motion)
    while True:
        time.sleep(1.0)


if __name__ == "__main__":
    main()
