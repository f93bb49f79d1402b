"""The block driver: known minima, honest statuses, corrections that come back to the bit."""

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest

import motionfit as mf
from motionfit._motion import rest_motion
from motionfit._solve import SETTLED
from motionfit.splines import bspline_basis


@pytest.fixture(scope="module")
def still(average):
    return average, rest_motion(average.skeleton)[np.zeros(20, int)]


def _control(character, motion, role, name=None, **bounds):
    basis = bspline_basis(motion.frame_count, float(motion.dt), 0.1)
    return mf.Control(
        name or role, (mf.Drive(character.skeleton.joint(role), np.array([0, 0, 1.0]), 1.0),), basis, **bounds
    )


def test_basis_sums_to_one_and_reproduces_lines():
    for frames, spacing in ((2, 0.1), (37, 0.05), (300, 0.2)):
        basis = bspline_basis(frames, 1 / 60, spacing)
        np.testing.assert_allclose(basis.values.sum(1), 1.0, atol=1e-12)
        assert basis.first.max() + 3 < basis.count
        line = basis(jnp.arange(basis.count, dtype=float))
        np.testing.assert_allclose(np.diff(line, 2), 0.0, atol=1e-9)


def test_least_squares_block_reaches_the_known_minimum(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    target = 0.3

    def towards(kin, goal):
        return (kin.signals - goal) / 0.1

    problem = mf.Problem(
        character, motion, {"goal": mf.Custom(towards, target), "effort": mf.terms.Effort(0.1)}, (control,)
    )
    result = mf.fit(problem, (mf.Block("arm", ("left_upper_arm",)),))
    # two equal parabolas: the middle
    np.testing.assert_allclose(result.correction.signals(), target / 2, atol=1e-6)
    assert result.history[0].status == "converged" and result.history[0].cost_after < result.history[0].cost_before


def test_a_solve_ends_where_it_gains_no_more(still):
    """Down a valley without an end: each step moves the points by as much, and gains less than the tolerance."""
    character, motion = still
    control = _control(character, motion, "left_upper_arm", lower=-np.inf, upper=np.inf)

    def valley(kin, _):
        return jnp.stack([100.0 * jnp.ones_like(kin.signals), jnp.exp(-kin.signals)])

    problem = mf.Problem(character, motion, {"valley": mf.Custom(valley)}, (control,))
    steps = {}
    for tolerance in (1e-3, 1e-7):
        block = mf.Block("arm", ("left_upper_arm",), tolerance=tolerance)
        (report,) = mf.fit(problem, (block,)).history
        steps[tolerance] = report.status, report.accepted_steps
    assert steps[1e-3] == ("converged", SETTLED + 1)  # the first is the start
    assert steps[1e-7][1] > SETTLED + 1


def test_minimisers_and_energies_work_and_are_refused_to_least_squares(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    problem = mf.Problem(
        character, motion, {"style": mf.Energy(lambda kin, goal: jnp.sum((kin.signals - goal) ** 2), 0.2)}, (control,)
    )
    with pytest.raises(mf.InputError, match="BFGS"):
        mf.fit(problem, (mf.Block("b", ("left_upper_arm",)),))
    result = mf.fit(
        problem, (mf.Block("b", ("left_upper_arm",), solver=optx.BFGS(rtol=1e-6, atol=1e-8), max_steps=100),)
    )
    np.testing.assert_allclose(result.correction.signals(), 0.2, atol=1e-3)


def test_bounds_clamp_control_points(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm", lower=-0.1, upper=0.1)
    problem = mf.Problem(
        character, motion, {"goal": mf.Custom(lambda kin, g: (kin.signals - g) / 0.1, 0.5)}, (control,)
    )
    result = mf.fit(problem, (mf.Block("arm", ("left_upper_arm",)),))
    assert float(result.correction.signals().max()) <= 0.1 + 1e-12


def test_unknown_names_list_the_known_ones(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    problem = mf.Problem(character, motion, {"effort": mf.terms.Effort(1.0)}, (control,))
    with pytest.raises(mf.InputError, match="controls: left_upper_arm"):
        mf.fit(problem, (mf.Block("b", ("nose",)),))
    with pytest.raises(mf.InputError, match="terms: effort"):
        mf.fit(problem, (mf.Block("b", ("left_upper_arm",), terms=("joy",)),))


def test_nothing_to_do_and_zero_correction_are_bit_for_bit(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    problem = mf.Problem(character, motion, {"effort": mf.terms.Effort(1.0)}, (control,))
    result = mf.fit(problem, (mf.Block("b", ("left_upper_arm",)),))
    assert result.history[0].status == "nothing_to_do"
    assert np.array_equal(result.motion.rotations, motion.rotations)
    traced = jax.jit(lambda m: mf.Correction.zero((control,)).apply(m).rotations)(motion)
    assert np.array_equal(traced, motion.rotations)


def test_frame_local_rule_gives_the_same_jacobian(still):
    """The one product per control against plain forward mode."""
    from motionfit._solve import _columns_of_signals, _Rows, _times_signals, _with_columns

    character, motion = still
    controls = tuple(_control(character, motion, r) for r in ("left_upper_arm", "left_forearm"))
    hand = (character.skeleton.joint("left_hand"),)
    problem = mf.Problem(character, motion, {"t": mf.terms.JointTracking(hand, np.zeros((20, 1, 3)))}, controls)
    rows = _Rows(problem.objective(), jnp.zeros((20, 2)), jnp.array([0, 1]), (0,))
    signals = jnp.asarray(np.random.default_rng(1).normal(size=(20, 2)))
    fast = jax.jacfwd(lambda s: _with_columns((s,), rows, _columns_of_signals, _times_signals)[0])(signals)
    np.testing.assert_allclose(fast, jax.jacfwd(lambda s: rows((s,))[0])(signals), atol=1e-9)


def test_rows_that_reach_over_frames_have_the_same_tangent(still):
    """By the kinematics' columns against plain forward mode, for rows that read all that moves."""
    from motionfit._solve import _PointRows, _Rows

    def rows(kin, shift):
        moved = shift + jnp.concatenate([x.reshape(len(x), -1) for x in (
            kin.positions_world, kin.rotations_world, kin.rotations_parent, kin.signals)], axis=1)  # fmt: skip
        return jnp.sin(moved[1:] * moved[:-1])[np.minimum(np.arange(20), 18)]

    character, motion = still
    controls = tuple(_control(character, motion, r) for r in ("left_upper_arm", "left_forearm"))
    problem = mf.Problem(character, motion, {"t": mf.Custom(rows, 0.3, reach=1)}, controls)
    far = _PointRows(controls, _Rows(problem.objective(), jnp.zeros((20, 2)), jnp.array([0, 1]), (0,)))
    x, way = (tuple(jnp.asarray(np.random.default_rng(k).normal(size=(2, controls[0].basis.count)))) for k in (0, 1))
    value, product = far.linearised(x)
    exact, tangent = jax.jvp(far, (x,), (way,))
    np.testing.assert_allclose(value[0], exact[0], atol=1e-12)
    np.testing.assert_allclose(product(way)[0], tangent[0], atol=1e-9)


def test_new_numbers_do_not_recompile(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    traces = []

    def counting(kin, goal):
        traces.append(1)
        return (kin.signals - goal) / 0.1

    for goal, weight in ((0.1, 1.0), (0.2, 2.0), (0.4, 0.5)):
        problem = mf.Problem(character, motion, {"goal": mf.Custom(counting, goal)}, (control,), {"goal": weight})
        mf.fit(problem, (mf.Block("arm", ("left_upper_arm",)),))
        if goal == 0.1:
            first = len(traces)
    assert first > 0 and len(traces) == first


def test_the_report_names_the_worst_frame(still):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    goal = np.ones((20, 1))
    goal[7], goal[3] = 2.0, -1.0
    terms = {"peak": mf.Custom(lambda kin, goal: kin.signals - goal, goal, reach=0),
             "style": mf.Energy(lambda kin, goal: jnp.sum((kin.signals - goal) ** 2), 0.2)}  # fmt: skip
    problem = mf.Problem(character, motion, terms, (control,))
    ahead = mf.Correction((control,), (jnp.full(control.basis.count, 3.0),))
    for correction, frame in ((None, "7"), (ahead, "3")):
        rows = [line.split() for line in problem.report(correction).splitlines()[1:]]
        assert [(r[0], r[-1]) for r in rows] == [("peak", frame), ("style", "-")]
        np.testing.assert_allclose([float(r[2]) for r in rows], list(problem.costs(correction).values()), rtol=1e-4)


def test_corrections_save_and_apply_to_the_same_bits(still, tmp_path):
    character, motion = still
    control = _control(character, motion, "left_upper_arm")
    points = (jnp.asarray(np.random.default_rng(2).normal(size=control.basis.count)) * 0.2,)
    correction = mf.Correction((control,), points)
    correction.save(tmp_path / "c.npz")
    again = mf.load_correction(tmp_path / "c.npz")
    assert np.array_equal(again.apply(motion).rotations, correction.apply(motion).rotations)
    assert np.array_equal(again["left_upper_arm"], correction["left_upper_arm"])
    with pytest.raises(KeyError, match="left_upper_arm"):
        again["nose"]
    with pytest.raises(mf.InputError, match="20 frames"):
        again.apply(motion[:5])


def test_files_and_arrays_get_the_same_correction(still, rng):
    """On the host and traced: bounds, gains, axes per frame, and two controls that turn one joint."""
    character, motion = still
    joints = [character.skeleton.joint(r) for r in ("left_upper_arm", "left_forearm")]
    axes = rng.normal(size=(motion.frame_count, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    basis = bspline_basis(motion.frame_count, float(motion.dt), 0.1)
    drives = (mf.Drive(joints[0], axes, -0.7), mf.Drive(joints[1], np.eye(3)[1], 1.3))
    controls = (mf.Control("both", drives, basis, -0.2, 0.5),
                mf.Control("one", (mf.Drive(joints[0], np.eye(3)[2], 0.5),), basis))  # fmt: skip
    correction = mf.Correction(controls, tuple(rng.normal(size=basis.count) for _ in controls))
    traced = mf.Motion(motion.skeleton, motion.root, jnp.asarray(motion.rotations), motion.dt)
    host, device = (np.asarray(correction.apply(m).rotations) for m in (motion, traced))
    np.testing.assert_allclose(host, device, atol=1e-14)
    assert np.abs(host - np.asarray(motion.rotations)).max() > 0.1


def test_blocks_side_by_side_are_those_one_after_the_other(still):
    character, motion = still
    roles = ("left_upper_arm", "right_upper_arm")
    controls = tuple(_control(character, motion, role) for role in roles)
    terms = {r: mf.Custom(lambda kin, goal, k=k: (kin.signals[:, k] - goal) / 0.1, 0.1 + k, reach=0)
             for k, r in enumerate(roles)}  # fmt: skip
    problem = mf.Problem(character, motion, terms, controls)
    left, right = (mf.Block(role, (role,), (role,)) for role in roles)
    done: list[tuple[str, int, int]] = []
    together = mf.fit(problem, ((left, right),), progress=lambda *x: done.append(x))
    alone = mf.fit(problem, (left, right))
    for a, b in zip(together.correction.points, alone.correction.points, strict=True):
        assert np.array_equal(a, b)
    assert done == [("left_upper_arm", 1, 2), ("right_upper_arm", 2, 2)]
    with pytest.raises(mf.InputError, match="side by side"):
        mf.fit(problem, ((left, mf.Block("again", ("left_upper_arm",))),))


def test_a_problem_takes_a_correction_by_name(still):
    """Of the whole clip, which has the first of the control points that the padded one has, too."""
    character, motion = still
    controls = tuple(_control(character, motion, r) for r in ("left_upper_arm", "left_forearm"))
    problem = mf.Problem(character, motion, {"effort": mf.terms.Effort(1.0)}, controls)
    points = tuple(jnp.asarray(np.random.default_rng(k).normal(size=c.basis.count)) for k, c in enumerate(controls))
    whole = mf.Correction(controls, points)
    turned_round = mf.Correction(controls[::-1], points[::-1])
    assert problem.costs(turned_round) == problem.costs(whole)
    short = mf.Correction(controls, tuple(p[:-2] for p in points))
    filled = mf.Correction(controls, tuple(p.at[-2:].set(0.0) for p in points))
    assert problem.costs(short) == problem.costs(filled)
    assert problem.report(short) == problem.report(filled)
    with pytest.raises(mf.InputError, match="left_forearm; it has left_upper_arm"):
        problem.costs(mf.Correction(controls[:1], points[:1]))
