"""Footskate removal by moving the root alone: Lyard 2007, 3.2 (thesis 3.1.2, 3.1.3). No joint is turned."""

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit.feet._floor import Floor
from motionfit.feet._plants import runs
from motionfit.feet._transfer import place_at, transfer_instant

CARRY = 0.2  # [s] of a stance next to a flight that say how the path is corrected there
SLOW = 0.3  # [m/s] a root that moves slower says little about the proportion of its path
SCALE_BOUNDS = (0.5, 2.0)  # of the root's up and down: outside, a clip that hardly moves would scale its noise


def root_steps(
    offsets: Float[np.ndarray, "frames soles 3"],
    standing_on: Int[np.ndarray, " frames"],
    speed: Float[np.ndarray, "frames soles"],
    foot_of: Int[np.ndarray, " soles"],
) -> tuple[Float[np.ndarray, "steps 3"], Bool[np.ndarray, " steps"]]:
    """Root displacement [m] of each step that keeps the planted vertex in place, and which steps have one.

    (3.1): o(v_i, t) - o(v_i, t + q) + o(v_j, t + q) - o(v_j, t + 1), where `offsets` are the vertices relative to
    the root in world directions, `standing_on` the vertex row per frame (-1 in flight) and q the transfer instant.
    For v_i = v_j it is the step of the vertex itself, whatever q is. Between two vertices of one foot q is taken to
    the nearer frame: inside a plant each vertex then holds still for whole frames, and a foot that slaps down at
    60 frames per second does not slide by millimetres in between.
    """
    frames = len(offsets)
    now, then = standing_on[:-1], standing_on[1:]
    held = (now >= 0) & (then >= 0)
    steps = np.zeros((max(frames - 1, 0), 3))
    at = np.flatnonzero(held & (now == then))
    steps[at] = offsets[at, now[at]] - offsets[at + 1, now[at]]
    at = np.flatnonzero(held & (now != then))
    if len(at):
        around = np.clip(at + np.arange(-1, 3)[:, None], 0, frames - 1)
        first, second = now[at], then[at]
        both = np.stack([first, second])
        slow = speed[around[:, None], both]
        q = transfer_instant(slow[:, 0], slow[:, 1])
        q = np.where(foot_of[first] == foot_of[second], np.round(q), q)
        leave, take = place_at(offsets[around[:, None], both], slow, np.stack([q, q]))
        steps[at] = offsets[at, first] - leave + take - offsets[at + 1, second]
    return steps, held


def horizontal_path(
    root: Float[np.ndarray, "frames 3"],
    offsets: Float[np.ndarray, "frames soles 3"],
    standing_on: Int[np.ndarray, " frames"],
    speed: Float[np.ndarray, "frames soles"],
    foot_of: Int[np.ndarray, " soles"],
    dt: float,
) -> Float[np.ndarray, "frames 3"]:
    """The root path [m] whose horizontal part follows the planted vertices; heights stay.

    In flight no vertex says how far the root goes: there it keeps its own displacement, in the proportion that the
    stances show on the whole (`path_stretch`: a body flies faster than it goes on its feet), plus what its velocity
    is further corrected by in the stances before and after (their medians, so that the braking of a landing does not
    count), passing over from one to the other. The source (T 6.2) leaves flight open.
    """
    if len(root) < 2:
        return root.copy()
    steps, held = root_steps(offsets, standing_on, speed, foot_of)
    own = np.diff(root, axis=0) * [1.0, 0.0, 1.0]
    stretch = path_stretch(own[held], steps[held], dt)
    correction = np.where(held[:, None], steps - stretch * own, 0.0)
    correction[:, 1] = 0.0
    carry_over_flights(correction, held, dt)
    correction += (stretch - 1.0) * own
    if not correction.any():
        return root.copy()
    moved = root.copy()
    moved[1:] += np.cumsum(correction, axis=0)
    return moved


def path_stretch(own: Float[np.ndarray, "steps 3"], steps: Float[np.ndarray, "steps 3"], dt: float) -> float:
    """The factor by which horizontal steps are longer than the clip's own on the whole [m both]: least squares,
    drawn to 1 as far as the root hardly moves (`SLOW`), within `SCALE_BOUNDS`."""
    prior = len(own) * (SLOW * dt) ** 2
    squared = float(np.sum(own * own)) + prior
    return float(np.clip(1.0 + np.sum((steps - own) * own) / squared, *SCALE_BOUNDS)) if squared else 1.0


def carry_over_flights(correction: Float[np.ndarray, "steps 3"], held: Bool[np.ndarray, " steps"], dt: float) -> None:
    """Fill the steps that are not held, in place, from the medians of those `CARRY` before and after."""
    width = max(1, round(CARRY / dt))
    for start, end in runs(~held):
        before, after = correction[max(start - width, 0) : start], correction[end + 1 : end + 1 + width]
        before, after = before[held[max(start - width, 0) : start]], after[held[end + 1 : end + 1 + width]]
        ends = [_median(c) for c in (before, after) if len(c)]
        if not ends:
            continue
        share = (np.arange(end - start + 1) + 1.0)[:, None] / (end - start + 2)
        correction[start : end + 1] = ends[0] + share * (ends[-1] - ends[0])


def _median(x: Float[np.ndarray, "rows k"]) -> Float[np.ndarray, " k"]:
    """Of each column; `numpy.median` takes five times as long on a few rows."""
    ordered, half = np.sort(x, axis=0), len(x) // 2
    return 0.5 * (ordered[half] + ordered[(len(x) - 1) // 2])


def vertical_scale(
    root_heights: Float[np.ndarray, " frames"], sole_heights: Float[np.ndarray, " frames"]
) -> tuple[float, float]:
    """The offset [m] and the scale of the root's up and down that bring the planted vertices nearest to the floor.

    Thesis 3.1.3: offset = -mean(h_t); then, with H_t = mean(H) + r_t after the offset and l_t = h_t - H_t the
    vertex relative to the root, scale = -sum r_t (mean(H) + l_t) / sum r_t^2. Heights are over the floor, of the
    frames with a plant. The scale stays within `SCALE_BOUNDS`, whose best point that is for a parabola; it is 1
    for a root that does not go up and down.
    """
    if len(root_heights) == 0:
        return 0.0, 1.0
    offset = -float(sole_heights.mean())
    heights = root_heights + offset
    mean = heights.mean()
    r, l = heights - mean, sole_heights - root_heights
    squared = float(r @ r)
    if squared < 1e-12 * len(r):
        return offset, 1.0
    return offset, float(np.clip(-(r @ (mean + l)) / squared, *SCALE_BOUNDS))


def scaled_heights(
    root: Float[np.ndarray, "frames 3"],
    planted_world: Float[np.ndarray, "frames 3"],
    held: Bool[np.ndarray, " frames"],
    estimated: Floor,
    target: Floor | None,
) -> tuple[Float[np.ndarray, " frames"], float, float]:
    """Root heights over the target floor [m] after offset and scale, with both.

    `planted_world` are the vertices stood on. Without a target floor the feet stay where they stand on the whole:
    the estimated plane is shifted to the mean height of the planted vertices, and only the scale acts.
    """
    over = estimated.above(root)
    soles = estimated.above(planted_world)[held]
    if not held.any():
        return over, 0.0, 1.0
    if target is None:
        mean = soles.mean()
        over, soles = over - mean, soles - mean
    offset, scale = vertical_scale(over[held], soles)
    mean = over[held].mean() + offset
    heights = mean + scale * (over + offset - mean)
    if target is None:
        heights = heights + (estimated.above(planted_world)[held]).mean()
    return heights, offset, scale


def frame_heights(
    root: Float[np.ndarray, "frames 3"],
    lowest_over_floor: Float[np.ndarray, " frames"],
    held: Bool[np.ndarray, " frames"],
    floor: Floor,
) -> Float[np.ndarray, " frames"]:
    """Root heights over the floor [m] after the per-frame correction of Emering et al. 2000, which thesis 3.1.3
    names as the alternative: where a sole is under the floor the root rises, and where a foot should stand but none
    touches it sinks, by what is missing. In flight it only rises, on top of what the stances around ask for."""
    frames = np.arange(len(root))
    shift = np.where(held, -lowest_over_floor, 0.0)
    if held.any():
        shift = np.interp(frames, frames[held], shift[held])
    shift = np.maximum(shift, -lowest_over_floor)
    return floor.above(root) + shift
