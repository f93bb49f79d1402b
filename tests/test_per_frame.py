"""The per-frame alternative of thesis 4.10, and its smoothing."""

import numpy as np
import pytest

import motionfit as mf
from motionfit import samples
from motionfit.adapt import smoothed_corrections
from motionfit.adapt._per_frame import CLOSE

DT = 1 / 60


def test_the_curve_covers_every_raw_correction():
    rng = np.random.default_rng(4)
    frames = np.arange(180)
    raw = np.maximum(0.3 * np.sin(frames / 17.0), 0.0) + 0.02 * rng.random(180) * (np.sin(frames / 17.0) > 0)
    curve = smoothed_corrections(raw, DT)
    assert (raw - np.abs(curve)).max() <= CLOSE
    # a correction that is there at once, and gone at once, is taken up before and let go after
    jump = np.where((frames > 60) & (frames < 90), 0.2, 0.0)
    eased = smoothed_corrections(jump, DT)
    assert (jump - eased).max() <= CLOSE and np.abs(np.diff(eased)).max() < 0.5 * np.abs(np.diff(jump)).max()


@pytest.mark.parametrize("raw", [np.zeros(50), np.array([0.3, 0.1]), np.full(40, 0.2)])
def test_what_is_smooth_already_stays(raw):
    np.testing.assert_allclose(smoothed_corrections(raw, DT), raw, atol=CLOSE)


@pytest.mark.slow
def test_it_takes_the_arms_out(heavy, average):
    fit = mf.adapt.per_frame_ik(samples.walk(cycles=1), heavy, reference=average)
    before, after = (np.asarray(fit.details[f"excess_{k}_m"]).max(axis=1) for k in ("before", "after"))
    assert (before > 0.01).mean() > 0.9 and (after > 0.01).mean() <= 0.1
    np.testing.assert_array_equal(fit.correction.apply(fit.base).rotations, fit.motion.rotations)


def test_a_clip_on_its_own_body_comes_back(average):
    walk = samples.walk(cycles=1)
    fit = mf.adapt.per_frame_ik(walk, average, reference=average)
    np.testing.assert_array_equal(fit.motion.rotations, fit.base.rotations)
