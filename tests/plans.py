"""What tests of planners share."""


def joints_of(plan):
    """The postures of a plan, which has some."""
    assert plan.joints is not None
    return plan.joints
