"""The pose that a clip's skeleton rests in: how a joint turns away from it is what goes onto another body.

BVH has no place for it. Some files stand in T-pose at zero angles, some in their first frame (CMU), and some nowhere: at
zero angles all bones lie along one axis, so that each joint's axes say which way its bone goes (Rokoko, LaFAN1).
"""

import dataclasses

import equinox as eqx
import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from motionfit._motion import Motion, bind_pose, host_kinematics
from motionfit._onto import between
from motionfit._skeleton import SIDES, Skeleton

ENOUGH = 500  # frames that a rest pose is found from
NO_HINGE = 0.1  # sine of the bend below which a limb's own plane says less than the joint above it
STILL, LOW = 0.2, 0.03  # [m/s], [m]: an ankle as slow, and as low, stands
SURELY = 0.1  # of 1: a foot that is never as sure to stand does not
X, Y, Z = np.eye(3)
ASKEW = np.array([0.36, 0.48, 0.8])
# what a left elbow bends about in T-pose: the forearm goes ahead and 30 degrees up, as in CMU's files
ELBOW = np.array([0.0, -np.sqrt(0.75), 0.5])


def split_rest_frame(motion: Motion, rest_frame: str = "auto") -> Motion:
    """Take a first frame that is a rest pose out of the motion and keep it as the skeleton's rest pose."""
    if motion.frame_count < 2 or rest_frame == "none":
        return motion
    if rest_frame == "auto" and not has_rest_frame(motion):
        return motion
    rest = np.asarray(motion.rotations)[0]
    skeleton = eqx.tree_at(lambda s: s.rest_rotations, motion.skeleton, rest)
    rotations, translations = motion.rotations[1:], motion.translations
    return Motion(skeleton, motion.root[1:], rotations, motion.dt, None if translations is None else translations[1:])


def has_rest_frame(motion: Motion) -> bool:
    """True where frame 0 is a standing rest pose that frame 1 does not lead on from.

    Legs straight and near vertical, arms straight and mirrored between level and 60 degrees down, trunk upright;
    and the step to frame 1 is far larger than the steps after it.
    """
    skeleton = motion.skeleton
    limbs = [(f"{s}_{a}", f"{s}_{b}", f"{s}_{c}") for s in SIDES
             for a, b, c in (("thigh", "calf", "foot"), ("upper_arm", "forearm", "hand"))]  # fmt: skip
    if any(skeleton.find(r) is None for limb in (("hips", "head"), *limbs) for r in limb):
        return False
    rotations = np.asarray(motion.rotations, float)[:12]
    steps = 2 * np.arccos(np.clip(np.abs((rotations[1:] * rotations[:-1]).sum(-1)), 0, 1)).max(-1)
    usual = np.median(steps[1:]) if len(steps) > 1 else 0.0
    if np.rad2deg(steps[:1].max()) < max(8.0, 4 * np.rad2deg(usual)):
        return False
    positions = host_kinematics(motion[:1])[0][0]

    def unit(a: str, b: str) -> np.ndarray:
        return _unit(positions[skeleton.joint(b)] - positions[skeleton.joint(a)])

    straight = all(unit(a, b) @ unit(b, c) > np.cos(np.deg2rad(30)) for a, b, c in limbs)
    legs = all(unit(a, c)[1] < -np.cos(np.deg2rad(20)) for a, _, c in limbs if "thigh" in a)
    left, right = (unit(f"{s}_upper_arm", f"{s}_hand") for s in ("left", "right"))
    level = all(-0.9 < v[1] < 0.35 for v in (left, right))
    mirrored = abs(left[1] - right[1]) < 0.1 and left[[0, 2]] @ right[[0, 2]] < 0.3
    return bool(straight and legs and level and mirrored and unit("hips", "head")[1] > np.cos(np.deg2rad(30)))


def with_standing_rest(motion: Motion) -> Motion:
    """The motion on a skeleton whose rest pose stands upright: its own, set upright, or the T-pose found from the
    motion where its own is none that anybody could stand in."""
    skeleton = motion.skeleton
    limbs = [f"{s}_{r}" for s in SIDES for r in ("thigh", "calf", "foot", "upper_arm", "forearm", "hand")]
    if any(skeleton.find(role) is None for role in ("hips", "chest", "head", *limbs)):
        return motion
    positions = bind_pose(skeleton)[0]
    trunk = _unit(positions[skeleton.joint("head")] - positions[skeleton.joint("hips")])
    legs = [_unit(positions[skeleton.joint(f"{s}_foot")] - positions[skeleton.joint(f"{s}_thigh")]) for s in SIDES]
    up = _unit(2.0 * trunk - sum(legs))
    if not all(leg @ trunk < -0.5 for leg in legs):
        rest = t_pose_of(motion)
    elif up[1] < 0.5:
        rest = np.array(skeleton.rest_rotations)
        axis = np.sign(up) * (np.abs(up) == np.abs(up).max())  # files lie by quarter turns
        rest[0] = (between(axis, Y) * Rotation.from_quat(rest[0], scalar_first=True)).as_quat(scalar_first=True)
    else:
        return motion
    return dataclasses.replace(motion, skeleton=eqx.tree_at(lambda s: s.rest_rotations, skeleton, rest))


def is_found_again(motion: Motion) -> bool:
    """Whether the rest pose is the one that would be found if the file told none."""
    rest = np.asarray(motion.skeleton.rest_rotations, float)
    zero = eqx.tree_at(lambda s: s.rest_rotations, motion.skeleton, np.zeros_like(rest) + [1.0, 0.0, 0.0, 0.0])
    found = with_standing_rest(dataclasses.replace(motion, skeleton=zero)).skeleton.rest_rotations
    return bool((np.abs((np.asarray(found) * rest).sum(axis=1)) > 1.0 - 1e-9).all())


def t_pose_of(motion: Motion) -> Float[np.ndarray, "joints 4"]:
    """Joint-to-parent rotations of the T-pose, facing z, that a motion's skeleton has no pose for.

    Q_t being a joint's world rotation and D_t how its body part is turned away from rest, which the joints' places tell,
    Q_rest is the mean over the frames of D_t^-1 Q_t. What no part is known of (hands, fingers) goes straight on.
    """
    skeleton = motion.skeleton
    every = -(-motion.frame_count // ENOUGH)
    seen = motion[::every]
    positions, rotations = host_kinematics(seen)
    away, weights = _turned_away(skeleton, positions, float(seen.dt) * every)
    known = {skeleton.joint(role): d for role, d in away.items()}
    carrying = {j for joint in known for j in _path(skeleton, joint)}
    rest: list[Rotation] = []
    for joint, parent in enumerate(skeleton.parents):
        if joint in carrying:  # one that no role has goes with the part below it
            known.setdefault(joint, known.get(parent, away["hips"]))
            turned = known[joint].inv() * Rotation.from_quat(rotations[:, joint], scalar_first=True)
            rest.append(turned.mean(weights.get(skeleton.role_of_joint.get(joint, "hips"), weights["hips"])))
        else:
            rest.append(rest[parent] if parent >= 0 else Rotation.identity())
    local = [rest[j] if p < 0 else rest[p].inv() * rest[j] for j, p in enumerate(skeleton.parents)]
    return np.array([r.as_quat(scalar_first=True) for r in local])


def _turned_away(
    skeleton: Skeleton, positions_world: Float[np.ndarray, "frames joints 3"], dt: float
) -> tuple[dict[str, Rotation], dict[str, Float[np.ndarray, " frames"]]]:
    """Per role how it is turned away from the T-pose in every frame, and how surely, for some roles.

    Joint places give a frame F_t of pelvis, chest, limbs and feet, and anatomy the same frame G in the T-pose: then
    D_t = F_t G^-1. Arms and legs hinge about the axis across their plane, and a foot that stands is level. On the mean
    the head is level, and the joints between turn as those below and above.
    """

    def at(role: str) -> np.ndarray:
        return positions_world[:, skeleton.joint(role)]

    def bone(a: str, b: str) -> np.ndarray:
        return _unit(at(b) - at(a))

    trunk = bone("hips", "chest")
    legs = _unit(bone("left_thigh", "left_foot") + bone("right_thigh", "right_foot"))
    above = [*(r for r, _ in skeleton.roles if r.startswith("neck_")), "head"]
    apart = np.array([np.linalg.norm(at(r) - at("chest"), axis=1).mean() for r in above])
    top = above[int(np.argmax(apart > 0.1 * apart.max()))]  # a neck may begin in the chest's own place
    stands = np.clip(-(trunk * legs).sum(1), 0.01, 1.0) ** 8  # where trunk and legs are in line, the pelvis is too
    weights = {"hips": stands}
    away = {"hips": _frame(bone("right_thigh", "left_thigh"), trunk - legs) * _frame(X, Y).inv(),
            "chest": _frame(bone("chest", top), bone("right_upper_arm", "left_upper_arm")) * _frame(Y, X).inv()}  # fmt: skip
    heading = np.array([1.0, 0.0, 1.0]) * away["chest"].apply(Z)
    away["head"] = _frame(Y, heading) * _frame(Y, Z).inv()
    for role, _ in skeleton.roles:
        if role.startswith("spine_"):
            away[role] = _half_way(away["hips"], away["chest"])
        elif role.startswith("neck_"):
            away[role] = _half_way(away["chest"], away["head"])
        elif role.endswith("_clavicle"):
            away[role] = away["chest"]
    stand_on = _standing([at(f"{s}_foot") for s in SIDES], dt)
    for side, across, stands_on in zip(SIDES, (1.0, -1.0), stand_on, strict=True):
        for upper, lower, end, carrier, along, hinge in (
            (f"{side}_upper_arm", f"{side}_forearm", f"{side}_hand", "chest", across * X, across * ELBOW),
            (f"{side}_thigh", f"{side}_calf", f"{side}_foot", "hips", -Y, X),
        ):
            first, second = bone(upper, lower), bone(lower, end)
            untwisted = _carried(away[carrier].apply(hinge), away[carrier].apply(along), first)
            plane = np.cross(first, second) + NO_HINGE * untwisted
            away[upper], away[lower] = (_frame(b, plane) * _frame(along, hinge).inv() for b in (first, second))
        foot, toe, calf = f"{side}_foot", f"{side}_toe", f"{side}_calf"
        has_toe = skeleton.find(toe) is not None
        if stands_on.max() < SURELY:
            away[foot] = away[calf]  # never seen to stand: on the mean at right angles to the shank
        else:
            ahead = bone(foot, toe) if has_toe else away[calf].apply(Z)
            away[foot], weights[foot] = _frame(Y, ahead) * _frame(Y, Z).inv(), stands_on
        if has_toe:
            away[toe], weights[toe] = away[foot], weights.get(foot, stands)
    return away, weights


def _path(skeleton: Skeleton, joint: int) -> list[int]:
    """A joint and those that carry it."""
    return [] if joint < 0 else [joint, *_path(skeleton, skeleton.parents[joint])]


def _standing(ankles: list[np.ndarray], dt: float) -> list[np.ndarray]:
    """How surely each foot stands, per frame: it is low, and hardly moves."""
    floor = min(np.quantile(a[:, 1], 0.05) for a in ankles)
    speeds = [np.linalg.norm(np.gradient(a, dt, axis=0), axis=1) if len(a) > 1 else np.zeros(1) for a in ankles]
    return [
        np.exp(-((v / STILL) ** 2) - ((a[:, 1] - floor) / LOW) ** 2) + 1e-9 for a, v in zip(ankles, speeds, strict=True)
    ]


def _frame(first: np.ndarray, second: np.ndarray) -> Rotation:
    """The rotations whose first column is along `first` and whose second is towards `second`."""
    first, second = np.broadcast_arrays(np.atleast_2d(first), np.atleast_2d(second))
    x = _unit(first)
    second = second + 1e-6 * ASKEW  # decides where both are along one line
    y = _unit(second - (second * x).sum(-1, keepdims=True) * x)
    return Rotation.from_matrix(np.stack([x, y, np.cross(x, y)], axis=-1))


def _half_way(a: Rotation, b: Rotation) -> Rotation:
    return a * Rotation.from_rotvec(0.5 * (a.inv() * b).as_rotvec())


def _carried(vectors: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Vectors after the smallest rotations that take directions a to directions b, row by row."""
    axis = np.cross(a, b)
    once = np.cross(axis, vectors)
    return vectors + once + np.cross(axis, once) / np.maximum(1.0 + (a * b).sum(-1, keepdims=True), 1e-6)


def _unit(v: np.ndarray) -> np.ndarray:
    """Directions; up for what has none."""
    length = np.linalg.norm(v, axis=-1, keepdims=True)
    return np.where(length > 1e-9, v / np.maximum(length, 1e-9), Y)
