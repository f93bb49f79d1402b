"""When is a foot down? An algorithm that needs no kind of motion named.

A foot is down where some low part of its sole both stands still and is near the floor. What "still" and "near"
mean follows from the clip: the floor is a plane fitted to the contacts, speeds are measured on a root path that was
put in proportion to the legs, and the bounds grow with the leg. The two-state path of most evidence per foot
(Viterbi) then leaves out blinks: a change of state must earn its cost. Flight and double support are what comes out
when no foot, or both feet, are down.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._motion import Motion
from motionfit._skeleton import SIDES, Skeleton
from motionfit.feet._floor import Floor, fit_floor
from motionfit.feet._plants import Footplants, runs
from motionfit.feet._sole import Sole, rows_of, sole_paths

ADULT_LEG = 0.85  # [m] the leg for which the bounds below are given; speeds and heights go with the leg
STILL = 0.6  # [m/s] a sole that moves faster is not down
NEAR = 0.06  # [m] nor is one that is higher over the floor
HELD = 2.5  # times as high where nothing else carries a body that does not fall
FALLING = -0.4 * 9.81  # [m/s^2] a body whose root gathers speed downwards faster than this is in flight
STEEP = 10.0  # [1/s] what a vertex that is higher than the lowest one of its foot pays: 1 cm counts as 0.1 m/s
SMOOTHING = 0.025  # [s] three frames at 120 frames per second
HELD_FOR = 0.05  # [s] over which the root's acceleration is averaged
SWITCH = 0.015  # [s] of full evidence that a change of state costs
SLIP = 0.005  # [m] of slide that another vertex or foot must save before the weight goes over to it
SCALES = np.geomspace(0.5, 2.0, 15)  # root path in proportion to the source's, as far as it is looked for
OWN = len(SCALES) // 2  # where 1 is among them
UNDER_WAY = 0.5  # [s] of going somewhere that it takes to tell that proportion
STILLER = 1.2  # times as still: so much better another proportion must be (1.18 was the most for paths that are right)


class Evidence(NamedTuple):
    """What the labels are decided on: `paths_world` [m] of all sole vertices, per vertex `speed` [m/s] and, with
    what its height over the foot's lowest adds, `cost` [m/s]; per foot the `speed_low` of its stillest low vertex
    [m/s] and its `height` over the floor [m]; the root's upward `acceleration` [m/s^2]; and the proportion `path_scale`
    of the root path that they hold for."""

    paths_world: Float[np.ndarray, "frames soles 3"]
    speed: Float[np.ndarray, "frames soles"]
    cost: Float[np.ndarray, "frames soles"]
    speed_low: Float[np.ndarray, "frames 2"]
    height: Float[np.ndarray, "frames 2"]
    acceleration: Float[np.ndarray, " frames"]
    floor: Floor
    path_scale: float


def smoothing_frames(dt: float) -> int:
    """The odd number of frames nearest to `SMOOTHING`, at least one (the source smooths over five frames)."""
    return 2 * int(round((SMOOTHING / dt - 1) / 2)) + 1 if dt < SMOOTHING else 1


def smooth(x: Float[np.ndarray, "frames *rest"], width: int) -> Float[np.ndarray, "frames *rest"]:
    """Running mean over an odd number of frames, narrower at the ends so that a straight line stays one."""
    frames = len(x)
    width = min(width, frames)
    if width <= 1:
        return x
    half = np.minimum(np.minimum(np.arange(frames), np.arange(frames)[::-1]), width // 2)
    total = np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0)])
    low, high = np.arange(frames) - half, np.arange(frames) + half + 1
    return (total[high] - total[low]) / (high - low).reshape(-1, *[1] * (x.ndim - 1))


def velocity(x: Float[np.ndarray, "frames *rest"], dt: float) -> Float[np.ndarray, "frames *rest"]:
    """Central differences [1/s], one-sided at the ends; zero for a single frame."""
    change = np.zeros_like(x)  # `numpy.gradient` takes three times as long on a second of motion
    if len(x) > 1:
        change[1:-1] = (x[2:] - x[:-2]) / (2 * dt)
        change[0], change[-1] = (x[1] - x[0]) / dt, (x[-1] - x[-2]) / dt
    return change


def leg_scale(skeleton: Skeleton) -> float:
    """Leg length in adult legs, from the offsets of the joints between hip and ankle."""
    if "leg_scale" not in skeleton.memo:
        lengths, total = np.linalg.norm(np.asarray(skeleton.offsets, float), axis=1), 0.0
        for side in SIDES:
            joint, top = skeleton.joint(f"{side}_foot"), skeleton.joint(f"{side}_thigh")
            while joint not in (top, -1):
                total += float(lengths[joint])
                joint = skeleton.parents[joint]
        skeleton.memo["leg_scale"] = max(total / 2, 0.01) / ADULT_LEG
    return skeleton.memo["leg_scale"]


def gather(
    sole: Sole, motion: Motion, floor: Floor | None = None, planted: Bool[np.ndarray, "frames 2"] | None = None
) -> Evidence:
    """Sole speeds and heights, on a root path in proportion to the legs, over the floor: the given one, or one
    fitted to the lowest points of feet that are `planted` (where that is known) or stand still."""
    dt, size = float(motion.dt), leg_scale(sole.skeleton)
    paths = sole_paths(sole, motion)
    # differences to the first frame: running sums of large numbers would cost digits
    calm = velocity(smooth(paths - paths[:1], smoothing_frames(dt)), dt)
    rows = [sole.of(foot) for foot in (0, 1)]
    above_lowest = np.empty(paths.shape[:2])
    for mine in rows:
        heights = paths[:, mine, 1]
        above_lowest[:, mine] = heights - heights.min(1, keepdims=True)
    root = np.asarray(motion.root, float)
    root = velocity(smooth(root - root[:1], smoothing_frames(dt)), dt)
    upward = velocity(smooth(root[:, 1], 2 * round(HELD_FOR / dt / 2) + 1), dt)
    root[:, 1] = 0.0
    penalty = STEEP * np.maximum(above_lowest - 0.005 * size, 0.0)
    scale = _path_scale(calm, root, penalty, rows, size, dt)
    if scale != 1.0:
        calm = calm + (scale - 1.0) * root[:, None]
    speed = np.sqrt(np.einsum("fsa,fsa->fs", calm, calm))
    cost = speed + penalty
    best = np.stack([mine[cost[:, mine].argmin(1)] for mine in rows], axis=1)
    speed_low = np.take_along_axis(cost, best, axis=1)
    lowest = np.stack([mine[paths[:, mine, 1].argmin(1)] for mine in rows], axis=1)
    points = np.take_along_axis(paths, lowest[..., None], axis=1)
    if floor is None:
        weights = np.exp(-((speed_low / (0.5 * STILL * size)) ** 2)) if planted is None else planted.astype(float)
        floor = fit_floor(points.reshape(-1, 3), weights.reshape(-1))
    return Evidence(paths, speed, cost, speed_low, floor.above(points), upward, floor, scale)


def _path_scale(calm, root, penalty, rows, size: float, dt: float) -> float:
    """The proportion of the root path at which the stillest foot stands stillest.

    A clip put on shorter legs with its root path left as it was slides by a tenth of a metre per second and more:
    no bound on speed would then tell stance from swing. 1 unless another proportion is clearly better.
    """
    travel = np.sqrt(np.einsum("fa,fa->f", root, root))
    moving = np.flatnonzero(travel > 0.4 * size)
    if len(moving) < max(10, UNDER_WAY / dt):
        return 1.0
    # a hundred frames say as much as ten thousand; of each foot the four lowest vertices
    some = moving[np.linspace(0, len(moving) - 1, min(len(moving), 100)).astype(int)]
    paid = penalty[some]
    low = np.concatenate([mine[_lows(paid[:, mine])] for mine in rows], axis=1)
    feet, forward = calm[some[:, None], low], root[some]
    paid = np.take_along_axis(paid, low, axis=1).T[:, None]
    # |feet + (scale - 1) forward|^2 of all scales at once: (soles, scales, frames)
    more = (SCALES - 1.0)[:, None]
    own, along = np.einsum("fsa,fsa->sf", feet, feet)[:, None], np.einsum("fsa,fa->sf", feet, forward)[:, None]
    squared = own + 2 * more * along + (more * travel[some]) ** 2
    speed = (np.sqrt(np.maximum(squared, 0.0)) + paid).min(0)
    # share of the frames with a foot at rest; bounded, so that swings and flights do not vote
    scores = np.exp(-((speed / (0.25 * size)) ** 2)).mean(1)
    best = float(SCALES[scores.argmax()])
    return best if scores.max() > STILLER * scores[OWN] + 0.02 and abs(best - 1.0) > 0.08 else 1.0


def _lows(penalty: np.ndarray) -> np.ndarray:
    """The four lowest vertices of a foot per frame."""
    count = min(4, penalty.shape[1])
    return np.argpartition(penalty, count - 1, axis=1)[:, :count]


def two_state_path(evidence: Float[np.ndarray, " frames"], cost: float) -> Bool[np.ndarray, " frames"]:
    """The on/off sequence of most evidence (summed where on, minus where off), less `cost` per change: Viterbi."""
    values = evidence.tolist()
    on, off = values[0], -values[0]
    from_off, from_on = [False], [False]  # did the best way to be on here come from off, and the reverse
    for value in values[1:]:
        switched_on, switched_off = off - cost > on, on - cost > off
        on, off = (off - cost if switched_on else on) + value, (on - cost if switched_off else off) - value
        from_off.append(switched_on)
        from_on.append(switched_off)
    state = on > off
    states = [state]
    for switched_on, switched_off in zip(reversed(from_off[1:]), reversed(from_on[1:]), strict=True):
        state = not state if (switched_on if state else switched_off) else state
        states.append(state)
    return np.array(states[::-1])


def _labels(evidence: Evidence, dt: float, size: float) -> tuple[np.ndarray, np.ndarray]:
    still = 1.0 - evidence.speed_low / (STILL * size)

    def decide(near: Float[np.ndarray, "frames feet"]) -> tuple[np.ndarray, np.ndarray]:
        both = np.clip(np.minimum(still, near), -1.0, 1.0)
        return np.stack([two_state_path(both[:, f], 2 * SWITCH / dt) for f in (0, 1)], axis=1), both

    near = 1.0 - evidence.height / (NEAR * size)
    planted, both = decide(near)
    # who neither stands nor falls is held by something: there a still foot may be higher over the plane, which one
    # plane for a whole clip (and a body other than the actor's) does not always meet
    held = ~planted.any(1) & (evidence.acceleration > FALLING * size)
    if (held[:, None] & (still > 0)).any():
        planted, both = decide(np.where(held[:, None], 1.0 - evidence.height / (HELD * NEAR * size), near))
    return planted, 1.0 / (1.0 + np.exp(-4.0 * both))


def least_moving(sole: Sole, evidence: Evidence, planted: Bool[np.ndarray, "frames 2"]) -> Int[np.ndarray, "frames 2"]:
    """The least moving sole vertex of each planted foot, frame by frame: thesis 3.1.1, second step. A vertex that is
    higher than the foot's lowest pays for its height. -1 where a foot is not down."""
    vertex = np.full(planted.shape, -1)
    for foot in (0, 1):
        mine = sole.of(foot)
        chosen = sole.vertices[mine[evidence.cost[:, mine].argmin(1)]]
        vertex[:, foot] = np.where(planted[:, foot], chosen, -1)
    return vertex


def choose_vertices(
    sole: Sole, evidence: Evidence, planted: Bool[np.ndarray, "frames 2"], dt: float
) -> Int[np.ndarray, "frames 2"]:
    """The sole vertices on which each planted foot stands: over a plant, those that move least in all, where going
    over to another one costs `SLIP`. -1 where a foot is not down.

    The source takes the least moving vertex of each frame (`least_moving`), which jumps to and fro between
    vertices of nearly the same speed; here each stays as long as it can. Viterbi again, all plants side by side.
    """
    vertex = np.full(planted.shape, -1)
    intervals = [(start, end, foot) for foot in (0, 1) for start, end in runs(planted[:, foot])]
    if not intervals:
        return vertex
    starts, ends, feet = np.array(intervals).T
    # frames of a plant count from its end, so that all plants are still there when the way back begins
    length = int((ends - starts).max()) + 1
    frames = ends - (length - 1) + np.arange(length)[:, None]
    inside = frames >= starts
    # the soles of both feet side by side: the shorter one is filled up with what nobody would choose
    rows = [sole.of(0), sole.of(1)]
    width = max(len(r) for r in rows)
    table = np.stack([np.append(r, np.full(width - len(r), r[0])) for r in rows])
    costs = evidence.cost[np.maximum(frames, 0)[..., None], table[feet]] * dt
    costs[:, np.arange(width) >= np.array([len(r) for r in rows])[feet][:, None]] = np.inf
    costs[~inside] = 0.0
    total, came_from = costs[0], np.empty((length, len(intervals), width), np.int32)
    plants, same = np.arange(len(intervals)), np.arange(width)
    for step in range(1, length):
        best = total.argmin(1)
        switched = (total[plants, best] + SLIP)[:, None]
        came_from[step] = np.where(switched < total, best[:, None], same)
        total = np.minimum(switched, total) + costs[step]
    at = total.argmin(1)
    for step in range(length - 1, -1, -1):
        here = inside[step]
        vertex[frames[step, here], feet[here]] = sole.vertices[table[feet[here], at[here]]]
        at = came_from[step, plants, at] if step else at
    return vertex


def choose_primary(
    sole: Sole,
    evidence: Evidence,
    planted: Bool[np.ndarray, "frames 2"],
    vertex: Int[np.ndarray, "frames 2"],
    dt: float,
) -> Int[np.ndarray, " frames"]:
    """The foot that carries: where both are down, the way of least slide between single supports (Viterbi)."""
    speed = np.take_along_axis(evidence.speed, rows_of(sole, vertex), axis=1)
    # positive where the right foot slides less; single supports leave no choice
    lead = (speed[:, 0] - speed[:, 1]) * dt
    lead = np.where(planted.all(1), lead, np.where(planted[:, 1], 1e3, np.where(planted[:, 0], -1e3, 0.0)))
    right = two_state_path(lead, 2 * SLIP)
    return np.where(planted.any(1), right.astype(int), -1)


def detect(sole: Sole, motion: Motion, floor: Floor | None = None) -> tuple[Footplants, Evidence]:
    """Footplants of a motion on the sole's own skeleton, with what they were decided on."""
    dt, size = float(motion.dt), leg_scale(sole.skeleton)
    evidence = gather(sole, motion, floor)
    planted, confidence = _labels(evidence, dt, size)
    vertex = choose_vertices(sole, evidence, planted, dt)
    root = np.asarray(motion.root, float)
    paths = evidence.paths_world + (evidence.path_scale - 1.0) * (root * [1.0, 0.0, 1.0])[:, None]
    vertex = _without_fast_ends(sole, paths, vertex, STILL * size * dt)
    planted = vertex >= 0
    primary = choose_primary(sole, evidence, planted, vertex, dt)
    return Footplants(planted, vertex, confidence, primary, evidence.floor, dt), evidence


def _without_fast_ends(
    sole: Sole, paths: Float[np.ndarray, "frames soles 3"], vertex: Int[np.ndarray, "frames 2"], still: float
) -> Int[np.ndarray, "frames 2"]:
    """The vertices stood on, less the frames at both ends of a plant in whose step to the next one the vertex goes
    further than `still` [m]: the labels are decided on averages of a few frames, which see a foot leave too late."""
    rows, vertex = rows_of(sole, vertex), vertex.copy()
    at = np.arange(len(paths) - 1)
    for foot in (0, 1):
        here = rows[:, foot]
        steps = [(paths[at + 1, v] - paths[at, v])[:, [0, 2]] for v in (here[:-1], here[1:])]
        is_calm = np.minimum(*(np.einsum("fa,fa->f", s, s) for s in steps)) <= still**2
        for start, end in runs(here >= 0):
            calm = np.flatnonzero(is_calm[start:end])
            if len(calm):
                vertex[start : start + calm[0], foot] = -1
                vertex[start + calm[-1] + 2 : end + 1, foot] = -1
    return vertex


def assemble(sole, evidence: Evidence, planted, confidence, dt: float, vertex=None) -> Footplants:
    """Footplants from on/off labels: vertices and the carrying foot are chosen here."""
    chosen = choose_vertices(sole, evidence, planted, dt)
    if vertex is not None:
        chosen = np.where(planted & (vertex >= 0), vertex, chosen)
    primary = choose_primary(sole, evidence, planted, chosen, dt)
    return Footplants(planted, chosen, confidence, primary, evidence.floor, dt)
