"""Inverse dynamics against pendulums in closed form, the power balance, statics, and MuJoCo."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.thesis._setting import planted_feet
from motionfit import rotation, samples
from motionfit._motion import rest_motion
from motionfit.balance import (
    GRAVITY,
    angular_velocities,
    centre_of_mass,
    sole_boxes,
    support_distance,
    velocities,
    zero_moment_point,
)
from motionfit.dynamics import (
    STRENGTH,
    feasibility,
    inverse_dynamics,
    joint_actions,
    newton_euler,
    required,
    strength_limits,
)
from motionfit.shape.mass import Masses, mesh_masses

# one program per clip length instead of one per operation
kinematics = eqx.filter_jit(mf.forward_kinematics)

RATE = 1000.0  # [1/s] so dense that the differences do not matter: their error is some (2 pi f / RATE)^2
DIFFERENCED = 2e-4  # relative


def _links(angles, lengths, masses, inertias, reaches):
    """A planar chain hanging from the origin; each angle is the link's own, from straight down, about z."""
    count = len(lengths)
    offsets = np.array([[0.0, 0.0, 0.0]] + [[0.0, -length, 0.0] for length in lengths[:-1]])
    skeleton = mf.Skeleton([f"link{k}" for k in range(count)], [k - 1 for k in range(count)], offsets)
    relative = np.diff(np.concatenate([np.zeros((len(angles), 1)), angles], axis=1), axis=1)
    turns = Rotation.from_rotvec(relative.reshape(-1, 1) * np.array([0.0, 0.0, 1.0])).as_quat(scalar_first=True)
    motion = mf.Motion(skeleton, np.zeros((len(angles), 3)), turns.reshape(*angles.shape, 4), 1 / RATE)
    bodies = Masses(("hips", "chest", "head")[:count], tuple(range(count)), np.array(masses),
                    np.array([[0.0, -r, 0.0] for r in reaches]), np.array([i * np.eye(3) for i in inertias]))  # fmt: skip
    return skeleton, kinematics(skeleton, motion), bodies


def test_a_pendulum():
    """tau = (I + m r^2) a + m g r sin(angle)."""
    t = np.arange(200) / RATE
    angle, w = 0.7 * np.sin(2 * np.pi * 1.3 * t), 2 * np.pi * 1.3
    skeleton, kin, bodies = _links(angle[:, None], [0.8], [3.0], [0.2], [0.5])
    loads = inverse_dynamics(skeleton, kin, bodies, window=0.0)
    expected = (0.2 + 3.0 * 0.5**2) * (-w * w * angle) + 3.0 * GRAVITY * 0.5 * np.sin(angle)
    np.testing.assert_allclose(loads.torque[3:-3, 0, 2], expected[3:-3], atol=DIFFERENCED * np.abs(expected).max())
    np.testing.assert_allclose(loads.torque[:, 0, :2], 0.0, atol=1e-9)


def test_a_double_pendulum():
    """Lagrange's equations of the double pendulum in absolute angles (Goldstein), motors at both joints."""
    t = np.arange(200) / RATE
    w = 2 * np.pi * np.array([1.1, 1.7])
    size, phase = np.array([0.6, 0.9]), np.array([0.3, -0.8])
    q, v, a = (size * f(w * t[:, None] + phase) * k for f, k in ((np.sin, 1), (np.cos, w), (np.sin, -w * w)))
    (l1, _), (m1, m2), (i1, i2), (r1, r2) = (0.5, 0.4), (2.0, 1.5), (0.06, 0.03), (0.2, 0.25)
    skeleton, kin, bodies = _links(q, [0.5, 0.4], [m1, m2], [i1, i2], [r1, r2])
    loads = inverse_dynamics(skeleton, kin, bodies, window=0.0)
    c, s, k = np.cos(q[:, 0] - q[:, 1]), np.sin(q[:, 0] - q[:, 1]), m2 * l1 * r2
    q1 = (i1 + m1 * r1**2 + m2 * l1**2) * a[:, 0] + k * (c * a[:, 1] + s * v[:, 1] ** 2)
    q1 += (m1 * r1 + m2 * l1) * GRAVITY * np.sin(q[:, 0])
    q2 = (i2 + m2 * r2**2) * a[:, 1] + k * (c * a[:, 0] - s * v[:, 0] ** 2) + m2 * r2 * GRAVITY * np.sin(q[:, 1])
    # generalised forces of absolute angles: the second motor pushes back on the first link
    for joint, expected in ((1, q2), (0, q1 + q2)):
        scale = np.abs(expected).max()
        np.testing.assert_allclose(loads.torque[3:-3, joint, 2], expected[3:-3], atol=DIFFERENCED * scale)


def _waving(seed, joints=6, frames=120, size=0.6):
    rng = np.random.default_rng(seed)
    parents = [-1] + [int(rng.integers(0, j)) for j in range(1, joints)]
    skeleton = mf.Skeleton([f"joint{j}" for j in range(joints)], parents, 0.3 * rng.normal(size=(joints, 3)))
    t = np.arange(frames) / RATE
    waves = np.sin(2 * np.pi * np.outer(t, rng.uniform(0.5, 1.5, 3 + 3 * joints)) + rng.uniform(0, 6, 3 + 3 * joints))
    turns = Rotation.from_rotvec(size * waves[:, 3:].reshape(-1, 3)).as_quat(scalar_first=True)
    motion = mf.Motion(skeleton, size / 3 * waves[:, :3] + [0, 1, 0], turns.reshape(frames, joints, 4), 1 / RATE)
    # from second moments, so that no moment of inertia is above the sum of the other two
    moments = [x @ x.T + 0.01 * np.eye(3) for x in 0.1 * rng.normal(size=(joints, 3, 3))]
    inertia = np.stack([np.trace(c) * np.eye(3) - c for c in moments])
    masses = Masses(("hips",) * joints, tuple(range(joints)), rng.uniform(0.5, 4, joints),
                    0.1 * rng.normal(size=(joints, 3)), inertia)  # fmt: skip
    return skeleton, motion, masses


@pytest.mark.parametrize("seed", range(3))
def test_power_goes_into_energy(seed):
    """The joints' power and the root's is the rate of kinetic and potential energy: no term may be missing."""
    skeleton, motion, masses = _waving(seed)
    kin = kinematics(skeleton, motion)
    loads = inverse_dynamics(skeleton, kin, masses, window=0.0)
    omega = np.asarray(angular_velocities(kin.rotations_world, kin.dt))
    above = np.concatenate([np.zeros_like(omega[:, :1]), omega[:, list(skeleton.parents[1:])]], axis=1)
    power = np.sum(np.asarray(loads.torque) * (omega - above), axis=(1, 2))
    power += np.sum(np.asarray(loads.force)[:, 0] * np.asarray(velocities(kin.positions_world[:, 0], kin.dt)), axis=1)

    centres = kin.positions_world + rotation.rotate(kin.rotations_world, jnp.asarray(masses.centre_joint)[None])
    speed = np.asarray(velocities(centres, kin.dt))
    turn = np.asarray(rotation.to_matrix(kin.rotations_world))
    inertia = turn @ np.asarray(masses.inertia_joint) @ np.swapaxes(turn, -1, -2)
    kinetic = 0.5 * np.einsum("s,tsa->t", masses.mass, speed**2)
    kinetic += 0.5 * np.einsum("tsa,tsab,tsb->t", omega, inertia, omega)
    potential = GRAVITY * np.asarray(centres)[..., 1] @ masses.mass
    rate = np.gradient(kinetic + potential, 1 / RATE)
    np.testing.assert_allclose(power[5:-5], rate[5:-5], atol=2e-3 * np.abs(rate).max())


def test_the_whole_needs_what_its_momentum_needs():
    skeleton, motion, masses = _waving(7)
    kin = kinematics(skeleton, motion)
    loads = inverse_dynamics(skeleton, kin, masses, window=0.0)
    com = np.asarray(centre_of_mass(kin, masses))
    acceleration = np.gradient(np.gradient(com, 1 / RATE, axis=0), 1 / RATE, axis=0)[5:-5]
    total = float(masses.total)
    expected = total * (acceleration + np.array([0, GRAVITY, 0]))
    np.testing.assert_allclose(loads.force[5:-5, 0], expected, atol=2e-3 * total * GRAVITY)


def test_standing(heavy):
    """At rest the ground carries the weight under the centre of mass, and nothing is left at the root."""
    motion = rest_motion(heavy.skeleton)[np.zeros(6, int)]
    kin, masses, soles = kinematics(heavy.skeleton, motion), mesh_masses(heavy), sole_boxes(heavy)
    loads = inverse_dynamics(heavy.skeleton, kin, masses, soles, np.ones((6, 2), bool))
    weight = GRAVITY * float(masses.total)
    np.testing.assert_allclose(np.sum(loads.ground_force, axis=1), [[0, weight, 0]] * 6, atol=1e-6)
    middle = np.sum(np.asarray(loads.ground_force)[..., 1:2] * np.asarray(loads.ground_point), axis=1) / weight
    com = np.asarray(centre_of_mass(kin, masses))
    np.testing.assert_allclose(middle[:, [0, 2]], com[:, [0, 2]], atol=1e-9)
    np.testing.assert_allclose(loads.force[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(loads.torque[:, 0], 0.0, atol=1e-6)
    # the raised arm hangs on the shoulder: mass times gravity times its lever
    arm = [k for k, r in enumerate(masses.roles) if r in ("left_upper_arm", "left_forearm", "left_hand")]
    joint = heavy.skeleton.joint("left_upper_arm")
    from motionfit.balance import centres_world

    lever = np.asarray(centres_world(kin, masses))[0, arm] - np.asarray(kin.positions_world)[0, joint]
    expected = np.cross(lever, GRAVITY * np.asarray(masses.mass)[arm, None] * np.array([0, 1, 0])).sum(0)
    np.testing.assert_allclose(loads.torque[0, joint], expected, atol=1e-6)
    # on one leg the ground pushes at the sole's edge, and what it cannot hold is missing at the root
    edge = inverse_dynamics(heavy.skeleton, kin, masses, soles, np.tile([False, True], (6, 1)))
    outside = support_distance(com, soles.corners_world(kin), np.tile([False, True], (6, 1)))
    missing = np.linalg.norm(np.asarray(edge.torque)[:, 0], axis=-1) / weight
    assert (np.asarray(outside) > 0.01).all()
    np.testing.assert_allclose(missing, outside, atol=1e-9)
    # that leg takes all, and the other one hangs
    one = inverse_dynamics(heavy.skeleton, kin, masses, soles, np.tile([True, False], (6, 1)))
    np.testing.assert_allclose(one.ground_force[:, 0, 1], weight, atol=1e-6)
    np.testing.assert_array_equal(one.ground_force[:, 1], 0.0)


def test_the_reaction_acts_at_the_zero_moment_point(average):
    """Found here from the root's wrench, in `balance` from the momenta about the centre of mass."""
    motion = mf.onto(samples.walk(cycles=1), average.skeleton)
    kin, masses, soles = kinematics(average.skeleton, motion), mesh_masses(average), sole_boxes(average)
    planted = np.tile([True, False], (motion.frame_count, 1))
    # on skis no reaction is outside the support
    soles = eqx.tree_at(lambda s: s.corners_joint, soles, np.asarray(soles.corners_joint) * np.array([60.0, 1.0, 60.0]))
    loads = inverse_dynamics(average.skeleton, kin, masses, soles, planted, ground=0.01)
    zmp = zero_moment_point(kin, masses, ground=0.01)
    # the two filter different signals, the segments' paths or the whole body's momenta: equal where those are smooth
    apart = np.linalg.norm(np.asarray(loads.ground_point)[6:-6, 0] - np.asarray(zmp.point_world)[6:-6], axis=-1)
    assert np.median(apart) < 2e-3 and apart.max() < 0.02
    np.testing.assert_allclose(loads.force[:, 0], 0.0, atol=1e-6)
    np.testing.assert_allclose(loads.torque[:, 0], 0.0, atol=1e-5)
    # both feet down: the same wrench, shared
    both = inverse_dynamics(average.skeleton, kin, masses, soles, np.ones_like(planted), ground=0.01)
    np.testing.assert_allclose(np.sum(both.ground_force, 1), np.sum(loads.ground_force, 1), atol=1e-6)
    np.testing.assert_allclose(both.torque[:, 0], 0.0, atol=1e-5)
    assert (np.asarray(both.ground_force)[..., 1] >= 0).all()
    # nobody stands: everything is missing at the root
    none = inverse_dynamics(average.skeleton, kin, masses, soles, np.zeros_like(planted))
    np.testing.assert_array_equal(none.ground_force, 0.0)
    np.testing.assert_allclose(none.force[:, 0], np.sum(loads.ground_force, 1), rtol=1e-9, atol=1e-6)


def test_torques_are_differentiable():
    skeleton, motion, masses = _waving(2, joints=4, frames=6)

    def total(turns):
        turned = mf.Motion(skeleton, motion.root, turns, jnp.asarray(1 / 60))
        loads = inverse_dynamics(skeleton, kinematics(skeleton, turned), masses)
        return jnp.sum(jnp.sin(0.01 * loads.torque))

    turns = jnp.asarray(motion.rotations)
    gradient, total = np.asarray(jax.jit(jax.grad(total))(turns)), jax.jit(total)
    direction = np.random.default_rng(0).normal(size=turns.shape)
    step = 1e-6
    slope = (float(total(turns + step * direction)) - float(total(turns - step * direction))) / (2 * step)
    assert np.isfinite(gradient).all() and float(np.sum(gradient * direction)) == pytest.approx(slope, rel=1e-5)


def test_mujoco_agrees():
    """The generalised forces of mj_inverse, for a tree of ball joints on a free root."""
    mujoco = pytest.importorskip("mujoco")
    skeleton, motion, masses = _waving(4, size=0.3)
    frames, joints = motion.rotations.shape[:2]

    def body(j: int) -> str:
        inner = "".join(body(k) for k in skeleton.children(j))
        joint = "<freejoint/>" if j == 0 else '<joint type="ball"/>'
        i = np.asarray(masses.inertia_joint)[j]
        inertia = f"{i[0, 0]} {i[1, 1]} {i[2, 2]} {i[0, 1]} {i[0, 2]} {i[1, 2]}"
        numbers = " ".join(map(str, skeleton.offsets[j] if j else np.zeros(3)))
        centre = " ".join(map(str, np.asarray(masses.centre_joint)[j]))
        return (f'<body pos="{numbers}">{joint}<inertial pos="{centre}" mass="{masses.mass[j]}" '
                f'fullinertia="{inertia}"/>{inner}</body>')  # fmt: skip

    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler balanceinertia="false" boundinertia="0"/><option gravity="0 {-GRAVITY} 0"/>'
        f"<worldbody>{body(0)}</worldbody></mujoco>"
    )
    # MuJoCo numbers bodies depth first
    order: list[int] = []

    def visit(j):
        order.append(j)
        for k in skeleton.children(j):
            visit(k)

    visit(0)
    rotations = np.asarray(motion.rotations)[:, order].reshape(frames, -1)
    qpos = np.concatenate([np.asarray(motion.root), rotations], axis=1)

    def velocity(a, b, dt):
        result = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, result, dt, a, b)
        return result

    # a ball joint's velocity is in the child's frame, so its rate of change is the acceleration itself
    half = np.stack([velocity(a, b, 1 / RATE) for a, b in zip(qpos, qpos[1:], strict=False)])
    data = mujoco.MjData(model)
    kin = kinematics(skeleton, motion)
    loads = inverse_dynamics(skeleton, kin, masses, window=0.0)
    zmp = zero_moment_point(kin, masses, window=0.0)
    turn = np.asarray(rotation.to_matrix(kin.rotations_world))
    for t in range(10, frames - 10, 9):
        data.qpos[:], data.qvel[:] = qpos[t], (half[t - 1] + half[t]) / 2
        data.qacc[:] = (half[t] - half[t - 1]) * RATE
        mujoco.mj_inverse(model, data)
        own = np.concatenate([np.asarray(loads.force)[t, 0], turn[t, 0].T @ np.asarray(loads.torque)[t, 0]])
        own = np.concatenate([own, *(turn[t, j].T @ np.asarray(loads.torque)[t, j] for j in order[1:])])
        np.testing.assert_allclose(own, data.qfrc_inverse, atol=1e-3 * np.abs(data.qfrc_inverse).max())
        # where a contact that carries the root's whole wrench has no horizontal moment
        force, moment = data.qfrc_inverse[:3], turn[t, 0] @ data.qfrc_inverse[3:6]
        assert zmp.load[t] == pytest.approx(force[1] / (GRAVITY * float(masses.total)), abs=1e-3)
        if zmp.load[t] > 0.3:
            x, y, z = np.asarray(motion.root)[t]
            there = [x + (moment[2] - y * force[0]) / force[1], z - (moment[0] + y * force[2]) / force[1]]
            np.testing.assert_allclose(np.asarray(zmp.point_world)[t, [0, 2]], there, atol=2e-3)
    assert joints == model.nbody - 1


def test_newton_euler_carries_a_load_to_the_root():
    """One force at the tip of a chain: every joint feels it, with its own lever."""
    skeleton = mf.Skeleton(["a", "b", "c"], [-1, 0, 1], np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0]]))
    kin = kinematics(skeleton, rest_motion(skeleton))
    forces = jnp.zeros((1, 3, 3)).at[0, 2].set(jnp.array([0.0, 5.0, 0.0]))
    force, torque = newton_euler(skeleton, kin.positions_world, forces, jnp.zeros((1, 3, 3)))
    np.testing.assert_allclose(force[0], [[0, 5, 0]] * 3)
    np.testing.assert_allclose(torque[0], [[0, 0, 10], [0, 0, 5], [0, 0, 0]])


# --- strength -----------------------------------------------------------------------------------------------------


def test_strength_limits():
    limits = strength_limits(75.0, 1.78, deviations=0.0)
    assert set(limits) == set(STRENGTH)
    # orders of magnitude of any dynamometer study of young men
    assert 180 < limits["knee_extension"] < 260 and 100 < limits["ankle_plantarflexion"] < 160
    assert 35 < limits["elbow"] < 80
    strong = strength_limits(75.0, 1.78)
    assert all(1.2 * limits[k] < strong[k] < 1.8 * limits[k] for k in limits)
    assert strength_limits(160.0, 1.76) == strength_limits(120.0, 1.76)  # fat does not pull
    with pytest.raises(mf.InputError, match="0 kg"):
        strength_limits(0.0, 1.7)
    with pytest.raises(mf.InputError, match="male, female"):
        strength_limits(70.0, 1.7, "x")


def test_a_crouch_strains_the_knees_and_a_lean_the_ankles(average):
    skeleton = average.skeleton
    motion = rest_motion(skeleton)[np.zeros(5, int)]
    rotations = np.array(motion.rotations)
    for side in ("left", "right"):
        for role, angle in (("thigh", -0.9), ("calf", 1.5), ("foot", -0.6)):
            joint = skeleton.joint(f"{side}_{role}")
            own = Rotation.from_quat(rotations[:, joint].copy(), scalar_first=True)
            rotations[:, joint] = (Rotation.from_rotvec([angle, 0, 0]) * own).as_quat(scalar_first=True)
    crouched = mf.Motion(skeleton, motion.root, rotations, motion.dt)
    masses, soles, both = mesh_masses(average), sole_boxes(average), np.ones((5, 2), bool)

    def actions(m):
        kin = kinematics(skeleton, m)
        ground = float(np.asarray(soles.corners_world(kin))[..., 1].min())
        loads = inverse_dynamics(skeleton, kin, masses, soles, both, ground=ground)
        return {k: float(v[2]) for k, v in joint_actions(skeleton, kin, loads).items()}

    standing, low = actions(motion), actions(crouched)
    assert low["left_knee_extension"] > standing["left_knee_extension"] + 30
    assert low["left_knee_flexion"] == 0.0


@pytest.mark.slow
def test_a_walk_is_feasible_and_the_same_walk_four_times_as_fast_is_not(average):
    motion = mf.onto(samples.walk(cycles=2), average.skeleton)
    masses = mesh_masses(average)
    soles, planted, ground = planted_feet(average, motion)
    kin = kinematics(average.skeleton, motion)
    found = feasibility(average.skeleton, kin, masses, soles, planted, 1.75, ground=ground)
    assert found.feasible, found.report()
    assert found.residual is not None and found.residual < 0.05
    fast = mf.Motion(motion.skeleton, motion.root, motion.rotations, float(motion.dt) / 4)
    kin = kinematics(average.skeleton, fast)
    strained = feasibility(average.skeleton, kin, masses, soles, planted, 1.75, ground=ground)
    assert not strained.feasible and "not feasible" in strained.report()
    assert all(np.isfinite(v) for v in [*strained.peak.values(), *strained.limit.values()])


def test_required_is_the_weight_at_rest(average):
    kin = kinematics(average.skeleton, rest_motion(average.skeleton)[np.zeros(4, int)])
    masses = mesh_masses(average)
    force, _ = required(kin, masses)
    np.testing.assert_allclose(np.sum(force, axis=1), [[0, GRAVITY * float(masses.total), 0]] * 4, atol=1e-6)
