"""What tests of learned motions share: the motion from a start, how far two curves are apart, how large they are."""

from dataclasses import replace

import numpy as np

from dt_viz.metrics import discrete_frechet, resample_by_arc_length


def path_from(imitation, start, label=None, num=400):
    """Places of the motion from a start, evenly in the phase."""
    system, state = imitation.system, imitation.states(start, label)
    z = system.base.at_fraction(system.transform.forward(state), np.linspace(1, 0, num))
    return system.transform.inverse(z)[:, : len(start)]


def frechet(a, b, num=150):
    """Discrete Fréchet distance of two curves, between as many points, evenly by arc length."""
    return float(discrete_frechet(resample_by_arc_length(a, num), resample_by_arc_length(b, num)))


def extent(demonstrations):
    """The longest side of the box around demonstrations, metres."""
    return float(np.ptp(np.concatenate([d.positions for d in demonstrations]), axis=0).max())


def from_one_start(demonstrations):
    """Demonstrations that begin where the first one does."""
    start = demonstrations[0].positions[0]
    moved = []
    for d in demonstrations:
        fading = np.linspace(1, 0, len(d.positions))[:, None]
        moved.append(replace(d, positions=d.positions + fading * (start - d.positions[0])))
    return moved
