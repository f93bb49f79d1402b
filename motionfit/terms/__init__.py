"""Built-in terms: wishes about a motion, as residuals over Kinematics."""

from motionfit.terms.balance import Standing, ZmpMargin
from motionfit.terms.penetration import CapsuleClearance, JointClearance, SkinClearance, SkinContact
from motionfit.terms.pose import Direction, Effort, JointTracking, RotationTracking, Smoothness, Steadiness

__all__ = [
    "CapsuleClearance",
    "Direction",
    "Effort",
    "JointClearance",
    "JointTracking",
    "RotationTracking",
    "SkinClearance",
    "SkinContact",
    "Smoothness",
    "Standing",
    "Steadiness",
    "ZmpMargin",
]
