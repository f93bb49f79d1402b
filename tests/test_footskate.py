"""Footskate removal: three methods on built-in and real clips, their measures, the command and the pictures."""

import json
import sys

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import bind_pose, host_kinematics, joint_angles, rest_motion
from motionfit.cli import main
from motionfit.feet import (
    Floor,
    hip_from_foot,
    load_labels,
    sole_paths,
)  # fmt: skip
from motionfit.feet._cycles import adaptive_threshold, find_constraints
from motionfit.feet._enforce import (
    Chain,
    _keep_foot_length,
    chain_effectors,
    chain_pose,
    descending_step,
    effector_path,
)
from motionfit.feet._knees import BRIEF, PRICE, _banded, _normal_blocks, calm_knees, knee_bend
from motionfit.feet._leg import _clearing, calm_feet, pass_over
from motionfit.metrics import derivative_ratio
from tests.helpers import jumping, knee_accelerations, random_motion, with_legs

SAME = 1e-9  # [m] "unchanged" in double precision


# --- the root method ----------------------------------------------------------------------------------------------------


def swaying(body: mf.Character, frames: int = 120) -> mf.Motion:
    """The body sways over a left foot that never moves, the right foot in the air."""
    skeleton, rest = body.skeleton, rest_motion(body.skeleton, 1 / 60)
    rotations = np.repeat(np.asarray(rest.rotations, float), frames, axis=0)
    time = np.arange(frames) / 60
    fixed = bind_pose(skeleton)[1]

    def turn(role: str, vectors: np.ndarray) -> None:
        joint = skeleton.joint(role)
        own = Rotation.from_quat(rotations[:, joint], scalar_first=True)
        rotations[:, joint] = (Rotation.from_rotvec(vectors) * own).as_quat(scalar_first=True)

    sway = np.sin(2 * np.pi * time)[:, None]
    turn("left_thigh", sway * [0.10, 0.05, 0.08] - [0.25, 0, 0])
    turn("left_calf", np.cos(3 * time)[:, None] * [0.1, 0, 0] + [0.4, 0, 0])
    turn("right_thigh", np.tile([-0.9, 0.0, 0.0], (frames, 1)))
    turn("right_calf", np.tile([1.2, 0.0, 0.0], (frames, 1)))
    motion = mf.Motion(skeleton, np.zeros((frames, 3)), rotations, 1 / 60)
    positions, world = host_kinematics(motion)
    foot, calf = skeleton.joint("left_foot"), skeleton.joint("left_calf")
    level = Rotation.from_quat(fixed[foot], scalar_first=True)
    rotations[:, foot] = (Rotation.from_quat(world[:, calf], scalar_first=True).inv() * level).as_quat(
        scalar_first=True
    )
    root = bind_pose(skeleton)[0][foot] + [0.3, 0.04, -0.2] - positions[:, foot]
    return mf.Motion(skeleton, root, rotations, 1 / 60)


def test_a_planted_foot_that_never_moves_changes_nothing(average):
    motion = swaying(average)
    assert np.ptp(motion.root, axis=0).max() > 0.05
    found = mf.remove_footskate(motion, average)
    assert set(found.plants.labels) == {"left"} and found.status == "converged"
    assert found.motion.rotations is motion.rotations
    np.testing.assert_allclose(found.motion.root, motion.root, atol=SAME)
    legs = mf.remove_footskate(motion, average, "leg-ik", lift=0.0)
    np.testing.assert_allclose(legs.motion.root, motion.root, atol=SAME)
    np.testing.assert_allclose(host_kinematics(legs.motion)[0], host_kinematics(motion)[0], atol=1e-8)


def test_skate_that_was_put_in_is_taken_out(average):
    """A swaying body that drifts over the floor comes back to where it was without the drift."""
    motion = swaying(average)
    drift = np.outer(np.arange(120) / 60, [0.15, 0.0, -0.1])
    skating = mf.Motion(motion.skeleton, np.asarray(motion.root) + drift, motion.rotations, motion.dt)
    found = mf.remove_footskate(skating, average)
    np.testing.assert_allclose(found.motion.root, motion.root, atol=1e-6)
    assert found.measure(skating)["slide_p95_m_s"] == pytest.approx(np.hypot(0.15, 0.1), rel=1e-6)


@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("path", ["scaled", "as it was"])
def test_root_method_on_longer_and_shorter_legs(average, scale, path):
    walk = samples.walk(cycles=4)
    body = with_legs(average, scale)
    motion = (
        mf.onto(walk, body.skeleton)
        if path == "scaled"
        else mf.Motion(body.skeleton, walk.root, walk.rotations, walk.dt)
    )
    found = mf.remove_footskate(motion, body)
    assert found.motion.rotations is motion.rotations
    after = found.measure(found.motion)
    assert after["slide_max_m_s"] * found.plants.dt < 1e-3 and after["slide_p95_m_s"] < 0.01
    way, source = (np.asarray(m.root)[-1, [0, 2]] - np.asarray(m.root)[0, [0, 2]] for m in (found.motion, walk))
    assert np.arccos(way @ source / np.linalg.norm(way) / np.linalg.norm(source)) < np.radians(5)
    assert np.linalg.norm(way) / np.linalg.norm(source) == pytest.approx(scale, rel=0.05)


def test_a_floor_may_be_given(average):
    walk = samples.walk(cycles=2)
    lifted = mf.Motion(walk.skeleton, np.asarray(walk.root) + [0, 0.3, 0], walk.rotations, walk.dt)
    plants = mf.detect_footplants(lifted, average)
    assert plants.floor.height == pytest.approx(0.3, abs=0.01)
    for method in ("root", "leg-ik", "adaptive"):
        found = mf.remove_footskate(lifted, average, method, floor=0.0)
        assert abs(np.mean(np.asarray(found.motion.root)[:, 1] - np.asarray(walk.root)[:, 1])) < 0.03
        assert found.measure(found.motion)["ground_penetration_max_m"] < 0.07  # the walk's own toes are 5 cm under
    for bad in (np.nan, np.inf):
        with pytest.raises(mf.InputError, match="floor"):
            mf.detect_footplants(walk, average, floor=bad)


def test_vertical_methods(average):
    walk = samples.walk(cycles=2)
    sunk = mf.Motion(walk.skeleton, np.asarray(walk.root) - [0, 0.05, 0], walk.rotations, walk.dt)
    plants = eqx.tree_at(lambda p: p.floor, mf.detect_footplants(sunk, average), Floor())
    kept = mf.remove_footskate(sunk, average, plants=plants, vertical="none").motion
    np.testing.assert_allclose(np.asarray(kept.root)[:, 1], np.asarray(sunk.root)[:, 1], atol=1e-12)
    each = mf.remove_footskate(sunk, average, plants=plants, vertical="frame")
    assert each.measure(each.motion)["ground_penetration_max_m"] < 1e-9
    with pytest.raises(mf.InputError, match="scale, frame, none"):
        mf.remove_footskate(walk, average, vertical="up")
    with pytest.raises(mf.InputError, match="root, leg-ik, adaptive"):
        mf.remove_footskate(walk, average, "magic")
    with pytest.raises(mf.InputError, match="frames for a clip"):
        mf.remove_footskate(walk[:9], average, plants=plants)
    with pytest.raises(mf.InputError, match="lift"):
        mf.remove_footskate(walk, average, "leg-ik", lift=3.0)


# --- legs --------------------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6))
def test_hierarchy_that_starts_at_a_foot(seed):
    """The hip computed from a foot puts that foot where it was asked for, with every other joint rotation the same."""
    motion = random_motion(seed, 9, 3)
    rng = np.random.default_rng(seed)
    place, turn = rng.normal(size=(3, 3)), Rotation.from_rotvec(rng.normal(size=(3, 3))).as_quat(scalar_first=True)
    root, hip = hip_from_foot(motion, 7, place, turn)
    moved = mf.Motion(motion.skeleton, root, np.concatenate([hip[:, None], motion.rotations[:, 1:]], axis=1), motion.dt)
    positions, rotations = host_kinematics(moved)
    np.testing.assert_allclose(positions[:, 7], place, atol=1e-12)
    assert (
        Rotation.from_quat(rotations[:, 7], scalar_first=True) * Rotation.from_quat(turn, scalar_first=True).inv()
    ).magnitude().max() < 1e-7
    # its own rotation: the root keeps its own too
    own = host_kinematics(motion)[1][:, 7]
    _, same = hip_from_foot(motion, 7, place, own)
    np.testing.assert_allclose(np.abs((same * np.asarray(motion.rotations)[:, 0]).sum(1)), 1.0, atol=1e-12)


@pytest.mark.parametrize("method", ["root", "leg-ik", "adaptive"])
def test_animated_translations_are_heeded_and_kept(average, method):
    walk = samples.walk(cycles=1)
    still = np.repeat(np.asarray(walk.skeleton.offsets)[None], walk.frame_count, axis=0)
    moving = mf.Motion(walk.skeleton, walk.root, walk.rotations, walk.dt, still)
    found, plain = (mf.remove_footskate(m, average, method) for m in (moving, walk))
    assert found.motion.translations is still
    np.testing.assert_allclose(found.motion.root, plain.motion.root, atol=1e-9)
    np.testing.assert_allclose(found.motion.rotations, plain.motion.rotations, atol=1e-9)


def test_both_feet_that_never_move_change_nothing(average):
    """Standing with feet at different heights (one on a plank): nothing to correct, so nothing is."""
    rest = rest_motion(average.skeleton, 1 / 60)
    rotations = np.repeat(np.asarray(rest.rotations), 60, axis=0)
    arm = average.skeleton.joint("left_upper_arm")
    wave = Rotation.from_rotvec(np.sin(np.arange(60) / 9)[:, None] * [0.3, 0.0, 0.2])
    rotations[:, arm] = (wave * Rotation.from_quat(rotations[:, arm], scalar_first=True)).as_quat(scalar_first=True)
    knee = average.skeleton.joint("right_calf")
    bent = Rotation.from_rotvec([0.1, 0, 0]) * Rotation.from_quat(rotations[:, knee], scalar_first=True)
    rotations[:, knee] = bent.as_quat(scalar_first=True)
    motion = mf.Motion(average.skeleton, np.repeat(np.asarray(rest.root), 60, axis=0), rotations, 1 / 60)
    found = mf.remove_footskate(motion, average)
    np.testing.assert_allclose(found.motion.root, motion.root, atol=SAME)
    assert found.details["scale"] == 1.0


def test_single_precision_agrees(average):
    """A motion of JAX's own arrays, as a fit returns it: the rotations are still the very same object."""
    walk = samples.walk(cycles=2)
    root, rotations, dt = (jnp.asarray(x, jnp.float32) for x in (walk.root, walk.rotations, walk.dt))
    single = mf.Motion(walk.skeleton, root, rotations, dt)
    found, double = mf.remove_footskate(single, average), mf.remove_footskate(walk, average)
    assert found.motion.rotations is single.rotations and found.motion.root.dtype == np.float32
    np.testing.assert_allclose(found.motion.root, double.motion.root, atol=5e-5)
    assert found.status == "converged"


def test_leg_ik_holds_both_feet_exactly_without_snapping(heavy):
    walk = samples.walk(cycles=3)
    found = mf.remove_footskate(walk, heavy, "leg-ik")
    assert found.reachable.all() and found.status == "converged"
    paths, plants = sole_paths(found.sole, found.motion), found.plants
    for plant in plants.plants:
        foot = 0 if plant.foot == "left" else 1
        for vertex in set(plants.vertex[plant.start : plant.end + 1, foot]):
            frames = plant.start + np.flatnonzero(plants.vertex[plant.start : plant.end + 1, foot] == vertex)
            held = paths[frames, found.sole.row(int(vertex))]
            assert np.ptp(held[:, [0, 2]], axis=0).max() < 1e-6
    base = found.base
    assert (derivative_ratio(found.motion, base, 2) or 9.0) < 1.2
    assert found.measure(found.motion)["ground_penetration_max_m"] < 0.02
    # only legs turn, and the feet keep their direction but for what trembles in a twentieth of a second
    turned = joint_angles(found.motion, base).max(0)
    legs = [base.skeleton.joint(f"{s}_{r}") for s in ("left", "right") for r in ("thigh", "calf", "foot", "toe")]
    assert np.delete(turned, legs).max() < 1e-12
    feet = [base.skeleton.joint(f"{s}_foot") for s in ("left", "right")]
    a, b = (
        Rotation.from_quat(host_kinematics(m)[1][:, feet].reshape(-1, 4), scalar_first=True)
        for m in (base, found.motion)
    )
    assert (a.inv() * b).magnitude().max() < np.radians(2)


@pytest.mark.parametrize("scale", [1.2, 1.4])
def test_a_sole_that_hangs_on_the_shank_holds_where_the_weight_goes_over_to_another_vertex(average, scale):
    """The next vertex has moved with the shank's skin by then: both have to be where the last step left them."""
    body = with_legs(average, scale)
    found = mf.remove_footskate(samples.walk(cycles=2), body, "leg-ik")
    assert found.status == "converged"
    assert found.measure(found.motion)["slide_max_m_s"] * found.plants.dt < 1e-5


def test_between_plants_a_foot_goes_the_calmest_way():
    frames, dt = 180, 1 / 60
    time = np.arange(frames)
    steps = np.where(time < 80, -0.001, -0.002)[:, None] * np.ones(2)
    plants = [(30, 60), (110, 140)]
    held = np.zeros((frames, 2))
    for start, end in plants:
        held[start : end + 1] = steps[start : end + 1] * (time[start : end + 1] - start)[:, None]
    moved = pass_over(held, plants, dt, anywhere=True)
    for start, end in plants:  # what holds a vertex is kept to the last digit, from a place near the foot's own
        np.testing.assert_allclose(np.diff(moved[start : end + 1], axis=0), np.diff(held[start : end + 1], axis=0),
                                   atol=1e-12)  # fmt: skip
        assert np.abs(moved[start : end + 1].mean(0)).max() < 0.01
    # speeds of 1 and 2 mm per frame are taken up and given back over more than ten frames, and nothing is left then
    assert np.abs(np.diff(moved, 2, axis=0)).max() < 0.5 * 0.002
    assert np.abs(moved[[0, 85, -1]]).max() < 0.15 * np.abs(moved).max()
    np.testing.assert_array_equal(pass_over(held, plants, dt, anywhere=False)[30:61], held[30:61])


def test_plants_with_a_blink_between_them_come_together():
    """A foot that drifts by 6 cm and blinks twice: each plant held amid its own drift would be thrown 2 cm between."""
    frames, plants = 120, [(0, 39), (42, 79), (82, 119)]
    drift = 0.0005 * np.arange(frames)[:, None]
    held = np.zeros((frames, 1))
    for start, end in plants:
        held[start : end + 1] = drift[start] - drift[start : end + 1]
    path = drift + pass_over(held, plants, 1 / 120, anywhere=True)
    assert np.abs(np.diff(path, axis=0)).max() < 0.005 and np.abs(np.diff(path, 2, axis=0)).max() < 0.002


def test_bend_of_a_knee_and_its_gain_against_geometry_and_differences(rng):
    thigh, shank = rng.normal(size=(2, 7, 3))
    lengths = np.linalg.norm(thigh, axis=1), np.linalg.norm(shank, axis=1)
    bend, gain = knee_bend(thigh + shank, *lengths)
    np.testing.assert_allclose(np.cos(bend), (thigh * shank).sum(1) / lengths[0] / lengths[1], atol=1e-12)
    for axis in np.eye(3):
        up, down = (knee_bend(thigh + shank + s * axis, *lengths)[0] for s in (1e-6, -1e-6))
        np.testing.assert_allclose(gain @ axis, (up - down) / 2e-6, rtol=1e-5, atol=1e-8)
    out_of_reach = knee_bend(2 * lengths[0].sum() * np.eye(3)[[0] * 7], *lengths)
    assert (out_of_reach[0] == 0).all() and np.isfinite(out_of_reach[1]).all()


def test_normal_equations_of_second_differences_in_bands(rng):
    frames = 7
    weight, gain = rng.uniform(size=(frames - 2, 1, 1)), rng.normal(size=(frames, 2, 3))
    rows = np.zeros((frames - 2, 2, frames, 3))
    for t in range(frames - 2):
        for k, factor in enumerate((1, -2, 1)):
            rows[t, :, t + k] = np.sqrt(weight[t, 0, 0]) * factor * gain[t + k]
    dense = rows.reshape(-1, 3 * frames)
    dense = dense.T @ dense
    bands = _banded(_normal_blocks(weight, gain))
    for below in range(9):
        np.testing.assert_allclose(bands[below, : 3 * frames - below], np.diagonal(dense, -below), atol=1e-12)


def trembling_leg(rng, frames: int = 24) -> tuple[np.ndarray, np.ndarray, tuple[np.ndarray, np.ndarray]]:
    """Chords of a nearly straight leg whose hip trembles by a millimetre over a foot that is held, and of the same leg
    when its foot trembled along; lengths of its bones."""
    source = np.tile([0.05, -0.835, 0.02], (frames, 1))
    held = source + 1e-3 * rng.normal(size=(frames, 3))
    return held, source, (np.full(frames, 0.43), np.full(frames, 0.42))


def test_hips_give_way_where_a_knee_would_snap_and_only_there(rng):
    held, source, bones = trembling_leg(rng)
    dt = 1 / 120

    def cost(move: np.ndarray) -> float:
        """A source knee at rest allows nothing: all of the knee's second difference counts."""
        knee = np.diff(knee_bend(held - move, *bones)[0], 2)
        own = (np.diff(move, 2, axis=0) ** 2).sum() + (dt / BRIEF) ** 4 * (move**2).sum()
        return float((knee**2).sum() + PRICE**2 * own)

    move = calm_knees([held], [source], [bones], dt)
    best = minimize(lambda m: 1e4 * cost(m.reshape(-1, 3)), np.zeros(held.size), tol=1e-9)
    assert cost(move) < 1.001 * 1e-4 * best.fun < 0.2 * cost(0 * move)
    assert np.abs(move).max() < 3e-3
    # as in the source, exactly nothing; and a clip of two frames has no acceleration
    assert not calm_knees([held, source], [held, source], [bones, bones], dt).any()
    assert not calm_knees([held[:2]], [source[:2]], [(bones[0][:2], bones[1][:2])], dt).any()
    # a knee that trembled more before may go on
    assert not calm_knees([source + 0.3 * (held - source)], [held], [bones], dt).any()


def test_trembling_feet_are_calmed_where_they_stand(average):
    """A standing body whose feet tremble by a degree: the tremor goes, what is in the air stays bit for bit."""
    rng = np.random.default_rng(4)
    still = jumping(average, 0.3)[0]
    rotations = np.array(still.rotations)
    foot = average.skeleton.joint("left_foot")
    shake = Rotation.from_rotvec(0.015 * rng.normal(size=(len(rotations), 3)))
    rotations[:, foot] = (Rotation.from_quat(rotations[:, foot], scalar_first=True) * shake).as_quat(scalar_first=True)
    shaking = mf.Motion(still.skeleton, still.root, rotations, still.dt)
    found = mf.remove_footskate(shaking, average, "leg-ik")
    down = np.flatnonzero(found.plants.planted[:, 0])[5:25]
    left, before = (
        joint_angles(m, still)[down, foot].mean() for m in (calm_feet(shaking, found.plants.vertex), shaking)
    )
    assert left < 0.5 * before
    air = ~found.plants.planted[:, 0]
    np.testing.assert_array_equal(calm_feet(shaking, found.plants.vertex).rotations[air], rotations[air])


def test_legs_that_cannot_reach_say_so_and_come_as_near_as_they_can(average):
    walk = samples.walk(cycles=2)
    flying = mf.Motion(walk.skeleton, np.asarray(walk.root) + [0, 0.05, 0], walk.rotations, walk.dt)
    plants = eqx.tree_at(lambda p: p.floor, mf.detect_footplants(flying, average), Floor())
    found = mf.remove_footskate(flying, average, "leg-ik", plants=plants, lift=0.0)
    assert not found.reachable.all() and found.status == "violations_left"
    assert np.isfinite(found.motion.rotations).all() and found.report()["unreachable_frames"] > 0
    positions, _ = host_kinematics(found.motion)
    for side, name in enumerate(("left", "right")):
        hip, knee, ankle = (positions[:, walk.skeleton.joint(f"{name}_{r}")] for r in ("thigh", "calf", "foot"))
        stretched = np.linalg.norm(ankle - hip, axis=1) / (
            np.linalg.norm(knee - hip, axis=1) + np.linalg.norm(ankle - knee, axis=1)
        )
        assert (stretched[~found.reachable[:, side]] > 0.999).all()
    # lowered as far as the legs need, they reach
    assert mf.remove_footskate(flying, average, "leg-ik", plants=plants).reachable.all()


@pytest.mark.parametrize("method", ["root", "leg-ik", "adaptive"])
def test_hard_clips_neither_raise_nor_give_nan(average, method):
    """Joints turned at random in every frame, far away, still, and with a frame that is a copy of the last."""
    rng = np.random.default_rng(11)
    skeleton, frames = average.skeleton, 40
    wild = Rotation.from_rotvec(2 * rng.normal(size=(frames * len(skeleton.names), 3))).as_quat(scalar_first=True)
    wild = wild.reshape(frames, -1, 4)
    wild[20:25] = wild[19]
    for root in (rng.normal(size=(frames, 3)), np.zeros((frames, 3)), 1e4 + rng.normal(size=(frames, 3))):
        found = mf.remove_footskate(mf.Motion(skeleton, root, wild, 1 / 30), average, method)
        assert np.isfinite(found.motion.root).all() and np.isfinite(found.motion.rotations).all()
        np.testing.assert_allclose(np.linalg.norm(found.motion.rotations, axis=-1), 1.0, atol=1e-6)
        assert json.dumps(found.report(), allow_nan=False)


# --- Glardon -----------------------------------------------------------------------------------------------------------


def test_adaptive_threshold_written_out():
    heights = np.array([0.20, 0.12, 0.05, 0.02, 0.06, 0.01, 0.03, 0.09, 0.16])
    # min 0.01, h = 0.18: eps = 0.01 + 0.4 * 0.17 = 0.078, from frame 2 on to frame 6, not split at frame 4
    assert adaptive_threshold(heights) == (2, 6)
    assert adaptive_threshold(np.full(5, 0.08)) == (0, 4)
    assert adaptive_threshold(heights, 1.0) == (1, 8)


def test_walking_cycles_get_heel_and_toe_of_both_feet(average):
    walk = samples.walk(cycles=3)
    found = find_constraints(walk)
    assert {(c.foot, c.part) for c in found} == {(0, 0), (0, 1), (1, 0), (1, 1)}
    per_joint = [[c for c in found if (c.foot, c.part) == k] for k in ((0, 0), (1, 1))]
    assert all(2 <= len(p) <= 4 for p in per_joint)
    for joint in per_joint:
        for a, b in zip(joint, joint[1:], strict=False):
            assert b.start > a.end


def test_effector_path_is_eq_9_and_continuous(rng):
    time = np.arange(80)
    own = np.column_stack([np.sin(time / 9), np.cos(time / 7), time / 40.0])
    goal, t1, t2, sigma = np.array([0.2, 0.0, 0.9]), 30, 50, 10
    printed = effector_path(own, [(t1, t2, goal)], sigma, smooth_speed=False)
    for t in (20, 25, 29):  # (9) with Gamma of (10)
        gamma = descending_step((t - t1 + sigma) / sigma)
        np.testing.assert_allclose(printed[t], own[t] + (1 - gamma) * (goal - own[t1]))
    for t in (51, 57):
        np.testing.assert_allclose(printed[t], own[t] + descending_step((t - t2) / sigma) * (goal - own[t2]))
    np.testing.assert_allclose(printed[t1 : t2 + 1], np.tile(goal, (21, 1)))
    np.testing.assert_array_equal(printed[:20], own[:20])
    calm = effector_path(own, [(t1, t2, goal)], sigma)
    speed = np.linalg.norm(np.diff(calm, axis=0), axis=1)
    most = np.linalg.norm(np.diff(own, axis=0), axis=1).max()
    assert (
        speed[t1 - 1] < 0.35 * most and np.linalg.norm(np.diff(printed, axis=0), axis=1)[t1 - 1] > 0.9 * speed[t1 - 1]
    )
    assert [float(descending_step(np.array(x))) for x in (0.0, 0.5, 1.0)] == [1.0, 0.5, 0.0]


def test_jacobians_of_the_leg_chain_against_differences(rng):
    hip, thigh, shank, foot = rng.normal(size=(4, 5, 3))
    axes = np.linalg.qr(rng.normal(size=(5, 3, 3)))[0]
    chain = Chain(hip, thigh, shank, foot, axes[:, 0], axes[:, 1:])
    for values in (0.4 * rng.normal(size=(5, 6)), np.zeros((5, 6)), 1e-5 * rng.normal(size=(5, 6))):
        points, jacobians = chain_effectors(chain, values)
        for k in range(6):
            step = np.zeros(6)
            step[k] = 1e-6
            up, down = (chain_effectors(chain, values + s * step)[0] for s in (1, -1))
            np.testing.assert_allclose(jacobians[..., k], (up - down) / 2e-6, atol=1e-8)
        np.testing.assert_allclose(points[1], chain_pose(chain, values).toe)


@pytest.mark.parametrize("body", ["average", "heavy"])
def test_adaptive_holds_heel_and_toe(body, request):
    character, walk = request.getfixturevalue(body), samples.walk(cycles=3)
    found = mf.remove_footskate(walk, character, "adaptive")
    assert found.details["ankle_error_max_m"] < 1e-4 and found.details["toe_error_max_m"] < 0.01
    assert found.reachable.all() and (derivative_ratio(found.motion, found.base, 2) or 9.0) < 1.2
    feet = [walk.skeleton.joint(f"{s}_{r}") for s in ("left", "right") for r in ("foot", "toe")]
    jump = [
        np.linalg.norm(np.diff(host_kinematics(m)[0][:, feet], 2, axis=0), axis=-1).max()
        for m in (found.motion, found.base)
    ]
    fastest = np.linalg.norm(np.diff(host_kinematics(found.base)[0][:, feet], axis=0), axis=-1).max()
    assert jump[0] < jump[1] + 0.05 * fastest


@pytest.mark.parametrize("scale", [0.7, 0.85, 1.0, 1.4])
def test_adaptive_never_makes_the_detected_plants_slide_more(average, scale):
    """The walk's feet roll and hardly slide: to hold joints that only pass by would make them slide twice as far."""
    body = with_legs(average, scale)
    motion = mf.onto(samples.walk(cycles=3), body.skeleton)
    plants = mf.detect_footplants(motion, body)
    found = mf.remove_footskate(motion, body, "adaptive")
    before, after = (mf.feet.measure_feet(body, m, plants) for m in (motion, found.motion))
    assert after["slide_path_m"] < before["slide_path_m"]
    assert after["slide_p95_m_s"] < max(before["slide_p95_m_s"], 0.03)
    # its own report speaks of the same plants
    np.testing.assert_array_equal(found.plants.planted, plants.planted)
    assert found.measure(found.motion)["slide_path_m"] == pytest.approx(after["slide_path_m"])


@pytest.mark.parametrize("method", ["root", "leg-ik", "adaptive"])
def test_status_says_when_a_planted_foot_still_slides(average, method):
    body = with_legs(average, 1.4)
    walk = samples.walk(cycles=1)
    skating = mf.Motion(body.skeleton, walk.root, walk.rotations, walk.dt)
    found = mf.remove_footskate(skating, body, method)
    slides = found.measure(found.motion)["slide_max_m_s"] * found.plants.dt
    assert found.status == ("converged" if slides <= 1e-3 else "violations_left")
    nothing_done = eqx.tree_at(lambda f: f.motion, found, found.base)
    assert nothing_done.status == "violations_left"


def test_a_joint_that_passes_by_is_not_held(average):
    walk = samples.walk(cycles=3)
    every, resting = find_constraints(walk), find_constraints(walk, resting=0.2)
    assert 0 < len(resting) <= len(every)
    joints = [[walk.skeleton.joint(f"{s}_{r}") for r in ("foot", "toe")] for s in ("left", "right")]
    positions = host_kinematics(walk)[0]
    for found, slow in ((every, False), (resting, True)):
        fastest = [
            np.linalg.norm(np.diff(positions[c.start : c.end + 1, joints[c.foot][c.part]], axis=0)[:, [0, 2]], axis=1)
            for c in found
        ]
        assert (max(f.max() for f in fastest if len(f)) < 0.25 * float(walk.dt)) == slow


def test_a_heel_that_never_comes_down_is_not_held(average):
    """On tiptoe (8) would still find a constraint for the heel, and put it on the floor."""
    walk = samples.walk(cycles=3)
    heels = [walk.skeleton.joint(f"{s}_foot") for s in ("left", "right")]
    standing = np.asarray(bind_pose(walk.skeleton)[0][:, 1]) * 1.0
    flat = find_constraints(walk, standing=standing)
    assert flat == find_constraints(walk) and any(c.part == 0 for c in flat)
    standing[heels] -= 0.08
    assert all(c.part == 1 for c in find_constraints(walk, standing=standing))


def test_an_ankle_that_gives_way_to_the_toe_is_back_where_its_own_hold_begins():
    """The toe is released five frames before the heel is held: the ease-out is shorter, the ankle does not jump."""
    frames = np.arange(60)
    foot = np.tile([0.0, -0.05, 0.15], (60, 1))
    ankle, toe = np.zeros((60, 3)), foot.copy()
    toe[20:] += [0.02, 0.0, 0.02]
    goals = [[(35, 59, ankle[0])], [(20, 29, toe[20])]]
    own = ankle.copy()
    _keep_foot_length(ankle, toe, goals, foot, 15)
    moved = np.linalg.norm(ankle - own, axis=1)
    assert moved[20:30].min() > 0.005 and (moved[35:] == 0).all()
    assert np.abs(np.diff(moved[frames >= 29])).max() < 0.5 * moved[29]


# --- measures ------------------------------------------------------------------------------------------------------------


def test_measures_by_hand():
    from motionfit import metrics

    paths = np.zeros((4, 2, 3))
    paths[:, 0, 0] = [0.0, 0.01, 0.03, 0.03]
    paths[:, 1, 2] = [0.0, 0.05, 0.05, 0.07]
    speeds = metrics.slide_speeds(paths, np.array([0, 0, 1, -1]), 0.1)
    np.testing.assert_allclose(speeds, [0.1, 0.0, np.nan])
    assert metrics.slide_path(speeds, 0.1) == pytest.approx(0.01)
    heights = np.array([[0.01, 0.2], [0.01, 0.2], [0.0, 0.2], [-0.02, 0.2]])
    assert metrics.ground_penetration(heights) == pytest.approx(0.02)
    planted = np.array([[True, False], [True, True], [False, True], [False, False]])
    assert metrics.floating(heights, planted) == pytest.approx(0.2)
    assert metrics.floating(heights, np.zeros((4, 2), bool)) is None
    # 2.5 cm in 50 ms is 0.5 m/s: nobody; at dt = 0.02 the first foot has 0.5, 1.0 and 0 m/s
    assert metrics.skate_ratio(paths, heights, 0.1) == 0.0
    assert metrics.skate_ratio(paths, heights, 0.02) == pytest.approx(1 / 3)
    # d (2 - 2^(h/H)) of the first foot alone: heights 1 cm, 1 cm, 0
    weights = 2 - 2 ** np.array([0.4, 0.4, 0.0])
    assert metrics.weighted_skate(paths, heights, 0.1) == pytest.approx((weights * [0.1, 0.2, 0.0]).sum() / 6)
    assert metrics.weighted_skate(paths[:1], heights[:1], 0.1) is None
    assert metrics.contact_preservation(planted, planted[::-1]) == pytest.approx(2 / 4)
    assert metrics.contact_preservation(planted, planted & False) is None


def test_measure_feet_of_a_motion_alone(average):
    found = mf.feet.measure_feet(average, samples.walk(cycles=2))
    assert found["slide_p95_m_s"] < 0.25 and found["contact_frames"] > 60
    assert 0 <= found["ground_penetration_max_m"] < 0.06 and found["slide_path_m"] > 0


# --- the command -----------------------------------------------------------------------------------------------------


def run(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["motionfit", "footskate", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return int(exit_.value.code or 0), capsys.readouterr().err


@pytest.mark.parametrize("method", ["root", "leg-ik", "adaptive"])
def test_command_writes_clip_report_labels_and_picture(method, monkeypatch, capsys, tmp_path):
    out, report, labels, plot = (tmp_path / n for n in ("o.glb", "r.json", "l.csv", "p.png"))
    code, _ = run(monkeypatch, capsys, "builtin:walk", "builtin:heavy", "--method", method, "-o", out, "--report", report,
                  "--save-labels", labels, "--plot", plot)  # fmt: skip
    assert code == 0 and plot.read_bytes()[:4] == b"\x89PNG"
    data = json.loads(report.read_text())
    assert data["schema"] == 1 and data["status"] == "converged" and data["footskate"]["method"] == method
    before, after = data["before"]["feet"], data["after"]["feet"]
    assert after["slide_path_m"] <= before["slide_path_m"]
    assert set(before) >= {"slide_max_m_s", "slide_p95_m_s", "slide_path_m", "contact_frames", "ground_penetration_max_m",
                           "floating_max_m"}  # fmt: skip
    assert len(load_labels(labels, data["frames"], 1 / 60)) > 6
    back = mf.load_motion(out)
    assert back.frame_count == data["frames"]
    code, _ = run(monkeypatch, capsys, "builtin:walk", "builtin:heavy", "--labels", labels, "-o", tmp_path / "o.bvh")
    assert code == 0


def test_pictures_are_drawn_without_a_display(average, tmp_path):
    from motionfit import view

    found = mf.remove_footskate(samples.walk(cycles=1), average)
    view.sole_picture(tmp_path / "sole.png", average, found.plants)
    view.curves_picture(tmp_path / "curves.png", average, found.base)
    view.snapshots_picture(tmp_path / "snapshots.png", average, found, count=2)
    view.reach_picture(tmp_path / "reach.png", np.array([-0.4, 0.1]), np.array([-0.4, -0.1]), samples=40)
    for name in ("sole", "curves", "snapshots", "reach"):
        assert (tmp_path / f"{name}.png").stat().st_size > 5000
    with pytest.raises(mf.InputError, match="cannot be written"):
        view.footprints_picture(tmp_path / "no" / "p.png", found)


def test_command_refuses_in_one_line(monkeypatch, capsys, tmp_path):
    (tmp_path / "l.csv").write_text("nonsense\n")
    for arguments, fact in (
        (("--method", "magic", "-o", tmp_path / "o.glb"), "root, leg-ik, adaptive"),
        (("--labels", tmp_path / "l.csv", "-o", tmp_path / "o.glb"), "foot,vertex,start,end"),
        (("-o", tmp_path / "no" / "o.glb"), "mkdir"),
        (("-o", tmp_path / "o.doc"), ".glb"),
    ):
        code, said = run(monkeypatch, capsys, "builtin:walk", "builtin:average", *arguments)
        assert code == 2 and fact in said and said.count("\n") == 1
    assert not list(tmp_path.glob("o*"))


# --- real clips ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def male(shared_data):
    return mf.load_character(shared_data / "characters" / "avg_male.glb")


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["bvh", "locomotion"])
def test_root_method_on_every_clip(shared_data, male, folder):
    for path in sorted((shared_data / folder).glob("*.bvh")):
        motion = mf.onto(mf.load_motion(path), male.skeleton)
        found = mf.remove_footskate(motion, male)
        assert found.motion.rotations is motion.rotations, path.name
        after = found.measure(found.motion)
        assert after["slide_max_m_s"] * found.plants.dt < 1e-3 and after["slide_p95_m_s"] < 0.01, path.name
        way, source = (np.asarray(m.root)[-1, [0, 2]] - np.asarray(m.root)[0, [0, 2]] for m in (found.motion, motion))
        if np.linalg.norm(source) > 1.0:
            assert abs(np.angle((way @ [1, 1j]) / (source @ [1, 1j]), deg=True)) < 5, path.name
        if path.stem.startswith(("run", "16_36", "16_42", "16_01", "16_05")):
            assert (found.plants.labels == "none").any(), path.name


def test_a_swinging_foot_is_led_over_the_floor_without_a_kink():
    time = np.arange(240) / 120
    planted = (time < 0.5) | (time > 1.5)
    tremor = 1e-3 * (-1.0) ** np.arange(240)
    heights = np.where(planted, 0.0, tremor - 0.02 * np.sin(np.pi * (time - 0.5)) ** 2)
    raised = _clearing(heights, planted, 1 / 120)
    assert (raised[planted] == 0).all() and (heights + raised).min() > -3e-3
    bounded = np.maximum(-heights, 0.0)  # what a bound in every frame would do
    assert np.abs(np.diff(raised, 2)).max() < 0.1 * np.abs(np.diff(bounded, 2)).max()
    assert not _clearing(np.abs(heights), planted, 1 / 120).any()


def test_knees_do_not_snap_where_feet_land(shared_data, male):
    for name in ("bvh/16_05_forward_jump", "bvh/16_36_run", "bvh/16_01_jump", "bvh/02_01_walk",
                 "bvh/16_42_run_90deg_left_turn", "bvh/05_03_dance_folding_arms", "bvh/64_01_golf_swing_two_hands",
                 "locomotion/walk_16_23", "locomotion/walk_49_01", "locomotion/run_16_48"):  # fmt: skip
        found = mf.remove_footskate(mf.load_motion(shared_data / f"{name}.bvh"), male, "leg-ik")
        after, before = (knee_accelerations(m) for m in (found.motion, found.base))
        assert (after.max(1) < 1.2 * before.max(1)).all() and after.mean() < 1.2 * before.mean(), name
        assert found.reachable.all() and (derivative_ratio(found.motion, found.base, 2) or 9.0) < 1.05, name


@pytest.mark.slow
def test_leg_ik_on_walks_runs_and_jumps(shared_data, male):
    for name in ("02_01_walk", "16_36_run", "16_05_forward_jump", "05_03_dance_folding_arms"):
        found = mf.remove_footskate(mf.load_motion(shared_data / "bvh" / f"{name}.bvh"), male, "leg-ik")
        assert found.status == "converged" and (derivative_ratio(found.motion, found.base, 2) or 9.0) < 1.2, name


@pytest.mark.slow
@pytest.mark.parametrize("scale", [0.7, 1.0, 1.4])
def test_adaptive_on_every_locomotion_clip(shared_data, male, scale):
    body = with_legs(male, scale)
    for path in sorted((shared_data / "locomotion").glob("*.bvh")):
        motion = mf.onto(mf.load_motion(path), body.skeleton)
        plants = mf.detect_footplants(motion, body)
        found = mf.remove_footskate(motion, body, "adaptive")
        before, after = (mf.feet.measure_feet(body, m, plants) for m in (motion, found.motion))
        assert after["slide_path_m"] < 0.5 * before["slide_path_m"], path.name
        assert found.details["ankle_error_max_m"] < 1e-4 and found.details["toe_error_max_m"] < 0.01, path.name
