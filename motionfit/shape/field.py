"""Depth fields: how deep a point is inside a body part's own skin, as a smooth table that is cheap to differentiate.

The skin judges, so the skin is what the objective sees. A part's surface is cut out of the mesh, posed with the arms
hanging (there limbs meet trunks; in an A-pose the armpit has another shape), and its signed distance is tabulated on
a grid in the bind frame, once per body. A lookup costs a few nanoseconds and has a closed-form gradient, whereas
winding numbers of the mesh have none.
"""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter1d, spline_filter
from scipy.spatial.transform import Rotation

from motionfit._character import PARTS, Character
from motionfit._motion import Kinematics, Motion, bind_pose, host_kinematics, rest_motion
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray, InputError
from motionfit.shape.volumes import bone_tips

# nodes of the grid per axis: the same for every body, so that their corrections share one compiled program
GRID = {"torso": (28, 44, 26)}
LIMB_GRID = (18, 30, 18)
MARGIN = 0.03  # [m] of grid around the part


class DepthField(eqx.Module):
    """Depth [m] below a part's skin on a grid in the bind frame: positive inside, negative outside.

    `coefficients` are those of a quadratic B-spline through the tabulated depths: once continuously differentiable.
    World points are first taken to the bind pose through the part's `joints`. Along `axis_bind` each joint takes over
    from the one before it between the heights `takeover` [m], so that a bent trunk is followed.
    """

    joints: Int[AnyArray, " blended"]
    origin_bind: Float[AnyArray, "3"]
    spacing: Float[AnyArray, "3"]
    coefficients: Float[AnyArray, "nx ny nz"]
    axis_bind: Float[AnyArray, "3"]
    takeover: Float[AnyArray, "blended-1 2"]

    def depth_bind(self, points_bind: Sequence[Float[AnyArray, "*points"]]) -> Float[Array, "*points"]:
        """Depth [m] of points given in the bind pose, one array per coordinate."""
        origin, spacing = jnp.asarray(self.origin_bind), jnp.asarray(self.spacing)
        cells = [(points_bind[a] - origin[a]) / spacing[a] for a in range(3)]
        # half a cell is the spline's reach; outside, the distance to the grid counts as a gap
        inside = [jnp.clip(c, 0.5, n - 1.5001) for c, n in zip(cells, self.coefficients.shape, strict=True)]
        gap = sum(jnp.abs(cells[a] - inside[a]) * spacing[a] for a in range(3))
        return _lookup(jnp.asarray(self.coefficients), *inside) - gap

    def to_bind(self, kin: Kinematics, points_world: Float[Array, "3 frames points"]) -> list[Array]:
        """World points taken into the bind pose of this part, one array per coordinate.

        Written out one component at a time: long contiguous vectors, where a trailing axis of 3 or a sum over a
        leading one is several times slower on the CPU.
        """
        chain = jnp.asarray(self.joints)
        turn, shift = kin.skin_rotations[:, chain], kin.skin_translations[:, chain]  # M_j B_j^-1
        moved = []
        for j in range(len(self.joints)):
            gap = [points_world[b] - shift[:, j, b, None] for b in range(3)]
            moved.append([sum(turn[:, j, b, a, None] * gap[b] for b in range(3)) for a in range(3)])
        if len(moved) == 1:
            return moved[0]
        axis, heights = jnp.asarray(self.axis_bind), jnp.asarray(self.takeover)
        height = sum(axis[a] * sum(m[a] for m in moved) / len(moved) for a in range(3))
        shares = [_smoothstep((height - low) / (high - low)) for low, high in heights]
        return [
            moved[0][a] + sum(s * (m[a] - before[a]) for s, before, m in zip(shares, moved, moved[1:], strict=False))
            for a in range(3)
        ]

    def depth(self, kin: Kinematics, points_world: Float[Array, "3 frames points"]) -> Float[Array, "frames points"]:
        """Depth [m] of world points below the posed part's skin; negative outside."""
        return self.depth_bind(self.to_bind(kin, points_world))


def _smoothstep(x):
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _cells(shape: tuple[int, ...], point: tuple) -> tuple[list[Array], Array]:
    """Offsets of grid coordinates from their nearest node, and the flat index of the first of the 27 neighbours."""
    nodes = [jnp.round(c) for c in point]
    i, j, k = (n.astype(jnp.int32) - 1 for n in nodes)
    return [c - n for c, n in zip(point, nodes, strict=True)], (i * shape[1] + j) * shape[2] + k


def _weights(offset) -> tuple:
    return 0.5 * (0.5 - offset) ** 2, 0.75 - offset * offset, 0.5 * (0.5 + offset) ** 2


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


@eqx.filter_custom_jvp
def _lookup(coefficients, x, y, z):
    """Triquadratic B-spline at grid coordinates: 27 neighbours."""
    _, ny, nz = coefficients.shape
    offsets, base = _cells(coefficients.shape, (x, y, z))
    wx, wy, wz = (_weights(o) for o in offsets)
    flat = coefficients.reshape(-1)

    def column(a, b):
        return [flat.at[base + ((a * ny + b) * nz + c)].get(mode="promise_in_bounds") for c in range(3)]

    return _dot(wx, [_dot(wy, [_dot(wz, column(a, b)) for b in range(3)]) for a in range(3)])


@_lookup.def_jvp
def _lookup_jvp(primals, tangents):
    """The gradient in closed form, once: every further tangent is then three products per point."""
    coefficients, x, y, z = primals
    t_coefficients, *t_points = tangents
    _, ny, nz = coefficients.shape
    offsets, base = _cells(coefficients.shape, (x, y, z))
    # neither the offsets nor the gradient may be computed anew for each of the tangents
    offsets, base = jax.lax.optimization_barrier((offsets, base))
    wx, wy, wz = (_weights(o) for o in offsets)
    sx, sy, sz = ((o - 0.5, -2.0 * o, o + 0.5) for o in offsets)
    flat = coefficients.reshape(-1)
    rows = []
    for a in range(3):
        columns = [
            [flat.at[base + ((a * ny + b) * nz + c)].get(mode="promise_in_bounds") for c in range(3)] for b in range(3)
        ]
        along, steep = [_dot(wz, c) for c in columns], [_dot(sz, c) for c in columns]
        rows.append((_dot(wy, along), _dot(sy, along), _dot(wy, steep)))
    level, across, along = zip(*rows, strict=True)
    value, *gradient = jax.lax.optimization_barrier((_dot(wx, level), _dot(sx, level), _dot(wx, across), _dot(wx, along)))
    tangent = jnp.zeros_like(value)
    for slope, t in zip(gradient, t_points, strict=True):
        if t is not None:
            tangent = tangent + slope * t
    if t_coefficients is not None:
        tangent = tangent + _lookup(t_coefficients, x, y, z)
    return value, tangent


# --- making them ------------------------------------------------------------------------------------------------


class Surface(NamedTuple):
    """A body part's own piece of the skin."""

    vertices: Int[np.ndarray, " part"]  # the part's vertices, in the whole mesh
    used: Int[np.ndarray, " used"]  # the vertices that its triangles use
    triangles: Int[np.ndarray, "triangles 3"]  # in indices into `used`


def part_surface(character: Character, part: str) -> Surface:
    """The vertices and triangles of a part; a triangle across a border belongs to the part of two of its corners."""
    if part not in PARTS:
        raise InputError(f"unknown part {part!r}; parts: {', '.join(PARTS)}")
    index, part_of_vertex = PARTS.index(part), character.part_of_vertex
    faces = np.asarray(character.skin.faces)
    of_face = np.median(np.sort(part_of_vertex[faces], axis=1), axis=1).astype(int)
    used, local = np.unique(faces[of_face == index], return_inverse=True)
    return Surface(np.flatnonzero(part_of_vertex == index), used, local.reshape(-1, 3).astype(np.int64))


def inside_depths(
    points: Float[np.ndarray, "points 3"], vertices: Float[np.ndarray, "vertices 3"], triangles: Int[np.ndarray, "t 3"]
) -> Float[np.ndarray, " points"]:
    """Depth [m] of points inside a surface (generalised winding number > 1/2), 0 for those outside.

    Jacobson et al. 2013, Barill et al. 2018, through libigl: surfaces may be open, as a cut-out part is.
    """
    import igl

    depth = np.zeros(len(points))
    if len(triangles) == 0:
        return depth
    near = np.flatnonzero(((points >= vertices.min(0)) & (points <= vertices.max(0))).all(-1))
    if len(near) == 0:
        return depth
    near = near[np.asarray(igl.fast_winding_number(vertices, triangles, points[near])) > 0.5]
    if len(near):
        squared = np.asarray(igl.point_mesh_squared_distance(points[near], vertices, triangles)[0])
        depth[near] = np.sqrt(np.maximum(squared, 0.0))
    return depth


def standing(skeleton: Skeleton) -> Motion:
    """One frame of standing with the arms hanging 2 degrees from the vertical and straight, all else at bind."""
    rest = rest_motion(skeleton)
    positions, world = bind_pose(skeleton)
    rotations = np.array(rest.rotations, float)
    turned: dict[int, Rotation] = {}
    for side in SIDES:
        chain = [skeleton.find(f"{side}_{r}") for r in ("upper_arm", "forearm", "hand")]
        if None in chain:
            continue
        arm, elbow, hand = chain
        sign = np.sign(positions[arm][0] - positions[skeleton.joint("chest")][0])
        down = np.array([sign * np.sin(np.deg2rad(2)), -np.cos(np.deg2rad(2)), 0.0])
        for joint, end in ((arm, elbow), (elbow, hand)):
            bone = positions[end] - positions[joint]
            laid, _ = Rotation.align_vectors(down[None], (bone / np.linalg.norm(bone))[None])
            turned[joint] = laid * Rotation.from_quat(world[joint], scalar_first=True)
    for joint in sorted(turned):
        above, path = Rotation.identity(), []
        parent = skeleton.parents[joint]
        while parent >= 0 and parent not in turned:
            path.append(parent)
            parent = skeleton.parents[parent]
        above = turned[parent] if parent >= 0 else above
        for between in reversed(path):
            above = above * Rotation.from_quat(rotations[0, between], scalar_first=True)
        rotations[0, joint] = (above.inv() * turned[joint]).as_quat(scalar_first=True)
    return Motion(skeleton, rest.root, rotations, rest.dt)


def standing_vertices(character: Character) -> Float[np.ndarray, "vertices 3"]:
    """World vertices [m] of the skin in the `standing` pose, (4.20), on the host."""
    skeleton, skin = character.skeleton, character.skin
    bind_positions, bind_rotations = bind_pose(skeleton)
    positions, rotations = (x[0] for x in host_kinematics(standing(skeleton)))
    turn = (
        Rotation.from_quat(rotations, scalar_first=True) * Rotation.from_quat(bind_rotations, scalar_first=True).inv()
    ).as_matrix()
    shift = positions - np.einsum("jab,jb->ja", turn, bind_positions)
    joints, weights = np.asarray(skin.joints), np.asarray(skin.weights, float)
    vertices = np.asarray(skin.vertices_bind, float)
    moved = np.einsum("vkab,vb->vka", turn[joints], vertices) + shift[joints]
    return np.einsum("vk,vka->va", weights, moved)


def fit_field(character: Character, part: str) -> DepthField:
    """Tabulate the depth below a part's skin.

    The sign is that of the generalised winding number about 1/2. Where a part is cut from its neighbour the winding
    number passes 1/2 smoothly and the depth is faded with it, so that the cut is no wall.
    """
    import igl

    surface = part_surface(character, part)
    if len(surface.vertices) < 50 or len(surface.triangles) == 0:
        raise InputError(f"{character.name}: part {part!r} has {len(surface.vertices)} vertices, too few to fit a "
                         "volume; check the skin weights and the role mapping")  # fmt: skip
    vertices = standing_vertices(character)[surface.used]
    shape = np.array(GRID.get(part, LIMB_GRID))
    low, high = vertices.min(0) - MARGIN, vertices.max(0) + MARGIN
    spacing = (high - low) / (shape - 1)
    axes = [low[a] + spacing[a] * np.arange(shape[a]) for a in range(3)]
    nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    winding = np.asarray(igl.fast_winding_number(vertices, surface.triangles, nodes))
    squared = np.asarray(igl.point_mesh_squared_distance(nodes, vertices, surface.triangles)[0])
    depth = np.sqrt(np.maximum(squared, 0.0)) * np.clip(4.0 * (winding - 0.5), -1.0, 1.0)
    coefficients = spline_filter(depth.reshape(shape), order=2)
    chain, axis, takeover = _blend(character, part, surface.vertices)
    return DepthField(np.array(chain), low, spacing, coefficients, axis, takeover)


def _blend(character: Character, part: str, mine: np.ndarray) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
    """The joints that carry a part, its axis, and the heights [m] between which each joint takes over."""
    skeleton, skin = character.skeleton, character.skin
    positions, tips = bind_pose(skeleton)[0], bone_tips(skeleton)
    if part != "torso":
        joint = skeleton.joint(part)
        axis = tips[joint] - positions[joint]
        return (joint,), axis / max(float(np.linalg.norm(axis)), 1e-9), np.zeros((0, 2))
    chain = (skeleton.joint("hips"), *skeleton.chain("spine"))
    axis = positions[chain[-1]] - positions[chain[0]]
    axis = axis / max(float(np.linalg.norm(axis)), 1e-9)
    heights = np.asarray(skin.vertices_bind, float)[mine] @ axis
    joints, weights = np.asarray(skin.joints)[mine], np.asarray(skin.weights, float)[mine]
    # skin of clavicles, hip helpers and the like moves with the chain's joint that carries them
    owners = np.array([_owner(skeleton, j, chain) for j in range(len(skeleton.names))])
    shares = np.stack([np.where(owners[joints] == k, weights, 0.0).sum(-1) for k in range(len(chain))], axis=1)
    shares /= np.maximum(shares.sum(-1, keepdims=True), 1e-9)
    order = np.argsort(heights)
    takeover = []
    for k in range(1, len(chain)):
        # how much of the skin at a height belongs to this joint or a later one, as a rising curve
        above = np.maximum.accumulate(gaussian_filter1d(shares[order, k:].sum(-1), len(order) / 40))
        low, high = np.interp((0.2, 0.8), above + 1e-9 * np.arange(len(above)), heights[order])
        middle, half = (low + high) / 2, max((high - low) / 2 / 0.43, 0.02)  # smoothstep is 0.2 at 0.287, 0.8 at 0.713
        takeover.append((middle - half, middle + half))
    return chain, axis, np.array(takeover)


def _owner(skeleton: Skeleton, joint: int, chain: tuple[int, ...]) -> int:
    """Index into `chain` of the joint itself or of the nearest one above it; -1 for limbs' own joints."""
    role = skeleton.nearest_role(joint) or "hips"
    trunk = role in ("hips", "chest", "left_clavicle", "right_clavicle") or role.startswith("spine_")
    if len(chain) > 1 and not trunk:
        return -1
    while joint not in chain and skeleton.parents[joint] >= 0:
        joint = skeleton.parents[joint]
    return chain.index(joint) if joint in chain else -1


# --- sampled skin points ----------------------------------------------------------------------------------------


class Probes(eqx.Module):
    """Points of a part's own skin that are tested against other parts' fields.

    `blend` holds skin weight times bind-pose position, so that posing all of them, (4.20), is one matrix product
    with the transforms of the few `joints` that carry the part.
    """

    joints: Int[AnyArray, " carrying"]
    blend: Float[AnyArray, "carrying 4 points"]

    def positions_world(self, kin: Kinematics) -> Float[Array, "3 frames points"]:
        """World positions [m], coordinates first."""
        chain = jnp.asarray(self.joints)
        moves = jnp.concatenate([kin.skin_rotations[:, chain], kin.skin_translations[:, chain, :, None]], axis=-1)
        blend = jnp.asarray(self.blend, moves.dtype)
        frames, carrying = moves.shape[:2]
        rows = jnp.moveaxis(moves, 2, 0).reshape(3 * frames, carrying * 4)
        return (rows @ blend.reshape(carrying * 4, -1)).reshape(3, frames, -1)

    def __getitem__(self, points: np.ndarray) -> "Probes":
        return Probes(self.joints, self.blend[..., points])

    @classmethod
    def joined(cls, some: Sequence["Probes"]) -> "Probes":
        """Several as one, on the joints of all of them."""
        joints = sorted(set(np.concatenate([p.joints for p in some]).tolist()))
        blend = np.zeros((len(joints), 4, sum(p.blend.shape[2] for p in some)))
        start = 0
        for p in some:
            stop = start + p.blend.shape[2]
            blend[[joints.index(j) for j in p.joints.tolist()], :, start:stop] = p.blend
            start = stop
        return cls(np.array(joints), blend)


def sample_probes(character: Character, part: str, count: int, vertices: np.ndarray | None = None) -> Probes:
    """`count` vertices of the part by farthest-point sampling, among `vertices` where given.

    A part with fewer repeats its last one, so that every body has the same number of points.
    """
    skin, skeleton = character.skin, character.skeleton
    mine = np.flatnonzero(character.part_of_vertex == PARTS.index(part)) if vertices is None else vertices
    if len(mine) == 0:
        raise InputError(
            f"{character.name}: part {part!r} has no vertices; check the skin weights and the role mapping"
        )
    points = np.asarray(skin.vertices_bind, float)[mine]
    chosen = [int(np.argmin(points @ np.array([0.3, 1.0, 0.2])))]
    distance = np.full(len(points), np.inf)
    for _ in range(min(count, len(points)) - 1):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(distance.argmax()))
    chosen += [chosen[-1]] * (count - len(chosen))
    carrying = carrying_joints(skeleton, part)
    weights = np.zeros((len(carrying), count))
    for column, vertex in enumerate(mine[chosen]):
        for joint, weight in zip(np.asarray(skin.joints)[vertex], np.asarray(skin.weights, float)[vertex], strict=True):
            if joint in carrying:
                weights[carrying.index(joint), column] += weight
    weights /= np.maximum(weights.sum(0), 1e-9)
    homogeneous = np.concatenate([points[chosen].T, np.ones((1, count))])
    return Probes(np.array(carrying), weights[:, None] * homogeneous[None])


def carrying_joints(skeleton: Skeleton, part: str) -> tuple[int, ...]:
    """The joints whose skin weights can reach a part: its own, and those of the limbs next to it."""
    side, _, kind = part.partition("_")
    around = {
        "upper_arm": ("chest", f"{side}_clavicle", f"{side}_forearm"),
        "forearm": (f"{side}_upper_arm", f"{side}_hand"),
        "hand": (f"{side}_forearm",),
        "thigh": ("hips", f"{side}_calf", *(f"{s}_thigh" for s in SIDES if s != side)),
        "calf": (f"{side}_thigh", f"{side}_foot"),
        "foot": (f"{side}_calf", f"{side}_toe"),
    }.get(kind, ())
    roles = {part, *around}
    return tuple(j for j in range(len(skeleton.names)) if skeleton.nearest_role(j) in roles)
