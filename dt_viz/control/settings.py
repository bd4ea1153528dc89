"""What may be chosen about a robot in the loop."""

from __future__ import annotations

from dataclasses import dataclass

from dt_viz.robot.robot import scales


@dataclass(frozen=True)
class ControllerSettings:
    """Settings of `dt_viz.control.controller.ArmController`.

    `scales` marks what is given for an arm as large as the JACO, and scales with an arm's reach.
    """

    acceleration: float = 4.0
    """Limit of the joints' acceleration, rad/s². The arm's URDF names none; joints then reach their limits of velocity,
    0.63 and 0.84 rad/s, within about 0.2 s."""
    course_speed: float = 0.85
    """Part of the velocity limits that the undisturbed motion uses: the rest closes gaps."""
    gain: float = 8.0
    """Rate at which a gap between the robot and its target is closed, 1/s."""
    patience: float = 0.5
    """Gap, rad, at which the clock of the motion stands still and waits for the robot. The smaller, the less of the
    motion is left out after the robot had to give way, and the later it arrives."""
    look_period: float = 0.03
    """Time between two looks at moving obstacles, seconds."""
    lead: float = 0.15
    """Time by which moving obstacles are anticipated, seconds: that until the joints have followed."""
    room: float = 0.06
    """Growth of the distance that is asked for with an obstacle's speed, m per m/s."""
    window: float = 1.2
    """Time of the motion ahead that is to be clear of moving obstacles, seconds; of obstacles at rest all is."""
    turning: float = 3.0
    """Rate at which the way out of an obstacle turns, rad/s."""
    easing: float = 3.0
    """Rate at which the duration of the flow around obstacles falls, and half that at which it rises, 1/s."""
    clearance: float = 5e-3
    """Distance of the arm from an obstacle that is kept even by a motion that has no way out, metres; at most half the
    margin."""
    barrier_gain: float = 5.0
    """γ, 1/s: the distance beyond that clearance falls at most at this rate."""
    barrier_reach: float = scales(0.25)
    """Distance from which on an obstacle slows the arm down, metres."""
    contact_gain: float = 20.0
    """γ, 1/s, of the distances from the table and between links: large, since neither moves, so that a motion along
    the table is not slowed down."""
    slow: float = 0.3
    """Speed, m/s, up to which an obstacle is not dodged: joints follow the flow around it."""
    horizon: float = 0.4
    """Time ahead in which the arm dodges, seconds: in much less joints get nowhere, for more nobody knows where the
    obstacle will be."""
    num_ahead: int = 10
    """Number of times in the horizon at which distances are looked at: an obstacle of 1 m/s moves 4 cm between two."""
    returning: float = 10.0
    """Rate λ, 1/s, at which an obstacle's velocity returns to its mean: a hand bends its way within about 0.2 s."""
    averaging: float = 0.3
    """Time over which that mean is taken, seconds: about one bend."""
    unsure: float = 0.03
    """Deviation of an obstacle from where it is expected now, m per m/s of its speed: that of about one look."""
    doubt: float = 0.3
    """Growth of that deviation with the time ahead, m/s per m/s: a way with bends of some centimetres, as a hand makes,
    is left by so much where it is thought to be straight."""
    floor_depth: float = 0.02
    """Depth below the table's top that counts as much as one deviation of an obstacle, metres."""
    stale: float = 0.25
    """Time without news, seconds, after which an obstacle counts as at rest."""
    fastest: float = 1.5
    """Speed, m/s, from which on an obstacle counts as put elsewhere, not as moving."""
    staying: float = 0.03
    """Gain in distance, in deviations, from which on another way of dodging is taken."""
    homing_speed: float = 2.0
    """Speed of the way home, relative to that of the learned motion."""
    holding_speed: float = scales(0.25)
    """Speed at which the hand follows whoever holds it, m/s."""
    shove_time: float = 0.3
    """Duration of a shove, seconds, if the joints can be as fast."""
    convergence: float = 0.5
    """Time constant with which the arm converges to the postures of its motion, seconds."""
    num_samples: int = 80
    """Number of samples of a course."""
    settling_period: float = 0.1
    """Spacing of the samples in which a robot that has arrived still converges, seconds."""
    converged: float = 1e-5
    """Distance from the postures of its motion that counts as none, rad."""
    num_clear: int = 40
    """Number of postures ahead that are to be clear of obstacles at rest."""
    num_between: int = 2
    """Number of postures for each sample of a course that are then looked at again, to be `clearance` away at least."""
    num_clear_moving: int = 10
    """Number of postures within `window` that are to be clear of obstacles that move."""
    ramp: float = 0.3
    """Shortest time in which the clock comes to its pace, seconds."""
    displaced: float = 5e-3
    """Deviation of a joint from where it was sent, rad, from which on somebody else has moved the robot."""
    at_rest: float = 1e-3
    """Gap, rad, and velocity, rad/s, of joints that count as at rest."""
    aside: float = scales(5e-3)
    """Displacement, metres by `Robot.levers`, from which on a robot at rest counts as having stepped aside."""
    touching: float = 5e-3
    """Depth of a body point in an obstacle that counts as touching, metres."""
    range_tolerance: float = 0.01
    """Distance from the end of a joint's range that counts as being there, rad."""
