"""The derivative of a fit with respect to girth, against finite differences of whole re-solves."""

import dataclasses

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import motionfit as mf
from motionfit import samples
from motionfit._motion import joint_angles
from motionfit._solve import banded_solver, block_adjoint, block_solver, block_work, solve_block
from motionfit.adapt._sensitivity import Held, _answer, _slope
from motionfit.shape import grow

pytestmark = pytest.mark.slow
AGREE = 1e-3  # of the greatest value of the same control
STEP = 1e-5  # of a scale, for a whole re-solve; kinks of the skin lie closer together than 1e-4


@pytest.fixture(scope="module")
def walk():
    return samples.walk(cycles=1)


@pytest.fixture(scope="module")
def skin_fit(walk, heavy, average):
    return mf.adapt(walk, heavy, reference=average, blocks=("arms",))


@pytest.fixture(scope="module")
def capsule_fit(walk, heavy, average):
    return mf.adapt(walk, heavy, reference=average, blocks=("arms", "legs"), objective="capsule")


def _solved(held: Held, problem: mf.Problem) -> dict[str, np.ndarray]:
    """The optimum of a problem, block after block: by the cost to the root of its rounding, then to a level slope."""
    blocks = [dataclasses.replace(s.block, max_steps=200, tolerance=1e-10) for s in held.stages]
    correction = mf.fit(problem, blocks, correction=mf.Correction(problem.controls, held.points)).correction
    points = [jnp.asarray(p) for p in correction.points]
    for block in blocks:
        work, solver = block_work(problem, block, tuple(points)), banded_solver(problem, block)
        assert solver is not None
        for _ in range(6):
            newton = _answer(work, _slope(work, work.start), solver)
            work = work._replace(start=jax.tree.map(jnp.add, work.start, newton))
        assert max(float(jnp.abs(s).max()) for s in _slope(work, work.start)) < 1e-9
        for k, new in zip(work.free.tolist(), work.start, strict=True):
            assert np.abs(np.asarray(new) - np.asarray(points[k])).max() < 1e-3
            points[k] = new
    return {c.name: np.asarray(p) for c, p in zip(problem.controls, points, strict=True)}


def _compare(derivative: dict[str, np.ndarray], ahead: dict[str, np.ndarray], behind: dict[str, np.ndarray]):
    moved = 0.0
    for name, mine in derivative.items():
        expected = (ahead[name] - behind[name])[: len(mine)] / (2 * STEP)
        np.testing.assert_allclose(mine, expected, rtol=0, atol=AGREE * max(np.abs(expected).max(), 0.01), err_msg=name)
        moved = max(moved, float(np.abs(expected).max()))
    assert moved > 0.1  # rad per unit of scale: there is something to agree about


@pytest.mark.parametrize("part", ["arms", "trunk"])
def test_girth_on_the_skin(part, skin_fit, heavy, average):
    change = mf.adapt.girth_derivative(skin_fit, (part,), reference=average, tolerance=1e-10)
    held = Held.of(skin_fit, average)
    ways = (_solved(held, held.problem_on(grow(heavy, {part: s}))) for s in (1 + STEP, 1 - STEP))
    _compare(change[part], *ways)


def test_a_session_in_single_precision_gets_the_same(skin_fit, average):
    """Of one fit: what a session's precision would be is of no account."""
    double = mf.adapt.girth_derivative(skin_fit, ("arms",), reference=average)["arms"]
    with jax.enable_x64(False):
        single = mf.adapt.girth_derivative(skin_fit, ("arms",), reference=average)["arms"]
    for name, values in double.items():
        np.testing.assert_allclose(single[name], values, atol=AGREE * np.abs(values).max() + 1e-9)


@pytest.mark.parametrize("part", ["arms", "trunk"])
def test_girth_of_the_reference(part, skin_fit, average):
    """Through the overlap that does not count."""
    change = mf.adapt.girth_derivative(skin_fit, (part,), reference=average, of_reference=True, tolerance=1e-10)
    held = Held.of(skin_fit, average)
    ways = (_solved(held, held.problem_on(reference=grow(average, {part: s}))) for s in (1 + STEP, 1 - STEP))
    _compare(change[part], *ways)


def test_girth_on_capsules(capsule_fit, heavy, average):
    """With legs: what they do moves the thighs that hands meet."""
    change = mf.adapt.girth_derivative(capsule_fit, ("trunk", "legs"), reference=average, tolerance=1e-10)
    held = Held.of(capsule_fit, average)
    for part in change:
        ways = (_solved(held, held.problem_on(grow(heavy, {part: s}))) for s in (1 + STEP, 1 - STEP))
        _compare(change[part], *ways)


def test_it_is_the_derivative_through_the_solver(capsule_fit, heavy, average):
    """Forward mode through `solve_block`, whose implicit adjoint uses the banded solver, says the same."""
    change = mf.adapt.girth_derivative(capsule_fit, ("trunk",), reference=average, tolerance=1e-10)["trunk"]
    held, problem = Held.of(capsule_fit, average), capsule_fit.problem
    there = [held.problem_on(grow(heavy, {"trunk": s})) for s in (1 + STEP, 1 - STEP)]
    block = dataclasses.replace(held.stages[0].block, max_steps=200, tolerance=1e-10)
    assert block.name == "legs"
    points = tuple(map(jnp.asarray, held.points))
    work, *ways = (block_work(p, block, points) for p in (problem, *there))
    solver = block_solver(problem, block)
    smooth, rest = eqx.partition(work, eqx.is_inexact_array)
    ahead, behind = (eqx.filter(w, eqx.is_inexact_array) for w in ways)
    # where they are equal they may be infinite
    along = jax.tree.map(lambda a, b: np.subtract(a, b, out=np.zeros(np.shape(a)), where=np.asarray(a != b)) / (2 * STEP),
                         ahead, behind)  # fmt: skip

    @jax.jit
    def moved(smooth, along):
        def points(smooth):
            return solve_block(eqx.combine(smooth, rest), solver, 200, block_adjoint(solver)).points

        return jax.jvp(points, (smooth,), (along,))[1]

    for name, through in zip(block.controls, moved(smooth, along), strict=True):
        mine = change[name]
        np.testing.assert_allclose(mine, through[: len(mine)], rtol=0, atol=AGREE * float(jnp.abs(through).max()))


def test_a_prediction_beats_the_unmoved_fit(skin_fit, heavy, average):
    change = mf.adapt.girth_derivative(skin_fit, ("arms", "trunk"), reference=average, tolerance=1e-10)
    held, controls = Held.of(skin_fit, average), skin_fit.correction.controls

    def correction(problem: mf.Problem) -> mf.Correction:
        points = _solved(held, problem)
        return mf.Correction(controls, tuple(points[c.name][: c.basis.count] for c in controls))

    exact = dataclasses.replace(skin_fit, correction=correction(skin_fit.problem))
    for girth, share in (({"arms": 1.04}, 0.4), ({"trunk": 1.005}, 0.4)):
        body = grow(heavy, girth)
        base = mf.onto(skin_fit.base, body.skeleton)
        right = correction(held.problem_on(body)).apply(base)
        predicted, unmoved = mf.adapt.predict(exact, change, girth).apply(base), exact.correction.apply(base)
        off = [np.sqrt(np.square(joint_angles(motion, right)).mean()) for motion in (predicted, unmoved)]
        assert off[0] < share * off[1], (girth, off)


def test_what_has_no_derivative_says_so(skin_fit, average):
    with pytest.raises(mf.InputError, match="vertex or the capsule"):
        empty = mf.Problem(average, skin_fit.problem.motion, {}, ())
        mf.adapt.girth_derivative(dataclasses.replace(skin_fit, problem=empty))
    with pytest.raises(mf.InputError, match="give reference="):
        mf.adapt.girth_derivative(skin_fit, of_reference=True)
    with pytest.raises(mf.InputError, match="no derivative for legs"):
        mf.adapt.predict(skin_fit, {"arms": {}}, {"legs": 1.01})
