"""The thesis's tables: its own figures add up, and ours reach them on the built-in walk and on real clips."""

import sys

import numpy as np
import pytest

import motionfit as mf
from benchmarks.thesis import _printed as printed
from benchmarks.thesis import pipeline, postures, scales, support, valley
from benchmarks.thesis._setting import CLIPS, MODELS, kinematics, planted_feet, truth
from motionfit import samples
from motionfit._control import Correction
from motionfit._motion import joint_angles
from motionfit.balance import zero_moment_point, zmp_distance
from motionfit.shape.mass import LIMBS


def _errors(character, clip):
    """Mean distance [cm] of each model's ZMP from the true one, in the supported frames: table 5.4."""
    motion = mf.onto(clip, character.skeleton)
    soles, feet, ground = planted_feet(character, motion)
    kin, true = kinematics(character.skeleton, motion), truth(character)
    counted = np.asarray(zmp_distance(kin, true, soles, feet, ground=ground).supported)
    target = np.asarray(zero_moment_point(kin, true, ground=ground).point_world)[counted]
    assert counted.mean() > 0.6 and np.isfinite(target).all()
    result = {}
    for name, model in MODELS.items():
        path = zero_moment_point(kin, model(character), spin=False, ground=ground).point_world
        result[name] = 100 * float(np.linalg.norm(np.asarray(path)[counted] - target, axis=1).mean())
    return result


def test_the_printed_tables_are_consistent():
    means = {k: np.mean([row[i][0] for row in printed.ZMP_ERROR_PER_MOTION.values()])
             for i, k in enumerate(("cylinders", "ellipsoids", "optimised"))}  # fmt: skip
    for k, (mean, _) in printed.ZMP_ERROR.items():
        assert means[k] == pytest.approx(mean, abs=0.01)
    assert np.mean([m for m, _ in printed.SUPPORT_DISTANCE.values()]) == pytest.approx(
        printed.SUPPORT_DISTANCE_MEAN, abs=0.01
    )
    for kind, masses in printed.MASS.items():
        np.testing.assert_allclose(100 * np.array(masses) / sum(masses), printed.SHARE[kind], atol=0.03)
    for k, kind in enumerate(("cylinders", "ellipsoids")):
        own = scales.scales(list(printed.SHARE[kind]), list(printed.SHARE["measured"]))
        np.testing.assert_allclose(own, [printed.RADIUS_SCALE[limb][k] for limb in LIMBS], atol=0.006)


@pytest.mark.slow
def test_volumes_reach_the_thesis_on_the_built_in_walk(heavy, average):
    for character in (heavy, average):
        errors = _errors(character, samples.walk(cycles=2))
        assert errors["cylinders"] <= printed.ZMP_ERROR["cylinders"][0], errors
        assert errors["ellipsoids"] <= printed.ZMP_ERROR["ellipsoids"][0], errors
        if character is heavy:
            assert errors["cylinders"] < errors["de Leva"], errors


@pytest.mark.slow
@pytest.mark.parametrize("name", ["Slow walk", "Jumps"])
def test_volumes_reach_the_thesis_on_real_clips(shared_data, name):
    character = mf.load_character(shared_data / "characters/heavy_male.glb")
    errors = _errors(character, mf.load_motion(shared_data / f"{CLIPS[name]}.bvh", fps=60.0))
    assert errors["cylinders"] <= 1.42 and errors["ellipsoids"] <= 1.59 and errors["cylinders"] < errors["de Leva"]


@pytest.mark.slow
@pytest.mark.parametrize("script", [scales, support])
def test_scripts_run_without_data(script, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["script", "--bodies", "average", "--out", str(tmp_path)])
    script.main()
    printed_out = capsys.readouterr().out
    assert "thesis" in printed_out and "nan" not in printed_out
    assert list(tmp_path.glob("*.csv")) and list(tmp_path.glob("*.png"))


def test_the_valley_is_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["script", "--out", str(tmp_path)])
    valley.main()
    assert "ten of a grid" in capsys.readouterr().out
    assert (tmp_path / "figure_4_9.png").stat().st_size > 10_000 and (tmp_path / "figure_4_9.csv").exists()


def test_a_cut_pipeline_goes_on_and_tells_of_failures(tmp_path, monkeypatch, capsys, average):
    done = []

    def row(clip, character, reference):
        done.append(character.name)
        return failed if len(done) == 1 else ["converged", *["0"] * 6, "3.37 (6.29)", "3.35", "3.30 (5.61)", "1", "2"]

    failed = pipeline.row(samples.walk(cycles=1), None, average)  # pyright: ignore[reportArgumentType]
    assert "Error: " in failed[0] and len(failed) == len(pipeline.COLUMNS) - 2
    monkeypatch.setattr(pipeline, "row", row)
    for bodies in (["heavy"], ["heavy", "slim"]):
        monkeypatch.setattr(sys, "argv", ["script", "--out", str(tmp_path), "--resume", "--bodies", *bodies])
        pipeline.main()
    assert done == ["builtin:heavy", "builtin:slim"]
    assert [r[:3] for r in pipeline.read(tmp_path / "pipeline.csv")][1] == ["walk", "slim", "converged"]
    assert "8.38 (7.78)" in capsys.readouterr().out and (tmp_path / "pipeline.png").exists()


def test_a_growing_body_goes_from_one_fit_to_the_other(average, tmp_path):
    base = mf.onto(samples.walk(cycles=1), average.skeleton)
    other = base[::-1]
    fits = [
        mf.Fit(Correction((), ()), m, base, "converged", (), mf.Problem(average, base, {}, ())) for m in (base, other)
    ]
    for share, expected in ((0.0, base), (1.0, other)):
        motion = postures.between(fits[0], fits[1], share, base)
        np.testing.assert_allclose(joint_angles(motion, expected), 0.0, atol=1e-7)
    row = [postures.Posture(average, base, 0, np.full(len(mf.shape.PAIRS), 0.01), "0 s")]
    postures.picture(tmp_path / "rows.png", "title", {"adapted": row, "original": row})
    assert (tmp_path / "rows.png").stat().st_size > 10_000
