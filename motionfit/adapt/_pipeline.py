"""`adapt`: a clip and a character in, an adapted clip out. Thesis 4.4 and 4.5, block after block."""

from collections.abc import Callable, Mapping, Sequence

import numpy as np

from motionfit._character import Character
from motionfit._control import Control
from motionfit._fit import Block, Fit, fit
from motionfit._motion import Motion
from motionfit._onto import onto
from motionfit._problem import Problem, Term
from motionfit._types import InputError
from motionfit.adapt._clearance import Clearance, allowance, build_clearance, rest_depths, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.metrics import TOLERANCE
from motionfit.shape.growth import grow
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import bspline_basis
from motionfit.terms.pose import Effort, Smoothness

BLOCKS = ("arms", "legs")

KNOT_SPACING = 0.1  # [s]
ALLOWED_EXCESS = 0.003  # [m]
MARGIN = 0.004  # [m]
SIGMA_DEPTH = 0.01  # [m]
SIGMA_EFFORT = {"left_arm": 1.0, "right_arm": 1.0, "hip_turn": 1.0, "thighs_apart": 1.0}  # [rad]
SIGMA_BEND = 60.0  # [rad/s^2]


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

    The `Fit` holds the adapted motion, the correction, what each block did, and per pair and frame the excess
    depth [m] on the volumes before and after (`fit.details["excess_before_m"]`, `["excess_after_m"]`).
    """
    unknown = [b for b in blocks if b not in BLOCKS]
    if unknown:
        raise InputError(f"unknown block {', '.join(map(repr, unknown))}; blocks: {', '.join(BLOCKS)}")
    if girth:
        reference, character = reference or character, grow(character, girth)
    base = onto(clip, character.skeleton)
    pairs = pairs_of(*blocks)
    controls: list[Control] = []
    terms: dict[str, Term] = {}
    made: list[Block] = []
    limits, clearances = {}, {}
    basis = bspline_basis(base.frame_count, float(base.dt), KNOT_SPACING)
    for block in blocks:
        own = pairs_of(block)
        clearance = build_clearance(character, own, objective)
        limit = reference_depths(clip, character, reference, own, objective, clearance)
        excess = volume_depths(clearance, base) - limit
        allowed = (limit + allowance(excess, ALLOWED_EXCESS, MARGIN))[:, list(clearance.pair_of_row)]
        new = (arm_controls(character, base, clearance, allowed, basis) if block == "arms"
               else leg_controls(character, base, basis))  # fmt: skip
        controls += new
        terms[f"{block}_clearance"] = clearance.allowing(allowed)
        limits[block], clearances[block] = limit, clearance
        made.append(Block(block, tuple(c.name for c in new), (f"{block}_clearance", "effort", "smoothness")))
    sigma = np.array([SIGMA_EFFORT[c.name] for c in controls])
    terms |= {"effort": Effort(sigma), "smoothness": Smoothness(SIGMA_BEND)}
    problem = Problem(character, base, terms, tuple(controls))
    result = fit(problem, made, sweeps, progress=progress)
    before = np.concatenate([volume_depths(clearances[b], base) - limits[b] for b in blocks], axis=1)
    after = np.concatenate([volume_depths(clearances[b], result.motion) - limits[b] for b in blocks], axis=1)
    left = float(np.maximum(after, 0).max(initial=0.0))
    status = "violations_left" if left > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in pairs], "excess_before_m": before, "excess_after_m": after}
    return Fit(result.correction, result.motion, base, status, result.history, problem, details)


def arms(clip: Motion, character: Character, **options) -> Fit:
    """The arm block alone: thesis 4.4.1. Options as in `adapt`."""
    return adapt(clip, character, blocks=("arms",), **options)


def legs(clip: Motion, character: Character, **options) -> Fit:
    """The leg block alone: thesis 4.5. Options as in `adapt`."""
    return adapt(clip, character, blocks=("legs",), **options)
