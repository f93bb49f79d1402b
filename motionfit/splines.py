"""Splines over time: what a control's points mean in each frame."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.interpolate import BSpline

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
