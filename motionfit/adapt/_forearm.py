"""The block that brings the forearm back to where it pointed: thesis 4.4.2."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import Fit, fit
from motionfit._motion import Motion, host_kinematics, joint_angles
from motionfit._onto import onto
from motionfit._problem import During, Problem
from motionfit._programs import program
from motionfit._skeleton import SIDES
from motionfit._solve import Block, block_adjoint, block_solver, block_work, solve_block
from motionfit.adapt._clearance import probe_depths, reduced, support
from motionfit.adapt._controls import Turn, turn_controls
from motionfit.adapt._easing import eased, sinking_skin
from motionfit.adapt._groups import Group, filled, known_depths
from motionfit.adapt._limits import MOST_JERK, SkinLooks
from motionfit.adapt._record import on_top, put_down
from motionfit.adapt._sampling import sampling
from motionfit.adapt._stages import SOLVE_PROBES, jerk_scale, smooth_floor
from motionfit.metrics import TOLERANCE, derivative_ratio
from motionfit.shape.pairs import PAIRS
from motionfit.terms.pose import Direction, Effort, Smoothness

GRID = 0.1  # [rad] between the starts, 4.4.2
STARTS = 10  # of them are refined
ALLOWED_EXCESS = 0.004  # [m] that may stay
EFFORT = 2.0  # [rad]
CLEAR = 0.02  # [rad] on the mean: forearms that point where they did are left alone
ROUNDS = 4


def forearm(
    clip: Motion, character: Character, so_far: Fit, *, reference: Character | None = None, hand: bool = False
) -> Fit:
    """Bring back the forearms' world directions, which the arm block changed, without sinking in again.

    Free are the shoulder's twist and the elbow's two useful axes, within a quarter turn; the elbow bends one way
    only, (4.8) and (4.9). The objective (4.7) has peaks, figure 4.9: constant turns on a grid of 0.1 rad are tried, and
    the ten best refined at once, before the clearance of forearm and hand comes in. `hand` brings the hands' world
    rotations back too, in closed form (thesis 5.5.2 says why it is off: a hand bent at the wrist draws the eye).
    `details["forearm"]` holds the mean error [rad] before and after.
    """
    result, told = so_far, {}
    for side in SIDES:
        result, told[side] = _side(clip, character, result, reference, side)
    if hand:
        result = _hands_back(result)
    return dataclasses.replace(result, details={**so_far.details, "forearm": told})


def forearm_turns(side: str) -> tuple[Turn, ...]:
    return (Turn(f"{side}_forearm_twist", ((f"{side}_upper_arm", "twist", 1.0),)),
            Turn(f"{side}_forearm_bend", ((f"{side}_forearm", "bend", 1.0),)),
            Turn(f"{side}_forearm_swing", ((f"{side}_forearm", "swing", 1.0),), 0.5))  # fmt: skip


def _side(clip: Motion, character: Character, so_far: Fit, reference: Character | None, side: str):
    motion, skeleton, at = so_far.motion, character.skeleton, sampling(so_far.motion)
    elbow, hand = skeleton.joint(f"{side}_forearm"), skeleton.joint(f"{side}_hand")
    count, real = len(at.frames), np.arange(len(at.rows)) < len(at.frames)
    target = host_kinematics(so_far.base)[0]
    target = target[:, hand] - target[:, elbow]
    target = (target / np.linalg.norm(target, axis=1, keepdims=True))[:, None]

    def error(m: Motion) -> float:
        places = host_kinematics(m)[0]
        now = places[:, hand] - places[:, elbow]
        cosine = (now * target[:, 0]).sum(1) / np.linalg.norm(now, axis=1)
        return float(np.arccos(np.clip(cosine, -1.0, 1.0)).mean())

    told = {"error_before_rad": error(motion), "error_after_rad": error(motion)}
    if told["error_before_rad"] <= CLEAR:
        return so_far, told

    group = Group("forearm", (f"{side}_forearm", f"{side}_hand"), ("torso", f"{side}_thigh"), ())
    small, clear = at.motion(motion), known_depths(character, (group,))
    body, own = (character, at.motion(so_far.base)) if reference is None else (
        reference, at.motion(onto(clip, reference.skeleton)))  # fmt: skip
    limit, before = np.maximum(known_depths(body, (group,)).depths(own), 0.0), clear.depths(small)
    allowed, score = (
        np.maximum(limit + ALLOWED_EXCESS, before),
        support(clear.clearance, probe_depths(clear.clearance, small), limit),
    )
    controls = turn_controls(motion, at.whole, forearm_turns(side))
    seen = dataclasses.replace(motion[at.rows], dt=np.asarray(at.dt))
    points = Correction.zero(tuple(at.control(c) for c in controls))
    names, smooth, history = tuple(c.name for c in controls), jerk_scale(motion), []
    for attempt in range(ROUNDS):
        free = filled(smooth_floor(allowed, at.dt), at, 1e3)
        terms = {"direction": During(Direction((elbow,), (hand,), target[at.rows]), real.astype(float)),
                 "effort": During(Effort(EFFORT), real.astype(float)),
                 "smoothness": During(Smoothness(smooth), (np.arange(len(at.rows)) < count - 2).astype(float)),
                 "clearance": reduced(clear.clearance, score, free, SOLVE_PROBES)}  # fmt: skip
        problem = Problem(character, seen, terms, points.controls)
        if attempt == 0:
            alone = Block("starts", names, ("direction", "effort", "smoothness"), max_steps=12, tolerance=1e-3)
            points = multi_start(problem, alone)
        solved = fit(problem, (Block(f"{side}_forearm", names, max_steps=24, tolerance=1e-3),), correction=points)
        points, history = solved.correction, [*history, *solved.history]
        result = on_top(so_far, Correction(controls, points.points), at)
        after = clear.depths(at.motion(result.motion))
        over = after - np.maximum(limit, before)
        jerk = derivative_ratio(result.motion, motion, 3) or 1.0
        if over.max() <= 0.7 * TOLERANCE and jerk <= MOST_JERK:
            break
        if jerk > MOST_JERK:
            smooth *= 0.4
        allowed = allowed - np.where(over > 0.7 * TOLERANCE, np.minimum(over, 0.02), 0.0)
        moved = probe_depths(clear.clearance, at.motion(result.motion))
        score = np.maximum(score, support(clear.clearance, moved, limit))
    # where a forearm cannot point there without sinking in, it comes back in the other frames
    looks = SkinLooks(clip[at.frames], character, reference, PAIRS)
    looks.look_closer(joint_angles(at.motion(result.motion), small).max(axis=1))
    on_skin = sinking_skin(looks, small, at)

    def sunk(fit: Fit) -> Bool[np.ndarray, " seen"]:
        after = clear.depths(at.motion(fit.motion))
        return (after - np.maximum(limit, before) > TOLERANCE).any(axis=1) | on_skin(fit)

    result = eased(f"{side}_forearm_eased", so_far, result, at, sunk)
    told["error_after_rad"] = error(result.motion)
    if told["error_after_rad"] > told["error_before_rad"]:
        result, told["error_after_rad"] = so_far, told["error_before_rad"]
    return dataclasses.replace(result, history=(*so_far.history, *history)), told


def multi_start(problem: Problem, block: Block, spacing: float = GRID, count: int = STARTS) -> Correction:
    """The best of several refined starts: the thesis's way past the peaks of figure 4.9.

    The first two controls of the block are set to constants on a grid within their bounds; the `count` starts of least
    cost are refined together (vmap), and the best result is returned, with the other controls at zero where they began.
    """
    free = [c for name in block.controls for c in problem.controls if c.name == name]
    axes = [np.unique(np.append(np.arange(float(c.lower), float(c.upper) + 1e-9, spacing), 0.0)) for c in free[:2]]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    zero = tuple(jnp.asarray(p, float) for p in Correction.zero(problem.controls).points)
    work, solver = block_work(problem, block, zero), block_solver(problem, block)
    costs = np.asarray(costs_on_grid(work, jnp.asarray(grid, float)))
    chosen = grid[np.argsort(costs, kind="stable")[:count]]
    starts = tuple(jnp.asarray(np.tile(chosen[:, k, None], p.shape[0]) if k < 2 else np.zeros((len(chosen), p.shape[0])),
                               float) for k, p in enumerate(work.start))  # fmt: skip
    refined = _refined(work, starts, solver, block.max_steps, block_adjoint(solver))
    total = np.sum([np.asarray(c) for c in refined.after], axis=0)
    winner = int(np.nanargmin(total))
    points = list(zero)
    for place, found in zip(np.asarray(work.free), refined.points, strict=True):
        points[int(place)] = found[winner]
    return Correction(problem.controls, tuple(points))


@program
def costs_on_grid(work, grid: Float[jax.Array, "starts 2"]) -> Float[jax.Array, " starts"]:
    def cost(x):
        start = tuple(jnp.full_like(p, x[k]) if k < 2 else p for k, p in enumerate(work.start))
        signals = work.objective.signals(work.points)
        signals = signals.at[:, work.free].set(
            jnp.stack([c.signal(p) for c, p in zip(work.controls, start, strict=True)], axis=1)
        )
        kin = work.objective.kinematics(signals)
        rows = [jnp.sum(jnp.square(t.residual(kin))) * w for t, w in
                zip(work.objective.terms, work.objective.weights, strict=True)]  # fmt: skip
        return 0.5 * sum(rows)

    return jax.lax.map(cost, grid, batch_size=16)


@program
def _refined(work, starts, solver, max_steps: int, adjoint):
    def solve(start):
        return solve_block(work._replace(start=start), solver, max_steps, adjoint)

    return jax.vmap(solve)(starts)


def _hands_back(fit: Fit) -> Fit:
    """The fit with its hands turned as on its base."""
    motion, skeleton = fit.motion, fit.motion.skeleton
    local = np.array(motion.rotations, float)
    before, after = host_kinematics(fit.base)[1], host_kinematics(motion)[1]
    joints = [skeleton.joint(f"{s}_hand") for s in SIDES]
    for joint in joints:
        wanted, above = (Rotation.from_quat(w[:, j], scalar_first=True)
                         for w, j in ((before, joint), (after, skeleton.parents[joint])))  # fmt: skip
        local[:, joint] = (above.inv() * wanted).as_quat(scalar_first=True)
    turned = dataclasses.replace(motion, rotations=local)
    base = dataclasses.replace(fit.base, root=motion.root)
    return put_down("hand_kept", fit, turned, base, fit.correction, joints)
