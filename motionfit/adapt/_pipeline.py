"""`adapt`: a clip and a character in, an adapted clip out. Thesis 4.4 and 4.5, block after block."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._fit import Block, BlockReport, Fit, fit
from motionfit._motion import Motion, bucket, host_kinematics, rest_motion
from motionfit._onto import onto
from motionfit._problem import During, Problem, Term
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, allowance, build_clearance, reduced, support, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.metrics import TOLERANCE, derivative_ratio, skin_depths
from motionfit.shape.field import standing
from motionfit.shape.growth import grow
from motionfit.shape.pairs import PAIRS, Pair, pairs_of
from motionfit.splines import Basis, bspline_basis
from motionfit.terms.pose import Effort, Smoothness

BLOCKS = ("arms", "legs")

SOLVE_RATE = 60.0  # [1/s] frames that the solver looks at; between two of them a limb's depth changes by millimetres
KNOT_SPACING = 0.1  # [s]
SOLVE_PROBES = {"upper_arm": 20, "forearm": 16, "hand": 12, "thigh": 20, "calf": 20}  # per pair, of those looked at
ALLOWED_EXCESS = 0.005  # [m]
MARGIN = 0.001  # [m]
SIGMA_DEPTH = 0.01  # [m]
SIGMA_EFFORT = {
    "left_arm": 1.0, "left_arm_across": 1.0, "left_arm_twist": 0.4,
    "right_arm": 1.0, "right_arm_across": 1.0, "right_arm_twist": 0.4,
    "hip_turn": 0.1, "thighs_apart": 1.0,
}  # [rad]  # fmt: skip
JERK_SHARE = 1.0  # of the hands' own jerk, what the correction may add at the cost of 1 per frame
LEVER = 0.5  # [m] shoulder to hand
LEAST_JERK = 30.0  # [m/s^3] for clips that stand still
LOOKS = 6
MOST_JERK = 1.04
SHOULDER_SLACK = 1.15
LEAST_LOOKS, LOOK_SHARE = 10, 1 / 60  # of the frames that the solver sees, looked at on the skin


class Stage(NamedTuple):
    """A block of the solve: its clearance on all probes and on the ones it works with, and the depths [m] that may
    stay, per frame and pair."""

    block: Block
    recipe: str
    clearance: Clearance
    allowed: Float[np.ndarray, "frames pairs"]
    columns: list[int]


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
    excess = before - own
    # A pair that shows no violation is left alone. What the reference shows standing with its arms hanging is the
    # joint's own overlap, at the armpit above all: measured against the reference frame by frame it would count as
    # excess wherever a clip holds the arms out, as every adapted clip does, and each further adaptation would push
    # them further out.
    quiet = (before - np.maximum(own, at_ease)).max(axis=0) <= TOLERANCE
    skin = None if reference is None or objective != "vertex" else _Skin(clip, frames, character, reference, pairs)
    beyond = np.zeros_like(own)
    if skin is not None:
        seen = skin.depths(small)
        # near the shoulder the skin knows better than the fields
        slack = np.array([2.0 if p.first.endswith("upper_arm") else 1.0 for p in pairs])
        quiet = skin.quiet(seen) & ((before - np.maximum(own, at_ease)).max(axis=0) <= slack * TOLERANCE)
        beyond = np.where(quiet, 0.0, skin.beyond(seen, excess))
    kept = own + allowance(excess + beyond, ALLOWED_EXCESS, MARGIN)
    # parts that do not meet at a joint may touch as on the reference, but on an adapted clip the reference no longer
    # does: what is kept must pass for no violation then either
    kept = np.where([p.adjacent for p in pairs], kept, np.maximum(own, np.minimum(kept, 0.8 * TOLERANCE)))
    allowed = np.where(quiet, np.maximum(before, own), kept)

    whole = bspline_basis(base.frame_count, float(base.dt), _spacing(basis, small, base))
    controls: list[Control] = []
    if "arms" in blocks:
        controls += arm_controls(character, base, whole)
    if "legs" in blocks:
        controls += leg_controls(character, base, whole)
    reduced_controls = tuple(_at(c, rows, basis) for c in controls)
    stages = []
    for recipe in blocks:
        for block, mine in _blocks_of(recipe, pairs):
            clearance = build_clearance(character, mine, objective)
            columns = [pairs.index(p) for p in clearance.pairs]
            stages.append(Stage(block, recipe, clearance, allowed[:, columns], columns))

    correction, history, result = Correction.zero(reduced_controls), [], None
    smooth = _jerk_scale(base)
    total = LOOKS * len(stages)
    padded = dataclasses.replace(base[rows], dt=small.dt)
    for look in range(LOOKS):
        problem = _problem(character, padded, small, stages, beyond, reduced_controls, smooth, objective, result and result.motion[np.arange(len(frames))])
        result = fit(problem, [s.block for s in stages], sweeps, correction=correction, progress=None if progress is None
                     else lambda name, done, _, look=look: progress(name, look * len(stages) + done, total))  # fmt: skip
        correction, history = result.correction, history + list(result.history)
        moved = result.motion[np.arange(len(frames))]
        after = volume_depths(everything, moved)
        used = {s.block.name: s.allowed - beyond[:, s.columns] for s in stages}
        over = after - own
        if skin is not None:
            beyond = np.where(quiet, 0.0, skin.beyond(skin.depths(moved), over))
        over = np.where(quiet, 0.0, over + beyond)
        if look == LOOKS - 1:
            break
        jerk = derivative_ratio(_final(controls, whole, correction).apply(base), base, 3) or 1.0
        if jerk > MOST_JERK:
            smooth *= 0.5
        elif over.max(initial=0.0) <= TOLERANCE * 0.8:
            break
        if over.max(initial=0.0) <= TOLERANCE * 0.8:
            continue
        # the solver looks at some points only, and its corrections are smooth: what is still seen is taken off
        stages = [
            _tighten(s, np.where(over > 0.7 * TOLERANCE, after, 0.0)[:, s.columns] - used[s.block.name], float(small.dt))
            for s in stages
        ]
    final = _final(controls, whole, correction)
    motion = final.apply(base)
    status = "violations_left" if over.max(initial=0.0) > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in pairs], "frames": frames, "excess_before_m": before - own,
               "excess_after_m": after - own}  # fmt: skip
    return Fit(final, motion, base, status, tuple(history), result.problem, details)


def _final(controls: Sequence[Control], basis: Basis, correction: Correction) -> Correction:
    """The correction of the whole clip: its controls in every frame, and the control points that they need."""
    return Correction(tuple(controls), tuple(np.asarray(p)[: basis.count] for p in correction.points))


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
    if reference is None:
        rest = volume_depths(clearance, rest_motion(body.skeleton))
        return np.tile(rest, (len(frames), 1)), np.zeros(len(pairs))
    moving, easy = onto(clip[frames], body.skeleton), _at_ease(body)
    both = Motion(body.skeleton, np.concatenate([moving.root, easy.root]),
                  np.concatenate([moving.rotations, easy.rotations]), moving.dt)  # fmt: skip
    depths = volume_depths(clearance, both)
    count = len(moving.root)
    return depths[:count], depths[count:].max(axis=0) * np.array([p.adjacent for p in pairs])


def _at_ease(body: Character) -> Motion:
    """Standing with the arms hanging, and swung as in a walk."""
    poses = [standing(body.skeleton, swing) for swing in (-0.35, 0.0, 0.35)]
    return Motion(body.skeleton, np.concatenate([p.root for p in poses]),
                  np.concatenate([p.rotations for p in poses]), poses[0].dt)  # fmt: skip


class _Skin:
    """Looks at the skinned mesh itself, at some frames of a clip: what the fields cannot tell near the shoulder.

    There the skin follows arm and trunk at once, and the fold of the joint is not where a table of one pose says.
    """

    def __init__(self, clip: Motion, frames: np.ndarray, character: Character, reference: Character, pairs):
        count = min(len(frames), max(LEAST_LOOKS, round(len(frames) * LOOK_SHARE)))
        self.at = np.unique(np.linspace(0, len(frames) - 1, count).round().astype(int))
        self.frames, self.character, self.pairs = np.arange(len(frames)), character, pairs
        self.own = skin_depths(reference, onto(clip[frames[self.at]], reference.skeleton), pairs).depth
        adjacent = np.array([p.adjacent for p in pairs])
        if ("skin at ease", pairs) not in reference.memo:
            reference.memo["skin at ease", pairs] = skin_depths(reference, _at_ease(reference), pairs).depth.max(axis=0)
        self.at_ease = reference.memo["skin at ease", pairs] * adjacent

    def depths(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        return skin_depths(self.character, motion[self.at], self.pairs).depth

    def quiet(self, seen: Float[np.ndarray, "looks pairs"]) -> Bool[np.ndarray, " pairs"]:
        slack = np.array([SHOULDER_SLACK if p.first.endswith("upper_arm") else 1.0 for p in self.pairs])
        return (seen - np.maximum(self.own, self.at_ease)).max(axis=0) <= slack * TOLERANCE

    def beyond(
        self, seen: Float[np.ndarray, "looks pairs"], excess: Float[np.ndarray, "frames pairs"]
    ) -> Float[np.ndarray, "frames pairs"]:
        """How much more excess [m] the skin shows than the fields, where it shows any; between looks interpolated."""
        more = np.where(seen > 0, seen - self.own - excess[self.at], 0.0)
        more = np.clip(more, 0.0, 0.05)
        return np.stack([np.interp(self.frames, self.at, column) for column in more.T], axis=1)


def _jerk_scale(base: Motion) -> float:
    """[rad/s^3] that adds as much jerk at the hand as the clip has itself."""
    positions = host_kinematics(base)[0][:, [base.skeleton.joint(f"{s}_hand") for s in ("left", "right")]]
    positions = gaussian_filter1d(positions, 1 / (60 * float(base.dt)), axis=0, mode="nearest")  # not the noise
    jerk = np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1) / float(base.dt) ** 3 if len(positions) > 3 else np.zeros(1)
    return JERK_SHARE * max(float(jerk.mean()), LEAST_JERK) / LEVER


def _problem(character, padded, small, stages, beyond, controls, smooth, objective, after) -> Problem:
    real = small.frame_count
    mask = (np.arange(padded.frame_count) < real).astype(float)
    inner = (np.arange(padded.frame_count) < real - 2).astype(float)
    terms: dict[str, Term] = {}
    for stage in stages:
        far = np.full((padded.frame_count - real, stage.allowed.shape[1]), 1e3)
        allowed = np.concatenate([stage.allowed - beyond[:, stage.columns], far])
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
    """Less may stay where the solve left more [m] than it was allowed: per pair, around the frames that show it."""
    more = np.where(over > 0.001, over, 0.0)
    width = max(1, round(0.1 / dt))
    more = gaussian_filter1d(maximum_filter1d(more, 2 * width + 1, axis=0), width / 2, axis=0, mode="nearest")
    return stage._replace(allowed=stage.allowed - np.minimum(1.3 * more, 0.02))


def arms(clip: Motion, character: Character, **options) -> Fit:
    """The arm block alone: thesis 4.4.1. Options as in `adapt`."""
    return adapt(clip, character, blocks=("arms",), **options)


def legs(clip: Motion, character: Character, **options) -> Fit:
    """The leg block alone: thesis 4.5. Options as in `adapt`."""
    return adapt(clip, character, blocks=("legs",), **options)
