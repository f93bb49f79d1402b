"""Limbs in closed form against numerical solutions, and priorities that hold."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import fsolve, least_squares
from scipy.spatial.transform import Rotation

from motionfit.ik import limited_step, move_limb, plane_angles, prioritized, prioritized_step, solve_limb, swivel_angle

EXACT = 1e-12  # [m] closed forms of lengths of about a metre
NUMERIC = 1e-7  # what the numerical oracles are solved to


def turned(angle: float, v: np.ndarray) -> np.ndarray:
    """In the (y, z) plane, from y to z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([c * v[0] - s * v[1], s * v[0] + c * v[1]])


def random_legs(rng, count: int) -> tuple[np.ndarray, ...]:
    """Hips, knees, ankles in space, and targets within reach."""
    hip = rng.normal(size=(count, 3))
    thigh = rng.normal(size=(count, 3))
    thigh *= 0.45 / np.linalg.norm(thigh, axis=1, keepdims=True)
    shank = Rotation.from_rotvec(rng.uniform(-0.9, 0.9, (count, 3))).apply(thigh) * 0.9
    ankle = hip + thigh + shank
    way = rng.normal(size=(count, 3))
    # thigh and shank lie in one plane with the line to the ankle, so that all of the length counts
    target = hip + way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0.2, 0.84, (count, 1))
    return hip, hip + thigh, ankle, target


# --- appendix C -----------------------------------------------------------------------------------------------


def test_plane_angles_move_the_ankle_and_keep_the_foot():
    rng = np.random.default_rng(1)
    thigh, shank = rng.normal(size=(2, 200, 2))
    move = 0.2 * rng.normal(size=(200, 2))
    found = plane_angles(thigh, shank, move)
    assert 50 < found.reachable.sum() <= 200
    for i in np.flatnonzero(found.reachable):
        for k in (0, 1):
            # the thigh turns by -alpha_3, the shank by +alpha_1, and with (C.13) the foot does not turn at all
            ankle = turned(-found.hip[k, i], thigh[i]) + turned(found.ankle[k, i], shank[i])
            np.testing.assert_allclose(ankle, thigh[i] + shank[i] + move[i], atol=EXACT)
        np.testing.assert_allclose(found.ankle[:, i] + found.knee[:, i] + found.hip[:, i], 0.0, atol=EXACT)
    assert (np.abs(found.hip[0]) <= np.abs(found.hip[1])).all()


def test_plane_angles_against_numerical_roots_of_c7():
    """(C.7), the two equations that the closed form solves, written out and solved by fsolve."""
    thigh, shank, move = np.array([-0.44, 0.06]), np.array([-0.40, -0.09]), np.array([0.03, 0.05])
    found = plane_angles(thigh[None], shank[None], move[None])

    def equations(x):
        a1, a3 = x
        (b3, c3), (c1, b1) = thigh, shank  # y3 - y2, z3 - z2; y2 - y1, z2 - z1
        y, z = thigh + shank + move
        return (np.cos(a3) * b3 + np.sin(a3) * c3 + np.cos(a1) * c1 - np.sin(a1) * b1 - y,
                np.cos(a3) * c3 - np.sin(a3) * b3 + np.cos(a1) * b1 + np.sin(a1) * c1 - z)  # fmt: skip

    for k in (0, 1):
        closed = np.array([found.ankle[k, 0], found.hip[k, 0]])
        np.testing.assert_allclose(np.asarray(fsolve(equations, closed + 0.05, xtol=1e-12)), closed, atol=NUMERIC)


def test_the_erratum_of_appendix_c():
    """With joints 1 and 3 as the text names them (hip and ankle) the same angles miss the target by centimetres."""
    thigh, shank, move = np.array([-0.44, 0.06]), np.array([-0.40, -0.09]), np.array([0.03, 0.05])
    found = plane_angles(thigh[None], shank[None], move[None])
    as_printed = turned(found.ankle[0, 0], thigh) + turned(-found.hip[0, 0], shank)
    assert np.linalg.norm(as_printed - (thigh + shank + move)) > 0.02


def test_out_of_reach_is_the_nearest_pose():
    thigh, shank = np.array([[-0.5, 0.0]] * 4), np.array([[-0.3, 0.1]] * 4)
    long = np.hypot(0.3, 0.1)
    targets = np.array([[-2.0, 0.0], [0.0, 1.5], [-0.01, 0.01], [0.0, 0.0]])
    found = plane_angles(thigh, shank, targets - thigh - shank)
    assert not found.reachable.any()
    for i, target in enumerate(targets):
        got = turned(-found.hip[0, i], thigh[i]) + turned(found.ankle[0, i], shank[i])
        distance = np.linalg.norm(target)
        nearest = abs(distance - (0.5 + long)) if distance > 0.5 else (0.5 - long) - distance
        assert np.linalg.norm(got - target) == pytest.approx(nearest, abs=1e-9)


# --- in space ---------------------------------------------------------------------------------------------------


def test_move_limb_reaches_and_keeps_lengths(rng):
    hip, knee, ankle, target = random_legs(rng, 300)
    lateral = np.cross(knee - hip, ankle - knee)
    found = move_limb(hip, knee, ankle, target, lateral / np.linalg.norm(lateral, axis=1, keepdims=True))
    assert found.reachable.all()
    np.testing.assert_allclose(found.end_world, target, atol=EXACT)
    moved_knee = hip + found.upper.apply(knee - hip)
    np.testing.assert_allclose(np.linalg.norm(target - moved_knee, axis=1), np.linalg.norm(ankle - knee, axis=1))


def test_move_limb_on_the_spot_turns_nothing(rng):
    hip, knee, ankle, _ = random_legs(rng, 100)
    found = move_limb(hip, knee, ankle, ankle, np.tile([1.0, 0.0, 0.0], (100, 1)))
    assert max(found.upper.magnitude().max(), found.lower.magnitude().max()) < 1e-7
    np.testing.assert_allclose(found.end_world, ankle, atol=1e-9)


def test_a_straight_knee_bends_forwards():
    """Legs straight down whose feet come up: the knee goes towards +z, where the lateral axis lets it, and stays
    there however the target is approached."""
    up = np.linspace(0.0, 0.3, 31)
    hip, knee, ankle = (np.tile([0.0, h, 0.0], (31, 1)) for h in (0.9, 0.45, 0.0))
    target = ankle + up[:, None] * [0.0, 1.0, 0.0]
    found = move_limb(hip, knee, ankle, target, np.tile([1.0, 0.0, 0.0], (31, 1)))
    forward = found.upper.apply(knee - hip)[:, 2]
    np.testing.assert_allclose(found.end_world, target, atol=1e-9)
    np.testing.assert_allclose(forward, np.sqrt(0.45**2 - ((0.9 - up) / 2) ** 2), atol=1e-9)


def test_move_limb_out_of_reach_points_at_the_target(rng):
    hip, knee, ankle, target = random_legs(rng, 50)
    far = hip + 3 * (target - hip) / np.linalg.norm(target - hip, axis=1, keepdims=True)
    lateral = np.cross(knee - hip, ankle - knee)
    found = move_limb(hip, knee, ankle, far, lateral / np.linalg.norm(lateral, axis=1, keepdims=True))
    assert not found.reachable.any() and np.isfinite(found.end_world).all()
    way, reach = far - hip, 0.45 + 0.45 * 0.9
    np.testing.assert_allclose(found.end_world, hip + way / 3 * reach, atol=1e-6)


def test_solve_limb_meets_target_swivel_and_side(rng):
    hip, knee, ankle, target = random_legs(rng, 300)
    pole, wanted = rng.normal(size=(300, 3)), rng.uniform(-np.pi, np.pi, 300)
    found = solve_limb(hip, knee, ankle, target, wanted, pole)
    moved = hip + found.upper.apply(knee - hip)
    np.testing.assert_allclose(moved + found.lower.apply(ankle - knee), target, atol=1e-9)
    got = swivel_angle(hip, moved, target, pole)
    np.testing.assert_allclose(np.angle(np.exp(1j * (got - wanted))), 0.0, atol=1e-6)


def test_solve_limb_with_its_own_swivel_turns_nothing(rng):
    hip, knee, ankle, _ = random_legs(rng, 100)
    pole = rng.normal(size=(100, 3))
    found = solve_limb(hip, knee, ankle, ankle, swivel_angle(hip, knee, ankle, pole), pole)
    assert max(found.upper.magnitude().max(), found.lower.magnitude().max()) < 1e-6


def test_solve_limb_against_numerical_ik(rng):
    """The middle joint found by least squares on its circle, from the same swivel."""
    hip, knee, ankle, target = random_legs(rng, 5)
    pole, swivel = np.tile([0.0, 0.0, 1.0], (5, 1)), np.full(5, 0.3)
    found = solve_limb(hip, knee, ankle, target, swivel, pole)
    for i in range(5):
        mine = hip[i] + found.upper.apply(knee - hip)[i]
        lengths = np.linalg.norm(knee[i] - hip[i]), np.linalg.norm(ankle[i] - knee[i])

        def residual(x, i=i, lengths=lengths):
            angle = swivel_angle(hip[i : i + 1], x[None], target[i : i + 1], pole[i : i + 1])[0]
            return [np.linalg.norm(x - hip[i]) - lengths[0], np.linalg.norm(target[i] - x) - lengths[1], angle - 0.3]

        solved = least_squares(residual, mine + 0.02, xtol=1e-14, ftol=1e-14, gtol=1e-14).x
        np.testing.assert_allclose(mine, solved, atol=NUMERIC)


# --- priorities -------------------------------------------------------------------------------------------------


def random_tasks(rng, batch=20, joints=7, sizes=(2, 2, 2)):
    jacobians = [rng.normal(size=(batch, m, joints)) for m in sizes]
    return jacobians, [rng.normal(size=(batch, m)) for m in sizes]


def test_two_levels_against_the_analytic_solution(rng):
    """dq = J1+ e1 + (J2 P1)+ (e2 - J2 J1+ e1), P1 = 1 - J1+ J1: Nakamura & Hanafusa 1987."""
    (j1, j2), (e1, e2) = random_tasks(rng, sizes=(3, 2))
    found = prioritized_step([j1, j2], [e1, e2])
    for b in range(len(found)):
        first = np.linalg.pinv(j1[b])
        null = np.eye(7) - first @ j1[b]
        wanted = first @ e1[b] + np.linalg.pinv(j2[b] @ null) @ (e2[b] - j2[b] @ first @ e1[b])
        np.testing.assert_allclose(found[b], wanted, atol=1e-10)


@given(st.integers(0, 10**6), st.floats(0.0, 0.5))
def test_a_lower_task_does_not_change_what_a_higher_one_achieves(seed, damping):
    rng = np.random.default_rng(seed)
    # five conflicting levels for four joints
    jacobians, errors = random_tasks(rng, batch=5, joints=4, sizes=(1, 2, 1, 2, 3))
    left = []
    for levels in range(1, 6):
        change = prioritized_step(jacobians[:levels], errors[:levels], damping=damping)
        left.append([e - np.einsum("bmj,bj->bm", j, change) for j, e in zip(jacobians, errors, strict=True)])
    for levels in range(1, 5):
        for k in range(levels):
            np.testing.assert_allclose(left[levels][k], left[levels - 1][k], atol=1e-8)


def test_an_impossible_task_is_met_as_well_as_it_can_be(rng):
    jacobian = np.zeros((3, 2, 4))
    jacobian[:, 0] = rng.normal(size=(3, 4))  # the second row cannot be moved at all
    error = rng.normal(size=(3, 2))
    change = prioritized_step([jacobian, jacobian], [error, error])
    left = error - np.einsum("bmj,bj->bm", jacobian, change)
    np.testing.assert_allclose(left[:, 0], 0.0, atol=1e-12)
    np.testing.assert_allclose(left[:, 1], error[:, 1])
    assert np.isfinite(change).all()


def test_limits_hold_and_the_others_take_over(rng):
    (jacobian,), (error,) = random_tasks(rng, sizes=(1,))
    free = prioritized_step([jacobian], [error])
    bound = 0.9 * np.abs(free).max(1, keepdims=True) * np.ones(7)
    change = limited_step([jacobian], [error], np.zeros((20, 7)), -bound, bound)
    assert (np.abs(change) <= bound + 1e-12).all() and (np.abs(free) > bound).any(1).all()
    np.testing.assert_allclose(np.einsum("bmj,bj->bm", jacobian, change), error, atol=1e-9)


def planar_arm(values):
    """Three unit bones in a plane: the end, and its Jacobian."""
    angles = np.cumsum(values, axis=1)
    bones = np.stack([np.cos(angles), np.sin(angles)], axis=2)
    tips = np.cumsum(bones[:, ::-1], axis=1)[:, ::-1]  # from each joint to the end
    return bones.sum(1), np.stack([-tips[..., 1], tips[..., 0]], axis=1)


def test_prioritized_solves_an_arm_and_its_second_wish():
    goals = np.array([[1.5, 1.0], [0.5, -2.0], [4.0, 0.0]])  # the last one is out of reach

    def reach(values):
        end, jacobian = planar_arm(values)
        return goals - end, jacobian

    def last_bone_points_up(values):
        jacobian = np.ones((len(values), 1, 3))
        return np.pi / 2 - values.sum(1, keepdims=True), jacobian

    start = np.array([[0.3, 0.4, 0.2]] * 3)
    found = prioritized([reach, last_bone_points_up], start, max_steps=200)
    # the second goal and the second wish exclude each other: the goal, which is above it, is met all the same
    assert np.abs(reach(found)[0][:2]).max() < 1e-8
    assert np.abs(last_bone_points_up(found)[0][0]).max() < 1e-8
    assert np.abs(last_bone_points_up(found)[0][1]).max() > 0.1
    assert np.linalg.norm(planar_arm(found)[0][2] - [3.0, 0.0]) < 0.05
    # the first joint may not follow: the other two reach all the same
    assert prioritized([reach], start)[0, 0] < 0.25
    limited = prioritized([reach], start, lower=np.array([0.25, -3.0, -3.0]), upper=np.array([0.3, 3.0, 3.0]))
    assert ((limited[:, 0] >= 0.25) & (limited[:, 0] <= 0.3)).all()
    assert np.abs(reach(limited)[0][0]).max() < 1e-6
