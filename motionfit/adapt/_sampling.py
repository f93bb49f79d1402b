"""The clip as the solver sees it: some of its frames, and one basis for both."""

import dataclasses
from typing import NamedTuple

import numpy as np
from jaxtyping import Int

from motionfit._control import Control
from motionfit._motion import Motion, bucket
from motionfit.splines import Basis, bspline_basis

SOLVE_RATE = 60.0  # [1/s] of the frames that the solver sees: between two of them a limb's depth changes by millimetres
KNOT_SPACING = 0.1  # [s]


class Sampling(NamedTuple):
    """Which `frames` of a clip the solver sees, at `dt` [s]; `rows` are those, the last repeated up to a bucket's
    length. Knots lie on the same instants in `basis`, of the rows, and in `whole`, of the clip: the control points
    are the same."""

    frames: Int[np.ndarray, " seen"]
    rows: Int[np.ndarray, " bucket"]
    dt: float
    basis: Basis
    whole: Basis

    def motion(self, clip: Motion) -> Motion:
        """The frames that are seen."""
        return dataclasses.replace(clip[self.frames], dt=np.asarray(self.dt))

    def control(self, control: Control) -> Control:
        """A control of the whole clip, as it is seen."""
        return dataclasses.replace(control[self.rows], basis=self.basis)


def sampling(clip: Motion, knot_spacing: float = KNOT_SPACING, rate: float = SOLVE_RATE, least: int = 0) -> Sampling:
    """The frames nearest to a `rate` [1/s], filled up to `least` rows or more, and knots every `knot_spacing` [s]."""
    step = max(1, round(clip.frame_rate / rate))
    frames = np.arange(0, clip.frame_count, step)
    dt, length = float(clip.dt) * step, bucket(max(len(frames), least))
    rows = frames[np.minimum(np.arange(length), len(frames) - 1)]
    every = max(1, round(knot_spacing / dt)) * step
    return Sampling(frames, rows, dt, bspline_basis(length, dt, knot_spacing),
                    bspline_basis(clip.frame_count, float(clip.dt), every * float(clip.dt)))  # fmt: skip
