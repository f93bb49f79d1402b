"""Legs that follow their feet: what turned thighs did to planted feet is taken back by the legs, not by the root.

The root can follow one foot at a time, and sways with it: where thighs are turned apart by an angle that changes by
two degrees within a stance, by centimetres, and the zero-moment point by decimetres. Here the root keeps its way, each
planted foot steps as in the source, wherever it stands, and thigh and shank are turned for it by the analytic leg
(appendix C). Both feet can be held at once.
"""

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._motion import Motion
from motionfit.feet._detect import smooth
from motionfit.feet._leg import CALM, find_legs, leg_kinematics, lowering, pass_over, turn_legs
from motionfit.feet._plants import runs
from motionfit.feet._sole import Sole


def follow_feet(
    motion: Motion,
    sole: Sole,
    paths_world: Float[np.ndarray, "frames soles 3"],
    source_world: Float[np.ndarray, "frames soles 3"],
    rows: Int[np.ndarray, "frames 2"],
) -> tuple[Motion, Bool[np.ndarray, "frames 2"]]:
    """The motion with planted feet that step as in the source, and which legs reached.

    Both paths [m] are those of the sole; `rows` say on which of its vertices each foot stands (-1: not down). Within a
    plant the vertex moves as in the source, from a place that is chosen so that the leg turns as little as
    possible on the whole, and the foot's lowest vertex is as high as there. The feet keep their orientation. Where
    the feet moved as in the source the very same motion comes back.
    """
    missing, dt = source_world - paths_world, float(motion.dt)
    reachable = np.ones(rows.shape, bool)
    if not missing.any() or not (rows >= 0).any():
        return motion, reachable
    moves = np.zeros((len(rows), 2, 3))
    for foot in (0, 1):
        mine, plants = sole.of(foot), runs(rows[:, foot] >= 0)
        for start, end in plants:
            part, at, standing = slice(start, end + 1), np.arange(start, end), rows[start : end + 1, foot]
            halves = [missing[at + 1, v] - missing[at, v] for v in (standing[:-1], standing[1:])]
            moves[start + 1 : end + 1, foot] = np.cumsum(0.5 * (halves[0] + halves[1]), axis=0)
            moves[part, foot, 1] = source_world[part, mine, 1].min(1) - paths_world[part, mine, 1].min(1)
        if plants:
            for axes, anywhere in (([0, 2], True), ([1], False)):
                moves[:, foot, axes] = pass_over(moves[:, foot, axes], plants, dt, anywhere=anywhere)
    positions, rotations = leg_kinematics(motion)
    targets = [leg.ankle + moves[:, f] for f, leg in enumerate(find_legs(motion.skeleton, positions, rotations))]
    # the root takes what both feet ask for on the whole, and comes down where a leg is too short
    calm = 2 * round(CALM / dt / 2) + 1
    up = np.array([0.0, 1.0, 0.0]) * smooth(smooth(moves[..., 1].mean(1), calm), calm)[:, None]
    legs = find_legs(motion.skeleton, positions + up[:, None], rotations)
    up[:, 1] -= lowering(legs, targets, dt)
    legs = find_legs(motion.skeleton, positions + up[:, None], rotations)
    local, reachable = turn_legs(motion, legs, targets, rotations)
    root, before = np.asarray(motion.root), np.asarray(motion.rotations)
    result = Motion(motion.skeleton, (root + up).astype(root.dtype), local.astype(before.dtype), motion.dt,
                    motion.translations)  # fmt: skip
    return result, reachable | (rows < 0)
