"""Clips whose files hold no pose to rest in: one is found, and the motion looks the same on another body."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics, rest_motion
from motionfit.io import describe
from motionfit.io._rest_pose import t_pose_of, with_standing_rest
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
    for role, most in (("thigh", 6), ("calf", 6), ("foot", 6), ("upper_arm", 8), ("forearm", 8)):
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


def on_the_back(motion: mf.Motion) -> mf.Motion:
    """The same motion on a skeleton whose zero pose lies, as files are that are turned upright by the root's angles."""
    lying, skeleton = Rotation.from_euler("x", 90, degrees=True), motion.skeleton
    places, quaternions = bind_pose(skeleton)
    offsets, world = np.array(skeleton.offsets, float), host_kinematics(motion)[1]
    offsets[1:] = [lying.apply(places[j] - places[p]) for j, p in enumerate(skeleton.parents) if p >= 0]
    turned = [
        Rotation.from_quat(world[:, j], scalar_first=True)
        * Rotation.from_quat(q, scalar_first=True).inv()
        * lying.inv()
        for j, q in enumerate(quaternions)
    ]
    local = [t if p < 0 else turned[p].inv() * t for t, p in zip(turned, skeleton.parents, strict=True)]
    rotations = np.stack([r.as_quat(scalar_first=True) for r in local], axis=1)
    return mf.Motion(mf.Skeleton(skeleton.names, skeleton.parents, offsets), motion.root, rotations, motion.dt)


def test_a_rest_pose_that_lies_is_set_upright(tmp_path, heavy):
    known = samples.walk()
    write_bvh(tmp_path / "x.bvh", on_the_back(known))
    found = read_bvh(tmp_path / "x.bvh")
    assert describe(tmp_path / "x.bvh")["rest_pose"] == "all angles zero, set upright"
    np.testing.assert_allclose(host_kinematics(found)[0], host_kinematics(known)[0], atol=1e-4)
    for role in ("hips", "chest", "head", "left_upper_arm", "right_calf"):
        assert turned_apart(mf.onto(known, heavy.skeleton), mf.onto(found, heavy.skeleton), role) < 0.5, role


@pytest.mark.parametrize("kind", ["bones along x", "on the back"])
def test_a_found_rest_pose_is_not_written_but_found_again(kind, tmp_path):
    """Also where the clip begins in T-pose and leads on from it: then a first frame would be taken for motion."""
    known = samples.walk(cycles=2)
    still = dataclasses.replace(rest_motion(known.skeleton), root=known.root[:1], dt=known.dt)
    eased = [Rotation.from_quat(np.asarray(m.rotations, float)[0], scalar_first=True) for m in (still, known)]
    way = (eased[0].inv() * eased[1]).as_rotvec()
    steps = [(eased[0] * Rotation.from_rotvec(s * way)).as_quat(scalar_first=True) for s in np.linspace(0, 1, 60)]
    begun = dataclasses.replace(known, root=np.concatenate([np.repeat(known.root[:1], 60, axis=0), known.root]),
                                rotations=np.concatenate([steps, known.rotations]))  # fmt: skip
    write_bvh(tmp_path / "x.bvh", bones_along_x(begun, 1) if kind == "bones along x" else on_the_back(begun))
    motion = read_bvh(tmp_path / "x.bvh")
    for name in ("y.bvh", "z.bvh"):
        write_bvh(tmp_path / name, motion)
        again = read_bvh(tmp_path / name)
        assert again.frame_count == begun.frame_count
        np.testing.assert_allclose(host_kinematics(again)[0], host_kinematics(motion)[0], atol=1e-5)
        turned = [Rotation.from_quat(np.asarray(m.skeleton.rest_rotations), scalar_first=True) for m in (motion, again)]
        assert np.rad2deg((turned[0].inv() * turned[1]).magnitude()).max() < 0.01
        motion = again


def test_a_bent_first_frame_that_was_asked_for_stays_the_rest_pose(tmp_path):
    known = samples.walk(cycles=1)
    bent = np.array(known.rotations)
    spine = known.skeleton.joint("spine_0")
    bent[0] = rest_motion(known.skeleton).rotations[0]
    bent[0, spine] = Rotation.from_euler("x", 50, degrees=True).as_quat(scalar_first=True)
    write_bvh(tmp_path / "x.bvh", dataclasses.replace(known, rotations=bent))
    first = read_bvh(tmp_path / "x.bvh", rest_frame="first")
    np.testing.assert_allclose(np.asarray(first.skeleton.rest_rotations)[spine], bent[0, spine], atol=1e-6)
    assert first.frame_count == known.frame_count - 1
    assert read_bvh(tmp_path / "x.bvh").frame_count == known.frame_count, "nobody rests bent by 50 degrees"


@pytest.mark.parametrize("seed", [0, 1])
def test_feet_without_toes_stand_flat(seed, heavy):
    known = samples.walk(cycles=2)
    along = bones_along_x(known, seed)
    roles = {role: along.skeleton.names[joint] for role, joint in along.skeleton.roles}
    renamed = [n if r not in ("left_toe", "right_toe") else f"tip{k}" for k, (n, r) in enumerate(
        (n, along.skeleton.role_of_joint.get(j)) for j, n in enumerate(along.skeleton.names))]  # fmt: skip
    toeless = mf.Skeleton(renamed, along.skeleton.parents, along.skeleton.offsets,
                          roles={r: n for r, n in roles.items() if not r.endswith("_toe")})  # fmt: skip
    assert toeless.find("left_toe") is None
    found = with_standing_rest(dataclasses.replace(along, skeleton=toeless))
    before, after = (mf.onto(m, heavy.skeleton) for m in (known, found))
    for side in ("left", "right"):
        assert turned_apart(before, after, f"{side}_foot") < 12, side


def test_a_foot_that_never_stands_hangs_at_right_angles(shared_data, heavy):
    known = mf.load_motion(shared_data / "bvh" / "49_18_balance_one_leg.bvh")
    found = with_standing_rest(bones_along_x(known, 0))
    before, after = (mf.onto(m, heavy.skeleton) for m in (known, found))
    assert turned_apart(before, after, "left_foot") < 10
    assert turned_apart(before, after, "right_foot") < 30


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
