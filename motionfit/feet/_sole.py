"""The sole: the few vertices of the skin that can touch the ground, and where they are in every frame.

Lyard 2007, 3.1 (thesis 3.1.1): take the vertices of the feet by their skin attachment, and of those the ones whose
normal points down. A dense mesh has thousands of them; one per cell of a coarse grid says the same.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from motionfit._character import PARTS, Character
from motionfit._motion import Motion, bind_pose, host_matrices
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import InputError

DOWNWARD = -0.5  # the normal's height component: within 60 degrees of straight down
CELLS = 9  # grid cells along a foot: about 25 vertices per foot, one every 3 cm


class Sole(NamedTuple):
    """Sole vertices of both feet, and what moves them.

    `vertices` are indices into the character's mesh and `side` says whose they are (0 left, 1 right). Each of the
    `joints` has four rows in `carried`: where the vertices are in its frame [m] times their skin weight, and the weight.
    """

    vertices: Int[np.ndarray, " soles"]
    side: Int[np.ndarray, " soles"]
    joints: tuple[int, ...]
    carried: Float[np.ndarray, "rows soles"]
    skeleton: Skeleton

    def of(self, foot: int) -> Int[np.ndarray, " soles_of_foot"]:
        """Rows of one foot: 0 left, 1 right."""
        return np.flatnonzero(self.side == foot)

    def row(self, vertex: int) -> int:
        """The row of a mesh vertex."""
        return int(np.flatnonzero(self.vertices == vertex)[0])


def find_sole(character: Character, *, cells: int | None = CELLS, include: tuple[int, ...] = ()) -> Sole:
    """The sole of each foot: skin of the foot and toe joints with downward normals at bind, thinned out.

    Of each square cell, `cells` of which go along a foot, the lowest vertex is kept: that is the one which can
    touch the ground. `cells=None` keeps every vertex, as the source does. `include` adds mesh vertices of the feet
    that somebody named.
    """
    for known, key, sole in _REMEMBERED:
        if known is character and key == (cells, include):
            return sole
    sole = _find_sole(character, cells, include)
    _REMEMBERED.append((character, (cells, include), sole))
    del _REMEMBERED[:-4]
    return sole


# the soles of the last few characters: finding one takes as long as two hundred frames of footskate removal
_REMEMBERED: list[tuple[Character, tuple, Sole]] = []


def _find_sole(character: Character, cells: int | None, include: tuple[int, ...]) -> Sole:
    skeleton, skin = character.skeleton, character.skin
    skeleton.require(*(f"{s}_foot" for s in SIDES))
    vertices = np.asarray(skin.vertices_bind, float)
    chosen, side = [], []
    for foot, name in enumerate(SIDES):
        mine = np.flatnonzero(character.part_of_vertex == PARTS.index(f"{name}_foot"))
        if len(mine) == 0:
            raise InputError(f"{character.name}: no vertex follows {name}_foot or {name}_toe most, so it has no sole; "
                             "give the foot's skin weights on them, or name the joints with a role mapping")  # fmt: skip
        low = mine[_facing_down(vertices, np.asarray(skin.faces), mine)]
        # where the mesh is inside out the top of the foot faces down: a sole has to be in the lower half of the foot,
        # and to begin at its bottom
        bottom, top = vertices[mine, 1].min(), vertices[mine, 1].max()
        low = low[vertices[low, 1] < 0.5 * (bottom + top)]
        if len(low) == 0 or vertices[low, 1].min() > bottom + 0.05 * (top - bottom):
            raise InputError(f"{character.name}: no vertex of the {name} foot faces down in the bind pose; bind the "
                             "character standing upright (y up), with triangles turned outwards")  # fmt: skip
        thin = low if cells is None else _lowest_per_cell(vertices, low, cells)
        chosen.append(np.union1d(thin, np.intersect1d(mine, np.array(include, int))))
        side.append(np.full(len(chosen[-1]), foot))
    picked = np.concatenate(chosen)
    return Sole(picked, np.concatenate(side), *_carried(character, picked), skeleton)


def _facing_down(vertices: np.ndarray, faces: np.ndarray, mine: np.ndarray) -> np.ndarray:
    """Which of the vertices `mine` have an area-weighted normal within 60 degrees of straight down."""
    is_mine = np.zeros(len(vertices), bool)
    is_mine[mine] = True
    around = faces[is_mine[faces].any(1)]
    corners = vertices[around]
    normals = np.zeros_like(vertices)
    face_normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    for i in range(3):
        np.add.at(normals, around[:, i], face_normals)
    length = np.linalg.norm(normals[mine], axis=1)
    return normals[mine, 1] < DOWNWARD * np.maximum(length, 1e-300)


def _lowest_per_cell(vertices: np.ndarray, low: np.ndarray, cells: int) -> np.ndarray:
    ground = vertices[low][:, [0, 2]]
    size = max(float(np.ptp(ground, axis=0).max()) / cells, 1e-6)
    cell = np.floor((ground - ground.min(0)) / size).astype(int)
    # by cell, lowest first; `unique` keeps the first of each
    order = np.lexsort((low, vertices[low, 1], cell[:, 1], cell[:, 0]))
    _, first = np.unique(cell[order], axis=0, return_index=True)
    return np.sort(low[order[first]])


def _carried(character: Character, picked: np.ndarray) -> tuple[tuple[int, ...], Float[np.ndarray, "rows soles"]]:
    """The joints that move the picked vertices, and `Sole.carried`."""
    positions, rotations = bind_pose(character.skeleton)
    joints = np.asarray(character.skin.joints)[picked]
    weights = np.asarray(character.skin.weights, float)[picked]
    weights = weights / weights.sum(1, keepdims=True)
    bind = np.asarray(character.skin.vertices_bind, float)[picked]
    found, rows = np.unique(joints[weights > 0]).tolist(), []
    for joint in found:
        weight = np.where(joints == joint, weights, 0.0).sum(1)
        local = (bind - positions[joint]) @ host_matrices(rotations[joint])
        rows += [*(weight * local.T), weight]
    return tuple(found), np.array(rows)


def chain_kinematics(
    motion: Motion, joints: tuple[int, ...]
) -> dict[int, tuple[Float[np.ndarray, "frames 3 3"], Float[np.ndarray, "frames 3"]]]:
    """World rotation matrix and position [m] of some joints and all above them, in double precision on the host.

    A sole needs eleven joints of a body's thirty or sixty: the rest is not computed.
    """
    parents = motion.skeleton.parents
    needed: set[int] = set()
    for joint in joints:
        while joint >= 0 and joint not in needed:
            needed.add(joint)
            joint = parents[joint]
    offsets = np.asarray(motion.skeleton.offsets, float)
    order = sorted(needed)
    local = host_matrices(np.asarray(motion.rotations)[:, order].astype(float))
    world: dict[int, tuple[np.ndarray, np.ndarray]] = {}
    for k, joint in enumerate(order):
        parent = parents[joint]
        if parent < 0:
            world[joint] = local[:, k], np.asarray(motion.root, float)
            continue
        turn, place = world[parent]
        offset = offsets[joint] if motion.translations is None else np.asarray(motion.translations)[:, joint, :, None]
        moved = turn @ offset
        world[joint] = turn @ local[:, k], place + (moved if moved.ndim == 2 else moved[..., 0])
    return world


def sole_paths(sole: Sole, motion: Motion) -> Float[np.ndarray, "frames soles 3"]:
    """World position [m] of every sole vertex in every frame: linear blend skinning, thesis (4.20), as one product of
    all joints' [turn | place] with what they carry."""
    world, frames = chain_kinematics(motion, sole.joints), motion.frame_count
    poses = np.empty((frames, 3, len(sole.joints), 4))
    for k, joint in enumerate(sole.joints):
        poses[:, :, k, :3], poses[:, :, k, 3] = world[joint]
    paths = poses.reshape(3 * frames, -1) @ sole.carried
    return np.ascontiguousarray(np.swapaxes(paths.reshape(frames, 3, -1), 1, 2))


def rows_of(sole: Sole, vertex: Int[np.ndarray, "..."]) -> Int[np.ndarray, "..."]:
    """Mesh vertices to rows of the sole, -1 kept."""
    table = np.full(int(sole.vertices.max()) + 2, -1)
    table[sole.vertices] = np.arange(len(sole.vertices))
    return table[vertex]
