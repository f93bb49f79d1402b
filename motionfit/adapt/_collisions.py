"""General collisions, by groups that are data: thesis 4.6.

The arm and leg blocks take out what a shape makes of a motion. What is left comes from the movement itself, for a
moment: a hand at the head, on the other arm, across the belly. And where a hand touches on purpose, it goes on touching.
"""

import dataclasses
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import BlockReport, Fit, fit
from motionfit._motion import Motion, joint_angles
from motionfit._onto import onto
from motionfit._problem import During, Problem
from motionfit._skeleton import SIDES
from motionfit._solve import Block
from motionfit.adapt._asked import EVERY, NEAR, Asked, Wrong, cut, skin_gaps_near
from motionfit.adapt._clearance import all_rows, build_clearance
from motionfit.adapt._controls import turn_controls
from motionfit.adapt._easing import ROUGHER, between, eased, rougher, sinking_skin
from motionfit.adapt._groups import GROUPS, Group, Known, Meetings, known_depths
from motionfit.adapt._limits import NEARLY, SkinLooks
from motionfit.adapt._record import on_top, put_down
from motionfit.adapt._sampling import sampling
from motionfit.adapt._stages import jerk_scale
from motionfit.adapt._touches import hold_term
from motionfit.metrics import TOLERANCE, skin_gaps
from motionfit.shape.pairs import Pair
from motionfit.terms.penetration import TouchHold
from motionfit.terms.pose import Effort, Smoothness

ALLOWED_EXCESS = 0.004  # [m] that may stay where more was
ROOM = 0.001  # [m] on the skin for what shows as much as it may
TOUCH = 0.02  # [m] from the surface: what counts as a touch on fields, and what a touch may come to
TOUCHED = 0.01  # [m] on the reference's skin, which knows better
TOUCH_AIM = 0.012  # [m] a touch is brought back to
HELD = 0.016  # [m] a solve is content with: where an arm then sinks in, a touch gives way a little
EASE = 0.08  # [s] within which a touch is taken up and let go
BESIDE_TOUCH = 0.24  # [s] around a look at a touch, in which it stands for it
EFFORT = 1.0  # [rad]
ROUNDS, PATIENCE = 12, 3  # rounds at most, and without a better result
BETTER = 0.9  # of the best result so far, at most
TOO_ROUGH = 0.2  # of the jerk's ratio, which counts as much as a touch lost in all frames
CALMER = 0.5  # of the jerk that a correction may have, where it was too rough to be taken: one too calm holds no touch
ASUNDER = 0.1  # [m] beyond a touch, from which on one that is lost counts as much as a violation
TRIAL, WELL = 2, 0.05  # rounds after which two starts are compared, and the faults below which there is no need to
CLOSER = (0, 1, 2)  # rounds after which more frames are looked at
MOST_MORE = 0.03  # [m] that a solve is asked for more, after all rounds
STIFFER = 4.0  # weight of what the skin shows, against the touches that pull the other way
BESIDE, TAKEN_UP = 0.6, 0.3  # [s] around what is wrong: what is solved, and of it what a correction is taken up in
WIDENED = 2  # times that such a run gets longer by BESIDE at both ends
MUCH = 0.7  # of a clip, from which on it is solved as a whole
WITHIN = 0.98  # of a control's bounds: where the points of a round begin
ARM = ("clavicle", "upper_arm", "forearm", "hand")
MEANT = tuple(Pair(f"{side}_hand", part, "arms") for side, other in (SIDES, SIDES[::-1])
              for part in ("head", f"{other}_upper_arm", f"{other}_forearm", f"{other}_hand"))  # fmt: skip


def collisions(
    clip: Motion, character: Character, so_far: Fit, *, reference: Character | None = None,
    groups: Sequence[Group] = GROUPS, worth: Sequence[Pair] | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Fit:  # fmt: skip
    """Take the groups' probes out of what they shall avoid, as far as they are deeper in than on `reference`.

    Where a hand touched on the reference (within 1 cm, on the skin), it is brought back to within 2 cm of the surface,
    as far as nothing sinks in for it: where the skins are nearest to each other, round by round. Without a reference,
    what the character shows with the clip before any correction may stay and touches, by the fields. What the arm and
    leg blocks reached is not undone: their pairs are in the tables, and what their skins show more than on the reference
    (without one: than so far) becomes rows of the solve, as in `motionfit.adapt.limbs`.
    Where touches were lost, and two rounds do not bring them back, arms without any correction are another start: from
    where the arm block led them, to either side of a heavy trunk, hands may not find together again.

    Only the frames around what is wrong are solved, run by run, unless they are most of the clip. A touch that is lost
    is wrong if it is of one of the pairs that are `worth` it (None: all); others are kept where frames are solved.

    `progress(done, most)` is called after each round. `details["collisions"]` holds per pair the greatest excess [m]
    before and after, and the share of the touched frames that still touch.
    """
    result, told, together = so_far, {}, _together(groups)
    for k, some in enumerate(together):

        def tell(share: float, k: int = k) -> None:
            if progress is not None:
                progress(round(100 * (k + share) / len(together)), 100)

        result, more = _solve(clip, character, result, reference, some, worth, tell)
        told |= more
    return dataclasses.replace(result, details={**so_far.details, "collisions": told})


def _together(groups: Sequence[Group]) -> list[list[Group]]:
    found: dict[tuple, list[Group]] = {}
    for group in groups:
        found.setdefault((group.turns, group.spacing), []).append(group)
    return list(found.values())


def _solve(
    clip: Motion, character: Character, so_far: Fit, reference: Character | None, groups: list[Group],
    worth: Sequence[Pair] | None, tell: Callable[[float], None],
) -> tuple[Fit, dict]:  # fmt: skip
    motion, known, spacing = so_far.motion, known_depths(character, groups), groups[0].spacing / 60.0
    at = sampling(motion, spacing)
    small, pairs = at.motion(motion), known.clearance.pairs
    if reference is None:
        own, touching = _shown(known, at.motion(so_far.base), None)
    else:
        own, touching = _shown(known_depths(reference, groups), at.motion(onto(clip, reference.skeleton)), reference)
    before, limit = known.depths(small), np.maximum(own, 0.0)
    # what meets at a joint goes no deeper than it is: on the skin, where that is looked at
    inner = np.array([p.adjacent for p in pairs])
    most = np.where(inner, np.inf, limit)
    allowed = np.where(inner, np.minimum(most, 1e3), limit + ALLOWED_EXCESS)
    asked = Asked(character, so_far, at, known, groups[0].turns, own, allowed, np.maximum(most, limit), touching,
                  reference is not None)  # fmt: skip
    gap_before = asked.gaps(small, before)
    apart, worst = np.where(touching, gap_before - TOUCH, 0.0), np.where(inner, 0.0, before - limit)
    asked_for = np.array([worth is None or p[:2] in {w[:2] for w in worth} for p in pairs])
    somewhere = np.maximum(worst - TOLERANCE, np.where(asked_for, apart, 0.0)).max(axis=1) > 0.0
    wrong = Wrong(clip, reference, worst, apart, somewhere)
    if so_far.status == "violations_left":
        somewhere[wrong.on_skin(asked, small)] = True
    result, history, left = _run_by_run(asked, wrong, spacing, tell)
    moved = at.motion(result.motion)
    after = known.depths(moved)
    told = _told(pairs, before - limit, after - limit, gap_before, asked.gaps(moved, after), touching)
    left = left or wrong.shown(asked, moved, np.where(inner, 0.0, after - limit) > TOLERANCE)
    status = "violations_left" if left else so_far.status
    if not left and status == "violations_left" and "balance" not in so_far.details:
        # what the arm and leg blocks had left may be gone
        looks = wrong.looks(asked, slice(None))
        looks.look_between(moved)
        status = "violations_left" if looks.most_seen(moved) > TOLERANCE else "converged"
    return dataclasses.replace(result, history=(*so_far.history, *history), status=status), told


class Outcome(NamedTuple):
    """What the solves of a window found (None: nothing better), whether its skin shows too much, and what they did."""

    fit: Fit | None
    shows: bool
    history: tuple[BlockReport, ...]


def _run_by_run(
    asked: Asked, wrong: Wrong, spacing: float, tell: Callable[[float], None]
) -> tuple[Fit, tuple[BlockReport, ...], bool]:
    """The fit with each run of frames solved in which something is wrong, what the solves did, and whether the skin of
    what is taken of them shows too much. Where an arm sinks in on its way from one motion to the other and back, the
    run gets longer, and in the end it is let be."""
    beside, seen = round(BESIDE / asked.at.dt), len(wrong.somewhere)
    windows, rounds = _windows(wrong.somewhere, beside), 0
    solved: dict[tuple[int, int], Outcome] = {}

    def told_round() -> None:
        nonlocal rounds
        rounds += 1
        tell(min(rounds / (ROUNDS * len(windows)), 1.0))

    def put_in(some: list[slice]) -> tuple[Fit, list[slice], list[slice]]:
        """The fit with what was found in some windows, those in which anything was, and those whose ends sink in."""
        found = {(w.start, w.stop): part for w in some if (part := solved[w.start, w.stop].fit) is not None}
        some = [w for w in some if (w.start, w.stop) in found]
        result = _put_in(asked, list(found.values()), some)
        return result, some, [w for w in some if _ends_sink(asked, wrong, result, w)]

    for widened in range(WIDENED + 1):
        if sum(w.stop - w.start for w in windows) > MUCH * seen:
            windows = [slice(0, seen)]
        least = max((w.stop - w.start for w in windows), default=0)
        for w in windows:
            if (w.start, w.stop) not in solved:
                faults = _faults(wrong.worst[w], wrong.apart[w])
                part, lost = asked.part(w, spacing, least), bool((wrong.apart[w] > 0.0).any())
                solved[w.start, w.stop] = _best(part, faults, lost, wrong.looks(asked, w), told_round)
        result, taken, sinking = put_in(windows)
        if not sinking:
            break
        if widened == WIDENED:
            result, taken, _ = put_in([w for w in taken if w not in sinking])
            break
        around = np.zeros(seen, bool)
        for w in windows:
            more = beside if w in sinking else 0
            around[max(w.start - more, 0) : w.stop + more] = True
        windows = _windows(around, 0)
    history = tuple(report for one in solved.values() for report in one.history)
    return result, history, any(solved[w.start, w.stop].shows for w in taken)


def _ends_sink(asked: Asked, wrong: Wrong, result: Fit, seen: slice) -> bool:
    """Whether anything sinks in where a window's motion is taken up or let go."""
    ends, length = round(TAKEN_UP / asked.at.dt) + 1, len(asked.at.frames)
    first = np.arange(seen.start, min(seen.start + ends, seen.stop) if seen.start > 0 else seen.start)
    last = np.arange(max(seen.stop - ends, seen.start) if seen.stop < length else seen.stop, seen.stop)
    some = np.union1d(first, last)
    if len(some) == 0:
        return False
    before, after = (asked.at.motion(fit.motion)[some] for fit in (asked.so_far, result))
    was, now = (asked.known.depths(m) - asked.most[some] for m in (before, after))
    if (now > np.maximum(was + ROOM, TOLERANCE)).any():
        return True
    looks = wrong.looks(asked, some)
    may = np.maximum(looks.depths(before) - looks.own + ROOM, TOLERANCE)
    return bool((looks.depths(after) - looks.own > may).any())


def _windows(wrong: Bool[np.ndarray, " seen"], beside: int) -> list[slice]:
    """The frames in which something is wrong and those beside them, run by run."""
    around = maximum_filter1d(wrong, 2 * beside + 1)
    ends = np.flatnonzero(np.diff(np.pad(around.astype(int), 1)))
    # the skin is asked in each third frame
    return [slice(int(low) - int(low) % EVERY, int(high)) for low, high in zip(ends[::2], ends[1::2], strict=True)]


def _best(
    asked: Asked, faults: float, lost: bool, looks: SkinLooks, tell: Callable[[], None]
) -> Outcome:  # fmt: skip
    """The best fit that some rounds find. What makes matters worse is let be, as is a touch that cannot be had without
    sinking in elsewhere."""
    starts = [Attempt(asked, asked.so_far, looks)]
    starts[0].go_on(TRIAL, tell)
    if not starts[0].done and starts[0].prospect > WELL and lost:
        # arms that were led out to either side of a trunk may not find together again from there
        starts.append(Attempt(asked, without_arms(asked.so_far), looks.anew()))
        starts[1].go_on(TRIAL, tell)
    for best in sorted(starts, key=lambda attempt: attempt.prospect):
        best.go_on(ROUNDS, tell)
        if best.look_between():
            best.go_on(best.rounds + PATIENCE, tell)
        if best.result is not None and best.faults < faults:
            break
    else:
        return Outcome(None, False, best.history)
    result, shown = best.result, best.judged(best.result)
    sunk = sinking_skin(best.looks, asked.small, asked.at)
    less = eased("collisions_eased", asked.so_far, result, asked.at, sunk)
    if less is not result:
        # single frames that sink in are not worth a touch that lasts
        shown, result = min((best.judged(less), less), (shown, result), key=lambda tried: tried[0].faults)
    return Outcome(result, bool(shown.on_skin.max() > (1.0 - NEARLY) * TOLERANCE), best.history)


def _put_in(asked: Asked, parts: list[Fit], windows: list[slice]) -> Fit:
    """The fit with other motions in some windows of the frames that are seen, taken up and let go at their ends."""
    so_far, at = asked.so_far, asked.at
    if windows == [slice(0, len(at.frames))]:
        return parts[0]
    whole, joints = np.array(so_far.motion.rotations, float), set()
    fade = TAKEN_UP / float(so_far.motion.dt)
    for part, seen in zip(parts, windows, strict=True):
        start, frames = int(at.frames[seen.start]), part.motion.frame_count
        at_start, at_end = start == 0, start + frames == len(whole)
        way = np.arange(frames) / fade
        share = np.minimum(np.inf if at_start else way, np.inf if at_end else way[::-1]) * np.ones(frames)
        share = np.clip(share, 0.0, 1.0)
        own = whole[start : start + frames]
        mine = between("taken_up", cut(so_far, np.arange(start, start + frames)), part, share**2 * (3.0 - 2.0 * share))
        rotations = np.asarray(mine.motion.rotations, float)
        joints |= set(np.flatnonzero((own != rotations).any(axis=(0, 2))).tolist())
        whole[start : start + frames] = rotations
    motion = dataclasses.replace(so_far.motion, rotations=whole)
    return put_down("collisions", so_far, motion, so_far.base, so_far.correction, sorted(joints)) if joints else so_far


class Shown(NamedTuple):
    """What a motion shows, in metres; positive is too much of it in the last three."""

    probes: Float[np.ndarray, "frames rows points"]
    depths: Float[np.ndarray, "frames rows"]
    gap: Float[np.ndarray, "frames rows"]
    over: Float[np.ndarray, "frames rows"]
    apart: Float[np.ndarray, "frames rows"]
    on_skin: Float[np.ndarray, "looks pairs"]
    shares: Float[np.ndarray, " looks"]  # of the frames, that each look stands for

    @property
    def faults(self) -> float:
        return _faults(self.over, self.apart, float(self.shares @ (self.on_skin > 0.0).any(axis=1)))


class Attempt:
    """Rounds of solves from one start: of what one of them leaves, the next is asked for more."""

    def __init__(self, asked: Asked, start: Fit, looks: SkinLooks):
        self.asked, self.start, self.looks = asked, start, looks
        self.result: Fit | None = None  # the best so far
        self.faults, self.shown = np.inf, []  # the least so far, and those of each round that can be compared
        # the faults of the last round, but for those of the skin, which take more rounds to learn
        self.prospect = np.inf
        self.done, self.rounds = False, 0
        self.history: tuple[BlockReport, ...] = ()
        motion, at, known = start.motion, asked.at, asked.known
        self.seen = dataclasses.replace(motion[at.rows], dt=np.asarray(at.dt))
        self.controls = turn_controls(motion, at.whole, asked.turns)
        self.points = self.best_points = Correction.zero(tuple(at.control(c) for c in self.controls))
        self.smooth = jerk_scale(motion)
        self.weight = _weights(asked.touching, at.dt)
        probes = known.probe_depths(at.motion(motion))
        depths = known.rows(probes)
        self.meetings = Meetings(known, at)
        self.meetings.seen(probes, np.maximum(asked.own, 0.0), np.maximum(depths, asked.own) - asked.allowed)
        # what the fields are off by at a touch is taken off the wish
        self.off = np.where(asked.touching, asked.gaps(at.motion(motion), depths) + depths, 0.0)
        self.allowed, self.gap = asked.allowed, np.full(asked.own.shape, TOUCH_AIM)

    def go_on(self, rounds: int, tell: Callable[[], None]) -> None:
        """Up to that many rounds in all, as long as they are of use."""
        while not self.done and self.rounds < rounds and not self._stale():
            self._round()
            tell()

    def _stale(self) -> bool:
        late, before = self.shown[-PATIENCE:], self.shown[:-PATIENCE]
        return bool(before) and min(late) >= BETTER * min(before)

    def look_between(self) -> bool:
        """Look at the best result in every second frame. Where more shows there, the rounds go on from it, and it is
        judged by what was seen."""
        if self.result is None or not self.looks.look_between(self.asked.at.motion(self.result.motion)):
            return False
        self.points = self.best_points
        self.faults = self.judged(self.result).faults
        self.shown, self.done = [self.faults], False
        return True

    def _round(self) -> None:
        result, history = self._solved()
        self.history += history
        if self.rounds in CLOSER:
            # what was looked at in fewer frames cannot be compared
            self.result, self.faults, self.shown = None, np.inf, []
            moved = self.asked.at.motion(result.motion)
            self.looks.look_closer(joint_angles(moved, self.asked.small).max(axis=1))
        shown, rough = self.judged(result), rougher(result, self.asked.so_far)
        self.off = np.where(self.asked.touching, shown.gap + shown.depths, 0.0)
        self.prospect = _faults(shown.over, shown.apart) + max(rough - ROUGHER, 0.0) / TOO_ROUGH
        if rough <= ROUGHER:
            self.shown.append(shown.faults)
            if shown.faults <= self.faults:  # of equals the one that was asked for more
                self.faults, self.result, self.best_points = shown.faults, result, self.points
        over, apart = shown.over, shown.apart
        self.done = max(over.max() - 0.7 * TOLERANCE, apart.max(), shown.on_skin.max(), rough) <= 0.0
        self.done |= self.faults == 0.0 and self.rounds >= CLOSER[-1]
        if rough > ROUGHER:
            self.smooth *= CALMER
        allowed = self.allowed - np.where(over > 0.7 * TOLERANCE, np.minimum(over, 0.02), 0.0)
        gap = self.gap - np.where(apart > 0.0, np.minimum(apart + 0.003, 0.02), 0.0)
        # what cannot be had, such as two that pull against each other, is not asked for ever more
        self.allowed = np.maximum(allowed, self.asked.allowed - MOST_MORE)
        self.gap = np.maximum(gap, TOUCH_AIM - MOST_MORE)
        self.meetings.seen(shown.probes, np.maximum(self.asked.own, 0.0), shown.depths - self.asked.allowed)
        self.rounds += 1

    def judged(self, result: Fit) -> "Shown":
        asked, moved = self.asked, self.asked.at.motion(result.motion)
        probes = asked.known.probe_depths(moved)
        depths = asked.known.rows(probes)
        gap, own = asked.gaps(moved, depths), self.looks.own
        may = np.maximum(self.looks.depths(asked.small) - own + ROOM, NEARLY * TOLERANCE)
        on_skin = self.looks.depths_and_touches(moved) - own - may
        over = np.where(asked.touching, np.minimum(-gap, depths), depths) - asked.most  # a touch is judged by the skin
        return Shown(probes, depths, gap, over, np.where(asked.touching, gap - HELD, 0.0), on_skin, self.looks.shares)

    def _hold(self) -> tuple[TouchHold, Float[np.ndarray, "frames rows"]]:
        """What holds the touches where the skins are nearest to each other by now, and the weights of those that are left
        to the fields, which are off by centimetres at a shoulder: where the skin was not asked."""
        asked, at = self.asked, self.asked.at
        now = at.motion(on_top(self.start, Correction(self.controls, self.points.points), at).motion)
        touches, frames = asked.touches(now, asked.known.depths(now))
        hold, held = hold_term(asked.character, touches, frames, round(BESIDE_TOUCH / at.dt), self.gap, self.weight,
                               len(at.rows))  # fmt: skip
        return hold, np.where(held, 0.0, self.weight)

    def _solved(self) -> tuple[Fit, tuple]:
        at = self.asked.at
        rows = np.arange(len(at.rows))
        hold, weight = self._hold()
        may = 0.0 if self.asked.by_skin else self.looks.depths(self.asked.small)
        allowed = self.allowed + _seen_too_near(self.off, at.dt)
        terms = {"collisions": self.meetings.term(allowed, self.gap - self.off, weight),
                 "touches": hold,
                 "effort": During(Effort(EFFORT), (rows < len(at.frames)).astype(float)),
                 "smoothness": During(Smoothness(self.smooth), (rows < len(at.frames) - 2).astype(float)),
                 "skin": self.looks.touch_term(np.arange(len(self.looks.pairs)), ALLOWED_EXCESS, len(at.rows), may)}  # fmt: skip
        problem = Problem(self.asked.character, self.seen, terms, self.points.controls, {"skin": STIFFER})
        block = Block("collisions", tuple(c.name for c in self.controls), max_steps=24, tolerance=1e-3)
        solved = fit(problem, (block,), correction=self.points)
        # a point beyond its bound would stay there: no row changes with it
        inside = (np.clip(np.asarray(p), WITHIN * float(c.lower), WITHIN * float(c.upper))
                  for c, p in zip(self.controls, solved.correction.points, strict=True))  # fmt: skip
        self.points = dataclasses.replace(solved.correction, points=tuple(inside))
        return on_top(self.start, Correction(self.controls, self.points.points), at), solved.history


def _weights(touching: Bool[np.ndarray, "frames rows"], dt: float) -> Float[np.ndarray, "frames rows"]:
    """Of the wish for a touch: 1 to its last frame, and fading in those around it, where the hand is on its way."""
    around = maximum_filter1d(touching.astype(float), 3, axis=0)
    return np.maximum(gaussian_filter1d(around, EASE / dt, axis=0), touching)


def _seen_too_near(off: Float[np.ndarray, "frames rows"], dt: float) -> Float[np.ndarray, "frames rows"]:
    """How much deeper [m] fields may show what touches, that are `off` by so much: one that sees a touch where the skin
    has a gap would keep it. In the frames around too, since what may stay is smoothed."""
    return maximum_filter1d(np.maximum(off, 0.0), 2 * round(EASE / dt) + 1, axis=0)


def hands_meet(clip: Motion, body: Character) -> bool:
    """Whether a hand of the clip touches the head, the other arm or the other hand on the body that it was made for."""
    played = onto(clip, body.skeleton)
    small = played[sampling(played).frames[::EVERY]]
    near = all_rows(build_clearance(body, MEANT, "capsule").term, small) > -NEAR
    gaps = skin_gaps(body, small, MEANT, near)
    return bool((gaps[near] < TOUCHED).any())


def without_arms(fit: Fit) -> Fit:
    """The fit with its arms as they were before any correction."""
    skeleton = fit.motion.skeleton
    arms = {skeleton.find(f"{side}_{part}") for side in SIDES for part in ARM}
    points = tuple(np.zeros_like(p) if arms.issuperset(int(d.joint) for d in c.drives) else p
                   for c, p in zip(fit.correction.controls, fit.correction.points, strict=True))  # fmt: skip
    bare = Correction(fit.correction.controls, points)
    motion = dataclasses.replace(bare.apply(fit.base), source=fit.motion.source)
    return dataclasses.replace(fit, correction=bare, motion=motion)


def _shown(
    known: Known, motion: Motion, body: Character | None
) -> tuple[Float[np.ndarray, "frames rows"], Bool[np.ndarray, "frames rows"]]:
    """The depths [m] that a clip shows where it comes from, and where a hand touches there: on the skin of the `body`
    that it was made for, else on the fields."""
    own, pairs = known.depths(motion), known.clearance.pairs
    hands = np.array([p.first.endswith("hand") for p in pairs])
    if body is None:
        return own, hands & (own > -TOUCH)
    return own, hands & (skin_gaps_near(body, motion, pairs, -own, known.on_skin) < TOUCHED)


def _faults(
    over: Float[np.ndarray, "frames rows"], apart: Float[np.ndarray, "frames rows"],
    sunk: float = 0.0,
) -> float:  # fmt: skip
    """Share of the frames that show a violation, on the fields or as `sunk` says on the skin, and of those that lost a
    touch, which counts half as much where it is lost by little: what a solve is judged by."""
    shown = (over > TOLERANCE).any(axis=1).mean() + sunk
    lost = np.where(apart > 0.0, 1.0 + np.minimum(apart / ASUNDER, 1.0), 0.0)
    return 2.0 * float(shown) + float(lost.mean(axis=0).sum())


def _told(pairs, excess_before, excess_after, gap_before, gap_after, touching) -> dict:
    told = {}
    for k, pair in enumerate(pairs):
        row = {
            "excess_before_m": float(excess_before[:, k].max()),
            "excess_after_m": float(excess_after[:, k].max()),
        }
        if touching[:, k].any():
            row["touching_before"] = float((gap_before <= TOUCH)[touching[:, k], k].mean())
            row["touching_after"] = float((gap_after <= TOUCH)[touching[:, k], k].mean())
        told[pair.name] = row
    return told
