"""The built-in walk: natural figures, and stance feet that stay in place."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._motion import host_kinematics, joint_angles
from motionfit.metrics import posed_vertices


@pytest.fixture(scope="module")
def walk():
    return samples.walk()


def test_length_and_figures(walk):
    gait = samples._Gait(walk.skeleton)
    assert walk.frame_count >= 4 * gait.duration * 60 and walk.frame_rate == pytest.approx(60.0)
    assert np.isfinite(walk.root).all()
    np.testing.assert_allclose(np.linalg.norm(walk.rotations, axis=-1), 1.0, atol=1e-9)
    assert 1.1 < gait.stride / gait.duration < 1.45
    assert 100 < 120 / gait.duration < 120
    assert np.ptp(walk.root[:, 2]) / ((walk.frame_count - 1) / 60) == pytest.approx(
        gait.stride / gait.duration, rel=0.02
    )


@pytest.mark.parametrize("side", ["left", "right"])
def test_planted_points_do_not_slide_or_sink(walk, side):
    gait = samples._Gait(walk.skeleton)
    positions, turns = host_kinematics(walk)
    foot = walk.skeleton.joint(f"{side}_foot")
    turn = Rotation.from_quat(turns[:, foot], scalar_first=True)
    heel, ball = (positions[:, foot] + turn.apply(x) for x in (gait.heel, gait.ball))
    phase = np.mod(np.arange(walk.frame_count) / 60 / gait.duration - (0.5 if side == "right" else 0), 1.0)
    stance = np.flatnonzero((phase > samples.STRIKE) & (phase < samples.LIFT))
    for run in np.split(stance, np.flatnonzero(np.diff(stance) > 1) + 1):
        toes_up = gait.pitch(phase[run]) < 0
        for points, mine in ((heel, run[toes_up]), (ball, run[~toes_up])):
            if len(mine) > 1:
                assert np.ptp(points[mine], axis=0).max() < 0.005
    assert min(heel[:, 1].min(), ball[:, 1].min()) > -0.003


def test_left_and_right_are_half_a_cycle_apart(walk):
    gait = samples._Gait(walk.skeleton)
    half = samples.walk(frame_rate=2 * 40 / gait.duration, cycles=1)
    positions, _ = host_kinematics(half)
    local = positions - half.root[:, None] * [0, 0, 1]
    for role in ("foot", "hand", "calf"):
        left, right = (local[:, half.skeleton.joint(f"{s}_{role}")] for s in ("left", "right"))
        np.testing.assert_allclose(np.roll(left[:-1], 40, axis=0) * [-1, 1, 1], right[:-1], atol=2e-3)


def test_arms_swing_against_the_legs(walk):
    positions, _ = host_kinematics(walk)
    hand, foot = (positions[:, walk.skeleton.joint(f"left_{r}"), 2] - walk.root[:, 2] for r in ("hand", "foot"))
    assert np.corrcoef(hand, foot)[0, 1] < -0.6


def test_frame_rates_agree_at_shared_times(walk):
    slow = samples.walk(frame_rate=30.0)
    shared = min(slow.frame_count, (walk.frame_count + 1) // 2)
    assert joint_angles(slow[:shared], walk[::2][:shared]).max() < 1e-6


def test_the_script_reproduces_the_figures(shared_data):
    import importlib.util
    import pathlib

    path = pathlib.Path(__file__).parents[1] / "scripts" / "fit_walk.py"
    spec = importlib.util.spec_from_file_location("fit_walk", path)
    assert spec is not None and spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(script)
    from motionfit._walk_harmonics import HARMONICS

    fitted = script.fitted(shared_data / "locomotion")
    assert set(fitted) == set(HARMONICS)
    for role, rows in HARMONICS.items():
        np.testing.assert_allclose(fitted[role], rows, atol=1e-4, err_msg=role)


@pytest.mark.parametrize("name", ["average", "child"])
def test_no_toe_dips_under_the_floor(name):
    """Of the skin: the toes reach further than any joint."""
    body = mf.load_character(f"builtin:{name}")
    walk = mf.onto(samples.walk(cycles=1, body=name), body.skeleton)
    assert posed_vertices(body, walk)[..., 1].min() > -0.006
