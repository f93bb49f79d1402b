"""Terms that keep the motion itself: small, smooth corrections, and poses near a target."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from motionfit import rotation
from motionfit._motion import Kinematics
from motionfit._problem import Term
from motionfit._types import AnyArray


def _array(x):
    return jnp.asarray(x, dtype=float) if isinstance(x, float | int) else x


class Effort(Term):
    """The alpha x^2 of thesis (4.6) and (4.10): every control near zero.

    Counted per frame instead of per control point, so that neither the knot spacing nor the clip's length shifts
    the balance with the penetration. `sigma` [rad] is one number or one per control.
    """

    sigma: Float[AnyArray, "*controls"] = eqx.field(converter=_array, default=1.0)

    def residual(self, kin: Kinematics) -> Float[Array, "frames controls"]:
        return jnp.asarray(kin.signals) / self.sigma


class Smoothness(Term):
    """Third time derivative of every control near zero: corrections that add little jerk (Flash & Hogan 1985).

    `sigma` [rad/s^3]. The third difference of the frames t - 1 .. t + 2; rows whose stencil leaves the clip are zero.
    """

    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=1000.0)

    @property
    def reach(self) -> int:
        return 2

    def residual(self, kin: Kinematics) -> Float[Array, "frames controls"]:
        s = kin.signals
        bend = (s[3:] - 3 * s[2:-1] + 3 * s[1:-2] - s[:-3]) / kin.dt**3
        return jnp.pad(bend, ((1, 2), (0, 0)))[: len(s)] / self.sigma


class Steadiness(Term):
    """First time derivative of some controls near zero: a stance as wide in one frame as in the next.

    A leg that turns while its foot stands makes the foot slide. `sigma` [rad/s], per control (infinite: it may change
    as it likes). The difference of the frames t and t + 1; the last row is zero.
    """

    sigma: Float[AnyArray, " controls"]

    @property
    def reach(self) -> int:
        return 1

    def residual(self, kin: Kinematics) -> Float[Array, "frames controls"]:
        pace = (kin.signals[1:] - kin.signals[:-1]) / kin.dt
        return jnp.pad(pace, ((0, 1), (0, 0))) / jnp.asarray(self.sigma)


class JointTracking(Term):
    """World positions of some joints near a target: (p - target) / sigma, `target` and `sigma` in [m]."""

    joints: tuple[int, ...] = eqx.field(static=True)
    target_world: Float[AnyArray, "frames tracked 3"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.01)

    def residual(self, kin: Kinematics) -> Float[Array, "frames tracked 3"]:
        return (
            jnp.asarray(kin.positions_world)[:, np.array(self.joints)] - jnp.asarray(self.target_world)
        ) / self.sigma


class RotationTracking(Term):
    """World rotations of some joints near a target: the rotation vector between them over `sigma` [rad]."""

    joints: tuple[int, ...] = eqx.field(static=True)
    target_world: Float[AnyArray, "frames tracked 4"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.05)

    def residual(self, kin: Kinematics) -> Float[Array, "frames tracked 3"]:
        turned = kin.rotations_world[:, np.array(self.joints)]
        return rotation.log(rotation.multiply(rotation.conjugate(self.target_world), turned)) / self.sigma


class Direction(Term):
    """Bones that point where they pointed: unit directions from `start` joints to `end` joints less the target's.

    The sum of squares is 2 sum (1 - cos angle): thesis (4.7), -sum (H - E).(h - e), but for constants. `sigma` is a
    chord: for small angles [rad].
    """

    start: tuple[int, ...] = eqx.field(static=True)
    end: tuple[int, ...] = eqx.field(static=True)
    target_world: Float[AnyArray, "frames bones 3"]
    sigma: Float[AnyArray, ""] = eqx.field(converter=_array, default=0.1)

    def directions(self, kin: Kinematics) -> Float[Array, "frames bones 3"]:
        bones = jnp.asarray(kin.positions_world)[:, np.array(self.end)]
        return rotation.normalize(bones - jnp.asarray(kin.positions_world)[:, np.array(self.start)])

    def residual(self, kin: Kinematics) -> Float[Array, "frames bones 3"]:
        return (self.directions(kin) - jnp.asarray(self.target_world)) / self.sigma
