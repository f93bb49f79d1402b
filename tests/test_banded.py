"""The banded solver against dense linear algebra, inside optimistix, under vmap and grad; and wrong reaches."""

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import motionfit as mf
import motionfit.banded
from motionfit._motion import rest_motion
from motionfit._solve import banded_solver, block_adjoint, block_work, levenberg_marquardt, solve_block
from motionfit.banded import Banded
from motionfit.splines import bspline_basis
from tests.helpers import central_difference

EXACT = 1e-8  # two ways to the same linear algebra in double precision


def _operator(frames: int, spacing: float, controls: int, reach: int, seed: int, damping: float):
    """Random rows of frame t over the signals of frames t - reach .. t + reach, as an operator in control points."""
    basis = bspline_basis(frames, 1 / 60, spacing)
    rng = np.random.default_rng(seed)
    weights = jnp.asarray(rng.normal(size=(2 * reach + 1, frames, controls, 3)))

    def rows(points):
        signals = jnp.stack([basis(p) for p in points], axis=1)
        padded = jnp.pad(signals, ((reach, reach), (0, 0)))
        total = sum(jnp.einsum("tc,tcn->tn", padded[k : k + frames], weights[k]) for k in range(2 * reach + 1))
        return total

    def damped(points):
        return rows(points), tuple(jnp.sqrt(damping) * p for p in points)

    start = tuple(jnp.zeros(basis.count) for _ in range(controls))
    operator = lx.FunctionLinearOperator(damped if damping else rows, jax.eval_shape(lambda: start))
    return basis, operator, start


@settings(max_examples=10)
@given(
    st.integers(2, 90), st.sampled_from([1 / 60, 0.05, 0.1, 0.4]), st.integers(1, 4), st.integers(0, 3),
    st.integers(0, 2**31),
)  # fmt: skip
def test_damped_systems_are_solved_as_densely(frames, spacing, controls, reach, seed):
    basis, operator, start = _operator(frames, spacing, controls, reach, seed, damping=0.3)
    rng = np.random.default_rng(seed)
    right = jax.tree.map(lambda x: jnp.asarray(rng.normal(size=x.shape)), operator.out_structure())
    # rows that look at their own frame only may say so
    banded = lx.linear_solve(operator, right, Banded.of(basis, reach, local=int(reach == 0)), throw=False).value
    dense = lx.linear_solve(operator, right, lx.QR(), throw=False).value
    for mine, theirs in zip(banded, dense, strict=True):
        np.testing.assert_allclose(mine, theirs, atol=1e-6 * max(1.0, float(jnp.abs(theirs).max())))


@settings(max_examples=5)
@given(st.integers(8, 60), st.integers(1, 3), st.integers(0, 2**31))
def test_symmetric_systems_are_solved_as_densely(frames, controls, seed):
    basis, operator, start = _operator(frames, 0.1, controls, 1, seed, damping=1.0)
    matrix = operator.as_matrix()
    hessian = matrix.T @ matrix
    points = basis.count

    def product(x):
        flat = hessian @ jnp.concatenate(x)
        return tuple(flat[k * points : (k + 1) * points] for k in range(controls))

    square = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: start), lx.positive_semidefinite_tag)
    right = jax.tree.map(lambda x: jnp.asarray(np.random.default_rng(seed).normal(size=x.shape)), start)
    solved = lx.linear_solve(square, right, Banded.of(basis, 1), throw=False).value
    np.testing.assert_allclose(jnp.concatenate(solved), np.linalg.solve(hessian, jnp.concatenate(right)), atol=1e-7)


def test_a_rank_deficient_matrix_stays_finite():
    basis = bspline_basis(40, 1 / 60, 0.1)
    start = (jnp.zeros(basis.count), jnp.zeros(basis.count))
    # the second control is seen by no row
    operator = lx.FunctionLinearOperator(lambda x: basis(x[0])[:, None], jax.eval_shape(lambda: start))
    value = lx.linear_solve(operator, jnp.ones((40, 1)), Banded.of(basis), throw=False).value
    np.testing.assert_allclose(basis(value[0]), 1.0, atol=1e-4)
    assert np.isfinite(value[1]).all() and np.abs(value[1]).max() < 1e-6


@pytest.fixture(scope="module")
def reaching(average):
    """A hand that should be elsewhere, smoothly: three controls, local and non-local terms."""
    motion = rest_motion(average.skeleton)[np.zeros(50, int)]
    basis = bspline_basis(50, float(motion.dt), 0.1)
    joint = average.skeleton.joint("left_upper_arm")
    controls = tuple(mf.Control(f"turn{k}", (mf.Drive(joint, np.eye(3)[k], 1.0),), basis, -1.2, 1.2) for k in range(3))
    hand = average.skeleton.joint("left_hand")
    base = mf.forward_kinematics(average.skeleton, motion).positions_world[:, hand, None]
    target = base + 0.2 * jnp.sin(jnp.linspace(0, 6, 50))[:, None, None] * jnp.array([0.3, 1.0, 0.5])
    terms = {"track": mf.terms.JointTracking((hand,), target, 0.05), "effort": mf.terms.Effort(1.0),
             "smooth": mf.terms.Smoothness(300.0)}  # fmt: skip
    return mf.Problem(average, motion, terms, controls), mf.Block("all", tuple(c.name for c in controls), max_steps=80)


def test_optimistix_solvers_reach_the_dense_optimum(reaching):
    problem, block = reaching
    banded = banded_solver(problem, block)
    assert banded is not None and banded.width == 5
    dense = mf.fit(problem, (eqx.tree_at(lambda b: b.solver, block, levenberg_marquardt(rtol=1e-10, atol=1e-10),
                                         is_leaf=lambda x: x is None),))  # fmt: skip
    best = dense.history[-1].cost_after
    for solver in (
        levenberg_marquardt(banded, rtol=1e-10, atol=1e-10),
        optx.GaussNewton(rtol=1e-10, atol=1e-10, linear_solver=banded),
        optx.Dogleg(rtol=1e-10, atol=1e-10, linear_solver=banded),
    ):
        found = mf.fit(problem, (eqx.tree_at(lambda b: b.solver, block, solver, is_leaf=lambda x: x is None),))
        assert found.history[-1].cost_after == pytest.approx(best, rel=1e-6), type(solver).__name__
        np.testing.assert_allclose(found.correction.signals(), dense.correction.signals(), atol=1e-4)


def test_float32_agrees_with_float64(reaching):
    problem, block = reaching
    double = mf.fit(problem, (block,)).correction.signals()
    with jax.enable_x64(False):
        single = jax.tree.map(
            lambda x: np.asarray(x, np.float32) if getattr(x, "dtype", None) == np.float64 else x, problem
        )
        signals = mf.fit(single, (block,)).correction.signals()
        assert signals.dtype == jnp.float32
    assert np.abs(np.asarray(signals, float) - np.asarray(double)).max() < np.deg2rad(0.1)


def test_vmap_over_problems_equals_one_by_one(reaching):
    problem, block = reaching
    solver = levenberg_marquardt(banded_solver(problem, block), rtol=1e-10, atol=1e-10)
    points = tuple(jnp.zeros(c.basis.count) for c in problem.controls)
    scales = jnp.array([0.5, 1.0, 1.5])

    def solve(scale):
        changed = eqx.tree_at(lambda p: p.weights["track"], problem, scale)
        return solve_block(block_work(changed, block, points), solver, 60, block_adjoint(solver)).points

    together = jax.vmap(solve)(scales)
    for k, scale in enumerate(scales):
        for mine, alone in zip(together, jax.jit(solve)(scale), strict=True):
            np.testing.assert_allclose(mine[k], alone, atol=1e-6)


def test_gradients_through_the_solve(reaching):
    """Implicit derivatives with respect to a weight and a target, by the banded solver itself."""
    problem, block = reaching
    solver = levenberg_marquardt(banded_solver(problem, block), rtol=1e-12, atol=1e-12)
    points = tuple(jnp.zeros(c.basis.count) for c in problem.controls)

    @jax.jit
    def outcome(x):
        changed = eqx.tree_at(
            lambda p: (p.weights["track"], p.terms["track"].target_world), problem,
            (x[0], problem.terms["track"].target_world * jnp.array([1.0, 1.0, 1.0]) + x[1]),
        )  # fmt: skip
        solved = solve_block(block_work(changed, block, points), solver, 100, block_adjoint(solver))
        return sum(jnp.sum(jnp.sin(p)) for p in solved.points)

    x = np.array([0.8, 0.01])
    # a step at which it matters little where the two solves of a difference stop
    expected = central_difference(outcome, x, 1e-3)
    for gradient in (jax.grad(outcome)(x), jax.jacfwd(outcome)(x)):
        np.testing.assert_allclose(gradient, expected, rtol=1e-3)


def _wide(kin, goal):
    return (kin.signals[:, :1] + jnp.roll(kin.signals[:, :1], 7, axis=0) - goal) / 0.1


def test_a_wrong_reach_is_found_out(average):
    motion = rest_motion(average.skeleton)[np.zeros(60, int)]
    basis = bspline_basis(60, float(motion.dt), 0.05)
    control = mf.Control("arm", (mf.Drive(average.skeleton.joint("left_upper_arm"), np.eye(3)[0], 1.0),), basis)
    block = (mf.Block("b", ("arm",)),)
    wrong = mf.Problem(average, motion, {"wide": mf.Custom(_wide, 0.2, reach=1)}, (control,))
    with pytest.raises(mf.InputError, match="'wide' says reach=1"):
        mf.fit(wrong, block)
    for reach in (None, 7, 59):
        right = mf.Problem(average, motion, {"wide": mf.Custom(_wide, 0.2, reach=reach)}, (control,))
        if reach == 7:
            # the roll brings the last frames to the first ones: 7 is not enough either
            with pytest.raises(mf.InputError, match="reach=7"):
                mf.fit(right, block)
        else:
            assert mf.fit(right, block).history[-1].cost_after < 1e-3
    with pytest.raises(mf.InputError, match="cannot be -1"):
        mf.Custom(_wide, 0.2, reach=-1)


@pytest.mark.parametrize("at_once", [10**6, 100, 1])
def test_columns_times_points_are_the_jacobian(at_once, monkeypatch):
    """However many of the products are formed together."""
    monkeypatch.setattr(motionfit.banded, "FRAMES_AT_ONCE", at_once)
    basis = bspline_basis(30, 1 / 60, 0.1)
    solver = Banded.of(basis, 1)
    x, way = (tuple(jnp.asarray(np.random.default_rng(k).normal(size=(2, basis.count)))) for k in (0, 1))

    def rows(x):
        signals = jnp.stack([basis(p) for p in x], axis=1)
        return (jnp.sin(signals), jnp.pad(signals[1:] * signals[:-1], ((0, 1), (0, 0))))

    _, product = jax.linearize(rows, x)
    along = solver.times(solver.columns_of(x, product), way)
    for told, expected in zip(along, product(way), strict=True):
        np.testing.assert_allclose(told, expected, atol=1e-12)
