"""Quaternions (w, x, y, z) and rotation vectors, safe to differentiate everywhere.

Every function broadcasts over leading axes. The last axis holds the components.
"""

import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from motionfit._types import AnyArray


def safe_norm(x: Float[AnyArray, "... n"], axis: int = -1, keepdims: bool = False) -> Float[Array, "..."]:
    """Euclidean norm whose gradient at zero is zero; `jnp.linalg.norm` gives NaN there."""
    squared = jnp.sum(jnp.square(x), axis=axis, keepdims=keepdims)
    # the inner `where` keeps sqrt away from 0, the outer one gives the value: both are needed, since a
    # masked NaN still reaches the gradient
    positive = squared > 0
    return jnp.where(positive, jnp.sqrt(jnp.where(positive, squared, 1.0)), 0.0)


def normalize(x: Float[AnyArray, "... n"]) -> Float[Array, "... n"]:
    """x / |x|; a zero vector stays zero, with a finite gradient."""
    length = safe_norm(x, keepdims=True)
    return jnp.where(length > 0, x / jnp.where(length > 0, length, 1.0), x)


def multiply(a: Float[AnyArray, "... 4"], b: Float[AnyArray, "... 4"]) -> Float[Array, "... 4"]:
    """Hamilton product a b: rotate by b, then by a."""
    aw, ax, ay, az = (a[..., i] for i in range(4))
    bw, bx, by, bz = (b[..., i] for i in range(4))
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def conjugate(q: Float[AnyArray, "... 4"]) -> Float[Array, "... 4"]:
    """The inverse of a unit quaternion."""
    return jnp.asarray(q) * jnp.array([1.0, -1.0, -1.0, -1.0], dtype=jnp.result_type(q))


def rotate(q: Float[AnyArray, "... 4"], v: Float[AnyArray, "... 3"]) -> Float[Array, "... 3"]:
    """The vector v turned by the unit quaternion q: v + 2 w (u x v) + 2 u x (u x v), with u = (x, y, z)."""
    w, x, y, z = (q[..., i] for i in range(4))
    vx, vy, vz = (v[..., i] for i in range(3))
    tx, ty, tz = 2 * (y * vz - z * vy), 2 * (z * vx - x * vz), 2 * (x * vy - y * vx)
    return jnp.stack(
        [
            vx + w * tx + y * tz - z * ty,
            vy + w * ty + z * tx - x * tz,
            vz + w * tz + x * ty - y * tx,
        ],
        axis=-1,
    )


def exp(vector: Float[AnyArray, "... 3"]) -> Float[Array, "... 4"]:
    """Rotation vector [rad] to unit quaternion. exp(0) is (1, 0, 0, 0) exactly."""
    squared = jnp.sum(jnp.square(vector), axis=-1, keepdims=True)
    small = squared < 1e-6
    angle = jnp.sqrt(jnp.where(small, 1.0, squared))
    # sin(a/2)/a and cos(a/2) as Taylor series below 1e-3 rad: their error there is under 1e-14
    scale = jnp.where(small, 0.5 - squared / 48.0, jnp.sin(angle / 2) / angle)
    w = jnp.where(small, 1.0 - squared / 8.0 + squared * squared / 384.0, jnp.cos(angle / 2))
    return jnp.concatenate([w, scale * vector], axis=-1)


def log(q: Float[AnyArray, "... 4"]) -> Float[Array, "... 3"]:
    """Unit quaternion to the shortest rotation vector [rad], |vector| <= pi. log(-q) = log(q)."""
    q = jnp.where(q[..., :1] < 0, -q, q)
    w, u = q[..., :1], q[..., 1:]
    squared = jnp.sum(jnp.square(u), axis=-1, keepdims=True)
    small = squared < 1e-8
    sine = jnp.sqrt(jnp.where(small, 1.0, squared))
    # near the identity 2 atan2(s, w)/s = 2 (1 + s^2/6 + ...) / 1, with w = sqrt(1 - s^2)
    scale = jnp.where(small, 2.0 + squared / 3.0, 2.0 * jnp.arctan2(sine, w) / sine)
    return scale * u


def angle_between(a: Float[AnyArray, "... 4"], b: Float[AnyArray, "... 4"]) -> Float[Array, "..."]:
    """The angle [rad] of the rotation that takes a to b, in 0..pi."""
    return safe_norm(log(multiply(conjugate(a), b)))


def slerp(a: Float[AnyArray, "... 4"], b: Float[AnyArray, "... 4"], t: Float[AnyArray, "..."]) -> Array:
    """The rotation a fraction t of the way from a to b along the shortest arc."""
    return multiply(a, exp(t[..., None] * log(multiply(conjugate(a), b))))


def between(a: Float[AnyArray, "... 3"], b: Float[AnyArray, "... 3"]) -> Float[Array, "... 4"]:
    """The smallest rotation that takes direction a to direction b; opposite directions turn about any
    perpendicular axis, a zero vector gives the identity."""
    a, b = normalize(a), normalize(b)
    dot = jnp.sum(a * b, axis=-1, keepdims=True)
    opposite = dot < -1.0 + 1e-6
    helper = jnp.where(jnp.abs(a[..., :1]) < 0.7, jnp.eye(3)[0], jnp.eye(3)[1]).astype(dot.dtype)
    half_turn = jnp.concatenate([jnp.zeros_like(dot), normalize(jnp.cross(a, helper))], axis=-1)
    q = jnp.concatenate([1.0 + dot, jnp.cross(a, b)], axis=-1)
    return normalize(jnp.where(opposite, half_turn, q))


def to_matrix(q: Float[AnyArray, "... 4"]) -> Float[Array, "... 3 3"]:
    """Unit quaternion to rotation matrix (columns are the rotated axes)."""
    w, x, y, z = (q[..., i] for i in range(4))
    rows = [
        jnp.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=-1),
        jnp.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=-1),
        jnp.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=-1),
    ]
    return jnp.stack(rows, axis=-2)


def matrix_times(m: Float[AnyArray, "... 3 3"], v: Float[AnyArray, "... 3"]) -> Float[Array, "... 3"]:
    """The vectors v turned by the matrices m; written out, since sums over an axis of three are slow on the CPU."""
    m, v = jnp.asarray(m), jnp.asarray(v)
    return m[..., 0] * v[..., 0, None] + m[..., 1] * v[..., 1, None] + m[..., 2] * v[..., 2, None]
