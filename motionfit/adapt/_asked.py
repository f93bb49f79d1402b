"""What is asked of a solve of general collisions, frame by frame, and what is wrong with a fit."""

import dataclasses
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import Fit
from motionfit._motion import Motion, host_kinematics
from motionfit._onto import onto
from motionfit.adapt._controls import Turn
from motionfit.adapt._groups import Known
from motionfit.adapt._limits import SkinLooks
from motionfit.adapt._sampling import Sampling, sampling
from motionfit.adapt._touches import Touches, touches_held
from motionfit.metrics import TOLERANCE, nearest_on_skin, skin_depths, skin_gaps
from motionfit.shape.pairs import PAIRS, Pair

NEAR, EVERY = 0.06, 3  # [m] by the fields: where the skin is asked, in each third frame that is seen


class Asked(NamedTuple):
    """What is asked of a solve, per frame that it sees and row of `known`."""

    character: Character
    so_far: Fit
    at: Sampling
    known: Known
    turns: tuple[Turn, ...]
    own: Float[np.ndarray, "frames rows"]  # [m] of depth on the reference
    allowed: Float[np.ndarray, "frames rows"]  # [m] of depth that a solve starts with
    most: Float[np.ndarray, "frames rows"]  # [m] of depth that a result may show
    touching: Bool[np.ndarray, "frames rows"]
    by_skin: bool

    @property
    def small(self) -> Motion:
        """The motion so far, in the frames that are seen."""
        return self.at.motion(self.so_far.motion)

    @property
    def looked_at(self) -> tuple[Pair, ...]:
        """The pairs whose skin is looked at: those of arms and legs, and what touches somewhere, since what is held
        together must not be pulled into each other."""
        rows = np.flatnonzero(self.touching.any(axis=0) & self.known.on_skin)
        either_way = {frozenset(pair[:2]): pair for pair in PAIRS}
        for row in rows:
            pair = self.known.clearance.pairs[row]
            either_way.setdefault(frozenset(pair[:2]), pair)
        return tuple(either_way.values())

    def gaps(self, of: Motion, depths: Float[np.ndarray, "frames rows"]) -> Float[np.ndarray, "frames rows"]:
        """How far [m] what should touch is apart."""
        if not self.by_skin:
            return -depths
        which = self.touching & self.known.on_skin
        return skin_gaps_near(self.character, of, self.known.clearance.pairs, -depths, which)

    def touches(
        self, of: Motion, depths: Float[np.ndarray, "frames rows"]
    ) -> tuple[Touches, Int[np.ndarray, " touches"]]:
        """Where the skins of what should touch are nearest to each other, and in which frames: those that are asked."""
        wanted = _asked_on_skin(-depths, self.touching & self.known.on_skin & self.by_skin)
        frames, rows = np.nonzero(wanted)
        gaps = nearest_on_skin(self.character, of, self.known.clearance.pairs, wanted)
        return touches_held(self.character, host_kinematics(of)[1][frames], rows, gaps), frames

    def part(self, seen: slice, spacing: float, least: int) -> "Asked":
        """What is asked in some of the frames that are seen, up to the next one after them."""
        ends = np.append(self.at.frames, self.so_far.motion.frame_count)
        so_far = cut(self.so_far, np.arange(int(ends[seen.start]), int(ends[seen.stop])))
        own, allowed, most, touching = (x[seen] for x in (self.own, self.allowed, self.most, self.touching))
        return self._replace(so_far=so_far, at=sampling(so_far.motion, spacing, least=least), own=own, allowed=allowed,
                             most=most, touching=touching)  # fmt: skip


class Wrong(NamedTuple):
    """What is wrong with a fit, per frame that is seen and row, and who shows what may stay: the clip on a reference."""

    clip: Motion
    reference: Character | None
    worst: Float[np.ndarray, "frames rows"]  # [m] deeper than it may be
    apart: Float[np.ndarray, "frames rows"]  # [m] farther than a touch
    somewhere: Bool[np.ndarray, " frames"]

    def looks(self, asked: Asked, seen: slice | np.ndarray) -> SkinLooks:
        """Looks at the skin in some of the frames that are seen."""
        return SkinLooks(self.clip[asked.at.frames[seen]], asked.character, self.reference, asked.looked_at)

    def on_skin(self, asked: Asked, small: Motion) -> Int[np.ndarray, " some"]:
        """The frames that are seen in which the skin shows more than the tolerance."""
        looks = self.looks(asked, slice(None))
        looks.look_between(small)
        return looks.at[(looks.depths(small) - looks.own > TOLERANCE).any(axis=1)]

    def shown(self, asked: Asked, small: Motion, over: Bool[np.ndarray, "frames rows"]) -> bool:
        """Whether the skin shows what the fields say is `over` the tolerance; spheres have none."""
        rows = np.flatnonzero(over.any(axis=0) & asked.known.on_skin)
        frames = np.flatnonzero(over[:, rows].any(axis=1))
        if over[:, ~asked.known.on_skin].any() or not len(frames):
            return bool(over[:, ~asked.known.on_skin].any())
        pairs = tuple(asked.known.clearance.pairs[row] for row in rows)
        body = self.reference or asked.character
        played = asked.so_far.base if self.reference is None else onto(self.clip, body.skeleton)
        own, now = (skin_depths(b, m[frames], pairs).depth
                    for b, m in ((body, asked.at.motion(played)), (asked.character, small)))  # fmt: skip
        return bool(((now - own > TOLERANCE) & over[np.ix_(frames, rows)]).any())


def cut(fit: Fit, frames: np.ndarray) -> Fit:
    """Some frames of a fit, with the correction that it has there."""
    correction = Correction(tuple(c[frames] for c in fit.correction.controls), fit.correction.points)
    return dataclasses.replace(fit, correction=correction, motion=fit.motion[frames], base=fit.base[frames])


def skin_gaps_near(
    character: Character, motion: Motion, pairs: Sequence[Pair], by_field: Float[np.ndarray, "frames rows"],
    which: Bool[np.ndarray, "*frames rows"],
) -> Float[np.ndarray, "frames rows"]:  # fmt: skip
    """How far [m] the first parts are from the second: what the fields say, corrected by what the skin shows, of the
    rows `which`, in some of the frames in which they are near."""
    wanted = _asked_on_skin(by_field, which)
    shown, frames, result = skin_gaps(character, motion, pairs, wanted), np.arange(len(wanted)), by_field.copy()
    for k in np.flatnonzero(wanted.any(axis=0)):
        asked = np.flatnonzero(wanted[:, k])
        result[:, k] += np.interp(frames, asked, (shown - by_field)[asked, k])
    return result


def _asked_on_skin(
    by_field: Float[np.ndarray, "frames rows"], which: Bool[np.ndarray, "*frames rows"]
) -> Bool[np.ndarray, "frames rows"]:
    """Where the skin is asked: each third frame, where the fields say that parts are near."""
    wanted = which & (by_field < NEAR)
    wanted[np.arange(len(wanted)) % EVERY != 0] = False
    return wanted
