"""Where the skins of two parts touch in the frames that were looked at, as rows for the solver.

Near a shoulder the fold of the skin is not where a field of one pose says. The skin itself tells where it is, but only
in the pose that was looked at: so what is found there is kept from round to round, and stands for the frames around.
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from motionfit._character import Character
from motionfit._motion import bind_pose
from motionfit.metrics import Direction, SkinGap
from motionfit.shape.surface import Inside, part_surface
from motionfit.terms.penetration import TouchClearance, TouchHold

AT_ONCE = 6  # touches of two parts in one look, each way, at most
APART = 0.015  # [m] between two of them
KEPT = 24  # of a block in one look, the latest ones first
NEVER = 1e3  # [m] allowed where there is no touch
HELD = 8  # touches of a frame that are held, at most: a hand is on few parts at once


class Touches(NamedTuple):
    """Touches of one look by vertex number: the same vertices touch on another body of the same topology."""

    pairs: Int[np.ndarray, " touches"]
    vertices: Int[np.ndarray, " touches"]
    corners: Int[np.ndarray, "touches 3"]  # of the triangles that they are nearest to
    shares: Float[np.ndarray, "touches 3"]  # of the corners in the nearest place
    normals: Float[np.ndarray, "touches 3"]  # outward, in the bind pose, where the joints `carried_by` take them
    carried_by: Int[np.ndarray, " touches"]

    def only(self, some) -> "Touches":
        return Touches(*(x[some] for x in self))

    def then(self, others: "Touches") -> "Touches":
        return Touches(*(np.concatenate(both) for both in zip(self, others, strict=True)))


NONE = Touches(*(np.zeros((0, *shape), kind) for shape, kind in
                 (((), int), ((), int), ((3,), int), ((3,), float), ((3,), float), ((), int))))  # fmt: skip


def touches_of(
    character: Character, rotations_world: Float[np.ndarray, "joints 4"], vertices: Float[np.ndarray, "vertices 3"],
    found: Mapping[Direction, Inside], least: Float[np.ndarray, " pairs"],
) -> Touches:  # fmt: skip
    """The deepest places of one posed frame, some way apart, that are deeper than `least` [m] of their pair."""
    touches = NONE
    for (pair, _, part), inside in found.items():
        chosen = _deepest(vertices[inside.points], inside.depth, max(float(least[pair]), 1e-4))
        if len(chosen) == 0:
            continue
        surface = part_surface(character, part)
        corners = surface.used[surface.triangles[inside.triangles[chosen]]]
        points, places = inside.points[chosen], inside.places[chosen]
        normals = (places - vertices[points]) / inside.depth[chosen, None]
        rotations = np.broadcast_to(rotations_world, (len(chosen), *rotations_world.shape))
        touches = touches.then(
            _touches(
                character, rotations, np.full(len(chosen), pair), points, corners, vertices[corners], places, normals
            )
        )
    return touches


def touches_held(
    character: Character, rotations_world: Float[np.ndarray, "touches joints 4"], rows: Int[np.ndarray, " touches"],
    gaps: Sequence[SkinGap],
) -> Touches:  # fmt: skip
    """Places of posed frames where parts touch, or shall: `rows` say what."""
    if not gaps:
        return NONE
    apart, vertices, corners, points, places, corners_world = (np.array(x) for x in zip(*gaps, strict=True))
    a, b, c = np.swapaxes(corners_world, 0, 1)
    facing = np.cross(b - a, c - a)
    facing /= np.maximum(np.linalg.norm(facing, axis=1, keepdims=True), 1e-12)
    near = np.abs(apart)[:, None] < 1e-5  # where the way has no direction, the triangle's
    normals = np.where(near, facing, (points - places) / np.where(near, 1.0, apart[:, None]))
    return _touches(character, rotations_world, rows, vertices, corners, corners_world, places, normals)


def _touches(
    character: Character, rotations_world: Float[np.ndarray, "touches joints 4"], pairs: Int[np.ndarray, " touches"],
    vertices: Int[np.ndarray, " touches"], corners: Int[np.ndarray, "touches 3"],
    corners_world: Float[np.ndarray, "touches 3 3"], places: Float[np.ndarray, "touches 3"],
    normals: Float[np.ndarray, "touches 3"],
) -> Touches:  # fmt: skip
    """Touches by vertex number, of where they are in the world [m]."""
    from trimesh.triangles import points_to_barycentric

    carried_by = character.skin.main_joint[corners[:, 0]]
    bind, posed = bind_pose(character.skeleton)[1][carried_by], rotations_world[np.arange(len(pairs)), carried_by]
    home, away = (Rotation.from_quat(q, scalar_first=True) for q in (bind, posed))
    shares = np.nan_to_num(points_to_barycentric(corners_world, places), nan=1 / 3)  # NaN: a flat triangle
    return Touches(pairs, vertices, corners, shares, (home * away.inv()).apply(normals), carried_by)


def hold_term(
    character: Character, touches: Touches, frame_of: Int[np.ndarray, " touches"], reach: int,
    gap: Float[np.ndarray, "frames rows"], weight: Float[np.ndarray, "frames rows"], length: int,
) -> tuple[TouchHold, Bool[np.ndarray, "frames rows"]]:  # fmt: skip
    """The rows of a solve that hold touches, up to a `gap` [m] and as far as the `weight` says, and which of frames and
    rows those are: each has the touch of the frame nearest to it, up to `reach` frames away."""
    frames, rows = weight.shape
    which = np.full((frames, rows), len(frame_of))
    for row in np.unique(touches.pairs):
        own = np.flatnonzero(touches.pairs == row)
        away = np.abs(np.arange(frames)[:, None] - frame_of[own])
        which[:, row] = np.where(away.min(axis=1) <= reach, own[away.argmin(axis=1)], len(frame_of))
    held = (which < len(frame_of)) & (weight > 0.0)
    slots = np.argsort(-np.where(held, weight, 0.0), axis=1, kind="stable")[:, :HELD]
    chosen, kind = np.take_along_axis(which, slots, axis=1), jax.dtypes.canonicalize_dtype(float)

    def of_touches(values: np.ndarray) -> np.ndarray:
        short = np.full((length - frames, chosen.shape[1]), len(frame_of))  # past the last one there is none
        values = np.concatenate([values, np.zeros((1, *values.shape[1:]), values.dtype)])
        return values[np.concatenate([chosen, short])]

    def of_rows(values: np.ndarray) -> np.ndarray:
        values = np.take_along_axis(values, slots, axis=1).astype(kind)
        return np.pad(values, ((0, length - frames), (0, 0)))

    blend = ways(character, touches.vertices, touches.corners, touches.shares).astype(kind)
    term = TouchHold(laid_out(of_touches(blend)), of_touches(touches.normals.astype(kind)), of_touches(touches.carried_by),
                     of_rows(gap), of_rows(np.where(held, weight, 0.0)))  # fmt: skip
    covered = np.zeros_like(held)
    np.put_along_axis(covered, slots, True, axis=1)
    return term, held & covered


def touch_term(
    character: Character, looks: Mapping[int, Touches], columns: Int[np.ndarray, " some"],
    allowed: Mapping[int, Float[np.ndarray, " pairs"]], frames: int, length: int,
) -> TouchClearance:  # fmt: skip
    """The rows of a block, whose pairs are `columns`: each of `frames` has the touches of the look nearest to it. The
    frames after them, up to `length`, only fill a bucket."""
    precision = jax.dtypes.canonicalize_dtype(float)  # the solver's: ten minutes of touches are a gigabyte in double
    at = np.array(sorted(looks) or [0])
    kept = [looks.get(frame, NONE) for frame in at.tolist()]
    kept = [t.only(np.flatnonzero(np.isin(t.pairs, columns))[:KEPT]) for t in kept]
    may = [allowed[frame][t.pairs] if len(t.pairs) else np.zeros(0) for frame, t in zip(at.tolist(), kept, strict=True)]
    nearest = np.abs(np.arange(frames)[:, None] - at).argmin(1)
    nearest = np.pad(nearest, (0, length - frames), "edge")

    def by_frame(rows: list[np.ndarray], filling: float = 0.0) -> np.ndarray:
        short = [KEPT - len(r) for r in rows]
        full = [np.pad(r, ((0, n), *((0, 0),) * (r.ndim - 1)), constant_values=filling)
                for r, n in zip(rows, short, strict=True)]  # fmt: skip
        kind = precision if full[0].dtype.kind == "f" else full[0].dtype
        return np.stack(full).astype(kind)[nearest]

    limits = by_frame(may, NEVER)
    limits[frames:] = NEVER
    blend = [ways(character, t.vertices, t.corners, t.shares) for t in kept]
    found = [np.column_stack([np.full(len(t.pairs), frame), t.pairs, t.vertices, t.corners])
             for frame, t in zip(at.tolist(), kept, strict=True)]  # fmt: skip
    normals, carried_by, shares = (by_frame([getattr(t, k) for t in kept]) for k in ("normals", "carried_by", "shares"))
    return TouchClearance(laid_out(by_frame(blend)), normals, carried_by, limits, by_frame(found), shares)


def ways(
    character: Character, vertices: Int[np.ndarray, " touches"], corners: Int[np.ndarray, "touches 3"],
    shares: Float[np.ndarray, "touches 3"],
) -> Float[np.ndarray, "touches joints 4"]:  # fmt: skip
    """From each vertex to its place as a sum over the joints: skin weight times bind-pose position, homogeneous."""
    skin, order = character.skin, np.arange(len(vertices))
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    points = np.pad(np.asarray(skin.vertices_bind, float), ((0, 0), (0, 1)), constant_values=1.0)
    result = np.zeros((len(order), len(character.skeleton.names), 4))
    for some, share in ((vertices, -np.ones(len(order))), *zip(corners.T, shares.T, strict=True)):
        for k in range(joints.shape[1]):
            np.add.at(result, (order, joints[some, k]), (share * weights[some, k])[:, None] * points[some])
    return result


def laid_out(blend: Float[np.ndarray, "frames touches joints 4"]) -> Float[np.ndarray, "frames four_joints touches"]:
    """Ways as `TouchClearance` has them."""
    return np.ascontiguousarray(np.swapaxes(blend.reshape(*blend.shape[:2], -1), 1, 2))


def touching_on(term: TouchClearance, character: Character) -> TouchClearance:
    """The same touches on a body of the same topology."""
    found = np.asarray(term.found).reshape(-1, 6)
    blend = ways(character, found[:, 2], found[:, 3:], np.asarray(term.shares).reshape(-1, 3))
    frames, _, touches = np.shape(term.blend)
    return eqx.tree_at(lambda t: t.blend, term, laid_out(blend.reshape(frames, touches, -1, 4)))


def _deepest(
    points: Float[np.ndarray, "points 3"], depth: Float[np.ndarray, " points"], least: float
) -> Int[np.ndarray, " chosen"]:
    left, chosen = np.where(depth > least, depth, 0.0), []
    while len(chosen) < AT_ONCE and left.max(initial=0.0) > 0.0:
        chosen.append(int(left.argmax()))
        left[np.linalg.norm(points - points[chosen[-1]], axis=-1) < APART] = 0.0
    return np.array(chosen, int)
