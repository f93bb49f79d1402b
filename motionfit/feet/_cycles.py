"""Glardon's adaptive height threshold, on arbitrary clips: Glardon, Boulic & Thalmann 2006, section 4.

The source knows its locomotion cycles; a clip does not come in cycles. Here they are found: where one foot is
furthest ahead of the other a cycle of 25 frames begins, where the other one is, its second half.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from motionfit._motion import Motion
from motionfit._skeleton import SIDES
from motionfit.feet._classics import foot_joints
from motionfit.feet._detect import ADULT_LEG, leg_scale, smooth, smoothing_frames, velocity
from motionfit.feet._floor import Floor
from motionfit.feet._plants import Plant, runs
from motionfit.feet._sole import chain_kinematics

CYCLE = 25  # frames of the source's normalised cycle
# Table 1: first and last frame in which a joint may be constrained, from the strike of its own foot on (frame 1 for
# the right foot, 13 for the left one; of the left foot's rows 12 and 13 are taken off: they are the right one's)
BOUNDS = {"walk": ((1, 12), (3, 15)), "run": ((1, 7), (1, 9))}
CORRECTNESS = 0.4  # delta of (8)
NOISE = 0.01  # [m] by which the height of a joint varies while its foot stands
RAISED = 0.04  # [m] for an adult's leg
BRIEF = 0.05  # [s] a joint that rests for less is on its way
RUNNING = 0.5  # Froude number v^2 / g L from which people run (Alexander 1989)


class Constraint(NamedTuple):
    """A foot joint that is held from frame `start` to `end`, both included: `foot` 0 left, 1 right; `part` 0 ankle
    (heel), 1 toe."""

    foot: int
    part: int
    start: int
    end: int


def adaptive_threshold(heights: Float[np.ndarray, " frames"], correctness: float = CORRECTNESS) -> tuple[int, int]:
    """First and last frame of the one constraint within bounding frames, whose joint heights [m] these are.

    (8): the threshold lies a share `correctness` of the way from the lowest height to the mean of the first and the
    last one, and `NOISE` over the lowest at least, since a standing foot has no such share. From both ends frames are
    left out until one is not above it: so a footplant is never split.
    """
    lowest = heights.min()
    threshold = lowest + max(correctness * (0.5 * (heights[0] + heights[-1]) - lowest), NOISE)
    low = np.flatnonzero(heights <= threshold)
    return int(low[0]), int(low[-1])


def strikes(motion: Motion) -> list[tuple[int, int]]:
    """(frame, foot) of each moment in which a foot is furthest ahead of the other, in order; none for a clip that
    does not go anywhere."""
    dt, size = float(motion.dt), leg_scale(motion.skeleton)
    ankles = [foot[0] for foot in foot_joints(motion.skeleton)]
    world = chain_kinematics(motion, tuple(ankles))
    apart = (world[ankles[1]][1] - world[ankles[0]][1])[:, [0, 2]]
    root = smooth(np.asarray(motion.root, float)[:, [0, 2]], 2 * round(0.25 / dt) + 1)
    forward = velocity(root, dt)
    pace = np.linalg.norm(forward, axis=1)
    forward = forward / np.maximum(pace, 1e-9)[:, None]
    ahead = smooth(np.einsum("fa,fa->f", apart, forward), 2 * round(0.03 / dt) + 1)
    ahead = np.where(pace > 0.2 * size, ahead, 0.0)
    # alternating extrema that differ by a fifth of a leg: small wobbles are no steps
    needed, found = 0.2 * size * ADULT_LEG, []
    sign, best = 0, 0
    for t in range(len(ahead)):
        if sign >= 0 and ahead[t] > ahead[best] or sign < 0 and ahead[t] < ahead[best]:
            best = t
        elif abs(ahead[t] - ahead[best]) > needed:
            if abs(ahead[best]) > 0.5 * needed:
                found.append((best, 1 if ahead[best] > 0 else 0))
            sign, best = (-1 if ahead[t] < ahead[best] else 1), t
    return [s for k, s in enumerate(found) if k == 0 or s[1] != found[k - 1][1]]


def find_constraints(
    motion: Motion,
    floor: Floor | None = None,
    *,
    plants: Sequence[Plant] = (),
    standing: Float[np.ndarray, " joints"] | None = None,
    resting: float | None = None,
    correctness: float = CORRECTNESS,
) -> list[Constraint]:
    """Ankle and toe constraints of both feet by the adaptive threshold, without a kind of motion named.

    Each strike opens the bounding frames of table 1 for its foot, scaled to the length of the cycle around it;
    walking or running is told by the Froude number. A clip without strikes (standing, a jump) is one interval, as
    far as nothing better is known: `plants` keep the bounding frames within the foot's own plants, and one that no
    strike explains bounds an interval of its own. (8) finds a constraint wherever it is asked to: where `standing` says
    how high [m] over the floor each joint is in a foot that stands flat, a joint that stays `RAISED` above that (a
    heel on tiptoe, or at the end of the clip) has none. Nor does a height say that a joint rests: a foot that turns
    on its toes, or comes down on its heel, has a low ankle that moves. `resting` [m/s] leaves of each constraint the
    longest part in which the joint is slower, over the floor, unless that is brief.
    """
    floor = floor or Floor()
    frames, joints = motion.frame_count, foot_joints(motion.skeleton)
    world = chain_kinematics(motion, tuple(j for foot in joints for j in foot))
    heights = [[floor.above(world[j][1]) for j in foot] for foot in joints]
    dt = float(motion.dt)
    calm = [[smooth(world[j][1] - world[j][1][0], smoothing_frames(dt)) for j in foot] for foot in joints]
    pace = [[np.linalg.norm(velocity(path, dt)[:, [0, 2]], axis=1) for path in foot] for foot in calm]
    most = None if standing is None else np.asarray(standing) + RAISED * leg_scale(motion.skeleton)
    moments = strikes(motion)
    constraints: list[Constraint] = []

    def add(foot: int, part: int, first: int, last: int) -> None:
        first, last = max(first, 0), min(last, frames - 1)
        own = [p for p in plants if SIDES.index(p.foot) == foot]
        if own:
            best = max(own, key=lambda p: min(p.end, last) - max(p.start, first))
            first, last = max(first, best.start), min(last, best.end)
        if first > last:
            return
        mine = heights[foot][part][first : last + 1]
        if most is None or mine.min() < most[joints[foot][part]]:
            a, b = adaptive_threshold(mine, correctness)
            slow = runs(pace[foot][part][first + a : first + b + 1] <= (np.inf if resting is None else resting))
            if slow:
                start, end = max(slow, key=lambda run: run[1] - run[0])
                if resting is None or end - start >= BRIEF / dt:
                    constraints.append(Constraint(foot, part, first + a + start, first + a + end))

    if len(moments) < 2:
        moments = []
        if not plants:
            plants = [Plant(side, None, 0, frames - 1) for side in SIDES]
    if moments:
        _by_strikes(motion, moments, joints, add)
    for plant in plants:
        foot = SIDES.index(plant.foot)
        held = planted_by([c for c in constraints if c.foot == foot], frames)[:, foot]
        if held[plant.start : plant.end + 1].mean() < 0.5:
            for part in range(len(joints[foot])):
                add(foot, part, plant.start, plant.end)
    return constraints


def _by_strikes(motion: Motion, moments: list[tuple[int, int]], joints: list, add: Callable) -> None:
    """Bounding frames of table 1 for the stance that each strike begins."""
    dt, root = float(motion.dt), np.asarray(motion.root, float)[:, [0, 2]]
    steps = np.diff([t for t, _ in moments])
    # strikes that lie before the clip's first and after its last one, at the same pace: their stances reach in
    before = (moments[0][0] - int(steps[0]), 1 - moments[0][1])
    moments = [before, *moments]
    steps = np.append([steps[0], *steps], steps[-1])
    leg = leg_scale(motion.skeleton) * ADULT_LEG
    for k, (frame, foot) in enumerate(moments):
        cycle = float(steps[k] + steps[min(k + 1, len(steps) - 1)])
        stretch = root[max(frame, 0) : max(frame, 0) + max(int(cycle), 2)]
        pace = np.linalg.norm(stretch[-1] - stretch[0]) / max(dt * (len(stretch) - 1), dt)
        kind = "run" if pace**2 / (9.81 * leg) > RUNNING else "walk"
        for part in range(len(joints[foot])):
            first, last = BOUNDS[kind][part]
            add(foot, part, *(round(frame + (f - 1) / CYCLE * cycle) for f in (first, last)))


def planted_by(constraints: list[Constraint], frames: int) -> Bool[np.ndarray, "frames 2"]:
    """Feet that are held by their ankle or toe."""
    planted = np.zeros((frames, 2), bool)
    for c in constraints:
        planted[c.start : c.end + 1, c.foot] = True
    return planted
