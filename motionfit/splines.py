"""Splines over time: what a control's points mean in each frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.interpolate import BSpline
from scipy.ndimage import gaussian_filter1d

from motionfit._types import AnyArray, InputError

DEGREE = 3


class Basis(eqx.Module):
    """A cubic B-spline basis sampled at the frames of a clip.

    In frame t the four control points from `first[t]` on count, with the `values[t]`, which sum to one. So a
    control point touches only the frames under its support, and equal control points give a constant signal.
    """

    first: Int[AnyArray, " frames"]
    values: Float[AnyArray, "frames 4"]
    count: int = eqx.field(static=True)

    def __call__(self, points: Float[AnyArray, " points"]) -> Float[Array, " frames"]:
        """The signal that control points make, frame by frame."""
        points = jnp.asarray(points)
        return sum(points[jnp.asarray(self.first) + k] * self.values[:, k] for k in range(DEGREE + 1))  # type: ignore

    def __getitem__(self, frames: Int[np.ndarray, " some"]) -> "Basis":
        """The same basis seen at some frames only."""
        return Basis(self.first[frames], self.values[frames], self.count)


def bspline_basis(frame_count: int, dt: float, spacing: float) -> Basis:
    """A cubic B-spline basis with a knot about every `spacing` [s] on `frame_count` frames of `dt` [s].

    Knots lie on every n-th frame, from the first frame on, and go on past both ends, so the first and the last frame
    have four control points like every other; whatever the clip's length, frame t has the same ones.
    """
    if spacing <= 0:
        raise InputError(f"knot spacing must be above 0 s, got {spacing}")
    every = max(1, round(spacing / float(dt)))
    spans = max(1, -(-(frame_count - 1) // every))
    knots = np.arange(-DEGREE, spans + DEGREE + 1) * float(every)
    rows = BSpline.design_matrix(np.arange(frame_count, dtype=float), knots, DEGREE)
    first = rows.indices.reshape(frame_count, DEGREE + 1)
    return Basis(first[:, 0].astype(np.int32), rows.data.reshape(frame_count, DEGREE + 1), spans + DEGREE)


def per_frame(frame_count: int) -> Basis:
    """A value of its own for every frame: control point t is frame t's (the three behind the last count nowhere)."""
    values = np.zeros((frame_count, DEGREE + 1))
    values[:, 0] = 1.0
    return Basis(np.arange(frame_count, dtype=np.int32), values, frame_count + DEGREE)


def knots_basis(knots: Float[np.ndarray, " knots"], frame_count: int) -> Basis:
    """A cubic B-spline basis on knots of one's own, in frames, ascending, from 0 or before to the last frame or after.

    Beyond both ends the outermost intervals are repeated, so that every frame has four control points.
    """
    knots = np.asarray(knots, float)
    if len(knots) < 2 or (np.diff(knots) <= 0).any() or knots[0] > 0 or knots[-1] < frame_count - 1:
        raise InputError(f"knots must ascend and span the frames 0 to {frame_count - 1}, got {knots.tolist()}")
    steps = np.arange(1, DEGREE + 1)
    whole = np.concatenate([knots[0] - (knots[1] - knots[0]) * steps[::-1], knots,
                            knots[-1] + (knots[-1] - knots[-2]) * steps])  # fmt: skip
    rows = BSpline.design_matrix(np.arange(frame_count, dtype=float), whole, DEGREE)
    first = rows.indices.reshape(frame_count, DEGREE + 1)
    return Basis(first[:, 0].astype(np.int32), rows.data.reshape(frame_count, DEGREE + 1), len(whole) - DEGREE - 1)


def knots_at_extrema(
    demand: Float[np.ndarray, " frames"], least: float, most: float = 60.0, threshold: float = 0.0
) -> Float[np.ndarray, " knots"]:
    """Knots where a demand over time (a violation, a wanted turn) has its extrema, in frames: for any motion.

    The idea of thesis 6.2, which leaves the placement open. Ends of the clip, the extrema of the smoothed demand, and
    where it rises over `threshold` and falls under it; between knots more than `most` frames apart there are more,
    and of those nearer than `least` frames only the first stays.
    """
    demand = np.asarray(demand, float)
    last = len(demand) - 1
    smooth = gaussian_filter1d(demand, max(least / 2, 0.5), mode="nearest")
    slopes = np.sign(np.diff(smooth))
    turning = np.flatnonzero(slopes[1:] * slopes[:-1] < 0) + 1
    crossing = np.flatnonzero(np.diff((smooth > threshold).astype(int)) != 0) + 1
    wanted = np.unique(np.concatenate([[0], turning[smooth[turning] > threshold], crossing, [max(last, 1)]]))
    kept = [wanted[0]]
    for knot in wanted[1:]:
        if knot - kept[-1] >= least:
            kept.append(knot)
    if kept[-1] != wanted[-1]:
        kept = [*kept[: max(len(kept) - 1, 1)], wanted[-1]] if len(kept) > 1 else [kept[0], wanted[-1]]
    return _filled(np.array(kept, float), most)


def refined_knots(
    knots: Float[np.ndarray, " knots"], residual: Float[np.ndarray, " frames"], tolerance: float, least: float = 2.0
) -> Float[np.ndarray, " more"]:
    """The knots with one more in the middle of every interval, and of its neighbours, whose residual exceeds
    `tolerance`, down to intervals of `least` frames."""
    residual = np.asarray(residual, float)
    middles = []
    for k, (a, b) in enumerate(zip(knots, knots[1:], strict=False)):
        low, high = knots[max(k - 1, 0)], knots[min(k + 2, len(knots) - 1)]
        seen = residual[max(int(low), 0) : int(high) + 1]
        if b - a >= 2 * least and seen.max(initial=0.0) > tolerance:
            middles.append((a + b) / 2)
    return np.sort(np.concatenate([knots, middles]))


def _filled(knots: Float[np.ndarray, " knots"], most: float) -> Float[np.ndarray, " more"]:
    """More knots, evenly, where two are more than `most` frames apart."""
    spans = [np.linspace(a, b, max(1, int(np.ceil((b - a) / most))) + 1)[:-1] for a, b in zip(knots, knots[1:], strict=False)]  # fmt: skip
    return np.concatenate([*spans, knots[-1:]])
