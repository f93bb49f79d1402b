"""The alternative without an optimiser: inverse kinematics per frame, smoothed afterwards. Thesis 4.10."""

import numpy as np
from jaxtyping import Float
from scipy.interpolate import CubicSpline
from scipy.ndimage import uniform_filter1d

from motionfit._character import Character
from motionfit._control import Correction
from motionfit._fit import Fit
from motionfit._motion import Motion, bind_pose
from motionfit._onto import onto
from motionfit._problem import Problem
from motionfit._skeleton import SIDES, Skeleton
from motionfit.adapt._clearance import build_clearance, volume_depths
from motionfit.adapt._controls import arm_controls, leg_controls
from motionfit.adapt._limits import reference_depths
from motionfit.metrics import TOLERANCE
from motionfit.shape.pairs import Pair, pairs_of
from motionfit.splines import per_frame

ITERATIONS = 6  # (4.22) is an approximation, refined by taking it again
AVERAGE = 0.15  # [s] of the average filter
CLOSE = 1e-3  # [rad] that a raw correction may exceed the curve


def per_frame_ik(clip: Motion, character: Character, *, reference: Character | None = None) -> Fit:
    """Take arms and legs out of each other frame by frame, and smooth what that needed: the thesis's comparison.

    A pair that is d deeper in than on the reference, at a distance l from the joint, is turned out by atan(d / l),
    (4.22): the arm alone about its removal axis, each leg by half. A few times over, then each correction becomes the
    natural cubic spline of `smoothed_corrections`. The same interface as `motionfit.adapt`, and the same `details`.
    """
    base = onto(clip, character.skeleton)
    basis, pairs = per_frame(base.frame_count), pairs_of("arms", "legs")
    clearance = build_clearance(character, pairs)
    own = reference_depths(clip, character, reference, pairs)
    controls = [c for c in arm_controls(character, base, basis) if c.name in ("left_arm", "right_arm")]
    controls.append(leg_controls(character, base, basis)[1])
    lever = np.array([_lever(character.skeleton, p) for p in pairs])
    mine = [np.array([_moves(c.name, p) for p in pairs]) for c in controls]

    def applied(angles: Float[np.ndarray, "controls frames"]) -> Correction:
        tail = np.zeros((len(angles), basis.count - base.frame_count))
        return Correction(tuple(controls), tuple(np.concatenate([angles, tail], axis=1)))

    raw, before = np.zeros((len(controls), base.frame_count)), volume_depths(clearance, base) - own
    excess = before
    for _ in range(ITERATIONS):
        turn = np.arctan(np.maximum(excess, 0.0) / lever)
        step = np.stack([np.where(some, turn, 0.0).max(axis=1) for some in mine])
        step[-1] /= 2.0  # each leg takes half
        if step.max() < CLOSE:
            break
        raw = raw + step
        excess = volume_depths(clearance, applied(raw).apply(base)) - own
    smooth = np.stack([smoothed_corrections(r, float(base.dt)) for r in raw])
    correction = applied(smooth)
    motion = correction.apply(base)
    after = volume_depths(clearance, motion) - own
    status = "violations_left" if after.max(initial=0.0) > TOLERANCE else "converged"
    details = {"pairs": [p.name for p in pairs], "frames": np.arange(base.frame_count), "excess_before_m": before,
               "excess_after_m": after}  # fmt: skip
    return Fit(correction, motion, base, status, (), Problem(character, base, {}, tuple(controls)), details)


def smoothed_corrections(raw: Float[np.ndarray, " frames"], dt: float) -> Float[np.ndarray, " frames"]:
    """The algorithm of thesis 4.10.2: through the extrema of the averaged corrections goes a curve; where a raw
    correction still exceeds it, the greatest one between two points becomes a point too.

    The thesis asks for a curve through its points with continuous second derivative and least curvature, and takes
    circle splines in time; of the functions of time, that is the natural cubic spline.
    """
    raw = np.asarray(raw, float)
    if len(raw) < 3 or not raw.any():
        return raw
    average = uniform_filter1d(raw, 2 * max(1, round(AVERAGE / dt / 2)) + 1, mode="nearest")
    slopes = np.sign(np.diff(average))
    turning = np.flatnonzero(slopes[1:] * slopes[:-1] < 0) + 1
    points = {int(k): average[k] for k in (0, *turning, len(raw) - 1)}
    frames = np.arange(len(raw))
    while True:
        at = np.array(sorted(points))
        curve = CubicSpline(at, [points[k] for k in at], bc_type="natural")(frames)
        over = np.abs(raw) - np.abs(curve)
        more = [a + int(over[a:b].argmax()) for a, b in zip(at, at[1:] + 1, strict=False) if over[a:b].max() > CLOSE]
        # a point that is raw already lies on the curve; one that is averaged gives way
        new = {k: raw[k] for k in more if points.get(k) != raw[k]}
        if not new:
            return curve
        points |= new


def _moves(control: str, pair: Pair) -> bool:
    return pair.block == "legs" if control == "thighs_apart" else pair.first.startswith(control.partition("_")[0])


def _lever(skeleton: Skeleton, pair: Pair) -> float:
    """l [m] of (4.22): from the joint that turns to where the part is met, the far end of an upper arm or thigh and
    the middle of what hangs on it."""
    places = bind_pose(skeleton)[0]
    side, _, kind = pair.first.partition("_")
    side = side if side in SIDES else SIDES[0]

    def bone(a: str, b: str) -> float:
        return float(np.linalg.norm(places[skeleton.joint(f"{side}_{b}")] - places[skeleton.joint(f"{side}_{a}")]))

    if pair.block == "legs":
        return bone("thigh", "calf") + (0.5 * bone("calf", "foot") if kind == "calf" else 0.0)
    along = {"upper_arm": 0.0, "forearm": 0.5, "hand": 1.0}[kind]
    return bone("upper_arm", "forearm") + (along * bone("forearm", "hand") if along else 0.0)
