"""Giving way: a result becomes the fit again that it came from, as far as need be, where it shows what it must not."""

import dataclasses
from collections.abc import Callable

import numpy as np
from jaxtyping import Bool, Float
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from scipy.spatial.transform import Rotation

from motionfit._fit import Fit
from motionfit._motion import Motion
from motionfit.adapt._limits import MOST_JERK, NEARLY, SkinLooks
from motionfit.adapt._record import put_down
from motionfit.adapt._sampling import Sampling
from motionfit.metrics import TOLERANCE, derivative_ratio

SLOPE = 0.08  # [s] of the Gaussian that a share rises and falls by
YIELDS = 0.2  # [s] around what sinks in, in which a correction gives way
ROUGHER = 0.01  # of the jerk's ratio, that is borne
GIVES = (0.1, 0.2, 0.3, *(0.5,) * 5)  # of what sinks in, one after the other: a touch bears little of it


def sinking_skin(looks: SkinLooks, small: Motion, at: Sampling) -> Callable[[Fit], Bool[np.ndarray, " seen"]]:
    """Says of a fit in which of the frames that are seen an arm or leg sinks in that was out in `small`: at a shoulder
    the fields, which controls are solved by, do not know the skin."""
    most = np.maximum(looks.depths(small) - looks.own, NEARLY * TOLERANCE)

    def sunk(fit: Fit) -> Bool[np.ndarray, " seen"]:
        result = np.zeros(small.frame_count, bool)
        result[looks.at] = (looks.depths(at.motion(fit.motion)) - looks.own > most).any(axis=1)
        return result

    return sunk


def eased(name: str, so_far: Fit, result: Fit, at: Sampling, sunk: Callable[[Fit], Bool[np.ndarray, " seen"]]) -> Fit:
    """A result that becomes `so_far` again, as far as need be, around the frames that show something `sunk`."""
    dt = float(so_far.motion.dt)
    share, whole, width = np.ones(so_far.motion.frame_count), result, SLOPE / dt
    for gives in GIVES:
        where = sunk(result)
        if not where.any() and rougher(result, so_far) <= ROUGHER:
            return result
        around = np.zeros(len(share))
        around[at.frames[where]] = 1.0
        around = gaussian_filter1d(maximum_filter1d(around, 2 * round(YIELDS / dt) + 1), width)
        share = share * (1.0 - gives * around) if where.any() else (1.0 - gives) * share
        result = between(name, so_far, whole, share)
    return so_far


def rougher(fit: Fit, so_far: Fit) -> float:
    """By how much the jerk of a fit, as a ratio to its base's, is more than it may be: that of `so_far` may stay."""
    now, before = (derivative_ratio(f.motion, so_far.base, 3) or 1.0 for f in (fit, so_far))
    return now - max(MOST_JERK, before)


def between(name: str, so_far: Fit, result: Fit, share: Float[np.ndarray, " frames"]) -> Fit:
    """A fit that is `so_far` where the share is 0, and the `result` where it is 1."""
    before, after = (np.asarray(fit.motion.rotations, float) for fit in (so_far, result))
    rotations, joints = after.copy(), np.flatnonzero((before != after).any(axis=(0, 2))).tolist()
    for joint in joints:
        first, last = (Rotation.from_quat(q[:, joint], scalar_first=True) for q in (before, after))
        turned = Rotation.from_rotvec(share[:, None] * (last * first.inv()).as_rotvec()) * first
        rotations[:, joint] = turned.as_quat(scalar_first=True)
    motion = dataclasses.replace(result.motion, rotations=rotations)
    return put_down(name, result, motion, result.base, result.correction, joints)
