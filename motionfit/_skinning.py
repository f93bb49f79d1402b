"""Linear blend skinning: thesis (4.20)."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from motionfit import rotation
from motionfit._motion import Kinematics
from motionfit._remembered import Remembering, remembered
from motionfit._types import AnyArray, Faces, InputError, Vertices


class Skin(eqx.Module, Remembering):
    """The mesh in its bind pose and which joints move each vertex.

    `vertices_bind` [m], triangles `faces`, and per vertex up to `influences` joints with weights that sum to one
    (unused slots have weight 0). `normals_bind` are unit, area-weighted, unless the file brought its own.
    """

    vertices_bind: Vertices
    faces: Faces
    joints: Int[AnyArray, "vertices influences"]
    weights: Float[AnyArray, "vertices influences"]

    def __check_init__(self):
        if not isinstance(self.weights, np.ndarray):  # traced, or already checked
            return
        count = len(self.vertices_bind)
        if count == 0 or len(self.faces) == 0:
            raise InputError(f"a skin needs vertices and triangles; got {count} and {len(self.faces)}")
        if len(self.joints) != count or self.joints.shape != self.weights.shape:
            raise InputError(f"{count} vertices but skin joints {self.joints.shape} and weights {self.weights.shape}")
        for name, array in (("position", self.vertices_bind), ("weight", self.weights)):
            if not np.isfinite(array).all():
                raise InputError(
                    f"vertex {int(np.argwhere(~np.isfinite(array))[0][0])} has a {name} that is not finite"
                )
        sums = self.weights.sum(-1)
        if (sums <= 0).any():
            raise InputError(f"vertex {int(np.argmin(sums))} has no skin weight ({int((sums <= 0).sum())} in all); "
                             "give each vertex a joint")  # fmt: skip
        if (self.weights < 0).any():
            raise InputError(f"vertex {int(np.argwhere(self.weights < 0)[0][0])} has a negative skin weight")
        if np.abs(sums - 1).max() > 1e-3:
            raise InputError(f"skin weights must sum to 1; vertex {int(np.abs(sums - 1).argmax())} "
                             f"sums to {sums[np.abs(sums - 1).argmax()]:.4g}")  # fmt: skip
        if self.faces.min() < 0 or self.faces.max() >= count:
            raise InputError(f"a triangle names vertex {int(self.faces.max())}, but there are {count}")

    @property
    def normals_bind(self) -> Vertices:
        return vertex_normals(self.vertices_bind, self.faces)

    @remembered
    def main_joint(self) -> Int[np.ndarray, " vertices"]:
        """The joint of greatest weight of each vertex: thesis (4.2)."""
        joints, weights = np.asarray(self.joints), np.asarray(self.weights)
        return np.take_along_axis(joints, weights.argmax(-1)[:, None], axis=1)[:, 0]


def vertex_normals(vertices: Vertices, faces: Faces) -> Float[Array, "vertices 3"]:
    """Unit vertex normals, the mean of the triangles around weighted by their area."""
    corners = jnp.asarray(vertices)[jnp.asarray(faces)]
    face_normals = jnp.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    sums = jnp.zeros_like(jnp.asarray(vertices))
    for i in range(3):
        sums = sums.at[jnp.asarray(faces)[:, i]].add(face_normals)
    return rotation.normalize(sums)


def skin_points(
    kin: Kinematics,
    points_bind: Float[AnyArray, "points 3"],
    joints: Int[AnyArray, "points influences"],
    weights: Float[AnyArray, "points influences"],
) -> Float[Array, "frames points 3"]:
    """World positions [m] of points given in the bind pose, moved by (4.20): sum_j w_j M_j B_j^-1 v.

    The sum runs over the few influences of each point only.
    """
    joints, weights, points = jnp.asarray(joints), jnp.asarray(weights), jnp.asarray(points_bind)
    turns, shifts = kin.skin_transforms()
    dtype = turns.dtype
    weights, points = weights.astype(dtype), points.astype(dtype)
    total = jnp.zeros((kin.positions_world.shape[0], *points.shape), dtype)
    for k in range(joints.shape[1]):
        moved = jnp.einsum("tpab,pb->tpa", turns[:, joints[:, k]], points)
        total = total + weights[:, k][:, None] * (moved + shifts[:, joints[:, k]])
    return total


def skin(mesh: Skin, kin: Kinematics) -> tuple[Float[Array, "frames vertices 3"], Float[Array, "frames vertices 3"]]:
    """World vertices [m] and unit normals of the whole skin in every frame: (4.20)."""
    vertices = skin_points(kin, mesh.vertices_bind, mesh.joints, mesh.weights)
    joints, weights, normals_bind = jnp.asarray(mesh.joints), jnp.asarray(mesh.weights), mesh.normals_bind
    normals, turns = jnp.zeros_like(vertices), kin.skin_transforms()[0]
    for k in range(joints.shape[1]):
        turned = jnp.einsum("tpab,pb->tpa", turns[:, joints[:, k]], normals_bind.astype(vertices.dtype))
        normals = normals + weights[:, k][:, None].astype(vertices.dtype) * turned
    return vertices, rotation.normalize(normals)
