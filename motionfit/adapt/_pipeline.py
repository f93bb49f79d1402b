"""`adapt`: a clip and a character in, an adapted clip out. Thesis 4.4 and 4.5, block after block."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._fit import Block, BlockReport, Fit, fit
from motionfit._motion import Motion, bucket, host_kinematics
from motionfit._onto import onto
from motionfit._problem import During, Problem, Term
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, allowance, build_clearance, reduced, support, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.metrics import TOLERANCE
from motionfit.shape.field import standing
from motionfit.shape.growth import grow
from motionfit.shape.pairs import PAIRS, Pair, pairs_of
from motionfit.splines import Basis, bspline_basis
from motionfit.terms.pose import Effort, Smoothness

BLOCKS = ("arms", "legs")

SOLVE_RATE = 60.0  # [1/s] frames that the solver looks at; between two of them a limb's depth changes by millimetres
KNOT_SPACING = 0.1  # [s]
SOLVE_PROBES = {"upper_arm": 20, "forearm": 16, "hand": 12, "thigh": 20, "calf": 20}  # per pair, of those looked at
ALLOWED_EXCESS = 0.007  # [m]
MARGIN = 0.001  # [m]
SIGMA_DEPTH = 0.01  # [m]
SIGMA_EFFORT = {
    "left_arm": 1.0, "left_arm_across": 1.0, "left_arm_twist": 1.0,
    "right_arm": 1.0, "right_arm_across": 1.0, "right_arm_twist": 1.0,
    "hip_turn": 0.1, "thighs_apart": 1.0,
}  # [rad]  # fmt: skip
JERK_SHARE = 1.0  # of the hands' own jerk, what the correction may add at the cost of 1 per frame
LEVER = 0.5  # [m] shoulder to hand
LEAST_JERK = 30.0  # [m/s^3] for clips that stand still
LOOKS = 2


class Stage(NamedTuple):
    """A block of the solve: its clearance on all probes and on the ones it works with, and the depths [m] that may
    stay, per frame and pair."""

    block: Block
    recipe: str
    clearance: Clearance
    allowed: Float[np.ndarray, "frames pairs"]


def adapt(
    clip: Motion,
    character: Character,
    *,
    reference: Character | None = None,
    girth: Mapping[str, float] | None = None,
    blocks: Sequence[str] = BLOCKS,
    objective: str = "vertex",
    sweeps: int = 1,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    unknown = [b for b in blocks if b not in BLOCKS]
    if unknown or not blocks:
        raise InputError(f"unknown block {', '.join(map(repr, unknown)) or 'list'}; blocks: {', '.join(BLOCKS)}")
    if girth:
        reference, character = reference or character, grow(character, girth)
    base = onto(clip, character.skeleton)
    frames = _solve_frames(base)
    small = dataclasses.replace(base[frames], dt=np.asarray(base.dt) * (frames[1] - frames[0] if len(frames) > 1 else 1))
    length = bucket(len(frames))
    rows = frames[np.minimum(np.arange(length), len(frames) - 1)]  # of the clip, for each padded frame
    basis = bspline_basis(length, float(small.dt), KNOT_SPACING)
    everything = build_clearance(character, pairs_of(*blocks), objective)
    pairs = everything.pairs
    own, at_ease = _limits(clip, frames, character, reference, pairs, objective)
    before = volume_depths(everything, small)
    # A pair that shows no violation is left alone. What the reference shows standing with its arms hanging is the
    # joint's own overlap, at the armpit above all: measured against the reference frame by frame it would count as
    # excess wherever a clip holds the arms out, as every adapted clip does, and each further adaptation would push
    # them further out.
    excess = before - own
    quiet = (before - np.maximum(own, at_ease)).max(axis=0) <= TOLERANCE
    allowed = np.where(quiet, np.maximum(before, own), own + allowance(excess, ALLOWED_EXCESS, MARGIN))

    whole = bspline_basis(base.frame_count, float(base.dt), _spacing(basis, small, base))
    controls: list[Control] = []
    if "arms" in blocks:
        controls += arm_controls(character, base, whole)
    if "legs" in blocks:
        controls += leg_controls(character, base, whole)
    seen = tuple(_at(c, rows, basis) for c in controls)
    stages = []
    for recipe in blocks:
        for block, mine in _blocks_of(recipe, pairs):
            clearance = build_clearance(character, mine, objective)
            columns = [pairs.index(p) for p in clearance.pairs]
            stages.append(Stage(block, recipe, clearance, allowed[:, columns]))

    correction, history, result = Correction.zero(seen), [], None
    smooth = _jerk_scale(base)
    total = LOOKS * len(stages)
    padded = dataclasses.replace(base[rows], dt=small.dt)
    for look in range(LOOKS):
        problem = _problem(character, padded, small, stages, seen, smooth, objective, result and result.motion[np.arange(len(frames))])
        result = fit(problem, [s.block for s in stages], sweeps, correction=correction, progress=None if progress is None
                     else lambda name, done, _, look=look: progress(name, look * len(stages) + done, total))  # fmt: skip
        correction, history = result.correction, history + list(result.history)
        after = volume_depths(everything, result.motion[np.arange(len(frames))])
        over = np.where(quiet, 0.0, after - own)
        if look == LOOKS - 1 or over.max(initial=0.0) <= TOLERANCE * 0.9:
            break
        # the solver looks at some points only, and its corrections are smooth: what is still seen is taken off
        stages = [_tighten(s, over[:, [pairs.index(p) for p in s.clearance.pairs]], float(small.dt)) for s in stages]
    final = Correction(tuple(controls), tuple(np.asarray(p)[: whole.count] for p in correction.points))
    motion = final.apply(base)
    left = (after - own)[:, ~quiet].max(initial=0.0)
    status = "violations_left" if left > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in pairs], "frames": frames, "excess_before_m": before - own,
               "excess_after_m": after - own}  # fmt: skip
    return Fit(final, motion, base, status, tuple(history), result.problem, details)


def _solve_frames(base: Motion) -> Int[np.ndarray, " seen"]:
    step = max(1, round(base.frame_rate / SOLVE_RATE))
    return np.arange(0, base.frame_count, step)


def _spacing(basis: Basis, small: Motion, base: Motion) -> float:
    every = max(1, round(KNOT_SPACING / float(small.dt)))
    return every * float(small.dt)


def _at(control: Control, frames: np.ndarray, basis: Basis) -> Control:
    """The control as the solver sees it: at some frames of the clip."""
    drives = tuple(
        dataclasses.replace(d, axis_parent=d.axis_parent[frames] if np.ndim(d.axis_parent) == 2 else d.axis_parent)
        for d in control.drives
    )
    return dataclasses.replace(control, drives=drives, basis=basis)


def _blocks_of(recipe: str, pairs: tuple[Pair, ...]) -> list[tuple[Block, tuple[Pair, ...]]]:
    if recipe == "legs":
        names = ("hip_turn", "thighs_apart")
        return [(Block("legs", names, ("legs_clearance", "effort", "smoothness")), tuple(p for p in pairs if p.block == "legs"))]
    made = []
    for side in ("left", "right"):
        name = f"{side}_arm"
        mine = tuple(p for p in pairs if p.block == "arms" and p.first.startswith(side))
        made.append((Block(name, (name, f"{name}_across", f"{name}_twist"), (f"{name}_clearance", "effort", "smoothness")), mine))
    return made


def _limits(clip, frames, character, reference, pairs, objective):
    """Depth [m] that does not count, per frame and pair, and that of the joint itself, per pair."""
    body = reference or character
    clearance = build_clearance(body, pairs, objective)
    still = standing(body.skeleton)
    adjacent = np.array([p.adjacent for p in pairs])
    if reference is None:
        from motionfit._motion import rest_motion
        rest = volume_depths(clearance, rest_motion(body.skeleton))
        return np.tile(rest, (len(frames), 1)), np.zeros(len(pairs))
    moving = onto(clip[frames], body.skeleton)
    both = Motion(body.skeleton, np.concatenate([moving.root, still.root]),
                  np.concatenate([moving.rotations, still.rotations]), moving.dt)  # fmt: skip
    depths = volume_depths(clearance, both)
    return depths[:-1], depths[-1] * adjacent


def _jerk_scale(base: Motion) -> float:
    """[rad/s^3] that adds as much jerk at the hand as the clip has itself."""
    positions = host_kinematics(base)[0][:, [base.skeleton.joint(f"{s}_hand") for s in ("left", "right")]]
    positions = gaussian_filter1d(positions, 1 / (60 * float(base.dt)), axis=0, mode="nearest")  # not the noise
    jerk = np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1) / float(base.dt) ** 3 if len(positions) > 3 else np.zeros(1)
    return JERK_SHARE * max(float(jerk.mean()), LEAST_JERK) / LEVER


def _problem(character, padded, small, stages, controls, smooth, objective, after) -> Problem:
    real = small.frame_count
    mask = (np.arange(padded.frame_count) < real).astype(float)
    inner = (np.arange(padded.frame_count) < real - 2).astype(float)
    terms: dict[str, Term] = {}
    for stage in stages:
        far = np.full((padded.frame_count - real, stage.allowed.shape[1]), 1e3)
        allowed = np.concatenate([stage.allowed, far])
        clearance = stage.clearance
        if objective == "vertex":
            score = sum(support(clearance, m, stage.allowed) for m in ((small,) if after is None else (small, after)))
            terms[stage.block.terms[0]] = reduced(clearance, score, allowed, SOLVE_PROBES)
        else:
            terms[stage.block.terms[0]] = clearance.allowing(allowed)
    effort = Effort(np.array([SIGMA_EFFORT[c.name] for c in controls]))
    terms |= {"effort": During(effort, mask), "smoothness": During(Smoothness(smooth), inner)}
    return Problem(character, padded, terms, controls)


def _tighten(stage: Stage, over: Float[np.ndarray, "frames pairs"], dt: float) -> Stage:
    """Less may stay where more than the tolerance is still seen: per pair, around the frames that show it."""
    more = np.where(over > TOLERANCE * 0.8, over - ALLOWED_EXCESS, 0.0)
    width = max(1, round(0.1 / dt))
    more = gaussian_filter1d(maximum_filter1d(more, 2 * width + 1, axis=0), width / 2, axis=0, mode="nearest")
    return stage._replace(allowed=stage.allowed - 1.3 * more)


def arms(clip: Motion, character: Character, **options) -> Fit:
    """The arm block alone: thesis 4.4.1. Options as in `adapt`."""
    return adapt(clip, character, blocks=("arms",), **options)


def legs(clip: Motion, character: Character, **options) -> Fit:
    """The leg block alone: thesis 4.5. Options as in `adapt`."""
    return adapt(clip, character, blocks=("legs",), **options)
