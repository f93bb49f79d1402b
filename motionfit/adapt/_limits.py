"""What overlap does not count: that of the reference body, the joint's own, and what only the skin itself can tell."""

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._character import Character
from motionfit._motion import Motion, host_kinematics, rest_motion
from motionfit._onto import onto
from motionfit.adapt._clearance import build_clearance, volume_depths
from motionfit.adapt._touches import Touches, touch_term, touches_of
from motionfit.metrics import TOLERANCE, insides, skin_depths
from motionfit.shape.field import standing
from motionfit.shape.pairs import Pair
from motionfit.terms.penetration import TouchClearance

LEAST_LOOKS, LOOK_SHARE = 16, 1 / 15  # looks at the skin: at least, and per frame that the solver sees
NEARLY = 0.9  # of TOLERANCE: what a result may show, since between two looks there may be a little more
LOOKS_APART = 2  # [frames] that two looks are at least apart
ENOUGH = 0.7  # of TOLERANCE: what a look may still show
SHOULDER_SLACK = 1.25  # of the tolerance at the armpit, whose overlap at ease varies with the pose
HALF_RAISED = tuple(np.deg2rad((18.0, 25.0, 55.0, 75.0)))  # [rad] from the trunk's axis down


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
    one pose says. So what touches in a look becomes rows for the solver.
    """

    def __init__(self, clip: Motion, character: Character, reference: Character, pairs: tuple[Pair, ...]):
        """`clip` holds the frames that the solver sees."""
        self.clip, self.character, self.reference, self.pairs = clip, character, reference, pairs
        self.frames = np.arange(clip.frame_count)
        count = min(clip.frame_count, max(LEAST_LOOKS, round(clip.frame_count * LOOK_SHARE)))
        self.at: Int[np.ndarray, " looks"] = np.unique(np.linspace(0, clip.frame_count - 1, count).round().astype(int))
        self.own = self._own(clip, self.at, pairs)
        self.basis = self.own.copy()
        key = ("skin at ease", pairs)
        if key not in reference.memo:
            reference.memo[key] = skin_depths(reference, at_ease(reference), pairs).depth.min(axis=0)
        self.at_ease = reference.memo[key] * _adjacent(pairs)
        self.touches: dict[int, Touches] = {}

    def _own(
        self, motion: Motion, at: Int[np.ndarray, " some"], pairs: tuple[Pair, ...]
    ) -> Float[np.ndarray, "some pairs"]:
        """What the reference shows playing a motion."""
        return skin_depths(self.reference, onto(motion[at], self.reference.skeleton), pairs).depth

    def depths(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """Depth [m] per look and pair of a motion of the solver's frames."""
        return skin_depths(self.character, motion[self.at], self.pairs).depth

    def depths_and_touches(self, motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """The same, and what goes beyond the reference is kept: `touches`, by frame, the latest ones first."""
        seen = motion[self.at]
        rotations, result = host_kinematics(seen)[1], np.zeros(self.basis.shape)
        for i, vertices, found in insides(self.character, seen, self.pairs):
            for (pair, *_), inside in found.items():
                result[i, pair] = max(result[i, pair], inside.depth.max(initial=0.0))
            new, frame = touches_of(self.character, rotations[i], vertices, found, self.basis[i]), int(self.at[i])
            self.touches[frame] = new.then(self.touches[frame]) if frame in self.touches else new
        return result

    def touch_term(self, columns: Int[np.ndarray, " some"], allowed: float, length: int) -> TouchClearance:
        """The touches of some pairs as rows for the solver, up to `allowed` [m] more than the reference shows."""
        limits = {int(frame): row + allowed for frame, row in zip(self.at, self.basis, strict=True)}
        return touch_term(self.character, self.touches, columns, limits, len(self.frames), length)

    def look_closer(self, risk: Float[np.ndarray, " frames"]) -> None:
        """Look at more frames from now on: those of greatest `risk`, apart from each other and from former looks."""
        risk, taken = risk.copy(), []
        for frame in self.at:
            risk[max(frame - LOOKS_APART, 0) : frame + LOOKS_APART + 1] = -np.inf
        while len(taken) < len(self.at) // 2 and risk.max() > -np.inf:
            taken.append(int(risk.argmax()))
            risk[max(taken[-1] - LOOKS_APART, 0) : taken[-1] + LOOKS_APART + 1] = -np.inf
        if taken:
            order = np.argsort(at := np.concatenate([self.at, taken]))
            more = self._own(self.clip, np.array(taken), self.pairs)
            self.own, self.basis = (np.concatenate([x, more])[order] for x in (self.own, self.basis))
            self.at = at[order]

    def quiet(self, seen: Float[np.ndarray, "looks pairs"], motion: Motion) -> Bool[np.ndarray, " pairs"]:
        """The pairs that show no more than the tolerance in any look at `motion`, of the solver's frames."""
        return (seen <= self._passes(self.own, motion) + TOLERANCE).all(axis=0)  # pyright: ignore[reportReturnType]

    def _passes(self, own: Float[np.ndarray, "looks pairs"], motion: Motion) -> Float[np.ndarray, "looks pairs"]:
        """The depth [m] that is none of the body's shape: what the reference shows in the frame or, within limits,
        at ease."""
        eased = np.stack([_half_raised(p, motion[self.at]) for p in self.pairs], axis=1)
        return np.maximum(own, eased * (self.at_ease + SHOULDER_SLACK * TOLERANCE) - NEARLY * TOLERANCE)

    def foresee(self, motion: Motion) -> None:
        """Expect as much from now on as adapting `motion`, the result so far, once more would: the reference that
        plays an adapted clip has its arms out and shows less overlap, which would pass for a violation."""
        # of parts that do not meet at a joint, little enough is kept anyway
        joined = _adjacent(self.pairs)
        own = self.own.copy()
        own[:, joined] = self._own(motion, self.at, tuple(p for p in self.pairs if p.adjacent))
        self.basis = np.minimum(self.basis, self._passes(own, motion))

    def joined(
        self, excess: Float[np.ndarray, "frames pairs"], on_skin: Float[np.ndarray, "looks pairs"],
        quiet: Bool[np.ndarray, " pairs"],
    ) -> Float[np.ndarray, "frames pairs"]:  # fmt: skip
        """Excess [m] on the fields or, in the looks, on the skin where that is more; 0 for quiet pairs."""
        excess = excess.copy()
        excess[self.at] = np.maximum(excess[self.at], on_skin)
        return np.where(quiet, 0.0, excess)


def _half_raised(pair: Pair, motion: Motion) -> Float[np.ndarray, " frames"]:
    """Where the reference's overlap at ease may stand for its own in the frame, 0..1: at a shoulder for an arm that is
    led away from the trunk somewhat, as in every adapted clip. An arm that hangs shows its overlap at ease anyway,
    and for one that is raised, that of a hanging arm means nothing."""
    if not pair.first.endswith("upper_arm"):
        return np.ones(motion.frame_count)
    skeleton, (positions, _) = motion.skeleton, host_kinematics(motion)
    side = pair.first.partition("_")[0]
    arm = positions[:, skeleton.joint(f"{side}_forearm")] - positions[:, skeleton.joint(f"{side}_upper_arm")]
    down = positions[:, skeleton.joint("hips")] - positions[:, skeleton.joint("chest")]
    cosine = (arm * down).sum(-1) / np.linalg.norm(arm, axis=-1) / np.linalg.norm(down, axis=-1)
    angle = np.arccos(np.clip(cosine, -1.0, 1.0))
    return np.interp(angle, HALF_RAISED, (0.0, 1.0, 1.0, 0.0))
