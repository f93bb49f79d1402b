"""The controls of each block: which joints turn, about which axes."""

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._control import Control, Drive
from motionfit._motion import Motion, host_kinematics
from motionfit._skeleton import SIDES
from motionfit.splines import Basis

UP = np.array([0.0, 1.0, 0.0])


def arm_controls(character: Character, motion: Motion, basis: Basis) -> tuple[Control, ...]:
    """Three controls per arm: the shoulder about r_i = l_i x v_i, thesis 4.4.1 with its erratum, across it, and twist.

    l_i is the *upper arm's* axis, so r_i is perpendicular to it, and v_i the way from the line hips-chest to the
    elbow: a positive angle leads the arm away from the trunk. r_i is fixed during the solve, smoothed over 0.15 s in
    the frame of the clavicle, and defined in frames without contact too. r is right to first order; where a bent arm
    lies across the belly the shortest way out bends away from it. `left_arm_across` turns about l x r and
    `left_arm_twist` about l: with them every turn of the shoulder can be reached.
    """
    skeleton = character.skeleton
    positions, world = host_kinematics(motion)
    controls = []
    for side in SIDES:
        joint, elbow = skeleton.joint(f"{side}_upper_arm"), skeleton.joint(f"{side}_forearm")
        parent = skeleton.parents[joint]
        above = Rotation.from_quat(world[:, parent], scalar_first=True).inv()
        upper_arm = _unit(above.apply(positions[:, elbow] - positions[:, joint]))
        away = above.apply(_away_from_trunk(skeleton, positions, elbow))
        axis = _unit(np.cross(upper_arm, away))
        axis = gaussian_filter1d(axis, 0.15 / float(motion.dt), axis=0, mode="nearest")
        axis = _unit(axis - (axis * upper_arm).sum(-1, keepdims=True) * upper_arm)
        for name, about in ((f"{side}_arm", axis), (f"{side}_arm_across", np.cross(upper_arm, axis)),
                            (f"{side}_arm_twist", upper_arm)):  # fmt: skip
            controls.append(Control(name, (Drive(joint, about, 1.0),), basis))
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
    up = np.tile(UP, (len(positions), 1))
    across = (positions[:, left] - positions[:, right]) * np.array([1.0, 0.0, 1.0])
    forward = _unit(np.cross(_unit(across), up))
    turn = ((hips, up, 1.0), (left, up, -1.0), (right, up, -1.0))
    apart = ((left, forward, 1.0), (right, forward, -1.0))
    return (
        _world_axis_control("hip_turn", turn, character, world, basis, bound=np.pi / 8),
        _world_axis_control("thighs_apart", apart, character, world, basis, bound=np.pi / 4),
    )


def _world_axis_control(
    name: str,
    drives: tuple[tuple[int, np.ndarray, float], ...],
    character: Character,
    rotations_world: np.ndarray,
    basis: Basis,
    bound: float = np.pi / 2,
) -> Control:
    """A control whose axes are given in the world, per frame, and are kept in the joints' parents' frames."""
    parents = character.skeleton.parents
    made = []
    for joint, axis_world, gain in drives:
        if parents[joint] >= 0:
            above = Rotation.from_quat(rotations_world[:, parents[joint]], scalar_first=True)
            axis_world = above.inv().apply(axis_world)
        made.append(Drive(joint, axis_world, gain))
    return Control(name, tuple(made), basis, -bound, bound)


def _away_from_trunk(skeleton, positions: np.ndarray, joint: int) -> np.ndarray:
    """Unit direction from the line hips-chest to a joint, per frame."""
    low, high = positions[:, skeleton.joint("hips")], positions[:, skeleton.joint("chest")]
    line = _unit(high - low)
    gap = positions[:, joint] - low
    return _unit(gap - (gap * line).sum(-1, keepdims=True) * line)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
