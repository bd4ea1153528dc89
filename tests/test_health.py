"""Certificates must recognise what they certify against: folds, bad inverses, a potential that does not fall."""

import numpy as np
import pytest

from dt_viz.diffeo import Diffeomorphism, Flow, Identity
from dt_viz.fields import Array, GaussianGrid, GridRBF
from dt_viz.health import Health, certified
from dt_viz.integrate import euler, implicit_euler
from dt_viz.rollouts import Bundle, Rays, evenly_sampled
from dt_viz.systems import Attractor, DiffeomorphicSystem

BASE = Attractor(np.array([0.5, 0.2, 0.0]), 0.2, 0.05)
RAYS = Rays(np.array([[-0.8, -0.3, 0.1], [-0.6, 0.7, -0.2]]), BASE)
CLEAR = Health(clearance=0.05, duration=0.3, doubts=("said before",))


def field(strength):
    grid = GaussianGrid(tuple(np.linspace(-1, 1, 4) for _ in range(3)), 0.5 / 0.4**2)
    return GridRBF(grid, strength * np.random.default_rng(0).normal(size=(grid.num_points, 3)))


def bundle_of(transform):
    return evenly_sampled(lambda i, u: transform.inverse(RAYS.at(i, u))[:, None], 2, 300)


def certify(transform, bundle=None):
    return certified(CLEAR, DiffeomorphicSystem(transform, BASE), bundle or bundle_of(transform))


@pytest.mark.parametrize(
    "transform", [Identity(3), Flow(field(0.3), 0.5, 20), Flow(field(0.3), 0.5, 6, implicit_euler, euler)]
)
def test_a_healthy_stack_gets_its_certificates_and_no_doubt(transform):
    health = certify(transform)
    assert health.min_det_jacobian is not None and health.min_det_jacobian > 0
    assert health.round_trip_error is not None and health.round_trip_error < 1e-6
    assert health.lyapunov_falls is True
    assert (health.clearance, health.duration, health.doubts) == (0.05, 0.3, ("said before",))


def test_the_smallest_determinant_is_that_of_the_forward_map():
    transform = Flow(field(0.5), 0.8, 6, implicit_euler, euler)
    bundle = bundle_of(transform)
    expected = np.linalg.det(transform.jacobian(bundle.positions)[1]).min()
    assert certify(transform, bundle).min_det_jacobian == pytest.approx(expected, rel=1e-8)


def test_a_folding_euler_map_is_recognised():
    folding = Flow(field(6.0), 1.0, 1, euler)
    bundle = bundle_of(Identity(3))  # straight through where it folds
    health = certify(folding, bundle)
    assert health.min_det_jacobian is not None and health.min_det_jacobian < 0
    assert any("no diffeomorphism" in doubt for doubt in health.doubts)


def test_a_bad_round_trip_is_recognised_and_measured():
    coarse = Flow(field(0.4), 1.0, 10, euler)  # Euler back is not the inverse of Euler there
    bundle = bundle_of(coarse)
    health = certify(coarse, bundle)
    error = np.linalg.norm(coarse.inverse(coarse.forward(bundle.positions)) - bundle.positions, axis=1).max()
    assert health.round_trip_error is not None
    assert health.round_trip_error == pytest.approx(error, rel=0.05)
    assert any(f"misses by {1e3 * health.round_trip_error:.3g} mm" in doubt for doubt in health.doubts)
    assert health.doubts[0] == "said before"


def test_a_motion_that_turns_back_is_recognised_and_said_once():
    there = np.linspace(0, 1, 100)
    fraction = np.concatenate([there[:60], there[40:]])
    index = np.zeros(len(fraction), dtype=int)
    bundle = Bundle(index, fraction, RAYS.at(index, fraction)[:, None])
    health = certify(Identity(3), bundle)
    assert health.lyapunov_falls is False
    assert health.doubts == (*CLEAR.doubts, "the Lyapunov value does not fall all the way")
    assert certified(health, DiffeomorphicSystem(Identity(3), BASE), bundle).doubts == health.doubts


@pytest.mark.parametrize(("distance", "arrived"), [(1e-7, True), (1e-5, False)])
def test_only_within_rounding_of_the_goal_a_motion_need_not_fall(distance, arrived):
    away = distance * np.outer([0.9, 1.0], [1.0, 0.0, 0.0])
    bundle = Bundle(np.zeros(2, dtype=int), np.array([0.0, 1.0]), (BASE.goal + away)[:, None])
    assert certify(Identity(3), bundle).lyapunov_falls is arrived


def test_a_motion_that_stands_still_does_not_fall_strictly():
    fraction = np.array([0.0, 0.3, 0.3, 1.0])
    index = np.zeros(4, dtype=int)
    assert certify(Identity(3), Bundle(index, fraction, RAYS.at(index, fraction)[:, None])).lyapunov_falls is False


def test_the_rise_from_the_end_of_one_rollout_to_the_start_of_the_next_is_none():
    assert certify(Identity(3)).lyapunov_falls is True
    assert len(bundle_of(Identity(3)).paths) == 2


class Broken(Diffeomorphism):
    """Gives no numbers."""

    @property
    def dim(self) -> int:
        return 3

    def scaled(self, fraction: float) -> Diffeomorphism:
        return self

    def _map(self, s: Array, U: Array | None, *, inverse: bool) -> tuple[Array, Array | None]:
        return (s if inverse else np.full_like(s, np.nan)), None if U is None else np.full_like(U, np.nan)


def test_no_number_is_no_certificate():
    index, fraction = np.zeros(5, dtype=int), np.linspace(0, 1, 5)
    with np.errstate(invalid="ignore"):
        health = certify(Broken(), Bundle(index, fraction, RAYS.at(index, fraction)[:, None]))
    assert health.lyapunov_falls is False
    assert len(health.doubts) == 1 + 3
