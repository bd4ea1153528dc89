"""Demonstrations of a hook, as a LASA file, for what reads files and writes measurements."""

import numpy as np
import scipy.io

from dt_viz.metrics import discrete_frechet, resample_by_arc_length

NUM_DEMONSTRATIONS = 2


def hook(i):
    """A hook some 50 mm wide that ends in the origin: seconds (T,) and millimetres (T, 2)."""
    s = np.linspace(0, 1, 80 + 7 * i)
    progress = s**2 * (3 - 2 * s)
    angle = 2.2 * (1 - progress)
    radius = 25 + 6 * i * (1 - progress)
    positions = radius[:, None] * np.stack([np.cos(angle) - 1, np.sin(angle)], axis=1)
    positions[:, 0] -= 20 * (1 - progress)
    return (3 + 0.4 * i) * s, positions


def write_mat(path):
    cells = np.empty((1, NUM_DEMONSTRATIONS), dtype=object)
    for i in range(NUM_DEMONSTRATIONS):
        times, positions = hook(i)
        cells[0, i] = {"t": times[None], "pos": positions.T, "dt": times[1]}
    scipy.io.savemat(path, {"demos": cells, "dt": 0.04})
    return path


def apart(path, other):
    """Fréchet distance of two paths."""
    return float(discrete_frechet(resample_by_arc_length(path, 400), resample_by_arc_length(other, 400)))
