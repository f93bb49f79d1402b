"""The controls of each block: which joints turn, about which axes."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import Character
from motionfit._control import Control, Drive
from motionfit._motion import Motion, forward_kinematics, host_kinematics
from motionfit._skeleton import SIDES
from motionfit.adapt._clearance import Clearance
from motionfit.splines import Basis
from motionfit.terms.penetration import SkinClearance

UP = np.array([0.0, 1.0, 0.0])


def arm_controls(
    character: Character, motion: Motion, clearance: Clearance, allowed: Float[np.ndarray, "frames rows"], basis: Basis
) -> tuple[Control, Control]:
    """One control per arm: the shoulder about r_i = l_i x v_i, thesis 4.4.1 with its erratum.

    l_i is the *upper arm's* axis, so r_i is perpendicular to it and leaves the twist to others; v_i is the way
    in which the arm should move. With n the way out of the body at the skin points that are inside, deepest
    first, the best v is what turns them out fastest: r is the part of sum_p w_p (p - shoulder) x n_p across the
    upper arm. It is the gradient of the weighted depth in the shoulder's rotation vector, and is taken as such.
    A positive angle leads the arm away. The weights are a soft maximum, so r is defined in frames without
    contact too, and it is smoothed over 0.15 s.
    """
    skeleton = character.skeleton
    positions, world = host_kinematics(motion)
    shoulders = tuple(skeleton.joint(f"{side}_upper_arm") for side in SIDES)
    gradients = np.asarray(_depth_gradient(clearance, motion, jnp.asarray(allowed), shoulders), float)
    controls = []
    for k, (side, joint) in enumerate(zip(SIDES, shoulders, strict=True)):
        elbow = skeleton.joint(f"{side}_forearm")
        upper_arm = _unit(positions[:, elbow] - positions[:, joint])
        # where the arm is far from everything the gradient says little: lead the elbow away from the spine line
        outward = np.cross(upper_arm, _away_from_trunk(skeleton, positions, elbow))
        axis = -gradients[:, k] + 1e-3 * outward
        axis -= (axis * upper_arm).sum(-1, keepdims=True) * upper_arm
        axis = gaussian_filter1d(_unit(axis), 0.15 / float(motion.dt), axis=0, mode="nearest")
        axis -= (axis * upper_arm).sum(-1, keepdims=True) * upper_arm
        controls.append(_world_axis_control(f"{side}_arm", ((joint, _unit(axis), 1.0),), character, world, basis))
    return tuple(controls)  # type: ignore[return-value]


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
        made.append(Drive(joint, jnp.asarray(axis_world), gain))
    return Control(name, tuple(made), basis, -bound, bound)


@eqx.filter_jit
def _depth_gradient(clearance: Clearance, motion: Motion, allowed, joints: tuple[int, ...]):
    """d (soft maximum of the excess) / d (world rotation vector of each joint), (frames, joints, 3).

    The rows that move with one joint do not move with the others, so one gradient serves all of them.
    """
    skeleton = motion.skeleton
    base = forward_kinematics(skeleton, motion)
    above = base.rotations_world[:, np.array([skeleton.parents[j] for j in joints])]
    softness = 0.02  # [m]

    def total(turn):
        local = rotation.rotate(rotation.conjugate(above), turn)
        turned = rotation.multiply(rotation.exp(local), jnp.asarray(motion.rotations)[:, np.array(joints)])
        rotations = jnp.asarray(motion.rotations).at[:, np.array(joints)].set(turned)
        kin = forward_kinematics(skeleton, Motion(skeleton, motion.root, rotations, motion.dt))
        cost = 0.0
        for joint in joints:
            side = skeleton.role_of_joint[joint].partition("_")[0]
            rows = [k for k, p in enumerate(clearance.pair_of_row) if clearance.pairs[p].first.startswith(side)]
            if isinstance(clearance.term, SkinClearance):
                depths = clearance.term.point_depths(kin)
                excess = jnp.concatenate([depths[k] - allowed[:, k, None] for k in rows], axis=1)
            else:
                excess = (clearance.row_depths(kin) - allowed)[:, np.array(rows)]
            cost = cost + jnp.sum(softness * jax.nn.logsumexp(excess / softness, axis=1))
        return cost

    return jax.grad(total)(jnp.zeros((motion.root.shape[0], len(joints), 3), base.positions_world.dtype))


def _away_from_trunk(skeleton, positions: np.ndarray, joint: int) -> np.ndarray:
    """Unit direction from the line hips-chest to a joint, per frame."""
    low, high = positions[:, skeleton.joint("hips")], positions[:, skeleton.joint("chest")]
    line = _unit(high - low)
    gap = positions[:, joint] - low
    return _unit(gap - (gap * line).sum(-1, keepdims=True) * line)


def _unit(x: np.ndarray) -> np.ndarray:
    return x / np.maximum(np.linalg.norm(x, axis=-1, keepdims=True), 1e-12)
