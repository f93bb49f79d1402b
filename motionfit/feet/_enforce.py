"""Footplants enforced by prioritized inverse kinematics: Glardon, Boulic & Thalmann 2006, section 5."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from motionfit._motion import Motion, bind_pose, rest_motion
from motionfit.feet._classics import foot_joints
from motionfit.feet._cycles import Constraint, find_constraints
from motionfit.feet._floor import Floor
from motionfit.feet._knees import calm_knees
from motionfit.feet._leg import Leg, find_legs, leg_kinematics, turned_locals
from motionfit.feet._plants import Footplants
from motionfit.feet._sole import Sole, sole_paths
from motionfit.ik import Task, move_limb, prioritized

EASE = 0.16  # [s] sigma of (9)
KNEE = (0.0, 2.7)  # [rad] how far a knee bends
ANKLE = 1.2  # [rad] how far the ankle may be turned away from the clip, about each of its axes
HIP = 1.0  # [rad] and the hip
REACHED = 1e-4  # [m]
HIPS = 2.0  # [rad/m] price of the hips' giving way (`calm_knees`): heels are held for seconds, and with 1 the whole
# body trembled by half more on a clip of standing on straight legs
RESTING = 0.03  # [m/s] a joint of a standing foot that moves faster does not rest: half a millimetre in 1/60 s


def descending_step(t: Float[np.ndarray, "..."] | float) -> Float[np.ndarray, "..."] | float:
    """The descending cubic step 2t^3 - 3t^2 + 1 of (10), from 1 to 0 over 0..1."""
    t = np.clip(t, 0.0, 1.0)
    return (2 * t - 3) * t * t + 1


def effector_path(
    own: Float[np.ndarray, "frames 3"],
    goals: list[tuple[int, int, Float[np.ndarray, "3"]]],
    ease: int,
    *,
    smooth_speed: bool = True,
) -> Float[np.ndarray, "frames 3"]:
    """The path [m] of an effector that holds each goal (start, end, position) and eases in and out: (9).

    `own` is its original path E_0 and `ease` the frames sigma of an ease, shortened where two constraints are near
    to each other. Printed as it is, (9) arrives with the speed that the original has at t_1 and stops dead;
    `smooth_speed` takes that speed out over the ease, by the cubic with zero ends and that slope.
    """
    path = np.array(own, float)
    frames = len(own)
    slope = np.gradient(own, axis=0) if frames > 1 else np.zeros_like(path)
    for k, (start, end, goal) in enumerate(goals):
        before = start - goals[k - 1][1] if k else start + ease
        after = goals[k + 1][0] - end if k + 1 < len(goals) else frames - 1 - end + ease
        into, out = min(ease, max(before // 2, 1)), min(ease, max(after // 2, 1))
        t = np.arange(max(start - into, 0), start)
        s = ((t - start + into) / into)[:, None]
        path[t] += (1 - descending_step(s)) * (goal - own[start])
        if smooth_speed:
            path[t] -= into * slope[start] * (s**3 - s**2)
        path[start : end + 1] = goal
        t = np.arange(end + 1, min(end + out, frames - 1) + 1)
        s = ((t - end) / out)[:, None]
        path[t] += descending_step(s) * (goal - own[end])
        if smooth_speed:
            path[t] -= out * slope[end] * (s**3 - 2 * s**2 + s)
    return path


class Chain(NamedTuple):
    """One leg from the hip to the toe: world positions and rotations of a frame batch, and the axes of its six
    degrees of freedom: three at the hip, one at the knee, two at the ankle."""

    hip: np.ndarray
    thigh: np.ndarray
    shank: np.ndarray
    foot: np.ndarray  # ankle to toe
    knee_axis: np.ndarray
    ankle_axes: np.ndarray  # (frames, 2, 3)


class Pose(NamedTuple):
    """A chain at some values: how thigh, shank and foot are turned from the clip's pose on, where knee, ankle and
    toe are [m], and how the turns of hip, knee and ankle change with their rotation vectors."""

    turns: Float[np.ndarray, "3 batch 3 3"]
    knee: Float[np.ndarray, "batch 3"]
    ankle: Float[np.ndarray, "batch 3"]
    toe: Float[np.ndarray, "batch 3"]
    changes: Float[np.ndarray, "3 batch 3 3"]


def chain_pose(chain: Chain, values: Float[np.ndarray, "batch 6"]) -> Pose:
    """The chain's pose: three values are the hip's rotation vector, one bends the knee, two turn the ankle."""
    ankle = np.einsum("fk,fka->fa", values[:, 4:6], chain.ankle_axes)
    (upper, bend, end), changes = _exponential(np.stack([values[:, :3], values[:, 3:4] * chain.knee_axis, ankle]))
    lower = upper @ bend
    turns = np.stack([upper, lower, lower @ end])
    bones = turns @ np.stack([chain.thigh, chain.shank, chain.foot])[..., None]
    knee, ankle, toe = chain.hip + np.cumsum(bones[..., 0], axis=0)
    return Pose(turns, knee, ankle, toe, changes)


def _exponential(
    vectors: Float[np.ndarray, "... 3"],
) -> tuple[Float[np.ndarray, "... 3 3"], Float[np.ndarray, "... 3 3"]]:
    """Rotation matrices of rotation vectors (Rodrigues), and how they turn, in the frame that they turn into, when the
    vectors change."""
    squared = np.einsum("...a,...a->...", vectors, vectors)[..., None, None]
    small = squared < 1e-8
    angle = np.sqrt(np.where(small, 1.0, squared))
    first = np.where(small, 1.0 - squared / 6, np.sin(angle) / angle)
    second = np.where(small, 0.5 - squared / 24, (1 - np.cos(angle)) / angle**2)
    third = np.where(small, 1 / 6 - squared / 120, (angle - np.sin(angle)) / angle**3)
    cross = np.zeros((*vectors.shape, 3))
    x, y, z = np.moveaxis(vectors, -1, 0)
    cross[..., 2, 1], cross[..., 0, 2], cross[..., 1, 0] = x, y, z
    cross = cross - np.swapaxes(cross, -1, -2)
    twice = cross @ cross
    return np.eye(3) + first * cross + second * twice, np.eye(3) + second * cross + third * twice


def chain_effectors(
    chain: Chain, values: Float[np.ndarray, "batch 6"]
) -> tuple[Float[np.ndarray, "effectors batch 3"], Float[np.ndarray, "effectors batch 3 6"]]:
    """Where ankle and toe are [m], and how the six values move them."""
    pose = chain_pose(chain, values)
    upper, lower = pose.turns[:2]
    points = np.stack([pose.ankle, pose.toe])
    # world axes of the six values, in columns, each through its joint
    axes = np.concatenate([pose.changes[0], upper @ chain.knee_axis[..., None],
                           lower @ pose.changes[2] @ np.swapaxes(chain.ankle_axes, 1, 2)], axis=2)  # fmt: skip
    joints = np.stack([chain.hip] * 3 + [pose.knee] + [pose.ankle] * 2, axis=2)
    jacobians = np.cross(axes, points[..., None] - joints, axis=-2)
    jacobians[0, ..., 4:] = 0.0  # the ankle is not moved by its own turns
    return points, jacobians


def chain_tasks(chain: Chain, goals: list[Float[np.ndarray, "batch 3"]]) -> list[Task]:
    """Ankle first, then toe: errors [m] and Jacobians of the chain's values."""
    last: list = [None, None]  # both tasks are asked for the same values in turn: their kinematics is done once

    def task_of(part: int) -> Task:
        def task(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
            if last[0] is None or not np.array_equal(last[0], values):
                last[:] = values.copy(), chain_effectors(chain, values)
            points, jacobians = last[1]
            return goals[part] - points[part], jacobians[part]

        return task

    return [task_of(part) for part in range(len(goals))]


def enforce(
    base: Motion, sole: Sole, plants: Footplants, floor: Floor
) -> tuple[Motion, Bool[np.ndarray, "frames 2"], dict[str, float]]:
    """Heel and toe of both feet held where adaptive thresholds find them constrained.

    Per leg a chain of six degrees of freedom from hip to toe and two positional effectors: the ankle first, then
    the toe, by prioritized inverse kinematics with damping and joint limits (5.1). Their paths are (9). A goal is
    the effector's mean place over its constraint (the source takes the one at its beginning). Where only one of both
    is held the other's path is drawn to the foot's length from it, so that both can be met.

    The source's cycles do not skate; a clip may, and a goal that its foot only slides through would make it slide
    more. So `base` is a motion whose planted feet stand still already (`with_leg_ik`), and only a joint that is
    at rest there (`RESTING`) is held: a foot rolls over its heel and toes as before.

    Returns the motion, which heels could be brought to their goals, and details.
    """
    skeleton, dt = base.skeleton, float(base.dt)
    positions, rotations = leg_kinematics(base)
    joints = foot_joints(skeleton)
    standing = bind_pose(skeleton)[0][:, 1] - sole_paths(sole, rest_motion(skeleton))[0, :, 1].min()
    constraints = find_constraints(base, floor, plants=plants.plants, standing=standing, resting=RESTING)
    ease = max(1, round(EASE / dt))
    paths, goals = [], []
    for side, mine in enumerate(joints):
        goals.append(_goals([c for c in constraints if c.foot == side], mine, positions, ease))
        paths.append([effector_path(positions[:, j], goals[side][part], ease) for part, j in enumerate(mine)])
        if len(mine) == 2:
            _keep_foot_length(
                paths[side][0], paths[side][1], goals[side], positions[:, mine[1]] - positions[:, mine[0]], ease
            )
    legs = find_legs(skeleton, positions, rotations)
    # a heel that is held leaves the tremor of its leg to the knee: the hips take some of it
    move = calm_knees([path[0] - leg.hip for path, leg in zip(paths, legs, strict=True)],
                      [leg.ankle - leg.hip for leg in legs], [leg.bones for leg in legs], dt, HIPS)  # fmt: skip
    positions, legs = positions + move[:, None], [leg.moved(move) for leg in legs]
    local, reachable = np.array(base.rotations, float), np.ones((base.frame_count, 2), bool)
    worst = [0.0, 0.0]
    for side, (mine, leg) in enumerate(zip(joints, legs, strict=True)):
        errors = _turn_leg(base, leg, mine, positions, rotations, paths[side], local)
        for part, error in enumerate(errors):
            for start, end, _ in goals[side][part]:
                worst[part] = max(worst[part], float(error[start : end + 1].max()))
                if part == 0:
                    reachable[start : end + 1, side] = error[start : end + 1] < REACHED
    details = {"constraints": float(sum(len(part) for side in goals for part in side)),
               "ankle_error_max_m": worst[0], "toe_error_max_m": worst[1]}  # fmt: skip
    root, before = np.asarray(base.root), np.asarray(base.rotations)
    moved = Motion(skeleton, (root + move).astype(root.dtype), local.astype(before.dtype), base.dt, base.translations)
    return moved, reachable, details


Goal = tuple[int, int, np.ndarray]


def _goals(
    constraints: list[Constraint],
    joints: tuple[int, ...],
    positions: np.ndarray,
    ease: int,
) -> list[list[Goal]]:
    """Per effector of a foot the goals (start, end, position), in order and at least an ease apart."""
    goals: list[list[Goal]] = []
    for part, joint in enumerate(joints):
        found: list[Goal] = []
        for c in sorted((c for c in constraints if c.part == part), key=lambda c: c.start):
            start = c.start if not found else max(c.start, found[-1][1] + ease)
            if start > c.end:
                continue
            goal = positions[start : c.end + 1, joint].mean(0)
            end = c.end
            if part == 1:
                heels = [(a, g) for a, b, g in goals[0] if a <= c.end and b >= start]
                # a heel that comes down elsewhere takes the toe along
                end = min([end, *(a - ease for a, _ in heels[1:])])
                if end < start:
                    continue
                if heels:
                    heel = heels[0][1]
                    # held together, they are as far apart as the foot is long
                    length = np.linalg.norm(positions[start, joint] - positions[start, joints[0]])
                    away = (goal - heel) * [1.0, 0.0, 1.0]
                    level = np.sqrt(max(length**2 - (goal[1] - heel[1]) ** 2, 0.0))
                    goal = heel + away * level / max(np.linalg.norm(away), 1e-9) + [0.0, goal[1] - heel[1], 0.0]
            found.append((start, end, goal))
        goals.append(found)
    return goals


def _keep_foot_length(ankle: np.ndarray, toe: np.ndarray, goals: list[list[Goal]], foot: np.ndarray, ease: int) -> None:
    """Draw the path of the effector that is not held to the foot's length from the other one, in place.

    Where the toe alone is held the ankle gives way; before (if it lands first) and after, the ankle comes back to its
    own path within an ease. Everywhere else the toe gives way.
    """
    frames, length = np.arange(len(ankle)), np.linalg.norm(foot, axis=1, keepdims=True)
    held = [np.zeros(len(ankle), bool) for _ in goals]
    for mask, mine in zip(held, goals, strict=True):
        for start, end, _ in mine:
            mask[start : end + 1] = True
    share = np.zeros(len(ankle))
    for start, end, _ in goals[1]:
        # where a heel is held again before an ease is over there is less time: it does not wait for the ankle
        before = max([b for _, b, _ in goals[0] if b < start], default=-ease)
        after = min([a for a, _, _ in goals[0] if a > end], default=len(ankle) + ease)
        into, out = min(ease, start - before), min(ease, after - end)
        early = (start - frames) / into if not held[0][start] else np.where(frames < start, 1.0, 0.0)
        share = np.maximum(share, descending_step(np.maximum(np.maximum(early, (frames - end) / out), 0.0)))
    share[held[0]] = 0.0

    def away() -> np.ndarray:
        apart = toe - ankle
        return apart * length / np.maximum(np.linalg.norm(apart, axis=1, keepdims=True), 1e-9)

    ankle += share[:, None] * (toe - away() - ankle)
    toe[~held[1]] = (ankle + away())[~held[1]]


def _turn_leg(
    base: Motion, leg: Leg, joints: tuple[int, ...], positions: np.ndarray, rotations: np.ndarray,
    paths: list[np.ndarray], local: np.ndarray,
) -> list[Float[np.ndarray, " frames"]]:  # fmt: skip
    """Bring a leg's effectors to their paths; writes joint rotations into `local`, returns the errors left [m]."""
    foot = positions[:, joints[1]] - leg.ankle if len(joints) == 2 else np.zeros_like(leg.ankle)
    forward = foot / np.maximum(np.linalg.norm(foot, axis=1, keepdims=True), 1e-9)
    side = leg.lateral - np.einsum("fa,fa->f", leg.lateral, forward)[:, None] * forward
    side /= np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    chain = Chain(leg.hip, leg.knee - leg.hip, leg.ankle - leg.knee, foot, leg.lateral,
                  np.stack([side, np.cross(forward, side)], axis=1))  # fmt: skip
    bent = np.arctan2(np.einsum("fa,fa->f", np.cross(chain.thigh, chain.shank), leg.lateral),
                      np.einsum("fa,fa->f", chain.thigh, chain.shank))  # fmt: skip
    lower = np.tile([-HIP] * 3 + [0.0] + [-ANKLE] * 2, (len(bent), 1))
    upper = -lower
    # a knee that the clip has bent further, or the other way, may stay so
    lower[:, 3], upper[:, 3] = np.minimum(KNEE[0] - bent, 0.0), np.maximum(KNEE[1] - bent, 0.0)
    values = np.zeros((len(bent), 6))
    # frames in which every effector already is where it should be are left alone, bit for bit
    busy = np.max([np.abs(path - positions[:, j]).max(1) for path, j in zip(paths, joints, strict=True)], 0) > 1e-12
    if busy.any():
        some = Chain(*(x[busy] for x in chain))
        # the analytic leg is the start: from a straight knee no gradient says which way to bend
        found = move_limb(leg.hip[busy], leg.knee[busy], leg.ankle[busy], paths[0][busy], leg.lateral[busy])
        values[busy, :3] = found.upper.as_rotvec()
        knee = (found.upper.inv() * found.lower).as_rotvec()
        values[busy, 3] = np.einsum("fa,fa->f", knee, some.knee_axis)
        values[busy] = prioritized(chain_tasks(some, [p[busy] for p in paths]), values[busy], lower=lower[busy],
                                   upper=upper[busy], tolerance=1e-2 * REACHED)  # fmt: skip
        thigh, shank, foot = (Rotation.from_matrix(turn) for turn in chain_pose(some, values[busy]).turns)
        # without a toe nothing says how the foot should turn: it keeps its way
        turns = thigh, shank, foot if len(joints) == 2 else None
        turned = turned_locals(base.skeleton, rotations[busy], local[busy], leg.joints, turns)
        for joint, quaternion in zip(leg.joints, turned, strict=True):
            local[busy, joint] = quaternion
    pose = chain_pose(chain, values)
    return [np.linalg.norm(path - end, axis=1) for path, end in zip(paths, (pose.ankle, pose.toe), strict=False)]
