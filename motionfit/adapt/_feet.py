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
    keep_heights,
    keep_steps,
    rows_of,
    sole_paths,
    stop_drift,
)
from motionfit.metrics import slide_speeds

ROUNDS = 6  # of drift removal: a foot that stands better is seen to stand a little longer, or on another vertex
SIGMA = 0.001  # [m] of slide in a frame, and of height, that costs one half in the report


def footskate(fit: Fit, character: Character) -> Fit:
    """The fit with a root path on which no planted foot skates; every rotation is the very same array.

    The feet are planted where they are in the source, `fit.base`. What the blocks before did to a carrying foot's path
    and to the height of the lower foot is taken back; then the drift of the carrying foot is taken out, until
    none drifts by more than a centimetre in a stance. A clip in which none does, and whose legs no block turned, comes
    back as it was. Tremor stays: `motionfit.remove_footskate` holds a foot in every frame, at the price of jerk.
    """
    started = time.perf_counter()
    try:
        sole = find_sole(character)
    except InputError as error:
        raise InputError(f"{error}; or leave footskate out of the blocks") from None
    motion = fit.motion
    plants, evidence = detect(sole, fit.base)
    dt = plants.dt
    source, before = evidence.paths_world, sole_paths(sole, motion)
    shift = keep_steps(before, source, rows_of(sole, plants.carrier), dt)
    rise = keep_heights(sole, before, source, plants.floor, dt)
    for rounds in range(ROUNDS + 1):
        shift[:, 1] = 0.0
        shift[:, 1] = rise + plants.floor.at(shift) - plants.floor.height  # a floor may be tilted
        # what drifts is judged by the plants that the result itself shows: so it stays as it is when adapted again
        seen, found = detect(sole, _moved(motion, shift)) if shift.any() else (plants, evidence)
        more = stop_drift(sole, before + shift[:, None], found.speed, rows_of(sole, seen.carrier), seen)
        if not more.any() or rounds == ROUNDS:
            break
        shift += more
    costs = [_costs(sole, plants, paths, source) for paths in (before, before + shift[:, None])]
    status = "nothing_to_do" if not shift.any() else "max_steps" if more.any() else "converged"
    report = BlockReport("footskate", 0, status, rounds, *(sum(c.values()) for c in costs), *costs,
                         time.perf_counter() - started)  # fmt: skip
    result = _moved(motion, shift) if shift.any() else motion
    return dataclasses.replace(fit, motion=result, history=(*fit.history, report))


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
