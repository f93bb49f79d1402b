"""The labellings that others use, to compare with: fixed thresholds, and Lyard's dot product."""

import numpy as np
from jaxtyping import Bool, Float

from motionfit._motion import Motion, bind_pose
from motionfit._skeleton import SIDES, Skeleton
from motionfit.feet._detect import Evidence, smooth, velocity
from motionfit.feet._sole import Sole, chain_kinematics


def foot_joints(skeleton: Skeleton) -> list[tuple[int, ...]]:
    """Ankle and, where there is one, toe joint of each foot."""
    if "foot_joints" not in skeleton.memo:
        joints = []
        for side in SIDES:
            toe = skeleton.find(f"{side}_toe")
            joints.append((skeleton.joint(f"{side}_foot"), *(() if toe is None else (toe,))))
        skeleton.memo["foot_joints"] = joints
    return skeleton.memo["foot_joints"]


def leg_joints(skeleton: Skeleton) -> list[tuple[int, int, int]]:
    """Hip, knee and ankle joint of each leg."""
    if "leg_joints" not in skeleton.memo:
        joint = skeleton.joint
        skeleton.memo["leg_joints"] = [(joint(f"{s}_thigh"), joint(f"{s}_calf"), joint(f"{s}_foot")) for s in SIDES]
    return skeleton.memo["leg_joints"]


def fixed_thresholds(motion: Motion, *, height: float = 0.05, speed: float = 0.5) -> Bool[np.ndarray, "frames 2"]:
    """A foot is down where its ankle or its toe joint is lower than `height` [m] over where it is in the bind pose,
    and slower than `speed` [m/s]. Lee et al. 2002, Menardais et al. 2004 (Glardon 2006, 4.1); the floor is y = 0."""
    joints = foot_joints(motion.skeleton)
    bind = bind_pose(motion.skeleton)[0]
    world = chain_kinematics(motion, tuple(j for foot in joints for j in foot))
    planted = np.zeros((motion.frame_count, 2), bool)
    for foot, mine in enumerate(joints):
        for joint in mine:
            place = world[joint][1]
            moving = np.linalg.norm(velocity(place, float(motion.dt)), axis=1)
            planted[:, foot] |= (place[:, 1] - bind[joint, 1] < height) & (moving < speed)
    return planted


def dot_product(
    sole: Sole, evidence: Evidence, root: Float[np.ndarray, "frames 3"], dt: float
) -> Bool[np.ndarray, "frames 2"]:
    """Lyard 2007, 3.1.1 and 3.1.2: always one foot, whose planted vertex would move the root most as it did move.

    With v_i planted at t, each candidate v_j gives the displacement (3.1) for delta = 1/2, with positions halfway
    by linear interpolation; the foot of the one with the largest dot product of directions is down at t+1, and on
    that foot the vertex of least speed, smoothed over five frames, is the next v_i. The first frame by speed alone.
    """
    frames = len(root)
    offsets = evidence.paths_world - root[:, None]
    speed = smooth(np.linalg.norm(velocity(evidence.paths_world, dt), axis=-1), 5)
    half = 0.5 * (offsets[:-1] - offsets[1:])
    way = np.diff(root, axis=0)
    way = way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-12)
    feet = [sole.of(0), sole.of(1)]
    current = int(speed[0].argmin())
    planted = np.zeros((frames, 2), bool)
    planted[0, sole.side[current]] = True
    for t in range(frames - 1):
        induced = half[t, current] + half[t]
        p = induced @ way[t] / np.maximum(np.sqrt(np.einsum("sa,sa->s", induced, induced)), 1e-12)
        foot = sole.side[p.argmax()]
        mine = feet[foot]
        current = int(mine[speed[t + 1, mine].argmin()])
        planted[t + 1, foot] = True
    return planted
