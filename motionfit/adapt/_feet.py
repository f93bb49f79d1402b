"""The footskate block: after the limbs, the root alone makes the feet stand as they did. Thesis 5.2, chapter 3."""

import dataclasses
import time

import numpy as np
from jaxtyping import Float

from motionfit._character import Character
from motionfit._fit import BlockReport, Fit
from motionfit._motion import Motion
from motionfit._types import InputError
from motionfit.feet import (
    Footplants,
    Sole,
    detect,
    find_sole,
    follow_feet,
    keep_heights,
    keep_steps,
    rows_of,
    sole_paths,
    stop_drift,
)
from motionfit.metrics import slide_speeds

ROUNDS = 6  # of drift removal: a foot that stands better is seen to stand a little longer, or on another vertex
SIGMA = 0.001  # [m] of slide in a frame, and of height, that costs one half in the report


def footskate(
    clip: Motion, character: Character, so_far: Fit, *, reference: Character | None = None, drift: bool = True,
    legs: bool = False,
) -> Fit:  # fmt: skip
    """The fit so far with a root path on which no planted foot skates; every rotation is the very same array.

    The feet are planted where they are in the source, `so_far.base`. What the blocks before did to a carrying foot's
    path and to the height of the lower foot is taken back. With `drift` the drift of the carrying foot is taken out
    too, until none drifts by more than a centimetre in a stance; without it, what the source drifts is left. A clip
    whose feet do neither comes back as it was. Tremor stays: `motionfit.remove_footskate` holds a foot in every frame,
    at the price of jerk.

    With `legs` the legs take back what the blocks before did to the feet, both at once, instead of the root: it does
    not sway, and the zero-moment point stays near the support, but thighs and shanks turn by a degree or two away from
    what kept them apart, and the correction's own rotations are no longer the motion's.
    """
    del clip, reference  # the feet are the character's own
    started = time.perf_counter()
    try:
        sole = find_sole(character)
    except InputError as error:
        raise InputError(f"{error}; or leave footskate out of the blocks") from None
    motion = so_far.motion
    plants, evidence = detect(sole, so_far.base)
    dt = plants.dt
    source, first = evidence.paths_world, sole_paths(sole, motion)
    if legs:
        motion, _ = follow_feet(motion, sole, first, source, rows_of(sole, plants.vertex))
        before, shift, rise = sole_paths(sole, motion), np.zeros((len(first), 3)), np.zeros(len(first))
    else:
        before, shift = first, keep_steps(first, source, rows_of(sole, plants.carrier), dt)
        rise = keep_heights(sole, before, source, plants.floor, dt)
    for rounds in range(ROUNDS + 1):
        shift[:, 1] = 0.0
        shift[:, 1] = rise + plants.floor.at(shift) - plants.floor.height  # a floor may be tilted
        more = np.zeros_like(shift)
        if not drift:
            break
        # what drifts is judged by the plants that the result itself shows: so it stays as it is when adapted again
        same = motion is so_far.base and not shift.any()
        seen, found = (plants, evidence) if same else detect(sole, _moved(motion, shift))
        more = stop_drift(sole, before + shift[:, None], found.speed, rows_of(sole, seen.carrier), seen)
        if not more.any() or rounds == ROUNDS:
            break
        shift += more
    costs = [_costs(sole, plants, paths, source) for paths in (first, before + shift[:, None])]
    status = (
        "nothing_to_do" if motion is so_far.motion and not shift.any() else "max_steps" if more.any() else "converged"
    )
    report = BlockReport("footskate", 0, status, rounds, *(sum(c.values()) for c in costs), *costs,
                         time.perf_counter() - started)  # fmt: skip  # pyright: ignore[reportCallIssue]
    result = _moved(motion, shift) if shift.any() else motion
    return dataclasses.replace(so_far, motion=result, history=(*so_far.history, report))


def _moved(motion: Motion, shift: Float[np.ndarray, "frames 3"]) -> Motion:
    root = np.asarray(motion.root)
    return dataclasses.replace(motion, root=(root + shift).astype(root.dtype))


def _costs(
    sole: Sole, plants: Footplants, paths: Float[np.ndarray, "frames soles 3"],
    source: Float[np.ndarray, "frames soles 3"],
) -> dict[str, float]:  # fmt: skip
    """Half the sums of squares of the carrying vertex's slide per frame, and of how much higher or lower the lowest
    sole vertex is than in the source."""
    slides = np.nan_to_num(slide_speeds(paths, rows_of(sole, plants.carrier), plants.dt)) * plants.dt
    heights = paths[..., 1].min(1) - source[..., 1].min(1)
    return {name: float(0.5 * np.sum((x / SIGMA) ** 2)) for name, x in (("slide", slides), ("height", heights))}
