"""The floor under a clip: a plane fitted to where the feet touch, never assumed to lie at zero."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from motionfit._types import AnyArray

TILT_PRIOR = 0.02  # standard deviation of a capture floor's slope [m/m]: the CMU takes show up to 0.017
NOISE = 0.012  # [m] standard deviation of the height at which a sole touches, from step to step and foot to foot
STEPS = 8  # as many independent looks at the floor as a clip counts for: frames of one step say the same
OUTLIER = 0.03  # [m] residuals beyond this are no contact (Tukey's biweight)


class Floor(NamedTuple):
    """The plane y = height + slope_x x + slope_z z in the world, y up; height in [m], slopes in [m/m]."""

    height: float = 0.0
    slope_x: float = 0.0
    slope_z: float = 0.0

    def at(self, points_world: Float[AnyArray, "... 3"]) -> Float[np.ndarray, "..."]:
        """Height of the floor [m] under (or over) points."""
        points = np.asarray(points_world, float)
        return np.asarray(self.height + self.slope_x * points[..., 0] + self.slope_z * points[..., 2])

    def above(self, points_world: Float[AnyArray, "... 3"]) -> Float[np.ndarray, "..."]:
        """Height of points over the floor [m], measured along the vertical."""
        return np.asarray(np.asarray(points_world, float)[..., 1] - self.at(points_world))

    @property
    def tilt(self) -> float:
        """Steepest slope [rad]."""
        return float(np.arctan(np.hypot(self.slope_x, self.slope_z)))


def fit_floor(
    points_world: Float[np.ndarray, "points 3"], weights: Float[np.ndarray, " points"] | None = None
) -> Floor:
    """The plane through contact points, robust against points in the air and cautious about tilt.

    Iteratively reweighted least squares with Tukey's biweight, from the lower third of the heights on: a foot held
    up stands still too, but the floor is below it. The slopes carry a normal prior of `TILT_PRIOR`, so that feet
    that stay within a step of each other do not tilt the floor by their own noise. No points: the plane y = 0.
    """
    if len(points_world) == 0:
        return Floor()
    weights = np.ones(len(points_world)) if weights is None else np.asarray(weights, float)
    if weights.sum() <= 0:
        weights = np.ones(len(points_world))
    heights = points_world[:, 1]
    order = np.argsort(heights)
    share = np.cumsum(weights[order]) / weights.sum()
    height = float(heights[order[np.searchsorted(share, 1 / 3)]])
    # the slope's own origin: amid the points, so that the prior on the slopes does not depend on where they are
    centre = weights @ points_world[:, [0, 2]] / weights.sum()
    across = points_world[:, [0, 2]] - centre
    design = np.column_stack([np.ones(len(heights)), across])
    prior = np.diag([0.0, 1.0, 1.0]) * (NOISE / TILT_PRIOR) ** 2
    plane = np.array([height, 0.0, 0.0])
    # wide at first, since a tilted floor leaves large residuals to a level start
    for width in (4, 3, 2, 1.5, 1, 1, 1, 1):
        residual = heights - design @ plane
        robust = weights * np.maximum(1 - (residual / (width * OUTLIER)) ** 2, 0.0) ** 2
        total = robust.sum()
        if total <= 0:
            break
        shared = (STEPS / total * robust) * design.T
        # residuals against the current plane keep an exact fit exact
        plane = plane + np.linalg.solve(shared @ design + prior, shared @ residual - prior @ plane)
    return Floor(float(plane[0] - plane[1:] @ centre), float(plane[1]), float(plane[2]))
