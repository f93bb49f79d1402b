"""Depth fields: how deep a point is inside a body part's own skin, as a smooth table that is cheap to differentiate.

The skin judges, so the skin is what the objective sees. A part's surface is cut out of the mesh, posed with the arms
hanging (there limbs meet trunks; in an A-pose the armpit has another shape), and its signed distance is tabulated on
a grid in the bind frame, once per body. A lookup costs a few nanoseconds and has a closed-form gradient, whereas
winding numbers of the mesh have none.
"""

import math
from collections.abc import Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.ndimage import gaussian_filter, gaussian_filter1d, spline_filter
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import Character
from motionfit._motion import Kinematics, Motion, bind_pose, host_kinematics, rest_motion
from motionfit._skeleton import SIDES, Skeleton
from motionfit._types import AnyArray, InputError
from motionfit.shape.surface import part_surface
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

    def depth_home(self, points_home: Float[AnyArray, "*frames 3 points"]) -> Float[Array, "*frames points"]:
        """Depth [m] of points given in the tabulated pose."""
        return _Meeting.of((self,), (points_home.shape[-1],)).depth_home(jnp.asarray(points_home))

    def depth(self, kin: Kinematics, points_world: Float[AnyArray, "frames 3 points"]) -> Float[Array, "frames points"]:
        """Depth [m] of world points below the posed part's skin; negative outside."""
        return depths(kin, (self,), (jnp.asarray(points_world),))


def depths(
    kin: Kinematics, fields: Sequence[DepthField], points_world: Sequence[Float[Array, "frames 3 _"]]
) -> Float[Array, "frames all_points"]:
    """Depth [m] of each field's own points below its skin, those of all fields side by side.

    One program for all fields: what is compiled is the same for a trunk on four joints as for a thigh on one.
    """
    moves = _moves_home(kin, fields)
    meeting = _Meeting.of(fields, tuple(p.shape[-1] for p in points_world))
    return _depth(meeting, tuple(moves[:, k] for k in range(len(fields))), tuple(points_world))


def depths_met(
    kin: Kinematics, fields: Sequence[DepthField], frame: Int[Array, " meetings"], met: Int[Array, " meetings"],
    points_world: Float[Array, "meetings 3 points"],
) -> Float[Array, "meetings points"]:  # fmt: skip
    """Depth [m] of points, each row of them in a frame and below the skin of a field of its own."""
    return _depth(_Meeting.of(fields, (1,) * len(fields)).of_each(met), (_moves_home(kin, fields)[frame, met],),
                  (points_world,))  # fmt: skip


def _moves_home(kin: Kinematics, fields: Sequence[DepthField]) -> Float[Array, "frames fields joints 3 4"]:
    """What takes world points to each field's tabulated pose, with each of its joints."""
    longest = max(len(field.joints) for field in fields) - 2

    def filled(x):  # a shorter chain repeats its last joint, which changes nothing
        x = jnp.asarray(x)
        return jnp.concatenate([x[:-2], *[x[-3:-2]] * (longest + 2 - len(x)), x[-2:]])

    joints, home_rotations, home_positions = (
        jnp.stack([filled(getattr(field, name)) for field in fields])
        for name in ("joints", "home_rotations", "home_positions")
    )
    turns = home_rotations @ jnp.swapaxes(rotation.to_matrix(kin.rotations_world[:, joints]), -1, -2)
    places = kin.positions_world[:, joints]
    shifts = home_positions - rotation.matrix_times(turns, places)
    return jnp.concatenate([turns, shifts[..., None]], axis=-1)


class _Meeting(eqx.Module):
    """Points and the fields that they meet: for each point the numbers of its own field, the same in all frames or
    others in each. `tables` are the depth and the two pulls, the grids of all fields one after the other."""

    tables: Float[Array, "3 nodes"]
    start: Int[Array, "*frames points"]
    size: Int[Array, "*frames 3 points"]
    origin: Float[Array, "*frames 3 points"]
    spacing: Float[Array, "*frames 3 points"]
    axis: Float[Array, "*frames 3 points"]
    takeover: Float[Array, "*frames joins 2 points"]

    @classmethod
    def of(cls, fields: Sequence[DepthField], counts: Sequence[int]) -> "_Meeting":
        def spread(values):
            wide = [
                jnp.broadcast_to(jnp.asarray(v)[..., None], (*jnp.shape(v), n))
                for v, n in zip(values, counts, strict=True)
            ]
            return jnp.concatenate(wide, axis=-1)

        joins = max(len(f.takeover) for f in fields)
        idle = np.array([[0.0, 1.0]])
        takeover = [jnp.concatenate([jnp.asarray(f.takeover), *[idle] * (joins - len(f.takeover))]) for f in fields]
        sizes = [f.coefficients.shape for f in fields]
        starts = np.cumsum([0, *(math.prod(s) for s in sizes)])[:-1].astype(np.int32)
        tables = [
            jnp.concatenate([jnp.asarray(f.coefficients)[None], jnp.asarray(f.pulls)]).reshape(3, -1) for f in fields
        ]
        return cls(jnp.concatenate(tables, axis=1), spread(starts), spread([np.array(s, np.int32) for s in sizes]),
                   spread([f.origin for f in fields]), spread([f.spacing for f in fields]),
                   spread([f.axis_home for f in fields]), spread(takeover))  # fmt: skip

    def of_each(self, which: Int[Array, " frames"]) -> "_Meeting":
        """All points of a frame meet one of the fields, of which there is one point each here."""
        numbers = self.start, self.size, self.origin, self.spacing, self.axis, self.takeover
        return _Meeting(self.tables, *(jnp.moveaxis(x, -1, 0)[which, ..., None] for x in numbers))

    def cells(self, points_home: Float[Array, "*frames 3 points"]) -> tuple[Array, Array]:
        """Grid coordinates clipped to the grid, and the distance [m] to it, which counts as a gap."""
        cells = (points_home - self.origin) / self.spacing
        inside = jnp.clip(cells, 0.5, self.size.astype(cells.dtype) - 1.5001)  # half a cell is the spline's reach
        return inside, _over_coordinates(jnp.abs(cells - inside) * self.spacing)

    def depth_home(self, points_home: Float[Array, "*frames 3 points"]) -> Float[Array, "*frames points"]:
        inside, gap = self.cells(points_home)
        return _lookup(self.tables[:1], self.start, self.size, inside)[0] - gap

    def home(
        self, chain: Float[Array, "frames chained 3 points"], first: Float[Array, "frames 3 points"],
        second: Float[Array, "frames 3 points"],
    ) -> Float[Array, "frames 3 points"]:  # fmt: skip
        """Points in the tabulated pose, from where the chain's joints and the two that pull alone would take them."""
        home = chain[:, 0]
        if self.takeover.shape[-3]:
            height = _over_coordinates(self.axis * jnp.mean(chain, axis=1))
            low, high = self.takeover[..., 0, :], self.takeover[..., 1, :]
            taken = _smoothstep((height[:, None] - low) / (high - low))
            ones = jnp.ones_like(taken[:, :1])
            shares = jnp.concatenate([ones, taken], axis=1) - jnp.concatenate([taken, 0 * ones], axis=1)
            home = jnp.sum(shares[:, :, None] * chain, axis=1)
        inside, _ = self.cells(home)
        one, other = (pull[..., None, :] for pull in _lookup(self.tables[1:], self.start, self.size, inside))
        return home + one * (first - home) + other * (second - home)


def _moved(moves, points):
    """Where the chain's joints (frames, chained, 3, all points) and the two that pull take each field's points."""
    frames, joints = moves[0].shape[:2]
    # one product per frame and field for all joints: (3 joints, 3) @ (3, points)
    moved = [m[..., :3].reshape(frames, -1, 3) @ p for m, p in zip(moves, points, strict=True)]
    shifts = [m[..., 3].reshape(frames, -1, 1) for m in moves]
    moved = jnp.concatenate([a + b for a, b in zip(moved, shifts, strict=True)], axis=-1)
    moved = moved.reshape(frames, joints, 3, -1)
    return moved[:, :-2], moved[:, -2], moved[:, -1]


def _depth_of(meeting: _Meeting, moves, points):
    return meeting.depth_home(meeting.home(*_moved(moves, points)))


_depth = eqx.filter_custom_jvp(_depth_of)


@_depth.def_jvp
def _depth_jvp(primals, tangents):
    """A point's depth depends on its own coordinates alone, so its gradient in where each joint takes it is one
    backward pass. Every tangent is then a sum of products: with the point's own way, and with the joints' ways."""
    meeting, moves, points = primals
    t_meeting, t_moves, t_points = tangents
    value, back = jax.vjp(lambda *moved: meeting.depth_home(meeting.home(*moved)), *_moved(moves, points))
    chain, first, second = back(jnp.ones_like(value))
    slopes = jnp.concatenate([chain, first[:, None], second[:, None]], axis=1)
    frames, joints = moves[0].shape[:2]
    ends = np.cumsum([p.shape[-1] for p in points])[:-1]
    ways = []
    for m, p, slope, t_m, t_p in zip(moves, points, jnp.split(slopes, ends, axis=-1), t_moves, t_points, strict=True):
        way = jnp.zeros((frames, p.shape[-1]), value.dtype)
        if t_p is not None:
            own = jnp.swapaxes(m[..., :3].reshape(frames, -1, 3), 1, 2) @ slope.reshape(frames, 3 * joints, -1)
            way = way + _over_coordinates(_once(own) * t_p)
        if t_m is not None:
            arms = jnp.concatenate([p, jnp.ones_like(p[:, :1])], axis=1)
            levers = _once((slope[:, :, :, None] * arms[:, None, None]).reshape(frames, 12 * joints, -1))
            way = way + jnp.einsum("tk,tkn->tn", t_m.reshape(frames, -1), levers)
        ways.append(way)
    tangent = jnp.concatenate(ways, axis=-1)
    if any(leaf is not None for leaf in jax.tree.leaves(t_meeting)):
        tangent = (
            tangent + eqx.filter_jvp(lambda meeting: _depth_of(meeting, moves, points), (meeting,), (t_meeting,))[1]
        )
    return value, tangent


_once = jax.lax.optimization_barrier  # keeps XLA from computing what all tangents share anew for each of them


def _over_coordinates(x):
    """The sum over the three coordinates, the last axis but one."""
    return x[..., 0, :] + x[..., 1, :] + x[..., 2, :]


def _smoothstep(x):
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


_COLUMNS = np.array([(a, b) for a in range(3) for b in range(3)], np.int32)


def _neighbours(size, start, cells):
    """Offsets of grid coordinates from their nearest node, and the index of the first of the 27 neighbours."""
    nodes = jnp.round(cells)
    i, j, k = (nodes[..., a, :].astype(jnp.int32) - 1 for a in range(3))
    return cells - nodes, start + (i * size[..., 1, :] + j) * size[..., 2, :] + k


def _weights(offsets) -> Array:
    return jnp.stack([0.5 * (0.5 - offsets) ** 2, 0.75 - offsets * offsets, 0.5 * (0.5 + offsets) ** 2])


def _slopes(offsets) -> Array:
    return jnp.stack([offsets - 0.5, -2.0 * offsets, offsets + 0.5])


def _along(tables, size, base, at):
    """The three neighbours along z in column (a, b): (3, tables, points...)."""
    place = base + (at[0] * size[..., 1, :] + at[1]) * size[..., 2, :]
    return [tables.at[:, place + c].get(mode="promise_in_bounds") for c in range(3)]


def _dot(weights, values):
    return sum(weights[c] * values[c] for c in range(3))


@eqx.filter_custom_jvp
def _lookup(tables, start, size, cells):
    """Triquadratic B-splines, (tables, frames..., points), at grid coordinates: 27 neighbours, scanned column by column
    so that the program stays small."""
    offsets, base = _neighbours(size, start, cells)
    weights = jnp.moveaxis(_weights(offsets), -2, 0)  # (coordinate, neighbour, frames..., points)

    def column(total, at):
        along = _along(tables, size, base, at)
        return total + weights[0][at[0]] * weights[1][at[1]] * _dot(weights[2], along), None

    return jax.lax.scan(column, jnp.zeros((len(tables), *base.shape), cells.dtype), _COLUMNS)[0]


@_lookup.def_jvp
def _lookup_jvp(primals, tangents):
    """The gradient in closed form, once: every further tangent is then three products per point."""
    tables, start, size, cells = primals
    t_tables, _, _, t_cells = tangents
    # neither the offsets nor the gradient may be computed anew for each of the tangents
    offsets, base = _once(_neighbours(size, start, cells))
    (wx, wy, wz), (sx, sy, sz) = (jnp.moveaxis(f(offsets), -2, 0) for f in (_weights, _slopes))

    def column(totals, at):
        along, (a, b) = _along(tables, size, base, at), at
        level = _dot(wz, along)
        parts = wx[a] * wy[b] * level, sx[a] * wy[b] * level, wx[a] * sy[b] * level, wx[a] * wy[b] * _dot(sz, along)
        return tuple(t + p for t, p in zip(totals, parts, strict=True)), None

    zero = jnp.zeros((len(tables), *base.shape), cells.dtype)
    value, *gradient = _once(jax.lax.scan(column, (zero,) * 4, _COLUMNS)[0])
    tangent = jnp.zeros_like(value)
    if t_cells is not None:
        tangent = sum(slope * t_cells[..., a, :] for a, slope in enumerate(gradient))
    if t_tables is not None:
        tangent = tangent + _lookup(t_tables, start, size, cells)
    return value, tangent


# --- making them ------------------------------------------------------------------------------------------------


def standing(skeleton: Skeleton, out: float = 0.035) -> Motion:
    """One frame of standing with the arms hanging straight, `out` [rad] from the vertical to their side, all else at
    bind."""
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
        down = np.array([sign * np.sin(out), -np.cos(out), 0.0])
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
