"""The stages of the limbs' solve, left arm, right arm, legs: what each is allowed, from round to round, and the problem
that they make."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._motion import Motion, host_kinematics
from motionfit._problem import During, Problem, Term
from motionfit._skeleton import SIDES
from motionfit._solve import Block
from motionfit.adapt._clearance import Clearance, build_clearance, reduced, support
from motionfit.adapt._limits import SkinLooks
from motionfit.adapt._sampling import SOLVE_RATE
from motionfit.shape.pairs import Pair
from motionfit.splines import Basis
from motionfit.terms.pose import Effort, Smoothness, Steadiness

SOLVE_PROBES = {"upper_arm": 20, "forearm": 16, "hand": 12, "thigh": 20, "calf": 20}  # per pair, of those looked at
# [m] that may stay where more was; well under TOLERANCE, which the skin is judged by: much that is in a little adds up
# too, and a body that leans and comes down to balance brings its thighs some 2 mm nearer
ALLOWED_EXCESS = 0.002
LEAST_GAP, LEAST_GAP_OF_LEGS = 0.005, 0.03  # [m]: of legs no rows but the fields' know what the skin shows
# Across and twist are there for what r alone cannot do, and the skin around a shoulder is known least where it twists
SIGMA_EFFORT = {
    **{f"{side}_arm{kind}": sigma for side in SIDES for kind, sigma in (("", 1.0), ("_across", 1.0), ("_twist", 0.4))},
    "hip_turn": 0.1,
    "thighs_apart": 1.0,
    "knees_apart": 0.6,
}  # [rad]
SIGMA_PACE = {"hip_turn": 0.3, "thighs_apart": 0.3}  # [rad/s]: a stance may widen over seconds, not within a step
JERK_SHARE = 4.0  # of the hands' own jerk, what the correction may add at the cost of 1 per frame
LEVER = 0.5  # [m] shoulder to hand
LEAST_JERK = 30.0  # [m/s^3] for clips that stand still
STIFFER, STIFFEST = 2.0, 16.0  # weight of what a round leaves on the skin, from round to round
LONG = 8192  # frames that the solver sees, from which on blocks are solved one by one: each takes half a gigabyte then


class Stage(NamedTuple):
    """A block of the solve: its clearance on all probes, the `columns` of its pairs, and the depths [m] that may stay,
    per frame and pair."""

    block: Block
    clearance: Clearance
    columns: list[int]
    allowed: Float[np.ndarray, "frames pairs"]
    quiet: Bool[np.ndarray, " pairs"]
    phantom: Float[np.ndarray, "frames pairs"]  # [m] of depth on the fields that the skin does not bear out
    stiffness: float = 1.0  # weight of what the skin shows


class Seen(NamedTuple):
    """The clip as the solver sees it: some of its frames, repeated at the end up to a bucket's length."""

    frames: Int[np.ndarray, " seen"]  # of the clip
    motion: Motion
    padded: Motion
    basis: Basis
    controls: tuple[Control, ...]


class Case(NamedTuple):
    """What stays as it is from round to round: the clip on the body, whole and as the solver sees it, its controls, the
    clearance of all pairs on all probes, the depths [m] that do not count, and the looks at the skin (None: the volumes
    judge alone)."""

    character: Character
    base: Motion
    controls: tuple[Control, ...]
    basis: Basis
    seen: Seen
    everything: Clearance
    own: Float[np.ndarray, "frames pairs"]
    looks: SkinLooks | None

    @property
    def pairs(self) -> tuple[Pair, ...]:
        return self.everything.pairs

    def final(self, correction: Correction) -> Correction:
        """The correction of the whole clip: its controls in every frame, and the control points that they need."""
        return Correction(self.controls, tuple(np.asarray(p)[: self.basis.count] for p in correction.points))

    def moved(self, correction: Correction) -> Motion:
        """The whole clip, corrected."""
        return self.final(correction).apply(self.base)

    def left(
        self, depths: Float[np.ndarray, "frames pairs"], on_skin: Float[np.ndarray, "looks pairs"] | None,
        quiet: Bool[np.ndarray, " pairs"],
    ) -> Float[np.ndarray, "frames pairs"]:  # fmt: skip
        """What counts [m]: the excess of all but quiet pairs, on the volumes and in the looks."""
        excess = depths - self.own
        if self.looks is None or on_skin is None:
            return np.where(quiet, 0.0, excess)
        return self.looks.joined(excess, on_skin - self.looks.own, quiet)


def together(stages: list[Stage], seen: Seen) -> Sequence[Block | tuple[Block, ...]]:
    """The legs do not look at the arms, so they go with the first one. The other arm shares its program, and waits."""
    blocks = [s.block for s in stages]
    legs = tuple(b for b in blocks if b.name == "legs")
    if len(blocks) == 1 or not legs or seen.padded.frame_count >= LONG:
        return blocks
    return [(blocks[0], *legs), *(b for b in blocks[1:] if b not in legs)]


def in_order(stages: list[Stage], columns: list[np.ndarray]) -> Float[np.ndarray, "frames pairs"]:
    """What the stages hold of their pairs, as columns of all pairs."""
    return np.concatenate(columns, axis=1)[:, np.argsort(np.concatenate([s.columns for s in stages]))]


def stages_of(
    character: Character, blocks: Sequence[str], pairs: tuple[Pair, ...], objective: str,
    allowed: Float[np.ndarray, "frames pairs"], quiet: Bool[np.ndarray, " pairs"],
    phantom: Float[np.ndarray, "frames pairs"], touching: bool = False,
) -> list[Stage]:  # fmt: skip
    """The blocks of each recipe, in order: left arm, right arm, legs."""
    made = []
    for recipe in blocks:
        if recipe == "arms":
            wanted = [(f"{s}_arm", tuple(f"{s}_arm{k}" for k in ("", "_across", "_twist")),
                       tuple(p for p in pairs if p.block == "arms" and p.first.startswith(s))) for s in SIDES]  # fmt: skip
        else:
            wanted = [
                ("legs", ("hip_turn", "thighs_apart", "knees_apart"), tuple(p for p in pairs if p.block == "legs"))
            ]
        for name, controls, mine in wanted:
            clearance = build_clearance(character, mine, objective)
            columns = [pairs.index(p) for p in clearance.pairs]
            # fields see thighs well, and the fold between them, where they touch, opens in no one direction
            touches = (f"{name}_touches",) if touching and recipe == "arms" else ()
            # a foot that stands shall not slide; arms may come and go
            steady = ("steadiness",) if recipe == "legs" else ()
            terms = (f"{name}_clearance", *touches, "effort", "smoothness", *steady)
            block = Block(name, controls, terms, max_steps=24, tolerance=1e-3)
            made.append(Stage(block, clearance, columns, allowed[:, columns], quiet[columns], phantom[:, columns]))
    return made


def own_sets(everything: Clearance, stage: Stage) -> Bool[np.ndarray, " sets"]:
    """Which sets of probes of all pairs are a stage's: both come in the order of their pairs."""
    return np.isin(everything.pair_of_row, stage.columns)


def problem_of(
    case: Case, stages: list[Stage], smooth: float, probes: tuple[Float[np.ndarray, "frames sets points"] | None, ...]
) -> Problem:
    """The terms of all stages; `probes` are the depths of all, by which those that matter are chosen."""
    seen, everything, looks = case.seen, case.everything, case.looks
    real, length = seen.motion.frame_count, seen.padded.frame_count
    terms: dict[str, Term] = {}
    weights: dict[str, float] = {}
    scores = np.zeros((0, 0))
    if everything.part_of_set:
        allowed = in_order(stages, [s.allowed + s.phantom for s in stages])
        scores = np.sum([support(everything, depth, allowed) for depth in probes], axis=0)
    for stage in stages:
        # however much the skin shows: an arm that is LEAST_GAP away from the other's field is pushed no further by it
        limit = np.maximum(stage.allowed, -LEAST_GAP if stage.block.name != "legs" else -LEAST_GAP_OF_LEGS)
        limit = np.where(stage.quiet, stage.allowed, smooth_floor(limit, float(seen.motion.dt)) + stage.phantom)
        # the frames that only fill the bucket cost nothing
        limit = np.concatenate([limit, np.full((length - real, limit.shape[1]), 1e3)])
        name = f"{stage.block.name}_clearance"
        if stage.clearance.part_of_set:
            terms[name] = reduced(stage.clearance, scores[own_sets(everything, stage)], limit, SOLVE_PROBES)  # pyright: ignore[reportArgumentType]
        else:
            terms[name] = stage.clearance.allowing(limit)
        if looks is not None and f"{stage.block.name}_touches" in (stage.block.terms or ()):
            awake = np.array(stage.columns)[~stage.quiet]
            terms[f"{stage.block.name}_touches"] = looks.touch_term(awake, ALLOWED_EXCESS, length)
            weights[f"{stage.block.name}_touches"] = stage.stiffness
    frames = np.arange(length)
    effort = Effort(np.array([SIGMA_EFFORT[c.name] for c in seen.controls]))
    terms["effort"] = During(effort, (frames < real).astype(float))
    terms["smoothness"] = During(Smoothness(smooth), (frames < real - 2).astype(float))
    steady = Steadiness(np.array([SIGMA_PACE.get(c.name, np.inf) for c in seen.controls]))
    terms["steadiness"] = During(steady, (frames < real - 1).astype(float))
    return Problem(case.character, seen.padded, terms, seen.controls, weights)


def jerk_scale(base: Motion) -> float:
    """[rad/s^3] of a shoulder that adds as much jerk at the hand as the clip has itself, noise left out."""
    dt = float(base.dt)
    hands = [j for s in SIDES if (j := base.skeleton.find(f"{s}_hand")) is not None]
    if base.frame_count < 4 or not hands:
        return JERK_SHARE * LEAST_JERK / LEVER
    positions = gaussian_filter1d(host_kinematics(base)[0][:, hands], 1 / (SOLVE_RATE * dt), axis=0, mode="nearest")
    jerk = float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1).mean()) / dt**3
    return JERK_SHARE * max(jerk, LEAST_JERK) / LEVER


def wake(stage: Stage, woken: Bool[np.ndarray, " pairs"], kept: Float[np.ndarray, "frames pairs"]) -> Stage:
    """The stage with some pairs no longer left alone."""
    return stage._replace(quiet=stage.quiet & ~woken, allowed=np.where(woken, kept, stage.allowed))


def stiffen(stage: Stage) -> Stage:
    """What the skin still shows counts more: a fold may yield to nothing less, and a field that says otherwise."""
    return stage._replace(stiffness=min(STIFFER * stage.stiffness, STIFFEST))


def smooth_floor(limit: Float[np.ndarray, "frames pairs"], dt: float) -> Float[np.ndarray, "frames pairs"]:
    """The limit without its jumps, nowhere above it by much: what a spline can follow without a jerk."""
    width = max(1, round(0.05 / dt))
    return gaussian_filter1d(minimum_filter1d(limit, 2 * width + 1, axis=0), width, axis=0, mode="nearest")


def tighten(stage: Stage, left: Float[np.ndarray, "frames pairs"], dt: float) -> Stage:
    """Less may stay where the solve left more [m] than it was allowed: per pair, around the frames that show it."""
    more = np.where(left > 0.001, left, 0.0)
    # wide enough for a spline to follow, and nowhere less than what the frame itself needs
    width = max(1, round(0.1 / dt))
    more = gaussian_filter1d(maximum_filter1d(more, 2 * width + 1, axis=0), width / 2, axis=0, mode="nearest")
    return stage._replace(allowed=stage.allowed - np.minimum(1.3 * more, 0.02))
