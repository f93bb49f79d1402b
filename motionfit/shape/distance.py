"""Distances between body volumes: thesis 4.2.3, with the errata of its (4.3)."""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from motionfit import rotation
from motionfit._types import AnyArray


def _dot(a, b):
    return jnp.sum(a * b, axis=-1)


def closest_on_lines(
    p0: Float[AnyArray, "... 3"], u: Float[AnyArray, "... 3"], q0: Float[AnyArray, "... 3"], v: Float[AnyArray, "... 3"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Parameters s, t of the closest points p0 + s u and q0 + t v of two infinite lines: (4.3).

    With w0 = p0 - q0, a = u.u, b = u.v, c = v.v, d = u.w0, e = v.w0: s = (be - cd) / (ac - b^2) and
    t = (ae - bd) / (ac - b^2); the thesis prints "ad - bd". For parallel lines s = 0 and t is its foot.
    """
    w0 = p0 - q0
    a, b, c, d, e = _dot(u, u), _dot(u, v), _dot(v, v), _dot(u, w0), _dot(v, w0)
    denominator = a * c - b * b
    parallel = denominator <= 1e-10 * a * c
    safe = jnp.where(parallel, 1.0, denominator)
    c_safe = jnp.where(c > 0, c, 1.0)
    s = jnp.where(parallel, 0.0, (b * e - c * d) / safe)
    t = jnp.where(parallel, e / c_safe, (a * e - b * d) / safe)
    return s, t


def segment_distance(
    p0: Float[AnyArray, "... 3"],
    p1: Float[AnyArray, "... 3"],
    q0: Float[AnyArray, "... 3"],
    q1: Float[AnyArray, "... 3"],
) -> tuple[Float[Array, "..."], Float[Array, "..."], Float[Array, "..."]]:
    """Distance [m] of two segments, and where on each (0..1) it is reached: exact, parallel segments included.

    The squared distance is a convex quadratic on the unit square. Its minimum is inside, where the lines are
    closest, or on one of the four edges, each of which is a point-to-segment distance: the least of the five.
    """
    u, v = p1 - p0, q1 - q0

    def foot(point, start, direction):
        length = _dot(direction, direction)
        ratio = _dot(point - start, direction) / jnp.where(length > 0, length, 1.0)
        return jnp.clip(jnp.where(length > 0, ratio, 0.0), 0.0, 1.0)

    s, t = closest_on_lines(p0, u, q0, v)
    inside = (s >= 0) & (s <= 1) & (t >= 0) & (t <= 1)
    zero, one = jnp.zeros_like(s), jnp.ones_like(s)
    candidates_s = jnp.stack([jnp.clip(s, 0, 1), zero, one, foot(q0, p0, u), foot(q1, p0, u)], axis=-1)
    candidates_t = jnp.stack([jnp.clip(t, 0, 1), foot(p0, q0, v), foot(p1, q0, v), zero, one], axis=-1)
    apart = (
        (p0 - q0)[..., None, :] + candidates_s[..., None] * u[..., None, :] - candidates_t[..., None] * v[..., None, :]
    )
    squared = jnp.sum(jnp.square(apart), axis=-1)
    # clamping both parameters of an outside solution is no minimum: leave it out
    squared = squared.at[..., 0].set(jnp.where(inside, squared[..., 0], jnp.inf))
    best = jnp.argmin(squared, axis=-1)[..., None]
    s, t = (jnp.take_along_axis(x, best, axis=-1)[..., 0] for x in (candidates_s, candidates_t))
    gap = p0 + s[..., None] * u - q0 - t[..., None] * v
    return rotation.safe_norm(gap), s, t


def capsule_depth(
    p0: Float[AnyArray, "... 3"], p1: Float[AnyArray, "... 3"], p_radius: Float[AnyArray, "..."],
    q0: Float[AnyArray, "... 3"], q1: Float[AnyArray, "... 3"], q_radius: Float[AnyArray, "..."],
) -> Float[Array, "..."]:  # fmt: skip
    """Penetration depth [m] of two capsules (negative: the gap): sum of the radii less the axes' distance."""
    distance, _, _ = segment_distance(p0, p1, q0, q1)
    return jnp.asarray(p_radius) + q_radius - distance


def cylinder_depth(
    p0: Float[AnyArray, "... 3"], p1: Float[AnyArray, "... 3"], p_radius: Float[AnyArray, "..."],
    q0: Float[AnyArray, "... 3"], q1: Float[AnyArray, "... 3"], q_radius: Float[AnyArray, "..."],
) -> Float[Array, "..."]:  # fmt: skip
    """Penetration depth [m] of two *flat-ended* cylinders, by the thesis's reduction (negative: the gap).

    Where the lines come closest inside both cylinders, it is the sum of the radii less that distance. Elsewhere
    the cylinder whose parameter lies further out becomes the disc at that end: the disc's centre is projected on
    the other axis, the direction to it re-projected on the disc's plane, and the disc's rim point in that
    direction gives the gap to the other cylinder's side.
    """
    u, v = p1 - p0, q1 - q0
    s, t = closest_on_lines(p0, u, q0, v)

    def outside(x):
        return jnp.maximum(jnp.maximum(-x, x - 1.0), 0.0)

    def disc_gap(centre, normal, radius, start, direction, other_radius):
        along = jnp.clip(_dot(centre - start, direction) / jnp.maximum(_dot(direction, direction), 1e-12), 0.0, 1.0)
        foot = start + along[..., None] * direction
        axis = rotation.normalize(normal)
        to_foot = foot - centre
        in_plane = to_foot - _dot(to_foot, axis)[..., None] * axis
        # an axis that runs through the disc's centre has no direction in the plane: the rim cannot be told
        reach = jnp.minimum(radius, rotation.safe_norm(in_plane))
        rim = centre + reach[..., None] * rotation.normalize(in_plane)
        foot_of_rim = jnp.clip(_dot(rim - start, direction) / jnp.maximum(_dot(direction, direction), 1e-12), 0.0, 1.0)
        return other_radius - rotation.safe_norm(rim - start - foot_of_rim[..., None] * direction)

    both = p_radius + q_radius - rotation.safe_norm(p0 + s[..., None] * u - q0 - t[..., None] * v)
    p_disc = disc_gap(p0 + jnp.clip(s, 0, 1)[..., None] * u, u, p_radius, q0, v, q_radius)
    q_disc = disc_gap(q0 + jnp.clip(t, 0, 1)[..., None] * v, v, q_radius, p0, u, p_radius)
    length_u, length_v = rotation.safe_norm(u), rotation.safe_norm(v)
    p_is_disc = outside(s) * length_u >= outside(t) * length_v
    reduced = jnp.where(p_is_disc, p_disc, q_disc)
    return jnp.where((outside(s) == 0) & (outside(t) == 0), both, reduced)
