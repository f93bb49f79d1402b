"""Terms that keep body parts out of each other: by joints, by capsules, and by skin points against depth fields.

All three count *excess* only: what goes beyond `allowed`, the overlap that the same pair shows on the reference
body in the same frame (method: adjacent segments always overlap a little at the joint).
"""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from motionfit import rotation
from motionfit._motion import Kinematics
from motionfit._problem import Term, pseudo_huber
from motionfit._types import AnyArray
from motionfit.shape.distance import capsule_depth, cylinder_depth
from motionfit.shape.field import DepthField, depths, depths_met
from motionfit.shape.probes import Probes, ProbeSets
from motionfit.shape.volumes import Volumes


def _array(x):
    return jnp.asarray(x, dtype=float) if isinstance(x, float | int) else x


def hinge(depth: Float[AnyArray, "..."], width: float | Float[AnyArray, ""]) -> Float[Array, "..."]:
    """max(0, depth) with its corner rounded over `width` [m], zero *inside* included: 0 for depth <= 0,
    depth^2 / (2 width) up to the width, then depth - width / 2. Once continuously differentiable."""
    positive = jnp.maximum(depth, 0.0)
    return jnp.where(positive < width, positive * positive / (2 * width), positive - width / 2)


class JointClearance(Term):
    """Joints at a threshold distance: the d_i of thesis (4.6), (4.10) and (4.11).

    `first`, `second` are joint indices per pair, `min_distance` [m] per pair, or per frame and pair. Where `frontal`
    says so the distance is measured on the plane of the vertical and the line between the `thighs`, which is the
    matrix M of (4.11): the actual separation of the legs. `sigma` [m].
    """

    first: tuple[int, ...] = eqx.field(static=True)
    second: tuple[int, ...] = eqx.field(static=True)
    min_distance: Float[AnyArray, "*frames pairs"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)
    frontal: tuple[bool, ...] = eqx.field(static=True, default=())
    thighs: tuple[int, int] | None = eqx.field(static=True, default=None)

    def distance(self, kin: Kinematics) -> Float[Array, "frames pairs"]:
        gap = kin.positions_world[:, np.array(self.first)] - kin.positions_world[:, np.array(self.second)]
        distance = rotation.safe_norm(gap)
        if self.thighs is None:
            return distance
        left, right = (kin.positions_world[:, j] for j in self.thighs)
        across = rotation.normalize((left - right) * jnp.array([1.0, 0.0, 1.0], gap.dtype))[:, None]
        lateral = jnp.sum(gap * across, axis=-1)
        separation = rotation.safe_norm(jnp.stack([lateral, gap[..., 1]], axis=-1))
        return jnp.where(np.array(self.frontal), separation, distance)

    def residual(self, kin: Kinematics) -> Float[Array, "frames pairs"]:
        short = jnp.asarray(self.min_distance).reshape(-1, len(self.first)) - self.distance(kin)
        return hinge(short, self.width) / self.sigma


class CapsuleClearance(Term):
    """One volume per segment against another, by the exact segment distance (capsules) or the thesis's flat-ended
    cylinders. `allowed` [m] is the depth that does not count, per pair or per frame and pair; `sigma` [m]."""

    volumes: Volumes
    first: tuple[int, ...] = eqx.field(static=True)
    second: tuple[int, ...] = eqx.field(static=True)
    allowed: Float[AnyArray, "*frames pairs"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)

    def depth(self, kin: Kinematics) -> Float[Array, "frames pairs"]:
        """Penetration depth [m] of every pair in every frame; negative where there is a gap."""
        start, end = self.volumes.axes_world(kin)
        radius = jnp.mean(jnp.asarray(self.volumes.radii), axis=-1)
        a, b = np.array(self.first), np.array(self.second)
        rule = cylinder_depth if self.volumes.kind == "cylinder" else capsule_depth
        return rule(start[:, a], end[:, a], radius[a][None], start[:, b], end[:, b], radius[b][None])

    def residual(self, kin: Kinematics) -> Float[Array, "frames pairs"]:
        excess = self.depth(kin) - jnp.asarray(self.allowed).reshape(-1, len(self.first))
        return hinge(excess, self.width) / self.sigma


class SkinClearance(Term):
    """Points of parts' skin against the depth fields of other parts: a residual per frame and point.

    Each of the `probes` is tested against the field that `field_of` names. `allowed` [m] is the depth that does not
    count, per frame and set of probes, or per frame and point. `sigma` [m].
    """

    probes: tuple[Probes, ...]
    fields: tuple[DepthField, ...]
    field_of: tuple[int, ...] = eqx.field(static=True)
    allowed: tuple[Float[AnyArray, "_ _"], ...]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)

    def point_depths(self, kin: Kinematics) -> list[Float[Array, "frames points"]]:
        """Depth [m] of every point, set by set; negative outside."""
        points = [p.positions_world(kin) for p in self.probes]
        order = [i for k in range(len(self.fields)) for i, owner in enumerate(self.field_of) if owner == k]
        counts = [sum(points[i].shape[2] for i in order if self.field_of[i] == k) for k in range(len(self.fields))]
        together = jnp.concatenate([points[i] for i in order], axis=2)
        met = jnp.split(together, np.cumsum(counts)[:-1], axis=2)
        split = jnp.split(depths(kin, self.fields, met), np.cumsum([points[i].shape[2] for i in order])[:-1], axis=1)
        return [split[order.index(i)] for i in range(len(points))]

    def depth(self, kin: Kinematics) -> Float[Array, "frames sets"]:
        """Depth [m] of the deepest point of every set in every frame; negative where all are outside."""
        return jnp.stack([jnp.max(d, axis=-1) for d in self.point_depths(kin)], axis=-1)

    def residual(self, kin: Kinematics) -> Float[Array, "frames points"]:
        excess = [d - jnp.asarray(a) for d, a in zip(self.point_depths(kin), self.allowed, strict=True)]
        return hinge(jnp.concatenate(excess, axis=-1), self.width) / self.sigma


class TouchClearance(Term):
    """Vertices of one part's skin against the places on another's that they are nearest to.

    These are the contacts of rigid-body dynamics, found on the posed skin and linearised: the depth of a touch is the
    way from the vertex to its place, along the surface's normal there. `blend` holds that way as a sum over the
    joints, skin weight times bind-pose position (homogeneous, four rows per joint), so that (4.20) is one product, and
    laid out so that it is a fast one; the `normals` turn with
    the joints `carried_by`. Exact in the pose in which it was found, where a field of one pose is not, and of first
    order around it. `allowed` [m] is the depth that does not count, per frame and touch; `sigma` [m].

    `found` tells what the same touch is on another body: the frame that was looked at, the pair of parts, the vertex
    and the corners of the triangle that it is nearest to, with their `shares` in the place.
    """

    blend: Float[AnyArray, "frames four_joints touches"]
    normals: Float[AnyArray, "frames touches 3"]
    carried_by: Int[AnyArray, "frames touches"]
    allowed: Float[AnyArray, "frames touches"]
    found: Int[AnyArray, "frames touches 6"]
    shares: Float[AnyArray, "frames touches 3"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)

    def depth(self, kin: Kinematics) -> Float[Array, "frames touches"]:
        """Depth [m] of every touch; negative where there is a gap."""
        ways, normals = _ways(kin, self.blend, self.normals, self.carried_by)
        return jnp.sum(normals * ways, axis=-1)

    def residual(self, kin: Kinematics) -> Float[Array, "frames touches"]:
        return hinge(self.depth(kin) - jnp.asarray(self.allowed), self.width) / self.sigma


class TouchHold(Term):
    """Touches that are meant, such as a hand on the hip, and shall not come loose.

    As in `TouchClearance`, a vertex and the place on another part's skin that it is nearest to. There the skin curves
    away from its plane, as a sphere of the `radius` [m]: without that a vertex could slide off along it. `gap` [m] is
    how far it may be, as far as the `weight` (0..1) says that there is a touch. Beyond `c` times `sigma` [m] a lost touch
    pulls no harder: pseudo-Huber.
    """

    blend: Float[AnyArray, "frames four_joints touches"]
    normals: Float[AnyArray, "frames touches 3"]
    carried_by: Int[AnyArray, "frames touches"]
    gap: Float[AnyArray, "frames touches"]
    weight: Float[AnyArray, "frames touches"]
    radius: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.05)
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)
    c: Float[AnyArray, ""] = eqx.field(converter=_array, default=2.0)

    def distance(self, kin: Kinematics) -> Float[Array, "frames touches"]:
        """How far [m] every vertex is from the other skin; negative where it is inside."""
        ways, normals = _ways(kin, self.blend, self.normals, self.carried_by)
        depth = jnp.sum(normals * ways, axis=-1)
        aside = ways - depth[..., None] * normals
        return jnp.sum(aside * aside, axis=-1) / (2.0 * self.radius) - depth

    def residual(self, kin: Kinematics) -> Float[Array, "frames touches"]:
        apart = hinge(self.distance(kin) - jnp.asarray(self.gap), self.width) / self.sigma
        return pseudo_huber(jnp.asarray(self.weight) * apart, jnp.asarray(self.c))


def _ways(
    kin: Kinematics, blend: Float[AnyArray, "frames four_joints touches"], normals: Float[AnyArray, "frames touches 3"],
    carried_by: Int[AnyArray, "frames touches"],
) -> tuple[Float[Array, "frames touches 3"], Float[Array, "frames touches 3"]]:  # fmt: skip
    """The ways of touches from vertex to place [m], and their normals, in the world."""
    turns, shifts = kin.skin_transforms()
    rows = jnp.moveaxis(jnp.concatenate([turns, shifts[..., None]], axis=-1), 2, 1).reshape(len(turns), 3, -1)
    ways = jnp.swapaxes(rows @ jnp.asarray(blend, rows.dtype), 1, 2)
    carried = jnp.take_along_axis(turns, jnp.asarray(carried_by)[..., None, None], axis=1)
    return ways, rotation.matrix_times(carried, jnp.asarray(normals, rows.dtype))


class SkinContact(Term):
    """Points of parts' skin against the fields that they come near, which are others in each frame: not too deep in
    and, where they touch on purpose, not too far away.

    Each set of probes is tested against one of the `fields`, that of its number in `field_of`. A meeting is a set and a
    frame; there is nothing to compute where parts are far from each other. `meeting_of` says which meetings are the rows
    of a frame, and has numbers past the last one where there are fewer. Per meeting, `allowed` [m] is the depth that
    does not count, and `gap` [m] is how far the deepest point may be from the other part's skin, as far as the `weight`
    (0..1) says that there is a touch to keep, such as a hand on the hip. Beyond `c` times `sigma` [m] a lost touch pulls
    no harder: pseudo-Huber.
    """

    probes: ProbeSets
    fields: tuple[DepthField, ...]
    field_of: Int[AnyArray, " sets"]
    frame: Int[AnyArray, " meetings"]
    met: Int[AnyArray, " meetings"]
    meeting_of: Int[AnyArray, "frames some"]
    allowed: Float[AnyArray, " meetings"]
    gap: Float[AnyArray, " meetings"]
    weight: Float[AnyArray, " meetings"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)
    width: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.002)
    c: Float[AnyArray, ""] = eqx.field(converter=_array, default=2.0)

    def point_depths(self, kin: Kinematics) -> Float[Array, "meetings points"]:
        """Depth [m] of every point of the sets that meet something; negative outside."""
        frame, met = jnp.asarray(self.frame), jnp.asarray(self.met)
        return depths_met(kin, self.fields, frame, jnp.asarray(self.field_of)[met],
                          self.probes.positions_world(kin, frame, met))  # fmt: skip

    def residual(self, kin: Kinematics) -> Float[Array, "frames rows"]:
        depth = self.point_depths(kin)
        deep = hinge(depth - jnp.asarray(self.allowed)[:, None], self.width) / self.sigma
        apart = hinge(-jnp.max(depth, axis=1) - jnp.asarray(self.gap), self.width) / self.sigma
        lost = pseudo_huber(jnp.asarray(self.weight) * apart, jnp.asarray(self.c))
        rows = jnp.pad(jnp.concatenate([deep, lost[:, None]], axis=1), ((0, 1), (0, 0)))
        return rows[jnp.asarray(self.meeting_of)].reshape(len(self.meeting_of), -1)
