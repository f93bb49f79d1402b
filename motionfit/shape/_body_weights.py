"""The skin weights of a built-in body: which limb by the implicit surface, which bone by the place along the limb."""

import numpy as np

from motionfit.shape._body_measures import BodyShape, joint_places
from motionfit.shape._body_surface import fields_of


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


def weights_of(shape: BodyShape, vertices: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Smooth weights (vertices, joints): which limb by the fields, which bone by the place along the limb."""
    h = shape.stature
    at = {name: place for name, (_, place) in joint_places(shape).items()}
    fields = fields_of(shape, vertices)
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


def four_influences(weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    joints = np.argsort(-weights, axis=1, kind="stable")[:, :4]
    kept = np.take_along_axis(weights, joints, axis=1)
    kept = np.where(kept < 1e-3, 0.0, kept)
    return np.where(kept > 0, joints, 0).astype(np.int32), kept / kept.sum(1, keepdims=True)
