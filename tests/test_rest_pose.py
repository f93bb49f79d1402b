"""Clips whose files hold no pose to rest in: one is found, and the motion looks the same on another body."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics
from motionfit.io import describe
from motionfit.io._rest_pose import t_pose_of
from motionfit.io.bvh import read_bvh, write_bvh

BONES = [
    (f"{side}_{a}", f"{side}_{b}")
    for side in ("left", "right")
    for a, b in (("thigh", "calf"), ("calf", "foot"), ("upper_arm", "forearm"), ("forearm", "hand"))
]


def bones_along_x(motion: mf.Motion, seed: int) -> mf.Motion:
    """The same motion with new axes for each joint: x along its bone, the others any way around it. All bones are in
    line at zero angles then."""
    skeleton, random = motion.skeleton, np.random.default_rng(seed)
    places, quaternions = bind_pose(skeleton)
    axes: list[Rotation] = []
    for joint, parent in enumerate(skeleton.parents):
        bones = [places[child] - places[joint] for child in skeleton.children(joint)] + [places[joint] - places[parent]]
        x = next(bone for bone in bones if np.linalg.norm(bone) > 1e-6)
        # hands and fingers go on as the arm does: that much such files agree on
        y = axes[parent].as_matrix()[:, 1] if "hand" in (skeleton.nearest_role(joint) or "") else random.normal(size=3)
        x = x / np.linalg.norm(x)
        z = np.cross(x, y) / np.linalg.norm(np.cross(x, y))
        axes.append(Rotation.from_matrix(np.stack([x, np.cross(z, x), z], axis=1)))
    world = host_kinematics(motion)[1]
    turned = [
        Rotation.from_quat(world[:, j], scalar_first=True) * Rotation.from_quat(q, scalar_first=True).inv() * axes[j]
        for j, q in enumerate(quaternions)
    ]
    offsets, local = np.array(skeleton.offsets, float), [turned[0]]
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        offsets[joint] = axes[parent].inv().apply(places[joint] - places[parent])
        local.append(turned[parent].inv() * turned[joint])
    rotations = np.stack([r.as_quat(scalar_first=True) for r in local], axis=1)
    return mf.Motion(mf.Skeleton(skeleton.names, skeleton.parents, offsets), motion.root, rotations, motion.dt)


def directions(motion: mf.Motion) -> np.ndarray:
    at = host_kinematics(motion)[0]
    v = np.stack([at[:, motion.skeleton.joint(b)] - at[:, motion.skeleton.joint(a)] for a, b in BONES], axis=1)
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def turned_apart(a: mf.Motion, b: mf.Motion, role: str) -> float:
    """Median over the frames of the angle [deg] between a joint's world orientations."""
    x, y = (Rotation.from_quat(host_kinematics(m)[1][:, m.skeleton.joint(role)], scalar_first=True) for m in (a, b))
    return float(np.median(np.rad2deg((x.inv() * y).magnitude())))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_a_clip_without_a_rest_pose_moves_another_body_the_same(seed, tmp_path, heavy):
    known = samples.walk()
    write_bvh(tmp_path / "x.bvh", bones_along_x(known, seed))
    found = read_bvh(tmp_path / "x.bvh")
    assert "found from the motion" in describe(tmp_path / "x.bvh")["rest_pose"]
    # the clip itself is what it was, in every frame
    np.testing.assert_allclose(host_kinematics(found)[0], host_kinematics(known)[0], atol=1e-4)
    before, after = (mf.onto(m, heavy.skeleton) for m in (known, found))
    np.testing.assert_allclose(directions(after), directions(known), atol=0.02)
    for role, most in (("thigh", 6), ("calf", 6), ("foot", 15), ("upper_arm", 40), ("forearm", 40)):
        for side in ("left", "right"):
            assert turned_apart(before, after, f"{side}_{role}") < most, (side, role)
    for role, most in (("hips", 15), ("chest", 10), ("head", 15)):
        assert turned_apart(before, after, role) < most, role


def test_the_pose_that_is_found_is_a_t_pose_facing_z(tmp_path):
    write_bvh(tmp_path / "x.bvh", bones_along_x(samples.walk(), 0))
    skeleton = read_bvh(tmp_path / "x.bvh").skeleton
    places = bind_pose(skeleton)[0]

    def way(a, b):
        v = places[skeleton.joint(b)] - places[skeleton.joint(a)]
        return v / np.linalg.norm(v)

    for side, sign in (("left", 1.0), ("right", -1.0)):
        for a, b, axis in (("upper_arm", "forearm", [sign, 0, 0]), ("forearm", "hand", [sign, 0, 0]),
                           ("thigh", "calf", [0, -1, 0]), ("calf", "foot", [0, -1, 0])):  # fmt: skip
            np.testing.assert_allclose(way(f"{side}_{a}", f"{side}_{b}"), axis, atol=0.03)
        assert way(f"{side}_foot", f"{side}_toe")[2] > 0.8
    assert way("hips", "head")[1] > 0.97
    assert way("right_thigh", "left_thigh")[0] > 0.99


def test_a_rest_pose_that_lies_is_set_upright(tmp_path, heavy):
    """As where a file was written with its character on the back, and turned upright by the root's angles only."""
    known = samples.walk()
    lying = Rotation.from_euler("x", 90, degrees=True)
    skeleton = known.skeleton
    places = bind_pose(skeleton)[0]
    offsets = np.array(skeleton.offsets, float)
    offsets[1:] = [lying.apply(places[j] - places[p]) for j, p in enumerate(skeleton.parents) if p >= 0]
    plain, rest = (Rotation.from_quat(np.asarray(q, float).reshape(-1, 4), scalar_first=True)
                   for q in (host_kinematics(known)[1], bind_pose(skeleton)[1]))  # fmt: skip
    frames, joints = known.frame_count, len(skeleton.names)
    away = plain * Rotation.from_quat(np.tile(rest.as_quat(), (frames, 1))).inv() * lying.inv()
    world = np.split(away.as_quat().reshape(frames, joints, 4), joints, axis=1)
    world = [Rotation.from_quat(w[:, 0]) for w in world]
    local = [w if p < 0 else world[p].inv() * w for w, p in zip(world, skeleton.parents, strict=True)]
    rotations = np.stack([r.as_quat(scalar_first=True) for r in local], axis=1)
    write_bvh(
        tmp_path / "x.bvh",
        mf.Motion(mf.Skeleton(skeleton.names, skeleton.parents, offsets), known.root, rotations, known.dt),
    )
    found = read_bvh(tmp_path / "x.bvh")
    assert describe(tmp_path / "x.bvh")["rest_pose"] == "all angles zero, set upright"
    np.testing.assert_allclose(host_kinematics(found)[0], host_kinematics(known)[0], atol=1e-4)
    for role in ("hips", "chest", "head", "left_upper_arm", "right_calf"):
        assert turned_apart(mf.onto(known, heavy.skeleton), mf.onto(found, heavy.skeleton), role) < 0.5, role


def test_files_that_stand_keep_the_rest_pose_they_have(shared_data):
    for path in [*sorted((shared_data / "bvh").glob("*.bvh"))[:4], *sorted((shared_data / "bvh_other").glob("*.bvh"))]:
        if path.name.startswith("rokoko"):
            continue
        motion, plain = read_bvh(path), read_bvh(path, rest_frame="none")
        rest = np.asarray(motion.skeleton.rest_rotations)
        first = np.asarray(plain.rotations)[0] if motion.frame_count < plain.frame_count else rest * 0 + [1, 0, 0, 0]
        np.testing.assert_array_equal(rest, first, err_msg=path.name)


def test_a_clip_captured_with_bones_along_x_stands_upright_on_a_body(shared_data):
    motion = mf.load_motion(shared_data / "bvh_other" / "rokoko_jesse_dance.bvh")
    body = mf.load_character("builtin:heavy")
    moved = mf.onto(motion, body.skeleton)
    np.testing.assert_allclose(directions(moved), directions(motion), atol=0.05)
    at = host_kinematics(moved)[0]
    trunk = at[:, body.skeleton.joint("head")] - at[:, body.skeleton.joint("hips")]
    assert (trunk[:, 1] > 0.6 * np.linalg.norm(trunk, axis=1)).all()
    # from the heel to the toe of the foot that carries: level
    feet = [at[:, body.skeleton.joint(f"{s}_toe")] - at[:, body.skeleton.joint(f"{s}_foot")] for s in ("left", "right")]
    low = np.argmin([at[:, body.skeleton.joint(f"{s}_foot"), 1] for s in ("left", "right")], axis=0)
    slope = np.choose(low, [f[:, 1] / np.linalg.norm(f, axis=1) for f in feet])
    standing = mf.detect_footplants(motion, body).planted.any(axis=1)
    own = body.skeleton
    rest = bind_pose(own)[0]
    level = np.mean([(rest[own.joint(f"{s}_toe")] - rest[own.joint(f"{s}_foot")])[1] for s in ("left", "right")])
    length = np.linalg.norm(rest[own.joint("left_toe")] - rest[own.joint("left_foot")])
    assert abs(np.median(slope[standing] if standing.any() else slope) - level / length) < 0.25


@given(seed=st.integers(0, 10_000), frames=st.integers(1, 4))
@settings(max_examples=20, deadline=None)
def test_any_tumble_has_a_pose(seed, frames, average):
    """However few frames there are, and whatever they show: bones in line with each other, or folded."""
    random = np.random.default_rng(seed)
    skeleton = average.skeleton
    turns = random.normal(size=(frames, len(skeleton.names), 4))
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    turns[random.random(turns.shape[:2]) < 0.5] = [1.0, 0.0, 0.0, 0.0]
    motion = mf.Motion(skeleton, np.zeros((frames, 3)), turns, np.asarray(0.01))
    rest = t_pose_of(motion)
    assert np.isfinite(rest).all()
    np.testing.assert_allclose(np.linalg.norm(rest, axis=-1), 1.0, atol=1e-9)
