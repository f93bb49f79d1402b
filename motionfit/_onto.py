"""Put a clip on another skeleton: by roles, through the bind poses' world orientations."""

import numpy as np
from jaxtyping import Float
from scipy.spatial.transform import Rotation

from motionfit._motion import Motion, bind_pose, host_kinematics
from motionfit._skeleton import SIDES, Skeleton

# what both skeletons must have
REQUIRED = ("hips", *(f"{s}_{r}" for s in SIDES for r in ("thigh", "calf", "foot", "upper_arm", "forearm")))
UP, SIDE = np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0])


def onto(motion: Motion, skeleton: Skeleton) -> Motion:
    """The motion as another skeleton would do it.

    Equal joint names do not mean equal bone axes or rest poses, so local rotations are never copied. A joint with
    a role turns in the world as the same role does in the clip, away from the rest pose: Q = D A Q_bind, where
    D = Q_clip Q_clip_rest^-1 and A is the smallest rotation that lays the character's bind bone along the clip's
    rest bone (a T-pose clip on an A-pose character). The trunk, neck and head stand upright in both and take
    A = 1, the foot only its yaw, so that soles stay flat; hands and toes go on like the bone before them. Joints
    that only one side has stay at bind. The path of the hips is scaled with the leg length.

    A skeleton that is truly the same gets the motion back bit for bit.
    """
    source = motion.skeleton
    if source is skeleton:
        return motion
    if source.is_same(skeleton):
        return Motion(skeleton, motion.root, motion.rotations, motion.dt, motion.translations)
    source.require(*REQUIRED)
    skeleton.require(*REQUIRED)

    clip_positions, clip_rest = bind_pose(source)
    positions, bind_quaternions = bind_pose(skeleton)
    # turn the character's bind pose to face the way that the clip's rest pose faces
    heading = between(_facing(skeleton, positions), _facing(source, clip_positions))
    positions = heading.apply(positions)
    bind = heading * Rotation.from_quat(bind_quaternions, scalar_first=True)

    frames = motion.frame_count
    clip_path, world = host_kinematics(motion)
    rest = Rotation.from_quat(clip_rest, scalar_first=True)
    away = [Rotation.from_quat(world[:, j], scalar_first=True) * rest[j].inv() for j in range(world.shape[1])]  # D
    align = _alignments(source, clip_positions, skeleton, positions)
    targets = _targets(source, skeleton, away)

    rest_local = Rotation.from_quat(np.asarray(skeleton.rest_rotations, float), scalar_first=True)
    local = np.empty((frames, len(skeleton.names), 4))
    turned: list[Rotation] = []
    for joint, parent in enumerate(skeleton.parents):
        above = turned[parent] if parent >= 0 else Rotation.identity(frames)
        if joint in targets:
            laid = align.get(skeleton.nearest_role(joint), Rotation.identity()) * bind[joint]
            turned.append(targets[joint] * laid)
            local[:, joint] = (above.inv() * turned[joint]).as_quat(scalar_first=True)
        else:
            local[:, joint] = rest_local[joint].as_quat(scalar_first=True)
            turned.append(above * rest_local[joint])
    path = _hips_path(source, clip_path[:, source.joint("hips")], clip_positions, skeleton, positions)
    if (hips := skeleton.joint("hips")) != 0:  # under a root on the floor, as in game rigs
        path = path - host_kinematics(Motion(skeleton, np.zeros_like(path), local, motion.dt))[0][:, hips]
    return Motion(skeleton, path, local, motion.dt)


def leg_length(skeleton: Skeleton, positions: Float[np.ndarray, "joints 3"] | None = None) -> float:
    """Mean length [m] of thigh and calf together."""
    if positions is None:
        positions = bind_pose(skeleton)[0]
    total = 0.0
    for side in SIDES:
        thigh, calf, foot = (positions[skeleton.joint(f"{side}_{r}")] for r in ("thigh", "calf", "foot"))
        total += np.linalg.norm(calf - thigh) + np.linalg.norm(foot - calf)
    return float(total / 2)


def between(a: np.ndarray, b: np.ndarray) -> Rotation:
    """The smallest rotation that takes direction a to direction b."""
    a, b = (v / max(float(np.linalg.norm(v)), 1e-12) for v in (a, b))
    axis = np.cross(a, b)
    sine, cosine = float(np.linalg.norm(axis)), float(a @ b)
    if sine < 1e-12:
        # the same direction, or the opposite one: then half a turn about the vertical, or about x for verticals
        return Rotation.identity() if cosine > 0 else Rotation.from_rotvec(np.pi * (UP if abs(a[1]) < 0.9 else SIDE))
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine))


def _facing(skeleton: Skeleton, positions: np.ndarray) -> np.ndarray:
    """The horizontal direction that the rest pose faces: (left - right) x up."""
    across = sum(
        positions[skeleton.joint(f"left_{r}")] - positions[skeleton.joint(f"right_{r}")] for r in ("thigh", "upper_arm")
    )
    forward = np.cross(across, UP)
    return forward / max(float(np.linalg.norm(forward)), 1e-9)


def _bone(skeleton: Skeleton, positions: np.ndarray, role: str) -> np.ndarray | None:
    following = {"upper_arm": "forearm", "forearm": "hand", "thigh": "calf", "calf": "foot", "foot": "toe"}
    side, _, kind = role.partition("_")
    joint, end = skeleton.find(role), skeleton.find(f"{side}_{following[kind]}")
    return None if joint is None or end is None else positions[end] - positions[joint]


def _alignments(
    source: Skeleton, clip_positions: np.ndarray, skeleton: Skeleton, positions: np.ndarray
) -> dict[str | None, Rotation]:
    """A per role: lays the character's bind bone along the clip's rest bone."""
    align: dict[str | None, Rotation] = {}
    for side in SIDES:
        for kind, heir in (
            ("upper_arm", None), ("forearm", "hand"), ("thigh", None), ("calf", None), ("foot", "toe")
        ):  # fmt: skip
            role = f"{side}_{kind}"
            mine, theirs = _bone(skeleton, positions, role), _bone(source, clip_positions, role)
            if mine is None or theirs is None:
                continue
            if kind == "foot":
                mine, theirs = (v * np.array([1.0, 0.0, 1.0]) for v in (mine, theirs))
            align[role] = between(mine, theirs)
            if heir:
                align[f"{side}_{heir}"] = align[role]
    return align


def _targets(source: Skeleton, skeleton: Skeleton, away: list[Rotation]) -> dict[int, Rotation]:
    """Joint of the character -> how it turns away from rest in the world, frame by frame."""
    targets: dict[int, Rotation] = {}
    for role, joint in skeleton.roles:
        if (match := source.find(role)) is not None and not role.startswith(("spine_", "neck_")):
            targets[joint] = away[match]
    for kind in ("spine", "neck"):
        mine, theirs = skeleton.chain(kind), source.chain(kind)
        for k, joint in enumerate(mine):
            if not theirs:
                continue
            # chains of different length share their turn evenly; their tops agree
            place = (k + 1) / len(mine) * len(theirs) - 1
            below, share = int(np.floor(max(place, 0.0))), max(place, 0.0) % 1
            low, high = away[theirs[below]], away[theirs[min(below + 1, len(theirs) - 1)]]
            targets[joint] = low * Rotation.from_rotvec(share * (low.inv() * high).as_rotvec())
    known = set(targets)
    names = {name.casefold(): j for j, name in enumerate(source.names)}
    for joint, name in enumerate(skeleton.names):
        # fingers and other joints without a role that both have; they follow the alignment of their limb
        match = names.get(name.casefold())
        if (
            joint not in known
            and match is not None
            and match not in source.role_of_joint
            and skeleton.parents[joint] >= 0
        ):
            targets[joint] = away[match]
    return targets


def _hips_path(
    source: Skeleton, clip_path_world: Float[np.ndarray, "frames 3"], clip_positions: Float[np.ndarray, "clip_joints 3"],
    skeleton: Skeleton, positions: Float[np.ndarray, "joints 3"],
) -> Float[np.ndarray, "frames 3"]:  # fmt: skip
    """The path [m] of the clip's hips scaled with the leg length, its height measured between hip joints and ankles."""
    scale = leg_length(skeleton, positions) / leg_length(source, clip_positions)

    def above_leg(s: Skeleton, p: np.ndarray) -> float:
        """What of the hips' height is not leg: hips over the hip joints, ankle over the lowest toe."""
        feet = [s.joint(f"{side}_foot") for side in SIDES]
        toes = [j for side in SIDES if (j := s.find(f"{side}_toe")) is not None] or feet
        joints = np.mean([p[s.joint(f"{side}_thigh")][1] for side in SIDES])
        return float(p[s.joint("hips")][1] - joints + np.mean(p[feet, 1]) - np.min(p[toes, 1]))

    path = clip_path_world * scale
    path[:, 1] += above_leg(skeleton, positions) - scale * above_leg(source, clip_positions)
    return path
