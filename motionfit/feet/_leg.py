"""Footskate removal with the legs: thesis 3.2. The hierarchy starts at the planted foot, the legs do the rest.

Where the foot on the ground changes, the new one is put on the ground where it is, and from there on the hip follows
from it (figure 3.7, algorithm of 3.2.1). The hip's path is that of the root method, low-passed; each foot is then
brought exactly to where it stands by the analytic leg of appendix C, and between two plants the leg's correction
passes over smoothly from one to the next.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import distance_transform_edt, gaussian_filter1d, maximum_filter1d
from scipy.sparse import csr_array, diags_array, eye_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

from motionfit._motion import CONJUGATE, Motion, bind_pose, host_kinematics, host_product
from motionfit._skeleton import Skeleton
from motionfit.feet._classics import foot_joints, leg_joints
from motionfit.feet._detect import smooth
from motionfit.feet._floor import Floor
from motionfit.feet._knees import calm_knees
from motionfit.feet._plants import Footplants, runs
from motionfit.feet._root import horizontal_path, root_steps
from motionfit.feet._sole import Sole, sole_paths
from motionfit.ik import move_limb

CALM = 0.25  # [s] over which the root's correction is averaged, twice: the legs take the rest
EASE = 0.12  # [s] within which a foot comes to rest and leaves again: half of what the move's curve takes
EVEN = 0.1  # [s] sigma over which the height of a standing sole is averaged: its noise would go to the knee, and a
# foot that is still coming down when its plant begins comes to rest as it did, instead of at once
TREMOR = 0.06  # [s] over which the rotation of a standing foot is averaged
EXACT = 1e-7  # [m] to which the vertices that stand are brought to their places
STRETCH = 0.99  # of a leg's length: near the end the knee turns by degrees for a millimetre at the foot
LOWEST = 0.1  # of a leg's length, as far as the character is lowered for the legs' sake


class Leg(NamedTuple):
    """Joints of one leg and, per frame, where they are in the world [m], with the knee's axis."""

    joints: tuple[int, int, int]
    hip: Float[np.ndarray, "frames 3"]
    knee: Float[np.ndarray, "frames 3"]
    ankle: Float[np.ndarray, "frames 3"]
    lateral: Float[np.ndarray, "frames 3"]

    @property
    def bones(self) -> tuple[Float[np.ndarray, " frames"], Float[np.ndarray, " frames"]]:
        """Lengths of thigh and shank [m]."""
        return np.linalg.norm(self.knee - self.hip, axis=1), np.linalg.norm(self.ankle - self.knee, axis=1)

    @property
    def length(self) -> Float[np.ndarray, " frames"]:
        thigh, shank = self.bones
        return thigh + shank

    def moved(self, by: Float[np.ndarray, "frames 3"]) -> "Leg":
        """The leg somewhere else, turned as it is."""
        return self._replace(hip=self.hip + by, knee=self.knee + by, ankle=self.ankle + by)


def hip_from_foot(
    motion: Motion, joint: int, place_world: Float[np.ndarray, "frames 3"], turn_world: Float[np.ndarray, "frames 4"]
) -> tuple[Float[np.ndarray, "frames 3"], Float[np.ndarray, "frames 4"]]:
    """Root position [m] and rotation for which a joint is where and turned as it should be: figure 3.7, the hierarchy
    that starts at a foot. No joint is turned against its neighbour.

    With the joint's own world rotation (`currentRotation` of the algorithm in 3.2.1) the root keeps its rotation,
    and moves by as much as the foot has to.
    """
    positions, rotations = host_kinematics(motion)
    root, foot = (Rotation.from_quat(rotations[:, j], scalar_first=True) for j in (0, joint))
    turned = Rotation.from_quat(turn_world, scalar_first=True) * foot.inv()
    place = place_world + turned.apply(positions[:, 0] - positions[:, joint])
    return place, (turned * root).as_quat(scalar_first=True)


def leg_kinematics(
    motion: Motion,
) -> tuple[Float[np.ndarray, "frames joints 3"], Float[np.ndarray, "frames joints 4"]]:
    """World positions [m] and rotations of the joints from the root to the toes, NaN elsewhere: a third of the work."""
    return host_kinematics(motion, [joint for foot in foot_joints(motion.skeleton) for joint in foot])


def find_legs(skeleton: Skeleton, positions: np.ndarray, rotations: np.ndarray) -> list[Leg]:
    """Both legs of a motion whose world kinematics are given. The knee's axis is the one about which the shank bends
    over the clip, fixed in the thigh; a leg that never bends takes the character's left-right axis at bind."""
    legs = []
    for joints in leg_joints(skeleton):
        hip, knee, ankle = (positions[:, j] for j in joints)
        turn = Rotation.from_quat(rotations[:, joints[0]], scalar_first=True)
        bend = turn.inv().apply(np.cross(knee - hip, ankle - knee)).sum(0)
        if np.linalg.norm(bend) < 0.02 * np.sum(
            np.linalg.norm(knee - hip, axis=1) * np.linalg.norm(ankle - knee, axis=1)
        ):
            bind = Rotation.from_quat(bind_pose(skeleton)[1][joints[0]], scalar_first=True)
            bend = bind.inv().apply([1.0, 0.0, 0.0])
        legs.append(Leg(joints, hip, knee, ankle, turn.apply(bend / np.linalg.norm(bend))))
    return legs


def stay(
    paths: Float[np.ndarray, "frames soles 3"],
    rows: Int[np.ndarray, "frames 2"],
    speed: Float[np.ndarray, "frames soles"],
    sole: Sole,
    dt: float,
) -> Float[np.ndarray, "frames 2 3"]:
    """How far [m] each foot must move horizontally in each frame so that the vertex stood on keeps its place in a
    plant. The place, and the moves between two plants, are those of the calmest way near to the foot's own."""
    moves = np.zeros((len(paths), 2, 3))
    for foot in (0, 1):
        plants = runs(rows[:, foot] >= 0)
        if plants:
            steps = root_steps(paths, rows[:, foot], speed, sole.side)[0][:, [0, 2]]
            held = np.zeros((len(paths), 2))
            for start, end in plants:
                held[start + 1 : end + 1] = np.cumsum(steps[start:end], axis=0)
            moves[:, foot, [0, 2]] = pass_over(held, plants, dt, anywhere=True)
    return moves


def hold_feet(
    paths: Float[np.ndarray, "frames soles 3"],
    rows: Int[np.ndarray, "frames 2"],
    speed: Float[np.ndarray, "frames soles"],
    sole: Sole,
    floor: Floor,
    dt: float,
) -> Float[np.ndarray, "frames 2 3"]:
    """How far [m] each foot must move in each frame so that it stands still, on the floor, while it is planted.

    In a plant the vertex stood on keeps its horizontal place (`stay`) and the foot's lowest vertex, its height averaged
    over a moment, is on the floor. Between two plants the move goes over from one to the other, with the speeds that
    the foot needs to come to rest, and a swinging sole is led over the floor.
    """
    moves = stay(paths, rows, speed, sole, dt)
    for foot in (0, 1):
        planted, move = rows[:, foot] >= 0, moves[:, foot]
        lowest, plants = floor.above(paths[:, sole.of(foot)]).min(1), runs(planted)
        for start, end in plants:
            level = gaussian_filter1d(lowest[start : end + 1], EVEN / dt, mode="nearest")
            move[start : end + 1, 1] = floor.at(move[start : end + 1]) - floor.height - level
        if plants:
            move[:, [1]] = pass_over(move[:, [1]], plants, dt, anywhere=False)
            move[:, 1] += _clearing(lowest + move[:, 1], planted, dt)
    return moves


def _clearing(
    heights: Float[np.ndarray, " frames"], planted: Bool[np.ndarray, " frames"], dt: float
) -> Float[np.ndarray, " frames"]:
    """How much [m] a swinging foot is raised so that it does not go under the floor: as a smooth curve over what each
    frame asks for, which ends where the foot is planted. A bound in every frame would be a knee's snap."""
    needed = np.where(planted, 0.0, np.maximum(-heights, 0.0))
    if not needed.any():
        return needed
    width = 2 * max(1, round(0.5 * EASE / dt)) + 1
    raised = smooth(smooth(maximum_filter1d(needed, 2 * width - 1, mode="nearest"), width), width)
    near = np.asarray(distance_transform_edt(~planted)) if planted.any() else np.full(len(planted), np.inf)
    s = np.clip(near * dt / EASE, 0.0, 1.0)
    return raised * (3 * s**2 - 2 * s**3)


def pass_over(
    moves: Float[np.ndarray, "frames k"], plants: list[tuple[int, int]], dt: float, *, anywhere: bool
) -> Float[np.ndarray, "frames k"]:
    """The moves [m] of all frames, given those of the frames with a plant, start to end.

    The one of least sum |m|^2 + EASE^4 |m''|^2: as near to the foot's own path as it is calm, so that it comes to rest
    and leaves with the speed that it has, and goes from one plant to the next. `anywhere` leaves open where each
    plant is, so that only the steps inside it are given: plants with little time between them come together.
    """
    given = np.zeros(moves.shape)
    for start, end in plants:
        given[start : end + 1] = moves[start : end + 1]
    share, cost, solve = _calmest_way(len(moves), tuple(plants), dt, anywhere)
    return given if solve is None else given - share @ solve(share.T @ (cost @ given))


@functools.lru_cache(maxsize=4)
def _calmest_way(frames: int, plants: tuple[tuple[int, int], ...], dt: float, anywhere: bool):
    """What `pass_over` solves, for both feet: it is asked again where a sole that hangs on the shank is brought nearer.
    Which unknown each frame takes part in, the cost's matrix, and the solution; None where nothing is open."""
    own = np.ones(frames, bool)
    for start, end in plants:
        own[start : end + 1] = False
        own[start] = anywhere  # one unknown for the whole plant
    open_frames = np.arange(frames) if anywhere else np.flatnonzero(own)
    share = csr_array((np.ones(len(open_frames)), (open_frames, (np.cumsum(own) - 1)[open_frames])),
                      shape=(frames, int(own.sum())))  # fmt: skip
    cost = eye_array(frames, format="csr")
    if frames > 2:
        bend = diags_array([1.0, -2.0, 1.0], offsets=[0, 1, 2], shape=(frames - 2, frames))  # pyright: ignore[reportArgumentType]: SciPy's stub
        cost = cost + (EASE / dt) ** 4 * (bend.T @ bend)
    return share, cost, splu((share.T @ cost @ share).tocsc()).solve if own.any() else None


def lowering(
    legs: list[Leg], targets: list[Float[np.ndarray, "frames 3"]], dt: float,
    reaches: list[Float[np.ndarray, " frames"]] | None = None,
) -> Float[np.ndarray, " frames"]:  # fmt: skip
    """How far [m] the character must come down so that both legs reach, as a smooth curve over what each frame asks
    for: the largest demand within the ease, averaged twice (thesis 5.5.1 lowers by one small amount). `reaches` [m] are
    those of each leg, nearly their lengths by default."""
    reaches = [STRETCH * leg.length for leg in legs] if reaches is None else reaches
    needed = np.zeros(len(legs[0].hip))
    for leg, target, reach in zip(legs, targets, reaches, strict=True):
        gap = leg.hip - target
        up = np.sqrt(np.maximum(reach**2 - gap[:, 0] ** 2 - gap[:, 2] ** 2, 0.0))
        needed = np.maximum(needed, np.minimum(gap[:, 1] - up, LOWEST * leg.length))
    if not needed.any():
        return needed
    width = 2 * max(1, round(EASE / dt)) + 1
    # the mean of a maximum over twice the width never falls below the demand
    return smooth(smooth(maximum_filter1d(needed, 2 * width - 1, mode="nearest"), width), width)


def turn_legs(
    motion: Motion, legs: list[Leg], targets: list[Float[np.ndarray, "frames 3"]], rotations: np.ndarray
) -> tuple[Float[np.ndarray, "frames joints 4"], Bool[np.ndarray, "frames 2"]]:
    """Joint rotations with each ankle at its target and the feet's world rotations kept; which targets were reached."""
    skeleton, local = motion.skeleton, np.array(motion.rotations, float)
    reachable = np.ones((motion.frame_count, 2), bool)

    for side, (leg, target) in enumerate(zip(legs, targets, strict=True)):
        found = move_limb(leg.hip, leg.knee, leg.ankle, target, leg.lateral)
        reachable[:, side] = found.reachable
        moved = np.linalg.norm(target - leg.ankle, axis=1) > 0
        turned = turned_locals(skeleton, rotations, local, leg.joints, (found.upper, found.lower, None))
        for joint, quaternion in zip(leg.joints, turned, strict=True):
            local[moved, joint] = quaternion[moved]
    return local, reachable


def turned_locals(
    skeleton: Skeleton,
    rotations_world: Float[np.ndarray, "frames joints 4"],
    local: Float[np.ndarray, "frames joints 4"],
    joints: tuple[int, ...],
    turns: Sequence[Rotation | None],
) -> list[Float[np.ndarray, "frames 4"]]:
    """Joint-to-parent rotations of a limb's joints, from the top down, when each is turned in the world. One without
    a turn keeps its way; joints between (twist bones) turn with the one above them."""
    above, result = None, []
    for joint, turn in zip(joints, turns, strict=True):
        parent, own = rotations_world[:, skeleton.parents[joint]], rotations_world[:, joint]
        if above is not None:
            parent = host_product(above, parent)
        if turn is not None:
            above = turn.as_quat(scalar_first=True)
            own = host_product(above, own)
        quaternion = host_product(parent * CONJUGATE, own)
        # the same side of the double cover as before: no sign jumps in files
        same_side = np.where((quaternion * local[:, joint]).sum(1, keepdims=True) < 0, -1.0, 1.0)
        result.append(quaternion * same_side)
    return result


def calm_feet(motion: Motion, rows: Int[np.ndarray, "frames 2"]) -> Motion:
    """The motion with the tremor of its planted feet averaged away.

    A foot that stands does not tremble; in a capture it does, by a degree or so. Held at the toes, it would hand
    that on to the knee. Over `TREMOR` the foot's world rotation and the toes' local one are averaged, less and less
    towards both ends of a plant, so that they join what is before and after.
    """
    skeleton, dt = motion.skeleton, float(motion.dt)
    local, width = np.array(motion.rotations, float), 2 * round(TREMOR / dt / 2) + 1
    world = leg_kinematics(motion)[1]
    for foot, (ankle, *toe) in enumerate(foot_joints(skeleton)):
        turned = world[:, ankle].copy()
        for start, end in runs(rows[:, foot] >= 0):
            part = slice(start, end + 1)
            turned[part] = _mean_rotation(turned[part], width)
            for joint in toe:
                local[part, joint] = _mean_rotation(local[part, joint], width)
        new = host_product(world[:, skeleton.parents[ankle]] * CONJUGATE, turned)
        new *= np.where((new * local[:, ankle]).sum(1, keepdims=True) < 0, -1.0, 1.0)
        planted = rows[:, foot] >= 0
        local[planted, ankle] = new[planted]
    return Motion(skeleton, motion.root, local, motion.dt, motion.translations)


def _mean_rotation(q: Float[np.ndarray, "frames 4"], width: int) -> Float[np.ndarray, "frames 4"]:
    """Running mean of unit quaternions that lie close together."""
    flips = np.cumprod(np.append(1.0, np.where((q[1:] * q[:-1]).sum(1) < 0, -1.0, 1.0)))[:, None]
    mean = smooth(q * flips, width)
    return mean / np.linalg.norm(mean, axis=1, keepdims=True) * flips


def with_leg_ik(
    base: Motion,
    sole: Sole,
    plants: Footplants,
    paths: Float[np.ndarray, "frames soles 3"],
    rows: Int[np.ndarray, "frames 2"],
    speed: Float[np.ndarray, "frames soles"],
    target: Floor | None,
    lift: float | None,
) -> tuple[Motion, Bool[np.ndarray, "frames 2"], dict[str, float]]:
    """The motion with planted feet exactly in place, which legs reached, and by how much it was lowered [m].

    The vertices stood on hold their places to `EXACT`; the feet keep their orientation, less its tremor.
    """
    base = calm_feet(base, rows)
    paths = sole_paths(sole, base)
    dt, root = float(base.dt), np.asarray(base.root, float)
    frames = np.arange(base.frame_count)
    carrier = np.where(plants.primary >= 0, rows[frames, np.maximum(plants.primary, 0)], -1)
    floor = plants.floor if target is None else target
    correction = horizontal_path(root, paths - root[:, None], carrier, speed, sole.side, dt) - root
    calm = 2 * round(CALM / dt / 2) + 1
    correction = smooth(smooth(correction, calm), calm)
    moved = root + correction
    if target is not None:
        held = carrier >= 0
        rise = -plants.floor.above(paths[frames, carrier])[held].mean() if held.any() else 0.0
        moved[:, 1] = floor.at(moved) + plants.floor.above(root) + rise
    else:
        moved[:, 1] = floor.at(moved) + plants.floor.above(root)
    shift = moved - root
    positions, rotations = leg_kinematics(base)
    moves = hold_feet(paths + shift[:, None], rows, speed, sole, floor, dt)
    legs = find_legs(base.skeleton, positions + shift[:, None], rotations)
    targets = [leg.ankle + moves[:, side] for side, leg in enumerate(legs)]
    down = lowering(legs, targets, dt) if lift is None else np.full(base.frame_count, float(lift))
    below = np.array([0.0, 1.0, 0.0]) * down[:, None]
    # where a knee would turn more abruptly for it than in the clip, the hips give way
    below -= calm_knees([target - leg.hip + below for leg, target in zip(legs, targets, strict=True)],
                        [leg.ankle - leg.hip for leg in legs], [leg.bones for leg in legs], dt)  # fmt: skip
    legs = [leg.moved(-below) for leg in legs]
    heights = paths[..., 1] + shift[:, 1:2] + moves[:, sole.side, 1]
    standing = rows >= 0
    dtype = np.asarray(base.root).dtype
    for _ in range(4):
        local, reachable = turn_legs(base, legs, targets, rotations)
        result = Motion(base.skeleton, moved - below, local, base.dt, base.translations)
        # a sole vertex that hangs on the shank's skin too is not yet quite where it should be: once more
        now = sole_paths(sole, result)
        missing = stay(now, rows, speed, sole, dt)
        missing[..., 1] = np.take_along_axis(heights - now[..., 1], np.maximum(rows, 0), axis=1) * standing
        missing *= reachable[..., None]
        if np.abs(missing).max() < EXACT:
            break
        targets = [target + missing[:, side] for side, target in enumerate(targets)]
    reachable |= ~standing
    result = Motion(base.skeleton, result.root.astype(dtype), local.astype(np.asarray(base.rotations).dtype), base.dt,
                    base.translations)  # fmt: skip
    return result, reachable, {"lowered_max_m": float(down.max())}
