"""`adapt`: a clip and a character in, an adapted clip out. Thesis 4.4 and 4.5, block after block."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d

from motionfit._character import Character
from motionfit._control import Control
from motionfit._fit import Block, Fit, fit
from motionfit._motion import Motion
from motionfit._onto import onto
from motionfit._problem import Problem, Term
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, allowance, build_clearance, rest_depths, standing, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.metrics import TOLERANCE, skin_depths
from motionfit.shape.growth import grow
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import bspline_basis
from motionfit.terms.pose import Effort, Smoothness

BLOCKS = ("arms", "legs")

KNOT_SPACING = 0.1  # [s]
ALLOWED_EXCESS = 0.003  # [m]
MARGIN = 0.004  # [m]
SIGMA_DEPTH = 0.01  # [m]
SIGMA_EFFORT = {"left_arm": 1.0, "right_arm": 1.0, "hip_turn": 0.1, "thighs_apart": 1.0}  # [rad]
SIGMA_BEND = 5.0  # [rad/s^2]
SKIN_ROUNDS = 3
SKIN_INTERVAL = 1 / 15  # [s] between two looks at the skin
SKIN_TOLERANCE = 0.007  # [m] excess that stays as it is
SKIN_AIM = 0.004  # [m]
SKIN_GAIN = 1.3


def reference_depths(
    clip: Motion, character: Character, reference: Character | None, pairs: tuple[Pair, ...], objective: str,
    clearance: Clearance,
) -> np.ndarray:  # fmt: skip
    """Depth [m] per frame and pair that does not count: the clip's on the reference body, else that at rest."""
    if reference is None:
        return np.tile(rest_depths(clearance, character), (clip.frame_count, 1))
    own = build_clearance(reference, pairs, objective)
    return volume_depths(own, onto(clip, reference.skeleton))


def adapt(
    clip: Motion,
    character: Character,
    *,
    reference: Character | None = None,
    girth: Mapping[str, float] | None = None,
    blocks: Sequence[str] = BLOCKS,
    objective: str = "vertex",
    sweeps: int = 2,
    progress: Callable[[str, int, int], None] | None = None,
) -> Fit:
    """Adapt a clip to the shape of a character.

    The clip is put on the character (`motionfit.onto`), then the blocks run in turn, `sweeps` times: `arms` keeps
    upper arms, forearms and hands out of the trunk and the thighs, `legs` the thighs and calves apart.
    Penetration counts as far as it exceeds what the same clip shows on `reference`, the body that it was made
    for; without one, on the character before `girth`, else in its rest pose.

    With a reference, the skin itself is looked at after the solve, some times per second, and where it shows more
    than a few millimetres the volumes are given that much less room, up to three times.

    The `Fit` holds the adapted motion, the correction, what each block did, and per pair and frame the excess
    depth [m] on the volumes before and after (`fit.details["excess_before_m"]`, `["excess_after_m"]`).
    """
    unknown = [b for b in blocks if b not in BLOCKS]
    if unknown or not blocks:
        raise InputError(f"unknown block {', '.join(map(repr, unknown)) or 'list'}; blocks: {', '.join(BLOCKS)}")
    if girth:
        reference, character = reference or character, grow(character, girth)
    base = onto(clip, character.skeleton)
    pairs = pairs_of(*blocks)
    basis = bspline_basis(base.frame_count, float(base.dt), KNOT_SPACING)
    step = max(1, round(SKIN_INTERVAL / float(base.dt)))
    quiet = own_joint = np.zeros(len(pairs), bool)
    if reference is not None:
        # A pair that shows no violation is left alone. What the reference shows standing with its arms hanging is
        # the joint's own overlap, at the armpit above all: measured against the reference frame by frame it would
        # count as excess wherever a clip holds the arms out, as every adapted clip does, and each further
        # adaptation would push them further out.
        own = skin_depths(reference, onto(clip, reference.skeleton), pairs, step=step)
        at_ease = skin_depths(reference, standing(reference.skeleton), pairs).depth
        at_ease = at_ease * np.array([p.adjacent for p in pairs])
        untouched = skin_depths(character, base, pairs, step=step).depth
        own_joint = at_ease[0] > 0
        quiet = (untouched - np.maximum(own.depth, at_ease)).max(axis=0) <= TOLERANCE
    controls: list[Control] = []
    made: list[Block] = []
    recipes: list[_Recipe] = []
    for name in blocks:
        clearance = build_clearance(character, pairs_of(name), objective)
        limit = reference_depths(clip, character, reference, clearance.pairs, objective, clearance)
        excess = volume_depths(clearance, base) - limit
        allowed = limit + allowance(excess, ALLOWED_EXCESS, MARGIN)
        if reference is not None:
            mine = [pairs.index(p) for p in clearance.pairs]
            alone = quiet[mine] & ((excess.max(axis=0) <= TOLERANCE) | own_joint[mine])
            allowed = np.where(alone, np.maximum(allowed, excess + limit), allowed)
            quiet[mine] = alone
        recipe = _Recipe(name, clearance, limit, allowed)
        new = (arm_controls(character, base, clearance, recipe.allowed_rows, basis) if name == "arms"
               else leg_controls(character, base, basis))  # fmt: skip
        controls += new
        recipes.append(recipe)
        made.append(Block(name, tuple(c.name for c in new), (f"{name}_clearance", "effort", "smoothness")))
    effort = Effort(np.array([SIGMA_EFFORT[c.name] for c in controls]))

    def problem_of(recipes: list[_Recipe]) -> Problem:
        terms: dict[str, Term] = {f"{r.name}_clearance": r.clearance.allowing(r.allowed_rows) for r in recipes}
        return Problem(
            character, base, terms | {"effort": effort, "smoothness": Smoothness(SIGMA_BEND)}, tuple(controls)
        )

    rounds = 1 + (SKIN_ROUNDS if reference is not None and objective == "vertex" else 0)
    total, history, correction = rounds * sweeps * len(made), [], None
    for round_ in range(rounds):
        problem = problem_of(recipes)
        result = fit(problem, made, sweeps, correction=correction, progress=None if progress is None else (
            lambda name, done, _, round_=round_: progress(name, round_ * sweeps * len(made) + done, total)))  # fmt: skip
        history, correction = [*history, *result.history], result.correction
        if round_ == rounds - 1:
            break
        # the volumes are a model: what the skin itself still shows is taken off what they may keep
        seen = skin_depths(character, result.motion, pairs, step=step)
        excess = np.where(quiet, 0.0, seen.depth - own.depth)
        if excess.max(initial=0.0) <= SKIN_TOLERANCE:
            break
        recipes = _tighten(recipes, pairs, seen.frames, excess, base.frame_count, float(base.dt))
    before, after = (
        np.concatenate([volume_depths(r.clearance, m) - r.limit for r in recipes], axis=1)
        for m in (base, result.motion)
    )
    order = [pairs.index(p) for r in recipes for p in r.clearance.pairs]
    left = after[:, ~quiet[order]].max(initial=0.0)
    status = "violations_left" if left > TOLERANCE else "converged"
    details = {"pairs": [p.name for r in recipes for p in r.clearance.pairs],
               "excess_before_m": before, "excess_after_m": after}  # fmt: skip
    return Fit(correction, result.motion, base, status, tuple(history), problem, details)


class _Recipe(NamedTuple):
    """What a block works with: its clearance, the reference's depths, and the depths that may stay [m]."""

    name: str
    clearance: Clearance
    limit: Float[np.ndarray, "frames pairs"]
    allowed: Float[np.ndarray, "frames pairs"]

    @property
    def allowed_rows(self) -> Float[np.ndarray, "frames rows"]:
        return self.allowed[:, list(self.clearance.pair_of_row)]


def _tighten(
    recipes: list[_Recipe], pairs: tuple[Pair, ...], seen: np.ndarray, excess: np.ndarray, frame_count: int, dt: float
) -> list[_Recipe]:
    """Less may stay where the skin shows more than its tolerance: per pair, around the frames that show it."""
    over = np.where(excess > SKIN_TOLERANCE, excess - SKIN_AIM, 0.0)
    frames = np.arange(frame_count)
    more = np.stack([np.interp(frames, seen, column) for column in over.T], axis=1)
    # wide enough for a spline to follow, and nowhere less than what the frame itself needs
    width = max(1, round(0.1 / dt))
    more = gaussian_filter1d(maximum_filter1d(more, 2 * width + 1, axis=0), width / 2, axis=0, mode="nearest")
    tightened = []
    for recipe in recipes:
        columns = [pairs.index(p) for p in recipe.clearance.pairs]
        tightened.append(recipe._replace(allowed=recipe.allowed - SKIN_GAIN * more[:, columns]))
    return tightened


def arms(clip: Motion, character: Character, **options) -> Fit:
    """The arm block alone: thesis 4.4.1. Options as in `adapt`."""
    return adapt(clip, character, blocks=("arms",), **options)


def legs(clip: Motion, character: Character, **options) -> Fit:
    """The leg block alone: thesis 4.5. Options as in `adapt`."""
    return adapt(clip, character, blocks=("legs",), **options)
