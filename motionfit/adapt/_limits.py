"""What overlap does not count: that of the reference body, the joint's own, and what only the skin itself can tell."""

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._character import Character
from motionfit._motion import Motion, rest_motion
from motionfit._onto import onto
from motionfit.adapt._clearance import build_clearance, volume_depths
from motionfit.metrics import TOLERANCE, skin_depths
from motionfit.shape.field import standing
from motionfit.shape.pairs import Pair

LEAST_LOOKS, LOOK_SHARE = 16, 1 / 30  # looks at the skin: at least, and per frame that the solver sees
LOOK_STEP = 0.007  # [m]
ENOUGH = 0.7  # of TOLERANCE: what a look may still show
SHOULDER_SLACK = 1.25  # of the tolerance at the armpit, whose overlap at ease varies with the pose


def at_ease(body: Character) -> Motion:
    """Standing with the arms hanging, and swung as in a walk."""
    poses = [standing(body.skeleton, swing) for swing in (-0.35, 0.0, 0.35)]
    return Motion(body.skeleton, np.concatenate([p.root for p in poses]),
                  np.concatenate([p.rotations for p in poses]), poses[0].dt)  # fmt: skip


def reference_depths(
    clip: Motion, character: Character, reference: Character | None, pairs: tuple[Pair, ...], objective: str = "vertex"
) -> tuple[Float[np.ndarray, "frames pairs"], Float[np.ndarray, " pairs"]]:
    """Depth [m] on the volumes that does not count, per frame and pair, and that of the joint itself, per pair.

    The first is what the clip shows on the reference body, without one what the character shows in its rest pose. The
    second is the least that the reference shows standing at ease, for parts that meet at a joint: measured against the
    reference frame by frame, that overlap would count as excess wherever a clip holds the arms out, as every adapted
    clip does, and each further adaptation would push them further out.
    """
    body = reference or character
    clearance = build_clearance(body, pairs, objective)
    if reference is None:
        rest = volume_depths(clearance, rest_motion(body.skeleton))
        return np.tile(rest, (clip.frame_count, 1)), np.zeros(len(pairs))
    moving, easy = onto(clip, body.skeleton), at_ease(body)
    both = Motion(body.skeleton, np.concatenate([moving.root, easy.root]),
                  np.concatenate([moving.rotations, easy.rotations]), moving.dt)  # fmt: skip
    depths = volume_depths(clearance, both)
    return depths[: clip.frame_count], depths[clip.frame_count :].min(axis=0) * _adjacent(pairs)


def _adjacent(pairs: tuple[Pair, ...]) -> Bool[np.ndarray, " pairs"]:
    return np.array([p.adjacent for p in pairs])


class SkinLooks:
    """Looks at the skinned mesh itself, at some frames of a clip.

    Near the shoulder the skin follows arm and trunk at once, and the fold of the joint is not quite where a field of
    one pose says. `beyond` says by how much, and the solver allows that much less.
    """

    def __init__(self, clip: Motion, character: Character, reference: Character, pairs: tuple[Pair, ...]):
        """`clip` holds the frames that the solver sees."""
        count = min(clip.frame_count, max(LEAST_LOOKS, round(clip.frame_count * LOOK_SHARE)))
        self.at: Int[np.ndarray, " looks"] = np.unique(np.linspace(0, clip.frame_count - 1, count).round().astype(int))
        self.frames, self.character, self.pairs = np.arange(clip.frame_count), character, pairs
        self.own = skin_depths(reference, onto(clip[self.at], reference.skeleton), pairs).depth
        key = ("skin at ease", pairs)
        if key not in reference.memo:
            reference.memo[key] = skin_depths(reference, at_ease(reference), pairs).depth.min(axis=0)
        self.at_ease = reference.memo[key] * _adjacent(pairs)

    def depths(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """Depth [m] per look and pair of a motion of the solver's frames."""
        return skin_depths(self.character, motion[self.at], self.pairs).depth

    def quiet(self, seen: Float[np.ndarray, "looks pairs"]) -> Bool[np.ndarray, " pairs"]:
        """The pairs that show no violation in any look."""
        slack = np.where([p.first.endswith("upper_arm") for p in self.pairs], SHOULDER_SLACK, 1.0)
        return (seen - np.maximum(self.own, self.at_ease)).max(axis=0) <= slack * TOLERANCE

    def beyond(
        self,
        seen: Float[np.ndarray, "looks pairs"],
        excess: Float[np.ndarray, "frames pairs"],
        allowed: float,
        before: Float[np.ndarray, "frames pairs"] | None = None,
    ) -> Float[np.ndarray, "frames pairs"]:
        """How much less than `allowed` [m] the fields' excess may be, so that the skin shows no violation either.

        Without `before`, what the skin shows more than the fields do. Else, where a look still shows too much, a step
        down from what the fields show there now: at an armpit a vertex is in by centimetres or out, so a step as
        large as the violation would overshoot. Between two looks the greater of them counts.
        """
        over, shown = seen - self.own, excess[self.at]
        if before is None:
            more = np.clip(np.where(seen > 0, over - shown, 0.0), 0.0, LOOK_STEP)
        else:
            down = allowed - shown + np.clip(over, 0.0, LOOK_STEP)
            more = np.where(
                (seen > 0) & (over > ENOUGH * TOLERANCE), np.maximum(down, before[self.at]), before[self.at]
            )
        after = np.searchsorted(self.at, self.frames)
        return np.maximum(more[after], more[np.maximum(after - 1, 0)])
