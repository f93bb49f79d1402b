"""A closed mesh cut into closed solids, and the volume, centre and second moments of each."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components


def solid_moments(
    corners: Float[np.ndarray, "triangles 3 3"],
) -> tuple[float, Float[np.ndarray, "3"], Float[np.ndarray, "3 3"]]:
    """Volume [m^3], centre [m] and second moment about the centre, integral of x x^T [m^5], of a closed surface.

    Sums over the tetrahedra from each triangle to a common point (Tonon 2004; the divergence theorem), exact for
    any closed surface, convex or not.
    """
    origin = corners.reshape(-1, 3).mean(0)  # near the solid: less cancellation
    a, b, c = np.moveaxis(corners - origin, 1, 0)
    six = np.einsum("ti,ti->t", a, np.cross(b, c))  # six times the signed volume
    volume = six.sum() / 6
    total = a + b + c
    first = (six @ total) / 24
    second = sum(np.einsum("t,ti,tj->ij", six, v, v) for v in (a, b, c, total)) / 120
    centre = first / volume if abs(volume) > 1e-15 else np.zeros(3)
    return float(volume), origin + centre, second - volume * np.outer(centre, centre)


def cut_and_cap(
    vertices: Float[np.ndarray, "vertices 3"], faces: Int[np.ndarray, "faces 3"], owner: Int[np.ndarray, " faces"]
) -> dict[int, Float[np.ndarray, "triangles 3 3"]]:
    """A mesh cut into closed solids, one per owner of a face, as triangle corners [m].

    Neighbours share their cut: for each connected run of border edges between two owners, a fan from the run's
    mean; where three owners meet, the fans are joined along straight lines to a common middle. So the solids fill
    the whole mesh exactly, and their volumes add up to it. Holes of the mesh are capped in the same way.
    """
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    of_edge = np.tile(owner, 3)
    key = edges.min(1) * np.int64(len(vertices)) + edges.max(1)
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.r_[True, np.diff(key[order]) != 0])
    count = np.diff(np.r_[first, len(order)])
    paired = order[first[count == 2, None] + np.arange(2)].reshape(-1, 2)
    opposite = edges[paired[:, 0], 0] == edges[paired[:, 1], 1]
    between = paired[opposite & (of_edge[paired[:, 0]] != of_edge[paired[:, 1]])]
    regular = np.zeros(len(edges), bool)
    regular[paired[opposite].ravel()] = True
    loose = np.flatnonzero(~regular)  # the mesh's own holes, and edges of more than two faces
    # half edges of the cuts, as the owner sees them; the other side of a hole is -1
    own = np.r_[between[:, 0], between[:, 1], loose]
    other = np.r_[of_edge[between[:, 1]], of_edge[between[:, 0]], np.full(len(loose), -1)]
    solids = {int(k): [vertices[faces[owner == k]]] for k in np.unique(owner)}
    if not len(own):
        return {k: v[0] for k, v in solids.items()}
    start, end, mine = edges[own, 0], edges[own, 1], of_edge[own]
    # the common middle of each connected net of cuts
    net = _components(start, end, len(vertices))
    low, high = np.minimum(mine, other), np.maximum(mine, other)
    for pair in np.unique(np.stack([low, high], axis=1), axis=0):
        of_pair = np.flatnonzero((low == pair[0]) & (high == pair[1]))
        runs = _components(start[of_pair], end[of_pair], len(vertices))
        for run in np.unique(runs[start[of_pair]]):
            some = of_pair[runs[start[of_pair]] == run]
            apex = (vertices[start[some]] + vertices[end[some]]).mean(0) / 2
            middle = vertices[np.unique(start[net[start] == net[start[some[0]]]])].mean(0)
            for k in (k for k in pair if k >= 0):
                seen = some[mine[some] == k]
                # the cap runs against the border of the owner's own faces
                solids[int(k)].append(_fan(apex, vertices[end[seen]], vertices[start[seen]]))
                loose_ends = np.bincount(start[seen], minlength=len(vertices)) - np.bincount(
                    end[seen], minlength=len(vertices)
                )
                for vertex in np.flatnonzero(loose_ends):
                    # an open run: its ends are where a third owner begins
                    spoke = np.stack([apex, vertices[vertex], middle])
                    spoke = spoke if loose_ends[vertex] > 0 else spoke[[0, 2, 1]]
                    solids[int(k)] += [spoke[None]] * abs(int(loose_ends[vertex]))
    return {k: np.concatenate(v) for k, v in solids.items()}


def _components(start: np.ndarray, end: np.ndarray, count: int) -> np.ndarray:
    graph = coo_array((np.ones(len(start)), (start, end)), shape=(count, count))
    return connected_components(graph, directed=False)[1]


def _fan(apex: np.ndarray, first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.stack([np.broadcast_to(apex, first.shape), first, second], axis=1)
