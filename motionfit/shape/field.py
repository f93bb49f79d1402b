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
from scipy.ndimage import gaussian_filter, gaussian_filter1d, spline_filter
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import PARTS, Character
from motionfit._motion import Kinematics, Motion, bind_pose, host_kinematics, rest_motion
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray, InputError
from motionfit.shape.volumes import bone_tips

# nodes of the grid per axis: the same for every body, so that their corrections share one compiled program
GRID = {"torso": (28, 44, 26)}
LIMB_GRID = (18, 30, 18)
MARGIN = 0.03  # [m] of grid around the part
FADE = 12.0  # of the depth with the winding number, where a part is cut from its neighbour


class DepthField(eqx.Module):
    """Depth [m] below a part's skin on a grid, in the pose in which it was tabulated: positive inside.

    `coefficients` are those of a quadratic B-spline through the tabulated depths: once continuously differentiable.
    A world point is first taken home, to the tabulated pose, by the part's `joints`, whose frames there are
    `home_rotations` and `home_positions`. The first ones are a chain: along `axis_home` each takes over from the one
    before it between the heights `takeover` [m], so that a bent trunk is followed. The last two are the neighbours
    that pull at the part's skin, as the arm at the shoulder and the thigh at the hip; `pulls` tabulates how much.
    """

    joints: Int[AnyArray, " blended"]
    home_rotations: Float[AnyArray, "blended 3 3"]
    home_positions: Float[AnyArray, "blended 3"]
    origin: Float[AnyArray, "3"]
    spacing: Float[AnyArray, "3"]
    coefficients: Float[AnyArray, "nx ny nz"]
    pulls: Float[AnyArray, "2 nx ny nz"]
    axis_home: Float[AnyArray, "3"]
    takeover: Float[AnyArray, "_ 2"]

    def depth_home(self, points_home: Sequence[Float[AnyArray, "*points"]]) -> Float[Array, "*points"]:
        """Depth [m] of points given in the tabulated pose, one array per coordinate."""
        inside, gap = self._cells(points_home)
        return _lookup(jnp.asarray(self.coefficients)[None], *inside)[0] - gap

    def _cells(self, points_home) -> tuple[list[Array], Array]:
        """Grid coordinates clipped to the grid, and the distance [m] to it, which counts as a gap."""
        origin, spacing = jnp.asarray(self.origin), jnp.asarray(self.spacing)
        cells = [(points_home[a] - origin[a]) / spacing[a] for a in range(3)]
        # half a cell is the spline's reach
        inside = [jnp.clip(c, 0.5, n - 1.5001) for c, n in zip(cells, self.coefficients.shape, strict=True)]
        return inside, sum(jnp.abs(cells[a] - inside[a]) * spacing[a] for a in range(3))  # pyright: ignore[reportReturnType]

    def to_home(self, kin: Kinematics, points_world: Float[Array, "3 frames points"]) -> list[Array]:
        """World points taken to the tabulated pose, one array per coordinate.

        Written out one component at a time: long contiguous vectors, where a trailing axis of 3 or a sum over a
        leading one is several times slower on the CPU. The barriers keep XLA from computing what all points share
        anew for each of them.
        """
        joints = jnp.asarray(self.joints)
        turns = jnp.asarray(self.home_rotations) @ jnp.swapaxes(
            rotation.to_matrix(kin.rotations_world[:, joints]), -1, -2
        )
        places = kin.positions_world[:, joints]
        shifts = jnp.asarray(self.home_positions) - jnp.sum(turns * places[:, :, None, :], axis=-1)
        turns, shifts = _once((turns, shifts))
        moved = _once([
            [shifts[:, j, a, None] + sum(turns[:, j, a, b, None] * points_world[b] for b in range(3)) for a in range(3)]
            for j in range(len(self.joints))
        ])  # fmt: skip
        *chain, first, second = moved
        home = chain[0]
        if len(chain) > 1:
            axis = jnp.asarray(self.axis_home)
            height = sum(axis[a] * sum(m[a] for m in chain) / len(chain) for a in range(3))
            shares = _once([_smoothstep((height - low) / (high - low)) for low, high in jnp.asarray(self.takeover)])
            home = [
                home[a] + sum(s * (m[a] - before[a]) for s, before, m in zip(shares, chain, chain[1:], strict=False))
                for a in range(3)
            ]
        inside, _ = self._cells(home)
        pulls = _once(_lookup(jnp.asarray(self.pulls), *inside))
        return [h + pulls[0] * (f - h) + pulls[1] * (g - h) for h, f, g in zip(home, first, second, strict=True)]

    def depth(self, kin: Kinematics, points_world: Float[Array, "3 frames points"]) -> Float[Array, "frames points"]:
        """Depth [m] of world points below the posed part's skin; negative outside."""
        return self.depth_home(self.to_home(kin, points_world))


_once = jax.lax.optimization_barrier


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


def _slopes(offset) -> tuple:
    return offset - 0.5, -2.0 * offset, offset + 0.5


def _dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


_COLUMNS = np.array([(a, b) for a in range(3) for b in range(3)], np.int32)


@eqx.filter_custom_jvp
def _lookup(tables, x, y, z):
    """Triquadratic B-splines, (tables, points...), at grid coordinates: 27 neighbours, scanned column by column so
    that the program stays small."""
    offsets, base = _cells(tables.shape[1:], (x, y, z))
    wx, wy = (jnp.stack(_weights(o)) for o in offsets[:2])

    def column(total, at):
        a, b = at
        along = _along(tables, base, a, b, _weights(offsets[2]))
        return total + wx[a] * wy[b] * along, None

    return jax.lax.scan(column, jnp.zeros((len(tables), *x.shape), x.dtype), tuple(_COLUMNS.T))[0]


def _along(tables, base, a, b, weights):
    """The weighted three neighbours along z in column (a, b)."""
    _, _, ny, nz = tables.shape
    flat, place = tables.reshape(len(tables), -1), base + (a * ny + b) * nz
    return _dot(weights, [flat.at[:, place + c].get(mode="promise_in_bounds") for c in range(3)])


@_lookup.def_jvp
def _lookup_jvp(primals, tangents):
    """The gradient in closed form, once: every further tangent is then three products per point."""
    tables, x, y, z = primals
    t_tables, *t_points = tangents
    # neither the offsets nor the gradient may be computed anew for each of the tangents
    offsets, base = _once(_cells(tables.shape[1:], (x, y, z)))
    (wx, wy, wz), (sx, sy, sz) = (tuple(jnp.stack(f(o)) for o in offsets) for f in (_weights, _slopes))

    def column(totals, at):
        a, b = at
        level, steep = _along(tables, base, a, b, wz), _along(tables, base, a, b, sz)
        parts = wx[a] * wy[b] * level, sx[a] * wy[b] * level, wx[a] * sy[b] * level, wx[a] * wy[b] * steep
        return tuple(t + p for t, p in zip(totals, parts, strict=True)), None

    zero = jnp.zeros((len(tables), *x.shape), x.dtype)
    value, *gradient = _once(jax.lax.scan(column, (zero,) * 4, tuple(_COLUMNS.T))[0])
    tangent = jnp.zeros_like(value)
    for slope, t in zip(gradient, t_points, strict=True):
        if t is not None:
            tangent = tangent + slope * t
    if t_tables is not None:
        tangent = tangent + _lookup(t_tables, x, y, z)
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


def standing(skeleton: Skeleton, swing: float = 0.0, out: float = 0.035) -> Motion:
    """One frame of standing with the arms hanging straight, `out` [rad] from the vertical to their side and `swing`
    [rad] to the front, all else at bind."""
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
        down = np.array([sign * np.sin(out), -np.cos(out) * np.cos(swing), np.cos(out) * np.sin(swing)])
        for joint, end in ((arm, elbow), (elbow, hand)):
            bone = positions[end] - positions[joint]
            laid, _ = Rotation.align_vectors(down[None], (bone / np.linalg.norm(bone))[None])  # pyright: ignore[reportAssignmentType]
            turned[joint] = laid * Rotation.from_quat(world[joint], scalar_first=True)  # pyright: ignore[reportArgumentType]
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


def fit_field(character: Character, part: str, side: str = "left") -> DepthField:
    """Tabulate the depth below a part's skin, in the `standing` pose.

    The sign is that of the generalised winding number about 1/2. Where a part is cut from its neighbour the winding
    number passes 1/2 smoothly and the depth is faded with it, so that the cut is no wall. `side` says whose arm and
    thigh pull at the trunk.
    """
    import igl

    skeleton, surface = character.skeleton, part_surface(character, part)
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
    squared, nearest, _ = igl.point_mesh_squared_distance(nodes, vertices, surface.triangles)
    depth = np.sqrt(np.maximum(squared, 0.0)) * np.clip(FADE * (winding - 0.5), -1.0, 1.0)
    chain, axis, takeover = _chain(character, part, surface.vertices)
    own, _, kind = part.partition("_")
    around = {"torso": (f"{side}_upper_arm", f"{side}_thigh"), "thigh": ("hips", f"{own}_calf"),
              "calf": (f"{own}_thigh", f"{own}_foot"), "foot": (f"{own}_calf", f"{own}_toe")}.get(
        part if part == "torso" else kind, (part, part))  # fmt: skip
    joints, weights = np.asarray(character.skin.joints)[surface.used], np.asarray(character.skin.weights, float)
    pulls = []
    for role in around:
        pulling = [j for j in range(len(skeleton.names)) if skeleton.nearest_role(j) == role]
        pull = np.where(np.isin(joints, pulling), weights[surface.used], 0.0).sum(-1)
        at_nodes = pull[surface.triangles].mean(-1)[np.asarray(nearest)].reshape(shape)
        pulls.append(gaussian_filter(at_nodes, 0.5) if role != part else np.zeros(shape))
    frames = (*chain, *(skeleton.find(role) if skeleton.find(role) is not None else chain[0] for role in around))
    positions, rotations = (x[0] for x in host_kinematics(standing(skeleton)))
    home = Rotation.from_quat(rotations, scalar_first=True).as_matrix()
    return DepthField(
        np.array(frames), home[list(frames)], positions[list(frames)], low, spacing,
        spline_filter(depth.reshape(shape), order=2), np.stack(pulls), axis, takeover,
    )  # fmt: skip


def _chain(character: Character, part: str, mine: np.ndarray) -> tuple[tuple[int, ...], np.ndarray, np.ndarray]:
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
        turns, shifts = kin.skin_transforms(jnp.asarray(self.joints))
        moves = jnp.concatenate([turns, shifts[..., None]], axis=-1)
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


def sample_vertices(
    character: Character, among: Int[np.ndarray, " some"], count: int, apart_from: Int[np.ndarray, " known"]
) -> Int[np.ndarray, " count"]:
    """`count` vertices by farthest-point sampling, `apart_from` others; the last is repeated where there are fewer, so
    that every body has the same number."""
    points, known = np.asarray(character.skin.vertices_bind, float)[among], list(apart_from)
    distance = np.full(len(points), np.inf)
    for vertex in known:
        distance = np.minimum(
            distance, ((points - np.asarray(character.skin.vertices_bind, float)[vertex]) ** 2).sum(-1)
        )
    chosen = [int(distance.argmax()) if known else int(np.argmin(points @ np.array([0.3, 1.0, 0.2])))]
    for _ in range(min(count, len(points)) - 1):
        distance = np.minimum(distance, ((points - points[chosen[-1]]) ** 2).sum(-1))
        chosen.append(int(distance.argmax()))
    return among[chosen + [chosen[-1]] * (count - len(chosen))]


def make_probes(character: Character, part: str, vertices: Int[np.ndarray, " points"]) -> Probes:
    """Probes at some vertices of a part."""
    skin, carrying = character.skin, carrying_joints(character.skeleton, part)
    joints, shares = np.asarray(skin.joints)[vertices], np.asarray(skin.weights, float)[vertices]
    weights = np.stack([np.where(joints == j, shares, 0.0).sum(-1) for j in carrying])
    weights /= np.maximum(weights.sum(0), 1e-9)
    points = np.asarray(skin.vertices_bind, float)[vertices]
    homogeneous = np.concatenate([points.T, np.ones((1, len(vertices)))])
    return Probes(np.array(carrying), weights[:, None] * homogeneous[None])


def carrying_joints(skeleton: Skeleton, part: str) -> tuple[int, ...]:
    """The joints that carry a part's probes: its own, and those of the limbs next to it.

    Weights of joints further away are left out, so a vertex in the fold of an armpit, which hangs on the spine too,
    goes with the arm by a centimetre more than on the skin. That errs towards the trunk, where the fields know least:
    with all weights kept, the fields lose sight of the fold on bodies whose arms and trunk are 1.6 times as thick.
    """
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
