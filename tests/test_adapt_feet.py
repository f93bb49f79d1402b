"""The footskate block of `adapt`, and how a motion stands: the `feet` and `balance` entries of the report."""

import json
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._control import Correction
from motionfit._fit import Fit
from motionfit._motion import continued, joint_angles
from motionfit.adapt import footskate, measure_standing, source_stance
from motionfit.balance import ZmpDistance, balance_measures, sole_boxes, zmp_distance
from motionfit.cli import main
from motionfit.metrics import derivative_ratio
from motionfit.shape.mass import mesh_masses
from tests.test_footskate import swaying

SAME = 1e-9  # [m] "unchanged" in double precision
MARGIN = 2e-3  # [m] more slide in a frame and more depth under the floor than the source's that are allowed


def standing(*arguments) -> dict[str, dict]:
    """`measure_standing` of a body that has soles and can be weighed."""
    return {name: entry for name, entry in measure_standing(*arguments).items() if entry is not None}


def so_far(body: mf.Character, base: mf.Motion, motion: mf.Motion) -> Fit:
    """What the blocks before the footskate block hand over."""
    return Fit(Correction((), ()), motion, base, "converged", (), mf.Problem(body, base, {}, ()))


def with_legs_apart(motion: mf.Motion, mean: float = 0.08, swing: float = 0.02) -> mf.Motion:
    """Thighs turned apart about the forward axis [rad], now more and now less: what the leg block does."""
    skeleton, rotations = motion.skeleton, np.array(motion.rotations, float)
    angle = mean + swing * np.sin(2 * np.pi * np.arange(motion.frame_count) * float(motion.dt))
    for role, sign in (("left_thigh", 1.0), ("right_thigh", -1.0)):
        joint = skeleton.joint(role)
        own = Rotation.from_quat(rotations[:, joint], scalar_first=True)
        turned = Rotation.from_rotvec(sign * angle[:, None] * [0.0, 0.0, 1.0]) * own
        rotations[:, joint] = turned.as_quat(scalar_first=True)
    return mf.Motion(skeleton, motion.root, rotations, motion.dt)


def test_feet_that_stand_are_left_alone(average):
    motion = swaying(average)
    fit = footskate(motion, average, so_far(average, motion, motion))
    assert fit.motion is motion and fit.history[-1].status == "nothing_to_do"


def test_what_moved_the_root_away_from_its_feet_is_taken_back(average):
    base = swaying(average)
    time = np.arange(base.frame_count)[:, None] * float(base.dt)
    moved = mf.Motion(base.skeleton, base.root + 0.05 * np.sin(2 * time) * [1.0, 0.3, 0.5], base.rotations, base.dt)
    found = np.asarray(footskate(base, average, so_far(average, base, moved)).motion.root)
    np.testing.assert_allclose(found - found[0], base.root - base.root[0], atol=1e-3)


@pytest.mark.parametrize("body", ["average", "heavy"])
def test_turned_legs_slide_no_more_than_the_source(body, request):
    character = request.getfixturevalue(body)
    base = mf.onto(samples.walk(cycles=3), character.skeleton)
    turned = with_legs_apart(base)
    fit = footskate(base, character, so_far(character, base, turned))
    assert fit.motion.rotations is turned.rotations and fit.base is base
    assert [b.name for b in fit.history] == ["footskate"] and fit.history[0].cost_after < fit.history[0].cost_before
    stance = source_stance(character, base)
    source, limbs, after = (standing(character, m, stance)["feet"] for m in (base, turned, fit.motion))
    assert (
        limbs["slide_path_m"] > 1.5 * source["slide_path_m"] and after["slide_path_m"] < 1.15 * source["slide_path_m"]
    )
    dt = float(base.dt)
    assert after["slide_p95_m_s"] * dt < source["slide_p95_m_s"] * dt + MARGIN
    assert after["ground_penetration_max_m"] < source["ground_penetration_max_m"] + MARGIN
    assert (derivative_ratio(fit.motion, turned, 3) or 9.0) < 1.05
    again = footskate(fit.motion, character, so_far(character, fit.motion, fit.motion))
    np.testing.assert_allclose(again.motion.root, fit.motion.root, atol=1e-4)


def test_legs_that_follow_their_feet_leave_the_root_and_the_balance(heavy):
    base = mf.onto(samples.walk(cycles=3), heavy.skeleton)
    turned = with_legs_apart(base, swing=0.04)
    by_root, by_legs = (footskate(base, heavy, so_far(heavy, base, turned), legs=k).motion for k in (False, True))
    stance = source_stance(heavy, base)
    source, root, legs = (standing(heavy, m, stance) for m in (base, by_root, by_legs))
    assert legs["feet"]["slide_path_m"] < 1.1 * source["feet"]["slide_path_m"]
    assert legs["feet"]["ground_penetration_max_m"] < source["feet"]["ground_penetration_max_m"] + MARGIN
    assert legs["balance"]["zmp_distance_mean_m"] < 0.5 * root["balance"]["zmp_distance_mean_m"]
    assert joint_angles(by_legs, turned).mean() < np.radians(1)
    same = footskate(by_legs, heavy, so_far(heavy, by_legs, by_legs), legs=True).motion
    assert same.rotations is by_legs.rotations
    np.testing.assert_allclose(same.root, by_legs.root, atol=1e-4)


def test_short_clips_and_clips_in_the_air(average):
    walk = mf.onto(samples.walk(cycles=1), average.skeleton)
    rising = np.asarray(walk.root) + np.linspace(1, 30, walk.frame_count)[:, None] * [0.0, 1.0, 0.0]
    up = mf.Motion(walk.skeleton, rising, walk.rotations, walk.dt)
    for motion in (walk[:1], walk[:3], up):
        for legs in (False, True):
            fit = footskate(motion, average, so_far(average, motion, with_legs_apart(motion)), legs=legs)
            assert np.isfinite(np.asarray(fit.motion.root)).all() and np.isfinite(fit.motion.rotations).all()


def test_the_block_runs_by_name(average):
    longer = mf.shape.scale_skeleton(average, {"inside_leg": 1.2})  # on its own body the walk has nothing to stop
    fit = mf.adapt(samples.walk(cycles=1), longer, blocks=("footskate",))
    assert [b.name for b in fit.history] == ["footskate"]
    assert fit.motion.rotations is fit.base.rotations and not np.array_equal(fit.motion.root, fit.base.root)
    json.dumps(fit.report())


def test_balance_entry_is_that_of_the_balance_module(average, heavy):
    walk = samples.walk(cycles=1)
    on_heavy, on_average = (mf.onto(walk, b.skeleton) for b in (heavy, average))
    stance = source_stance(heavy, on_heavy, average, on_average)
    found = standing(heavy, on_heavy, stance)["balance"]
    down = mf.detect_footplants(on_average, average)

    def distance(body, motion):
        count, more = motion.frame_count, 40  # it goes on past its end, however long
        kin = mf.forward_kinematics(body.skeleton, continued(motion, count + more))
        ground = np.pad(mf.detect_footplants(motion, body).floor.at(np.asarray(motion.root)), (0, more), "edge")
        planted = np.pad(down.planted, ((0, more), (0, 0)))
        found = zmp_distance(kin, mesh_masses(body), sole_boxes(body), planted, ground=ground)
        return ZmpDistance(found.signed[:count], found.supported[:count])

    expected = balance_measures(distance(heavy, on_heavy), distance(average, on_average))
    assert expected["zmp_distance_mean_m"] > 0.01
    assert found == pytest.approx(expected, rel=1e-6)
    assert standing(heavy, on_heavy, source_stance(heavy, on_heavy))["balance"]["excess_over_reference_mean_m"] is None


def test_a_body_without_a_sole_has_no_entries(average):
    import equinox as eqx

    hips = np.zeros_like(np.asarray(average.skin.joints))
    ghost = eqx.tree_at(lambda c: c.skin.joints, average, hips)
    ghost = mf.Character(ghost.skeleton, ghost.skin, "ghost")
    motion = samples.walk(cycles=1)
    assert measure_standing(ghost, motion, source_stance(ghost, motion)) == {"feet": None, "balance": None}
    with pytest.raises(mf.InputError, match="leave footskate out"):
        mf.adapt(motion, ghost, blocks=("footskate",))


def run(monkeypatch, capsys, *arguments) -> tuple[int, str]:
    monkeypatch.setattr(sys, "argv", ["motionfit", *map(str, arguments)])
    with pytest.raises(SystemExit) as exit_:
        main()
    return int(exit_.value.code or 0), capsys.readouterr().err


@pytest.mark.slow
def test_commands_report_feet_and_balance(monkeypatch, capsys, tmp_path):
    out, report, measured = (tmp_path / n for n in ("o.npz", "r.json", "m.json"))
    code, _ = run(monkeypatch, capsys, "adapt", "builtin:walk", "builtin:heavy", "--end", 0.8, "--blocks", "footskate",
                  "--reference", "builtin:average", "-o", out, "--report", report)  # fmt: skip
    data = json.loads(report.read_text())
    assert code == 0 and [b["name"] for b in data["blocks"]] == ["footskate"]
    for name in ("before", "after"):
        assert all(np.isfinite(v) for v in data[name]["feet"].values() if v is not None)
        assert None not in data[name]["balance"].values()
    # the file holds its source, and the reference plays that
    arguments = "metrics", out, "builtin:heavy", "--reference", "builtin:average", "--json", measured
    code, said = run(monkeypatch, capsys, *arguments)
    assert code == 0 and said == ""
    same, after = (m["penetration"]["skin"]["excess_max_m"] for m in (json.loads(measured.read_text()), data["after"]))
    assert same == pytest.approx(after, abs=1e-6)
    # what the reference plays is said where it is the measured clip itself, and only there
    mf.save(forgetful := tmp_path / "o.bvh", mf.load_motion(out))
    code, said = run(monkeypatch, capsys, "metrics", forgetful, *arguments[2:])
    assert code == 0 and "--reference-clip" in said and said.count("\n") == 1
    code, said = run(monkeypatch, capsys, *arguments[:-2], "--reference-clip", out, "--json", measured)
    assert code == 0 and said == "" and json.loads(measured.read_text())["feet"]["contact_frames"] > 0


def test_no_more_slide_than_the_source_on_a_real_clip(shared_data):
    body = mf.load_character(shared_data / "characters" / "heavy_male.glb")
    for name in ("02_01_walk", "16_36_run", "16_05_forward_jump"):
        base = mf.onto(mf.load_motion(shared_data / "bvh" / f"{name}.bvh"), body.skeleton)
        fit = footskate(base, body, so_far(body, base, with_legs_apart(base)))
        stance = source_stance(body, base)
        source, after = (standing(body, m, stance)["feet"] for m in (base, fit.motion))
        assert after["slide_path_m"] < 1.1 * source["slide_path_m"], name
        assert after["slide_p95_m_s"] * float(base.dt) < source["slide_p95_m_s"] * float(base.dt) + MARGIN, name
        assert after["ground_penetration_max_m"] < source["ground_penetration_max_m"] + MARGIN, name
        again = footskate(fit.motion, body, so_far(body, fit.motion, fit.motion))
        np.testing.assert_allclose(again.motion.root, fit.motion.root, atol=1e-4, err_msg=name)
