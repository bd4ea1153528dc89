"""How the whole arm avoids: lengths are those of an arm as large as the JACO, and scale with its reach."""

from __future__ import annotations

from dataclasses import dataclass

from dt_viz.robot.robot import Robot
from dt_viz.robot.sizing import scales, sized


@dataclass(frozen=True)
class WholeArmSettings:
    """Settings of `dt_viz.avoidance.arm`, of its field, and of the reference postures."""

    reach_per_temperature: float = scales(0.08 / 6)
    """Reach of an obstacle's field, metres, for each unit of the temperature T."""
    beyond: float = scales(0.03)
    """Reach of the field of a robot in the loop beyond the margin, metres, at least."""
    core: float = 0.5
    """Depth at which the field has its full strength, as a part of the way from touching the obstacle to its middle;
    deeper inside the strength is constant, so the middle is not singular."""
    fan: float = 4.0
    """Distance of the source, from which escaping points fan out, behind the obstacle's middle, in the obstacle's
    radii."""
    behind: float = 1.25
    """Lower bound of that distance, in multiples of the field's outer radius, for no point may escape from the
    source."""
    damping: float = scales(0.06)
    """Damping λ of the contact's pseudo-inverse, m/rad: contacts that joints can hardly move are not chased."""
    hand_weight: float = scales(100.0, -2)
    """Weight of the end effector's motion, rad²/m²: a contact of the forearm is resolved with the hand at rest."""
    pin: float = scales(0.02)
    """Size of the region around a pinned posture in which the field fades out, metres by `Robot.levers`."""
    speed: float = scales(0.2)
    """Distance that a contact at full strength escapes in a unit of flow time, metres."""
    coarse_spacing: float = scales(0.025)
    """Largest distance between neighbouring samples of coarse motions, metres at the hand, about."""
    beside: float = scales(0.20)
    """Clearance up to which a sample is bent along with the colliding ones, metres."""
    together: float = scales(0.05)
    """Clearance from another obstacle up to which a colliding posture meets both, metres."""
    opposed: float = -0.5
    """Cosine of the angle between the escapes from two obstacles beyond which both are left in one direction."""
    duration_change: float = scales(50.0, -1)
    """Largest change of the flow time for each metre that an obstacle is dragged: contacts move by 1 cm a
    millimetre."""
    alike: float = scales(0.15)
    """Root mean square distance of postures, by `Robot.levers`, up to which reference postures are alike, metres."""
    in_the_way: float = 10.0
    """Cost of each metre that the mean motion lacks of the clearance that is asked for, against a metre from the usual
    postures."""
    at_ends: float = 40.0
    """Factor by which that costs more at the ends of the motion."""
    ends: float = scales(0.06)
    """Distance from them over which this fades, metres."""

    @classmethod
    def of(cls, robot: Robot) -> WholeArmSettings:
        """The settings for an arm."""
        return sized(cls(), robot.size)
