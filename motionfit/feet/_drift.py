"""The root method for a motion that has to stay itself: what moved the feet is taken back, and drift is stopped, calmly.

`_root.py` holds the planted vertex in every frame. A recorded foot trembles by a millimetre or two from one frame to
the next; held, it hands that on to the whole body, whose jerk grows by a tenth to a half on clips at 120 frames
per second. Here the root makes up for what turned joints did to the feet (`keep_steps`, `keep_heights`), which is
as calm as the turns, and of the source's own skating only what the eye sees is taken out: the drift (`stop_drift`).
No joint is turned.
"""

import numpy as np
from jaxtyping import Float, Int
from scipy.interpolate import BSpline
from scipy.ndimage import maximum_filter1d
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import spsolve

from motionfit.feet._detect import smooth
from motionfit.feet._floor import Floor
from motionfit.feet._plants import Footplants, runs
from motionfit.feet._root import carry_over_flights, root_steps
from motionfit.feet._sole import Sole
from motionfit.splines import DEGREE

DRIFT = 0.01  # [m] a foot that drifts by less during a plant stands
CALM = 0.3  # [s] between the knots of the drift's correction: with 0.1 s a turning run's mean ZMP distance went from 6
# to 22 cm, with this it stays
KNOTS = 0.1  # [s] between those of the height's: as calm as the controls of `motionfit.adapt`
KINK = 0.04  # [s] within which the weight goes over from one foot to the other, twice
LEVEL = 0.3  # weight of equal neighbouring knots, in frames with a foot down: it decides in flight only
LOW = 0.02  # [m] a foot that much higher than the other one counts 1/e as much for the height
DEEPER = 0.001  # [m] that a sole may go under the floor beyond the source's deepest


def keep_steps(
    paths_world: Float[np.ndarray, "frames soles 3"],
    source_world: Float[np.ndarray, "frames soles 3"],
    standing_on: Int[np.ndarray, " frames"],
    dt: float,
) -> Float[np.ndarray, "frames 3"]:
    """The horizontal move of the root [m] for which the vertex stood on steps as it does in the source.

    Both paths [m] are those of the sole, `standing_on` its row per frame (-1 in flight, where the root's move passes
    over from the stance before to the one after). Where the weight goes over to another vertex both count half.
    Zero, exactly, where the feet moved as in the source.
    """
    frames = len(paths_world)
    shift = np.zeros((frames, 3))
    missing = source_world - paths_world
    if frames < 2 or not missing.any():
        return shift
    steps, held = np.arange(frames - 1), (standing_on[1:] >= 0) & (standing_on[:-1] >= 0)
    halves = [missing[steps + 1, v] - missing[steps, v] for v in (standing_on[:-1], standing_on[1:])]
    moved = np.where(held[:, None], 0.5 * (halves[0] + halves[1]), 0.0)
    moved[:, 1] = 0.0
    carry_over_flights(moved, held, dt)
    # feet that were turned differently hand over with a kink
    width = 2 * max(1, round(0.5 * KINK / dt)) + 1
    shift[1:] = np.cumsum(smooth(smooth(moved, width), width), axis=0)
    return shift


def keep_heights(
    sole: Sole,
    paths_world: Float[np.ndarray, "frames soles 3"],
    source_world: Float[np.ndarray, "frames soles 3"],
    floor: Floor,
    dt: float,
) -> Float[np.ndarray, " frames"]:
    """The vertical move of the root [m] for which the lowest foot is as high as in the source.

    A cubic spline through what is missing at both feet's lowest vertices, the lower foot counting more. Where a sole
    is then deeper under the floor than it ever is in the source, the root rises by what is missing, smoothly. Zero,
    exactly, where the feet are as high as in the source.
    """
    heights, source = (np.stack([floor.above(p[:, sole.of(f)]).min(1) for f in (0, 1)], axis=1)
                       for p in (paths_world, source_world))  # fmt: skip
    missing = source - heights
    if not missing.any():
        return np.zeros(len(heights))
    share = np.exp((source.min(1, keepdims=True) - source) / LOW)
    rise = _spline_through(missing[..., None], share / share.sum(1, keepdims=True), KNOTS / dt)[:, 0]
    deepest = min(source.min(), 0.0) - DEEPER
    needed = np.maximum(deepest - (heights.min(1) + rise), 0.0)
    width = 2 * max(1, round(0.5 * KNOTS / dt)) + 1
    # the mean of a maximum over twice the width never falls below the demand
    return rise + smooth(smooth(maximum_filter1d(needed, 2 * width - 1, mode="nearest"), width), width)


def stop_drift(
    sole: Sole,
    paths_world: Float[np.ndarray, "frames soles 3"],
    speed: Float[np.ndarray, "frames soles"],
    standing_on: Int[np.ndarray, " frames"],
    plants: Footplants,
) -> Float[np.ndarray, "frames 3"]:
    """The horizontal move of the root [m] that stops the carrying foot from drifting.

    The move's velocity is a cubic spline over time, fitted to what would hold the vertex stood on, (3.1), the more
    a frame counts the surer it is that the foot is down: a plant that is found a frame longer or shorter changes
    little. Zero, exactly, where no foot drifts by more than `DRIFT` while it carries.
    """
    frames = len(paths_world)
    shift = np.zeros((frames, 3))
    carries = plants.primary >= 0
    if frames < 2 or not carries.any():
        return shift
    wanted, _ = root_steps(paths_world, standing_on, speed, sole.side)
    # nothing where a foot is as likely to be up; and not where the weight goes over
    sure = np.clip(2.0 * plants.confidence[np.arange(frames), np.maximum(plants.primary, 0)] - 1.0, 0.0, 1.0) * carries
    weight = np.minimum(sure[1:], sure[:-1]) * (plants.primary[1:] == plants.primary[:-1])
    steps = _spline_through(wanted[:, None, [0, 2]], weight[:, None], CALM / plants.dt)
    moved = np.concatenate([np.zeros((1, 2)), np.cumsum(steps, axis=0)])
    stances = [stance for foot in (0, 1) for stance in runs(plants.primary == foot)]
    if max(np.linalg.norm(moved[end] - moved[start]) for start, end in stances) > DRIFT:
        shift[:, [0, 2]] = moved
    return shift


def _spline_through(
    values: Float[np.ndarray, "frames feet k"], weights: Float[np.ndarray, "frames feet"], every: float
) -> Float[np.ndarray, "frames k"]:
    """The cubic spline of weighted least squares through values, a knot each `every` frames; where nothing counts it
    passes over evenly."""
    frames, every = len(values), max(every, 1.0)
    spans = max(1, int(np.ceil((frames - 1) / every)))
    knots = np.arange(-DEGREE, spans + DEGREE + 1) * every
    rows = csr_array(BSpline.design_matrix(np.arange(frames, dtype=float), knots, DEGREE))
    count = spans + DEGREE
    change = diags_array([-1.0, 1.0], offsets=[0, 1], shape=(count - 1, count))  # pyright: ignore[reportArgumentType]: SciPy's stub
    # the trace of weight keeps the system regular where nothing counts at all
    normal = rows.T @ diags_array(weights.sum(1) + 1e-9) @ rows + LEVEL * change.T @ change
    target = rows.T @ (weights[..., None] * values).sum(1)
    return rows @ spsolve(normal.tocsc(), target).reshape(count, -1)
