"""What overlap does not count, that of the reference body, and looks at the skin itself."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter1d

from motionfit._character import Character
from motionfit._motion import Motion, host_kinematics, rest_motion
from motionfit._onto import onto
from motionfit.adapt._clearance import MANY, build_clearance, volume_depths
from motionfit.adapt._touches import Touches, touch_term, touches_of
from motionfit.metrics import TOLERANCE, insides, poses_of, shown_before, shown_in, skin_depths
from motionfit.shape.pairs import Pair
from motionfit.terms.penetration import TouchClearance

LEAST_LOOKS, LOOK_SHARE = 16, 1 / 15  # looks at the skin: at least, and per frame that the solver sees
MOST_JERK = 1.04  # ratio of a result's to that of the motion before it
NEARLY = 0.9  # of TOLERANCE: what a result may show, since between two looks there may be a little more
LOOKS_APART = 2  # [frames] that two looks are at least apart
FLEETING = 0.025  # [m] of excess in a single frame, from which on a limb passes too fast to be led out and back
ENOUGH = 0.7  # of TOLERANCE: what a look may still show
FARTHER = 0.005  # [m] out than need be, from which on touches are eased
EASES = (0.5, 0.25, 0.0)  # of what was found, one after the other


def reference_depths(
    clip: Motion, character: Character, reference: Character | None, pairs: tuple[Pair, ...], objective: str = "vertex"
) -> Float[np.ndarray, "frames pairs"]:
    """Depth [m] on the volumes that does not count, per frame and pair: what the clip shows on the reference body,
    without one what the character shows in its rest pose."""
    body = reference or character
    clearance = build_clearance(body, pairs, objective)
    if reference is None:
        return np.tile(volume_depths(clearance, rest_motion(body.skeleton)), (clip.frame_count, 1))
    return volume_depths(clearance, onto(clip, body.skeleton))


def shown_between(
    clip: Motion, character: Character, reference: Character | None, motion: Motion, pairs: tuple[Pair, ...],
    seen: Int[np.ndarray, " seen"],
) -> float:  # fmt: skip
    """The greatest excess [m] on the skin in those frames between the `seen` ones in which a part is suddenly deep on
    the volumes, and in the last of all: a hand can swing through a thigh from one frame that was looked at to the next."""
    if len(seen) == motion.frame_count:
        return 0.0
    clearance, frames = build_clearance(character, pairs), np.arange(motion.frame_count)
    chunks = np.split(frames, np.arange(MANY, len(frames), MANY))
    depth = np.concatenate([volume_depths(clearance, motion[some]) for some in chunks])
    smooth = np.stack([np.interp(frames, seen, d) for d in depth[seen].T], axis=1)
    sudden = np.asarray((depth > smooth + TOLERANCE).any(axis=1))
    sudden[-1] = True  # it may lie beyond what was seen
    at = np.flatnonzero(sudden)
    excess = skin_depths(character, motion[at], pairs).depth
    if reference is not None:
        excess = excess - skin_depths(reference, onto(clip[at], reference.skeleton), pairs).depth
    return float(excess.max(initial=0.0))


def unborne(
    excess: Float[np.ndarray, "frames pairs"], on_skin: Float[np.ndarray, "looks pairs"], at: Int[np.ndarray, " looks"]
) -> Float[np.ndarray, "frames pairs"]:
    """How much [m] of the fields' excess the skin does not bear out, which was looked at in the frames `at`; in between
    looks by the shares of it in those on both sides that have any."""
    result = np.zeros_like(excess)
    for k in range(excess.shape[1]):
        told = excess[at, k] > 0.0
        if told.any():
            share = 1.0 - np.maximum(on_skin[told, k], 0.0) / excess[at[told], k]
            shares = np.interp(np.arange(len(excess)), at[told], np.maximum(share, 0.0))
            result[:, k] = shares * np.maximum(excess[:, k], 0.0)
    return result


class Look(NamedTuple):
    """What one look at the skin showed."""

    depths: Float[np.ndarray, " pairs"]  # [m]
    touches: Touches


class SkinLooks:
    """Looks at the skinned mesh itself, at some frames of a clip.

    Near the shoulder the skin follows arm and trunk at once, and the fold of the joint is not quite where a field of
    one pose says. So what touches in a look becomes rows for the solver.

    No pose is looked at twice: what a frame showed is kept here, with its touches. Without a reference nothing is
    allowed: what lies inside in the rest pose never counts (`motionfit.metrics.skin_depths`).
    """

    def __init__(self, clip: Motion, character: Character, reference: Character | None, pairs: tuple[Pair, ...]):
        """`clip` is what the reference plays, in the frames that the solver sees."""
        self.clip, self.character, self.reference, self.pairs = clip, character, reference, pairs
        self.original = None if reference is None else onto(clip, reference.skeleton)
        self.frames = np.arange(clip.frame_count)
        count = min(clip.frame_count, max(LEAST_LOOKS, round(clip.frame_count * LOOK_SHARE)))
        self.at: Int[np.ndarray, " looks"] = np.unique(np.linspace(0, clip.frame_count - 1, count).round().astype(int))
        self.own = self._own(self.at)
        self.seen: dict[tuple[int, bytes], Look] = {}  # by frame and pose
        self.touches: dict[int, Touches] = {}
        self.found_in: dict[int, bytes] = {}  # the pose of the latest of them
        self.deepest = np.zeros_like(self.own)  # [m] of excess in any look, where touches were found
        self.eased = np.zeros_like(self.own)  # the share of it that touches may show again
        self.let_be: Int[np.ndarray, " some"] = np.zeros(0, int)  # frames in which something fleeting was seen

    def _own(self, at: Int[np.ndarray, " some"]) -> Float[np.ndarray, "some pairs"]:
        """What the reference shows."""
        if self.reference is None or self.original is None:  # both or neither
            return np.zeros((len(at), len(self.pairs)))
        return skin_depths(self.reference, self.original[at], self.pairs).depth

    @property
    def shares(self) -> Float[np.ndarray, " looks"]:
        """Of the frames, that each look stands for: those nearest to it. More looks lie where more may be wrong."""
        ends = np.concatenate([[-0.5], (self.at[1:] + self.at[:-1]) / 2, [len(self.frames) - 0.5]])
        return np.diff(ends) / len(self.frames)

    def anew(self) -> "SkinLooks":
        """Looks that start over, but look at no pose twice."""
        fresh = SkinLooks(self.clip, self.character, self.reference, self.pairs)
        fresh.seen = self.seen
        return fresh

    def depths(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """Depth [m] per look and pair of a motion of the solver's frames."""
        return np.array([look.depths for look in self._look(motion, self.at).values()])

    def depths_and_touches(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """The same, and what goes beyond the reference is kept: `touches`, by frame, the latest ones first."""
        looked = self._look(motion, self.at)
        for (frame, pose), look in looked.items():
            if self.found_in.get(frame) != pose:
                self.touches[frame] = look.touches.then(self.touches[frame]) if frame in self.touches else look.touches
                self.found_in[frame] = pose
        result = np.array([look.depths for look in looked.values()])
        if not self.eased.any():
            self.deepest = np.maximum(self.deepest, result - self.own)
        return result

    def _look(self, motion: Motion, at: Int[np.ndarray, " some"]) -> dict[tuple[int, bytes], Look]:
        """What each look shows; poses that were seen before are not looked at again."""
        looked = motion[at]
        keys = list(zip(at.tolist(), poses_of(looked), strict=True))
        new = np.array([i for i, key in enumerate(keys) if key not in self.seen], int)
        if len(new):
            looked, own = looked[new], self._own(at[new])
            rotations, known = host_kinematics(looked)[1], shown_before(self.character, self.pairs)
            for k, vertices, found in insides(self.character, looked, self.pairs):
                key = keys[new[k]]
                known[key[1]] = shown = shown_in(found, len(self.pairs))
                self.seen[key] = Look(shown.depth, touches_of(self.character, rotations[k], vertices, found, own[k]))
        return {key: self.seen[key] for key in keys}

    def touch_term(
        self, columns: Int[np.ndarray, " some"], allowed: float, length: int,
        least: float | Float[np.ndarray, "looks pairs"] = 0.0,
    ) -> TouchClearance:  # fmt: skip
        """The touches of some pairs as rows for the solver, up to `allowed` [m] more than the reference shows, or up to
        a depth of `least` [m]."""
        rows = self.own + allowed + self.eased * np.maximum(self.deepest - allowed, 0.0)
        rows = np.maximum(rows, least)
        limits = {int(frame): row for frame, row in zip(self.at, rows, strict=True)}
        return touch_term(self.character, self.touches, columns, limits, len(self.frames), length)

    def ease(self, seen: Float[np.ndarray, "looks pairs"], allowed: float) -> bool:
        """Let touches show more where the skin came out farther than it had to; says whether there is more to try.

        A touch was found in another pose, and on the way from there a fold opens faster than its rows say. So half of
        what was found may show again, and less of it where the skin then sinks in.
        """
        excess = seen - self.own
        if not self.eased.any():
            farther = (self.deepest > ENOUGH * TOLERANCE) & (excess < allowed - FARTHER)
            self.eased[:] = EASES[0] if farther.any() else 0.0
            return bool(farther.any())
        sinks = maximum_filter1d(excess, 3, axis=0) > ENOUGH * TOLERANCE  # a spline takes its neighbours along
        less = np.where(self.eased > EASES[1], EASES[1], EASES[2])
        wanted = bool((sinks & (self.eased > 0.0)).any())
        self.eased = np.where(sinks, less, self.eased)
        return wanted

    def look_closer(self, risk: Float[np.ndarray, " frames"]) -> None:
        """Look at more frames from now on: those of greatest `risk`, apart from each other and from former looks."""
        risk, taken = risk.copy(), []
        for frame in self.at:
            risk[max(frame - LOOKS_APART, 0) : frame + LOOKS_APART + 1] = -np.inf
        while len(taken) < len(self.at) // 2 and risk.max() > -np.inf:
            taken.append(int(risk.argmax()))
            risk[max(taken[-1] - LOOKS_APART, 0) : taken[-1] + LOOKS_APART + 1] = -np.inf
        self._look_at(taken)

    def look_between(
        self, motion: Motion, near: Bool[np.ndarray, " frames"] | None = None, every: int | None = 2
    ) -> bool:
        """Look at a motion once in `every` so many frames (None: where it is looked at anyway), and in all that may be
        `near` the tolerance; from now on where some show nearly as much. Says whether there are any.

        What is deep in a single frame is let be, and told: a hand that swings through a hip is out again before it
        could be led around it, and what is tried for it spoils the frames beside it.
        """
        at = np.union1d(self.at, [] if every is None else self.frames[::every])
        at = np.union1d(at, [] if near is None else self.frames[near]).astype(int)
        over = at[self._excess(motion, at) > NEARLY * TOLERANCE]
        beside = np.intersect1d([over - 1, over + 1], self.frames)
        over = np.union1d(over, beside[self._excess(motion, beside) > ENOUGH * TOLERANCE])
        lasting = np.isin(over - 1, over) | np.isin(over + 1, over) | (self._excess(motion, over) <= FLEETING)
        self.let_be = np.union1d(self.let_be, over[~lasting]).astype(int)
        missed = np.setdiff1d(over[lasting], self.at)
        if (self._excess(motion, missed) <= NEARLY * TOLERANCE).all():
            return False
        self._look_at(missed.tolist())
        return True

    def most_seen(self, motion: Motion, doubtful: Bool[np.ndarray, " frames"] | None = None) -> float:
        """The greatest excess [m] of a motion in any frame in which it was looked at, where something is let be, and in
        frames that are `doubtful`."""
        self._look(motion, np.union1d(self.let_be, [] if doubtful is None else self.frames[doubtful]).astype(int))
        keys = zip(self.frames.tolist(), poses_of(motion), strict=True)
        at = np.array([key[0] for key in keys if key in self.seen], int)
        return float(self._excess(motion, at).max(initial=0.0))

    def _excess(self, motion: Motion, at: Int[np.ndarray, " some"]) -> Float[np.ndarray, " some"]:
        """The greatest excess [m] of any pair in some frames; where nothing is deep, that depth, since the reference
        can only make it less, and need not be looked at."""
        shown = np.array([look.depths for look in self._look(motion, at).values()]).reshape(len(at), len(self.pairs))
        deep = np.flatnonzero((shown > ENOUGH * TOLERANCE).any(axis=1))
        shown[deep] -= self._own(at[deep])
        return shown.max(axis=1, initial=-np.inf)

    def _look_at(self, frames: list[int]) -> None:
        if frames:
            order = np.argsort(at := np.concatenate([self.at, frames]))
            self.own = np.concatenate([self.own, self._own(np.array(frames))])[order]
            none = np.zeros((len(frames), len(self.pairs)))
            self.deepest, self.eased = (np.concatenate([x, none])[order] for x in (self.deepest, self.eased))
            self.at = at[order]

    def quiet(self, seen: Float[np.ndarray, "looks pairs"]) -> Bool[np.ndarray, " pairs"]:
        """The pairs of which no look shows more than the tolerance."""
        return (seen <= self.own + TOLERANCE).all(axis=0)  # pyright: ignore[reportReturnType]

    def joined(
        self, excess: Float[np.ndarray, "frames pairs"], on_skin: Float[np.ndarray, "looks pairs"],
        quiet: Bool[np.ndarray, " pairs"],
    ) -> Float[np.ndarray, "frames pairs"]:  # fmt: skip
        """Excess [m] on the skin where it was looked at, in between on the fields as far as the looks on both sides bear
        them out; 0 for quiet pairs."""
        wrong = on_skin - excess[self.at]
        # where both say that parts are apart, only the fields know how far
        wrong = np.where((on_skin <= 0.0) & (excess[self.at] <= 0.0), 0.0, wrong)
        result = excess + np.stack([np.interp(self.frames, self.at, w) for w in wrong.T], axis=1)
        return np.where(quiet, 0.0, result)
