"""Make the demonstrations that ship with DT-Viz: ``python -m assets.make_demonstrations`` rewrites the npz files.

Nobody recorded them. They imitate how a person moves: each starts a little elsewhere, bows a little differently,
slows down in bends as the two-thirds power law says (speed ∝ curvature^(-1/3)), starts and stops softly, trembles
by a fraction of a millimetre, and has its own duration and number of samples. All of a task end in one point.
The random numbers are seeded, so the files are the same every time.
"""

from pathlib import Path

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import gaussian_filter1d

from dt_viz.learning.demonstrations import Demonstration, save_demonstrations

FOLDER = Path(__file__).parent
DENSE = 2001  # points of a path before it is sampled in time
LIFT_GOAL = np.array([0.0, -0.52, 0.45])  # metres, world frame
LIFT_CORNER = np.array([0.0, -0.55, 0.10])
LIFT_START = np.array([0.38, -0.30, 0.38])
PUSH_START = np.array([0.34, -0.33, 0.38])
PUSH_CONTACT = np.array([0.30, -0.47, 0.15])  # behind the box, where the hand is down
PUSH_GOAL = np.array([-0.34, -0.42, 0.15])
DROP_START = np.array([0.0, -0.28, 0.42])
DROP_GOAL = np.array([0.0, -0.52, 0.26])  # above the centre pot, `dt_viz.scenario.tasks.POTS`


def draw_s(num_demonstrations: int = 7, seed: int = 41) -> tuple[Demonstration, ...]:
    """Draw the letter S on a plane, from its upper right end to its lower left end.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.30 wide and 0.40 high),
        u to the right and v up.
    """
    return _draw(_letter_s(), "draw S", num_demonstrations, seed)


def lift_box(num_demonstrations: int = 8, seed: int = 48) -> tuple[Demonstration, ...]:
    """Reach forward and down into a box, then turn sharply and lift straight up.

    Returns:
        Demonstrations in metres, 3-D, in the world frame: origin at the arm's base on the table, front −y, z up.
    """
    rng = np.random.default_rng(seed)
    demonstrations = []
    for i in range(num_demonstrations):
        path = _lift_path(LIFT_CORNER + rng.normal(0.0, [0.007, 0.005, 0.005]))
        path = _vary(path, LIFT_GOAL, rng, start_spread=0.025, bow=0.008)
        demonstrations.append(_perform(path, LIFT_GOAL, rng, f"lift box {i}"))
    return tuple(demonstrations)


def push_box(num_demonstrations: int = 7, seed: int = 54) -> tuple[Demonstration, ...]:
    """Approach a box from one side, come down behind it, and push it along the table in a gently curved line.

    Returns:
        Demonstrations in metres, 3-D, in the world frame: origin at the arm's base on the table, front −y, z up.
    """
    rng = np.random.default_rng(seed)
    demonstrations = []
    for i in range(num_demonstrations):
        path = _push_path(PUSH_CONTACT + rng.normal(0.0, [0.006, 0.005, 0.003]))
        path = _vary(path, PUSH_GOAL, rng, start_spread=0.020, bow=0.005)
        demonstrations.append(_perform(path, PUSH_GOAL, rng, f"push box {i}"))
    return tuple(demonstrations)


def draw_j(num_demonstrations: int = 7, seed: int = 103) -> tuple[Demonstration, ...]:
    """Draw the letter J on a plane: down its stem, then through its bow to the upper left.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.24 wide and 0.40 high),
        u to the right and v up.
    """
    return _draw(_letter_j(), "draw J", num_demonstrations, seed)


def draw_c(num_demonstrations: int = 7, seed: int = 52) -> tuple[Demonstration, ...]:
    """Draw the letter C on a plane, from its upper right end round to its lower right one.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.28 wide and 0.40 high),
        u to the right and v up.
    """
    return _draw(_letter_c(), "draw C", num_demonstrations, seed)


def draw_g(num_demonstrations: int = 7, seed: int = 18) -> tuple[Demonstration, ...]:
    """Draw the letter G on a plane in one stroke: a C that goes on up to the middle and in along its bar.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.32 wide and 0.40 high),
        u to the right and v up.
    """
    return _draw(_letter_g(), "draw G", num_demonstrations, seed)


def draw_w(num_demonstrations: int = 7, seed: int = 22) -> tuple[Demonstration, ...]:
    """Draw the letter W on a plane, from its upper left end to its upper right one.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.41 wide and 0.30 high),
        u to the right and v up.
    """
    return _draw(_letter_w(), "draw W", num_demonstrations, seed)


def draw_z(num_demonstrations: int = 7, seed: int = 71) -> tuple[Demonstration, ...]:
    """Draw the letter Z on a plane: to the right, down to the lower left, and to the right again.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the letter (about 0.29 wide and 0.39 high),
        u to the right and v up.
    """
    return _draw(_letter_z(), "draw Z", num_demonstrations, seed)


def draw_8(num_demonstrations: int = 7, seed: int = 84) -> tuple[Demonstration, ...]:
    """Draw the figure 8 on a plane, from its top down across itself, round, and up again to the left of where it began.

    Returns:
        Demonstrations in metres, 2-D, origin in the middle of the figure (about 0.26 wide and 0.40 high),
        u to the right and v up.
    """
    return _draw(_figure_8(), "draw 8", num_demonstrations, seed)


def draw_s_wavy(num_demonstrations: int = 7, seed: int = 73) -> tuple[Demonstration, ...]:
    """Draw the letter S by another hand, in waves.

    Returns:
        As `draw_s`.
    """
    return _draw(_wavy(_letter_s()), "draw wavy S", num_demonstrations, seed)


def drop_pots(num_demonstrations: int = 8, seed: int = 98) -> tuple[Demonstration, ...]:
    """Carry an object forward over the centre one of three pots in a row, and stop above it.

    Returns:
        Demonstrations in metres, 3-D, in the world frame: origin at the arm's base on the table, front −y, z up.
    """
    rng = np.random.default_rng(seed)
    demonstrations = []
    for i in range(num_demonstrations):
        path = _vary(_drop_path(), DROP_GOAL, rng, start_spread=0.020, bow=0.005)
        demonstrations.append(_perform(path, DROP_GOAL, rng, f"drop pots {i}"))
    return tuple(demonstrations)


def _draw(letter: np.ndarray, name: str, num_demonstrations: int, seed: int) -> tuple[Demonstration, ...]:
    """Draw a letter several times, each a little differently, all to its last point."""
    rng = np.random.default_rng(seed)
    goal = letter[-1].round(6)
    return tuple(
        _perform(_vary(letter, goal, rng, start_spread=0.013, bow=0.006), goal, rng, f"{name} {i}")
        for i in range(num_demonstrations)
    )


def _letter_s() -> np.ndarray:
    """Return the path of a slender S: one bend to the left, then the same bend to the right.

    The tangent angle is the integral of a curvature that rises and falls over each half; the result is scaled to
    the letter's height and width and centred, shape ``(DENSE, 2)``.
    """
    s = np.linspace(-1.0, 1.0, DENSE)
    curvature = -np.sign(s) * np.abs(np.sin(np.pi * s)) ** 0.8
    turned = cumulative_trapezoid(curvature, s, initial=0.0)
    heading = np.deg2rad(129.0) + np.deg2rad(205.0) * turned / turned.max()
    path = cumulative_trapezoid(np.stack([np.cos(heading), np.sin(heading)], axis=1), s, axis=0, initial=0.0)
    path = path - (path[0] + path[-1]) / 2
    return path * np.array([0.30, 0.40]) / np.ptp(path, axis=0)


def _letter_j() -> np.ndarray:
    """Return the path of a J: its tangent angle falls, soft at both ends, from straight down to up and left.

    Scaled to the letter's height and width and centred, shape ``(DENSE, 2)``.
    """
    s = np.linspace(0.0, 1.0, DENSE)
    heading = np.deg2rad(-88.0 - 160.0 * _smooth_step((s - 0.38) / 0.58))
    path = cumulative_trapezoid(np.stack([np.cos(heading), np.sin(heading)], axis=1), s, axis=0, initial=0.0)
    path = path * np.array([0.24, 0.40]) / np.ptp(path, axis=0)
    return path - (path.min(axis=0) + path.max(axis=0)) / 2


def _letter_c() -> np.ndarray:
    """Return the path of a C: an ellipse, open to the right, shape ``(DENSE, 2)``."""
    return _arc(47.0, 313.0)


def _letter_g() -> np.ndarray:
    """Return the path of a G: an ellipse that is open to the upper right, and a bar, shape ``(DENSE, 2)``."""
    bowl = _arc(47.0, 352.0)
    corner = np.array([0.158, -0.005])
    return _rounded(np.concatenate([bowl, [corner, corner - [0.115, 0.0]]]), 0.012)


def _letter_w() -> np.ndarray:
    """Return the path of a W with narrow bends, shape ``(DENSE, 2)``."""
    corners = np.array([[-0.205, 0.16], [-0.115, -0.17], [0.0, 0.12], [0.115, -0.17], [0.205, 0.16]])
    return _rounded(corners, 0.020)


def _letter_z() -> np.ndarray:
    """Return the path of a Z with narrow bends and bars that bow a little, shape ``(DENSE, 2)``."""
    u = np.linspace(-1.0, 1.0, 101)[:, None]
    bar = u * [0.15, 0.0] + (1 - u**2) * [0.0, 0.012]
    up = np.array([0.0, 0.18])
    return _rounded(np.concatenate([bar + up, bar * [1.0, -1.0] - up]), 0.016)


def _figure_8() -> np.ndarray:
    """Return the path of an 8: a Lissajous figure that is open at its top, shape ``(DENSE, 2)``."""
    turn = np.linspace(0.10, 2 * np.pi - 0.40, DENSE)
    return np.stack([0.13 * np.sin(2 * turn), 0.20 * np.cos(turn)], axis=1)


def _wavy(path: np.ndarray) -> np.ndarray:
    """Return a path (DENSE, 2) that is drawn in waves, as a curtate cycloid is; its ends stay."""
    s = np.linspace(0.0, 1.0, DENSE)
    turn = 2 * np.pi * 6 * s
    size = 0.020 * _smooth_step(s / 0.15) * _smooth_step((1 - s) / 0.15)
    return path + size[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


def _arc(start: float, end: float) -> np.ndarray:
    """Return an upright ellipse, 0.32 by 0.40 metres, between two angles in degrees, shape ``(DENSE, 2)``."""
    turn = np.deg2rad(np.linspace(start, end, DENSE))
    return np.stack([0.16 * np.cos(turn), 0.20 * np.sin(turn)], axis=1)


def _rounded(corners: np.ndarray, radius: float) -> np.ndarray:
    """Return a polyline whose corners are smoothed over about ``radius`` metres, shape ``(DENSE, d)``."""
    path = _equidistant(corners)
    spacing = np.linalg.norm(path[1] - path[0])
    return gaussian_filter1d(path, radius / spacing, axis=0, mode="nearest")


def _lift_path(corner: np.ndarray) -> np.ndarray:
    """Return the way into the box, a narrow bend at ``corner``, and the way up, shape ``(DENSE, 3)``."""
    u = np.linspace(0.0, 1.0, DENSE)[:, None]
    over = LIFT_START + np.array([-0.14, -0.06, 0.06])  # this and the next are Bézier control points
    into = corner + np.array([0.15, 0.10, 0.03])
    reach = (1 - u) ** 3 * LIFT_START + 3 * (1 - u) ** 2 * u * over + 3 * (1 - u) * u**2 * into + u**3 * corner
    lift = corner + u * (LIFT_GOAL - corner) + np.sin(np.pi * u) * [0.008, -0.006, 0.0]
    return _rounded(np.concatenate([reach, lift[1:]]), 0.010)


def _push_path(contact: np.ndarray) -> np.ndarray:
    """Return the way over and down to ``contact``, and the push from there in a wide arc, shape ``(DENSE, 3)``."""
    u = np.linspace(0.0, 1.0, DENSE)[:, None]
    over = PUSH_START + np.array([0.03, -0.04, -0.03])  # this and the next are Bézier control points
    down = contact + np.array([0.08, 0.02, 0.08])
    approach = (1 - u) ** 3 * PUSH_START + 3 * (1 - u) ** 2 * u * over + 3 * (1 - u) * u**2 * down + u**3 * contact
    push = contact + u * (PUSH_GOAL - contact) + np.sin(np.pi * u) * [0.0, -0.11, 0.0]
    return _rounded(np.concatenate([approach, push[1:]]), 0.035)


def _drop_path() -> np.ndarray:
    """Return the way up and forward, then down towards the pot, shape ``(DENSE, 3)``."""
    u = np.linspace(0.0, 1.0, DENSE)[:, None]
    over = DROP_START + np.array([0.0, -0.08, 0.02])  # this and the next are Bézier control points
    above = DROP_GOAL + np.array([0.0, 0.0, 0.12])
    path = (1 - u) ** 3 * DROP_START + 3 * (1 - u) ** 2 * u * over + 3 * (1 - u) * u**2 * above + u**3 * DROP_GOAL
    return _equidistant(path)


def _vary(path: np.ndarray, goal: np.ndarray, rng: np.random.Generator, start_spread: float, bow: float) -> np.ndarray:
    """Carry a path to ``goal`` and bend it smoothly, the most at its start and not at all at its end.

    Args:
        path: shape ``(DENSE, d)``, metres.
        goal: shape ``(d,)``, metres, where it shall end.
        rng: source of the variation.
        start_spread: standard deviation of the start in each coordinate, metres.
        bow: standard deviation of the first sideways bow, metres; the higher ones are smaller.
    """
    s = np.linspace(0.0, 1.0, len(path))[:, None]
    offset = rng.normal(0.0, start_spread, path.shape[1]).clip(-2 * start_spread, 2 * start_spread) * (1 - s) ** 2
    for k in (1, 2, 3):
        offset = offset + rng.normal(0.0, bow / k, path.shape[1]) * np.sin(k * np.pi * s)
    return _equidistant(path + offset + (goal - path[-1]))


def _perform(path: np.ndarray, goal: np.ndarray, rng: np.random.Generator, name: str) -> Demonstration:
    """Move along a path with a person's timing and tremor, and sample it."""
    duration = rng.uniform(4.0, 7.0)
    num_samples = int(rng.integers(110, 240))
    u = np.linspace(0.0, 1.0, len(path))
    # How long each piece of the path takes relative to its length: more in bends, and a slow random change.
    pace = (_curvature(path) + 5.0) ** (1 / 3) * np.exp(_smooth_noise(rng, len(path), len(path) / 12) * 0.08)
    clock = cumulative_trapezoid(pace, u, initial=0.0)
    # Within the motion's time, speed rises over the first and falls over the last part.
    rise, fall = rng.uniform(0.15, 0.22), rng.uniform(0.20, 0.30)
    speed = _smooth_step(u / rise) * _smooth_step((1 - u) / fall)
    progress = cumulative_trapezoid(speed, u, initial=0.0)
    where = np.interp(np.linspace(0.0, 1.0, num_samples), u, np.interp(progress / progress[-1], clock / clock[-1], u))
    positions = np.stack([np.interp(where, u, coordinate) for coordinate in path.T], axis=1)
    correlation = 0.08 * num_samples / duration  # samples in 0.08 s: tremor of a few hertz
    tremor = np.stack([_smooth_noise(rng, num_samples, correlation) for _ in goal], axis=1)
    positions += 0.0005 * tremor * (1 - np.linspace(0.0, 1.0, num_samples)[:, None] ** 4)
    positions[-1] = goal
    return Demonstration(np.linspace(0.0, duration, num_samples).round(6), positions.round(6), name)


def _equidistant(path: np.ndarray) -> np.ndarray:
    """Return ``DENSE`` points equally spaced along a polyline."""
    length = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    even = np.linspace(0.0, length[-1], DENSE)
    return np.stack([np.interp(even, length, coordinate) for coordinate in path.T], axis=1)


def _curvature(path: np.ndarray) -> np.ndarray:
    """Return the curvature of an equidistant path, 1/m, shape ``(N,)``, smoothed over about a centimetre."""
    spacing = np.linalg.norm(path[1] - path[0])
    smooth = gaussian_filter1d(path, 0.005 / spacing, axis=0, mode="nearest")
    tangent = np.gradient(smooth, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    bend = np.linalg.norm(np.gradient(tangent, axis=0), axis=1) / spacing
    return gaussian_filter1d(bend, 0.008 / spacing, mode="nearest")


def _smooth_noise(rng: np.random.Generator, size: int, correlation: float) -> np.ndarray:
    """Return Gaussian noise of unit variance, smooth over ``correlation`` samples, shape ``(size,)``."""
    margin = int(4 * correlation) + 1
    noise = gaussian_filter1d(rng.normal(size=size + 2 * margin), correlation)[margin:-margin]
    return noise * np.sqrt(2 * np.sqrt(np.pi) * correlation)


def _smooth_step(x: np.ndarray) -> np.ndarray:
    """Rise from 0 at 0 to 1 at 1 with zero slope at both ends."""
    x = np.clip(x, 0.0, 1.0)
    return x * x * (3 - 2 * x)


if __name__ == "__main__":
    for make in (draw_s, lift_box, push_box, draw_j, drop_pots, draw_c, draw_g, draw_w, draw_z, draw_8, draw_s_wavy):
        save_demonstrations(FOLDER / f"{make.__name__}.npz", make())
