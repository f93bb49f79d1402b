"""Exact gradients against finite differences: one block of four controls, solved in seven ways.

    python -m benchmarks.finite_differences [--frames 75 150 300 ...] [--solvers NAME ...] [--cap SECONDS]
        [--objective vertex] [--out FOLDER]

Thesis 4.3.1 adapts a motion with a sequential quadratic program whose derivatives are finite differences: a gradient
costs one evaluation of the whole clip per control point, so a step is quadratic in the clip's length. Here the same
objective, the same start and the same bounds go to:

  slsqp-differences   SciPy SLSQP, finite differences of the jitted objective: the thesis's setting
  slsqp-exact         SciPy SLSQP, jitted reverse-mode gradient
  slsqp-exact-eager   the same without jit: what automatic differentiation alone gives
  lm-qr               optimistix Levenberg-Marquardt, its default dense QR
  lm-cholesky         the same, dense normal equations
  lm-banded           motionfit's default: normal equations banded in time
  lbfgsb              jaxopt's L-BFGS-B

Everything is in double precision (finite differences need it), and compilation is outside the time: every solver runs
once for a step or two before it is timed. Prints a table in markdown; with --out it is written to a folder together
with two plots, time against frames and cost against time.
"""

import argparse
import pathlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import jax
import jax.numpy as jnp
import lineax as lx
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

import motionfit as mf
from benchmarks.metrics import Metric, has_banded, seconds
from motionfit import samples
from motionfit._problem import term_cost
from motionfit._solve import levenberg_marquardt
from motionfit.adapt import build_clearance, volume_depths
from motionfit.shape.pairs import pairs_of
from motionfit.splines import bspline_basis

SOLVERS = ("slsqp-differences", "slsqp-exact", "slsqp-exact-eager", "lm-qr", "lm-cholesky", "lm-banded", "lbfgsb")
# where each stops being worth the wait: the dense ones grow with the square or the cube of the frames
MOST_FRAMES = {
    "slsqp-differences": 300, "slsqp-exact": 600, "slsqp-exact-eager": 75, "lm-qr": 300, "lm-cholesky": 1200,
}  # fmt: skip
SAME = 1.001  # costs within this factor of the best are the same optimum
CAP_S = 300.0


# --- the problem -----------------------------------------------------------------------------------------------


def arm_problem(frames: int, objective: str = "vertex") -> tuple[mf.Problem, mf.Block]:
    """The built-in walk on the heavy body: both shoulders free about the forward and the upward axis.

    The terms are those of `motionfit.adapt`: skin points of upper arms and forearms in the trunk, as far as they
    exceed what the average body shows, the controls themselves, and their bends over time. The capsules of
    `objective="capsule"` are the thesis's one volume per segment, and much cheaper to evaluate.
    """
    average, heavy = (mf.load_character(f"builtin:{name}") for name in ("average", "heavy"))
    clip = samples.walk(cycles=-(-frames // 60))[:frames]
    motion = mf.onto(clip, heavy.skeleton)
    pairs = tuple(p for p in pairs_of("arms") if p.first.endswith("arm") and p.second == "torso")
    clearance = build_clearance(heavy, pairs, objective)
    shown = volume_depths(build_clearance(average, pairs, objective), mf.onto(clip, average.skeleton))
    terms = {
        "clearance": clearance.allowing(shown),
        "effort": mf.terms.Effort(1.0),
        "smoothness": mf.terms.Smoothness(),
    }
    basis = bspline_basis(frames, float(motion.dt), 0.1)
    skeleton = heavy.skeleton
    world: dict[int, Rotation] = {}
    for joint, parent in enumerate(skeleton.parents):
        own = Rotation.from_quat(np.asarray(skeleton.rest_rotations)[joint], scalar_first=True)
        world[joint] = world[parent] * own if parent >= 0 else own
    controls = []
    for side in ("left", "right"):
        joint = skeleton.joint(f"{side}_upper_arm")
        for name, axis_world in (("out", [0.0, 0.0, 1.0]), ("round", [0.0, 1.0, 0.0])):
            axis = world[skeleton.parents[joint]].inv().apply(axis_world)
            controls.append(mf.Control(f"{side}_{name}", (mf.Drive(joint, axis, 1.0),), basis))
    problem = mf.Problem(heavy, motion, terms, tuple(controls))
    return problem, mf.Block("arms", tuple(c.name for c in controls), max_steps=100)


def flat_objective(problem: mf.Problem) -> Callable:
    """The block's cost as a function of one vector, which is what SciPy and jaxopt take."""
    counts = np.cumsum([c.basis.count for c in problem.controls])[:-1]

    def cost(x):
        points = jnp.split(x, counts)
        signals = jnp.stack([c.signal(p) for c, p in zip(problem.controls, points, strict=True)], axis=1)
        kin = problem.kinematics(signals)
        return sum(problem.weights[k] * term_cost(t, kin) for k, t in problem.terms.items())

    return cost


def bounds(problem: mf.Problem) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper bound [rad] of every control point."""
    ends = [[np.full(c.basis.count, float(v)) for v in (c.lower, c.upper)] for c in problem.controls]
    low, high = zip(*ends, strict=True)
    return np.concatenate(low), np.concatenate(high)


# --- the solvers -----------------------------------------------------------------------------------------------


@dataclass
class Outcome:
    """What one solver did on one problem: seconds without compilation, the cost it reached, and on the way."""

    name: str
    frames: int
    unknowns: int
    time_s: float
    cost: float
    evaluations: int  # of the objective for SciPy and jaxopt, accepted steps for the others
    capped: bool = False
    trace: list[tuple[float, float]] = field(default_factory=list)  # (seconds, lowest cost so far)
    skipped: str = ""


class _Capped(Exception):
    """Time is up: thrown out of the objective, since SciPy's solvers have no clock."""


def solve_with(name: str, problem: mf.Problem, block: mf.Block, cap_s: float = CAP_S, trace: bool = False) -> Outcome:
    """Solve the block from a zero correction with one of `SOLVERS`; see the module's text for what each is.

    `trace` also follows the cost over time, which for the Levenberg-Marquardt solvers means solving again with
    fewer steps.
    """
    unknowns = sum(c.basis.count for c in problem.controls)
    blank = Outcome(name, problem.motion.frame_count, unknowns, np.nan, np.nan, 0)
    if problem.motion.frame_count > MOST_FRAMES.get(name, np.inf):
        blank.skipped = f"not run above {MOST_FRAMES[name]} frames"
        return blank
    if name == "lm-banded" and not has_banded():
        blank.skipped = "this version has no motionfit.banded"
        return blank
    if name.startswith("slsqp"):
        return _slsqp(blank, problem, cap_s)
    if name == "lbfgsb":
        return _lbfgsb(blank, problem, cap_s)
    linear = {"lm-qr": lx.QR(), "lm-cholesky": lx.Normal(lx.Cholesky()), "lm-banded": None}[name]
    # the tolerances of motionfit's default, which is what Block(solver=None) stands for
    solver = None if linear is None else levenberg_marquardt(linear)
    return _least_squares(blank, problem, block, solver, trace)


def _slsqp(outcome: Outcome, problem: mf.Problem, cap_s: float) -> Outcome:
    objective = flat_objective(problem)
    differences, eager = outcome.name == "slsqp-differences", outcome.name == "slsqp-exact-eager"
    evaluate: Any = objective if differences else jax.value_and_grad(objective)
    evaluate = evaluate if eager else jax.jit(evaluate)
    zero = np.zeros(outcome.unknowns)
    with jax.disable_jit(eager):
        jax.block_until_ready(evaluate(zero))  # compiles
        start, best = time.perf_counter(), (np.inf, zero)

        def told(x):
            nonlocal best
            if time.perf_counter() - start > cap_s:
                raise _Capped
            got = evaluate(x)
            cost, gradient = (got, None) if differences else got
            outcome.evaluations += 1
            if float(cost) < best[0]:
                best = float(cost), np.array(x)
                outcome.trace.append((time.perf_counter() - start, best[0]))
            return float(cost) if differences else (float(cost), np.asarray(gradient, float))

        try:
            minimize(told, zero, jac=None if differences else True, method="SLSQP",
                     bounds=list(zip(*bounds(problem), strict=True)), options={"maxiter": 1000, "ftol": 1e-7})  # fmt: skip
        except _Capped:
            outcome.capped = True
        outcome.time_s = time.perf_counter() - start
    outcome.cost = best[0]
    return outcome


def _lbfgsb(outcome: Outcome, problem: mf.Problem, cap_s: float) -> Outcome:
    import jaxopt

    objective = jax.value_and_grad(flat_objective(problem))
    limits = tuple(jnp.asarray(b) for b in bounds(problem))
    solver = jaxopt.LBFGSB(fun=objective, value_and_grad=True, maxiter=1000, tol=1e-5, history_size=20)
    # stepped from here, so that the clock and the cost can be looked at on the way
    update = jax.jit(lambda params, state: solver.update(params, state, bounds=limits))
    first = jnp.zeros(outcome.unknowns)
    fresh = solver.init_state(first, bounds=limits)
    jax.block_until_ready(update(first, fresh))  # compiles
    start, params, state, lowest = time.perf_counter(), first, fresh, np.inf
    outcome.trace.append((0.0, float(state.value)))
    last_gain = 0
    while float(state.error) > solver.tol and outcome.evaluations < solver.maxiter:
        params, state = update(params, state)
        outcome.evaluations += 1
        elapsed = time.perf_counter() - start
        if float(state.value) < lowest * (1 - 1e-7):
            last_gain = outcome.evaluations
        lowest = min(lowest, float(state.value))
        outcome.trace.append((elapsed, lowest))
        if outcome.evaluations - last_gain >= 20:  # the same ftol as SLSQP's, over some steps: nothing more to gain
            break
        if elapsed > cap_s:
            outcome.capped = True
            break
    outcome.time_s, outcome.cost = time.perf_counter() - start, lowest
    return outcome


def _least_squares(outcome: Outcome, problem: mf.Problem, block: mf.Block, solver, trace: bool) -> Outcome:
    def solve(max_steps: int) -> tuple[float, mf.Fit]:
        limited = mf.Block(block.name, block.controls, block.terms, max_steps, solver)
        mf.fit(problem, (limited,))  # compiles
        start = time.perf_counter()
        fit = mf.fit(problem, (limited,))
        return time.perf_counter() - start, fit

    outcome.time_s, fit = solve(block.max_steps)
    report = fit.history[0]
    outcome.cost, outcome.evaluations, outcome.capped = report.cost_after, report.accepted_steps, False
    if trace:
        outcome.trace.append((0.0, report.cost_before))
        steps = 2
        while steps < report.accepted_steps:
            elapsed, fit = solve(steps)
            outcome.trace.append((elapsed, fit.history[0].cost_after))
            steps *= 2
        outcome.trace.append((outcome.time_s, outcome.cost))
    return outcome


# --- the comparison --------------------------------------------------------------------------------------------


def compare_solvers(
    frame_counts: tuple[int, ...],
    solvers: tuple[str, ...] = SOLVERS,
    cap_s: float = CAP_S,
    traced_at: int | None = None,
    objective: str = "vertex",
) -> list[Outcome]:
    """Every solver on every length; one that was capped is not asked again for a longer clip."""
    outcomes, too_slow = [], set()
    with jax.enable_x64(True):
        for frames in frame_counts:
            problem, block = arm_problem(frames, objective)
            for name in solvers:
                if name in too_slow:
                    continue
                outcome = solve_with(name, problem, block, cap_s, trace=frames == traced_at)
                outcomes.append(outcome)
                if outcome.capped:
                    too_slow.add(name)
                what = outcome.skipped or f"cost {outcome.cost:.6g} after {outcome.time_s:.4g} s"
                print(f"    {frames} frames, {name}: {what}{', capped' if outcome.capped else ''}", flush=True)
    return outcomes


def best_cost(outcomes: list[Outcome], frames: int) -> float:
    """The lowest cost that any solver reached at a length."""
    return min((o.cost for o in outcomes if o.frames == frames and not o.skipped), default=np.nan)


def _verdict(outcome: Outcome, best: float) -> str:
    if outcome.skipped:
        return outcome.skipped
    reached = "same optimum" if outcome.cost <= SAME * best else "DID NOT REACH the optimum"
    return f"capped, {reached}" if outcome.capped else reached


def table(outcomes: list[Outcome]) -> str:
    """The comparison in markdown; "x banded" is the time over that of the banded solver at the same length."""
    lines = ["| frames | unknowns | solver | time [s] | ms/frame | x banded | cost | cost / best | evaluations or steps "
             "| verdict |", "|---" * 10 + "|"]  # fmt: skip
    banded = {o.frames: o.time_s for o in outcomes if o.name == "lm-banded" and not o.skipped}
    for o in outcomes:
        best = best_cost(outcomes, o.frames)
        if o.skipped:
            lines.append(f"| {o.frames} | {o.unknowns} | {o.name} | | | | | | | {o.skipped} |")
            continue
        more = ">" if o.capped else ""
        times = f"{more}{o.time_s / banded[o.frames]:.3g}" if o.frames in banded else ""
        lines.append(f"| {o.frames} | {o.unknowns} | {o.name} | {more}{o.time_s:.4g} | {1e3 * o.time_s / o.frames:.4g} "
                     f"| {times} | {o.cost:.6g} | {o.cost / best:.5f} | {o.evaluations} | {_verdict(o, best)} |")  # fmt: skip
    return "\n".join(lines)


def plot(outcomes: list[Outcome], folder: pathlib.Path) -> None:
    """time_against_frames.png and cost_against_time.png."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    names = [n for n in SOLVERS if any(o.name == n and not o.skipped for o in outcomes)]
    colours: dict[str, Any] = dict(zip(SOLVERS, plt.get_cmap("tab10").colors, strict=False))  # type: ignore[attr-defined]
    figure, axes = plt.subplots(figsize=(7, 5))
    for name in names:
        rows = [o for o in outcomes if o.name == name and not o.skipped]
        axes.plot([o.frames for o in rows], [o.time_s for o in rows], "-o", color=colours[name], label=name)
        for o in rows:
            if o.capped:
                axes.annotate("capped", (o.frames, o.time_s), textcoords="offset points", xytext=(4, 6))
    axes.set(xscale="log", yscale="log", xlabel="frames", ylabel="time to solve the block [s]")
    axes.legend()
    axes.grid(True, which="both", alpha=0.3)
    figure.savefig(folder / "time_against_frames.png", dpi=150, bbox_inches="tight")
    plt.close(figure)

    traced = [o for o in outcomes if len(o.trace) > 1]
    frames = max((o.frames for o in traced if o.name.startswith("lm-")), default=0)
    if not frames:  # no length was traced
        return
    figure, axes = plt.subplots(figsize=(7, 5))
    best = best_cost(outcomes, frames)
    for o in traced:
        if o.frames == frames:
            times, costs = np.array(o.trace).T
            # a log axis has no zero: the start is drawn at a tenth of a millisecond
            axes.step(np.maximum(times, 1e-4), costs / best, where="post", color=colours[o.name], label=o.name)
    axes.axhline(SAME, color="0.5", lw=0.8, ls="--")
    axes.set(xscale="log", yscale="log", xlabel=f"time [s], {frames} frames", ylabel="cost / best cost")
    axes.legend()
    axes.grid(True, which="both", alpha=0.3)
    figure.savefig(folder / "cost_against_time.png", dpi=150, bbox_inches="tight")
    plt.close(figure)


# --- benchmark entries -----------------------------------------------------------------------------------------


def solvers(frames: int = 75) -> Iterator[Metric]:
    """The solvers with exact gradients on one short block of capsules: all reach the same optimum."""
    names = ("slsqp-exact", "lm-cholesky", "lm-banded", "lbfgsb")
    outcomes = compare_solvers((frames,), names, cap_s=60.0, objective="capsule")
    yield from _metrics("solvers", outcomes, tolerance=1.0)


def entry(frame_counts: tuple[int, ...] = (75, 150, 300)) -> Iterator[Metric]:
    """Finite differences against exact gradients, dense against banded (see benchmarks/finite_differences.py)."""
    yield from _metrics("finite-differences", compare_solvers(frame_counts), tolerance=1.0)


def _metrics(key: str, outcomes: list[Outcome], tolerance: float) -> Iterator[Metric]:
    print(table(outcomes), flush=True)
    for frames in sorted({o.frames for o in outcomes}):
        rows = {o.name: o for o in outcomes if o.frames == frames and not o.skipped}
        best, base = best_cost(outcomes, frames), rows.get("lm-banded", rows.get("lm-cholesky"))
        for name, o in rows.items():
            yield seconds(f"{key}.{name}_{frames}", o.time_s)
            if not o.capped:
                yield Metric(f"{key}.{name}_{frames}_cost_over_best", o.cost / best, "ratio", "lower", 0.0, 1e-3)
            if base is not None and o is not base:
                gated = None if o.capped else tolerance
                yield Metric(f"{key}.{base.name}_over_{name}_{frames}", base.time_s / o.time_s, "ratio", "lower",
                             gated, 0.0, True)  # fmt: skip


def main() -> None:
    """Run the comparison from the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[75, 150, 300, 600, 1200, 3000])
    parser.add_argument("--solvers", nargs="+", default=list(SOLVERS), choices=SOLVERS)
    parser.add_argument("--cap", type=float, default=CAP_S, help="seconds after which a solver is stopped")
    parser.add_argument("--trace-at", type=int, default=300, help="frames at which cost is followed over time")
    parser.add_argument("--objective", default="vertex", choices=("capsule", "vertex", "joint"))
    parser.add_argument("--out", type=pathlib.Path, help="write table.md and two plots to this folder")
    options = parser.parse_args()
    outcomes = compare_solvers(tuple(options.frames), tuple(options.solvers), options.cap, options.trace_at,
                               options.objective)  # fmt: skip
    print(table(outcomes))
    if options.out:
        options.out.mkdir(parents=True, exist_ok=True)
        (options.out / "table.md").write_text(table(outcomes) + "\n", encoding="utf-8")
        plot(outcomes, options.out)


if __name__ == "__main__":
    main()
