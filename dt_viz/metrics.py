"""Measures of paths: how far two are apart, how deep one collides, how sharply it turns.

A path is a polyline, an array ``(T, d)`` of points in any unit of length; distances come back in the same unit.
"""

from collections.abc import Callable

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from dt_viz.numerics import divisor


def arc_length(points: np.ndarray) -> np.ndarray:
    """Return the lengths (*B, T) of polylines (*B, T, d) from their first point up to each point."""
    steps = np.linalg.norm(np.diff(points, axis=-2), axis=-1)
    return np.concatenate([np.zeros_like(steps[..., :1]), np.cumsum(steps, axis=-1)], axis=-1)


def resample_by_arc_length(points: np.ndarray, n: int) -> np.ndarray:
    """Return `n` ≥ 2 points (n, d) at equal distances along a polyline (T, d), the first and the last being its own.

    Successive points may coincide.
    """
    length = arc_length(points)
    keep = np.concatenate([[True], np.diff(length) > 0])
    resampled = interpolate(np.linspace(0.0, length[-1], n), length[keep], points[keep])
    resampled[-1] = points[-1]
    return resampled


def interpolate(at: np.ndarray, parameter: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Interpolate points (T, d) at an increasing parameter (T,), such as time, linearly `at` others (N,), as (N, d).

    The first and last point hold beyond the ends.
    """
    return np.stack([np.interp(at, parameter, coordinate) for coordinate in points.T], axis=1)


def discrete_frechet(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the discrete Fréchet distances (*B,) between the points of paths (*B, n, d) and (*B, m, d), exactly.

    The least, over all ways of stepping forward along both from their first to their last points, of the largest
    distance met: F(i, j) = max(‖a_i − b_j‖, min(F(i−1, j), F(i, j−1), F(i−1, j−1))) (Eiter and Mannila, 1994). A cell
    of the anti-diagonal i + j = k depends only on the two anti-diagonals before it, so each of them is computed at
    once, and for all pairs of a batch together. Leading axes are broadcast; that of a single pair is a 0-d value.
    """
    if a.shape[-2] > b.shape[-2]:
        a, b = b, a  # the sweep is as wide as the first is long
    n, m = a.shape[-2], b.shape[-2]
    batch = np.broadcast_shapes(a.shape[:-2], b.shape[:-2])
    a, b = np.broadcast_to(a, (*batch, *a.shape[-2:])), np.broadcast_to(b, (*batch, *b.shape[-2:]))
    # Slid along b, the reversed a meets on its k-th place the pairs with i + j = k; beyond the ends of b is infinity.
    reversed_a = np.moveaxis(a[..., ::-1, :], -1, 0).copy()  # (d, *B, n): column c is i = n − 1 − c
    margins = [(0, 0)] * (b.ndim - 1) + [(n - 1, n - 1)]
    padded_b = np.pad(np.moveaxis(b, -1, 0), margins, constant_values=np.inf)
    places = np.moveaxis(sliding_window_view(padded_b, n, axis=-1), -2, 1)  # (d, n + m − 1, *B, n)

    num = 32  # diagonals computed together: few enough to stay in the processor's cache
    last, before = np.full((2, *batch, n + 1), np.inf)  # F² on the last two anti-diagonals; column n is i = −1
    before[..., n] = 0.0  # from where F(0, 0) is reached; infinity ever after
    for k in range(0, n + m - 1, num):
        low, high = max(0, n - k - num), n - max(0, k - m + 1)  # the columns that lie in the table
        squared = np.zeros(())
        for place, point in zip(places[:, k : k + num, ..., low:high], reversed_a[..., low:high], strict=True):
            squared = squared + np.square(place - point)
        for distances in squared:
            reached = np.minimum(last[..., low:high], last[..., low + 1 : high + 1])
            np.minimum(reached, before[..., low + 1 : high + 1], out=reached)
            np.maximum(reached, distances, out=before[..., low:high])
            before[..., n] = np.inf
            last, before = before, last
    return np.sqrt(last[..., 0])


def _skewed(table: np.ndarray, fill: float) -> np.ndarray:
    """Return a table (n, m) by its anti-diagonals, (n + m − 1, n): row k, column i is the entry (i, k − i)."""
    n, m = table.shape
    padded = np.full((n, n + m), fill)
    padded[:, :m] = table
    return np.ascontiguousarray(padded.ravel()[: n * (n + m - 1)].reshape(n, n + m - 1).T)


def dynamic_time_warping(a: np.ndarray, b: np.ndarray) -> float:
    """Return the least sum of distances between matched points of two paths, (n, d) and (m, d).

    Matched are pairs on a way that steps forward along one path, the other, or both, from their first to their last
    points: D(i, j) = ‖a_i − b_j‖ + min(D(i−1, j), D(i, j−1), D(i−1, j−1)) (Sakoe and Chiba, 1978). The sum grows with
    the number of points.
    """
    distances = _skewed(np.linalg.norm(a[:, None] - b[None], axis=-1), np.inf)
    before, last = np.full((2, len(a) + 1), np.inf)  # of the last two anti-diagonals; place i + 1 is row i
    before[0] = 0.0
    for distance in distances:
        least = np.minimum(np.minimum(last[1:], last[:-1]), before[:-1])
        before, last = last, np.concatenate([[np.inf], distance + least])
    return float(last[-1])


def rms_jerk(times: np.ndarray, points: np.ndarray, interval: float) -> float:
    """Return the root mean square of the third derivative of a motion (T, d) at times (T,) that do not decrease.

    It is that of differences between positions that an `interval` of time lies between, as length per cubed time; 0 for
    a motion of less than three intervals.
    """
    at = np.arange(times[0], times[-1] + interval / 2, interval)
    jerk = np.diff(interpolate(at, times, points), 3, axis=0) / interval**3
    return float(np.sqrt(np.square(jerk).sum(axis=1).mean())) if len(jerk) else 0.0


def rms_at_equal_times(
    times: np.ndarray, points: np.ndarray, reference_times: np.ndarray, reference_points: np.ndarray
) -> float:
    """Return the root mean square distance of a motion (T, d) from a reference (R, d), at the times (R,) of this.

    The motion rests at its first point before its increasing times (T,), and at its last point after.
    """
    error = interpolate(reference_times, times, points) - reference_points
    return float(np.sqrt((error**2).sum(axis=1).mean()))


def distance_from_path(points: np.ndarray, path: np.ndarray) -> np.ndarray:
    """Return how far points (N, d) are from a polyline (T, d), T ≥ 2, also between its points, (N,).

    Successive points may coincide.
    """
    step = np.diff(path, axis=0)
    from_start = points[:, None] - path[:-1]
    share = ((from_start * step).sum(axis=2) / divisor((step**2).sum(axis=1))).clip(0, 1)
    return np.linalg.norm(from_start - share[..., None] * step, axis=2).min(axis=1)


def maximum_collision_distance(
    points: np.ndarray, signed_distance: Callable[[np.ndarray], np.ndarray], tolerance: float = 1e-5
) -> float:
    """Return how deep a polyline (T, d) enters an obstacle (M.C.D., sec. 5), also between its points; 0 if it is clear.

    A signed distance changes no faster than the point moves, so on a segment of length L whose ends have distances d₀
    and d₁ it is at least (d₀ + d₁ − L)/2. Segments that could still hold a deeper point are halved until none can.

    Args:
        points: of the polyline.
        signed_distance: of points (N, d), (N,), negative inside; its slope must nowhere exceed 1.
        tolerance: how far the result may stay below the true depth, in the unit of the points.
    """
    distance = signed_distance(points)
    deepest = min(0.0, float(distance.min()))
    start, end, at_start, at_end = points[:-1], points[1:], distance[:-1], distance[1:]
    while len(start):
        bound = (at_start + at_end - np.linalg.norm(end - start, axis=1)) / 2
        open_ = bound < deepest - tolerance
        start, end, at_start, at_end = start[open_], end[open_], at_start[open_], at_end[open_]
        if len(start):
            middle = (start + end) / 2
            at_middle = signed_distance(middle)
            deepest = min(deepest, float(at_middle.min()))
            start, end = np.concatenate([start, middle]), np.concatenate([middle, end])
            at_start, at_end = np.concatenate([at_start, at_middle]), np.concatenate([at_middle, at_end])
    return -deepest


def sharpest_turn(path: np.ndarray, window: float) -> float:
    """Return the largest angle, degrees, between tangents on a common piece of a path (T, d) of length `window` > 0.

    Exact for the polyline: two of its segments count when the path between them is shorter than the window. Points may
    coincide, and more of them on its segments change nothing. A smooth curve wants samples much closer than the window.
    0 is straight, or fewer than two segments; 180 turns back on itself.
    """
    steps = np.diff(path, axis=0)
    length = np.linalg.norm(steps, axis=1)
    tangent = steps[length > 0] / length[length > 0, None]
    end = np.cumsum(length[length > 0])
    sharpest = 0.0
    for k in range(1, len(tangent)):
        # Between segment i and segment i + k lie k − 1 whole segments.
        near = end[k - 1 : -1] - end[:-k] < window
        if not near.any():
            break
        before, after = tangent[:-k][near], tangent[k:][near]
        opening, closing = np.linalg.norm(after - before, axis=1), np.linalg.norm(after + before, axis=1)
        sharpest = max(sharpest, float(2 * np.arctan2(opening, closing).max()))  # accurate near 0 and near 180
    return float(np.rad2deg(sharpest))
