"""Feet on the ground: every formula against an independent oracle, laws on built-in clips, hand labels on real ones."""

import json

import equinox as eqx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

import motionfit as mf
from motionfit import samples
from motionfit._character import PARTS
from motionfit._motion import rest_motion
from motionfit.feet import (
    METHODS,
    Floor,
    Plant,
    catmull_rom,
    cubic_roots,
    find_sole,
    fit_floor,
    frame_heights,
    gather,
    horizontal_path,
    load_labels,
    place_at,
    root_steps,
    save_labels,
    scaled_heights,
    sole_paths,
    transfer_instant,
    vertical_scale,
)  # fmt: skip
from motionfit.feet._detect import _without_fast_ends, smooth, two_state_path
from motionfit.feet._plants import runs
from motionfit.feet._root import SLOW, path_stretch
from motionfit.feet._transfer import evaluate, integral
from motionfit.metrics import posed_vertices
from tests.helpers import jumping, with_legs

SAME = 1e-9  # [m] "unchanged" in double precision
ROOT = 1e-5  # closed-form roots against numpy.roots: multiple roots keep a third of the digits in both


# --- the transfer instant -----------------------------------------------------------------------------------------


def real_roots(coefficients) -> np.ndarray:
    """The oracle: numpy.roots, real ones only, multiple ones once."""
    found = np.roots(np.trim_zeros(coefficients, "f")) if np.any(coefficients) else np.zeros(0)
    real = np.sort(found[np.abs(found.imag) < 1e-5].real)
    return real[np.append(True, np.diff(real) > 1e-4)] if len(real) else real


@pytest.mark.parametrize(
    "coefficients",
    [
        np.poly([0.2, 0.5, 0.9]), np.poly([-3.0, 0.1, 40.0]), -2.5 * np.poly([0.3, 0.4, 0.5]),  # three roots
        np.poly([0.3, 0.3, 0.8]), np.poly([0.8, 0.8, 0.3]), -np.poly([0.1, 0.1, -5.0]),  # a double one
        np.poly([0.4, 0.4, 0.4]), 7 * np.poly([0.0, 0.0, 0.0]),  # a triple one
        np.array([1.0, 0.0, 1.0, -1.0]), np.array([1.0, -3.0, 5.0, 2.0]), np.array([-4.0, 1.0, 0.0, 1.0]),  # one
        np.array([0.0, 1.0, -0.9, 0.2]), np.array([0.0, 1.0, 0.0, 1.0]), np.array([0.0, 4.0, -4.0, 1.0]),  # quadratic
        np.array([0.0, 2.0, 0.0, 0.0]), np.array([0.0, 0.0, 2.0, -1.0]),  # and linear
    ],
)  # fmt: skip
def test_cubic_roots_on_every_branch(coefficients):
    found = cubic_roots(coefficients)
    assert found.shape == (3,)
    np.testing.assert_allclose(found[np.isfinite(found)], real_roots(coefficients), atol=ROOT)


def test_an_equation_without_unknowns_has_no_root():
    assert np.isnan(cubic_roots(np.array([[0.0, 0.0], [0.0, 0.0], [0.0, 0.0], [0.0, 3.0]]))).all()


@given(st.lists(st.floats(-2, 2), min_size=4, max_size=4))
def test_cubic_roots_are_roots_and_none_is_missed(coefficients):
    coefficients = np.array(coefficients)
    found = cubic_roots(coefficients)
    found = found[np.isfinite(found)]
    size = np.abs(coefficients).max()
    inside = found[(found >= 0) & (found <= 1)]
    np.testing.assert_allclose(np.polyval(coefficients, inside), 0.0, atol=1e-7 * max(size, 1e-300))
    # every change of sign on the interval has its root
    q = np.linspace(0, 1, 2001)
    values = np.polyval(coefficients, q)
    for k in np.flatnonzero(values[:-1] * values[1:] < 0):
        assert ((found > q[k] - 1e-6) & (found < q[k + 1] + 1e-6)).any()


def test_cubic_roots_of_many_at_once():
    rng = np.random.default_rng(3)
    many = rng.normal(size=(4, 50, 4))
    found = cubic_roots(many)
    for i in np.ndindex(50, 4):
        mine = found[(slice(None), *i)]
        np.testing.assert_allclose(mine[np.isfinite(mine)], real_roots(many[(slice(None), *i)]), atol=1e-5)


def test_catmull_rom_passes_through_its_points_with_central_slopes(rng):
    points = rng.normal(size=(4, 5))
    curve = catmull_rom(points)
    np.testing.assert_allclose(evaluate(curve, np.zeros(5)), points[1], atol=1e-12)
    np.testing.assert_allclose(evaluate(curve, np.ones(5)), points[2], atol=1e-12)
    np.testing.assert_allclose(curve[2], (points[2] - points[0]) / 2, atol=1e-12)
    np.testing.assert_allclose(3 * curve[0] + 2 * curve[1] + curve[2], (points[3] - points[1]) / 2, atol=1e-12)
    q = np.linspace(0, 1, 10001)
    numeric = np.trapezoid(np.polyval(curve[:, 0], q), q)
    np.testing.assert_allclose(integral(curve[:, 0], np.array(1.0)), numeric, atol=1e-8)


@given(st.integers(0, 10**6))
def test_transfer_is_where_the_next_vertex_becomes_the_slower(seed):
    rng = np.random.default_rng(seed)
    leaving, taking = np.sort(rng.uniform(0, 1, 4)), np.sort(rng.uniform(0, 1, 4))[::-1]
    q = float(transfer_instant(leaving[:, None], taking[:, None])[0])
    difference = lambda x: float(np.polyval(catmull_rom(leaving) - catmull_rom(taking), x))  # noqa: E731
    dense = np.array([difference(x) for x in np.linspace(0, 1, 1001)])
    if (dense[:-1] * dense[1:] < 0).any():
        assert abs(difference(q)) < 1e-9
        assert difference(min(q + 1e-4, 1.0)) >= -1e-6
    else:
        assert q == (0.0 if dense[500] > 0 else 1.0)


def test_place_at_shares_the_way_by_speed(rng):
    positions, speeds = rng.normal(size=(4, 6, 3)), rng.uniform(0.5, 1.0, size=(4, 6))
    np.testing.assert_allclose(place_at(positions, speeds, np.zeros(6)), positions[1], atol=1e-12)
    np.testing.assert_allclose(place_at(positions, speeds, np.ones(6)), positions[2], atol=1e-12)
    steady = np.arange(4.0)[:, None, None] * np.ones((4, 6, 3))
    np.testing.assert_allclose(place_at(steady, np.ones((4, 6)), np.full(6, 0.3)), 1.3, atol=1e-12)
    # a vertex at rest has no way: it is where it is
    still = np.ones((4, 6, 3))
    np.testing.assert_allclose(place_at(still, np.zeros((4, 6)), np.full(6, 0.3)), 1.0, atol=1e-12)


# --- root steps, (3.1) ----------------------------------------------------------------------------------------------


def test_root_steps_written_out(rng):
    """(3.1) for a change of foot, by its four terms; for one vertex by hand; none without a plant."""
    offsets, speed = rng.normal(size=(6, 2, 3)), rng.uniform(0.1, 1.0, size=(6, 2))
    standing_on = np.array([0, 0, 0, 1, 1, -1])
    steps, held = root_steps(offsets, standing_on, speed, np.array([0, 1]))
    assert held.tolist() == [True, True, True, True, False]
    np.testing.assert_allclose(steps[0], offsets[0, 0] - offsets[1, 0])
    np.testing.assert_allclose(steps[3], offsets[3, 1] - offsets[4, 1])
    around = np.arange(1, 5)
    q = transfer_instant(speed[around, 0, None], speed[around, 1, None])
    i, j = (place_at(offsets[around, v][:, None], speed[around, v, None], q)[0] for v in (0, 1))
    np.testing.assert_allclose(steps[2], offsets[2, 0] - i + j - offsets[3, 1], atol=1e-12)
    # on one foot the transfer lies on a frame: one of both vertices holds the whole step
    steps, _ = root_steps(offsets, standing_on, speed, np.array([0, 0]))
    whole = [offsets[2, v] - offsets[3, v] for v in (0, 1)]
    assert min(np.abs(steps[2] - w).max() for w in whole) < 1e-12


def test_flight_keeps_its_displacement_and_carries_the_correction_on():
    """Feet that pull the root back by 1 cm per frame before a flight and by 3 cm after it: between, from one to the
    other; without any plant nothing changes."""
    frames = 60
    root = np.zeros((frames, 3))
    root[:, 2] = 0.05 * np.arange(frames)
    offsets = np.zeros((frames, 1, 3))
    offsets[:30, 0, 2], offsets[30:, 0, 2] = -0.04 * np.arange(30), -0.02 * np.arange(30)
    standing_on = np.zeros(frames, int)
    standing_on[25:40] = -1
    speed = np.zeros((frames, 1))
    moved = horizontal_path(root, offsets, standing_on, speed, np.zeros(1, int), 1 / 60)
    steps = np.diff(moved[:, 2])
    np.testing.assert_allclose(steps[:24], 0.04, atol=1e-12)
    np.testing.assert_allclose(steps[40:], 0.02, atol=1e-12)
    assert (np.diff(steps[24:40]) < 0).all() and 0.02 < steps[30] < 0.04
    np.testing.assert_array_equal(
        horizontal_path(root, offsets, np.full(frames, -1), speed, np.zeros(1, int), 1 / 60), root
    )


def test_a_path_too_long_for_its_feet_is_shortened_in_flight_in_the_same_proportion():
    """A run whose root flies faster than it goes in the stances: feet that allow 0.7 of its steps allow 0.7 of its
    flights; an added shift would leave them too long."""
    frames = 90
    pace = 2.0 + np.sin(np.arange(frames - 1) / 7.0) ** 2
    flying = (np.arange(frames) // 15) % 2 == 1
    pace[flying[:-1]] *= 1.5
    root = np.zeros((frames, 3))
    root[1:, 2] = np.cumsum(pace) / 60
    offsets = -0.7 * root[:, None]
    moved = horizontal_path(root, offsets, np.where(flying, -1, 0), np.zeros((frames, 1)), np.zeros(1, int), 1 / 60)
    np.testing.assert_allclose(moved, 0.7 * root, rtol=0.005, atol=1e-12)


@given(st.integers(0, 10**6))
def test_path_stretch_is_the_ridge_minimum(seed):
    rng = np.random.default_rng(seed)
    own, dt = 0.02 * rng.normal(size=(12, 3)), 1 / 60
    steps = rng.uniform(0.6, 1.8) * own + 1e-3 * rng.normal(size=own.shape)
    cost = lambda s: float(((steps - s * own) ** 2).sum() + 12 * (SLOW * dt) ** 2 * (s - 1) ** 2)  # noqa: E731
    best: float = minimize_scalar(cost, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-10}).x  # type: ignore
    assert path_stretch(own, steps, dt) == pytest.approx(best, abs=1e-6)
    assert path_stretch(own, own, dt) == 1.0 and path_stretch(own[:0], steps[:0], dt) == 1.0


# --- heights ---------------------------------------------------------------------------------------------------------


@given(st.integers(0, 10**6))
def test_vertical_scale_is_the_minimum_of_the_variance(seed):
    rng = np.random.default_rng(seed)
    root = 0.9 + 0.03 * rng.normal(size=40)
    soles = root - 0.9 + 0.3 * (root - root.mean()) * rng.normal() + 0.004 * rng.normal(size=40) + 0.05
    offset, scale = vertical_scale(root, soles)
    assert offset == pytest.approx(-soles.mean())
    moved, relative = root + offset, soles - root
    cost = lambda a: float(((moved.mean() + a * (moved - moved.mean()) + relative) ** 2).sum())  # noqa: E731
    best: float = minimize_scalar(cost, bounds=(0.5, 2.0), method="bounded", options={"xatol": 1e-10}).x  # type: ignore
    assert scale == pytest.approx(best, abs=1e-6)


def test_a_still_root_is_not_scaled():
    assert vertical_scale(np.full(9, 0.9), np.linspace(-0.01, 0.01, 9))[1] == 1.0
    assert vertical_scale(np.zeros(0), np.zeros(0)) == (0.0, 1.0)


def test_scaled_heights_lay_the_clip_on_another_floor(rng):
    root = np.column_stack([rng.normal(size=20), 0.9 + 0.02 * rng.normal(size=20), np.linspace(0, 3, 20)])
    tilted = Floor(0.05, 0.0, 0.02)
    root[:, 1] += 0.02 * root[:, 2]
    planted = root.copy()
    planted[:, 1] = tilted.at(planted)
    held = np.ones(20, bool)
    heights, _, scale = scaled_heights(root, planted, held, tilted, None)
    np.testing.assert_allclose(heights, tilted.above(root) + 0 * scale, atol=0.1)
    assert heights.mean() == pytest.approx(tilted.above(root).mean())
    level, offset, _ = scaled_heights(root, planted, held, tilted, Floor())
    assert offset == pytest.approx(0.0, abs=1e-12) and level.mean() == pytest.approx(heights.mean())


def test_frame_heights_raise_what_sinks_and_lower_what_floats():
    root = np.tile([0.0, 1.0, 0.0], (6, 1))
    lowest = np.array([-0.02, 0.03, 0.0, 0.2, 0.2, 0.0])
    held = np.array([True, True, True, False, False, True])
    found = frame_heights(root, lowest, held, Floor())
    np.testing.assert_allclose(found + lowest - 1.0, [0.0, 0.0, 0.0, 0.2, 0.2, 0.0], atol=1e-12)
    sunk = frame_heights(root, np.array([0.0, 0.0, 0.0, -0.1, 0.2, 0.0]), held, Floor())
    assert sunk[3] == pytest.approx(1.1)


# --- floor ------------------------------------------------------------------------------------------------------------


def test_floor_is_found_among_feet_in_the_air(rng):
    ground = rng.uniform(-3, 3, size=(300, 2))
    truth = Floor(-0.04, 0.012, -0.017)
    points = np.column_stack([ground[:, 0], np.zeros(300), ground[:, 1]])
    points[:, 1] = truth.at(points) + 0.003 * rng.normal(size=300)
    points[:120, 1] += rng.uniform(0.08, 0.6, size=120)
    found = fit_floor(points)
    np.testing.assert_allclose(found, truth, atol=0.003)
    assert found.tilt == pytest.approx(truth.tilt, abs=0.003)
    np.testing.assert_allclose(found.above(points)[120:], 0.0, atol=0.02)


def test_floor_is_exact_where_it_can_be_and_never_tilted_by_a_stance():
    standing = np.tile([[0.1, 0.031, 0.2]], (50, 1))
    assert fit_floor(standing) == pytest.approx((0.031, 0.0, 0.0), abs=1e-15)
    feet = np.concatenate([standing, standing + [-0.2, 0.012, 0.05]])
    assert fit_floor(feet).tilt < np.radians(1.5)
    assert fit_floor(np.zeros((0, 3))) == Floor()


# --- sole -----------------------------------------------------------------------------------------------------------


def test_sole_is_low_faces_down_and_moves_with_the_skin(average):
    sole, walk = find_sole(average), samples.walk(cycles=1)
    vertices = np.asarray(average.skin.vertices_bind)[sole.vertices]
    assert 10 <= len(sole.of(0)) <= 60 and 10 <= len(sole.of(1)) <= 60
    assert vertices[:, 1].max() < 0.08 and (vertices[sole.of(0), 0] > 0).all() and (vertices[sole.of(1), 0] < 0).all()
    assert (np.asarray(average.skin.normals_bind)[sole.vertices, 1] < -0.3).all()
    some = np.array([0, 17, 40])
    np.testing.assert_allclose(
        sole_paths(sole, walk)[some], posed_vertices(average, walk[some])[:, sole.vertices], atol=1e-6
    )
    dense = find_sole(average, cells=None)
    assert len(dense.vertices) > 3 * len(sole.vertices) and set(sole.vertices) <= set(dense.vertices)


def subdivided(body: mf.Character, times: int) -> mf.Character:
    """Every triangle of the feet cut into four, `times` times."""
    skin = body.skin
    vertices, faces = np.asarray(skin.vertices_bind, float), np.asarray(skin.faces)
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    feet = np.isin(body.part_of_vertex[faces], [PARTS.index(f"{s}_foot") for s in ("left", "right")])
    fine, rest = faces[feet.all(1)], faces[~feet.all(1)]
    for _ in range(times):
        edges = np.sort(np.concatenate([fine[:, [0, 1]], fine[:, [1, 2]], fine[:, [2, 0]]]), axis=1)
        unique, index = np.unique(edges, axis=0, return_inverse=True)
        middle = len(vertices) + index.reshape(3, -1)
        vertices = np.concatenate([vertices, vertices[unique].mean(1)])
        joints, weights = (
            np.concatenate([joints, joints[unique[:, 0]]]),
            np.concatenate([weights, weights[unique[:, 0]]]),
        )
        a, b, c = fine.T
        ab, bc, ca = middle
        fine = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
    return mf.Character(body.skeleton, mf.Skin(vertices, np.concatenate([rest, fine]), joints, weights), "dense")


def test_a_sole_of_ten_thousand_vertices_is_thinned_out(average):
    dense = subdivided(average, 3)
    assert len(find_sole(dense, cells=None).vertices) > 10_000
    assert len(find_sole(dense).vertices) < 120
    walk = samples.walk(cycles=1)
    assert (mf.detect_footplants(walk, dense).labels == mf.detect_footplants(walk, average).labels).mean() > 0.97
    for method in METHODS:
        fine, coarse = (mf.remove_footskate(walk, body, method) for body in (dense, average))
        assert fine.status == coarse.status == "converged"
        np.testing.assert_allclose(fine.motion.root, coarse.motion.root, atol=0.01)


def footless(body: mf.Character) -> mf.Character:
    """The same body with the skin of its feet on a shank."""
    skin, joint = body.skin, body.skeleton.joint
    feet = [joint(f"{s}_{r}") for s in ("left", "right") for r in ("foot", "toe")]
    joints = np.where(np.isin(skin.joints, feet), joint("left_calf"), np.asarray(skin.joints))
    return mf.Character(body.skeleton, mf.Skin(skin.vertices_bind, skin.faces, joints, skin.weights), "stump")


def upside_down_feet(body: mf.Character) -> mf.Character:
    """The same body with its feet mirrored in their own height: soles above, facing up."""
    skin, vertices = body.skin, np.array(body.skin.vertices_bind)
    feet = np.isin(body.part_of_vertex, [PARTS.index(f"{s}_foot") for s in ("left", "right")])
    vertices[feet, 1] = vertices[feet, 1].max() + vertices[feet, 1].min() - vertices[feet, 1]
    return mf.Character(body.skeleton, mf.Skin(vertices, skin.faces, skin.joints, skin.weights), "upside down")


def inside_out(body: mf.Character) -> mf.Character:
    return eqx.tree_at(lambda c: c.skin.faces, body, np.asarray(body.skin.faces)[:, ::-1])


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize(
    ("change", "fact"),
    [
        (footless, "stump: no vertex follows left_foot"),
        (lambda body: without(body, "foot", "toe"), "no joint found for left_foot, right_foot"),
        (upside_down_feet, "upside down: no vertex of the left foot faces down"),
        (inside_out, "no vertex of the left foot faces down"),
    ],
    ids=["no skin on the feet", "no foot joints", "upside down", "inside out"],
)
def test_feet_that_cannot_be_used_say_why_in_one_line(average, method, change, fact):
    walk, body = samples.walk(cycles=1), change(average)
    for call in (lambda: mf.remove_footskate(walk, body, method), lambda: mf.detect_footplants(walk, body)):
        with pytest.raises(mf.InputError, match=fact) as said:
            call()
        assert "\n" not in str(said.value)


@pytest.mark.parametrize("method", METHODS)
def test_feet_that_walk_upside_down_are_held_as_they_are(average, method):
    """Turned over at the ankle: what is lowest then carries, and holds still."""
    walk = samples.walk(cycles=2)
    rotations = np.array(walk.rotations)
    for side in ("left", "right"):
        foot = walk.skeleton.joint(f"{side}_foot")
        over = Rotation.from_quat(rotations[:, foot], scalar_first=True) * Rotation.from_rotvec([0.0, 0.0, np.pi])
        rotations[:, foot] = over.as_quat(scalar_first=True)
    found = mf.remove_footskate(mf.Motion(walk.skeleton, walk.root, rotations, walk.dt), average, method)
    assert found.status == "converged" and np.isfinite(found.motion.rotations).all()
    assert found.plants.planted.mean() > 0.4
    assert found.measure(found.motion)["slide_max_m_s"] < found.measure(found.base)["slide_max_m_s"]


@pytest.mark.parametrize("method", METHODS)
def test_a_motion_without_frames_is_refused(average, method):
    with pytest.raises(mf.InputError, match="without frames"):
        mf.remove_footskate(samples.walk(cycles=1)[:0], average, method)


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frames", [1, 2, 3])
def test_clips_of_a_few_frames_are_answered(average, method, frames):
    """One frame has nothing to correct and comes back; two and three are held like any others."""
    walk = samples.walk(cycles=1)[:frames]
    found = mf.remove_footskate(walk, average, method, vertical="none", lift=0.0)
    assert found.status == "converged" and found.motion.frame_count == frames
    assert json.dumps(found.report(), allow_nan=False)
    after = found.measure(found.motion)["slide_max_m_s"]
    if frames == 1:
        assert after is None
        np.testing.assert_allclose(
            np.asarray(found.motion.root)[:, [0, 2]], np.asarray(walk.root)[:, [0, 2]], atol=SAME
        )
    else:
        assert after < 1e-6 < found.measure(found.base)["slide_max_m_s"]


def without(body: mf.Character, *roles: str) -> mf.Character:
    """The same body on a skeleton that lacks some joints of both legs; their skin is on the joints above."""
    skeleton, skin = body.skeleton, body.skin
    gone = [skeleton.joint(f"{s}_{r}") for s in ("left", "right") for r in roles]
    keep = [j for j in range(len(skeleton.names)) if j not in gone]

    def kept(joint: int) -> int:
        return keep.index(joint) if joint in keep else kept(skeleton.parents[joint])

    parents = [-1 if skeleton.parents[j] < 0 else kept(skeleton.parents[j]) for j in keep]
    bare = mf.Skeleton([skeleton.names[j] for j in keep], parents, np.asarray(skeleton.offsets)[keep],
                       np.asarray(skeleton.rest_rotations)[keep])  # fmt: skip
    joints = np.vectorize(kept)(np.asarray(skin.joints))
    return mf.Character(bare, mf.Skin(skin.vertices_bind, skin.faces, joints, skin.weights), f"without {roles}")


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("frames", [None, 1, 3])
def test_a_missing_toe_joint_is_no_obstacle(average, method, frames):
    toeless, walk = without(average, "toe"), samples.walk(cycles=2)[:frames]
    found = mf.remove_footskate(walk, toeless, method)
    assert np.isfinite(found.motion.rotations).all() and np.isfinite(found.motion.root).all()
    assert found.plants.planted.any() and found.reachable.all() and found.status == "converged"


# --- labels ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("standing", [0.0, 10.0])
def test_a_path_of_longer_legs_is_recognised_however_long_the_body_stands(average, standing):
    """Two seconds of walking with the root path of other legs skate, whatever is around them."""
    walk, body = samples.walk(cycles=2), with_legs(average, 0.7)
    frames = np.append(np.zeros(round(standing / float(walk.dt)), int), np.arange(walk.frame_count))
    skating = mf.Motion(body.skeleton, walk.root, walk.rotations, walk.dt)[frames]
    assert gather(find_sole(body), skating).path_scale == pytest.approx(0.7, abs=0.05)
    assert gather(find_sole(body), mf.onto(walk, body.skeleton)[frames]).path_scale == 1.0


def test_labels_are_written_and_read_again(tmp_path):
    plants = (Plant("left", None, 0, 9), Plant("right", 17, 5, 20))
    save_labels(tmp_path / "l.csv", plants)
    assert (tmp_path / "l.csv").read_text().splitlines()[0] == "foot,vertex,start,end"
    assert load_labels(tmp_path / "l.csv", 30, 1 / 60) == plants
    (tmp_path / "s.csv").write_text("foot,vertex,start,end\n# by eye\nboth,any,0.5,1.25\n")
    assert load_labels(tmp_path / "s.csv", 60, 1 / 60) == (Plant("left", None, 30, 59), Plant("right", None, 30, 59))


@pytest.mark.parametrize(
    ("text", "fact"),
    [
        ("", "first line"), ("left,any,0,1\n", "first line"), ("foot,vertex,start,end\nfeft,any,0,1\n", "line 2: foot 'feft'"),
        ("foot,vertex,start,end\nleft,x,0,1\n", "vertex 'x'"), ("foot,vertex,start,end\nleft,any,a,1\n", "neither a frame"),
        ("foot,vertex,start,end\nleft,any,5,1\n", "in order"), ("foot,vertex,start,end\nleft,any,99,100\n", "0 to 29"),
        ("foot,vertex,start,end\nleft,any,1\n", "3 columns"),
    ],
)  # fmt: skip
def test_bad_labels_say_what_and_where(tmp_path, text, fact):
    (tmp_path / "l.csv").write_text(text)
    with pytest.raises(mf.InputError, match=fact):
        load_labels(tmp_path / "l.csv", 30, 1 / 60)
    with pytest.raises(mf.InputError, match="cannot be read"):
        load_labels(tmp_path / "none.csv", 30, 1 / 60)


def test_labels_override_and_their_vertices_are_held(average, tmp_path):
    walk = samples.walk(cycles=2)
    vertex = int(find_sole(average, cells=None).of(0)[5])
    vertex = int(find_sole(average, cells=None).vertices[vertex])
    (tmp_path / "l.csv").write_text(f"foot,vertex,start,end\nleft,{vertex},10,30\nright,any,40,50\n")
    found = mf.remove_footskate(walk, average, labels=tmp_path / "l.csv")
    labels = found.plants.labels
    assert (
        set(labels[10:31]) == {"left"}
        and set(labels[40:51]) == {"right"}
        and (labels == "none").sum() == len(labels) - 32
    )
    assert (found.plants.vertex[10:31, 0] == vertex).all()
    held = posed_vertices(average, found.motion[np.arange(10, 31)])[:, vertex]
    assert np.ptp(held[:, [0, 2]], axis=0).max() < 1e-6
    head = int(np.asarray(average.skin.vertices_bind)[:, 1].argmax())
    for text, fact in ((f"left,{head},1,2", "not to a foot"), ("left,999999,1,2", "not in the mesh"),
                       (f"right,{vertex},1,2", "not on the right foot")):  # fmt: skip
        (tmp_path / "l.csv").write_text(f"foot,vertex,start,end\n{text}\n")
        with pytest.raises(mf.InputError, match=fact):
            mf.remove_footskate(walk, average, labels=tmp_path / "l.csv")


@given(st.lists(st.floats(-1, 1), min_size=1, max_size=9), st.floats(0, 2))
def test_two_state_path_is_the_best_of_all(evidence, cost):
    def score(states):
        return sum(e if s else -e for e, s in zip(evidence, states, strict=True)) - cost * np.sum(np.diff(states))

    every = [[bool(k >> i & 1) for i in range(len(evidence))] for k in range(2 ** len(evidence))]
    gains = [
        sum(e if s else -e for e, s in zip(evidence, states, strict=True))
        - cost * sum(a != b for a, b in zip(states, states[1:], strict=False))
        for states in every
    ]
    found = two_state_path(np.array(evidence), cost).tolist()
    assert gains[every.index(found)] == pytest.approx(max(gains), abs=1e-9)


def test_a_foot_that_is_off_already_is_not_down(average):
    """Averaged speeds and the cost of a change let a plant last a frame or two too long, or begin too early."""
    sole, frames = find_sole(average), 20
    rows = sole.of(0)[0], sole.of(1)[0]
    paths = np.zeros((frames, len(sole.vertices), 3))
    paths[:, rows[0], 0] = np.cumsum([0, 0.03, 0.02, *[0.001] * 6, 0.03, *[0.001] * 8, 0.02, 0.05])
    vertex = np.tile(sole.vertices[list(rows)], (frames, 1))
    vertex[:2, 1] = vertex[15:, 1] = -1
    found = _without_fast_ends(sole, paths, vertex, 0.01)
    # a plant is not split: the fast step amid it stays
    assert runs(found[:, 0] >= 0) == [(2, 17)] and runs(found[:, 1] >= 0) == [(2, 14)]
    np.testing.assert_array_equal(found[found >= 0], vertex[found >= 0])


def test_smoothing_keeps_straight_lines_and_short_clips():
    line = np.linspace(0, 1, 11)[:, None] * [1.0, 2.0]
    np.testing.assert_allclose(smooth(line, 5), line, atol=1e-12)
    assert smooth(line[:1], 5).shape == (1, 2) and runs(np.array([True, True, False, True])) == [(0, 1), (3, 3)]


# --- detection on clips whose contacts are known ------------------------------------------------------------------------


def test_builtin_walk_is_labelled_as_it_was_made(average):
    walk = samples.walk(cycles=4)
    gait = samples._Gait(walk.skeleton)
    plants = mf.detect_footplants(walk, average)
    phase = np.arange(walk.frame_count) / 60 / gait.duration
    truth = np.stack([np.mod(phase - shift, 1.0) for shift in (0.0, 0.5)], axis=1)
    truth = (truth > samples.STRIKE) & (truth < samples.LIFT)
    # the walk says when heel and ball touch; the skin's toes stay down a little longer
    assert (plants.planted == truth).mean() > 0.9
    assert set(plants.labels) == {"left", "right", "both"}
    assert abs(plants.floor.height) < 0.01 and plants.floor.tilt < 0.01
    assert ((plants.vertex >= 0) == plants.planted).all() and plants.confidence[plants.planted].mean() > 0.8


@pytest.mark.parametrize("rate", [24.0, 60.0, 120.0])
@pytest.mark.parametrize("height", [0.05, 0.4])
def test_flight_is_found(average, height, rate):
    jump, in_air = jumping(average, height, rate)
    labels = mf.detect_footplants(jump, average).labels
    assert (labels[in_air] == "none").mean() > 0.8
    assert (labels[~in_air] == "both").mean() > 0.9


def test_a_foot_held_up_is_not_planted(average):
    rest = rest_motion(average.skeleton, 1 / 60)
    rotations = np.repeat(np.asarray(rest.rotations), 90, axis=0)
    for role, angle in (("thigh", -1.0), ("calf", 1.2)):
        joint = average.skeleton.joint(f"right_{role}")
        turn = Rotation.from_rotvec([angle, 0, 0]) * Rotation.from_quat(rotations[:, joint], scalar_first=True)
        rotations[:, joint] = turn.as_quat(scalar_first=True)
    pose = mf.Motion(average.skeleton, np.repeat(np.asarray(rest.root), 90, axis=0), rotations, 1 / 60)
    assert set(mf.detect_footplants(pose, average).labels) == {"left"}


def test_short_clips_and_none_planted(average):
    walk = samples.walk(cycles=1)
    for frames in (1, 2, 3):
        for method in ("root", "leg-ik", "adaptive"):
            found = mf.remove_footskate(walk[10 : 10 + frames], average, method)
            assert found.motion.frame_count == frames and np.isfinite(found.motion.root).all()
            assert json.dumps(found.report(), allow_nan=False)
    # upside down in the air: no sole is ever near the floor that the others would show
    high, in_air = jumping(average, 0.4)
    flying = mf.remove_footskate(high[np.flatnonzero(in_air)[8:-8]], average, floor=None)
    assert flying.motion.rotations is not None and np.isfinite(flying.motion.root).all()


def test_a_handstand_gets_an_answer(average):
    rest = rest_motion(average.skeleton, 1 / 60)
    over = Rotation.from_rotvec([np.pi, 0, 0]) * Rotation.from_quat(np.asarray(rest.rotations)[:, 0], scalar_first=True)
    rotations = np.repeat(np.asarray(rest.rotations), 30, axis=0)
    rotations[:, 0] = over.as_quat(scalar_first=True)
    root = np.repeat(np.asarray(rest.root), 30, axis=0) * [1.0, 0.9, 1.0]
    found = mf.remove_footskate(mf.Motion(average.skeleton, root, rotations, 1 / 60), average, floor=None)
    np.testing.assert_allclose(found.motion.root, root, atol=SAME)
    stood = mf.detect_footplants(mf.Motion(average.skeleton, root, rotations, 1 / 60), average, floor=0.0)
    assert set(stood.labels) == {"none"} and stood.primary.max() == -1
    nothing = mf.remove_footskate(mf.Motion(average.skeleton, root, rotations, 1 / 60), average, plants=stood)
    assert nothing.status == "no_progress" and np.array_equal(nothing.motion.root, root)


# --- real clips ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def male(shared_data):
    return mf.load_character(shared_data / "characters" / "avg_male.glb")


@pytest.fixture(scope="module")
def hand_labelled(shared_data, male):
    from benchmarks.footplants import labelled

    return labelled(shared_data, male)


def test_labels_agree_with_the_eye_and_better_than_the_baselines(hand_labelled, male):
    from benchmarks.footplants import methods, score, tuned

    assert len(hand_labelled) >= 10
    table = {
        name: score([label(m) for _, m, _ in hand_labelled], hand_labelled)
        for name, label in methods(male, *tuned(hand_labelled, male)).items()
    }
    mine = table.pop("motionfit")
    assert min(mine[f"F1 {label}"] for label in ("none", "left", "right", "both")) >= 0.95
    assert mine["flights found"] == 1.0 and mine["boundary median"] <= 1.0
    for row in table.values():
        assert all(mine[k] >= row[k] for k in ("mean F1", "F1 none", "F1 left", "F1 right", "F1 both"))
