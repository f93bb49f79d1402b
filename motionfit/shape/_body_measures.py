"""A body in numbers, and where they put its joints.

Segment lengths are fractions of stature after Drillis & Contini (1966), as in Winter, *Biomechanics and Motor
Control of Human Movement* (2009), fig. 4.1, with joint centres a little inside the landmarks as in de Leva (1996).
Girths of the average adult lie near the ANSUR II means (Gordon et al. 2014), brought to a BMI of 24; slim and heavy
follow the NHANES 2011-2014 percentiles (Fryar et al. 2016) for a BMI near 19 and 38, the child Snyder et al. (1977)
and NHANES at 7 to 8 years.
"""

from typing import NamedTuple

import numpy as np

from motionfit._skeleton import Skeleton


class BodyShape(NamedTuple):
    """A body in numbers, all [m]: stature and circumferences. `head` is the height of the head."""

    stature: float
    neck: float
    chest: float
    waist: float
    hip: float
    thigh: float
    calf: float
    upper_arm: float
    forearm: float
    head: float


SHAPES = {
    "average": BodyShape(1.75, 0.385, 1.000, 0.880, 0.990, 0.570, 0.380, 0.315, 0.275, 0.228),
    "slim": BodyShape(1.78, 0.350, 0.890, 0.740, 0.900, 0.500, 0.345, 0.262, 0.242, 0.226),
    "heavy": BodyShape(1.75, 0.450, 1.240, 1.270, 1.260, 0.730, 0.450, 0.425, 0.330, 0.236),
    "child": BodyShape(1.25, 0.275, 0.620, 0.570, 0.660, 0.380, 0.262, 0.195, 0.185, 0.208),
}
BUILTIN = tuple(SHAPES)


def joint_places(shape: BodyShape) -> dict[str, tuple[str | None, np.ndarray]]:
    """Joint -> (parent, bind position [m]) in an A-pose; names and tree are those of the CMU MotionBuilder rig."""
    h, child = shape.stature, shape.stature < 1.45
    leg = 0.495 if child else 0.515  # hip joint height over stature: children have shorter legs
    neck = 1.0 - shape.head / h - 0.030
    arm_scale = 0.97 if child else 1.0
    stance = 0.052 + max(0.0, shape.thigh / h - 0.33) * 0.24  # thick thighs stand further apart
    places: dict[str, tuple[str | None, np.ndarray]] = {}

    def put(name: str, parent: str | None, x, y, z) -> None:
        places[name] = (parent, np.array([x, y, z]) * h)

    put("Hips", None, 0, leg + 0.028, -0.004)
    for side, sign in (("Left", 1), ("Right", -1)):
        s = side[0]
        put(f"{s}HipJoint", "Hips", 0, leg + 0.028, -0.004)
        put(f"{side}UpLeg", f"{s}HipJoint", sign * 0.050, leg, 0)
        put(f"{side}Leg", f"{side}UpLeg", sign * (0.6 * stance + 0.022), 0.283 * leg / 0.515, 0.004)
        put(f"{side}Foot", f"{side}Leg", sign * (stance + 0.005), 0.043, -0.016)
        put(f"{side}ToeBase", f"{side}Foot", sign * (stance + 0.012), 0.014, 0.062)
    put("LowerBack", "Hips", 0, leg + 0.062, -0.012)
    put("Spine", "LowerBack", 0, leg + 0.122, -0.016)
    put("Spine1", "Spine", 0, leg + 0.192, -0.018)
    put("Neck", "Spine1", 0, neck - 0.030, -0.016)
    put("Neck1", "Neck", 0, neck, -0.008)
    put("Head", "Neck1", 0, neck + 0.030, 0.002)
    down = np.deg2rad(47)
    along = np.array([np.cos(down), -np.sin(down), 0.06])
    along /= np.linalg.norm(along)
    for side, sign in (("Left", 1), ("Right", -1)):
        mirror = np.array([sign, 1, 1])
        put(f"{side}Shoulder", "Spine1", sign * 0.018, neck - 0.040, -0.008)
        shoulder = np.array([0.100 if not child else 0.094, neck - 0.030, -0.014])
        reach = np.cumsum([0.0, 0.170, 0.147, 0.050, 0.022]) * arm_scale
        for name, parent, r in zip(
            ("Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1"),
            ("Shoulder", "Arm", "ForeArm", "Hand", "FingerBase"), reach, strict=True,
        ):  # fmt: skip
            put(side + name, side + parent, *((shoulder + along * r) * mirror))
        put(f"{side[0]}Thumb", f"{side}Hand", *((shoulder + along * (reach[2] + 0.012) + [0, 0, 0.014]) * mirror))
    return places


def skeleton_of(shape: BodyShape) -> Skeleton:
    """31 joints with the CMU MotionBuilder names; every joint's frame is the world's at bind."""
    places = joint_places(shape)
    names = list(places)
    parents = [-1 if p is None else names.index(p) for p, _ in places.values()]
    positions = np.stack([x for _, x in places.values()])
    offsets = np.where(np.array(parents)[:, None] >= 0, positions - positions[parents], positions)
    h, along = shape.stature, positions[names.index("LeftHand")] - positions[names.index("LeftForeArm")]
    along = along / np.linalg.norm(along)
    tips = {"Head": [0, h - positions[names.index("Head")][1], 0]}
    for side, sign in (("Left", 1), ("Right", -1)):
        tips[f"{side}ToeBase"] = [0, 0, 0.038 * h]
        tips[f"{side}HandIndex1"] = along * [sign, 1, 1] * 0.032 * h
        tips[f"{side[0]}Thumb"] = (along * [sign, 1, 1] * 0.024 + [0, 0, 0.018]) * h
    return Skeleton(names, parents, offsets, end_parents=[names.index(n) for n in tips],
                    end_offsets=np.array(list(tips.values()), float))  # fmt: skip
