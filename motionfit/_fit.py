"""Block-coordinate descent over optimistix solvers, and nothing else: thesis 4.3.1."""

import dataclasses
import functools
import json
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
from jax import Array

from motionfit._control import Correction
from motionfit._motion import Motion
from motionfit._problem import Energy, Problem
from motionfit._solve import Block, Solved, Work, block_adjoint, block_solver, block_work, check_reach, run_block
from motionfit._types import InputError


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
        signals = {
            c.name: np.abs(c.signal_on_host(p))
            for c, p in zip(self.correction.controls, self.correction.points, strict=True)
        }
        moved = {name: {"max_rad": float(s.max()), "mean_rad": float(s.mean())} for name, s in signals.items()}
        return {"status": self.status, "blocks": blocks, "controls": moved, **self.details}

    def __str__(self) -> str:
        return json.dumps(self.report(), indent=2)


def fit(
    problem: Problem,
    blocks: Sequence[Block | tuple[Block, ...]],
    sweeps: int = 1,
    *,
    correction: Correction | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Block-coordinate descent: solve each block in turn over its free controls, `sweeps` times.

    Blocks in a tuple are solved side by side, each from where all of them started: for blocks that free different
    controls, and do not look at each other's.

    Starts at `correction` (None: zero). `progress(block name, done, total)` is called after each block. Never
    raises for a hard clip: the best iterate comes back, and `history` says what moved.
    """
    groups = [group if isinstance(group, tuple) else (group,) for group in blocks]
    names = [c.name for c in problem.controls]
    for group in groups:
        free = [c for block in group for c in block.controls]
        if len(set(free)) < len(free):
            raise InputError(f"blocks {', '.join(b.name for b in group)} cannot be solved side by side: they free the "
                             "same control; give them one after the other")  # fmt: skip
        for block in group:
            _check(block, problem, names)
    points = tuple(jnp.asarray(p, float) for p in (correction or Correction.zero(problem.controls)).points)
    history: list[BlockReport] = []
    total, done = sweeps * sum(len(group) for group in groups), 0
    for sweep in range(sweeps):
        for group in groups:
            run = functools.partial(_run, problem, points, sweep == 0)
            if len(group) == 1:
                runs = [run(group[0])]
            else:
                with ThreadPoolExecutor(len(group)) as pool:
                    runs = list(pool.map(run, group))
            for block, (work, solved, time_s) in zip(group, runs, strict=True):
                terms = tuple(problem.terms) if block.terms is None else block.terms
                points, report = settle(block, terms, points, work, solved, sweep)
                history.append(dataclasses.replace(report, time_s=time_s))
                done += 1
                if progress is not None:
                    progress(block.name, done, total)
    result = Correction(problem.controls, points)
    last = {b.name: b.status for b in history}
    status = "no_progress" if "no_progress" in last.values() else "converged"
    if status == "converged" and "max_steps" in last.values():
        status = "violations_left"
    return Fit(result, result.apply(problem.motion), problem.motion, status, tuple(history), problem)


def _run(problem: Problem, points: tuple[Array, ...], check: bool, block: Block) -> tuple[Work, Solved, float]:
    """Solve one block; with the seconds that it took."""
    started = time.perf_counter()
    work = block_work(problem, block, points)
    if check:
        check_reach(problem, block, work)
    solver = block_solver(problem, block)
    solved = jax.device_get(run_block(work, solver, block.max_steps, block_adjoint(solver)))
    return work, solved, time.perf_counter() - started


def settle(
    block: Block, terms: tuple[str, ...], points: tuple[Array, ...], work: Work, solved: Solved, sweep: int
) -> tuple[tuple[Array, ...], BlockReport]:
    """The control points after a block, and its report; the old ones where the solver made things worse or broke
    down (NaN)."""
    before, after = ({k: float(v) for k, v in zip(terms, c, strict=True)} for c in (solved.before, solved.after))
    cost_before, cost_after = sum(before.values()), sum(after.values())
    if cost_after <= cost_before:
        changed = list(points)
        for k, new in zip(np.asarray(work.free).tolist(), solved.points, strict=True):
            changed[k] = jnp.asarray(new)
        points = tuple(changed)
    else:
        after, cost_after = before, cost_before
    status = _status(cost_before, cost_after, int(solved.steps), bool(solved.converged))
    report = BlockReport(block.name, sweep, status, int(solved.steps), cost_before, cost_after, before, after, 0.0)
    return points, report


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
