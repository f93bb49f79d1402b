"""The blocks that take arms and legs out of what they sink into: thesis 4.4 and 4.5."""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._fit import Fit, fit
from motionfit._motion import Motion
from motionfit._onto import onto
from motionfit._problem import Problem
from motionfit._types import InputError
from motionfit.adapt._clearance import allowance, build_clearance, probe_depths, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.adapt._limits import ENOUGH, MOST_JERK, NEARLY, SkinLooks, reference_depths, unborne
from motionfit.adapt._sampling import sampling
from motionfit.adapt._stages import (
    ALLOWED_EXCESS,
    SIGMA_EFFORT,
    Case,
    Seen,
    Stage,
    in_order,
    jerk_scale,
    problem_of,
    stages_of,
    stiffen,
    tighten,
    together,
    wake,
)
from motionfit.metrics import TOLERANCE, derivative_ratio
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import Basis

LIMBS = ("arms", "legs")

RATE = 30.0  # [1/s] of the frames that the solver sees: three for every knot
MARGIN = 0.001  # [m]
DOUBTFUL = 0.003  # [m] between two looks, where there may be a centimetre
FAINT = 0.015  # [m] of a phantom that is lost along with what is there, and left on the volumes under the tolerance
DOUBTED = 0.02  # [m] on the fields of a shoulder that shows nothing on the skin
CALM = 2.0  # knots over which a correction that is too jerky is smoothed before it is solved again
WIDE = np.deg2rad(45.0)  # a turn that makes one look for a shorter way out
# out, out and across: where an arm lies deep in a trunk or before it, each way out has a valley of its own
STARTS = tuple(np.deg2rad(s) for s in ((30.0, 0.0, 0.0), (30.0, 30.0, 30.0), (30.0, -30.0, -30.0)))
ROUNDS, PATIENCE = 9, 2  # rounds at most, and rounds without a better result
LONGER, MANY_FAULTS = 15, 0.01  # rounds at most of a result that still gets better and has more faults than that
FEW_FAULTS = 0.005
DONE = 0.5  # of what the source shows on a body: what a block leaves at most that has done its work
LESS = 0.8  # of the mean square of all turns: a tenth of the turns themselves
CLOSER = (0, 1)  # rounds after which more frames are looked at


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
    clear, phantom = None, np.zeros_like(own)
    if looks is not None:
        at_start = looks.depths(small)
        clear, phantom = looks.quiet(at_start), unborne(before - own, at_start - looks.own, looks.at)
    quiet, kept, phantom = _quiet(before - own, own, case.pairs, clear, phantom)
    settled = checked = known and bool(quiet.all())  # and what is settled was looked at closely then
    correction = _beginning(case, start)
    allowed = np.where(quiet, np.maximum(before, own), kept)
    held_back = np.zeros_like(own) if start is None else np.where(quiet, 0.0, start.details["held_back_m"])

    stages = stages_of(character, blocks, case.pairs, objective, allowed - held_back, quiet, phantom, looks is not None)
    smooth, history, since, easing, on_skin, missed = jerk_scale(base), [], 0, False, None, False
    best = Iterate(np.inf, correction, None, before, held_back, np.inf)

    for round_ in range(LONGER):
        problem = problem_of(case, stages, smooth, (at_first, probes))
        result = fit(problem, together(stages, seen), sweeps, correction=correction,
                     progress=_told(progress, round_, sweeps * len(stages)))  # fmt: skip
        if not round_ and start is None:
            result = _from_elsewhere(problem, result, stages)
        correction, history = result.correction, [*history, *result.history]
        whole = case.moved(correction)
        moved = whole[seen.frames]
        probes = probe_depths(everything, moved)
        after = volume_depths(everything, moved, probes)
        used = in_order(stages, [s.allowed for s in stages])
        if looks is not None:
            if round_ in CLOSER and not settled:
                looks.look_closer((after - own).max(axis=1))
            on_skin, missed = looks.depths_and_touches(moved), False
            clean = bool((on_skin <= looks.own + TOLERANCE).all())
            most = ROUNDS if best.faults < MANY_FAULTS else LONGER
            late = since >= PATIENCE or round_ >= most - 1 - PATIENCE
            if round_ >= CLOSER[-1] and (easing or not checked) and (clean or (late and not checked)):
                # clean where it was looked at, or as clean as it gets: in between it is looked at once, and again where
                # more may show since
                near = case.left(after, on_skin, quiet).max(axis=1) > DOUBTFUL
                missed = looks.look_between(moved, near, None if checked else 1)
                on_skin, checked = looks.depths_and_touches(moved), checked or not missed
            # what the first looks missed
            woken = quiet & ~looks.quiet(on_skin)
            quiet = quiet & ~woken
            stages = [wake(s, woken[s.columns], kept[:, s.columns]) for s in stages]
        left = case.left(after, on_skin, quiet)
        jerk = derivative_ratio(whole, base, 3) or 1.0
        faults = max(jerk - MOST_JERK, 0.0) / 0.2 + _amount(left) / TOLERANCE
        found = Iterate(faults, correction, result.problem, after, allowed - used, left.max(initial=0.0))
        # one that was looked at in fewer frames cannot be compared
        if found.better_than(best) or missed or round_ in CLOSER:
            best, since = found, 0
        since += 1
        easing = (easing and not missed) or (found.clean and (settled or round_ >= CLOSER[-1]))
        if easing:
            if looks is None or on_skin is None or not looks.ease(on_skin, ALLOWED_EXCESS):
                break
            continue
        if since > PATIENCE or (round_ >= ROUNDS - 1 and (checked or looks is None) and best.faults < MANY_FAULTS):
            break
        if jerk > MOST_JERK:
            smooth *= 0.5
            correction = _calmed(correction)
        stages = _pressed(case, stages, after, left)
        if looks is not None and on_skin is not None and round_ > 0:  # what was found in a round counts in the next
            shown = np.max(np.where(quiet, 0.0, on_skin - looks.own), axis=0, initial=0.0) > ENOUGH * TOLERANCE
            stages = [stiffen(s) if shown[s.columns].any() else s for s in stages]
    correction, depths, most_left = best.correction, best.depths, best.left
    if looks is not None and (best.left > TOLERANCE or known):
        correction = _worth_it(case, best.correction, stages, first)
        depths = volume_depths(everything, case.moved(correction)[seen.frames])
    final, result = case.final(correction), case.moved(correction)
    if looks is not None:  # where the fields say that there is something, the skin is asked
        moved = result[seen.frames]
        doubtful = case.left(depths, looks.depths(moved), quiet).max(axis=1, initial=0.0) > TOLERANCE
        most_left = looks.most_seen(moved, doubtful)
    status = "violations_left" if most_left > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in case.pairs], "frames": seen.frames, "excess_before_m": before - own,
               "excess_after_m": depths - own, "held_back_m": best.held_back}  # fmt: skip
    return Fit(final, result, base, status, tuple(history), best.problem, details)  # pyright: ignore[reportArgumentType]


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
    return lambda name, done, _: progress(name, min(round_ * steps + done, ROUNDS * steps), ROUNDS * steps)


def _quiet(
    excess: Float[np.ndarray, "frames pairs"], own: Float[np.ndarray, "frames pairs"], pairs: tuple[Pair, ...],
    clear: Bool[np.ndarray, " pairs"] | None, phantom: Float[np.ndarray, "frames pairs"],
) -> tuple[Bool[np.ndarray, " pairs"], Float[np.ndarray, "frames pairs"], Float[np.ndarray, "frames pairs"]]:  # fmt: skip
    """The pairs that show no violation, which are left alone, and the depth [m] that may stay in the others, without
    what is `phantom`, and that [m]. `clear` are those that show none on the skin (None: it was not looked at)."""
    most, kept = excess.max(axis=0), own + allowance(excess, ALLOWED_EXCESS, MARGIN)
    quiet = most <= TOLERANCE
    if clear is None:
        return quiet, kept, phantom
    # near the shoulder the skin alone knows; but where the arm has to turn anyway, and the fields show a little more
    # than the tolerance, they lose that too
    lone = clear & ~quiet & np.array([p.first.endswith("upper_arm") for p in pairs])
    quiet = (clear & quiet) | lone
    arm_of = np.array([p.first.partition("_")[0] if p.block == "arms" else p.block for p in pairs])
    lone &= (most <= DOUBTED) & np.isin(arm_of, arm_of[~quiet])
    faint = phantom.max(axis=0) <= FAINT
    phantom = np.where(faint, np.minimum(phantom, ENOUGH * TOLERANCE - MARGIN - ALLOWED_EXCESS), phantom)
    return quiet & ~lone, np.where(lone, own + ENOUGH * TOLERANCE - MARGIN, kept), np.where(lone, 0.0, phantom)


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


def _pressed(
    case: Case, stages: list[Stage], after: Float[np.ndarray, "frames pairs"], left: Float[np.ndarray, "frames pairs"]
) -> list[Stage]:
    """The stages with less allowed where much is `left` [m]: the solver sees some probes only, and its corrections are
    smooth, so what the depths `after` it [m] go beyond what it was allowed is taken off."""
    over = after - in_order(stages, [s.allowed + s.phantom for s in stages])
    # no rows of the solve know what the skin shows between legs; as little as need be, since a stance widens for it
    legs = np.array([p.block == "legs" for p in case.pairs]) & (left > NEARLY * TOLERANCE)
    over = np.where(legs, np.maximum(over, (left - NEARLY * TOLERANCE / 2) / 2), over)
    over = np.where(left > ENOUGH * TOLERANCE, over, 0.0)
    return [tighten(s, over[:, s.columns], float(case.seen.motion.dt)) for s in stages]


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


def _amount(over: Float[np.ndarray, "frames pairs"]) -> float:
    """Mean over frames of what goes beyond what a look may show [m]."""
    return float(np.maximum(over - ENOUGH * TOLERANCE, 0.0).max(axis=1).mean())


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
