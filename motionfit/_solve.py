"""One block's solve as a pure function of arrays: its rows, their Jacobian, and the optimistix solver that runs on
them."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import Array
from jaxtyping import Float, Int

from motionfit._control import Control
from motionfit._motion import Kinematics
from motionfit._problem import Custom, Objective, Problem, Term, term_cost
from motionfit._programs import program
from motionfit._types import AnyArray, InputError
from motionfit.banded import Banded

SETTLED, COARSE = 6, 1e-4  # steps that are looked at together, by a solver of at least this tolerance


class Block(eqx.Module):
    """Which controls are free, which terms count, which optimistix solver, how many steps.

    `solver` is any optimistix least-squares solver or minimiser. The default is Levenberg-Marquardt, banded in time
    where the terms' reach is known, which stops at a `tolerance`, relative and absolute, in control points [rad] and
    residuals, or, from 1e-4 on, relative in the cost. `terms=None` means all terms of the problem.
    """

    name: str = eqx.field(static=True)
    controls: tuple[str, ...] = eqx.field(static=True)
    terms: tuple[str, ...] | None = eqx.field(static=True, default=None)
    max_steps: int = eqx.field(static=True, default=40)
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | None = None
    tolerance: float = eqx.field(static=True, default=1e-5)


def levenberg_marquardt(
    linear_solver: lx.AbstractLinearSolver | None = None, rtol: float = 1e-5, atol: float = 1e-5
) -> optx.LevenbergMarquardt:
    """The default solver. Without a `Banded` solver its normal equations are dense and factorised by Cholesky: the
    damping keeps them definite, and a tall QR of the same system takes several times longer."""
    return optx.LevenbergMarquardt(rtol=rtol, atol=atol, linear_solver=linear_solver or lx.Normal(lx.Cholesky()))


@eqx.filter_custom_jvp
def _with_columns(x: tuple[Array, ...], fn: Callable, columns_of: Callable, times: Callable) -> tuple[Array, ...]:
    """Rows fn(x), (frames, n) each, whose Jacobian has few distinct columns: `columns_of(x, fn)` tells value and
    columns, `times(columns, t_x)` the product. It is computed once per linearisation, and every product with it,
    transposed or not, is then a few lines; without this rule each would be one more pass through the kinematics, and
    one more copy of it to compile."""
    del columns_of, times
    return fn(x)


@_with_columns.def_jvp
def _with_columns_jvp(primals, tangents):
    x, fn, columns_of, times = primals
    t_x, t_fn, *_ = tangents
    if any(t is not None for t in t_x):
        t_x = tuple(jnp.zeros_like(p) if t is None else t for p, t in zip(x, t_x, strict=True))
        value, columns = columns_of(x, fn)
        tangent = times(columns, t_x)
    else:
        value = fn(x)
        tangent = jax.tree.map(jnp.zeros_like, value)
    if any(leaf is not None for leaf in jax.tree.leaves(t_fn)):
        _, extra = eqx.filter_jvp(lambda f: f(x), (fn,), (t_fn,))
        tangent = jax.tree.map(jnp.add, tangent, extra)
    return value, tangent


def _columns_of_signals(x, fn):
    """Of rows that look at one frame at a time: d row_t / d signal_c for *all* t comes from one product with the seed
    "signal c = 1 in every frame"."""
    (signals,) = x
    seeds = jnp.eye(signals.shape[1], dtype=signals.dtype)[:, None, :] * jnp.ones_like(signals)
    return jax.vmap(lambda seed: jax.jvp(fn, (x,), ((seed,),)), out_axes=(None, 0))(seeds)


def _columns_of_points(banded: Banded, x: tuple[Array, ...], rows: "_PointRows"):
    value, product = rows.linearised(x)
    return value, banded.columns_of(x, product)


def _times_signals(columns, t_x):
    return jax.tree.map(lambda c: jnp.einsum("tc,ctn->tn", t_x[0], c), columns)


class _Rows(eqx.Module):
    """The weighted residuals of some terms, (frames, n) each, as a function of the signals of the free controls."""

    objective: Objective
    fixed: Float[Array, "frames controls"]  # signals of all controls; the free columns are replaced
    free: Int[AnyArray, " free"]
    terms: tuple[int, ...] = eqx.field(static=True)

    @eqx.filter_jit  # traced once, however often a solver's program evaluates it
    def __call__(self, x: tuple[Float[Array, "frames free"]]) -> tuple[Float[Array, "frames _"], ...]:
        return self.of(self.kinematics(x))

    def kinematics(self, x: tuple[Float[Array, "frames free"]]) -> Kinematics:
        return self.objective.kinematics(self.fixed.at[:, self.free].set(x[0]))

    def of(self, kin: Kinematics) -> tuple[Float[Array, "frames _"], ...]:
        return tuple(
            jnp.sqrt(self.objective.weights[k]) * self.objective.terms[k].residual(kin).reshape(len(self.fixed), -1)  # type: ignore
            for k in self.terms
        )


class _PointRows(eqx.Module):
    """The same as a function of the free controls' points."""

    controls: tuple[Control, ...]
    rows: _Rows

    def __call__(self, points: tuple[Array, ...]) -> tuple[Array, ...]:
        return self.rows((_signals(self.controls, points),))

    def linearised(self, points: tuple[Array, ...]) -> tuple[tuple[Array, ...], Callable]:
        """The rows, and the function that gives their tangent for one of the points.

        However far the rows look, the kinematics of a frame depend on the signals of that frame only: what a product
        costs is the rows, and not one more pass through the kinematics.
        """
        signals = (_signals(self.controls, points),)

        def parts(kin):
            return kin.positions_world, kin.rotations_world, kin.rotations_parent, kin.signals

        kin = self.rows.kinematics(signals)
        moved, by_signal = _columns_of_signals(signals, lambda x: parts(self.rows.kinematics(x)))

        def rows(moved):
            return self.rows.of(eqx.tree_at(parts, kin, moved))

        def product(t_points):
            _, t_signals = jax.jvp(lambda p: _signals(self.controls, p), (points,), (t_points,))
            t_moved = jax.tree.map(lambda c: jnp.einsum("tc,ct...->t...", t_signals, c), by_signal)
            return jax.jvp(rows, (moved,), (t_moved,))[1]

        return rows(moved), product


def _signals(controls: tuple[Control, ...], points: tuple[Array, ...]) -> Float[Array, "frames controls"]:
    return jnp.stack([c.signal(p) for c, p in zip(controls, points, strict=True)], axis=1)


class _Remembers(eqx.Module):
    """An optimistix solver that also tells what its function said at the start, as `solution.stats["start"]`: the
    first step of each is there. To ask the function once more would compile it once more.

    Levenberg-Marquardt of a tolerance of `COARSE` or more also stops where the last `SETTLED` steps that it took
    lowered the cost by less than its `rtol` of it, all together: over rows that come and go, points may wander along a
    valley for ever. Where points are wanted more exactly than that, costs cannot tell when to stop.
    """

    inner: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser

    @property
    def rtol(self):
        return self.inner.rtol

    @property
    def atol(self):
        return self.inner.atol

    @property
    def norm(self):
        return self.inner.norm

    def init(self, fn, y, args, options, f_struct, aux_struct, tags):
        start = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan, x.dtype), aux_struct)
        costs = jnp.full(SETTLED + 1, jnp.inf)
        return self.inner.init(fn, y, args, options, f_struct, aux_struct, tags), jnp.array(True), start, costs

    def step(self, fn, y, args, options, state, tags):
        inner, first, start, costs = state
        y, inner, aux = self.inner.step(fn, y, args, options, inner, tags)
        start = jax.tree.map(lambda old, new: jnp.where(first, new, old), start, aux)
        if isinstance(self.inner, optx.LevenbergMarquardt) and self.inner.rtol >= COARSE:
            cost = jnp.sum(jnp.stack([jnp.sum(jnp.square(r)) for r in jax.tree.leaves(inner.f_info.residual)]))
            latest = jnp.append(costs[1:], cost.astype(costs.dtype))
            costs = jnp.where(inner.num_steps_since_acceptance == 0, latest, costs)
        return y, (inner, jnp.array(False), start, costs), aux

    def terminate(self, fn, y, args, options, state, tags):
        inner, _, _, costs = state
        done, result = self.inner.terminate(fn, y, args, options, inner, tags)
        settled = jnp.isfinite(costs[0]) & (costs[-1] >= (1.0 - self.inner.rtol) * costs[0])
        return done | settled, result

    def postprocess(self, fn, y, aux, args, options, state, tags, result):
        y, aux, stats = self.inner.postprocess(fn, y, aux, args, options, state[0], tags, result)
        accepted = getattr(state[0], "num_accepted_steps", None)
        return y, aux, {**stats, "start": state[2], **({} if accepted is None else {"accepted": accepted})}


class _RemembersSquares(_Remembers, optx.AbstractLeastSquaresSolver):
    pass


class _RemembersMinimum(_Remembers, optx.AbstractMinimiser):
    pass


class Work(NamedTuple):
    """One block's solve as arrays: what is fixed, what is free, and where the free controls start."""

    objective: Objective
    controls: tuple[Control, ...]  # the free ones
    free: Int[AnyArray, " free"]  # their places among all: data, not structure
    start: tuple[Array, ...]  # their control points
    points: tuple[Array, ...]  # of all controls


class Solved(NamedTuple):
    points: tuple[Array, ...]  # of the free controls
    before: tuple[Array, ...]  # cost of each term
    after: tuple[Array, ...]
    steps: Array
    converged: Array


def solve_block(work: Work, solver, max_steps: int, adjoint: optx.AbstractAdjoint) -> Solved:
    """Run one block's solver; a pure function of arrays, to be jitted, vmapped or differentiated."""
    banded = _banded_inside(solver)

    def joined(rows, frames):
        return jnp.concatenate(rows, axis=1) if rows else jnp.zeros((frames, 0))

    @eqx.filter_jit  # traced once: a solver linearises it for the shapes of its state, and again in its loop
    def residuals(x, args):
        objective, controls, free, fixed = args
        terms = range(len(objective.terms))
        local = tuple(k for k in terms if objective.terms[k].reach == 0)  # type: ignore
        other = tuple(k for k in terms if k not in local)
        signals = (_signals(controls, x),)
        far = _PointRows(controls, _Rows(objective, fixed, free, other))
        rows = (_with_columns(signals, _Rows(objective, fixed, free, local), _columns_of_signals, _times_signals),
                far(x) if banded is None
                else _with_columns(x, far, jax.tree_util.Partial(_columns_of_points, banded), banded.times))  # fmt: skip
        costs = {k: 0.5 * jnp.sum(jnp.square(r)) for k, r in zip(local + other, rows[0] + rows[1], strict=True)}
        return tuple(joined(r, len(fixed)) for r in rows), tuple(costs[k] for k in terms)

    @eqx.filter_jit
    def energy(x, args):
        objective, controls, free, fixed = args
        kin = objective.kinematics(fixed.at[:, free].set(_signals(controls, x)))
        costs = tuple(w * term_cost(t, kin) for t, w in zip(objective.terms, objective.weights, strict=True))
        return jnp.sum(jnp.stack(costs)), costs

    arguments = (work.objective, work.controls, jnp.asarray(work.free), work.objective.signals(work.points))
    options = {"max_steps": max_steps, "throw": False, "adjoint": adjoint, "has_aux": True}
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        solution = optx.least_squares(residuals, _RemembersSquares(inner=solver), work.start, arguments, **options)  # pyright: ignore[reportCallIssue]
    else:
        solution = optx.minimise(energy, _RemembersMinimum(inner=solver), work.start, arguments, **options)  # pyright: ignore[reportCallIssue]
    return Solved(solution.value, solution.stats["start"], solution.aux,
                  solution.stats.get("accepted", solution.stats["num_steps"]),
                  solution.result == optx.RESULTS.successful)  # fmt: skip


run_block = program(solve_block)


def block_work(problem: Problem, block: Block, points: tuple[Array, ...]) -> Work:
    """A block's solve as arrays, from the control points so far."""
    objective = problem.objective(block.terms)
    free = [k for k, c in enumerate(problem.controls) if c.name in block.controls]
    free.sort(key=lambda k: block.controls.index(problem.controls[k].name))
    return Work(
        objective, tuple(objective.controls[k] for k in free), np.array(free), tuple(points[k] for k in free), points
    )


def block_solver(problem: Problem, block: Block):
    """The solver of a block: its own, or Levenberg-Marquardt, banded in time where its terms' reach is known."""
    if block.solver is not None:
        return block.solver
    return levenberg_marquardt(banded_solver(problem, block), block.tolerance, block.tolerance)


def banded_solver(problem: Problem, block: Block) -> Banded | None:
    """The linear solver that suits a block; None where a term may look anywhere or the free controls have bases of
    their own."""
    bases = [c.basis for c in problem.controls if c.name in block.controls]
    same = all(b.count == bases[0].count and np.array_equal(b.first, bases[0].first) for b in bases[1:])
    terms = problem.terms if block.terms is None else block.terms
    reaches = [problem.terms[k].reach for k in terms if isinstance(problem.terms[k], Term)]  # type: ignore
    if not same or any(r is None for r in reaches):
        return None
    return Banded.of(bases[0], max(reaches, default=0), local=1)  # `solve_block` gives the frame-local rows first  # pyright: ignore[reportArgumentType]


# optimistix's default adjoint calls a system singular where a control cannot be observed (no frame in contact)
def block_adjoint(solver) -> optx.ImplicitAdjoint:
    """Implicit derivatives through a solve, by the block's own banded solver where it has one."""
    banded = _banded_inside(solver)
    return optx.ImplicitAdjoint(lx.AutoLinearSolver(well_posed=False) if banded is None else banded)


def _banded_inside(solver) -> Banded | None:
    inner = getattr(getattr(solver, "descent", None), "linear_solver", None)
    return inner if isinstance(inner, Banded) else None


@eqx.filter_jit
def _reach_errors(work: Work, reaches: tuple[int, ...], solver: Banded) -> tuple[Array, ...]:
    """How far each term's Jacobian is from the one that its reach allows, relative to its largest row."""
    del reaches
    objective = work.objective
    start = work.start
    fixed = objective.signals(work.points)
    points = start[0].shape[0]
    count = len(start)
    # pseudo-random, so that no cancellation hides a row that reaches too far
    probe = tuple(jnp.sin(12.9898 * (k + 1) + 78.233 * jnp.arange(points, dtype=float) ** 1.5) for k in range(count))
    probe = tuple(p.astype(s.dtype) for p, s in zip(probe, start, strict=True))
    errors = []
    for k in range(len(objective.terms)):

        def rows(x, k=k):
            return _PointRows(work.controls, _Rows(objective, fixed, work.free, (k,)))(x)[0]

        value, product = jax.linearize(rows, start)
        operator = lx.FunctionLinearOperator(product, jax.eval_shape(lambda: start))
        (columns,) = solver.columns(operator, count, points, solver.width)
        windows = solver.windows(columns.reshape(*columns.shape[:2], -1), count)
        # the rows that the windows allow, times the probe, against the product itself
        stacked = jnp.stack(probe, axis=1)
        place = np.minimum(np.arange(points)[:, None] + np.arange(solver.width), points - 1)
        seen = stacked[place].reshape(points, -1)
        allowed = jnp.einsum("kin,ki->kn", windows, seen).reshape(points, solver.frames_of.shape[1], -1)
        exact = product(probe).reshape(value.shape[0], -1)
        exact = jnp.pad(exact, ((0, 1), (0, 0)))[jnp.asarray(solver.frames_of)]
        errors.append(jnp.max(jnp.abs(exact - allowed), initial=0.0) / (jnp.max(jnp.abs(exact), initial=0.0) + 1e-12))
    return tuple(errors)


def check_reach(problem: Problem, block: Block, work: Work) -> None:
    """Find out a `Custom` term whose declared reach is wrong, before it quietly spoils every step of the solve."""
    names = tuple(problem.terms) if block.terms is None else block.terms
    declared = [k for k in names if isinstance(problem.terms[k], Custom) and problem.terms[k].reach is not None]  # pyright: ignore[reportAttributeAccessIssue]
    bases = [c.basis for c in problem.controls if c.name in block.controls]
    for name in declared:
        reach = problem.terms[name].reach  # type: ignore
        alone = work._replace(objective=problem.objective((name,)))
        (error,) = _reach_errors(alone, (reach,), Banded.of(bases[0], reach))  # pyright: ignore[reportArgumentType]
        if float(error) > 1e-3:
            raise InputError(f"term {name!r} says reach={reach}, but its rows depend on frames further away than that; "
                             "give mf.Custom(fn, args, reach=R) the R that it needs, or leave reach out")  # fmt: skip
