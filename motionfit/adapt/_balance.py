"""The block that keeps a motion as balanced as it was, on a body of other masses: thesis 4.7."""

import dataclasses
import warnings
from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import Character
from motionfit._control import Control, Correction
from motionfit._fit import Fit, fit
from motionfit._motion import Motion, continued, host_kinematics
from motionfit._onto import onto
from motionfit._problem import During, Problem
from motionfit._skeleton import SIDES
from motionfit._solve import Block
from motionfit._types import InputError
from motionfit.adapt._clearance import build_clearance, volume_depths
from motionfit.adapt._controls import lean_controls
from motionfit.adapt._limits import MOST_JERK, NEARLY, reference_depths, unborne
from motionfit.adapt._record import put_down
from motionfit.adapt._sampling import Sampling, sampling
from motionfit.adapt._standing import distances, weighed
from motionfit.balance import WINDOW, Soles, ZmpDistance
from motionfit.feet._leg import Leg, find_legs, lowering, turn_legs
from motionfit.feet._remove import detect_footplants
from motionfit.metrics import TOLERANCE, skin_depths
from motionfit.shape.mass import Masses
from motionfit.shape.pairs import PAIRS, Pair, pairs_of
from motionfit.terms.balance import Standing, ZmpMargin
from motionfit.terms.pose import Effort, Smoothness

ALLOWED_EXCESS = 0.005  # [m] beyond its threshold that a frame may keep: what the filter's choice alone makes
MEAN_ENOUGH = 0.0005  # [m] of mean distance more than the source's, what may be left
MOST_LEFT = 0.001  # [m] the same, before it counts as a violation
CARTOON = 0.9  # thesis 4.7.3: thresholds scaled by less lean the character more than one would
EFFORT = 0.3  # [rad]
JERK_SHARE = 0.5  # of the source's own jerk, what the hips may get at the cost of 1 per frame
LEAST_JERK = 10.0  # [m/s^3] for clips that stand still
LEVER = 0.9  # [m] ankle to hip
PASS_OVER = 0.08  # [s] within which the weight goes from one foot to the other
STRETCH = 0.998  # of a leg's length, as far as it may be stretched: straight legs leave no way to shift the hips
ROUNDS, PATIENCE = 8, 3  # rounds at most, and rounds without a better result
HOLD = 4.0  # times as heavy as in the round before is the effort of a frame that sank in
AROUND = 0.1  # [s]
NEAR, LOOKS_APART = 0.02, 1 / 15  # [m] by the fields, from which on thighs are looked at on the skin, and how often [s]
FADE, FADES = 0.15, 12  # what goes of a lean at once where it sinks in or is jerky, and how often
OUTLIER = 0.05  # [m] beyond its threshold, from which on a frame counts by its distance, not by the square of that


class _Stance(NamedTuple):
    """What of a body and its floor does not change: masses, soles, and the height [m] of the floor in each frame."""

    masses: Masses
    soles: Soles
    ground: Float[np.ndarray, " frames"]


def balance(
    clip: Motion, character: Character, so_far: Fit, *, reference: Character | None = None, scale: float = 1.0,
    gaze: bool = True, shoulders: bool = False,
) -> Fit:  # fmt: skip
    """Bring the zero-moment point no farther from the support than the clip has it on `reference`, frame by frame.

    Masses come from both bodies' shapes. The character leans over the ankles and bends the spine, (4.12), on top of
    `so_far`; the feet stay where they are in every frame, planted or not: the legs follow by the analytic leg.
    Without a reference the thresholds are those of the clip before any correction on the character itself. `scale`
    multiplies them: below 0.9 it looks like a cartoon. `gaze` keeps the head's orientation. `shoulders` keeps that of the
    arms, which a bent spine would take along; arms that no longer go with the trunk may come to lie in it (thesis 5.5.2
    warns of that too), and then the block leans less.

    A clip that is as balanced in the mean comes back as it was, and where the mean would fall below 0.9 times what was
    asked for, only the part of the lean is taken that reaches it. `details["balance"]` holds the mean distance [m] of
    the source, and before and after; the root's way lies in the fit's `base`.
    """
    if not 0.0 <= scale <= 2.0:
        raise InputError(f"thresholds can be scaled by 0 to 2, got {scale:g}")
    if scale < CARTOON:
        warnings.warn(f"thresholds scaled by {scale:g}: below {CARTOON} the character leans more than one would, and "
                      "looks like a cartoon", stacklevel=2)  # fmt: skip
    motion = so_far.motion
    source, body = (so_far.base, character) if reference is None else (onto(clip, reference.skeleton), reference)
    plants = detect_footplants(source, body)
    planted = np.asarray(plants.planted)
    at = sampling(motion)
    own_stance = _stance(body, source, plants.floor)
    stance = _stance(character, motion, detect_footplants(motion, character).floor)
    own = _distance(body, source, own_stance, planted)
    threshold = np.asarray(own.outside)
    before = _distance(character, motion, stance, planted)
    wanted = _mean(own, scale * threshold)

    def done(result: Fit, after: ZmpDistance) -> Fit:
        told = {"zmp_distance_source_m": _mean(own, threshold), "zmp_distance_before_m": _mean(before),
                "zmp_distance_after_m": _mean(after), "supported_frames": int(np.asarray(after.supported).sum())}  # fmt: skip
        return dataclasses.replace(result, details={**so_far.details, "balance": told})

    if _mean(before) <= wanted + MEAN_ENOUGH:
        return done(so_far, before)

    controls = lean_controls(character, motion, at.whole, gaze, shoulders)
    feet = tuple(character.skeleton.joint(f"{s}_foot") for s in SIDES)
    share = _share(planted, float(motion.dt))
    term = ZmpMargin(stance.masses, stance.soles, _padded(planted[at.frames], at, False), np.zeros(len(at.rows)),
                     ground=stance.ground[at.rows], frames_around=round(5 * WINDOW / at.dt) + 1)  # fmt: skip
    seen = continued(at.motion(motion), len(at.rows))
    home = host_kinematics(seen)[0][:, list(feet)]
    sinks = _sinking(clip, character, reference, motion, at)
    limit = (scale * threshold + ALLOWED_EXCESS)[at.frames]
    points = Correction.zero(tuple(at.control(c) for c in controls))
    smooth = JERK_SHARE * max(_jerk(motion), LEAST_JERK) / LEVER
    held = smoother = np.ones(len(at.frames))
    best, after, idle, history = None, before, 0, []

    def leaned(points: Correction, part) -> _Leaned:
        some = _stood(so_far, controls, at, points, feet, share, part)
        after = _distance(character, some.motion, stance, planted)
        jerky = np.logical_or.reduceat(_jerky(some.motion, motion), at.frames)
        return _Leaned(some, after, _mean(after), points, part, jerky, sinks(some.motion))

    for _ in range(ROUNDS):
        zmp = eqx.tree_at(lambda z: z.threshold, term, _padded(limit, at, 0.0))
        # next to flight the point is metres away: squares of that would leave all other frames as they are
        far = np.maximum(np.asarray(after.outside)[at.frames] - limit, 1e-9)
        counts = _padded(np.sqrt(np.minimum(OUTLIER / far, 1.0)), at, 0.0)
        terms = {"balance": During(Standing(zmp, feet, home, share[at.rows]), counts),
                 "effort": During(Effort(EFFORT), _padded(held, at, 0.0)),
                 "smoothness": During(Smoothness(smooth), _padded(smoother, at, 0.0))}  # fmt: skip
        problem = Problem(character, seen, terms, points.controls)
        solved = fit(problem, (Block("balance", tuple(c.name for c in controls), max_steps=24, tolerance=1e-3),),
                     correction=points)  # fmt: skip
        points, history = solved.correction, [*history, *solved.history]
        whole = leaned(points, np.ones(at.whole.count))
        after = whole.after
        clean = _cleaned(whole, leaned, at)
        idle = 0 if best is None or clean.mean < best.mean - MEAN_ENOUGH else idle + 1
        best = clean if best is None or clean.mean < best.mean else best
        if best.mean <= wanted + MEAN_ENOUGH or idle == PATIENCE:
            break
        smoother = smoother * (1.0 + _around(whole.jerky, at.dt))
        held = held * (1.0 + (HOLD - 1.0) * _around(whole.sunk, at.dt))
        if whole.mean > wanted + MEAN_ENOUGH:
            left = np.where(whole.after.supported, np.asarray(whole.after.outside) - scale * threshold, 0.0)[at.frames]
            limit = limit - np.maximum(left, 0.0)
    assert best is not None
    if best.mean < CARTOON * wanted:
        # the thresholds hold what was farther and let be what was nearer, so that the mean ends under the source's:
        # what is more than was asked for is given back
        found = best
        part = _crossing(lambda part: leaned(found.points, part * found.part).mean - wanted)
        some = leaned(found.points, part * found.part)
        best = found if some.sunk.any() else some
    reached = best.mean <= wanted + MOST_LEFT
    return done(dataclasses.replace(best.result, history=(*so_far.history, *history),
                                    status=so_far.status if reached else "violations_left"), best.after)  # fmt: skip


class _Leaned(NamedTuple):
    """A part of a lean, 0 to 1 per control point, put on the motion: how balanced it is in the mean [m], and which of
    the frames seen are too jerky or sink in."""

    result: Fit
    after: ZmpDistance
    mean: float
    points: Correction
    part: Float[np.ndarray, " points"]
    jerky: Bool[np.ndarray, " seen"]
    sunk: Bool[np.ndarray, " seen"]

    @property
    def wrong(self) -> Bool[np.ndarray, " seen"]:
        return self.jerky | self.sunk


def _cleaned(whole: _Leaned, leaned: Callable[[Correction, np.ndarray], _Leaned], at: Sampling) -> _Leaned:
    """As much of a lean as sinks in nowhere and is not jerky: rather less balanced than that. First there is less of it
    around the frames where it is so, then everywhere."""
    some = whole
    for _ in range(FADES):
        if not some.wrong.any():
            return some
        some = leaned(whole.points, some.part * (1.0 - FADE * _of_points(_around(some.wrong, at.dt), at)))
    faded = some.part
    for part in (0.75, 0.5, 0.25, 0.0):
        if not some.wrong.any():
            break
        some = leaned(whole.points, part * faded)
    return some


def _around(sunk: Bool[np.ndarray, " seen"], dt: float) -> Float[np.ndarray, " seen"]:
    """1 in some frames, and smoothly to 0 around them: as far as a spline takes its neighbours along."""
    width = max(1, round(AROUND / dt))
    return gaussian_filter1d(maximum_filter1d(sunk.astype(float), 2 * width + 1), width / 2, mode="nearest")


def _of_points(rows: Float[np.ndarray, " seen"], at: Sampling) -> Float[np.ndarray, " points"]:
    """Per control point the most of the frames that it moves."""
    first, width = np.asarray(at.basis.first)[: len(rows)], np.shape(at.basis.values)[1]
    result = np.zeros(at.basis.count)
    for k in range(width):
        np.maximum.at(result, first + k, rows)
    return result[: at.whole.count]


def _padded(rows: np.ndarray, at: Sampling, value) -> np.ndarray:
    """Rows of the frames that are seen, and a value for those that fill the bucket."""
    more = np.full((len(at.rows) - len(rows), *rows.shape[1:]), value, rows.dtype)
    return np.concatenate([rows, more])


def _stance(body: Character, motion: Motion, floor) -> _Stance:
    masses, soles = weighed(body)
    return _Stance(masses, soles, floor.at(np.asarray(motion.root, float)))


def _distance(body: Character, motion: Motion, stance: _Stance, planted: np.ndarray) -> ZmpDistance:
    return distances(body, motion, stance.masses, stance.soles, planted, stance.ground)


def _mean(distance: ZmpDistance, outside: np.ndarray | None = None) -> float:
    outside = np.asarray(distance.outside) if outside is None else outside
    supported = np.asarray(distance.supported)
    return float(outside[supported].mean()) if supported.any() else 0.0


def _crossing(function: Callable[[float], float], steps: int = 6) -> float:
    """Where between 0 and 1 a function that is positive at 0 has fallen to zero: by halves, from above."""
    low, high = 0.0, 1.0
    for _ in range(steps):
        middle = (low + high) / 2
        low, high = (middle, high) if function(middle) > 0.0 else (low, middle)
    return high


def _share(planted: Bool[np.ndarray, "frames 2"], dt: float) -> Float[np.ndarray, "frames 2"]:
    """How much each foot carries, passing smoothly from one to the other; in flight what is nearer in time."""
    weight = gaussian_filter1d(planted.astype(float), PASS_OVER / dt, axis=0, mode="nearest") + 1e-3
    return weight / weight.sum(axis=1, keepdims=True)


def _jerky(motion: Motion, before: Motion) -> Bool[np.ndarray, " frames"]:
    """The frames without whose jerk a motion would have no more than `MOST_JERK` times that of the one before; none
    where it has not."""
    now, was = (np.zeros(m.frame_count) for m in (motion, before))
    if motion.frame_count > 3:
        for row, m in ((now, motion), (was, before)):
            row[1:-2] = np.linalg.norm(np.diff(host_kinematics(m)[0], 3, axis=0), axis=-1).mean(axis=1)
    more = now - was
    order = np.argsort(-more)
    left = more.sum() - np.concatenate([[0.0], np.cumsum(more[order])])
    result = np.zeros(len(more), bool)
    result[order[: int((left > (MOST_JERK - 1.0) * was.sum()).sum())]] = True
    return result


def _jerk(motion: Motion) -> float:
    """Mean jerk [m/s^3] of the joints, noise left out."""
    if motion.frame_count < 4:
        return 0.0
    positions = gaussian_filter1d(host_kinematics(motion)[0], 0.016 / float(motion.dt), axis=0, mode="nearest")
    return float(np.linalg.norm(np.diff(positions, 3, axis=0), axis=-1).mean()) / float(motion.dt) ** 3


def _sinking(clip: Motion, character: Character, reference: Character | None, so_far: Motion, at: Sampling):
    """Says of a motion in which of the frames seen some pair shows nearly as much as the tolerance, and more than before
    the block. Thighs and calves that come near each other are looked at on the skin too: it knows better where they
    touch, and what the fields see and it does not bear out is no touch."""
    clearance, legs = build_clearance(character, PAIRS), pairs_of("legs")
    columns = [PAIRS.index(p) for p in legs]
    limit = reference_depths(clip[at.frames], character, reference, PAIRS)
    near = bool(volume_depths(clearance, at.motion(so_far))[:, columns].max() > -NEAR)
    looks = np.arange(0, len(at.frames) if near else 0, max(1, round(LOOKS_APART / at.dt)))
    looked, own = at.frames[looks], 0.0
    if reference is not None:
        own = skin_depths(reference, onto(clip[looked], reference.skeleton)).depth[:, columns]

    def shown(motion: Motion, pairs: tuple[Pair, ...] = legs) -> tuple[np.ndarray, np.ndarray]:
        """Excess [m] on the fields, per frame and pair, and on the skin, per look and pair of the legs."""
        on_skin = skin_depths(character, motion[looked], pairs).depth[:, [pairs.index(p) for p in legs]] - own
        on_fields = volume_depths(clearance, at.motion(motion)) - limit
        on_fields[:, columns] -= unborne(on_fields[:, columns], on_skin, looks)
        return on_fields, on_skin

    # of all pairs, since the limbs' blocks looked at most of these poses already
    before = shown(so_far, PAIRS)

    def sinks(motion: Motion) -> Bool[np.ndarray, " seen"]:
        on_fields, on_skin = (
            np.asarray((now > _most(was)).any(axis=1)) for now, was in zip(shown(motion), before, strict=True)
        )
        on_fields[looks] |= on_skin
        return on_fields

    return sinks


def _most(before: Float[np.ndarray, "frames pairs"]) -> Float[np.ndarray, "frames pairs"]:
    return np.maximum(before + 0.001, NEARLY * TOLERANCE)


def _stood(
    so_far: Fit, controls: tuple[Control, ...], at: Sampling, points: Correction, feet: tuple[int, ...],
    share: Float[np.ndarray, "frames 2"], part: float | Float[np.ndarray, " points"] = 1.0,
) -> Fit:  # fmt: skip
    """The block's controls, or a part of them, on top of the fit so far, with every foot where it was: the root moves,
    the legs follow."""
    motion, skeleton = so_far.motion, so_far.motion.skeleton
    mine = Correction(controls, tuple(part * np.asarray(p)[: at.whole.count] for p in points.points))
    leaned = mine.apply(motion)
    home, turned = host_kinematics(motion)[0][:, list(feet)], host_kinematics(leaned)[0][:, list(feet)]
    shift = (share[..., None] * (home - turned)).sum(axis=1)
    positions, rotations = host_kinematics(leaned)
    legs = find_legs(skeleton, positions + shift[:, None], rotations)
    shift = shift - _down(legs, find_legs(skeleton, *host_kinematics(motion)), float(motion.dt))
    legs = find_legs(skeleton, positions + shift[:, None], rotations)
    local, _ = turn_legs(leaned, legs, [home[:, k] for k in range(2)], rotations)
    root = np.asarray(motion.root, float) + shift
    result = Motion(skeleton, root, local, motion.dt, motion.translations)
    base = dataclasses.replace(so_far.base, root=root)
    both = Correction((*so_far.correction.controls, *mine.controls), (*so_far.correction.points, *mine.points))
    joints = sorted({int(d.joint) for c in controls for d in c.drives} | {j for leg in legs for j in leg.joints})
    return put_down("stand", so_far, result, base, both, joints)


def _down(legs: list[Leg], before: list[Leg], dt: float) -> Float[np.ndarray, "frames 3"]:
    """How far [m] the body comes down so that no leg must be longer than it is, nor straighter than it was."""
    reach = [np.maximum(STRETCH * leg.length, np.linalg.norm(leg.hip - leg.ankle, axis=1)) for leg in before]
    return lowering(legs, [leg.ankle for leg in before], dt, reach)[:, None] * np.array([0.0, 1.0, 0.0])
