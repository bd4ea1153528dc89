"""A step of tracking by plain array operations: what the compiled one must equal."""

import numpy as np
from scipy.spatial.transform import Rotation


def newton(robot, q, targets, postures, gain, turns=None):
    """One step of postures q (N, 6) towards targets (N, 3), each with its posture, in the notation of the kernel.

    With `turns` (N,), rotations that are wanted of the last joint, these take the place of the direction.
    """
    chain, chosen = robot.chain(q.T), robot.tracking
    J, D = (jacobian.transpose(2, 1, 0) for jacobian in (chain.position_jacobian(), chain.direction_jacobian()))
    error = targets - chain.position.T
    excess = q - np.clip(q, postures.soft_lower, postures.soft_upper)
    slope = q - postures.reference + chosen.limit_weight * excess
    turn = postures.direction - chain.direction.T
    if turns is not None:
        D = chain.axes[:, 2].transpose(2, 1, 0)
        turn = (turns * Rotation.from_matrix(chain.axes[-1].transpose(2, 1, 0)).inv()).as_rotvec()
    H = np.einsum("n,nri,nrj->nij", postures.direction_weight, D, D)
    H += np.eye(6) * (1 + chosen.limit_weight * (excess != 0))[:, None]
    slope -= postures.direction_weight[:, None] * np.einsum("nri,nr->ni", D, turn)
    p = -np.linalg.solve(H, slope[..., None])[..., 0]
    H_inv_J = np.linalg.solve(H, J.transpose(0, 2, 1))
    S = J @ H_inv_J
    damping = chosen.damping_floor + chosen.damping_per_error * np.linalg.norm(error, axis=1)
    towards = np.linalg.solve(S + damping[:, None, None] * np.eye(3), error[..., None])[..., 0]
    multipliers = np.linalg.solve(S + chosen.damping_floor * np.eye(3), J @ p[..., None])[..., 0]
    caution = (gain / (1 + chosen.curvature * np.linalg.norm(multipliers, axis=1)))[:, None]
    step = caution * p + (H_inv_J @ (towards - caution * multipliers)[..., None])[..., 0]
    step *= np.minimum(1, chosen.step_limit / np.maximum(np.abs(step).max(axis=1, keepdims=True), 1e-12))
    return np.clip(q + step, robot.lower, robot.upper)
