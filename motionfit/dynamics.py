"""Inverse dynamics over the segments, and whether a body is strong enough for a motion.

Thesis 6.2 names it as open: its adaptation gives a solution even where the motion is impossible for the body. The
recursive Newton-Euler algorithm (Luh, Walker & Paul 1980; Featherstone 2008, 5.3) in the world frame: the forward
pass are the kinematics and their time derivatives, by the filter of `motionfit.balance`; the backward pass sums forces
and moments from the tips of the tree to its root.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from motionfit import rotation
from motionfit._motion import Kinematics, bind_pose
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray, InputError
from motionfit.balance import (
    FLIGHT,
    GRAVITY,
    WINDOW,
    Soles,
    centres_world,
    nearest_in_hull,
    smooth_derivatives,
    spin_momenta,
)
from motionfit.shape.mass import Masses


class Loads(eqx.Module):
    """What moves the body, in the world frame.

    `force` [N] and `torque` [N m]: what each joint's parent exerts on the joint's segment, at the joint. At the root
    they are what nobody exerts: the rest that keeps the captured motion from being a physical one.
    `ground_force` [N] acts on each foot at `ground_point` [m], together with a moment about the vertical,
    `ground_twist` [N m].
    """

    force: Float[AnyArray, "frames joints 3"]
    torque: Float[AnyArray, "frames joints 3"]
    ground_force: Float[AnyArray, "frames feet 3"]
    ground_point: Float[AnyArray, "frames feet 3"]
    ground_twist: Float[AnyArray, "frames feet"]


def newton_euler(
    skeleton: Skeleton,
    positions_world: Float[AnyArray, "frames joints 3"],
    forces: Float[AnyArray, "frames joints 3"],
    moments: Float[AnyArray, "frames joints 3"],
) -> tuple[Float[Array, "frames joints 3"], Float[Array, "frames joints 3"]]:
    """The backward pass: force [N] and torque [N m] that each joint must transmit to the tree beyond it.

    `forces` and `moments` (about the joint) are what each joint's own segment needs: rate of change of its momenta,
    less gravity and contacts. Level by level, as in `forward_kinematics`: f_parent += f, n_parent += n + r x f.
    """
    positions, force, torque = jnp.asarray(positions_world), jnp.asarray(forces), jnp.asarray(moments)
    for level in reversed(skeleton.levels[1:]):
        joints = np.array(level)
        parents = np.array([skeleton.parents[j] for j in level])
        arm = positions[:, joints] - positions[:, parents]
        passed = torque[:, joints] + jnp.cross(arm, force[:, joints])
        torque = torque.at[:, parents].add(passed)
        force = force.at[:, parents].add(force[:, joints])
    return force, torque


def required(
    kin: Kinematics, masses: Masses, window: float | Float[AnyArray, ""] = WINDOW
) -> tuple[Float[Array, "frames joints 3"], Float[Array, "frames joints 3"]]:
    """Force [N] and moment about the joint [N m] that each joint's own segment needs to move as it does, its weight
    included: m (a + g up), and dH/dt + r x f."""
    centres = centres_world(kin, masses)
    mass = jnp.asarray(masses.mass).astype(centres.dtype)
    up = jnp.array([0.0, GRAVITY, 0.0], centres.dtype)

    def filtered(pair):
        return smooth_derivatives(pair[0], kin.dt, window)[2], smooth_derivatives(pair[1], kin.dt, window)[1]

    # one segment after the other: all windows of a long clip at once would fill the memory
    along = (jnp.moveaxis(centres, 1, 0), jnp.moveaxis(spin_momenta(kin, masses), 1, 0))
    acceleration, moment = (jnp.moveaxis(x, 0, 1) for x in jax.lax.map(filtered, along))
    force = mass[:, None] * (acceleration + up)
    joints = np.array(masses.joints)
    moment = moment + jnp.cross(centres - kin.positions_world[:, joints], force)
    empty = jnp.zeros_like(kin.positions_world)
    return empty.at[:, joints].add(force), empty.at[:, joints].add(moment)


def inverse_dynamics(
    skeleton: Skeleton,
    kin: Kinematics,
    masses: Masses,
    soles: Soles | None = None,
    planted: Bool[AnyArray, "frames feet"] | None = None,
    *,
    ground: float | Float[AnyArray, ""] = 0.0,
    window: float | Float[AnyArray, ""] = WINDOW,
) -> Loads:
    """Joint forces and torques of a motion, with the ground's reaction on the planted feet.

    One planted foot takes all: the force at the zero-moment point and the twist about the vertical. The ground cannot
    push outside the support: there the reaction acts at the nearest point inside, and the moment that is missing shows
    at the root. Two planted feet are indeterminate; they share the force by where it acts along the line between
    their soles' centres, each at its own centre shifted alike, which gives the same total force and moment. Without a
    planted foot, or in flight, there is no reaction, and all of it is missing at the root.
    """
    # as arrays: Python numbers would be static under jit, and each new one would compile again
    numbers = jnp.asarray(ground, dtype=float), jnp.asarray(window, dtype=float)
    return _inverse_dynamics(skeleton, kin, masses, soles, planted, *numbers)


@eqx.filter_jit
def _inverse_dynamics(skeleton: Skeleton, kin: Kinematics, masses: Masses, soles, planted, ground, window) -> Loads:
    positions = jnp.asarray(kin.positions_world)
    forces, moments = required(kin, masses, window)
    total, about_root = (x[:, 0] for x in newton_euler(skeleton, positions, forces, moments))
    frames = positions.shape[0]
    feet = jnp.zeros((frames, 2), positions.dtype)
    if soles is None or planted is None:
        spread = jnp.zeros((frames, 2, 3), positions.dtype)
        return Loads(*newton_euler(skeleton, positions, forces, moments), spread, spread, feet)
    # where the total force has no horizontal moment
    weight = GRAVITY * jnp.sum(jnp.asarray(masses.mass)).astype(positions.dtype)
    vertical = jnp.maximum(total[:, 1], FLIGHT * weight)
    drop = jnp.asarray(ground, positions.dtype) - positions[:, 0, 1]
    arm_x = (about_root[:, 2] + drop * total[:, 0]) / vertical
    arm_z = (drop * total[:, 2] - about_root[:, 0]) / vertical
    point: Array = positions[:, 0] + jnp.stack([arm_x, drop, arm_z], axis=-1)
    twist = about_root[:, 1] - (arm_z * total[:, 0] - arm_x * total[:, 2])
    down = jnp.asarray(planted)
    plane = np.array([0, 2])
    corners = soles.corners_world(kin)
    inside = nearest_in_hull(point[:, plane], corners.reshape(frames, -1, 3)[..., plane], jnp.repeat(down, 4, axis=1))
    point = point.at[:, plane].set(inside)
    centre = jnp.mean(corners, axis=2).at[..., 1].set(jnp.asarray(ground, positions.dtype))
    between = centre[:, 1] - centre[:, 0]
    squared = jnp.sum(between**2, axis=-1)
    along = jnp.sum((point - centre[:, 0]) * between, axis=-1) / jnp.where(squared > 1e-9, squared, 1.0)
    right = jnp.clip(along, 0.0, 1.0)
    share = jnp.stack([1.0 - right, right], axis=-1)
    share = jnp.where(down[:, ::-1], share, 1.0) * jnp.where(down, 1.0, 0.0).astype(positions.dtype)
    share = jnp.where((total[:, 1] > FLIGHT * weight)[:, None], share, 0.0)
    middle = jnp.sum(share[..., None] * centre, axis=1)
    points = centre + (point - middle)[:, None]
    ground_force = share[..., None] * total[:, None]
    ground_twist = share * twist[:, None]
    joints = np.array(soles.joints)
    about_foot = jnp.cross(points - positions[:, joints], ground_force)
    about_foot = about_foot.at[..., 1].add(ground_twist)
    forces = forces.at[:, joints].add(-ground_force)
    moments = moments.at[:, joints].add(-about_foot)
    return Loads(*newton_euler(skeleton, positions, forces, moments), ground_force, points, ground_twist)


# --- strength -----------------------------------------------------------------------------------------------------


class Strength(NamedTuple):
    """Greatest voluntary torque over weight x height: mean and standard deviation of young men and women."""

    men: tuple[float, float]
    women: tuple[float, float]


# Legs: Anderson, Madigan & Nussbaum 2007, J. Biomechanics 40:3105, table 3, C1 of 18 to 25 years.
# Arms: Holzbaur, Delp, Gold & Murray 2007, J. Biomechanics 40:2442, table 1: shoulder abduction 31.6 N m and elbow
# flexion 23.5 N m of a woman of 49.9 kg and 1.575 m; the mean shoulder adduction of their ten men and women, 67.9 N m,
# is the same share of weight x height as hers, so one share serves both sexes.
# Trunk: Chaffin, Andersson & Martin 1999, table 4.5: extension 232 N m for men at 40 degrees of bend, over the weight
# and height of a US man (78.7 kg, 1.755 m); normalised by weight x height men and women hardly differ.
# Arms and trunk come without a spread of the normalised torque: 22 %, the mean of the legs'.
STRENGTH: dict[str, Strength] = {
    "hip_extension": Strength((0.161, 0.049), (0.181, 0.047)),
    "hip_flexion": Strength((0.113, 0.025), (0.127, 0.033)),
    "knee_extension": Strength((0.163, 0.040), (0.159, 0.028)),
    "knee_flexion": Strength((0.087, 0.015), (0.080, 0.015)),
    "ankle_plantarflexion": Strength((0.095, 0.022), (0.104, 0.034)),
    "ankle_dorsiflexion": Strength((0.033, 0.005), (0.027, 0.006)),
    "shoulder": Strength((0.041, 0.009), (0.041, 0.009)),
    "elbow": Strength((0.0305, 0.0067), (0.0305, 0.0067)),
    "trunk_extension": Strength((0.171, 0.038), (0.171, 0.038)),
}

STRONG_BMI = 25.0  # [kg/m^2]: mass beyond it is taken for fat, which pulls at no bone


def strength_limits(mass: float, height: float, sex: str = "male", deviations: float = 2.0) -> dict[str, float]:
    """Greatest voluntary torque [N m] of a person of a mass [kg] and height [m].

    `deviations` 0 is the average person; 2, the default, is stronger than 98 % of all: what exceeds that is out of
    reach. The table is of normal build; of a heavier body only the mass up to a body-mass index of 25 counts.
    """
    if not (1.0 <= mass <= 500.0 and 0.3 <= height <= 3.0):
        raise InputError(f"a person of {mass:g} kg and {height:g} m; give 1 to 500 kg and 0.3 to 3 m")
    if sex not in ("male", "female"):
        raise InputError(f"sex {sex!r}: the strength table has male, female")
    scale = min(mass, STRONG_BMI * height**2) * GRAVITY * height
    rows = {action: row.men if sex == "male" else row.women for action, row in STRENGTH.items()}
    return {action: scale * max(mean + deviations * sd, 0.0) for action, (mean, sd) in rows.items()}


class _Hinge(NamedTuple):
    """An action of a joint: the torque about the left-right axis of `frame`'s bind pose, in this direction."""

    action: str
    joint: str
    frame: str
    sign: float


# With x to the left, y up and z ahead a turn by +x takes the leg back, the heel to the seat and the toes down.
_HINGES = (
    _Hinge("hip_extension", "{s}_thigh", "hips", 1.0), _Hinge("hip_flexion", "{s}_thigh", "hips", -1.0),
    _Hinge("knee_flexion", "{s}_calf", "{s}_thigh", 1.0), _Hinge("knee_extension", "{s}_calf", "{s}_thigh", -1.0),
    _Hinge("ankle_plantarflexion", "{s}_foot", "{s}_calf", 1.0),
    _Hinge("ankle_dorsiflexion", "{s}_foot", "{s}_calf", -1.0),
)  # fmt: skip


def joint_actions(skeleton: Skeleton, kin: Kinematics, loads: Loads) -> dict[str, Float[Array, "frames"]]:
    """Torque [N m] of every action of `STRENGTH` and side, never negative: "left_knee_extension" and so on.

    Legs and trunk about the left-right axis of the segment above the joint; shoulder and elbow as the torque's
    size across the arm, whatever its direction (the table holds their weakest one).
    """
    rest = bind_pose(skeleton)[1]

    def about_side(joint: int, frame: int) -> Array:
        axis = rotation.rotate(rotation.conjugate(jnp.asarray(rest[frame])), jnp.array([1.0, 0.0, 0.0]))
        turn = kin.rotations_world[:, frame]
        return jnp.sum(loads.torque[:, joint] * rotation.rotate(turn, axis.astype(turn.dtype)[None]), axis=-1)

    actions: dict[str, Array] = {}
    for side in SIDES:
        for hinge in _HINGES:
            joint = skeleton.joint(hinge.joint.format(s=side))
            torque = hinge.sign * about_side(joint, skeleton.joint(hinge.frame.format(s=side)))
            actions[f"{side}_{hinge.action}"] = jnp.maximum(torque, 0.0)
        for name, role, next_role in (("shoulder", "upper_arm", "forearm"), ("elbow", "forearm", "hand")):
            joint, tip = skeleton.joint(f"{side}_{role}"), skeleton.joint(f"{side}_{next_role}")
            axis = rotation.normalize(kin.positions_world[:, tip] - kin.positions_world[:, joint])
            actions[f"{side}_{name}"] = rotation.safe_norm(jnp.cross(axis, loads.torque[:, joint]))
    spine = skeleton.chain("spine")
    if spine:
        actions["trunk_extension"] = jnp.maximum(-about_side(spine[0], skeleton.joint("hips")), 0.0)
    return actions


class Feasibility(NamedTuple):
    """Per action: the greatest torque [N m], the limit [N m] and the share of frames above it. `feasible` says that
    none exceeds its limit in more than a tolerated share of the frames. `residual` [m] is the mean moment that nobody
    exerts at the root over the weight, in the supported frames: about how far the zero-moment point is outside the
    support. Above some centimetres the motion itself is not in balance, whatever the strength."""

    peak: dict[str, float]
    limit: dict[str, float]
    exceeded: dict[str, float]
    residual: float | None
    feasible: bool

    def report(self) -> str:
        """A table, the most strained action first."""
        order = sorted(self.peak, key=lambda k: -self.peak[k] / self.limit[k])
        lines = [f"{'action':<28} {'peak N m':>9} {'limit':>9} {'peak/limit':>10} {'over':>6}"]
        lines += [f"{k:<28} {self.peak[k]:>9.1f} {self.limit[k]:>9.1f} {self.peak[k] / self.limit[k]:>10.2f} "
                  f"{100 * self.exceeded[k]:>5.1f}%" for k in order]  # fmt: skip
        return "\n".join([*lines, "feasible" if self.feasible else "not feasible for this body"])


def feasibility(
    skeleton: Skeleton, kin: Kinematics, masses: Masses, soles: Soles, planted: Bool[AnyArray, "frames feet"],
    height: float, *, sex: str = "male", deviations: float = 2.0, ground: float = 0.0, window: float = WINDOW,
    tolerance: float = 0.05,
) -> Feasibility:  # fmt: skip
    """Whether a body of these masses and this height [m] is strong enough for a motion, action by action.

    Frames count where a planted foot carries weight: elsewhere the legs' torques are those of a hanging body. An
    action may exceed its limit in a `tolerance` share of them: single frames at a foot strike tell more of the
    filter than of the body.
    """
    planted = np.asarray(planted)
    limits = strength_limits(float(masses.total), height, sex, deviations)
    loads = inverse_dynamics(skeleton, kin, masses, soles, planted, ground=ground, window=window)
    counted = planted.any(axis=1) & (np.asarray(loads.ground_force)[..., 1].sum(-1) > 0)
    weight = GRAVITY * float(masses.total)
    peak, limit, exceeded = {}, {}, {}
    for name, torque in joint_actions(skeleton, kin, loads).items():
        action = name.removeprefix("left_").removeprefix("right_")
        values = np.asarray(torque, float)[counted]
        peak[name], limit[name] = float(values.max(initial=0.0)), limits[action]
        exceeded[name] = float((values > limit[name]).mean()) if len(values) else 0.0
    rest = np.linalg.norm(np.asarray(loads.torque, float)[counted, 0], axis=-1)
    residual = float(rest.mean() / weight) if len(rest) else None
    return Feasibility(peak, limit, exceeded, residual, all(v <= tolerance for v in exceeded.values()))
