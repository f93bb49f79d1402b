"""Limbs of two bones in closed form: appendix C of Lyard's thesis in its plane, and in space.

Erratum of appendix C: its joint 1 is the ankle, 2 the knee and 3 the hip, other than the text says. Read so, the
closed form is exact: the thigh turns by -alpha_3 and the shank by +alpha_1 in the (y, z) plane, and the foot keeps
its orientation because alpha_2 = -alpha_1 - alpha_3 (C.13).
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

LATERAL = 0.15  # share of the anatomical knee axis in the bending axis: a straight leg has no plane of its own
INVERTED = 0.1  # [rad] a knee that bends further than this the other way is meant to


class PlaneAngles(NamedTuple):
    """The angles of (C.11) to (C.13) [rad] at ankle, knee and hip, for both solutions: the first is the one with
    the smaller hip angle. `reachable` where the target lies within reach; elsewhere the nearest pose is given."""

    ankle: Float[np.ndarray, "2 *batch"]
    knee: Float[np.ndarray, "2 *batch"]
    hip: Float[np.ndarray, "2 *batch"]
    reachable: Bool[np.ndarray, "*batch"]


def plane_angles(
    thigh: Float[np.ndarray, "*batch 2"], shank: Float[np.ndarray, "*batch 2"], move: Float[np.ndarray, "*batch 2"]
) -> PlaneAngles:
    """How ankle, knee and hip turn so that the ankle moves by `move` and the foot keeps its orientation.

    `thigh` (hip to knee) and `shank` (knee to ankle) [m] are given in the leg's plane as (y, z), and so is `move`
    [m]. Thesis 3.2.2 and appendix C: (C.11) gives the ankle's angle, twice for the two values of the arc sine; of
    the four pairs with (C.12) the two that satisfy (C.9) are kept, here by taking both (C.8) and (C.9) into one
    atan2; the one with the smaller hip angle comes first (3.2.3). A target out of reach is drawn to the nearest
    point that can be reached.
    """
    r1, r3 = np.linalg.norm(shank, axis=-1), np.linalg.norm(thigh, axis=-1)
    wanted = thigh + shank + move
    distance = np.linalg.norm(wanted, axis=-1)
    low, high = np.abs(r1 - r3), r1 + r3
    reachable = (distance >= low * (1 - 1e-12)) & (distance <= high * (1 + 1e-12))
    near = np.clip(distance, np.maximum(low, 1e-12), high)
    # a target on the hip itself has no direction: the leg's own serves
    own = thigh + shank
    own = own / np.maximum(np.linalg.norm(own, axis=-1, keepdims=True), 1e-300)
    direction = np.where((distance > 1e-12)[..., None], wanted / np.maximum(distance, 1e-300)[..., None], own)
    y, z = np.moveaxis(direction * near[..., None], -1, 0)
    k1 = np.arctan2(shank[..., 1], shank[..., 0])  # atan(b1 / a1), a1 = y2 - y1, b1 = z2 - z1
    k3 = np.arctan2(thigh[..., 0], thigh[..., 1])  # atan(b3 / a3), a3 = z3 - z2, b3 = y3 - y2
    k = np.arctan2(y, z)
    sine = np.clip((near**2 + r1**2 - r3**2) / np.maximum(2 * near * r1, 1e-300), -1.0, 1.0)
    ankles, hips = [], []
    for turn in (np.arcsin(sine), np.pi - np.arcsin(sine)):
        ankle = turn - k1 - k  # (C.11)
        # (C.8) and (C.9): sine and cosine of alpha_3 + k3
        hip = np.arctan2(y - r1 * np.cos(ankle + k1), z - r1 * np.sin(ankle + k1)) - k3
        ankles.append(_wrapped(ankle))
        hips.append(_wrapped(hip))
    ankle, hip = np.stack(ankles), np.stack(hips)
    order = np.argsort(np.abs(hip), axis=0, kind="stable")
    ankle, hip = np.take_along_axis(ankle, order, 0), np.take_along_axis(hip, order, 0)
    return PlaneAngles(ankle, -ankle - hip, hip, reachable)


def _wrapped(angle: np.ndarray) -> np.ndarray:
    """To -pi..pi."""
    return (angle + np.pi) % (2 * np.pi) - np.pi


class LimbTurn(NamedTuple):
    """World rotations that are put before those of the upper and of the lower bone, and where the end gets."""

    upper: Rotation
    lower: Rotation
    end_world: Float[np.ndarray, "frames 3"]
    reachable: Bool[np.ndarray, " frames"]


def move_limb(
    hip_world: Float[np.ndarray, "frames 3"],
    knee_world: Float[np.ndarray, "frames 3"],
    ankle_world: Float[np.ndarray, "frames 3"],
    target_world: Float[np.ndarray, "frames 3"],
    lateral_world: Float[np.ndarray, "frames 3"],
) -> LimbTurn:
    """Bring the ankle to the target by turning thigh and shank; the hip stays, and the foot may keep its orientation.

    Thesis 3.2.2: an intermediate frame is laid through the leg, with its x axis across it, and the plane problem of
    appendix C is solved there. Here that frame is first swung about the hip until the target lies in its plane (the
    smallest rotation that takes the direction of the ankle to that of the target), and its x axis is perpendicular
    to the line from hip to ankle: what thigh and shank have outside of the plane then cancels, and one pass is
    exact. `lateral_world` is the knee's anatomical axis, about which the shank turns when it bends: it says which
    way a straight leg bends.
    """
    chord, goal = ankle_world - hip_world, target_world - hip_world
    swing = shortest(chord, goal)
    apart = np.stack([knee_world - hip_world, ankle_world - knee_world, lateral_world, chord], axis=2)
    thigh, shank, lateral, swung = np.moveaxis(swing.as_matrix() @ apart, 2, 0)
    forward = _unit(np.where(np.linalg.norm(goal, axis=1, keepdims=True) > 1e-9, goal, swung))
    lengths = np.linalg.norm(thigh, axis=1) * np.linalg.norm(shank, axis=1)
    bend = np.cross(thigh, shank) / np.maximum(lengths, 1e-12)[:, None]
    # both ways to bend have the same axis: taken to the side of the anatomical one, the two never cancel
    same_side = np.where(np.einsum("fa,fa->f", bend, lateral) < 0, -1.0, 1.0)[:, None]
    x = _perpendicular(same_side * bend + LATERAL * lateral, forward)
    y = np.cross(forward, x)  # z is `forward`: (x, y, z) is right-handed
    plane = np.stack([y, forward], axis=1)
    flat = [np.einsum("fka,fa->fk", plane, v) for v in (thigh, shank)]
    gap = np.linalg.norm(goal, axis=1) - np.linalg.norm(chord, axis=1)
    move = np.stack([np.zeros_like(gap), gap], axis=1)
    angles = plane_angles(flat[0], flat[1], move)
    bent = np.arctan2(np.einsum("fa,fa->f", np.cross(thigh, shank), x), np.einsum("fa,fa->f", thigh, shank))
    # of the two solutions the nearer one, unless it would bend a knee backwards that did not bend so before
    backwards = np.sin(bent - angles.knee) < -1e-9
    pick = ((bent > -INVERTED) & backwards[0] & ~backwards[1]).astype(int)[None]
    hip, ankle = (np.take_along_axis(angle, pick, 0)[0][:, None] for angle in (angles.hip, angles.ankle))
    # in the (y, z) plane the thigh turns by -alpha_3 and the shank by +alpha_1: about x, from y to z
    upper = Rotation.from_rotvec(x * -hip) * swing
    lower = Rotation.from_rotvec(x * ankle) * swing
    end = hip_world + upper.apply(knee_world - hip_world) + lower.apply(ankle_world - knee_world)
    return LimbTurn(upper, lower, end, angles.reachable)


def shortest(a: Float[np.ndarray, "frames 3"], b: Float[np.ndarray, "frames 3"]) -> Rotation:
    """The smallest rotations that take directions a to directions b; opposite ones turn about any perpendicular."""
    a, b = _unit(a), _unit(b)
    axis = np.cross(a, b)
    sine, cosine = np.linalg.norm(axis, axis=1), np.einsum("fa,fa->f", a, b)
    any_way = _perpendicular(np.eye(3)[np.abs(a).argmin(1)], a)
    axis = np.where((sine > 1e-12)[:, None], axis / np.maximum(sine, 1e-300)[:, None], any_way)
    return Rotation.from_rotvec(axis * np.arctan2(sine, cosine)[:, None])


def swivel_angle(
    shoulder_world: Float[np.ndarray, "frames 3"],
    elbow_world: Float[np.ndarray, "frames 3"],
    wrist_world: Float[np.ndarray, "frames 3"],
    pole_world: Float[np.ndarray, "frames 3"],
) -> Float[np.ndarray, " frames"]:
    """Where on its circle the middle joint stands [rad], from the direction of `pole_world` on: Tolani et al. 2000."""
    n = _unit(wrist_world - shoulder_world)
    u = _perpendicular(pole_world, n)
    arm = elbow_world - shoulder_world
    return np.arctan2(np.einsum("fa,fa->f", arm, np.cross(n, u)), np.einsum("fa,fa->f", arm, u))


def solve_limb(
    shoulder_world: Float[np.ndarray, "frames 3"],
    elbow_world: Float[np.ndarray, "frames 3"],
    wrist_world: Float[np.ndarray, "frames 3"],
    target_world: Float[np.ndarray, "frames 3"],
    swivel: Float[np.ndarray, " frames"],
    pole_world: Float[np.ndarray, "frames 3"],
) -> LimbTurn:
    """A limb of seven degrees of freedom with its end at the target: Tolani, Goswami & Badler 2000, position part.

    The law of cosines gives the middle joint's circle around the line from shoulder to target, and the swivel angle
    [rad, from the pole's direction on] its place there. Both bones then turn with the plane that they span, so
    that a bend keeps its side. The end's own rotation is free: the hand or foot keeps the one it had.
    """
    arm, fore = elbow_world - shoulder_world, wrist_world - elbow_world
    a, b = np.linalg.norm(arm, axis=1), np.linalg.norm(fore, axis=1)
    goal = target_world - shoulder_world
    distance = np.linalg.norm(goal, axis=1)
    low, high = np.abs(a - b), a + b
    reachable = (distance >= low * (1 - 1e-12)) & (distance <= high * (1 + 1e-12))
    n = _unit(np.where((distance > 1e-12)[:, None], goal, wrist_world - shoulder_world))
    near = np.clip(distance, np.maximum(low, 1e-12), high)
    cosine = np.clip((a**2 + near**2 - b**2) / (2 * a * near), -1.0, 1.0)
    sine = np.sqrt(1.0 - cosine**2)
    u = _perpendicular(pole_world, n)
    v = np.cross(n, u)
    out = np.cos(swivel)[:, None] * u + np.sin(swivel)[:, None] * v
    elbow = a[:, None] * (cosine[:, None] * n + sine[:, None] * out)
    end = near[:, None] * n
    old_n = _unit(wrist_world - shoulder_world)
    old_side = _perpendicular(np.cross(arm, fore), old_n, fallback=np.cross(_perpendicular(pole_world, old_n), old_n))
    side = np.cross(out, n)
    upper = _frame(elbow, side) * _frame(arm, old_side).inv()
    lower = _frame(end - elbow, side) * _frame(fore, old_side).inv()
    return LimbTurn(upper, lower, shoulder_world + end, reachable)


def _frame(axis: np.ndarray, across: np.ndarray) -> Rotation:
    first = _unit(axis)
    second = _perpendicular(across, first)
    return Rotation.from_matrix(np.stack([first, second, np.cross(first, second)], axis=2))


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-300)


def _perpendicular(x: np.ndarray, axis: np.ndarray, fallback: np.ndarray | None = None) -> np.ndarray:
    """The unit vector across the unit `axis` that is nearest to x; one of the coordinate axes' where x lies along it."""
    across = x - np.einsum("fa,fa->f", x, axis)[:, None] * axis
    length = np.linalg.norm(across, axis=1, keepdims=True)
    other = np.eye(3)[np.abs(axis).argmin(1)]
    other = other - np.einsum("fa,fa->f", other, axis)[:, None] * axis
    return np.where(length > 1e-9, across / np.maximum(length, 1e-300), _unit(other if fallback is None else fallback))
