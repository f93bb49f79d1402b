"""The built-in people: closed, skinned bodies that motionfit makes itself from published anthropometry.

Segment lengths are fractions of stature after Drillis & Contini (1966), as in Winter, *Biomechanics and Motor
Control of Human Movement* (2009), fig. 4.1, with joint centres a little inside the landmarks as in de Leva (1996).
Girths of the average adult lie near the ANSUR II means (Gordon et al. 2014), brought to a BMI of 24; slim and heavy
follow the NHANES 2011-2014 percentiles (Fryar et al. 2016) for a BMI near 19 and 38, the child Snyder et al. (1977)
and NHANES at 7 to 8 years.

The surface is an implicit one. Tubes of elliptic section with smooth radius profiles, and ellipsoids, are blended
limb by limb (Quilez' polynomial smooth minimum) and polygonised by marching cubes.
"""

import hashlib
import inspect
import io
import sys
from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from motionfit._cache import cache_folder, remember
from motionfit._character import Character
from motionfit._skeleton import Skeleton
from motionfit._skinning import Skin
from motionfit._types import InputError


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


def builtin_body(name: str) -> Character:
    """One of the built-in people: average, slim, heavy, child. Made in a few seconds, then read from the cache."""
    return body(_shape(name), f"builtin:{name}")


def builtin_skeleton(name: str) -> Skeleton:
    """The skeleton of a built-in body, without making its skin."""
    return skeleton_of(_shape(name))


def _shape(name: str) -> BodyShape:
    if name not in SHAPES:
        raise InputError(f"no built-in body {name!r}; there are {', '.join(BUILTIN)}")
    return SHAPES[name]


# --- skeleton ---------------------------------------------------------------------------------------------------


def _joints(shape: BodyShape) -> dict[str, tuple[str | None, np.ndarray]]:
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
    places = _joints(shape)
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


# --- surface ----------------------------------------------------------------------------------------------------


def _smooth_min(a: np.ndarray, b: np.ndarray, k: float) -> np.ndarray:
    """Minimum of two fields [m], rounded over k [m]."""
    blend = np.maximum(k - np.abs(a - b), 0.0) / k
    return np.minimum(a, b) - blend * blend * k / 4


class _Tube(NamedTuple):
    """A limb as a stack of ellipses along a polyline: half widths [m] at knots of the arc length (0..1)."""

    points: np.ndarray  # (n, 3)
    knots: np.ndarray
    wide: np.ndarray  # half widths across, in the direction of `side`
    deep: np.ndarray
    side: np.ndarray  # (3,)

    def field(self, x: np.ndarray) -> np.ndarray:
        """About the distance [m] to the surface, negative inside."""
        return self.field_and_place(x)[0]

    def field_and_place(self, x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        starts, bones = self.points[:-1], np.diff(self.points, axis=0)
        lengths = np.linalg.norm(bones, axis=1)
        ends = np.cumsum(lengths)
        wide, deep = PchipInterpolator(self.knots, self.wide), PchipInterpolator(self.knots, self.deep)
        best, place = np.full(len(x), np.inf), np.zeros(len(x))
        for start, bone, length, end in zip(starts, bones, lengths, ends, strict=True):
            axis = bone / length
            gap = x - start
            along = gap @ axis
            inside = np.clip(along, 0.0, length)
            s = (end - length + inside) / ends[-1]
            a, b = wide(s), deep(s)
            across = self.side - (self.side @ axis) * axis
            across /= np.linalg.norm(across)
            u, v, w = gap @ across, gap @ np.cross(axis, across), along - inside
            field = (np.sqrt((u / a) ** 2 + (v / b) ** 2 + (w / np.minimum(a, b)) ** 2) - 1.0) * np.minimum(a, b)
            place = np.where(field < best, s, place)
            best = np.minimum(best, field)
        return best, place


def _ellipsoid(x: np.ndarray, centre, radii) -> np.ndarray:
    radii = np.asarray(radii, float)
    return (np.sqrt((((x - centre) / radii) ** 2).sum(-1)) - 1.0) * radii.min()


def _half_axes(circumference: float, aspect: float) -> tuple[float, float]:
    """Half width and half depth of an ellipse of given girth [m] and depth over width (Ramanujan's formula)."""
    h = ((1 - aspect) / (1 + aspect)) ** 2
    wide = circumference / (np.pi * (1 + aspect) * (1 + 3 * h / (10 + np.sqrt(4 - 3 * h))))
    return wide, wide * aspect


class _Fields(NamedTuple):
    """The body's implicit surface by group, so that weights can follow the same groups."""

    trunk: np.ndarray
    arms: dict[str, np.ndarray]
    legs: dict[str, np.ndarray]

    def total(self, h: float) -> np.ndarray:
        body = self.trunk
        legs = np.minimum(self.legs["Left"], self.legs["Right"])  # never blended: they must stay two
        body = _smooth_min(body, legs, 0.030 * h)
        for arm in self.arms.values():
            body = _smooth_min(body, arm, 0.030 * h)
        return body


def _fields(shape: BodyShape, x: np.ndarray) -> _Fields:
    h = shape.stature
    at = {name: place for name, (_, place) in _joints(shape).items()}
    return _Fields(
        _trunk(shape, at, x),
        {side: _arm(shape, at, side, x) for side in ("Left", "Right")},
        {side: _leg(shape, at, side, sign, h, x) for side, sign in (("Left", 1.0), ("Right", -1.0))},
    )


def _trunk(shape: BodyShape, at: dict[str, np.ndarray], x: np.ndarray) -> np.ndarray:
    h = shape.stature
    stout = float(np.clip((shape.waist / h - 0.50) / 0.22, 0.0, 1.2))
    hip_y, neck_y = at["LeftUpLeg"][1], at["Neck1"][1]
    waist_y = hip_y + 0.105 * h
    chest_y = at["Spine1"][1] + 0.030 * h
    hip = _half_axes(shape.hip * 0.89, 0.70 + 0.08 * stout)
    waist = _half_axes(shape.waist, 0.72 + 0.16 * stout)
    chest = _half_axes(shape.chest * 0.94, 0.71 + 0.12 * stout)
    neck = shape.neck / (2 * np.pi)
    shoulder = at["LeftArm"]
    rows = [  # height, half width, half depth, centre z
        (hip_y - 0.075 * h, hip[0] * 0.42, hip[1] * 0.52, -0.006 * h),
        (hip_y - 0.035 * h, hip[0] * 0.80, hip[1] * 0.86, -0.007 * h),
        (hip_y + 0.005 * h, hip[0] * 0.99, hip[1] * 1.00, -0.008 * h),
        (
            hip_y + 0.050 * h,
            0.55 * hip[0] + 0.45 * waist[0],
            0.55 * hip[1] + 0.45 * waist[1],
            (0.010 * stout - 0.004) * h,
        ),
        (waist_y, waist[0], waist[1], (0.020 * stout + 0.001) * h),
        (
            0.5 * (waist_y + chest_y),
            0.45 * waist[0] + 0.55 * chest[0],
            0.5 * (waist[1] + chest[1]),
            (0.012 * stout) * h,
        ),
        (chest_y, chest[0], chest[1], 0.002 * h),
        (shoulder[1] - 0.028 * h, chest[0] * 0.93, chest[1] * 0.88, -0.004 * h),
        (shoulder[1] + 0.004 * h, shoulder[0] * 0.86, chest[1] * 0.62, -0.012 * h),
        (shoulder[1] + 0.024 * h, shoulder[0] * 0.46 + 0.25 * neck, 0.5 * chest[1] * 0.62 + 0.5 * neck, -0.014 * h),
        (neck_y + 0.010 * h, neck * 1.02, neck * 1.02, -0.010 * h),
        (neck_y + 0.050 * h, neck * 0.96, neck * 1.00, 0.000),
    ]
    y, wide, deep, z = (np.array(c) for c in zip(*rows, strict=True))
    centre = PchipInterpolator(y, z)
    inside = np.clip(x[:, 1], y[0], y[-1])
    a, b = PchipInterpolator(y, wide)(inside), PchipInterpolator(y, deep)(inside)
    # sections a little squarer than ellipses, as trunks are; the ends are round
    square = 2.12
    u, v = np.abs(x[:, 0]) / a, np.abs(x[:, 2] - centre(inside)) / b
    over = np.abs(x[:, 1] - inside) / np.minimum(a, b)
    ring = (u**square + v**square) ** (1 / square)
    body = (np.sqrt(ring**2 + over**2) - 1.0) * np.minimum(a, b)

    for sign in (1.0, -1.0):
        buttock = at["LeftUpLeg"] * [sign, 1, 1] + [0, -0.004 * h, -0.55 * hip[1]]
        body = _smooth_min(body, _ellipsoid(x, buttock, np.array([0.48 * hip[0], 0.052 * h, 0.62 * hip[1]])), 0.03 * h)
        pectoral = [sign * 0.46 * chest[0], chest_y + 0.020 * h, 0.58 * chest[1]]
        body = _smooth_min(
            body, _ellipsoid(x, pectoral, np.array([0.46 * chest[0], 0.042 * h, 0.46 * chest[1]])), 0.025 * h
        )
    if stout > 0.3:
        belly = [0, waist_y - 0.025 * h, 0.48 * waist[1]]
        body = _smooth_min(
            body, _ellipsoid(x, belly, np.array([0.80 * waist[0], 0.075 * h, 0.66 * waist[1]])), 0.04 * h
        )

    # head: height from chin to vertex is `head`
    head, top = shape.head, h
    fat = 1.0 + 0.06 * stout
    skull = [0, top - 0.40 * head, -0.006 * h]
    field = _ellipsoid(x, skull, np.array([0.335 * head * fat, 0.40 * head, 0.425 * head]))
    face = [0, top - 0.60 * head, 0.105 * head]
    field = _smooth_min(
        field, _ellipsoid(x, face, np.array([0.27 * head * fat, 0.36 * head, 0.30 * head])), 0.10 * head
    )
    chin = [0, top - 0.91 * head, 0.235 * head]
    field = _smooth_min(field, _ellipsoid(x, chin, np.array([0.13, 0.085, 0.11]) * head * fat), 0.12 * head)
    nose = [0, top - 0.60 * head, 0.415 * head]
    field = _smooth_min(field, _ellipsoid(x, nose, np.array([0.062, 0.12, 0.085]) * head), 0.05 * head)
    for sign in (1.0, -1.0):
        ear = [sign * 0.335 * head * fat, top - 0.55 * head, -0.03 * head]
        field = _smooth_min(field, _ellipsoid(x, ear, np.array([0.05, 0.13, 0.075]) * head), 0.03 * head)
    return _smooth_min(body, field, 0.022 * h)


def _arm(shape: BodyShape, at: dict[str, np.ndarray], side: str, x: np.ndarray) -> np.ndarray:
    h = shape.stature
    shoulder, elbow, wrist = (at[side + n] for n in ("Arm", "ForeArm", "Hand"))
    fingers = at[f"{side}HandIndex1"]
    sign = np.sign(shoulder[0])
    upper, fore = shape.upper_arm / (2 * np.pi), shape.forearm / (2 * np.pi)
    wrist_r = 0.55 * fore + 0.0068 * h
    forward = np.array([0.0, 0.0, 1.0])
    tube = _Tube(
        np.stack([shoulder + [-sign * 0.006 * h, -0.004 * h, 0], elbow, wrist + (wrist - elbow) * 0.08]),
        np.array([0.0, 0.10, 0.26, 0.42, 0.51, 0.60, 0.72, 0.88, 0.97, 1.0]),
        np.array([1.10, 1.12, 1.02, 0.94, 0.80, 0, 0, 0, 0, 0]) * upper
        + np.array([0, 0, 0, 0, 0, 1.04, 0.98, 0, 0, 0]) * fore
        + np.array([0, 0, 0, 0, 0, 0, 0, 0.90, 0.86, 0.84]) * wrist_r,
        np.array([1.02, 1.04, 0.98, 0.92, 0.80, 0, 0, 0, 0, 0]) * upper
        + np.array([0, 0, 0, 0, 0, 0.98, 0.96, 0, 0, 0]) * fore
        + np.array([0, 0, 0, 0, 0, 0, 0, 1.06, 1.06, 1.06]) * wrist_r,
        np.cross(forward, wrist - elbow),
    )
    along = (fingers - wrist) / np.linalg.norm(fingers - wrist)
    tip = fingers + along * 0.026 * h
    # a mitten: thin across the palm, wide from thumb side to little finger
    palm = _Tube(
        np.stack([wrist - along * 0.006 * h, wrist + along * 0.045 * h, tip]),
        np.array([0.0, 0.18, 0.40, 0.62, 0.85, 1.0]),
        np.array([0.62, 0.66, 0.72, 0.62, 0.50, 0.34]) * 0.0128 * h,
        np.array([0.90, 1.15, 1.42, 1.38, 1.20, 0.75]) * 0.0172 * h,
        np.cross(forward, along),
    )
    thumb_base, thumb = at[f"{side[0]}Thumb"], along * 0.8 + np.array([0, 0, 0.62])
    thumb = thumb / np.linalg.norm(thumb)
    digit = _Tube(
        np.stack([thumb_base - thumb * 0.008 * h, thumb_base + thumb * 0.030 * h]),
        np.array([0.0, 0.6, 1.0]), np.array([0.0088, 0.0074, 0.0056]) * h, np.array([0.0088, 0.0074, 0.0056]) * h,
        np.cross(forward, along),
    )  # fmt: skip
    hand = _smooth_min(palm.field(x), digit.field(x), 0.008 * h)
    return _smooth_min(tube.field(x), hand, 0.014 * h)


def _leg(shape: BodyShape, at: dict[str, np.ndarray], side: str, sign: float, h: float, x: np.ndarray) -> np.ndarray:
    hip, knee, ankle, toe = (at[side + n] for n in ("UpLeg", "Leg", "Foot", "ToeBase"))
    thigh, calf = shape.thigh / (2 * np.pi), shape.calf / (2 * np.pi)
    ankle_r = 0.46 * calf + 0.0055 * h
    knee_r = 0.42 * thigh + 0.42 * calf
    knots = np.array([0.0, 0.10, 0.25, 0.40, 0.475, 0.54, 0.66, 0.78, 0.90, 1.0])
    wide = np.array([0.98, 1.02, 0.93, 0, 0, 0, 0, 0, 0, 0]) * thigh
    wide += np.array([0, 0, 0, 1.06, 0.96, 0.93, 0, 0, 0, 0]) * knee_r
    wide += np.array([0, 0, 0, 0, 0, 0, 0.98, 0.80, 0, 0]) * calf
    wide += np.array([0, 0, 0, 0, 0, 0, 0, 0, 1.02, 0.98]) * ankle_r
    deep = wide * np.array([1.0, 1.0, 1.02, 1.02, 1.06, 1.06, 1.06, 1.08, 1.16, 1.2])
    # the calf lies behind the bone
    bow = knee + 0.42 * (ankle - knee) + np.array([0, 0, -0.012 * h])
    tube = _Tube(np.stack([hip + [sign * 0.004 * h, 0.01 * h, 0], knee, bow, ankle]), knots, wide, deep,
                 np.array([1.0, 0.0, 0.0]))  # fmt: skip
    sole = 0.020 * h
    heel, ball = ankle + [0, 0, -0.020 * h], toe + [0, 0, 0.004 * h]
    heel[1] = ball[1] = sole
    tip = toe + [0, 0, 0.032 * h]
    tip[1] = 0.013 * h
    foot = _Tube(
        np.stack([heel, 0.5 * (heel + ball) + [0, 0.004 * h, 0], ball, tip]),
        np.array([0.0, 0.2, 0.45, 0.72, 0.9, 1.0]),
        np.array([0.0185, 0.0185, 0.020, 0.0265, 0.0245, 0.018]) * h,
        np.array([0.024, 0.026, 0.029, 0.022, 0.014, 0.011]) * h,
        np.array([1.0, 0.0, 0.0]),
    )
    instep = _Tube(
        np.stack([ankle + [0, 0.008 * h, 0], ankle + [0, -0.012 * h, 0.034 * h]]),
        np.array([0.0, 1.0]), np.array([0.019, 0.016]) * h, np.array([0.021, 0.014]) * h, np.array([1.0, 0, 0]),
    )  # fmt: skip
    shoe = _smooth_min(foot.field(x), instep.field(x), 0.02 * h)
    leg = _smooth_min(tube.field(x), shoe, 0.022 * h)
    leg = -_smooth_min(-leg, x[:, 1], 0.006 * h)  # the ground cuts the sole flat
    # thighs that touch are flattened against each other, so that the two legs stay two surfaces
    return -_smooth_min(-leg, sign * x[:, 0] - 0.007 * h, 0.016 * h)


def _grid(shape: BodyShape) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grid lines [m], finer where hands, feet and face need it; x = 0 is one of them and keeps the legs apart."""
    h = shape.stature
    at = {name: place for name, (_, place) in _joints(shape).items()}
    reach = at["LeftHandIndex1"][0] + 0.06 * h
    wrist = at["LeftHand"]

    def lines(start: float, stops: list[tuple[float, float]]) -> np.ndarray:
        """From `start` to each stop with steps of about the given size."""
        parts, low = [np.array([start])], start
        for high, step in stops:
            parts.append(np.linspace(low, high, max(2, round((high - low) / step) + 1))[1:])
            low = high
        return np.concatenate(parts)

    coarse, fine = 0.0122 * h, 0.0058 * h
    half = lines(0.0, [(wrist[0] - 0.02 * h, coarse), (reach, fine)])
    x = np.concatenate([-half[:0:-1], half])
    hand_low = at["LeftHandIndex1"][1] - 0.06 * h
    y = lines(-0.02 * h, [(0.06 * h, fine), (hand_low, 1.25 * coarse), (wrist[1] + 0.01 * h, 0.8 * coarse),
                          (h - shape.head, coarse), (h + 0.02 * h, 0.75 * coarse)])  # fmt: skip
    deep = 0.5 * _half_axes(shape.waist, 0.9)[1] + 0.085 * h
    z = lines(
        -deep - 0.03 * h, [(-0.05 * h, coarse), (0.06 * h, 0.7 * coarse), (max(0.13 * h, deep + 0.08 * h), coarse)]
    )
    return x, y, z


def _mesh(shape: BodyShape) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of the body: vertices [m] and faces, outward."""
    import trimesh
    from skimage.measure import marching_cubes

    lines = _grid(shape)
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    field = _fields(shape, points).total(shape.stature).reshape([len(g) for g in lines])
    index, faces, _, _ = marching_cubes(field, 0.0)
    vertices = np.stack([np.interp(index[:, i], np.arange(len(g)), g) for i, g in enumerate(lines)], axis=1)
    mesh = trimesh.Trimesh(vertices, faces, process=True)
    parts = mesh.split(only_watertight=False)
    mesh = max(parts, key=lambda m: len(m.vertices))
    vertices = np.asarray(mesh.vertices)
    # even the triangles out along the surface, then put the vertices exactly on it
    laplacian = trimesh.smoothing.laplacian_calculation(mesh)
    step = 1e-4
    for round_ in range(4):
        if round_ < 3:
            vertices = vertices + 0.5 * (laplacian.dot(vertices) - vertices)  # pyright: ignore[reportOptionalMemberAccess]: trimesh's stub
        around = np.concatenate([vertices, *(vertices + step * np.eye(3)[i] for i in range(3))])
        value = _fields(shape, around).total(shape.stature).reshape(4, -1)
        gradient = ((value[1:] - value[0]) / step).T
        steep = np.maximum((gradient**2).sum(1), 0.05)
        vertices = vertices - np.clip(value[0] / steep, -0.01, 0.01)[:, None] * gradient
    faces = np.asarray(mesh.faces)
    vertices[:, 1] = np.where(vertices[:, 1] < 0.004, np.maximum(vertices[:, 1], 0.0), vertices[:, 1])
    vertices[:, 1] *= shape.stature / vertices[:, 1].max()
    if trimesh.Trimesh(vertices, faces, process=False).volume < 0:
        faces = faces[:, ::-1]
    return vertices, faces


# --- skin weights -----------------------------------------------------------------------------------------------


def _step(x: np.ndarray) -> np.ndarray:
    x = np.clip(x, 0.0, 1.0)
    return x * x * x * (x * (6 * x - 15) + 10)


def _chain_weights(place: np.ndarray, joints: np.ndarray, widths: np.ndarray) -> np.ndarray:
    """Weights of the bones of a chain at arc lengths `place`: bone k gives way to k + 1 around `joints[k]`."""
    passed = np.stack([_step((place - j) / (2 * w) + 0.5) for j, w in zip(joints, widths, strict=True)], axis=1)
    before = np.concatenate([np.ones((len(place), 1)), passed], axis=1)
    after = np.concatenate([passed, np.zeros((len(place), 1))], axis=1)
    return np.cumprod(before, axis=1) * (1 - after)


def _arc_length(x: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Arc length [m] of the nearest place on a polyline, running on straight past both of its ends."""
    best, place, start = np.full(len(x), np.inf), np.zeros(len(x)), 0.0
    bones = np.diff(points, axis=0)
    for k, (origin, bone) in enumerate(zip(points, bones, strict=False)):
        length = float(np.linalg.norm(bone))
        along = (x - origin) @ (bone / length)
        inside = np.clip(along, -np.inf if k == 0 else 0.0, np.inf if k == len(bones) - 1 else length)
        distance = np.linalg.norm(x - origin - inside[:, None] * bone / length, axis=1)
        place = np.where(distance < best, start + inside, place)
        best = np.minimum(best, distance)
        start += length
    return place


def _weights(shape: BodyShape, vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Smooth weights (vertices, joints): which limb by the fields, which bone by the place along the limb."""
    h = shape.stature
    at = {name: place for name, (_, place) in _joints(shape).items()}
    fields = _fields(shape, vertices)
    weights = np.zeros((len(vertices), len(names)))
    limbs = {}
    for side in ("Left", "Right"):
        limbs[side, "arm"] = _step(0.5 + (fields.trunk - fields.arms[side]) / (0.056 * h))
        own = np.sign(vertices[:, 0]) == (1 if side == "Left" else -1)
        limbs[side, "leg"] = own * _step(0.5 + (fields.trunk - fields.legs[side]) / (0.075 * h))
    rest = np.clip(1 - sum(limbs.values()), 0.0, 1.0)
    for (side, kind), share in limbs.items():
        if kind == "arm":
            chain = [f"{side}{n}" for n in ("Arm", "ForeArm", "Hand", "FingerBase", "HandIndex1")]
            widths = np.array([0.024, 0.015, 0.012, 0.010]) * h
            radius = shape.upper_arm / (2 * np.pi)
            widths[0] = max(widths[0], 0.8 * radius)
        else:
            chain = [f"{side}{n}" for n in ("UpLeg", "Leg", "Foot", "ToeBase")]
            widths = np.array([0.032, 0.022, 0.014]) * h
            widths[0] = max(widths[0], 0.6 * shape.thigh / (2 * np.pi))
        points = np.stack([at[n] for n in chain])
        joints = np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))
        own = _chain_weights(_arc_length(vertices, points), joints, widths)
        for name, column in zip(chain, own.T, strict=True):
            weights[:, names.index(name)] += share * column
        if kind == "arm":
            base = at[f"{side[0]}Thumb"]
            thumb = _step(1.4 - np.linalg.norm(vertices - base - [0, -0.008 * h, 0.014 * h], axis=1) / (0.020 * h))
            hand = [names.index(f"{side}{n}") for n in ("Hand", "FingerBase", "HandIndex1")]
            moved = weights[:, hand] * thumb[:, None]
            weights[:, hand] -= moved
            weights[:, names.index(f"{side[0]}Thumb")] += moved.sum(1)
    spine = ["Hips", "LowerBack", "Spine", "Spine1", "Neck", "Neck1", "Head"]
    heights = np.array([at[n][1] for n in spine[1:]])
    heights[3:] += np.array([0.012, 0.010, 0.008]) * h
    widths = np.array([0.040, 0.045, 0.045, 0.022, 0.018, 0.018]) * h
    columns = _chain_weights(vertices[:, 1], heights, widths)
    # the shoulder girdle follows the clavicle
    level = _step((vertices[:, 1] - (at["LeftArm"][1] - 0.075 * h)) / (0.07 * h))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        share = level * _step((sign * vertices[:, 0] - 0.035 * h) / (0.065 * h)) * 0.85
        taken = columns[:, 3:5] * share[:, None]
        columns[:, 3:5] -= taken
        weights[:, names.index(f"{side}Shoulder")] += rest * taken.sum(1)
    for name, column in zip(spine, columns.T, strict=True):
        weights[:, names.index(name)] += rest * column
    return weights / weights.sum(1, keepdims=True)


def _four_influences(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = np.where(kept < 1e-3, 0.0, kept)
    return np.where(kept > 0, joints, 0).astype(np.int32), kept / kept.sum(1, keepdims=True)


# --- cache ------------------------------------------------------------------------------------------------------


def body(shape: BodyShape, name: str = "body") -> Character:
    """A closed, skinned body of the given measures, from the cache where it was made before."""
    skeleton = skeleton_of(shape)
    source = inspect.getsource(sys.modules[__name__])
    key = hashlib.sha256(repr((shape, source)).encode()).hexdigest()[:16]
    file = cache_folder() / f"body-{key}.npz"
    try:
        with np.load(file) as data:
            arrays = [data[k] for k in ("vertices", "faces", "joints", "weights")]
    except Exception:  # missing, cut off or unreadable: whatever it is, the body can be made again
        vertices, faces = _mesh(shape)
        joints, weights = _four_influences(_weights(shape, vertices, skeleton.names))
        arrays = [vertices, faces.astype(np.int32), joints, weights]
        packed = io.BytesIO()
        np.savez_compressed(packed, **dict(zip(("vertices", "faces", "joints", "weights"), arrays, strict=True)))
        remember(file, packed.getvalue())
    return Character(skeleton, Skin(*arrays), name)
