"""General collisions and forearms: groups as data, touches kept, and the trap of the thesis's figure 4.9."""

from types import SimpleNamespace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.thesis import valley
from motionfit import samples
from motionfit._character import PARTS
from motionfit._control import Correction
from motionfit._motion import Motion, host_kinematics, joint_angles, rest_motion
from motionfit._solve import block_adjoint, block_solver, block_work, solve_block
from motionfit.adapt import Group, Sphere, Turn, multi_start
from motionfit.adapt._asked import Asked
from motionfit.adapt._collisions import (
    HELD,
    Attempt,
    Outcome,
    _seen_too_near,
    _weights,
    _windows,
    hands_meet,
    without_arms,
)
from motionfit.adapt._controls import turn_controls
from motionfit.adapt._easing import between, eased, sinking_skin
from motionfit.adapt._groups import GROUPS, MOST, PROBES, Meetings, arm_turns, known_depths
from motionfit.adapt._limits import SkinLooks
from motionfit.adapt._record import on_top
from motionfit.adapt._sampling import sampling
from motionfit.adapt._stages import smooth_floor
from motionfit.metrics import skin_depths, skin_gaps
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.splines import bspline_basis
from motionfit.terms import Direction
from motionfit.terms.penetration import hinge
from tests.helpers import central_difference, random_motion

RELATIVE = 1e-5  # analytic against central differences in double precision


def _as_fit(motion, base, character):
    return mf.Fit(Correction((), ()), motion, base, "converged", (), mf.Problem(character, base, {}, ()))


def _swung_in(average, cycles, moments):
    """The walk, and the walk with the left hand swung into the thigh around some frames."""
    base = mf.onto(samples.walk(cycles=cycles), average.skeleton)
    joint = average.skeleton.joint("left_upper_arm")
    time = np.arange(base.frame_count)
    swing = 0.35 * np.sum([np.exp(-(((time - moment) / 8.0) ** 2)) for moment in moments], axis=0)
    world = host_kinematics(base)[1][:, average.skeleton.parents[joint]]
    # about the forward axis, so that the hanging arm goes to the right
    axis = Rotation.from_quat(world, scalar_first=True).inv().apply([0.0, 0.0, -1.0])
    rotations = np.array(base.rotations)
    own = Rotation.from_quat(rotations[:, joint], scalar_first=True)
    rotations[:, joint] = (Rotation.from_rotvec(swing[:, None] * axis) * own).as_quat(scalar_first=True)
    return base, Motion(base.skeleton, base.root, rotations, base.dt)


@pytest.fixture(scope="module")
def sunk(average):
    return _swung_in(average, 1, (25,))


@pytest.mark.slow
def test_of_a_long_clip_only_what_is_wrong_is_solved(average):
    first = 60
    second = first + 4 * (samples.walk(cycles=6).frame_count // 6)  # the same moment of a later step
    base, bad = _swung_in(average, 6, (first, second))
    group = Group("hand/thigh", ("left_hand",), ("left_thigh",),
                  (Turn("arm_out", (("left_upper_arm", "forward", 1.0),)),
                   Turn("arm_ahead", (("left_upper_arm", "left", 1.0),))))  # fmt: skip
    shares = []
    fit = mf.adapt.collisions(base, average, _as_fit(bad, base, average), groups=(group,),
                              progress=lambda done, most: shares.append(done / most))  # fmt: skip
    told = fit.details["collisions"]["left_hand/left_thigh"]
    assert told["excess_before_m"] > 0.02 and told["excess_after_m"] < 0.01
    assert shares == sorted(shares) and 0.0 < shares[0] and shares[-1] <= 1.0
    moved = joint_angles(fit.motion, bad).max(axis=1)
    assert moved[[first, second]].min() > 0.05
    between = (first + second) // 2
    np.testing.assert_array_equal(fit.motion.rotations[between], bad.rotations[between])
    np.testing.assert_allclose(fit.correction.apply(fit.base).rotations, fit.motion.rotations, atol=1e-12)
    assert (mf.metrics.derivative_ratio(fit.motion, bad, 3) or 9.0) < 1.1


def test_windows_are_the_runs_of_what_is_wrong_and_what_is_beside_it():
    wrong = np.zeros(100, bool)
    wrong[[20, 24, 70, 99]] = True
    assert _windows(wrong, 10) == [slice(9, 35), slice(60, 81), slice(87, 100)]
    assert _windows(np.zeros(5, bool), 10) == [] and _windows(np.ones(5, bool), 10) == [slice(0, 5)]


@pytest.mark.slow
def test_what_sinks_in_where_it_is_taken_up_is_solved_in_more_frames_and_then_let_be(average, monkeypatch):
    base, bad = _swung_in(average, 6, (200,))
    out = Turn("arm_out", (("left_upper_arm", "forward", 1.0),))
    group, lengths = Group("hand/thigh", ("left_hand",), ("left_thigh",), (out,)), []

    def into_the_thigh(asked, *_):
        lengths.append(len(asked.at.frames))
        controls = turn_controls(asked.so_far.motion, asked.at.whole, [out])
        inwards = Correction(controls, (np.full(asked.at.basis.count, -0.35),))
        return Outcome(on_top(asked.so_far, inwards, asked.at), False, ())

    monkeypatch.setattr("motionfit.adapt._collisions._best", into_the_thigh)
    fit = mf.adapt.collisions(base, average, _as_fit(bad, base, average), groups=(group,))
    assert len(lengths) == 3 and lengths[0] < lengths[1] < lengths[2] < base.frame_count
    np.testing.assert_array_equal(fit.motion.rotations, bad.rotations)


@pytest.mark.slow
def test_a_hand_comes_out_of_the_thigh(sunk, average):
    base, bad = sunk
    turns = (
        Turn("arm_out", (("left_upper_arm", "forward", 1.0),)),
        Turn("arm_ahead", (("left_upper_arm", "left", 1.0),)),
    )
    group = Group("hand/thigh", ("left_hand",), ("left_thigh",), turns)
    fit = mf.adapt.collisions(base, average, _as_fit(bad, base, average), groups=(group,))
    told = fit.details["collisions"]["left_hand/left_thigh"]
    assert told["excess_before_m"] > 0.02 and told["excess_after_m"] < 0.01
    # away from the moment nothing moves by much, and the correction alone gives the motion again
    moved = np.abs(host_kinematics(fit.motion)[0] - host_kinematics(bad)[0]).max(axis=(1, 2))
    assert moved[-1] < 0.005 < moved[25]
    np.testing.assert_allclose(fit.correction.apply(fit.base).rotations, fit.motion.rotations, atol=1e-12)


@pytest.mark.slow
def test_what_sinks_in_on_the_skin_gives_way_there_and_nowhere_else(average):
    base = mf.onto(samples.walk(cycles=2), average.skeleton)
    at, turn = sampling(base, 2 / 60), Turn("arm_out", (("left_upper_arm", "forward", 1.0),))
    controls = turn_controls(base, at.whole, [turn])
    time = np.arange(at.basis.count) / (at.whole.count - 1)
    in_then_out = 0.3 * (np.exp(-(((time - 0.75) / 0.1) ** 2)) - np.exp(-(((time - 0.25) / 0.1) ** 2)))
    mine, so_far = Correction(controls, (in_then_out,)), _as_fit(base, base, average)
    whole, looks, small = on_top(so_far, mine, at), SkinLooks(base[at.frames], average, average, PAIRS), at.motion(base)
    looks.look_closer(joint_angles(at.motion(whole.motion), small).max(axis=1))
    result = eased("eased", so_far, whole, at, sinking_skin(looks, small, at))

    own = skin_depths(average, base, step=2).depth
    excess = [(skin_depths(average, fit.motion, step=2).depth - own).max() for fit in (whole, result)]
    assert excess[0] > 0.02 and excess[1] < 0.011
    np.testing.assert_allclose(result.correction.apply(result.base).rotations, result.motion.rotations, atol=1e-12)
    quarter = base.frame_count // 4
    turned, asked = (joint_angles(fit.motion, base).max(axis=1)[[quarter, 3 * quarter]] for fit in (result, whole))
    assert asked.min() > 0.25 and turned[0] < 0.7 * asked[0] and turned[1] > 0.99 * asked[1]


@pytest.mark.slow
def test_a_hand_that_left_the_head_comes_back_to_it_and_nothing_sinks_in(average):
    """The source touches the head; the arm was led out, as on a heavy body; on the skin the hand is back."""
    skeleton, walk = average.skeleton, mf.onto(samples.walk(cycles=2)[:120], average.skeleton)
    shoulder, elbow = (skeleton.joint(f"right_{part}") for part in ("upper_arm", "forearm"))

    def posed(turns, share):
        rotations = np.array(walk.rotations)
        for joint, turn in ((shoulder, turns[:3]), (elbow, turns[3:])):
            own = Rotation.from_quat(rotations[:, joint], scalar_first=True)
            turned = Rotation.from_rotvec(share[:, None] * turn) * own
            rotations[:, joint] = turned.as_quat(scalar_first=True)
        return Motion(skeleton, walk.root, rotations, walk.dt)

    touch = (Pair("right_hand", "head", ""),)
    hand, head = skeleton.joint("right_hand"), skeleton.joint("head")

    def far(x, exactly=True):
        motion = posed(x, np.ones(120))[60:61]
        if not exactly:
            places = host_kinematics(motion)[0][0]
            return abs(float(np.linalg.norm(places[hand] - places[head])) - 0.25)
        beside = skin_depths(average, motion).depth.max()
        return abs(float(skin_gaps(average, motion, touch)[0, 0]) - 0.003) + beside + 0.002 * float(np.linalg.norm(x))

    rng = np.random.default_rng(0)
    near = sorted((2.0 * rng.normal(size=6) for _ in range(200)), key=lambda x: far(x, False))[:12]
    there = minimize(far, min(near, key=far), method="Nelder-Mead", options={"maxfev": 150}).x
    share = gaussian_filter1d(np.clip(1.6 * np.exp(-(((np.arange(120) - 60) / 30.0) ** 2)), 0.0, 1.0), 4.0)
    source = posed(there, share)
    out = np.zeros(6)
    out[:3] = 0.25 * there[:3] / np.linalg.norm(there[:3])
    led_out = posed(there - out, share)
    touched = skin_gaps(average, source, touch)[:, 0] < 0.005
    assert touched.sum() >= 3 and skin_gaps(average, led_out, touch)[touched].min() > 0.02

    group = Group("hand/head", ("right_forearm", "right_hand"), ("head",), arm_turns("right"))
    fit = mf.adapt.collisions(source, average, _as_fit(led_out, source, average), reference=average, groups=(group,))
    assert skin_gaps(average, fit.motion, touch)[touched].max() <= 0.02
    assert (skin_depths(average, fit.motion).depth - skin_depths(average, source).depth).max() < 0.01
    told = fit.details["collisions"]["right_hand/head"]
    assert told["touching_before"] < 0.5 and told["touching_after"] == 1.0


@pytest.mark.slow
def test_arms_led_too_far_to_come_back_begin_again_without_it(sunk, average):
    """The hand of the source is at the thigh; the turns of the table do not reach back from where the arm was led."""
    source = sunk[1]
    out = Turn("arm_out", (("left_upper_arm", "forward", 1.0),), 0.5)
    at = sampling(source, 2 / 60)
    far = turn_controls(source, at.whole, [Turn("far_out", out.drives)])  # to a right angle
    led = Correction(far, (np.full(at.basis.count, 1.2),))
    so_far = on_top(_as_fit(source, source, average), led, at)
    group = Group("hand/thigh", ("left_hand",), ("left_thigh",), (out,))
    left = mf.adapt.collisions(source, average, so_far, reference=average, groups=(group,), worth=())
    assert left.motion is so_far.motion  # a touch that is not worth a solve
    fit = mf.adapt.collisions(source, average, so_far, reference=average, groups=(group,))
    told = fit.details["collisions"]["left_hand/left_thigh"]
    assert told["touching_before"] == 0.0 and told["touching_after"] == 1.0
    np.testing.assert_allclose(fit.correction.apply(fit.base).rotations, fit.motion.rotations, atol=1e-12)


@pytest.mark.slow
def test_where_more_shows_between_the_looks_the_rounds_go_on(sunk, average, monkeypatch):
    base, bad = sunk
    group = Group("hand/thigh", ("left_hand",), ("left_thigh",), (Turn("out", (("left_upper_arm", "forward", 1.0),)),))
    rounds, asked, one_round = [], [], Attempt._round

    def counted(self):
        rounds.append(self.rounds)
        one_round(self)

    def more_shows(self, motion):
        asked.append(len(rounds))
        assert joint_angles(motion, sampling(bad, 2 / 60).motion(bad)).max() > 0.01  # the result is what is looked at
        return True

    monkeypatch.setattr(Attempt, "_round", counted)
    monkeypatch.setattr(SkinLooks, "look_between", more_shows)
    fit = mf.adapt.collisions(base, average, _as_fit(bad, base, average), groups=(group,))
    assert len(asked) == 1 and 0 < asked[0] < len(rounds)
    assert fit.details["collisions"]["left_hand/left_thigh"]["excess_after_m"] < 0.01


def test_a_clip_without_collisions_comes_back(sunk, average):
    base, _ = sunk
    group = Group("hand/thigh", ("left_hand",), ("left_thigh",), (Turn("out", (("left_upper_arm", "forward", 1.0),)),))
    so_far = _as_fit(base, base, average)
    assert mf.adapt.collisions(base, average, so_far, groups=(group,)).motion is base


def test_a_sphere_is_its_centre_deeper_by_its_radius(average):
    motion = rest_motion(average.skeleton)
    # near the surface the field is a distance; far away it counts the way to its grid
    vertex = int(np.flatnonzero(average.part_of_vertex == PARTS.index("torso"))[0])
    small, big = (known_depths(average, (Group("x", (Sphere("hips", radius=r, vertex=vertex),), ("torso",), ()),))
                  for r in (0.0, 0.03))  # fmt: skip
    np.testing.assert_allclose(big.depths(motion) - small.depths(motion), 0.03, atol=1e-9)


def test_what_is_unknown_is_named(average):
    walk = samples.walk(cycles=1)[:2]
    so_far = _as_fit(mf.onto(walk, average.skeleton), mf.onto(walk, average.skeleton), average)
    with pytest.raises(mf.InputError, match="unknown part 'tail'"):
        mf.adapt.collisions(walk, average, so_far, groups=(Group("x", ("left_hand",), ("tail",), ()),))
    with pytest.raises(mf.InputError, match="axes: left, up, forward, bend, swing"):
        basis = bspline_basis(2, 1 / 60, 0.1)
        from motionfit.adapt._controls import turn_controls

        turn_controls(so_far.motion, basis, (Turn("x", (("left_hand", "sideways", 1.0),)),))


def test_the_tables_name_both_sides_and_all_five_groups():
    kinds = {g.name.partition("_")[2] for g in GROUPS}
    assert kinds == {"hand/torso", "hand/head", "hand/shoulder", "hand/legs", "leg/torso"}
    assert len(GROUPS) == 10


def _turned(motion, joint, axis, angle):
    q = jnp.asarray(motion.rotations)
    turn = mf.rotation.exp(angle * jnp.asarray(axis))
    return eqx.tree_at(lambda m: m.rotations, motion, q.at[:, joint].set(mf.rotation.multiply(turn[None], q[:, joint])))


def test_direction_is_the_thesis_s_objective_and_has_its_gradient():
    motion = random_motion(2, 5, 4)
    target = np.random.default_rng(1).normal(size=(4, 2, 3))
    target /= np.linalg.norm(target, axis=-1, keepdims=True)
    term = Direction((1, 2), (3, 4), target, 1.0)
    kin = mf.forward_kinematics(motion.skeleton, motion)
    # 4.7, with unit bones
    printed = -float(jnp.sum(term.directions(kin) * target))
    np.testing.assert_allclose(0.5 * float(jnp.sum(term.residual(kin) ** 2)) - target[..., 0].size, printed, atol=1e-12)

    @jax.jit
    def cost(x):
        return 0.5 * jnp.sum(
            term.residual(mf.forward_kinematics(motion.skeleton, _turned(motion, 0, [0.6, 0, 0.8], x[0]))) ** 2
        )

    x = np.array([0.3])
    np.testing.assert_allclose(jax.grad(cost)(x), central_difference(cost, x), rtol=RELATIVE, atol=1e-8)


def _contact(average, motion, groups, allowed, gap, weight, spacing=2 / 60):
    """A group's rows in a solve of all frames."""
    known, at = known_depths(average, groups), sampling(motion, spacing)
    meetings, probes = Meetings(known, at), known.probe_depths(motion)
    meetings.seen(probes, np.zeros(probes.shape[:2]), known.rows(probes))
    return known, at, meetings.term(allowed, gap, weight)


def test_contact_asks_only_for_what_was_lost(average):
    motion = mf.onto(samples.walk(cycles=1), average.skeleton)[:3]
    group = (Group("x", ("left_hand",), ("left_thigh",), ()),)
    apart = -known_depths(average, group).depths(motion)
    gap = np.array([[1.0], [apart[1, 0] - 0.02], [apart[2, 0] - 0.02]])
    known, at, term = _contact(average, motion, group, np.full((3, 1), 1e3), gap, np.array([[1.0], [1.0], [0.0]]))
    seen = motion[at.rows]
    joint = average.skeleton.joint("left_upper_arm")
    rows = np.asarray(eqx.filter_jit(lambda t: t.residual(mf.forward_kinematics(seen.skeleton, seen)))(term))
    assert rows.shape == (len(at.rows), PROBES + 1) and not rows[:, :-1].any()
    # near enough; 2 cm too far, less half the rounded corner, in units of 1 cm, by pseudo-Huber; without weight
    wide = 2.0 * np.sqrt(2 * (np.sqrt(1 + (1.9 / 2.0) ** 2) - 1))
    np.testing.assert_allclose(rows[:3, -1], [0.0, wide, 0.0], atol=1e-5)
    assert not rows[3:].any()  # what fills the bucket

    @jax.jit
    def cost(x):
        return 0.5 * jnp.sum(
            term.residual(mf.forward_kinematics(seen.skeleton, _turned(seen, joint, [0.6, 0, 0.8], x[0]))) ** 2
        )

    x = np.array([0.01])
    np.testing.assert_allclose(jax.grad(cost)(x), central_difference(cost, x), rtol=1e-4, atol=1e-6)


def test_a_solve_sees_the_deepest_points_of_the_nearest_parts_and_no_others(sunk, average):
    """What is computed for the meetings alone is what the fields say of all points in all frames."""
    _, motion = sunk
    motion, groups = motion[10:40], GROUPS[:8]
    known = known_depths(average, groups)
    depths, free = known.depths(motion), np.zeros((30, len(known.radius)))
    known, at, term = _contact(average, motion, groups, free, free, free)
    kin = mf.forward_kinematics(motion.skeleton, motion[at.rows])
    seen = np.asarray(eqx.filter_jit(lambda t: t.point_depths(kin))(term))
    frame, met = np.asarray(term.frame), np.asarray(term.met)
    real = np.asarray(term.allowed) < 1.0
    assert seen.shape == (len(frame), PROBES) and 0 < real.sum() < depths.size
    expected = depths[frame[real], met[real]]
    near = expected > -0.05  # farther away, other points are nearest than those that go deepest
    assert near.sum() > 50
    np.testing.assert_allclose(seen[real].max(axis=1)[near], expected[near], atol=2e-3)
    out = np.ones(depths.shape, bool)
    out[frame[real], met[real]] = False
    assert depths[out].max() < 0.0 < depths.max()  # nothing that sinks in is left out
    # and the rows of a frame are those of its own meetings
    rows = np.asarray(eqx.filter_jit(lambda t: t.residual(kin))(term)).reshape(len(at.rows), MOST, PROBES + 1)
    smooth = np.asarray(term.allowed)
    for t in (15, 20):
        mine = np.flatnonzero(real & (frame == t))
        expected = np.asarray(hinge(jnp.asarray(seen[mine] - smooth[mine, None]), 0.002) / 0.01)
        np.testing.assert_allclose(rows[t, : len(mine), :-1], expected, atol=1e-6)
        assert not rows[t, len(mine) :].any()


@pytest.mark.slow
def test_a_calf_comes_out_of_the_trunk(average):
    """The tables' own groups for the legs: the trunk straightens."""
    walk = mf.onto(samples.walk(cycles=1)[:16], average.skeleton)
    rotations = np.array(walk.rotations)
    for role, angle in (("left_thigh", -2.2), ("left_calf", 1.4), ("chest", 0.7)):
        joint = average.skeleton.joint(role)
        own = Rotation.from_quat(rotations[:, joint], scalar_first=True)
        rotations[:, joint] = (Rotation.from_rotvec([angle, 0.0, 0.0]) * own).as_quat(scalar_first=True)
    bent = Motion(walk.skeleton, walk.root, rotations, walk.dt)
    fit = mf.adapt.collisions(walk, average, _as_fit(bent, bent, average), reference=average, groups=GROUPS[8:])
    told = fit.details["collisions"]["left_calf/torso"]
    assert told["excess_before_m"] > 0.02 and told["excess_after_m"] < 0.5 * told["excess_before_m"]


def test_between_two_fits_is_either_of_them_at_the_ends(average):
    base = mf.onto(samples.walk(cycles=1)[:30], average.skeleton)
    at = sampling(base, 2 / 60)
    controls = turn_controls(base, at.whole, [Turn("arm_out", (("left_upper_arm", "forward", 1.0),))])
    so_far = _as_fit(base, base, average)
    whole = on_top(so_far, Correction(controls, (np.full(at.basis.count, 0.3),)), at)
    share = np.repeat([0.0, 0.5, 1.0], 10)
    some = between("half", so_far, whole, share)
    angles = joint_angles(some.motion, base).max(axis=1)
    np.testing.assert_allclose(angles, 0.3 * share, atol=1e-6)
    np.testing.assert_allclose(some.correction.apply(some.base).rotations, some.motion.rotations, atol=1e-12)
    bare = without_arms(whole)
    np.testing.assert_allclose(bare.motion.rotations, base.rotations, atol=1e-12)
    assert [c.name for c in bare.correction.controls] == [c.name for c in whole.correction.controls]


def test_the_wish_for_a_touch_is_whole_to_its_last_frame_and_fades_around_it():
    touching = np.zeros((60, 2), bool)
    touching[20:30, 0] = touching[45, 0] = True  # a touch that lasts, and one of a single frame
    weight = _weights(touching, 1 / 60)
    assert (weight[touching] == 1.0).all() and (weight[:, 1] == 0.0).all()
    assert (np.diff(weight[30:36, 0]) < 0.0).all() and 0.3 < weight[30, 0] < 1.0
    assert (weight[:3, 0] < 0.01).all()


def test_a_field_that_sees_a_touch_too_near_does_not_keep_it_away():
    dt, off = 1 / 60, np.zeros((60, 2))
    off[25:35, 0] = 0.02  # the field of the first row sees the touch 2 cm nearer than the skin shows it
    off[25:35, 1] = -0.02  # and that of the second farther: what keeps it out stays as it is
    more = _seen_too_near(off, dt)
    floor = smooth_floor(0.004 + more, dt)
    assert (floor[25:35, 0] > 0.019).all() and (more[:, 1] == 0.0).all()
    assert (more[off[:, 0] > 0.0, 0] == 0.02).all() and (more[[0, 10, 50, 59], 0] == 0.0).all()

    class Asked(Exception):
        pass

    def term(allowed, gap, weight):
        raise Asked(allowed, gap)

    attempt: Any = object.__new__(Attempt)
    attempt.asked = SimpleNamespace(at=SimpleNamespace(rows=np.arange(60), dt=dt), by_skin=True)
    attempt.meetings, attempt.off = SimpleNamespace(term=term), off
    attempt._hold = lambda: (None, np.ones((60, 2)))
    attempt.allowed, attempt.gap = np.full((60, 2), 0.004), np.full((60, 2), 0.012)
    with pytest.raises(Asked) as asked:
        attempt._solved()
    np.testing.assert_array_equal(asked.value.args[0], 0.004 + more)
    np.testing.assert_array_equal(asked.value.args[1], 0.012 - off)


def test_a_touch_is_judged_by_the_skin_and_all_else_by_the_fields(average):
    still = rest_motion(average.skeleton)
    attempt: Any = object.__new__(Attempt)
    depths, gap = np.array([[0.03, 0.03], [0.0, 0.03]]), np.array([[0.022, -0.03], [0.0, -0.03]])
    small = SimpleNamespace(motion=lambda motion: motion)
    known = SimpleNamespace(probe_depths=lambda motion: depths[..., None], rows=lambda probes: depths)
    attempt.asked = SimpleNamespace(at=small, known=known, gaps=lambda *_: gap, most=np.full((2, 2), 0.005), small=None,
                                    touching=np.array([[True, False], [False, True]]))  # fmt: skip
    attempt.looks = SimpleNamespace(own=np.zeros((1, 1)), shares=np.ones(1), depths=lambda _: np.zeros((1, 1)),
                                    depths_and_touches=lambda _: np.zeros((1, 1)))  # fmt: skip
    shown = attempt.judged(_as_fit(still, still, average))
    # where the skin shows a gap of 2.2 cm, and where it shows what the field does
    np.testing.assert_allclose(shown.over, [[-0.027, 0.025], [-0.005, 0.025]], atol=1e-12)
    np.testing.assert_allclose(shown.apart, [[0.022 - HELD, 0.0], [0.0, -0.03 - HELD]], atol=1e-12)


def test_by_default_hands_that_meet_nothing_cost_no_block(average):
    assert not hands_meet(samples.walk(cycles=1), average)


@pytest.mark.slow
def test_a_golfer_s_hands_stay_together_on_a_heavier_body(shared_data):
    body, average = (
        mf.load_character(shared_data / f"characters/{name}.glb") for name in ("athletic_female", "avg_male")
    )
    clip = mf.load_motion(shared_data / "bvh/64_01_golf_swing_two_hands.bvh")
    clip = clip[190:310]
    told = []
    fit = mf.adapt(clip, body, reference=average, progress=lambda name, done, total: told.append(name))
    assert "collisions" in told
    hands = (Pair("left_hand", "right_hand", ""),)
    original, at = mf.onto(clip, average.skeleton), np.arange(0, clip.frame_count, 6)
    touched = skin_gaps(average, original[at], hands)[:, 0] < 0.005
    assert touched.sum() >= 5 and (skin_gaps(body, fit.motion[at], hands)[touched] <= 0.02).mean() >= 0.9
    excess = skin_depths(body, fit.motion[at]).depth - skin_depths(average, original[at]).depth
    assert (excess > 0.01).any(axis=1).mean() <= 0.02


def test_multi_start_escapes_the_trap_of_figure_4_9():
    """A straight arm that should point away from the way it bends: the gradient at zero pushes the elbow against its
    bound, where the solver stays; twisting the shoulder first leads to the minimum."""
    problem = valley.trap()
    block, controls = valley.BLOCK, problem.controls

    def cost(correction):
        return valley.cost(problem, correction)

    # figure 4.9's surface: from zero, every step of the bend leads uphill
    zero = Correction.zero(controls)
    stuck = mf.fit(problem, (block,))
    assert cost(stuck.correction) > 0.99 * cost(zero)
    found = multi_start(problem, block)
    assert cost(found) < 0.5 * cost(zero)
    # the best within the bounds is a quarter turn of the shoulder, 30 degrees short of the target's plane
    np.testing.assert_allclose(np.clip(found["twist"], -np.pi / 2, np.pi / 2), np.pi / 2, atol=0.02)
    # a start of its own ends where the driver does
    work, solver = block_work(problem, block, tuple(jnp.asarray(p) for p in found.points)), block_solver(problem, block)
    again = solve_block(work, solver, 20, block_adjoint(solver))
    assert float(sum(again.after)) <= cost(found) + 1e-6


@pytest.mark.slow
def test_forearms_point_where_they_did(heavy, average):
    walk = samples.walk(cycles=1)
    arms = mf.adapt(walk, heavy, reference=average, blocks=("arms",))
    fit = mf.adapt.forearm(walk, heavy, arms, reference=average, hand=True)
    before, after = (mf.metrics.forearm_direction(f.motion, arms.base) for f in (arms, fit))
    assert before is not None and after is not None and after < 0.5 * before
    assert fit.motion.source is arms.motion.source is not None
    limit = np.maximum(arms.details["excess_after_m"], 0).max()
    pairs = tuple(p for p in mf.shape.PAIRS if p.name in arms.details["pairs"])
    own = mf.adapt.reference_depths(walk, heavy, average, pairs)
    depths = mf.adapt.volume_depths(mf.adapt.build_clearance(heavy, pairs), fit.motion) - own
    keep = [k for k, p in enumerate(pairs) if not p.first.endswith("upper_arm")]
    assert depths[:, keep].max() <= max(limit, 0.01)
    assert (mf.metrics.derivative_ratio(fit.motion, arms.base, 3) or 9.0) <= 1.05
    hands = [heavy.skeleton.joint(f"{s}_hand") for s in ("left", "right")]
    turned = [host_kinematics(m)[1][:, hands] for m in (arms.base, fit.motion)]
    np.testing.assert_allclose(np.abs((turned[0] * turned[1]).sum(-1)), 1.0, atol=1e-9)


def test_touches_are_held_on_the_skin_and_left_to_the_fields_where_it_was_not_asked(heavy, average):
    """A hand at a shoulder, where a field of one pose is off: the row that holds it says what the skin says."""
    clip = mf.onto(samples.walk(cycles=1), heavy.skeleton)[:60]
    groups = GROUPS[:4]
    known, at = known_depths(heavy, groups), sampling(clip, groups[0].spacing / 60.0)
    depths, small = known.depths(at.motion(clip)), at.motion(clip)
    row = [p[:2] for p in known.clearance.pairs].index(("left_hand", "left_thigh"))
    touching = np.zeros(depths.shape, bool)
    touching[10:20, row] = True
    so_far = _as_fit(clip, clip, heavy)
    asked = Asked(heavy, so_far, at, known, groups[0].turns, depths, depths, depths, touching, True)
    shown = skin_gaps(heavy, small[12:13], (known.clearance.pairs[row],))[0, 0]
    assert shown < 0.06
    for by_skin, near in ((True, True), (False, False)):
        attempt = Attempt(asked._replace(by_skin=by_skin), so_far, SkinLooks(small, heavy, average, PAIRS))
        hold, weight = attempt._hold()
        assert (attempt.weight[touching] == 1.0).all()
        held = np.asarray(hold.weight)[: len(at.frames)].sum(axis=1)
        np.testing.assert_allclose(held + weight[:, row], attempt.weight[:, row], atol=1e-6)
        assert (held[touching[:, row]] == (1.0 if near else 0.0)).all()
        if near:
            padded = small[np.minimum(np.arange(len(at.rows)), small.frame_count - 1)]
            told = np.asarray(hold.distance(mf.forward_kinematics(heavy.skeleton, padded)))[12]
            assert np.abs(told - shown).min() < 1e-4
