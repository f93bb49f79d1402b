"""Skeleton and character scaling: the seven measures are met, the rest stays, feet stand where they stood."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics, rest_motion
from motionfit.shape.bodies import builtin_skeleton
from motionfit.shape.scaling import MEASURES, SEGMENTS, scale_character, scale_root, scale_skeleton, segment_scales

EXACT = 1e-9
SKELETON = builtin_skeleton("average")


def _measure(skeleton, name):
    """Each measure of figure 5.4, read off the bind pose."""
    p = bind_pose(skeleton)[0]
    waist, nape = skeleton.chain("spine")[0], skeleton.chain("neck")[0]

    def bone(a, b):
        return np.mean([np.linalg.norm(p[skeleton.joint(f"{s}_{a}")] - p[skeleton.joint(f"{s}_{b}")])
                        for s in ("left", "right")])  # fmt: skip

    hip = np.mean([p[skeleton.joint(f"{s}_thigh")][1] for s in ("left", "right")])
    pelvis, thigh, calf = p[waist][1] - hip, bone("thigh", "calf"), bone("calf", "foot")
    return {
        "scye": bone("clavicle", "upper_arm"), "upper_arm": bone("upper_arm", "forearm"),
        "forearm": bone("forearm", "hand"), "waist_knee": pelvis + thigh, "inside_leg": thigh + calf,
        "waist_height": pelvis + thigh + calf, "back": np.linalg.norm(p[nape] - p[waist]),
    }[name]  # fmt: skip


@pytest.mark.parametrize("name", MEASURES)
@pytest.mark.parametrize("scale", [0.5, 1.3])
def test_one_measure_is_met_and_scales_its_segments_alike(heavy, name, scale):
    for scaled in (scale_skeleton(heavy, {name: scale}), scale_character(heavy, {name: scale})):
        ratio = _measure(scaled.skeleton, name) / _measure(heavy.skeleton, name)
        assert ratio == pytest.approx(scale, abs=EXACT)
    scales = segment_scales(heavy.skeleton, {name: scale})
    for segment in SEGMENTS:
        assert scales[segment] == pytest.approx(scale if segment in MEASURES[name] else 1.0, abs=EXACT)


@given(st.fixed_dictionaries({s: st.floats(0.7, 1.4) for s in SEGMENTS}))
def test_all_measures_together_are_met(true):
    """From any scales of the segments: the measures determine them again."""
    length = {"pelvis": 0.1, "thigh": 0.4, "calf": 0.4}
    from motionfit.shape.scaling import _lengths

    length = _lengths(SKELETON)
    measures = {
        name: sum(true[s] * length[s] for s in parts) / sum(length[s] for s in parts)
        for name, parts in MEASURES.items()
    }
    found = segment_scales(SKELETON, measures)
    for segment in SEGMENTS:
        assert found[segment] == pytest.approx(true[segment], abs=1e-6)


def test_contradictions_are_said(heavy):
    with pytest.raises(mf.InputError, match="contradict each other"):
        segment_scales(heavy.skeleton, {"inside_leg": 1.5, "waist_height": 1.0, "waist_knee": 1.0})
    with pytest.raises(mf.InputError, match="unknown measure 'waist'; measures: scye"):
        segment_scales(heavy.skeleton, {"waist": 1.1})
    with pytest.raises(mf.InputError, match="0.1 to 5"):
        segment_scales(heavy.skeleton, {"back": 0.0})
    with pytest.raises(mf.InputError, match=r"mf|motionfit\.onto"):
        scale_root(rest_motion(heavy.skeleton), mf.Skeleton(["a"], [-1], np.zeros((1, 3))))


def test_ones_return_the_character_itself(heavy):
    for measures in ({}, dict.fromkeys(MEASURES, 1.0)):
        assert scale_skeleton(heavy, measures) is heavy
        assert scale_character(heavy, measures) is heavy


def test_the_mesh_follows_the_skeleton(heavy):
    scaled = scale_skeleton(heavy, {"inside_leg": 1.2, "upper_arm": 1.1})
    before, after = np.asarray(heavy.skin.vertices_bind), np.asarray(scaled.skin.vertices_bind)
    # the feet stand on the same floor, the rest is higher by what the legs gained
    assert after[:, 1].min() == pytest.approx(before[:, 1].min(), abs=2e-3)
    gained = bind_pose(scaled.skeleton)[0][0, 1] - bind_pose(heavy.skeleton)[0][0, 1]
    assert gained == pytest.approx(0.2 * _measure(heavy.skeleton, "inside_leg"), rel=0.05)
    assert after[:, 1].max() == pytest.approx(before[:, 1].max() + gained, abs=1e-6)
    # a vertex of the thigh alone keeps its distance to the bone and its share of the bone's length
    joints, weights = np.asarray(heavy.skin.joints), np.asarray(heavy.skin.weights)
    joint, knee = heavy.skeleton.joint("left_thigh"), heavy.skeleton.joint("left_calf")
    alone = np.flatnonzero((np.where(joints == joint, weights, 0).sum(1)) > 0.999)
    assert len(alone) > 20
    split = []
    for character, vertices in ((heavy, before), (scaled, after)):
        p = bind_pose(character.skeleton)[0]
        bone = p[knee] - p[joint]
        offset = vertices[alone] - p[joint]
        along = offset @ bone / (bone @ bone)
        split.append((along, np.linalg.norm(offset - along[:, None] * bone, axis=1)))
    np.testing.assert_allclose(split[1][0], split[0][0], atol=1e-6)
    np.testing.assert_allclose(split[1][1], split[0][1], atol=1e-6)


@pytest.mark.parametrize("scale", [scale_skeleton, scale_character])
def test_the_bind_pose_shows_the_mesh(heavy, scale):
    scaled = scale(heavy, {"back": 1.15, "forearm": 0.9, "scye": 1.1})
    kin = mf.forward_kinematics(scaled.skeleton, rest_motion(scaled.skeleton))
    np.testing.assert_allclose(mf.skin(scaled.skin, kin)[0][0], scaled.skin.vertices_bind, atol=1e-9)
    if scale is scale_character:
        assert scaled.skin is heavy.skin  # attached anew, not moved


def test_joints_that_no_measure_touches_keep_their_offsets(heavy):
    scaled = scale_skeleton(heavy, {"forearm": 1.2}).skeleton
    moved = {j for j in range(len(scaled.names))
             if not np.array_equal(np.asarray(scaled.offsets)[j], np.asarray(heavy.skeleton.offsets)[j])}  # fmt: skip
    on_forearm = {j for j, p in enumerate(scaled.parents) if (heavy.skeleton.nearest_role(p) or "").endswith("forearm")}
    assert moved and moved <= on_forearm


@pytest.mark.parametrize("scale", [0.8, 1.25])
def test_longer_legs_walk_further_with_the_feet_still_planted(average, scale):
    motion = mf.onto(samples.walk(cycles=2), average.skeleton)
    scaled = scale_skeleton(average, {"waist_height": scale})
    walked = scale_root(motion, scaled.skeleton)
    assert np.array_equal(walked.rotations, motion.rotations)
    path = [np.linalg.norm(np.asarray(m.root)[-1, [0, 2]] - np.asarray(m.root)[0, [0, 2]]) for m in (motion, walked)]
    assert path[1] / path[0] == pytest.approx(scale, rel=1e-6)
    foot = average.skeleton.joint("left_foot")
    first, second = host_kinematics(motion)[0][:, foot], host_kinematics(walked)[0][:, foot]
    # every foot path is the old one scaled, up to the thighs' offsets, which no measure widens: no new slide
    ankle = bind_pose(average.skeleton)[0][foot, 1]
    np.testing.assert_allclose(second[:, 1] - ankle, scale * (first[:, 1] - ankle), atol=0.012)
    slide = [np.linalg.norm(np.diff(p[:, [0, 2]], axis=0), axis=1)[25:40].max() for p in (first, second)]
    assert slide[1] < scale * slide[0] + 1e-3


def test_a_standing_body_of_any_length_stands(average):
    for measures in ({"inside_leg": 1.3}, {"waist_height": 0.8}, {"waist_knee": 1.1}):
        scaled = scale_skeleton(average, measures)
        standing = scale_root(rest_motion(average.skeleton), scaled.skeleton)
        feet = [average.skeleton.joint(f"{s}_foot") for s in ("left", "right")]
        before = host_kinematics(rest_motion(average.skeleton))[0][0, feet, 1]
        np.testing.assert_allclose(host_kinematics(standing)[0][0, feet, 1], before, atol=1e-6)
