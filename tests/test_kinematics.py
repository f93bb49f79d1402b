"""Forward kinematics against 4x4 products, skinning against rigid bodies."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit._motion import CONJUGATE, host_kinematics, host_matrices, host_product, joint_angles, rest_motion
from tests.helpers import matrices, motions, random_motion

EXACT = 1e-10  # positions of a metre over a dozen joints in double precision


@given(motions)
def test_forward_kinematics_agrees_with_matrix_products(arguments):
    motion = random_motion(*arguments)
    kin = mf.forward_kinematics(motion.skeleton, motion)
    for frame in range(motion.frame_count):
        oracle = matrices(motion, frame)
        np.testing.assert_allclose(kin.positions_world[frame], oracle[:, :3, 3], atol=EXACT)
        np.testing.assert_allclose(mf.rotation.to_matrix(kin.rotations_world[frame]), oracle[:, :3, :3], atol=EXACT)
    positions, rotations = host_kinematics(motion)
    np.testing.assert_allclose(positions, kin.positions_world, atol=EXACT)
    # of the last joint and those above it alone
    some, turned = host_kinematics(motion, [len(motion.skeleton.names) - 1])
    there = np.isfinite(some[0, :, 0])
    assert there[[0, -1]].all()
    np.testing.assert_allclose(some[:, there], positions[:, there], atol=EXACT)
    np.testing.assert_allclose(turned[:, there], rotations[:, there], atol=EXACT)


@given(st.integers(0, 2**31))
def test_products_on_the_host_are_those_of_rotations(seed):
    p, q = (Rotation.random(5, random_state=np.random.default_rng([seed, k])) for k in (0, 1))  # pyright: ignore[reportCallIssue]: the name before SciPy 1.15
    product = host_product(p.as_quat(scalar_first=True), q.as_quat(scalar_first=True))
    np.testing.assert_allclose(host_matrices(product), (p * q).as_matrix(), atol=EXACT)
    np.testing.assert_allclose(host_product(CONJUGATE * p.as_quat(scalar_first=True), product),
                               q.as_quat(scalar_first=True), atol=EXACT)  # fmt: skip


@given(motions)
def test_bind_pose_leaves_every_bind_point_where_it_is(arguments):
    motion = random_motion(*arguments)
    kin = mf.forward_kinematics(motion.skeleton, rest_motion(motion.skeleton))
    joints = len(motion.skeleton.names)
    turns, shifts = kin.skin_transforms()
    np.testing.assert_allclose(turns[0], np.tile(np.eye(3), (joints, 1, 1)), atol=EXACT)
    np.testing.assert_allclose(shifts[0], np.zeros((joints, 3)), atol=EXACT)


def test_translations_replace_the_offsets():
    motion = random_motion(3, 6, 4)
    offsets = np.tile(np.asarray(motion.skeleton.offsets), (4, 1, 1))
    moving = mf.Motion(motion.skeleton, motion.root, motion.rotations, motion.dt, offsets)
    a, b = (mf.forward_kinematics(m.skeleton, m).positions_world for m in (motion, moving))
    np.testing.assert_allclose(a, b, atol=EXACT)


@pytest.mark.parametrize(("seed", "joints", "frames"), [(0, 1, 1), (1, 2, 3), (2, 9, 2)])
def test_derivatives_in_closed_form_agree_with_differences(seed, joints, frames):
    """Of everything that a tree is made of, quaternions that leave the sphere too; and the derivative's own derivative,
    and the gradient as its transpose."""
    motion = random_motion(seed, joints, frames)
    rng, skeleton = np.random.default_rng(seed), motion.skeleton
    moving = np.tile(np.asarray(skeleton.offsets), (frames, 1, 1))
    start = tuple(jnp.asarray(x) for x in (motion.root, motion.rotations, moving, skeleton.offsets))
    ways = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in start)

    def kinematics(root, rotations, translations, offsets):
        body = eqx.tree_at(lambda s: s.offsets, skeleton, offsets)
        kin = mf.forward_kinematics(body, mf.Motion(body, root, rotations, motion.dt, translations))
        return kin.positions_world, kin.rotations_world, kin.positions_bind

    def along(step):
        return kinematics(*(x + step * way for x, way in zip(start, ways, strict=True)))

    def velocity(step):
        return jax.jvp(along, (step,), (1.0,))[1]

    h = 1e-5
    for fn, derivative in ((along, velocity), (velocity, lambda step: jax.jvp(velocity, (step,), (1.0,))[1])):
        if fn is velocity:  # off the sphere a second derivative is not that of a rotation
            ways = (ways[0], _tangential(ways[1], start[1]), *ways[2:])
        oracle = jax.tree.map(lambda a, b: (a - b) / (2 * h), fn(h), fn(-h))
        for told, expected in zip(derivative(0.0), oracle, strict=True):
            np.testing.assert_allclose(told, expected, atol=1e-6 * float(1 + jnp.abs(expected).max()))

    weights = tuple(jnp.asarray(rng.normal(size=x.shape)) for x in along(0.0))
    _, pull = jax.vjp(kinematics, *start)
    there = sum(jnp.vdot(w, v) for w, v in zip(weights, velocity(0.0), strict=True))
    back = sum(jnp.vdot(g, way) for g, way in zip(pull(weights), ways, strict=True))
    np.testing.assert_allclose(there, back, rtol=1e-9)


def _tangential(ways, quaternions):
    return ways - jnp.sum(ways * quaternions, axis=-1, keepdims=True) * quaternions


def test_skinning_moves_rigid_parts_as_trimesh_does():
    """Two boxes, each bound to one joint: the skin is the boxes under the joints' bind-to-world transforms."""
    motion = random_motion(11, 2, 5)
    boxes = [trimesh.creation.box((0.2, 0.3, 0.4)) for _ in range(2)]
    vertices = np.concatenate([b.vertices for b in boxes])
    faces = np.concatenate([boxes[0].faces, boxes[1].faces + len(boxes[0].vertices)])
    owner = np.repeat([0, 1], [len(b.vertices) for b in boxes])
    mesh = mf.Skin(vertices, faces, owner[:, None].astype(np.int32), np.ones((len(owner), 1)))
    posed, normals = mf.skin(mesh, mf.forward_kinematics(motion.skeleton, motion))
    bind = matrices(rest_motion(motion.skeleton), 0)
    for frame in range(5):
        world = matrices(motion, frame)
        for joint in range(2):
            part = boxes[joint].copy()
            part.apply_transform(world[joint] @ np.linalg.inv(bind[joint]))
            np.testing.assert_allclose(posed[frame][owner == joint], part.vertices, atol=EXACT)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=-1), 1.0, atol=EXACT)


def test_one_joint_moves_only_its_own_limb(average):
    skeleton, joint = average.skeleton, average.skeleton.joint("left_forearm")
    rest = rest_motion(skeleton)
    rotations = np.array(rest.rotations)
    rotations[:, joint] = Rotation.from_euler("Y", 50, degrees=True).as_quat(scalar_first=True)
    bent = mf.Motion(skeleton, rest.root, rotations, rest.dt)
    a, b = (mf.skin(average.skin, mf.forward_kinematics(skeleton, m))[0][0] for m in (rest, bent))
    below = [j for j in range(len(skeleton.names)) if _is_below(skeleton, j, joint)]
    touched = np.where(np.isin(average.skin.joints, below), average.skin.weights, 0).sum(1) > 0
    moved = np.linalg.norm(a - b, axis=1) > 1e-12
    assert moved.any() and not moved[~touched].any()


def _is_below(skeleton, joint, ancestor):
    while joint >= 0 and joint != ancestor:
        joint = skeleton.parents[joint]
    return joint == ancestor


def test_float32_agrees_with_float64():
    motion = random_motion(5, 10, 8)
    small = jax.tree.map(lambda x: jnp.asarray(x, jnp.float32) if isinstance(x, np.ndarray) else x, motion)
    a, b = (mf.forward_kinematics(m.skeleton, m).positions_world for m in (motion, small))
    assert b.dtype == jnp.float32
    np.testing.assert_allclose(a, b, atol=2e-5)  # ten joints of a metre in single precision


def test_resample_keeps_poses_and_duration():
    motion = random_motion(2, 4, 6, rate=30.0)
    fine = mf.resample(motion, 60.0)
    assert fine.frame_count == 11
    np.testing.assert_allclose(joint_angles(fine[::2], motion), 0.0, atol=1e-7)
    np.testing.assert_allclose(fine.root[::2], motion.root, atol=1e-12)
