"""The balance block: the zero-moment point comes back to where it was allowed, the feet stay, and quiet clips too."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._control import Control, Correction, Drive
from motionfit._motion import Motion, continued, host_kinematics, joint_angles, padded, rest_motion
from motionfit.adapt._balance import _cleaned, _jerky, _Leaned, _sinking, _stood
from motionfit.adapt._controls import lean_controls
from motionfit.adapt._limits import MOST_JERK
from motionfit.adapt._record import recorded
from motionfit.adapt._sampling import sampling
from motionfit.adapt._stages import SIGMA_EFFORT
from motionfit.metrics import TOLERANCE, derivative_ratio, skin_depths
from motionfit.shape import grow
from motionfit.shape.pairs import PAIRS, pairs_of
from motionfit.splines import bspline_basis, per_frame
from motionfit.terms import JointTracking, Standing
from tests.helpers import central_difference, random_motion

PLANTED = 0.002  # [m] that a planted foot may move
RELATIVE = 1e-5  # analytic against central differences in double precision


@pytest.fixture
def hops(shared_data):
    clip = mf.load_motion(shared_data / "bvh/131_03_start_hop_stop.bvh")[411:891]
    return clip, *(mf.load_character(shared_data / f"characters/{n}.glb") for n in ("heavy_male", "avg_male"))


def _alone(clip, character):
    base = mf.onto(clip, character.skeleton)
    return mf.Fit(Correction((), ()), base, base, "converged", (), mf.Problem(character, base, {}, ()))


def _bent(average, axis):
    """The walk, the trunk bent by 14 degrees at its lowest joint, about an axis of its parent's."""
    walk = samples.walk(cycles=1)
    joint, basis = average.skeleton.chain("spine")[0], per_frame(walk.frame_count)
    control = Control("bend", (Drive(joint, np.array(axis) / np.linalg.norm(axis), 1.0),), basis)
    bent = Correction((control,), (np.full(basis.count, np.deg2rad(14.0)),))
    return walk, bent.apply(mf.onto(walk, average.skeleton))


def test_thick_thighs_are_balanced_without_sinking_into_each_other(shared_data):
    """A lean brings the thighs nearer, in some frames too near: the weight is shifted in others for it."""
    clip = mf.load_motion(shared_data / "bvh/05_01_slow_walk.bvh")[:240]
    own = mf.load_character(shared_data / "characters/avg_male.glb")
    thick = grow(own, {"trunk": 1.087, "legs": 1.27})
    fit = mf.adapt(clip, thick, reference=own, blocks=("arms", "legs", "balance"))
    told, legs = fit.details["balance"], pairs_of("legs")
    assert told["zmp_distance_before_m"] > 0.06 and fit.status == "converged"
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001
    assert len([h for h in fit.history if h.name == "balance"]) <= 5  # the effort is raised fast enough
    excess = (
        skin_depths(thick, fit.motion, legs, step=2).depth
        - skin_depths(own, mf.onto(clip, own.skeleton), legs, step=2).depth
    )
    assert excess.max() <= TOLERANCE


@pytest.mark.slow
def test_straight_knees_come_down_without_a_jolt(average):
    """At heel strike a leg is nearly straight: the body came down within two frames for it, in a walk that is smooth
    everywhere else, and the lean was taken back for that."""
    thick, walk = grow(average, {"legs": 1.3}), samples.walk(cycles=2)
    fit = mf.adapt(walk, thick, reference=average, blocks=("legs", "balance"))
    told = fit.details["balance"]
    assert told["zmp_distance_before_m"] > told["zmp_distance_source_m"] + 0.02 and fit.status == "converged"
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001
    assert (derivative_ratio(fit.motion, fit.base, 3) or 0.0) <= MOST_JERK


@pytest.mark.slow
def test_what_only_the_fields_see_between_thighs_takes_no_balance_away(shared_data):
    """A pirouette on one leg: the fields see thighs 3 cm in each other, the skin none at all."""
    clip = mf.load_motion(shared_data / "bvh/05_11_sideways_steps_pirouette.bvh", fps=60.0)[60:180]
    body, own = (mf.load_character(shared_data / f"characters/{n}.glb") for n in ("heavy_male", "avg_male"))
    fit = mf.adapt(clip, body, reference=own, blocks=("legs", "balance"))
    told = fit.details["balance"]
    assert told["zmp_distance_before_m"] > 0.3 and fit.status == "converged"
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001


@pytest.fixture(scope="module")
def leaning(average):
    """Bent sideways."""
    return _bent(average, [0.0, 0.0, 1.0])


@pytest.mark.slow
def test_a_leaning_walk_is_brought_back(leaning, average):
    walk, bent = leaning
    so_far = mf.Fit(Correction((), ()), bent, bent, "converged", (), mf.Problem(average, bent, {}, ()))
    fit = mf.adapt.balance(walk, average, so_far, reference=average)
    told = fit.details["balance"]
    assert told["zmp_distance_before_m"] > told["zmp_distance_source_m"] + 0.002
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001
    feet = [average.skeleton.joint(f"{s}_{r}") for s in ("left", "right") for r in ("foot", "toe")]
    before, after = (host_kinematics(m)[0] for m in (bent, fit.motion))
    assert np.abs(after[:, feet] - before[:, feet]).max() < PLANTED
    assert (derivative_ratio(fit.motion, bent, 3) or 9.0) <= 1.05
    # the correction alone gives the motion again
    again = fit.correction.apply(fit.base)
    np.testing.assert_allclose(joint_angles(again, fit.motion), 0.0, atol=1e-7)
    np.testing.assert_array_equal(again.root, fit.motion.root)


def test_a_clip_on_its_own_body_comes_back(average):
    walk = samples.walk(cycles=1)
    so_far = _alone(walk, average)
    fit = mf.adapt.balance(walk, average, so_far, reference=average)
    assert fit.motion is so_far.motion and fit.correction is so_far.correction


def test_all_frames_are_measured_not_only_those_that_the_solver_sees(average):
    walk = samples.walk(cycles=1, frame_rate=120.0)
    told = mf.adapt.balance(walk, average, _alone(walk, average), reference=average).details["balance"]
    down = mf.detect_footplants(walk, average).planted.any(1)
    assert told["supported_frames"] > 0.9 * down.sum()


def test_a_scale_that_makes_cartoons_is_said(average):
    walk = samples.walk(cycles=1)
    with pytest.warns(UserWarning, match="cartoon"):
        mf.adapt.balance(walk[:1], average, _alone(walk[:1], average), reference=average, scale=0.5)
    with pytest.raises(mf.InputError, match="0 to 2"):
        mf.adapt.balance(walk, average, _alone(walk, average), scale=-1.0)


@pytest.mark.slow
def test_no_more_balance_than_was_asked_for(average):
    """Bent forward and sideways one foot's frames are nearer to their support and the other's farther: brought back to
    their thresholds, the mean would fall to 0.87 of the source's."""
    walk, bent = _bent(average, [1.0, 0.0, 1.0])
    so_far = mf.Fit(Correction((), ()), bent, bent, "converged", (), mf.Problem(average, bent, {}, ()))
    told = mf.adapt.balance(walk, average, so_far, reference=average).details["balance"]
    assert told["zmp_distance_before_m"] > told["zmp_distance_source_m"] + 0.001
    assert 0.97 * told["zmp_distance_source_m"] <= told["zmp_distance_after_m"]
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.0005


@pytest.mark.parametrize(("gaze", "shoulders"), [(True, True), (True, False), (False, True)])
def test_a_bent_spine_takes_along_what_is_not_kept(average, gaze, shoulders):
    """Thesis 5.5.2: the opposite of the spine's turn on head and shoulders keeps their orientation in the world."""
    walk = mf.onto(samples.walk(cycles=1), average.skeleton)
    controls = lean_controls(average, walk, bspline_basis(walk.frame_count, float(walk.dt), 0.1), gaze, shoulders)
    bent = Correction(controls, tuple(np.full(np.shape(p), 0.2 if c.name == "spine_sideways" else 0.0)
                                      for c, p in zip(controls, Correction.zero(controls).points, strict=True)))  # fmt: skip
    before, after = (host_kinematics(m)[1] for m in (walk, bent.apply(walk)))
    joints = [average.skeleton.joint(r) for r in ("chest", "head", "left_upper_arm", "right_forearm")]
    turned = 2 * np.arccos(np.clip(np.abs((before * after).sum(-1)), 0.0, 1.0))[:, joints]
    kept = [0.2, 0.2 * (not gaze), 0.2 * (not shoulders), 0.2 * (not shoulders)]
    np.testing.assert_allclose(turned, np.tile(kept, (len(turned), 1)), atol=0.002)


@pytest.mark.slow
def test_shoulders_stay_while_the_body_leans(leaning, average):
    walk, bent = leaning
    so_far = mf.Fit(Correction((), ()), bent, bent, "converged", (), mf.Problem(average, bent, {}, ()))
    arms = [average.skeleton.joint(f"{s}_upper_arm") for s in ("left", "right")]

    def turn(shoulders: bool) -> float:
        fit = mf.adapt.balance(walk, average, so_far, reference=average, shoulders=shoulders)
        told = fit.details["balance"]
        assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001
        before, after = (host_kinematics(m)[1][:, arms] for m in (bent, fit.motion))
        return float(2 * np.arccos(np.clip(np.abs((before * after).sum(-1)), 0.0, 1.0)).max())

    # the ankles do most of it; what the spine does must not reach the arms
    assert turn(True) < 0.1 * turn(False)


def test_standing_moves_the_body_and_not_the_feet():
    motion = random_motion(3, 6, 5)
    kin = mf.forward_kinematics(motion.skeleton, motion)
    home = np.random.default_rng(0).normal(size=(5, 2, 3))
    inner = JointTracking((1, 4), np.zeros((5, 2, 3)), 1.0)
    one_foot = Standing(inner, (4, 5), home, np.tile([1.0, 0.0], (5, 1)))
    rows = np.asarray(one_foot.residual(kin))
    np.testing.assert_allclose(rows[:, 1], home[:, 0], atol=1e-12)
    gap = np.asarray(kin.positions_world[:, 1] - kin.positions_world[:, 4])
    np.testing.assert_allclose(rows[:, 0] - rows[:, 1], gap, atol=1e-12)
    assert one_foot.reach == 0


def test_legs_that_are_straight_may_stay_so(average):
    """A body comes down for legs that would be straighter than they were, not for those that are."""
    still = rest_motion(average.skeleton)[np.zeros(30, int)]
    at = sampling(still)
    controls = lean_controls(average, still, at.whole, True, False)
    points = Correction.zero(tuple(at.control(c) for c in controls))
    feet = tuple(average.skeleton.joint(f"{s}_foot") for s in ("left", "right"))
    stood = _stood(_alone(still, average), controls, at, points, feet, np.full((30, 2), 0.5))
    np.testing.assert_allclose(stood.motion.root, still.root, atol=1e-6)


def test_its_gradient_is_that_of_finite_differences():
    import equinox as eqx
    import jax
    import jax.numpy as jnp

    motion = random_motion(5, 6, 4)
    home, share = np.zeros((4, 2, 3)), np.tile([0.7, 0.3], (4, 1))
    term = Standing(JointTracking((1, 2), np.ones((4, 2, 3)), 1.0), (4, 5), home, share)

    @jax.jit
    def cost(x):
        control = Control("c", (Drive(2, np.array([0.0, 0.6, 0.8]), 1.0), Drive(4, np.array([1.0, 0.0, 0.0]), -1.0)),
                          bspline_basis(4, 1 / 60, 0.1))  # fmt: skip
        signals = control.signal(x)[:, None]
        from motionfit._control import turned

        moved = eqx.tree_at(lambda m: m.rotations, motion, turned(motion, (control,), signals))
        return 0.5 * jnp.sum(term.residual(mf.forward_kinematics(motion.skeleton, moved)) ** 2)

    x = np.array([0.1, -0.2, 0.3, 0.05])
    np.testing.assert_allclose(jax.grad(cost)(x), central_difference(cost, x), rtol=RELATIVE, atol=1e-8)


def test_recorded_gives_the_motion_again(average):
    base = mf.onto(samples.walk(cycles=1), average.skeleton)
    rotations = np.array(base.rotations)
    joints = [average.skeleton.joint(f"left_{r}") for r in ("thigh", "calf")]
    rotations[:, joints] = rotations[::-1][:, joints]
    target = Motion(base.skeleton, base.root, rotations, base.dt)
    found = recorded("x", target, base, Correction((), ()), joints).apply(base)
    np.testing.assert_allclose(joint_angles(found, target), 0.0, atol=1e-7)


def test_a_continued_clip_goes_on_at_its_speed(average):
    walk = samples.walk(cycles=1)[:30]
    longer = continued(walk, 40)
    np.testing.assert_array_equal(longer.root[:30], walk.root)
    places = host_kinematics(longer)[0]
    steps = np.linalg.norm(np.diff(places, axis=0), axis=-1)
    np.testing.assert_allclose(steps[29], steps[28], rtol=0.05, atol=1e-3)
    np.testing.assert_array_equal(continued(walk, 30).rotations, padded(walk, 30).rotations)


def test_a_lean_fades_where_it_is_wrong_and_stays_elsewhere():
    at = sampling(samples.walk(cycles=3))
    seen = len(at.frames)
    tried = []

    def leaned(points, part):
        tried.append(part)
        # a frame in the middle sinks in with more than half of the lean
        values = np.asarray(at.whole(part))[at.frames]
        sunk = (np.arange(seen) == seen // 2) & (values > 0.5)
        return _Leaned(None, None, 0.0, points, part, np.zeros(seen, bool), sunk)  # pyright: ignore[reportArgumentType]

    whole = leaned(None, np.ones(at.whole.count))
    clean = _cleaned(whole, leaned, at)
    assert whole.sunk.any() and not clean.wrong.any() and len(tried) > 2
    knot = int(np.asarray(at.basis.first)[seen // 2]) + 1
    assert clean.part[knot] <= 0.5
    assert (clean.part[: knot - 6] == 1.0).all() and (clean.part[knot + 7 :] == 1.0).all()
    # what is wrong whatever is taken is not leaned at all
    hopeless = _cleaned(whole, lambda points, part: whole._replace(part=part), at)
    assert (hopeless.part == 0.0).all()


def test_the_jerky_frames_are_those_without_which_there_is_no_more_jerk_than_allowed(average):
    walk = mf.onto(samples.walk(cycles=2), average.skeleton)
    assert not _jerky(walk, walk).any()
    root = np.array(walk.root, float)
    root[60] += [0.0, 0.02, 0.0]  # a jolt
    jolted = dataclasses.replace(walk, root=root)
    found = np.flatnonzero(_jerky(jolted, walk))
    assert len(found) and set(found) <= set(range(57, 63))
    # just as many as need be
    now, was = (np.linalg.norm(np.diff(host_kinematics(m)[0], 3, axis=0), axis=2).mean(1) for m in (jolted, walk))
    more = (now - was)[found - 1]  # the third difference from t - 1 to t + 2 is frame t's
    rest = (now - was).sum() - more.sum()
    assert rest <= 0.04 * was.sum() < rest + more.min()
    assert not _jerky(walk[:3], walk[:3]).any()


@pytest.mark.slow
def test_a_lean_gives_way_where_thighs_show_on_the_skin(average, monkeypatch):
    """The skin of thighs is judged too, by the legs' pairs alone."""
    heavy = grow(average, {"trunk": 1.1, "legs": 1.4})
    walk = samples.walk(cycles=1)
    so_far = mf.adapt(walk, heavy, reference=average, blocks=("arms", "legs"))
    at = sampling(so_far.motion)
    sinks = _sinking(walk, heavy, average, so_far.motion, at)
    assert not sinks(so_far.motion).any()
    rotations = np.array(so_far.motion.rotations, float)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        joint = heavy.skeleton.joint(f"{side}_thigh")
        turned = Rotation.from_rotvec([0.0, 0.0, -0.06 * sign]) * Rotation.from_quat(
            rotations[:, joint], scalar_first=True
        )
        rotations[:, joint] = turned.as_quat(scalar_first=True)
    together = dataclasses.replace(so_far.motion, rotations=rotations)
    monkeypatch.setattr(
        "motionfit.adapt._balance.volume_depths", lambda clearance, motion: np.full((len(at.frames), 12), -0.01)
    )
    blind = _sinking(walk, heavy, average, so_far.motion, at)  # the fields tell of nothing
    assert blind(together).any() and not blind(so_far.motion).any()

    def of_thighs(clearance, motion):
        """Fields that see thighs in each other in all but the motion before."""
        same = np.array_equal(motion.rotations, so_far.motion.rotations[at.frames])
        return np.where([p in pairs_of("legs") for p in PAIRS], -0.01 if same else 0.03, -0.01) * np.ones(
            (len(at.frames), 1)
        )

    monkeypatch.setattr("motionfit.adapt._balance.volume_depths", of_thighs)
    wary = _sinking(walk, heavy, average, so_far.motion, at)
    apart = mf.onto(walk, heavy.skeleton)[np.zeros(walk.frame_count, int)]
    assert wary(together).any() and not wary(apart).any()  # the skin bears out the one, not the other


@pytest.mark.slow
def test_knees_make_room_for_a_heavy_body_that_hops(hops):
    """Whole legs came apart by 17 degrees for thighs that touch in one squat, and led the root to and fro with every
    hop since: the zero-moment point went from 5 to 46 cm."""
    clip, body, reference = hops
    fit = mf.adapt(clip, body, reference=reference)
    knees, legs = (np.abs(np.asarray(fit.correction[name])).max() for name in ("knees_apart", "thighs_apart"))
    assert np.deg2rad(5.0) < knees and legs < np.deg2rad(5.0)
    told = fit.details["balance"]
    assert told["zmp_distance_before_m"] < 0.1
    assert told["zmp_distance_after_m"] <= told["zmp_distance_source_m"] + 0.001


@pytest.mark.slow
def test_hops_of_a_heavy_body_are_balanced_where_they_can_be(hops, monkeypatch):
    # metres away next to flight: squares of that left all other frames as they were, and one that sinks in gave all up
    clip, body, reference = hops
    monkeypatch.setitem(SIGMA_EFFORT, "knees_apart", 1e-4)  # legs that come apart from the hip sway the body
    monkeypatch.setattr("motionfit.adapt._stages.LEAST_GAP_OF_LEGS", 0.005)
    told = mf.adapt(clip, body, reference=reference).details["balance"]
    assert told["zmp_distance_before_m"] > 0.2
    assert told["zmp_distance_after_m"] < 0.15  # 0.07; the source: 0.05
