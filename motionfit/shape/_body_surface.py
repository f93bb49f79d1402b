"""The surface of a built-in body: an implicit one.

Tubes of elliptic section with smooth radius profiles, and ellipsoids, are blended limb by limb (Quilez' polynomial smooth
minimum) and polygonised by marching cubes.
"""

from typing import NamedTuple

import numpy as np
from scipy.interpolate import PchipInterpolator

from motionfit.shape._body_measures import BodyShape, joint_places


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


class BodyFields(NamedTuple):
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


def fields_of(shape: BodyShape, x: np.ndarray) -> BodyFields:
    h = shape.stature
    at = {name: place for name, (_, place) in joint_places(shape).items()}
    return BodyFields(
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
    at = {name: place for name, (_, place) in joint_places(shape).items()}
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


def mesh_of(shape: BodyShape) -> tuple[np.ndarray, np.ndarray]:
    """Closed triangle mesh of the body: vertices [m] and faces, outward."""
    import trimesh
    from skimage.measure import marching_cubes

    lines = _grid(shape)
    points = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
    field = fields_of(shape, points).total(shape.stature).reshape([len(g) for g in lines])
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
        value = fields_of(shape, around).total(shape.stature).reshape(4, -1)
        gradient = ((value[1:] - value[0]) / step).T
        steep = np.maximum((gradient**2).sum(1), 0.05)
        vertices = vertices - np.clip(value[0] / steep, -0.01, 0.01)[:, None] * gradient
    faces = np.asarray(mesh.faces)
    vertices[:, 1] = np.where(vertices[:, 1] < 0.004, np.maximum(vertices[:, 1], 0.0), vertices[:, 1])
    vertices[:, 1] *= shape.stature / vertices[:, 1].max()
    if trimesh.Trimesh(vertices, faces, process=False).volume < 0:
        faces = faces[:, ::-1]
    return vertices, faces
