"""Body volumes fitted to the skin: cylinders, capsules, ellipsoids.

Thesis 4.2.1, 4.2.2 and 5.6, with errata: the covariance is normalised (vertices weighted by the area around them),
and the radius is the length that a surface sample of the volume would show, not an eigenvalue.
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int
from scipy.spatial.transform import Rotation

from motionfit import rotation
from motionfit._character import Character
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
        turn, origin = kin.rotations_world[:, joints], jnp.asarray(kin.positions_world)[:, joints]
        start = rotation.rotate(turn, jnp.asarray(self.start)[None])
        return origin + start, origin + rotation.rotate(turn, jnp.asarray(self.end)[None])


def fit_volumes(
    character: Character, kind: str = "capsule", owner: Int[np.ndarray, " vertices"] | None = None
) -> Volumes:
    """Cylinders, capsules or ellipsoids of the segments that have a role and skin.

    The axis is the eigenvector of the area-weighted covariance that is nearest to the bone. Points on the side of
    a cylinder of radius r have variance r^2/2 in each direction across it, so r^2 = lambda_2 + lambda_3, and the
    two half widths of an elliptic one are sqrt(2 lambda). A surface sample of an ellipsoid has variance close to
    a_i^2 / 3 per axis (exact for the sphere): thesis 5.6. `owner` says whose bone each vertex counts for (None:
    `allocate_vertices`).
    """
    if kind not in ("cylinder", "capsule", "ellipsoid"):
        raise InputError(f"unknown volume {kind!r}; there are cylinder, capsule, ellipsoid")
    skeleton = character.skeleton
    owner, areas = allocate_vertices(character) if owner is None else owner, vertex_areas(character)
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
