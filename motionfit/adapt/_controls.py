"""The controls of each block: which joints turn, about which axes."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._control import Control, Drive
from motionfit._motion import Motion, host_kinematics
from motionfit._skeleton import SIDES, Skeleton
from motionfit.splines import Basis

UP = np.array([0.0, 1.0, 0.0])


def arm_controls(character: Character, motion: Motion, basis: Basis) -> tuple[Control, ...]:
    """Three controls per arm: the shoulder about r_i = l_i x v_i, thesis 4.4.1 with its erratum, across it, and twist.

    l_i is the *upper arm's* axis, so r_i is perpendicular to it, and v_i the way from the line hips-chest to the
    elbow: a positive angle leads the arm away from the trunk. r_i is fixed during the solve, smoothed over
    0.15 s, and defined in frames without contact too. r is right to first order; where a bent arm
    lies across the belly the shortest way out bends away from it. `left_arm_across` turns about l x r and
    `left_arm_twist` about l: with them every turn of the shoulder can be reached.
    """
    skeleton = character.skeleton
    positions, world = host_kinematics(motion)
    controls = []
    for side in SIDES:
        joint, elbow = skeleton.joint(f"{side}_upper_arm"), skeleton.joint(f"{side}_forearm")
        # smoothed in the world: a recording's joint angles are noisy, but cancel along a limb, and an axis that is
        # smooth in the noisy frame of the clavicle would let that noise out
        upper_arm = _smooth(positions[:, elbow] - positions[:, joint], motion)
        axis = _smooth(np.cross(upper_arm, _away_from_trunk(skeleton, positions, elbow)), motion)
        axis = _unit(axis - (axis * upper_arm).sum(-1, keepdims=True) * upper_arm)
        for name, about in ((f"{side}_arm", axis), (f"{side}_arm_across", np.cross(upper_arm, axis)),
                            (f"{side}_arm_twist", upper_arm)):  # fmt: skip
            controls.append(Control(name, (Drive(joint, _in_parent(skeleton, world, joint, about), 1.0),), basis))
    return tuple(controls)


def leg_controls(character: Character, motion: Motion, basis: Basis) -> tuple[Control, Control]:
    """The hip x and the opposite thighs y of thesis 4.5.

    `hip_turn` turns the hips about the vertical while the thighs turn back, so that the legs keep their
    orientation; `thighs_apart` turns the thighs by opposite angles about the pelvis's forward axis, positive
    apart.
    """
    skeleton = character.skeleton
    positions, world = host_kinematics(motion)
    hips, left, right = (skeleton.joint(r) for r in ("hips", "left_thigh", "right_thigh"))
    across = (positions[:, left] - positions[:, right]) * np.array([1.0, 0.0, 1.0])
    forward = _smooth(np.cross(_unit(across), UP), motion)

    up = np.tile(UP, (len(positions), 1))
    turn = tuple(
        Drive(j, _in_parent(skeleton, world, j, up), gain) for j, gain in ((hips, 1.0), (left, -1.0), (right, -1.0))
    )
    apart = tuple(Drive(j, _in_parent(skeleton, world, j, forward), gain) for j, gain in ((left, 1.0), (right, -1.0)))
    return (Control("hip_turn", turn, basis, -np.pi / 8, np.pi / 8),
            Control("thighs_apart", apart, basis, -np.pi / 4, np.pi / 4))  # fmt: skip


def lean_controls(character: Character, motion: Motion, basis: Basis, gaze: bool = True) -> tuple[Control, ...]:
    """Ankle against thigh, and the spine, each sideways and forward: thesis 4.7.3, bounds (4.13).

    `lean_*` turns both thighs one way and both feet back, so that trunk and soles keep their orientation: seen from
    the feet, the hips move. `spine_*` bends the trunk, shared evenly by the spine's joints; with `gaze` the head
    turns back. Positive is to the left, and forward. Axes are level and follow the hips' heading.
    """
    skeleton = character.skeleton
    positions, world = host_kinematics(motion)
    left, right = (skeleton.joint(f"{s}_thigh") for s in SIDES)
    across = _smooth((positions[:, left] - positions[:, right]) * np.array([1.0, 0.0, 1.0]), motion)
    forward = np.cross(across, UP)
    spine, controls = skeleton.chain("spine"), []

    def drives(axis: np.ndarray, joints: tuple[int, ...], gain: float) -> tuple[Drive, ...]:
        return tuple(Drive(j, _in_parent(skeleton, world, j, axis), gain) for j in joints)

    legs = [tuple(skeleton.joint(f"{s}_{r}") for s in SIDES) for r in ("thigh", "foot")]
    head = (skeleton.joint("head"),) if gaze and skeleton.find("head") is not None else ()
    # about `forward` a positive turn takes what is up to the right, about `across` to the front
    for name, axis, up in (("sideways", forward, -1.0), ("forward", across, 1.0)):
        lean = drives(axis, legs[0], up) + drives(axis, legs[1], -up)
        controls.append(Control(f"lean_{name}", lean, basis, -np.pi / 8, np.pi / 8))
        if spine:
            bend = drives(axis, spine, up / len(spine)) + drives(axis, head, -up)
            controls.append(Control(f"spine_{name}", bend, basis, -np.pi / 8, np.pi / 8))
    return tuple(controls)


def _in_parent(skeleton: Skeleton, rotations_world: np.ndarray, joint: int, axis_world: np.ndarray) -> np.ndarray:
    """World axes, per frame, in the frame of a joint's parent."""
    parent = skeleton.parents[joint]
    if parent < 0:
        return axis_world
    return Rotation.from_quat(rotations_world[:, parent], scalar_first=True).inv().apply(axis_world)


def _smooth(directions: np.ndarray, motion: Motion) -> np.ndarray:
    """Unit directions, low-passed over 0.15 s."""
    return _unit(gaussian_filter1d(_unit(directions), 0.15 / float(motion.dt), axis=0, mode="nearest"))


def _away_from_trunk(skeleton, positions: np.ndarray, joint: int) -> np.ndarray:
    """Unit direction from the line hips-chest to a joint, per frame."""
    low, high = positions[:, skeleton.joint("hips")], positions[:, skeleton.joint("chest")]
    line = _unit(high - low)
    gap = positions[:, joint] - low
    return _unit(gap - (gap * line).sum(-1, keepdims=True) * line)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
