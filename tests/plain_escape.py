"""The whole arm's escape by plain array operations: what the compiled one must equal."""

import numpy as np

from dt_viz.avoidance.arm_field import WholeArmField
from dt_viz.robot.kinematics import cross


def velocities(field: WholeArmField, q: np.ndarray) -> np.ndarray:
    """V_q (N, 6) at postures q (N, 6), real or complex, in the notation of `WholeArmField`."""
    parts = zip(field.obstacles, field.directions, strict=True)
    squared = (((q[:, None] - field.pins) * field.robot.levers) ** 2).sum(axis=2)
    freedom = np.prod(1 - np.exp(-squared / (2 * field.settings.pin**2)), axis=1)
    return freedom[:, None] * sum(_without_pins(field, q, obstacle, direction) for obstacle, direction in parts)


def _without_pins(field, q, obstacle, direction):
    chain = field.robot.chain(q.T)
    x = field.body.of_chain(chain)  # (P, 3, N)
    distance = obstacle.signed_distance(x.transpose(0, 2, 1)) - field.body.radius[:, None]
    core = -field.settings.core * (obstacle.depth + field.body.radius)[:, None]
    u = (field.reach - distance) / (field.reach - core)
    u = np.where(u.real <= 0, 0, np.where(u.real >= 1, 1, u))
    w = (u**3 * (10 - 15 * u + 6 * u**2)) ** 2
    total = w.sum(axis=0)
    weight = w / np.where(total == 0, 1, total)
    behind = field.settings.behind * (obstacle.radius + field.reach + field.body.radius.max())
    source = np.asarray(obstacle.position) - max(field.settings.fan * obstacle.radius, behind) * direction
    outward = x - source[:, None]
    outward = outward / np.sqrt((outward**2).sum(axis=1, keepdims=True))
    n = (weight[:, None] * outward).sum(axis=0).T  # n_c, (N, 3)
    levers = x[None] - chain.origins[:, None]  # (6, P, 3, N)
    is_beyond = field.body.joint >= np.arange(field.dim)[:, None]
    moves = is_beyond[:, :, None, None] * cross(chain.axes[:, None, 2], levers)
    J = (weight[:, None] * moves).sum(axis=1).transpose(2, 1, 0)  # J_c, (N, 3, 6)
    hand = chain.position_jacobian().transpose(2, 1, 0), chain.direction_jacobian().transpose(2, 1, 0)
    H = np.eye(field.dim) + field.settings.hand_weight * hand[0].transpose(0, 2, 1) @ hand[0]
    H = H + field.robot.tracking.direction_weight * hand[1].transpose(0, 2, 1) @ hand[1]
    back = np.linalg.solve(H, J.transpose(0, 2, 1))  # H⁻¹J_cᵀ
    pulled = np.linalg.solve(J @ back + field.settings.damping**2 * np.eye(3), n[..., None])
    return -field.settings.speed * np.sqrt(total)[:, None] * (back @ pulled)[..., 0]
