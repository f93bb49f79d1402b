"""A body part's own piece of the skin, and how deep points are inside it: exactly, frame by frame, on the host.

Generalised winding numbers and distances come from libigl, which builds a tree of all triangles for each call. On a
posed body that takes far longer than to ask it, so what can be told by simpler means is not asked.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from motionfit._character import PARTS, Character
from motionfit._types import InputError

SLICES = 16  # of a surface along its length, at most
SIDES_OF_SLICE = 8
APART = 0.05  # [m] between points that are measured one after the other, each with the triangles near it
EVERY = 4  # vertices of a surface that bound a distance


class Surface(NamedTuple):
    """A body part's own piece of the skin."""

    vertices: Int[np.ndarray, " part"]  # the part's vertices, in the whole mesh
    used: Int[np.ndarray, " used"]  # the vertices that its triangles use
    triangles: Int[np.ndarray, "triangles 3"]  # in indices into `used`


def part_surface(character: Character, part: str) -> Surface:
    """The vertices and triangles of a part; a triangle across a border belongs to the part of two of its corners."""
    if part not in PARTS:
        raise InputError(f"unknown part {part!r}; parts: {', '.join(PARTS)}")
    key = ("surface", part)
    if key not in character.memo:
        index, part_of_vertex = PARTS.index(part), character.part_of_vertex
        faces = np.asarray(character.skin.faces)
        of_face = np.median(np.sort(part_of_vertex[faces], axis=1), axis=1).astype(int)
        used, local = np.unique(faces[of_face == index], return_inverse=True)
        surface = Surface(np.flatnonzero(part_of_vertex == index), used, local.reshape(-1, 3).astype(np.int64))
        character.memo[key] = surface
    return character.memo[key]


class Inside(NamedTuple):
    """The points that are inside a surface, and where it is nearest to them."""

    points: Int[np.ndarray, " inside"]  # among those asked about
    depth: Float[np.ndarray, " inside"]  # [m]
    triangles: Int[np.ndarray, " inside"]
    places: Float[np.ndarray, "inside 3"]  # [m]


def find_inside(
    points: Float[np.ndarray, "points 3"], vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "t 3"]
) -> Inside:
    """The points inside a surface: those of generalised winding number > 1/2.

    Jacobson et al. 2013, Barill et al. 2018, through libigl: surfaces may be open, as a cut-out part is.
    """
    import igl

    near = np.zeros(0, int)
    if len(triangles) and len(points):
        near = np.flatnonzero(may_be_inside(points, vertices, triangles))
    if len(near):
        near = near[np.asarray(igl.fast_winding_number(vertices, triangles, points[near])) > 0.5]
    if len(near) == 0:
        return Inside(near, np.zeros(0), near, np.zeros((0, 3)))
    return Inside(near, *_nearest(points[near], vertices, triangles, *_spans(vertices, triangles)))


def inside_depths(
    points: Float[np.ndarray, "points 3"], vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, " points"]:
    """Depth [m] of points inside a surface, 0 for those outside."""
    found, depth = find_inside(points, vertices, triangles), np.zeros(len(points))
    depth[found.points] = found.depth
    return depth


class Gap(NamedTuple):
    """How far [m] the nearest of some points is from a surface, or the deepest is inside, below zero."""

    gap: float
    point: int  # which it is
    triangle: int
    place: Float[np.ndarray, "3"]  # [m] on the surface, where that is nearest to it


def surface_gaps(
    sets: Sequence[Float[np.ndarray, "_ 3"]], vertices: Float[np.ndarray, "vertices 3"],
    triangles: Int[np.ndarray, "t 3"],
) -> list[Gap]:  # fmt: skip
    """How far each set of points is from a surface, or how deep inside."""
    ends = np.cumsum([len(points) for points in sets])
    found, near = find_inside(np.concatenate(sets), vertices, triangles), KDTree(vertices)
    cuts, gaps = np.searchsorted(found.points, ends), []
    for points, end, low, high in zip(sets, ends, [0, *cuts[:-1]], cuts, strict=True):
        if low == high:
            gaps.append(_nearest_outside(points, near, vertices, triangles))
            continue
        k = low + int(found.depth[low:high].argmax())
        point = int(found.points[k]) - int(end) + len(points)
        gaps.append(Gap(-float(found.depth[k]), point, int(found.triangles[k]), found.places[k].copy()))
    return gaps


def _nearest_outside(
    points: Float[np.ndarray, "points 3"], near: KDTree, vertices: Float[np.ndarray, "vertices 3"],
    triangles: Int[np.ndarray, "t 3"],
) -> Gap:  # fmt: skip
    """The nearest of some points, all outside a surface."""
    import igl

    # the nearest vertex says which points and triangles can be nearer yet
    apart = np.asarray(near.query(points)[0])
    bound = float(apart.min())
    low, high = _spans(vertices, triangles)
    some = np.flatnonzero(apart <= bound + float(np.linalg.norm(high - low, axis=1).max()))
    box = points[some].min(axis=0) - bound, points[some].max(axis=0) + bound
    beside = np.flatnonzero(_overlap(low, high, *box))
    nearest = igl.point_mesh_squared_distance(points[some], vertices, triangles[beside])
    squared, triangle, place = (np.asarray(x) for x in nearest)
    k = int(squared.argmin())
    return Gap(float(np.sqrt(max(squared[k], 0.0))), int(some[k]), int(beside[triangle[k]]), place[k].copy())


def may_be_inside(
    points: Float[np.ndarray, "points 3"], vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "t 3"]
) -> Bool[np.ndarray, " points"]:
    """False for points that are outside a surface for certain: beyond the octagon around its slice at their height.

    All around a point inside, at its own height along any axis, there is surface: that of its own slice or, where a
    triangle reaches over a border, of the next one. An opening is closed by what lies around it.
    """
    columns = np.ascontiguousarray(vertices.T)
    may = _overlap(points, points, columns.min(1), columns.max(1))
    if not may.any():
        return may
    middle = vertices.mean(0)
    about = vertices - middle
    across, second, axis = np.linalg.eigh(about.T @ about)[1].T
    heights = about @ axis
    least, greatest = _spans(heights, triangles)
    longest = float((greatest - least).max())
    low, length = float(heights.min()), float(np.ptp(heights))
    slices = int(np.clip(length / max(longest, 1e-9), 1, SLICES))

    def slice_of(heights):
        return np.clip(((heights - low) * (slices / max(length, 1e-9))).astype(int), 0, slices - 1)

    angles = np.arange(SIDES_OF_SLICE) * (2 * np.pi / SIDES_OF_SLICE)
    directions = np.outer(across, np.cos(angles)) + np.outer(second, np.sin(angles))
    own = slice_of(heights)
    reach = np.full((slices + 2, SIDES_OF_SLICE), -np.inf)
    order = np.argsort(own, kind="stable")
    filled, starts = np.unique(own[order], return_index=True)
    reach[filled + 1] = np.maximum.reduceat((about @ directions)[order], starts)
    reach = np.maximum(np.maximum(reach[:-2], reach[1:-1]), reach[2:])
    some = np.flatnonzero(may)
    about = points[some] - middle
    may[some] = (about @ directions <= reach[slice_of(about @ axis)]).all(-1)
    return may


def _nearest(
    points: Float[np.ndarray, "points 3"], vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "t 3"],
    low: Float[np.ndarray, "t 3"], high: Float[np.ndarray, "t 3"],
) -> tuple[Float[np.ndarray, " points"], Int[np.ndarray, " points"], Float[np.ndarray, "points 3"]]:  # fmt: skip
    """Distance [m] of points to triangles, whose boxes are given, the nearest triangle and the place on it. Points that
    are apart, as under two arms, are measured apart."""
    import igl

    axis = int(np.ptp(points, axis=0).argmax())
    order = np.argsort(points[:, axis])
    gaps = np.diff(points[order, axis])
    if len(gaps) and gaps.max() > APART:
        cut, back = int(gaps.argmax()) + 1, np.argsort(order)
        parts = [_nearest(points[some], vertices, triangles, low, high) for some in (order[:cut], order[cut:])]
        distance, triangle, place = (np.concatenate(both)[back] for both in zip(*parts, strict=True))
        return distance, triangle, place
    # no point is further from the surface than from some of its vertices
    bound = cdist(points, vertices[triangles[::EVERY, 0]]).min(1)[:, None]
    near = np.flatnonzero(_overlap(low, high, (points - bound).min(0), (points + bound).max(0)))
    squared, triangle, place = igl.point_mesh_squared_distance(points, vertices, triangles[near])
    return np.sqrt(np.maximum(np.asarray(squared), 0.0)), near[np.asarray(triangle)], np.asarray(place)


def _spans(
    values: Float[np.ndarray, "vertices *of"], triangles: Int[np.ndarray, "t 3"]
) -> tuple[Float[np.ndarray, "t *of"], Float[np.ndarray, "t *of"]]:
    """The least and the greatest of each triangle's corners: column by column, since NumPy goes through an axis of
    length three one item at a time, and a posed torso's boxes would take longer than its tree's answers."""
    a, b, c = (values[corner] for corner in np.ascontiguousarray(triangles.T))
    return np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)


def _overlap(
    low: Float[np.ndarray, "boxes 3"], high: Float[np.ndarray, "boxes 3"], least: Float[np.ndarray, " 3"],
    greatest: Float[np.ndarray, " 3"],
) -> Bool[np.ndarray, " boxes"]:  # fmt: skip
    """Which boxes reach into the one from `least` to `greatest`; column by column too."""
    inside = [(high[:, i] >= least[i]) & (low[:, i] <= greatest[i]) for i in range(3)]
    return inside[0] & inside[1] & inside[2]
