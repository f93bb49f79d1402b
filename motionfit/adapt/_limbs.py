"""The blocks that take arms and legs out of what they sink into: thesis 4.4 and 4.5."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import gaussian_filter1d, maximum_filter1d, minimum_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._fit import Fit, fit
from motionfit._motion import Motion, host_kinematics
from motionfit._onto import onto
from motionfit._problem import During, Problem, Term
from motionfit._skeleton import SIDES
from motionfit._solve import Block
from motionfit._types import InputError
from motionfit.adapt._clearance import (
    Clearance,
    allowance,
    build_clearance,
    probe_depths,
    reduced,
    support,
    volume_depths,
)
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.adapt._limits import ENOUGH, NEARLY, SkinLooks, reference_depths
from motionfit.adapt._sampling import SOLVE_RATE, sampling
from motionfit.metrics import TOLERANCE, derivative_ratio
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import Basis
from motionfit.terms.pose import Effort, Smoothness, Steadiness

LIMBS = ("arms", "legs")

RATE = 30.0  # [1/s] of the frames that the solver sees: three for every knot
SOLVE_PROBES = {"upper_arm": 20, "forearm": 16, "hand": 12, "thigh": 20, "calf": 20}  # per pair, of those looked at
# [m] that may stay where more was; well under TOLERANCE, which the skin is judged by: much that is in a little adds up
# too, and a body that leans and comes down to balance brings its thighs some 2 mm nearer
ALLOWED_EXCESS = 0.002
MARGIN = 0.001  # [m]
DOUBTED = 0.02  # [m] on the fields of a shoulder that shows nothing on the skin
LEAST_GAP = 0.005  # [m]
# Across and twist are there for what r alone cannot do, and the skin around a shoulder is known least where it twists
SIGMA_EFFORT = {
    **{f"{side}_arm{kind}": sigma for side in SIDES for kind, sigma in (("", 1.0), ("_across", 1.0), ("_twist", 0.4))},
    "hip_turn": 0.1,
    "thighs_apart": 1.0,
}  # [rad]
SIGMA_PACE = {"hip_turn": 0.3, "thighs_apart": 0.3}  # [rad/s]: a stance may widen over seconds, not within a step
JERK_SHARE = 4.0  # of the hands' own jerk, what the correction may add at the cost of 1 per frame
LEVER = 0.5  # [m] shoulder to hand
LEAST_JERK = 30.0  # [m/s^3] for clips that stand still
MOST_JERK = 1.04  # ratio to the source's
CALM = 2.0  # knots over which a correction that is too jerky is smoothed before it is solved again
WIDE = np.deg2rad(45.0)  # a turn that makes one look for a shorter way out
# out, out and across: where an arm lies deep in a trunk or before it, each way out has a valley of its own
STARTS = tuple(np.deg2rad(s) for s in ((30.0, 0.0, 0.0), (30.0, 30.0, 30.0), (30.0, -30.0, -30.0)))
ROUNDS, PATIENCE = 9, 2  # rounds at most, and rounds without a better result
FEW_FAULTS = 0.005
STIFFER, STIFFEST = 2.0, 16.0  # weight of what a round leaves on the skin, from round to round
DONE = 0.5  # of what the source shows on a body: what a block leaves at most that has done its work
LESS = 0.8  # of the mean square of all turns: a tenth of the turns themselves
CLOSER = (0, 1)  # rounds after which more frames are looked at
LONG = 8192  # frames that the solver sees, from which on blocks are solved one by one: each takes half a gigabyte then


class Stage(NamedTuple):
    """A block of the solve: its clearance on all probes, the `columns` of its pairs, and the depths [m] that may stay,
    per frame and pair."""

    block: Block
    clearance: Clearance
    columns: list[int]
    allowed: Float[np.ndarray, "frames pairs"]
    quiet: Bool[np.ndarray, " pairs"]
    stiffness: float = 1.0  # weight of what the skin shows


class Iterate(NamedTuple):
    """A round's result; `faults` say how good it is: what is left, in tolerances in the mean over the frames, and jerk
    over the limit, a fifth of which counts as much as one."""

    faults: float
    correction: Correction
    problem: Problem | None
    depths: Float[np.ndarray, "frames pairs"]
    held_back: Float[np.ndarray, "frames pairs"]
    left: float  # [m]

    @property
    def clean(self) -> bool:
        return bool(self.faults < FEW_FAULTS and self.left <= NEARLY * TOLERANCE)

    @property
    def turn(self) -> float:
        """Mean square of the control points, each by its `SIGMA_EFFORT`."""
        points = zip(self.correction.controls, self.correction.points, strict=True)
        return sum(float(np.square(np.asarray(p) / SIGMA_EFFORT[c.name]).mean()) for c, p in points)

    def better_than(self, other: "Iterate") -> bool:
        """Fewer faults; of two that are clean the one that turns clearly less, since it is nearer to sinking in."""
        return bool(self.turn < LESS * other.turn if self.clean and other.clean else self.faults < other.faults)


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


def limbs(
    clip: Motion,
    character: Character,
    *,
    reference: Character | None = None,
    blocks: Sequence[str] = LIMBS,
    objective: str = "vertex",
    sweeps: int = 1,
    start: Fit | None = None,
    source: Motion | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Take the arms out of the trunk and the thighs, and the legs out of each other.

    The solver sees 30 frames per second, and the skin's probes that matter. An arm that turns far begins again from
    other turns; the least cost counts. Afterwards all probes are looked at, the skinned mesh itself at some
    frames, and the jerk. Where the skins touch becomes rows of the solve, where more than the tolerance
    is left the fields get less room, where the jerk grew the correction gets smoother, and the blocks run again from
    where they were.

    `fit.details` holds per pair and seen frame (`["frames"]`) the excess depth [m] on the volumes before and after
    (`["excess_before_m"]`, `["excess_after_m"]`), and how much less than at first the fields were allowed in the end
    (`["held_back_m"]`). `blocks` are run in the order given, `sweeps` times, starting from zero or from the
    result of an earlier `start` for the same clip. The reference plays the `source`, where the clip is adapted already.
    """
    known = source is not None
    case = _case(clip, character, reference, blocks, objective, clip if source is None else source)
    base, seen, everything, own, looks = case.base, case.seen, case.everything, case.own, case.looks
    small = seen.motion
    first = onto(source[seen.frames], character.skeleton) if source is not None else None
    probes = at_first = probe_depths(everything, small)
    before = volume_depths(everything, small, at_first)
    if looks is not None:  # first in the frames that were looked at when an adapted clip was made
        shown = before if first is None else volume_depths(everything, first)
        looks.look_closer((shown - own).max(axis=1))
    quiet, kept = _quiet(before - own, own, case.pairs, None if looks is None else looks.quiet(looks.depths(small)))
    settled = checked = known and bool(quiet.all())  # and what is settled was looked at closely then
    correction = _beginning(case, start)
    allowed = np.where(quiet, np.maximum(before, own), kept)
    held_back = np.zeros_like(own) if start is None else np.where(quiet, 0.0, start.details["held_back_m"])

    stages = _stages(character, blocks, case.pairs, objective, allowed - held_back, quiet, looks is not None)
    smooth, history, since, easing, on_skin, missed = jerk_scale(base), [], 0, False, None, False
    best = Iterate(np.inf, correction, None, before, held_back, np.inf)

    for round_ in range(ROUNDS):
        problem = _problem(case, stages, smooth, (at_first, probes))
        result = fit(problem, _together(stages, seen), sweeps, correction=correction,
                     progress=_told(progress, round_, sweeps * len(stages)))  # fmt: skip
        if not round_ and start is None:
            result = _from_elsewhere(problem, result, stages)
        correction, history = result.correction, [*history, *result.history]
        whole = case.moved(correction)
        moved = whole[seen.frames]
        probes = probe_depths(everything, moved)
        after = volume_depths(everything, moved, probes)
        used = np.concatenate([s.allowed for s in stages], axis=1)[:, _order(stages)]
        if looks is not None:
            if round_ in CLOSER and not settled:
                looks.look_closer((after - own).max(axis=1))
            on_skin, missed = looks.depths_and_touches(moved), False
            if round_ >= CLOSER[-1] and not checked and (on_skin <= looks.own + TOLERANCE).all():
                # clean where it was looked at: in between it is looked at once
                missed = looks.look_between(moved)
                on_skin, checked = looks.depths_and_touches(moved), not missed
            # what the first looks missed
            woken = quiet & ~looks.quiet(on_skin)
            quiet = quiet & ~woken
            stages = [_wake(s, woken[s.columns], kept[:, s.columns]) for s in stages]
        left = case.left(after, on_skin, quiet)
        jerk = derivative_ratio(whole, base, 3) or 1.0
        faults = max(jerk - MOST_JERK, 0.0) / 0.2 + _amount(left) / TOLERANCE
        found = Iterate(faults, correction, result.problem, after, allowed - used, left.max(initial=0.0))
        # one that was looked at in fewer frames cannot be compared
        if found.better_than(best) or missed or round_ in CLOSER:
            best, since = found, 0
        since += 1
        easing |= found.clean and (settled or round_ >= CLOSER[-1])
        if easing:
            if looks is None or on_skin is None or not looks.ease(on_skin, ALLOWED_EXCESS):
                break
            continue
        if since > PATIENCE:
            break
        if jerk > MOST_JERK:
            smooth *= 0.5
            correction = _calmed(correction)
        if left.max() > ENOUGH * TOLERANCE:
            # the solver sees some probes only, and its corrections are smooth: what they left is taken off
            over = np.where(left > ENOUGH * TOLERANCE, after - used, 0.0)
            stages = [_tighten(s, over[:, s.columns], float(small.dt)) for s in stages]
        if looks is not None and on_skin is not None and round_ > 0:  # what was found in a round counts in the next
            shown = (np.where(quiet, 0.0, on_skin - looks.own) > ENOUGH * TOLERANCE).any(axis=0)
            stages = [_stiffen(s) if shown[s.columns].any() else s for s in stages]
    if looks is not None and (best.left > TOLERANCE or known):
        worth = _worth_it(case, best.correction, stages, first)
        shown = case.moved(worth)[seen.frames]
        depths = volume_depths(everything, shown)
        left = case.left(depths, looks.depths(shown), quiet)
        best = best._replace(correction=worth, depths=depths, left=left.max(initial=0.0))
    final = case.final(best.correction)
    status = "violations_left" if best.left > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in case.pairs], "frames": seen.frames, "excess_before_m": before - own,
               "excess_after_m": best.depths - own, "held_back_m": best.held_back}  # fmt: skip
    return Fit(final, final.apply(base), base, status, tuple(history), best.problem, details)  # pyright: ignore[reportArgumentType]


def _case(
    clip: Motion, character: Character, reference: Character | None, blocks: Sequence[str], objective: str,
    source: Motion,
) -> Case:  # fmt: skip
    base = onto(clip, character.skeleton)
    controls, basis, seen = _controls(character, base, blocks)
    everything = build_clearance(character, pairs_of(*blocks), objective)
    source = source[seen.frames]
    own = reference_depths(source, character, reference, everything.pairs, objective)
    looks = SkinLooks(source, character, reference, everything.pairs) if objective == "vertex" else None
    return Case(character, base, controls, basis, seen, everything, own, looks)


def _beginning(case: Case, start: Fit | None) -> Correction:
    """Control points of the solver's frames to begin with: zero, or those of an earlier result."""
    seen = case.seen
    # a whole clip has no more control points than the bucket that the solver sees
    empty = Correction(seen.controls, tuple(np.zeros(seen.basis.count) for _ in seen.controls))
    if start is None:
        return empty
    _check_start(start, seen, case.pairs)
    # by name: later blocks may have added controls of their own
    points = (np.asarray(start.correction[c.name], float) for c in seen.controls)
    result = Correction(seen.controls, tuple(np.pad(p, (0, seen.basis.count - len(p))) for p in points))
    if case.looks is not None:
        case.looks.depths_and_touches(case.moved(result)[seen.frames])
    return result


def _told(progress: Callable[[str, int, int], None] | None, round_: int, steps: int):
    """The progress of one round of so many steps."""
    if progress is None:
        return None
    return lambda name, done, _: progress(name, round_ * steps + done, ROUNDS * steps)


def _quiet(
    excess: Float[np.ndarray, "frames pairs"], own: Float[np.ndarray, "frames pairs"], pairs: tuple[Pair, ...],
    clear: Bool[np.ndarray, " pairs"] | None,
) -> tuple[Bool[np.ndarray, " pairs"], Float[np.ndarray, "frames pairs"]]:  # fmt: skip
    """The pairs that show no violation, which are left alone, and the depth [m] that may stay in the others. `clear`
    are those that show none on the skin (None: it was not looked at)."""
    most, kept = excess.max(axis=0), own + allowance(excess, ALLOWED_EXCESS, MARGIN)
    quiet = most <= TOLERANCE
    if clear is None:
        return quiet, kept
    # near the shoulder the skin alone knows; but where the arm has to turn anyway, and the fields show a little more
    # than the tolerance, they lose that too
    phantom = clear & ~quiet & np.array([p.first.endswith("upper_arm") for p in pairs])
    quiet = (clear & quiet) | phantom
    arm_of = np.array([p.first.partition("_")[0] if p.block == "arms" else p.block for p in pairs])
    phantom &= (most <= DOUBTED) & np.isin(arm_of, arm_of[~quiet])
    return quiet & ~phantom, np.where(phantom, own + ENOUGH * TOLERANCE - MARGIN, kept)


def _from_elsewhere(problem: Problem, result: Fit, stages: list[Stage]) -> Fit:
    """A first result with the arms that turned far solved again from other `STARTS`; the least cost of each counts."""
    for block in (s.block for s in stages):
        turned = max(float(np.abs(result.correction[name]).max()) for name in block.controls)
        if turned < WIDE or len(block.controls) != len(STARTS[0]):
            continue
        cost = min(h.cost_after for h in result.history if h.name == block.name)
        for angles in STARTS:
            begun = dict(zip(block.controls, angles, strict=True))
            points = tuple(
                np.full(np.shape(p), begun[c.name]) if c.name in begun else p
                for c, p in zip(result.correction.controls, result.correction.points, strict=True)
            )
            again = fit(problem, [block], correction=dataclasses.replace(result.correction, points=points))
            history = (*result.history, *again.history)
            if again.history[-1].cost_after < cost:
                result, cost = again, again.history[-1].cost_after
            result = dataclasses.replace(result, history=history)
    return result


def _worth_it(case: Case, correction: Correction, stages: list[Stage], first: Motion | None) -> Correction:
    """A correction without the blocks that leave their pairs deeper in each other, on the skin, than they were: where
    the fields see what is not there, the clip is better left alone. Of a clip that was adapted from `first` also
    without those that had done their work: what is still there then is what they could not take out."""
    looks = case.looks
    assert looks is not None
    now, was = (looks.depths(m[case.seen.frames]) - looks.own for m in (case.moved(correction), case.base))
    once = was if first is None else looks.depths(first) - looks.own
    names = set()
    for stage in stages:
        is_now, before, at_first = (_amount(excess[:, stage.columns]) for excess in (now, was, once))
        if 0.0 < is_now >= before or (first is not None and before <= DONE * at_first):
            names |= set(stage.block.controls)
    points = tuple(
        np.zeros(np.shape(p)) if c.name in names else p
        for c, p in zip(correction.controls, correction.points, strict=True)
    )
    return dataclasses.replace(correction, points=points)


def _calmed(correction: Correction) -> Correction:
    """Control points smoothed in time, to go on from: where an arm is in deep, neighbouring frames may have found
    opposite ways out, and no smoothness term brings them back over what lies between."""
    points = tuple(gaussian_filter1d(np.asarray(p, float), CALM, mode="nearest") for p in correction.points)
    return dataclasses.replace(correction, points=points)


def _check_start(start: Fit, seen: Seen, pairs: tuple[Pair, ...]) -> None:
    had, controls = start.details.get("pairs"), {c.name for c in start.correction.controls}
    same = had == [p.name for p in pairs] and controls >= {c.name for c in seen.controls}
    if not same or len(start.details["frames"]) != len(seen.frames):
        raise InputError("start= is a fit of another clip, other blocks or another objective; give one of the same clip "
                         "and blocks, or leave it out")  # fmt: skip


def _together(stages: list[Stage], seen: Seen) -> Sequence[Block | tuple[Block, ...]]:
    """The legs do not look at the arms, so they go with the first one. The other arm shares its program, and waits."""
    blocks = [s.block for s in stages]
    legs = tuple(b for b in blocks if b.name == "legs")
    if len(blocks) == 1 or not legs or seen.padded.frame_count >= LONG:
        return blocks
    return [(blocks[0], *legs), *(b for b in blocks[1:] if b not in legs)]


def _amount(over: Float[np.ndarray, "frames pairs"]) -> float:
    """Mean over frames of what goes beyond what a look may show [m]."""
    return float(np.maximum(over - ENOUGH * TOLERANCE, 0.0).max(axis=1).mean())


def _order(stages: list[Stage]) -> Int[np.ndarray, " pairs"]:
    """Where each pair stands among the stages' columns."""
    return np.argsort(np.concatenate([s.columns for s in stages]))


def _controls(character: Character, base: Motion, blocks: Sequence[str]) -> tuple[tuple[Control, ...], Basis, Seen]:
    """The controls of the whole clip, their basis, and the clip as the solver sees it.

    Knots lie on the same instants in both, so the control points are the same.
    """
    at = sampling(base, rate=RATE)
    whole = at.whole
    controls = (*(arm_controls(character, base, whole) if "arms" in blocks else ()),
                *(leg_controls(character, base, whole) if "legs" in blocks else ()))  # fmt: skip

    padded = dataclasses.replace(base[at.rows], dt=np.asarray(at.dt))
    return controls, whole, Seen(at.frames, at.motion(base), padded, at.basis, tuple(at.control(c) for c in controls))


def _stages(
    character: Character, blocks: Sequence[str], pairs: tuple[Pair, ...], objective: str,
    allowed: Float[np.ndarray, "frames pairs"], quiet: Bool[np.ndarray, " pairs"], touching: bool = False,
) -> list[Stage]:  # fmt: skip
    """The blocks of each recipe, in order: left arm, right arm, legs."""
    made = []
    for recipe in blocks:
        if recipe == "arms":
            wanted = [(f"{s}_arm", tuple(f"{s}_arm{k}" for k in ("", "_across", "_twist")),
                       tuple(p for p in pairs if p.block == "arms" and p.first.startswith(s))) for s in SIDES]  # fmt: skip
        else:
            wanted = [("legs", ("hip_turn", "thighs_apart"), tuple(p for p in pairs if p.block == "legs"))]
        for name, controls, mine in wanted:
            clearance = build_clearance(character, mine, objective)
            columns = [pairs.index(p) for p in clearance.pairs]
            # fields see thighs well, and the fold between them, where they touch, opens in no one direction
            touches = (f"{name}_touches",) if touching and recipe == "arms" else ()
            # a foot that stands shall not slide; arms may come and go
            steady = ("steadiness",) if recipe == "legs" else ()
            terms = (f"{name}_clearance", *touches, "effort", "smoothness", *steady)
            block = Block(name, controls, terms, max_steps=24, tolerance=1e-3)
            made.append(Stage(block, clearance, columns, allowed[:, columns], quiet[columns]))
    return made


def _own_sets(everything: Clearance, stage: Stage) -> Bool[np.ndarray, " sets"]:
    """Which sets of probes of all pairs are a stage's: both come in the order of their pairs."""
    return np.isin(everything.pair_of_row, stage.columns)


def _problem(
    case: Case, stages: list[Stage], smooth: float, probes: tuple[Float[np.ndarray, "frames sets points"] | None, ...]
) -> Problem:
    """The terms of all stages; `probes` are the depths of all, by which those that matter are chosen."""
    seen, everything, looks = case.seen, case.everything, case.looks
    real, length = seen.motion.frame_count, seen.padded.frame_count
    terms: dict[str, Term] = {}
    weights: dict[str, float] = {}
    scores = np.zeros((0, 0))
    if everything.part_of_set:
        allowed = np.concatenate([s.allowed for s in stages], axis=1)[:, _order(stages)]
        scores = np.sum([support(everything, depth, allowed) for depth in probes], axis=0)
    for stage in stages:
        # however much the skin shows: a part that is LEAST_GAP away from the other's field is pushed no further
        limit = np.maximum(stage.allowed, -LEAST_GAP)
        limit = np.where(stage.quiet, stage.allowed, smooth_floor(limit, float(seen.motion.dt)))
        # the frames that only fill the bucket cost nothing
        limit = np.concatenate([limit, np.full((length - real, limit.shape[1]), 1e3)])
        name = f"{stage.block.name}_clearance"
        if stage.clearance.part_of_set:
            terms[name] = reduced(stage.clearance, scores[_own_sets(everything, stage)], limit, SOLVE_PROBES)  # pyright: ignore[reportArgumentType]
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


def _wake(stage: Stage, woken: Bool[np.ndarray, " pairs"], kept: Float[np.ndarray, "frames pairs"]) -> Stage:
    """The stage with some pairs no longer left alone."""
    return stage._replace(quiet=stage.quiet & ~woken, allowed=np.where(woken, kept, stage.allowed))


def _stiffen(stage: Stage) -> Stage:
    """What the skin still shows counts more: a fold may yield to nothing less, and a field that says otherwise."""
    return stage._replace(stiffness=min(STIFFER * stage.stiffness, STIFFEST))


def smooth_floor(limit: Float[np.ndarray, "frames pairs"], dt: float) -> Float[np.ndarray, "frames pairs"]:
    """The limit without its jumps, nowhere above it by much: what a spline can follow without a jerk."""
    width = max(1, round(0.05 / dt))
    return gaussian_filter1d(minimum_filter1d(limit, 2 * width + 1, axis=0), width, axis=0, mode="nearest")


def _tighten(stage: Stage, left: Float[np.ndarray, "frames pairs"], dt: float) -> Stage:
    """Less may stay where the solve left more [m] than it was allowed: per pair, around the frames that show it."""
    more = np.where(left > 0.001, left, 0.0)
    # wide enough for a spline to follow, and nowhere less than what the frame itself needs
    width = max(1, round(0.1 / dt))
    more = gaussian_filter1d(maximum_filter1d(more, 2 * width + 1, axis=0), width / 2, axis=0, mode="nearest")
    return stage._replace(allowed=stage.allowed - np.minimum(1.3 * more, 0.02))
