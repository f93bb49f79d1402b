"""Every measure, one function each, with its definition and source.

Penetration is judged twice: on fitted volumes, and on the skinned mesh itself by generalised winding numbers
(Jacobson et al. 2013; Barill et al. 2018, through libigl), so that volumes are never judged by volumes alone.
"""

import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from motionfit._character import Character
from motionfit._motion import Motion, forward_kinematics, host_kinematics, joint_angles
from motionfit._programs import program
from motionfit._skinning import skin_points
from motionfit._types import AnyArray
from motionfit.shape.pairs import PAIRS, Pair
from motionfit.shape.surface import Inside, find_inside, inside_depths, part_surface, surface_gaps

TOLERANCE = 0.01  # [m]: the "1 cm" of every frames_over_1cm
SHOWN_KEPT = 100_000  # poses of which it is known what they show, some 40 MB, and gaps, twice that


# --- penetration -----------------------------------------------------------------------------------------------


class SkinDepths(NamedTuple):
    """What `skin_depths` measured: per frame and pair the depth [m] (0 where nothing is inside), and the share of
    all probed vertices that were inside (over all frames)."""

    depth: Float[np.ndarray, "frames pairs"]
    inside_ratio: float
    frames: np.ndarray


@program
def _posed_vertices(skeleton, motion, vertices, joints, weights):
    return skin_points(forward_kinematics(skeleton, motion), vertices, joints, weights)


def posed_vertices(character: Character, motion: Motion) -> Float[np.ndarray, "frames vertices 3"]:
    """World vertices [m] of the skin in every frame, on the host."""
    skin = character.skin
    return np.asarray(_posed_vertices(character.skeleton, motion, skin.vertices_bind, skin.joints, skin.weights))


def skin_depths(
    character: Character,
    motion: Motion,
    pairs: Sequence[Pair] = PAIRS,
    *,
    step: int = 1,
    progress: Callable[[int, int], None] | None = None,
) -> SkinDepths:
    """Per pair of parts and frame, how deep the deepest vertex of either part is inside the other's surface.

    Parts are the vertices by joint of greatest weight; a surface is a part's own triangles, open at the joints,
    which generalised winding numbers allow. Vertices that are inside at bind do not count: they are the joint
    itself. `step` looks at every step-th frame only.
    """
    frames = np.arange(0, motion.frame_count, step)
    looked, known = motion[frames], shown_before(character, pairs)
    poses = poses_of(looked)
    new = list({pose: i for i, pose in enumerate(poses) if pose not in known}.values())
    for i, (_, _, found) in enumerate(insides(character, looked[np.array(new, int)], pairs), 1):
        known[poses[new[i - 1]]] = shown_in(found, len(pairs))
        if progress is not None:
            progress(len(frames) - len(new) + i, len(frames))
    if progress is not None and not new:
        progress(len(frames), len(frames))
    result = np.array([known[pose].depth for pose in poses]).reshape(len(frames), len(pairs))
    probed = max(sum(len(v) for v in _probed(character, pairs).values()), 1)
    return SkinDepths(result, sum(known[pose].inside for pose in poses) / (probed * max(len(frames), 1)), frames)


class Shown(NamedTuple):
    """What the skin shows in one pose: per pair the depth [m], and how many vertices are inside."""

    depth: Float[np.ndarray, " pairs"]
    inside: int


def shown_before(character: Character, pairs: Sequence[Pair]) -> dict[bytes, Shown]:
    """What was seen on a body before, by pose: a look takes ten milliseconds or more, so none is taken twice."""
    known = character.memo.setdefault(("shown", tuple(pairs)), {})
    if len(known) > SHOWN_KEPT:
        known.clear()
    return known


def shown_in(found: Mapping["Direction", Inside], pairs: int) -> Shown:
    """What a look found, as numbers."""
    depth, inside = np.zeros(pairs), 0
    for (pair, *_), points in found.items():
        depth[pair] = max(depth[pair], points.depth.max(initial=0.0))
        inside += int((points.depth > 0.0).sum())  # not what lies on the border of both
    return Shown(depth, inside)


def poses_of(motion: Motion) -> list[bytes]:
    """What tells frames apart by what their skin shows: where a body stands does not matter."""
    arrays = [motion.rotations, *(() if motion.translations is None else (motion.translations,))]
    rows = [np.asarray(x) for x in arrays]
    return [hashlib.sha256(b"".join(r[t].tobytes() for r in rows)).digest() for t in range(motion.frame_count)]


Direction = tuple[int, str, str]  # which pair, the part whose vertices are tested, the part whose surface it is


def insides(
    character: Character, motion: Motion, pairs: Sequence[Pair] = PAIRS
) -> Iterator[tuple[int, Float[np.ndarray, "vertices 3"], dict[Direction, Inside]]]:
    """Frame after frame: its number, the posed vertices [m], and what `skin_depths` finds inside, by direction. Points
    and triangles are numbered as in the whole skin and as in the part's own surface."""
    probed = _probed(character, pairs)
    by_surface: dict[str, list[Direction]] = {}
    for direction in probed:
        by_surface.setdefault(direction[2], []).append(direction)
    surfaces = {part: part_surface(character, part) for part in by_surface}
    for i, vertices in enumerate(posed_frames(character, motion)):
        result = {}
        for part, directions in by_surface.items():
            asked = np.concatenate([probed[d] for d in directions])
            mesh = surfaces[part]
            found = find_inside(vertices[asked], vertices[mesh.used], mesh.triangles)
            ends = np.searchsorted(found.points, np.cumsum([len(probed[d]) for d in directions]))
            for direction, low, high in zip(directions, [0, *ends[:-1]], ends, strict=True):
                own = Inside(*(x[low:high] for x in found))
                result[direction] = own._replace(points=asked[own.points])
        yield i, vertices, result


def posed_frames(character: Character, motion: Motion) -> Iterator[Float[np.ndarray, "vertices 3"]]:
    """World vertices [m] of the skin, frame after frame."""
    chunk = 16  # frames skinned at once: the whole clip would not fit for long clips
    for start in range(0, motion.frame_count, chunk):
        # always whole chunks, so that the skinning compiles once
        some = np.minimum(np.arange(start, start + chunk), motion.frame_count - 1)
        yield from posed_vertices(character, motion[some]).astype(float)[: motion.frame_count - start]


class SkinGap(NamedTuple):
    """How far apart [m] two parts of a posed skin are, and where: the first part's vertex that is nearest to the second
    or deepest in it, and the corners of the triangle that is nearest to that, by their numbers in the skin, with where
    they are [m]."""

    gap: float
    vertex: int
    corners: Int[np.ndarray, "3"]
    vertex_world: Float[np.ndarray, "3"]
    place_world: Float[np.ndarray, "3"]
    corners_world: Float[np.ndarray, "3 3"]


def nearest_on_skin(
    character: Character, motion: Motion, pairs: Sequence[Pair], wanted: Bool[np.ndarray, "frames pairs"]
) -> list[SkinGap]:
    """How far the skin of pairs' first parts is from the second's surface, frame after frame, where it is `wanted`."""
    known, poses = character.memo.setdefault("gaps", {}), poses_of(motion)
    if len(known) > SHOWN_KEPT:
        known.clear()
    asked = [
        [(pose, *pairs[k][:2]) for k in np.flatnonzero(row).tolist()] for pose, row in zip(poses, wanted, strict=True)
    ]
    frames = np.array([t for t, keys in enumerate(asked) if any(key not in known for key in keys)], int)
    for t, vertices in zip(frames, posed_frames(character, motion[frames]), strict=True):
        by_surface: dict[str, list[tuple[bytes, str, str]]] = {}
        for key in asked[t]:
            if key not in known:
                by_surface.setdefault(key[2], []).append(key)
        for part, keys in by_surface.items():
            surface = part_surface(character, part)
            sets = [part_surface(character, first).vertices for _, first, _ in keys]
            gaps = surface_gaps([vertices[of] for of in sets], vertices[surface.used], surface.triangles)
            for key, of, found in zip(keys, sets, gaps, strict=True):
                vertex, corners = int(of[found.point]), surface.used[surface.triangles[found.triangle]]
                # a view of the vertex would keep the whole posed skin
                known[key] = SkinGap(
                    found.gap, vertex, corners, vertices[vertex].copy(), found.place, vertices[corners]
                )
    return [known[key] for keys in asked for key in keys]


def skin_gaps(
    character: Character, motion: Motion, pairs: Sequence[Pair], wanted: Bool[np.ndarray, "frames pairs"] | None = None
) -> Float[np.ndarray, "frames pairs"]:
    """How far [m] the skin of each pair's first part is from the second's surface: that of its nearest vertex, negative
    where one is inside. NaN where it is not `wanted` (None: it is everywhere)."""
    wanted = np.ones((motion.frame_count, len(pairs)), bool) if wanted is None else wanted
    result = np.full(wanted.shape, np.nan)
    result[wanted] = [found.gap for found in nearest_on_skin(character, motion, pairs, wanted)]
    return result


def _probed(character: Character, pairs: Sequence[Pair]) -> dict[Direction, Int[np.ndarray, " vertices"]]:
    """The vertices that count, by direction: those inside at bind are the joint itself."""
    key = ("probed", tuple(pairs))
    if key not in character.memo:
        bind = np.asarray(character.skin.vertices_bind, float)
        probed = {}
        for k, pair in enumerate(pairs):
            for a, b in (pair[:2], pair[1::-1]):
                mine, mesh = part_surface(character, a).vertices, part_surface(character, b)
                probed[k, a, b] = mine[inside_depths(bind[mine], bind[mesh.used], mesh.triangles) == 0.0]
        character.memo[key] = probed
    return character.memo[key]


def penetration_summary(excess: Float[np.ndarray, "frames pairs"], pairs: Sequence[Pair] = PAIRS) -> dict:
    """report.json's penetration entry from excess depths [m]: how much deeper than on the reference."""
    excess = np.maximum(np.nan_to_num(np.asarray(excess, float)), 0.0)
    return {
        "excess_max_m": float(excess.max(initial=0.0)),
        "excess_mean_m": float(excess.max(axis=1, initial=0.0).mean()) if len(excess) else 0.0,
        "frames_over_1cm": float((excess > TOLERANCE).any(axis=1).mean()) if len(excess) else 0.0,
        "pairs": {
            pair.name: {
                "excess_max_m": float(excess[:, k].max(initial=0.0)),
                "frames_over_1cm": float((excess[:, k] > TOLERANCE).mean()) if len(excess) else 0.0,
            }
            for k, pair in enumerate(pairs)
        },
    }


# --- fidelity: against the source clip -------------------------------------------------------------------------


def joint_angle_deviation(motion: Motion, source: Motion) -> tuple[float, float]:
    """Mean over frames and joints, and maximum, of the angle [rad] between each joint's rotation and the source's."""
    angles = joint_angles(motion, source)
    return float(angles.mean()), float(angles.max())


def forearm_direction(motion: Motion, source: Motion) -> float | None:
    """Mean angle [rad] between the forearms' world directions and the source's: thesis (4.7)."""
    skeleton = motion.skeleton
    sides = [(skeleton.find(f"{s}_forearm"), skeleton.find(f"{s}_hand")) for s in ("left", "right")]
    sides = [(f, h) for f, h in sides if f is not None and h is not None]
    if not sides:
        return None
    mine, theirs = host_kinematics(motion)[0], host_kinematics(source)[0]
    angles = []
    for forearm, hand in sides:
        a, b = mine[:, hand] - mine[:, forearm], theirs[:, hand] - theirs[:, forearm]
        angles.append(np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1)))
    return float(np.mean(angles))


def root_path_ratio(motion: Motion, source: Motion) -> float | None:
    """Length of the root's horizontal path over that of the source; None where the source stands still."""

    def length(m: Motion) -> float:
        return float(np.linalg.norm(np.diff(np.asarray(m.root, float)[:, [0, 2]], axis=0), axis=-1).sum())

    return length(motion) / length(source) if length(source) > 0.05 else None


# --- smoothness -------------------------------------------------------------------------------------------------


def derivative_ratio(motion: Motion, source: Motion, order: int) -> float | None:
    """Mean over frames and joints of the norm of the order-th time derivative of the joints' world positions, over
    that of the source: 2 is acceleration, 3 jerk. Flash & Hogan 1985 take jerk as the measure of smoothness. None
    for clips too short, or a source at rest."""
    if motion.frame_count <= order:
        return None
    means = []
    for m in (motion, source):
        # float64: the third difference of float32 positions at 120 fps is mostly rounding
        positions = host_kinematics(m)[0]
        means.append(float(np.linalg.norm(np.diff(positions, order, axis=0), axis=-1).mean()))
    return means[0] / means[1] if means[1] > 1e-9 else None


# --- the whole entry --------------------------------------------------------------------------------------------


def measure(
    motion: Motion,
    source: Motion,
    *,
    volume_excess: Float[AnyArray, "frames pairs"] | None = None,
    skin: SkinDepths | None = None,
    reference: SkinDepths | None = None,
    pairs: Sequence[Pair] = PAIRS,
    feet: dict | None = None,
    balance: dict | None = None,
) -> dict:
    """One M of report.json (schema 1): penetration on volumes and skin, fidelity and smoothness against `source`.

    `volume_excess` [m] per frame and pair comes from `motionfit.adapt.volume_depths`, `skin` and `reference` from
    `skin_depths`, `feet` and `balance` from `motionfit.adapt.measure_standing`. What is not given is null.
    """
    penetration: dict = {"excess_max_m": None, "excess_mean_m": None, "frames_over_1cm": None, "pairs": {}}
    if volume_excess is not None:
        penetration = penetration_summary(np.asarray(volume_excess), pairs)
    if skin is not None:
        excess = skin.depth - (0.0 if reference is None else reference.depth)
        summary = penetration_summary(excess, pairs)
        penetration["skin"] = {
            "excess_max_m": summary["excess_max_m"],
            "frames_over_1cm": summary["frames_over_1cm"],
            "inside_ratio": float(skin.inside_ratio),
            "inside_ratio_reference": None if reference is None else float(reference.inside_ratio),
            "pairs": summary["pairs"],
        }
    mean, worst = joint_angle_deviation(motion, source)
    return {
        "penetration": penetration,
        "feet": feet or dict.fromkeys(("slide_max_m_s", "slide_p95_m_s", "slide_path_m", "contact_frames",
                                       "ground_penetration_max_m", "floating_max_m")),
        "balance": balance or dict.fromkeys(("zmp_distance_mean_m", "zmp_distance_sd_m", "excess_over_reference_mean_m",
                                             "supported_frames")),
        "fidelity": {
            "joint_angle_mean_rad": mean,
            "joint_angle_max_rad": worst,
            "forearm_direction_mean_rad": forearm_direction(motion, source),
            "root_path_ratio": root_path_ratio(motion, source),
        },
        "smoothness": {
            "jerk_ratio": derivative_ratio(motion, source, 3),
            "acceleration_ratio": derivative_ratio(motion, source, 2),
        },
    }  # fmt: skip


# --- feet: slide, skate, ground contact ---------------------------------------------------------------------------


def slide_speeds(
    paths_world: Float[np.ndarray, "frames points 3"],
    standing_on: Int[np.ndarray, " frames"],
    dt: float,
) -> Float[np.ndarray, " steps"]:
    """Horizontal speed [m/s] of the planted point in each step from one frame to the next; NaN without a plant.

    `standing_on` names the point (a column of `paths_world` [m]) that a foot stands on in each frame, -1 for none.
    Where the weight goes over from one point to another within the step, each is meant to hold for a part of it
    only: the smaller of the two displacements counts. Lyard 2007, figure 4, shows this slide as footprints.
    """
    now, then = standing_on[:-1], standing_on[1:]
    held = (now >= 0) & (then >= 0)
    steps = np.arange(len(now))
    moved = [
        np.linalg.norm((paths_world[steps + 1, v] - paths_world[steps, v])[:, [0, 2]], axis=1) for v in (now, then)
    ]
    return np.where(held, np.minimum(*moved) / dt, np.nan)


def slide_path(speeds: Float[np.ndarray, " steps"], dt: float) -> float:
    """How far [m] the planted points slide in all."""
    return float(np.nansum(speeds) * dt)


def skate_ratio(
    points_world: Float[np.ndarray, "frames points 3"], heights: Float[np.ndarray, "frames points"], dt: float,
    *, near: float = 0.05, slide: float = 0.025, per: float = 0.05,
) -> float | None:  # fmt: skip
    """Share of the frames in which a foot skates: lower than `near` [m] over the floor, yet moving faster than
    `slide` [m] per `per` [s]. Karunratanakul et al. 2023 (GMD): 5 cm and 2.5 cm, at 20 frames per second. One
    point per foot; None for a single frame."""
    if len(points_world) < 2:
        return None
    speed = np.linalg.norm(np.diff(points_world, axis=0)[..., [0, 2]], axis=-1) / dt
    low = (heights[:-1] < near) & (heights[1:] < near)
    return float((low & (speed > slide / per)).any(1).mean())


def weighted_skate(
    points_world: Float[np.ndarray, "frames points 3"], heights: Float[np.ndarray, "frames points"], dt: float,
    *, threshold: float = 0.025,
) -> float | None:  # fmt: skip
    """Mean over frames and feet of d (2 - 2^(h/H)), the horizontal speed d [m/s] of a foot lower than H = 2.5 cm,
    the more the nearer it is to the floor. Zhang et al. 2018 (mode-adaptive networks). None for a single frame."""
    if len(points_world) < 2:
        return None
    speed = np.linalg.norm(np.diff(points_world, axis=0)[..., [0, 2]], axis=-1) / dt
    height = np.maximum(heights[:-1], 0.0)
    weight = np.where(height < threshold, 2.0 - 2.0 ** np.minimum(height / threshold, 1.0), 0.0)
    return float((speed * weight).mean())


def ground_penetration(heights: Float[np.ndarray, "frames points"]) -> float:
    """How deep [m] the lowest of the points ever is under the floor, from heights over it. Ma et al. 2019."""
    return float(max(0.0, -heights.min(initial=0.0)))


def floating(heights: Float[np.ndarray, "frames feet"], planted: Bool[np.ndarray, "frames feet"]) -> float | None:
    """How high [m] a foot that should stand is over the floor at worst: the lowest point of the planted foot that
    is nearest to it. None without a plant. The counterpart of penetration in Yuan et al. 2023 (PhysDiff, "float")."""
    down = planted.any(1)
    if not down.any():
        return None
    nearest = np.where(planted, heights, np.inf).min(1)[down]
    return float(max(0.0, nearest.max()))


def contact_preservation(
    planted: Bool[np.ndarray, "frames feet"], source: Bool[np.ndarray, "frames feet"]
) -> float | None:
    """Share of the source's contacts (frame and foot) that are contacts still: the recall of Villegas et al. 2021's
    contact consistency. None where the source has none."""
    return float((planted & source).sum() / source.sum()) if source.any() else None


def feet_summary(
    paths_world: Float[np.ndarray, "frames points 3"],
    heights: Float[np.ndarray, "frames points"],
    foot_of_point: Int[np.ndarray, " points"],
    standing_on: Int[np.ndarray, "frames 2"],
    carrying: Int[np.ndarray, " frames"],
    dt: float,
) -> dict:
    """report.json's `feet` entry: slide, skate, penetration and floating of the soles.

    `paths_world` [m] and `heights` [m over the floor] of the sole points, which foot each belongs to (0 left,
    1 right), the point on which each foot stands per frame (-1: not down) and the foot that carries (-1: flight).
    `slide_*` is that of the carrying foot while it carries, `handover_slide_max_m_s` that of the step in which the
    weight goes from one foot to the other, and `other_slide_p95_m_s` that of the other foot in double support.
    """
    frames = np.arange(len(paths_world))
    carrier = np.where(carrying >= 0, standing_on[frames, np.maximum(carrying, 0)], -1)
    other = np.where((standing_on >= 0).all(1), standing_on[frames, 1 - np.maximum(carrying, 0)], -1)
    slide, second = (slide_speeds(paths_world, points, dt) for points in (carrier, other))
    changes = carrying[1:] != carrying[:-1]
    handover, slide = np.where(changes, slide, np.nan), np.where(changes, np.nan, slide)
    lows = [np.flatnonzero(foot_of_point == foot) for foot in (0, 1)]
    lowest = np.stack([mine[heights[:, mine].argmin(1)] for mine in lows], axis=1)
    low_points = np.take_along_axis(paths_world, lowest[..., None], axis=1)
    low_heights = np.take_along_axis(heights, lowest, axis=1)

    def percentile(x: np.ndarray, q: float) -> float | None:
        x = x[np.isfinite(x)]
        return float(np.percentile(x, q)) if len(x) else None

    return {
        "slide_max_m_s": percentile(slide, 100.0),
        "slide_p95_m_s": percentile(slide, 95.0),
        "slide_path_m": slide_path(slide, dt),
        "contact_frames": int((carrying >= 0).sum()),
        "ground_penetration_max_m": ground_penetration(heights),
        "floating_max_m": floating(low_heights, standing_on >= 0),
        "handover_slide_max_m_s": percentile(handover, 100.0),
        "other_slide_p95_m_s": percentile(second, 95.0),
        "skate_ratio": skate_ratio(low_points, low_heights, dt),
        "weighted_skate_m_s": weighted_skate(low_points, low_heights, dt),
    }
