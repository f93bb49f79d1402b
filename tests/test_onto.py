"""Clips onto characters."""

import numpy as np

import motionfit as mf
from motionfit import samples
from motionfit._motion import host_kinematics

LIMBS = [(f"{s}_{a}", f"{s}_{b}") for s in ("left", "right")
         for a, b in (("upper_arm", "forearm"), ("forearm", "hand"), ("thigh", "calf"), ("calf", "foot"))]  # fmt: skip


def _directions(motion):
    positions, _ = host_kinematics(motion)
    skeleton = motion.skeleton
    bones = np.stack([positions[:, skeleton.joint(b)] - positions[:, skeleton.joint(a)] for a, b in LIMBS], axis=1)
    return bones / np.linalg.norm(bones, axis=-1, keepdims=True)


def test_the_same_skeleton_gets_the_motion_back_bit_for_bit(average):
    walk = samples.walk(cycles=1)
    again = mf.onto(walk, average.skeleton)
    assert np.array_equal(again.rotations, walk.rotations) and np.array_equal(again.root, walk.root)
    assert mf.onto(again, average.skeleton) is again


def test_real_clip_on_a_pose_character_keeps_every_limb_direction(shared_data):
    """T-pose clip, A-pose characters with world-aligned and with bone-aligned frames: the bones point alike."""
    clip = mf.load_motion(shared_data / "bvh" / "02_01_walk.bvh")
    for name in ("avg_male", "heavy_male", "short_female"):
        body = mf.load_character(shared_data / "characters" / f"{name}.glb")
        placed = mf.onto(clip, body.skeleton)
        cosine = (_directions(placed) * _directions(clip)).sum(-1)
        assert np.rad2deg(np.arccos(np.clip(cosine, -1, 1))).max() < 0.01
        lowest = mf.metrics.posed_vertices(body, placed[::20])[..., 1].min(1)
        assert np.abs(lowest).max() < 0.06, "the soles are near the ground"


def test_root_path_scales_with_the_legs(average):
    walk = samples.walk(cycles=2)
    child = mf.load_character("builtin:child")
    placed = mf.onto(walk, child.skeleton)
    from motionfit._onto import leg_length

    ratio = leg_length(child.skeleton) / leg_length(average.skeleton)
    lengths = [np.ptp(m.root[:, 2]) for m in (placed, walk)]
    assert abs(lengths[0] / lengths[1] - ratio) < 1e-9
    assert abs(mf.metrics.posed_vertices(child, placed[::10])[..., 1].min(1)).max() < 0.045


def test_a_turned_rest_pose_walks_the_same_way(average):
    """A character whose bind pose faces the other way still walks where the clip walks."""
    from scipy.spatial.transform import Rotation

    walk = samples.walk(cycles=1)
    turn = Rotation.from_euler("Y", 180, degrees=True)
    skeleton = average.skeleton
    turned = mf.Skeleton(skeleton.names, skeleton.parents, turn.apply(skeleton.offsets), skeleton.rest_rotations,
                         end_parents=skeleton.end_parents, end_offsets=turn.apply(skeleton.end_offsets))  # fmt: skip
    placed = mf.onto(walk, turned)
    np.testing.assert_allclose(_directions(placed), _directions(walk), atol=1e-9)


def test_hips_that_move_under_a_root_on_the_floor_take_the_body_along(average, heavy, tmp_path):
    """As in game rigs: the root stays where it is, and the hips have a path of their own."""
    walk = samples.walk(cycles=1)
    skeleton, frames = walk.skeleton, walk.frame_count
    unturned = np.array([[1.0, 0.0, 0.0, 0.0]])
    offsets = np.concatenate([np.zeros((1, 3)), skeleton.offsets])
    rooted = mf.Skeleton(("Root", *skeleton.names), (-1, *(p + 1 for p in skeleton.parents)), offsets,
                         np.concatenate([unturned, skeleton.rest_rotations]))  # fmt: skip
    places = np.tile(offsets, (frames, 1, 1))
    places[:, 1] = walk.root
    rotations = np.concatenate([np.tile(unturned, (frames, 1, 1)), walk.rotations], axis=1)
    clip = mf.Motion(rooted, np.zeros((frames, 3)), rotations, walk.dt, places)
    mf.save(tmp_path / "rooted.bvh", clip)
    expected = host_kinematics(mf.onto(walk, heavy.skeleton))[0]
    for motion, atol in ((clip, 1e-9), (mf.load_motion(tmp_path / "rooted.bvh"), 1e-4)):
        np.testing.assert_allclose(host_kinematics(mf.onto(motion, heavy.skeleton))[0], expected, atol=atol)
    # and the other way round: such a body goes where the hips of a clip go
    np.testing.assert_allclose(host_kinematics(mf.onto(walk, rooted))[0][:, 1:], host_kinematics(walk)[0], atol=1e-9)
