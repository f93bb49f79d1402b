"""The controls of each block: which joints turn, about which axes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._control import Control, Drive
from motionfit._motion import Motion, host_kinematics
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import InputError
from motionfit.splines import Basis

UP = np.array([0.0, 1.0, 0.0])
FAINT = 0.1  # [rad] from an arm's own direction, within which the way from the trunk to it tells nothing


def arm_controls(character: Character, motion: Motion, basis: Basis) -> tuple[Control, ...]:
    """Three controls per arm: the shoulder about r_i = l_i x v_i, thesis 4.4.1 with its erratum, across it, and twist.

    l_i is the *upper arm's* axis, so r_i is perpendicular to it, and v_i the way from the line hips-chest to the
    elbow: a positive angle leads the arm away from the trunk. r_i is fixed during the solve, smoothed over
    0.15 s, and defined in frames without contact too. Where an arm points straight away from the trunk r_i is
    undefined, and may be the opposite afterwards: there it turns about the arm from the one to the other, as fast as
    the smoothing lets it. r is right to first order; where a bent arm
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
        axis = _steady_across(upper_arm, np.cross(upper_arm, _away_from_trunk(skeleton, positions, elbow)), motion)
        for name, about in ((f"{side}_arm", axis), (f"{side}_arm_across", np.cross(upper_arm, axis)),
                            (f"{side}_arm_twist", upper_arm)):  # fmt: skip
            controls.append(Control(name, (Drive(joint, _in_parent(skeleton, world, joint, about), 1.0),), basis))
    return tuple(controls)


def leg_controls(character: Character, motion: Motion, basis: Basis) -> tuple[Control, Control, Control]:
    """The hip x and the opposite thighs y of thesis 4.5, and the knees.

    `hip_turn` turns the hips about the vertical while the thighs turn back, so that the legs keep their
    orientation; `thighs_apart` turns the thighs by opposite angles about the pelvis's forward axis, positive
    apart. `knees_apart` turns each leg about the line from its ankle to its hip, positive apart, and the foot back: in a
    squat or a step the thighs make room for each other, and the feet stay where they are.
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
    knees = []
    for side, gain in zip(SIDES, (1.0, -1.0), strict=True):
        thigh, foot = (skeleton.joint(f"{side}_{r}") for r in ("thigh", "foot"))
        line = _smooth(positions[:, thigh] - positions[:, foot], motion)
        knees += [Drive(j, _in_parent(skeleton, world, j, line), g) for j, g in ((thigh, gain), (foot, -gain))]
    return (Control("hip_turn", turn, basis, -np.pi / 8, np.pi / 8),
            Control("thighs_apart", apart, basis, -np.pi / 4, np.pi / 4),
            Control("knees_apart", tuple(knees), basis, -np.pi / 4, np.pi / 4))  # fmt: skip


def lean_controls(
    character: Character, motion: Motion, basis: Basis, gaze: bool = True, shoulders: bool = False
) -> tuple[Control, ...]:
    """Ankle against thigh, and the spine, each sideways and forward: thesis 4.7.3, bounds (4.13).

    `lean_*` turns both thighs one way and both feet back, so that trunk and soles keep their orientation: seen from
    the feet, the hips move. `spine_*` bends the trunk, shared evenly by the spine's joints; with `gaze` the head
    turns back, and with `shoulders` the upper arms, by the opposite of the spine's turn (thesis 5.5.2). Positive is to
    the left, and forward. Axes are level and follow the hips' heading.
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
    roles = ("head",) * gaze + ("left_upper_arm", "right_upper_arm") * shoulders
    kept = tuple(j for role in roles if (j := skeleton.find(role)) is not None)
    # about `forward` a positive turn takes what is up to the right, about `across` to the front
    for name, axis, up in (("sideways", forward, -1.0), ("forward", across, 1.0)):
        lean = drives(axis, legs[0], up) + drives(axis, legs[1], -up)
        controls.append(Control(f"lean_{name}", lean, basis, -np.pi / 8, np.pi / 8))
        if spine:
            bend = drives(axis, spine, up / len(spine)) + drives(axis, kept, -up)
            controls.append(Control(f"spine_{name}", bend, basis, -np.pi / 8, np.pi / 8))
    return tuple(controls)


class Turn(NamedTuple):
    """A control as data: each drive names a role, an axis and a gain, and `bound` [rad] holds both ways.

    Axes are directions of the trunk, "left", "up" and "forward", or of the limb itself: "bend", about which it bends
    over the clip (positive: more), "swing", across that and the bone, and "twist", about the bone itself. A bend never stretches a limb beyond straight.
    """

    name: str
    drives: tuple[tuple[str, str, float], ...]
    bound: float = np.pi / 2


def turn_controls(motion: Motion, basis: Basis, turns: Sequence[Turn]) -> tuple[Control, ...]:
    """The controls of some turns: axes smooth in the world, as those of the arms."""
    skeleton = motion.skeleton
    positions, world = host_kinematics(motion)
    line = _smooth(positions[:, skeleton.joint("chest")] - positions[:, skeleton.joint("hips")], motion)
    arms = positions[:, skeleton.joint("left_upper_arm")] - positions[:, skeleton.joint("right_upper_arm")]
    left = _smooth(arms - (arms * line).sum(-1, keepdims=True) * line, motion)
    trunk = {"left": left, "up": line, "forward": np.cross(left, line)}
    controls = []
    for turn in turns:
        drives, lower = [], -turn.bound
        for role, name, gain in turn.drives:
            joint = skeleton.joint(role)
            if name in ("bend", "swing"):
                axis, least = _limb_axis(motion, positions, world, joint, name)
                lower = max(lower, -least) if name == "bend" else lower
            elif name == "twist":
                axis = _smooth(positions[:, skeleton.children(joint)[0]] - positions[:, joint], motion)
            elif name in trunk:
                axis = trunk[name]
            else:
                raise InputError(f"unknown axis {name!r} of {turn.name}; axes: {', '.join(trunk)}, bend, swing, twist")
            drives.append(Drive(joint, _in_parent(skeleton, world, joint, axis), gain))
        controls.append(Control(turn.name, tuple(drives), basis, lower, turn.bound))
    return tuple(controls)


def _limb_axis(
    motion: Motion, positions: np.ndarray, world: np.ndarray, joint: int, name: str
) -> tuple[np.ndarray, float]:
    """A limb's bend or swing axis in the world, per frame, and its least bend over the clip [rad].

    The bend axis is that of the whole clip, fixed in the upper bone: a straight limb has none of its own."""
    skeleton = motion.skeleton
    above = Rotation.from_quat(world[:, skeleton.parents[joint]], scalar_first=True)
    upper = _unit(positions[:, joint] - positions[:, skeleton.parents[joint]])
    lower = _unit(positions[:, skeleton.children(joint)[0]] - positions[:, joint])
    hinge = above.inv().apply(np.cross(upper, lower)).sum(0)
    bend = _smooth(above.apply(_unit(hinge)), motion)
    angle = np.arctan2((np.cross(upper, lower) * bend).sum(-1), (upper * lower).sum(-1))
    axis = bend if name == "bend" else _unit(np.cross(bend, _smooth(lower, motion)))
    return axis, float(max(angle.min(), 0.0))


def _in_parent(skeleton: Skeleton, rotations_world: np.ndarray, joint: int, axis_world: np.ndarray) -> np.ndarray:
    """World axes, per frame, in the frame of a joint's parent."""
    parent = skeleton.parents[joint]
    if parent < 0:
        return axis_world
    return Rotation.from_quat(rotations_world[:, parent], scalar_first=True).inv().apply(axis_world)


def _smooth(directions: np.ndarray, motion: Motion) -> np.ndarray:
    """Unit directions, low-passed over 0.15 s."""
    return _unit(gaussian_filter1d(_unit(directions), 0.15 / float(motion.dt), axis=0, mode="nearest"))


def _steady_across(along: np.ndarray, across: np.ndarray, motion: Motion) -> np.ndarray:
    """Unit vectors across unit directions `along`: those of `across`, low-passed over 0.15 s, each by its length.

    The low-pass is one of angles about `along`, against a frame that is carried along without twist (Bishop 1975):
    vectors that come to be opposite would cancel, and what is left of them flips from one frame to the next.
    """
    first = np.empty_like(along)
    carried = across[np.linalg.norm(across, axis=-1).argmax()]
    for t, direction in enumerate(along):
        carried = _unit(carried - (carried @ direction) * direction)
        first[t] = carried
    second = np.cross(along, first)
    x, y = (across * first).sum(-1), (across * second).sum(-1)
    weight = np.maximum(x * x + y * y, FAINT**2)
    width = 0.15 / float(motion.dt)
    mean, total = (gaussian_filter1d(v, width, mode="nearest") for v in (weight * np.unwrap(np.arctan2(y, x)), weight))
    angle = (mean / total)[:, None]
    return first * np.cos(angle) + second * np.sin(angle)


def _away_from_trunk(skeleton, positions: np.ndarray, joint: int) -> np.ndarray:
    """Unit direction from the line hips-chest to a joint, per frame."""
    low, high = positions[:, skeleton.joint("hips")], positions[:, skeleton.joint("chest")]
    line = _unit(high - low)
    gap = positions[:, joint] - low
    return _unit(gap - (gap * line).sum(-1, keepdims=True) * line)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
