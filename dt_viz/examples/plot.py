# %% [markdown]
# Learn a drawing, put a ball in its way, and plot what happens. Cells are marked as notebooks read them.
# Needs matplotlib: pip install matplotlib
"""A drawing and its way around a ball, plotted: python -m dt_viz.examples.plot [FILE.png]."""

from __future__ import annotations

import sys

import numpy as np

import dt_viz as dt


def main(file: str | None = None) -> None:
    """Plot the demonstrations, the paths around a ball and the velocity field, on the screen or into a file."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - an extra
    from matplotlib.patches import Circle  # noqa: PLC0415

    # %% Learn
    demonstrations = dt.example("draw_s")
    motion = dt.fit(demonstrations, state="plain")  # one velocity field, which is plotted

    # %% A ball in the middle of the first path
    path = motion.rollouts()[0].positions
    x, y = path[len(path) // 2]
    ball = dt.Sphere((float(x), float(y) + 0.02, 0.0), diameter=0.10)
    around = motion.stack(dt.Avoidance(ball))

    # %% Plot
    figure, axes = plt.subplots(figsize=(6, 6))
    for demonstration in demonstrations:
        axes.plot(*demonstration.positions.T, color="0.7", linewidth=1)
    for one in around.rollouts():
        axes.plot(*one.positions.T, color="tab:orange")
    axes.add_patch(Circle((x, ball.position[1]), ball.diameter / 2, color="tab:pink", alpha=0.5))
    lower, upper = path.min(axis=0) - 0.05, path.max(axis=0) + 0.05
    grid = np.stack(np.meshgrid(*np.linspace(lower, upper, 20).T), axis=-1)
    velocity = around.velocity(grid)
    velocity /= np.maximum(np.linalg.norm(velocity, axis=-1, keepdims=True), 1e-9)
    axes.quiver(*np.moveaxis(grid, -1, 0), *np.moveaxis(velocity, -1, 0), color="0.5", alpha=0.6)
    axes.set(aspect="equal", xlabel="x [m]", ylabel="y [m]", title=str(around.certificates().warnings or "stable"))
    if file is None:
        plt.show()
    else:
        figure.savefig(file, dpi=150)


if __name__ == "__main__":
    main(*sys.argv[1:2])
