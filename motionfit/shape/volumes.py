"""Body volumes fitted to the skin: cylinders, capsules, ellipsoids, and generalised cylinders.

Thesis 4.2.1, 4.2.2 and 5.6, with errata: the covariance is normalised (vertices weighted by the area around them),
and the radius is the length that a surface sample of the volume would show, not an eigenvalue.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.interpolate import BSpline
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import PARTS, Character
from motionfit._motion import Kinematics, bind_pose
from motionfit._skeleton import Skeleton
from motionfit._types import AnyArray, InputError

# --- bones and the vertices that belong to them ----------------------------------------------------------------


def bone_tips(skeleton: Skeleton) -> Float[np.ndarray, "joints 3"]:
    """Bind position [m] of the far end of each joint's bone.

    The next joint of the limb where there is one, else the mean of the children, else the end site, else the
    joint itself.
    """
    positions, rotations = bind_pose(skeleton)
    limb = {"upper_arm": "forearm", "forearm": "hand", "thigh": "calf", "calf": "foot", "foot": "toe",
            "clavicle": "upper_arm"}  # fmt: skip
    spine, neck = skeleton.chain("spine"), skeleton.chain("neck")
    up = [j for j in (skeleton.find("hips"), *spine, *neck, skeleton.find("head")) if j is not None]
    following = dict(zip(up, up[1:], strict=False))
    for role, joint in skeleton.roles:
        side, _, kind = role.partition("_")
        if kind in limb and (child := skeleton.find(f"{side}_{limb[kind]}")) is not None:
            following[joint] = child
    tips = positions.copy()
    for joint in range(len(positions)):
        children = skeleton.children(joint)
        ends = [k for k, p in enumerate(skeleton.end_parents) if p == joint]
        if joint in following:
            tips[joint] = positions[following[joint]]
        elif children:
            tips[joint] = positions[list(children)].mean(0)
        elif ends:
            offset = np.asarray(skeleton.end_offsets, float)[ends].mean(0)
            tips[joint] += Rotation.from_quat(rotations[joint], scalar_first=True).apply(offset)
    return tips


def vertex_areas(character: Character) -> Float[np.ndarray, " vertices"]:
    """A third of the area [m^2] of the triangles around each vertex, so that dense hands do not count more."""
    vertices, faces = np.asarray(character.skin.vertices_bind, float), np.asarray(character.skin.faces)
    corners = vertices[faces]
    double = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=-1)
    return np.bincount(faces.ravel(), np.repeat(double / 6.0, 3), minlength=len(vertices))


def allocate_vertices(character: Character) -> Int[np.ndarray, " vertices"]:
    """The joint whose bone each vertex contributes to: thesis 4.2.2.

    The joint of greatest skin weight, (4.2), unless the vertex projects orthogonally inside one of that bone's
    two neighbours and not inside the bone itself: then the neighbour.
    """
    skeleton = character.skeleton
    positions = bind_pose(skeleton)[0]
    tips = bone_tips(skeleton)
    vertices = np.asarray(character.skin.vertices_bind, float)
    master = character.skin.main_joint

    def projects_inside(joint: np.ndarray) -> np.ndarray:
        bone = tips[joint] - positions[joint]
        squared = np.maximum((bone**2).sum(-1), 1e-12)
        s = ((vertices - positions[joint]) * bone).sum(-1) / squared
        return (s >= 0) & (s <= 1) & (squared > 1e-6)

    parents = np.array(skeleton.parents)
    following = np.full(len(parents), -1)
    for joint in range(len(parents)):
        for child in skeleton.children(joint):
            if np.allclose(positions[child], tips[joint], atol=1e-6):
                following[joint] = child
    result, own = master.copy(), projects_inside(master)
    for neighbours in (following, parents):
        neighbour = neighbours[master]
        take = ~own & (neighbour >= 0) & (result == master)
        take &= projects_inside(np.maximum(neighbour, 0))
        result = np.where(take, neighbour, result)
    return result


# --- one volume per segment ------------------------------------------------------------------------------------


class Volumes(eqx.Module):
    """One volume per segment, in its joint's frame.

    `start` and `end` [m] are the axis, `radii` [m] the two half widths across it (equal for round sections); an
    ellipsoid has its half length in `half_length`.
    """

    kind: str = eqx.field(static=True)
    roles: tuple[str, ...] = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    start: Float[AnyArray, "segments 3"]
    end: Float[AnyArray, "segments 3"]
    radii: Float[AnyArray, "segments 2"]
    half_length: Float[AnyArray, " segments"]

    def index(self, role: str) -> int:
        if role not in self.roles:
            raise InputError(f"no {self.kind} for {role!r}; there are {', '.join(self.roles)}")
        return self.roles.index(role)

    def axes_world(
        self, kin: Kinematics
    ) -> tuple[Float[Array, "frames segments 3"], Float[Array, "frames segments 3"]]:
        """World start and end of every axis [m]."""
        joints = np.array(self.joints)
        turn, origin = kin.rotations_world[:, joints], kin.positions_world[:, joints]
        start = rotation.rotate(turn, jnp.asarray(self.start)[None])
        return origin + start, origin + rotation.rotate(turn, jnp.asarray(self.end)[None])


def fit_volumes(character: Character, kind: str = "capsule") -> Volumes:
    """Cylinders, capsules or ellipsoids of the segments that have a role and skin.

    The axis is the eigenvector of the area-weighted covariance that is nearest to the bone. Points on the side of
    a cylinder of radius r have variance r^2/2 in each direction across it, so r^2 = lambda_2 + lambda_3, and the
    two half widths of an elliptic one are sqrt(2 lambda). A surface sample of an ellipsoid has variance close to
    a_i^2 / 3 per axis (exact for the sphere): thesis 5.6.
    """
    if kind not in ("cylinder", "capsule", "ellipsoid"):
        raise InputError(f"unknown volume {kind!r}; there are cylinder, capsule, ellipsoid")
    skeleton = character.skeleton
    owner, areas = allocate_vertices(character), vertex_areas(character)
    vertices = np.asarray(character.skin.vertices_bind, float)
    positions, rotations = bind_pose(skeleton)
    tips = bone_tips(skeleton)
    of_role = {
        role: [j for j in range(len(positions)) if skeleton.nearest_role(j) == role] for role, _ in skeleton.roles
    }
    rows = []
    for role, joint in skeleton.roles:
        mine = np.isin(owner, of_role[role])
        if mine.sum() < 8:
            continue
        points, weights = vertices[mine], areas[mine] / areas[mine].sum()
        centre = weights @ points
        values, vectors = np.linalg.eigh(((points - centre) * weights[:, None]).T @ (points - centre))
        bone = tips[joint] - positions[joint]
        along = int(np.argmax(np.abs(vectors.T @ bone))) if np.linalg.norm(bone) > 1e-6 else 2
        across = [i for i in range(3) if i != along]
        axis = vectors[:, along] * (1 if vectors[:, along] @ bone >= 0 else -1)
        reach = (points - centre) @ axis
        low, high = reach.min(), reach.max()
        if kind == "ellipsoid":
            widths, half = np.sqrt(3 * values[across]), np.sqrt(3 * values[along])
            low, high = -half, half
        else:
            widths, half = np.full(2, np.sqrt(values[across].sum())), (high - low) / 2
            if kind == "capsule":  # the half spheres must not stick out of the limb
                inset = min(widths[0], half)
                low, high = low + inset, high - inset
        to_joint = Rotation.from_quat(rotations[joint], scalar_first=True).inv()
        local = [to_joint.apply(centre + s * axis - positions[joint]) for s in (low, high)]
        rows.append((role, joint, *local, widths, half))
    roles, joints, start, end, radii, half = zip(*rows, strict=True)
    return Volumes(kind, roles, joints, np.array(start), np.array(end), np.array(radii), np.array(half))


# --- generalised cylinders --------------------------------------------------------------------------------------

HARMONICS = 6
BLEND_KNOTS = 8


class Section(eqx.Module):
    """A generalised cylinder: a radius that varies smoothly with the height along a limb and the angle around it.

    It lives in the bind pose. A world point is first taken there, through the joints of `joints` blended by
    `joint_weights` as a function of height, so that a bent trunk is followed. Then its radius about the centre
    line is compared with r(height, angle) = sum_k a_k(height) cos(k angle) + b_k(height) sin(k angle), the
    coefficients being cubic B-splines of the height. Where the surface is inclined against the radial direction
    the distance is shorter than the difference of the radii: `scales` holds that factor in the same form.
    """

    part: str = eqx.field(static=True)
    joints: tuple[int, ...] = eqx.field(static=True)
    origin_bind: Float[AnyArray, "3"]
    frame_bind: Float[AnyArray, "3 3"]  # rows: two directions across, the axis
    height_range: Float[AnyArray, "2"]
    joint_weights: Float[AnyArray, "blend_knots blended"]
    centres: Float[AnyArray, "knots 2"]
    radii: Float[AnyArray, "knots harmonics"]
    scales: Float[AnyArray, "knots harmonics"]

    def depth_bind(self, points: Float[Array, "... 3"]) -> Float[Array, "..."]:
        """Depth [m] of bind-pose points below the surface (negative outside, roughly the distance)."""
        return _section_depth(self._local(points), self.height_range, self.centres, self.radii, self.scales)

    def to_bind(self, kin: Kinematics, points_world: Float[Array, "frames points 3"]) -> Array:
        """World points taken into the bind pose of this part: (frames, points, 3)."""
        chain = np.array(self.joints)
        gap = points_world[:, :, None] - kin.skin_translations[:, None, chain]
        moved = jnp.einsum("tjba,tpjb->tpja", kin.skin_rotations[:, chain], gap)
        if len(chain) == 1:
            return moved[:, :, 0]
        point = jnp.mean(moved, axis=-2)
        for _ in range(2):  # the weights depend on the height that they help to find: two rounds settle it
            h = self._local(point)[..., 2]
            weights = _height_basis(h, self.height_range, self.joint_weights.shape[0]) @ self.joint_weights
            point = jnp.sum(weights[..., None] * moved, axis=-2)
        return point

    def depth(self, kin: Kinematics, points_world: Float[Array, "frames points 3"]) -> Float[Array, "frames points"]:
        """Depth [m] of world points below the surface; negative outside."""
        return self.depth_bind(self.to_bind(kin, points_world))

    def _local(self, points):
        return (points - jnp.asarray(self.origin_bind)) @ jnp.asarray(self.frame_bind).T


@jax.jit
def _section_depth(local, height_range, centres, radii, scales):
    """Depth [m] of points given in a section's frame. Jitted by itself, so that sections share one trace."""
    x, y, h = local[..., 0], local[..., 1], local[..., 2]
    harmonics = radii.shape[1]
    fields = _height_basis(h, height_range, radii.shape[0]) @ jnp.concatenate([radii, scales, centres], axis=1)
    x, y = x - fields[..., -2], y - fields[..., -1]
    rho = rotation.safe_norm(jnp.stack([x, y], axis=-1))
    safe = jnp.where(rho > 1e-6, rho, 1.0)
    waves = _fourier(jnp.where(rho > 1e-6, x / safe, 1.0), jnp.where(rho > 1e-6, y / safe, 0.0))
    radius = jnp.sum(fields[..., :harmonics] * waves, axis=-1)
    scale = jnp.sum(fields[..., harmonics : 2 * harmonics] * waves, axis=-1)
    depth = (radius - rho) * scale
    # the ends are open: they go on in the next segment. Fade out over 3 cm instead of ending in a wall
    fade = _smoothstep((h - height_range[0]) / 0.03) * _smoothstep((height_range[1] - h) / 0.03)
    return jnp.where(depth > 0, depth * fade, depth)


def _smoothstep(x):
    x = jnp.clip(x, 0.0, 1.0)
    return x * x * (3.0 - 2.0 * x)


def _fourier(cosine, sine):
    """1, cos a, sin a, cos 2a, sin 2a, ... by the addition theorem."""
    waves = [jnp.ones_like(cosine)]
    c, s = cosine, sine
    for _ in range(HARMONICS):
        waves += [c, s]
        c, s = c * cosine - s * sine, s * cosine + c * sine
    return jnp.stack(waves, axis=-1)


def _height_basis(h, height_range, count: int):
    """Uniform cubic B-splines: the values of `count` coefficients at heights h [m], clamped to the range.

    Written out densely, as a bump at each coefficient: it becomes a matrix product, where a gather of four
    neighbours would be slow to differentiate.
    """
    u = jnp.clip((h - height_range[0]) / (height_range[1] - height_range[0]), 0.0, 1.0) * (count - 3)
    a = jnp.abs(u[..., None] - (jnp.arange(count, dtype=u.dtype) - 1.0))
    far = jnp.maximum(2.0 - a, 0.0)
    near = jnp.maximum(1.0 - a, 0.0)
    # the cubic B-spline as a difference of truncated powers
    return (far * far * far - 4.0 * near * near * near) / 6.0


def fit_section(character: Character, part: str) -> Section:
    """The generalised cylinder of a body part, by linear least squares over its vertices.

    Vertices are weighted by area; a small penalty on the bend in height and on high harmonics closes the holes
    where other limbs are attached.
    """
    skeleton = character.skeleton
    if part not in PARTS:
        raise InputError(f"unknown part {part!r}; parts: {', '.join(PARTS)}")
    vertices = np.asarray(character.skin.vertices_bind, float)
    mine = character.part_of_vertex == PARTS.index(part)
    if mine.sum() < 50:
        raise InputError(f"{character.name}: part {part!r} has {int(mine.sum())} vertices, too few to fit a volume; "
                         "check the skin weights and the role mapping")  # fmt: skip
    points, areas = vertices[mine], vertex_areas(character)[mine]
    positions, tips = bind_pose(skeleton)[0], bone_tips(skeleton)
    if part == "torso":
        chain = (skeleton.joint("hips"), *skeleton.chain("spine"))
        axis = positions[chain[-1]] - positions[chain[0]]
        origin = positions[chain[0]]
    else:
        chain = (skeleton.joint(part),)
        origin, axis = positions[chain[0]], tips[chain[0]] - positions[chain[0]]
    axis = axis / np.linalg.norm(axis)
    forward = np.array([0.0, 0.0, 1.0]) if abs(axis[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    first = np.cross(axis, forward)
    first /= np.linalg.norm(first)
    frame = np.stack([first, np.cross(axis, first), axis])
    local = (points - origin) @ frame.T
    low, high = local[:, 2].min(), local[:, 2].max()
    # the same for every body: corrections of different bodies then share one compiled program
    count = (18 if part == "torso" else 11) + 3
    basis = _design(local[:, 2], low, high, count)
    bend = np.diff(np.eye(count), 2, axis=0)

    def solve(design, values, penalty):
        weighted = design * areas[:, None] / areas.sum()
        return np.linalg.solve(weighted.T @ design + penalty, weighted.T @ values)

    smooth = 1e-3 * bend.T @ bend + 1e-9 * np.eye(count)
    centres = solve(basis, local[:, :2], smooth)
    around = local[:, :2] - basis @ centres
    rho = np.linalg.norm(around, axis=1)
    angle = np.arctan2(around[:, 1], around[:, 0])
    waves = [np.ones_like(angle)]
    for k in range(1, HARMONICS + 1):
        waves += [np.cos(k * angle), np.sin(k * angle)]
    order = np.array([0] + [k for k in range(1, HARMONICS + 1) for _ in range(2)])
    design = (basis[:, :, None] * np.stack(waves, axis=1)[:, None, :]).reshape(len(points), -1)
    penalty = np.kron(1e-4 * bend.T @ bend, np.eye(len(order))) + np.kron(
        np.eye(count), np.diag(1e-6 * order**4 + 1e-9)
    )
    radii = solve(design, rho, penalty).reshape(count, len(order))
    scales = _inclination(radii, low, high)

    joints, weights = np.asarray(character.skin.joints)[mine], np.asarray(character.skin.weights, float)[mine]
    shares = np.stack([np.where(joints == j, weights, 0.0).sum(-1) for j in chain], axis=1)
    if len(chain) > 1:
        # skin of clavicles and hip helpers moves with the spine joint that carries them
        for j in range(len(skeleton.names)):
            owner = j
            while owner not in chain and skeleton.parents[owner] >= 0:
                owner = skeleton.parents[owner]
            if owner != j and owner in chain and _is_trunk(skeleton, j):
                shares[:, chain.index(owner)] += np.where(joints == j, weights, 0.0).sum(-1)
    coarse = _design(local[:, 2], low, high, BLEND_KNOTS)
    bend = np.diff(np.eye(BLEND_KNOTS), 2, axis=0)
    blend = np.clip(solve(coarse, shares, 1e-4 * bend.T @ bend + 1e-9 * np.eye(BLEND_KNOTS)), 1e-4, None)
    blend /= blend.sum(-1, keepdims=True)
    return Section(part, chain, origin, frame, np.array([low, high]), blend, centres, radii, scales)


def _inclination(radii: np.ndarray, low: float, high: float) -> np.ndarray:
    """1 / sqrt(1 + (dr/dangle / r)^2 + (dr/dheight)^2), the cosine of the surface's inclination, as coefficients."""
    count, waves_count = radii.shape
    heights = np.linspace(low, high, 4 * count)
    angles = np.linspace(0.0, 2 * np.pi, 48, endpoint=False)
    k = np.arange(1, HARMONICS + 1)
    pairs = np.stack([np.cos(np.outer(angles, k)), np.sin(np.outer(angles, k))], axis=2).reshape(len(angles), -1)
    waves = np.concatenate([np.ones((len(angles), 1)), pairs], axis=1)
    basis = _design(heights, low, high, count)
    radius = basis @ radii @ waves.T
    along = np.gradient(radius, heights, axis=0)
    around = (np.roll(radius, -1, 1) - np.roll(radius, 1, 1)) / (2 * (angles[1] - angles[0])) / np.maximum(radius, 0.02)
    cosine = 1.0 / np.sqrt(1.0 + along**2 + around**2)
    rows = np.linalg.lstsq(basis, cosine, rcond=None)[0] @ waves / len(angles)
    return rows * np.r_[1.0, np.full(waves_count - 1, 2.0)]  # the discrete Fourier transform of the angles


def _is_trunk(skeleton: Skeleton, joint: int) -> bool:
    role = skeleton.nearest_role(joint) or "hips"
    return role in ("hips", "chest", "left_clavicle", "right_clavicle") or role.startswith("spine_")


def _design(h: np.ndarray, low: float, high: float, count: int) -> np.ndarray:
    step = (high - low) / (count - 3)
    knots = low + step * np.arange(-3, count + 1)
    return BSpline.design_matrix(np.clip(h, low, knots[count]), knots, 3).toarray()


# --- sampled skin points ----------------------------------------------------------------------------------------


class Probes(eqx.Module):
    """Points of a part's own skin, spread evenly, that are tested against other parts' volumes."""

    part: str = eqx.field(static=True)
    points_bind: Float[AnyArray, "points 3"]
    joints: Int[AnyArray, "points influences"]
    weights: Float[AnyArray, "points influences"]


def sample_probes(character: Character, part: str, count: int) -> Probes:
    """`count` vertices of the part by farthest-point sampling (all of them where it has fewer)."""
    skin = character.skin
    mine = np.flatnonzero(character.part_of_vertex == PARTS.index(part))
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
    rows = mine[chosen]
    return Probes(part, points[chosen], np.asarray(skin.joints)[rows], np.asarray(skin.weights, float)[rows])
