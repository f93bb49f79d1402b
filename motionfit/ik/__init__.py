"""Inverse kinematics: limbs of two bones in closed form, and any number of strict priorities."""

from motionfit.ik._limb import LimbTurn, PlaneAngles, move_limb, plane_angles, shortest, solve_limb, swivel_angle
from motionfit.ik._prioritized import Task, limited_step, prioritized, prioritized_step

__all__ = [
    "LimbTurn", "PlaneAngles", "Task", "limited_step", "move_limb", "plane_angles", "prioritized", "prioritized_step",
    "shortest", "solve_limb", "swivel_angle",
]  # fmt: skip
