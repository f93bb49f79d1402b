"""Block-coordinate descent over optimistix solvers, and nothing else: thesis 4.3.1."""

import json
import time
from collections.abc import Callable, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
import optimistix as optx
from jax import Array
from jaxtyping import Float

from motionfit._control import Correction
from motionfit._motion import Motion
from motionfit._problem import Energy, Problem, Term, term_cost
from motionfit._types import InputError

# `SUCCEEDED` and the like are what reports print; the advice stands with the word
STATUS_ADVICE = {
    "converged": "the solver met its tolerance",
    "max_steps": "the solver ran out of steps; raise Block(max_steps=...)",
    "no_progress": "the solver accepted no step; check the block's weights, bounds and terms",
    "nothing_to_do": "the block's cost was zero already; its controls were left alone",
}


class Block(eqx.Module):
    """Which controls are free, which terms count, which optimistix solver, how many steps.

    `solver` is any optimistix least-squares solver (default: Levenberg-Marquardt) or minimiser; `terms=None`
    means all terms of the problem.
    """

    name: str = eqx.field(static=True)
    controls: tuple[str, ...] = eqx.field(static=True)
    terms: tuple[str, ...] | None = eqx.field(static=True, default=None)
    max_steps: int = eqx.field(static=True, default=40)
    solver: optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser | None = None


class BlockReport(eqx.Module):
    """What one run of one block did: costs of its terms before and after, accepted solver steps, wall time."""

    name: str = eqx.field(static=True)
    sweep: int = eqx.field(static=True)
    status: str = eqx.field(static=True)
    accepted_steps: int = eqx.field(static=True)
    cost_before: float = eqx.field(static=True)
    cost_after: float = eqx.field(static=True)
    terms_before: dict[str, float] = eqx.field(static=True)
    terms_after: dict[str, float] = eqx.field(static=True)
    time_s: float = eqx.field(static=True)


class Fit(eqx.Module):
    """The result of `fit`: the correction, the adapted motion, and what each block did.

    `status` is "converged", "violations_left" (a solve did all it could, and a violation over the tolerance is
    left) or "no_progress". `base` is the motion before the correction. `details` holds what a recipe such as
    `motionfit.adapt` measured on top (see its docstring).
    """

    correction: Correction
    motion: Motion
    base: Motion
    status: str = eqx.field(static=True)
    history: tuple[BlockReport, ...] = eqx.field(static=True)
    problem: Problem
    details: dict = eqx.field(default_factory=dict)

    def report(self) -> dict:
        """The result as plain numbers, ready for JSON: status, and per block and term what moved."""
        blocks = [
            {
                "name": b.name, "sweep": b.sweep, "status": b.status, "accepted_steps": b.accepted_steps,
                "cost_before": b.cost_before, "cost_after": b.cost_after,
                "terms": {k: {"before": b.terms_before[k], "after": b.terms_after[k]} for k in b.terms_after},
                "time_s": b.time_s,
            }
            for b in self.history
        ]  # fmt: skip
        signals = np.abs(np.asarray(self.correction.signals())) if self.correction.controls else np.zeros((0, 0))
        moved = {
            c.name: {"max_rad": float(signals[:, k].max()), "mean_rad": float(signals[:, k].mean())}
            for k, c in enumerate(self.correction.controls)
        }
        return {"status": self.status, "blocks": blocks, "controls": moved, **self.details}

    def __str__(self) -> str:
        return json.dumps(self.report(), indent=2)


def levenberg_marquardt(rtol: float = 1e-4, atol: float = 1e-6) -> optx.LevenbergMarquardt:
    """The default solver. Its dense normal equations are factorised by Cholesky: the damping keeps them definite,
    and a tall QR of the same system takes several times longer."""
    return optx.LevenbergMarquardt(rtol=rtol, atol=atol, linear_solver=lx.Normal(lx.Cholesky()))


# optimistix's default adjoint calls a system singular where a control cannot be observed (no frame in contact)
ADJOINT = optx.ImplicitAdjoint(linear_solver=lx.AutoLinearSolver(well_posed=False))


@eqx.filter_custom_jvp
def _frame_local_rows(signals: Float[Array, "frames controls"], rows: Callable) -> Array:
    """Rows (frames, n) of terms that look at one frame at a time, with a cheap Jacobian in the control points.

    Row t depends on the signals of frame t only, so d row_t / d signal_c for *all* t comes from one product with
    the seed "signal c = 1 in every frame". The tangent of any control point is then a sum over controls; without
    this rule each control point would cost one pass through the kinematics.
    """
    return rows(signals)


@_frame_local_rows.def_jvp
def _frame_local_rows_jvp(primals, tangents):
    signals, rows = primals
    t_signals, t_rows = tangents
    value = rows(signals)
    tangent = jnp.zeros_like(value)
    if t_signals is not None:
        seeds = jnp.eye(signals.shape[1], dtype=signals.dtype)[:, None, :] * jnp.ones_like(signals)
        _, columns = jax.vmap(lambda seed: jax.jvp(rows, (signals,), (seed,)))(seeds)
        tangent = tangent + jnp.einsum("tc,ctn->tn", t_signals, columns)
    if any(leaf is not None for leaf in jax.tree.leaves(t_rows)):
        _, extra = eqx.filter_jvp(lambda r: r(signals), (rows,), (t_rows,))
        tangent = tangent + extra
    return value, tangent


class _Rows(eqx.Module):
    """The weighted residuals of some terms as a function of the signals of the free controls."""

    problem: Problem
    fixed: Float[Array, "frames controls"]  # signals of all controls; the free columns are replaced
    free: tuple[int, ...] = eqx.field(static=True)
    terms: tuple[str, ...] = eqx.field(static=True)

    def __call__(self, signals: Float[Array, "frames free"]) -> Float[Array, "frames n"]:
        all_signals = self.fixed.at[:, np.array(self.free)].set(signals)
        kin = self.problem.kinematics(all_signals)
        frames = signals.shape[0]
        rows = [
            jnp.sqrt(self.problem.weights[k]) * self.problem.terms[k].residual(kin).reshape(frames, -1)  # type: ignore
            for k in self.terms
        ]
        return jnp.concatenate(rows, axis=1) if rows else jnp.zeros((frames, 0))


def _free_signals(problem: Problem, free: tuple[int, ...], points: tuple[Array, ...]) -> Float[Array, "frames free"]:
    return jnp.stack([problem.controls[k].signal(p) for k, p in zip(free, points, strict=True)], axis=1)


@eqx.filter_jit
def _solve(problem: Problem, block: Block, points: tuple[Array, ...], free: tuple[int, ...], terms: tuple[str, ...]):
    """Run one block's solver. Only arrays come back: optimistix's Solution holds leaves that are not."""
    fixed = jnp.stack([c.signal(p) for c, p in zip(problem.controls, points, strict=True)], axis=1)
    is_local = {k: isinstance(problem.terms[k], Term) and problem.terms[k].frame_local for k in terms}  # type: ignore
    start = tuple(points[k] for k in free)
    residual_terms = tuple(k for k in terms if isinstance(problem.terms[k], Term))

    def residuals(x, args):
        problem, fixed = args
        signals = _free_signals(problem, free, x)
        local = _Rows(problem, fixed, free, tuple(k for k in residual_terms if is_local[k]))
        other = _Rows(problem, fixed, free, tuple(k for k in residual_terms if not is_local[k]))
        return _frame_local_rows(signals, local), other(signals)

    def total(x, args):
        problem, fixed = args
        kin = problem.kinematics(fixed.at[:, np.array(free)].set(_free_signals(problem, free, x)))
        return sum(problem.weights[k] * term_cost(problem.terms[k], kin) for k in terms)

    solver = levenberg_marquardt() if block.solver is None else block.solver
    options = {"max_steps": block.max_steps, "throw": False, "adjoint": ADJOINT}
    arguments = (problem, fixed)
    if isinstance(solver, optx.AbstractLeastSquaresSolver):
        solution = optx.least_squares(residuals, solver, start, arguments, **options)
    else:
        solution = optx.minimise(total, solver, start, arguments, **options)
    steps = getattr(solution.state, "num_accepted_steps", solution.stats["num_steps"])
    return solution.value, steps, solution.result == optx.RESULTS.successful


def fit(
    problem: Problem,
    blocks: Sequence[Block],
    sweeps: int = 1,
    *,
    correction: Correction | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Block-coordinate descent: solve each block in turn over its free controls, `sweeps` times.

    Starts at `correction` (None: zero). `progress(block name, done, total)` is called after each block. Never
    raises for a hard clip: the best iterate comes back, and `history` says what moved.
    """
    blocks = tuple(blocks)
    names = [c.name for c in problem.controls]
    for block in blocks:
        _check(block, problem, names)
    points = tuple(jnp.asarray(p) for p in (correction or Correction.zero(problem.controls)).points)
    costs = problem.costs(Correction(problem.controls, points))
    history: list[BlockReport] = []
    for sweep in range(sweeps):
        for i, block in enumerate(blocks):
            started = time.perf_counter()
            free = tuple(names.index(c) for c in block.controls)
            terms = tuple(problem.terms) if block.terms is None else block.terms
            before = costs
            value, steps, converged = _solve(problem, block, points, free, terms)
            changed = list(points)
            for k, new in zip(free, value, strict=True):
                changed[k] = new
            costs = problem.costs(Correction(problem.controls, tuple(changed)))
            cost_before, cost_after = (sum(c[k] for k in terms) for c in (before, costs))
            # the best iterate: a solver that broke down (NaN, a higher cost) must not make the motion worse
            if cost_after <= cost_before:
                points = tuple(changed)
            else:
                costs, cost_after = before, cost_before
            status = _status(cost_before, cost_after, int(steps), bool(converged))
            history.append(
                BlockReport(
                    block.name, sweep, status, int(steps), cost_before, cost_after,
                    {k: before[k] for k in terms}, {k: costs[k] for k in terms}, time.perf_counter() - started,
                )
            )  # fmt: skip
            if progress is not None:
                progress(block.name, sweep * len(blocks) + i + 1, sweeps * len(blocks))
    result = Correction(problem.controls, points)
    last = {b.name: b.status for b in history}
    status = "no_progress" if "no_progress" in last.values() else "converged"
    if status == "converged" and "max_steps" in last.values():
        status = "violations_left"
    return Fit(result, result.apply(problem.motion), problem.motion, status, tuple(history), problem)


def _status(cost_before: float, cost_after: float, steps: int, converged: bool) -> str:
    if cost_before == 0.0:
        return "nothing_to_do"
    # the first accepted step of an optimistix solver is its start
    if steps <= 1 or (cost_after == cost_before and not converged):
        return "no_progress"
    return "converged" if converged else "max_steps"


def _check(block: Block, problem: Problem, names: list[str]) -> None:
    if not block.controls:
        raise InputError(f"block {block.name!r} frees no control; controls: {', '.join(names)}")
    for kind, wanted, known in (
        ("control", block.controls, names), ("term", block.terms or (), list(problem.terms))
    ):  # fmt: skip
        unknown = [w for w in wanted if w not in known]
        if unknown:
            raise InputError(f"block {block.name!r} names unknown {kind} {', '.join(unknown)}; "
                             f"{kind}s: {', '.join(known) or 'none'}")  # fmt: skip
    wanted = problem.terms if block.terms is None else block.terms
    energies = [k for k in wanted if isinstance(problem.terms[k], Energy)]
    least_squares = block.solver is None or isinstance(block.solver, optx.AbstractLeastSquaresSolver)
    if energies and least_squares:
        raise InputError(f"block {block.name!r} has a least-squares solver, but {', '.join(energies)} is an Energy; "
                         "give Block(solver=optx.BFGS(rtol=1e-4, atol=1e-6)) or leave it out of terms=")  # fmt: skip
