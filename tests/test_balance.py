"""The zero-moment point against closed forms; support distances against SciPy's hulls; gradients."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.thesis._setting import planted_feet
from motionfit import samples
from motionfit._motion import rest_motion
from motionfit.balance import (
    FLIGHT,
    GRAVITY,
    angular_momentum,
    balance_measures,
    centre_of_mass,
    hull_distance,
    linear_momentum,
    nearest_in_hull,
    optimised_masses,
    smooth_derivatives,
    sole_boxes,
    support_distance,
    support_polygon,
    zero_moment_point,
    zmp_distance,
)  # fmt: skip
from motionfit.shape.mass import LIMBS, Masses, mass_volumes, mesh_masses, volume_masses
from tests.helpers import central_difference, random_motion

# one program per clip length instead of one per operation
kinematics = eqx.filter_jit(mf.forward_kinematics)
hull, smooth = jax.jit(hull_distance), jax.jit(smooth_derivatives)

EXACT = 1e-9  # what passes through the filter unchanged [m]
FILTERED = 2e-3  # the filter's own error on a smooth motion [m]
RELATIVE = 1e-5  # analytic against central differences in double precision


def _body(positions, turns, rate, mass=1.0, centre=(0.0, 0.0, 0.0), inertia=0.0):
    """One rigid body: its joint's path and rotation are the motion's own."""
    skeleton = mf.Skeleton(["body"], [-1], np.zeros((1, 3)))
    motion = mf.Motion(skeleton, np.asarray(positions, float), turns.as_quat(scalar_first=True)[:, None], 1.0 / rate)
    masses = Masses(("hips",), (0,), np.array([mass]), np.array([centre], float), np.array([inertia * np.eye(3)]))
    return kinematics(skeleton, motion), masses


@given(st.sampled_from([3, 4, 60]), st.floats(0.0, 0.2), st.sampled_from([24.0, 60.0, 120.0]), st.integers(0, 2**31))
def test_filter_is_exact_on_quadratics(frames, window, rate, seed):
    a, b, c = np.random.default_rng(seed).normal(size=(3, 2))
    t = np.arange(frames)[:, None] / rate
    value, velocity, acceleration = smooth(a + b * t + c * t * t, 1 / rate, window)
    np.testing.assert_allclose(value, a + b * t + c * t * t, atol=1e-8)
    np.testing.assert_allclose(velocity, b + 2 * c * t, atol=1e-6)
    np.testing.assert_allclose(acceleration, np.broadcast_to(2 * c, t.shape[:1] + (2,)), atol=2e-4)


def test_filter_has_the_response_it_states():
    rate, window = 120.0, 0.03
    t = np.arange(480) / rate
    for frequency, kept in ((1.0, 0.98), (2.0, 0.93), (4.0, 0.75), (6.0, 0.53), (10.0, 0.17)):
        w = 2 * np.pi * frequency
        wave = np.cos(w * t)
        acceleration = smooth_derivatives(wave, jnp.asarray(1 / rate), window)[2][200:280]
        expected = np.exp(-((w * window) ** 2) / 2)
        np.testing.assert_allclose(acceleration, -w * w * expected * wave[200:280], atol=0.01 * w * w)
        assert expected == pytest.approx(kept, abs=0.006)


def test_one_and_two_frames_are_enough():
    for frames in (1, 2):
        x = np.arange(frames)[:, None] * 0.5
        value, velocity, acceleration = smooth_derivatives(x, jnp.asarray(0.1))
        np.testing.assert_array_equal(value, x)
        np.testing.assert_allclose(velocity, np.full_like(x, 5.0 if frames == 2 else 0.0))
        np.testing.assert_array_equal(acceleration, np.zeros_like(x))


@pytest.mark.parametrize("spin", [True, False])
def test_a_static_pose_has_its_zmp_under_the_centre_of_mass(heavy, spin):
    motion = samples.walk(cycles=1)
    still = mf.onto(motion, heavy.skeleton)[np.full(20, 17)]
    kin, masses = kinematics(heavy.skeleton, still), mesh_masses(heavy)
    zmp = zero_moment_point(kin, masses, spin=spin, ground=0.02)
    com = np.asarray(centre_of_mass(kin, masses))
    np.testing.assert_allclose(zmp.point_world[:, [0, 2]], com[:, [0, 2]], atol=EXACT)
    np.testing.assert_allclose(zmp.point_world[:, 1], 0.02, atol=EXACT)
    np.testing.assert_allclose(zmp.load, 1.0, atol=EXACT)


def test_a_sliding_mass():
    """Pushed along the floor with acceleration a at height h, the ZMP lags by h a / g."""
    t = np.arange(40) / 60.0
    a, h = np.array([1.3, 0.0, -0.7]), 0.9
    path = np.array([5.0, h, -2.0]) + np.outer(t, [0.4, 0, 1.0]) + 0.5 * np.outer(t * t, a)
    kin, masses = _body(path, Rotation.identity(40), 60.0, mass=3.0)
    zmp = zero_moment_point(kin, masses)
    np.testing.assert_allclose(zmp.point_world[:, [0, 2]], (path - h * a / GRAVITY)[:, [0, 2]], atol=1e-7)


def test_a_lift_does_not_move_the_zmp_of_a_mass_but_loads_the_ground():
    t = np.arange(40) / 60.0
    path = np.stack([np.full(40, 0.3), 1.0 + 0.5 * 2.0 * t * t, np.full(40, -0.1)], axis=1)
    kin, masses = _body(path, Rotation.identity(40), 60.0)
    zmp = zero_moment_point(kin, masses)
    np.testing.assert_allclose(zmp.load, 1 + 2.0 / GRAVITY, atol=1e-7)
    np.testing.assert_allclose(zmp.point_world[:, [0, 2]], path[:, [0, 2]], atol=EXACT)


def test_a_flywheel_pushes_the_zmp_aside():
    """Angular acceleration A about z at rest: x - x_com = I A / (m g); about x: z - z_com = -I A / (m g)."""
    t = np.arange(40) / 60.0
    rate, inertia, mass = 6.0, 0.8, 20.0
    for axis, sign, column in ((2, 1.0, 0), (0, -1.0, 2)):
        turns = Rotation.from_rotvec(np.outer(0.5 * rate * t * t, np.eye(3)[axis]))
        kin, masses = _body(np.tile([0.2, 1.0, 0.1], (40, 1)), turns, 60.0, mass, inertia=inertia)
        offset = np.asarray(zero_moment_point(kin, masses).point_world)[:, column] - kin.positions_world[:, 0, column]
        np.testing.assert_allclose(offset, sign * inertia * rate / (mass * GRAVITY), atol=1e-6)
        still = zero_moment_point(kin, masses, spin=False).point_world[:, column]
        np.testing.assert_allclose(still, kin.positions_world[:, 0, column], atol=EXACT)


def test_a_steady_spin_leaves_the_zmp_alone():
    turns = Rotation.from_rotvec(np.outer(np.arange(40) / 60.0 * 9.0, [0.3, 0.9, -0.2]))
    kin, masses = _body(np.tile([0.2, 1.0, 0.1], (40, 1)), turns, 60.0, 20.0, inertia=0.8)
    np.testing.assert_allclose(zero_moment_point(kin, masses).point_world[:, [0, 2]], [[0.2, 0.1]] * 40, atol=1e-7)
    momentum = np.asarray(angular_momentum(kin, masses))
    np.testing.assert_allclose(momentum, momentum[:1].repeat(40, 0), atol=1e-9)


def test_a_falling_rod_has_its_zmp_at_the_pivot():
    """An inverted compound pendulum on a free pivot: its reaction passes through the pivot, whatever it does."""
    mass, inertia, reach, rate = 5.0, 0.4, 0.9, 240.0
    gain = mass * GRAVITY * reach / (inertia + mass * reach**2)
    t = np.arange(150) / rate
    angle = solve_ivp(lambda _, y: [y[1], gain * np.sin(y[0])], (0, t[-1]), [0.1, 0.2], t_eval=t, rtol=1e-10).y[0]
    turns = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, -1.0]))  # falls towards +x
    kin, masses = _body(np.tile([0.5, 0.0, 0.3], (len(t), 1)), turns, rate, mass, (0, reach, 0), inertia)
    zmp = np.asarray(zero_moment_point(kin, masses, window=0.0).point_world)
    np.testing.assert_allclose(zmp[:-1, [0, 2]], [[0.5, 0.3]] * (len(t) - 1), atol=FILTERED)
    # the point mass misses the rod's own turning
    missed = np.asarray(zero_moment_point(kin, masses, window=0.0, spin=False).point_world)[:, 0] - 0.5
    assert np.abs(missed).max() > 0.02


def test_flight_is_told_and_finite():
    t = np.arange(40) / 60.0
    path = np.stack([2.0 * t, 1.0 + 3.0 * t - 0.5 * GRAVITY * t * t, 0 * t], axis=1)
    kin, masses = _body(path, Rotation.identity(40), 60.0, mass=70.0)
    zmp = zero_moment_point(kin, masses)
    np.testing.assert_allclose(zmp.load, 0.0, atol=1e-6)
    assert np.isfinite(zmp.point_world).all()
    momentum = np.asarray(linear_momentum(kin, masses))
    expected = 70.0 * np.stack([np.full(40, 2.0), 3.0 - GRAVITY * t, 0 * t], axis=1)
    np.testing.assert_allclose(momentum, expected, atol=1e-6)


def _smooth_motion(seed, rate=1000.0, frames=300):
    """A few bodies on sines, sampled so densely that finite differences do not matter."""
    rng = np.random.default_rng(seed)
    parents = [-1, 0, 1, 0]
    skeleton = mf.Skeleton([f"j{k}" for k in range(4)], parents, rng.normal(size=(4, 3)) * 0.3)
    t = np.arange(frames) / rate
    waves = np.sin(2 * np.pi * np.outer(t, rng.uniform(0.5, 1.5, 15)) + rng.uniform(0, 6, 15))
    root = np.array([0, 1.2, 0]) + 0.02 * waves[:, :3]
    turns = Rotation.from_rotvec(0.15 * waves[:, 3:].reshape(-1, 3)).as_quat(scalar_first=True).reshape(frames, 4, 4)
    inertia = np.stack([a @ a.T + 0.01 * np.eye(3) for a in rng.normal(size=(4, 3, 3)) * 0.1])
    masses = Masses(("hips", "chest", "head", "left_thigh"), (0, 1, 2, 3), rng.uniform(1, 8, 4),
                    rng.normal(size=(4, 3)) * 0.1, inertia)  # fmt: skip
    return skeleton, mf.Motion(skeleton, root, turns, 1 / rate), masses


@pytest.mark.parametrize("seed", range(3))
def test_it_is_the_printed_sum_over_the_bodies(seed):
    """Thesis 4.7: x = sum m ((y'' + g) x - x'' y) / sum m (y'' + g), z alike."""
    skeleton, motion, masses = _smooth_motion(seed)
    kin = kinematics(skeleton, motion)
    local = jnp.asarray(masses.centre_joint)[None]
    from motionfit import rotation

    p = np.asarray(kin.positions_world + rotation.rotate(kin.rotations_world, local))
    a = np.gradient(np.gradient(p, float(motion.dt), axis=0), float(motion.dt), axis=0)[20:-20]
    p, m = p[20:-20], np.asarray(masses.mass)
    down = ((a[..., 1] + GRAVITY) * m).sum(1)
    printed = [(m * ((a[..., 1] + GRAVITY) * p[..., k] - a[..., k] * p[..., 1])).sum(1) / down for k in (0, 2)]
    zmp = zero_moment_point(kin, masses, spin=False, window=0.0)
    np.testing.assert_allclose(np.asarray(zmp.point_world)[20:-20, [0, 2]], np.stack(printed, 1), atol=2e-4)


@pytest.mark.parametrize(("seed", "scale"), [(0, 0.1), (1, 3.0), (2, 10.0)])
def test_zmp_moves_with_the_body_and_ignores_the_total_mass(seed, scale):
    motion = random_motion(seed, 5, 8)
    rng = np.random.default_rng(seed)
    # slowed down: random rotations from frame to frame are no motion at all
    slow = Rotation.from_rotvec(0.02 * rng.normal(size=(40, 3))).as_quat(scalar_first=True).reshape(8, 5, 4)
    motion = mf.Motion(motion.skeleton, 0.01 * np.asarray(motion.root), slow, 1 / 60)
    masses = Masses(("hips",) * 5, tuple(range(5)), rng.uniform(1, 5, 5), rng.normal(size=(5, 3)),
                    np.tile(0.1 * np.eye(3), (5, 1, 1)))  # fmt: skip
    shift, heading = np.array([30.0, 0.0, -80.0]), Rotation.from_rotvec([0, rng.uniform(-3, 3), 0])
    rotations = np.array(motion.rotations)
    own = Rotation.from_quat(rotations[:, 0].copy(), scalar_first=True)
    rotations[:, 0] = (heading * own).as_quat(scalar_first=True)
    moved = mf.Motion(motion.skeleton, heading.apply(np.array(motion.root)) + shift, rotations, 1 / 60)
    heavier = Masses(
        masses.roles, masses.joints, scale * masses.mass, masses.centre_joint, scale * masses.inertia_joint
    )
    first = zero_moment_point(kinematics(motion.skeleton, motion), masses)
    second = zero_moment_point(kinematics(moved.skeleton, moved), heavier)
    np.testing.assert_allclose(second.load, first.load, atol=1e-8)
    ok = np.asarray(first.load) > FLIGHT
    expected = heading.apply(np.array(first.point_world)) + shift
    np.testing.assert_allclose(np.asarray(second.point_world)[ok], expected[ok], atol=1e-6)


def test_zmp_gradient():
    skeleton, motion, masses = _smooth_motion(5, rate=60.0, frames=7)

    def total(turns):
        turned = mf.Motion(skeleton, motion.root, turns, motion.dt)
        zmp = zero_moment_point(kinematics(skeleton, turned), masses)
        return jnp.sum(jnp.sin(zmp.point_world)) + jnp.sum(zmp.load)

    turns = np.asarray(motion.rotations)
    gradient = np.asarray(jax.jit(jax.grad(total))(jnp.asarray(turns)))
    expected = central_difference(jax.jit(total), turns)
    np.testing.assert_allclose(gradient, expected, atol=RELATIVE * np.abs(expected).max())


def test_single_precision_agrees(heavy):
    motion = mf.onto(samples.walk(cycles=1), heavy.skeleton)
    kin, masses, soles = kinematics(heavy.skeleton, motion), mesh_masses(heavy), sole_boxes(heavy)
    coarse = jax.tree.map(lambda x: x.astype(jnp.float32), kin)
    planted = np.ones((motion.frame_count, 2), bool)
    exact, single = (zmp_distance(k, masses, soles, planted) for k in (kin, coarse))
    assert single.signed.dtype == jnp.float32
    # 1 um of rounding at 60 frames per second is 4 mm/s^2 of acceleration, at a height of a metre 0.4 mm of ZMP
    np.testing.assert_allclose(single.signed, exact.signed, atol=2e-3)
    with pytest.raises(mf.InputError, match="planted has shape"):
        zmp_distance(kin, masses, soles, planted[:5])


def test_new_numbers_do_not_compile_again(average, monkeypatch):
    motion = rest_motion(average.skeleton)[np.zeros(23, int)]
    kin, masses, soles = kinematics(average.skeleton, motion), mesh_masses(average), sole_boxes(average)
    traced = []

    def counted(*arguments):
        traced.append(1)
        return smooth_derivatives(*arguments)

    monkeypatch.setattr("motionfit.balance.smooth_derivatives", counted)
    for ground, window in ((0.0, 0.03), (0.01, 0.03), (0.02, 0.05)):
        zero_moment_point(kin, masses, ground=ground, window=window)
        zmp_distance(kin, masses, soles, np.ones((23, 2), bool), ground=ground, window=window)
        if ground == 0.0:
            first = len(traced)
    assert first > 0 and len(traced) == first


# --- support ------------------------------------------------------------------------------------------------------


def _oracle(point, corners):
    hull = ConvexHull(corners)
    ring = corners[np.append(hull.vertices, hull.vertices[0])]
    best = np.inf
    for a, b in zip(ring, ring[1:], strict=False):
        t = np.clip((point - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
        best = min(best, np.linalg.norm(point - a - t * (b - a)))
    inside = (hull.equations[:, :2] @ point + hull.equations[:, 2] <= 0).all()
    return -best if inside else best


nearest_jit = jax.jit(nearest_in_hull)


@given(st.integers(0, 2**31), st.integers(3, 8), st.booleans())
def test_hull_distance_is_scipys(seed, count, near):
    rng = np.random.default_rng(seed)
    corners, point = rng.normal(size=(8, 2)), rng.normal(size=2) * (0.5 if near else 3.0)
    present = np.zeros(8, bool)
    present[rng.permutation(8)[:count]] = True
    distance = hull(jnp.asarray(point), jnp.asarray(corners), jnp.asarray(present))
    expected = _oracle(point, corners[present])
    assert float(distance) == pytest.approx(expected, abs=1e-9)
    nearest = np.asarray(nearest_jit(jnp.asarray(point), jnp.asarray(corners), jnp.asarray(present)))
    assert np.linalg.norm(nearest - point) == pytest.approx(max(expected, 0.0), abs=1e-9)
    assert _oracle(nearest, corners[present]) <= 1e-9


def test_hull_distance_of_less_than_a_polygon():
    corners = jnp.asarray([[0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [9.0, 9.0]])
    line, one, none = ([True, True, True, False], [False, True, False, False], [False] * 4)
    for present, point, expected in (
        (line, [1.0, 0.5], 0.5), (line, [3.0, 0.0], 1.0), (line, [1.5, 0.0], 0.0), (one, [2.0, -2.0], 2.0),
        (none, [5.0, 5.0], 0.0),
    ):  # fmt: skip
        value, slope = jax.jit(jax.value_and_grad(hull_distance))(jnp.asarray(point), corners, jnp.asarray(present))
        assert float(value) == pytest.approx(expected, abs=1e-12) and np.isfinite(slope).all()
    np.testing.assert_array_equal(support_polygon(np.zeros((4, 2))), [[0.0, 0.0]])


def test_hull_distance_gradient(rng):
    corners = rng.normal(size=(20, 8, 2))
    points = rng.normal(size=(20, 2)) * 1.5
    present = np.ones((20, 8), bool)

    def total(x):
        return jnp.sum(hull_distance(x[:, 0], x[:, 1:], jnp.asarray(present)) ** 2)

    x = np.concatenate([points[:, None], corners], axis=1)
    np.testing.assert_allclose(
        jax.jit(jax.grad(total))(jnp.asarray(x)), central_difference(jax.jit(total), x), atol=1e-6
    )


def test_two_identical_feet_side_by_side_have_one_clean_hull():
    """Collinear corners, as two parallel soles have: no edge is lost or doubled into a wrong sign."""
    box = np.array([[0.0, 0.0], [0.1, 0.0], [0.1, 0.3], [0.0, 0.3]])
    corners = np.concatenate([box, box + [0.2, 0.0]])
    for point, expected in (
        ([0.15, 0.15], -0.15),
        ([0.15, 0.02], -0.02),
        ([0.15, 0.4], 0.1),
        ([0.4, 0.4], np.sqrt(0.02)),
    ):
        value = hull(jnp.asarray(point), jnp.asarray(corners), jnp.ones(8, bool))
        assert float(value) == pytest.approx(expected, abs=1e-9)
    ring = support_polygon(corners)
    area = np.sum(np.cross(np.pad(ring, ((0, 0), (0, 1))), np.pad(np.roll(ring, -1, 0), ((0, 0), (0, 1))))[:, 2]) / 2
    assert area == pytest.approx(0.3 * 0.3)


def test_sole_boxes_lie_under_the_feet(heavy):
    soles = sole_boxes(heavy)
    corners = np.asarray(soles.corners_world(kinematics(heavy.skeleton, rest_motion(heavy.skeleton))))[0]
    vertices = np.asarray(heavy.skin.vertices_bind)
    assert np.abs(corners[..., 1] - vertices[:, 1].min()).max() < 0.01
    length = np.linalg.norm(corners[:, 3] - corners[:, 0], axis=-1)
    width = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=-1)
    # the thesis's subject of 1.85 m: 29.6 by 13.5 cm
    assert ((length > 0.2) & (length < 0.33)).all() and ((width > 0.06) & (width < 0.15)).all()
    assert (corners[0, :, 0] > 0).all() and (corners[1, :, 0] < 0).all()  # left is +x


def test_standing_is_supported_and_leaning_is_not(heavy):
    motion = rest_motion(heavy.skeleton)[np.zeros(10, int)]
    kin, masses, soles = kinematics(heavy.skeleton, motion), mesh_masses(heavy), sole_boxes(heavy)
    both = np.ones((10, 2), bool)
    standing = zmp_distance(kin, masses, soles, both)
    assert (np.asarray(standing.signed) < 0).all() and np.asarray(standing.supported).all()
    one = zmp_distance(kin, masses, soles, both & np.array([True, False]))
    assert (np.asarray(one.signed) > 0).all()  # the middle of the body is not above one foot
    none = zmp_distance(kin, masses, soles, ~both)
    assert not np.asarray(none.supported).any() and not np.asarray(none.outside).any()
    assert balance_measures(none) == {"zmp_distance_mean_m": None, "zmp_distance_sd_m": None,
                                      "excess_over_reference_mean_m": None, "supported_frames": 0}  # fmt: skip
    measures = balance_measures(one, standing)
    assert measures["excess_over_reference_mean_m"] == pytest.approx(measures["zmp_distance_mean_m"])
    assert measures["zmp_distance_sd_m"] == pytest.approx(0.0, abs=1e-9) and measures["supported_frames"] == 10
    assert balance_measures(one, one)["excess_over_reference_mean_m"] == 0.0
    with pytest.raises(mf.InputError, match="10 frames, the motion 9"):
        balance_measures(jax.tree.map(lambda x: x[:9], one), one)


def test_support_follows_the_feet(heavy):
    """The distance is that of the moved sole: a step sideways takes the support along."""
    soles = sole_boxes(heavy)
    kin = kinematics(heavy.skeleton, rest_motion(heavy.skeleton)[np.zeros(3, int)])
    corners = soles.corners_world(kin)
    middle = jnp.mean(corners[:, 0], axis=1)
    planted = jnp.asarray([[True, False]] * 3)
    shifted = middle + jnp.asarray([0.5, 0.0, 0.0])
    np.testing.assert_allclose(
        support_distance(shifted, corners + jnp.asarray([0.5, 0.0, 0.0]), planted),
        support_distance(middle, corners, planted), atol=1e-12,
    )  # fmt: skip
    assert (np.asarray(support_distance(middle, corners, planted)) < 0).all()


def test_optimised_masses_come_nearer_to_the_support_at_the_same_total(average):
    motion = mf.onto(samples.walk(cycles=1), average.skeleton)
    kin, soles = kinematics(average.skeleton, motion), sole_boxes(average)
    masses = volume_masses(mass_volumes(average))
    planted = planted_feet(average, motion).feet
    found = optimised_masses(kin, masses, soles, planted)
    assert float(found.total) == pytest.approx(float(masses.total))
    assert min(found.limbs()[limb] for limb in LIMBS) >= 0

    def spread(m):
        distance = zmp_distance(kin, m, soles, planted, spin=False)
        return float(np.sum(np.asarray(distance.outside) ** 2))

    assert spread(found) < spread(masses)


# --- the term -----------------------------------------------------------------------------------------------------


def _margin(character, motion, planted, **options):
    masses, soles = mesh_masses(character), sole_boxes(character)
    threshold = options.pop("threshold", np.zeros(motion.frame_count))
    return mf.terms.ZmpMargin(masses, soles, planted, threshold, **options)


@pytest.mark.parametrize("pose", ["walk", "bind"])
@pytest.mark.parametrize("kind", ["outside", "contact"])
def test_zmp_margin_contract(heavy, pose, kind):
    """Rows per frame, finite, and a gradient that central differences confirm: that of tests/test_terms.py."""
    from motionfit.splines import bspline_basis

    if pose == "walk":
        motion = mf.onto(samples.walk(cycles=1), heavy.skeleton)[20:29]
    else:
        motion = rest_motion(heavy.skeleton)[np.zeros(9, int)]
    planted = np.tile([True, False], (9, 1))
    planted[4] = [True, True]
    planted[6] = [False, False]
    kin = kinematics(heavy.skeleton, motion)
    own = np.asarray(zmp_distance(kin, mesh_masses(heavy), sole_boxes(heavy), planted).signed)
    # within a hair of the limit, every other frame on this side of it; or far outside
    threshold = own - 1e-4 * np.where(np.arange(9) % 2 == 0, 1.0, -1.0) if kind == "contact" else own - 0.05
    term = _margin(heavy, motion, planted, threshold=threshold)
    basis = bspline_basis(9, float(motion.dt), 0.1)
    axes = {"hips": [0.0, 0.0, 1.0], "left_thigh": [1.0, 0.0, 0.0], "left_foot": [1.0, 0.0, 0.0]}
    controls = tuple(
        mf.Control(role, (mf.Drive(heavy.skeleton.joint(role), np.array(axis), 1.0),), basis)
        for role, axis in axes.items()
    )
    problem = mf.Problem(heavy, motion, {"term": term}, controls)

    size = 1e-3 if kind == "outside" else 1e-6
    start = size * np.random.default_rng(3).normal(size=3 * basis.count)
    at_zero = np.asarray(_rows(problem, jnp.zeros(start.shape)))
    assert at_zero.shape == (9,) and np.isfinite(at_zero).all() and at_zero[6] == 0.0
    assert (at_zero[[0, 2, 4, 8]] > 0).all()
    for x in (np.zeros_like(start), start):
        # a ZMP moves by a hundred metres per radian of a single frame: small steps, to stay on one side of the corner
        gradient = np.asarray(_slope(problem, jnp.asarray(x)))
        expected = central_difference(lambda x: _cost(problem, jnp.asarray(x)), x, 1e-8)
        assert np.isfinite(gradient).all() and np.abs(expected).max() > 0
        np.testing.assert_allclose(gradient, expected, atol=1e-4 * np.abs(expected).max() + 1e-7)


@eqx.filter_jit
def _rows(problem, x):
    points = jnp.split(x, len(problem.controls))
    signals = jnp.stack([c.signal(p) for c, p in zip(problem.controls, points, strict=True)], axis=1)
    return problem.terms["term"].residual(problem.kinematics(signals))


@eqx.filter_jit
def _cost(problem, x):
    return 0.5 * jnp.sum(_rows(problem, x) ** 2)


@eqx.filter_jit
def _slope(problem, x):
    return jax.grad(lambda x: _cost(problem, x))(x)


def test_zmp_margin_asks_for_nothing_that_the_original_did_not_have(heavy):
    motion = mf.onto(samples.walk(cycles=1), heavy.skeleton)
    kin, soles = kinematics(heavy.skeleton, motion), sole_boxes(heavy)
    planted = planted_feet(heavy, motion).feet
    original = zmp_distance(kin, mesh_masses(heavy), soles, planted)
    assert np.asarray(original.outside).max() > 0.003  # a walk leaves its support: thesis 5.6.2
    kept = _margin(heavy, motion, planted, threshold=np.asarray(original.outside))
    residual = eqx.filter_jit(lambda term: term.residual(kin))
    np.testing.assert_allclose(residual(kept), 0.0, atol=1e-9)
    assert kept.reach is None and _margin(heavy, motion, planted, frames_around=9).reach == 9
    stricter = _margin(heavy, motion, planted, threshold=np.asarray(original.outside), scale=0.5)
    rows = np.asarray(residual(stricter))
    assert (rows >= 0).all() and rows.max() > 0.1


def test_zmp_margin_does_not_recompile_for_new_numbers(heavy):
    motion = rest_motion(heavy.skeleton)[np.zeros(5, int)]
    kin, planted, count = kinematics(heavy.skeleton, motion), np.ones((5, 2), bool), []

    @jax.jit
    def cost(term):
        count.append(1)
        return jnp.sum(term.residual(kin))

    for scale, sigma in ((1.0, 0.01), (0.9, 0.02), (0.5, 0.03)):
        cost(_margin(heavy, motion, planted, scale=scale, sigma=sigma))
    assert len(count) == 1


@pytest.mark.parametrize("frames", [1, 2, 3])
def test_the_shortest_clips(heavy, frames):
    motion = rest_motion(heavy.skeleton)[np.zeros(frames, int)]
    distance = zmp_distance(
        kinematics(heavy.skeleton, motion), mesh_masses(heavy), sole_boxes(heavy), np.ones((frames, 2), bool)
    )
    assert np.isfinite(distance.signed).all() and np.asarray(distance.supported).all()
